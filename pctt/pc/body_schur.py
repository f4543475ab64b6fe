"""``-pc_type python -pc_python_type pctt.pc.BodySchur``: it solves contact systems through the bodies.

Let S = G G' + B, where B is block diagonal (3 x 3) and positive definite. Then S z = r is equivalent to

    K y = G' B^-1 r,   z = B^-1 (r - G y),    K = I + G' B^-1 G   (6 x 6 blocks per body),

and the residual of S is exactly G times the residual of K: r - S z = G (K y - G' B^-1 r). So it is safe to solve with K
by an inner Krylov method that stops when the residual of S is small enough. An approximate inverse of K is not safe,
because B^-1 multiplies its error. If B is tiny, B^-1 also multiplies rounding errors; ``richardson`` then refines the
solution of one solve. K is smaller than S, and it is far better conditioned if contacts slide or open.

The Mat S has its parts as attributes. ``contact_map`` is G, as ``pctt.blocks.BlockRows``, as
``pctt.contact_map.CompactRows``, or as a map with products. ``barrier`` has the blocks of B (nc, 3, 3). S itself may be
a function.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from pctt.block_diagonal import without_memory
from pctt.blocks import BlockRows
from pctt.body_matrix import BodyOperator, inverse_blocks
from pctt.contact_map import CompactRows, ContactMap, contact_map
from pctt.exchange import refuse
from pctt.ksp_options import entered, prefer_mumps, to_enter
from pctt.options import NOT_NEGATIVE, option
from pctt.pc.base import PythonPC
from pctt.pc.mat import residual_norm

_SCALAR_FORMAT = {"gamg", "hypre", "cholesky", "lu"}  # these have no code for block formats
_COARSE_SPACE = {"gamg", "python"}  # these use the rigid motions
TINY = float(np.finfo(float).tiny)
_FACTORS = {"ilu", "icc", "bjacobi", "cholesky", "lu"}


@dataclass(frozen=True)
class Options:
    """Options ``-pc_body_*``, after the prefix of the PC. The inner KSP has the additional prefix ``body_``."""

    rtol: float = option(
        0.0, "relative residual of S at which the solve with K stops; 0: half the tolerance of the KSP",
        check=NOT_NEGATIVE,
    )
    shift: float = option(
        0.03, "the diagonal blocks of the factorised matrix are enlarged by this part", check=NOT_NEGATIVE
    )
    least: float = option(
        0.1,
        "the factorised matrix lacks the blocks of K that have no entry above this part of the mass",
        check=NOT_NEGATIVE,
    )


class BodySchur(PythonPC):
    """The python PC. Use it with ``-ksp_type preonly``, ``richardson`` (iterative refinement) or ``fgmres``."""

    options_class = Options
    options_prefix = "pc_body_"
    options: Options
    needs_entries = False

    def create(self, pc: PETSc.PC) -> None:
        super().create(pc)
        self.ksp: PETSc.KSP = None  # before `build`
        self.solves = self.its = self._failure = 0
        self._rtol, self._atol = 1e-3, 0.0
        self._formed: PETSc.Mat | None = None  # the matrix of the inner preconditioner, if it is not the stiff part

    def build(self, pc: PETSc.PC, P: PETSc.Mat) -> None:
        self.release()
        self._take_map(P, P.getAttr("contact_map"))
        self.K = BodyOperator(self._G)
        points = P.getAttr("coordinates")
        self._y, self._rhs = self.K.mat.createVecs()
        self.ksp = PETSc.KSP().create(P.comm)
        prefix = (pc.getOptionsPrefix() or "") + "body_"
        self._options = to_enter(prefix, {"pc_type": "pbjacobi"}, P.comm.size)
        self.ksp.setOptionsPrefix(prefix)
        self.ksp.setType(PETSc.KSP.Type.CG)
        self.ksp.setNormType(PETSc.KSP.NormType.UNPRECONDITIONED)
        self.ksp.setTolerances(max_it=10_000)
        with entered(self._options):
            prefer_mumps(self.ksp.pc, PETSc.Options(prefix).getString("pc_type"))
            self.ksp.setFromOptions()
        if points is not None:
            self.K.whole.mat.setAttr("coordinates", self.K.whole.places(points))
            if self.ksp.pc.getType() in _COARSE_SPACE:
                self.K.whole.set_rigid_modes(points)
        # the residual of S is G times the inner one; the factor 2 because the power method gives a lower bound
        self._gain = 2 * float(np.sqrt(_largest_eigenvalue(self._G)))

    def update(self, pc: PETSc.PC, P: PETSc.Mat) -> None:
        """Compute K for the present barrier blocks."""
        given = P.getAttr("contact_map")
        if given is not self._given:  # of the same structure
            self._release_map()
            self._take_map(P, given)
            self.K.load(self._G)
        self.inverse_barrier = _inverse(P.comm.tompi4py(), P.getAttr("barrier"), self._G.rows)
        self.K.update(self.inverse_barrier)
        old, self._formed = self._formed, without_memory(self.K.mat, self.ksp.pc.getType())
        self.ksp.setOperators(self.K.mat, self._stiff_part() if self._formed is None else self._formed)
        with entered(self._options):
            self.ksp.setUp()
        if old is not None:
            old.destroy()

    def _stiff_part(self) -> PETSc.Mat:
        """The matrix of the inner preconditioner."""
        kind = self.ksp.pc.getType()
        least = self.options.least if kind in _FACTORS else 0.0
        entries = self.K.entries()
        P = entries.stiff_part(least, self.options.shift, scalar=kind in _SCALAR_FORMAT)
        if kind in _COARSE_SPACE:
            near = entries.mat.getNearNullSpace()
            if near.handle:
                P.setNearNullSpace(near)
            P.setAttr("coordinates", entries.mat.getAttr("coordinates"))
        return P

    def preSolve(self, pc: PETSc.PC, ksp: PETSc.KSP, b: PETSc.Vec, x: PETSc.Vec) -> None:
        self._rtol = self.options.rtol or 0.5 * ksp.getTolerances()[0]
        # refining solves need not reduce their own right side by rtol, only the residual of the whole
        self._failure = 0
        self._atol = self._rtol * b.norm() if ksp.getType() in ("preonly", "richardson") else 0.0

    def multiply(self, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """z = B^-1 (r - G K^-1 G' B^-1 r); the inner KSP solves with K."""
        r = x.array_r.reshape(-1, 3)
        self._rhs.array_w[:] = self._G.momenta(times(self.inverse_barrier, r)).ravel()
        self.ksp.setTolerances(rtol=1e-14, atol=(self._atol or self._rtol * x.norm()) / self._gain)
        self.ksp.solve(self._rhs, self._y)
        self.solves += 1
        self.its += self.ksp.getIterationNumber()
        if self.ksp.getConvergedReason() < 0:
            self._failure = self.ksp.getConvergedReason()
        y.array_w[:] = times(self.inverse_barrier, r - self._G.velocities(self._y.array_r)).ravel()

    def postSolve(self, pc: PETSc.PC, ksp: PETSc.KSP, b: PETSc.Vec, x: PETSc.Vec) -> None:
        """``preonly`` has no test of its own, so a failure of the inner method that spoils x is that of the solve."""
        if self.P is None or not self._failure or ksp.getType() != PETSc.KSP.Type.PREONLY:
            return
        if not residual_norm(pc.getOperators()[0], b, x) <= ksp.getTolerances()[0] * b.norm():  # also true for nan
            ksp.setConvergedReason(self._failure)

    def report(self) -> list[str]:
        inner = self.its / max(self.solves, 1)
        return [f"through the bodies: {self.solves} solves with K, {inner:.1f} inner iterations on average"]

    def release(self) -> None:
        if self.ksp is not None:
            for thing in (self.ksp, self.K, self._y, self._rhs, self._formed):
                if thing is not None:
                    thing.destroy()
            self._release_map()
            self.ksp = self._formed = None

    def _take_map(self, P: PETSc.Mat, given: ContactMap | BlockRows | CompactRows | None) -> None:
        """ValueError on all ranks if the map does not fit P, or is missing."""
        comm, rows = P.comm.tompi4py(), P.getLocalSize()[0]
        count = getattr(given, "rows", None)
        words = "" if count is not None and 3 * count == rows else f"the map of contacts has {count} rows, S has {rows}"
        words = words and f"{words}; allowed are three rows of S for each contact of the map"
        missing = "the Mat has no attribute contact_map; see docs/preconditioners.md"
        words = missing if given is None else words
        refuse(comm, words and f"{self.name}: {words}")
        assert given is not None
        self._given = given
        self._G = contact_map(comm, given) if isinstance(given, (BlockRows, CompactRows)) else given

    def _release_map(self) -> None:
        if self._G is not self._given:
            self._G.destroy()


def times(blocks: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Products of blocks (nc, 3, 3) with rows (nc, 3)."""
    return np.einsum("nij,nj->ni", blocks, x)


def _inverse(comm: MPI.Comm, barrier: np.ndarray | None, count: int) -> np.ndarray:
    """The inverses (count, 3, 3) of the blocks of B; ValueError on all ranks if a block is singular or missing."""
    wrong, inverse = "", np.zeros((0, 3, 3))
    if barrier is None:
        wrong = "is missing"
    elif np.shape(barrier) != (count, 3, 3):
        wrong = f"has the shape {np.shape(barrier)}"
    else:
        try:
            inverse = inverse_blocks(np.asarray(barrier, dtype=float))
        except np.linalg.LinAlgError:
            wrong = "has a singular block"
    refuse(comm, wrong and f"pctt.pc.BodySchur: barrier of the Mat {wrong}; allowed are {(count, 3, 3)} regular blocks")
    return inverse


def _largest_eigenvalue(G: ContactMap) -> float:
    """A lower bound of the largest eigenvalue of G G', by 15 steps of the power method."""
    g = np.random.default_rng(G.comm.rank).standard_normal((G.rows, 3))
    value = 1.0
    for _ in range(15):
        g /= max(np.sqrt(G.comm.allreduce(np.vdot(g, g))), TINY)
        momenta = G.momenta(g)
        value = G.comm.allreduce(np.vdot(momenta, momenta))
        g = G.velocities(momenta)
    return float(value)
