"""``-pc_type python -pc_python_type pctt.pc.TensorTrain``: a tensor train as approximate inverse.

The blocks of a sparse matrix are ordered, scaled, compressed and inverted as in ``sparse_train.py``. A matrix that is
given by its entries (the attribute ``entries``, or a dense Mat) is compressed by cross approximation and inverted
(``entries_train.py``). At rank 1 there is no train, only the scaled diagonal, which is block Jacobi. `-pc_tt_rank auto`
chooses it for sparse matrices, as no train has paid for one solution (docs/preconditioners.md).
"""

from __future__ import annotations

import time

import numpy as np
from petsc4py import PETSc

from pctt.blocks import block_diagonal, diagonal_matrix
from pctt.mat.entries import diagonal_blocks, has_entries
from pctt.mat.order import places_of
from pctt.pc.entries_train import EntriesTrain
from pctt.pc.mat import Preconditioner, has_negative_diagonal, negated, replaced_blocks, without_singular
from pctt.pc.options import Account, Options
from pctt.pc.sparse_train import SparseTrain
from pctt.pc.watch import Watch
from pctt.petsc import set_failed

NOT_SYMMETRIC = "the matrix is not symmetric, so a train for its inverse may be useless"
NOWHERE = (
    "nothing is known of the places of its rows (no grid, coordinates, DM or near null space), so they are in reverse "
    "Cuthill-McKee order"
)
#: The orders of rows but for that of a grid, which is named by where it is known from.
ORDERS = {"morton": "a space-filling curve", "rcm": "reverse Cuthill-McKee", "natural": "their numbers"}
FASTER = "for sparse matrices try pctt.pc.BlockICC"
#: Krylov methods that are as accurate if the preconditioner rounds to single precision: they multiply by A each vector
#: that they add to x. Others take a product M A p for the preconditioner of a vector that they never formed.
UNHARMED = {"cg", "cgne", "fcg", "fgmres", "fbcgs", "fbcgsr", "gcr", "pipefcg", "pipefgmres"}
#: Methods that compute the residual of x anew. If they are part of another preconditioner, that must be linear.
REFINING = {"richardson", "chebyshev"}
#: Methods for matrices of any sign, whose preconditioner must be positive: of a negative matrix they get minus its own.
ABSOLUTE = {"minres", "symmlq"}
#: Reasons for the end of a Krylov method whose preconditioner is not positive definite.
SPOILT = {
    getattr(PETSc.KSP.ConvergedReason, f"DIVERGED_{name}")
    for name in ("BREAKDOWN", "BREAKDOWN_BICG", "INDEFINITE_MAT", "INDEFINITE_PC", "NANORINF", "DTOL")
}


class TensorTrain(Preconditioner):
    """The python PC; see the module and ``Options``. It works on symmetric positive definite Mats of any block size."""

    name = "pctt.pc.TensorTrain"  #: for ``-pc_python_type``
    options_class = Options
    options_prefix = "pc_tt_"
    made: SparseTrain | EntriesTrain  #: the maker of trains
    sparse_train: type[SparseTrain] = SparseTrain

    def create(self, pc: PETSc.PC) -> None:
        super().create(pc)
        self.account = Account()
        self.P: PETSc.Mat | None = None  # the matrix, or a copy of it in AIJ; None if it has no rows
        self.rank = 1
        self.sign = 1.0  # -1: the train is that of minus the matrix
        self._turned = False  # whether the solve that is going on gets minus the preconditioner
        self.failed = False  # whether there is no preconditioner, by -pc_tt_fallback none
        self._structure: tuple | None = None
        self._copy: list[PETSc.Mat] = []  # P, if it is a copy
        self._own: list[PETSc.Object] = []  # block Jacobi and its matrix
        self._refused = False  # whether the last set-up failed
        self._last_precision: type = np.float64  # of the last solve
        self._watch: Watch | None = None  # of the solve that is going on
        self._trials = 0.0  # products that the trials of the last set-up have cost, until a solve has counted them

    def destroy(self, pc: PETSc.PC) -> None:
        self.P = None
        _destroy(self._own)
        _destroy(self._copy)
        super().destroy(pc)

    def reset(self, pc: PETSc.PC) -> None:
        """Forget the matrix; keep everything that the next matrix can use."""
        self._structure = self.P = None

    def forget(self) -> None:
        self._structure = None

    # -- set-up ---------------------------------------------------------------------------------------------

    def setFromOptions(self, pc: PETSc.PC) -> None:
        before = self.options
        super().setFromOptions(pc)
        if self.options != before:
            self.forget()

    def setUp(self, pc: PETSc.PC) -> None:
        """ValueError on all ranks if the matrix is not square or has no entries, or if places do not fit it."""
        P = self.square(pc)
        structure: tuple = (P.handle, P.getSize()[0])
        if P.getSize()[0] == 0:
            self.P, self._structure = None, structure
            return
        if not has_entries(P):
            P = self._in_aij(P)
            structure += (P.getInfo()["nz_used"],)
        self.P = P
        if structure != self._structure:
            self._begin(pc, P)
            self._structure = structure
        self.update(pc, P)

    def _in_aij(self, P: PETSc.Mat) -> PETSc.Mat:
        """P, or a copy of P in AIJ if P has another type than AIJ and BAIJ."""
        kind = P.getType().removeprefix("seq").removeprefix("mpi")
        if kind.startswith(("aij", "baij")):
            return P
        if kind.startswith(("sbaij", "dense")):
            sparse = P.convert(PETSc.Mat.Type.AIJ, PETSc.Mat())
            if sparse.getBlockSize() != P.getBlockSize():
                sparse.setBlockSize(P.getBlockSize())
            for attribute in ("coordinates", "grid", "key"):
                sparse.setAttr(attribute, P.getAttr(attribute))
        else:
            sparse = self._diagonal_of(P)
        _destroy(self._copy)
        self._copy = [sparse]
        return sparse

    def _diagonal_of(self, P: PETSc.Mat) -> PETSc.Mat:
        """The diagonal of a Mat without entries to read; ValueError on all ranks if it has none."""
        what = f"a Mat of type {P.getType()} has no entries to read"
        try:
            diagonal = P.getDiagonal()
        except PETSc.Error:
            allowed = "aij, baij, sbaij, dense, any Mat with the attribute entries, or at least MatGetDiagonal"
            raise ValueError(f"{self.name}: {what}; allowed are {allowed}") from None
        self.warn(P.comm.tompi4py(), f"{what}: its diagonal is used")
        return diagonal_matrix(diagonal)

    def _begin(self, pc: PETSc.PC, P: PETSc.Mat) -> None:
        """Take what depends on the structure of P only."""
        self.comm = P.comm.tompi4py()
        self.places = places_of(P, (pc.getDM(), pc.getOperators()[0].getDM()), self._points)
        if has_entries(P):
            self.made = EntriesTrain(self.comm, self.options, self.account, self.prefix, self.places)
            return
        made = getattr(self, "made", None)
        if not isinstance(made, SparseTrain) or made.options != self.options:
            made = self.sparse_train(self.comm, self.options, self.account, self.prefix)
        self.made = made
        made.begin(P, self.places)

    def update(self, pc: PETSc.PC, P: PETSc.Mat) -> None:
        """Make a train or what the rule prefers to it; if this fails, fall back."""
        start, made, A = time.perf_counter(), self.made, pc.getOperators()[0]
        self.sign = -1.0 if made.rank > 1 and has_negative_diagonal(P) else 1.0
        operators = [A, P] if self.sign > 0 else [negated(A), negated(P)]
        self.rank = made.rank if made.make(*operators) else 1
        if self.sign < 0:
            _destroy(operators)
        if not made.symmetric:
            self.warn(self.comm, NOT_SYMMETRIC)
        for name, why in made.idle.items():
            if (option := f"{self.prefix}{self.options_prefix}{name}") in self._given:
                self.warn(self.comm, f"-{option} has no effect: {why}")
        self.failed = bool(made.failure) and self.options.fallback == "none"
        if made.failure and not self._refused:
            takes_over = "there is no preconditioner" if self.failed else f"{made.base} takes over"
            sparse = isinstance(made, SparseTrain)
            lost = sparse and self.places.source == "nothing" and self.options.order == "auto"
            reasons = [f"{made.failure}: {takes_over}", *[NOWHERE] * lost, *[FASTER] * sparse]
            self.warn(self.comm, "; ".join(reasons))
        self._refused = bool(made.failure)
        self._trials = made.cost_estimate.spent if made.cost_estimate is not None else 0.0
        if self.rank == 1 and not self.failed:
            self._make_block_jacobi(P)
        set_failed(pc, self.failed)
        self._made_in = time.perf_counter() - start
        self.account.setups += 1
        self.account.setup_s += self._made_in
        left = made.left if self.rank > 1 else 0.0
        if left > 0.5:
            words = f"the train of rank {self.rank} leaves {left:.2g} of the matrix or of the residual"
            self.warn(self.comm, words, "leaves")

    def _make_block_jacobi(self, P: PETSc.Mat) -> None:
        _destroy(self._own)
        diagonal = block_diagonal(P, without_singular(diagonal_blocks(P)) if has_entries(P) else replaced_blocks(P))
        self._jacobi = PETSc.PC().create(P.comm)
        self._jacobi.setType(PETSc.PC.Type.PBJACOBI)
        self._jacobi.setOperators(diagonal)
        self._jacobi.setUp()
        self._own = [self._jacobi, diagonal]

    # -- application ----------------------------------------------------------------------------------------

    def apply(self, pc: PETSc.PC, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """y = M x, where M is block Jacobi or the train; if the set-up failed, y has no numbers."""
        if self._structure is None:  # PETSc does not set up a new context of a PC that is set up (`-pc_python_type`)
            self.setUp(pc)
        if self.P is None:
            return
        if self._watch is not None:
            self._watch.count()
        if self.failed:
            y.set(np.inf)
        elif self.rank == 1:
            self._jacobi.apply(x, y)
        else:
            with PETSc.Log.Event("TTApply"):
                y.array_w[:] = self.sign * self.made.times(x.array_r)
                PETSc.Log.logFlops(self.made.flops)
        if self._turned:
            y.scale(-1.0)

    def matApply(self, pc: PETSc.PC, X: PETSc.Mat, Y: PETSc.Mat) -> None:
        """Y = M X for dense Mats; block Jacobi and trains of sparse matrices take one column after the other."""
        if self._structure is None:
            self.setUp(pc)
        x, y = X.getDenseArray(readonly=True), Y.getDenseArray()
        if self.P is not None and self.rank > 1 and not self.failed and isinstance(self.made, EntriesTrain):
            with PETSc.Log.Event("TTApply"):
                y[:] = self.sign * self.made.times(x.T).T
                PETSc.Log.logFlops(self.made.flops * x.shape[1])
            return
        for k in range(X.getSize()[1]):
            one, other = X.getDenseColumnVec(k, "r"), Y.getDenseColumnVec(k, "w")
            self.apply(pc, one, other)
            X.restoreDenseColumnVec(k, "r")
            Y.restoreDenseColumnVec(k, "w")

    def applyTranspose(self, pc: PETSc.PC, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """y = M' x; trains are symmetric, blocks of a matrix may be not."""
        if self._structure is not None and self.P is not None and self.rank == 1 and not self.failed:
            self._jacobi.applyTranspose(x, y)
        else:
            self.apply(pc, x, y)

    # -- watching the solves --------------------------------------------------------------------------------

    def preSolve(self, pc: PETSc.PC, ksp: PETSc.KSP, b: PETSc.Vec, x: PETSc.Vec) -> None:
        if self.P is not None and self.rank > 1:
            outermost = ksp.getTabLevel() == 0
            unharmed = ksp.getType() in UNHARMED or (outermost and ksp.getType() in REFINING)
            self._last_precision = self._precision(unharmed)
            self.made.use(self._last_precision)
        self._turned = ksp.getType() in ABSOLUTE and self.P is not None and has_negative_diagonal(self.P)
        cost_estimate = None if self.P is None or self.failed else self.made.cost_estimate
        self._watch = None
        if cost_estimate is not None and Watch.can(ksp, pc):
            self._watch = Watch(ksp, b, x, cost_estimate, self._trials, self.sign)
            self._trials = 0.0

    def _precision(self, unharmed: bool) -> type:
        """The precision of products, for a Krylov method that single precision harms or not."""
        if self.options.precision != "auto":
            return np.float32 if self.options.precision == "single" else np.float64
        harmless = unharmed and self.made.single_pays and self.options.eps >= self.options.single_eps
        return np.float32 if harmless else np.float64

    def postSolve(self, pc: PETSc.PC, ksp: PETSc.KSP, b: PETSc.Vec, x: PETSc.Vec) -> None:
        """Solve again where a train has spoilt the method, and count what the solve used."""
        self._turned = False
        if self.P is None or self.failed:
            return
        if self.rank > 1:  # whoever calls next may be another method
            self.made.use(self._precision(unharmed=False))
        if self._watch is not None:
            watch, self._watch = self._watch, None
            watch.end()
            if watch.solution is not None and ksp.getConvergedReason() < 0:
                self._leave(watch, ksp, b, x)
                return
        reason = ksp.getConvergedReason()
        if self.rank > 1 and reason < 0:
            used = self._used()
            what = f"with {f'rank {used}' if isinstance(used, int) else used}"
            # a matrix that is not symmetric may have had a transpose solve; b with NaN spoils any method
            if reason in SPOILT and self.made.symmetric and np.isfinite(b.norm()):
                what = f"{ksp.getType()} broke down ({reason}) {what}"
                again = self.options.fallback == "jacobi"
                self.account.fall_back(f"{what}, solved again with block Jacobi" if again else what)
                self.made.note_failure(self.account.last)
                self.warn(self.comm, self.account.last)
                if again:
                    self._solve_again(ksp, b, x)
            elif ksp.getType() not in ("preonly", "richardson"):
                self.account.fall_back(f"{ksp.getType()} stalled {what}")
                self.made.note_failure(self.account.last)
        self.account.used[self._used()] += 1

    def _leave(self, watch: Watch, ksp: PETSc.KSP, b: PETSc.Vec, x: PETSc.Vec) -> None:
        """Hand the solution of conjugate gradients alone to the KSP; other solves with this matrix then have no
        preconditioner."""
        used = self._used()
        what = used if isinstance(used, str) else f"the train of rank {used}"
        why = f"conjugate gradients alone take {watch.products} iterations, {what} has not done in as many products"
        assert isinstance(self.made, EntriesTrain)
        self.made.leave(why)
        self.rank = self.made.rank
        x.array_w[:] = watch.solution
        self._go_on(ksp, b, x, PETSc.PC.Type.NONE, ksp.getOperators()[1], nonzero=True)
        self.account.used[self._used()] += 1

    def _solve_again(self, ksp: PETSc.KSP, b: PETSc.Vec, x: PETSc.Vec) -> None:
        """Solve from zero by the same method with block Jacobi, which other solves with this matrix then use too."""
        self.rank = 1
        self._make_block_jacobi(self.P)
        self._go_on(ksp, b, x, PETSc.PC.Type.PBJACOBI, self._own[1])

    @staticmethod
    def _go_on(
        ksp: PETSc.KSP, b: PETSc.Vec, x: PETSc.Vec, kind: str, P: PETSc.Mat, nonzero: bool = False
    ) -> None:  # fmt: skip
        """Solve by the same method with another preconditioner, from zero or from x. The KSP gets the outcome."""
        again = PETSc.KSP().create(ksp.comm)
        again.setType(ksp.getType())
        again.setPCSide(ksp.getPCSide())
        again.setNormType(ksp.getNormType())
        rtol, atol, divtol, max_it = ksp.getTolerances()
        again.setTolerances(rtol, atol, divtol, max_it)
        again.setInitialGuessNonzero(nonzero)
        again.pc.setType(kind)
        again.setOperators(ksp.getOperators()[0], P)
        again.solve(b, x)
        ksp.setIterationNumber(ksp.getIterationNumber() + again.getIterationNumber())
        ksp.setResidualNorm(np.nan_to_num(again.getResidualNorm(), nan=np.inf))  # PETSc takes no NaN
        ksp.setConvergedReason(again.getConvergedReason())
        again.destroy()

    # -- words ----------------------------------------------------------------------------------------------

    def report(self) -> list[str]:
        a, symmetric = self.account, self.P is None or self.made.symmetric
        return [
            f"tensor train: {self._line()}",
            f"set-ups {a.setups} ({a.setup_s:.3g} s), warm starts {a.reused}, kept {a.kept} times, "
            f"trees made anew {a.resets}",
            *([f"rows ordered by {ORDERS.get(self.made.order, self.places.source)}"] if self.rank > 1 else []),
            *([] if symmetric else [NOT_SYMMETRIC]),
            *(f"fell back: {why} ({count} times)" for why, count in a.fallbacks.items()),
            *(["the next matrix is tried again"] if a.fallbacks else []),
        ]

    def what(self) -> str:
        """What the preconditioner really was over its solves, in a few words."""
        return self.account.what()

    def _used(self) -> int | str:
        """The greatest rank of the train of the inverse, or what is used in its place."""
        if self.rank > 1 and self.made.inverse is not None:
            return max(self.made.inverse.applied.ranks)
        return "rank 1: block Jacobi" if self.rank == 1 else self.made.base

    def _line(self) -> str:
        if self.failed:
            return f"none: {self.account.last}"
        if self.P is None:
            return "made for no system yet"
        if self.rank == 1:
            why = self.made.note or self.made.failure
            note = f", because {why}" if why else ""
            faster = f"; {FASTER}" if isinstance(self.made, SparseTrain) else ""
            return f"rank 1 (block Jacobi{note}), set up in {self._made_in:.2e} s{faster}"
        digits = "single" if self._last_precision is np.float32 and self.made.inverse is not None else "double"
        return f"{self.made.words()}, {digits} precision, set up in {self._made_in:.2e} s"


def _destroy(things: list[PETSc.Object]) -> None:
    while things:
        things.pop().destroy()
