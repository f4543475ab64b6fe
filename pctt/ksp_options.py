"""PETSc's options database: the options of a KSP that the project makes, and those that nothing has read.

Defaults are in the database only while PETSc reads them, as in the options manager of petsctools.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager

from petsc4py import PETSc

from pctt.options import OptionError, nearest, no_such_option
from pctt.petsc import is_used, options_database

#: First words of the options of PETSc's solvers; all others are read when PETSc starts or ends.
OF_SOLVERS = (
    "ksp_", "pc_", "mat_", "vec_", "sub_", "mg_", "fieldsplit_", "compare_", "fallback_",
)  # fmt: skip

# those of the others that it reads in a run or at its end; what it has read when it starts is not `unused`
_LATE = (
    "is_", "sf_", "dm_", "prefix_", "log_", "options_", "info", "malloc", "memory_", "viewer_", "draw_", "citations",
    "help", "version", "on_error", "start_in_debugger", "nox", "get_total_flops", "tmp", "shared_tmp", "not_shared_tmp",
)  # fmt: skip

#: The options of Newton systems that are typed most, for what others are taken to be misspelt.
COMMON = (
    "ksp_type", "ksp_rtol", "ksp_atol", "ksp_max_it", "ksp_monitor", "ksp_view", "ksp_norm_type", "ksp_pc_side",
    "ksp_converged_reason", "ksp_gmres_restart", "pc_type", "pc_python_type", "pc_factor_levels",
    "pc_factor_shift_type", "pc_factor_mat_solver_type", "pc_factor_mat_ordering_type",
)  # fmt: skip


@contextmanager
def entered(options: Mapping[str, str | None]) -> Iterator[None]:
    """Put these options into the database within the block; afterwards it has the user's options again."""
    database = PETSc.Options()
    users = {name: value for name, value in options_database().items() if name in options}
    for name, value in options.items():
        database[name] = value
    try:
        yield
    finally:
        for name in options:
            database.delValue(name)
        for name, value in users.items():
            database[name] = value
        keep_from_petsc(users)


def to_enter(prefix: str, defaults: Mapping[str, str], ranks: int) -> dict[str, str | None]:
    """The options to enter for a KSP with this prefix.

    They are the defaults of options that the user has not given. Factorisations are those of MUMPS if PETSc has it: its
    own have natural orders and one rank only. On several ranks block Jacobi replaces ILU and ICC, which PETSc has for
    one rank only; they become the solvers of its blocks.
    """
    database = PETSc.Options()
    options: dict[str, str | None] = {  # PETSc looks them up: options of mg_levels_ are also those of mg_levels_1_
        prefix + name: value for name, value in defaults.items() if not database.hasName(prefix + name)
    }
    everything = {**options_database(), **options}
    kind, solver = everything.get(prefix + "pc_type"), prefix + "pc_factor_mat_solver_type"
    if kind in ("cholesky", "lu") and solver not in everything and PETSc.Sys.hasExternalPackage("mumps"):
        options[solver] = "mumps"
        room = prefix + "mat_mumps_icntl_14"  # % beyond its estimate, which pivots of nearly singular matrices exceed
        options |= {} if room in everything else {room: "100"}
    if ranks > 1 and kind in ("ilu", "icc"):
        options |= {prefix + "pc_type": "bjacobi", prefix + "sub_pc_type": kind}
        factor = {name: value for name, value in everything.items() if name.startswith(prefix + "pc_factor_")}
        options |= {f"{prefix}sub_{name[len(prefix):]}": value for name, value in factor.items()}
        keep_from_petsc(factor)
    return options


def keep_from_petsc(names: Iterable[str]) -> None:
    """Keep PETSc from warnings about these options: it warns at the end of options that nothing has read."""
    for name in names:
        PETSc.Options().hasName(name)


def unused(names: Iterable[str]) -> list[str]:
    """Those of the names in PETSc's database that nobody has asked for."""
    return [name for name in names if not is_used(name)]


def refuse_stray(words: Sequence[str]) -> None:
    """OptionError for a word of the command line that is neither an option nor the value of an option."""
    before = ""
    for word in words:
        is_option = re.match(r"--?[a-zA-Z]", word) is not None
        if not is_option and not before:
            raise OptionError(f"{word}: belongs to no option; a value follows its option, as in -output {word}")
        before = word if is_option else ""


def refuse_unknown(names: Iterable[str], known: Iterable[str]) -> None:
    """OptionError for a name that neither the project nor PETSc knows; the message has the nearest of our names."""
    known = set(known)
    for name in unused(names):
        if name not in known and not name.startswith(OF_SOLVERS + _LATE):
            raise no_such_option(name, known)


def refuse_misspelt(names: Iterable[str]) -> None:
    """OptionError for a name that nobody has asked for and that is nearly a common one."""
    for name in unused(names):
        if name not in COMMON and (meant := nearest(name, COMMON, "-", 0.85)):
            raise OptionError(f"-{name}: PETSc has no such option for these systems{meant}")


def remark() -> str:
    """A line that names the options of solvers that had no effect; empty if there are none."""
    database = options_database()
    left = unused(name for name in database if name.startswith(OF_SOLVERS))
    keep_from_petsc(left)
    listed = ", ".join(f"-{name} {database[name] or ''}".strip() for name in left)
    return f"options without effect in this run: {listed}" if listed else ""
