"""Every file of docs/examples, run at a small size, and the page that shows them."""

from __future__ import annotations

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
PAGE = (ROOT / "docs" / "examples.md").read_text()
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


def test_the_page_shows_every_example_and_its_picture():
    listed = {path.stem for path in EXAMPLES.glob("*.py")} - {"integral_problems", "comparison"}
    assert set(re.findall(r"\]\(examples/(\w+)\.py\)", PAGE)) == listed
    assert sorted(re.findall(r"\]\(examples/(\w+)\.png\)", PAGE)) == pictures.pictured()
    for name in pictures.pictured():
        assert (EXAMPLES / f"{name}.png").stat().st_size < PICTURE_BYTES


def test_the_commands_in_the_heads_name_the_files_and_known_options():
    for name in pictures.STEPS:
        *_, simulate, draw = pictures.commands(EXAMPLES / f"{name}.py")
        words = dict(zip(simulate[2:], simulate[3:]))
        assert simulate[:2] == ["-m", "pctt.run"]
        assert words["-scene"] == f"docs/examples/{name}.py"
        assert words["-output"] == name
        assert draw[:3] == ["-m", "pctt.render", name]
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


@pytest.mark.parametrize("shape", ["stones", "dodecahedra"])
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
    _, records = run("wheel", 200, scene_settling_time="0.1", scene_length="16")
    assert np.mean(records["slip"][100:]) < 0.7
    assert np.mean(records["pull [W]"][100:]) > 0
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
