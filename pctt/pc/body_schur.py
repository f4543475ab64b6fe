"""``-pc_type python -pc_python_type pctt.pc.BodySchur``: contact systems solved through the bodies.

With S = G G' + B, B block diagonal (3 x 3) and positive definite, S z = r is

    K y = G' B^-1 r,   z = B^-1 (r - G y),    K = I + G' B^-1 G   (6 x 6 blocks per body),

and the residual of S is exactly G times the residual of K: r - S z = G (K y - G' B^-1 r). An inner Krylov method on K,
stopped by what that leaves in S, is therefore safe, where a merely approximate inverse of K is not: its error comes
back multiplied by B^-1. K is smaller than S, and far better conditioned where contacts slide or open.

The Mat S brings what it is made of as attributes: ``contact_map``, G as ``pctt.blocks.BlockRows``, and ``barrier``, the
blocks of B (nc, 3, 3).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from petsc4py import PETSc

from pctt.blocks import BlockRows, block_matrix
from pctt.options import NOT_NEGATIVE, option
from pctt.pc.base import PythonPC, factor_within_ranks


@dataclass(frozen=True)
class Options:
    """Options ``-pc_body_*``, behind the prefix of the PC. The inner KSP has the further prefix ``body_``."""

    rtol: float = option(
        0.0, "residual of S to which K is solved, relative; 0: half the tolerance of the KSP", check=NOT_NEGATIVE
    )
    shift: float = option(
        0.03, "part by which the diagonal blocks are enlarged in the matrix that is factorised", check=NOT_NEGATIVE
    )


class BodySchur(PythonPC):
    """The python PC; used with ``-ksp_type preonly`` or ``fgmres``."""

    options_class = Options
    options_prefix = "pc_body_"
    options: Options

    def create(self, pc: PETSc.PC) -> None:
        super().create(pc)
        self.ksp: PETSc.KSP | None = None
        self.solves = self.its = 0
        self._rtol = 1e-3

    def build(self, pc: PETSc.PC, P: PETSc.Mat) -> None:
        G = P.getAttr("contact_map")
        if G is None:
            raise ValueError("pctt.pc.BodySchur: the Mat has no attribute contact_map; see the class's module")
        self.destroy(pc)
        self._row = np.repeat(np.arange(len(G.indptr) - 1), np.diff(G.indptr))
        self._pairs = _pairs(G.indptr)
        self.K = _body_matrix(P.comm, G)
        self.shifted: PETSc.Mat | None = None
        self._y, self._rhs = self.K.createVecs()
        self.ksp = PETSc.KSP().create(P.comm)
        prefix = (pc.getOptionsPrefix() or "") + "body_"
        factor_within_ranks(prefix, P.comm.size)
        self.ksp.setOptionsPrefix(prefix)
        self.ksp.setType(PETSc.KSP.Type.CG)
        self.ksp.setNormType(PETSc.KSP.NormType.UNPRECONDITIONED)
        self.ksp.setTolerances(max_it=10_000)
        self.ksp.pc.setType(PETSc.PC.Type.PBJACOBI)
        self.ksp.setFromOptions()
        self._G = block_matrix(P.comm, G)
        self._contact = self._G.createVecLeft()
        # an inner residual enters that of S through G; twice, as the power method stays below
        self._gain = 2 * float(np.sqrt(_largest_eigenvalue(self._G)))

    def update(self, pc: PETSc.PC, P: PETSc.Mat) -> None:
        """K for the present barrier blocks."""
        G = P.getAttr("contact_map")
        barrier = P.getAttr("barrier")
        floor = 1e-14 * np.trace(barrier, axis1=1, axis2=2)  # a block that rounding has made singular
        self.inverse_barrier = np.linalg.inv(barrier + floor[:, None, None] * np.eye(3))
        weighted = self.inverse_barrier[self._row] @ G.blocks
        i, j = self._pairs
        contributions = G.blocks[i].transpose(0, 2, 1) @ weighted[j]
        self.K.zeroEntries()
        add = PETSc.InsertMode.ADD_VALUES
        if len(i):
            rows, columns = (G.indices[k].astype(PETSc.IntType)[:, None] for k in (i, j))
            self.K.setValuesBlockedRCV(rows, columns, contributions.reshape(len(i), -1), add)
        first, last = self.K.getOwnershipRange()
        bodies = np.arange(first // 6, last // 6, dtype=PETSc.IntType)[:, None]
        if len(bodies):
            self.K.setValuesBlockedRCV(bodies, bodies, np.tile(np.eye(6).ravel(), (len(bodies), 1)), add)
        self.K.assemble()
        assert self.ksp is not None
        self.ksp.setOperators(self.K, self._enlarged_diagonal(bodies) if self.options.shift else self.K)
        self.ksp.setUp()

    def preSolve(self, pc: PETSc.PC, ksp: PETSc.KSP, b: PETSc.Vec, x: PETSc.Vec) -> None:
        self._rtol = self.options.rtol or 0.5 * ksp.getTolerances()[0]

    def apply(self, pc: PETSc.PC, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """z = B^-1 (r - G K^-1 G' B^-1 r), K by the inner KSP."""
        assert self.ksp is not None
        r = x.array_r.reshape(-1, 3)
        self._contact.array_w[:] = (self.inverse_barrier @ r[:, :, None]).ravel()
        self._G.multTranspose(self._contact, self._rhs)
        self.ksp.setTolerances(rtol=1e-14, atol=self._rtol * x.norm() / self._gain)
        self.ksp.solve(self._rhs, self._y)
        self.solves += 1
        self.its += self.ksp.getIterationNumber()
        self._G.mult(self._y, self._contact)
        rest = r - self._contact.array_r.reshape(-1, 3)
        y.array_w[:] = (self.inverse_barrier @ rest[:, :, None]).ravel()

    def _enlarged_diagonal(self, bodies: np.ndarray) -> PETSc.Mat:
        """K with its diagonal blocks times 1 + shift: without, incomplete factorisations break down."""
        if self.shifted is None:
            self.shifted = self.K.duplicate(copy=True)
        else:
            self.K.copy(self.shifted, PETSc.Mat.Structure.SAME_NONZERO_PATTERN)
        if len(bodies):
            diagonal = np.linalg.inv(self.K.invertBlockDiagonal().reshape(-1, 6, 6))
            enlarged = self.options.shift * diagonal.reshape(-1, 36)
            self.shifted.setValuesBlockedRCV(bodies, bodies, enlarged, PETSc.InsertMode.ADD_VALUES)
        self.shifted.assemble()
        return self.shifted

    def report(self) -> list[str]:
        inner = self.its / max(self.solves, 1)
        return [f"through the bodies: {self.solves} solves with K, {inner:.1f} inner iterations on average"]

    def destroy(self, pc: PETSc.PC) -> None:
        if self.ksp is not None:
            for thing in (self.ksp, self.K, self._G, self._y, self._rhs, self._contact):
                thing.destroy()
            if self.shifted is not None:
                self.shifted.destroy()
            self.ksp = None


def _pairs(indptr: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """All ordered pairs of entries of the same block row, itself included."""
    count = np.diff(indptr)
    start = np.repeat(indptr[:-1], count**2)
    width = np.repeat(count, count**2)
    within = np.arange(len(start)) - np.repeat(np.cumsum(count**2) - count**2, count**2)
    return start + within // np.maximum(width, 1), start + within % np.maximum(width, 1)


def _body_matrix(comm: PETSc.Comm, G: BlockRows) -> PETSc.Mat:
    """K's structure: a block per body and per pair of bodies in contact."""
    degree = PETSc.Vec().createMPI((G.columns, PETSc.DETERMINE), comm=comm)
    degree.setValues(G.indices.astype(PETSc.IntType), np.ones(len(G.indices)), PETSc.InsertMode.ADD_VALUES)
    degree.assemble()
    most = (degree.array_r + 1).astype(PETSc.IntType)
    total = degree.getSize()
    degree.destroy()
    K = PETSc.Mat().create(comm)
    K.setSizes(((6 * G.columns, PETSc.DETERMINE), (6 * G.columns, PETSc.DETERMINE)))
    K.setBlockSize(6)
    K.setType(PETSc.Mat.Type.BAIJ)
    K.setPreallocationNNZ((np.minimum(most, max(G.columns, 1)), np.minimum(most, max(total - G.columns, 1))))
    K.setOption(PETSc.Mat.Option.SYMMETRIC, True)
    return K


def _largest_eigenvalue(G: PETSc.Mat, iterations: int = 15) -> float:
    """Of G G', from below, by the power method."""
    g, momentum = G.createVecLeft(), G.createVecRight()
    g.setRandom()
    value = 1.0
    for _ in range(iterations):
        g.normalize()
        G.multTranspose(g, momentum)
        value = momentum.norm() ** 2
        G.mult(momentum, g)
    g.destroy()
    momentum.destroy()
    return value
