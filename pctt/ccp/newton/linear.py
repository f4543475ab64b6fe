"""What solves the Newton systems: the asked-for KSP with a ladder behind it, or the rung of a ladder that costs
least."""

from __future__ import annotations

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from pctt.ccp.newton.compare import Comparison
from pctt.ccp.newton.krylov import Krylov, Solve

CHOLESKY_LIMIT = 50_000  # contacts: above, a factor of the contact matrix takes more than the rest of the step

# what solves a system of contacts when the asked-for KSP does not, in this order
LADDER = {
    "pbjacobi": {"pc_type": "pbjacobi"},
    "cholesky": {"pc_type": "cholesky", "ksp_type": "gmres"},
}


class AskedFor:
    """The KSP without prefix, as the options have it; what it does not solve goes down the ladder.

    Attributes
    ----------
    iterations : Krylov iterations so far
    fallbacks : systems that the asked-for KSP did not solve to twice the tolerance
    """

    def __init__(self, comm: MPI.Comm, defaults: dict[str, str], compare: Comparison | None = None, prefix: str = ""):
        self.comm, self.defaults, self.compare, self.prefix = comm, defaults, compare, prefix
        self._krylov: dict[str, Krylov] = {}
        self.iterations = self.fallbacks = 0

    def begin(self) -> None:
        """Another problem."""
        self.iterations = self.fallbacks = 0

    def new_matrix(self, system) -> None:
        """The system has new values."""
        self.system = system

    def solve(self, b: PETSc.Vec, x: PETSc.Vec, rtol: float) -> bool:
        """x = A^-1 b to a relative residual of rtol; whether that was reached."""
        A, P = self.system.matrix, self.system.preconditioned
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
        """Whether the preconditioner is a factorisation of the present matrix."""
        return "" in self._krylov and self._krylov[""].ksp.pc.getType() in ("cholesky", "lu")

    def report(self) -> list[str]:
        """What the asked-for preconditioner tells of itself, if it is one of the project's."""
        return self._krylov[""].report() if "" in self._krylov else []

    def _climb_down(self, b: PETSc.Vec, x: PETSc.Vec, rtol: float, done: Solve) -> bool:
        """Try the ladder; keep in x what has the smallest true residual, or zero if nothing is below 1."""
        A, P = self.system.matrix, self.system.preconditioned
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

    def forget(self) -> None:
        """The next matrix has another structure."""
        for krylov in self._krylov.values():
            krylov.forget()

    def destroy(self) -> None:
        for krylov in self._krylov.values():
            krylov.destroy()
        self._krylov.clear()


# -- the body system's own ladder ------------------------------------------------------------------------------

RUNGS = {
    "pbjacobi": {"pc_type": "pbjacobi"},
    "ilu": {"pc_type": "ilu", "pc_factor_levels": "1", "pc_factor_mat_ordering_type": "rcm"},
    "cholesky": {"pc_type": "cholesky"},
}
CAP = {"pbjacobi": "1500", "ilu": "1000", "cholesky": "60"}

# Costs in products with K, measured at 700, 4,900 and 35,900 bodies (docs/ccp.md)
ITERATION = {"pbjacobi": 1.3, "ilu": 2.8, "cholesky": 20.0}
FEWER = {"pbjacobi": 1.0, "ilu": 4.8, "cholesky": np.inf}  # block Jacobi's iterations / this one's
SOLVES = 1.8  # iterations of predictor and correctors / those of the predictor
OLD_FACTOR = 60.0  # iterations to expect with the factor of an earlier matrix


def _setup_cost(rung: str, bodies: int) -> float:
    return {"pbjacobi": 3.0, "ilu": 45.0, "cholesky": 650.0 * (bodies / 5000.0) ** 0.4}[rung]


class Cheapest:
    """Conjugate gradients on the body system, preconditioned by what is expected to cost least: block Jacobi while it
    takes few iterations, then block ILU(1), then Cholesky factors, of its stiff part; a factor of an earlier
    matrix is kept as long as iterating with it costs less than a new one.

    The choice rests on iteration counts and fixed costs, so that a repeated run repeats it.
    """

    def __init__(self, comm: MPI.Comm):
        self.comm = comm
        self._krylov: dict[str, Krylov] = {}
        self._hardness = 20.0  # expected iterations with block Jacobi
        self._growth = 1.0
        self._lagged: float | None = None  # expected iterations with the factor that is there
        self._approximation: PETSc.Mat | None = None
        self.iterations = self.fallbacks = 0
        self.used: dict[str, int] = {}

    def new_matrix(self, system) -> None:
        self.system = system
        bodies = system.matrix.getSize()[0] // 6
        expected = self._hardness * self._growth
        costs = {
            rung: _setup_cost(rung, bodies) + SOLVES * ITERATION[rung] * max(1.0, expected / FEWER[rung])
            for rung in RUNGS
        }
        rung = min(costs, key=lambda name: costs[name])
        self._keep = False
        if self._lagged is not None:
            lagged = SOLVES * ITERATION["cholesky"] * self._lagged
            if lagged < min(costs.values()):
                rung, self._keep = "cholesky", True
        self._rung = rung
        self._worst = 0
        self._fresh = True

    def solve(self, b: PETSc.Vec, x: PETSc.Vec, rtol: float) -> bool:
        rungs = list(RUNGS)
        while True:
            done = self._try(self._rung, b, x, rtol)
            if done.converged:
                return True
            if self._rung == "cholesky" and not self._keep:
                self.fallbacks += 1
                return False
            if self._rung != "cholesky":
                self._rung = rungs[rungs.index(self._rung) + 1]
            self._keep, self._fresh = False, True

    def _try(self, rung: str, b: PETSc.Vec, x: PETSc.Vec, rtol: float) -> Solve:
        krylov = self._solver(rung)
        if self._fresh and not self._keep:
            self._approximation = self._approximate(rung)
        P = self._approximation
        done = krylov.solve(self.system.matrix, b, x, rtol, P, keep=self._keep)
        self._fresh = False
        self.iterations += done.iterations
        self.used[rung] = self.used.get(rung, 0) + done.iterations
        if done.iterations > self._worst:
            self._worst = done.iterations
            self._learn(rung, done.iterations)
        return done

    def _approximate(self, rung: str) -> PETSc.Mat:
        """The matrix that a rung's preconditioner is made from."""
        return self.system.matrix if rung == "pbjacobi" else self.system.stiff_part(complete=rung == "cholesky")

    def _learn(self, rung: str, iterations: int) -> None:
        if rung == "cholesky":
            self._lagged = 1.5 * iterations if self._keep else OLD_FACTOR
            return
        hardness = max(10.0, iterations * FEWER[rung])
        self._growth = min(max(hardness / self._hardness, 1.0), 2.0)
        self._hardness = hardness

    @property
    def factored(self) -> bool:
        """Whether the present matrix has factors of its own."""
        return self._rung == "cholesky" and not self._keep

    def report(self) -> list[str]:
        """Nothing: its rungs are PETSc's own."""
        return []

    def begin(self) -> None:
        """Another problem: its first systems are easy ones."""
        self.iterations = self.fallbacks = 0
        self._hardness, self._growth, self._lagged = 20.0, 1.0, None

    def _solver(self, rung: str) -> Krylov:
        if rung not in self._krylov:
            defaults = {"ksp_type": "cg", "ksp_norm_type": "unpreconditioned", "ksp_max_it": CAP[rung], **RUNGS[rung]}
            if rung == "cholesky" and self.comm.size == 1 and PETSc.Sys.hasExternalPackage("suitesparse"):
                defaults["pc_factor_mat_solver_type"] = "cholmod"  # 1.3 times faster than MUMPS, its solves twice
            self._krylov[rung] = Krylov(self.comm, f"body_{rung}_", defaults)
        return self._krylov[rung]

    def forget(self) -> None:
        for krylov in self._krylov.values():
            krylov.forget()

    def destroy(self) -> None:
        for krylov in self._krylov.values():
            krylov.destroy()
        self._krylov.clear()
