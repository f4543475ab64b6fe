"""Newton systems of the interior point method: the Schur complement S = N + barrier blocks (3Nc x 3Nc).

N's structure and values are copied once per cone problem; a Newton step writes the diagonal blocks alone.
"""

from __future__ import annotations

import numpy as np
from petsc4py import PETSc

from pctt.ccp.compare import Comparison
from pctt.ccp.cone import Array
from pctt.ccp.krylov import Krylov
from pctt.ccp.problem import ConeProblem
from pctt.log import phase

# what solves a Newton system when the asked-for KSP does not: the ladder, in this order
LADDER = {
    "pbjacobi": {"pc_type": "pbjacobi"},
    "cholesky": {"pc_type": "cholesky", "ksp_type": "preonly"},
}
CHOLESKY_LIMIT = 50_000  # contacts: above, the factor of a packing takes more than the rest of the step


class SchurSystem:
    """S = N + diag(B_1, ..., B_Nc) and the KSP without prefix that solves with it.

    ``rtol`` is the relative tolerance of the linear solves where ``-ksp_rtol`` does not say otherwise.

    Attributes
    ----------
    ksp_its : Krylov iterations so far
    fallbacks : systems that the asked-for KSP did not solve to twice its tolerance
    """

    def __init__(self, problem: ConeProblem, rtol: float, compare: Comparison | None = None):
        self.problem, self.rtol, self.compare = problem, rtol, compare
        self.S = problem.N.duplicate(copy=True)
        self.S.setOption(PETSc.Mat.Option.SYMMETRIC, True)
        # what preconditioners may ask for: the places of the contacts, and what S is made of
        if problem.point is not None:
            self.S.setAttr("coordinates", problem.point)
        if problem.contact_map is not None:
            self.S.setAttr("contact_map", problem.contact_map)
        first, last = self.S.getOwnershipRange()
        self._block_rows = np.arange(first // 3, last // 3, dtype=PETSc.IntType)[:, None]
        self._x, self._b = self.S.createVecs()
        self._krylov: dict[str, Krylov] = {}
        self.ksp_its = self.fallbacks = 0

    def update(self, barrier: Array) -> None:
        """Put the barrier blocks (nc, 3, 3) in."""
        with phase("CCPUpdate"):
            self.S.setAttr("barrier", barrier)
            blocks = self.problem.diagonal_blocks + barrier
            if len(blocks):  # petsc4py divides by their number
                self.S.setValuesBlockedRCV(self._block_rows, self._block_rows, blocks.reshape(-1, 9))
            self.S.assemble()

    def solve(self, rhs: Array) -> Array:
        """S^-1 rhs (nc, 3), by the asked-for KSP or the first of the ladder that can."""
        with phase("CCPKrylov"):
            self._b.array[:] = rhs.ravel()
            if self.compare is not None and self.compare.due():
                done = self.compare.run(self.S, self._b, self._x, self.rtol)
            else:
                done = self._solver("").solve(self.S, self._b, self._x)
            self.ksp_its += done.iterations
            if not done.converged:
                self.fallbacks += 1
                self._climb_down(done.true_residual)
            return self._x.array.reshape(-1, 3).copy()

    def tighten(self) -> None:
        """Solve ten times more accurately from now on."""
        self.rtol = max(0.1 * self.rtol, 1e-12)
        for krylov in self._krylov.values():
            krylov.set_rtol(self.rtol)
        if self.compare is not None:
            self.compare.set_rtol(self.rtol)

    def _climb_down(self, best: float) -> None:
        """Try the ladder; keep in x what has the smallest true residual, or zero if nothing is below 1."""
        kept = self._x.array.copy() if best < 1 else np.zeros(self._x.getLocalSize())
        best = min(best, 1.0)
        for name in LADDER:
            if name == "cholesky" and self.problem.size > CHOLESKY_LIMIT:
                break
            done = self._solver(name).solve(self.S, self._b, self._x)
            self.ksp_its += done.iterations
            if done.true_residual < best:
                best, kept = done.true_residual, self._x.array.copy()
            if done.converged:
                break
        self._x.array[:] = kept

    def _solver(self, name: str) -> Krylov:
        if name not in self._krylov:
            prefix = f"fallback_{name}_" if name else ""
            self._krylov[name] = Krylov(self.problem.comm, prefix, LADDER.get(name), self.rtol)
        return self._krylov[name]

    def destroy(self) -> None:
        for krylov in self._krylov.values():
            krylov.destroy()
        if self.compare is not None:
            self.compare.forget_systems()
        for thing in (self.S, self._x, self._b):
            thing.destroy()
