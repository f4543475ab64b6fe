"""The entries of a Mat on several ranks: from a function of the user, or from a dense Mat."""

from __future__ import annotations

import traceback
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from dem.exchange import refuse
from pctt.tt.train import Array

DENSE = ("dense", "seqdense", "mpidense")


#: Takes rows and columns, integers (p,), and returns numbers (p,).
Entry = Callable[[Array, Array], Array]


def given(P: PETSc.Mat, name: str) -> Any:
    """What the user has said about a Mat under a name (``entries``, ``grid``, ``coordinates``), or None.

    It is the attribute of the Mat (``setAttr``). If the Mat is of type python, it may also be an attribute or a method
    of its context, or be in a dict ``appctx`` of the context, as Firedrake has it. A method is called without the Mat.
    """
    value = P.getAttr(name)
    if value is not None or P.getType() != PETSc.Mat.Type.PYTHON:
        return value
    context = P.getPythonContext()
    value = getattr(context, name, None)
    more = getattr(context, "appctx", None)
    if value is None and isinstance(more, Mapping):
        value = more.get(name)
    return value() if callable(value) and name != "entries" else value


def multiplies(A: PETSc.Mat) -> bool:
    """Whether a Mat has products; one of type python may have none."""
    return A.getType() != PETSc.Mat.Type.PYTHON or hasattr(A.getPythonContext(), "mult")


def has_entries(P: PETSc.Mat) -> bool:
    """Whether P gives its entries one by one: the user has given ``entries``, or P is dense and has a grid or no
    blocks."""
    dense = P.getType() in DENSE and (P.getBlockSize() == 1 or given(P, "grid") is not None)
    return dense or given(P, "entries") is not None


@dataclass(frozen=True)
class Combination:
    """The function of the entries of c I + f_1 A_1 + f_2 A_2 + ...; the terms are (f_k, the entries of A_k)."""

    added: float
    terms: Sequence[tuple[float, Entry]]

    @classmethod
    def of_function(cls, function: Entry) -> Combination:
        return function if isinstance(function, cls) else cls(0.0, ((1.0, function),))

    def __call__(self, i: Array, j: Array) -> Array:
        values = np.where(i == j, self.added, 0.0)
        for factor, function in self.terms:
            values = values + factor * np.asarray(function(i.copy(), j.copy()))
        return values

    def scaled(self, factor: float) -> Combination:
        return Combination(factor * self.added, [(factor * each, function) for each, function in self.terms])

    def plus(self, factor: float, other: Combination) -> Combination:
        """This matrix + factor times another one; terms with the same function become one."""
        sums: dict[int, tuple[float, Entry]] = {}  # by identity, as a user's function may have no hash
        for each, function in (*self.terms, *other.scaled(factor).terms):
            sums[id(function)] = sums.get(id(function), (0.0, function))[0] + each, function
        return Combination(self.added + factor * other.added, [term for term in sums.values() if term[0]])


class Entries:
    """Calling it gives the values (p,) at rows i and columns j; collective.

    i and j are the same integers (p,) on all ranks, and each rank evaluates its share. If one rank has an error, all
    ranks raise it.
    """

    def __init__(self, comm: MPI.Comm, function: Entry) -> None:
        self.comm, self.function = comm, function

    @classmethod
    def of_mat(cls, P: PETSc.Mat) -> Entries:
        """The entries of a Mat for which `has_entries` is true."""
        comm, function = P.comm.tompi4py(), given(P, "entries")
        found = comm.allgather(None if function is None else callable(function))
        lacking = found[0] is None and P.getType() not in DENSE
        if len(set(found)) > 1 or found[0] is False or lacking:
            raise ValueError(
                f"the attribute entries of the Mat is {found} by rank (None: missing, False: no function); allowed is "
                "a function of two integer arrays, on all ranks"
            )
        return cls(comm, function) if found[0] else DenseEntries(P)

    def __call__(self, i: Array, j: Array) -> Array:
        share = self._share(i)
        values = self.own(i[share], j[share])
        if self.comm.size == 1:
            return values
        out = np.zeros(len(i))
        out[share] = values
        self.comm.Allreduce(MPI.IN_PLACE, out)
        return out

    def _share(self, i: Array) -> slice | Array:
        size, rank = self.comm.size, self.comm.rank
        return slice(len(i) * rank // size, len(i) * (rank + 1) // size)

    def own(self, i: Array, j: Array) -> Array:
        """Values at rows and columns that only this rank knows; collective."""
        values, wrong = np.zeros(len(i)), ""
        if len(i):
            try:
                raw = np.asarray(self.function(i.copy(), j.copy()))  # copies, because the function may change them
            except Exception as error:  # any kind, because it is the user's code
                frame = traceback.extract_tb(error.__traceback__)[-1]
                wrong = f"{type(error).__name__}: {error} ({frame.filename}:{frame.lineno})"
            else:
                wrong = _what_is_wrong(raw, i, j)
                values = values if wrong else raw.astype(float)
        wrong = wrong and f"entries of the Mat: {wrong}; allowed are finite real numbers, as many as indices"
        refuse(self.comm, wrong)
        return values


def _what_is_wrong(values: Array, i: Array, j: Array) -> str:
    if values.shape != i.shape:
        return f"an array of shape {values.shape} for {len(i)} indices"
    if values.dtype.kind not in "fiub":
        return f"an array of type {values.dtype}"
    bad = np.flatnonzero(~np.isfinite(values))
    return f"{values[bad[0]]} at row {i[bad[0]]}, column {j[bad[0]]}" if len(bad) else ""


class DenseEntries(Entries):
    """The entries of a dense Mat; each rank has its rows."""

    def __init__(self, P: PETSc.Mat) -> None:
        self.comm = P.comm.tompi4py()
        self.first, self.last = P.getOwnershipRange()
        self.local = P.getDenseArray(readonly=True)  # otherwise it counts as a change of P

    def _share(self, i: Array) -> slice | Array:
        return np.flatnonzero((i >= self.first) & (i < self.last))

    def function(self, i: Array, j: Array) -> Array:
        return self.local[i - self.first, j]


def is_symmetric(entries: Entries, rows: int) -> bool:
    """Whether entries at some random places equal those across the diagonal, up to rounding; collective."""
    i, j = np.random.default_rng(0).integers(0, rows, (2, 256))
    here, there = entries(i, j), entries(j, i)
    return entries.comm.bcast(bool(np.linalg.norm(here - there) <= 1e-8 * np.linalg.norm(here)))


def diagonal(P: PETSc.Mat) -> Array:
    """This rank's part of the diagonal, for a Mat with `has_entries`; collective."""
    here = np.arange(*P.getOwnershipRange())
    return Entries.of_mat(P).own(here, here)


def diagonal_blocks(P: PETSc.Mat) -> Array:
    """The diagonal blocks (n, bs, bs) of this rank's block rows, for a Mat with `has_entries`; collective."""
    bs = P.getBlockSize()
    rows = np.arange(*P.getOwnershipRange()).reshape(-1, bs, 1)
    i, j = np.broadcast_arrays(rows, rows.transpose(0, 2, 1))
    return Entries.of_mat(P).own(i.ravel(), j.ravel()).reshape(i.shape)
