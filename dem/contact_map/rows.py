"""The rows of a contact map: frames and arms of contacts, or 3 x 6 blocks, and the roots of masses."""

from __future__ import annotations

import operator
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
from mpi4py import MPI

from dem.arrays import Floats, Ints
from dem.exchange import refuse

#: The entries (xx, xy, xz, yy, yz, zz) of a symmetric matrix among the nine, and the numbers (3, 3) of all among these.
UPPER, SYMMETRIC = [0, 1, 2, 4, 5, 8], [[0, 1, 2], [1, 3, 4], [2, 4, 5]]


@dataclass(frozen=True)
class CompactRows:
    """Contacts of rigid bodies: 15 numbers per contact, while two 3 x 6 blocks have 36 numbers.

    In the frame F of a contact, body b has the velocity F (v_b + w_b x r_b - v_a - w_a x r_a) relative to body a.
    Put the contacts between two own bodies first: a product does not wait for other ranks until it reaches the first
    contact with a body of another rank.

    Attributes
    ----------
    frame : (nc, 9) rows normal, tangent 1, tangent 2 of F
    arm : (nc, 6) r_a and r_b, from the centres of the bodies to the contact point (m)
    body : (nc, 2) global indices of a and b; -1 for a body that no impulse moves
    root : M^-1/2 of the bodies that this rank owns: (columns, 6) with its diagonals, or (columns, 12) with its two
        symmetric blocks, for translation and rotation, as (xx, xy, xz, yy, yz, zz) each; the same width on all ranks
    columns : number of bodies that this rank owns
    """

    frame: Floats
    arm: Floats
    body: Ints
    root: Floats
    columns: int

    @property
    def rows(self) -> int:
        return len(self.frame)

    def only(self, contacts: Ints) -> CompactRows:
        """Those of these contacts."""
        return replace(self, frame=self.frame[contacts], arm=self.arm[contacts], body=self.body[contacts])

    def checked(self) -> CompactRows:
        """The same arrays in the types that compiled loops trust; ValueError if they do not fit together."""
        nc, columns = len(self.frame), operator.index(self.columns)
        frame, arm = _array("frame", self.frame, float, (nc, 9)), _array("arm", self.arm, float, (nc, 6))
        body = _array("body", self.body, np.int64, (nc, 2))
        if body.min(initial=0) < -1:
            raise ValueError(f"body of the rows has {body.min()}; allowed are indices of bodies, and -1 for no body")
        return CompactRows(frame, arm, body, _array("root", self.root, float, (columns, 6), (columns, 12)), columns)


@dataclass(frozen=True)
class BlockRows:
    """Local block rows of G in block CSR format: one row of 3 x 6 blocks per contact, one block column per body.

    Attributes
    ----------
    indptr : (nc + 1,) index of the first block of each contact, and the number of blocks
    indices : (nnz,) global block columns (bodies)
    blocks : (nnz, 3, 6)
    columns : number of block columns that this rank owns
    """

    indptr: Ints
    indices: Ints
    blocks: Floats
    columns: int

    @property
    def rows(self) -> int:
        return len(self.indptr) - 1

    def checked(self) -> BlockRows:
        """The same arrays in the types of the attributes; ValueError if they do not fit together."""
        count = len(self.indices)
        indptr = _array("indptr", self.indptr, np.int64, (max(len(self.indptr), 1),))
        indices = _array("indices", self.indices, np.int64, (count,))
        if indptr[0] != 0 or indptr[-1] != count or (np.diff(indptr) < 0).any():
            raise ValueError(f"indptr of the rows does not ascend from 0 to the number of blocks, {count}")
        if indices.min(initial=0) < 0:
            raise ValueError(f"indices of the rows have {indices.min()}; allowed are indices of bodies")
        blocks = _array("blocks", self.blocks, float, (count, 3, 6))
        return BlockRows(indptr, indices, blocks, operator.index(self.columns))


AnyRows = TypeVar("AnyRows", CompactRows, BlockRows)


def checked(comm: MPI.Comm, rows: AnyRows) -> AnyRows:
    """The same rows as C-contiguous arrays of float64 and int64, as the compiled loops trust. Collective.

    ValueError on all ranks if shapes do not fit or bodies do not exist.
    """
    wrong, figures = "", np.zeros(3, np.int64)
    try:
        rows = rows.checked()
        body, root = (rows.body, rows.root) if isinstance(rows, CompactRows) else (rows.indices, np.zeros((0, 0)))
        figures[:] = rows.columns, body.max(initial=-1), root.shape[1]
    except (TypeError, ValueError) as error:
        wrong = str(error)
    refuse(comm, wrong)
    everywhere = np.empty((comm.size, 3), np.int64)
    comm.Allgather(figures, everywhere)
    bodies, last, width = everywhere[:, 0].sum(), everywhere[:, 1].max(), everywhere[:, 2]
    if last >= bodies:
        raise ValueError(f"a contact has the body {last}, but there are {bodies} bodies")
    if np.ptp(width):
        raise ValueError("root of the rows has another width on some ranks")
    return rows


def _array(name: str, given: np.ndarray, kind: type, *shapes: tuple[int, ...]) -> np.ndarray:
    """A C-contiguous array of this type and of one of the shapes; ValueError for other data."""
    array = np.asarray(given)
    if array.shape not in shapes:
        raise ValueError(f"{name} of the rows has the shape {array.shape}; allowed is {' or '.join(map(str, shapes))}")
    if array.dtype.kind not in ("iu" if kind is np.int64 else "fiu") and array.size:
        raise ValueError(f"{name} of the rows has the type {array.dtype}; allowed is {np.dtype(kind).name}")
    return np.ascontiguousarray(array, dtype=kind)


def root_blocks(root: Floats) -> Floats:
    """Return matrices in the format of `CompactRows.root` as blocks (n, 2, 3, 3)."""
    if root.shape[1] == 6:
        return root.reshape(-1, 2, 3, 1) * np.eye(3)
    return root.reshape(-1, 2, 6)[:, :, SYMMETRIC]


def packed(blocks: Floats) -> Floats:
    """Symmetric blocks (n, 2, 3, 3) as (n, 12), the inverse of `root_blocks`."""
    return blocks.reshape(-1, 2, 9)[:, :, UPPER].reshape(-1, 12)
