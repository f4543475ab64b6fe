"""A run that goes on from a checkpoint takes the way that it would have taken."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import threading
import time
from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np
import pytest
from mpi4py import MPI
from program import (
    DROP,
    EVERY,
    SETTLED,
    SMALL,
    arrays,
    assert_same_bits,
    database,
    recorded_steps,
    simulated,
    steps_of,
    summary_of,
)
from sealed import edited

import pctt
from dem.experiment import Experiment
from dem.scene import Scene
from dem.shapes import Plane
from pctt.disk import FileError, Lock
from pctt.folder import Folder
from pctt.options import OptionError
from pctt.run.settings import Settings
from pctt.run.state import origin, settled_path, unfinished
from pctt.scenes import Mixer
from pctt.simulation import Simulation


@pytest.mark.parallel(1, 2)
def test_on_as_many_ranks_the_way_is_the_same_bit_for_bit(program, settled, tmp_path):
    options = ("-ccp_type", "pdip", "-ccp_tol", 1e-2)
    program(*SETTLED, *options, "-steps", 3, "-output", "whole")
    program(*SETTLED, *options, "-steps", 2, "-output", "parts")
    again = (*SMALL, *EVERY, *options, "-restart", "parts/checkpoint.h5", "-output", "parts")
    program(*again, "-steps", 1)
    for name in ("state.h5", "checkpoint.h5"):
        assert_same_bits(tmp_path / "whole" / name, tmp_path / "parts" / name)
    steps = [steps_of(tmp_path / d) for d in ("whole", "parts")]
    for one, two in zip(*steps):
        for field in ("step", "time", "contacts", "newton_its", "ksp_its", "objective"):
            assert one[field] == two[field], field
        # numpy's arctan2, in which it is measured, may round otherwise at another place in memory
        assert one["natural_residual"] == pytest.approx(two["natural_residual"], rel=1e-9)
    assert len(steps[0]) == len(steps[1]) == 3


def test_a_checkpoint_of_another_format_is_refused(tmp_path):
    sim = pctt.Simulation(Mixer(n=1), dt=0.02, solver="apgd", comm=MPI.COMM_SELF)
    sim.save(tmp_path / "old.h5")
    with edited(tmp_path / "old.h5") as file:
        file.attrs["format"] = "pctt checkpoint 3"
    words = r"old\.h5: .*its format is 'pctt checkpoint 3'; allowed is 'pctt checkpoint 4'"
    with pytest.raises(FileError, match=words):
        pctt.Simulation.load(tmp_path / "old.h5", Mixer(n=1), dt=0.02, solver="apgd", comm=MPI.COMM_SELF)
    with h5py.File(tmp_path / "old.h5", "a") as file:
        file.attrs["format"] = "pctt checkpoint 4"
    with pytest.raises(FileError, match="it has no checksum"):
        pctt.Simulation.load(tmp_path / "old.h5", Mixer(n=1), dt=0.02, solver="apgd", comm=MPI.COMM_SELF)


#: A scene file: spheres that lie on each other.
PILE = DROP.replace("0.05 * k, 0, self.height + 0.3 * k", "0.2 * (k % 3), 0.2 * (k // 3 % 3), 0.1 + 0.2 * (k // 9)")
PILE = PILE.replace("range(3)", "range(27)")


@pytest.mark.parallel(3)
def test_on_another_number_of_ranks_the_way_is_the_same_but_for_rounding(tmp_path, monkeypatch, double):
    """Twenty iterations a step, solved or not: only the order of sums depends on the ranks."""
    monkeypatch.chdir(tmp_path)
    comm = MPI.COMM_WORLD
    if comm.rank == 0:
        (tmp_path / "pile.py").write_text(PILE)
    comm.Barrier()
    one, two = (comm.Split(0 if comm.rank < count else MPI.UNDEFINED) for count in (1, 2))
    options = ("-scene", "pile.py", *EVERY, "-ccp_type", "apgd", "-ccp_max_it", "20", "-ccp_fallback", "0", "-quiet")

    def run(ranks, *more):
        if ranks != MPI.COMM_NULL:
            simulated(database([*options, *more]), ranks)
        comm.Barrier()

    run(one, "-steps", "2", "-output", "whole")
    run(two, "-steps", "1", "-output", "half")
    for name, ranks in (("on1", one), ("on3", comm)):
        run(ranks, "-restart", "half/checkpoint.h5", "-steps", "1", "-output", name)
    whole = arrays(tmp_path / "whole" / "state.h5")
    last = recorded_steps(whole)[-1]
    for ranks in (1, 3):
        part = arrays(tmp_path / f"on{ranks}" / "state.h5")
        for name in ("position", "quaternion", "velocity"):
            here, there = part[f"{last}/{name}"], whole[f"{last}/{name}"]
            np.testing.assert_allclose(here, there, rtol=0, atol=1e-10, err_msg=f"{name} on {ranks}")
        keys = [np.argsort(table[f"{last}/contact/key"]) for table in (part, whole)]
        for name in ("key", "body", "gap", "impulse"):
            here, there = (t[f"{last}/contact/{name}"][k] for t, k in zip((part, whole), keys))
            np.testing.assert_allclose(here, there, rtol=0, atol=1e-9, err_msg=f"{name} on {ranks}")


def test_a_scene_that_another_run_settles_is_waited_for(program, settled, tmp_path):
    folder = tmp_path / "cache" / "pctt"
    folder.mkdir(parents=True)
    other = Lock((folder / settled.name).with_suffix(".lock"))
    assert other.take()

    def end():
        shutil.copy(settled, folder)
        other.release()

    timer = threading.Timer(0.5, end)
    timer.start()
    done = program(*SETTLED, "-steps", 1, "-ccp_type", "apgd", cache=tmp_path / "cache")
    timer.join()
    assert "waits for another run that settles the same scene" in done.stdout
    assert "settling mixer" not in done.stdout
    assert [path.name for path in folder.glob("*.h5")] == [settled.name]


def test_a_cache_that_cannot_be_made_is_named(program, tmp_path):
    (tmp_path / "file").touch()
    done = program(*SETTLED, status=2, cache=tmp_path / "file")
    assert f"{tmp_path}/file/pctt: cannot write" in done.stderr


def test_a_settled_state_is_known_by_its_scene_and_by_what_settled_it(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))

    def path(scene=None, **changes):
        scene = scene or Mixer(n=2)
        settings = Settings(**changes).completed_for(scene)
        return settled_path(scene, settings, scene.build(), origin(scene, scene.build(), settings.dt))

    paths = [path(), *(path(Mixer(**more)) for more in ({"n": 3}, {"n": 2, "friction": 0.3}, {"n": 2, "seed": 5}))]
    paths += [path(settle_tol=0.7)]
    assert len(set(paths)) == len(paths)
    assert {path.parent for path in paths} == {tmp_path / "pctt"}
    for changes in ({"solver": "pdip"}, {"dt": 0.7}, {"delta": 0.7}, {"recovery_speed": 0.7}, {"stiffness": 1e7}):
        assert paths[0] == path(**changes)


@pytest.fixture
def drop(tmp_path, monkeypatch):
    """`drop(text, options)` runs a scene file with this text on from out/checkpoint.h5, where two steps of DROP are."""
    monkeypatch.chdir(tmp_path)

    def run(text, **options):
        (tmp_path / "drop.py").write_text(text)
        words = {"scene": "drop.py", "ccp_type": "apgd", "steps": "2", "output": "out", "quiet": "true", **options}
        simulated(words)

    run(DROP)

    def go_on(text, restart="out/checkpoint.h5", **options):
        run(text, **options, **({"restart": restart} if restart else {}))

    return go_on


def step_of(path):
    return int(arrays(path)["world/step"])


def test_another_text_of_the_scene_file_is_warned_of(drop, tmp_path):
    changed = DROP.replace("friction=0.3", "friction=0.4")
    digests = [hashlib.sha256(text.encode()).hexdigest() for text in (DROP, changed)]
    with pytest.warns(UserWarning, match="out/checkpoint.h5 was made with another text.*: {}, now {}".format(*digests)):
        drop(changed)
    assert step_of(tmp_path / "out" / "checkpoint.h5") == 4


@pytest.mark.filterwarnings("ignore:.*another text of the scene file")
def test_other_bodies_or_options_of_a_changed_scene_file_are_refused(drop):
    for text, words in {
        DROP.replace("range(3)", "range(4)"): ("-restart out/checkpoint.h5", "3 grains", "4"),
        DROP.replace("option(0.2", "option(2.0"): ("-scene_height 2.0", "made with -scene_height 0.2"),
        DROP.replace("height", "level"): ("-scene_level 0.2", "made with -scene_level (no such option)"),
    }.items():
        with pytest.raises(OptionError) as refusal:
            drop(text)
        for word in words:
            assert word in str(refusal.value)


def test_another_surface_of_a_tool_is_warned_of(drop, tmp_path):
    """The text of the scene file is the same, the file with the triangles is not."""
    tool = DROP.replace("import Plane", "import Mesh, Plane").replace("from dem.scene", "import numpy\nfrom dem.scene")
    body = 'scene.add_body("tool", [Mesh(numpy.load("tool.npy"), [[0, 1, 2]])], position=(3, 0, 1))'
    tool = tool.replace("        return scene", f"        {body}\n        return scene")
    corners = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
    np.save("tool.npy", corners)
    drop(tool, restart="", overwrite="true")
    drop(tool)
    np.save("tool.npy", 2.0 * corners)
    with pytest.warns(UserWarning, match="""other surfaces of bodies: {"tool": \\["1", "0.5".*, now .*"1", "2","""):
        drop(tool)
    assert step_of(tmp_path / "out" / "checkpoint.h5") == 6


@pytest.mark.parallel(1, 2)
@pytest.mark.parametrize("name", ["checkpoint.h5", "frames/000002.h5"])
@pytest.mark.parametrize("flips", [15, pytest.param(2000, marks=pytest.mark.slow)])
def test_a_flipped_bit_is_an_error_on_all_ranks(name, flips, tmp_path, monkeypatch):
    """Anywhere before the seal."""
    monkeypatch.chdir(tmp_path)
    comm = MPI.COMM_WORLD
    with Simulation(Mixer(n=1, margin=0.7), solver="apgd") as sim:
        sim.write("out")
        sim.run(steps=2)
        position, key = sim.positions, np.sort(np.concatenate(comm.allgather(sim.memory.state()[0])))
    path, rng = tmp_path / "out" / name, np.random.default_rng(comm.bcast(time.time_ns()))
    whole = path.read_bytes()
    comm.Barrier()

    def read():
        if name == "checkpoint.h5":
            again = Simulation.load(path, Mixer(n=1, margin=0.7), solver="apgd")
            np.testing.assert_array_equal(again.positions, position)
            again_key = np.sort(np.concatenate(comm.allgather(again.memory.state()[0])))
            np.testing.assert_array_equal(again_key, key)
        else:
            np.testing.assert_array_equal(Folder("out").frame(2).position[:27], position)

    for _ in range(flips):
        place, bit = int(rng.integers(len(whole) - 16)), int(rng.integers(8))
        if comm.rank == 0:
            path.write_bytes(whole[:place] + bytes([whole[place] ^ 1 << bit]) + whole[place + 1 :])
        comm.Barrier()
        with pytest.raises(FileError, match="damaged, or no such file"):
            read()
        comm.Barrier()
    if comm.rank == 0:
        path.write_bytes(whole)
    comm.Barrier()
    read()


def test_figures_that_are_no_numbers_are_gone_on_with(drop, tmp_path):
    """Such a step is told by null in steps.jsonl, and its residual is the worst."""
    path = tmp_path / "out" / "steps.jsonl"
    first, second = path.read_text().splitlines()
    path.write_text("\n".join([json.dumps({**json.loads(first), "natural_residual": None}), second, ""]))
    drop(DROP, quiet="false")
    assert [line["natural_residual"] is None for line in steps_of(tmp_path / "out")] == [True, False, False, False]
    summary = summary_of(tmp_path / "out")
    assert (summary["steps"], summary["natural_residual"]) == (4, None)


IMPOSSIBLE = {
    "grains/mass": (np.inf, "mass or inertia of a grain"),
    "grains/size": (-1.0, "size of a grain"),
    "grains/quaternion": (0.0, "quaternion of a grain"),
    "grains/velocity": (np.nan, "velocity of a grain"),
    "grains/id": (1, "id of a grain"),
    "grains/material": (7, "material of a grain"),
    "world/step": (-3, "time or step"),
    "contacts/impulse": (np.nan, "impulses of contacts"),
}


@pytest.mark.parallel(1, 2)
def test_a_state_that_no_run_can_have_is_refused(tmp_path, monkeypatch):
    """As if somebody had edited the file."""
    monkeypatch.chdir(tmp_path)
    if MPI.COMM_WORLD.rank == 0:
        with Simulation(Mixer(n=1, margin=0.7), solver="apgd", comm=MPI.COMM_SELF) as sim:
            sim.run(until=0.6)
            sim.save("whole.h5")
    for name, (value, words) in list(IMPOSSIBLE.items())[:: MPI.COMM_WORLD.size ** 2]:
        if MPI.COMM_WORLD.rank == 0:
            shutil.copy("whole.h5", "edited.h5")
            with edited("edited.h5") as file:
                assert file[name].size
                file[name][() if file[name].ndim == 0 else slice(2)] = value
        MPI.COMM_WORLD.Barrier()
        with pytest.raises(OptionError, match=words):
            Simulation.load("edited.h5", Mixer(n=1, margin=0.7), solver="apgd")
        MPI.COMM_WORLD.Barrier()


@pytest.mark.parallel(1, 2)
def test_columns_of_other_lengths_are_refused(tmp_path, monkeypatch):
    """Of grains, contacts and large bodies, one row fewer or one more, or none at all."""
    monkeypatch.chdir(tmp_path)
    comm, scene = MPI.COMM_WORLD, Mixer(n=1, margin=0.7)
    if comm.rank == 0:
        with Simulation(scene, solver="apgd", comm=MPI.COMM_SELF) as sim:
            sim.run(until=0.6)
            sim.save("whole.h5")
    comm.Barrier()
    with h5py.File("whole.h5", "r") as file:
        names = [f"{group}/{name}" for group in ("grains", "contacts") for name in file[group]]
        names += [f"world/{name}" for name in file["world"] if name.startswith("large_")] + ["world/slabs"]
        kept = {name: file[name][()] for name in names}
    for turn, (name, rows) in list(enumerate(kept.items()))[:: 5 * comm.size - 4]:
        change = [rows[:-1], np.concatenate([rows, rows[-1:] + (name == "world/slabs")]), rows.ravel()[0]][turn % 3]
        if comm.rank == 0:
            shutil.copy("whole.h5", "edited.h5")
            with edited("edited.h5") as file:
                del file[name]
                file[name] = change
        comm.Barrier()
        with pytest.raises(FileError, match=rf"edited\.h5: damaged.*({name}|{name.partition('/')[0]}/.*) (has|is)"):
            Simulation.load("edited.h5", scene, solver="apgd")
        comm.Barrier()


@dataclass(frozen=True)
class Settles(Experiment):
    dt = 0.01
    settling_time = 0.04

    def build(self):
        scene = Scene(friction=0.3)
        scene.add_body("floor", [Plane(normal=(0, 0, 1))])
        scene.add_spheres([[x, 0, 0.1] for x in range(4)], 0.1, 1000.0)
        return scene


@pytest.mark.parallel(1, 2)
def test_damaged_files_of_a_settling_are_made_anew_with_a_remark(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    comm, said = MPI.COMM_WORLD, []

    def settled():
        said.clear()
        with Simulation(Settles(), restart="settled", solver="apgd", say=said.append) as sim:
            assert sim.steps == 4
            return Path(sim.restart)

    path = settled()
    assert comm.bcast(said[:1]) == ["settling Settles, 4 steps with APGD to 0.001:"]
    whole = path.read_bytes()
    comm.Barrier()
    assert settled() == path
    assert said == []
    if comm.rank == 0:
        path.write_bytes(whole[:-100])
    comm.Barrier()
    settled()
    assert comm.bcast("\n".join(said)).count("it is made anew") == 1
    if comm.rank == 0:
        os.replace(path, unfinished(path))
        unfinished(path).write_bytes(whole[: len(whole) // 2])
    comm.Barrier()
    settled()
    assert comm.bcast("\n".join(said)).count("settled from the beginning") == 1
    assert not unfinished(path).exists()


def test_impulses_of_a_checkpoint_begin_another_time_step_scaled(tmp_path):
    """A sphere at rest is held by the impulse m g dt."""
    scene = Scene(0.5)
    scene.add_body("floor", [Plane((0, 0, 1))])
    scene.add_spheres([0.0, 0.0, 0.1], 0.1, 1000.0)
    with Simulation(scene, dt=0.01, tol=1e-9, comm=MPI.COMM_SELF) as sim:
        sim.run(steps=30)
        sim.save(tmp_path / "state.h5")
    with Simulation.load(tmp_path / "state.h5", scene, dt=0.002, comm=MPI.COMM_SELF) as sim:
        sim.save(tmp_path / "scaled.h5")
        sim.step()
        assert sim.velocities[0] == pytest.approx(0.0, abs=1e-6)
    with h5py.File(tmp_path / "scaled.h5") as file:
        impulse = file["contacts/impulse"][:]
    assert np.linalg.norm(impulse, axis=1) == pytest.approx(4e3 / 3 * np.pi * 0.1**3 * 9.81 * 0.002, rel=1e-3)
