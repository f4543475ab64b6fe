"""A preconditioner of a matrix on a grid that is given by its entries: a fast transform, or the train of an inverse.

Where the entries depend on differences of points only, a fast transform (`pctt.pc.transforms`) costs next to nothing.
Otherwise cross approximation compresses the matrix, which is not scaled, and its inverse is computed.
`EntriesTrain.make` is the rule of -pc_tt_rank auto, in operations (about a nanosecond each, `pctt.tt.work`).
"""

from __future__ import annotations

from dataclasses import replace
from math import log2, prod

from mpi4py import MPI
from numpy.typing import DTypeLike
from petsc4py import PETSc

from dem.exchange import on_first
from pctt.blocks import symmetric_shell
from pctt.mat.entries import DENSE, Entries, diagonal, is_symmetric, multiplies
from pctt.mat.grid_train import GridTrain, TrainProduct
from pctt.mat.order import Layout, Places, layout_of
from pctt.mat.tensor_train import compressed, compressed_entries
from pctt.pc.mat import finds_negative, iterations_with_the_diagonal
from pctt.pc.nystrom import Identity, Nystrom, choose
from pctt.pc.options import Account, Options
from pctt.pc.transforms import DifferencesInverse
from pctt.tt.conjugate import NO_ESTIMATE, CostEstimate
from pctt.tt.cross import CROSS
from pctt.tt.inverse import Inverse, invert_positive
from pctt.tt.train import Array
from pctt.tt.work import TooMuchWorkError, Work, apply_operations

SMALL = tuple(5 << k for k in range(9))  # ranks that are tried once the limit of operations has ended an attempt


class EntriesTrain:
    """`make` makes a preconditioner for a matrix, `times` multiplies with it.

    transform : the fast transform that is used; None if it is a train, or the diagonal
    cost_estimate : what a trial has shown of the preconditioner in use, for `pctt.pc.watch`; None: there is none
    compressed, inverse : trains of the present matrix and of its inverse; None before `make`, and without a train
    rank : cap of the ranks
    failure : why a train that was wanted is not used; empty if all is as asked
    note : why auto takes no train
    """

    single_pays = True
    _product: TrainProduct  # by the train of the inverse

    def __init__(self, comm: MPI.Comm, options: Options, account: Account, prefix: str, places: Places) -> None:
        self.comm, self.options, self.account = comm, options, account
        self._named = f"-{prefix}pc_tt_"  # how the names of the options begin
        self._places = places
        self._layout: Layout | None = None
        self.rank = options.max_rank if options.automatic else int(options.rank)
        self.transform: DifferencesInverse | Nystrom | Identity | None = None
        self.cost_estimate: CostEstimate | None = None
        self.compressed: GridTrain | None = None
        self._product: TrainProduct
        self.inverse: Inverse | None = None
        self.symmetric = True
        self.failure = self.note = ""

    @property
    def order(self) -> str:
        """The order of the rows."""
        return self._layout.order if self._layout else "natural"

    @property
    def idle(self) -> dict[str, str]:
        """Options that have no effect, and why."""
        none: dict[str, str] = {}
        if self.rank == 1:
            none = dict.fromkeys(("eps", "order", "setup_limit"), "there is no train of rank 1")
        elif not self._tried:
            none = dict.fromkeys(("eps", "setup_limit"), "auto tries no train, as none would pay")
        return {"variant": "it is for sparse matrices", **none}

    def make(self, A: PETSc.Mat, P: PETSc.Mat) -> bool:
        """Make a preconditioner. False: the diagonal is better, or nothing else worked; `failure` or `note` say why.

        1. If entries depend on differences, CG with a fast transform would do; otherwise CG with the best of the
           diagonal, Nystrom's approximation and nothing (`pctt.pc.nystrom.choose`).
        2. A train may take a quarter of the operations of this solution, unless -pc_tt_setup_limit is given. If the
           quarter is less than `pays`, no train is tried.
        3. If there is no train within the limit, or if it is not positive, 1 takes over.

        A number as -pc_tt_rank asks for the train of this rank. It may take `pays` operations more than a solution with
        the diagonal, and 1 takes over if it fails. ValueError on all ranks for bad entries or a bad
        grid.
        """
        self.failure, self.note, self.transform, self.cost_estimate = "", "", None, None
        self._iterations = 50  # if there is no estimate
        self._tried = self._chosen = False  # whether a train was tried, and the base was chosen
        if self.rank == 1:
            return False
        options = self.options
        layout = self._layout = self._layout or layout_of(P, options.order, f"{self._named}order", self._places)
        if options.automatic and options.eps >= options.coarse:
            limit = options.part * self._choose_base(A, P, layout)
        else:
            product = _product_operations(P, layout.digits.shape)
            if multiplies(A) and (options.automatic or 20 * product < options.pays):  # six products are cheap
                self._iterations = iterations_with_the_diagonal(A, diagonal(P))
            cost = self._iterations * product
            limit = options.part * cost if options.automatic else options.pays + cost
        if options.automatic and limit < options.pays:
            found = self._take_no_train(A, P, layout, "")
            if not found:
                self.note = f"conjugate gradients take about {self._iterations} iterations, so a train does not pay"
            return found
        self._tried = True
        refused = self._make_train(P, layout, options.setup_limit or limit)
        if refused:
            return self._take_no_train(A, P, layout, refused)
        spent = self.cost_estimate.spent if self.cost_estimate else 0.0
        self.transform, self.cost_estimate = None, replace(NO_ESTIMATE, spent=spent)
        return True

    def _choose_base(self, A: PETSc.Mat, P: PETSc.Mat, layout: Layout) -> float:
        """Choose what is used where no train is; the operations of a solution with it."""
        self._chosen = True
        self.transform = found = DifferencesInverse.best_of(P, layout)
        lattice = self._places.lattice(P.getSize()[0] // P.getBlockSize())
        product = _product_operations(P, lattice if found is None else layout.digits.shape)
        if found is not None:
            self.cost_estimate = found.cost_estimate if found.inverse.kind else None
            return (1 + found.cost_estimate.each) * product * found.cost_estimate.iterations
        if not multiplies(A) or not is_symmetric(Entries.of_mat(P), P.getSize()[0]):
            return self._iterations * product
        chosen = choose(P, A, product)
        self.transform = chosen.inverse or (None if chosen.scaled else Identity())
        self.cost_estimate = chosen.cost_estimate
        self._iterations = int(min(chosen.iterations, 1e9))
        return chosen.cost * product

    def _take_no_train(self, A: PETSc.Mat, P: PETSc.Mat, layout: Layout, why: str) -> bool:
        """Use the base if it is not the diagonal; False: it is. ``why``: a train that was tried has failed."""
        self.compressed = self.inverse = None
        if self.transform is not None:
            self.note = why
        elif why:
            self.account.fall_back(why)
            self.failure = why
        if not self._chosen:
            self._choose_base(A, P, layout)
        return self.transform is not None

    def _make_train(self, P: PETSc.Mat, layout: Layout, limit: float) -> str:
        """Make a train of at most the rank that is asked for; the reason if there is no positive one.

        If the limit of operations ends the attempt, others with small ranks follow, each with twice the rank of the
        last, until it ends one of these too. The train that leaves least is kept, so a large rank is rarely worse
        than a small one.
        """
        start = None if self.options.reuse == "none" else self.compressed
        found, why = None, ""
        for cap in (self.rank, *(r for r in SMALL if r < self.rank)):
            self.compressed = start
            failure, stopped = self._try_train(P, layout, limit, cap)
            why = why or failure
            left = self.comm.bcast(self.left)
            if not failure and (found is None or left < found[0]):
                found = left, self.compressed, self.inverse, self._product
            asked = cap == self.rank
            if (not stopped if asked else stopped) or (found is not None and found[0] <= self.options.eps):
                break
        if found is None:
            return why
        _, self.compressed, self.inverse, self._product = found
        return ""

    def _try_train(self, P: PETSc.Mat, layout: Layout, limit: float, cap: int) -> tuple[str, bool]:
        """Make a train of at most this rank with at most this number of operations.

        eps is lowered three times if the train of the matrix or of its inverse is not positive. The result says why
        there is no positive train, empty if there is one, and whether the limit has ended it.
        """
        work, eps = Work(limit), self.options.eps
        try:
            for _ in range(4):
                warm = self.compressed is not None
                with PETSc.Log.Event("TTCompress"):
                    A = self.compressed = self._compress(P, layout, eps, cap, self.compressed, work)
                self.symmetric = A.symmetric
                if A.shift <= 0:
                    return "the mean of the diagonal is not positive", False
                self.account.reused += warm
                with PETSc.Log.Event("TTInvert"):
                    X = self.inverse = self._invert(A, cap, eps, work)
                    if X is not None:
                        self._product = A.product(X.applied)
                        if X.certain or not self._is_negative(P):
                            return "", bool(X.stopped)
                        if X.stopped:
                            return self._too_much(X.stopped, work), True
                        if X.residual > eps:
                            break  # the rank cannot reach this accuracy, and even less a higher one
                eps *= 0.05
            return self._why_not_positive(A, X, cap), False
        except TooMuchWorkError as stopped:
            return self._too_much(str(stopped), work), True

    def _compress(
        self, P: PETSc.Mat, layout: Layout, eps: float, cap: int, start: GridTrain | None, work: Work
    ) -> GridTrain:
        known = compressed(P)
        if known is not None and known.error <= eps and self.options.order in ("auto", known.layout.order):
            return known.rounded(0.5 * eps, cap)
        return compressed_entries(P, layout, eps, cap, start, work)

    def _invert(self, A: GridTrain, cap: int, eps: float, work: Work) -> Inverse | None:
        """The inverse of A / c; None if its train turns out not to be positive."""
        found, work.spent = on_first(self.comm, lambda: (invert_positive(A.train, cap, eps, work=work), work.spent))
        return found

    def _is_negative(self, P: PETSc.Mat) -> bool:
        """Whether a test finds that the train of the inverse is not positive."""
        assert self.compressed is not None
        factors = []
        for product in (self._product, self.compressed.product(self.compressed.train)):

            def times(x: Array, out: Array, product: TrainProduct = product) -> None:
                out[:] = x + product(x)

            factors.append(symmetric_shell(self.comm, P.getLocalSize()[0], 1, times))
        found = finds_negative(*factors)
        for mat in factors:
            mat.destroy()
        return found

    def _too_much(self, where: str, work: Work) -> str:
        limit = f"the limit of {work.limit:.1e} operations ({self._named}setup_limit) ends {where}"
        if self.options.setup_limit:
            return f"{limit}: raise it, if the ranks do not grow"
        if where == CROSS:
            return f"{limit}: the ranks of the matrix grow, which is hopeless in this order of the points"
        return f"{limit}: a train costs more than one solution without it; raise the limit for many right-hand sides"

    def _why_not_positive(self, A: GridTrain, X: Inverse | None, cap: int) -> str:
        missed = f"the train of the matrix leaves {A.error:.1e} of it"
        if X is None:
            return f"the train of the matrix is not positive, {missed}: lower {self._named}eps"
        if X.residual <= self.options.eps:
            return f"the inverse is not positive, because {missed}: lower {self._named}eps"
        why = f"the inverse of rank {cap} is not positive, it leaves {X.residual:.1e} of the residual"
        return f"{why}: " + (f"raise {self._named}rank" if X.residual < 1 else "this is hopeless")

    # -- application ----------------------------------------------------------------------------------------

    def note_failure(self, why: str) -> None:
        """A solve failed; the next matrix is tried again."""
        self.failure = why

    def leave(self, why: str) -> None:
        """Conjugate gradients are faster without a preconditioner: there is none from now on."""
        self.account.fall_back(why)
        self.note, self.cost_estimate = why, None
        self.transform, self.compressed, self.inverse = Identity(), None, None

    def use(self, dtype: DTypeLike) -> None:
        """Multiply with the train in this precision; a transform has double precision."""
        if self.transform is None:
            self._product.use(dtype)

    @property
    def flops(self) -> int:
        """Operations of this rank in `times`."""
        return self._product.flops if self.transform is None else self.transform.flops

    def times(self, x: Array) -> Array:
        """This rank's part of the product, (x + Z x) / c for a train, from its part of x."""
        if self.transform is not None:
            return self.transform(x)
        assert self.compressed is not None
        return (x + self._product(x)) / self.compressed.shift

    @property
    def base(self) -> str:
        """What is used where no train is."""
        return "block Jacobi" if self.transform is None else self.transform.name

    @property
    def left(self) -> float:
        """What the trains leave of the matrix or of the residual, the larger part; 0 without trains."""
        if self.compressed is None or self.inverse is None:
            return 0.0
        return max(self.compressed.error, self.inverse.residual)

    def words(self) -> str:
        """What the preconditioner really is, with ranks, errors and sizes."""
        if self.transform is not None:
            reason = f", because {self.note}" if self.note else ""
            return f"{self.transform.words}, no train{reason}"
        assert self.compressed is not None
        assert self.inverse is not None
        X = self.inverse.applied
        stopped = self.inverse.stopped
        stopped = stopped and f"; the limit of operations ({self._named}setup_limit) ended {stopped}"
        return f"{self.compressed.words()}; inverse I + Z ranks {X.ranks} residual {self.inverse.residual:.2g}{stopped}"


def _product_operations(P: PETSc.Mat, grid: tuple[int, ...] | None) -> float:
    """Of a product with P. If P does not show how it multiplies: by FFT on a grid twice as wide as that of the points,
    or without a grid as a stored matrix, or in a microsecond per row, as fast multipole methods and H-matrices take."""
    known, rows = compressed(P), P.getSize()[0]
    if known is not None:
        return apply_operations(known.train)
    if P.getType() in DENSE:
        return 0.5 * float(rows) ** 2
    if grid is None:
        return min(0.5 * float(rows) ** 2, 1e3 * rows)
    wide = prod(2 * n for n in grid)
    return wide * log2(wide)
