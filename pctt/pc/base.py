"""What the python-type preconditioners of the project share.

    -pc_type python -pc_python_type pctt.pc.TensorTrain -pc_tt_max_rank 10

A class names its group of options (a dataclass, see ``pctt.options``) and their prefix; PETSc's own calls are turned
into ``build`` (a matrix of a new structure), ``update`` (new values in the same structure) and ``apply``.
"""

from __future__ import annotations

import atexit
import gc
from typing import Any

from petsc4py import PETSc

from pctt.options import describe, no_such_option, read


class PythonPC:
    """Base class; subclasses set ``options_class`` and ``options_prefix`` and define build, update, apply.

    The preconditioner is taken to be symmetric.
    """

    options_class: type
    options_prefix: str

    def create(self, pc: PETSc.PC) -> None:
        self.options: Any = self.options_class()
        self._structure: tuple | None = None

    def setFromOptions(self, pc: PETSc.PC) -> None:
        """Read the options behind the PC's prefix; OptionError for a bad one, or a misspelt one."""
        prefix = (pc.getOptionsPrefix() or "") + self.options_prefix
        database = PETSc.Options().getAll()
        known = [line.name for line in describe(self.options_class, prefix)]
        for name in database:
            if name.startswith(prefix) and name not in known:
                raise no_such_option(name, known)
        for name in known:
            PETSc.Options().hasName(name)  # or PETSc reports it as unused
        self.options = read(self.options_class, database, prefix)
        if "help" in database:
            PETSc.Sys.Print("\n".join(map(str, describe(self.options_class, prefix))), comm=pc.comm)

    def setUp(self, pc: PETSc.PC) -> None:
        _, P = pc.getOperators()
        structure = (P.handle, P.getSize(), P.getInfo()["nz_used"])
        if structure != self._structure:
            self.build(pc, P)
            self._structure = structure
        self.update(pc, P)

    def build(self, pc: PETSc.PC, P: PETSc.Mat) -> None:
        """What depends on the structure of P alone."""

    def update(self, pc: PETSc.PC, P: PETSc.Mat) -> None:
        """What depends on the values of P."""
        raise NotImplementedError

    def apply(self, pc: PETSc.PC, x: PETSc.Vec, y: PETSc.Vec) -> None:
        raise NotImplementedError

    def applyTranspose(self, pc: PETSc.PC, x: PETSc.Vec, y: PETSc.Vec) -> None:
        self.apply(pc, x, y)

    def reset(self, pc: PETSc.PC) -> None:
        """Forget the matrix; what may serve the next one stays."""
        self._structure = None

    def view(self, pc: PETSc.PC, viewer: PETSc.Viewer | None = None) -> None:
        if viewer is not None and viewer.getType() == PETSc.Viewer.Type.ASCII:
            for line in self.report():
                viewer.printfASCII(f"  {line}\n")

    def report(self) -> list[str]:
        """Lines for ``-ksp_view``."""
        return []


def factor_within_ranks(prefix: str, ranks: int) -> str:
    """The name of the PC type of a prefix; on several ranks ILU and ICC, which PETSc has for one rank only, are made
    block Jacobi with that factorisation within each rank."""
    database = PETSc.Options()
    pc = database.getString(prefix + "pc_type", "")
    if ranks == 1 or pc not in ("ilu", "icc"):
        return pc
    for name, value in database.getAll().items():
        if name.startswith(prefix + "pc_factor_"):
            database[prefix + "sub_" + name[len(prefix) :]] = value
    database[prefix + "pc_type"] = "bjacobi"
    database[prefix + "sub_pc_type"] = pc
    return f"{pc} within each rank"


def prefer_mumps(pc: PETSc.PC, kind: str) -> None:
    """Let a factorisation be MUMPS's where PETSc has it: its own keeps to natural orders and one rank."""
    if kind in ("cholesky", "lu") and PETSc.Sys.hasExternalPackage("mumps"):
        pc.setType(kind)
        pc.setFactorSolverType("mumps")


@atexit.register
def _destroy_garbage() -> None:
    """PETSc destroys what petsc4py has let go of when it is finalised, which is after Python's own end: a
    preconditioner written in Python must be gone before. (One that a global variable still holds must be destroyed by
    its owner: ``ksp.destroy()``.)"""
    gc.collect()
    PETSc.garbage_cleanup()
