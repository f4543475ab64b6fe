"""The preconditioner `BlockICC`: a threshold incomplete Cholesky factor by blocks, of the rows of each rank.

    -pc_type python -pc_python_type pctt.pc.BlockICC

Diagonal blocks of the Newton systems of contacts differ by many orders of magnitude, and PETSc's ILU and ICC, which
keep the pattern of the matrix, break down on them or gain little. Here the matrix is scaled by its diagonal blocks
first, and what is kept is chosen by size (`pctt.pc.incomplete_cholesky`).

Rows are eliminated along the longest extent of the points, a sweep through the bed. That needs less memory, takes fewer
iterations and breaks down less often than an order along a space-filling curve or by dissection
(docs/preconditioners.md).
"""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from petsc4py import PETSc
from scipy.sparse.csgraph import reverse_cuthill_mckee

from dem.exchange import on_all
from pctt.blocks import shell_of
from pctt.mat.order import places_of
from pctt.options import option, word_or_number
from pctt.pc.incomplete_cholesky import BAD_BLOCK, BAD_PIVOT, MOST, Array, Blocks, Factor, compile_loops, factorised
from pctt.pc.mat import Preconditioner, is_symmetric
from pctt.petsc import block_values, set_failed

_RAISED = 2.0  # factor on a shift with which a pivot was bad
_GREATEST = 16.0  # shift: a matrix that is scaled by its diagonal blocks has hardly any off them beside it
_TILT = np.array([1.0, 0.3, 0.1])  # of the sweep, by the extents of the points: rows of a lattice are not equal


@dataclass(frozen=True)
class Options:
    """Options ``-pc_bic_*``, after the prefix of the PC."""

    tau: float = option(
        0.05, "blocks of the factor below it are dropped, of the matrix scaled by its diagonal blocks",
        check=("a number >= 0 and below 1", lambda x: 0 <= x < 1),
    )
    shift: str = option(
        "auto", "added to the diagonal of the scaled matrix; auto: half of tau, and twice as much whenever a pivot is "
        "not positive",
        check=("auto or a number from 0 to 1e6", word_or_number("auto", lambda x: 0.0 <= x <= 1e6)),
    )  # fmt: skip


class BlockICC(Preconditioner):
    """The python PC; see the module and `Options`. It works on symmetric positive definite Mats of type AIJ, BAIJ,
    SBAIJ or dense with blocks of any size, and on shells of this project, of which it knows the diagonal blocks alone.

    The order of the rows is kept while the pattern of the matrix stays."""

    name = "pctt.pc.BlockICC"  #: for ``-pc_python_type``
    options_class = Options
    options_prefix = "pc_bic_"

    def create(self, pc: PETSc.PC) -> None:
        super().create(pc)
        compile_loops()
        self.factor: Factor | None = None
        self._layout: Blocks | None = None
        self._pattern: tuple[np.ndarray, ...] = ()
        self._shift = 0.0  # with which the last matrix of the same pattern had a factor
        self.setups, self.setup_s = 0, 0.0
        self._fills: list[float] = []  # least and greatest of all set-ups, over the ranks, and the greatest shift
        self._shifts: list[float] = []

    def destroy(self, pc: PETSc.PC) -> None:
        self.factor = None
        super().destroy(pc)

    def reset(self, pc: PETSc.PC) -> None:
        """Forget the matrix."""
        self.factor, self._pattern = None, ()

    def forget(self) -> None:
        self._pattern = ()

    # -- set-up ---------------------------------------------------------------------------------------------

    def setUp(self, pc: PETSc.PC) -> None:
        """ValueError on all ranks if the matrix is not square or has no entries, or if places do not fit it. If it is
        not positive definite, the KSP ends with PETSc's reason for a failed preconditioner."""
        start, P = time.perf_counter(), self.square(pc)
        comm = P.comm.tompi4py()
        with PETSc.Log.Event("BICSetUp"):
            pattern, values = _pattern_and_values(P)
            same = len(pattern) == len(self._pattern) and all(map(np.array_equal, pattern, self._pattern))
            if not on_all(comm, same):
                self._begin(pc, P, pattern)
            failure = self._factorise(values)
        found = comm.allgather((failure, self.factor and self.factor.fill, self.factor and self.factor.shift))
        failure = next((words for words, *_ in found if words), "")
        set_failed(pc, bool(failure))
        if failure:
            self.factor = None
            self.warn(comm, f"{failure}: there is no preconditioner")
        else:
            self._fills = [f(self._fills + [fill for _, fill, _ in found]) for f in (min, max)]
            self._shifts = [f(self._shifts + [shift for *_, shift in found]) for f in (min, max)]
        self.setups += 1
        self.setup_s += time.perf_counter() - start

    def _begin(self, pc: PETSc.PC, P: PETSc.Mat, pattern: tuple[np.ndarray, ...]) -> None:
        """Take what depends on the pattern of P only; collective."""
        if not is_symmetric(P):
            self.warn(P.comm.tompi4py(), "the matrix is not symmetric, so a Cholesky factor may be useless")
        self.places = places_of(P, (pc.getDM(), pc.getOperators()[0].getDM()), self._points)
        size, block, (indptr, indices) = P.getLocalSize()[0], P.getBlockSize(), pattern
        from_rows = len(indptr) == size + 1 and size > 0 and not (block == 3 and _has_blocks(P))
        graph = sp.csr_matrix((np.ones(len(indices)), indices, indptr), shape=(len(indptr) - 1,) * 2)
        if self.places.points is not None:
            order = _sweep(self.places.points)
            if from_rows and block > 1:
                order = np.add.outer(block * order, np.arange(block)).ravel()
        elif graph.nnz:
            order = reverse_cuthill_mckee(graph, symmetric_mode=True).astype(np.int64)
        else:  # a rank without rows
            order = np.arange(graph.shape[0])
        self._source: np.ndarray | None = None
        if from_rows:
            self._layout, self._source = Blocks.from_rows(graph, order)
        else:
            self._layout = Blocks.from_blocks(indptr, indices, order)
        self._pattern, self._shift = tuple(array.copy() for array in pattern), 0.0

    def _factorise(self, values: Array) -> str:
        """Make the factor of this rank's rows; why there is none, or nothing."""
        assert self._layout is not None
        if not np.isfinite(values).all():
            return "the matrix has entries that are NaN or infinite"
        blocks = values.reshape(-1, 3, 3) if self._source is None else np.append(values, 0.0)[self._source]
        tau, named = self.options.tau, f"-{self.prefix}{self.options_prefix}"
        automatic = self.options.shift == "auto"
        shift = max(0.5 * tau, self._shift) if automatic else float(self.options.shift)
        while True:
            found = factorised(self._layout, blocks, tau, shift)
            if isinstance(found, Factor):
                self.factor, self._shift = found, shift
                return ""
            if found == BAD_BLOCK:
                return "a diagonal block of the matrix is not positive definite"
            if not automatic or shift >= _GREATEST:
                why = f"a pivot is not positive with {named}shift {shift:g}: raise it, or leave it to auto"
                full = f"the factor has more than {MOST:g} times the entries of the matrix: raise {named}tau"
                return why if found == BAD_PIVOT else full
            shift = max(_RAISED * shift, 1e-3)

    # -- application ----------------------------------------------------------------------------------------

    def apply(self, pc: PETSc.PC, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """y = (L L')^-1 x on this rank's rows; if the set-up failed, y has no numbers."""
        if not self._pattern:  # PETSc does not set up a new context of a PC that is set up (`-pc_python_type`)
            self.setUp(pc)
        if self.factor is None:
            y.set(np.inf)
            return
        with PETSc.Log.Event("BICApply"):
            self.factor.solve(x.array_r, y.array_w)
            PETSc.Log.logFlops(self.factor.flops)

    applyTranspose = apply  # noqa: N815 - as PETSc names it

    # -- words ----------------------------------------------------------------------------------------------

    def report(self) -> list[str]:
        source = self.places.source
        order = "reverse Cuthill-McKee" if source == "nothing" else f"a sweep along the longest extent of {source}"
        return [
            f"block incomplete Cholesky: drop tolerance {self.options.tau:g}, shift {self.options.shift}, "
            + (self.what() or "made for no system yet"),
            f"set-ups {self.setups} ({self.setup_s:.3g} s), rows ordered by {order}",
        ]

    def what(self) -> str:
        """What the factors were: their blocks as a multiple of those of the matrix, and the shifts."""
        if not self._fills:
            return ""
        fill, shift = (_range(values) for values in (self._fills, self._shifts))
        return f"fill {fill}, shift {shift}"


def _range(values: list[float]) -> str:
    low, high = (f"{value:.2g}" for value in values)
    return low if low == high else f"{low} to {high}"


def _sweep(points: np.ndarray) -> np.ndarray:
    """Points (n, d) in order along their longest extent, tilted a little."""
    extent = np.ptp(points, axis=0) if len(points) else np.zeros(points.shape[1])
    axes = np.argsort(-extent, kind="stable")
    return np.argsort(points[:, axes] @ _TILT[: len(axes)], kind="stable")


def _has_blocks(P: PETSc.Mat) -> bool:
    return P.getType() in ("seqbaij", "mpibaij") or shell_of(P) is not None


def _pattern_and_values(P: PETSc.Mat) -> tuple[tuple[np.ndarray, np.ndarray], Array]:
    """The pattern (CSR) of this rank's square part of P and its values: transposed blocks (nb, 3, 3) of a BAIJ Mat with
    such blocks, the entries of others. ValueError on all ranks if P has none."""
    shell = shell_of(P)
    if shell is not None and shell.blocks is not None and P.getBlockSize() == 3:
        count = len(shell.blocks)
        return (np.arange(count + 1), np.arange(count)), np.ascontiguousarray(shell.blocks.transpose(0, 2, 1))
    kind = P.getType().removeprefix("seq").removeprefix("mpi")
    if not kind.startswith(("aij", "baij", "sbaij", "dense")):
        allowed = "allowed are aij, baij, sbaij, dense"
        raise ValueError(f"{BlockICC.name}: a Mat of type {P.getType()} has no entries to read; {allowed}")
    if kind.startswith("baij") and P.getBlockSize() == 3:
        own = P.getDiagonalBlock()
        return own.getRowIJ(compressed=True), block_values(own)
    rows = P if kind in ("aij", "baij") else P.convert(PETSc.Mat.Type.AIJ, PETSc.Mat())
    indptr, indices, values = rows.getDiagonalBlock().getValuesCSR()
    if rows is not P:
        rows.destroy()
    return (indptr, indices), values
