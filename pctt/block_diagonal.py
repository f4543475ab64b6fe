"""The present diagonal blocks of a Mat.

PETSc inverts the diagonal blocks of a BAIJ matrix once and keeps these inverses even if the matrix gets other values
(seen in 3.22 and 3.25, not in 3.18; in 3.25 also for AIJ). So ``MatInvertBlockDiagonal``, ``-pc_type pbjacobi`` and SOR
on BAIJ always use the first inverses. A new Mat has no such memory.
"""

from __future__ import annotations

import numpy as np
from petsc4py import PETSc

from pctt.blocks import block_csr_matrix, new_matrix

#: Types of preconditioners that use the inverses of the diagonal blocks of a Mat.
BY_DIAGONAL_BLOCKS = frozenset({"pbjacobi", "sor"})


def set_diagonal_blocks(P: PETSc.Mat, blocks: np.ndarray) -> None:
    """Attach the diagonal blocks (n, bs, bs) of this rank's block rows to P, which saves a copy of P.

    Call this again whenever P changes.
    """
    P.setAttr("diagonal_blocks", blocks)


def put_diagonal_blocks(mat: PETSc.Mat, blocks: np.ndarray) -> None:
    """Write the diagonal blocks (n, bs, bs) of this rank's block rows into a Mat; collective."""
    size = mat.getBlockSize()
    first, last = mat.getOwnershipRange()
    rows = np.arange(first // size, last // size, dtype=PETSc.IntType)[:, None]
    if len(blocks):  # petsc4py divides by their number
        mat.setValuesBlockedRCV(rows, rows, blocks.reshape(-1, size**2))
    mat.assemble()


def block_diagonal(P: PETSc.Mat, blocks: np.ndarray | None = None) -> PETSc.Mat:
    """A new Mat with the diagonal blocks of P; ``pbjacobi`` needs nothing else. The caller destroys the Mat.

    If neither the argument ``blocks`` nor an attribute of P gives the blocks, the new Mat is a copy of P.
    """
    blocks = P.getAttr("diagonal_blocks") if blocks is None else blocks
    if blocks is None:
        return P.duplicate(copy=True)
    first, last = (row // P.getBlockSize() for row in P.getOwnershipRange())
    rows = P.getLocalSize()[0]
    return block_csr_matrix(P.comm, rows, rows, np.arange(last - first + 1), np.arange(first, last), blocks)


def without_memory(P: PETSc.Mat, kind: str) -> PETSc.Mat | None:
    """A new Mat for a preconditioner of this type, because PETSc may remember old diagonal blocks of P.

    None if the preconditioner can use P itself. The caller destroys the Mat.
    """
    if kind == "pbjacobi":
        return block_diagonal(P)
    return _copy(P) if kind == "sor" and P.getType() == "seqbaij" else None


def _copy(P: PETSc.Mat) -> PETSc.Mat:
    """A copy of a sequential BAIJ matrix; SOR does not work with the copy that ``MatDuplicate`` makes."""
    copy = new_matrix(P.comm, P.getSizes(), P.getBlockSize(), P.getRowIJ(compressed=True), P.getType())
    P.copy(copy, PETSc.Mat.Structure.SAME_NONZERO_PATTERN)
    return copy


def inverse_diagonal_blocks(P: PETSc.Mat) -> np.ndarray:
    """Inverses (n, bs, bs) of the diagonal blocks of this rank's block rows.

    Raises numpy.linalg.LinAlgError on the ranks that have a singular block.
    """
    blocks = P.getAttr("diagonal_blocks")
    if blocks is not None:
        inverse = np.linalg.inv(blocks)
    else:
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
