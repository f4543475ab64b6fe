"""The cone complementarity problem (CCP): min 1/2 g'Ng + r'g over the friction cones."""

from __future__ import annotations

import copy
from functools import cached_property
from typing import NamedTuple, Union

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from dem.compiled import loop
from dem.contact_map import BlockRows, CompactRows, ContactMap
from dem.exchange import reduced, refuse
from pctt.ccp.cone import Array, FrictionCones
from pctt.ccp.delassus import BlockMap, GivenMatrix, delassus, without_hubs

Given = Union[BlockRows, CompactRows, ContactMap]


class Errors(NamedTuple):
    """Of impulses g and velocities y = N g + r.

    Attributes
    ----------
    natural : ||g - P(g - y / mean diag N)|| / ||g||. inf if that is undefined: for g = 0, unless it solves the problem,
        and if g or y has a nan or inf
    work : the larger of the closing and the opening work, over 1/2 g'Ng: the sums of g_n max(-y_n, 0) and of max(g.y,
        0) over the contacts. 0 without impulses, inf if it is no number
    speed : the greatest -y_n: how fast a contact still closes beyond what its spring gives (m/s)
    """

    natural: float
    work: float
    speed: float


class ConeProblem:
    """One step's cone problem, its contacts distributed over the ranks of ``comm``.

    N = G G' + C is given by the mass-scaled contact map G = D' M^-1/2 (3Nc x 6M), or directly (``N``). The compliance
    C is diagonal: contacts that yield a little, see `dem.stiffness`.

    Attributes
    ----------
    r : (nc, 3) velocities of the contacts without impulses, plus gap/dt (m/s)
    mu : (nc,) friction coefficients
    operator : G or N, with its products; a copy of what was given, unless that is a `ContactMap`
    contact_map : the operator if it is G, and the bodies are known; or None
    point : (nc, 3) contact points (m) or None; orders the unknowns of hierarchical preconditioners
    key : (nc,) persistent names of the contacts or None
    compliance : (nc, 3) the diagonal of C, (C_n, C_t, C_t) per contact (1/kg); given as C_n, a number or (nc,), or as
        (nc, 2)
    yields : whether C is not zero, the same on all ranks
    cones : those of the contacts of this rank
    size : contacts on all ranks, Nc
    mean_diagonal : mean of the diagonal of N without compliance (1/kg); 1 for a problem without contacts
    """

    def __init__(
        self,
        comm: MPI.Comm,
        r: Array,
        mu: Array,
        *,
        G: Given | None = None,
        N: PETSc.Mat | None = None,
        point: Array | None = None,
        key: np.ndarray | None = None,
        compliance: Array | float = 0.0,
    ):
        if (G is None) == (N is None):
            raise ValueError("a cone problem is given by either the map G or the matrix N")
        self.comm, self.point, self.key = comm, point, key
        refuse(comm, _wrong(r, mu, G, N, point, key, compliance))
        self.r = np.ascontiguousarray(r, dtype=float).reshape(-1, 3)
        self.mu = np.ascontiguousarray(mu, dtype=float)
        self.compliance = compliances(compliance, len(self.r))
        self.cones = self._cones()
        self.contact_map = None if G is None else _map(comm, G)
        self.operator: ContactMap | GivenMatrix = self.contact_map or GivenMatrix(comm, N)
        bad = _not_finite(self.r)
        if not _none_negative(self.mu):
            bad += int(np.sum(~((self.mu >= 0) & (self.mu < np.inf))))
        trace = _diagonals(self._rigid_blocks).sum()  # has squares of all numbers of G
        known = self.contact_map is not None and np.isfinite(trace)
        wrong = 0 if known else _not_finite(self._rigid_blocks)
        here = np.array([bad, wrong, self.cones.count, self.compliance.max(initial=0.0) > 0.0, self.r.size, trace])
        *counts, trace = self.sum(here).tolist()
        bad, wrong, self.size, soft, rows = map(int, counts)
        if bad or wrong:
            self.destroy()
            what = f"{bad} contacts with a" if bad else f"G has a NaN or an infinite number in {wrong} contacts"
            raise ValueError(f"{what} NaN, infinite or negative coefficient" if bad else what)
        self.yields = bool(soft)
        self.mean_diagonal = trace / rows if trace > 0.0 else 1.0

    def __repr__(self) -> str:
        given = "N" if self.contact_map is None else "G"
        return f"ConeProblem({self.size} contacts, {self.comm.size} ranks, given by {given})"

    def _cones(self) -> FrictionCones:
        return FrictionCones(self.mu)

    # -- the operator ---------------------------------------------------------------------------------------

    def product(self, g: Array) -> Array:
        """N g for impulses g (nc, 3): velocities of the contacts (nc, 3)."""
        y = np.zeros_like(self.r)
        self.operator.add_delassus(g, y)
        if self.yields:
            y += self.compliance * g
        return y

    def momentum(self, g: Array) -> Array:
        """G' g (6m,): the change of the mass-scaled velocities of this rank's bodies by impulses g (nc, 3). A problem
        given by N has no bodies: g itself."""
        return self.operator.momenta(g).ravel()

    def velocity_of(self, momentum: Array) -> Array:
        """G v: velocities of the contacts (nc, 3) for those of the bodies; N g where the problem is given by N."""
        return self.operator.velocities(momentum)

    @np.errstate(over="ignore", invalid="ignore")  # impulses may be no numbers
    def errors(self, g: Array, y: Array, coulomb: bool = False, units: Array | None = None) -> Errors:
        """How far impulses g with the velocities y = N g + r are from a solution. For Coulomb's law y gets De Saxce's
        term. Both are multiplied by ``units`` (2, nc, 3), if these are given."""
        sums, most = self.cones.errors(g, y, self.r, 1.0 / self.mean_diagonal, coulomb, units)
        (moved, whole, closing, opening, energy), (speed,) = reduced(self.comm, sums, (most,))
        natural = np.sqrt(moved) / np.sqrt(whole) if whole > 0.0 else np.inf
        work = 0.0 if energy <= 0.0 else np.maximum(closing, opening) / energy
        natural, work, speed = (float(x) if x == x else np.inf for x in (natural, work, speed))
        return Errors(0.0 if moved == 0.0 else natural, work, speed)

    def natural_residual(self, g: Array, y: Array, coulomb: bool = False) -> float:
        """That of the `errors`."""
        return self.errors(g, y, coulomb).natural

    @cached_property
    def N(self) -> PETSc.Mat:
        """N as a Mat of block size 3 (BAIJ), without the columns of hubs; built at its first use and kept."""
        N = self.rigid_matrix()
        if self.yields:
            diagonal = N.createVecLeft()
            diagonal.array[:] = self.compliance.ravel()
            N.setDiagonal(diagonal, PETSc.InsertMode.ADD_VALUES)
            diagonal.destroy()
        return N

    def rigid_matrix(self) -> PETSc.Mat:
        """A new Mat like ``N`` without the compliance."""
        if isinstance(self.operator, GivenMatrix):
            return self.operator.mat.duplicate(copy=True)
        return delassus(self.comm, self._split[0])

    @property
    def has_hubs(self) -> bool:
        """Whether some bodies have more than HUB contacts and would fill N: ``N`` is without their columns of G."""
        return self.contact_map is not None and self._split[1]

    @cached_property
    def _split(self) -> tuple[BlockRows, bool]:
        assert self.contact_map is not None
        return without_hubs(self.comm, self.contact_map.block_rows)

    @cached_property
    def diagonal_blocks(self) -> Array:
        """The 3 x 3 diagonal blocks of N (nc, 3, 3), hubs and the compliance included."""
        if not self.yields:
            return self._rigid_blocks
        blocks = self._rigid_blocks.copy()
        for k in range(3):
            blocks[:, k, k] += self.compliance[:, k]
        return blocks

    @cached_property
    def diagonal(self) -> Array:
        """The diagonal of N (nc, 3), hubs and the compliance included."""
        return _diagonals(self._rigid_blocks) + self.compliance

    @cached_property
    def compliance_blocks(self) -> Array:
        """C as blocks (nc, 3, 3)."""
        return self.compliance[:, :, None] * np.eye(3)

    @cached_property
    def _rigid_blocks(self) -> Array:
        return self.operator.contact_blocks()

    def structure(self) -> tuple[np.ndarray, ...]:
        """Arrays of this rank that are equal where contacts, their bodies and all sizes are."""
        key = np.zeros(0) if self.key is None else self.key
        return (key, *self.operator.structure(), np.array([self.size]))

    @cached_property
    def all_yield(self) -> bool:
        """Whether all contacts have compliance; the same on all ranks."""
        normal = self.compliance[: self.cones.count, 0]
        return self.yields and self.min(normal.min(initial=np.inf)) > 0.0

    def by_rows(self) -> ConeProblem:
        """The same problem with the rows of its map as they are, if more than contacts couples its bodies; it shares
        all arrays, and has the same residuals. Collective."""
        if self.contact_map is None or not self.contact_map.couples:
            return self
        other = copy.copy(self)
        for name in ("_rigid_blocks", "diagonal", "diagonal_blocks", "_split", "N"):  # those of its map are estimates
            other.__dict__.pop(name, None)
        other.contact_map = other.operator = self._block_map
        return other

    @cached_property
    def _block_map(self) -> BlockMap:
        assert self.contact_map is not None
        return BlockMap(self.comm, self.contact_map.block_rows)

    def by_matrix(self, N: GivenMatrix) -> ConeProblem:
        """The same problem given by its N without compliance; it shares all arrays."""
        other = copy.copy(self)
        other.contact_map, other.operator = None, N
        return other

    # -- reductions over all contacts -----------------------------------------------------------------------

    def sum(self, x):
        """Over all ranks, of a number or an array."""
        return self._reduced(x, MPI.SUM)

    def min(self, x: float) -> float:
        return self._reduced(x, MPI.MIN)

    def max(self, x):
        return self._reduced(x, MPI.MAX)

    def _reduced(self, x, op: MPI.Op):
        if self.comm.size == 1:
            return x
        here = np.array(x, order="C")
        if here.dtype == bool:  # MPI has no maximum of these
            here = here.astype(int)
        everywhere = np.empty_like(here)
        self.comm.Allreduce(here, everywhere, op)
        return everywhere if here.ndim else everywhere.item()

    def dot(self, x: Array, y: Array) -> float:
        return self.sum(float(np.vdot(x, y)))

    def norm(self, x: Array) -> float:
        return float(np.sqrt(self.dot(x, x)))

    def __enter__(self) -> ConeProblem:
        return self

    def __exit__(self, *exception: object) -> None:
        self.destroy()

    def destroy(self) -> None:
        """Free the PETSc objects now."""
        self.operator.destroy()
        if "N" in self.__dict__:
            self.__dict__.pop("N").destroy()


def compliances(compliance: Array | float, contacts: int) -> Array:
    """The diagonal of C (nc, 3), of so many contacts, from what a `ConeProblem` takes as the compliance."""
    given = np.asarray(compliance, dtype=float)
    if given.ndim == 2:
        return _with_both_tangents(np.ascontiguousarray(given))
    out = np.zeros((contacts, 3))
    out[:, 0] = given
    return out


@loop
def _with_both_tangents(given: Array) -> Array:
    out = np.empty((len(given), 3))
    for c in range(len(given)):
        out[c, 0], out[c, 1], out[c, 2] = given[c, 0], given[c, 1], given[c, 1]
    return out


def _diagonals(blocks: Array) -> Array:
    """The diagonals (nc, 3) of blocks (nc, 3, 3). (Three times as fast as numpy's einsum.)"""
    return blocks.reshape(-1, 9)[:, ::4]


def _not_finite(array: Array) -> int:
    """How many rows of an array have a NaN or an infinite number."""
    if np.isfinite(array.sum()):  # so are all its numbers
        return 0
    return int((~np.isfinite(array).reshape(len(array), -1).all(axis=1)).sum())


def _none_negative(array: Array) -> bool:
    """Whether all numbers are finite and >= 0."""
    return bool(array.min(initial=0.0) >= 0.0 and array.max(initial=0.0) < np.inf)


def _map(comm: MPI.Comm, G: Given) -> ContactMap:
    """The map in any of its forms, with the products of frames and arms counted by PETSc's log."""
    if isinstance(G, BlockRows):
        return BlockMap(comm, G)
    contact_map = G if isinstance(G, ContactMap) else ContactMap(comm, G)
    contact_map.log_flops = PETSc.Log.logFlops
    return contact_map


def _wrong(
    r: Array, mu: Array, G: Given | None, N: PETSc.Mat | None, point: Array | None, key: np.ndarray | None,
    compliance: Array | float,
) -> str:  # fmt: skip
    """What is wrong with the shapes of a problem's data on this rank; empty if nothing is."""
    try:
        shape, friction = np.asarray(r, dtype=float).shape, np.asarray(mu, dtype=float).shape
    except (TypeError, ValueError) as error:
        return f"r or mu are no numbers: {error}"
    nc = int(np.prod(shape)) // 3
    if shape not in ((nc, 3), (3 * nc,)):
        return f"r has the shape {shape}; allowed is (nc, 3)"
    if friction != (nc,):
        return f"{nc} contacts in r but {friction[0] if len(friction) == 1 else friction} friction coefficients"
    known = isinstance(G, (BlockRows, CompactRows, ContactMap))
    if G is not None and (not known or G.rows != nc):
        rows = f"{G.rows} contacts" if known else f"the type {type(G).__name__}"
        return f"{nc} contacts in r, but G has {rows}; allowed are BlockRows or CompactRows of as many"
    if N is not None and N.getLocalSize() != (3 * nc, 3 * nc):
        return f"{nc} contacts in r, but N has {N.getLocalSize()} local rows and columns"
    for name, given, width in (("point", point, (3,)), ("key", key, ())):
        if given is not None and np.shape(given) != (nc, *width):
            return f"{name} has the shape {np.shape(given)}; allowed is {(nc, *width)}"
    if np.shape(compliance) not in ((), (nc,), (nc, 2)):
        return f"compliance has the shape {np.shape(compliance)}; allowed are {(nc,)}, {(nc, 2)}, or a number"
    if not _none_negative(np.asarray(compliance)):
        return "compliance: allowed are numbers >= 0"
    return ""
