"""Symmetric matrices given by a function: PETSc Mats of type python."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from mpi4py import MPI
from numpy.typing import NDArray
from petsc4py import PETSc

Array = NDArray[np.float64]


def symmetric_shell(comm: MPI.Comm, rows: int, block: int, product: Callable[[Array, Array], None]) -> PETSc.Mat:
    """A Mat with ``rows`` local rows in blocks of size ``block``. Its product is ``product(x, out)``.

    This function is collective and gets local flat arrays. The diagonal of the Mat is that of the attribute
    ``diagonal_blocks`` (`pctt.block_diagonal.set_diagonal_blocks`).
    """
    mat = PETSc.Mat().createPython(((rows, PETSc.DETERMINE), (rows, PETSc.DETERMINE)), Shell(product), comm=comm)
    mat.setBlockSize(block)
    mat.setUp()
    mat.setOption(PETSc.Mat.Option.SYMMETRIC, True)
    return mat


class Shell:
    """The methods that PETSc calls for a matrix of `symmetric_shell`."""

    def __init__(self, product: Callable[[Array, Array], None]):
        self.product = product

    def mult(self, mat: PETSc.Mat, x: PETSc.Vec, y: PETSc.Vec) -> None:
        self.product(x.array_r, y.array_w)

    multTranspose = mult  # noqa: N815 - as PETSc names it

    def getDiagonal(self, mat: PETSc.Mat, diagonal: PETSc.Vec) -> None:
        blocks = mat.getAttr("diagonal_blocks")
        diagonal.array_w[:] = np.diagonal(blocks, axis1=1, axis2=2).ravel()


def is_shell(mat: PETSc.Mat) -> bool:
    return bool(mat.getType() == PETSc.Mat.Type.PYTHON)
