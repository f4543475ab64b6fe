"""A step that fails changes nothing, and can be tried again: it is then the step of a run in which nothing failed."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import pytest
from mpi4py import MPI

import pctt
from dem.experiment import Experiment
from dem.measures import Block
from dem.motion import Dynamic, Glide
from dem.scene import Scene
from dem.shapes import Box, Plane, Sphere
from dem.together import SceneError

LATE = 0.035  #: [s] from when on code of the scene fails


@dataclass
class Fault:
    """Raises where it is told to, from LATE on, on one rank."""

    where: str = ""
    rank: int = 0

    def raises(self, where: str, time: float) -> None:
        if where == self.where and time > LATE and self.rank == MPI.COMM_WORLD.rank:
            raise ZeroDivisionError


@dataclass(frozen=True)
class Sinking:
    fault: Fault

    def pose(self, time, position, orientation):
        self.fault.raises("motion", time)
        return position + [0, 0, -0.1 * time], orientation


@dataclass(frozen=True)
class Slowed(Dynamic):
    fault: Fault = field(default_factory=Fault)

    def held(self, time, dt):
        self.fault.raises("held", time)
        return np.zeros(6)


class Bed(Experiment):
    """Grains that come, go, are pulled and meet tools on a belt; they also begin to fall as the belt runs on."""

    def __init__(self, fault: Fault):
        self.fault, self.now = fault, 0.0

    def build(self) -> Scene:
        scene = Scene(0.4, restitution=0.3)
        scene.add_body("belt", [Plane((0, 0, 1))], surface_velocity=self.surface)
        scene.add_body("tool", [Sphere(0.1)], Sinking(self.fault), position=(0.3, 0.3, 0.7))
        scene.add_body("lid", [Box((0.3, 0.3, 0.02))], Slowed(self.fault), position=(0.5, 0.5, 0.9), density=500.0)
        grid = 0.2 * np.indices((4, 4, 2)).reshape(3, -1).T + [0.1, 0.1, 0.1]
        scene.add_spheres(grid, 0.095, 1000.0, velocity=(0.1, 0.2, -0.5))
        scene.add_body("arm", [Box((0.1, 0.02, 0.02))], Dynamic(), position=(0.5, 0.5, 1.1), density=500.0)
        scene.add_spring("spring", "lid", "arm", stiffness=100.0, damping=1.0)
        scene.add_joint("joint", None, "arm", anchor=(0.4, 0.5, 1.1), axis=(0, 1, 0), limits=(-0.01, 0.2))
        scene.add_load("wind", force=self.law)
        region = Block((0.1, 0.1, 1.2), (0.7, 0.7, 1.6))
        scene.add_source("rain", region, radius=0.05, density=1000.0, number_rate=150.0, velocity=(0, 0, -1.0))
        scene.add_outlet("gap", Block((0.6, 0.6, -1.0), (1.0, 1.0, 0.4)))
        return scene

    def law(self, time, table):
        self.now = time
        self.fault.raises("load", time)
        return -0.1 * table.velocity[:, :3]

    def surface(self, point, normal):
        self.fault.raises("surface", self.now)
        return np.tile([0.3, 0.0, 0.0], (len(point), 1))

    def record(self, step):
        self.fault.raises("record", step.world.time)
        return {"fast": step.total(step.world.grains.velocity[:, 2] < -1.0)}


class Cell(Experiment):
    """A cell that deforms, of which a step changes periods, rates and the shift of images."""

    def __init__(self, fault: Fault):
        self.fault = fault

    def build(self) -> Scene:
        more = {"period": (0.8, 0.8, 0.8), "stress": (None, 3000.0, None), "shear_rate": 2.0}
        scene = Scene(0.4, gravity=(0, 0, 0), stiffness=1e5, **more)
        grid = 0.26 * np.indices((3, 3, 3)).reshape(3, -1).T + [0.1, 0.12, 0.14]
        scene.add_spheres(grid, 0.125, 1000.0, velocity=0.3 * np.sin(np.arange(81.0)).reshape(27, 3))
        return scene

    def record(self, step):
        self.fault.raises("record", step.world.time)
        return {}


def state(sim):
    """All that a run goes on from, and what a user sees of it. Lists of pairs are not: a search finds the same with any
    that hold."""
    local, replicated = sim.world.state()
    arrays = {**local, **replicated}
    arrays |= {f"memory {k}": values for k, values in enumerate(sim.memory.state())}
    arrays |= {"tallies": np.array([list(vars(tally).values()) for tally in sim.world.passages.tallies.values()])}
    kept = {name: np.array(values) for name, values in arrays.items()}
    return kept | {"figures": sim.figures}


def assert_unchanged(sim, before):
    now = state(sim)
    assert now.keys() == before.keys()
    for name, values in before.items():
        np.testing.assert_array_equal(now[name], values, err_msg=name)


def before_failure(sim, words):
    """The state before the step that fails with these words."""
    for _ in range(20):
        before = state(sim)
        try:
            sim.step()
        except SceneError as error:
            said = str(error)
            break
    assert words in said
    return before


def made(experiment, comm=MPI.COMM_WORLD, **more):
    return pctt.Simulation(experiment, comm=comm, dt=0.01, say=lambda text: None, **more)


@pytest.mark.parallel(1, 2)
@pytest.mark.parametrize(("scene", "places"), [
    (Bed, ("load", "motion", "held", "surface", "record")), (Cell, ("record",)),
])  # fmt: skip
def test_a_step_whose_code_fails_on_one_rank_changes_nothing(scene, places):
    comm = MPI.COMM_WORLD
    fault = Fault(rank=comm.size - 1)
    sim, other = made(scene(fault)), made(scene(Fault()))
    for _ in range(3):
        sim.step()
    for fault.where in places:
        for _ in range(2):
            assert_unchanged(sim, before_failure(sim, "ZeroDivisionError"))
    assert 3 <= sim.steps < 6
    fault.where = ""
    while sim.steps < 6:
        sim.step()
    other.run(steps=6)
    np.testing.assert_array_equal(sim.positions, other.positions)
    np.testing.assert_array_equal(sim.velocities, other.velocities)
    if scene is Bed:
        assert vars(sim.source("rain")) == vars(other.source("rain"))
        assert sim.source("rain").count > 0


@pytest.mark.parallel(1, 2)
def test_a_step_without_solution_changes_nothing():
    """A source goes on, while a sphere is squeezed between rigid walls that close."""
    scene = Scene(0.3, stiffness=np.inf)
    scene.add_body("floor", [Plane((0, 0, 1))])
    scene.add_body("press", [Plane((0, 0, -1), (0, 0, 0.21))], Glide((0, 0, -0.3)))
    scene.add_spheres([[0, 0, 0.1]], 0.1, 1000.0)
    scene.add_source("rain", Block((2, 2, 0.05), (4, 4, 0.1)), radius=0.02, density=1000.0, number_rate=200.0)
    sim = made(scene)
    for _ in range(2):
        assert_unchanged(sim, before_failure(sim, "squeezed"))
    assert sim.source("rain").count > 0


def test_a_step_in_which_a_body_is_lost_changes_nothing():
    scene = Scene(0.3)
    scene.add_spheres([[0, 0, 0.1]], 0.1, 1000.0)
    scene.add_source("rain", Block((2, 2, 0.05), (4, 4, 0.1)), radius=0.02, density=1000.0, number_rate=200.0)
    sim = made(scene, MPI.COMM_SELF)
    sim.run(steps=3)
    sim.world.grains.velocity[0] = np.nan
    assert_unchanged(sim, before_failure(sim, "no finite position or velocity"))
    assert sim.source("rain").count > 0
