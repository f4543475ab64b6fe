"""A KSP with its preconditioner for one matrix after another of the same structure, timed and checked."""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from pctt.pc.base import PythonPC, factor_within_ranks, prefer_mumps

# right preconditioning makes the residual that the method sees the true one
_RIGHT_SIDED = {"bcgs", "gmres", "tfqmr", "cgs"}
# what wants scalar rows; others switch when PETSc says so
_SCALAR_FORMAT = {"gamg", "hypre", "cholesky", "lu", "eisenstat"}
_NOT_SUPPORTED = 56  # PETSC_ERR_SUP: this method has no code for block formats


@dataclass(frozen=True)
class Solve:
    """One linear solve: ``true_residual`` is ||b - S x|| / ||b||, computed afterwards (1 after a breakdown)."""

    converged: bool
    reason: str
    iterations: int
    setup_s: float
    solve_s: float
    true_residual: float


class Krylov:
    """KSP with options prefix ``prefix``; ``defaults`` are PETSc options that the user's own replace.

    Without options: BiCGStab, preconditioned from the right by the inverses of the diagonal blocks, to a
    relative residual of ``rtol`` in at most 1000 iterations (the paper's cap). On several ranks ILU and ICC
    work within each rank (block Jacobi).
    """

    def __init__(self, comm: MPI.Comm, prefix: str = "", defaults: dict[str, str] | None = None, rtol: float = 1e-3):
        self.comm, self.prefix = comm, prefix
        given, self._entered = _with_defaults(prefix, defaults or {})
        self.method = given["ksp_type"]
        self.name = factor_within_ranks(prefix, comm.size)
        # block Gauss-Seidel over several ranks crashes in PETSc 3.18
        self.scalar = given["pc_type"] in _SCALAR_FORMAT or (given["pc_type"] == "sor" and comm.size > 1)
        self._scalar_matrix: PETSc.Mat | None = None
        self._converted: tuple[int, int] | None = None
        self.ksp = PETSc.KSP().create(comm)
        self.ksp.setOptionsPrefix(prefix)
        self.ksp.setTolerances(rtol=rtol, atol=1e-300, max_it=1000)
        if self.method in _RIGHT_SIDED:
            self.ksp.setPCSide(PETSc.PC.Side.RIGHT)
        prefer_mumps(self.ksp.pc, given["pc_type"])
        self.ksp.setFromOptions()
        # PETSc lets preonly have no options, but its preconditioner may be an iteration that wants the tolerance
        self._rtol_is_given = PETSc.Options().hasName(prefix + "ksp_rtol")
        self.rtol = PETSc.Options().getReal(prefix + "ksp_rtol", rtol)
        self.ksp.setTolerances(rtol=self.rtol)

    def set_rtol(self, rtol: float) -> None:
        """Another relative tolerance, unless ``-ksp_rtol`` has fixed it."""
        if not self._rtol_is_given:
            self.rtol = rtol
            self.ksp.setTolerances(rtol=rtol)

    def solve(
        self,
        A: PETSc.Mat,
        b: PETSc.Vec,
        x: PETSc.Vec,
        rtol: float | None = None,
        P: PETSc.Mat | None = None,
        keep: bool = False,
    ) -> Solve:
        """x = A^-1 b from zero. A set-up or solve that breaks down is reported, never raised.

        P : the Mat from which the preconditioner is made; none: A
        keep : use the preconditioner of the last solve, whatever the matrix is now
        """
        if rtol is not None:
            self.set_rtol(float(rtol))
        try:
            return self._solve(A, P if P is not None else A, b, x, keep)
        except PETSc.Error as error:
            self.forget()
            if error.ierr == _NOT_SUPPORTED and not self.scalar:
                self.scalar = True
                return self.solve(A, b, x, rtol, P)
            x.zeroEntries()
            return Solve(False, f"PETSc error {error.ierr}", 0, 0.0, 0.0, 1.0)

    def _solve(self, A: PETSc.Mat, P: PETSc.Mat, b: PETSc.Vec, x: PETSc.Vec, keep: bool) -> Solve:
        start = _now(self.comm)
        self.ksp.pc.setReusePreconditioner(keep)
        if not keep:
            formed = self._in_format(P)
            self.ksp.setOperators(formed if A is P else A, formed)
        self.ksp.setUp()
        setup = _now(self.comm)
        x.zeroEntries()
        self.ksp.solve(b, x)
        reason, iterations = self.ksp.getConvergedReason(), self.ksp.getIterationNumber()
        end = _now(self.comm)
        if reason == PETSc.KSP.ConvergedReason.DIVERGED_PCSETUP_FAILED:
            self.ksp.reset()  # else MUMPS, once failed, fails for every later matrix
        true = _true_residual(A, b, x)
        # twice: BiCGStab's recursive residual may drift a little without harm
        converged = reason > 0 and true <= 2 * self.rtol
        words = _REASONS.get(reason, str(reason))
        return Solve(converged, words, iterations, setup - start, end - setup, true)

    def _in_format(self, P: PETSc.Mat) -> PETSc.Mat:
        if not self.scalar or P.getType() in ("seqaij", "mpiaij", "aij"):
            return P
        version = (P.handle, P.stateGet())
        if self._scalar_matrix is None:
            self._scalar_matrix = P.convert(PETSc.Mat.Type.AIJ, PETSc.Mat())
        elif version != self._converted:  # else the preconditioner would be made anew
            P.convert(PETSc.Mat.Type.AIJ, self._scalar_matrix)
        self._converted = version
        # a factorisation that takes the matrix for definite fails where rounding has made it just indefinite
        definite = self.ksp.pc.getType() not in ("cholesky", "lu")
        self._scalar_matrix.setOption(PETSc.Mat.Option.SPD if definite else PETSc.Mat.Option.SYMMETRIC, True)
        return self._scalar_matrix

    def report(self) -> list[str]:
        """What a preconditioner of the project tells of itself and its fallbacks, as in ``-ksp_view``."""
        pc = self.ksp.pc
        context = pc.getPythonContext() if pc.getType() == PETSc.PC.Type.PYTHON else None
        return context.report() if isinstance(context, PythonPC) else []

    def forget(self) -> None:
        """The next matrix has another structure; a python preconditioner keeps what may serve that one too."""
        self.ksp.reset()
        if self._scalar_matrix is not None:
            self._scalar_matrix.destroy()
            self._scalar_matrix = None

    def destroy(self) -> None:
        self.ksp.destroy()
        for name in self._entered:
            PETSc.Options().delValue(name)
        if self._scalar_matrix is not None:
            self._scalar_matrix.destroy()


class KrylovFamily:
    """Krylov methods by name, each made when it is first needed."""

    def __init__(self, comm: MPI.Comm):
        self.comm = comm
        self._krylov: dict[str, Krylov] = {}

    def forget(self) -> None:
        """The next matrix has another structure."""
        for krylov in self._krylov.values():
            krylov.forget()

    def destroy(self) -> None:
        for krylov in self._krylov.values():
            krylov.destroy()
        self._krylov.clear()


_REASONS = {
    value: name.lower() for name, value in vars(PETSc.KSP.ConvergedReason).items() if isinstance(value, int)
}


def _with_defaults(prefix: str, defaults: dict[str, str]) -> tuple[dict[str, str], list[str]]:
    """Enter defaults in the database where the user has said nothing; the type names in force, and what was entered.

    A prefixed KSP takes the ``-ksp_*`` options of the one without prefix, so that compared preconditioners
    work under the same method and tolerance.
    """
    database = PETSc.Options()
    everything = database.getAll()
    wanted = {"ksp_type": "bcgs", "pc_type": "pbjacobi"}
    if prefix:
        wanted |= {name: value for name, value in everything.items() if name.startswith("ksp_")}
    entered = {prefix + name: value for name, value in (wanted | defaults).items() if prefix + name not in everything}
    for name, value in entered.items():
        database[name] = value
    return {name: database.getString(prefix + name) for name in wanted}, list(entered)


def _true_residual(S: PETSc.Mat, b: PETSc.Vec, x: PETSc.Vec) -> float:
    """||b - S x|| / ||b||; an x that is no number is replaced by zero, and leaves 1."""
    residual = b.duplicate()
    S.mult(x, residual)
    residual.aypx(-1.0, b)
    norm, reference = residual.norm(), b.norm()
    residual.destroy()
    if not np.isfinite(norm):
        x.zeroEntries()
        return 1.0
    return norm / reference if reference > 0 else norm


def _now(comm: MPI.Comm) -> float:
    if comm.size > 1:
        comm.Barrier()  # a phase lasts until its slowest rank
    return time.perf_counter()
