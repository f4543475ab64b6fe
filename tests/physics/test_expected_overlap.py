"""What a scene promises of its overlaps by default holds: at rest, in falls, under springs, loads and tools."""

from __future__ import annotations

import warnings

import numpy as np
import pytest
from mpi4py import MPI

import pctt
from dem.mesh import Mesh
from dem.motion import Dynamic, Guided
from dem.scene import Scene
from dem.shapes import Box, Plane
from dem.start.stiffness import recommended
from dem.start.time_step import recommended as recommended_step
from pctt.scenes import Mixer

FLAT = (np.cos(np.pi / 4), 0.0, np.sin(np.pi / 4), 0.0)
NEEDLE = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-1e-3, 1e-3) for z in (-1e-3, 1e-3)])


def floor(**given) -> Scene:
    scene = Scene(0.5, **given)
    scene.add_body("floor", [Plane((0, 0, 1))])
    return scene


def deepest(scene: Scene, half: float, seconds: float, **settings) -> tuple[float, float]:
    """The greatest overlap of a run by the defaults over a half thickness [m], and the promised one."""
    with pctt.Simulation(scene, **settings) as sim:
        worst = [0.0]
        sim.run(until=seconds, call=lambda sim: worst.append(sim.figures["worst_overlap"]))
        return max(worst) / half, sim.expected_overlap


def test_a_flat_mesh_is_no_thin_body():
    scene, corners = Scene(0.5), [[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]
    scene.add_body("floor", [Mesh(np.array(corners, float), np.array([[0, 1, 2], [0, 2, 3]]))])
    scene.add_body("box", [Box((0.05, 0.05, 0.05))], Dynamic(), density=1000.0, position=(0, 0, 0.07))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        pctt.Simulation(scene).run(until=0.3)


@pytest.mark.parametrize(
    ("add", "half"),
    [
        (lambda s, r: s.add_capsules([[0, 0, r]], r, 0.8, 7800.0, quaternions=FLAT), 1e-3),
        (lambda s, r: s.add_capsules([[0, 0, r]], r, 0.3, 900.0, quaternions=FLAT), 4e-3),
        (lambda s, r: s.add_boxes([[0, 0, r]], (0.4, 0.3, r), 7800.0), 5e-4),
        (lambda s, r: s.add_polyhedra([[0, 0, r]], NEEDLE, 7800.0), 1e-3),
    ],
    ids=["rod", "light rod", "plate", "needle"],
)
def test_slender_grains_rest_on_the_overlap_that_is_promised(add, half):
    scene = floor()
    add(scene, half)
    worst, promised = deepest(scene, half, 0.05)
    assert promised <= 0.0055
    assert 0.0 < worst <= 2.0 * promised


@pytest.mark.parametrize(("radius", "height", "count"), [(1e-3, 0.3, (3, 3, 1)), (2e-4, 0.04, (3, 3, 6))])
def test_grains_that_fall_overlap_by_what_is_promised(radius, height, count):
    """Way in a step of less than two radii, so that nothing ends the run; layers above each other come together."""
    scene = floor()
    places = 2.2 * radius * np.indices(count).reshape(3, -1).T
    scene.add_spheres(places + [0, 0, height + radius], radius, 2500.0)
    speed = np.sqrt(2 * 9.81 * height)
    assert recommended_step(scene) * speed < 1.6 * radius
    worst, promised = deepest(scene, radius, speed / 9.81 + 20 * radius / speed)
    assert promised <= 0.0055
    assert 0.0 < worst <= 2.0 * promised


def test_what_ends_a_fall():
    """The time step goes as the inverse of the speed at the end: planes, slabs, slopes; and none without."""
    radius, high = 1e-3, 0.5
    ends = {
        "plane": ([Plane((0, 0, 1))], high),
        "slab": ([Box((1.0, 1.0, 0.2), (0, 0, -0.2))], high),
        "slope": ([Plane((0.6, 0, 0.8))], high),
        "nearer plane": ([Plane((0, 0, 1)), Plane((0, 0, 1), (0, 0, 0.3))], high - 0.3),
        "wall": ([Plane((1, 0, 0), (-1, 0, 0))], 0.0),
        "nothing": ([], 0.0),
    }
    for name, (shapes, way) in ends.items():
        scene = Scene(0.5)
        if shapes:
            scene.add_body("body", shapes)
        scene.add_spheres([[0, 0, high]], radius, 2500.0)
        dt = recommended_step(scene)
        expected = 1e-3 if way == 0.0 else min(1e-3, 1.5 * radius / np.sqrt(2 * 9.81 * way))
        assert dt == pytest.approx(expected, rel=0.06), name
    falling = Scene(0.5)  # that goes with the grain is no floor
    falling.add_body("raft", [Box((1.0, 1.0, 0.1))], Dynamic(), density=100.0)
    falling.add_spheres([[0, 0, high]], radius, 2500.0)
    assert recommended_step(falling) == pytest.approx(1e-3, rel=0.06)


@pytest.mark.parametrize("size", [1.0, 0.01])
def test_the_motion_and_the_stress_of_a_cell_have_their_steps(size):
    """A tenth of d sqrt(rho / P), a shear strain of a hundredth, a strain of .002; a plate moves by its thickness."""

    def step(**given):
        scene = Scene(0.5, (0, 0, 0), period=(10 * size,) * 3, **given)
        scene.add_spheres(size * np.array([[1.0, 1.0, 1.0], [4.0, 4.0, 4.0]]), size * np.array([0.5, 0.7]), 2500.0)
        return recommended_step(scene)

    pressures = 1e4 * size**2 * np.array([1.0, 100.0])
    for pressure in pressures:
        expected = 0.1 * size * np.sqrt(2500.0 / pressure)
        assert step(stress=(pressure / 2, None, pressure)) == pytest.approx(min(expected, 1e-2), rel=0.06)
    assert step(shear_rate=-20.0) == 5e-4
    assert step(strain_rate=(None, -4.0, 1.0)) == 5e-4
    assert step(stress=(1e-9,) * 3) == step() == 1e-2
    plate = Scene(0.5, (0, 0, 0), period=(10.0,) * 3, stress=(1e6,) * 3)
    plate.add_boxes([5.0, 5.0, 5.0], (0.5, 0.5, 0.05), 2500.0)
    mass, wide = 2500.0 * 0.1, 2.0 * np.linalg.norm([0.5, 0.5, 0.05])
    assert recommended_step(plate) == pytest.approx(0.1 * np.sqrt(6 / np.pi * 0.1 * mass / wide**2 / 1e6), rel=0.06)


def test_a_fall_in_the_scenes_of_the_package_asks_for_nothing_more():
    """Beds, and chains of force in them, need more than the grains that fall on them."""
    scene, radius = Mixer(n=4).build(), 0.1
    paddle = np.pi / 3 * np.hypot(0.5 * 2.25 / 2, 2.25 / 40)
    mass, reach = 2500.0 * 4 / 3 * np.pi * radius**3, np.hypot(paddle, np.pi / 3 * 2.25 / 8)
    assert recommended(scene) == pytest.approx(mass * (reach / (0.003 * radius)) ** 2, rel=0.05)
    assert recommended_step(scene) == 0.01


def pulled(scene: Scene, radius: float) -> None:
    """Two spheres, two diameters apart, that a spring of length zero pulls together."""
    scene.add_spheres([[0, 0, 1], [4 * radius, 0, 1]], radius, 1000.0)
    scene.add_spring("s", 0, 1, stiffness=2e4, length=0.0)


def loaded(scene: Scene, radius: float) -> None:
    """A sphere that a load of many weights presses on the floor."""
    scene.add_spheres([[0, 0, radius]], radius, 1000.0)
    scene.add_load("press", [0], force=(0, 0, -3e3))


def pressed(scene: Scene, radius: float) -> None:
    """A sphere between the floor and a tool of given force."""
    scene.add_spheres([[0, 0, radius]], radius, 1000.0)
    press = Guided((0, 0, 1), force=-2e3)
    scene.add_body("press", [Box((0.1, 0.1, 0.02))], press, position=(0, 0, 2 * radius + 0.02), density=1000.0)


@pytest.mark.parametrize("add", [pulled, loaded, pressed])
def test_forces_beside_the_weight_are_reckoned_with(add):
    scene, radius = floor(), 0.05
    add(scene, radius)
    worst, promised = deepest(scene, radius, 0.03)
    assert promised <= 0.0055
    assert 0.0 < worst <= 2.0 * promised + 0.0075  # which the solver may leave


def told(**settings) -> list[str]:
    """The warnings of overlaps in a run in which a load crushes a sphere against the floor."""
    scene = floor()
    scene.add_spheres([[0, 0, 0.1]], 0.1, 2500.0)
    scene.add_load("press", [0], force=lambda time, table: np.outer(table.mass, [0, 0, -3e4]))  # which nobody knows
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        with pctt.Simulation(scene, **settings) as sim:
            sim.run(steps=20)
    return [str(warning.message) for warning in caught if "overlap" in str(warning.message)]


@pytest.mark.parallel(2)
def test_the_ranks_tell_it_together():
    assert len(told()) == (MPI.COMM_WORLD.rank == 0)


def test_a_spring_that_bears_more_than_promised_is_told_once_in_the_language_of_the_door():
    for program, name in ((False, "a larger stiffness="), (True, "a larger -stiffness")):
        (words,) = told(program=program)
        assert words.endswith(name)
    assert not told(stiffness=1e10)


@pytest.mark.parametrize(
    ("held", "loose", "cause"), [(0.06, 0.0, "stiffness"), (0.001, 0.06, "tol"), (0.001, 0.002, "dt")]
)
def test_what_makes_an_overlap(held, loose, cause, monkeypatch):
    """What springs leave at the end of a step, what the solver leaves, or else the step itself."""
    scene = floor()
    scene.add_spheres([[0, 0, 0.1]], 0.1, 2500.0)
    with pctt.Simulation(scene) as sim:
        watch, dt = sim.overlap_watch, sim.settings.dt
    seen = iter([(0.0, held), (0.06, 0.0), (0.001, 0.0)])
    monkeypatch.setattr("pctt.run.overlaps.overlaps", lambda *step: next(seen))
    assert [watch.look(None, loose * 0.1 / dt) for _ in range(3)] == ["", cause, ""]
    assert watch.cause == cause
