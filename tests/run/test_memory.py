"""The memory of a run does not grow with its steps."""

from __future__ import annotations

import json

import pytest
from program import ROOT

STEPS, WARM = 150, 50

#: Prints the growth of the resident memory of each rank, in MiB, for each of the runs whose options it is given.
PROGRAM = """
import json, sys
from pathlib import Path
from mpi4py import MPI
from pctt.run import simulate as program
from pctt.run.options import read_options

comm = MPI.COMM_WORLD
runs, steps, warm = json.loads(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3])
page = 4096 / 2**20

class Watched(program.Stepper):
    def step(self):
        line = super().step()
        if self.world.step in (warm, steps):
            resident.append(int(Path("/proc/self/statm").read_text().split()[1]) * page)
        return line

program.Stepper = Watched
for number, options in enumerate(runs):
    resident = []
    words = {"scene_n": "1", "scene_margin": "0.7", "quiet": None, "steps": str(steps), "output": f"run{number}", **options}
    program.simulate(read_options(words, comm), comm)
    growth = comm.gather(resident[1] - resident[0])
    if comm.rank == 0:
        print(json.dumps(growth))
"""
RUNS = [
    {"ccp_type": "pdip", "ccp_tol": "1e-4", "dump_problem": "problems"},
    {"ccp_type": "apgd", "ccp_tol": "1e-3", "dump_problem": "problems"},
    {"ccp_type": "pdip", "ccp_tol": "1e-4"},
    {"ccp_type": "conic", "ccp_tol": "1e-4"},
    {"ccp_type": "apgd", "ccp_tol": "1e-3"},
]


@pytest.mark.skipif(not (ROOT / "/proc/self/statm").exists(), reason="this system does not tell resident memory")
@pytest.mark.mpi
@pytest.mark.parametrize("ranks", [1, 2])
@pytest.mark.parametrize(
    ("runs", "steps", "bound"),
    [(RUNS[:2], STEPS, 3.0), pytest.param(RUNS, 500, 5.0, marks=pytest.mark.slow)],
    ids=["150 steps", "500 steps"],
)
def test_memory_stays_as_it_is_after_the_first_steps(runs, steps, bound, ranks, mpirun):
    """A leaked map between bodies and contacts, or a matrix for a file, is 8 MiB and more in 100 steps."""
    lines = mpirun(PROGRAM, ranks, json.dumps(runs), steps, WARM).splitlines()
    assert len(lines) == len(runs)
    for options, line in zip(runs, lines):
        growth = json.loads(line)
        assert len(growth) == ranks
        assert max(growth) < bound, (options, growth)
