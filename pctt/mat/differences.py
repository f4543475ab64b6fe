"""A matrix whose entries depend on differences of points of a grid: for PETSc a Mat with products by FFT."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from math import log2, prod

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from dem.exchange import refuse
from pctt.mat.grid_train import WholeVectors
from pctt.mat.order import whole_numbers
from pctt.petsc import Context
from pctt.tt.differences import Differences
from pctt.tt.train import Array


class Toeplitz(Context):
    """The context of a Mat of `from_differences`.

    a : the differences, the same on all ranks
    """

    without = PETSc.Mat.Type.AIJ

    def __init__(self, a: Differences) -> None:
        self.a = a

    def create(self, mat: PETSc.Mat) -> None:
        super().create(mat)
        comm = mat.comm.tompi4py()
        self._gather = WholeVectors(comm, np.array(comm.allgather(mat.getLocalSize()[0])))
        self._take(mat, self.a)

    def _take(self, mat: PETSc.Mat, a: Differences) -> None:
        """Become another matrix."""
        self.a, self._times, self.symmetric = a, a.times, a.symmetric
        self._transposed: Callable[[Array], Array] | None = self._times if self.symmetric else None
        mat.setOption(PETSc.Mat.Option.SYMMETRIC, self.symmetric)

    @property
    def grid(self) -> tuple[int, ...]:
        return self.a.shape

    def entries(self, i: Array, j: Array) -> Array:
        """The entries (p,) at rows i and columns j."""
        b = self.a.block
        x, y = (np.unravel_index(k // b, self.grid) for k in (i, j))
        apart = [np.abs(u - v) if self.a.even else u - v for u, v in zip(x, y)]
        return self.a.values[(*apart, i % b, j % b)]

    def mult(self, mat: PETSc.Mat, x: PETSc.Vec, y: PETSc.Vec) -> None:
        y.array_w[:] = self._product(x.array_r, self._times)

    def multTranspose(self, mat: PETSc.Mat, x: PETSc.Vec, y: PETSc.Vec) -> None:
        if self._transposed is None:
            self._transposed = self.a.transposed.times
        y.array_w[:] = self._product(x.array_r, self._transposed)

    def _product(self, x: Array, times: Callable[[Array], Array]) -> Array:
        wide = 2 ** len(self.grid) * prod(self.grid)
        PETSc.Log.logFlops(int(5 * self.a.block * wide * log2(max(2, wide)) + 2 * self.a.block**2 * wide))
        return times(self._gather(x))[self._gather.mine]

    def getDiagonal(self, mat: PETSc.Mat, vec: PETSc.Vec) -> None:
        rows = np.arange(*vec.getOwnershipRange())
        vec.array_w[:] = self.entries(rows, rows)

    def scale(self, mat: PETSc.Mat, factor: float) -> None:
        self._take(mat, Differences(self.grid, factor * self.a.values))

    def shift(self, mat: PETSc.Mat, more: float) -> None:
        values = self.a.values.copy()
        values[(0,) * len(self.grid)] += more * np.eye(self.a.block)
        self._take(mat, Differences(self.grid, values))

    def view(self, mat: PETSc.Mat, viewer: PETSc.Viewer | None = None) -> None:
        if viewer is not None and viewer.getType() == PETSc.Viewer.Type.ASCII:
            grid = " x ".join(map(str, self.grid))
            signs = "" if self.a.even else ", which their signs change"
            viewer.printfASCII(f"  differences of a grid of {grid}{signs}; products by FFT\n")


def differences_in(P: PETSc.Mat) -> Differences | None:
    """The differences of a Mat of this module; None for other Mats."""
    context = P.getPythonContext() if P.getType() == PETSc.Mat.Type.PYTHON else None
    return context.a if isinstance(context, Toeplitz) else None


def from_differences(
    kernel: Callable[[Array], Array], grid: Sequence[int], block: int = 1, comm: MPI.Comm | PETSc.Comm | None = None
) -> PETSc.Mat:
    """Return the matrix A(x, y) = kernel(x - y) for the points x, y of a grid, as a Mat that multiplies by FFT.

    kernel : takes differences of grid indices, integers (D, p), and returns numbers (p,), or (p, block, block) if a
        point has several unknowns; all ranks call it once, for all differences
    grid : (n_1, ..., n_D); the unknowns of the point numpy.unravel_index(k, grid) are the rows block k, ...,
        block (k + 1) - 1
    block : number of unknowns a point

    It takes products, transposed ones, `scale`, `shift`, the diagonal, and has what `pctt.pc.TensorTrain` needs. Every
    rank has the values, 2^D numbers a point (1 if the kernel is even in each coordinate), and transforms whole
    vectors. Raises ValueError on all ranks if values are not finite numbers, and for a bad grid or block.

    >>> A = from_differences(lambda s: np.exp(-abs(s[0]) / 5), (64,))
    >>> A.shift(0.1)
    >>> x, b = A.createVecs()
    >>> x.set(1.0)
    >>> A.mult(x, b)
    >>> round(b.max()[1], 3)
    10.117
    """
    mat = PETSc.Mat().create(comm=comm or PETSc.COMM_WORLD)
    ranks, shape = mat.comm.tompi4py(), whole_numbers(grid)
    wrong = "" if shape else f"a grid of shape {grid!r}; allowed is a tuple of whole numbers >= 1"
    if not (isinstance(block, (int, np.integer)) and block >= 1):
        wrong = f"block = {block!r}; allowed are whole numbers >= 1"
    refuse(ranks, wrong and f"pctt.mat.from_differences: {wrong}")
    assert shape is not None
    axes = np.meshgrid(*[np.concatenate([np.arange(n), np.arange(1 - n, 0)]) for n in shape], indexing="ij")
    s, allowed = np.array(axes).reshape(len(shape), -1), "finite real numbers"
    count, values, wrong = s.shape[1], np.zeros(0), ""
    shapes = {(count, block, block), (count,)} if block == 1 else {(count, block, block)}
    try:
        values = np.asarray(kernel(s))
    except Exception as error:  # any kind, because it is the user's code
        wrong = f"{type(error).__name__}: {error}"
    else:
        if values.shape not in shapes:
            wrong = f"an array of shape {values.shape} for {count} differences"
            allowed = f"arrays of shape {' or '.join(map(str, sorted(shapes)))}"
        elif values.dtype.kind not in "fiub":
            wrong = f"an array of type {values.dtype}"
        elif not np.isfinite(values).all():
            k = int(np.argmax(~np.isfinite(values).reshape(count, -1).all(axis=1)))
            wrong = f"{values[k]} at the difference {tuple(map(int, s[:, k]))}"
    refuse(ranks, wrong and f"pctt.mat.from_differences: the kernel gives {wrong}; allowed are {allowed}")
    values = ranks.bcast(values.astype(float))  # what processors compute differs by rounding
    a = Differences(shape, values.reshape(*[2 * n - 1 for n in shape], block, block)).compact()
    rows = prod(shape)
    here = rows // ranks.size + (ranks.rank < rows % ranks.size)
    mat.setSizes(((here * block, rows * block), (here * block, rows * block)), block)
    mat.setType(PETSc.Mat.Type.PYTHON)
    mat.setPythonContext(Toeplitz(a))
    mat.setUp()
    return mat
