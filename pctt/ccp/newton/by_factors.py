"""Newton systems of the bodies by the project's own choice: conjugate gradients with block Jacobi, then factors."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from mpi4py import MPI

from pctt.arrays import Array
from pctt.ccp.newton.conjugate_gradients import ConjugateGradients
from pctt.ccp.newton.defaults import DEFAULTS
from pctt.ccp.newton.factor import Room, easy_iterations
from pctt.ccp.newton.iterative import Iterative
from pctt.ccp.newton.krylov import Solve
from pctt.ksp_options import OWN
from pctt.petsc import options_database

if TYPE_CHECKING:
    from pctt.ccp.newton.forms import System

LIMIT = 2.0  # iterations with block Jacobi at most, in units of the easy ones
ALONE = 20_000  # the same where the memory has no room for a factor


class ByFactors(Iterative):
    """Systems get harder from one iteration of an interior point method to the next; so once they take many iterations
    with block Jacobi, the rest of the problem is left to factors. The choice rests on iteration counts, so that a
    repeated run repeats it. Where the memory has no room for factors, block Jacobi goes on alone."""

    takes_unsymmetric = True

    def __init__(self, comm: MPI.Comm, room: Room):
        super().__init__(comm, room, DEFAULTS["body"])
        self._own = ConjugateGradients(comm)
        self.begin()

    def begin(self) -> None:
        super().begin()
        self._most, self._hard = 0, False
        self._asked = any(name.startswith(OWN + "ksp_") for name in options_database())

    def factor(self, system: System) -> None:
        super().factor(system)
        self._own.renew()
        self._easy = easy_iterations(self.comm, system)
        self._hard = self._hard or self._most > self._easy

    def solve(self, b: Array, wanted: float, earlier: Sequence[Array]) -> Array:
        x, rtol = self.start(b, wanted, earlier)
        if not rtol:
            return x
        system, first = self.system, None
        if not self._hard:
            first = self._by_jacobi(rtol, int(LIMIT * self._easy))
            self.iterations += first.iterations
            self._most = max(self._most, first.iterations)
            if first.converged:
                return x + self._x.array
        self._hard, before = True, self._x.array.copy()
        last, iterations = self.factors.solve(system, self._b, self._x, rtol)
        if last is None:
            last = self.krylov("alone", {"ksp_max_it": str(ALONE)}).solve(system.matrix, self._b, self._x, rtol)
            iterations += last.iterations
        self.iterations += iterations
        self.fallbacks += not last.converged
        return self.end(x, first, last, before)

    def _by_jacobi(self, rtol: float, most: int) -> Solve:
        """By block Jacobi; in compiled loops if the matrix is symmetric, and no option asks for a KSP."""
        if self._symmetric and not self._asked:
            return self._own.solve(self.system.matrix, self._b, self._x, rtol, most)
        return self.krylov("", {"ksp_max_it": str(most)}).solve(self.system.matrix, self._b, self._x, rtol)

    def words(self) -> str:
        """Krylov method and preconditioner."""
        return "CG, pbjacobi until it takes long, then cholesky"
