"""Cone problems in PETSc's binary format: the Mat N of rigid contacts, then the Vecs r and mu, and where there is
compliance a Vec of length 1 with it.

>>> viewer = PETSc.Viewer().createBinary("step000012_18213contacts.petsc", "r")    # doctest: +SKIP
>>> N = PETSc.Mat().load(viewer)                                                   # doctest: +SKIP
>>> r, mu = PETSc.Vec().load(viewer), PETSc.Vec().load(viewer)                     # doctest: +SKIP

Rank 0 reads and writes, with objects of its own: the format does not depend on the number of ranks, and an
error in collective input or output of PETSc leaves the other ranks waiting.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import scipy.sparse as sp
from mpi4py import MPI
from petsc4py import PETSc

from pctt.ccp.cone import Array
from pctt.ccp.gather import gather_matrix, gather_rows, write_whole
from pctt.ccp.problem import ConeProblem
from pctt.ccp.stored import FileFormatError, Stored, Whole, sparse_matrix, spread, symmetric_blocks

# the first number of a file that begins with a Mat, MAT_FILE_CLASSID of petscmat.h, with 32- and 64-bit indices
_BEGINNINGS = tuple((1211216).to_bytes(size, "big") for size in (4, 8))


def is_one(path: str | Path) -> bool:
    """Whether a file begins as these do."""
    with open(path, "rb") as file:
        return file.read(8).startswith(_BEGINNINGS)


def write(path: str | Path, problem: ConeProblem) -> None:
    """Write N, r, mu; collective. Raises OSError on all ranks if the file cannot be written, ValueError if a body
    has so many contacts that it would fill N."""
    rigid = sparse_matrix(problem)
    N = gather_matrix(rigid)
    rigid.destroy()
    vectors = [gather_rows(problem.comm, x).ravel() for x in (problem.r, problem.mu)]
    if problem.softness:
        vectors.append(np.array([problem.softness]))

    def write_it(temporary: Path) -> None:
        csr = (N.indptr.astype(PETSc.IntType), N.indices.astype(PETSc.IntType), N.data)
        contents: list[PETSc.Object] = [PETSc.Mat().createAIJ(N.shape, csr=csr, comm=PETSc.COMM_SELF)]
        contents += [PETSc.Vec().createWithArray(vector, comm=PETSc.COMM_SELF) for vector in vectors]
        viewer = PETSc.Viewer()
        try:
            viewer.createBinary(str(temporary), "w", comm=PETSc.COMM_SELF)
            for thing in contents:
                thing.view(viewer)
        except PETSc.Error as error:
            raise OSError(_reason(error)) from None
        finally:
            for thing in (viewer, *contents):
                thing.destroy()
            temporary.with_name(f"{temporary.name}.info").unlink(missing_ok=True)

    write_whole(path, problem.comm, write_it)


def load(path: str | Path, comm: MPI.Comm, compliance: float | None = None) -> Stored:
    """The cone problem of a file, its contacts in equal parts over the ranks; collective. ``compliance`` takes the
    place of the file's.

    Raises FileFormatError on every rank where the file cannot be read as one.
    """
    return spread(comm, path, "PETSc binary", lambda: _whole(path), compliance)


def _whole(path: str | Path) -> Whole:
    viewer = None
    try:
        viewer = PETSc.Viewer().createBinary(str(path), "r", comm=PETSc.COMM_SELF)
        N = PETSc.Mat().create(PETSc.COMM_SELF)
        N.setType(PETSc.Mat.Type.AIJ)
        N.load(viewer)
        indptr, indices, values = N.getValuesCSR()
        W = sp.csr_matrix((values, indices, indptr), shape=N.getSize())
        r, mu = (_vector(viewer) for _ in range(2))
        plain = _bytes(len(r), len(mu), len(values), len(indptr))
        compliance = _vector(viewer) if Path(path).stat().st_size > plain else np.zeros(1)
    except PETSc.Error as error:
        raise FileFormatError(_reason(error)) from None
    finally:
        if viewer is not None:
            viewer.destroy()
    if len(compliance) != 1:
        raise FileFormatError(f"a vector of length {len(compliance)} follows mu; allowed is its compliance, a number")
    matrix, note = symmetric_blocks(W)
    return Whole("PETSc binary", "", matrix, r, mu, compliance=float(compliance[0]), note=note)


def _bytes(r: int, mu: int, nonzeros: int, rows_and_one: int) -> int:
    """Length of a file without compliance, for objects of these lengths."""
    integers = 4 + rows_and_one - 1 + nonzeros + 2 * 2
    return np.dtype(PETSc.IntType).itemsize * integers + 8 * (nonzeros + r + mu)


def _vector(viewer: PETSc.Viewer) -> Array:
    vector = PETSc.Vec().create(PETSc.COMM_SELF)
    vector.setType(PETSc.Vec.Type.SEQ)
    return np.array(vector.load(viewer).array)


def _reason(error: PETSc.Error) -> str:
    """The last line of an error, which states the reason; the lines above it are functions and lines of PETSc."""
    last = str(error).splitlines()[-1]
    return last.partition("] ")[2] or last
