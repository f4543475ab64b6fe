"""Memory of the last impulses of contacts, also if their bodies have changed their rank since."""

from __future__ import annotations

import numpy as np
from mpi4py import MPI

from dem.arrays import Bools, Floats, Ints
from dem.exchange import exchange


class ImpulseMemory:
    """Impulses of the contacts of one step, by key.

    The normal impulse is kept as a number and the tangential one as a vector in the world, because the
    contact frames of the next step are others. Rows stay on the rank that stored them: most contacts are on the same
    rank a step later. What a rank does not find, and what it was not asked for, meets on ranks that a hash of the key
    tells.
    """

    def __init__(self, comm: MPI.Comm) -> None:
        self._comm = comm
        self.restore(np.zeros(0, np.int64), np.zeros((0, 4)))

    def remember(self, key: Ints, impulse: Floats, frame: Floats) -> None:
        """Replace the memory by impulses (nc, 3) of contacts with keys (nc,) and frames (nc, 3, 3)."""
        tangential = np.einsum("ci,cij->cj", impulse[:, 1:], frame[:, 1:])
        self.restore(key, np.concatenate([impulse[:, :1], tangential], axis=1))

    def recall(self, key: Ints, frame: Floats) -> tuple[Floats, Bools]:
        """Impulses (nc, 3) in the given frames (nc, 3, 3), zero where unknown, and the mask (nc,) of those
        known.

        Collective."""
        place, found = _places(self._key, key)
        stored = np.zeros((len(key), 4))
        stored[found] = self._impulse.take(place[found], axis=0)
        if self._comm.size > 1:
            missing, left = np.flatnonzero(~found), np.ones(len(self._key), dtype=bool)
            left[place[found]] = False
            row, impulse = self._elsewhere(key[missing], self._key[left], self._impulse[left])
            stored[missing[row]], found[missing[row]] = impulse, True
        # of the tangential vectors only the part that is tangential in these frames
        tangential = np.einsum("cij,cj->ci", frame[:, 1:], stored[:, 1:])
        return np.concatenate([stored[:, :1], tangential], axis=1), found

    def _elsewhere(self, asked: Ints, key: Ints, impulse: Floats) -> tuple[Ints, Floats]:
        """Which of the keys `asked` (m,) other ranks offer in their `key` (n,), and their impulses; collective."""
        comm, many = self._comm, len(asked)
        both = np.concatenate([asked, key])
        rows = {
            "key": both,
            "row": np.concatenate([np.arange(many), np.full(len(key), -1)]),  # -1: this one is offered
            "rank": np.full(len(both), comm.rank),
            "impulse": np.concatenate([np.zeros((many, 4)), impulse]),
        }
        # Fibonacci hashing: the low bits of keys are mostly zero and must not choose the rank.
        mixed = (both.astype(np.uint64) * np.uint64(0x9E3779B97F4A7C15)) >> np.uint64(32)
        met = exchange(comm, rows, (mixed % np.uint64(comm.size)).astype(np.int64))
        offered = np.flatnonzero(met["row"] < 0)
        offered = offered[np.argsort(met["key"][offered])]
        wanted = np.flatnonzero(met["row"] >= 0)
        place, known = _places(met["key"][offered], met["key"][wanted])
        wanted, offered = wanted[known], offered[place[known]]
        answer = exchange(comm, {"row": met["row"][wanted], "impulse": met["impulse"][offered]}, met["rank"][wanted])
        return answer["row"], answer["impulse"]

    def state(self) -> tuple[Ints, Floats]:
        """Keys (n,) and impulses (n, 4) (normal, tangential vector) that this rank stores, for `restore`."""
        return self._key, self._impulse

    def restore(self, key: Ints, stored: Floats) -> None:
        """Replace the memory by rows of `state`, distributed in any way."""
        order = np.argsort(key)
        self._key, self._impulse = key[order], stored.take(order, axis=0)


def _places(sorted_keys: Ints, keys: Ints) -> tuple[Ints, Bools]:
    """Where the keys (n,) are among sorted ones, and whether they are there."""
    place = np.searchsorted(sorted_keys, keys)
    known = place < len(sorted_keys)
    known[known] = sorted_keys[place[known]] == keys[known]
    return place, known
