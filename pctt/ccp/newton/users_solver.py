"""The user's solver of Newton systems: the KSP of the options, with a ladder behind it."""

from __future__ import annotations

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from pctt.ccp.newton.compare import Comparison
from pctt.ccp.newton.form import NewtonForm
from pctt.ccp.newton.krylov import Krylov, LinearSolver, Solve

CHOLESKY_LIMIT = 50_000  # contacts: above, a factor of the contact matrix takes more than the rest of the step

# what solves a system of contacts when the user's KSP does not, in this order
LADDER = {
    "cg": {"pc_type": "pbjacobi", "ksp_type": "cg", "ksp_norm_type": "unpreconditioned"},
    "cholesky": {"pc_type": "cholesky", "ksp_type": "gmres"},
}


class UsersSolver(LinearSolver):
    """A `LinearSolver` by the KSP without prefix, with the user's options. Systems that it does not solve to twice the
    tolerance go down the ladder."""

    def __init__(self, comm: MPI.Comm, defaults: dict[str, str], compare: Comparison | None, prefix: str):
        super().__init__(comm)
        self.defaults, self.compare, self.prefix = defaults, compare, prefix

    def new_matrix(self, system: NewtonForm) -> None:
        self.system = system

    def solve(self, b: PETSc.Vec, x: PETSc.Vec, rtol: float) -> bool:
        A, P = self.system.matrix, self.system.entries
        if self.compare is not None and self.compare.due():
            done = self.compare.run(A, b, x, rtol, P)
        else:
            done = self._solver("").solve(A, b, x, rtol, P)
        self.iterations += done.iterations
        if done.converged:
            return True
        self.fallbacks += 1
        return self._climb_down(b, x, rtol, done)

    @property
    def factored(self) -> bool:
        return "" in self._krylov and self._krylov[""].ksp.pc.getType() in ("cholesky", "lu")

    def report(self) -> list[str]:
        return self._krylov[""].report() if "" in self._krylov else []

    def words(self) -> str:
        return self._solver("").words()

    def what(self) -> str:
        own = self._krylov[""].own if "" in self._krylov else None
        return f"{own.name} was {own.what()}" if own and own.what() else ""

    def _climb_down(self, b: PETSc.Vec, x: PETSc.Vec, rtol: float, done: Solve) -> bool:
        """Try the ladder; keep in x what has the smallest true residual, or zero if nothing is below 1."""
        A, P = self.system.matrix, self.system.entries
        best = min(done.true_residual, 1.0)
        kept = x.array.copy() if best < 1 else np.zeros(x.getLocalSize())
        for name in LADDER:
            if name == "cholesky" and self.system.problem.size > CHOLESKY_LIMIT:
                break
            done = self._solver(name).solve(A, b, x, rtol, P)
            self.iterations += done.iterations
            if done.true_residual < best:
                best, kept = done.true_residual, x.array.copy()
            if done.converged:
                break
        x.array[:] = kept
        return done.converged

    def _solver(self, name: str) -> Krylov:
        if name not in self._krylov:
            prefix = f"fallback_{name}_" if name else self.prefix
            self._krylov[name] = Krylov(self.comm, prefix, LADDER.get(name, self.defaults))
        return self._krylov[name]
