"""Products with the contact map by compiled loops over the contacts, without a matrix.

A product moves 136 bytes per contact (frame, arms, bodies); PETSc's block formats move 300 to 800. Bodies that other
ranks own are ghosts. While their values travel, the loops work on the contacts that do not touch ghosts.
"""

from __future__ import annotations

import dataclasses
from functools import cached_property
from types import ModuleType
from typing import Any

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from pctt.blocks import Array, BlockRows, diagonal_blocks, shaped
from pctt.contact_map import block_loops, compact_loops
from pctt.contact_map.ghosts import Ghosts
from pctt.contact_map.rows import CompactRows, block_rows, checked, packed, root_blocks


class ContactMap:
    """The contact map G of all ranks.

    Impulses and velocities of contacts are arrays (nc, 3), mass-scaled velocities of bodies are arrays (columns, 6).
    Flat arrays are allowed too; a ValueError for other shapes comes on this rank alone. All products are collective.

    given : the rows, `CompactRows` or `BlockRows`; ValueError on all ranks for wrong ones
    ghosts : those of another map between the same bodies, whose rows need no check
    precision : of the arrays that products take and return; single precision moves half of the bytes
    """

    def __init__(
        self,
        comm: MPI.Comm,
        given: BlockRows | CompactRows,
        ghosts: Ghosts | None = None,
        precision: type[np.floating] = np.float64,
    ):
        given = checked(comm, given) if ghosts is None else given
        self.comm, self.given, self.precision = comm, given, precision
        self.rows, self.columns = given.rows, given.columns
        if isinstance(given, CompactRows):
            self._take_compact(given, ghosts)
        else:
            self._take_blocks(given, ghosts)
        self._w, self._m = np.zeros((2, self._ghosts.nobody + 1, 6), precision)
        # two halves of the contacts that wait for no other rank, then the other contacts
        ends = [0, self._first_away // 2, self._first_away, self.rows]
        self._half, self._rest, self._away = (Contacts.of(self, *pair) for pair in zip(ends, ends[1:]))

    def _take_compact(self, given: CompactRows, ghosts: Ghosts | None) -> None:
        self._ghosts = ghosts or Ghosts(self.comm, given.columns, given.body)
        self._loops: ModuleType = compact_loops
        self._arrays: Any = (self._floats(given.frame), self._floats(given.arm), self._ghosts.body)
        self._root: Array | None
        self._mass: Array | None
        self._root, self._mass = self._floats(given.root), self._floats(_square(given.root))
        self._first_away = _first(self._is_ghost(self._ghosts.body).any(axis=1))
        self._flops = {"single": 45 * self.rows + 6 * self.columns, "through": 72 * self.rows + 18 * self.columns}

    def _take_blocks(self, given: BlockRows, ghosts: Ghosts | None) -> None:
        self._ghosts = ghosts or Ghosts(self.comm, given.columns, given.indices)
        self._loops = block_loops
        start = np.ascontiguousarray(given.indptr, dtype=np.int64)
        self._arrays = (self._floats(given.blocks), start, self._ghosts.body)
        self._root = self._mass = None
        contact = np.repeat(np.arange(self.rows), np.diff(start))
        away = np.zeros(self.rows, bool)
        away[contact[self._is_ghost(self._ghosts.body)]] = True
        self._first_away = _first(away)
        self._flops = {"single": 36 * len(given.blocks), "through": 72 * len(given.blocks) + 15 * self.rows}

    def _cut(self, first: int, last: int) -> Any:
        """The arrays of the contacts ``first`` to ``last - 1``."""
        if self._loops is compact_loops:
            return tuple(array[first:last] for array in self._arrays)
        blocks, start, body = self._arrays
        return blocks, start[first : last + 1], body

    def _is_ghost(self, body: np.ndarray) -> np.ndarray:
        return (body >= self._ghosts.own) & (body < self._ghosts.nobody)

    # -- products -------------------------------------------------------------------------------------------

    def velocities(self, v: Array) -> Array:
        """G v (nc, 3)."""
        y = np.zeros((self.rows, 3), self.precision)
        self._enter(self._root, shaped("velocities of bodies", v, self.columns, 6))
        self._add_velocities(y)
        PETSc.Log.logFlops(self._flops["single"])
        return y

    def momenta(self, g: Array) -> Array:
        """G' g (columns, 6)."""
        self._collect(g)
        PETSc.Log.logFlops(self._flops["single"])
        return self._left(self._root)

    def add_delassus(self, g: Array, y: Array) -> None:
        """y += G G' g; y (nc, 3) is C-contiguous."""
        y = shaped("velocities of contacts", y, self.rows, 3)
        self._collect(g)
        self._enter(self._mass, self._m)
        self._add_velocities(y)
        PETSc.Log.logFlops(2 * self._flops["single"])

    def weights(self, H: Array, symmetric: bool = True) -> Array:
        """Blocks H (nc, 3, 3) in the format of `through`: (nc, 6), or (nc, 9) if they are not symmetric."""
        weight = np.empty((self.rows, 6 if symmetric else 9), self.precision)
        self._loops.weights(*self._arrays, self._floats(H), weight)
        return weight

    def through(self, weight: Array, v: Array, out: Array) -> None:
        """out = v + G' H G v (columns, 6); out is C-contiguous."""
        v = v.reshape(-1, 6)
        self._m[:] = 0.0
        self._enter(self._root, v)
        self._half.add_through(weight, self._w, self._m)
        self._ghosts.end_update(self._w)
        self._away.add_through(weight, self._w, self._m)
        self._ghosts.begin_add(self._m)
        self._rest.add_through(weight, self._w, self._m)
        self._ghosts.end_add(self._m)
        np.add(v, self._left(self._root), out=out.reshape(-1, 6))
        PETSc.Log.logFlops(self._flops["through"])

    def _enter(self, scale: Array | None, v: Array) -> None:
        """Store R v, or v if there is no R, for the own bodies, and begin to send it to the ranks with ghosts of them.

        The caller must call `end_update` later.
        """
        if scale is None:
            self._w[: self.columns] = v[: self.columns]
        else:
            compact_loops.scale(scale, v, self._w)
        self._ghosts.begin_update(self._w)

    def _add_velocities(self, y: Array) -> None:
        self._half.add_velocities(self._w, y)
        self._rest.add_velocities(self._w, y)
        self._ghosts.end_update(self._w)
        self._away.add_velocities(self._w, y)

    def _collect(self, g: Array) -> None:
        """Collect the momenta that the impulses give to the bodies, not yet scaled by masses."""
        g = self._floats(shaped("impulses", g, self.rows, 3))
        self._m[:] = 0.0
        self._away.add_momenta(g, self._m)
        self._ghosts.begin_add(self._m)
        self._half.add_momenta(g, self._m)
        self._rest.add_momenta(g, self._m)
        self._ghosts.end_add(self._m)

    def _left(self, scale: Array | None) -> Array:
        """The scaled momenta of the own bodies: R m, or m if there is no R."""
        if scale is None:
            return self._m[: self.columns].copy()
        out = np.empty((self.columns, 6), self.precision)
        compact_loops.scale(scale, self._m, out)
        return out

    # -- parts of matrices ----------------------------------------------------------------------------------

    def contact_blocks(self) -> Array:
        """The diagonal blocks of G G' (nc, 3, 3)."""
        if isinstance(self.given, BlockRows):
            return diagonal_blocks(self.given)
        assert self._mass is not None
        out = np.empty((self.rows, 3, 3), self.precision)
        mass = np.zeros((self._ghosts.nobody + 1, 12), self.precision)
        mass[: self.columns] = packed(root_blocks(self._mass))
        self._ghosts.update(mass)
        self._loops.contact_blocks(*self._arrays, mass, out)
        return out

    def body_blocks(self, weight: Array) -> Array:
        """The diagonal blocks of I + G' H G (columns, 6, 6)."""
        blocks = np.zeros((self._ghosts.nobody + 1, 6, 6), self.precision)
        self._loops.add_body_blocks(*self._arrays, weight, blocks)
        self._ghosts.begin_add(blocks)
        self._ghosts.end_add(blocks)
        own = blocks[: self.columns]
        if self._root is not None and self._root.shape[1] == 6:
            own *= self._root[:, :, None] * self._root[:, None, :]
        elif self._root is not None:
            roots = np.zeros((self.columns, 6, 6))
            roots[:, :3, :3], roots[:, 3:, 3:] = root_blocks(self._root).transpose(1, 0, 2, 3)
            own = roots @ own @ roots
        own[:, range(6), range(6)] += 1.0
        return own

    def scaled(self, size: Array, precision: type[np.floating] = np.float64) -> ContactMap:
        """The map with its rows multiplied by ``size`` (nc, 3); it is valid until this map is destroyed."""
        if isinstance(self.given, CompactRows):
            frame = (self.given.frame.reshape(-1, 3, 3) * size[:, :, None]).reshape(-1, 9)
            return ContactMap(self.comm, dataclasses.replace(self.given, frame=frame), self._ghosts, precision)
        each = np.repeat(size, np.diff(self.given.indptr), axis=0)
        given = dataclasses.replace(self.given, blocks=self.given.blocks * each[:, :, None])
        return ContactMap(self.comm, given, self._ghosts, precision)

    def structure(self) -> tuple[np.ndarray, ...]:
        """Arrays that are equal where contacts and their bodies are."""
        given = self.given
        graph = (given.body,) if isinstance(given, CompactRows) else (given.indptr, given.indices)
        return (*graph, np.array([self.columns]))

    @cached_property
    def block_rows(self) -> BlockRows:
        """The rows as 3 x 6 blocks; collective at its first use."""
        return block_rows(self.comm, self.given)

    def _floats(self, array: Array) -> Array:
        return np.ascontiguousarray(array, dtype=self.precision)

    def destroy(self) -> None:
        self._ghosts.destroy()


@dataclasses.dataclass(frozen=True)
class Contacts:
    """A range of contacts of a map, and the loops over it."""

    loops: ModuleType
    here: slice
    arrays: tuple[np.ndarray, ...]

    @classmethod
    def of(cls, whole: ContactMap, first: int, last: int) -> Contacts:
        return cls(whole._loops, slice(first, last), whole._cut(first, last))

    def add_velocities(self, w: Array, y: Array) -> None:
        if self.here.stop > self.here.start:
            self.loops.add_velocities(*self.arrays, w, y[self.here])

    def add_momenta(self, g: Array, m: Array) -> None:
        if self.here.stop > self.here.start:
            self.loops.add_momenta(*self.arrays, g[self.here], m)

    def add_through(self, weight: Array, w: Array, m: Array) -> None:
        if self.here.stop > self.here.start:
            self.loops.add_through(*self.arrays, weight[self.here], w, m)


def _first(mask: np.ndarray) -> int:
    """The index of the first True, or the length."""
    return int(np.argmax(mask)) if mask.any() else len(mask)


def _square(root: Array) -> Array:
    """R^2, in the format of R."""
    if root.shape[1] == 6:
        return root * root
    blocks = root_blocks(root)
    return packed(blocks @ blocks)
