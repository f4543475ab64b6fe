"""The train of the inverse of a matrix that is given by its entries. Cross approximation compresses the matrix; it is
not scaled."""

from __future__ import annotations

import numpy as np
from mpi4py import MPI
from numpy.typing import DTypeLike
from petsc4py import PETSc

from pctt.mat.grid_train import GridTrain
from pctt.mat.order import Places
from pctt.mat.tensor_train import CompressedEntries, compressed
from pctt.pc.positivity import CERTAIN, finds_negative, has_inertia_of
from pctt.pc.train_options import Account, Options
from pctt.tt.inverse import Inverse, invert_near_identity
from pctt.tt.lowest import lowest
from pctt.tt.train import identity

WORTH = 0.25  # smallest part of eps that is asked for to get a certificate
TIGHTER, TRIES = 0.05, 4  # eps is lowered if the train of the matrix or of its inverse is not positive


class EntriesTrain:
    """`make` makes a train for a matrix, `times` multiplies with it.

    compressed, inverse : trains of the present matrix and of its inverse; None before `make`, and after a failure
    """

    places: Places

    def __init__(self, comm: MPI.Comm, options: Options, account: Account, prefix: str) -> None:
        self.comm, self.options, self.account, self.prefix = comm, options, account, prefix
        self.compressed: GridTrain | None = None
        self.inverse: Inverse | None = None

    def begin(self, places: Places) -> None:
        """Begin a matrix whose rows are at other places."""
        self.places = places

    def make(self, P: PETSc.Mat, rank: int) -> bool:
        """Make a train. If there is no positive inverse, return False and write the reason to the account.

        EntriesError or ValueError on all ranks for bad entries or a bad grid.
        """
        for eps in self.options.eps * TIGHTER ** np.arange(TRIES):
            warm = self.compressed is not None and self.options.reuse != "none"
            with PETSc.Log.Event("TTCompress"):
                self.compressed = self._compress(P, rank, eps, self.compressed if warm else None)
            if self.compressed.shift <= 0:
                return self._refuse("the mean of the diagonal is not positive")
            self.account.reused += warm
            with PETSc.Log.Event("TTInvert"):
                # every rank inverts the same train, but results may differ in the last bit: all take the first rank's
                self.inverse = self.comm.bcast(self._invert(rank, eps))
                if self.inverse is not None and self._is_positive(self.inverse):
                    return True
            if self.inverse is not None and self.inverse.residual > eps:
                break  # the rank cannot reach this accuracy, and even less a higher one
        return self._refuse(f"the inverse of rank {rank} is not positive")

    def _compress(self, P: PETSc.Mat, rank: int, eps: float, start: GridTrain | None) -> GridTrain:
        known = compressed(P)
        if known is not None and known.error <= eps and self.options.order in ("auto", known.order):
            return known.rounded(0.5 * eps, rank)
        name = f"-{self.prefix}pc_tt_order"
        return CompressedEntries(P, eps, rank, self.options.order, name, start, self.options.seed, self.places)

    def _invert(self, rank: int, eps: float) -> Inverse | None:
        """The inverse; None if the train of the matrix turns out not to be positive."""
        assert self.compressed is not None
        T = self.compressed.train
        if lowest(identity(T.rows) + T) <= 0:
            return None
        certain = CERTAIN / (T.norm() or 1.0)  # zero for a multiple of the identity
        if WORTH * eps <= certain:  # a little more accuracy is cheaper than a test whether the inverse is positive
            eps = min(eps, certain)
        rng = np.random.default_rng(self.options.seed)
        return invert_near_identity(T, rank, eps=eps, rng=rng)

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

    def _refuse(self, why: str) -> bool:
        self.account.fall_back(why)
        self.compressed = self.inverse = None
        return False

    def distrust(self) -> bool:
        """False, because every matrix has a train of its own."""
        return False

    def use(self, dtype: DTypeLike) -> None:
        """Multiply in this precision."""
        self._product.use(dtype)

    @property
    def flops(self) -> int:
        """Operations of this rank in `times`."""
        return self._product.flops

    def times(self, x: np.ndarray) -> np.ndarray:
        """This rank's part of (x + Z x) / c, from its part of x."""
        assert self.compressed is not None
        return (x + self._product(x)) / self.compressed.shift

    def words(self) -> str:
        """Ranks, errors and sizes."""
        if self.inverse is None or self.compressed is None:
            return ""
        X = self.inverse.applied
        return f"{self.compressed.words()}; inverse I + Z ranks {X.ranks} residual {self.inverse.residual:.2g}"
