"""Every file of docs/examples, run at a small size, and the page that shows them."""

from __future__ import annotations

import importlib
import importlib.util
import json
import re
import sys
from pathlib import Path

import notebook as notebooks
import numpy as np
import pictures
import pytest
from mpi4py import MPI

from dem.experiment import from_file
from dem.scene import Scene
from pctt.run.options import read_options
from pctt.simulation import Simulation

ROOT = Path(__file__).resolve().parents[1]
EXAMPLES = ROOT / "docs" / "examples"
PICTURE_BYTES = 150_000


@pytest.fixture(autouse=True)
def imports(monkeypatch):
    """The examples import each other, as files of one folder do."""
    monkeypatch.syspath_prepend(str(EXAMPLES))


def run(name: str, steps: int, **options: str) -> tuple[object, dict[str, np.ndarray]]:
    """The scene of an example and the records of its first steps."""
    words = {"scene": str(EXAMPLES / f"{name}.py"), "ccp_type": "apgd", **options}
    given = read_options(words, MPI.COMM_SELF)
    with Simulation(given.scene, given.settings, comm=MPI.COMM_SELF) as sim:
        rows = [sim.step() for _ in range(steps)]
    return given.scene, {column: np.array([row[column] for row in rows]) for column in rows[0]}


def test_the_page_shows_every_example_and_its_picture(monkeypatch):
    monkeypatch.syspath_prepend(str(ROOT / "docs"))
    listed = {path.stem for path in EXAMPLES.glob("*.py")} - {"integral_problems", "comparison"}
    page = importlib.import_module("pages").gallery()
    assert set(re.findall(r"\]\(examples/(\w+)\.py\)", page)) == listed
    assert sorted(re.findall(r":img-top: examples/(\w+)\.png", page)) == pictures.pictured()
    for name in pictures.pictured():
        assert (EXAMPLES / f"{name}.png").stat().st_size < PICTURE_BYTES


def test_the_commands_in_the_heads_name_the_files_and_known_options():
    for name in pictures.STEPS:
        *_, simulate, draw = pictures.commands(EXAMPLES / f"{name}.py")
        words = dict(zip(simulate[2:], simulate[3:]))
        assert draw[:3] == ["-m", "pctt.render", name]
        if simulate == [f"docs/examples/{name}.py", name]:  # a program of its own
            continue
        assert simulate[:2] == ["-m", "pctt.run"]
        assert words["-scene"] == f"docs/examples/{name}.py"
        assert words["-output"] == name
        assert pictures.STEPS[name] <= int(words["-steps"])
        assert pictures.STEPS[name] % int(words["-output_every"]) == 0


def test_a_sliding_box_and_a_rolling_sphere_have_the_textbooks_accelerations():
    scene, records = run("incline", 10, ccp_tol="1e-8", ccp_type="apgd", stiffness="inf")
    found = scene.analyse(records)
    assert found["sphere_acceleration [m/s^2]"] == pytest.approx(5 / 7 * 9.81 * np.sin(np.radians(25)), rel=1e-7)
    assert abs(found["box_error [m/s^2]"]) < 1e-6
    assert abs(found["sphere_error [m/s^2]"]) < 1e-6


def test_a_slope_on_which_the_box_would_stick_is_refused():
    with pytest.raises(ValueError, match=r"angle 10: its tangent must be between"):
        from_file(EXAMPLES / "incline.py")(angle=10.0)


def test_the_halves_of_the_drum_begin_apart():
    _, records = run("drum", 3, scene_radius="0.03", scene_length="0.02", scene_settling_time="0")
    assert 0.5 < records["separation"][-1] < 1.5
    assert records["force_side_z [N]"].min() <= 0


def test_the_hopper_keeps_its_grains_until_the_gate_opens():
    scene, records = run("hopper", 40, scene_layers="2", scene_settling_time="0.08", scene_outlet="0.04")
    out = records["discharged [kg]"]
    assert (out[:18] == 0).all()
    assert out[-1] > 0
    assert (np.diff(out) >= 0).all()
    assert set(scene.analyse(records)) <= {"flow [kg/s]", "flux [kg/(m^2 s)]"}


def test_the_plough_feels_the_bed():
    scene, records = run("blade", 20, scene_settling_time="0", scene_speed="1.0")
    assert records["draft [N]"].max() > 0
    assert scene.analyse(records)["mean_draft [N]"] > 0


def test_both_sizes_fall_in_the_shaken_box():
    _, records = run("vibrated", 20, scene_n="3")
    assert (np.diff(records["large_z [m]"]) < 0).any()
    large, small = records["large_z [m]"], records["small_z [m]"]
    np.testing.assert_allclose(records["segregation"], (large - small) / (large + small))


@pytest.mark.parametrize("shape", ["dodecahedra", pytest.param("stones", marks=pytest.mark.slow)])
def test_the_sleeper_comes_down_on_the_ballast(shape):
    _, records = run("ballast", 120, scene_n="2", scene_settling_time="0", scene_shape=shape)
    assert records["force_sleeper_z [N]"].max() > 500
    assert records["sleeper [m]"][0] > records["sleeper [m]"][-1] > 0.0


def test_ballast_of_an_unknown_shape_is_refused():
    with pytest.raises(ValueError, match="shape cones: allowed is one of stones"):
        from_file(EXAMPLES / "ballast.py")(shape="cones")


def test_the_belt_carries_the_capsules():
    _, records = run("conveyor", 100, scene_layers="1", dt="0.0071")
    assert records["arrived"][-1] > 0
    assert records["lost"][-1] == 0
    assert records["power [W]"].sum() > 0


@pytest.mark.slow
def test_the_feeder_carries_to_its_end_what_its_source_feeds():
    scene, records = run("feeder", 400, scene_rate="8", scene_speed="8", dt="0.004", scene_radius="0.03")
    came, left = records["mass_feed [kg]"], records["mass_end [kg]"]
    assert left[-1] > 0
    assert (np.diff(came) >= 0).all()
    largest = 2500 * 4 / 3 * np.pi * 0.04**3
    time = records["time [s]"] - 0.004  # grains come before a step
    assert ((8 * time - came > -1e-9) & (8 * time - came < largest)).all()
    assert scene.analyse(records)["held [kg]"] == came[-1] - left[-1] > 0


def test_the_wheel_drives_itself_with_its_load():
    _, records = run("wheel", 100, scene_settling_time="0.1", scene_length="16")
    assert np.mean(records["slip"][50:]) < 0.7
    assert np.mean(records["pull [W]"][50:]) > 0
    assert records["height [m]"][-1] < records["height [m]"][0]


def test_the_bucket_is_a_scene_with_a_tool_from_a_file(tmp_path, monkeypatch):
    pytest.importorskip("trimesh", reason="trimesh is not installed (extra `meshes`)")
    monkeypatch.setattr(sys, "argv", ["bucket.py", str(tmp_path / "bucket.stl")])
    exec(compile((EXAMPLES / "bucket.py").read_text(), "bucket.py", "exec"), {"__name__": "__main__"})
    scene = from_file(EXAMPLES / "bucket.py")(file=str(tmp_path / "bucket.stl")).build()
    assert isinstance(scene, Scene)
    assert [body.name for body in scene.large_bodies] == ["tray", "bucket"]
    _, records = run("bucket", 2, scene_file=str(tmp_path / "bucket.stl"))
    assert records["lifted [kg]"].tolist() == [0.0, 0.0]
    _, records = run("bucket", 2, scene_file=str(tmp_path / "bucket.stl"), scene_grains="stones")
    assert 0 < records["lifted [kg]"][0] < 1  # the uppermost layers, before they settle
    with pytest.raises(ValueError, match="grains cubes: allowed are spheres and stones"):
        from_file(EXAMPLES / "bucket.py")(grains="cubes")


def test_the_bucket_digs_in_the_bed_that_it_meets():
    """Without gravity, in a bed that rests: its lip is on a circle, and what it pushes against pushes back."""
    scene = importlib.import_module("dig").digging()
    scene.gravity = np.zeros(3)
    with Simulation(scene, comm=MPI.COMM_SELF, dt=0.005, delta=0.002) as sim:
        bucket, turned = sim.body("bucket"), 0.9 * 0.5
        sim.run(steps=60)
        assert (bucket.force == 0).all()
        sim.run(until=0.8)
        np.testing.assert_allclose(2 * np.arctan2(bucket.orientation[2], bucket.orientation[0]), 1 - turned, atol=1e-9)
        assert np.linalg.norm(sim.velocities[:, :3], axis=1).max() < 0.4 * 0.9 * 1.5
        assert bucket.force[0] < 0


def test_the_accelerations_of_the_sweep_are_those_of_theory():
    """The relaxation lifts the box off the slope in the first step, which it then loses."""
    rows = importlib.import_module("sweep").main()
    assert len(rows) == 8
    for friction, law, value, theory in rows:  # of contacts that settle into their springs
        assert value == pytest.approx(theory, abs=1e-3 if law == "Coulomb" or friction in (0.0, 0.6) else 0.01)


def test_the_notebook_runs_and_shows_what_its_file_has(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    path = EXAMPLES / "simulation.ipynb"
    try:
        pictures = importlib.import_module("pctt.look.surfaces") and importlib.util.find_spec("PIL")
    except ModuleNotFoundError:
        pictures = None
    notebook, names = notebooks.run(path, skipped=() if pictures else ("pictures",))
    stored = json.loads(path.read_text())
    for here, there in zip(notebook["cells"], stored["cells"]):
        assert here["source"] == there["source"]
        outputs = [cell.get("outputs", []) for cell in (here, there)]
        one, two = ([(output["output_type"], sorted(output.get("data", {}))) for output in each] for each in outputs)
        assert one == two
    assert names["run"].output.analysis is not None
    assert abs(names["stirrer"].velocity[5]) < 0.2  # the servo stands still
    assert names["means"][2.0] > names["means"][8.0]  # the bed resists
    assert path.stat().st_size < PICTURE_BYTES


def test_poisson(tmp_path, capsys):
    iterations = importlib.import_module("poisson").main(16)
    assert iterations["tensor train, rank 24"] < iterations["none"]
    # the series for the middle of the square is 0.0737; the grid has no point there
    assert "greatest u 0.07" in capsys.readouterr().out


def test_elasticity_agrees_with_beam_theory(capsys):
    importlib.import_module("elasticity").main(4)
    said = re.findall(r"deflection of the end ([\d.]+)", capsys.readouterr().out)
    assert len(set(said)) == 1  # all preconditioners lead to the same
    assert float(said[0]) == pytest.approx(349.44, rel=0.1)


def test_an_integral_equation():
    iterations, residual = importlib.import_module("integral_equation").main(32)
    assert iterations <= 10
    assert residual < 1e-8


@pytest.mark.parametrize("name", ["poisson", "elasticity", "integral_equation"])
def test_pictures_of_solutions(name, tmp_path, monkeypatch):
    matplotlib = pytest.importorskip("matplotlib", reason="matplotlib is not installed (extra `figures`)")
    matplotlib.use("agg")
    importlib.import_module(name).main(8, str(tmp_path / "picture.png"))
    assert (tmp_path / "picture.png").stat().st_size > 1000


@pytest.mark.parametrize("name", ["fredholm", "gaussian_process", "lippmann_schwinger", "yukawa"])
def test_comparisons_on_small_grids(name, capsys):
    problem = getattr(importlib.import_module("integral_problems"), name)(8)
    v = np.random.default_rng(0).standard_normal(problem.size)
    A = problem.entries(*np.indices((problem.size, problem.size)).reshape(2, -1)).reshape(problem.size, -1)
    np.testing.assert_allclose(problem.product()(v), A @ v)  # products by FFT are those of the entries
    importlib.import_module("comparison").compare(problem, eps=1e-6)
    said = capsys.readouterr().out
    assert "CG + train, FFT products" in said
    assert "dense Cholesky" in said
    assert ("CG + circulant" in said) == (name != "lippmann_schwinger")  # no convolution
    assert "compare(" in (EXAMPLES / f"{name}.py").read_text()


@pytest.mark.parametrize(("name", "n"), [("gaussian_process", 6), ("yukawa", 4)])
def test_the_circulant_has_the_means_of_the_matrix(name, n):
    """It is the circulant nearest to A (T. Chan): each entry the mean of those of A that it stands for."""
    problem = getattr(importlib.import_module("integral_problems"), name)(n)
    i, j = (k.ravel() for k in np.indices((problem.size, problem.size)))
    A = problem.entries(i, j)
    x, y = (np.array(np.unravel_index(k, problem.grid)) for k in (i, j))
    offset = np.ravel_multi_index(tuple((x - y) % n), problem.grid)
    means = np.bincount(offset, A) / np.bincount(offset)
    C = means[offset].reshape(problem.size, -1)
    v = np.random.default_rng(0).standard_normal(problem.size)
    np.testing.assert_allclose(problem.circulant()(C @ v), v, atol=1e-10)


def test_arm_digs_within_the_torques_of_its_motors():
    shoulder, wrist = importlib.import_module("arm").main(until=0.2)
    assert 0.0 < wrist < 100.0
    assert 0.0 < shoulder <= 1.2 * 400.0


# -- cone problems of others ------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def half_space():
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(EXAMPLES))
        return importlib.import_module("half_space")


@pytest.mark.parametrize("coupled", [False, True])
def test_the_half_space_has_the_displacements_of_point_forces_far_away(half_space, coupled):
    """Boussinesq and Cerruti (Johnson, sections 3.2, 3.6), and N is symmetric and positive definite."""
    n, a, nu = 8, 0.01, half_space.NU
    K = half_space.influence(n, a, coupled)
    x, y = -5 * a, 6 * a
    r, bodies = np.hypot(x, y), 1 if coupled else 2
    of = bodies / (2 * np.pi * half_space.G)
    side = of * (0.5 - nu) * coupled / r**2  # a normal force draws its surroundings near
    expected = [
        [of * (1 - nu) / r, side * x, side * y],
        [-side * x, of * ((1 - nu) / r + nu * x**2 / r**3), of * nu * x * y / r**3],
        [-side * y, of * nu * x * y / r**3, of * ((1 - nu) / r + nu * y**2 / r**3)],
    ]
    np.testing.assert_allclose(K[:, :, -5, 6], expected, rtol=5e-3, atol=1e-12 * of / r)
    given = half_space.operator(n, K)
    N = np.array([given.mult(row.reshape(-1, 3)).ravel() for row in np.eye(3 * n * n)])
    np.testing.assert_allclose(N, N.T, atol=1e-14 * abs(N).max())
    assert np.linalg.eigvalsh(N)[0] > 0.01 * np.linalg.eigvalsh(N)[-1]
    np.testing.assert_allclose(N[3:6, 3:6], given.blocks[1], atol=1e-14 * abs(N).max())


def test_a_smooth_ball_obeys_hertz_and_cattaneo_and_mindlin(half_space):
    n, theory = 48, half_space.Theory
    shifts = theory.shift * np.array([0.0, 0.3, 0.8, 1.2])
    states = half_space.press_and_shift(np.zeros((n, n)), shifts)
    for shift, state in zip(shifts, states):
        normal, tangential, across = state.totals
        assert normal == pytest.approx(theory.normal, rel=2e-3)
        assert tangential / (half_space.FRICTION * normal) == pytest.approx(theory.tangential(shift), abs=2e-3)
        assert abs(across) < 1e-6 * normal
        touching, stuck = (state.zones > 0).sum(), (state.zones == 2).sum()
        assert touching * (half_space.LENGTH / n) ** 2 == pytest.approx(np.pi * theory.radius**2, rel=0.03)
        assert np.sqrt(stuck / touching) == pytest.approx(theory.stick(shift), abs=0.03)
        np.testing.assert_allclose(state.force[::-1, ::-1], state.force, atol=1e-4 * state.force.max())
        pressure, friction = theory.tractions(half_space.points(n)[:, n // 2, 0], shift)
        found = state.force[:, n // 2, :2].T * (n / half_space.LENGTH) ** 2
        inside = pressure > 0.4 * theory.pressure  # at the rim points are partly in contact
        np.testing.assert_allclose(found[0, inside], pressure[inside], rtol=0.02)
        np.testing.assert_allclose(found[1, inside], friction[inside], atol=0.02 * theory.pressure)


def test_each_point_of_a_rough_ball_obeys_the_law_of_friction(half_space):
    """What slides has the traction of its limit, against its slip; what sticks has not slid in the step."""
    n = 48
    states = half_space.press_and_shift(half_space.roughness(n), half_space.Theory.shift * np.array([0.0, 0.5]), True)
    for before, state in zip([None, *states], states):
        slip = state.slip - (0 if before is None else before.slip)
        limit = half_space.FRICTION * state.force[..., 0]
        size = np.linalg.norm(state.force[..., 1:], axis=2)
        assert (size <= limit * (1 + 1e-6)).all()
        moved = np.linalg.norm(slip, axis=2)
        assert (state.force[..., 1:] * slip).sum(axis=2).max() <= 1e-4 * (limit * moved).max()
        far = (state.zones == 1) & (moved > 0.05 * moved[state.zones > 0].max())
        cosine = (state.force[..., 1:] * slip).sum(axis=2)[far] / (limit * moved)[far]
        np.testing.assert_allclose(cosine, -1, atol=1e-2)
        assert moved[state.zones == 2].max() < 1e-3 * moved.max()
        touching = (state.zones > 0).sum() * (half_space.LENGTH / n) ** 2
        assert touching < 0.9 * np.pi * half_space.Theory.radius**2


def test_a_rough_ball_has_the_pressures_of_tamaas(half_space):
    """Without friction it is the problem of Polonsky and Keer 1999, whose conjugate gradients tamaas has."""
    tamaas = pytest.importorskip("tamaas", reason="tamaas is not installed")
    n, kinds = 48, tamaas.model_type
    heights = half_space.roughness(n)
    (state,) = half_space.press_and_shift(heights, np.zeros(1), tol=1e-8)
    model = tamaas.ModelFactory.createModel(kinds.basic_2d, [half_space.LENGTH] * 2, [n, n])
    model.E, model.nu = half_space.G / (1 - half_space.NU), 0.0  # of both bodies together
    tamaas.ModelFactory.registerNonPeriodic(model, "dcfft")
    ball = heights - (half_space.points(n) ** 2).sum(axis=2) / (2 * half_space.RADIUS)
    solver = tamaas.PolonskyKeerRey(model, np.ascontiguousarray(ball), 1e-12)
    solver.setIntegralOperator("dcfft")
    solver.solve(state.totals[0] / half_space.LENGTH**2)
    expected = np.asarray(model.traction) * (half_space.LENGTH / n) ** 2
    np.testing.assert_allclose(state.force[..., 0], expected, atol=1e-6 * expected.max())


@pytest.fixture(scope="module")
def block():
    pytest.importorskip("skfem", reason="scikit-fem is not installed (extra `examples`)")
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(EXAMPLES))
        return importlib.import_module("block")


def test_a_block_without_friction_has_uniform_pressure(block):
    """Held by planes of symmetry and a smooth top it has the stress of a bar, and widens by Poisson's ratio."""
    bar = block.Block(3, friction=0.0)
    x = bar.mesh.p
    bar.held = np.array([x[0] == 0, x[1] == 0, x[2] == block.SIZE[2]])
    (state,) = bar.move(np.array([[0.0, 0.0, -0.3]]))
    strain = 0.3 / block.SIZE[2]
    np.testing.assert_allclose(state.force[:, 0], block.YOUNG * strain * bar.area, rtol=1e-6)
    np.testing.assert_allclose(state.u, np.array([[block.NU], [block.NU], [-1]]) * strain * x, atol=1e-8)
    np.testing.assert_allclose(bar.stress(state.u), block.YOUNG * strain, rtol=1e-6)


def test_a_block_sticks_then_slides_with_the_force_of_its_friction(block, capsys):
    states = block.main(3)
    shape = block.Block(3)
    x, y = shape.mesh.p[:2, shape.floor]
    mirror = np.lexsort([x, block.SIZE[1] - y])
    for before, state in zip([None, *states], states):
        force, u = state.force, state.u[:, shape.floor]
        np.testing.assert_allclose(state.held + force.sum(axis=0)[[1, 2, 0]], 0, atol=1e-9 * force.sum())
        np.testing.assert_allclose(force[mirror] * [1, 1, -1], force, atol=1e-5 * force.max())  # the plane y = 10 mm
        assert u[2].min() > -1e-7
        assert (np.minimum(force[:, 0], 0) == 0).all()
        assert (force[:, 0] * u[2]).sum() < 1e-7 * force[:, 0].sum()
        slip = (u if before is None else u - before.u[:, shape.floor])[:2].T
        limit, size = block.FRICTION * force[:, 0], np.linalg.norm(force[:, 1:], axis=1)
        assert (size <= limit * (1 + 1e-9)).all()
        work = (force[:, 1:] * slip).sum()  # the greatest that friction can take
        assert work == pytest.approx(-(limit * np.linalg.norm(slip, axis=1)).sum(), rel=1e-6, abs=1e-7 * force.max())
    sticking = [state.result.counts.sticking for state in states[1:]]
    assert sticking == sorted(sticking, reverse=True)
    assert sticking[0] > sticking[-1] == 0  # the part that sticks shrinks
    shear, normal = -states[-1].force[:, 1].sum(), states[-1].force[:, 0].sum()
    assert shear == pytest.approx(block.FRICTION * normal, rel=0.01)
    assert "shear / normal" in capsys.readouterr().out


def test_the_block_says_what_it_needs(monkeypatch):
    monkeypatch.setitem(sys.modules, "skfem", None)
    monkeypatch.delitem(sys.modules, "block", raising=False)
    with pytest.raises(SystemExit, match=r"^block.py needs scikit-fem: pip install 'pctt\[examples\]', or "):
        importlib.import_module("block")


@pytest.mark.parametrize(("name", "n"), [("half_space", 36), ("block", 3)])
def test_pictures_of_cone_problems(name, n, tmp_path, monkeypatch):
    matplotlib = pytest.importorskip("matplotlib", reason="matplotlib is not installed (extra `figures`)")
    if name == "block":
        pytest.importorskip("skfem", reason="scikit-fem is not installed (extra `examples`)")
    matplotlib.use("agg")
    example = importlib.import_module(name)
    monkeypatch.setattr(example, "STEPS", 2)
    example.main(n, str(tmp_path / "picture.png"))
    assert (tmp_path / "picture.png").stat().st_size > 10_000
