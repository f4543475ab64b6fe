"""Contacts of a stated stiffness have the closed forms of springs, whatever the time step is."""

from __future__ import annotations

import numpy as np
import pytest

import pctt
from dem.motion import Glide, Rotation
from dem.scene import Scene
from dem.shapes import Box, Plane
from dem.start.stiffness import (
    DAMPING,
    RESISTS,
    STOPPED,
    compliance,
    expected_overlap,
    of_youngs_modulus,
    pairs,
    recommended,
)
from pctt import ccp
from pctt.scenes import Mixer

R, DENSITY, G = 0.1, 2500.0, 9.81
MASS = DENSITY * 4 / 3 * np.pi * R**3
EXACT = {"tol": 1e-10, "closing_work": np.inf, "delta": 0.01}


def column(stiffness: float | None, count: int = 5, squeezed: float = 0.0) -> Scene:
    """Spheres on top of each other on a floor, each squeezed by so much [m] into the next."""
    scene = Scene(friction=0.3, stiffness=stiffness)
    scene.add_body("floor", [Plane((0, 0, 1))])
    scene.add_spheres([[0, 0, (2 * R - squeezed) * (k + 0.5)] for k in range(count)], R, DENSITY)
    return scene


@pytest.mark.parametrize(
    "settings",
    [{"solver": solver, "law": ccp.COULOMB} for solver in ("apgd", "pdip", "conic")]
    + [{"solver": "apgd", "law": ccp.RELAXATION}]
    + [{"solver": "apgd", "dt": dt} for dt in (0.002, 0.02)],
    ids=repr,
)
def test_a_column_rests_on_the_overlaps_that_its_weight_makes(settings):
    stiffness = 1e6
    with pctt.Simulation(column(stiffness), **{"dt": 0.01, **settings, **EXACT}) as sim:
        sim.run(until=0.35)
        height = sim.positions[:, 2]
        overlap = 2 * R - np.diff(np.concatenate([[-R], height]))
        expected = MASS * G * np.arange(5, 0, -1) / stiffness
        np.testing.assert_allclose(overlap, expected, rtol=1e-4)
        np.testing.assert_allclose(sim.body("floor").force, [0, 0, -5 * MASS * G], atol=1e-3 * MASS * G)
        assert sim.figures["spring_energy [J]"] == pytest.approx(0.5 * stiffness * (expected**2).sum(), rel=1e-3)


def heads_on(stiffness: float, dt: float, steps: int) -> tuple[np.ndarray, float]:
    """Velocities along x of two spheres after they have met at 2 m/s, and the energy lost by then."""
    scene = Scene(friction=0.0, gravity=(0, 0, 0), stiffness=stiffness)
    for side in (-1, 1):
        scene.add_spheres([[side * 1.01 * R, 0, 0]], R, DENSITY, velocity=(-side * 1.0, 0, 0))
    with pctt.Simulation(scene, dt=dt, solver="apgd", **EXACT) as sim:
        lost = 0.0
        for _ in range(steps):
            lost += sim.step()["impact_loss [J]"]
        return sim.velocities[:, 0], lost


@pytest.mark.parametrize("dt", [2e-5, 1e-4, 1e-3, 1e-2])
def test_an_impact_takes_nearly_all_speed_whatever_the_step(dt):
    """5 % are left where the step resolves the impact (Schwager, Poeschel 2007), and none where it is longer."""
    velocity, lost = heads_on(1e7, dt, max(30, int(0.006 / dt)))
    assert velocity.sum() == pytest.approx(0.0, abs=1e-9)
    assert -1e-9 <= velocity[1] <= 0.055
    if dt == 2e-5:
        assert velocity[1] == pytest.approx(0.048, abs=0.003)
    assert lost == pytest.approx(MASS - MASS * velocity[1] ** 2, rel=0.02)


def test_the_limit_of_great_stiffness_is_the_rigid_contact():
    """From steps on that are longer than impacts of free spheres, these are rigid."""
    velocities = [heads_on(k, 1e-3, 20)[0] for k in (1e6, 1e7, 1e9, np.inf)]
    off = [np.abs(velocity - velocities[-1]).max() for velocity in velocities[:-1]]
    assert off[0] > off[1] > 1e-3
    assert off[2] < 1e-8


@pytest.mark.parametrize("dt", [1e-3, 1e-2])
def test_what_was_squeezed_gives_back_at_most_what_it_holds(dt):
    """The energy of motion, weight and springs never rises."""
    stiffness, squeezed = 1e6, 0.0009
    scene = column(stiffness, squeezed=squeezed)
    held = 0.5 * stiffness * squeezed**2 * 5
    with pctt.Simulation(scene, dt=dt, solver="apgd", **EXACT) as sim:
        start, whole = MASS * G * sim.positions[:, 2].sum(), []
        for _ in range(int(0.15 / dt)):
            row = sim.step()
            whole.append([row[f"{name} [J]"] for name in ("kinetic_energy", "potential_energy", "spring_energy")])
    total = np.sum(whole, axis=1) - start
    assert (total < 1.001 * held).all()
    assert (np.diff(total) < 1e-3 * held).all()


@pytest.mark.parametrize("steps", [100, pytest.param(10_000, marks=pytest.mark.slow)])
def test_a_block_on_an_incline_does_not_creep(steps):
    """A sticking contact under a constant load does not move: its spring remembers what it holds."""
    angle = np.radians(15.0)
    scene = Scene(friction=0.5, gravity=(G * np.sin(angle), 0, -G * np.cos(angle)), stiffness=1e6)
    scene.add_body("floor", [Plane((0, 0, 1))])
    scene.add_boxes([[0, 0, 0.05]], (0.2, 0.15, 0.05), DENSITY)
    with pctt.Simulation(scene, dt=0.01, solver="apgd", **{**EXACT, "tol": 1e-8}) as sim:
        sim.run(steps=100)
        before = sim.positions[0]
        sim.run(steps=steps)
        moved = np.abs(sim.positions[0] - before).max()
    assert moved < 1e-8 * steps


@pytest.mark.parametrize(("solver", "dt"), [("apgd", 0.004), ("apgd", 0.01), ("conic", 0.01)])
def test_friction_gives_way_by_a_spring_and_gives_back(solver, dt):
    """A box on four contacts, each of k_t = 2/7 k, that a force pulls aside: by F / 4 k_t, and then lets go."""
    stiffness, force = 1e6, 40.0  # with twice as much, as it swings, no contact slides
    scene = Scene(friction=0.5, stiffness=stiffness)
    scene.add_body("floor", [Plane((0, 0, 1))])
    scene.add_boxes([[0, 0, 0.05]], (0.2, 0.15, 0.05), DENSITY)
    scene.add_load("push", force=(force, 0, 0), start=0.2, end=0.4)
    with pctt.Simulation(scene, dt=dt, solver=solver, **EXACT) as sim:
        place, energy = [], []
        for until in (0.2, 0.4, 0.6):
            sim.run(until=until)
            place.append(sim.positions[0, 0])
            energy.append(sim.figures["spring_energy [J]"])
    springs = 4 * 2 / 7 * stiffness
    np.testing.assert_allclose(np.diff(place), np.array([1, -1]) * force / springs, rtol=0.05)  # it tilts by 2 %
    np.testing.assert_allclose(np.diff(energy), np.array([1, -1]) * 0.5 * force**2 / springs, rtol=0.1)


def test_the_recommended_stiffness_holds_the_bed_and_the_tool():
    scene = column(None, count=20)
    stiffness = recommended(scene)
    assert pairs(scene).stiffness.tolist() == [[stiffness]]
    assert expected_overlap(scene, stiffness, 0.01) == pytest.approx(0.003, rel=0.05)
    assert stiffness == pytest.approx(4 * 20 * MASS * G / (0.003 * R), rel=0.05)
    with pctt.Simulation(scene, dt=0.01, solver="apgd", **EXACT) as sim:
        sim.run(steps=50)
        assert sim.figures["worst_overlap [m]"] <= 0.0031 * R / 4
    for motion, speed in ((Glide((0, 3.0, 0)), 3.0), (Rotation((0, 0, 2.0)), 2.0 * np.sqrt(3.0))):
        scene = Scene(friction=0.3, gravity=(0, 0, 0))
        scene.add_body("tool", [Box((1.0, 1.0, 1.0))], motion)
        scene.add_spheres([[0, 0, 2]], R, DENSITY)
        assert recommended(scene) == pytest.approx(MASS * (speed / (0.003 * R)) ** 2, rel=0.05)
    scene.leaving.add("tool")
    assert recommended(scene) == np.inf
    bed = column(None, count=20)
    bed.add_body("tool", [Box((1.0, 1.0, 1.0))], Glide((0, 3.0, 0)), position=(0, 5, 0))
    assert recommended(bed) == pytest.approx(RESISTS * stiffness, rel=0.05)  # a bed gives way before a chain does
    assert expected_overlap(bed, recommended(bed), 0.01) == pytest.approx(0.003, rel=0.05)
    alone = column(None, count=1)
    alone.add_body("tool", [Box((1.0, 1.0, 1.0))], Glide((0, 30.0, 0)), position=(0, 5, 0))
    assert recommended(alone) == pytest.approx(MASS * (STOPPED * 30.0 / (0.003 * R)) ** 2, rel=0.05)
    idle = Scene(friction=0.3, gravity=(0, 0, 0))
    idle.add_spheres([[0, 0, 0]], R, DENSITY)
    assert recommended(idle) == np.inf


def test_how_far_a_grain_goes_into_a_contact_that_stops_it():
    """Of v sqrt(m / k), by the closed form of a spring with twice the critical damping."""
    stiffness, speed = 1e6, 0.5
    time = np.sqrt(MASS / stiffness)
    scene = Scene(friction=0.0, stiffness=stiffness, gravity=(0, 0, 0))
    scene.add_body("floor", [Plane((0, 0, 1))])
    scene.add_spheres([[0, 0, R]], R, DENSITY, velocity=[[0, 0, -speed]])
    with pctt.Simulation(scene, dt=0.01 * time, solver="apgd", **EXACT) as sim:
        overlaps = [sim.step()["worst_overlap [m]"] for _ in range(120)]
    slow, fast = DAMPING - np.sqrt(DAMPING**2 - 1), DAMPING + np.sqrt(DAMPING**2 - 1)
    at = np.log(fast / slow) / (fast - slow)
    most = (np.exp(-slow * at) - np.exp(-fast * at)) / (fast - slow)
    assert most == pytest.approx(STOPPED, rel=0.01)
    assert max(overlaps) == pytest.approx(most * speed * time, rel=0.02)


def test_pairs_of_materials_and_moduli():
    scene = Scene(friction=0.3, stiffness=2e6)
    scene.add_spheres([[0, 0, 0], [1, 0, 0]], R, DENSITY, material="glass")
    scene.add_spheres([[2, 0, 0]], R, DENSITY, material="steel")
    scene.set_pair("steel", "steel", stiffness=np.inf)
    scene.set_pair("steel", "glass", stiffness=of_youngs_modulus(7e7, R))
    np.testing.assert_array_equal(pairs(scene).stiffness, [[2e6, 7e6], [7e6, np.inf]])
    assert scene.states_stiffness
    assert not Scene(friction=0.3).states_stiffness
    assert compliance(np.inf, 1.0, 0.01) == (0.0, 0.0, 1.0)
    normal, tangential, share = compliance(1e6, 1.0, 0.01)
    assert normal == pytest.approx(1 / (1e6 * 1e-4 + 4 * 1e3 * 0.01))
    assert tangential == pytest.approx(normal / (2 / 7))
    assert share == pytest.approx(normal * 1e6 * 1e-4)
    for bad in (0.0, -1.0, np.nan):
        with pytest.raises(ValueError, match="stiffness must be positive, or inf"):
            scene.set_pair("glass", "glass", stiffness=bad)


def test_the_balance_of_energy_of_a_step_has_its_springs_before_and_after():
    with pctt.Simulation(Mixer(n=1), dt=0.01) as sim:
        sim.run(steps=60)
        before = sim.figures
        for _ in range(10):
            now = sim.step()
            change = sum(now[name] - before[name] for name in ("kinetic_energy [J]", "potential_energy [J]"))
            change += now["spring_energy [J]"] - now["spring_energy_before [J]"]
            gain = now["work_of_motions [J]"] + now["time_stepping [J]"]
            loss = now["friction_loss [J]"] + now["impact_loss [J]"]
            assert change == pytest.approx(gain - loss, abs=1e-9 * before["potential_energy [J]"])
            before = now
        assert now["spring_energy [J]"] > 0.0


def test_the_springs_of_impacts_hold_no_energy_that_nobody_gave():
    """Tetrahedra that fly together: the energy of motion, weight and springs never rises, and no impact is a gain. What
    the tolerance and turning edges leave of overlaps would be joules, times such a stiffness."""
    rng = np.random.default_rng(5)
    place = 3.0 * R * (np.stack(np.meshgrid(*[np.arange(3)] * 3, indexing="ij"), axis=-1).reshape(-1, 3) - 1.0)
    scene = Scene(friction=0.4, stiffness=1e9)
    scene.add_body("floor", [Plane((0, 0, 1), (0, 0, -5.0 * R))])
    corners = R * np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1.0]])
    scene.add_polyhedra(place, corners, DENSITY, velocity=-6.0 * place + rng.normal(size=place.shape))
    with pctt.Simulation(scene, dt=0.002) as sim:
        whole, gained = [], []
        for _ in range(80):
            row = sim.step()
            names = "kinetic_energy", "potential_energy", "spring_energy"
            whole.append(sum(row[f"{name} [J]"] for name in names))
            gained.append(-row["impact_loss [J]"])
    scale = whole[0] - whole[-1]
    assert np.diff(whole).max() < 1e-3 * scale
    assert max(gained) < 1e-3 * scale
