"""The train of the inverse of a sparse matrix, for a sequence of matrices.

The block rows get slots and are scaled by the Cholesky factors of the diagonal blocks. The off-diagonal part is
compressed into a train T (paper, section 3), and I + T is inverted as a train. The next matrix can use the slots, the
cores and whole trains again.

Scaled by its own diagonal blocks, the matrix of the next Newton step or time step is similar to the last one. So the
train of the last matrix is often as good as a new one, and costs nothing: with -pc_tt_reuse trains it is kept. A new
one is tried after 2 set-ups, and then after twice as many each time, as long as this gains nothing.
"""

from __future__ import annotations

from functools import partial

import numpy as np
from mpi4py import MPI
from numpy.typing import DTypeLike
from petsc4py import PETSc

from dem.exchange import on_all, on_first, summed
from pctt import memory
from pctt.blocks import symmetric_shell
from pctt.mat.grid_train import TrainProduct
from pctt.mat.order import Places, chosen_order
from pctt.pc.mat import finds_negative, is_symmetric, null_vectors
from pctt.pc.options import Account, Options
from pctt.pc.slots import Slots, SlottedMatrix
from pctt.tt.cross import Cross, compress_cross
from pctt.tt.inverse import Inverse, invert, invert_near_identity
from pctt.tt.quantise import choose_modes
from pctt.tt.sparse import Compression, SparseHierarchy, compress
from pctt.tt.train import Array, Train, decompose, identity

LEAF = 16  # least number of blocks in the first and in the last mode


class SparseTrain:
    """`make` makes a train for a matrix, `times` multiplies with it.

    inverse, compression : the inverse in use, and the newest train of a matrix; None before `make`, and after a failure
    order : of the rows
    slots, hierarchy : slots and block pairs of the present structure; None before a train is made for it
    tree : slots that are kept from structure to structure
    rank : cap of the ranks
    failure : why a train that was asked for is not used; the next matrix is tried again. With reuse the intervals
        between trials double until the next structure
    """

    note, base, cost_estimate = "", "block Jacobi", None
    single_pays = False
    _product: TrainProduct  # of the inverse in use

    def __init__(self, comm: MPI.Comm, options: Options, account: Account, prefix: str) -> None:
        self.comm, self.options, self.account = comm, options, account
        self._named = f"-{prefix}pc_tt_"  # how the names of the options begin
        self.rank = 1 if options.automatic else int(options.rank)
        self._block = 0  # block size of the last structure
        self.symmetric, self.failure = True, ""
        self._pause = self._waits = 0  # set-ups without a trial after the last refusal, and those that are left of them
        self._forget_trains()

    @property
    def idle(self) -> dict[str, str]:
        """Options that have no effect, and why."""
        if self.rank == 1:
            why = f"a sparse matrix has no train unless {self._named}rank asks for one"
            return dict.fromkeys(("eps", "variant", "order", "setup_limit"), why)
        return {"setup_limit": "it is for matrices given by their entries"}

    def _forget_structure(self) -> None:
        self.slots: SlottedMatrix | None = None
        self.hierarchy: SparseHierarchy | None = None

    def _forget_trains(self) -> None:
        self._forget_structure()
        self.tree: Slots | None = None
        self.compression: Compression | Cross | None = None
        self.inverse: Inverse | None = None
        self._opening: Inverse | None = None  # the inverse for the first matrix of a structure
        self._age, self._trial = 0, 2  # set-ups since a train was new, and the one at which another is tried

    def begin(self, P: PETSc.Mat, places: Places) -> None:
        """Begin a new structure; ValueError on all ranks if it lacks what the order needs."""
        keyed = P.getAttr("key") is not None
        self.order = chosen_order(self.options.order, places, f"{self._named}order", stored=True, keyed=keyed)
        self.places, self.failure = places, ""
        self._pause = self._waits = 0
        self._forget_structure()
        if self.options.reuse == "none" or P.getBlockSize() != self._block:
            self._forget_trains()
        self._block = P.getBlockSize()

    def make(self, A: PETSc.Mat, P: PETSc.Mat) -> bool:
        """Keep the train or make a new one; False if there is none, and `failure` says why."""
        if self.rank == 1:
            return False
        if self.failure and self._waits > 0:
            self._waits -= 1
            return False
        self.failure = ""
        norm = P.norm(PETSc.NormType.FROBENIUS)  # which may overflow
        if not np.isfinite(norm) and not on_all(self.comm, np.isfinite(P.getValuesCSR()[2]).all()):
            return self._refuse("the matrix has entries that are NaN or infinite")
        self.symmetric = is_symmetric(P)
        if self.options.reuse == "none":
            self.compression = self.inverse = self._opening = None
        first = self.slots is None
        if first:
            # a first set-up takes ten times the memory of the entries; measured at 142,000 contacts
            needed = 80.0 * self.comm.allreduce(P.getInfo(PETSc.Mat.InfoType.LOCAL)["nz_used"], op=MPI.MAX)
            if needed >= memory.available(self.comm):
                return self._refuse("there is no memory for the tables of a train")
        slots = self.slots = self._slots_of(P) if self.slots is None else self.slots
        if not slots.scale(P):
            return self._refuse("a diagonal block is not positive definite")
        kept = (self._opening if first else self.inverse) if self.options.reuse == "trains" else None
        self._age += 1
        if kept is not None and self._age < self._trial:
            self._use(kept)
            self.account.kept += 1
        elif not self._try_new(A, P, slots, kept):
            return False
        if first:
            self._opening = self.inverse
        return True

    def _slots_of(self, P: PETSc.Mat) -> SlottedMatrix:
        """The slots of P's block rows; those of the last structure if they fit."""
        if self.tree is not None and not self.tree.follow(P, self.places):
            self.account.resets += 1
            self._forget_trains()
        if self.tree is None:
            self.tree = Slots(P, self.places, LEAF, self.order)
        slots = SlottedMatrix(P, self.tree, self.comm, self.options.scaled)
        self._product = slots.product()
        return slots

    def _try_new(self, A: PETSc.Mat, P: PETSc.Mat, slots: SlottedMatrix, kept: Inverse | None) -> bool:
        """Make a train for P and use it, or use the kept train if it is as good; False if no train is positive."""
        csr = P.getValuesCSR()
        if self.hierarchy is None or not slots.lists(csr):
            with PETSc.Log.Event("TTBuild"):
                slots.list_blocks(csr)
                modes = slots.modes or choose_modes(slots.size, LEAF)
                self.hierarchy = SparseHierarchy(
                    slots.rows, slots.columns, modes, slots.block, partial(summed, self.comm), self.comm.bcast
                )
        self.hierarchy.set_values(slots.load(P, csr))
        warm = self.compression is not None
        with PETSc.Log.Event("TTCompress"):
            self.compression = self._compress(warm)
        with PETSc.Log.Event("TTInvert"):
            null = [slots.spread(slots.images(v)) for v in null_vectors(A, P)]
            new = on_first(self.comm, lambda: self._invert(warm, null))
            self._use(new)
            positive = self._is_positive(P)
        self.account.reused += warm
        if not positive and kept is None:
            return self._refuse(f"the inverse of rank {self.rank} is not positive")
        if kept is not None:
            news = self._left(P, slots) if positive else np.inf
            self._use(kept)
            if news * 1.1 >= self._left(P, slots):  # it gains less than 10 %; False if the kept train leaves no number
                self._trial = 2 * self._age + 1
                self.account.kept += 1
                return True
            self._use(new)
        self._age, self._trial = 0, 2
        return True

    def _compress(self, warm: bool) -> Compression | Cross:
        assert self.hierarchy is not None
        eps, rng = self.options.eps, np.random.default_rng(self.options.seed)
        last = self.compression if warm else None
        if self.options.by_cross:
            assert last is None or isinstance(last, Cross)
            return compress_cross(self.hierarchy, self.rank, eps, last, rng=rng)
        return compress(self.hierarchy, self.rank, eps, last.train if last else None, rng=rng)

    def _invert(self, warm: bool, null: list[Array]) -> Inverse:
        """The inverse of the train, plus the projections on these vectors of its null space, which would spoil it."""
        assert self.compression is not None
        train = self.compression.train
        if null:
            unit = 1.0 if self.options.scaled else abs(train.inner(identity(train.rows))) / np.prod(train.rows)
            for v in null:
                train = train + float(unit) * _projection(v, train.rows)
            train = train.round(0.1 * self.options.eps)
        start = self.inverse.applied if warm and self.inverse is not None else None
        method = invert_near_identity if self.options.scaled else invert  # block scaling has unit blocks
        rng = np.random.default_rng(self.options.seed)
        return method(train, self.rank, start, eps=self.options.eps, rng=rng)

    def _is_positive(self, P: PETSc.Mat) -> bool:
        """Whether the train in use is positive, as far as a test shows."""

        def times(x: Array, out: Array) -> None:
            out[:] = self.times(x)

        X = symmetric_shell(self.comm, P.getLocalSize()[0], 1, times)
        negative = finds_negative(X, P)
        X.destroy()
        return not negative

    def _left(self, P: PETSc.Mat, slots: SlottedMatrix) -> float:
        """||w - S X w|| / ||w|| for a random vector w, where S is the scaled matrix; the same on all ranks."""
        x, y = P.createVecs()
        w = np.random.default_rng(self.options.seed).standard_normal(x.getLocalSize())
        x.array_w[:] = slots.unscaled(self._inverse_times(w))
        P.mult(x, y)
        left = w - slots.scaled_vector(y.array_r)
        squares = self.comm.allreduce(np.array([left @ left, w @ w]))
        return float(self.comm.bcast(np.sqrt(squares[0] / squares[1])))

    def _refuse(self, why: str) -> bool:
        self.account.fall_back(why)
        self.failure = why
        self.compression = self.inverse = self._opening = None
        self._wait()
        return False

    def _wait(self) -> None:
        """Try no train for the next matrices of a sequence of similar ones, each time for twice as many."""
        if self.options.reuse != "none":
            self._pause = self._waits = 2 * self._pause + 1

    # -- application ----------------------------------------------------------------------------------------

    def _use(self, inverse: Inverse) -> None:
        self.inverse = inverse
        self._product.set_train(inverse.applied)

    def use(self, dtype: DTypeLike) -> None:
        """Multiply in this precision."""
        self._product.use(dtype)

    @property
    def flops(self) -> int:
        """Operations of this rank in `times`."""
        assert self.slots is not None
        return self._product.flops + 4 * self.slots.root.size

    def note_failure(self, why: str) -> None:
        """A solve failed: the next set-up tries another train; with reuse a later one, if this one was new."""
        if self._age:
            self._trial = 0
        else:
            self.failure = why
            self._wait()

    def times(self, x: Array) -> Array:
        """This rank's part of L^-T X L^-1 x, from its part of x."""
        assert self.slots is not None
        return self.slots.unscaled(self._inverse_times(self.slots.scaled_vector(x)))

    def _inverse_times(self, x: Array) -> Array:
        """This rank's part of X x, from its part of x."""
        assert self.inverse is not None
        product = self._product(x)
        return x + product if self.inverse.identity else product

    @property
    def left(self) -> float:
        """What the trains leave of the matrix or of the residual, the larger part; 0 without trains."""
        if self.compression is None or self.inverse is None:
            return 0.0
        return max(self.compression.error, self.inverse.residual)

    def words(self) -> str:
        """Ranks, errors and sizes."""
        if self.inverse is None or self.compression is None:
            return ""
        T, X = self.compression.train, self.inverse.applied
        form = "I + Z" if self.inverse.identity else "X"
        return (
            f"{'scaled' if self.options.scaled else 'not scaled'}, modes {'x'.join(map(str, T.rows))}, "
            f"matrix ranks {T.ranks} error {self.compression.error:.2g}, "
            f"inverse {form} ranks {X.ranks} residual {self.inverse.residual:.2g}, "
            f"{X.storage} numbers"
        )


def _projection(v: Array, modes: tuple[int, ...]) -> Train:
    """v v' / v'v as a train, with an error of 1e-3."""
    column = decompose(v / np.linalg.norm(v), 1e-3, modes=modes)
    matrix = Train([core[:, :, None] for core in column.cores])
    return matrix @ matrix.T
