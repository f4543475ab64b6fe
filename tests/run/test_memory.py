"""The memory of a run does not grow with its steps, nor that of a step beyond what its contacts need."""

from __future__ import annotations

import gc
import json
import sys
from pathlib import Path
from types import FunctionType, ModuleType

import numpy as np
import pytest

import pctt
from dem.shapes import Plane
from dem.together import SceneError
from pctt.ccp.first_order.scaled import ScaledProblem
from pctt.run import state
from pctt.scenes import Drum, Mixer, Wheel

STEPS = 70
WARM = 0.4  #: part of the steps in which arrays grow with the contacts, and loops are loaded

#: Prints the growth of the resident memory of each rank, in MiB, in a run with the options that it is given. Files are
#: not forced to the disk: it would take most of the time.
PROGRAM = """
import json, os, sys
from pathlib import Path
from mpi4py import MPI
from pctt import simulation
from pctt.run.options import read_options
from pctt.run.simulate import simulate

comm = MPI.COMM_WORLD
options, steps, warm = json.loads(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3])
os.fsync = lambda descriptor: None
page = 4096 / 2**20

class Watched(simulation.Stepper):
    def take(self, made):
        super().take(made)
        if self.world.step in (warm, steps):
            resident.append(int(Path("/proc/self/statm").read_text().split()[1]) * page)

simulation.Stepper = Watched
resident = []
words = {"scene_n": "1", "scene_margin": "0.7", "quiet": None, "steps": str(steps), "output": options["ccp_type"]}
simulate(read_options({**words, **options}, comm), comm)
growth = comm.gather(resident[1] - resident[0])
if comm.rank == 0:
    print(json.dumps(growth))
"""
RUNS = [
    {"ccp_type": "pdip", "ccp_tol": "1e-2", "dump_problem": "problems"},
    {"ccp_type": "apgd", "ccp_tol": "1e-3"},
    {"ccp_type": "conic", "ccp_tol": "1e-4"},
]


@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="this system does not tell resident memory")
@pytest.mark.mpi
@pytest.mark.parametrize(
    ("ranks", "runs", "steps", "bound"),
    [
        (1, RUNS[:1], STEPS, 2.0),
        pytest.param(1, RUNS, 500, 5.0, marks=pytest.mark.slow),
        pytest.param(2, RUNS, 500, 5.0, marks=pytest.mark.slow),
    ],
)
def test_memory_stays_as_it_is_after_the_first_steps(ranks, runs, steps, bound, mpirun):
    """Where the maps between bodies and contacts leaked, and the matrices for files, it grew by 5 MiB in 60 steps."""
    for options in runs:
        (line,) = mpirun(PROGRAM, ranks, json.dumps(options), steps, int(WARM * steps), seconds=4 * steps).splitlines()
        growth = json.loads(line)
        assert len(growth) == ranks
        assert max(growth) < bound, (options, growth)


def bytes_of_arrays(*roots):
    """Of all arrays that objects refer to, each counted once, and as the whole one that a view is of."""
    found, seen, todo = {}, {}, list(roots)
    while todo:
        thing = todo.pop()
        if id(thing) in seen or isinstance(thing, (type, ModuleType)):
            continue
        seen[id(thing)] = thing
        if isinstance(thing, np.ndarray):
            while isinstance(thing.base, np.ndarray):
                thing = thing.base
            found[thing.ctypes.data] = thing.nbytes
        else:
            todo += thing.__closure__ or () if isinstance(thing, FunctionType) else gc.get_referents(thing)
    return sum(found.values())


def test_iterations_of_a_step_hold_few_bytes_per_contact(monkeypatch):
    """In a lattice of 1,000 spheres with 2,800 contacts they held 1,380 bytes, with blocks of N, sizes of unknowns that
    follow from each other, and a second copy of each iterate."""
    most, step = [], ScaledProblem.step

    def watched(self, *arguments):
        frame, scopes = sys._getframe(), []
        while frame.f_code is not pctt.Simulation.step.__code__:
            scopes.append(dict(frame.f_locals))
            frame = frame.f_back
        most.append(bytes_of_arrays(sim, *scopes))
        return step(self, *arguments)

    scene = pctt.Scene(0.4)
    scene.add_body("floor", [Plane((0, 0, 1))])
    place = 0.2 * np.indices((10, 10, 10)).reshape(3, -1).T + 0.1
    scene.add_spheres(place, 0.1, 1000.0, velocity=np.random.default_rng(0).normal(0.0, 0.3, place.shape))
    with pctt.Simulation(scene, dt=0.005, say=lambda _: None) as sim:
        sim.step()
        monkeypatch.setattr(ScaledProblem, "step", watched)
        sim.step()
        contacts = sim.figures["contacts"]
    assert contacts > 2500
    assert 0 < max(most) < 1150 * contacts


def test_a_scene_that_no_memory_holds_is_refused_before_its_grains_are_made(monkeypatch):
    with pytest.raises(SceneError, match=r"8e\+15 grains need about 2.56e\+10 GB of memory, and cannot even start"):
        pctt.Simulation(Mixer(n=99999))
    for scene in (Wheel, Drum):
        with pytest.raises(ValueError, match=r"^n 99999 asks for .* places of spheres; allowed are 2.7e\+08"):
            assert scene(n=99999).settling_time
    monkeypatch.setattr(state, "available", lambda comm: 3e4)
    with pytest.warns(UserWarning, match="27 grains need about 8.64e-05 GB of memory once they lie on each other"):
        pctt.Simulation(Mixer(n=1)).close()
