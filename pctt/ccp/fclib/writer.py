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

from pctt.ccp.cone import Array
from pctt.ccp.gather import gather_matrix, gather_rows, write_whole
from pctt.ccp.problem import ConeProblem
from pctt.ccp.stored import sparse_matrix
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
    N = sparse_matrix(problem)
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
    whole_matrices = {name: gather_matrix(A) for name, A in matrices.items()}
    whole_vectors = {name: gather_rows(comm, x).ravel() for name, x in vectors.items()}
    states = {"solution": solution, "guesses/1": guess}
    whole_states = {name: _gather_state(comm, state) for name, state in states.items() if state is not None}
    points = None if point is None else gather_rows(comm, point)

    def write(temporary: Path) -> None:
        arrays = [part for A in whole_matrices.values() for part in (A.data, A.indices, A.indices)]
        arrays += [*whole_vectors.values(), *(x for state in whole_states.values() for x in state.values())]
        arrays += [] if points is None else [points]
        texts = sum(len(text.encode()) for text in vars(info or Info()).values())
        make_hdf5(temporary, sum(array.nbytes for array in arrays) + texts, len(arrays) + 30)
        with h5py.File(temporary, "r+") as file:
            group = file.create_group(f"fclib_{form}")
            group["spacedim"] = _integers([3])
            for name, matrix in whole_matrices.items():
                _write_matrix(group.create_group(name), matrix)
            for name, vector in whole_vectors.items():
                group[f"vectors/{name}"] = vector
            for name, text in vars(info or Info()).items():
                group[f"info/{name}"] = _string(text)
            for name, state in whole_states.items():
                for letter, vector in state.items():
                    file[f"{name}/{letter}"] = vector
            if guess is not None:
                file["guesses/number_of_guesses"] = _integers([1])
            if points is not None:
                file["pctt/point"] = points
            if compliance:
                file["pctt/compliance"] = compliance

    write_whole(path, comm, write)


def _gather_state(comm: MPI.Comm, state: Solution) -> dict[str, Array]:
    return {name: gather_rows(comm, x).ravel() for name, x in vars(state).items() if x is not None}


def _write_matrix(group: h5py.Group, A: sp.csr_matrix) -> None:
    """A in triplets without duplicates."""
    entries = A.tocoo()
    if entries.nnz > np.iinfo(np.int32).max:
        raise ValueError(f"{entries.nnz} nonzeros, more than FCLIB's 32-bit integers count")
    for name, value in {"m": A.shape[0], "n": A.shape[1], "nz": entries.nnz, "nzmax": entries.nnz}.items():
        group[name] = _integers([value])
    group["i"], group["p"], group["x"] = _integers(entries.row), _integers(entries.col), entries.data


def _integers(values: np.ndarray | list[int]) -> np.ndarray:
    return np.asarray(values).astype(np.int32)


def _string(text: str) -> np.ndarray:
    """A string with the zero at its end that a reader in C counts on."""
    data = text.encode()
    return np.array(data, dtype=f"S{len(data) + 1}")
