"""``-pc_type python -pc_python_type pctt.pc.TensorTrain``: a tensor train as approximate inverse.

The blocks of a sparse matrix are ordered, scaled, compressed and inverted as in ``sparse_train.py``. At rank 1 there is
no train, only the scaled diagonal, which is block Jacobi. By default the rank is the one with the fewest measured
seconds per digit (``rank_policy.py``). A matrix that is given by its entries (the attribute ``entries``, or a dense
Mat) is compressed by cross approximation and inverted (``entries_train.py``).
"""

from __future__ import annotations

import time

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from pctt.block_diagonal import block_diagonal
from pctt.mat.entries import diagonal_blocks, has_entries
from pctt.mat.order import Places, places_of
from pctt.pc.base import PythonPC
from pctt.pc.entries_train import EntriesTrain
from pctt.pc.mat import is_symmetric, residual_norm
from pctt.pc.rank_policy import RankPolicy
from pctt.pc.sparse_train import SparseTrain
from pctt.pc.train_options import ENTRIES_RANK, SPARSE_RANK, Account, Options
from pctt.petsc import on_coordinates, set_failed, warn

NOT_SYMMETRIC = "the matrix is not symmetric, so a train for its inverse may be useless"
NOWHERE = (
    "nothing is known of the places of its rows (no grid, coordinates, DM or near null space), so they are in reverse "
    "Cuthill-McKee order"
)
LOWER = 3  # auto tries the cap and the cap divided by this
POOR = 0.5  # an inverse with a larger residual causes a warning
SINGLE = 1e-5  # with this eps or a larger one, products of the inverse may use single precision
#: Krylov methods that are as accurate if the preconditioner rounds to single precision: they multiply by A each vector
#: that they add to x. Others take a product M A p for the preconditioner of a vector that they never formed.
UNHARMED = {"cg", "cgne", "fcg", "fgmres", "fbcgs", "fbcgsr", "gcr", "pipefcg", "pipefgmres"}
#: Methods that compute the residual of x anew. If they are part of another preconditioner, that must be linear.
REFINING = {"richardson", "chebyshev"}
#: Reasons for the end of a Krylov method whose preconditioner is not positive definite.
SPOILT = {
    getattr(PETSc.KSP.ConvergedReason, f"DIVERGED_{name}")
    for name in ("BREAKDOWN", "BREAKDOWN_BICG", "INDEFINITE_MAT", "INDEFINITE_PC", "NANORINF", "DTOL")
}


class TensorTrain(PythonPC):
    """The python PC; see the module and ``Options``. It works on symmetric positive definite Mats of any block size."""

    options_class = Options
    options_prefix = "pc_tt_"
    options: Options
    policy: RankPolicy
    made: SparseTrain | EntriesTrain  #: the maker of trains
    sparse_train: type[SparseTrain] = SparseTrain

    def create(self, pc: PETSc.PC) -> None:
        super().create(pc)
        self.account = Account()
        self.rank = 1
        self.failed = False  # whether there is no preconditioner, by -pc_tt_fallback none
        self.symmetric = True
        self.places = Places()
        self._own: list[PETSc.Object] = []  # block Jacobi and its matrix
        self._warned: set[str] = set()
        self._points: np.ndarray | None = None
        self._last_precision: type = np.float64  # of the last solve
        self._on_coordinates = on_coordinates(pc, self._take_points)

    def destroy(self, pc: PETSc.PC) -> None:
        self._on_coordinates = on_coordinates(pc, None)  # the function refers to this context
        super().destroy(pc)

    def _take_points(self, points: np.ndarray) -> None:
        """The points (n, d) of this rank's block rows, from ``PCSetCoordinates``."""
        self._points = points
        self._structure = None

    # -- set-up ---------------------------------------------------------------------------------------------

    def takes(self, P: PETSc.Mat) -> bool:
        return has_entries(P)

    def build(self, pc: PETSc.PC, P: PETSc.Mat) -> None:
        """ValueError on all ranks if coordinates, grid or modes do not fit the matrix."""
        self.comm = P.comm.tompi4py()
        self.places = places_of(P, (pc.getDM(), pc.getOperators()[0].getDM()), self._points)
        if has_entries(P):
            self.made = EntriesTrain(self.comm, self.options, self.account, self.prefix)
            self.made.begin(self.places)
            self.policy = RankPolicy((self.options.cap(ENTRIES_RANK),), automatic=False)
        else:
            self._begin_sparse(P)
        self.release()
        self._jacobi = PETSc.PC().create(P.comm)
        self._jacobi.setType(PETSc.PC.Type.PBJACOBI)
        self._own = [self._jacobi]

    def _begin_sparse(self, P: PETSc.Mat) -> None:
        made = getattr(self, "made", None)
        if isinstance(made, SparseTrain) and made.options == self.options:
            self.policy.forgive()  # a rank that failed on another matrix may work here
        else:
            cap = self.options.cap(SPARSE_RANK)
            self.made = self.sparse_train(self.comm, self.options, self.account)
            ladder = (max(1, cap // LOWER), cap) if self.options.automatic else (cap,)
            self.policy = RankPolicy(ladder, self.options.automatic)
        assert isinstance(self.made, SparseTrain)
        self.made.begin(P, self.places)
        self._judge_symmetry(is_symmetric(P))

    def _judge_symmetry(self, symmetric: bool) -> None:
        self.symmetric = symmetric
        if not symmetric:
            self._warn(NOT_SYMMETRIC)

    def _warn(self, words: str) -> None:
        """Warn, once in the life of this preconditioner; collective."""
        if words not in self._warned:
            self._warned.add(words)
            warn(self.comm, f"{self.name}: {words}")

    def update(self, pc: PETSc.PC, P: PETSc.Mat) -> None:
        """Make a preconditioner of the rank that the policy chooses; if this fails, fall back."""
        start = time.perf_counter()
        # all take the first process's choice, because figures may differ in the last bit
        self.rank = self.comm.bcast(self.policy.choose())
        self.failed = False
        if self.rank > 1 and not self.made.make(P, self.rank):
            self.policy.report(self.rank, self._slowest(time.perf_counter() - start), 0.0, sound=False)
            self.rank = 1
        if isinstance(self.made, EntriesTrain) and self.made.compressed is not None:
            self._judge_symmetry(self.made.compressed.symmetric)
        if failure := self._failure():
            self._fall_back(failure)
        if self.rank == 1 and not self.failed:
            self._make_block_jacobi(P)
        set_failed(pc, self.failed)
        self._setup_seconds = self._made_in = self._slowest(time.perf_counter() - start)
        self.account.setups += 1
        self.account.setup_s += self._setup_seconds
        inverse = self.made.inverse
        if isinstance(self.made, EntriesTrain) and inverse is not None and inverse.residual > POOR:
            self._warn(f"the inverse of rank {self.rank} leaves {inverse.residual:.2g} of the residual")
        if self.options.monitor:
            PETSc.Sys.Print(f"  {self.name}: {self._line()}", comm=P.comm)

    def _failure(self) -> str:
        """Why a train that was asked for is not used; empty if nothing failed."""
        if isinstance(self.made, EntriesTrain):
            return self.made.failure
        lacking = not self.options.automatic and self.rank == 1 and max(self.policy.ladder) > 1
        return self.account.last if lacking else ""

    def _fall_back(self, why: str) -> None:
        """Take what there is in place of a train, or nothing; and say why."""
        self.failed = self.options.fallback == "none"
        takes_over = "there is no preconditioner" if self.failed else f"{self._base()} takes over"
        lost = not isinstance(self.made, EntriesTrain) and self.places.source == "nothing"
        self._warn(f"{why}: {takes_over}" + (f"; {NOWHERE}" if lost and self.options.order == "auto" else ""))

    def _base(self) -> str:
        """What is used where no train is."""
        transform = self.made.transform if isinstance(self.made, EntriesTrain) else None
        return "block Jacobi" if transform is None else f"the {transform.transform.name}"

    def _make_block_jacobi(self, P: PETSc.Mat) -> None:
        old = self._own[1:]
        diagonal = block_diagonal(P, diagonal_blocks(P) if has_entries(P) else None)
        self._jacobi.setOperators(diagonal)
        self._jacobi.setUp()
        self._own = [self._jacobi, diagonal]
        for mat in old:
            mat.destroy()

    # -- application ----------------------------------------------------------------------------------------

    def multiply(self, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """y = M x, where M is block Jacobi or the train; if the set-up failed, y has no numbers."""
        if self.failed:
            y.set(np.inf)
        elif self.rank == 1:
            self._jacobi.apply(x, y)
        else:
            with PETSc.Log.Event("TTApply"):
                y.array_w[:] = self.made.times(x.array_r)
                PETSc.Log.logFlops(self.made.flops)

    def multiply_transpose(self, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """y = M' x; trains are symmetric, blocks of a matrix may be not."""
        if self.rank == 1 and not self.failed:
            self._jacobi.applyTranspose(x, y)
        else:
            self.multiply(x, y)

    # -- watching the solves --------------------------------------------------------------------------------

    def preSolve(self, pc: PETSc.PC, ksp: PETSc.KSP, b: PETSc.Vec, x: PETSc.Vec) -> None:
        self._solve_start = time.perf_counter()
        if self.P is not None and self.rank > 1:
            self._last_precision = self._precision(self._is_unharmed(ksp))
            self.made.use(self._last_precision)

    @staticmethod
    def _is_unharmed(ksp: PETSc.KSP) -> bool:
        """Whether a Krylov method is as accurate with products in single precision."""
        outermost = ksp.getTabLevel() == 0
        return ksp.getType() in UNHARMED or (outermost and ksp.getType() in REFINING)

    def _precision(self, unharmed: bool) -> type:
        """The precision of products, for a Krylov method that single precision harms or not."""
        if self.options.precision != "auto":
            return np.float32 if self.options.precision == "single" else np.float64
        harmless = unharmed and isinstance(self.made, EntriesTrain) and self.options.eps >= SINGLE
        return np.float32 if harmless else np.float64

    def postSolve(self, pc: PETSc.PC, ksp: PETSc.KSP, b: PETSc.Vec, x: PETSc.Vec) -> None:
        """Report the seconds and the accuracy of the solve to the policy; ban a rank with which the method stalled."""
        if self.P is None or self.failed:
            return
        if self.rank > 1:  # whoever calls next may be another method
            self.made.use(self._precision(unharmed=False))
        reason, rank = ksp.getConvergedReason(), self.rank
        spoilt = rank > 1 and reason in SPOILT and self.symmetric  # otherwise it may have been a transpose solve
        if spoilt:
            what = f"{ksp.getType()} broke down ({reason}) with {self._used_words()}"
            again = self.options.fallback == "jacobi"
            self.account.fall_back(f"{what}, solved again with block Jacobi" if again else what)
            if not self.options.automatic or isinstance(self.made, EntriesTrain):
                self._warn(self.account.last)
            if again:
                self._solve_again(ksp, b, x)
        self.account.used[self._used()] += 1
        seconds = self._slowest(time.perf_counter() - self._solve_start)
        reference = b.norm()
        if reference == 0 or ksp.getIterationNumber() == 0:
            return
        digits = 0.0
        if self.policy.automatic:  # else nobody asks, and the product would be for nothing
            true = self.comm.bcast(residual_norm(pc.getOperators()[0], b, x) / reference)
            digits = -np.log10(max(true, 1e-16)) if np.isfinite(true) else 0.0
        stalled = ksp.getConvergedReason() < 0 and ksp.getType() not in ("preonly", "richardson")
        if stalled and rank > 1 and not spoilt:
            self.account.fall_back(f"{ksp.getType()} stalled with {self._used_words()}")
        sound = not (spoilt or stalled)
        if not sound and self.made.distrust():  # it was a train of an earlier matrix; a new train may work
            sound = True
        self.policy.report(rank, self._setup_seconds + seconds, max(digits, 0.0), sound)
        self._setup_seconds = 0.0  # a second solve with the same matrix has no set-up

    def _solve_again(self, ksp: PETSc.KSP, b: PETSc.Vec, x: PETSc.Vec) -> None:
        """Solve from zero by the same method with block Jacobi, which other solves with this matrix then use too.

        The KSP gets the outcome.
        """
        self.rank = 1
        self._make_block_jacobi(self.P)
        again = PETSc.KSP().create(ksp.comm)
        again.setType(ksp.getType())
        again.setPCSide(ksp.getPCSide())
        again.setNormType(ksp.getNormType())
        rtol, atol, divtol, max_it = ksp.getTolerances()
        again.setTolerances(rtol, atol, divtol, max_it)
        again.pc.setType(PETSc.PC.Type.PBJACOBI)
        again.setOperators(ksp.getOperators()[0], self._own[1])
        again.solve(b, x)
        ksp.setIterationNumber(ksp.getIterationNumber() + again.getIterationNumber())
        ksp.setConvergedReason(again.getConvergedReason())
        again.destroy()

    def _slowest(self, seconds: float) -> float:
        return self.comm.allreduce(seconds, op=MPI.MAX)

    # -- words ----------------------------------------------------------------------------------------------

    def report(self) -> list[str]:
        a = self.account
        lines = [
            f"tensor train: {self._line()}",
            f"set-ups {a.setups} ({a.setup_s:.3g} s), warm starts {a.reused}, kept {a.kept} times, "
            f"trees made anew {a.resets}",
            f"rows ordered by {self.places.source}",
        ]
        lines += [] if self.symmetric else [NOT_SYMMETRIC]
        lines += [f"fell back: {why} ({count} times)" for why, count in a.fallbacks.items()]
        if isinstance(self.made, SparseTrain):
            lines.append(f"scaling {self.options.scaling}")
        if self.policy.automatic:
            figures = self.policy.figures.items()
            costs = ", ".join(f"rank {r}: {f.cost:.2e} s ({f.uses} uses)" for r, f in figures if f.uses)
            lines.append(f"seconds per digit: {costs or 'none measured yet'}")
        return lines

    def what(self) -> str:
        return self.account.what()

    def _used(self) -> int | str:
        """The greatest rank of the train of the inverse, or what is used in its place."""
        if self.rank > 1 and self.made.inverse is not None:
            return max(self.made.inverse.applied.ranks)
        return "rank 1: block Jacobi" if self.rank == 1 else self._base()

    def _used_words(self) -> str:
        used = self._used()
        return f"rank {used}" if isinstance(used, int) else used

    def _line(self) -> str:
        if self.failed:
            return f"none: {self.account.last}"
        if self.rank == 1:
            note = f", because {self.made.note}" if isinstance(self.made, EntriesTrain) and self.made.note else ""
            return f"rank 1 (block Jacobi{note}), set up in {self._made_in:.2e} s"
        digits = "single" if self._last_precision is np.float32 and self.made.inverse is not None else "double"
        return f"{self.made.words()}, {digits} precision, set up in {self._made_in:.2e} s"

    def release(self) -> None:
        for thing in self._own:
            thing.destroy()
        self._own = []
