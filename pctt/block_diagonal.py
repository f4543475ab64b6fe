"""The diagonal blocks of a Mat, as they are now.

Newer releases of PETSc (seen in 3.22 and 3.25, not in 3.18) keep the inverses of the first diagonal blocks of a BAIJ
matrix, 3.25 of an AIJ matrix too, whatever values it gets later: ``MatInvertBlockDiagonal``, ``-pc_type pbjacobi`` and
SOR on BAIJ work with the first ones for ever. A Mat that is made anew has no such memory.
"""

from __future__ import annotations

import numpy as np
from petsc4py import PETSc

from pctt.blocks import block_csr_matrix

#: Types of preconditioners that ask a Mat for the inverses of its diagonal blocks.
BY_DIAGONAL_BLOCKS = frozenset({"pbjacobi", "sor"})


def set_diagonal_blocks(P: PETSc.Mat, blocks: np.ndarray) -> None:
    """Say what the diagonal blocks (n, bs, bs) of this rank's block rows are, which saves a copy of P; to be said
    again whenever P changes."""
    P.setAttr("diagonal_blocks", blocks)


def block_diagonal(P: PETSc.Mat, blocks: np.ndarray | None = None) -> PETSc.Mat:
    """A new Mat with the diagonal blocks of P, which is all that ``pbjacobi`` asks of it; the caller destroys it.

    Where they are not given, and P does not say what they are, a copy of P."""
    blocks = P.getAttr("diagonal_blocks") if blocks is None else blocks
    if blocks is None:
        return P.duplicate(copy=True)
    first, last = (row // P.getBlockSize() for row in P.getOwnershipRange())
    rows = P.getLocalSize()[0]
    return block_csr_matrix(P.comm, rows, rows, np.arange(last - first + 1), np.arange(first, last), blocks)


def without_memory(P: PETSc.Mat, kind: str) -> PETSc.Mat | None:
    """A new Mat from which a preconditioner of this type is to be made in place of P, as PETSc may remember diagonal
    blocks of P that are no longer true; None where P itself will do. The caller destroys it."""
    if kind == "pbjacobi":
        return block_diagonal(P)
    return _copy(P) if kind == "sor" and P.getType() == "seqbaij" else None


def _copy(P: PETSc.Mat) -> PETSc.Mat:
    """Of a sequential BAIJ matrix; ``MatDuplicate`` makes one that has no SOR."""
    copy = PETSc.Mat().create(P.comm)
    copy.setSizes(P.getSizes())
    copy.setBlockSize(P.getBlockSize())
    copy.setType(P.getType())
    copy.setPreallocationCSR(P.getRowIJ(compressed=True))
    P.copy(copy, PETSc.Mat.Structure.SAME_NONZERO_PATTERN)
    return copy


def inverse_diagonal_blocks(P: PETSc.Mat) -> np.ndarray:
    """Inverses (n, bs, bs) of the diagonal blocks of this rank's block rows.

    Raises numpy.linalg.LinAlgError, on the ranks concerned, where one is singular.
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
