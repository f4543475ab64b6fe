"""The rank that pays."""

from __future__ import annotations

import pytest

from pctt.pc.rank_policy import BUDGET, RankPolicy


def use(policy: RankPolicy, cost: dict[int, float], times: int, setup: dict[int, float] | None = None) -> list[int]:
    """Let the policy choose; a use of rank r takes setup[r] + 3 cost[r] seconds for three digits."""
    chosen = []
    for _ in range(times):
        rank = policy.choose()
        policy.report(rank, (setup or {}).get(rank, 0.0) + 3 * cost[rank], 3.0)
        chosen.append(rank)
    return chosen


def test_starts_with_block_jacobi():
    assert RankPolicy((10,)).choose() == 1


def test_takes_the_rank_that_is_faster():
    chosen = use(RankPolicy((10,)), {1: 1.0, 10: 0.2}, 2000)
    assert chosen[0] == 1
    assert chosen[-100:].count(10) >= 95


def test_a_rank_that_does_not_pay_costs_little():
    policy = RankPolicy((10,))
    cost, setup = {1: 1.0, 10: 1.5}, {1: 0.0, 10: 1.0}
    chosen = use(policy, cost, 2000, setup)
    extra = chosen.count(10) * (setup[10] + 3 * cost[10] - 3 * cost[1])
    assert chosen.count(10) > 0
    assert extra <= 1.1 * BUDGET * 3 * cost[1] * len(chosen)


def test_an_unsound_rank_is_not_chosen_again():
    policy = RankPolicy((10,), automatic=False)
    assert policy.choose() == 10
    policy.report(10, 1.0, 0.1, sound=False)
    assert policy.choose() == 1
    policy.forgive()
    assert policy.choose() == 10


def test_rank_one_is_never_banned():
    policy = RankPolicy((10,))
    policy.report(1, 1.0, 0.0, sound=False)
    assert policy.choose() == 1


SKEWED = """
import dataclasses
import time
import numpy as np
from mpi4py import MPI
from petsc4py import PETSc
import pctt.pc.sparse_train as module
import pctt.pc.tensor_train as shell
from pctt.pc import rank_policy
from pctt.tt import cross
from pctt.tt.train import Train
from systems import poisson
from test_tensor_train import context, solve, solver

comm = MPI.COMM_WORLD


class Clock: # one rank's goes faster, and jumps
    def __init__(self):
        self.calls = 0

    def perf_counter(self):
        self.calls += 1
        return time.perf_counter() * (1 + 2 * comm.rank) + 0.02 * comm.rank * self.calls


shell.time = Clock()
rank_policy.BUDGET = 0.5 # trials are frequent
mat = poisson(24)
chosen = set()
for refuse in (False, True):
    ksp = solver(mat, max_rank=6)
    ksp.setUp()
    if refuse: # the train that is refused reports what the trial took
        context(ksp).made._is_positive = lambda P: False
    for k in range(60):
        ksp.setOperators(mat)
        mat.stateIncrease()
        assert solve(ksp)[1] < 1e-6
        ranks = comm.allgather(context(ksp).rank)
        assert len(set(ranks)) == 1, ranks
        chosen.add(ranks[0])
    policies = comm.allgather([(f.cost, f.uses) for f in context(ksp).policy.figures.values()])
    assert policies == [policies[0]] * comm.size, policies
    ksp.destroy()
assert len(chosen) > 1, chosen

PETSc.Options().delValue("pc_tt_max_rank")
# processors that round differently: ranks of trains, pivots of crosses, numbers of inverses
mat.shift(4.0)
round_here, dominant, invert = Train.round, cross._dominant, module.invert_near_identity


def invert_here(*arguments, **named):
    inverse = invert(*arguments, **named)
    return dataclasses.replace(inverse, applied=(1 + 1e-12 * comm.rank) * inverse.applied)


Train.round = lambda self, eps=1e-14, max_rank=None: round_here(self, max(eps, 0.3 * comm.rank), max_rank)
cross._dominant = lambda C, most, eps: dominant(C, most if comm.rank == 0 else max(1, most - 1), eps)
module.invert_near_identity = invert_here
for way in ("als", "cross"):
    ksp = solver(mat, rank=6, compress=way)
    assert solve(ksp)[1] < 1e-6
    trains = comm.allgather([core.tobytes() for core in context(ksp).made.inverse.applied.cores])
    assert trains == [trains[0]] * comm.size, way
    ksp.destroy()
print("done", flush=True)
"""


@pytest.mark.mpi
def test_clocks_and_processors_that_differ_do_not_part_the_ranks(mpirun):
    assert mpirun(SKEWED, 2).count("done") == 2
