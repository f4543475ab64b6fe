"""A KSP with its preconditioner for one matrix after another of the same structure, timed and checked."""

from __future__ import annotations

import re
import sys
import time
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import Any, Protocol, Union, runtime_checkable

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from pctt.blocks import block_diagonal, fresh_copy, shell_of
from pctt.ksp_options import OWN, entered, mark_used, to_enter, unmarked
from pctt.petsc import options_database, own_errors, set_skip_pc

# the Mat from which a preconditioner is made, or a function that makes it, for those that read entries
Pmat = Union[PETSc.Mat, Callable[[], PETSc.Mat], None]
# right preconditioning makes the residual that the method sees the true one
_RIGHT_SIDED = {"bcgs", "gmres", "tfqmr", "cgs"}
_BY_PRODUCTS = {"none", "jacobi", "pbjacobi"}  # these need no entries beside the diagonal blocks
_IN_BLOCKS = {*_BY_PRODUCTS, "ilu", "icc", "python"}  # others get scalar rows, as PETSc has no block code for all
_FACTORS = {"cholesky", "lu"}
#: Seconds until a rank ends the run whose KSP has failed alone: the others are in calls that wait for it for ever.
PATIENCE = 60.0
WITHIN = "within each rank"
_WITHIN_RANKS = {"bjacobi", "sor", "eisenstat"}  # of several ranks each works on its own rows
_NAMES = {"bcgs": "BiCGStab", "cg": "CG", "gmres": "GMRES", "fgmres": "FGMRES", "minres": "MINRES"}
# preconditioners of parts of the matrix; ours have inner ones too, but of other matrices
_OF_PARTS = re.compile(r"(sub|mg|fieldsplit|composite|telescope)_.*pc_type")
_VIEWER = re.compile(r"ksp_view.*|ksp_converged_.*")
_REMEMBERING = {"pbjacobi", "sor"}  # the inverse diagonal blocks of the first matrix, see `pctt.blocks`
_REASONS = {
    value: name.lower() for name, value in vars(PETSc.KSP.ConvergedReason).items() if isinstance(value, int)
}


@runtime_checkable
class Reporting(Protocol):
    """A python preconditioner that tells of itself, as those of the project do: its name for ``-pc_python_type``, lines
    for ``-ksp_view``, and in a few words what it really was over its solves."""

    name: str

    def report(self) -> list[str]: ...

    def what(self) -> str: ...


@dataclass(frozen=True)
class Solve:
    """One linear solve: ``true_residual`` is ||b - S x|| / ||b||, computed afterwards (1 after a breakdown), ``asked``
    the tolerance."""

    converged: bool
    reason: str
    iterations: int
    setup_s: float
    solve_s: float
    true_residual: float
    asked: float


class Krylov:
    """A Krylov method is a KSP with the options prefix ``prefix``; the user's options replace the ``defaults``.

    Without options: BiCGStab, preconditioned from the right by the inverses of the diagonal blocks, to a
    relative residual of ``rtol`` in at most 1000 iterations (the paper's cap). On several ranks ILU and ICC
    work within each rank (block Jacobi). A KSP with another prefix takes the ``ksp_`` options of the one with the
    prefix ``ccp_``, so that compared preconditioners work under the same method and tolerance. Options count as used
    once a system is solved with them.
    """

    def __init__(
        self, comm: MPI.Comm, prefix: str = OWN, defaults: dict[str, str] | None = None, rtol: float = 1e-3,
        timed: bool = False,
    ):  # fmt: skip
        """``timed``: ranks wait for each other, so that the seconds of a `Solve` are those of all."""
        self.comm, self.prefix, self.timed = comm, prefix, timed
        similar = {"pc_tt_reuse": "trains"}  # the matrices are alike
        self._options, self._sources = to_enter(prefix, similar | (defaults or {}), comm.size)
        self.ksp = PETSc.KSP().create(comm)
        self.ksp.setOptionsPrefix(prefix)
        self.ksp.setTolerances(rtol=rtol, atol=1e-300, max_it=1000)
        with unmarked() as self._read, self._entered(), own_errors():
            self._configure(PETSc.Options(prefix), rtol)
        self._formed: PETSc.Mat | None = None  # what the preconditioner is made from, if not P itself
        self._version: tuple[int, int] | None = None  # of P, when it was
        self._has_viewers = True

    def _entered(self) -> AbstractContextManager[None]:
        return entered(self._options, self._sources)

    def _configure(self, options: PETSc.Options, rtol: float) -> None:
        self.ksp.setType("bcgs")
        self.ksp.pc.setType("pbjacobi")
        self.method, self.kind = options.getString("ksp_type", "bcgs"), options.getString("pc_type", "pbjacobi")
        self._pc_name = options.getString("sub_pc_type", "ilu") if self.kind == "bjacobi" else self.kind
        within = {value for name, value in options_database(self.prefix).items() if _OF_PARTS.fullmatch(name)}
        self._remembers = bool(_REMEMBERING & within)
        shifted = any(name.endswith("pc_factor_shift_type") for name in options_database(self.prefix))
        # block Gauss-Seidel over several ranks crashes in PETSc 3.18
        in_blocks = self._pc_name in _IN_BLOCKS or (self.kind == "sor" and self.comm.size == 1)
        self._scalar = not in_blocks or shifted or self._remembers
        if self.method in _RIGHT_SIDED:
            self.ksp.setPCSide(PETSc.PC.Side.RIGHT)
        self.ksp.setFromOptions()
        # PETSc lets preonly have no options, but its preconditioner may be an iteration that wants the tolerance
        self._rtol_is_given = options.hasName("ksp_rtol")
        self.rtol = options.getReal("ksp_rtol", rtol)
        self.ksp.setTolerances(rtol=self.rtol)

    def solve(
        self,
        A: PETSc.Mat,
        b: PETSc.Vec,
        x: PETSc.Vec,
        rtol: float | None = None,
        P: Pmat = None,
        keep: bool = False,
    ) -> Solve:
        """x = A^-1 b from zero. If a set-up or a solve breaks down on any rank, the result says so; nothing is raised.

        rtol : another relative tolerance, unless ``-ksp_rtol`` has fixed it
        P : the Mat from which the preconditioner is made, or a function that makes it where A is one and the
            preconditioner reads entries; none: A
        keep : use the preconditioner of the last solve, whatever the matrix is now
        """
        if rtol is not None and not self._rtol_is_given:
            self.rtol = float(rtol)
            self.ksp.setTolerances(rtol=self.rtol)
        start = self._now()
        mark_used(self._read)
        with self._entered():
            with OnAllRanks(self.comm) as done:
                self._set_up(A, P, keep)
            setup = self._now()
            if not done.error:
                x.zeroEntries()
                right_hand_side = b.copy()  # an error of PETSc may leave it locked
                with OnAllRanks(self.comm, PATIENCE) as done:
                    self.ksp.solve(right_hand_side, x)
                right_hand_side.destroy()
        if done.error:
            self.forget()
            x.zeroEntries()
            return Solve(False, f"PETSc error {done.error}", 0, 0.0, 0.0, 1.0, self.rtol)
        reason, iterations = self.ksp.getConvergedReason(), self.ksp.getIterationNumber()
        end = self._now()
        if reason == PETSc.KSP.ConvergedReason.DIVERGED_PCSETUP_FAILED:
            self._reset()  # else MUMPS, once failed, fails for every later matrix
        residual = b.duplicate()
        A.mult(x, residual)
        true = part_left(residual, b, x)
        # twice: BiCGStab's recursive residual may drift a little without harm
        converged = reason > 0 and true <= 2 * self.rtol
        words = _REASONS.get(reason, str(reason))
        return Solve(converged, words, iterations, setup - start, end - setup, true, self.rtol)

    def _reset(self) -> None:
        """KSPReset, which drops the viewers of ``-ksp_view`` and the like too."""
        self.ksp.reset()
        self._has_viewers = False

    def _read_viewers(self) -> None:
        """Read the options of viewers alone once more: a second monitor would write beside the first, and a python
        preconditioner would be made anew. Files are continued."""
        self._has_viewers = True
        start = self.prefix + "ksp_"
        own = {name: value for name, value in options_database().items() if name.startswith(start)}
        viewers = {name: value for name, value in own.items() if _VIEWER.fullmatch(name[len(self.prefix) :])}
        if viewers:
            continued = {name: _continued(value) for name, value in viewers.items()}
            with entered(continued, hidden=own), set_skip_pc(self.ksp):
                self.ksp.setFromOptions()

    def _set_up(self, A: PETSc.Mat, P: Pmat, keep: bool) -> None:
        if not self._has_viewers:
            self._read_viewers()
        self.ksp.pc.setReusePreconditioner(keep)
        if not keep:
            if P is None or (shell_of(A) and not self.needs_entries):
                P = A
            form = self._form(P if isinstance(P, PETSc.Mat) else P())
            self.ksp.setOperators(form if self.kind == "eisenstat" else A, form)
        self.ksp.setUp()
        self.ksp.setUpOnBlocks()

    @property
    def needs_entries(self) -> bool:
        """Whether the preconditioner reads entries beside the diagonal blocks."""
        return self.kind not in _BY_PRODUCTS

    def _form(self, P: PETSc.Mat) -> PETSc.Mat:
        """P in the form that the preconditioner wants."""
        version = (P.handle, P.stateGet())
        if version != self._version:  # else the preconditioner would be made anew
            self._version = version
            self._formed = self._formed_anew(P, self._formed)
        return self._formed if self._formed is not None else P

    def _formed_anew(self, P: PETSc.Mat, old: PETSc.Mat | None) -> PETSc.Mat | None:
        to_scalar = self._remembers or (self._scalar and P.getType() not in ("seqaij", "mpiaij"))
        if to_scalar and old is not None and self.kind in _FACTORS:
            return P.convert(PETSc.Mat.Type.AIJ, old)  # in place: a factorisation knows its structure
        if self._remembers:  # parts of the matrix
            self._reset()
            self._read_viewers()
        if old is not None:
            old.destroy()
        if to_scalar:
            rows = P.convert(PETSc.Mat.Type.AIJ, PETSc.Mat())
            # a factorisation that takes the matrix for definite fails where rounding has made it just indefinite
            definite = self.kind not in _FACTORS
            rows.setOption(PETSc.Mat.Option.SPD if definite else PETSc.Mat.Option.SYMMETRIC, True)
            return rows
        if self.kind == "sor" and P.getType() == "seqbaij":
            return fresh_copy(P)
        return block_diagonal(P) if self.kind == "pbjacobi" else None

    @property
    def own(self) -> Reporting | None:
        """The preconditioner, if it is one that tells of itself."""
        return self._context if isinstance(self._context, Reporting) else None

    @property
    def _context(self) -> Any:
        """The object of Python that is the preconditioner, or None."""
        pc = self.ksp.pc
        return pc.getPythonContext() if pc.getType() == PETSc.PC.Type.PYTHON else None

    def report(self) -> list[str]:
        """What a preconditioner that is `Reporting` says of itself and its fallbacks, as in ``-ksp_view``."""
        return self.own.report() if self.own else []

    def what(self) -> str:
        """What the preconditioner really was, where its name does not say it."""
        if self.own:
            return self.own.what()
        return WITHIN if self.comm.size > 1 and self.kind in _WITHIN_RANKS else ""

    def words(self) -> str:
        """Krylov method and preconditioner."""
        own, right, name = self.own, self.ksp.getPCSide() == PETSc.PC.Side.RIGHT, self._pc_name
        if (context := self._context) is not None:  # the class as -pc_python_type has it
            name = own.name if own else f"{type(context).__module__}.{type(context).__qualname__}"
        remark = f" {WITHIN}" if not own and self.what() else ""
        method = _NAMES.get(self.method, self.method) + " (right)" * right
        return f"{method}, {name}{remark}"

    def _now(self) -> float:
        if self.timed and self.comm.size > 1:
            self.comm.Barrier()  # a phase lasts until its slowest rank
        return time.perf_counter()

    def forget(self) -> None:
        """Prepare for a matrix of another structure. A python preconditioner keeps the data that may serve it too."""
        self._reset()
        self._version = None
        if self._formed is not None:
            self._formed.destroy()
            self._formed = None

    def destroy(self) -> None:
        self.forget()
        self.ksp.destroy()


def _continued(viewer: str | None) -> str | None:
    """The same viewer TYPE:FILE:FORMAT:MODE, which appends to its file."""
    parts = (viewer or "").split(":")
    return ":".join([*parts, ""][:3] + ["append"]) if len(parts) in (2, 3) and parts[1] else viewer


def part_left(product: PETSc.Vec, b: PETSc.Vec, x: PETSc.Vec) -> float:
    """||b - S x|| / ||b|| of the product S x, which is destroyed; an x that is no number becomes zero, and leaves 1."""
    residual = product
    residual.aypx(-1.0, b)
    norm, reference = residual.norm(), b.norm()
    residual.destroy()
    if not np.isfinite(norm):
        x.zeroEntries()
        return 1.0
    return norm / reference if reference > 0 else norm


class OnAllRanks:
    """A block that ends alike on all ranks: ``error`` is then 0, or PETSc's error code if it failed on one or more.

    A rank that fails alone waits for the others, which may still factorise blocks of their own. It cannot call them
    back from a collective call of PETSc. Where the block is nothing but such calls, it ends the run after ``patience``
    seconds, with a message."""

    def __init__(self, comm: MPI.Comm, patience: float = np.inf):
        self.comm, self.patience, self.error = comm, patience, 0

    def __enter__(self) -> OnAllRanks:
        self._errors = own_errors()
        self._errors.__enter__()
        return self

    def __exit__(self, *raised: Any) -> bool:
        error, words = raised[1], ""
        try:
            self._errors.__exit__(*raised)
        except PETSc.Error as other:
            error = other
        if isinstance(error, PETSc.Error):
            self.error, words = abs(error.ierr) or 1, str(error)
        elif error is not None:
            return False
        if self.comm.size > 1:
            self._meet(words)
        return True

    def _meet(self, words: str) -> None:
        worst = np.empty(1, int)
        meeting = self.comm.Iallreduce(np.array([self.error]), worst, op=MPI.MAX)
        deadline = time.monotonic() + self.patience
        while self.error and not meeting.Test():
            if time.monotonic() > deadline:
                sys.stderr.write(f"pctt: rank {self.comm.rank} failed alone: {words}\n")
                sys.stderr.flush()
                self.comm.Abort(1)
            time.sleep(0.01)
        meeting.Wait()
        self.error = int(worst[0])
