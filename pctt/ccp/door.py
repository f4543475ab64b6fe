"""What users have becomes what the solvers take: matrices of numpy, scipy and PETSc, operators, and maps with masses.

On several ranks arrays and scipy matrices are the rows of this rank's contacts, with the columns of all; masses are
whole on every rank; Mats are distributed as they are.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from operator import neg
from typing import Any, Union

import numpy as np
import scipy.linalg
import scipy.sparse as sp
from mpi4py import MPI
from petsc4py import PETSc
from scipy.sparse.csgraph import structural_rank
from scipy.sparse.linalg import LinearOperator, splu

from dem.contact_map import BlockRows, CompactRows, ContactMap
from dem.exchange import greatest, on_any, on_each, reduced, refuse
from pctt.arrays import Array, all_from
from pctt.blocks import unready
from pctt.ccp.cones import Cones
from pctt.ccp.delassus import BlockMap, ColumnMap, GivenMatrix, GivenOperator, rows_of

FULL = 10_000  # rows up to which N is found by a product with each unit vector, if nothing but products is known
MOST = 50_000_000  # numbers of an N that is made by solves; of a larger one the diagonal blocks are kept
BATCH = 300  # rows of N that are made together
ALIKE = 1e-6  # of the largest entry of a matrix: by how much an entry may differ from its mirror image
ABOUT = 1e-2  # of a block: by how much a product may differ from it
#: types of Mats that have entries; others are known by their products
WITH_ENTRIES = ("aij", "baij", "sbaij", "dense", "nest", "sell", "is")
#: what is the same on all ranks, and the kinds of it
COLLECTIVE = ("N", "G", "masses", "point", "key")
KINDS = ("not given", "an object of PETSc", "a map of bodies", "a function or a factor", "a matrix", "a vector")
LARGEST = 1e140  #: of what is squared and multiplied with each other, and summed: a fourth power would overflow

MATRICES = "a two-dimensional array, a scipy sparse matrix, a PETSc Mat"

Solve = Callable[[Array], Array]


@dataclass(frozen=True)
class Operator:
    """An operator gives N by its product and its diagonal blocks, for solvers that need no entries.

    Attributes
    ----------
    mult : a function of impulses g (nc, 3) of this rank's contacts that returns N g (nc, 3); all ranks call it
        together. Or a scipy `LinearOperator` or a Mat, which take flat vectors. In the plane arrays are (nc, 2)
    blocks : (nc, 3, 3) the diagonal blocks of N, (nc, 2, 2) in the plane
    """

    mult: Any
    blocks: Array


Given = Union[BlockRows, CompactRows, ContactMap, np.ndarray, sp.spmatrix, PETSc.Mat]
Matrix = Union[np.ndarray, sp.spmatrix, PETSc.Mat, LinearOperator, Operator]


# -- contacts ----------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Contacts:
    """The numbers of contacts in circular cones of space, and the way back to the user's.

    width : of the user's rows: 3, or 2 in the plane
    units : (nc, 3) the user's impulses over those in the cones; None: the same
    r, mu, given_r : (nc, 3) velocities in the cones, (nc,) friction, and (nc, 3) velocities in the user's units
    """

    width: int
    units: Array | None
    r: Array
    mu: Array
    given_r: Array


def contacts_of(comm: MPI.Comm, r: Any, mu: Any, cones: Cones | None, **data: Any) -> Contacts:
    """The contacts of velocities r (nc, 3) and friction mu (nc,) or, for each tangent, (nc, 2); in the plane r is
    (nc, 2). ValueError on all ranks for others, for what does not fit of a problem's other ``data``, and for what is of
    another kind on another rank.

    |g_1 / mu_1, g_2 / mu_2| <= g_n is a circular cone of friction mu = max mu_k in the impulses g_k mu / mu_k. A
    contact of the plane has the friction 0 along its second tangent, in which nothing moves."""
    kinds = [kind_of(data.get(name)) for name in COLLECTIVE]
    N = data.pop("N", None)
    parts = cones.parts if isinstance(cones, Cones) else 1
    if cones is not None and not isinstance(cones, Cones):
        words = f"cones are of the type {type(cones).__name__}; allowed are FrictionCones and RollingCones of pctt.ccp"
    elif (mu is None) == (cones is None):
        words = "a cone problem has either mu or cones"
    elif cones is not None:
        words = cones.why_refused() or _wrong_contacts(r, mu := cones.mu, parts=parts, **data)
    else:
        words = _wrong_contacts(r, mu, **data)
    if (data.get("G") is None) == (N is None):
        words = "a cone problem is given by either the map G or the matrix N"
    velocity, friction = (np.zeros(0), np.zeros(0)) if words else (np.asarray(r, float), np.asarray(mu, float))
    flat, space = velocity.ndim == 2 and velocity.shape[1] == 2, velocity.ndim == 2 and velocity.shape[1] == 3
    space = space or (velocity.ndim == 1 and velocity.size > 0)
    facts = bool(words), flat, space, friction.ndim == 2, parts == 1, parts > 1
    _, most = reduced(comm, (), (*facts, *kinds, *map(neg, kinds)))
    wrong, plane, spatial, elliptic, plain, moments, *every = map(int, most)
    if wrong:
        refuse(comm, words)
    for name, last, first in zip(COLLECTIVE, every, every[len(kinds) :]):
        if last != -first:
            found = f"{KINDS[-first]} on some ranks, and {KINDS[last]} on others"
            raise ValueError(f"{name} is {found}; allowed is one of them on all")
    if plain and moments:
        raise ValueError("cones have moments on some ranks, and none on others; allowed is one of both")
    if plane and spatial:
        raise ValueError("r has 2 columns on some ranks and 3 on others; allowed is one of both")
    width = 2 if plane else 3
    velocity, friction = np.ascontiguousarray(velocity.reshape(-1, width)), np.ascontiguousarray(friction)
    if not elliptic and not plane:
        return Contacts(3, None, velocity, friction, velocity)
    velocity = padded(velocity)
    both = friction if friction.ndim == 2 else np.stack([friction, 0 * friction if plane else friction], axis=1)
    most = both.max(axis=1, initial=0.0)
    units = np.ones((len(most), 3))
    units[:, 1:] = np.divide(both, most[:, None], out=np.ones_like(both), where=most[:, None] > 0)
    if plane:
        units[:, 2] = 0.0
    return Contacts(width, units, units * velocity, most, velocity)


def kind_of(given: Any) -> int:
    """The number among KINDS of a part of a problem's data: ranks that take one for another would wait for each
    other."""
    if given is None:
        return 0
    if isinstance(given, np.ndarray):
        return 4 if given.ndim == 2 else 5
    if isinstance(given, PETSc.Object):
        return 1
    if isinstance(given, (BlockRows, CompactRows, ContactMap)):
        return 2
    if callable(given) or isinstance(given, tuple) or hasattr(given, "mult") or hasattr(given, "solve"):
        return 3
    return 4 if sp.issparse(given) or np.ndim(given) == 2 else 5


def wrong_velocities(r: Any, shape: tuple[int, ...]) -> str:
    """What is wrong with velocities r that are to have this shape; empty if nothing is."""
    if np.shape(r) != shape:
        return f"r has the shape {np.shape(r)}; allowed is {shape}"
    return _wrong_contacts(r, np.zeros(shape[0]))


def refuse_out_of_range(comm: MPI.Comm, r: Array, diagonal: float) -> None:
    """ValueError on all ranks for what is `out_of_range`."""
    if most := out_of_range(comm, r, diagonal):
        raise ValueError(
            f"r of up to {most:.1e} and N of {diagonal:.1e} (the mean of its diagonal): squares of velocities or "
            f"impulses leave the range of double precision; allowed are r, N and r / N from {1.0 / LARGEST:g} to "
            f"{LARGEST:g}, as other units may make them"
        )


def out_of_range(comm: MPI.Comm, r: Array, diagonal: float) -> float:
    """The greatest of velocities r of a problem with this mean of the diagonal of N if squares of them or of the
    impulses overflow, or vanish: all residuals would be zero or no numbers; else 0. Collective."""
    most = greatest(comm, float(np.abs(r).max(initial=0.0)))
    good = not most or all(1.0 / LARGEST <= size <= LARGEST for size in (most, diagonal, most / diagonal))
    return 0.0 if good else most


def padded(rows: Array) -> Array:
    """The rows (nc, w), (nc, 3) with zeros."""
    out = np.zeros((len(rows), 3))
    out[:, : rows.shape[1]] = rows
    return out


def _wrong_contacts(
    r: Any, mu: Any, G: Any = None, masses: Any = None, point: Any = None, key: Any = None, compliance: Any = 0.0,
    parts: int = 1,
) -> str:  # fmt: skip
    """What is wrong with a problem's data on this rank, but for its matrices; empty if nothing is."""
    try:
        velocity, friction, soft = map(_real, (r, mu, compliance))
    except (TypeError, ValueError) as error:
        return f"r, mu or compliance are no numbers: {error}"
    shape = velocity.shape
    width = 2 if len(shape) == 2 and shape[1] == 2 else 3
    if not (len(shape) == 2 and shape[1] in (2, 3)) and not (len(shape) == 1 and shape[0] % 3 == 0):
        return f"r has the shape {shape}; allowed is (nc, 3), or (nc, 2) for contacts of the plane"
    nc = velocity.size // (width * parts)
    if parts > 1 and not (width == 3 and velocity.size == 3 * parts * len(friction)):
        return f"r has the shape {shape}; allowed is {(parts * len(friction), 3)} with these cones"
    if parts > 1 and not isinstance(G, (BlockRows, CompactRows, ContactMap)):
        return f"G is of the type {type(G).__name__}; allowed with moments are BlockRows and a ContactMap"
    for name, given, allowed in (
        ("mu", friction, [(nc,), (nc, 2)][: width - 1]),
        ("point", point, [(nc, 3)]),
        ("key", key, [(nc,)]),
        ("compliance", soft, [(), (nc,), (nc, 2), (nc, 3)]),
    ):
        if given is not None and (found := _shape(given)) not in allowed:
            words = " or ".join(map(str, allowed))
            return f"{name} has the shape {found}; allowed is {words}, as r has {nc} contacts"
    for name, numbers, least in (("r", velocity, -np.inf), ("mu", friction, 0.0), ("compliance", soft, 0.0)):
        if not all_from(numbers.ravel(), least):
            wrong = np.flatnonzero(~(np.isfinite(numbers) & (numbers >= least)))
            per = max(numbers.size // max(nc, 1), 1)
            more = f" and {len(wrong) - 1} more numbers" if len(wrong) > 1 else ""
            kind = "finite numbers" + " >= 0" * (least == 0.0)
            return f"{name} is {numbers.ravel()[wrong[0]]} at contact {wrong[0] // per}{more}; allowed are {kind}"
    if friction.ndim == 2 and soft.ndim == 2 and soft[:, 1:].any():
        return "compliance of tangents, with friction per direction; allowed with it is compliance of normals"
    if isinstance(G, (BlockRows, CompactRows, ContactMap)):
        if G.rows != parts * nc:
            return f"G has {G.rows} contacts, but r has {parts * nc}"
        if width == 2:
            return f"G is of the type {type(G).__name__}; allowed for contacts of the plane are {MATRICES}"
        if masses is not None:
            return f"masses: G of the type {type(G).__name__} has them already; allowed with them are {MATRICES}"
    elif masses is not None and G is None:
        return "masses: N has them already; allowed with them is G"
    return ""


def _shape(given: Any) -> tuple[int, ...]:
    return given.shape if isinstance(given, np.ndarray) else np.shape(given)


def _real(given: Any) -> Array:
    """An array of float64; TypeError for complex numbers."""
    if isinstance(given, np.ndarray) and given.dtype == float:
        return given
    if np.iscomplexobj(given):
        raise TypeError("complex numbers")
    return np.asarray(given, dtype=float)


# -- operators ---------------------------------------------------------------------------------------------


def operator_of(
    comm: MPI.Comm, nc: int, width: int, N: Matrix | GivenOperator | None, G: Given | None, masses: Any
) -> ContactMap | GivenOperator:
    """The operator of nc contacts of this rank, in rows of 3, from N or from G with its masses. ValueError on all ranks
    for what is none."""
    if N is not None:
        return N if isinstance(N, GivenOperator) else _by_N(comm, nc, width, N)
    if isinstance(G, (BlockRows, CompactRows, ContactMap)):
        return _map(comm, G)
    return _by_G(comm, nc, width, G, masses)


def in_units(comm: MPI.Comm, operator: ContactMap | GivenOperator, units: Array) -> ContactMap | GivenOperator:
    """The operator of impulses and velocities in cones: of rows, and of N columns, multiplied by ``units`` (nc, 3)."""
    if isinstance(operator, ContactMap):
        rows = operator.block_rows
        of_block = np.repeat(units, np.diff(rows.indptr), axis=0)
        kind = ColumnMap if isinstance(operator, ColumnMap) else BlockMap
        return kind(comm, BlockRows(rows.indptr, rows.indices, of_block[:, :, None] * rows.blocks, rows.columns))
    if isinstance(operator, GivenMatrix):
        every, N = np.concatenate(comm.allgather(units)), operator.local
        row = np.repeat(np.arange(len(units)), np.diff(N.indptr))
        data = units[row][:, :, None] * N.data * every[N.indices][:, None, :]
        return GivenMatrix(comm, sp.bsr_matrix((data, N.indices, N.indptr), shape=N.shape))
    blocks = units[:, :, None] * operator.contact_blocks() * units[:, None, :]
    return GivenOperator(comm, blocks, lambda g: units * operator.velocities(units * g))


def _map(comm: MPI.Comm, G: BlockRows | CompactRows | ContactMap) -> ContactMap:
    """The map in any of its forms, with the products of frames and arms counted by PETSc's log."""
    if isinstance(G, BlockRows):
        return BlockMap(comm, G)
    contact_map = G if isinstance(G, ContactMap) else ContactMap(comm, G)
    contact_map.log_flops = PETSc.Log.logFlops
    return contact_map


def _by_N(comm: MPI.Comm, nc: int, width: int, N: Any) -> GivenOperator:  # noqa: N802 - as in formulas
    rows, total = width * nc, width * comm.allreduce(nc)
    if isinstance(N, PETSc.Mat):
        _check_mat(comm, "N", N, rows, rows)
        known = any(kind in N.getType() for kind in WITH_ENTRIES)
        if not known and total > FULL:
            raise ValueError(
                f"N is a Mat of type {N.getType()}, whose entries are not known; allowed with more than {FULL} rows is "
                "pctt.ccp.Operator(N, blocks), with its diagonal blocks"
            )
    elif isinstance(N, LinearOperator):
        if comm.size > 1 or total > FULL:
            raise ValueError(
                "N is a LinearOperator, whose diagonal blocks are not known; allowed on several ranks or with more "
                f"than {FULL} rows is pctt.ccp.Operator(N, blocks)"
            )
        _check_shape(comm, "N", N.shape, rows, total)
        N = np.asarray(N @ np.eye(total))
    elif hasattr(N, "mult") and hasattr(N, "blocks"):
        return _by_products(comm, nc, width, N)
    local = _rows_of(comm, "N", N, rows, total)
    given = GivenMatrix(comm, _lifted(local, width, both=True).tobsr((3, 3)))
    unlike, most = _unlike(given)
    if unlike > ALIKE * most:
        given.destroy()
        raise ValueError(f"N differs from its transpose by {unlike:.3g}; allowed are symmetric matrices")
    return given


def _unlike(N: GivenMatrix) -> tuple[float, float]:
    """The largest |N_ij - N_ji|, and the largest |N_ij|; the same on all ranks."""
    if N.comm.size == 1:
        different = (N.local - N.local.T).data
    else:
        other = N.mat.transpose(PETSc.Mat())
        other.axpy(-1.0, N.mat, PETSc.Mat.Structure.DIFFERENT_NONZERO_PATTERN)
        different = rows_of(other).data
        other.destroy()
    largest = [max(each.max(initial=0.0), -each.min(initial=0.0)) for each in (different, N.local.data)]
    unlike, most = reduced(N.comm, [], largest)[1]
    return unlike, most


def _by_products(comm: MPI.Comm, nc: int, width: int, N: Any) -> GivenOperator:  # noqa: N803
    """The operator of an `Operator`, or of another object with its attributes."""
    shape, wrong = (nc, width, width), ""
    blocks = np.asarray(N.blocks)
    if blocks.shape != shape or np.iscomplexobj(blocks):
        wrong = f"N.blocks has the shape {blocks.shape} and the type {blocks.dtype}; allowed are {shape} real numbers"
    elif not np.isfinite(blocks).all():
        wrong = "N.blocks has a NaN or an infinite number"
    elif np.abs(blocks - blocks.transpose(0, 2, 1)).max(initial=0.0) > ALIKE * np.abs(blocks).max(initial=0.0):
        wrong = "N.blocks differ from their transposes; allowed are symmetric blocks"
    if not (callable(N.mult) or isinstance(N.mult, (PETSc.Mat, LinearOperator))):
        wrong = f"N.mult has the type {type(N.mult).__name__}; allowed are a function, a LinearOperator, a Mat"
    refuse(comm, wrong)
    mult = _product(comm, N.mult, nc, width)

    def product(g: Array) -> Array:
        return padded(on_each(comm, "N.mult", lambda: rows(np.array(g[:, :width]))))  # which it may change

    def rows(g: Array) -> Array:
        y = np.asarray(mult(g), dtype=float)
        if y.size != nc * width:
            raise ValueError(f"N.mult returns the shape {y.shape}; allowed is {(nc, width)}")
        return y.reshape(nc, width)

    in_space = np.zeros((nc, 3, 3))
    in_space[:, :width, :width] = blocks
    given = GivenOperator(comm, in_space, product)
    rng = np.random.default_rng(comm.rank)
    x, z = rng.standard_normal((2, nc, 3))
    Nx, Nz = given.velocities(x), given.velocities(z)
    numbers = np.isfinite(Nx).all() and np.isfinite(Nz).all()
    refuse(comm, "" if numbers else "N.mult returns a NaN or an infinite number")
    unit = np.zeros((nc, 3))
    unit[:1, 0] = float(comm.rank == 0)
    first = given.velocities(unit)[:1, :width] - unit[:1, :1] * blocks[:1, :, 0]
    unlike = comm.rank == 0 and np.abs(first).max(initial=0.0) > ABOUT * np.abs(blocks[:1]).max(initial=0.0)
    refuse(comm, "N.mult of the first contact's normal is not the first column of N.blocks[0]" if unlike else "")
    sums = comm.allreduce(np.array([np.vdot(z, Nx), np.vdot(x, Nz), np.vdot(x, x), np.vdot(Nz, Nz)]))
    if abs(sums[0] - sums[1]) > ALIKE * np.sqrt(sums[2] * sums[3]):
        raise ValueError(f"N.mult is not symmetric: x'Nz = {sums[1]:.6g} and z'Nx = {sums[0]:.6g}")
    return given


def _product(comm: MPI.Comm, mult: Any, nc: int, width: int) -> Solve:
    """The product of arrays (nc, width)."""
    if isinstance(mult, PETSc.Mat):
        _check_mat(comm, "N.mult", mult, nc * width, nc * width)
        x, y = mult.createVecs()

        def by_mat(g: Array) -> Array:
            x.array[:] = g.ravel()
            mult.mult(x, y)
            return y.array.copy()

        return by_mat
    if isinstance(mult, LinearOperator):
        refuse(comm, "" if mult.shape[0] == nc * width else f"N.mult has {mult.shape[0]} rows; allowed is {nc * width}")
        return lambda g: mult.matvec(g.ravel())
    return mult


def _lifted(rows: sp.csr_matrix, width: int, both: bool = False) -> sp.csr_matrix:
    """The rows of contacts in space: those of the plane get one of zeros each, and of ``both`` the columns too."""
    if width == 3:
        return rows

    def lift(count: int) -> sp.csr_matrix:
        return sp.kron(sp.identity(count // 2), np.eye(3, 2), format="csr")

    rows = lift(rows.shape[0]) @ rows
    return (rows @ lift(rows.shape[1]).T if both else rows).tocsr()


# -- maps with masses --------------------------------------------------------------------------------------


def _by_G(comm: MPI.Comm, nc: int, width: int, G: Any, masses: Any) -> ContactMap | GivenOperator:  # noqa: N802
    if isinstance(G, PETSc.Mat):
        _check_mat(comm, "G", G, width * nc, None)
    rows = _rows_of(comm, "G", G, width * nc, None)
    n = rows.shape[1]
    refuse(comm, "" if comm.allreduce(n, MPI.MAX) == n else f"G has {n} columns on one rank, and more on another")
    rows = _lifted(rows, width)
    known = _masses(comm, masses, n)
    if not isinstance(known, np.ndarray):
        return _by_solves(comm, rows, *known)
    rows = (rows @ sp.diags(1.0 / np.sqrt(known))).tocsr()
    rows.eliminate_zeros()
    count = -(-n // 6)
    rows.resize((3 * nc, 6 * count))
    blocks = rows.tobsr((3, 6))
    own = count * (comm.rank + 1) // comm.size - count * comm.rank // comm.size
    return ColumnMap(comm, BlockRows(blocks.indptr, blocks.indices, blocks.data, own))


def _by_solves(comm: MPI.Comm, G: sp.csr_matrix, solve: Solve, together: bool) -> GivenOperator:  # noqa: N803
    """N = G M^-1 G' in 3 x 3 blocks, by a solve for each row; ``together``: all ranks solve for the same vector."""
    parts = comm.allgather(G) if comm.size > 1 else [G]
    first = sum(part.shape[0] for part in parts[: comm.rank])
    whole, last = sp.vstack(parts, format="csr"), first + G.shape[0]
    begin, end = (0, whole.shape[0]) if together else (first, last)
    batches = comm.allreduce(-(-(end - begin) // BATCH), MPI.MAX)
    blocks, kept, count = np.zeros((G.shape[0] // 3, 3, 3)), list[sp.csr_matrix](), 0
    for batch in range(batches):
        low = min(begin + batch * BATCH, end)
        high = min(low + BATCH, end)
        own = slice(max(low, first), max(min(high, last), max(low, first)))
        X = on_each(comm, "masses", partial(solve, whole[low:high].T.toarray()))[:, own.start - low : own.stop - low]
        if on_any(comm, not np.isfinite(X).all())[0]:
            raise ValueError("masses: a solve returns a NaN or an infinite number")
        k = np.arange((own.stop - own.start) // 3)
        blocks[(own.start - first) // 3 + k] = (whole[own] @ X).reshape(len(k), 3, len(k), 3)[k, :, k, :]
        if count <= MOST:
            kept.append(sp.csr_matrix((whole @ X).T))
            count += comm.allreduce(int(kept[-1].nnz))
    if count <= MOST:
        rows = sp.vstack([sp.csr_matrix((0, whole.shape[0])), *kept], format="csr")
        N = GivenMatrix(comm, rows.tobsr((3, 3)))
        unlike, most = _unlike(N)
        if unlike > ALIKE * most:
            N.destroy()
            raise ValueError(f"masses: G M^-1 G' differs from its transpose by {unlike:.3g}; allowed are exact solves")
        return N

    def product(g: Array) -> Array:
        momentum = G.T @ g.ravel()
        momentum = comm.allreduce(momentum)[:, None]
        return (G @ on_each(comm, "masses", lambda: solve(momentum))[:, 0]).reshape(-1, 3)

    return GivenOperator(comm, blocks, product)


def _masses(comm: MPI.Comm, masses: Any, n: int) -> Array | tuple[Solve, bool]:
    """The diagonal of M (n,), or a function that returns M^-1 B of B (n, k), and whether all ranks must call it
    together. ValueError on all ranks for others."""
    if masses is None:
        return np.ones(n)
    if isinstance(masses, (PETSc.Vec, PETSc.Mat, PETSc.KSP)):
        _refuse_unready(comm, "masses", masses)
    if isinstance(masses, PETSc.Vec):
        masses = _whole_vector(masses)
    elif isinstance(masses, PETSc.Mat):
        masses = sp.vstack(masses.comm.tompi4py().allgather(rows_of(masses)), format="csr")
    elif isinstance(masses, PETSc.KSP):
        return _by_ksp(comm, masses, n), True
    if isinstance(masses, tuple) and len(masses) == 2:
        wrong = "" if np.shape(masses[0]) == (n, n) else f"masses: a factor of shape {np.shape(masses[0])}"
        if not wrong and np.ndim(masses[1]):  # the pivots of lu_factor
            wrong = "masses: the second part of the factor is an array"
        refuse(comm, wrong + f"; allowed is what scipy.linalg.cho_factor gives of M {(n, n)}" if wrong else "")
        return lambda b: scipy.linalg.cho_solve(masses, b), False
    if not sp.issparse(masses) and (hasattr(masses, "solve") or callable(masses)):
        return _column_by_column(masses.solve if hasattr(masses, "solve") else masses, n), False
    return _by_matrix(comm, masses, n)


def _by_matrix(comm: MPI.Comm, masses: Any, n: int) -> Array | tuple[Solve, bool]:
    """Of masses as an array or a scipy matrix."""
    M, wrong = np.ones(n), ""
    try:
        M = masses if sp.issparse(masses) else _real(masses)
    except (TypeError, ValueError) as error:
        wrong = f"masses are no numbers: {error}"
    if M.shape not in ((n,), (n, n)):
        wrong = (
            f"masses: {type(masses).__name__} of shape {M.shape}; allowed are {(n,)} or {(n, n)} numbers, as G has {n} "
            "columns, a factor with solve(b), the pair of scipy.linalg.cho_factor, a PETSc Vec, Mat or KSP, or a "
            "function b -> M^-1 b"
        )
    elif M.ndim == 2 and np.isfinite(M.sum()) and _is_diagonal(M):
        M = np.asarray(M.diagonal(), dtype=float)
    if not wrong and M.ndim == 1 and not (M > 0).all():
        k = np.flatnonzero(~(M > 0))[0]
        wrong = f"masses: {M[k]} at {k}; allowed are numbers > 0, and inf for what does not move"
    refuse(comm, wrong)
    if M.ndim == 1:
        return M
    numbers = np.asarray(M.data)
    if numbers.dtype.kind == "c" or not np.isfinite(numbers).all():
        wrong = "masses: a matrix with a NaN, an infinite or a complex number"
    elif abs(M - M.T).max() > ALIKE * abs(M).max():
        unlike = abs(M - M.T).max()
        wrong = f"masses: a matrix that differs from its transpose by {unlike:.3g}; allowed are symmetric ones"
    refuse(comm, wrong)
    solve = _factorised(M)
    refuse(comm, "" if solve else "masses: a matrix that is not positive definite; allowed are positive definite ones")
    assert solve is not None
    return solve, False


def _is_diagonal(M: Any) -> bool:  # noqa: N803
    entries = sp.coo_matrix(M)
    return bool((entries.row[entries.data != 0] == entries.col[entries.data != 0]).all())


def _factorised(M: Any) -> Solve | None:  # noqa: N803
    """M^-1 of a symmetric matrix; None if it is not positive definite."""
    if not sp.issparse(M):
        try:
            factor = scipy.linalg.cho_factor(M)
        except scipy.linalg.LinAlgError:
            return None
        return lambda b: scipy.linalg.cho_solve(factor, b)
    M = sp.csc_matrix(M, dtype=float)
    if structural_rank(M) < M.shape[0]:
        return None
    try:
        # no pivots off the diagonal: those of U are then those of L D L'
        found = splu(M, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
    except RuntimeError:
        return None
    definite = np.array_equal(found.perm_r, found.perm_c) and (found.U.diagonal() > 0).all()
    return found.solve if definite else None


def _column_by_column(solve: Solve, n: int) -> Solve:
    """The solve of B (n, k) by one of b (n,)."""

    def of_each(B: Array) -> Array:
        out = np.empty_like(B)
        for k in range(B.shape[1]):
            x = np.asarray(solve(np.ascontiguousarray(B[:, k])), dtype=float)
            if x.shape != (n,):
                raise ValueError(f"masses: a solve returns the shape {x.shape}; allowed is {(n,)}")
            out[:, k] = x
        return out

    return of_each


def _by_ksp(comm: MPI.Comm, ksp: PETSc.KSP, n: int) -> Solve:
    """M^-1 b by a KSP, of a vector b that all ranks have."""
    b, x = ksp.getOperators()[0].createVecs()
    if b.getSize() != n:
        raise ValueError(f"masses: a KSP of {b.getSize()} rows; allowed is {n}, as G has {n} columns")
    low, high = b.getOwnershipRange()

    def solve(b_whole: Array) -> Array:
        b.array[:] = b_whole[low:high]
        ksp.solve(b, x)
        if ksp.getConvergedReason() < 0:
            raise ValueError(f"masses: the KSP does not converge (reason {ksp.getConvergedReason()})")
        return _whole_vector(x)

    return _column_by_column(solve, n)


def _whole_vector(vector: PETSc.Vec) -> Array:
    return np.concatenate(vector.comm.tompi4py().allgather(vector.array_r.copy()))


# -- rows --------------------------------------------------------------------------------------------------


def _rows_of(comm: MPI.Comm, name: str, A: Any, rows: int, columns: int | None) -> sp.csr_matrix:  # noqa: N803
    """This rank's rows of a matrix, their columns global. ValueError on all ranks for what is none."""
    local, wrong = sp.csr_matrix((rows, columns or 0)), ""
    try:
        if isinstance(A, PETSc.Mat):
            A = rows_of(A)
        numeric = sp.issparse(A) or (isinstance(A, np.ndarray) and A.ndim == 2)
        if not numeric:
            wrong = f"{name} has the type {type(A).__name__}; allowed are {MATRICES}"
            wrong += ", pctt.ccp.Operator" if name == "N" else ", BlockRows, CompactRows"
        elif np.dtype(A.dtype).kind == "c":
            wrong = f"{name} has complex numbers; allowed are real ones"
        else:
            local = sp.csr_matrix(A, dtype=float)
    except (TypeError, ValueError, PETSc.Error) as error:
        wrong = f"{name} has no entries that can be read: {error}"
    refuse(comm, wrong)
    _check_shape(comm, name, local.shape, rows, columns)
    refuse(comm, "" if np.isfinite(local.data).all() else f"{name} has a NaN or an infinite number")
    return local


def _check_shape(comm: MPI.Comm, name: str, shape: tuple[int, int], rows: int, columns: int | None) -> None:
    wrong = shape[0] != rows or shape[1] != (shape[1] if columns is None else columns)
    allowed = f"({rows}, {'n' if columns is None else columns})"
    refuse(comm, f"{name} has the shape {shape}; allowed is {allowed}, rows of this rank's contacts" if wrong else "")


def _refuse_unready(comm: MPI.Comm, name: str, thing: PETSc.Object) -> None:
    """ValueError on all ranks if a Mat, Vec or KSP lacks something on any."""
    lack = unready(thing)
    refuse(comm, lack and f"{name} is a {type(thing).__name__} that {lack}; allowed is one that is ready for use")


def _check_mat(comm: MPI.Comm, name: str, mat: PETSc.Mat, rows: int, columns: int | None) -> None:
    """ValueError on all ranks if a Mat is not ready, or has other ranks or other rows than the contacts."""
    _refuse_unready(comm, name, mat)
    same = MPI.Comm.Compare(comm, mat.comm.tompi4py()) in (MPI.IDENT, MPI.CONGRUENT)
    refuse(comm, "" if same else f"{name} is a Mat on other ranks than the problem; allowed are the same")
    size = mat.getLocalSize()
    wrong = size[0] != rows or (columns is not None and size[1] != columns)
    allowed = f"{rows} rows" + (" and columns" if columns is not None else "")
    words = f"{name} has {size[0]} local rows and {size[1]} columns; allowed are {allowed}"
    refuse(comm, words if wrong else "")
