"""The base class of the project's preconditioners of type python.

    -pc_type python -pc_python_type pctt.pc.TensorTrain -pc_tt_rank 10

It turns the calls of PETSc into ``build`` (a matrix with a new structure), ``update`` (new values in the same
structure) and ``multiply``.
"""

from __future__ import annotations

from typing import Any

from petsc4py import PETSc

from pctt.options import describe, read
from pctt.petsc import Context, given_options

#: The attributes that a user's Mat may have, see docs/preconditioners.md.
ATTRIBUTES = ("coordinates", "grid", "key")


class PythonPC(Context):
    """Base class. Subclasses name their group of options (a dataclass, see ``pctt.options``) and its prefix, and define
    update and multiply.

    Matrices of other types than AIJ and BAIJ are converted. For a matrix without rows no method of a subclass is
    called.
    """

    options_class: type
    options_prefix: str
    without = PETSc.PC.Type.NONE

    def create(self, pc: PETSc.PC) -> None:
        super().create(pc)
        self.options: Any = self.options_class()
        self.prefix = ""
        self._structure: tuple | None = None
        self.P: PETSc.Mat | None = None  # the matrix, in AIJ or BAIJ; None if it has no rows
        self._converted: PETSc.Mat | None = None

    @property
    def name(self) -> str:
        """The name for ``-pc_python_type``."""
        return f"pctt.pc.{type(self).__name__}"

    def setFromOptions(self, pc: PETSc.PC) -> None:
        """Read the options with the prefix of the PC; OptionError for a bad value or a misspelt name.

        The next set-up uses them.
        """
        self.prefix = pc.getOptionsPrefix() or ""
        prefix = self.prefix + self.options_prefix
        before, self.options = self.options, read(self.options_class, given_options(self.options_class, prefix), prefix)
        if self.options != before:
            self._structure = None
        if PETSc.Options().hasName("help"):
            PETSc.Sys.Print("\n".join(map(str, describe(self.options_class, prefix))), comm=pc.comm)

    def setUp(self, pc: PETSc.PC) -> None:
        """ValueError on all ranks if the matrix is not square or cannot be converted."""
        _, P = pc.getOperators()
        rows, columns = P.getSize()
        if rows != columns:
            raise ValueError(f"{self.name}: the matrix has {rows} rows and {columns} columns; allowed is a square one")
        structure: tuple = (P.handle, rows)
        if rows == 0:
            self.P, self._structure = None, structure
            return
        if not self.takes(P):
            P = self._as_sparse(P)
            structure += (P.getInfo()["nz_used"],)
        self.P = P
        if structure != self._structure:
            self.build(pc, P)
            self._structure = structure
        self.update(pc, P)

    def takes(self, P: PETSc.Mat) -> bool:
        """Whether P is used as it is, whatever its type."""
        return False

    def _as_sparse(self, P: PETSc.Mat) -> PETSc.Mat:
        """P, or a copy of P in AIJ if P has another type."""
        kind = P.getType()
        if kind.startswith(("seqaij", "mpiaij", "seqbaij", "mpibaij")):
            return P
        if not kind.startswith(("seqsbaij", "mpisbaij", "seqdense", "mpidense")):
            allowed = "allowed are aij, baij, sbaij, dense"
            raise ValueError(f"{self.name}: a Mat of type {kind} has no entries to read; {allowed}")
        sparse = P.convert(PETSc.Mat.Type.AIJ, PETSc.Mat())
        if sparse.getBlockSize() != P.getBlockSize():
            sparse.setBlockSize(P.getBlockSize())
        for attribute in ATTRIBUTES:
            if P.getAttr(attribute) is not None:
                sparse.setAttr(attribute, P.getAttr(attribute))
        self._drop_converted()
        self._converted = sparse
        return sparse

    def _drop_converted(self) -> None:
        if self._converted is not None:
            self._converted.destroy()
            self._converted = None

    def build(self, pc: PETSc.PC, P: PETSc.Mat) -> None:
        """Set up everything that depends only on the structure of P."""

    def update(self, pc: PETSc.PC, P: PETSc.Mat) -> None:
        """Set up everything that depends on the values of P."""

    def multiply(self, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """y = M x."""

    def multiply_transpose(self, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """y = M' x; unless a subclass says something else, M is symmetric."""
        self.multiply(x, y)

    def apply(self, pc: PETSc.PC, x: PETSc.Vec, y: PETSc.Vec) -> None:
        if self._ready(pc):
            self.multiply(x, y)

    def applyTranspose(self, pc: PETSc.PC, x: PETSc.Vec, y: PETSc.Vec) -> None:
        if self._ready(pc):
            self.multiply_transpose(x, y)

    def _ready(self, pc: PETSc.PC) -> bool:
        """Whether there are rows. PETSc does not set up a PC again that gets a new context, as in
        ``PCSetFromOptions`` with ``-pc_python_type``; so this does it."""
        if self._structure is None:
            self.setUp(pc)
        return self.P is not None

    def reset(self, pc: PETSc.PC) -> None:
        """Forget the matrix; keep everything that the next matrix can use."""
        self._structure = self.P = None

    def release(self) -> None:
        """Destroy the PETSc objects of this preconditioner."""

    def destroy(self, pc: PETSc.PC) -> None:
        """PETSc calls this at the end of the PC."""
        self.release()
        self.P = None
        self._drop_converted()
        super().destroy(pc)

    def view(self, pc: PETSc.PC, viewer: PETSc.Viewer | None = None) -> None:
        if viewer is not None and viewer.getType() == PETSc.Viewer.Type.ASCII:
            lines = ["no matrix with rows"] if self.P is None else self.report()
            for line in pc.comm.tompi4py().bcast(lines):
                viewer.printfASCII(f"  {line}\n")

    def report(self) -> list[str]:
        """Lines for ``-ksp_view``."""
        return []

    def what(self) -> str:
        """What the preconditioner really was over its solves, in a few words, where its name does not say it."""
        return ""
