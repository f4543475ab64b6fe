"""Contact graphs, cone problems with a known optimum, and their parts on several ranks."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from mpi4py import MPI
from petsc4py import PETSc

from pctt.blocks import square_block_matrix
from pctt.ccp import BlockRows, ConeProblem

SELF = MPI.COMM_SELF


@dataclass(frozen=True)
class Graph:
    """All block rows of a contact map G: contact c has the blocks indptr[c] to indptr[c + 1]."""

    indptr: np.ndarray
    indices: np.ndarray
    blocks: np.ndarray
    bodies: int

    @property
    def contacts(self) -> int:
        return len(self.indptr) - 1

    def dense(self) -> np.ndarray:
        """G (3nc, 6 bodies), by its definition."""
        G = np.zeros((self.contacts, 3, self.bodies, 6))
        for c in range(self.contacts):
            for k in range(self.indptr[c], self.indptr[c + 1]):
                G[c, :, self.indices[k]] += self.blocks[k]
        return G.reshape(3 * self.contacts, 6 * self.bodies)

    def part(self, comm: MPI.Comm, contact_ends=None, body_ends=None) -> BlockRows:
        """This rank's rows; ``*_ends`` are the ends of the ranks' parts, equal parts without them."""
        contacts, bodies = part(comm, self.contacts, contact_ends), part(comm, self.bodies, body_ends)
        near = slice(self.indptr[contacts.start], self.indptr[contacts.stop])
        return BlockRows(
            self.indptr[contacts.start : contacts.stop + 1] - self.indptr[contacts.start],
            self.indices[near],
            self.blocks[near],
            bodies.stop - bodies.start,
        )


def part(comm: MPI.Comm, count: int, ends=None) -> slice:
    """The rows of ``count`` that this rank owns."""
    ends = [0, *(ends or [count * (rank + 1) // comm.size for rank in range(comm.size)])]
    return slice(ends[comm.rank], ends[comm.rank + 1])


def random_graph(
    seed: int, contacts: int, bodies: int, one_body: float = 0.2, hub: bool = False, mass_ratio: float = 1.0
) -> Graph:
    """Contacts between random bodies in random frames, a part ``one_body`` of them with one dynamic body.

    With ``hub`` half of the contacts touch the last body; masses spread over ``mass_ratio``.
    """
    rng = np.random.default_rng(seed)
    mass = mass_ratio ** rng.random(bodies)
    indptr, indices, blocks = [0], [], []
    for _ in range(contacts):
        count = 1 if bodies == 1 or rng.random() < one_body else 2
        touched = rng.choice(bodies, count, replace=False)
        if hub and rng.random() < 0.5 and bodies - 1 not in touched:
            touched[0] = bodies - 1
        frame = np.linalg.qr(rng.normal(size=(3, 3)))[0]
        for sign, body in zip((1.0, -1.0), touched):
            arm = 0.1 * rng.normal(size=3)
            turn = np.cross(arm, frame) / 0.05  # 0.05: the radius of gyration
            blocks.append(sign * np.hstack([frame, turn]) / np.sqrt(mass[body]))
            indices.append(body)
        indptr.append(len(indices))
    return Graph(
        np.array(indptr), np.array(indices, dtype=int), np.array(blocks).reshape(-1, 3, 6), bodies
    )


@dataclass(frozen=True)
class Known:
    """A cone problem N, r, mu with an optimal impulse g and *the* optimal velocity y = N g + r."""

    N: np.ndarray
    r: np.ndarray
    mu: np.ndarray
    g: np.ndarray
    y: np.ndarray

    @property
    def objective(self) -> float:
        """1/2 g'Ng + r'g, which is -1/2 g'Ng where g.y = 0."""
        return -0.5 * self.g.ravel() @ self.N @ self.g.ravel()


def known_optimum(seed: int, N: np.ndarray, mu: np.ndarray) -> Known:
    """The problem whose optimum is a random complementary pair: open, sticking and sliding contacts.

    open: g = 0, y inside the dual cone; sticking: g inside the cone, y = 0; sliding: g = s (1, mu e) and
    y = c (mu, -e) with a tangential unit vector e. Without friction y_t is free in a closed contact.
    """
    rng = np.random.default_rng(seed)
    count = len(mu)
    kind = rng.integers(3, size=count)
    e = rng.normal(size=(count, 2))
    e /= np.linalg.norm(e, axis=1)[:, None]
    size = rng.uniform(0.2, 2.0, count)
    inside = 0.7 * rng.random(count)
    g, y = np.zeros((count, 3)), np.zeros((count, 3))
    open_, sticks, slides = (kind == k for k in range(3))
    y[open_, 0] = size[open_]
    y[open_, 1:] = (size * inside / np.maximum(mu, 0.5))[open_, None] * e[open_]
    g[sticks, 0] = size[sticks]
    g[sticks, 1:] = (size * inside * mu)[sticks, None] * e[sticks]
    g[slides, 0] = size[slides]
    g[slides, 1:] = (size * mu)[slides, None] * e[slides]
    speed = rng.uniform(0.2, 2.0, count)
    y[slides, 0] = (speed * mu)[slides]
    y[slides, 1:] = -speed[slides, None] * e[slides]
    return Known(N, y - (N @ g.ravel()).reshape(-1, 3), mu, g, y)


def matrix(comm: MPI.Comm, N: np.ndarray, contact_ends=None):
    """A dense matrix as a Mat of block size 3, its rows over the ranks."""
    rows = part(comm, len(N) // 3, contact_ends)
    return square_block_matrix(comm, sp.csr_matrix(N)[3 * rows.start : 3 * rows.stop].tobsr((3, 3)))


def from_matrix(known: Known, comm: MPI.Comm = SELF) -> ConeProblem:
    """The problem given by its matrix N."""
    rows = part(comm, len(known.mu))
    return ConeProblem(comm, known.r[rows], known.mu[rows], N=matrix(comm, known.N))


def from_graph(
    known: Known, graph: Graph, comm: MPI.Comm = SELF, contact_ends=None, body_ends=None
) -> ConeProblem:
    """The problem given by the contact map of which N is the Gram matrix."""
    rows = part(comm, len(known.mu), contact_ends)
    return ConeProblem(comm, known.r[rows], known.mu[rows], G=graph.part(comm, contact_ends, body_ends))


def heap(seed: int = 0, contacts: int = 40, bodies: int = 12, mu=None, **graph) -> tuple[Known, Graph]:
    """A random problem of known optimum with its contact map; by default mu is 0.1 to 1, and N singular."""
    made = random_graph(seed, contacts, bodies, **graph)
    G = made.dense()
    if mu is None:
        mu = np.random.default_rng(seed + 1).uniform(0.1, 1.0, contacts)
    return known_optimum(seed + 2, G @ G.T, np.array(np.broadcast_to(mu, contacts), float)), made


def dense_of(mat: PETSc.Mat) -> np.ndarray:
    """All of a sequential Mat."""
    copy = mat.convert("dense", PETSc.Mat())
    values = copy.getDenseArray().copy()
    copy.destroy()
    return values
