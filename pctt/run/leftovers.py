"""Words of the command line that would have no effect: stray words, and options that nothing reads."""

from __future__ import annotations

import ctypes
import difflib
import re
from collections.abc import Iterable, Sequence

from petsc4py import PETSc

from pctt.options import OptionError

#: First words of the options of PETSc's solvers; all others are read when PETSc starts or ends.
OF_SOLVERS = (
    "ksp_", "pc_", "mat_", "vec_", "sub_", "mg_", "fieldsplit_", "kkt_", "compare_", "fallback_",
)  # fmt: skip

#: The options of Newton systems that are typed most, for what others are taken to be misspelt.
COMMON = (
    "ksp_type", "ksp_rtol", "ksp_atol", "ksp_divtol", "ksp_max_it", "ksp_monitor", "ksp_view", "ksp_norm_type",
    "ksp_pc_side", "ksp_converged_reason", "ksp_gmres_restart", "ksp_monitor_true_residual", "pc_type",
    "pc_python_type", "pc_side", "pc_factor_levels", "pc_factor_shift_type", "pc_factor_mat_solver_type",
    "pc_factor_mat_ordering_type", "pc_sor_omega", "pc_asm_overlap", "pc_gamg_threshold", "pc_hypre_type",
)  # fmt: skip

# PetscOptionsUsed, which petsc4py has no name for in every version; in the library that petsc4py stands on
_used = getattr(ctypes.CDLL(PETSc.__file__), "PetscOptionsUsed", None)


def refuse_stray(words: Sequence[str]) -> None:
    """OptionError for a word of the command line that is neither an option nor the value of an option."""
    before = ""
    for word in words:
        is_option = re.match(r"--?[a-zA-Z]", word) is not None
        if not is_option and not before:
            raise OptionError(f"{word}: belongs to no option; a value follows its option, as in -output {word}")
        before = word if is_option else ""


def unused(names: Iterable[str]) -> list[str]:
    """Those of the names in PETSc's database that nobody has asked for."""
    return [name for name in names if _used is not None and not _is_used(name)]


def _is_used(name: str) -> bool:
    flag = ctypes.c_int(0)  # at least as wide as PetscBool in any version
    assert _used is not None
    _used(None, name.encode(), ctypes.byref(flag))
    return flag.value != 0


def refuse_misspelt(names: Iterable[str]) -> None:
    """OptionError for a name that nobody has asked for and that is nearly a common one."""
    for name in unused(names):
        close = difflib.get_close_matches(name, COMMON, n=1, cutoff=0.85)
        if close and name not in COMMON:
            raise OptionError(f"-{name}: PETSc has no such option for these systems; did you mean -{close[0]}?")


def remark() -> str:
    """A line that names the options of solvers that had no effect; empty if there are none."""
    database = PETSc.Options().getAll()
    left = unused(name for name in database if name.startswith(OF_SOLVERS))
    keep_from_petsc(left)
    listed = ", ".join(f"-{name} {database[name] or ''}".strip() for name in left)
    return f"options without effect in this run: {listed}" if listed else ""


def keep_from_petsc(names: Iterable[str]) -> None:
    """Keep PETSc from warnings about these options. Some versions warn at the end of options that nothing has read."""
    for name in names:
        PETSc.Options().hasName(name)
