"""The ladder of the body system: it solves each system in the way with the least expected cost."""

from __future__ import annotations

from dataclasses import dataclass

from mpi4py import MPI
from petsc4py import PETSc

from pctt import memory
from pctt.ccp.newton.body import BodyForm
from pctt.ccp.newton.form import NewtonForm
from pctt.ccp.newton.krylov import Krylov, LinearSolver, Solve

RUNGS = {"pbjacobi": {"pc_type": "pbjacobi"}, "cholesky": {"pc_type": "cholesky"}}
UNSYMMETRIC = {  # systems of Coulomb's law
    "pbjacobi": {"ksp_type": "bcgs"},
    "cholesky": {"ksp_type": "gmres", "ksp_gmres_restart": "100", "pc_type": "lu"},
}


@dataclass(frozen=True)
class Steering:
    """Numbers that steer the choice. Costs are in iterations with block Jacobi, measured at 5, 4,900 and 35,900 bodies
    (docs/ccp.md); those with a factor are for 5,000 bodies and one rank."""

    jacobi: float = 5.0  #: set-up of block Jacobi
    factor: float = 550.0  #: a Cholesky factor
    factor_growth: float = 0.4  #: power of the number of bodies with which that cost grows
    apply: float = 25.0  #: an iteration with a factor
    apply_growth: float = 0.3  #: power of the number of bodies with which that cost grows
    solves: float = 1.8  #: iterations of predictor and correctors over those of the predictor
    hardness: float = 20.0  #: expected with block Jacobi in a problem's first systems, which are easy [iterations]
    easiest: float = 10.0  #: expected at least, so that one easy system does not set the growth [iterations]
    growth: float = 2.0  #: greatest expected growth of iterations from one system to the next
    old_factor: float = 60.0  #: expected with the factor of the last matrix [iterations]
    ageing: float = 1.5  #: factor on that with each further matrix
    jacobi_max_it: int = 1500  #: limit of block Jacobi
    alone_max_it: int = 20_000  #: the same where there is no room for factors
    factor_max_it: int = 60  #: limit of a factor: beyond, a new one takes less time
    #: memory of a factor of 35,900 bodies [bytes], a fifth more than measured; it grows as nested dissection in space
    factor_bytes: float = 2.2e9
    spare: float = 0.9  #: part of the available memory that a factor may take


STEERING = Steering()


def cost(rung: str, iterations: float, bodies: int, ranks: int) -> float:
    """Cost of all systems with one matrix, if the predictor's takes so many iterations. On more ranks products take
    less time, but factors hardly do."""
    factor = STEERING.factor * (bodies / 5000.0) ** STEERING.factor_growth * ranks
    return {"pbjacobi": STEERING.jacobi, "cholesky": factor}[rung] + solves_cost(rung, iterations, bodies, ranks)


def solves_cost(rung: str, iterations: float, bodies: int, ranks: int) -> float:
    """The same when the preconditioner is there already."""
    apply = STEERING.apply * (bodies / 5000.0) ** STEERING.apply_growth * ranks
    return STEERING.solves * {"pbjacobi": 1.0, "cholesky": apply}[rung] * max(1.0, iterations)


def fits(bodies: int, comm: MPI.Comm) -> bool:
    """Whether the memory has room for a factor; collective."""
    needed = STEERING.factor_bytes * (bodies / 35900.0) ** (4.0 / 3.0) / comm.size
    return needed < STEERING.spare * memory.available(comm)


class BodyLadder(LinearSolver):
    """Conjugate gradients on the body system, with the preconditioner of the least expected cost: block Jacobi while it
    takes few iterations, then Cholesky factors of the stiff part. A factor of an earlier matrix is kept as long as
    iterating with it costs less than a new factor. (Incomplete factors never pay: an iteration costs six times as
    much.) Where the memory has no room for factors, block Jacobi goes on alone.

    The choice rests on iteration counts, fixed costs and that room, so that a repeated run repeats it.
    """

    takes_any = True

    def __init__(self, comm: MPI.Comm):
        super().__init__(comm)
        self._asked, self._room = 0, True  # bodies for which room was asked for, and whether there was
        self._approximation: PETSc.Mat | None = None
        self.used: dict[str, int] = {}

    def begin(self) -> None:
        super().begin()
        self._hardness, self._growth = STEERING.hardness, 1.0  # expected iterations with block Jacobi
        self._lagged: float | None = None  # expected iterations with the factor that is there

    def new_matrix(self, system: NewtonForm) -> None:
        assert isinstance(system, BodyForm)
        self.system = system
        bodies, ranks = system.matrix.getSize()[0] // 6, self.comm.size
        if bodies > self._asked:  # while no factor of this size is there, which would count as taken
            self._asked, self._room = bodies, fits(bodies, self.comm)
        expected = self._hardness * self._growth
        costs = {"pbjacobi": cost("pbjacobi", expected, bodies, ranks), "cholesky": cost("cholesky", 1, bodies, ranks)}
        rung, keep = min(costs, key=lambda name: costs[name]) if self._room else "pbjacobi", False
        if self._lagged is not None and solves_cost("cholesky", self._lagged, bodies, ranks) < min(costs.values()):
            rung, keep = "cholesky", True
        self._rung, self._keep = self.comm.bcast((rung, keep))  # costs may differ in a last bit between processors
        self._worst = 0
        self._fresh = True

    def solve(self, b: PETSc.Vec, x: PETSc.Vec, rtol: float) -> bool:
        while True:
            done = self._try(self._rung, b, x, rtol)
            if done.converged:
                return True
            if not self._room or (self._rung == "cholesky" and not self._keep):
                self.fallbacks += 1
                return False
            self._rung, self._keep, self._fresh = "cholesky", False, True

    def _try(self, rung: str, b: PETSc.Vec, x: PETSc.Vec, rtol: float) -> Solve:
        krylov = self._solver(rung)
        if self._fresh and not self._keep:
            self._approximation = self.system.matrix if rung == "pbjacobi" else self.system.stiff_part()
        P = self._approximation
        done = krylov.solve(self.system.matrix, b, x, rtol, P, keep=self._keep)
        self._fresh = False
        self.iterations += done.iterations
        self.used[rung] = self.used.get(rung, 0) + done.iterations
        if done.iterations > self._worst:
            self._worst = done.iterations
            self._learn(rung, done.iterations)
        return done

    def _learn(self, rung: str, iterations: int) -> None:
        if rung == "cholesky":
            self._lagged = STEERING.ageing * iterations if self._keep else STEERING.old_factor
            return
        hardness = max(STEERING.easiest, float(iterations))
        self._growth = min(max(hardness / self._hardness, 1.0), STEERING.growth)
        self._hardness = hardness

    def words(self) -> str:
        return "CG, pbjacobi or cholesky by expected cost"

    @property
    def factored(self) -> bool:
        return self._rung == "cholesky" and not self._keep

    def _solver(self, rung: str) -> Krylov:
        unsymmetric = not self.system.symmetric
        name = rung + "_any" * unsymmetric + "_alone" * (not self._room)
        if name not in self._krylov:
            defaults = {"ksp_type": "cg", "ksp_norm_type": "unpreconditioned", **RUNGS[rung]}
            jacobi_max_it = STEERING.jacobi_max_it if self._room else STEERING.alone_max_it
            defaults["ksp_max_it"] = str(STEERING.factor_max_it if rung == "cholesky" else jacobi_max_it)
            defaults |= UNSYMMETRIC[rung] if unsymmetric else {}
            cholmod = self.comm.size == 1 and PETSc.Sys.hasExternalPackage("suitesparse")
            if rung == "cholesky" and cholmod and not unsymmetric:
                # 1.3 times faster than MUMPS, its solves twice; for unsymmetric matrices UMFPACK takes twice as long
                defaults["pc_factor_mat_solver_type"] = "cholmod"
            self._krylov[name] = Krylov(self.comm, f"body_{name}_", defaults)
        return self._krylov[name]
