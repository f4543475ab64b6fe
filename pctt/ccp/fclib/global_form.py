"""Elimination of the velocities v from global problems, M v = H r + f, u = H'v + w, the form in files of other
programs."""

from __future__ import annotations

import warnings

import numpy as np
import scipy.sparse as sp
from scipy.sparse.linalg import MatrixRankWarning, spsolve

from pctt.ccp.cone import Array
from pctt.ccp.fclib.stored import MIRRORED, FileFormatError, mirrored, symmetric_blocks

#: M_ij and M_ji of a symmetric M differ by no more than this part of sqrt(M_ii M_jj), which bounds both.
ROUNDING = 1e-8


def without_velocities(M: sp.csr_matrix, H: sp.csr_matrix, f: Array, w: Array) -> tuple[sp.bsr_matrix, Array, str]:
    """G or N of a global problem, q = w + H' M^-1 f, and in words what was done to M.

    M (n, n) masses, H (n, 3 nc), f (n,), w (3 nc,). The matrix is the map G = H' L^-T of bodies, with M = L L', where M
    has 6 x 6 blocks on its diagonal and nothing else, and otherwise N = H' M^-1 H. Raises FileFormatError where sizes
    do not fit together and where M is no matrix of masses.
    """
    if M.shape != (len(f), len(f)) or H.shape != (len(f), len(w)) or len(w) % 3:
        raise FileFormatError(f"M {M.shape}, H {H.shape}, f {f.shape} and w {w.shape} do not fit together")
    if not (np.isfinite(M.data).all() and (M.diagonal() > 0).all()):
        raise FileFormatError("its mass matrix is not positive")
    M, note = symmetric_masses(M)
    roots = _inverse_roots(M)
    if roots is None:
        H_over_M = _solve(M, H)
        return symmetric_blocks(H.T @ H_over_M)[0], w + H_over_M.T @ f, note
    G = H.T.tocsr()
    G.sort_indices()
    G = G.tobsr((3, 6))
    G.data = G.data @ roots[G.indices].transpose(0, 2, 1)
    return G, w + G @ (roots @ f.reshape(-1, 6, 1)).ravel(), note


def symmetric_masses(M: sp.csr_matrix, rounding: float = ROUNDING) -> tuple[sp.csr_matrix, str]:
    """M made exactly symmetric, and MIRRORED if it was one triangle; FileFormatError if it is neither that nor
    symmetric up to rounding."""
    whole = mirrored(M)
    if whole is not None:
        return whole, MIRRORED.format("M")
    bound = np.sqrt(M.diagonal())
    entries = abs(M - M.T).tocoo()
    off = entries.data > rounding * bound[entries.row] * bound[entries.col]
    if off.any():
        i, j = entries.row[off][0], entries.col[off][0]
        raise FileFormatError(
            f"its mass matrix is not symmetric: M[{i}, {j}] = {M[i, j]:.9g}, M[{j}, {i}] = {M[j, i]:.9g}; allowed is "
            "one triangle, or both equal up to rounding"
        )
    return (0.5 * (M + M.T)).tocsr(), ""


def _solve(M: sp.csr_matrix, H: sp.csr_matrix) -> sp.csr_matrix:
    """M^-1 H."""
    with warnings.catch_warnings():
        warnings.simplefilter("error", MatrixRankWarning)
        try:
            return sp.csr_matrix(spsolve(M.tocsc(), H.tocsc())).reshape(H.shape)
        except MatrixRankWarning:
            raise FileFormatError("its mass matrix is singular") from None


def _inverse_roots(M: sp.csr_matrix) -> Array | None:
    """L^-1 of the 6 x 6 diagonal blocks L L' of M (bodies, 6, 6); None if M is not made of such blocks."""
    if M.shape[0] % 6:
        return None
    entries = M.tocoo()
    entries.eliminate_zeros()
    if (entries.row // 6 != entries.col // 6).any():
        return None
    blocks = np.zeros((M.shape[0] // 6, 6, 6))
    blocks[entries.row // 6, entries.row % 6, entries.col % 6] = entries.data
    try:
        return np.linalg.inv(np.linalg.cholesky(blocks))
    except np.linalg.LinAlgError:
        raise FileFormatError("its mass matrix is not positive") from None
