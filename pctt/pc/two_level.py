"""``-pc_type python -pc_python_type pctt.pc.TwoLevel``: block Jacobi and a coarse space on boxes of block rows.

Recursive bisection of their places divides the block rows (bodies) into boxes. On each box the coarse space has the
restriction of the Mat's near null space (``MatSetNearNullSpace``). For the body system these are the rigid motions,
which `BodyMatrix` provides. A Mat without near null space gets the constants. With the orthonormal columns Z of the
coarse space and the block diagonal D of A,

    M = D^-1 + Z (Z' A Z)^-1 Z'.

PETSc's multigrid with two levels applies M. It has its usual options with the additional prefix ``two_``, for example
``-two_pc_mg_type multiplicative -two_mg_levels_ksp_type chebyshev``, or another ``-two_mg_coarse_pc_type``.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from pctt.block_diagonal import block_diagonal
from pctt.ksp_options import entered, to_enter
from pctt.options import AT_LEAST_ONE, option
from pctt.pc.base import PythonPC
from pctt.pc.mat import check_coordinates
from pctt.pc.ordering import block_order

DEPENDENT = 1e-8  # modes of a box whose Gram eigenvalues are below this part of the largest depend on the others

#: Options of the multigrid: one application of block Jacobi, and factors of the coarse matrix, all on the first rank.
DEFAULTS = {
    "pc_mg_type": "additive",
    "mg_levels_ksp_type": "preonly",
    "mg_levels_pc_type": "pbjacobi",
    "mg_coarse_ksp_type": "preonly",
    "mg_coarse_pc_type": "bjacobi",
    "mg_coarse_sub_pc_type": "cholesky",
    "mg_coarse_sub_pc_factor_shift_type": "nonzero",  # a pivot counts as zero relative to its row, not to 1
}


@dataclass(frozen=True)
class Options:
    """Options ``-pc_two_*``, after the prefix of the PC."""

    boxes: int = option(256, "number of boxes, rounded down to a power of two", check=AT_LEAST_ONE)


class TwoLevel(PythonPC):
    """The python PC; see the module and ``Options``. For symmetric positive definite Mats of any block size."""

    options_class = Options
    options_prefix = "pc_two_"
    options: Options

    def create(self, pc: PETSc.PC) -> None:
        super().create(pc)
        self._own: list = []  # PETSc objects that depend on the structure only
        self._values: list = []  # PETSc objects that depend on the values

    def build(self, pc: PETSc.PC, P: PETSc.Mat) -> None:
        """Make the boxes, the coarse space and the multigrid."""
        self.release()
        check_coordinates(P)
        comm = P.comm.tompi4py()
        points = _places(P)
        modes = _modes(P)
        self.modes = modes.shape[2]
        # fewer columns than rows: by the shape of Z PETSc tells interpolation from restriction
        most = min(self.options.boxes, (P.getSize()[0] - 1) // self.modes)
        self.multigrid = PETSc.PC().create(P.comm)
        self.multigrid.setOptionsPrefix((pc.getOptionsPrefix() or "") + "two_")
        self._own = [self.multigrid]
        if most < 1:  # a matrix of a few rows
            self.boxes = 0
            self.multigrid.setType(PETSc.PC.Type.PBJACOBI)
            return
        box = bisect(np.concatenate(comm.allgather(points)), most)
        first = P.getOwnershipRange()[0] // P.getBlockSize()
        self.boxes = int(box.max()) + 1
        self._Z, self._dependent = coarse_space(comm, modes, box[first : first + len(points)], self.boxes)
        self.multigrid.setType(PETSc.PC.Type.MG)
        self.multigrid.setMGLevels(2)
        self.multigrid.setMGInterpolation(1, self._Z)
        self._own.append(self._Z)

    def update(self, pc: PETSc.PC, P: PETSc.Mat) -> None:
        """Compute the block diagonal and the coarse matrix."""
        old = self._values
        jacobi = block_diagonal(P)
        self._values = [jacobi]
        self.multigrid.setOperators(P, jacobi)
        if self.boxes:
            self._values.append(self._set_levels(P, jacobi))
        for thing in old:
            thing.destroy()

    def _set_levels(self, P: PETSc.Mat, jacobi: PETSc.Mat) -> PETSc.Mat:
        """Give the levels their matrices; the coarse one is returned."""
        # a copy, because PETSc has no such product for block formats, and its conversion counts as a change of P
        rows = PETSc.Mat().createAIJ(P.getSizes(), csr=P.getValuesCSR(), comm=P.comm)
        coarse = rows.ptap(self._Z)
        rows.destroy()
        coarse.setOption(PETSc.Mat.Option.NEW_NONZERO_ALLOCATION_ERR, False)  # P need not store its diagonal
        diagonal = coarse.getDiagonal()
        diagonal.array[:] += self._dependent
        coarse.setDiagonal(diagonal)
        diagonal.destroy()
        self.multigrid.getMGSmoother(1).setOperators(P, jacobi)
        self.multigrid.getMGCoarseSolve().setOperators(coarse)
        prefix = self.multigrid.getOptionsPrefix()
        with entered(to_enter(prefix, DEFAULTS, P.comm.size)):
            self.multigrid.setFromOptions()
            self.multigrid.setUp()
        return coarse

    def multiply(self, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """y = M x."""
        self.multigrid.apply(x, y)

    def report(self) -> list[str]:
        return [f"two levels: {self.boxes} boxes, {self.modes} modes each"]

    def release(self) -> None:
        for thing in (*self._own, *self._values):
            thing.destroy()
        self._own, self._values = [], []


def coarse_space(comm: MPI.Comm, modes: np.ndarray, box: np.ndarray, boxes: int) -> tuple[PETSc.Mat, np.ndarray]:
    """Z from the modes (n, bs, k) and the boxes (n,) of this rank's block rows, and a mask of its columns.

    The columns of Z are orthonormal on each box. Columns of dependent modes are zero, and the mask is 1 for them and 0
    for others. The first rank has all columns.
    """
    count, bs, k = modes.shape
    gram = np.zeros((boxes, k, k))
    np.add.at(gram, box, modes.transpose(0, 2, 1) @ modes)
    comm.Allreduce(MPI.IN_PLACE, gram)
    value, vector = np.linalg.eigh(gram)
    kept = value > DEPENDENT * value[:, -1:]
    vector *= np.where(kept, 1.0 / np.sqrt(np.where(kept, value, 1.0)), 0.0)[:, None, :]
    own = slice(0, boxes if comm.rank == 0 else 0)
    columns = np.repeat(k * box[:, None] + np.arange(k), bs, axis=0)
    csr = (
        (k * np.arange(count * bs + 1)).astype(PETSc.IntType),
        columns.astype(PETSc.IntType).ravel(),
        (modes @ vector[box]).ravel(),
    )
    size = ((count * bs, None), (k * own.stop, None))
    return PETSc.Mat().createAIJ(size, csr=csr, comm=comm), (~kept[own]).ravel().astype(float)


def bisect(points: np.ndarray, boxes: int) -> np.ndarray:
    """Box of each point (n,). Each box is halved along its longest side into equal numbers of points, until another
    step would give more than ``boxes`` boxes.

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
    """Places (n, d) of this rank's block rows; without coordinates, their numbers in an order of the matrix."""
    points = P.getAttr("coordinates")
    if points is None:
        return (P.getOwnershipRange()[0] // P.getBlockSize() + block_order(P)).astype(float)[:, None]
    return np.asarray(points, dtype=float)  # (n, d), as `check_coordinates` has seen


def _modes(P: PETSc.Mat) -> np.ndarray:
    """The near null space (n, bs, k) of this rank's block rows; without one, the constants (k = bs)."""
    block = P.getBlockSize()
    near = P.getNearNullSpace()
    vectors = near.getVecs() if near.handle else []
    if not vectors:
        return np.tile(np.eye(block), (P.getLocalSize()[0] // block, 1, 1))
    return np.stack([v.array_r.reshape(-1, block) for v in vectors], axis=2)
