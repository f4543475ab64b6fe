"""The train of the inverse of a matrix that is given by its entries: compressed by cross alone, nothing is scaled."""

from __future__ import annotations

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from pctt.mat.tensor_train import CompressedEntries, compressed
from pctt.pc.approximate_inverse import ApproximateInverse, approximate_inverse
from pctt.pc.positivity import CERTAIN, finds_negative, has_inertia_of
from pctt.pc.train_options import Account, Options
from pctt.tt.lowest import lowest
from pctt.tt.train import identity

SINGLE = 1e-5  # eps from which products of the inverse are made in single precision
WORTH = 0.25  # of eps: the least that is asked for to have a certificate
TIGHTER, TRIES = 0.05, 4  # eps is lowered where the train of the matrix or of its inverse is not positive


class EntriesTrain:
    """`make` a train for a matrix, multiply with it by `times`.

    compressed, inverse : of the present matrix; None before, and after a failure
    """

    def __init__(self, comm: MPI.Comm, options: Options, account: Account, prefix: str) -> None:
        self.comm, self.options, self.account, self.prefix = comm, options, account, prefix
        self.compressed: CompressedEntries | None = None
        self.inverse: ApproximateInverse | None = None

    def make(self, P: PETSc.Mat, rank: int) -> bool:
        """Make a train; False, with the reason on the account, if there is no positive inverse.

        EntriesError, ValueError, on all ranks alike, for entries or a grid that are not as they should be."""
        for eps in self.options.eps * TIGHTER ** np.arange(TRIES):
            warm = self.compressed is not None and self.options.reuse != "none"
            with PETSc.Log.Event("TTCompress"):
                self.compressed = self._compress(P, rank, eps, self.compressed if warm else None)
            if self.compressed.shift <= 0:
                return self._refuse("the mean of the diagonal is not positive")
            self.account.reused += warm
            with PETSc.Log.Event("TTInvert"):
                # every rank inverts the same train; a last bit of difference must not part their ways
                self.inverse = self.comm.bcast(self._invert(rank, eps))
                if self.inverse is not None and self._is_positive(self.inverse):
                    return True
            if self.inverse is not None and self.inverse.residual > eps:
                break  # the rank does not reach this accuracy, let alone a higher one
        return self._refuse(f"the inverse of rank {rank} is not positive")

    def _compress(self, P: PETSc.Mat, rank: int, eps: float, start: CompressedEntries | None) -> CompressedEntries:
        known = compressed(P)
        if known is not None and known.error <= eps and self.options.order in ("auto", known.order):
            return known.rounded(0.5 * eps, rank)
        name = f"-{self.prefix}pc_tt_order"
        return CompressedEntries(P, eps, rank, self.options.order, name, start, self.options.seed)

    def _invert(self, rank: int, eps: float) -> ApproximateInverse | None:
        """None where the train of the matrix is found not to be positive."""
        assert self.compressed is not None
        T = self.compressed.train
        if lowest(identity(T.rows) + T) <= 0:
            return None
        certain = CERTAIN / T.norm()
        if WORTH * eps <= certain:  # with a little more accuracy, no trial has to say that the inverse is positive
            eps = min(eps, certain)
        rng = np.random.default_rng(self.options.seed)
        return approximate_inverse(self.compressed.found, rank, eps, True, None, rng)

    def _is_positive(self, inverse: ApproximateInverse) -> bool:
        """Use I + Z, and whether it is positive: as its matrix is, if near enough to the inverse, or on trial."""
        assert self.compressed is not None
        Z, T = inverse.train, self.compressed.train
        self._product = self.compressed.product(Z.astype(np.float32) if self.options.eps >= SINGLE else Z)
        if inverse.repaired == 0 and self.comm.bcast(has_inertia_of(inverse.residual * T.norm())):
            return True
        product = self.compressed.product(T)
        count = int(self.compressed.counts[self.comm.rank])
        return not finds_negative(lambda x: x + self._product(x), lambda x: x + product(x), count, self.comm)

    def _refuse(self, why: str) -> bool:
        self.account.fallbacks.append(why)
        self.compressed = self.inverse = None
        return False

    def distrust(self) -> bool:
        """Every matrix has a train of its own."""
        return False

    def times(self, x: np.ndarray) -> np.ndarray:
        """(x + Z x) / c, this rank's part from its part."""
        assert self.compressed is not None
        return (x + self._product(x)) / self.compressed.shift

    def words(self) -> str:
        """Ranks, errors and sizes."""
        if self.inverse is None or self.compressed is None:
            return ""
        X = self.inverse.train
        return f"{self.compressed.words()}; inverse I + Z ranks {X.ranks} residual {self.inverse.residual:.2g}"
