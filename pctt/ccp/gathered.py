"""A problem of few contacts that are on several ranks, whole on the first one.

There its Newton systems have the factors of `pctt.ccp.newton.elimination`, which are those of one rank: a step of the
conic method then takes as long as the messages of one product of all ranks."""

from __future__ import annotations

from contextlib import suppress

import numpy as np
import scipy.sparse as sp
from mpi4py import MPI

from dem.exchange import offsets
from pctt.arrays import Array
from pctt.ccp.delassus import GivenMatrix, rows_in_blocks
from pctt.ccp.interior import conic
from pctt.ccp.newton import Newton, by_elimination
from pctt.ccp.problem import ConeProblem
from pctt.ccp.result import Limits, Result, Status


def takes(problem: ConeProblem, newton: Newton) -> bool:
    """Whether a problem has few contacts, on several ranks; the same on all."""
    few = newton.own and problem.comm.size > 1 and problem.size <= by_elimination.FEW
    return few and problem.has_entries and problem.cones.parts == 1


def has_elimination(problem: ConeProblem) -> bool:
    """Whether the systems of the whole problem are solved by elimination on the first rank. Collective."""
    if problem.by_rows().has_dense_columns:
        return False
    cheap, whole = False, None
    with suppress(ValueError):  # on the first rank: of bodies that fly apart no squares of velocities are numbers
        whole = _whole(problem, problem.r)
    if whole is not None:
        own = Newton(MPI.COMM_SELF, "body")
        cheap = own.has_elimination(whole[0])
        own.destroy()
        whole[0].destroy()
    return bool(problem.comm.bcast(cheap))


def solve(
    problem: ConeProblem, guess: Array, limits: Limits, options: conic.Conic, newton: Newton, coulomb: bool = False
) -> Result:
    """What `conic` makes of the whole problem on the first rank; GIVEN_UP if its systems are not cheap. Collective."""
    comm, whole = problem.comm, _whole(problem, guess)
    found = Result(guess, Status.GIVEN_UP, "no order of elimination is cheap", np.inf, 0)
    if whole is not None:
        own = Newton(MPI.COMM_SELF, "body")
        if own.has_elimination(whole[0]):
            found = conic.solve(*whole, limits.unwatched, options, own, coulomb=coulomb)
        own.destroy()
        whole[0].destroy()
    found = comm.bcast(found)
    for iteration, residual in enumerate(found.history):
        limits.report(iteration, residual)
    if found.status is Status.GIVEN_UP:
        found.impulse = guess
    else:
        first = offsets(comm, len(problem.r))[comm.rank]
        found.impulse = found.impulse[first : first + len(problem.r)].copy()
    return found


def _whole(problem: ConeProblem, guess: Array) -> tuple[ConeProblem, Array] | None:
    """The problem of all ranks, and its guess, on the first one; None on the others. Collective."""
    known = problem.by_rows()
    N = known.rigid_matrix()
    parts = problem.comm.gather((rows_in_blocks(N), known.r, known.mu, known.compliance, guess))
    N.destroy()
    if parts is None:
        return None
    rows, r, mu, soft, start = zip(*parts)
    N = GivenMatrix(MPI.COMM_SELF, sp.vstack([part.tocsr() for part in rows]).tobsr((3, 3)))
    given = np.concatenate(r), np.concatenate(mu)
    return ConeProblem(MPI.COMM_SELF, *given, N=N, compliance=np.concatenate(soft)[:, :2]), np.concatenate(start)
