"""Newton systems by the KSP that the options name, and where that fails by a factor."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from mpi4py import MPI

from pctt.arrays import Array
from pctt.ccp.newton.compare import Comparison
from pctt.ccp.newton.defaults import INCOMPLETE, Options
from pctt.ccp.newton.factor import Room
from pctt.ccp.newton.iterative import Iterative

if TYPE_CHECKING:
    from pctt.ccp.newton.forms import System

#: Iterations of BiCGStab with block Jacobi after which the next matrix of contacts gets an incomplete factor, which
#: costs as much as 25; and with that factor, up to which the next gets none: block Jacobi takes 6 to 8 times as many.
MANY, FEW = 25, 4


class ByKSP(Iterative):
    """The user's KSP, to at most twice the asked true residual. Where it fails, a factor of the matrix takes over.

    compare : its preconditioners are tried in place of the KSP
    incomplete : whether incomplete factors take over from block Jacobi while that would take long. Systems are hard in
        the middle of a problem. The choice rests on iteration counts, so that a repeated run repeats it
    entries : whether systems have them: else nothing but a KSP works on them
    unsymmetric : whether it `takes_unsymmetric` systems
    """

    def __init__(
        self, comm: MPI.Comm, room: Room, defaults: Options, compare: Comparison | None = None,
        incomplete: bool = False, entries: bool = True, unsymmetric: bool = False,
    ):  # fmt: skip
        super().__init__(comm, room, defaults)
        self.compare, self.incomplete, self._entries = compare, incomplete, entries
        self.takes_unsymmetric = unsymmetric
        self.begin()

    def begin(self) -> None:
        super().begin()
        self._with_incomplete, self._latest = False, 0

    def factor(self, system: System) -> None:
        super().factor(system)
        most = FEW if self._with_incomplete else MANY
        self._with_incomplete, self._latest = self.incomplete and self._latest > most, 0

    def solve(self, b: Array, wanted: float, earlier: Sequence[Array]) -> Array:
        x, rtol = self.start(b, wanted, earlier)
        if not rtol:
            return x
        system = self.system
        if self.compare is not None and self.compare.due():
            first = self.compare.run(system.matrix, self._b, self._x, rtol, system.entries)
        else:
            solver = self.krylov("incomplete", INCOMPLETE) if self._with_incomplete else self.krylov("", {})
            first = solver.solve(system.matrix, self._b, self._x, rtol, system.entries)
        self.iterations += first.iterations
        self._latest = max(self._latest, first.iterations)
        if first.converged:
            return x + self._x.array
        self.fallbacks += 1
        before, last = self._x.array.copy(), None
        if self._entries:
            last, iterations = self.factors.solve(system, self._b, self._x, rtol)
            self.iterations += iterations
        return self.end(x, first, last, before)

    @property
    def readers(self) -> list[str]:
        usual = self.krylov("", {})
        compared = [] if self.compare is None else self.compare.readers
        return [usual.kind] * usual.needs_entries + compared

    def words(self) -> str:
        """Krylov method and preconditioner."""
        later = f", {INCOMPLETE['pc_python_type']} where that takes long" if self.incomplete else ""
        return self.krylov("", {}).words() + later
