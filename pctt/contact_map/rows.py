"""The local rows of the contact map G = D' M^-1/2, in one of two storage formats."""

from __future__ import annotations

import operator
from dataclasses import dataclass, replace

import numpy as np
from mpi4py import MPI

from pctt.blocks import Array, BlockRows
from pctt.contact_map.ghosts import Ghosts
from pctt.exchange import refuse


@dataclass(frozen=True)
class CompactRows:
    """Contacts of rigid bodies: 15 numbers per contact, while two 3 x 6 blocks have 36 numbers.

    In the frame F of a contact, body b has the velocity F (v_b + w_b x r_b - v_a - w_a x r_a) relative to body a.

    Attributes
    ----------
    frame : (nc, 9) rows normal, tangent 1, tangent 2 of F
    arm : (nc, 6) r_a and r_b, from the centres of the bodies to the contact point (m)
    body : (nc, 2) global indices of a and b; -1 for a body that no impulse moves
    root : M^-1/2 of the bodies that this rank owns: (columns, 6) with its diagonals, or (columns, 12) with its two
        symmetric blocks, for translation and rotation, as (xx, xy, xz, yy, yz, zz) each; the same width on all ranks
    columns : number of bodies that this rank owns

    Put the contacts between two own bodies first: a product does not wait for other ranks until it reaches the first
    contact with a body of another rank.
    """

    frame: Array
    arm: Array
    body: np.ndarray
    root: Array
    columns: int

    @property
    def rows(self) -> int:
        return len(self.frame)

    def block_rows(self, comm: MPI.Comm) -> BlockRows:
        """These rows as 3 x 6 blocks; collective."""
        ghosts = Ghosts(comm, self.columns, self.body)
        root = np.zeros((ghosts.nobody + 1, self.root.shape[1]))
        root[: self.columns] = self.root
        ghosts.update(root)
        ghosts.destroy()
        order = np.argsort(self.body, axis=1)
        frame, arms = self.frame.reshape(-1, 1, 3, 3), self.arm.reshape(-1, 2, 1, 3)
        blocks = np.concatenate(np.broadcast_arrays(frame, np.cross(arms, frame)), axis=3)
        blocks *= np.array([-1.0, 1.0])[:, None, None]
        blocks = np.take_along_axis(blocks, order[:, :, None, None], axis=1)
        body = np.take_along_axis(self.body, order, axis=1)
        moves = body >= 0
        local = np.take_along_axis(ghosts.body, order, axis=1)[moves]
        blocks, both = blocks[moves], root_blocks(root)[local]
        blocks = np.concatenate([blocks[:, :, :3] @ both[:, 0], blocks[:, :, 3:] @ both[:, 1]], axis=2)
        indptr = np.concatenate([[0], np.cumsum(moves.sum(axis=1))])
        return BlockRows(indptr, body[moves], blocks, self.columns)


def checked(comm: MPI.Comm, rows: BlockRows | CompactRows) -> BlockRows | CompactRows:
    """The same rows with C-contiguous arrays of float64 and int64, as the compiled loops trust. Collective.

    ValueError on all ranks if shapes do not fit or bodies do not exist.
    """
    wrong, width, last = "", -1, -1
    try:
        rows = _compact(rows) if isinstance(rows, CompactRows) else _blocks(rows)
    except (TypeError, ValueError) as error:
        wrong = str(error)
    else:
        body = rows.body if isinstance(rows, CompactRows) else rows.indices
        last = int(body.max(initial=-1))
        width = rows.root.shape[1] if isinstance(rows, CompactRows) else -1
    refuse(comm, wrong)
    figures = comm.allgather((rows.columns, last, width))
    bodies = sum(columns for columns, _, _ in figures)
    if max(last for _, last, _ in figures) >= bodies:
        raise ValueError(f"a contact has the body {max(last for _, last, _ in figures)}, but there are {bodies} bodies")
    if len({width for _, _, width in figures}) > 1:
        raise ValueError("the rows have another format, or a root of another width, on some ranks")
    return rows


def _compact(rows: CompactRows) -> CompactRows:
    nc, columns = len(rows.frame), operator.index(rows.columns)
    root = _array("root", rows.root, float, (columns, 6), (columns, 12))
    body = _array("body", rows.body, np.int64, (nc, 2))
    if body.min(initial=0) < -1:
        raise ValueError(f"body of the rows has {body.min()}; allowed are indices of bodies, and -1 for no body")
    frame, arm = _array("frame", rows.frame, float, (nc, 9)), _array("arm", rows.arm, float, (nc, 6))
    return replace(rows, frame=frame, arm=arm, body=body, root=root, columns=columns)


def _blocks(rows: BlockRows) -> BlockRows:
    count, columns = len(rows.indices), operator.index(rows.columns)
    indptr = _array("indptr", rows.indptr, np.int64, (max(len(rows.indptr), 1),))
    if indptr[0] != 0 or indptr[-1] != count or (np.diff(indptr) < 0).any():
        raise ValueError(f"indptr of the rows does not ascend from 0 to the number of blocks, {count}")
    indices = _array("indices", rows.indices, np.int64, (count,))
    if indices.min(initial=0) < 0:
        raise ValueError(f"indices of the rows have {indices.min()}; allowed are indices of bodies")
    return BlockRows(indptr, indices, _array("blocks", rows.blocks, float, (count, 3, 6)), columns)


def _array(name: str, given: np.ndarray, kind: type, *shapes: tuple[int, ...]) -> np.ndarray:
    array = np.asarray(given)
    if array.shape not in shapes:
        raise ValueError(f"{name} of the rows has the shape {array.shape}; allowed is {' or '.join(map(str, shapes))}")
    if array.dtype.kind not in ("iu" if kind is np.int64 else "fiu") and array.size:
        raise ValueError(f"{name} of the rows has the type {array.dtype}; allowed is {np.dtype(kind).name}")
    return np.ascontiguousarray(array, dtype=kind)


def root_blocks(root: Array) -> Array:
    """Matrices in the format of `CompactRows.root` as blocks (n, 2, 3, 3)."""
    if root.shape[1] == 6:
        return root.reshape(-1, 2, 3, 1) * np.eye(3)
    return root.reshape(-1, 2, 6)[:, :, [[0, 1, 2], [1, 3, 4], [2, 4, 5]]]


def packed(blocks: Array) -> Array:
    """Symmetric blocks (n, 2, 3, 3) as (n, 12), the inverse of `root_blocks`."""
    return blocks.reshape(-1, 2, 9)[:, :, [0, 1, 2, 4, 5, 8]].reshape(-1, 12)


def block_rows(comm: MPI.Comm, rows: BlockRows | CompactRows) -> BlockRows:
    """The rows as 3 x 6 blocks; collective."""
    return rows if isinstance(rows, BlockRows) else rows.block_rows(comm)
