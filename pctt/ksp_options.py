"""Options of a KSP that the project makes. Its defaults are in PETSc's database only while PETSc reads them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager

from petsc4py import PETSc


@contextmanager
def entered(options: Mapping[str, str | None]) -> Iterator[None]:
    """Put these options into the database within the block; afterwards it has the user's options again."""
    database = PETSc.Options()
    users = {name: value for name, value in database.getAll().items() if name in options}
    for name, value in options.items():
        database[name] = value
    try:
        yield
    finally:
        for name in options:
            if name in users:
                database[name] = users[name]
                database.hasName(name)  # marks it as used, so that PETSc does not report it as left over
            else:
                database.delValue(name)


def to_enter(prefix: str, defaults: Mapping[str, str], ranks: int) -> dict[str, str | None]:
    """The options to enter for a KSP with this prefix.

    They are the defaults of options that the user has not given. On several ranks block Jacobi replaces ILU and ICC,
    which PETSc has for one rank only; they become the solvers of its blocks.
    """
    database = PETSc.Options()
    options: dict[str, str | None] = {  # PETSc looks them up: options of mg_levels_ are also those of mg_levels_1_
        prefix + name: value for name, value in defaults.items() if not database.hasName(prefix + name)
    }
    everything = {**database.getAll(), **options}
    kind = options.get(prefix + "pc_type") or database.getString(prefix + "pc_type", "")
    if ranks > 1 and kind in ("ilu", "icc"):
        options |= {prefix + "pc_type": "bjacobi", prefix + "sub_pc_type": kind}
        for name, value in everything.items():
            if name.startswith(prefix + "pc_factor_"):
                options[f"{prefix}sub_{name[len(prefix):]}"] = value
                database.hasName(name)  # marks it as used, so that PETSc does not report it as left over
    return options


def prefer_mumps(pc: PETSc.PC, kind: str) -> None:
    """Use MUMPS for a factorisation if PETSc has it. PETSc's own factorisations have natural orders and one rank
    only."""
    if kind in ("cholesky", "lu") and PETSc.Sys.hasExternalPackage("mumps"):
        pc.setType(kind)
        pc.setFactorSolverType("mumps")
