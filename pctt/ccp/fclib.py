"""Cone problems from FCLIB files (HDF5), the library of friction contact problems of Acary et al. (2014).

A local problem holds W and q of u = W r + q; a global one M, H, f, w of M v = H r + f, u = H'v + w. Either
way the cone problem has N = W = H' M^-1 H and r = q = w + H' M^-1 f. Bilateral constraints (``G`` and ``b``
of a global problem) are not part of a cone problem and are refused.
"""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
import scipy.sparse as sp
from mpi4py import MPI
from scipy.sparse.linalg import spsolve

from pctt.blocks import square_block_matrix
from pctt.ccp.problem import ConeProblem


class FileFormatError(ValueError):
    """A file that is no FCLIB problem, or one that is not a cone problem."""


def read(path: str | Path, comm: MPI.Comm) -> ConeProblem:
    """The cone problem of an FCLIB file, its contacts in equal parts over the ranks.

    Raises FileFormatError on every rank where the file cannot be read as one.
    """
    N = q = mu = error = None
    if comm.rank == 0:
        try:
            N, q, mu = _read(path)
        except (OSError, LookupError, ValueError, TypeError, RuntimeError) as problem:  # h5py's, scipy's
            error = f"{path}: no FCLIB problem: {problem}"
    error = comm.bcast(error)
    if error:
        raise FileFormatError(error)
    N, q, mu = comm.bcast((N, q, mu))
    first, last = (len(mu) * rank // comm.size for rank in (comm.rank, comm.rank + 1))
    rows = N[3 * first : 3 * last].tobsr((3, 3))
    return ConeProblem(comm, q.reshape(-1, 3)[first:last], mu[first:last], N=square_block_matrix(comm, rows))


def _read(path: str | Path) -> tuple[sp.csr_matrix, np.ndarray, np.ndarray]:
    """N symmetrised, q, mu of a file."""
    with h5py.File(path, "r") as file:
        if "fclib_local" in file:
            group = file["fclib_local"]
            N, q = _matrix(group["W"]), group["vectors/q"][:]
        elif "fclib_global" in file:
            group = file["fclib_global"]
            if "G" in group:
                raise FileFormatError("it has bilateral constraints (G), which a cone problem has not")
            M, H = _matrix(group["M"]), _matrix(group["H"])
            H_over_M = _inverse(M) @ H
            N, q = H.T @ H_over_M, group["vectors/w"][:] + H_over_M.T @ group["vectors/f"][:]
        else:
            raise FileFormatError("it has neither fclib_local nor fclib_global")
        mu = group["vectors/mu"][:]
        if int(np.ravel(group["spacedim"][()])[0]) != 3:
            raise FileFormatError("its space dimension is not 3")
    if N.shape != (3 * len(mu), 3 * len(mu)) or len(q) != 3 * len(mu):
        raise FileFormatError(
            f"{len(mu)} friction coefficients, but a matrix {N.shape} and a vector {q.shape}"
        )
    N = sp.csr_matrix(N)
    if not (np.isfinite(N.data).all() and np.isfinite(q).all() and (np.isfinite(mu) & (mu >= 0)).all()):
        raise FileFormatError("it has a NaN, an infinite value or a negative friction coefficient")
    return (0.5 * (N + N.T)).tocsr(), q, mu


def _matrix(group: h5py.Group) -> sp.csr_matrix:
    """A matrix in triplets (nz >= 0: rows i, columns p, duplicates summed), CSC (-1) or CSR (-2)."""
    m, n, nz = (int(np.ravel(group[name][()])[0]) for name in ("m", "n", "nz"))
    i, p, x = (group[name][:] for name in ("i", "p", "x"))
    if nz >= 0:
        return sp.coo_matrix((x[:nz], (i[:nz], p[:nz])), shape=(m, n)).tocsr()
    if nz == -1:
        return sp.csc_matrix((x, i, p), shape=(m, n)).tocsr()
    if nz == -2:
        return sp.csr_matrix((x, i, p), shape=(m, n))
    raise FileFormatError(f"{group.name}/nz is {nz}; known are triplets (>= 0), CSC (-1) and CSR (-2)")


def _inverse(M: sp.csr_matrix) -> sp.spmatrix:
    """Inverse of a mass matrix, diagonal or block diagonal with small blocks."""
    diagonal = M.diagonal()
    if (M - sp.diags(diagonal)).count_nonzero() == 0:
        if not (diagonal > 0).all():
            raise FileFormatError("its mass matrix is not positive")
        return sp.diags(1.0 / diagonal)
    return spsolve(M.tocsc(), sp.identity(M.shape[0], format="csc"))
