"""`pctt.Simulation`: mechanics in closed form, changes within the loop, files, ranks, and the program beside it."""

from __future__ import annotations

import re
import subprocess
import sys
from dataclasses import dataclass

import numpy as np
import pytest
from mpi4py import MPI
from petsc4py import PETSc
from program import DROP, ROOT, arrays, assert_same_bits, database, table

import pctt
from dem.experiment import Experiment, option
from dem.mesh import Mesh
from dem.motion import Dynamic, Fixed, Glide, Guided, Hinged, Oscillation, Rotation
from dem.scene import Scene
from dem.shapes import Box, Plane
from dem.together import SceneError
from pctt.ccp.first_order.apgd import APGD
from pctt.disk import FileError
from pctt.folder import Folder
from pctt.options import OptionError
from pctt.run.options import read_options
from pctt.run.simulate import simulate
from pctt.scenes import Mixer

SELF, WORLD, G = MPI.COMM_SELF, MPI.COMM_WORLD, 9.81


def falling(count=1):
    scene = Scene(0.3)
    scene.add_spheres([[k, 0, 10] for k in range(count)], 0.1, 1000.0, velocity=(1, 0, 2))
    return scene


def lying():
    """A box of 2 kg that lies on the floor."""
    scene = Scene(0.5)
    scene.add_body("floor", [Plane((0, 0, 1))])
    scene.add_boxes([0, 0, 0.1], (0.1, 0.1, 0.1), 250.0)
    return scene


def moved(motion, **more):
    """A body with this motion far from a sphere."""
    scene = Scene(0.3, gravity=(0, 0, 0))
    scene.add_body("tool", [Box((0.1, 0.1, 0.1))], motion, position=(1, 2, 3), **more)
    scene.add_spheres([50, 0, 0], 0.1, 1000.0)
    return pctt.Simulation(scene, dt=0.01, comm=SELF)


@dataclass(frozen=True)
class Stirred(Experiment):
    """Spheres in a box with a plate that a servo turns."""

    speed: float = option(1.0, "of the servo", unit="rad/s")
    dt = 0.01
    delta = 0.01

    def build(self):
        scene = Scene(0.3)
        scene.add_body("box", [Plane((0, 0, 1)), *(Plane((s, 0, 0), (-0.5 * s, 0, 0)) for s in (-1, 1))])
        motion = Hinged((0, 0, 1), torque=20.0, speed=self.speed)
        scene.add_body("stirrer", [Box((0.3, 0.02, 0.2))], motion, density=1000.0, position=(0, 0, 0.25))
        places = [[x, y, z] for x in (-0.2, 0, 0.2) for y in (-0.075, 0.075) for z in (0.06, 0.17)]
        scene.add_spheres(places, 0.05, 2500.0)
        return scene

    def record(self, step):
        return {"height": step.total(step.world.grains.position[:, 2])}

    def analyse(self, records):
        return {"mean_height": records["height"].mean(), "twice": 2 * records["height"]}


# -- mechanics ----------------------------------------------------------------------------------------------


def test_a_free_fall_is_that_of_the_semi_implicit_step():
    sim = pctt.Simulation(falling(), dt=0.01, comm=SELF)
    sim.run(until=0.5)
    assert (sim.steps, sim.time) == (50, pytest.approx(0.5))
    np.testing.assert_allclose(sim.positions, [[0.5, 0, 10 + 2 * 0.5 - G * 0.01**2 * 50 * 51 / 2]], rtol=1e-13)
    np.testing.assert_allclose(sim.velocities, [[1, 0, 2 - G * 0.5, 0, 0, 0]], rtol=1e-13)
    np.testing.assert_array_equal(sim.orientations, [[1, 0, 0, 0]])
    mass = 1000 * 4e-3 / 3 * np.pi
    assert sim.kinetic_energy == pytest.approx(mass / 2 * (1 + (2 - G * 0.5) ** 2))
    assert sim.figures["kinetic_energy [J]"] == pytest.approx(sim.kinetic_energy)
    assert len(sim.contacts) == 0


@pytest.mark.parametrize("solver", ["auto", "pdip", "conic"])
def test_the_contacts_of_a_box_at_rest_bear_its_weight(solver):
    sim = pctt.Simulation(lying(), solver=solver, tol=1e-8, comm=SELF, stiffness=np.inf)
    sim.run(steps=5)
    contacts = sim.contacts
    np.testing.assert_allclose(contacts.force.sum(axis=0), [0, 0, -2 * G], atol=1e-5)
    np.testing.assert_allclose(sim.body("floor").force, [0, 0, -2 * G], atol=1e-5)
    np.testing.assert_allclose(sim.body("floor").torque, 0, atol=1e-5)
    assert (contacts.bodies == [0, 1]).all()  # forces are on the second, the floor
    np.testing.assert_allclose(contacts.normal, [[0, 0, -1]] * len(contacts), atol=1e-9)  # from the box to the floor
    np.testing.assert_allclose(contacts.gap, 0, atol=1e-7)
    np.testing.assert_allclose(contacts.point[:, 2], 0, atol=1e-7)
    assert sim.figures["converged"]
    assert sim.figures["solver"] in (solver, "apgd", "conic")


# -- motions ------------------------------------------------------------------------------------------------


def test_a_servo_takes_another_speed():
    sim = moved(Guided((1, 0, 0), force=100.0, speed=0.5), mass=1.0)
    sim.run(steps=20)
    tool = sim.body("tool")
    np.testing.assert_allclose(tool.velocity[:3], [0.5, 0, 0], atol=1e-12)
    place = tool.position
    sim.change("body tool", speed=-0.25)
    assert tool.motion.speed == -0.25
    sim.run(steps=20)
    np.testing.assert_allclose(tool.velocity[:3], [-0.25, 0, 0], atol=1e-12)
    assert abs(tool.position[0] - (place[0] - 0.25 * 0.2)) < 0.01  # after the time in which its force brakes it
    with pytest.raises(ValueError, match=r"cannot change its motion to Fixed.*Guided with another drive"):
        sim.change("body tool", motion=Fixed())
    with pytest.raises(ValueError, match="cannot change its motion"):
        sim.change("body tool", direction=(0, 1, 0))


@pytest.mark.parametrize(
    ("motion", "changes", "velocity"),
    [
        (Glide((1, 0, 0)), {"velocity": (0, 2, 0)}, [0, 2, 0, 0, 0, 0]),
        (Rotation((0, 0, 1), (0, 0, 0)), {"velocity": (0, 0, -3)}, None),
        (Rotation((0, 1, 1), (1, 0, 0)), {"center": (0, 1, 0)}, None),
        (Oscillation((0, 0, 1), 0.1, 1.0), {"amplitude": 0.3}, None),
        (Oscillation((0, 0, 1), 0.1, 1.0, start=0.05), {"period": 0.2}, None),
    ],
)
def test_a_body_on_a_path_goes_on_from_where_it_is(motion, changes, velocity):
    sim = moved(motion)
    sim.run(steps=13)
    tool = sim.body("tool")
    before = tool.position, tool.orientation
    sim.change("body tool", **changes)
    np.testing.assert_array_equal(tool.position, before[0])
    sim.step()
    np.testing.assert_allclose(tool.position, before[0] + 0.01 * tool.velocity[:3], rtol=1e-12)
    assert np.linalg.norm(tool.velocity[:3]) < 12.0  # nothing jumps: 1 cm would be 1 m/s
    assert tool.orientation @ before[1] > 0.999
    if velocity:
        np.testing.assert_allclose(tool.velocity, velocity, atol=1e-10)


def test_an_oscillation_of_another_period_stays_in_its_phase():
    sim = moved(Oscillation((1, 0, 0), 0.1, 1.0))
    sim.run(steps=37)
    phase = 2 * np.pi * 0.37
    sim.change("body tool", period=0.5)
    places = []
    sim.run(steps=50, call=lambda sim: places.append(sim.body("tool").position[0] - 1))
    expected = 0.1 * np.sin(phase + 2 * np.pi * 0.01 * np.arange(1, 51) / 0.5)
    np.testing.assert_allclose(places, expected, atol=1e-12)


def test_a_body_on_a_path_takes_another_one():
    sim = moved(Fixed())
    sim.run(steps=5)
    sim.change("body tool", motion=Glide((0, 0, 1), start=0.1))
    sim.run(until=0.3)
    np.testing.assert_allclose(sim.body("tool").position, [1, 2, 3.2], rtol=1e-12)


class OnRails:
    """A path in the world, whatever the pose at time zero is."""

    def pose(self, time, position, orientation):
        return np.array([time, 0, 0]), orientation


def test_a_path_that_would_let_the_body_jump_is_refused():
    sim = moved(Fixed())
    sim.step()
    with pytest.raises(ValueError, match="OnRails does not displace the pose at time zero: the body would jump"):
        sim.change("body tool", motion=OnRails())
    with pytest.raises(ValueError, match="cannot change its motion to Guided.*allowed is a path"):
        sim.change("body tool", motion=Guided((1, 0, 0)))
    with pytest.raises(ValueError, match="Fixed has no speed"):
        sim.change("body tool", speed=1.0)
    with pytest.raises(ValueError, match="no large body 'paddle'; there are: tool"):
        sim.body("paddle")


# -- the loop -----------------------------------------------------------------------------------------------


def test_a_run_ends_at_a_time_after_steps_or_when_it_is_to():
    sim = pctt.Simulation(falling(), dt=0.01, comm=SELF)
    seen = []
    sim.run(steps=7, every=3, call=lambda sim: seen.append(sim.steps))
    assert seen == [3, 6]
    sim.run(until=0.1)
    assert sim.steps == 10
    sim.run(until=0.1)
    assert sim.steps == 10
    sim.run(until=5.0, stop=lambda sim: sim.velocities[0, 2] < 0)
    assert sim.steps == np.floor(2 / (G * 0.01)) + 1
    with pytest.raises(OptionError, match="run: without an end"):
        sim.run()
    with pytest.raises(ZeroDivisionError):
        sim.run(steps=1, call=lambda sim: 1 / 0)


def test_two_simulations_by_turns_do_not_disturb_each_other():
    def make(solver):
        return pctt.Simulation(Stirred(), solver=solver, comm=SELF)

    for solver in ("apgd", "pdip"):
        one, two, alone = make(solver), make(solver), make(solver)
        two.change("body stirrer", speed=-2.0)
        for _ in range(6):
            one.step()
            two.step()
        alone.run(steps=6)
        for name in ("positions", "velocities", "orientations"):
            np.testing.assert_array_equal(getattr(one, name), getattr(alone, name))
        assert np.abs(two.positions - one.positions).max() > 1e-4


@pytest.mark.parametrize("solver", ["apgd", "pdip", "conic"])
def test_the_options_of_petsc_stay_as_they_are(solver, tmp_path):
    options = PETSc.Options()
    options["ccp_ksp_max_it"] = "500"  # the user's own
    before = options.getAll()
    try:
        with pctt.Simulation(Mixer(n=1, margin=0.7), solver=solver, comm=SELF) as sim:
            sim.write(tmp_path / "out")
            sim.run(steps=2)
            assert options.getAll() == before
        assert options.getAll() == before
    finally:
        options.delValue("ccp_ksp_max_it")


PLAIN = """
import sys, pctt
assert not any("petsc4py" in name or "numpy" in name for name in sys.modules), "slow"
import petsc4py
petsc4py.init(["", "-my_option", "3"])
pctt.Simulation
from petsc4py import PETSc
assert PETSc.Options().getInt("my_option") == 3
from pctt.scenes import Mixer
from pctt.run import help, simulate
pctt.Simulation(Mixer(n=1), solver="apgd").run(steps=1)
print(*sys.modules)
"""


def test_a_plain_run_does_not_load_what_it_does_not_use():
    """On a cluster every rank opens the file of every module. To import the package starts no PETSc."""
    said = subprocess.run([sys.executable, "-c", PLAIN], cwd=ROOT, capture_output=True, text=True, check=True)
    loaded = set(said.stdout.split())
    assert "dem.contact" in loaded
    assert not loaded & {"pctt.tt", "pctt.mat", "pctt.pc", "matplotlib", "vtk", "scipy.fft", "scipy.signal"}


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"dt": -1.0}, "dt -1.0: allowed is a positive number"),
        ({"tol": 2}, "tol 2: allowed is a number between 0 and 1"),
        ({"dt": "fast"}, "dt 'fast': allowed is a positive number"),
        ({"solver": "agpd"}, "solver agpd: allowed is one of .*; did you mean apgd"),
        ({"slover": "apgd"}, "slover: no such setting; .*; did you mean solver"),
        ({"solver": "apgd", "options": {"memroy": 1}}, "memroy: no such setting"),
        ({"solver": "pdip", "options": APGD()}, "options APGD.*allowed for pdip is a dict or a PDIP"),
        ({"solver": "conic", "newton": "kkt"}, "newton kkt: conic has no constraints.*allowed.*contact and body"),
        ({"solver": "apgd", "newton": "contact"}, "newton contact: apgd solves no Newton.*are pdip, conic, auto"),
        ({"solver": "conic", "newton": "contact"}, "newton contact: conic solves Coulomb's law in .* body alone"),
        ({"newton": "contact"}, "newton contact: auto solves Coulomb's law in the form body alone; allowed are body"),
        ({"delta": 1e-3, "solver": "spiral"}, "solver spiral: allowed is one of"),
        ({"law": "yes"}, "law yes: allowed is one of coulomb, relaxation"),
    ],
)
def test_a_bad_setting_is_named(settings, words):
    with pytest.raises(OptionError, match=words):
        pctt.Simulation(falling(), comm=SELF, **settings)


def test_settings_are_given_one_by_one_or_together():
    given = pctt.Settings(tol=1e-6, solver="apgd")
    sim = pctt.Simulation(Mixer(n=1), given, dt=0.001, comm=SELF)
    assert (sim.settings.tol, sim.settings.solver, sim.settings.dt, sim.settings.delta) == (1e-6, "apgd", 0.001, 0.005)
    assert sim.settings.law == "coulomb"
    assert pctt.Simulation(Mixer(n=1), solver="pdip", comm=SELF).settings.law == "relaxation"
    assert sim.settings.limits.closing_speed == pytest.approx(0.15 * 0.005 / 0.001)  # of delta in a step
    for given in ({"solver": "pdip"}, {"closing_work": np.inf}, {"closing_speed": np.inf}):
        assert pctt.Simulation(Mixer(n=1), **given, comm=SELF).settings.limits.closing_speed == np.inf
    assert sim.settings.options == APGD()
    with pytest.raises(OptionError, match="allowed is a dem.scene.Scene"):
        pctt.Simulation(Mixer, comm=SELF)
    scene = falling()
    scene.add_spheres([0.1, 0, 10], 0.1, 1.0)
    with pytest.raises(OptionError, match="overlapping start"):
        pctt.Simulation(scene, comm=SELF)


# -- files --------------------------------------------------------------------------------------------------


@pytest.mark.parallel(1, 2)
def test_a_loaded_simulation_goes_on_with_the_same_bits(tmp_path):
    """Also with motions that were changed: of a servo, and of a body on a path."""

    def change(sim, k):
        sim.change("body stirrer", speed=2.0 + k)
        sim.change("body lid", motion=Rotation((0, 0, 1 + k), (0.1, 0, 0)))

    @dataclass(frozen=True)
    class Lidded(Stirred):
        def build(self):
            scene = super().build()
            scene.add_body("lid", [Box((0.4, 0.4, 0.02))], Glide((0, 0, -0.1)), position=(0, 0, 0.6))
            return scene

    whole = pctt.Simulation(Lidded(), solver="apgd")
    whole.run(steps=3)
    change(whole, 0.0)
    whole.run(steps=4)
    whole.save(tmp_path / "half.h5")
    part = pctt.Simulation.load(tmp_path / "half.h5", Lidded(), solver="apgd")
    assert part.steps == 7
    assert part.body("stirrer").motion.speed == 2.0
    for sim in (whole, part):
        sim.run(steps=3)
        change(sim, 0.5)
        sim.run(steps=3)
        sim.save(tmp_path / f"{sim is whole}.h5")
    assert_same_bits(tmp_path / "True.h5", tmp_path / "False.h5")
    twice = pctt.Simulation.load(tmp_path / "half.h5", Lidded(), dt=0.02)
    assert twice.body("lid").motion.velocity == (0.0, 0.0, 1.0)
    time = twice.time
    twice.run(steps=2)
    assert twice.time == pytest.approx(time + 0.04)
    with pytest.raises(FileError, match="damaged, or no such file"):
        pctt.Simulation.load(tmp_path / "none.h5", Lidded())


@pytest.mark.parallel(1, 2)
@pytest.mark.parametrize(
    ("words", "solver"), [(["-scene_n", "1", "-scene_margin", "0.4"], "pdip"), (["-scene", "drop.py"], "apgd")]
)
def test_it_does_what_the_program_does(words, solver, tmp_path, monkeypatch):
    """The files of both have the same bits, but for the seconds."""
    monkeypatch.chdir(tmp_path)
    if WORLD.rank == 0:
        (tmp_path / "drop.py").write_text(DROP)
    WORLD.Barrier()
    more = [*words, "-ccp_type", solver, "-steps", "5", "-output_every", "2", "-checkpoint_every", "3", "-quiet"]
    options = read_options(database([*more, "-output", "program"]), WORLD)
    simulate(options, WORLD)
    with pctt.Simulation(options.scene, solver=solver) as sim:
        sim.write("object", every=2, checkpoint_every=3)
        for _ in range(5):
            sim.step()
    if WORLD.rank > 0:
        return
    for name in ("state.h5", "checkpoint.h5"):
        assert_same_bits(tmp_path / "program" / name, tmp_path / "object" / name)
    names = {path.name for path in (tmp_path / "program").iterdir()}
    assert names == {path.name for path in (tmp_path / "object").iterdir()}
    for name in {"records.csv", "analysis.csv"} & names:
        assert (tmp_path / "program" / name).read_bytes() == (tmp_path / "object" / name).read_bytes()


@pytest.mark.parametrize("minutes", [0.0, 1e6])
def test_checkpoints_by_the_clock(tmp_path, minutes):
    sim = pctt.Simulation(Stirred(), solver="apgd", comm=SELF)
    sim.write(tmp_path, checkpoint_minutes=minutes)
    sim.step()
    assert (tmp_path / "checkpoint.h5").exists() == (minutes == 0.0)
    sim.close()
    assert arrays(tmp_path / "checkpoint.h5")["world/step"] == 1


def test_the_folder_of_a_run_is_written_from_then_on(tmp_path):
    sim = pctt.Simulation(Stirred(), solver="apgd", comm=SELF)
    sim.run(steps=2)
    sim.write(tmp_path / "out", every=4, checkpoint_every=10)
    with pytest.raises(OptionError, match="writes to .*out already"):
        sim.write(tmp_path / "other")
    with pytest.raises(FileError, match="another run is writing there"):
        pctt.Simulation(Stirred(), comm=SELF).write(tmp_path / "out")
    sim.run(steps=3)
    assert arrays(tmp_path / "out" / "checkpoint.h5")["world/step"] == 5  # a run leaves a whole folder
    sim.step()
    sim.close()
    assert arrays(tmp_path / "out" / "checkpoint.h5")["world/step"] == 6
    assert sorted(path.stem for path in (tmp_path / "out" / "frames").glob("0*.h5")) == ["000004", "000005", "000006"]
    assert table(tmp_path / "out" / "records.csv")["step"].tolist() == [3, 4, 5, 6]
    assert len(table(tmp_path / "out" / "analysis.csv")["twice"]) == 4
    with pytest.raises(ValueError, match="closed"):
        sim.step()
    with pytest.raises(FileError, match="holds a run"):
        pctt.Simulation(Stirred(), comm=SELF).write(tmp_path / "out")
    with pctt.Simulation.load(tmp_path / "out" / "checkpoint.h5", Stirred(), solver="apgd", comm=SELF) as sim:
        sim.write(tmp_path / "out")
        sim.run(steps=2)
    assert table(tmp_path / "out" / "records.csv")["step"].tolist() == [3, 4, 5, 6, 7, 8]
    with pytest.raises(OptionError, match="checkpoint_every 0: allowed is a whole number >= 1"):
        pctt.Simulation(Stirred(), comm=SELF).write(tmp_path / "new", checkpoint_every=0)


# -- ranks --------------------------------------------------------------------------------------------------


@pytest.mark.parallel(1, 2, 3)
def test_arrays_of_all_ranks_are_in_the_order_of_the_scene():
    rng = np.random.default_rng(4)
    spheres = rng.permutation(np.indices((4, 4, 4)).reshape(3, -1).T)[:40].astype(float)
    boxes = [[9, k, 0] for k in range(5)]
    speeds, turns = rng.normal(size=(40, 3)), rng.normal(size=(5, 4))
    scene = Scene(0.3, gravity=(0, 0, 0))
    scene.add_body("wall", [Plane((0, 0, 1), (0, 0, -9))])
    scene.add_spheres(spheres, 0.1, 1000.0, velocity=speeds)
    scene.add_boxes(boxes, (0.1, 0.2, 0.3), 1000.0, quaternions=turns)
    sim = pctt.Simulation(scene, dt=1e-3)
    sim.step()
    np.testing.assert_allclose(sim.positions, np.vstack([spheres + 1e-3 * speeds, boxes]), rtol=1e-14)
    np.testing.assert_allclose(sim.velocities[:40, :3], speeds)
    np.testing.assert_allclose(sim.orientations[40:], turns / np.linalg.norm(turns, axis=1)[:, None], rtol=1e-14)
    assert WORLD.allreduce(len(sim.local)) == 45
    assert sim.figures["contacts"] == 0


@pytest.mark.parallel(2)
def test_contacts_and_forces_are_the_same_on_all_ranks_and_as_on_one(double):
    alone, sim = (pctt.Simulation(Stirred(), solver="apgd", tol=1e-9, comm=comm) for comm in (SELF, WORLD))
    for each in (alone, sim):
        each.run(steps=8)
    one, all = alone.contacts, sim.contacts
    np.testing.assert_array_equal(all.bodies, one.bodies)
    for name in ("point", "normal", "gap"):
        np.testing.assert_allclose(getattr(all, name), getattr(one, name), atol=1e-6)
    np.testing.assert_allclose(all.force.sum(axis=0), one.force.sum(axis=0), atol=1e-3 * 24)
    np.testing.assert_allclose(sim.body("stirrer").torque, alone.body("stirrer").torque, atol=1e-2)
    for value in (all.force, sim.positions, sim.kinetic_energy, sim.body("box").force):
        assert all_equal(value)


def all_equal(value):
    return len({np.asarray(each).tobytes() for each in WORLD.allgather(value)}) == 1


@pytest.mark.parallel(2)
def test_an_error_of_one_rank_is_one_of_all():
    sim = pctt.Simulation(Stirred(), solver="apgd")

    def bad(sim):
        if WORLD.rank == 1:
            raise KeyError("mine")
        return sim.positions.sum() > 0

    with pytest.raises(SceneError, match="call or stop of run: KeyError: 'mine' .on rank 1 of 2."):
        sim.run(steps=2, stop=bad)
    with pytest.raises(OptionError, match="tol"):
        pctt.Simulation(Stirred(), tol=2.0 if WORLD.rank else 1e-3)
    sim.change("body stirrer", speed=float(WORLD.rank))  # the first rank's counts
    assert sim.body("stirrer").motion.speed == 0.0


@pytest.mark.parallel(2)
def test_files_and_ends_that_differ_between_ranks_are_those_of_the_first(tmp_path):
    """As folders of tempfile do, and ends by a clock. A call may be that of one rank alone."""
    sim, told = pctt.Simulation(Stirred(), solver="apgd"), []
    sim.write(tmp_path / f"of {WORLD.rank}", every=1 + WORLD.rank)
    sim.run(steps=2 + WORLD.rank, call=(lambda sim: told.append(sim.steps)) if WORLD.rank else None)
    sim.run(until=sim.time + (1.0 + WORLD.rank) * sim.settings.dt, every=1 + WORLD.rank)
    sim.close()
    assert told == [1, 2] * WORLD.rank
    assert sim.steps == 3
    assert [path.name for path in tmp_path.glob("of *")] == ["of 0"]
    assert Folder(tmp_path / "of 0").steps == [1, 2, 3]
    kept = "" if WORLD.rank else tmp_path / "of 0" / "checkpoint.h5"
    assert pctt.Simulation(Stirred(), solver="apgd", restart=kept).steps == 3


# -- notebooks ----------------------------------------------------------------------------------------------


def test_a_notebook_shows_the_last_step_as_a_table():
    sim = pctt.Simulation(Stirred(), comm=SELF)
    assert "step 0, time 0 s" in sim._repr_html_()
    sim.run(steps=2)
    shown = sim._repr_html_()
    assert "<th>kinetic_energy [J]</th>" in shown
    assert "<th>iterations</th>" in shown
    assert repr(sim).startswith("<Simulation of Stirred: 14 bodies on 1 ranks, step 2, time 0.02 s, auto to 0.0005, ")


def test_a_picture_of_the_present_state(tmp_path):
    pytest.importorskip("pctt.look.surfaces", reason="vtk 9.4 is not installed (extra `pictures`)")
    sim = pctt.Simulation(Stirred(), comm=SELF)
    sim.render(width=320, height=240)
    sim.run(steps=2)
    picture = sim.render("force", azimuth=30.0, width=320, height=240)
    assert picture._repr_png_()[:8] == b"\x89PNG\r\n\x1a\n"
    assert picture.pixels.shape == (240, 320, 3)
    assert picture.pixels.std() > 10
    picture.save(tmp_path / "now.png")
    assert (tmp_path / "now.png").read_bytes() == picture._repr_png_()
    for bad in ({"color": "taste"}, {"elevation": 90.0}, {"tilt": 1.0}):
        with pytest.raises(OptionError):
            sim.render(**bad)


def test_a_time_step_that_is_too_large_is_warned_of():
    scene = Scene(0.5)
    scene.add_spheres([0.0, 0.0, 0.1], 0.1, 1000.0, velocity=(100.0, 0.0, 0.0))
    with pytest.warns(UserWarning, match=r"dt 0.01 s is too large: a grain goes further .* at most 0.00095 s"):
        pctt.Simulation(scene, dt=0.01, comm=MPI.COMM_SELF)


def test_objects_say_what_they_are(tmp_path):
    """In a line or two, and their columns are those of a table, as pandas takes it."""
    scene = Scene(0.5)
    scene.add_spheres([[0, 0, 0.1], [1, 0, 0.1]], 0.1, 1e3)
    scene.add_body("floor", [Plane((0, 0, 1))])
    scene.add_body("lid", [Mesh.revolved([(0, 1), (1, 1), (0, 2)], 9)], Dynamic(), mass=1.0, inertia=(1, 1, 1))
    scene.add_joint("hinge", "lid", anchor=(0, 0, 1))
    sim = pctt.Simulation(scene, dt=0.001, comm=SELF)
    sim.write(tmp_path)
    sim.step()
    sim.complete()
    shown = [scene, sim, sim.contacts, sim.local, sim.sample, sim.last, sim.world, sim.body("lid"), sim.joint("hinge")]
    shown += [Folder(tmp_path), Folder(tmp_path).frame(1), *(body.shapes[0] for body in scene.large_bodies)]
    for thing in shown:
        assert " object at 0x" not in repr(thing)
        assert len(repr(thing)) < 300
    assert "Mesh of 18 triangles" in repr(shown[-1])
    for grains_or_contacts in (sim.contacts, sim.local):
        columns = dict(grains_or_contacts)
        assert all(column.shape == (2,) for column in columns.values())
    assert dict(sim.contacts)["force_z"].tolist() == sim.contacts.force[:, 2].tolist()


def test_the_way_to_the_end_is_told(capsys):
    """For each tenth of it."""
    sim = pctt.Simulation(Mixer(n=1), dt=0.01, comm=SELF)
    sim.run(steps=20, progress=True)
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 10
    assert re.fullmatch(r"time 0.020 s: 2 of 20 steps in \d+ s, about .* left", lines[0])
    assert re.fullmatch(r"time 0.200 s: 20 of 20 steps in \d+ s", lines[-1])
    sim.run(stop=lambda sim: sim.steps == 25, progress=True)
    assert capsys.readouterr().out.startswith("time 0.250 s: 5 of 5 steps in ")
    sim.run(steps=5)
    assert capsys.readouterr().out == ""
