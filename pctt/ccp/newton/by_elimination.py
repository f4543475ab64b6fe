"""Newton systems of few contacts on one rank by the project's own choice: elimination by blocks."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from mpi4py import MPI

from pctt.arrays import Array
from pctt.ccp.delassus import GivenMatrix, all_blocks
from pctt.ccp.newton.by_ksp import ByKSP
from pctt.ccp.newton.defaults import GIVEN
from pctt.ccp.newton.elimination import Factors, Order, ordered
from pctt.ccp.newton.factor import Room

if TYPE_CHECKING:
    from pctt.ccp.problem import ConeProblem

FEW = 1000  # contacts up to which an order of elimination is looked for
PAIRS = 100_000  # pairs of blocks in an elimination at most: 20 ns each
REST = 133  # contacts in the dense rest at most: 1 ms
GIVEN_MORE = 100  # times the pairs, and any rest, where no bodies are known: PETSc's factors take longer


def has_few(problem: ConeProblem) -> bool:
    """Whether an order of elimination is looked for."""
    return problem.comm.size == problem.cones.parts == 1 and problem.size <= FEW and problem.has_entries


def matrix_of(problem: ConeProblem) -> GivenMatrix | None:
    """N of few contacts without compliance; None if it is full."""
    if isinstance(problem.operator, GivenMatrix):
        return problem.operator
    assert problem.contact_map is not None
    G = problem.contact_map.block_rows
    if np.square(np.bincount(G.indices)).sum() > 2 * PAIRS + len(G.indices):
        return None
    return GivenMatrix(problem.comm, all_blocks(G))


def order_of(N: GivenMatrix | None, more: int = 1) -> Order | None:
    """An order of elimination; None if none is cheap. With ``more`` it may have so many times as many pairs, and any
    rest."""
    most_rest = REST if more == 1 else FEW
    return None if N is None else ordered(N.local.indptr, N.local.indices, more * PAIRS, most_rest)


def is_cheap(order: Order | None) -> bool:
    """Whether an elimination is one that `order_of` finds by itself."""
    return order is not None and len(order.target) <= PAIRS and order.rest <= REST


class ByElimination:
    """`Factors` in one order for all matrices of a structure. Where a solve fails a KSP takes over, and no object of
    PETSc is made before."""

    takes_unsymmetric = True
    readers: Sequence[str] = ()

    def __init__(self, comm: MPI.Comm, room: Room):
        self.ksp = ByKSP(comm, room, GIVEN)
        self.begin()

    def begin(self) -> None:
        """Another problem."""
        self.ksp.begin()
        self._solves = 0

    def factor(self, system: Any) -> None:
        """The system has new values."""
        self.system = system
        self._factors = Factors(system.N, system.order, system.blocks, system.symmetric)

    def solve(self, b: Array, wanted: float, earlier: Sequence[Array]) -> Array:
        x, count = self._factors.solve(b.reshape(-1, 3), max(wanted, 1e-14 * math.sqrt(b @ b)))
        self._solves += count
        if count:
            return x.ravel()
        self.ksp.factor(self.system)
        return self.ksp.solve(b, wanted, earlier)

    @property
    def iterations(self) -> int:
        return self._solves + self.ksp.iterations

    @property
    def fallbacks(self) -> int:
        return self.ksp.fallbacks

    @property
    def systems(self) -> int:
        return self.ksp.systems

    @property
    def remark(self) -> str:
        return self.ksp.remark

    def words(self) -> str:
        """How systems are solved."""
        return "elimination by blocks"

    def what(self) -> str:
        return self.ksp.what()

    def report(self) -> list[str]:
        return self.ksp.report()

    def forget(self) -> None:
        """The next matrix has another structure."""
        self.ksp.forget()

    def destroy(self) -> None:
        self.ksp.destroy()
