"""Memory of the last impulses of contacts, also if their bodies have changed their rank since.

The memory is a directory distributed by a hash of the contact key: it does not depend on which rank owns a
contact, so that neither migration of bodies nor a restart on another number of ranks matters.
"""

from __future__ import annotations

import numpy as np
from mpi4py import MPI

from dem.arrays import Bools, Floats, Ints
from dem.compiled import loop
from dem.exchange import exchange


@loop
def in_the_world(impulse: Floats, frame: Floats) -> Floats:
    """Normal impulses and tangential vectors in the world (nc, 4), of impulses (nc, 3) in frames (nc, 3, 3)."""
    out = np.empty((len(frame), 4))
    for c in range(len(frame)):
        out[c, 0] = impulse[c, 0]
        for k in range(3):
            out[c, 1 + k] = impulse[c, 1] * frame[c, 1, k] + impulse[c, 2] * frame[c, 2, k]
    return out


@loop
def in_frames(stored: Floats, frame: Floats) -> Floats:
    """Impulses (nc, 3) in frames (nc, 3, 3), from rows (nc, 4) as `in_the_world` returns them; of the tangential
    vectors only the part that is tangential in these frames."""
    out = np.empty((len(frame), 3))
    for c in range(len(frame)):
        out[c, 0] = stored[c, 0]
        for i in range(1, 3):
            out[c, i] = stored[c, 1] * frame[c, i, 0] + stored[c, 2] * frame[c, i, 1] + stored[c, 3] * frame[c, i, 2]
    return out


class ImpulseMemory:
    """Impulses of the contacts of one step, by key.

    The normal impulse is kept as a number and the tangential one as a vector in the world, because the
    contact frames of the next step are others.
    """

    def __init__(self, comm: MPI.Comm) -> None:
        self._comm = comm
        self._key = np.zeros(0, np.int64)
        self._impulse = np.zeros((0, 4))

    def remember(self, key: Ints, impulse: Floats, frame: Floats) -> None:
        """Replace the memory by impulses (nc, 3) of contacts with keys (nc,) and frames (nc, 3, 3);
        collective."""
        self.restore(key, in_the_world(impulse, frame))

    def recall(self, key: Ints, frame: Floats) -> tuple[Floats, Bools]:
        """Impulses (nc, 3) in the given frames (nc, 3, 3), zero where unknown, and the mask (nc,) of those
        known.

        Collective."""
        count = len(key)
        rank = np.full(count, self._comm.rank)
        asked = exchange(self._comm, {"key": key, "rank": rank, "row": np.arange(count)}, self._home(key))
        place = np.searchsorted(self._key, asked["key"])
        known = place < len(self._key)
        known[known] = self._key[place[known]] == asked["key"][known]
        answer = {"row": asked["row"][known], "impulse": self._impulse.take(place[known], axis=0)}
        answer = exchange(self._comm, answer, asked["rank"][known])
        stored, found = np.zeros((count, 4)), np.zeros(count, dtype=bool)
        stored[answer["row"]], found[answer["row"]] = answer["impulse"], True
        return in_frames(stored, frame), found

    def state(self) -> tuple[Ints, Floats]:
        """Keys (n,) and impulses (n, 4) (normal, tangential vector) that this rank stores, for `restore`."""
        return self._key, self._impulse

    def restore(self, key: Ints, stored: Floats) -> None:
        """Replace the memory by rows of `state`, distributed in any way; collective."""
        rows = exchange(self._comm, {"key": key, "impulse": stored}, self._home(key))
        order = np.argsort(rows["key"])
        self._key, self._impulse = rows["key"][order], rows["impulse"].take(order, axis=0)

    def _home(self, key: Ints) -> Ints:
        """The ranks (n,) that store the keys."""
        # Fibonacci hashing: the low bits of keys are mostly zero and must not choose the rank.
        mixed = (key.astype(np.uint64) * np.uint64(0x9E3779B97F4A7C15)) >> np.uint64(32)
        return (mixed % np.uint64(self._comm.size)).astype(np.int64)
