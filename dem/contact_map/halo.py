"""The halo of a rank: copies of bodies that other ranks own and that its contacts touch."""

from __future__ import annotations

import math
import weakref

import numpy as np
from mpi4py import MPI

from dem.arrays import Ints
from dem.compiled import loop
from dem.exchange import exchange, offsets

TAG = 4711  # of the messages of halos; those of one pair of ranks keep their order

Pieces = list[tuple[int, slice]]


class Halo:
    """Which rows of a table of bodies are ghosts, and who owns them.

    Values of bodies are arrays (rows, ...) of any type. The first ``own`` rows are the bodies of this rank. Messages
    go only to ranks that share a ghost, one per rank and call.

    Attributes
    ----------
    own : number of own bodies
    rows : number of rows of a table
    ghosts : (n,) rows of the ghosts, in the order of their owners
    talks : whether this rank shares ghosts with others
    """

    def __init__(self, comm: MPI.Comm, own: int, rows: int, ghosts: Ints, owner: np.ndarray, place: Ints):
        """Ghosts in the rows ``ghosts`` (n,) are copies of the rows ``place`` (n,) of the ranks ``owner`` (n,);
        collective."""
        self.comm, self.own, self.rows = comm, own, rows
        self.ghosts = ghosts[owner.argsort(kind="stable")]
        asked = exchange(comm, {"row": place, "rank": np.full(len(place), comm.rank)}, owner)
        self._shared = asked["row"]  # own rows that are ghosts elsewhere, by rank
        self._owners, self._holders = _pieces(owner), _pieces(asked["rank"])
        self.talks = bool(self._owners or self._holders)
        self._messages: dict[tuple, Messages] = {}
        self._open: Messages | None = None

    def update(self, values: np.ndarray) -> None:
        """Copy the values of the owners to the ghosts."""
        if self.talks:
            self.begin_update(values)
            self.end_update(values)

    def add(self, values: np.ndarray) -> None:
        """Add the values of the ghosts to those of the owners."""
        if self.talks:
            self.begin_add(values)
            self.end_add(values)

    def lower(self, values: np.ndarray) -> None:
        """Lower the values of the owners to the least of their ghosts."""
        self.begin_add(values)
        for rows, arrived in self._wait():
            values[rows] = np.minimum(values[rows], arrived.reshape(-1, *values.shape[1:]))

    def begin_update(self, values: np.ndarray) -> None:
        """Owners may change their values after this, and read those of ghosts after `end_update`."""
        if self.talks:
            self._send(values, self._shared, self.ghosts, self._holders, self._owners)

    def end_update(self, values: np.ndarray) -> None:
        if self.talks:
            for rows, arrived in self._wait():
                _put(arrived, rows, _flat(values))

    def begin_add(self, values: np.ndarray) -> None:
        """Owners may still change their own values until `end_add`."""
        if self.talks:
            self._send(values, self.ghosts, self._shared, self._owners, self._holders)

    def end_add(self, values: np.ndarray) -> None:
        if self.talks:
            for rows, arrived in self._wait():  # in the order of the ranks, so that sums repeat themselves
                _add(arrived, rows, _flat(values))

    def _send(self, values: np.ndarray, rows: Ints, changed: Ints, to: Pieces, by: Pieces) -> None:
        """Begin to send ``rows`` of the values to some ranks; the rows ``changed`` are those of what others send."""
        kind = (rows is self.ghosts, values.shape[1:], values.dtype)
        if kind not in self._messages:
            self._messages[kind] = Messages(self.comm, kind, rows, changed, to, by)
        self._open = self._messages[kind]
        self._open.start(values)

    def _wait(self) -> list[tuple[Ints, np.ndarray]]:
        """Rows and what has arrived for them, as tables (rows, n), of each rank."""
        messages, self._open = self._open, None
        return messages.wait() if messages else []


class Messages:
    """The messages of a halo for tables of one width and type, with their memory: begun again and again."""

    def __init__(self, comm: MPI.Comm, kind: tuple, rows: Ints, changed: Ints, to: Pieces, by: Pieces):
        _, shape, dtype = kind
        self._rows, self._leaving = rows, np.empty((len(rows), *shape), dtype)
        arriving = np.empty((len(changed), *shape), dtype)
        self._parts = [(changed[piece], _flat(arriving[piece])) for _, piece in by]
        requests = [comm.Recv_init(arriving[piece], rank, TAG) for rank, piece in by]
        requests += [comm.Send_init(self._leaving[piece], rank, TAG) for rank, piece in to]
        self._requests = requests
        weakref.finalize(self, _free, requests)

    def start(self, values: np.ndarray) -> None:
        values.take(self._rows, axis=0, out=self._leaving, mode="clip")  # other modes take a copy
        MPI.Prequest.Startall(self._requests)

    def wait(self) -> list[tuple[Ints, np.ndarray]]:
        MPI.Request.Waitall(self._requests)
        return self._parts


def _flat(values: np.ndarray) -> np.ndarray:
    """A C-contiguous array (rows, ...) as a table (rows, n)."""
    return values.reshape(len(values), math.prod(values.shape[1:]))


@loop
def _put(values, rows, out):
    """out[rows] = values."""
    for k in range(len(rows)):
        row = rows[k]
        for n in range(values.shape[1]):
            out[row, n] = values[k, n]


@loop
def _add(values, rows, out):
    """out[rows] += values, where each row is there once."""
    for k in range(len(rows)):
        row = rows[k]
        for n in range(values.shape[1]):
            out[row, n] += values[k, n]


def _free(requests: list[MPI.Prequest]) -> None:
    for request in requests:
        if not MPI.Is_finalized():
            request.Free()


def _pieces(rank: Ints) -> Pieces:
    """The ranks and their parts of a buffer that is sorted by rank, for the ranks (n,) of its rows in any order."""
    if not len(rank):
        return []
    ranks, count = np.unique(rank, return_counts=True)
    ends = np.cumsum(count)
    return [(int(rank), slice(int(end - n), int(end))) for rank, n, end in zip(ranks, count, ends)]


def find_halo(comm: MPI.Comm, own: int, body: Ints) -> tuple[Halo, np.ndarray]:
    """Return the halo of a rank with ``own`` bodies whose contacts touch these, and local numbers of them; collective.

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
