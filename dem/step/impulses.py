"""Memory of the last impulses of contacts, also if their bodies have changed their rank since."""

from __future__ import annotations

import numpy as np
from mpi4py import MPI

from dem.arrays import Bools, Floats, Ints, Keys, mixed, places
from dem.compiled import loop
from dem.exchange import exchange


class ImpulseMemory:
    """Impulses of the contacts of one step, by key.

    The normal impulse is kept as a number and the tangential one as a vector in the world, because the
    contact frames of the next step are others. Rows stay on the rank that stored them: contacts are on the same rank a
    step later, unless grains were given to other ranks. Then what a rank does not find, and what it was not asked for,
    meets on ranks that a hash of the key tells.
    """

    def __init__(self, comm: MPI.Comm, parts: int = 1, columns: int = 0) -> None:
        """`parts`: how often a contact has three numbers; `columns`: how many others laws keep, see `ContactLaw`."""
        self._comm, self._parts, self.width = comm, parts, 4 * parts + columns
        self.restore(np.zeros(0, np.complex128), np.zeros((0, self.width)))

    def remember(self, key: Keys, impulse: Floats, frame: Floats, kept: Floats | None = None) -> None:
        """Replace the memory by impulses (parts nc, 3) of contacts with keys (nc,) and frames (nc, 3, 3), and by what
        laws `kept` (nc, columns) of them."""
        each = impulse.reshape(self._parts, len(key), 3)
        rows = [in_world(part, frame) for part in each]
        rows += [] if kept is None or not kept.shape[1] else [kept]
        self.restore(key, rows[0] if len(rows) == 1 else np.concatenate(rows, axis=1))

    def recall(self, key: Keys, frame: Floats, elsewhere: bool = True) -> tuple[Floats, Bools, Floats]:
        """Impulses (parts nc, 3) in the given frames (nc, 3, 3), zero where unknown, the mask (nc,) of those known, and
        what laws kept (nc, columns). `elsewhere`: whether other ranks may have stored them, as grains have changed
        their rank since; the same on all ranks.

        Collective."""
        place, stored = places(self._key, key), self._impulse
        if elsewhere and self._comm.size > 1:
            missing, left = np.flatnonzero(place < 0), np.ones(len(self._key), dtype=bool)
            left[place[place >= 0]] = False
            row, impulse = self._elsewhere(key[missing], self._key[left], self._impulse[left])
            place[missing[row]] = len(stored) + np.arange(len(row))
            stored = np.concatenate([stored, impulse])
        end = 4 * self._parts
        each, columns = [stored[:, first : first + 4] for first in range(0, end, 4)], stored[:, end:]
        found = [in_frames(np.ascontiguousarray(part), place, frame) for part in each]
        kept, known = np.zeros((len(place), columns.shape[1])), place >= 0
        if columns.shape[1]:
            kept[known] = columns[place[known]]
        return found[0] if self._parts == 1 else np.concatenate(found), known, kept

    def _elsewhere(self, asked: Keys, key: Keys, impulse: Floats) -> tuple[Ints, Floats]:
        """Which of the keys `asked` (m,) other ranks offer in their `key` (n,), and their impulses; collective."""
        comm, many = self._comm, len(asked)
        both = np.concatenate([asked, key])
        rows = {
            "key": both,
            "row": np.concatenate([np.arange(many), np.full(len(key), -1)]),  # -1: this one is offered
            "rank": np.full(len(both), comm.rank),
            "impulse": np.concatenate([np.zeros((many, self.width)), impulse]),
        }
        met = exchange(comm, rows, homes(both, comm.size))
        offered, wanted = np.flatnonzero(met["row"] < 0), np.flatnonzero(met["row"] >= 0)
        place = places(met["key"][offered], met["key"][wanted])
        wanted, offered = wanted[place >= 0], offered[place[place >= 0]]
        answer = exchange(comm, {"row": met["row"][wanted], "impulse": met["impulse"][offered]}, met["rank"][wanted])
        return answer["row"], answer["impulse"]

    def state(self) -> tuple[Keys, Floats]:
        """Keys (n,) and rows (n, 4 parts + columns) that this rank stores, for `restore`: of each part the normal
        impulse and the tangential vector, then what laws keep."""
        return self._key, self._impulse

    def restore(self, key: Keys, stored: Floats) -> None:
        """Replace the memory by rows of `state`, distributed in any way."""
        self._key, self._impulse = key, stored


@loop
def homes(key: Keys, ranks: int) -> Ints:
    """The ranks (n,) on which keys (n,) meet."""
    out = np.empty(len(key), np.int64)
    for n in range(len(key)):
        out[n] = (mixed(key[n]) >> np.uint64(32)) % np.uint64(ranks)
    return out


@loop
def in_world(impulse: Floats, frame: Floats) -> Floats:
    """Impulses (nc, 3) in frames (nc, 3, 3) as rows (nc, 4): the normal one, and the tangential one in the world."""
    out = np.empty((len(impulse), 4))
    for c in range(len(impulse)):
        out[c, 0] = impulse[c, 0]
        for k in range(3):
            out[c, 1 + k] = impulse[c, 1] * frame[c, 1, k] + impulse[c, 2] * frame[c, 2, k]
    return out


@loop
def in_frames(stored: Floats, place: Ints, frame: Floats) -> Floats:
    """The rows `place` (nc,) of `in_world` as impulses (nc, 3) in the given frames (nc, 3, 3), of which they may not be
    quite tangential; zero for the row -1."""
    out = np.zeros((len(place), 3))
    for c in range(len(place)):
        n = place[c]
        if n >= 0:
            out[c, 0] = stored[n, 0]
            for k in range(3):
                out[c, 1] += stored[n, 1 + k] * frame[c, 1, k]
                out[c, 2] += stored[n, 1 + k] * frame[c, 2, k]
    return out
