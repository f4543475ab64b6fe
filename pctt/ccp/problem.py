"""The cone complementarity problem (CCP): min 1/2 g'Ng + r'g over the friction cones."""

from __future__ import annotations

from functools import cached_property

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from pctt.blocks import BlockRows, block_matrix
from pctt.ccp.cone import Array, project
from pctt.ccp.delassus import delassus, diagonal_blocks, local_blocks


class ConeProblem:
    """One step's cone problem, its contacts distributed over the ranks of ``comm``.

    N = G G' is given by the mass-scaled contact map G = D' M^-1/2 (3Nc x 6M), or directly (``N``).

    Attributes
    ----------
    r : (nc, 3) velocities of the contacts without impulses, plus gap/dt (m/s)
    mu : (nc,) friction coefficients
    contact_map : the block rows of G, or None
    point : (nc, 3) contact points (m) or None; orders the unknowns of hierarchical preconditioners
    key : (nc,) persistent names of the contacts or None
    size : contacts on all ranks, Nc
    """

    def __init__(
        self,
        comm: MPI.Comm,
        r: Array,
        mu: Array,
        *,
        G: BlockRows | None = None,
        N: PETSc.Mat | None = None,
        point: Array | None = None,
        key: np.ndarray | None = None,
    ):
        if (G is None) == (N is None):
            raise ValueError("a cone problem is given by either the map G or the matrix N")
        self.comm, self.point, self.key = comm, point, key
        self.r = np.ascontiguousarray(r, dtype=float).reshape(-1, 3)
        self.mu = np.ascontiguousarray(mu, dtype=float)
        if len(self.r) != len(self.mu):
            raise ValueError(f"{len(self.r)} contacts in r but {len(self.mu)} friction coefficients")
        bad = ~np.isfinite(self.r).all(1) | ~(np.isfinite(self.mu) & (self.mu >= 0))
        if self.sum(bad.sum()):
            raise ValueError(f"{self.sum(bad.sum())} contacts with a NaN, infinite or negative coefficient")
        self.size = self.sum(len(self.mu))
        self.contact_map, self._N = G, N
        if N is not None:
            self._in, self._out = N.createVecs()
        elif G is not None:
            self._G = block_matrix(comm, G)
            self._momentum, self._out = self._G.createVecs()
            self._in = self._out.duplicate()

    def __repr__(self) -> str:
        given = "N" if self.contact_map is None else "G"
        return f"ConeProblem({self.size} contacts, {self.comm.size} ranks, given by {given})"

    # -- the operator ---------------------------------------------------------------------------------------

    def product(self, g: Array) -> Array:
        """N g for impulses g (nc, 3): velocities of the contacts (nc, 3)."""
        self._in.array[:] = g.ravel()
        if self._N is not None:
            self._N.mult(self._in, self._out)
        else:
            self._G.multTranspose(self._in, self._momentum)
            self._G.mult(self._momentum, self._out)
        return self._out.array.reshape(-1, 3).copy()

    def natural_residual(self, g: Array, y: Array) -> float:
        """||g - P(g - y / mean diag N)|| / ||g||, velocities y = N g + r: the stop test of every solver."""
        moved = project(g - y / self.mean_diagonal, self.mu)
        distance, norm = np.sqrt(self.sum(np.array([np.vdot(g - moved, g - moved), np.vdot(g, g)])))
        if distance == 0:
            return 0.0
        return float(distance / norm) if norm > 0 else np.inf

    @cached_property
    def N(self) -> PETSc.Mat:
        """The Delassus matrix N as a Mat of block size 3 (BAIJ), built at its first use and kept."""
        return self._N if self.contact_map is None else delassus(self.comm, self.contact_map)

    @cached_property
    def diagonal_blocks(self) -> Array:
        """The 3 x 3 diagonal blocks of N (nc, 3, 3)."""
        return local_blocks(self._N) if self.contact_map is None else diagonal_blocks(self.contact_map)

    @cached_property
    def mean_diagonal(self) -> float:
        """Mean of diag(N) (1/kg); 1 for a problem without contacts."""
        trace = self.sum(np.trace(self.diagonal_blocks, axis1=1, axis2=2).sum())
        return trace / (3 * self.size) if trace > 0 else 1.0

    # -- reductions over all contacts -----------------------------------------------------------------------

    def sum(self, x):
        return self.comm.allreduce(x)

    def min(self, x: float) -> float:
        return self.comm.allreduce(x, op=MPI.MIN)

    def max(self, x: float) -> float:
        return self.comm.allreduce(x, op=MPI.MAX)

    def dot(self, x: Array, y: Array) -> float:
        return self.sum(float(np.vdot(x, y)))

    def norm(self, x: Array) -> float:
        return float(np.sqrt(self.dot(x, x)))

    def destroy(self) -> None:
        """Free the PETSc objects now, not when the garbage collector finds the cycle."""
        for name in ("_G", "_momentum", "_in", "_out"):
            if name in self.__dict__:
                self.__dict__.pop(name).destroy()
        if "N" in self.__dict__:
            self.__dict__.pop("N").destroy()
