"""The halo of a rank: copies of bodies that other ranks own and that its contacts touch."""

from __future__ import annotations

import numpy as np
from mpi4py import MPI

from dem.arrays import Ints
from dem.exchange import exchange, offsets

TAG = 4711  # of the messages of halos; those of one pair of ranks keep their order

Pieces = list[tuple[int, slice]]


class Halo:
    """Which rows of a table of bodies are ghosts, and who owns them.

    Values of bodies are arrays (rows, ...) of any type. The first ``own`` rows are the bodies of this rank. Messages
    go only to ranks that share a ghost, one per rank and call; they need no other memory than their buffers.

    Attributes
    ----------
    own : number of own bodies
    rows : number of rows of a table
    ghosts : (n,) rows of the ghosts, in the order of their owners
    """

    def __init__(self, comm: MPI.Comm, own: int, rows: int, ghosts: Ints, owner: np.ndarray, place: Ints):
        """Ghosts in the rows ``ghosts`` (n,) are copies of the rows ``place`` (n,) of the ranks ``owner`` (n,);
        collective."""
        self.comm, self.own, self.rows = comm, own, rows
        self.ghosts = ghosts[np.argsort(owner, kind="stable")]
        asked = exchange(comm, {"row": place, "rank": np.full(len(place), comm.rank)}, owner)
        self._shared = asked["row"]  # own rows that are ghosts elsewhere, by rank
        self._owners, self._holders = _pieces(owner), _pieces(asked["rank"])
        self._open: list[MPI.Request] = []

    def update(self, values: np.ndarray) -> None:
        """Copy the values of the owners to the ghosts."""
        self.begin_update(values)
        self.end_update(values)

    def add(self, values: np.ndarray) -> None:
        """Add the values of the ghosts to those of the owners."""
        self.begin_add(values)
        self.end_add(values)

    def begin_update(self, values: np.ndarray) -> None:
        """Owners may change their values after this, and read those of ghosts after `end_update`."""
        self._arriving = np.empty((len(self.ghosts), *values.shape[1:]), values.dtype)
        self._send(values, self._shared, self._holders, self._owners)

    def end_update(self, values: np.ndarray) -> None:
        if self._wait():
            values[self.ghosts] = self._arriving

    def begin_add(self, values: np.ndarray) -> None:
        """Owners may still change their own values until `end_add`."""
        self._arriving = np.empty((len(self._shared), *values.shape[1:]), values.dtype)
        self._send(values, self.ghosts, self._owners, self._holders)

    def end_add(self, values: np.ndarray) -> None:
        if self._wait():
            for _, piece in self._holders:  # in the order of the ranks, so that sums repeat themselves
                values[self._shared[piece]] += self._arriving[piece]

    def _send(self, values: np.ndarray, rows: Ints, to: Pieces, by: Pieces) -> None:
        if to or by:
            leaving = values[rows]
            self._open = [self.comm.Irecv(self._arriving[piece], rank, TAG) for rank, piece in by]
            self._open += [self.comm.Isend(leaving[piece], rank, TAG) for rank, piece in to]

    def _wait(self) -> bool:
        """Whether there were messages, which are now here."""
        requests, self._open = self._open, []
        MPI.Request.Waitall(requests)
        return bool(requests)


def _pieces(rank: Ints) -> Pieces:
    """The ranks and their parts of a buffer that is sorted by rank, for the ranks (n,) of its rows in any order."""
    ranks, count = np.unique(rank, return_counts=True)
    ends = np.cumsum(count)
    return [(int(rank), slice(int(end - n), int(end))) for rank, n, end in zip(ranks, count, ends)]


def find_halo(comm: MPI.Comm, own: int, body: Ints) -> tuple[Halo, np.ndarray]:
    """The halo of a rank with ``own`` bodies whose contacts touch these, and local numbers of them; collective.

    body : global indices in any shape, -1 for no body. The local numbers, uint32 in the same shape, are first those of
    the own bodies, then those of the ghosts, and the last row of a table is that of no body.
    """
    starts = offsets(comm, own)
    first, last = starts[comm.rank], starts[comm.rank + 1]
    here = (body >= first) & (body < last)
    away = ~here & (body >= 0)
    names, place = np.unique(body[away], return_inverse=True)
    local = np.full(body.shape, own + len(names), np.uint32)
    local[here] = body[here] - first
    local[away] = own + place.ravel()
    owner = np.asarray(np.searchsorted(starts, names, side="right") - 1)
    ghosts = own + np.arange(len(names))
    return Halo(comm, own, own + len(names) + 1, ghosts, owner, names - starts[owner]), local
