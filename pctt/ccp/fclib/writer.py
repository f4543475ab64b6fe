"""Cone problems written as FCLIB files.

All is gathered on rank 0, which writes the file: FCLIB's own reader is serial, so a problem has to fit one node anyway.
Matrices are written as triplets, rows in ``i`` and columns in ``p``. Of the three formats this is the one that every
known reader takes; Siconos, for example, refuses global problems in CSR.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np
import scipy.sparse as sp
from mpi4py import MPI
from petsc4py import PETSc

from pctt.blocks import HUB
from pctt.ccp.cone import Array
from pctt.ccp.fclib.gather import gather_matrix, gather_rows, write_whole
from pctt.ccp.problem import ConeProblem
from pctt.disk import make_hdf5


@dataclass(frozen=True)
class Info:
    """What a file says of itself."""

    title: str = "cone problem"
    description: str = ""
    math_info: str = ""


@dataclass(frozen=True)
class Solution:
    """A solution or a guess, of this rank's nc contacts and n generalised velocities.

    r : (nc, 3) impulses (N s)
    u : (nc, 3) velocities W r + q (m/s)
    v : (n,) generalised velocities of a global problem; None for a local one
    """

    r: Array
    u: Array
    v: Array | None = None


def write_local(
    path: str | Path,
    problem: ConeProblem,
    info: Info | None = None,
    solution: Solution | None = None,
    guess: Solution | None = None,
) -> None:
    """Write N, r, mu of a problem as W, q, mu of a local problem; collective.

    W is that of rigid contacts; the compliance is kept outside the groups of FCLIB. Raises OSError on all ranks if
    the file cannot be written, ValueError if a body has so many contacts that it would fill W.
    """
    if problem.has_hubs:
        raise ValueError(f"a body has more than {HUB} contacts and would fill N; allowed is fclib.write_global")
    N = problem.rigid_matrix()
    matrices, vectors = {"W": N}, {"q": problem.r, "mu": problem.mu}
    _write(path, problem.comm, "local", matrices, vectors, info, solution, guess, problem.point, problem.softness)
    N.destroy()


def write_global(
    path: str | Path,
    M: PETSc.Mat,
    H: PETSc.Mat,
    f: Array,
    w: Array,
    mu: Array,
    info: Info | None = None,
    solution: Solution | None = None,
    guess: Solution | None = None,
    point: Array | None = None,
    compliance: float = 0.0,
) -> None:
    """Write M v = H r + f, u = H'v + w with all rows distributed over the ranks; collective.

    M (n x n) masses and inertia tensors, H (n x 3nc) impulses to momenta, f (n,) momenta without contacts
    (N s), w (nc, 3) velocities of the contacts at v = 0 (m/s), mu (nc,); ``point`` (nc, 3) contact points
    (m), and ``compliance``, that of a `ConeProblem`, are kept outside the groups of FCLIB. Raises OSError on all
    ranks if the file cannot be written.
    """
    vectors = {"f": f, "w": w, "mu": mu}
    _write(path, M.comm.tompi4py(), "global", {"M": M, "H": H}, vectors, info, solution, guess, point, compliance)


def _write(
    path: str | Path,
    comm: MPI.Comm,
    form: str,
    matrices: dict[str, PETSc.Mat],
    vectors: dict[str, Array],
    info: Info | None,
    solution: Solution | None,
    guess: Solution | None,
    point: Array | None,
    compliance: float,
) -> None:
    """Gather, then write ``/fclib_local`` or ``/fclib_global``."""
    top = f"fclib_{form}"
    whole = {name: gather_matrix(A) for name, A in matrices.items()}
    data = {f"{top}/spacedim": _integers([3])}
    data |= {f"{top}/vectors/{name}": gather_rows(comm, x).ravel() for name, x in vectors.items()}
    data |= {f"{top}/info/{name}": _string(text) for name, text in vars(info or Info()).items()}
    for name, state in {"solution": solution, "guesses/1": guess}.items():
        parts = {} if state is None else vars(state)
        data |= {f"{name}/{letter}": gather_rows(comm, x).ravel() for letter, x in parts.items() if x is not None}
    if guess is not None:
        data["guesses/number_of_guesses"] = _integers([1])
    if point is not None:
        data["pctt/point"] = gather_rows(comm, point)
    if compliance:
        data["pctt/compliance"] = np.array(compliance)

    def write(temporary: Path) -> None:
        for name, A in whole.items():
            data.update({f"{top}/{name}/{part}": values for part, values in _triplets(A).items()})
        make_hdf5(temporary, sum(values.nbytes for values in data.values()), len(data) + 10)  # and the groups
        with h5py.File(temporary, "r+") as file:
            for name, values in data.items():
                file[name] = values

    write_whole(path, comm, write)


def _triplets(A: sp.csr_matrix) -> dict[str, np.ndarray]:
    """A without duplicates, as FCLIB's datasets by name."""
    entries = A.tocoo()
    if entries.nnz > np.iinfo(np.int32).max:
        raise ValueError(f"{entries.nnz} nonzeros, more than FCLIB's 32-bit integers count")
    sizes = {"m": A.shape[0], "n": A.shape[1], "nz": entries.nnz, "nzmax": entries.nnz}
    places = {"i": _integers(entries.row), "p": _integers(entries.col), "x": entries.data}
    return {name: _integers([size]) for name, size in sizes.items()} | places


def _integers(values: np.ndarray | list[int]) -> np.ndarray:
    return np.asarray(values).astype(np.int32)


def _string(text: str) -> np.ndarray:
    """A string with the zero at its end that a reader in C counts on."""
    data = text.encode()
    return np.array(data, dtype=f"S{len(data) + 1}")
