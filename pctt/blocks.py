"""PETSc Mats of small dense blocks, distributed by rows: from arrays, or symmetric ones by a function and their
diagonal blocks; and the diagonal blocks of Mats.

PETSc inverts the diagonal blocks of a BAIJ matrix once and keeps these inverses even if the matrix gets other values
(seen in 3.22 and 3.25, not in 3.18; in 3.25 also for AIJ). So ``MatInvertBlockDiagonal``, ``-pc_type pbjacobi`` and SOR
use the first inverses for ever. A new Mat has no such memory.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import scipy.sparse as sp
from mpi4py import MPI
from petsc4py import PETSc

from pctt.arrays import Array

Product = Callable[[Array, Array], None]


def square_block_matrix(comm: MPI.Comm, rows: sp.bsr_matrix) -> PETSc.Mat:
    """A square Mat from this rank's block rows (b nc x b Nc); b is the block size of the rows and of the Mat."""
    size = rows.blocksize[0]
    shape = (rows.shape[0] // size, rows.shape[1] // size)
    columns = rows.indices.copy()  # the sort below changes them in place
    order = sp.csr_matrix((np.arange(len(columns)), columns, rows.indptr), shape=shape)
    order.sort_indices()  # PETSc needs sorted columns; sorting positions is much faster than sorting blocks
    count = rows.shape[0]
    return block_csr_matrix(comm, count, count, rows.indptr, order.indices, rows.data[order.data])


def block_csr_matrix(
    comm: MPI.Comm, rows: int, columns: int, indptr: np.ndarray, indices: np.ndarray, blocks: Array
) -> PETSc.Mat:
    """A BAIJ Mat from local block CSR arrays with ``blocks`` (nb, b, b).

    ``rows`` and ``columns`` are the local sizes in scalar rows and columns.
    """
    csr = (indptr.astype(PETSc.IntType), indices.astype(PETSc.IntType), np.ascontiguousarray(blocks).ravel())
    return new_matrix(comm, ((rows, PETSc.DETERMINE), (columns, PETSc.DETERMINE)), blocks.shape[-1], csr)


def new_matrix(
    comm: MPI.Comm, sizes: Any, block: int, csr: tuple[np.ndarray, ...], kind: str = PETSc.Mat.Type.BAIJ
) -> PETSc.Mat:
    """A Mat of this type with the pattern ``csr`` of the local rows, and its values if they are the third array."""
    mat = PETSc.Mat().create(comm)
    mat.setSizes(sizes)
    mat.setBlockSize(block)
    mat.setType(kind)
    mat.setPreallocationCSR(csr)
    return mat


def diagonal_matrix(diagonal: PETSc.Vec) -> PETSc.Mat:
    """A new AIJ Mat with this diagonal."""
    rows, first = diagonal.getLocalSize(), diagonal.getOwnershipRange()[0]
    indptr = np.arange(rows + 1, dtype=PETSc.IntType)
    csr = (indptr, indptr[:-1] + indptr.dtype.type(first), diagonal.array_r.copy())
    sizes = (rows, PETSc.DETERMINE)
    return new_matrix(diagonal.comm.tompi4py(), (sizes, sizes), 1, csr, PETSc.Mat.Type.AIJ)


# -- objects of the user -------------------------------------------------------------------------------------


def unready(thing: Any) -> str:
    """What a Mat, Vec or KSP lacks, in words; "" if nothing. PETSc may crash where one was never created."""
    if not isinstance(thing, PETSc.Object):
        return f"is a {type(thing).__name__}"
    if not thing.handle:
        return "was never created, or is destroyed"
    if isinstance(thing, PETSc.KSP):
        return "".join(f"has an operator that {lack}" for lack in map(unready, thing.getOperators()[:1]) if lack)
    if not thing.type or np.min(thing.getLocalSize()) < 0:
        return "has no type or no sizes"
    return "is not assembled" if isinstance(thing, PETSc.Mat) and not thing.isAssembled() else ""


def refuse_unready(who: str, *mats: PETSc.Mat) -> None:
    """ValueError that says who refuses a Mat which is not ready for use."""
    if wrong := next(filter(None, map(unready, mats)), ""):
        raise ValueError(f"{who}: the Mat {wrong}; allowed is an assembled Mat")


# -- diagonal blocks -----------------------------------------------------------------------------------------


class Shell:
    """The context of a Mat of type python; it knows the diagonal blocks (n, bs, bs) of this rank's rows."""

    def __init__(self, product: Product, transposed: Product | None = None):
        self.product, self.transposed = product, transposed or product
        self.blocks: Array | None = None

    def mult(self, mat: PETSc.Mat, x: PETSc.Vec, y: PETSc.Vec) -> None:
        self.product(x.array_r, y.array_w)

    def multTranspose(self, mat: PETSc.Mat, x: PETSc.Vec, y: PETSc.Vec) -> None:  # noqa: N802 - as PETSc names it
        self.transposed(x.array_r, y.array_w)

    def getDiagonal(self, mat: PETSc.Mat, diagonal: PETSc.Vec) -> None:
        assert self.blocks is not None
        diagonal.array_w[:] = np.diagonal(self.blocks, axis1=1, axis2=2).ravel()


def symmetric_shell(
    comm: MPI.Comm, rows: int, block: int, product: Product, transposed: Product | None = None
) -> PETSc.Mat:
    """A Mat with ``rows`` local rows in blocks of size ``block``. Its product is ``product(x, out)``, which is
    collective and gets local flat arrays. ``transposed`` is that of the transposed matrix, if it is another one."""
    context = Shell(product, transposed)
    mat = PETSc.Mat().createPython(((rows, PETSc.DETERMINE), (rows, PETSc.DETERMINE)), context, comm=comm)
    mat.setBlockSize(block)
    mat.setUp()
    mat.setOption(PETSc.Mat.Option.SYMMETRIC, True)
    return mat


def shell_of(mat: PETSc.Mat) -> Shell | None:
    """The context of a Mat of `symmetric_shell`; None for other Mats."""
    context = mat.getPythonContext() if mat.getType() == PETSc.Mat.Type.PYTHON else None
    return context if isinstance(context, Shell) else None


def set_diagonal_blocks(mat: PETSc.Mat, blocks: Array, symmetric: bool = True) -> None:
    """Tell a Mat of `symmetric_shell` that it has changed, and its diagonal blocks (n, bs, bs) on this rank."""
    shell = shell_of(mat)
    assert shell is not None
    shell.blocks = blocks
    mat.setOption(PETSc.Mat.Option.SYMMETRIC, symmetric)
    mat.stateIncrease()


def put_diagonal_blocks(mat: PETSc.Mat, blocks: Array) -> None:
    """Write the diagonal blocks (n, bs, bs) of this rank's block rows into a Mat; collective."""
    size = mat.getBlockSize()
    first, last = mat.getOwnershipRange()
    rows = np.arange(first // size, last // size, dtype=PETSc.IntType)[:, None]
    if len(blocks):  # petsc4py divides by their number
        mat.setValuesBlockedRCV(rows, rows, blocks.reshape(-1, size**2))
    mat.assemble()


def block_diagonal(P: PETSc.Mat, blocks: Array | None = None) -> PETSc.Mat:
    """A new Mat with the diagonal blocks of P, or these ``blocks``; ``pbjacobi`` needs nothing else. For an assembled P
    it is a copy. The caller destroys the Mat."""
    refuse_unready("pctt.blocks.block_diagonal", P)
    shell = shell_of(P)
    blocks = shell.blocks if blocks is None and shell else blocks
    if blocks is None:
        return P.duplicate(copy=True)
    first, last = (row // P.getBlockSize() for row in P.getOwnershipRange())
    rows = P.getLocalSize()[0]
    return block_csr_matrix(P.comm, rows, rows, np.arange(last - first + 1), np.arange(first, last), blocks)


def fresh_copy(P: PETSc.Mat) -> PETSc.Mat:
    """A copy of a sequential BAIJ matrix for SOR, which does not work with the copy that ``MatDuplicate`` makes."""
    copy = new_matrix(P.comm, P.getSizes(), P.getBlockSize(), P.getRowIJ(compressed=True), P.getType())
    P.copy(copy, PETSc.Mat.Structure.SAME_NONZERO_PATTERN)
    return copy


def inverse_diagonal_blocks(P: PETSc.Mat) -> Array:
    """Inverses (n, bs, bs) of the diagonal blocks of this rank's block rows of an assembled Mat.

    Raises numpy.linalg.LinAlgError on the ranks that have a singular block.
    """
    here = P.getDiagonalBlock().duplicate(copy=True)
    try:
        inverse = np.array(here.invertBlockDiagonal())
    except PETSc.Error:  # a zero pivot
        raise np.linalg.LinAlgError("a diagonal block is singular") from None
    finally:
        here.destroy()
    if not np.isfinite(inverse).all():
        raise np.linalg.LinAlgError("a diagonal block is singular")
    return inverse
