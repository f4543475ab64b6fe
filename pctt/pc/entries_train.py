"""A preconditioner of a matrix on a grid that is given by its entries: a fast transform, or the train of an inverse.

Where the entries depend on differences of points only, a cosine or sine transform (`differences.py`) costs next to
nothing. Otherwise cross approximation compresses the matrix, which is not scaled, and its inverse is computed.
-pc_tt_rank auto follows this rule, in operations (about a nanosecond each, `pctt.tt.work`), never by a clock:

1. Entries depend on differences, eps is COARSE or larger, and conjugate gradients with a transform take less than LONG
   operations: the transform.
2. The same, but they take longer: a train, if a quarter of these operations are enough to set it up; otherwise 1.
3. Entries are of another kind, and conjugate gradients take less than SHORT operations without a train: the diagonal.
4. Otherwise a train, if its set-up takes no more operations than these conjugate gradients; else the diagonal.

A number as -pc_tt_rank asks for the train of this rank; the others take over if it fails.
"""

from __future__ import annotations

import numpy as np
from mpi4py import MPI
from numpy.typing import DTypeLike
from petsc4py import PETSc

from pctt.mat.entries import DENSE
from pctt.mat.grid_train import GridTrain
from pctt.mat.order import Places, digits_of
from pctt.mat.tensor_train import CompressedEntries, compressed
from pctt.pc.differences import DifferencesInverse
from pctt.pc.positivity import CERTAIN, finds_negative, has_inertia_of
from pctt.pc.train_options import Account, Options
from pctt.tt.cross import CROSS
from pctt.tt.inverse import Inverse, invert_near_identity
from pctt.tt.lowest import lowest
from pctt.tt.train import identity
from pctt.tt.work import TooMuchWorkError, Work, apply_operations, dense_operations, product_operations

SEED = 0  # of the random starts
WORTH = 0.25  # smallest part of eps that is asked for to get a certificate
TIGHTER, TRIES = 0.05, 4  # eps is lowered if the train of the matrix or of its inverse is not positive

COARSE = 1e-2  # with a smaller eps an accurate inverse is asked for, which a transform is not
LONG = 2e9  # operations of conjugate gradients with a fast transform from which on a train is tried
SHORT = 5e8  # the same with the diagonal
PART = 0.25  # a train may take this part of the operations with a fast transform
ALWAYS = 5e8  # operations that a set-up may take in any case
OPENING, PRODUCTS = 1.5e8, 10  # auto: operations that the compression may take in any case, and products besides
TRANSFORM = 1.3  # an iteration with a fast transform, in products
PROBE = 6  # iterations of conjugate gradients from which their number is extrapolated
DIGITS = 8.0  # to which it is
MOST = 500  # largest number of them
EXPENSIVE, UNKNOWN = 3.0, 50  # a train whose product is so much more expensive is not used for this; number without


class EntriesTrain:
    """`make` makes a preconditioner for a matrix, `times` multiplies with it.

    transform : the fast transform that is used; None if it is a train, or nothing
    compressed, inverse : trains of the present matrix and of its inverse; None before `make`, and without a train
    failure : why a train that was wanted is not used; empty if all is as asked
    note : why auto takes no train
    """

    places: Places

    def __init__(self, comm: MPI.Comm, options: Options, account: Account, prefix: str) -> None:
        self.comm, self.options, self.account, self.prefix = comm, options, account, prefix
        self.transform: DifferencesInverse | None = None
        self.compressed: GridTrain | None = None
        self.inverse: Inverse | None = None
        self.failure = self.note = ""
        self._refused = ""  # why there was no train of an earlier matrix; it is not tried again

    def begin(self, places: Places) -> None:
        """Begin a matrix whose rows are at other places."""
        self.places = places

    def make(self, P: PETSc.Mat, rank: int) -> bool:
        """Make a preconditioner. False: the diagonal is better, or nothing else worked; `failure` or `note` say why.

        EntriesError or ValueError on all ranks for bad entries or a bad grid.
        """
        self.failure = self.note = ""
        coarse = self.options.automatic and self.options.eps >= COARSE
        self.transform = transform = self._find_transform(P) if coarse else None
        product = self._product_operations(P, transform)
        alternative = 0.0
        if transform is not None:
            alternative = TRANSFORM * product * transform.iterations
            if alternative < LONG:
                self.compressed = self.inverse = None
                return True
        why = self._refused or self._make_train(P, rank, product, PART * alternative)
        self._refused = why
        if not why:
            self.transform = None
            return True
        self.compressed = self.inverse = None
        if transform is not None:
            self.note = why
            return True
        if self.note:
            return False
        self.account.fall_back(why)
        self.failure = why
        if not self.options.automatic:
            self.transform = self._find_transform(P)
        return self.transform is not None

    def _find_transform(self, P: PETSc.Mat) -> DifferencesInverse | None:
        return DifferencesInverse.of(P, self.options.order, self._order_option, self.places)

    @property
    def _order_option(self) -> str:
        return f"-{self.prefix}pc_tt_order"

    def _product_operations(self, P: PETSc.Mat, transform: DifferencesInverse | None) -> float:
        """Of a product with P, by FFT if P does not show how it multiplies."""
        known = compressed(P)
        if known is not None:
            return apply_operations(known.train)
        rows = P.getSize()[0]
        if P.getType() in DENSE:
            return dense_operations(rows)
        if transform is not None:
            return product_operations(transform.shape)
        return product_operations(digits_of(P, self.options.order, self._order_option, self.places)[0].shape)

    def _make_train(self, P: PETSc.Mat, rank: int, product: float, limit: float) -> str:
        """Make a train; the reason if there is no positive one.

        product : operations of a product with P
        limit : of the operations of the set-up; 0: those of conjugate gradients without a train
        """
        given = self.options.setup_limit
        work = Work(given or (OPENING if self.options.automatic else ALWAYS) + PRODUCTS * product)
        try:
            for attempt in range(TRIES):
                eps = self.options.eps * TIGHTER**attempt
                warm = self.compressed is not None and self.options.reuse != "none"
                with PETSc.Log.Event("TTCompress"):
                    self.compressed = self._compress(P, rank, eps, self.compressed if warm else None, work)
                if self.compressed.shift <= 0:
                    return "the mean of the diagonal is not positive"
                self.account.reused += warm
                if attempt == 0 and not given:
                    iterations = self._iterations_without(product) if not limit else 0
                    if self.options.automatic and not limit and iterations * product < SHORT:
                        self.note = f"conjugate gradients take about {iterations} iterations, so a train does not pay"
                        return self.note
                    work.limit = ALWAYS + (limit or iterations * product)
                with PETSc.Log.Event("TTInvert"):
                    # every rank inverts the same train, but results may differ in the last bit: all take the first's
                    found, work.spent = self.comm.bcast((self._invert(rank, eps, work), work.spent))
                    if isinstance(found, TooMuchWorkError):
                        raise found
                    self.inverse = found
                    if self.inverse is not None and self._is_positive(self.inverse):
                        return ""
                if self.inverse is not None and self.inverse.residual > eps:
                    break  # the rank cannot reach this accuracy, and even less a higher one
            return self._why_not_positive(rank)
        except TooMuchWorkError as stopped:
            return self._too_much(str(stopped), work)

    def _too_much(self, where: str, work: Work) -> str:
        limit = f"the limit of {work.limit:.1e} operations (-{self.prefix}pc_tt_setup_limit) ends {where}"
        if self.options.setup_limit:
            return f"{limit}: raise it, if the ranks do not grow"
        if where == CROSS:
            return f"{limit}: the ranks of the matrix grow, which is hopeless in this order of the points"
        return f"{limit}: a train costs more than one solution without it; raise the limit for many right-hand sides"

    def _why_not_positive(self, rank: int) -> str:
        assert self.compressed is not None
        missed = f"the train of the matrix leaves {self.compressed.error:.1e} of it"
        if self.inverse is None:
            return f"the train of the matrix is not positive, {missed}: lower -{self.prefix}pc_tt_eps"
        if self.inverse.residual <= self.options.eps:
            return f"the inverse is not positive, because {missed}: lower -{self.prefix}pc_tt_eps"
        why = f"the inverse of rank {rank} is not positive, it leaves {self.inverse.residual:.1e} of the residual"
        if self.inverse.residual < 1:
            return f"{why}: raise -{self.prefix}pc_tt_rank"
        return f"{why}: this is hopeless"

    def _iterations_without(self, product: float) -> int:
        """About how many iterations conjugate gradients take without a train, extrapolated from a few; collective."""
        assert self.compressed is not None
        if apply_operations(self.compressed.train) > EXPENSIVE * product:
            return UNKNOWN
        times = self.compressed.product(self.compressed.train.astype(np.float32))

        def dot(u: np.ndarray, v: np.ndarray) -> float:
            return float(self.comm.allreduce(float(u @ v)))

        r = np.random.default_rng(self.comm.rank).standard_normal(int(self.compressed.counts[self.comm.rank]))
        p, square = r, dot(r, r)
        first = square
        for _ in range(PROBE):
            q = p + times(p)
            curvature = dot(p, q)
            if not curvature > 0:
                break  # the train of the matrix is not positive
            r = r - square / curvature * q
            square, before = dot(r, r), square
            p = r + square / before * p
        digits = 0.5 * float(np.log10(first / max(square, 1e-32 * first)))
        return int(self.comm.bcast(min(MOST, PROBE * DIGITS / max(digits, PROBE * DIGITS / MOST))))

    def _compress(self, P: PETSc.Mat, rank: int, eps: float, start: GridTrain | None, work: Work) -> GridTrain:
        known = compressed(P)
        if known is not None and known.error <= eps and self.options.order in ("auto", known.order):
            return known.rounded(0.5 * eps, rank)
        return CompressedEntries(
            P, eps, rank, self.options.order, self._order_option, start, SEED, self.places, work
        )

    def _invert(self, rank: int, eps: float, work: Work) -> Inverse | TooMuchWorkError | None:
        """The inverse; None if the train of the matrix turns out not to be positive."""
        assert self.compressed is not None
        T = self.compressed.train
        if lowest(identity(T.rows) + T) <= 0:
            return None
        certain = CERTAIN / (T.norm() or 1.0)  # zero for a multiple of the identity
        if WORTH * eps <= certain:  # a little more accuracy is cheaper than a test whether the inverse is positive
            eps = min(eps, certain)
        rng = np.random.default_rng(SEED)
        try:
            return invert_near_identity(T, rank, eps=eps, rng=rng, work=work)
        except TooMuchWorkError as stopped:  # perhaps on this rank only
            return stopped

    def _is_positive(self, inverse: Inverse) -> bool:
        """Take I + Z into use, and tell whether it is positive.

        It is positive, like its matrix, if it is near enough to the inverse. Otherwise a test decides.
        """
        assert self.compressed is not None
        Z, T = inverse.applied, self.compressed.train
        self._product = self.compressed.product(Z)
        if inverse.repaired == 0 and self.comm.bcast(has_inertia_of(inverse.residual * T.norm())):
            return True
        product = self.compressed.product(T)
        count = int(self.compressed.counts[self.comm.rank])
        return not finds_negative(lambda x: x + self._product(x), lambda x: x + product(x), count, self.comm)

    def distrust(self) -> bool:
        """False, because every matrix has a train of its own."""
        return False

    def use(self, dtype: DTypeLike) -> None:
        """Multiply with the train in this precision; a transform has double precision."""
        if self.transform is None:
            self._product.use(dtype)

    @property
    def flops(self) -> int:
        """Operations of this rank in `times`."""
        return self._product.flops if self.transform is None else self.transform.flops

    def times(self, x: np.ndarray) -> np.ndarray:
        """This rank's part of the product, (x + Z x) / c for a train, from its part of x."""
        if self.transform is not None:
            return self.transform(x)
        assert self.compressed is not None
        return (x + self._product(x)) / self.compressed.shift

    @property
    def used(self) -> str:
        """What the preconditioner really is, in few words."""
        if self.transform is not None:
            return self.transform.transform.name
        if self.inverse is None or self.compressed is None:
            return "rank 1: block Jacobi"
        return f"train of ranks {max(self.compressed.train.ranks)}, {max(self.inverse.train.ranks)}"

    def words(self) -> str:
        """The same with ranks, errors and sizes."""
        if self.transform is not None:
            reason = f", because {self.note}" if self.note else ""
            return f"no train but the {self.transform.words()}{reason}"
        if self.inverse is None or self.compressed is None:
            return self.note
        X = self.inverse.applied
        return f"{self.compressed.words()}; inverse I + Z ranks {X.ranks} residual {self.inverse.residual:.2g}"
