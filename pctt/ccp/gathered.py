"""A problem of few contacts that are on several ranks, whole on the first one.

There its Newton systems have the factors of `pctt.ccp.newton.elimination`, which are those of one rank: a step of the
conic method then takes as long as the messages of one product of all ranks."""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp
from mpi4py import MPI

from dem.exchange import offsets
from pctt.arrays import Array
from pctt.ccp import door
from pctt.ccp.delassus import GivenMatrix, rows_in_blocks
from pctt.ccp.interior import conic
from pctt.ccp.newton import Newton, by_elimination
from pctt.ccp.problem import ConeProblem
from pctt.ccp.result import Limits, Result


def takes(problem: ConeProblem, newton: Newton) -> bool:
    """Whether a problem has few contacts, on several ranks; the same on all."""
    few = newton.own and problem.comm.size > 1 and problem.size <= by_elimination.FEW
    return few and problem.has_entries and problem.cones.parts == 1


def whole(problem: ConeProblem) -> Whole | None:
    """The problem as a whole, if its systems are then solved by elimination. Collective."""
    known = problem.by_rows()
    # of bodies that fly apart no squares of velocities are numbers
    if known.has_dense_columns or door.out_of_range(known.comm, known.r, known.mean_diagonal):
        return None
    found = Whole(known)
    return found if found.comm.bcast(found.is_cheap) else None


class Whole:
    """A problem of several ranks, gathered once. Its making is collective.

    problem : that of all ranks on the first one, None on the others
    """

    def __init__(self, known: ConeProblem):
        self.comm, self._rows = known.comm, len(known.r)
        N = known.rigid_matrix()
        parts = self.comm.gather((rows_in_blocks(N), known.r, known.mu, known.compliance[:, :2]))
        N.destroy()
        self.problem: ConeProblem | None = None
        self.is_cheap = False  # known to the first rank alone
        if parts is not None:
            rows, *more = zip(*parts)
            matrix = GivenMatrix(MPI.COMM_SELF, sp.vstack([part.tocsr() for part in rows]).tobsr((3, 3)))
            r, mu, soft = map(np.concatenate, more)
            self.problem = ConeProblem(MPI.COMM_SELF, r, mu, N=matrix, compliance=soft)
            self.is_cheap = by_elimination.order_of(matrix) is not None

    def solve(self, r: Array, guess: Array, limits: Limits, options: conic.Conic, coulomb: bool = False) -> Result:
        """What `conic` makes of it on the first rank, with velocities r (nc, 3) of each rank in place of its own.
        Collective."""
        parts, found = self.comm.gather((r, guess)), None
        if self.problem is not None and parts is not None:
            own = Newton(MPI.COMM_SELF, "body")
            r, start = map(np.concatenate, zip(*parts))
            found = conic.solve(self.problem.with_r(r), start, limits.unwatched, options, own, coulomb=coulomb)
            own.destroy()
        result: Result = self.comm.bcast(found)
        for iteration, residual in enumerate(result.history):
            limits.report(iteration, residual)
        first = offsets(self.comm, self._rows)[self.comm.rank]
        result.impulse = result.impulse[first : first + self._rows].copy()
        return result
