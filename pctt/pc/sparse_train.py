"""The train of the inverse of a sparse matrix, for a sequence of matrices.

The block rows get slots and are scaled by the Cholesky factors of the diagonal blocks. The off-diagonal part is
compressed into a train T (paper, section 3), and I + T is inverted as a train. The next matrix can use the slots, the
cores and whole trains again.
"""

from __future__ import annotations

import numpy as np
from mpi4py import MPI
from numpy.typing import DTypeLike
from petsc4py import PETSc

from pctt import memory
from pctt.mat.order import Places
from pctt.mat.product import TrainProduct
from pctt.pc.ordering import block_order, grid_slots
from pctt.pc.positivity import finds_negative
from pctt.pc.refresh_schedule import RefreshSchedule
from pctt.pc.slots import Slots
from pctt.pc.slotted import CSR, SlottedMatrix
from pctt.pc.train_options import Account, Options
from pctt.tt.als import Compression, compress
from pctt.tt.cross import Cross, compress_cross
from pctt.tt.inverse import Inverse, invert, invert_near_identity
from pctt.tt.quantise import choose_modes
from pctt.tt.sparse import SparseHierarchy

LEAF = 16  # least number of blocks in the first and in the last mode
SEED = 0  # of the random starts
TABLES = 10.0  # memory that a first set-up takes, over that of the entries; measured at 142,000 contacts


class SparseTrain:
    """`make` makes a train for a matrix, `times` multiplies with it.

    inverse, compression : the inverse in use, and the newest train of a matrix; None before `make`, and after a failure
    slots, hierarchy : slots and block pairs of the present structure
    tree : slots that are kept from structure to structure
    """

    slots: SlottedMatrix
    places: Places

    def __init__(self, comm: MPI.Comm, options: Options, account: Account) -> None:
        self.comm, self.options, self.account = comm, options, account
        self._block = 0  # block size of the last structure
        self._forget_structure()
        self._forget_trains()

    def _forget_structure(self) -> None:
        self._begun = False  # whether there are slots for the present structure
        self.hierarchy: SparseHierarchy | None = None

    def _forget_trains(self) -> None:
        self.tree: Slots | None = None
        self.compression: Compression | Cross | None = None
        self.inverse: Inverse | None = None
        self._opening: Inverse | None = None  # the inverse for the first matrix of a structure
        self._cap = 0  # of the ranks of these
        self._schedule = RefreshSchedule()
        self._product: TrainProduct | None = None

    def begin(self, P: PETSc.Mat, places: Places) -> None:
        """Begin a new structure; ValueError on all ranks if it lacks what the order needs."""
        grid_slots(P, places, self.options.order)
        block_order(P, places, self.options.order)
        self.places = places
        self._forget_structure()
        if self.options.reuse not in ("steps", "trains") or P.getBlockSize() != self._block:
            self._forget_trains()
        self._block = P.getBlockSize()

    def make(self, P: PETSc.Mat, rank: int) -> bool:
        """Keep the train or make a new one.

        If there is no positive inverse, return False and write the reason to the account.
        """
        if self.options.reuse == "none":
            self._forget_structure()
            self._forget_trains()
        first = not self._begun
        if first:
            if not self._fits(P):
                return self._refuse("there is no memory for the tables of a train")
            self._take_slots(P)
        try:
            self.slots.scale(P)
            singular = False
        except np.linalg.LinAlgError:
            singular = True
        if self.comm.allreduce(singular, op=MPI.LOR):
            return self._refuse("a diagonal block is not positive definite")
        if self._cap != rank:
            self.compression = self.inverse = self._opening = None
            self._cap = rank
        kept = (self._opening if first else self.inverse) if self.options.reuse == "trains" else None
        if kept is not None and not self._schedule.over():
            self._use(kept)
            self.account.kept += 1
        elif not self._try_new(P, rank, kept):
            return False
        if first:
            self._opening = self.inverse
        return True

    def _fits(self, P: PETSc.Mat) -> bool:
        """Whether the memory has room for the tables of a new structure; collective."""
        entries = self.comm.allreduce(8.0 * P.getInfo(PETSc.Mat.InfoType.LOCAL)["nz_used"], op=MPI.MAX)
        return TABLES * entries < memory.available(self.comm)

    def _try_new(self, P: PETSc.Mat, rank: int, kept: Inverse | None) -> bool:
        """Make a train for P and use it, or use the kept train if it is as good; False if no train is positive."""
        csr = P.getValuesCSR()
        if not self._all(bool(np.isfinite(csr[2]).all())):
            return self._refuse("the matrix has entries that are no numbers")
        if self.hierarchy is None or not self.slots.lists(csr):
            with PETSc.Log.Event("TTBuild"):
                self.hierarchy = self._block_pairs(csr)
        self.hierarchy.set_values(self.slots.load(P, csr))
        warm = self.compression is not None
        with PETSc.Log.Event("TTCompress"):
            self.compression = self._compress(rank, warm)
        with PETSc.Log.Event("TTInvert"):
            # every rank inverts the same train, but results may differ in the last bit: all take the first rank's
            new = self.comm.bcast(self._invert(rank, warm))
            self._use(new)
            positive = self._is_positive(P)
        self.account.reused += warm
        if kept is None:
            self._schedule = RefreshSchedule()
            return positive or self._refuse(f"the inverse of rank {rank} is not positive")
        left = []
        for inverse in (kept, new):
            self._use(inverse)
            left.append(self._left(P) if positive or inverse is kept else np.inf)
        if not self._schedule.decide(*self.comm.bcast(left)):
            self._use(kept)
            self.account.kept += 1
        return True

    def _is_positive(self, P: PETSc.Mat) -> bool:
        """Whether the train in use is positive, as far as a test with the symmetric part of P shows."""
        x, y = P.createVecs()

        def times(v: np.ndarray) -> np.ndarray:
            x.array_w[:] = v
            P.mult(x, y)
            product = y.array_r.copy()
            P.multTranspose(x, y)
            return 0.5 * (product + y.array_r)

        found = finds_negative(self.times, times, x.getLocalSize(), self.comm)
        x.destroy()
        y.destroy()
        return not found

    def _left(self, P: PETSc.Mat) -> float:
        """||w - S X w|| / ||w|| for a random vector w, where S is the scaled matrix."""
        slots = self.slots
        x, y = P.createVecs()
        w = np.random.default_rng(SEED).standard_normal(x.getLocalSize())
        x.array_w[:] = slots.unscaled(self._inverse_times(w))
        P.mult(x, y)
        left = w - slots.scaled_vector(y.array_r)
        squares = self.comm.allreduce(np.array([left @ left, w @ w]))
        x.destroy()
        y.destroy()
        return float(np.sqrt(squares[0] / squares[1]))

    def _take_slots(self, P: PETSc.Mat) -> None:
        """Give slots to P's block rows; use those of the last structure if they fit."""
        if self.tree is not None and not self.tree.follow(P, self.places, self._all):
            self.account.resets += 1
            self._forget_trains()
        if self.tree is None:
            self.tree = Slots(P, self.places, LEAF, self.options.order)
        self.slots = SlottedMatrix(P, self.tree, self.comm, self.options.scaling == "block")
        self._begun = True
        self._product = None  # rows have other slots

    def _block_pairs(self, csr: CSR) -> SparseHierarchy:
        assert self.tree is not None
        slots = self.slots
        slots.list_blocks(csr)
        modes = self.tree.modes or choose_modes(slots.size, LEAF)
        return SparseHierarchy(slots.rows, slots.columns, modes, slots.block, self._add, self.comm.bcast)

    def _compress(self, rank: int, warm: bool) -> Compression | Cross:
        assert self.hierarchy is not None
        options, rng = self.options, np.random.default_rng(SEED)
        if options.compress == "cross":
            start = self.compression if warm and isinstance(self.compression, Cross) else None
            return compress_cross(self.hierarchy, rank, options.eps, start, rng=rng)
        train = self.compression.train if warm and self.compression is not None else None
        return compress(self.hierarchy, rank, options.eps, train, rng=rng)

    def _invert(self, rank: int, warm: bool) -> Inverse:
        assert self.compression is not None
        options, rng = self.options, np.random.default_rng(SEED)
        start = self.inverse.applied if warm and self.inverse is not None else None
        method = invert_near_identity if options.scaling == "block" else invert  # block scaling has unit blocks
        return method(self.compression.train, rank, start, eps=options.eps, rng=rng)

    def _refuse(self, why: str) -> bool:
        self.account.fall_back(why)
        self.compression = self.inverse = None
        return False

    # -- application ----------------------------------------------------------------------------------------

    def _use(self, inverse: Inverse) -> None:
        self.inverse = inverse
        if self._product is None:
            self._product = self.slots.product(inverse.applied)
        else:
            self._product.set_train(inverse.applied)

    def use(self, dtype: DTypeLike) -> None:
        """Multiply in this precision."""
        assert self._product is not None
        self._product.use(dtype)

    @property
    def flops(self) -> int:
        """Operations of this rank in `times`."""
        assert self._product is not None
        return self._product.flops + 4 * self.slots.root.size

    def distrust(self) -> bool:
        """Whether a train of an earlier matrix is in use. If so, the next set-up tries another train."""
        if self._schedule.served:
            self._schedule.lose()
            return True
        return False

    def times(self, x: np.ndarray) -> np.ndarray:
        """This rank's part of L^-T X L^-1 x, from its part of x."""
        return self.slots.unscaled(self._inverse_times(self.slots.scaled_vector(x)))

    def _inverse_times(self, x: np.ndarray) -> np.ndarray:
        """This rank's part of X x, from its part of x."""
        assert self.inverse is not None
        assert self._product is not None
        product = self._product(x)
        return x + product if self.inverse.identity else product

    def _all(self, here: bool) -> bool:
        return bool(self.comm.allreduce(here, op=MPI.LAND))

    def _add(self, x: np.ndarray) -> np.ndarray:
        if self.comm.size > 1:
            out = np.empty(x.shape, x.dtype)
            self.comm.Allreduce(np.ascontiguousarray(x), out)
            return out
        return x

    def words(self) -> str:
        """Ranks, errors and sizes."""
        if self.inverse is None or self.compression is None:
            return ""
        T, X = self.compression.train, self.inverse.applied
        form = "I + Z" if self.inverse.identity else "X"
        return (
            f"modes {'x'.join(map(str, T.rows))}, matrix ranks {T.ranks} error {self.compression.error:.2g}, inverse "
            f"{form} ranks {X.ranks} residual {self.inverse.residual:.2g}, {X.storage} numbers"
        )
