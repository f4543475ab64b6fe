"""Copies, pickles and new beginnings of a simulation, a step that Ctrl-C ends, and tables for pandas."""

from __future__ import annotations

import pickle
import signal

import numpy as np
import pytest
from mpi4py import MPI

from pctt import Box, Hinged, Plane, Scene, Simulation
from pctt.folder import Folder
from pctt.options import OptionError
from pctt.run import stepper


def stirred():
    scene = Scene(0.5)
    scene.add_body("floor", [Plane((0, 0, 1))])
    scene.add_spheres(np.indices((3, 3, 2)).reshape(3, -1).T * 0.21 + 0.1, 0.1, 1e3, velocity=(0.3, 0, 0))
    scene.add_boxes([0.3, 0.3, 0.8], (0.1, 0.08, 0.12), 900.0)
    blade = Hinged((0, 0, 1), torque=5.0, speed=2.0)
    inertia = (0.1, 0.1, 0.1)
    scene.add_body("blade", [Box((0.2, 0.02, 0.1))], blade, position=(-0.5, 0.3, 0.2), mass=2.0, inertia=inertia)
    scene.add_load("wind", force=(1.0, 0, 0))
    return scene


def begun(comm=MPI.COMM_SELF):
    sim = Simulation(stirred(), dt=0.005, comm=comm)
    sim.run(steps=8)
    sim.change("load wind", force=(3.0, 0, 0))
    sim.run(steps=4)
    return sim


def assert_same(one, other):
    assert one.time == other.time
    for name in ("positions", "velocities", "orientations"):
        assert (getattr(one, name) == getattr(other, name)).all()


def test_a_copy_and_a_pickle_go_on_with_the_same_bits_and_apart():
    sim = begun()
    others = [sim.copy(), pickle.loads(pickle.dumps(sim))]
    for each in (sim, *others):
        each.run(steps=5)
    for other in others:
        assert_same(sim, other)
        other.change("load wind", force=(-9.0, 0, 0))
        other.run(steps=3)
        assert (sim.steps, other.steps) == (17, 20)
        assert sim.loads["wind"].force[0] == 3.0
        assert other.velocities[:, 0].mean() < sim.velocities[:, 0].mean()


@pytest.mark.parallel(2)
def test_a_copy_on_ranks_goes_on_with_the_same_bits():
    sim = begun(MPI.COMM_WORLD)
    other = sim.copy()
    for each in (sim, other):
        each.run(steps=5)
    assert_same(sim, other)
    with pytest.raises(TypeError, match="pickle of a simulation on 2 ranks: allowed are one rank, or save and load"):
        pickle.dumps(sim)


def test_reset_goes_back_to_the_beginning(tmp_path):
    sim, first = begun(), Simulation(stirred(), dt=0.005, comm=MPI.COMM_SELF)
    sim.reset()
    assert_same(sim, first)
    assert sim.loads["wind"].force[0] == 1.0
    sim.run(steps=5)
    first.run(steps=5)
    assert_same(sim, first)
    sim.write(tmp_path / "run")
    with pytest.raises(OptionError, match="reset: this simulation writes to"):
        sim.reset()


def test_a_scene_is_pickled():
    scene = pickle.loads(pickle.dumps(stirred()))
    for name, column in stirred().grains().columns().items():
        assert (getattr(scene.grains(), name) == column).all()


@pytest.mark.parametrize("where", ["find_contacts", "advance", "ContactSystem", "unconstrained"])
def test_ctrl_c_in_a_step_leaves_the_state_before_it(monkeypatch, where):
    sim, other, whole = begun(), begun(), getattr(stepper, where)

    def interrupted(*given, **more):
        whole(*given, **more)
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(stepper, where, interrupted)
        with pytest.raises(KeyboardInterrupt):
            sim.run(steps=3)
    assert sim.steps == 12
    assert_same(sim, other)
    for each in (sim, other):
        each.run(steps=4)
    assert_same(sim, other)


def test_ctrl_c_while_files_are_written_waits_for_them(monkeypatch, tmp_path):
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background jobs begin without
    sim, other = begun(), begun()
    sim.write(tmp_path / "run")
    record = sim.output.record
    with monkeypatch.context() as patch:
        patch.setattr(sim.output, "record", lambda *given: (signal.raise_signal(signal.SIGINT), record(*given)))
        with pytest.raises(KeyboardInterrupt):
            sim.run(steps=3)
    assert sim.steps == 13
    sim.run(steps=2)
    other.run(steps=3)
    assert_same(sim, other)
    assert Folder(tmp_path / "run").records()["step"].tolist() == [13, 14, 15]
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_a_bare_number_is_neither_steps_nor_seconds():
    with pytest.raises(OptionError, match=r"run\(100\): steps or seconds\? allowed is run\(steps=100\), or run\(until"):
        begun().run(100)


def test_contacts_and_grains_are_tables():
    sim = begun()
    contacts, grains = dict(sim.contacts), dict(sim.local)
    assert {column.shape for column in contacts.values()} == {(len(sim.contacts),)}
    force = np.stack([contacts[f"force_{axis}"] for axis in "xyz"], axis=1)
    on_floor = contacts["b"] == len(sim.ids)
    assert force[on_floor].sum(axis=0) == pytest.approx(sim.body("floor").force)
    assert (grains["position_z"] == sim.local.position[:, 2]).all()
    pandas = pytest.importorskip("pandas")
    assert len(pandas.DataFrame(contacts)) == len(sim.contacts)
    assert pandas.DataFrame(dict(sim.local))["mass"].sum() == pytest.approx(sim.local.mass.sum())
