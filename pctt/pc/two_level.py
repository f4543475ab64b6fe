"""``-pc_type python -pc_python_type pctt.pc.TwoLevel``: block Jacobi and a coarse space on boxes of block rows.

The block rows (bodies) are divided into boxes by recursive bisection of their places. On each box the coarse space has
the restriction of the Mat's near null space (``MatSetNearNullSpace``: for the body system the rigid motions, which
`BodyMatrix` provides), or the constants where it has none. With Z their orthonormal columns, D the block diagonal,
Q = Z C Z' and C an inverse of Z' A Z, exact or a tensor train,

    additive   M = D^-1 + Q,
    balanced   M = Q + (I - Q A) D^-1 (I - A Q)                       (Mandel 1993; positive for any positive C).

The first rank inverts Z' A Z; an application sends it a coarse vector and gets one back (balanced: two).
"""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from petsc4py import PETSc

from pctt.block_diagonal import block_diagonal
from pctt.ksp_options import entered, prefer_mumps, to_enter
from pctt.options import AT_LEAST_ONE, option
from pctt.pc.base import PythonPC
from pctt.pc.mat import check_coordinates
from pctt.pc.ordering import block_order
from pctt.pc.second_solve import solve_again

DEPENDENT = 1e-8  # part of the largest: modes of a box with smaller Gram eigenvalues depend on the others


@dataclass(frozen=True)
class Options:
    """Options ``-pc_two_*``, behind the prefix of the PC. The coarse PC has the further prefix ``two_coarse_``."""

    boxes: int = option(256, "number of boxes, rounded down to a power of two", check=AT_LEAST_ONE)
    coarse: str = option(
        "lu", "inverse of the coarse matrix: tt: a tensor train; lu: Cholesky factors", choices=("tt", "lu")
    )
    rank: int = option(10, "rank of the train; 1: block Jacobi of the coarse matrix", check=AT_LEAST_ONE)
    correction: str = option(
        "additive",
        "additive: one product with the coarse inverse; balanced: two, before and after block Jacobi",
        choices=("additive", "balanced"),
    )


class TwoLevel(PythonPC):
    """The python PC; see the module and ``Options``. For symmetric positive definite Mats of any block size."""

    options_class = Options
    options_prefix = "pc_two_"
    options: Options

    def create(self, pc: PETSc.PC) -> None:
        super().create(pc)
        self.coarse: PETSc.PC | None = None
        self._coarse_mat: PETSc.Mat | None = None
        self._diagonal: PETSc.Mat | None = None  # what block Jacobi is made from
        self.boxes = self.width = 0
        self._space: list = []  # PETSc objects of the coarse space
        self._values: list = []  # PETSc objects that hold values of the matrix
        self._setup_s = 0.0
        self._indefinite = False  # the train was, in a solve

    def build(self, pc: PETSc.PC, P: PETSc.Mat) -> None:
        """Boxes and coarse space."""
        self.release()
        self.comm = P.comm.tompi4py()
        check_coordinates(P)
        self.block = P.getBlockSize()
        self._points = _everywhere(self.comm, _places(P))
        self._box = bisect(self._points, self.options.boxes)
        self.boxes = int(self._box.max()) + 1
        centres = np.zeros((self.boxes, self._points.shape[1]))
        np.add.at(centres, self._box, self._points)
        self._centres = centres / np.bincount(self._box)[:, None]
        self._first = P.getOwnershipRange()[0] // self.block
        self._own = slice(self._first, self._first + P.getLocalSize()[0] // self.block)
        self._make_space(_modes(P, self.block))

    def _make_space(self, modes: np.ndarray) -> None:
        """Z from the modes (n, bs, k) of this rank's block rows: orthonormal on each box, zero where dependent."""
        box, k = self._box[self._own], modes.shape[2]
        gram = np.zeros((self.boxes, k, k))
        np.add.at(gram, box, modes.transpose(0, 2, 1) @ modes)
        gram = self._sum(gram)
        value, vector = np.linalg.eigh(gram)
        kept = value > DEPENDENT * value[:, -1:]
        vector *= np.where(kept, 1.0 / np.sqrt(np.where(kept, value, 1.0)), 0.0)[:, None, :]
        self.width = k
        self._missing = ~kept
        local = modes @ vector[box]
        everywhere = _everywhere(self.comm, local)
        self._Z = _one_per_row(local, box, self.boxes)
        self._Z_all = _one_per_row(everywhere, self._box, self.boxes)
        self._prolong = _mat(self._Z)
        self._coarse_x, self._fine = self._prolong.createVecs()
        self._coarse_b = self._coarse_x.duplicate()
        self._jacobi = PETSc.PC().create(self.comm)
        self._jacobi.setType(PETSc.PC.Type.PBJACOBI)
        self._space = [self._prolong, self._coarse_x, self._coarse_b, self._fine, self._jacobi]

    def update(self, pc: PETSc.PC, P: PETSc.Mat) -> None:
        """Block diagonal and coarse inverse."""
        start = time.perf_counter()
        old, self._diagonal = self._diagonal, block_diagonal(P)
        self._jacobi.setOperators(self._diagonal)
        self._jacobi.setUp()
        if old is not None:
            old.destroy()
        indptr, indices, values = P.getValuesCSR()
        rows = sp.csr_matrix((values, indices, indptr), shape=(len(indptr) - 1, P.getSize()[1]))
        product = rows.tobsr((self.block, self.block)) @ self._Z_all
        if self.options.correction == "balanced":
            self._forget_values()
            self._AZ = _mat(product)
            self._residual, self._smooth = P.createVecs()
            self._values = [self._AZ, self._residual, self._smooth]
        own = sp.bsr_matrix(self._Z.T @ product)
        parts = self.comm.allgather(own) if self.comm.size > 1 else [own]
        matrix = sum(parts[1:], parts[0]) + sp.diags(self._missing.ravel().astype(float))
        self._matrix = sp.bsr_matrix(matrix, blocksize=(self.width, self.width))
        self._invert(self._matrix)
        self._setup_s = time.perf_counter() - start

    def _invert(self, matrix: sp.bsr_matrix) -> None:
        """The inverse of the coarse matrix, on the first rank: made by several, it might differ between them."""
        failure = None
        if self.comm.rank == 0:
            try:
                self._invert_here(matrix)
            except (PETSc.Error, ValueError) as error:
                failure = error
        failure = self.comm.bcast(str(failure) if failure else "")
        if failure:
            raise ValueError(f"{self.name}: the coarse matrix: {failure}")

    def _invert_here(self, matrix: sp.bsr_matrix) -> None:
        if self.coarse is None:
            self.coarse = self._coarse_pc()
        if self._coarse_mat is not None:
            self._coarse_mat.destroy()
        self._coarse_mat = _mat(matrix)
        self._coarse_mat.setBlockSize(self.width)
        self._coarse_mat.setOption(PETSc.Mat.Option.SYMMETRIC, True)
        self._coarse_mat.setAttr("coordinates", self._centres)
        self.coarse.setOperators(self._coarse_mat)
        self.coarse.setUp()

    def _coarse_pc(self) -> PETSc.PC:
        pc = PETSc.PC().create(PETSc.COMM_SELF)
        prefix = f"{self.prefix}two_coarse_"
        pc.setOptionsPrefix(prefix)
        if not self._by_train:
            pc.setType(PETSc.PC.Type.CHOLESKY)
            prefer_mumps(pc, "cholesky")
            pc.setFromOptions()
            return pc
        pc.setType(PETSc.PC.Type.PYTHON)
        pc.setPythonType("pctt.pc.TensorTrain")
        with entered(to_enter(prefix, {"pc_tt_rank": "fixed", "pc_tt_max_rank": str(self.options.rank)}, ranks=1)):
            pc.setFromOptions()
        return pc

    # -- application ----------------------------------------------------------------------------------------

    def apply(self, pc: PETSc.PC, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """y = M x."""
        self._fine.array_w[:] = x.array_r
        self._correct(self._prolong)
        if self.options.correction == "additive":
            self._jacobi.apply(x, y)
            self._prolong.mult(self._coarse_x, self._fine)
            y.array_w[:] += self._fine.array_r
            return
        self._AZ.mult(self._coarse_x, self._fine)
        np.subtract(x.array_r, self._fine.array_r, out=self._residual.array_w)
        self._prolong.mult(self._coarse_x, self._fine)
        y.array_w[:] = self._fine.array_r
        self._jacobi.apply(self._residual, self._smooth)
        y.axpy(1.0, self._smooth)
        self._fine.array_w[:] = self._smooth.array_r
        self._correct(self._AZ)
        self._prolong.mult(self._coarse_x, self._fine)
        y.array_w[:] -= self._fine.array_r

    def _correct(self, restrict: PETSc.Mat) -> None:
        """coarse_x = C R' fine, R this rank's rows of Z or of A Z."""
        restrict.multTranspose(self._fine, self._coarse_b)
        if self.comm.size > 1:
            part = self._coarse_b.array_r.copy()
            self.comm.Reduce(part, self._coarse_b.array_w if self.comm.rank == 0 else None)
        if self.coarse is not None:
            self.coarse.apply(self._coarse_b, self._coarse_x)
        if self.comm.size > 1:
            self.comm.Bcast(self._coarse_x.array_w)

    @property
    def _by_train(self) -> bool:
        return self.options.coarse == "tt" and not self._indefinite

    def postSolve(self, pc: PETSc.PC, ksp: PETSc.KSP, b: PETSc.Vec, x: PETSc.Vec) -> None:
        """A solve that a train has spoilt is made again with block Jacobi; from now on there are Cholesky factors in
        its place."""
        if self._by_train and solve_again(ksp, block_diagonal, self.P, b, x):
            self._indefinite = True
            if self.coarse is not None:
                self.coarse.destroy()
                self.coarse = None
            self._invert(self._matrix)

    def _sum(self, x: np.ndarray) -> np.ndarray:
        if self.comm.size == 1:
            return x
        out = np.empty_like(x)
        self.comm.Allreduce(np.ascontiguousarray(x), out)
        return out

    def report(self) -> list[str]:
        lines = [
            f"two levels: {self.boxes} boxes, {self.width} modes each, {self.options.correction}, coarse "
            f"{self.options.coarse}, set up in {self._setup_s:.2e} s"
        ]
        if self._indefinite:
            lines.append("fell back: the train was not positive; Cholesky factors in its place")
        if self.coarse is not None and self._by_train:
            lines += [f"  {line}" for line in self.coarse.getPythonContext().report()]
        return lines

    def _forget_values(self) -> None:
        for thing in self._values:
            thing.destroy()
        self._values = []

    def release(self) -> None:
        self._forget_values()
        own = (self.coarse, self._coarse_mat, self._diagonal)
        for thing in (*own, *self._space):
            if thing is not None:
                thing.destroy()
        self.coarse = self._coarse_mat = self._diagonal = None
        self._space = []


def bisect(points: np.ndarray, boxes: int) -> np.ndarray:
    """Box of each point (n,): halves of equal number along the longest side, until there are at most ``boxes``.

    >>> bisect(np.array([[0.0], [3.0], [1.0], [2.0]]), 2)
    array([0, 1, 0, 1])
    """
    count = len(points)
    order, starts = np.arange(count), np.array([0])
    while 2 * len(starts) <= min(boxes, count):
        sizes = np.diff(starts, append=count)
        sorted_points = points[order]
        sides = np.maximum.reduceat(sorted_points, starts) - np.minimum.reduceat(sorted_points, starts)
        box = np.repeat(np.arange(len(starts)), sizes)
        along = sorted_points[np.arange(count), sides.argmax(axis=1)[box]]
        order = order[np.lexsort((along, box))]
        starts = np.sort(np.concatenate([starts, starts + sizes // 2]))
    place = np.empty(count, np.int64)
    place[order] = np.repeat(np.arange(len(starts)), np.diff(starts, append=count))
    return place


def _places(P: PETSc.Mat) -> np.ndarray:
    """A place (n, d) of each of this rank's block rows; without coordinates, their number in an order of the matrix."""
    points = P.getAttr("coordinates")
    if points is None:
        return (P.getOwnershipRange()[0] // P.getBlockSize() + block_order(P)).astype(float)[:, None]
    return np.asarray(points, dtype=float).reshape(P.getLocalSize()[0] // P.getBlockSize(), -1)


def _modes(P: PETSc.Mat, block: int) -> np.ndarray:
    """The near null space (n, bs, k) of this rank's block rows; without one, the constants (k = bs)."""
    near = P.getNearNullSpace()
    vectors = near.getVecs() if near.handle else []
    if not vectors:
        return np.tile(np.eye(block), (P.getLocalSize()[0] // block, 1, 1))
    return np.stack([v.array_r.reshape(-1, block) for v in vectors], axis=2)


def _one_per_row(blocks: np.ndarray, column: np.ndarray, columns: int) -> sp.bsr_matrix:
    count, rows, width = blocks.shape
    return sp.bsr_matrix((blocks, column, np.arange(count + 1)), shape=(count * rows, columns * width))


def _mat(matrix: sp.spmatrix) -> PETSc.Mat:
    """A sequential AIJ Mat."""
    rows = matrix.tocsr()
    rows.sort_indices()
    csr = (rows.indptr.astype(PETSc.IntType), rows.indices.astype(PETSc.IntType), rows.data)
    return PETSc.Mat().createAIJ(rows.shape, csr=csr, comm=PETSc.COMM_SELF)


def _everywhere(comm, rows: np.ndarray) -> np.ndarray:
    """Rows (n, ...) of all ranks, in their order."""
    return np.concatenate(comm.allgather(rows)) if comm.size > 1 else rows
