"""Options of a KSP that the project makes: its defaults stand in PETSc's database only while PETSc reads it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager

from petsc4py import PETSc


@contextmanager
def entered(options: Mapping[str, str | None]) -> Iterator[None]:
    """Have these options in the database within the block; afterwards it is the user's again."""
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
                database.hasName(name)  # it has been used: PETSc is not to report it as left over
            else:
                database.delValue(name)


def to_enter(prefix: str, defaults: Mapping[str, str], ranks: int) -> dict[str, str | None]:
    """What is to be entered for a KSP of this prefix: defaults where the user has said nothing, and block Jacobi in
    place of ILU and ICC on several ranks, as PETSc has these for one rank only."""
    given = PETSc.Options().getAll()
    options: dict[str, str | None] = {
        prefix + name: value for name, value in defaults.items() if prefix + name not in given
    }
    everything = {**given, **options}
    kind = everything.get(prefix + "pc_type")
    if ranks > 1 and kind in ("ilu", "icc"):
        options |= {prefix + "pc_type": "bjacobi", prefix + "sub_pc_type": kind}
        for name, value in everything.items():
            if name.startswith(prefix + "pc_factor_"):
                options[f"{prefix}sub_{name[len(prefix):]}"] = value
                PETSc.Options().hasName(name)  # PETSc is not to report it as left over
    return options


def prefer_mumps(pc: PETSc.PC, kind: str) -> None:
    """Let a factorisation be MUMPS's where PETSc has it: its own keeps to natural orders and one rank."""
    if kind in ("cholesky", "lu") and PETSc.Sys.hasExternalPackage("mumps"):
        pc.setType(kind)
        pc.setFactorSolverType("mumps")
