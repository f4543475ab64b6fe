"""Grains that come and go within a simulation: balances, overlaps, restarts, ranks."""

import numpy as np
import pytest
from mpi4py import MPI

from dem.measures import Block, Cylinder
from dem.mesh import Mesh
from dem.motion import Fixed, Glide
from dem.parts.sizes import Uniform
from dem.scene import Scene
from dem.shapes import Box, Capsule, Clump, Plane, Sphere, Superellipsoid
from dem.shapes import Cylinder as Rod
from pctt.options import OptionError
from pctt.simulation import Simulation

WORDS = {"dt": 0.002, "solver": "apgd", "tol": 1e-6, "delta": 0.005, "stiffness": 1e5}


def chute(**given) -> Scene:
    """Rain on a floor with an outlet in its middle."""
    scene = Scene(0.3)
    scene.add_body("floor", [Plane((0, 0, 1))])
    source = {"radius": Uniform(0.015, 0.025), "density": 2500.0, "number_rate": 200.0, "seed": 5, **given}
    scene.add_source("rain", Block((-0.1, -0.1, 0.1), (0.1, 0.1, 0.2)), **source)
    scene.add_outlet("hole", Cylinder((0, 0, -1), (0, 0, 0.05), 0.06))
    return scene


def held(sim: Simulation) -> tuple[int, float]:
    """Number and mass of the grains that there are."""
    return len(sim.ids), sim.comm.allreduce(float(sim.local.mass.sum()))


def least_gap(sim: Simulation) -> float:
    """Of all pairs of grains that are spheres."""
    at, size = sim.positions, sim._of_grains("size")[:, 0]
    gap = np.linalg.norm(at[:, None] - at, axis=2) - size[:, None] - size
    return float(gap[np.triu_indices(len(at), 1)].min(initial=np.inf))


@pytest.mark.parametrize("rate", [{"number_rate": 200.0}, {"number_rate": None, "mass_rate": 15.0}])
def test_what_came_is_there_or_has_left_to_the_last_grain(rate):
    sim = Simulation(chute(**rate), comm=MPI.COMM_SELF, **WORDS)
    energies = 0.0
    for _ in range(130):
        before = sim.figures.get("kinetic_energy [J]", 0.0) + sim.figures.get("potential_energy [J]", 0.0)
        sim.step()
        figures, rain, hole = sim.figures, sim.source("rain"), sim.outlet("hole")
        count, mass = held(sim)
        assert rain.count == hole.count + count
        assert rain.mass == pytest.approx(hole.mass + mass, rel=1e-12)
        now = sim.time - WORDS["dt"]  # grains come before the step
        if rain.refused == 0:
            due = 200.0 * now if "mass_rate" not in rate else 15.0 * now
            came = rain.count if "mass_rate" not in rate else rain.mass
            assert -1e-9 <= due - came < (1.0 if "mass_rate" not in rate else 2500 * 4 / 3 * np.pi * 0.025**3)
        change = figures["kinetic_energy [J]"] + figures["potential_energy [J]"] + figures["spring_energy [J]"]
        change -= before + figures["spring_energy_before [J]"]
        passed = figures["energy_of_sources [J]"] - figures["energy_of_outlets [J]"]
        losses = sum(figures[f"{name} [J]"] for name in ("friction_loss", "impact_loss"))
        gained = figures["work_of_motions [J]"] + figures["time_stepping [J]"] + passed
        energies = max(energies, abs(change - gained + losses))
    assert hole.count > 3
    assert energies < 1e-9
    assert figures["count_rain"] == rain.count
    assert figures["mass_hole [kg]"] == hole.mass
    assert sim.ids.max() < rain.count
    assert (np.diff(sim.ids) > 0).all()
    assert len(sim.ids) == len(sim.positions) == len(sim.velocities) == len(sim.orientations)


def test_no_grain_comes_into_another_one_and_those_without_room_wait():
    """A region that holds few grains, much more due than fits, and no gravity that would make room."""
    scene = Scene(0.3, gravity=(0, 0, 0))
    scene.add_spheres([(0.1, 0.1, 0.1)], 0.05, 1000.0)
    region = Block((0, 0, 0), (0.2, 0.2, 0.2))
    scene.add_source("one", region, radius=Uniform(0.02, 0.03), density=1000.0, number_rate=2e4, seed=1)
    scene.add_source("two", region, radius=0.02, density=1000.0, number_rate=2e4)
    sim = Simulation(scene, comm=MPI.COMM_SELF, **WORDS)
    for _ in range(5):
        sim.step()
    assert least_gap(sim) >= 0.0
    assert len(sim.ids) > 20
    assert sim.source("one").refused == 4  # nothing is due at time zero
    assert sim.figures["refused_one"] == 4
    first = sim._of_grains("size")[1:6, 0]  # in the order of the queue, whatever their size
    sizes = scene.passages.sources["one"].grains("one", np.arange(5)).size[:, 0]
    np.testing.assert_array_equal(first, sizes)


def test_no_grain_comes_into_a_large_body():
    scene = Scene(0.3, gravity=(0, 0, 0))
    ball = Mesh.revolved([(0.0, -0.05), (0.05, 0.0), (0.0, 0.05)], 16)
    shapes = [Sphere(0.05, (0.1, 0.1, 0.1)), Box((0.03, 0.05, 0.04), (0.3, 0.1, 0.1))]
    scene.add_body("things", [*shapes, Capsule(0.03, 0.04, (0.2, 0.3, 0))], Fixed())
    scene.add_body("ball", [ball], position=(0.3, 0.3, 0.1))
    scene.add_body("wall", [Plane((1, 0, 0), (0.05, 0, 0))])
    region = Block((0, 0, 0), (0.4, 0.4, 0.2))
    scene.add_source("dust", region, radius=0.01, density=1000.0, number_rate=2e5, most=900, start=0.001)
    sim = Simulation(scene, comm=MPI.COMM_SELF, **WORDS)
    sim.run(steps=4)
    at = sim.positions
    assert len(at) > 300
    assert at[:, 0].min() > 0.06
    assert np.linalg.norm(at - (0.1, 0.1, 0.1), axis=1).min() > 0.06
    outside = np.maximum(np.abs(at - (0.3, 0.1, 0.1)) - (0.03, 0.05, 0.04), 0.0)
    assert np.linalg.norm(outside, axis=1).min() > 0.01
    along = np.clip(at[:, 2], -0.04, 0.04)
    assert np.hypot(np.linalg.norm(at[:, :2] - (0.2, 0.3), axis=1), at[:, 2] - along).min() > 0.04
    assert sim.last.contacts.gap.min(initial=0.0) >= 0.0


def test_boxes_and_capsules_come_too_and_fall():
    scene = Scene(0.3)
    scene.add_body("floor", [Plane((0, 0, 1))])
    for name, shape, x in (("boxes", Box((1, 2, 1)), 0.0), ("capsules", Capsule(1.0, 1.0), 1.0)):
        region = Block((x, 0, 0.1), (x + 0.2, 0.2, 0.2))
        scene.add_source(name, region, radius=0.01, density=1e3, number_rate=1e3, most=8, shape=shape, material=name)
    sim = Simulation(scene, comm=MPI.COMM_SELF, **WORDS)
    sim.run(steps=120)
    assert len(sim.ids) == 16
    assert sim.positions[:, 2].max() < 0.06
    assert sim.positions[:, 2].min() > 0.009


ROCK = 0.02 * np.array([[1, 0, 0], [-1, 0.1, 0], [0, 1.2, 0.2], [0, -1, 0], [0.1, 0, 0.8], [0, 0.2, -1]])
SHAPES = {
    "rocks": {"shape": ROCK, "radius": Uniform(0.6, 1.2)},
    "clumps": {"shape": Clump([[-0.012, 0, 0], [0.012, 0, 0], [0, 0.016, 0]], [0.012, 0.012, 0.01])},
    "pairs": {"shape": Clump([[-0.01, 0, 0], [0.01, 0, 0]], [0.012, 0.014])},
    "pills": {"shape": Superellipsoid((0.02, 0.02, 0.01)), "radius": (0.8, 1.0)},
    "rods": {"shape": Rod(0.01, 0.02)},
    "boxes": {"shape": Box((0.02, 0.015, 0.01))},
    "fibres": {"shape": Capsule(0.006, 0.015)},
    "balls": {"radius": 0.012},
}


def silo(*names: str, high: float = 0.3, **given) -> Scene:
    """Rain of some SHAPES between smooth walls."""
    scene = Scene(0.5)
    scene.add_body("floor", [Plane((0, 0, 1))])
    inwards = ((1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0))
    walls = [Plane(normal, tuple(-0.08 * np.array(normal))) for normal in inwards]
    scene.add_body("walls", walls, material="glass")
    scene.set_pair("default", "glass", friction=0.0)
    source = {"density": 2500.0, "number_rate": 100.0, "most": 6, **given}
    for name in names or SHAPES:
        scene.add_source(name, Block((-0.05, -0.05, 0.06), (0.05, 0.05, high)), **source, **SHAPES[name])
    return scene


@pytest.mark.parametrize("name", ["rocks", "clumps"])
def test_a_bed_that_has_rained_comes_to_rest_on_its_floor(name):
    sim = Simulation(silo(name, high=0.12), comm=MPI.COMM_SELF, tol=1e-6)
    sim.run(until=0.75)
    assert sim.source(name).count == len(sim.ids) == 6
    assert sim.figures["kinetic_energy [J]"] < 1e-8 * sim.source(name).mass
    assert -sim.body("floor").force[2] == pytest.approx(9.81 * sim.source(name).mass, rel=1e-4)
    assert sim.positions[:, 2].min() > 0.0
    assert np.abs(sim.positions[:, :2]).max() < 0.08
    assert sim.positions[:, 2].max() < 0.1


def test_grains_of_all_shapes_come_at_their_rates_without_overlaps_and_their_contacts_have_keys_of_their_own():
    scene = silo(mass_rate=2.0, number_rate=None, most=4)
    scene.add_clumps([(0, 0, 0.03)], Clump([[0, 0, 0.01], [0, 0, -0.01]], [0.02, 0.02]), 2500.0)
    sim = Simulation(scene, comm=MPI.COMM_SELF, **WORDS)
    came, largest = 1, 0
    while sim.time < 0.2:
        sim.step()
        new = np.isin(sim.last.contacts.near.bodies.id, sim.ids[came:])
        contacts, came = sim.last.contacts, len(sim.ids)
        touching = new[contacts.a] | new[contacts.b]
        assert contacts.gap[touching].min(initial=0.0) >= 0.0
        assert len(np.unique(contacts.key)) == len(contacts.key)
        largest = max(largest, len(contacts.key))
        for name in SHAPES:
            tally, heaviest = sim.source(name), scene.passages.sources[name].extremes().mass.max()
            due = 2.0 * (sim.time - WORDS["dt"]) - tally.mass
            assert tally.refused or tally.count == 4 or -1e-9 <= due < heaviest
    assert came == 1 + 4 * len(SHAPES)
    assert largest > 30
    assert held(sim)[1] == pytest.approx(
        scene.survey().mass + sum(sim.source(name).mass for name in SHAPES), rel=1e-12)  # fmt: skip


def test_a_run_that_begins_and_ends_without_grains():
    scene = chute(number_rate=100.0, most=3, start=0.01, velocity=(0, 0, -1))
    scene.add_outlet("below", Block((-1, -1, -1), (1, 1, 0.03)))
    sim = Simulation(scene, comm=MPI.COMM_SELF, **WORDS)
    sim.run(steps=4)
    assert held(sim) == (0, 0.0)
    assert sim.figures["kinetic_energy [J]"] == 0.0
    assert sim.figures["coordination_number"] == 0.0
    sim.run(until=2.0, stop=lambda sim: sim.source("rain").count == 3 and len(sim.ids) == 0)
    assert sim.time < 1.0
    assert sim.outlet("hole").count + sim.outlet("below").count == 3
    sim.run(steps=2)
    assert held(sim) == (0, 0.0)


def test_an_outlet_in_the_middle_of_a_bed_leaves_the_others():
    scene = Scene(0.3)
    grid = np.stack(np.meshgrid(*[np.arange(5) * 0.1] * 2, [0.05, 0.151], indexing="ij"), axis=-1).reshape(-1, 3)
    ids = scene.add_spheres(grid, 0.05, 1000.0)
    scene.add_body("floor", [Plane((0, 0, 1))])
    region = Block((0.15, 0.15, 0.0), (0.25, 0.25, 0.1))
    scene.add_outlet("middle", region)
    sim = Simulation(scene, comm=MPI.COMM_SELF, **WORDS)
    sim.step()
    gone = region.contains(grid)
    assert gone.sum() == 1
    np.testing.assert_array_equal(sim.ids, ids[~gone])
    sim.run(steps=100)
    assert sim.outlet("middle").count == 2  # that above has fallen in
    contacts = sim.contacts  # their bodies are rows of positions, then large bodies
    of_two = contacts.bodies[:, 1] < len(sim.ids)
    way = sim.positions[contacts.bodies[of_two, 1]] - sim.positions[contacts.bodies[of_two, 0]]
    np.testing.assert_allclose(np.linalg.norm(way, axis=1), 0.1 + contacts.gap[of_two], atol=1e-3)
    assert (contacts.bodies[~of_two, 1] == len(sim.ids)).all()
    weight = 48 * 1000 * 4 / 3 * np.pi * 0.05**3 * 9.81
    assert -sim.body("floor").force[2] == pytest.approx(weight, rel=0.02)


def test_a_domain_is_an_outlet_outside_of_its_region():
    scene = Scene(0.0, gravity=(0, 0, 0))
    ids = scene.add_spheres([(0.1, 0.5, 0.5), (0.5, 0.5, 0.5)], 0.05, 1000.0, velocity=[(-1, 0, 0), (0, 0, 0)])
    scene.add_outlet("far", Block((0, 0, 0), (1, 1, 1)), outside=True)
    sim = Simulation(scene, comm=MPI.COMM_SELF, **WORDS)
    sim.run(steps=60)
    np.testing.assert_array_equal(sim.ids, ids[1:])
    assert sim.outlet("far").count == 1
    with pytest.raises(ValueError, match="no outlet 'near'; there are: far"):
        sim.outlet("near")


def test_grains_on_springs_cannot_leave():
    scene = Scene(0.0)
    scene.add_spheres([(0, 0, 0)], 0.05, 1000.0)
    scene.add_spring("cord", 0, None, stiffness=1.0)
    scene.add_outlet("far", Block((0, 0, 0), (1, 1, 1)))
    with pytest.raises(OptionError, match="spring 'cord' holds a grain"):
        Simulation(scene, comm=MPI.COMM_SELF, **WORDS)


def test_defaults_follow_from_what_may_come():
    """The same as those of a scene that has the smallest and the largest grain from the beginning."""
    scene = chute()
    sim = Simulation(scene, comm=MPI.COMM_SELF, solver="apgd")
    assert sim.settings.delta == pytest.approx(0.015 / 20)
    bed = 0.64 * 2500 * 9.81 * 0.2  # from the floor to the top of the source
    expected = max(4 * bed * (2 * r) ** 2 / (0.003 * r) for r in (0.015, 0.025))
    assert float(sim.world.pairs.stiffness.min()) == pytest.approx(expected, rel=0.05)


def state(sim: Simulation) -> dict[str, np.ndarray]:
    names = ("position", "velocity", "size", "mass")
    return {"ids": sim.ids, **{name: sim._of_grains(name) for name in names}}


@pytest.mark.parallel(2, 3)
def test_the_same_grains_come_and_go_on_any_number_of_ranks():
    """Up to their first contacts to rounding."""
    scene = chute(number_rate=1000.0, velocity=(0, 0, -1))
    together, alone = (Simulation(scene, comm=comm, **WORDS) for comm in (MPI.COMM_WORLD, MPI.COMM_SELF))
    for _ in range(30):
        together.step()
        alone.step()
    one, other = state(together), state(alone)
    np.testing.assert_array_equal(one["ids"], other["ids"])
    assert len(one["ids"]) > 20
    for name in ("size", "mass"):
        np.testing.assert_array_equal(one[name], other[name])
    np.testing.assert_allclose(one["position"], other["position"], atol=1e-5)
    for kind, name in (("source", "rain"), ("outlet", "hole")):
        assert getattr(together, kind)(name).count == getattr(alone, kind)(name).count
    assert together.world.slabs[-1] == len(one["ids"])


@pytest.mark.parallel(1, 2)
def test_a_restart_goes_on_with_the_same_bits(tmp_path):
    comm, scene = MPI.COMM_WORLD, chute(velocity=(0, 0, -1))
    sim = Simulation(scene, comm=comm, **WORDS)
    sim.run(steps=40)
    sim.save(tmp_path / "state.h5")
    sim.run(steps=20)
    again = Simulation.load(tmp_path / "state.h5", scene, comm=comm, **WORDS)
    again.run(steps=20)
    one, other = state(sim), state(again)
    for name, column in one.items():
        np.testing.assert_array_equal(column, other[name])
    assert vars(sim.source("rain")) == vars(again.source("rain"))
    assert vars(sim.outlet("hole")) == vars(again.outlet("hole"))
    assert sim.outlet("hole").count > 0
    other_scene = chute()
    other_scene.add_outlet("more", Block((5, 5, 5), (6, 6, 6)))
    with pytest.raises(OptionError, match="no counts of the sources and outlets"):
        Simulation.load(tmp_path / "state.h5", other_scene, comm=comm, **WORDS)


@pytest.mark.parallel(1, 2)
def test_a_source_that_was_set_goes_on_after_a_restart(tmp_path):
    comm = MPI.COMM_WORLD
    sim = Simulation(chute(), comm=comm, **WORDS)
    sim.run(steps=20)
    sim.change("source rain", number_rate=500.0, velocity=(0.0, 0.0, -1.0))
    with pytest.raises(ValueError, match="no source 'snow'; there are: rain"):
        sim.change("source snow", number_rate=1.0)
    came = sim.source("rain").count
    sim.run(steps=10)
    assert came + 9 <= sim.source("rain").count <= came + 10
    sim.save(tmp_path / "state.h5")
    again = Simulation.load(tmp_path / "state.h5", chute(), comm=comm, **WORDS)
    for each in (sim, again):
        each.run(steps=10)
    one, other = state(sim), state(again)
    for name, column in one.items():
        np.testing.assert_array_equal(column, other[name])
    assert vars(sim.source("rain")) == vars(again.source("rain"))
    count = sim.source("rain").count
    sim.change("source rain", number_rate=0.0)
    sim.run(steps=10)
    assert sim.source("rain").count <= count + 1


@pytest.mark.parallel(2)
def test_the_same_grains_of_all_shapes_come_on_any_number_of_ranks():
    """Up to their first contacts to rounding."""
    scene = silo(high=0.6, number_rate=300.0)
    together, alone = (Simulation(scene, comm=comm, **WORDS) for comm in (MPI.COMM_WORLD, MPI.COMM_SELF))
    for _ in range(10):
        together.step()
        alone.step()
    one, other = ({**state(sim), "shape": sim._of_grains("shape")} for sim in (together, alone))
    assert len(one["ids"]) > 20
    assert len(np.unique(one["shape"])) == len(SHAPES)
    for name in ("ids", "shape", "size", "mass"):
        np.testing.assert_array_equal(one[name], other[name])
    np.testing.assert_allclose(one["position"], other["position"], atol=1e-5)


@pytest.mark.parallel(1, 2)
def test_a_restart_with_grains_of_all_shapes_goes_on_with_the_same_bits(tmp_path):
    comm = MPI.COMM_WORLD
    sim = Simulation(silo(high=0.6), comm=comm, **WORDS)
    sim.run(steps=20)
    sim.change("source clumps", number_rate=900.0)
    sim.save(tmp_path / "state.h5")
    again = Simulation.load(tmp_path / "state.h5", silo(high=0.6), comm=comm, **WORDS)
    for each in (sim, again):
        each.run(steps=12)
    one, other = ({**state(each), "shape": each._of_grains("shape")} for each in (sim, again))
    for name, column in one.items():
        np.testing.assert_array_equal(column, other[name])
    assert sim.source("clumps").count == again.source("clumps").count == 6
    assert len(np.unique(one["shape"])) == len(SHAPES)


@pytest.mark.slow
def test_a_hopper_fills_and_runs_out():
    """Rain into a cone that a gate shuts; then the gate goes, and all run through the outlet below."""
    scene = Scene(0.2)
    scene.add_body("hopper", [Mesh.revolved([(0.06, 0.0), (0.15, 0.15), (0.15, 0.6)], 16)])
    scene.add_body("gate", [Mesh.revolved([(0.0, 0.0), (0.06, 0.0)], 16)])
    region = Cylinder((0, 0, 0.4), (0, 0, 0.55), 0.1)
    scene.add_source("rain", region, radius=Uniform(0.018, 0.022), density=2500.0, number_rate=200.0, most=60)
    scene.add_outlet("below", Block((-1, -1, -1), (1, 1, -0.1)))
    sim = Simulation(scene, comm=MPI.COMM_SELF, **{**WORDS, "tol": 1e-4})
    sim.run(until=0.7)
    assert len(sim.ids) == 60
    assert sim.positions[:, 2].min() > 0.0
    sim.change("body gate", motion=Glide((0, 0, -5.0), start=sim.time))
    sim.run(until=sim.time + 1.5, stop=lambda sim: len(sim.ids) == 0)
    assert sim.outlet("below").count == 60
    assert sim.outlet("below").mass == pytest.approx(sim.source("rain").mass, rel=1e-12)
