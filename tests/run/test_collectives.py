"""How often all ranks wait for each other in a step, outside of the solve: the part that more ranks do not shorten."""

from __future__ import annotations

import sys
from collections import Counter

import pytest
from mpi4py import MPI

import pctt
from dem.scenes import Mixer
from pctt import ccp

COLLECTIVE = {
    *("allgather", "Allgather", "Allgatherv", "allreduce", "Allreduce", "alltoall", "Alltoall", "Alltoallv"),
    *("barrier", "Barrier", "bcast", "Bcast", "exscan", "Exscan", "gather", "Gather", "Gatherv", "reduce", "Reduce"),
    *("scan", "Scan", "scatter", "Scatter", "Scatterv", "Dup", "Split"),
}


def collectives(step):
    """Collective calls from Python within `step()`: of the cone solvers, and of all else."""
    count = Counter()

    def note(frame, event, argument):
        if event == "c_call" and argument.__name__ in COLLECTIVE and isinstance(argument.__self__, MPI.Comm):
            count[is_in_solve(frame)] += 1

    sys.setprofile(note)
    try:
        step()
    finally:
        sys.setprofile(None)
    return count[True], count[False]


def is_in_solve(frame):
    while frame is not None:
        if frame.f_code is ccp.solve.__code__:
            return True
        frame = frame.f_back
    return False


@pytest.mark.parallel(2)
def test_a_step_has_few_collectives_outside_of_the_solve():
    """40, and 90 in the few in which bodies go to other ranks."""
    sim = pctt.Simulation(Mixer(n=2), comm=MPI.COMM_WORLD, solver="apgd", dt=0.01)
    sim.run(steps=20)
    counts = [collectives(sim.step) for _ in range(20)]
    outside = sorted(outside for _, outside in counts)
    assert outside[10] <= 40
    assert outside[-1] <= 90
    assert outside[0] > 0
    assert all(solve > 0 for solve, _ in counts)
