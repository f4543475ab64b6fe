"""The operators of problems that are not given by frames and arms, and the Delassus matrix N = G G' as a Mat.

PETSc multiplies only scalar formats; on one block row per contact scipy's block product is several times
faster (n = 16, 134,547 contacts, one core: 0.45 s against 1.4 s and a slow conversion).
"""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np
import scipy.sparse as sp
from mpi4py import MPI
from petsc4py import PETSc

from dem.compiled import loop
from dem.contact_map import BlockRows, ContactMap, Halo, find_halo, loops
from dem.contact_map.map import shaped
from dem.contact_map.rows import checked
from dem.exchange import exchange, offsets, on_any
from pctt.blocks import Array, square_block_matrix

DENSE = 500  # contacts of a body beyond which its columns of G are dense, and would fill N


def rows_of(mat: PETSc.Mat) -> sp.csr_matrix:
    """This rank's rows of a Mat, their columns global; collective."""
    plain = mat.getType() in ("seqaij", "mpiaij", "seqbaij", "mpibaij")
    rows = mat if plain else mat.convert(PETSc.Mat.Type.AIJ, PETSc.Mat())
    indptr, indices, values = rows.getValuesCSR()
    if not plain:
        rows.destroy()
    return sp.csr_matrix((values, indices, indptr), shape=(mat.getLocalSize()[0], mat.getSize()[1]))


def rows_in_blocks(N: PETSc.Mat) -> sp.bsr_matrix:
    """This rank's rows of a Mat in 3 x 3 blocks, their columns global; collective."""
    return rows_of(N).tobsr((3, 3))


class GivenOperator:
    """N by its products, of a problem that knows no bodies, with the members of `ContactMap` that it can have: impulses
    take the place of momenta, and N g that of the velocities of contacts; an image has both, of all contacts.

    product : a function of impulses (nc, 3) that returns N g (nc, 3); collective
    blocks : (nc, 3, 3) the diagonal blocks of N
    """

    has_parts = False

    def __init__(self, comm: MPI.Comm, blocks: Array, product: Callable[[Array], Array] | None = None):
        self.comm, self.rows, self._blocks, self._product = comm, len(blocks), blocks, product
        self._size: Array | None = None

    def velocities(self, g: Array) -> Array:
        """N g (nc, 3)."""
        assert self._product is not None
        return self._product(shaped("impulses", g, self.rows, 3))

    def momenta(self, g: Array) -> Array:
        """g (nc, 3)."""
        return shaped("impulses", g, self.rows, 3).copy()

    def add_delassus(self, g: Array, y: Array) -> None:
        """y += N g; y (nc, 3)."""
        y += self._scaled_product(g)

    def _scaled_product(self, g: Array) -> Array:
        return self.velocities(g) if self._size is None else self._size * self.velocities(self._size * g)

    def image(self) -> Array:
        """Memory for the image (nc, 6) of impulses: x and N x."""
        return np.zeros((self.rows, 6), float if self._size is None else self._size.dtype)

    def find_image(self, x: Array, image: Array) -> None:
        image[:, :3], image[:, 3:] = x, self._scaled_product(x)

    def find_velocities(self, image: Array, last: Array, beta: float, before: Array, y: Array) -> None:
        y[:] = before + (image + beta * (image - last))[:, 3:]

    def energy_of_step(self, new: Array, image: Array, last: Array, beta: float) -> float:
        d = new - (image + beta * (image - last))
        return float(np.vdot(d[:, :3], d[:, 3:]))

    def contact_blocks(self) -> Array:
        """The diagonal blocks of N (nc, 3, 3)."""
        return self._blocks

    def scaled(self, size: Array, precision: type[np.floating] = np.float64) -> GivenOperator:
        """N with rows and columns multiplied by ``size`` (nc, 3), for products with impulses of this precision; it is
        valid until this object is destroyed."""
        other = copy.copy(self)
        other._size = size.astype(precision, copy=False)
        return other

    def structure(self) -> tuple[np.ndarray, ...]:
        """Arrays of this rank that are equal where the places of the blocks are, of which there are none here."""
        return (np.array([self.rows]),)

    def destroy(self) -> None:
        """Free the objects of PETSc."""


class GivenMatrix(GivenOperator):
    """N by its entries.

    local : this rank's rows in 3 x 3 blocks, their columns global. Of a Mat they are a copy. ValueError on all ranks if
        they have a NaN or an infinite number
    """

    def __init__(self, comm: MPI.Comm, N: PETSc.Mat | sp.bsr_matrix):
        self.local: sp.bsr_matrix = N if isinstance(N, sp.bsr_matrix) else rows_in_blocks(N)
        if on_any(comm, not np.isfinite(self.local.data).all())[0]:
            raise ValueError("N has a NaN or an infinite number")
        rows = len(self.local.indptr) - 1
        row, first = np.repeat(np.arange(rows), np.diff(self.local.indptr)), offsets(comm, rows)[comm.rank]
        near, blocks = first + row == self.local.indices, np.zeros((rows, 3, 3))
        blocks[row[near]] = self.local.data[near]
        super().__init__(comm, blocks)

    @cached_property
    def mat(self) -> PETSc.Mat:
        """N as a Mat (BAIJ), built at its first use and kept; collective."""
        return square_block_matrix(self.comm, self.local)

    @cached_property
    def _vectors(self) -> tuple[PETSc.Vec, PETSc.Vec]:
        return self.mat.createVecs()

    def velocities(self, g: Array) -> Array:
        g = shaped("impulses", g, self.rows, 3)
        if self.comm.size == 1:
            return _product(self.local.indptr, self.local.indices, self.local.data, np.ascontiguousarray(g, float))
        g_of_mat, y = self._vectors
        g_of_mat.array[:] = g.ravel()
        self.mat.mult(g_of_mat, y)
        return y.array.reshape(-1, 3).copy()

    def structure(self) -> tuple[np.ndarray, ...]:
        return self.local.indptr, self.local.indices

    def destroy(self) -> None:
        for thing in (*self.__dict__.pop("_vectors", ()), self.__dict__.pop("mat", None)):
            if thing is not None:
                thing.destroy()


class BlockMap(ContactMap):
    """The map G given by 3 x 6 blocks, as problems in files are.

    rows : ValueError on all ranks for wrong ones
    halo : that of another map between the same bodies, whose rows need no check
    """

    has_parts = False

    def __init__(
        self, comm: MPI.Comm, rows: BlockRows, halo: tuple[Halo, np.ndarray] | None = None,
        precision: type[np.floating] = np.float64,
    ):  # fmt: skip
        rows = checked(comm, rows) if halo is None else rows
        self.comm, self.source, self.precision = comm, rows, precision  # type: ignore[assignment]
        self.body_rows = self.block_rows = rows
        self.rows, self.columns = rows.rows, rows.columns
        self._found = halo or find_halo(comm, rows.columns, rows.indices)
        self.halo, body = self._found
        self._blocks = (np.ascontiguousarray(rows.blocks, precision), rows.indptr, body)

    def velocities(self, v: Array) -> Array:
        """G v (nc, 3)."""
        y = np.zeros((self.rows, 3), self.precision)
        loops.block_velocities(*self._blocks, self._with_ghosts(v), y)
        return y

    def _with_ghosts(self, v: Array) -> Array:
        """Velocities (halo.rows, 6) of this rank's bodies and of those that it only touches."""
        w = np.empty((self.halo.rows, 6), self.precision)
        w[: self.columns] = shaped("velocities of bodies", v, self.columns, 6)
        self.halo.update(w)
        return w

    def momenta(self, g: Array) -> Array:
        """G' g (columns, 6)."""
        m = np.zeros((self.halo.rows, 6), self.precision)
        loops.block_momenta(*self._blocks, np.ascontiguousarray(shaped("impulses", g, self.rows, 3), self.precision), m)
        self.halo.add(m)
        return m[: self.columns]

    def add_delassus(self, g: Array, y: Array) -> None:
        """y += G G' g; y (nc, 3)."""
        y += self.velocities(self.momenta(g))

    def image(self) -> Array:
        """Memory for an image: G'x (columns, 6)."""
        return np.zeros((self.columns, 6), self.precision)

    def find_image(self, x: Array, image: Array) -> None:
        image[:] = self.momenta(x)

    def find_velocities(self, image: Array, last: Array, beta: float, before: Array, y: Array) -> None:
        y[:] = before + self.velocities(image + image.dtype.type(beta) * (image - last))

    def energy_of_step(self, new: Array, image: Array, last: Array, beta: float) -> float:
        d = new - (image + image.dtype.type(beta) * (image - last))
        return float(np.vdot(d, d))

    def weights(self, H: Array, symmetric: bool = True) -> Array:
        """Blocks H (nc, 3, 3) in the format of `through`."""
        return np.ascontiguousarray(H, self.precision)

    def through(self, weight: Array, v: Array, out: Array) -> None:
        """out = v + G' H G v (columns, 6)."""
        m = np.zeros((self.halo.rows, 6), self.precision)
        loops.block_through(*self._blocks, weight, self._with_ghosts(v), m)
        self.halo.add(m)
        np.add(v.reshape(-1, 6), m[: self.columns], out=out.reshape(-1, 6))

    def contact_blocks(self) -> Array:
        """The diagonal blocks of G G' (nc, 3, 3)."""
        each = self.block_rows.blocks
        return sums_of(self._contact(), each @ each.transpose(0, 2, 1), self.rows)

    def body_blocks(self, weight: Array) -> Array:
        """The diagonal blocks of I + G' H G (columns, 6, 6)."""
        each = self.block_rows.blocks
        blocks = sums_of(self._found[1], each.transpose(0, 2, 1) @ weight[self._contact()] @ each, self.halo.rows)
        self.halo.add(blocks)
        return blocks[: self.columns] + np.eye(6)

    def scaled(self, size: Array, precision: type[np.floating] = np.float64) -> BlockMap:
        """The map with its rows multiplied by ``size`` (nc, 3)."""
        rows = replace(self.block_rows, blocks=self.block_rows.blocks * size[self._contact()][:, :, None])
        return BlockMap(self.comm, rows, self._found, precision)

    def structure(self) -> tuple[np.ndarray, ...]:
        """Arrays that are equal where contacts and their bodies are."""
        return self.block_rows.indptr, self.block_rows.indices, np.array([self.columns])

    def _contact(self) -> np.ndarray:
        """The contacts of the blocks."""
        return np.repeat(np.arange(self.rows), np.diff(self.block_rows.indptr))


class ColumnMap(BlockMap):
    """The map of a matrix whose columns are any unknowns of the mass one: six of them in a block."""


def without_dense_columns(comm: MPI.Comm, G: BlockRows) -> tuple[BlockRows, bool]:
    """G without the columns of the bodies with more than DENSE contacts, and whether there are such. Collective."""
    halo, body = find_halo(comm, G.columns, G.indices)
    count = np.bincount(body, minlength=halo.rows)
    halo.add(count)
    halo.update(count)
    kept = count[body] <= DENSE
    if not comm.allreduce(not kept.all(), MPI.LOR):
        return G, False
    before = np.concatenate([[0], np.cumsum(kept)])
    return BlockRows(before[G.indptr], G.indices[kept], G.blocks[kept], G.columns), True


def delassus(comm: MPI.Comm, G: BlockRows) -> PETSc.Mat:
    """N = G G' as a Mat (3Nc x 3Nc) of block size 3, rows distributed as those of G. Collective.

    The owners of the bodies multiply: N is the sum of G_b G_b' over the bodies b, with G_b the columns of a body. On
    several ranks the owners send the blocks to the ranks of their rows.
    """
    starts, bodies = offsets(comm, G.rows), offsets(comm, G.columns)
    first, total, last = starts[comm.rank], starts[-1], bodies[-1]
    # a contact without bodies in G needs a diagonal block too: it gets a body of its own, without mass
    lonely = np.flatnonzero(np.diff(G.indptr) == 0)
    column = np.concatenate([G.indices, last + first + lonely])
    owner = np.searchsorted(bodies, column, side="right") - 1
    owner[len(G.indices) :] = comm.rank
    contact = np.concatenate([np.repeat(np.arange(G.rows), np.diff(G.indptr)), lonely])
    blocks = np.concatenate([G.blocks, np.zeros((len(lonely), 3, 6))])
    rows = exchange(comm, {"contact": first + contact, "body": column, "block": blocks}, owner)
    names, row = np.unique(rows["contact"], return_inverse=True)
    _, column = np.unique(rows["body"], return_inverse=True)
    left = _block_rows(row, column, rows["block"], len(names))
    N = (left @ left.T).tobsr((3, 3)) if len(names) else sp.bsr_matrix((0, 0), blocksize=(3, 3))
    columns = names[N.indices]
    if comm.size > 1:
        row = np.repeat(names, np.diff(N.indptr))
        owner = np.searchsorted(starts, row, side="right") - 1
        parts = exchange(comm, {"row": row, "column": columns, "block": N.data}, owner)
        row, columns = np.divmod(np.unique((parts["row"] - first) * total + parts["column"]), max(total, 1))
        place = np.searchsorted(row * total + columns, (parts["row"] - first) * total + parts["column"])
        data = sums_of(place, parts["block"], len(row))
        N = sp.bsr_matrix((data, columns, np.searchsorted(row, np.arange(G.rows + 1))), shape=(3 * G.rows, 3 * total))
    return square_block_matrix(comm, sp.bsr_matrix((N.data, columns, N.indptr), shape=(3 * G.rows, 3 * total)))


def all_blocks(G: BlockRows) -> sp.bsr_matrix:
    """N = G G' of a problem on one rank, dense columns included."""
    starts = np.cumsum(np.bincount(G.indices + 1, minlength=G.columns + 1))
    indptr, indices, blocks = _all_blocks(G.indptr, G.indices, np.ascontiguousarray(G.blocks), starts)
    indices, blocks = indices[: indptr[-1]].copy(), blocks[: indptr[-1]].copy()
    return sp.bsr_matrix((blocks, indices, indptr), shape=(3 * G.rows,) * 2)


@loop
def _all_blocks(indptr, indices, blocks, start):
    """`start` (columns + 1,): of the blocks of each column, were they in the order of columns. Returns as many rows of
    the last two as are needed, and more."""
    count, columns, end = len(indptr) - 1, len(start) - 1, start.copy()
    contact, place = np.empty(len(indices), np.int64), np.empty(len(indices), np.int64)
    for c in range(count):
        for p in range(indptr[c], indptr[c + 1]):
            k = end[indices[p]]
            contact[k], place[k], end[indices[p]] = c, p, k + 1
    found = 0
    for k in range(columns):
        found += (start[k + 1] - start[k]) ** 2
    where, starts = np.empty(count, np.int64), np.zeros(count + 1, np.int32)
    where[:] = -1
    near, out = np.empty(found + count, np.int32), np.zeros((found + count, 3, 3))
    for c in range(count):
        first = last = starts[c]
        where[c], near[last] = last, c  # a contact without bodies in G needs a block too
        last += 1
        for p in range(indptr[c], indptr[c + 1]):
            for k in range(start[indices[p]], start[indices[p] + 1]):
                other, q = contact[k], place[k]
                if where[other] < first:
                    where[other], near[last] = last, other
                    last += 1
                for i in range(3):
                    for j in range(3):
                        for m in range(6):
                            out[where[other], i, j] += blocks[p, i, m] * blocks[q, j, m]
        starts[c + 1] = last
    return starts, near, out


@loop
def _product(indptr, indices, blocks, x):
    """Of block rows with the numbers x (nc, 3) of all contacts."""
    y = np.empty((len(indptr) - 1, 3))
    for c in range(len(y)):
        u, v, w = 0.0, 0.0, 0.0
        for p in range(indptr[c], indptr[c + 1]):
            i = indices[p]
            u += blocks[p, 0, 0] * x[i, 0] + blocks[p, 0, 1] * x[i, 1] + blocks[p, 0, 2] * x[i, 2]
            v += blocks[p, 1, 0] * x[i, 0] + blocks[p, 1, 1] * x[i, 1] + blocks[p, 1, 2] * x[i, 2]
            w += blocks[p, 2, 0] * x[i, 0] + blocks[p, 2, 1] * x[i, 1] + blocks[p, 2, 2] * x[i, 2]
        y[c, 0], y[c, 1], y[c, 2] = u, v, w
    return y


def ritz_values(product: Callable[[Array], Array], start: Array, total: Callable[[Any], Any]) -> Array:
    """The Ritz values, ascending, of a symmetric operator after 30 Lanczos steps from a vector with parts on all ranks;
    ``total`` sums over them. The vectors are kept, and made orthogonal twice, so that the values are right to rounding.
    An eigenvalue of -1 % of the largest shows after about 20 steps."""
    steps = 30
    size = np.sqrt(total(np.vdot(start, start)))
    if not size > 0.0:
        return np.zeros(1)
    basis, T = [start / size], np.zeros((steps, steps))
    for k in range(steps):
        w = product(basis[k])
        for _ in range(2):
            shares = total(np.array([np.vdot(q, w) for q in basis]))
            w = w - sum(share * q for share, q in zip(shares, basis))
            T[k, k] += shares[k]
        size = np.sqrt(total(np.vdot(w, w)))
        if k + 1 == steps or not size > 1e-10 * np.abs(T).max():
            break
        T[k, k + 1] = T[k + 1, k] = size
        basis.append(w / size)
    return np.linalg.eigvalsh(T[: k + 1, : k + 1])


def sums_of(row: np.ndarray, blocks: Array, count: int) -> Array:
    """Sums (count, ...) of the blocks (n, ...) of equal row. (numpy's add.at takes ten times as long.)"""
    add = sp.csr_matrix((np.ones(len(row)), (row, np.arange(len(row)))), shape=(count, len(row)))
    return (add @ blocks.reshape(len(row), int(np.prod(blocks.shape[1:])))).reshape(count, *blocks.shape[1:])


def _block_rows(row: np.ndarray, column: np.ndarray, blocks: Array, count: int) -> sp.bsr_matrix:
    """A matrix of ``count`` block rows from blocks (n, 3, 6) and their places (n,)."""
    order = np.lexsort((column, row))
    indptr = np.concatenate([[0], np.cumsum(np.bincount(row, minlength=count))])
    shape = (3 * count, 6 * (int(column.max(initial=-1)) + 1))
    return sp.bsr_matrix((blocks[order], column[order], indptr), shape=shape)
