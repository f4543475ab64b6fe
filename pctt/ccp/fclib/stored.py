"""A cone problem as a file holds it: whole on rank 0, which reads the file, then in parts on all ranks."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import scipy.sparse as sp
from mpi4py import MPI

from pctt.blocks import BlockRows, square_block_matrix
from pctt.ccp.cone import Array
from pctt.ccp.problem import ConeProblem

MIRRORED = "{} is stored as one triangle, which was mirrored"


class FileFormatError(ValueError):
    """A file that is no cone problem; raised on all ranks alike."""


@dataclass(frozen=True)
class Whole:
    """All of a file, for nc contacts; `spread` gives each rank the rows of its own contacts.

    Attributes
    ----------
    form, title : FCLIB local or FCLIB global, and what the file says of itself
    matrix : (3 nc, 6 bodies) the map G in 3 x 6 blocks, or (3 nc, 3 nc) the matrix N in 3 x 3 blocks
    r : (3 nc,) velocities without impulses (m/s)
    mu : (nc,) friction coefficients
    solution, guess : (3 nc,) impulses (N s) or None
    point : (nc, 3) contact points (m) or None
    compliance : e of `ConeProblem`; the matrix is that of rigid contacts
    note : what the reader had to make of the data, in words; mostly nothing
    """

    form: str
    title: str
    matrix: sp.bsr_matrix
    r: Array
    mu: Array
    solution: Array | None = None
    guess: Array | None = None
    point: Array | None = None
    compliance: float = 0.0
    note: str = ""

    def check(self) -> None:
        """FileFormatError unless all sizes fit together and all numbers are finite."""
        count = len(self.mu)
        if self.matrix.shape[0] != 3 * count or len(self.r) != 3 * count:
            raise FileFormatError(
                f"{count} friction coefficients, but a matrix {self.matrix.shape} and a vector {self.r.shape}"
            )
        if self.matrix.blocksize == (3, 3) and self.matrix.shape[1] != 3 * count:
            raise FileFormatError(f"its matrix {self.matrix.shape} is not square")
        finite = np.isfinite(self.matrix.data).all() and np.isfinite(self.r).all()
        if not (finite and (np.isfinite(self.mu) & (self.mu >= 0)).all()):
            raise FileFormatError("it has a NaN, an infinite value or a negative friction coefficient")
        if not (np.isfinite(self.compliance) and self.compliance >= 0):
            raise FileFormatError(f"its compliance {self.compliance} is not a number >= 0")
        for name in ("solution", "guess", "point"):
            array = getattr(self, name)
            if array is not None and not (np.size(array) == 3 * count and np.isfinite(array).all()):
                raise FileFormatError(f"its {name} is not {3 * count} finite numbers")


@dataclass(frozen=True)
class Stored:
    """A problem from a file, with the impulses (nc, 3) in the file for this rank's contacts. ``note`` says what the
    reader had to change."""

    problem: ConeProblem
    form: str
    title: str
    solution: Array | None = None
    guess: Array | None = None
    note: str = ""


def symmetric_blocks(W: sp.spmatrix) -> tuple[sp.bsr_matrix, str]:
    """(W + W') / 2 in 3 x 3 blocks: matrices in files are symmetric up to the rounding of their writers. One triangle
    is mirrored; the words say so."""
    if W.shape[0] != W.shape[1] or W.shape[0] % 3:
        raise FileFormatError(f"its matrix {W.shape} is not square with three rows per contact")
    whole = mirrored(W)
    symmetric = (0.5 * (W + W.T)).tocsr() if whole is None else whole
    symmetric.sort_indices()
    return symmetric.tobsr((3, 3)), "" if whole is None else MIRRORED.format("W")


def mirrored(A: sp.spmatrix) -> sp.csr_matrix | None:
    """A square matrix that is stored as one triangle, with the mirror of that triangle. None if there are entries on
    both sides of the diagonal, or on neither. Half the sum of a triangle and its mirror would be another matrix."""
    above, below = sp.triu(A, 1), sp.tril(A, -1)
    if (above.count_nonzero() == 0) == (below.count_nonzero() == 0):
        return None
    return (A + (above + below).T).tocsr()


def spread(comm: MPI.Comm, path: str | Path, read: Callable[[], Whole], compliance: float | None = None) -> Stored:
    """The problem that ``read`` finds on rank 0, contacts (and bodies) in equal parts over the ranks; collective.

    ``compliance`` takes the place of the file's.

    Raises FileFormatError on every rank if ``read`` raises any error: bad data surprise h5py, numpy and scipy.
    """
    parts: list[tuple[Whole, int]] = []
    error = None
    if comm.rank == 0:
        try:
            whole = read()
            whole.check()
            parts = [_part(whole, rank, comm.size) for rank in range(comm.size)]
        except Exception as reason:  # of any kind: the other ranks wait for the parts
            error = f"{path}: no FCLIB problem: {reason}"
    error = comm.bcast(error)
    if error:
        raise FileFormatError(error)
    part, columns = comm.scatter(parts)
    rows, G, N = part.matrix, None, None
    if rows.blocksize == (3, 6):
        G = BlockRows(rows.indptr, rows.indices, rows.data, columns)
    else:
        N = square_block_matrix(comm, rows)
    e = part.compliance if compliance is None else compliance
    problem = ConeProblem(comm, part.r, part.mu, G=G, N=N, point=part.point, compliance=e)
    if N is not None:
        N.destroy()  # the problem has a copy
    return Stored(problem, part.form, part.title, part.solution, part.guess, part.note)


def _part(whole: Whole, rank: int, ranks: int) -> tuple[Whole, int]:
    """What one rank gets: the rows of its contacts, and how many of the block columns (bodies) it owns."""
    A, contacts, columns = whole.matrix, len(whole.mu), whole.matrix.shape[1] // whole.matrix.blocksize[1]
    mine = slice(contacts * rank // ranks, contacts * (rank + 1) // ranks)
    near = slice(A.indptr[mine.start], A.indptr[mine.stop])
    pointers = A.indptr[mine.start : mine.stop + 1] - near.start
    shape = (3 * (mine.stop - mine.start), A.shape[1])
    rows = sp.bsr_matrix((A.data[near], A.indices[near], pointers), shape=shape)
    vectors = {name: getattr(whole, name) for name in ("r", "solution", "guess", "point")}
    parts: dict[str, Any] = {name: None if x is None else np.reshape(x, (-1, 3))[mine] for name, x in vectors.items()}
    own = columns * (rank + 1) // ranks - columns * rank // ranks
    return replace(whole, matrix=rows, mu=whole.mu[mine], **parts), own
