"""The memory of a run does not grow with its steps."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

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
        (2, RUNS[:1], STEPS, 2.0),
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
