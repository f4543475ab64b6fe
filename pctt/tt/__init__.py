"""Quantised tensor trains: approximate sparse matrices, their inverses and products, in numpy::

    modes = choose_modes(slots)                            cut the index
    A = SparseHierarchy(rows, columns, modes, block)       once per pattern
    A.set_values(blocks)
    T = compress(A, max_rank=10, eps=1e-2).train           or `compress_cross`
    X = invert(identity(T.rows) + T, max_rank=10).train
    y = Apply(X, n)(x)

This package does not use PETSc or MPI. If the rows are distributed, the caller passes a function that adds an array
over the ranks.
"""

from __future__ import annotations

from pctt.tt.apply import Apply
from pctt.tt.cross import Cross, EntryMatrix, compress_cross
from pctt.tt.inverse import Inverse, invert, invert_near_identity, residual
from pctt.tt.projection import lowest
from pctt.tt.quantise import GridDigits, choose_modes, merge, scalar_modes, slots_of
from pctt.tt.sparse import Compression, SparseHierarchy, compress, relative_error
from pctt.tt.train import Train, decompose, decompose_matrix, identity, matrix_train, random, zeros

__all__ = [
    "Apply", "Compression", "Cross", "EntryMatrix", "GridDigits", "Inverse", "SparseHierarchy", "Train", "choose_modes",
    "compress", "compress_cross", "decompose", "decompose_matrix", "identity", "invert", "invert_near_identity",
    "lowest", "matrix_train", "merge", "random", "relative_error", "residual", "scalar_modes", "slots_of", "zeros",
]  # fmt: skip
