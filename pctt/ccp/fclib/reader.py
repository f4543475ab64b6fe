"""FCLIB files read as cone problems."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
import scipy.sparse as sp
from mpi4py import MPI

from pctt.ccp.cone import Array
from pctt.ccp.fclib.global_form import without_velocities
from pctt.ccp.fclib.stored import FileFormatError, Stored, Whole, spread, symmetric_blocks
from pctt.ccp.problem import ConeProblem


def read(path: str | Path, comm: MPI.Comm) -> ConeProblem:
    """The cone problem of an FCLIB file, its contacts in equal parts over the ranks.

    A local problem is given by N = W. A global one is given by the map G = H' L^-T of the bodies, with M = L L', where
    M has 6 x 6 blocks on its diagonal and nothing else, and otherwise by N = H' M^-1 H. Raises FileFormatError on every
    rank if the file is none.
    """
    return load(path, comm).problem


def load(path: str | Path, comm: MPI.Comm, compliance: float | None = None) -> Stored:
    """The cone problem as ``read`` gives it, with the solution and the first guess of the file if it has
    impulses there: all published files have the groups, many with nothing but zeros in them. ``compliance`` takes
    the place of the file's."""
    return spread(comm, path, lambda: _whole(path), compliance)


def _whole(path: str | Path) -> Whole:
    if Path(path).is_file() and not h5py.is_hdf5(path):
        raise FileFormatError(
            "it is not HDF5; run/study convert_problems makes FCLIB files of Siconos' text and of PETSc's binary files"
        )
    with h5py.File(path, "r") as file:
        form = next((form for form in ("local", "global") if f"fclib_{form}" in file), None)
        if form is None:
            raise FileFormatError("it has neither fclib_local nor fclib_global")
        group = file[f"fclib_{form}"]
        if int(np.ravel(group["spacedim"][()])[0]) != 3:
            raise FileFormatError("its space dimension is not 3")
        matrix, q, note = (_local if form == "local" else _global)(group)
        point = file["pctt/point"][()] if "pctt/point" in file else None
        return Whole(
            f"FCLIB {form}",
            _text(group, "info/title"),
            matrix,
            q,
            group["vectors/mu"][:],
            _impulses(file, "solution/r"),
            _impulses(file, "guesses/1/r"),
            point,
            float(file["pctt/compliance"][()]) if "pctt/compliance" in file else 0.0,
            note,
        )


def _local(group: h5py.Group) -> tuple[sp.bsr_matrix, Array, str]:
    """N = W, q, and what was done to W in words."""
    if "V" in group or "R" in group:
        raise FileFormatError("it has bilateral constraints (V, R), which a cone problem has not")
    matrix, note = symmetric_blocks(_matrix(group["W"]))
    return matrix, group["vectors/q"][:], note


def _global(group: h5py.Group) -> tuple[sp.bsr_matrix, Array, str]:
    """G or N, q = w + H' M^-1 f, and what was done to M in words."""
    if "G" in group:
        raise FileFormatError("it has bilateral constraints (G), which a cone problem has not")
    return without_velocities(_matrix(group["M"]), _matrix(group["H"]), group["vectors/f"][:], group["vectors/w"][:])


def _matrix(group: h5py.Group) -> sp.csr_matrix:
    """A matrix in triplets (nz >= 0: rows i, columns p, duplicates summed), CSC (-1) or CSR (-2).

    fclib.h says of triplets that p holds the rows; the files have it as CSparse does.
    """
    m, n, nz = (int(np.ravel(group[name][()])[0]) for name in ("m", "n", "nz"))
    i, p, x = (group[name][:] for name in ("i", "p", "x"))
    if nz >= 0:
        return sp.coo_matrix((x[:nz], (i[:nz], p[:nz])), shape=(m, n)).tocsr()
    if nz not in (-1, -2):
        raise FileFormatError(f"{group.name}/nz is {nz}; known are triplets (>= 0), CSC (-1) and CSR (-2)")
    matrix = (sp.csc_matrix if nz == -1 else sp.csr_matrix)((x, i, p), shape=(m, n))
    matrix.check_format(full_check=True)
    matrix.sum_duplicates()
    return matrix.tocsr()


def _impulses(file: h5py.File, name: str) -> Array | None:
    """Impulses of a solution or guess; None where there is none but zeros."""
    impulses = file[name][()] if name in file else np.zeros(0)
    return impulses if impulses.any() else None


def _text(group: h5py.Group, name: str) -> str:
    if name not in group:
        return ""
    text = np.ravel(group[name][()])[0]
    return (text.decode("utf-8", "replace") if isinstance(text, bytes) else str(text)).strip("\0 \n")
