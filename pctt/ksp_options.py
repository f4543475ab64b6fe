"""PETSc's options database: the options of the KSPs that the project makes, and those that had no effect.

The project's KSPs have the prefix `OWN`, so that the options of a program that uses the library are its own. The
program ``pctt.run`` takes the options without prefix for those of its KSPs (`taken_over`). Defaults are in the database
only while PETSc reads them, as in the options manager of petsctools. PETSc marks an option as used when somebody looks
it up; here it has the mark once a system was solved with it.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager

from petsc4py import PETSc

from dem.checks import nearest
from pctt.options import OptionError, no_such_option
from pctt.petsc import is_used, options_database

OWN = "ccp_"  #: Prefix of the project's own KSPs.

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
_NO_PREFIX = {"compare_every"}  # an option of the program that begins like those of a compared preconditioner


# -- what stands in the database for a while -------------------------------------------------------------------------


@contextmanager
def entered(
    options: Mapping[str, str | None], origins: Mapping[str, str] | None = None, hidden: Iterable[str] = ()
) -> Iterator[None]:
    """Put these options into the database within the block; afterwards it has the user's options again.

    ``origins`` are the user's options from which some were made, by their names: those are used when these are. The
    options ``hidden`` are not there within the block.
    """
    database = PETSc.Options()
    users = {name: value for name, value in options_database().items() if name in options or name in hidden}
    used = set(users) - set(unused(users))
    for name in users:
        database.delValue(name)
    for name, value in options.items():
        database[name] = value
    try:
        yield
    finally:
        used |= set(options) - set(unused(options))
        for name in options:
            database.delValue(name)
        for name, value in users.items():
            database[name] = value
        used |= {source for name, source in (origins or {}).items() if name in used}
        mark_used(used & options_database().keys())


@contextmanager
def unmarked() -> Iterator[set[str]]:
    """Look-ups within the block leave no mark. After it the set has the names that were looked up."""
    database, found = PETSc.Options(), set[str]()
    before = unused(options_database())
    try:
        yield found
    finally:
        present = options_database()
        found |= {name for name in before if name in present and is_used(name)}
        for name in found:
            database.delValue(name)
            database[name] = present[name]


def mark_used(names: Iterable[str]) -> None:
    """Mark options as used; PETSc warns of the others at its end."""
    for name in names:
        PETSc.Options().hasName(name)


def unused(names: Iterable[str]) -> list[str]:
    """Those of the names in PETSc's database that have no mark."""
    return [name for name in names if not is_used(name)]


def to_enter(prefix: str, defaults: Mapping[str, str], ranks: int) -> tuple[dict[str, str | None], dict[str, str]]:
    """The options to enter for a KSP with this prefix, and their origins (`entered`).

    They are the defaults of options that the user has not given; before these, a KSP with another prefix than `OWN` has
    the ``ksp_`` options of that one. Factorisations are those of MUMPS if PETSc has it: its own have natural orders and
    one rank only. On several ranks block Jacobi replaces ILU and ICC, which PETSc has for one rank only; they become
    the solvers of its blocks.
    """
    given = options_database()
    of_main = [name for name in given if name.startswith(f"{OWN}ksp_") and prefix != OWN]
    shared = {prefix + name[len(OWN) :]: name for name in of_main}
    ours = {prefix + name: value for name, value in defaults.items() if prefix + name not in given}
    origins = {name: source for name, source in shared.items() if name not in given and name not in ours}
    options: dict[str, str | None] = {**ours, **{name: given[source] for name, source in origins.items()}}
    everything = {**given, **options}
    kind, solver = everything.get(prefix + "pc_type"), prefix + "pc_factor_mat_solver_type"
    if kind in ("cholesky", "lu") and solver not in everything and PETSc.Sys.hasExternalPackage("mumps"):
        options[solver] = "mumps"
        room = prefix + "mat_mumps_icntl_14"  # % beyond its estimate, which pivots of nearly singular matrices exceed
        options |= {} if room in everything else {room: "100"}
    if ranks > 1 and kind in ("ilu", "icc"):
        options |= {prefix + "pc_type": "bjacobi", prefix + "sub_pc_type": kind}
        start = f"{prefix}pc_factor_"
        factor = {f"{prefix}sub_{name[len(prefix):]}": name for name in everything if name.startswith(start)}
        options |= {name: everything[source] for name, source in factor.items()}
        origins |= factor
    return options, origins


# -- the options of the program --------------------------------------------------------------------------------------


def solver_options(database: Mapping[str, str | None]) -> dict[str, str]:
    """The options of solvers in the database: by their names without prefix, as they are spelt there.

    OptionError for one that is there in both spellings with different values.
    """
    found: dict[str, str] = {}
    for name, value in database.items():
        short = name[len(OWN) :] if name.startswith(OWN) else name
        if short.startswith(OF_SOLVERS) and short not in _NO_PREFIX:
            other = found.setdefault(short, name)
            if database[other] != value:
                twice = " and ".join(_with_value(spelt, database) for spelt in sorted((name, other), key=len))
                raise OptionError(f"{twice}: the same option; allowed is one value")
    return found


@contextmanager
def taken_over(database: Mapping[str, str | None]) -> Iterator[None]:
    """Within the block the options of solvers without prefix are also those of the project's KSPs. An OptionError names
    an option as it is spelt in the database."""
    origins = {OWN + short: spelt for short, spelt in solver_options(database).items()}
    try:
        with entered({name: database[spelt] for name, spelt in origins.items()}, origins):
            yield
    except OptionError as error:
        starts = "|".join(OF_SOLVERS)

        def spelt(match: re.Match[str]) -> str:
            return match[0] if match[1] in database else f"-{match[1].removeprefix(OWN)}"

        raise OptionError(re.sub(rf"-({OWN}(?:{starts})\w*)", spelt, str(error))) from None


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
        if name not in known and not name.removeprefix(OWN).startswith(OF_SOLVERS) and not name.startswith(_LATE):
            raise no_such_option(name, known)


def refuse_misspelt(given: Mapping[str, str]) -> None:
    """OptionError for an option of `solver_options` that no KSP has asked for and that is nearly a common one."""
    for short, spelt in given.items():
        if not is_used(OWN + short) and short not in COMMON and (meant := nearest(short, COMMON, "-", 0.85)):
            raise OptionError(f"-{spelt}: PETSc has no such option for these systems{meant}")


def remark(database: Mapping[str, str | None], systems: int) -> str:
    """A line that names the options of a run that had no effect; empty if there are none.

    ``database`` has the options of the user, ``systems`` is the number of systems that were solved by a KSP.
    """
    given = solver_options(database)
    left = [spelt for short, spelt in given.items() if not (is_used(spelt) or is_used(OWN + short))]
    if not systems:
        left = [*(name for name in ("compare", "compare_every") if name in database), *given.values()]
    if "options_left" not in database:  # which says the same
        mark_used(left)
    listed = ", ".join(_with_value(name, database) for name in left)
    why = "" if systems else ", as no Newton system was solved by a KSP"
    return f"options without effect in this run{why}: {listed}" if listed else ""


def _with_value(name: str, database: Mapping[str, str | None]) -> str:
    return f"-{name} {database[name] or ''}".rstrip()
