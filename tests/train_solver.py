"""What the tests of trains share: kernels, Mats, and solvers with `pctt.pc.TensorTrain`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields, replace
from typing import Any

import numpy as np
import scipy.sparse as sp
from mpi4py import MPI
from petsc4py import PETSc

from pctt.pc import TensorTrain
from pctt.pc.options import Options

Entries = Callable[[np.ndarray, np.ndarray], np.ndarray]


class Kernel:
    """c I + a kernel on a grid, unsymmetric with a skew."""

    def __init__(self, grid: tuple[int, ...], nugget: float = 2.0, width: float = 8.0, skew: float = 0.0) -> None:
        self.grid, self.nugget, self.width, self.skew = grid, nugget, width, skew

    def __call__(self, i: np.ndarray, j: np.ndarray) -> np.ndarray:
        apart = np.subtract(np.unravel_index(i, self.grid), np.unravel_index(j, self.grid))
        smooth = np.exp(-(apart**2).sum(axis=0) / self.width)
        return self.nugget * (i == j) + smooth * (1 + self.skew * np.sin(i) * np.cos(j))

    @property
    def dense(self) -> np.ndarray:
        return dense_of(self, int(np.prod(self.grid)))


def dense_of(entries: Entries, size: int) -> np.ndarray:
    return entries(*np.indices((size, size)).reshape(2, -1)).reshape(size, size)


def gathered(vec: PETSc.Vec) -> np.ndarray:
    """All of a vector, on all ranks."""
    return np.concatenate(vec.comm.tompi4py().allgather(vec.array_r.copy()))


def columns(mat: PETSc.Mat, product: Callable[[PETSc.Vec, PETSc.Vec], None]) -> np.ndarray:
    """A product with vectors of this Mat as a dense matrix, on all ranks."""
    x, y = mat.createVecs()
    found = []
    for k in range(mat.getSize()[1]):
        x.set(0.0)
        x.setValue(k, 1.0)
        x.assemble()
        product(x, y)
        found.append(gathered(y))
    return np.array(found).T


def with_attributes(mat: PETSc.Mat, **attributes: object) -> PETSc.Mat:
    for name, value in attributes.items():
        mat.setAttr(name, value)
    return mat


def dense_mat(A: np.ndarray, comm: Any = PETSc.COMM_WORLD, **attributes: object) -> PETSc.Mat:
    """A dense Mat; each rank has a share of the rows."""
    sizes = [len(A) // comm.size + (rank < len(A) % comm.size) for rank in range(comm.size)]
    first = sum(sizes[: comm.rank])
    size = (sizes[comm.rank], len(A))
    mat = PETSc.Mat().createDense((size, size), array=A[first : first + size[0]].copy(), comm=comm)
    return with_attributes(mat, **attributes)


def shell(entries: Any, A: np.ndarray, block: int = 1, **attributes: object) -> PETSc.Mat:
    """A Mat that a user has written, with dense products by A, and with this function of its entries."""

    class Shell:
        def mult(self, mat: PETSc.Mat, x: PETSc.Vec, y: PETSc.Vec) -> None:
            y.array_w[:] = A[slice(*y.getOwnershipRange())] @ gathered(x)

    sizes = (PETSc.DECIDE, len(A))
    mat = PETSc.Mat().create(PETSc.COMM_WORLD)
    mat.setSizes((sizes, sizes), block)
    mat.setType(PETSc.Mat.Type.PYTHON)
    mat.setPythonContext(Shell())
    mat.setUp()
    return with_attributes(mat, entries=entries, **attributes)


def poisson(n: int) -> PETSc.Mat:
    """The five-point stencil on an n x n grid, AIJ, with its points as attribute."""
    line = sp.diags([-1.0, 2.0, -1.0], [-1, 0, 1], shape=(n, n))
    comm = MPI.COMM_WORLD
    first, last = (n * n * rank // comm.size for rank in (comm.rank, comm.rank + 1))
    rows = sp.kronsum(line, line, format="csr")[first:last]
    size = (last - first, n * n)
    mat = PETSc.Mat().createAIJ((size, size), csr=(rows.indptr, rows.indices, rows.data), comm=comm)
    return with_attributes(mat, coordinates=np.stack(np.divmod(np.arange(first, last), n), axis=1))


def solver(
    mat: PETSc.Mat, ksp_type: str = "cg", rtol: float = 1e-8, prefix: str = "", **options: object
) -> PETSc.KSP:
    """A KSP with the train as preconditioner, by these options -pc_tt_*, or numbers of `pctt.pc.options`."""
    numbers = {f.name for f in fields(Options) if "python_only" in f.metadata} & options.keys()
    set_here = {name: options.pop(name) for name in numbers}
    for name, value in options.items():
        PETSc.Options()[f"{prefix}pc_tt_{name}"] = str(value)
    ksp = PETSc.KSP().create(mat.comm)
    ksp.setOptionsPrefix(prefix)
    ksp.setOperators(mat)
    ksp.setType(ksp_type)
    ksp.setTolerances(rtol=rtol, max_it=2000)
    ksp.pc.setType("python")
    ksp.pc.setPythonType("pctt.pc.TensorTrain")
    ksp.setFromOptions()
    context(ksp).options = replace(context(ksp).options, **set_here)
    return ksp


def ready(mat: PETSc.Mat, ksp_type: str = "cg", **options: object) -> PETSc.KSP:
    """The same, set up."""
    ksp = solver(mat, ksp_type, **options)
    ksp.setUp()
    return ksp


def context(ksp: PETSc.KSP) -> TensorTrain:
    return ksp.pc.getPythonContext()


def report(ksp: PETSc.KSP) -> str:
    return "\n".join(context(ksp).report())


def left(ksp: PETSc.KSP, x: PETSc.Vec, b: PETSc.Vec) -> float:
    """||b - A x|| / ||b||."""
    residual = b.duplicate()
    ksp.getOperators()[0].mult(x, residual)
    residual.aypx(-1.0, b)
    return residual.norm() / b.norm()


def solve(ksp: PETSc.KSP) -> tuple[int, float]:
    """Iterations and true residual for a random right-hand side."""
    x, b = ksp.getOperators()[0].createVecs()
    b.array[:] = np.random.default_rng(0).standard_normal(b.getSize())[slice(*b.getOwnershipRange())]
    ksp.solve(b, x)
    return ksp.getIterationNumber(), left(ksp, x, b)


def operator(ksp: PETSc.KSP) -> np.ndarray:
    """The preconditioner as a dense matrix."""
    return columns(ksp.getOperators()[0], ksp.pc.apply)
