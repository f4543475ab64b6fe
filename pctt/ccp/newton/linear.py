"""The linear solver of Newton systems: a KSP, and where that fails a factor."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from pctt import memory
from pctt.ccp.newton.compare import Comparison
from pctt.ccp.newton.forms import BodyForm, NewtonForm
from pctt.ccp.newton.fronts import FrontPC
from pctt.ccp.newton.krylov import Krylov, Solve, Source
from pctt.ksp_options import OWN
from pctt.options import number

# factors of the part of a symmetric K that is worth it
FRONTS = {
    "ksp_type": "cg", "ksp_norm_type": "unpreconditioned",
    "pc_type": "python", "pc_python_type": "pctt.ccp.newton.fronts.FrontPC",
}  # fmt: skip
# of the contacts, where block Jacobi takes long
INCOMPLETE = {"pc_type": "python", "pc_python_type": "pctt.pc.BlockICC"}


@dataclass(frozen=True)
class Settings:
    """Numbers of `LinearSolver`."""

    few: int = number(1000, "contacts on one rank up to which an order of elimination is looked for")
    pairs: int = number(100_000, "of these, pairs of blocks in an elimination at most: 20 ns each")
    rest: int = number(133, "of these, contacts in the dense rest at most: 1 ms")
    jacobi: int = number(25, "iterations of BiCGStab with block Jacobi, after which the next matrix of contacts gets "
                             "an incomplete factor, which costs as much as 25")  # fmt: skip
    incomplete: int = number(4, "iterations with an incomplete factor, up to which the next matrix gets none: block "
                                "Jacobi takes 6 to 8 times as many")  # fmt: skip
    easy: float = number(6.0, "iterations with block Jacobi / bodies^0.4, after which the next matrix gets a factor, "
                              "which costs as much as 8 to 14")  # fmt: skip
    least: float = number(0.1, "drop tolerance of a factor [mass]: entries of a block between bodies that it is better "
                               "off without")  # fmt: skip
    single: float = number(0.02, "iterations with factors of single precision, in units of easy, after which the "
                                  "next are of double, which cost 10 iterations more (n = 8), 30 (n = 16)")  # fmt: skip
    limit: float = number(4.0, "iterations with block Jacobi at most, in units of easy")
    alone: int = number(20_000, "the same where the memory has no room for a factor")
    factor_bytes: float = number(210.0, "memory of a factor in double precision / rows^(4/3), the growth of nested "
                                        "dissection in space: 2.7e9 bytes at 35,939 bodies by fronts")  # fmt: skip
    spare: float = number(0.9, "part of the available memory that a factor may take")


class LinearSolver:
    """Solves the systems of a `NewtonForm` by a KSP, to at most twice the asked true residual. Where it fails, a factor
    of the matrix takes over, if the memory has room for one.

    own : whether the KSP is the project's own choice, conjugate gradients with block Jacobi. Systems get harder from
        one iteration of an interior point method to the next; so once they take many iterations, the rest of the
        problem is left to factors. The choice rests on iteration counts, so that a repeated run repeats it.
    incomplete : whether incomplete factors take over from block Jacobi while that would take long. Systems are hard in
        the middle of a problem, and iteration counts tell here too
    compare : its preconditioners are tried in place of the KSP
    entries : whether systems have them: else nothing but a KSP works on them

    Attributes
    ----------
    iterations, fallbacks : of the present problem: Krylov iterations, systems that were not solved as planned
    """

    def __init__(
        self,
        comm: MPI.Comm,
        defaults: dict[str, str],
        compare: Comparison | None = None,
        own: bool = False,
        incomplete: bool = False,
        entries: bool = True,
    ):
        self.comm, self.defaults, self.compare, self.own, self.incomplete = comm, defaults, compare, own, incomplete
        self._entries = entries
        self._krylov: dict[tuple[str, bool], Krylov] = {}
        self._symmetric = True
        self.begin()

    def begin(self) -> None:
        """Another problem."""
        self.iterations = self.fallbacks = 0
        self._worst, self._hard, self._factored, self._double = 0, False, False, False
        self._with_incomplete, self._latest = False, 0

    def new_matrix(self, system: NewtonForm) -> None:
        """The system has new values."""
        self.system, self._symmetric, self._factored = system, system.symmetric, False
        bodies = system.matrix.getSize()[0] / 6.0
        easy = int(Settings.easy * bodies**0.4)
        self._easy = self.comm.bcast(easy)  # a last bit may differ between processors
        self._hard = self.own and self._worst > self._easy
        most = Settings.incomplete if self._with_incomplete else Settings.jacobi
        self._with_incomplete, self._latest = self.incomplete and self._latest > most, 0

    def solve(self, b: PETSc.Vec, x: PETSc.Vec, rtol: float) -> bool:
        """x = A^-1 b to a relative residual of rtol; whether that was reached. Otherwise x is the best that was found,
        or zero if nothing leaves less than 1."""
        first = None if self._hard else self._by_ksp(b, x, rtol)
        if first and first.converged:
            return True
        self._hard, before = self.own, x.array.copy()
        last = self._by_factor(b, x, rtol) if self._entries else None
        self.fallbacks += not (self.own and last and last.converged)
        if first and (last is None or first.true_residual < last.true_residual):
            last, x.array[:] = first, before
        if last is None or last.true_residual >= 1.0:
            x.zeroEntries()
        return last is not None and last.converged

    def _by_ksp(self, b: PETSc.Vec, x: PETSc.Vec, rtol: float) -> Solve:
        if self.compare is not None and self.compare.due():
            done = self.compare.run(self.system.matrix, b, x, rtol, self.system.entries)
            self.iterations += done.iterations
        else:
            name = "incomplete" if self._with_incomplete else ""
            done = self._run(self._solver(name), b, x, rtol, self.system.entries)
        self._worst, self._latest = (max(most, done.iterations) for most in (self._worst, self._latest))
        return done

    def _by_factor(self, b: PETSc.Vec, x: PETSc.Vec, rtol: float) -> Solve | None:
        """Fronts are of single precision, until they take many iterations. Without room for a factor block Jacobi goes
        on, if it was our choice; else None."""
        solver, system = self._solver("factor"), self.system
        context = solver.ksp.pc.getPythonContext() if solver.kind == "python" else None
        single = isinstance(context, FrontPC) and not self._double
        if self._factored:
            done = self._run(solver, b, x, rtol, keep=True)
            if done.converged or not single:
                return done
            self._double = True
        solver.forget()  # first, as its memory counts as taken
        if not self._has_room(0.5 if single else 1.0):
            return self._run(self._solver("alone"), b, x, rtol) if self.own else None
        if isinstance(context, FrontPC):
            assert isinstance(system, BodyForm)
            context.make = lambda: system.fronts(Settings.least, np.float64 if self._double else np.float32)
            done = self._run(solver, b, x, rtol, system.matrix)
            if not self._double:
                self._double = done.iterations > Settings.single * self._easy and self._has_room()
                if self._double and not done.converged:
                    solver.forget()
                    done = self._run(solver, b, x, rtol, system.matrix)
        elif isinstance(system, BodyForm):
            part = system.stiff_part(Settings.least)
            done = self._run(solver, b, x, rtol, part)
            part.destroy()  # the KSP keeps it
        else:
            done = self._run(solver, b, x, rtol, system.entries)
        self._factored = done.converged
        return done

    def _run(
        self, solver: Krylov, b: PETSc.Vec, x: PETSc.Vec, rtol: float, P: Source = None, keep: bool = False
    ) -> Solve:
        done = solver.solve(self.system.matrix, b, x, rtol, P, keep)
        self.iterations += done.iterations
        return done

    def _has_room(self, part: float = 1.0) -> bool:
        """Whether the memory has room for a factor of double precision, or for this part of it; collective."""
        needed = part * Settings.factor_bytes * self.system.matrix.getSize()[0] ** (4.0 / 3.0) / self.comm.size
        return self.comm.bcast(needed < Settings.spare * memory.available(self.comm))

    def _solver(self, name: str) -> Krylov:
        """A Krylov method by its name, "" for the first one, made when it is first needed. Unsymmetric systems, which
        are those of Coulomb's law, have others."""
        symmetric = self._symmetric
        if (name, symmetric) not in self._krylov:
            if name == "factor":
                options = {"ksp_type": "gmres", "ksp_gmres_restart": "60", "ksp_max_it": "60"}
                options["pc_type"] = "cholesky" if symmetric else "lu"
                if symmetric and isinstance(self.system, BodyForm):
                    options |= FRONTS
            else:
                options = {**self.defaults, **({} if symmetric else {"ksp_type": "bcgs"})}
                options |= INCOMPLETE if name == "incomplete" else {}
                if self.own:
                    most = Settings.alone if name == "alone" else int(Settings.limit * self._easy)
                    options["ksp_max_it"] = str(most)
            self._krylov[name, symmetric] = Krylov(self.comm, OWN + "fallback_" * (name == "factor"), options)
        return self._krylov[name, symmetric]

    @property
    def readers(self) -> list[str]:
        """The preconditioners that read entries beside the diagonal blocks."""
        usual = self._solver("")
        compared = [] if self.compare is None else self.compare.readers
        return [usual.kind] * usual.needs_entries + compared

    def report(self) -> list[str]:
        """Lines about the preconditioner, if it is one of this package."""
        return [line for solver in self._krylov.values() for line in solver.report()]

    def words(self) -> str:
        """Krylov method and preconditioner."""
        if self.own:
            return "CG, pbjacobi until it takes long, then cholesky"
        later = f", {INCOMPLETE['pc_python_type']} where that takes long" if self.incomplete else ""
        return self._solver("").words() + later

    def what(self) -> str:
        """What a preconditioner of this package really was; empty for others."""
        owns = [solver.own for solver in self._krylov.values()]
        return "; ".join(f"{own.name} was {own.what()}" for own in owns if own and own.what())

    def forget(self) -> None:
        """The next matrix has another structure."""
        self._factored = False
        for solver in self._krylov.values():
            solver.forget()

    def destroy(self) -> None:
        for solver in self._krylov.values():
            solver.destroy()
        self._krylov.clear()
