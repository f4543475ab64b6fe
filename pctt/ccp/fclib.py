"""Cone problems in FCLIB files (HDF5), the library of friction contact problems of Acary et al. (2014).

A local problem holds W and q of u = W r + q; a global one M, H, f, w of M v = H r + f, u = H'v + w. Either
way the cone problem has N = W = H' M^-1 H and r = q = w + H' M^-1 f. A global problem with rolling has five rows for
each contact, the last two those of rolling, and mu_r beside mu; it is read, not written. Bilateral constraints (G, b of
a global problem, V, R, s of a local one) are not part of a cone problem and are refused.

FCLIB's own problem statement adds mu |u_t| to the normal velocity (Coulomb's law); the cone problem is the
convex one without that term. The data of the two are the same, the solutions are not where contacts slide.

Rank 0 reads and writes the files: FCLIB's own reader is serial, so a problem has to fit one node anyway. Matrices are
written as triplets, rows in ``i`` and columns in ``p``. Of the three formats this is the one that every known reader
takes; Siconos, for example, refuses global problems in CSR.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import scipy.sparse as sp
from mpi4py import MPI
from scipy.sparse.linalg import MatrixRankWarning, spsolve

from dem.contact_map import BlockRows
from dem.exchange import refuse
from pctt.arrays import Array
from pctt.blocks import square_block_matrix
from pctt.ccp.cones import Cones, FrictionCones, RollingCones
from pctt.ccp.delassus import DENSE, rows_in_blocks
from pctt.ccp.problem import ConeProblem
from pctt.disk import FileError, hdf5, refuse_links, whole
from pctt.options import short

__all__ = ["FileFormatError", "Info", "Solution", "Stored", "load", "read", "write_global", "write_local"]


class FileFormatError(ValueError):
    """A file that is no cone problem; raised on all ranks alike."""


@dataclass(frozen=True)
class Stored:
    """A problem from a file, with the impulses (nc, 3) in the file for this rank's contacts. ``note`` says what the
    reader had to change."""

    problem: ConeProblem
    form: str
    title: str
    solution: Array | None = None
    guess: Array | None = None
    note: str = ""


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


# -- reading ------------------------------------------------------------------------------------------------


def read(path: str | Path, comm: MPI.Comm) -> ConeProblem:
    """Return the cone problem of an FCLIB file, its contacts in equal parts over the ranks; collective. One with
    rolling has `RollingCones`, and its M must have 6 x 6 blocks.

    A local problem is given by N = W. A global one is given by the map G = H' L^-T of the bodies, with M = L L', where
    M has 6 x 6 blocks on its diagonal and nothing else, and otherwise by N = H' M^-1 H. Raises FileFormatError on every
    rank if the file is none.
    """
    return load(path, comm).problem


def load(path: str | Path, comm: MPI.Comm) -> Stored:
    """Return the cone problem as ``read`` gives it, with the solution and the first guess of the file if it has
    impulses there: all published files have the groups, many with nothing but zeros in them."""
    parts: list[dict[str, Any]] = []
    error = None
    if comm.rank == 0:
        try:
            matrix, vectors, words = _contents(Path(path))
            parts = [_part(matrix, vectors, rank, comm.size) | words for rank in range(comm.size)]
        except Exception as reason:  # of any kind, as bad data surprise h5py, numpy and scipy; other ranks wait
            error = f"{path}: no FCLIB problem: {reason}"
    error = comm.bcast(error)
    if error:
        raise FileFormatError(error)
    part = comm.scatter(parts)
    rows, N = part["matrix"], None
    try:
        if rows.blocksize == (3, 6):
            operator: dict[str, Any] = {"G": BlockRows(rows.indptr, rows.indices, rows.data, part["columns"])}
        else:
            operator = {"N": (N := square_block_matrix(comm, rows))}
        more = {name: part[name] for name in ("point", "compliance")}
        if (rolling := part["mu_r"]) is None:
            cones: Cones = FrictionCones(part["mu"])
        else:
            cones = RollingCones(part["mu"], rolling, np.zeros_like(rolling))
        problem = ConeProblem(comm, part["r"], cones=cones, **operator, **more)
    except ValueError as reason:  # on all ranks alike
        raise FileFormatError(f"{path}: no FCLIB problem: {reason}") from None
    finally:
        if N is not None:
            N.destroy()  # the problem has a copy
    return Stored(problem, *(part[name] for name in ("form", "title", "solution", "guess", "note")))


def _contents(path: Path) -> tuple[sp.bsr_matrix, dict[str, Any], dict[str, Any]]:
    """G (3 nc, 6 bodies) in 3 x 6 blocks or N (3 nc, 3 nc) in 3 x 3 blocks, the vectors, and what the file says."""
    if path.is_file() and not h5py.is_hdf5(path):
        raise FileFormatError("it is not HDF5; run/study convert_problems makes FCLIB files of Siconos' text files")
    with h5py.File(path, "r") as file:
        refuse_links(file)
        form = next((form for form in ("local", "global", "global_rolling") if f"fclib_{form}" in file), None)
        if form is None:
            raise FileFormatError("it has neither fclib_local nor fclib_global nor fclib_global_rolling")
        group, rolls = file[f"fclib_{form}"], form == "global_rolling"
        dimension = int(np.ravel(group["spacedim"][()])[0])
        allowed = (5,) if rolls else (2, 3)
        if dimension not in allowed:
            raise FileFormatError(f"its space dimension is {dimension}; allowed is {' or '.join(map(str, allowed))}")
        for name in ("V", "R") if form == "local" else ("G",):
            if name in group:
                raise FileFormatError(f"it has bilateral constraints ({name}), which a cone problem has not")
        mu = group["vectors/mu"][:]
        spatial = partial(in_space, dimension=dimension, contacts=len(mu))
        if form == "local":
            matrix, note = symmetric_blocks(spatial(spatial(_matrix(group["W"])).T).T)
            r = spatial(group["vectors/q"][:])
        else:
            f, w, H = group["vectors/f"][:], spatial(group["vectors/w"][:]), spatial(_matrix(group["H"]).T).T
            matrix, r, note = without_velocities(_matrix(group["M"]), H.tocsr(), f, w)
            if rolls and matrix.blocksize != (3, 6):
                raise FileFormatError("its mass matrix couples bodies, or has no 6 x 6 blocks, as rolling needs them")

        def optional(name: str, otherwise: Any = None) -> Any:
            return file[name][()] if name in file else otherwise

        def impulses(name: str) -> Any:
            stored = optional(name)
            return spatial(stored) if np.any(stored) else None

        vectors = {
            "r": r,
            "mu": mu,
            "mu_r": group["vectors/mu_r"][:] if rolls else None,
            "solution": impulses("solution/r"),
            "guess": impulses("guesses/1/r"),
            "point": optional("pctt/point"),
            "compliance": optional("pctt/compliance", np.zeros(len(mu))),
        }
        rows = len(mu) * (2 if rolls else 1)
        of_contacts = {"mu": (), "mu_r": (), "point": (3,), "compliance": vectors["compliance"].shape[1:2]}
        for name, x in vectors.items():
            shape = (len(mu), *of_contacts[name]) if name in of_contacts else (rows, 3)
            if x is not None and np.size(x) != np.prod(shape):
                raise FileFormatError(f"{len(mu)} friction coefficients, but its {name} has {np.size(x)} numbers")
            vectors[name] = None if x is None else np.reshape(x, shape)
        if matrix.shape[0] != 3 * rows:
            raise FileFormatError(f"{len(mu)} friction coefficients, but its matrix has {matrix.shape[0]} rows")
        title = _text(group["info/title"][()]) if "info/title" in group else ""
        return matrix, vectors, {"form": f"FCLIB {form.replace('_', ' ')}", "title": title, "note": note}


def _part(A: sp.bsr_matrix, vectors: Mapping[str, Any], rank: int, ranks: int) -> dict[str, Any]:
    """What one rank gets: the rows of its contacts, and how many of the block columns (bodies) it owns."""
    contacts, columns = len(vectors["mu"]), A.shape[1] // A.blocksize[1]
    first, last = contacts * rank // ranks, contacts * (rank + 1) // ranks

    def own(x: np.ndarray) -> np.ndarray:
        """The rows of the contacts, and of their moments if there are some behind those of all contacts."""
        return np.concatenate([x[first:last], x[contacts:][first:last]])

    lengths = own(np.diff(A.indptr))
    near = np.repeat(own(A.indptr[:-1]) - np.cumsum(lengths) + lengths, lengths) + np.arange(lengths.sum())
    pointers = np.concatenate([[0], np.cumsum(lengths)])
    return {
        "matrix": sp.bsr_matrix((A.data[near], A.indices[near], pointers), shape=(3 * len(lengths), A.shape[1])),
        "columns": columns * (rank + 1) // ranks - columns * rank // ranks,
        **{name: None if x is None else own(x) for name, x in vectors.items()},
    }


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


def _text(stored: Any) -> str:
    text = np.ravel(stored)[0]
    return (text.decode("utf-8", "replace") if isinstance(text, bytes) else str(text)).strip("\0 \n")


# -- problems of other programs -----------------------------------------------------------------------------


def in_space(x: Any, dimension: int, contacts: int) -> Any:
    """The rows (3 nc, ...) in space of those of contacts in the plane, (2 nc, ...): normal and one tangent. No impulse
    along the second tangent moves anything. With dimension 3, x itself. With 5, which is rolling in space, (6 nc, ...):
    normal and tangents of all contacts, then zero and two rolls. ValueError for another number of rows."""
    if dimension == 3:
        return x
    if x.shape[0] != dimension * contacts:
        raise ValueError(f"{x.shape[0]} rows for {contacts} contacts of {dimension} rows each")
    every, known = np.arange(dimension * contacts), [0, 1, 2, 4, 5][:dimension]
    contact, number = np.divmod(every, dimension)
    part, number = np.divmod(np.array(known)[number], 3)
    rows = 3 * (contacts * part + contact) + number
    lift = sp.csr_matrix((np.ones(len(every)), (rows, every)), shape=(3 * contacts * (dimension // 2), len(every)))
    return lift @ x


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
    entries = M.tocoo()
    entries.eliminate_zeros()
    if len(f) % 6 or (entries.row // 6 != entries.col // 6).any():
        with warnings.catch_warnings():
            warnings.simplefilter("error", MatrixRankWarning)
            try:
                H_over_M = sp.csr_matrix(spsolve(M.tocsc(), H.tocsc())).reshape(H.shape)
            except MatrixRankWarning:
                raise FileFormatError("its mass matrix is singular") from None
        return symmetric_blocks(H.T @ H_over_M)[0], w + H_over_M.T @ f, note
    blocks = np.zeros((len(f) // 6, 6, 6))
    blocks[entries.row // 6, entries.row % 6, entries.col % 6] = entries.data
    try:
        roots = np.linalg.inv(np.linalg.cholesky(blocks))
    except np.linalg.LinAlgError:
        raise FileFormatError("its mass matrix is not positive") from None
    G = H.T.tocsr()
    G.sort_indices()
    G = G.tobsr((3, 6))
    G.data = G.data @ roots[G.indices].transpose(0, 2, 1)
    return G, w + G @ (roots @ f.reshape(-1, 6, 1)).ravel(), note


def symmetric_masses(M: sp.csr_matrix, rounding: float = 1e-8) -> tuple[sp.csr_matrix, str]:
    """M made exactly symmetric, and what was done to it; FileFormatError if it is neither one triangle nor symmetric
    up to ``rounding``, a part of sqrt(M_ii M_jj), which bounds M_ij."""
    made, note = _symmetric(M, "M")
    bound = np.sqrt(M.diagonal())
    entries = abs(M - M.T).tocoo()
    off = entries.data > rounding * bound[entries.row] * bound[entries.col]
    if off.any() and not note:
        i, j = entries.row[off][0], entries.col[off][0]
        raise FileFormatError(
            f"its mass matrix is not symmetric: M[{i}, {j}] = {M[i, j]:.9g}, M[{j}, {i}] = {M[j, i]:.9g}; allowed is "
            "one triangle, or both equal up to rounding"
        )
    return made, note


def symmetric_blocks(W: sp.spmatrix) -> tuple[sp.bsr_matrix, str]:
    """(W + W') / 2 in 3 x 3 blocks, and what was done to W: matrices in files are symmetric up to the rounding of their
    writers."""
    if W.shape[0] != W.shape[1] or W.shape[0] % 3:
        raise FileFormatError(f"its matrix {W.shape} is not square with three rows per contact")
    made, note = _symmetric(W, "W")
    made.sort_indices()
    return made.tobsr((3, 3)), note


def _symmetric(A: sp.spmatrix, name: str) -> tuple[sp.csr_matrix, str]:
    """(A + A') / 2. Where only one triangle is stored, half the sum would be another matrix: it is mirrored, and the
    words say so."""
    above, below = sp.triu(A, 1), sp.tril(A, -1)
    if (above.count_nonzero() == 0) == (below.count_nonzero() == 0):
        return (0.5 * (A + A.T)).tocsr(), ""
    return (A + (above + below).T).tocsr(), f"{name} is stored as one triangle, which was mirrored"


# -- writing ------------------------------------------------------------------------------------------------


def write_local(
    path: str | Path, problem: ConeProblem, info: Info | None = None, solution: Solution | None = None,
    guess: Solution | None = None,
) -> None:  # fmt: skip
    """Write N, r, mu of a problem as W, q, mu of a local problem; collective.

    W is that of rigid contacts; the compliance is kept outside the groups of FCLIB. Raises OSError on all ranks if
    the file cannot be written, ValueError if a body has so many contacts that it would fill W, or contacts have
    moments or two friction coefficients.
    """
    if problem.cones.parts > 1:
        raise ValueError(f"the problem has {problem.cones.what}, which is read but not written")
    elliptic = problem.units is not None and bool(((problem.units != 1.0) & (problem.units != 0.0)).any())
    if problem.max(float(elliptic)):
        raise ValueError("the problem has two friction coefficients a contact; allowed in FCLIB is one")
    if problem.has_dense_columns:
        raise ValueError(f"a body has more than {DENSE} contacts and would fill N; allowed is fclib.write_global")
    N = problem.rigid_matrix()
    W = _gathered(problem.comm, rows_in_blocks(N).tocsr())
    N.destroy()
    vectors = {"q": problem.r, "mu": problem.mu}
    extra = {"point": problem.point, "compliance": problem.compliance[:, :2] if problem.yields else None}
    _write(path, problem.comm, "local", {"W": W}, vectors, info, solution, guess, extra)


def write_global(
    path: str | Path, comm: MPI.Comm, M: sp.spmatrix, Ht: sp.spmatrix, f: Array, w: Array, mu: Array,
    info: Info | None = None, solution: Solution | None = None, guess: Solution | None = None,
    point: Array | None = None, compliance: Array | None = None,
) -> None:  # fmt: skip
    """Write M v = H r + f, u = H'v + w with all rows distributed over the ranks; collective.

    M (n, N) this rank's rows of the masses and inertia tensors, Ht (3 nc, N) its rows of H', f (n,) momenta without
    contacts (N s), w (nc, 3) velocities of the contacts at v = 0 (m/s), mu (nc,); ``point`` (nc, 3) contact points
    (m), and ``compliance`` (nc, 2), that of a `ConeProblem`, are kept outside the groups of FCLIB. Raises OSError on
    all ranks if the file cannot be written.
    """
    matrices = {"M": _gathered(comm, M.tocsr()), "H": _gathered(comm, Ht.tocsr()).T}
    vectors, extra = {"f": f, "w": w, "mu": mu}, {"point": point, "compliance": compliance}
    _write(path, comm, "global", matrices, vectors, info, solution, guess, extra)


def _write(
    path: str | Path, comm: MPI.Comm, form: str, matrices: dict[str, sp.csr_matrix], vectors: dict[str, Array],
    info: Info | None, solution: Solution | None, guess: Solution | None, extra: dict[str, Any],
) -> None:  # fmt: skip
    """Gather the vectors, then write ``/fclib_local`` or ``/fclib_global`` under a temporary name until it is whole."""
    given = (("info", info, Info), ("solution", solution, Solution), ("guess", guess, Solution))
    wrong = [f"{name} {short(each)}: allowed is a {kind.__name__} of pctt.ccp.fclib" for name, each, kind in given
             if not isinstance(each, (kind, type(None)))]  # fmt: skip
    refuse(comm, "; ".join(wrong))
    top = f"fclib_{form}"
    arrays = {f"{top}/vectors/{name}": np.ravel(x) for name, x in vectors.items()}
    for name, state in (("solution", solution), ("guesses/1", guess)):
        parts = {} if state is None else vars(state)
        arrays |= {f"{name}/{letter}": np.ravel(x) for letter, x in parts.items() if x is not None}
    arrays |= {f"pctt/{name}": x for name, x in extra.items() if x is not None}
    data = {name: _gathered_rows(comm, x) for name, x in arrays.items()}
    data |= {f"{top}/info/{name}": _string(text) for name, text in vars(info or Info()).items()}
    data[f"{top}/spacedim"] = _integers([3])
    if guess is not None:
        data["guesses/number_of_guesses"] = _integers([1])
    failure = None
    if comm.rank == 0:
        try:
            for name, A in matrices.items():
                data |= {f"{top}/{name}/{part}": values for part, values in _triplets(A).items()}
            with whole(Path(path)) as temporary, hdf5(temporary) as file:
                for name, values in data.items():
                    file[name] = values
        except FileError as error:
            failure = str(error)
        except (ValueError, RuntimeError) as error:  # h5py raises both
            failure = f"{path}: cannot write ({error})"
    failure = comm.bcast(failure)
    if failure:
        raise OSError(failure)


def _gathered_rows(comm: MPI.Comm, local: np.ndarray) -> np.ndarray:
    """The rows of all ranks, in their order, on rank 0; no rows elsewhere; collective."""
    local = np.ascontiguousarray(local)
    width = int(np.prod(local.shape[1:]))
    counts = comm.gather(len(local) * width)
    out = np.empty((sum(counts or []) // width, *local.shape[1:]), local.dtype)
    comm.Gatherv(local, [out, counts])
    return out


def _gathered(comm: MPI.Comm, rows: sp.csr_matrix) -> sp.csr_matrix:
    """The rows of a matrix of all ranks, without zeros, on rank 0; a matrix without rows elsewhere; collective."""
    parts = np.diff(rows.indptr), rows.indices.astype(np.int64), rows.data
    lengths, indices, values = (_gathered_rows(comm, array) for array in parts)
    indptr = np.concatenate([[0], np.cumsum(lengths)])
    matrix = sp.csr_matrix((values, indices, indptr), shape=(len(lengths), rows.shape[1]))
    matrix.eliminate_zeros()
    return matrix


def _triplets(A: sp.spmatrix) -> dict[str, np.ndarray]:
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
