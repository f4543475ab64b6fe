"""What the tests of trains share: solvers with `pctt.pc.TensorTrain`, and matrices that are given by their entries."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from petsc4py import PETSc

from pctt.pc import TensorTrain

Entries = Callable[[np.ndarray, np.ndarray], np.ndarray]


def solver(
    mat: PETSc.Mat, ksp_type: str = "cg", rtol: float = 1e-8, prefix: str = "", **options: object
) -> PETSc.KSP:
    """A KSP with the train as preconditioner, by these options -pc_tt_*."""
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
    return ksp


def context(ksp: PETSc.KSP) -> TensorTrain:
    return ksp.pc.getPythonContext()


def left(ksp: PETSc.KSP, x: PETSc.Vec, b: PETSc.Vec) -> float:
    """||b - A x|| / ||b||."""
    residual = b.duplicate()
    ksp.getOperators()[0].mult(x, residual)
    residual.aypx(-1.0, b)
    return residual.norm() / b.norm()


def solve(ksp: PETSc.KSP) -> tuple[int, float]:
    """Iterations and true residual for a random right-hand side."""
    x, b = ksp.getOperators()[0].createVecs()
    b.array[:] = np.random.default_rng(0).standard_normal(b.getLocalSize())
    ksp.solve(b, x)
    return ksp.getIterationNumber(), left(ksp, x, b)


def operator(ksp: PETSc.KSP) -> np.ndarray:
    """The preconditioner as a dense matrix."""
    mat = ksp.getOperators()[0]
    x, y = mat.createVecs()
    columns = []
    for k in range(mat.getSize()[0]):
        x.zeroEntries()
        x[k] = 1.0
        x.assemble()
        ksp.pc.apply(x, y)
        columns.append(y.array.copy())
    return np.stack(columns, axis=1)


def dense_of(entries: Entries, size: int) -> np.ndarray:
    return entries(*np.indices((size, size)).reshape(2, -1)).reshape(size, size)


def shell(entries: Any, A: np.ndarray, **attributes: object) -> PETSc.Mat:
    """A Mat that a user has written, with dense products by A, and with this function of its entries."""

    class Shell:
        def mult(self, mat: PETSc.Mat, x: PETSc.Vec, y: PETSc.Vec) -> None:
            y.array_w[:] = A[slice(*y.getOwnershipRange())] @ np.concatenate(mat.comm.tompi4py().allgather(x.array_r))

    sizes = (PETSc.DECIDE, len(A))
    mat = PETSc.Mat().createPython((sizes, sizes), Shell(), comm=PETSc.COMM_WORLD)
    mat.setUp()
    for name, value in {"entries": entries, **attributes}.items():
        mat.setAttr(name, value)
    return mat
