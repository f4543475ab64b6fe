"""Every listed preconditioner on the same Newton systems, with the same KSP, tolerance and iteration cap."""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from typing import Any

from mpi4py import MPI
from petsc4py import PETSc

from pctt import log
from pctt.ccp.newton.krylov import Krylov, KrylovFamily, Solve, Source
from pctt.options import OptionError
from pctt.shell import is_shell

# names beside PETSc's own PC types: options that make them
NAMED: dict[str, dict[str, str]] = {
    "ilu-shifted": {"pc_type": "ilu", "pc_factor_shift_type": "positive_definite"},
    "icc-shifted": {"pc_type": "icc", "pc_factor_shift_type": "positive_definite"},
    "cholesky": {"pc_type": "cholesky", "ksp_type": "gmres"},
    "tt": {"pc_type": "python", "pc_python_type": "pctt.pc.TensorTrain"},
}


@dataclass
class Record:
    """What one preconditioner did over the systems of a run: sums, and the solves since they were last taken."""

    systems: int = 0
    converged: int = 0
    iterations: int = 0
    most_iterations: int = 0
    setup_s: float = 0.0
    solve_s: float = 0.0
    true_residual_max: float = 0.0
    excess_max: float = 0.0
    solves: list[Solve] = field(default_factory=list)

    def add(self, solve: Solve) -> None:
        self.systems += 1
        self.converged += solve.converged
        self.iterations += solve.iterations
        self.most_iterations = max(self.most_iterations, solve.iterations)
        self.setup_s += solve.setup_s
        self.solve_s += solve.solve_s
        self.true_residual_max = max(self.true_residual_max, float(solve.true_residual))
        self.excess_max = max(self.excess_max, float(solve.true_residual) / solve.asked)
        self.solves.append(solve)

    def take_solves(self) -> list[list[Any]]:
        """Converged, iterations, seconds and true residual of each solve since this was last asked."""
        solves, self.solves = self.solves, []
        return [[s.converged, s.iterations, s.setup_s + s.solve_s, s.true_residual] for s in solves]

    def summary(self) -> dict[str, Any]:
        """Figures over the systems; ``excess_max``: the greatest true residual, as a multiple of what was asked for."""
        return {
            "systems": self.systems,
            "converged": self.converged,
            "ksp_its_mean": self.iterations / max(self.systems, 1),
            "ksp_its_max": self.most_iterations,
            "setup_s": self.setup_s,
            "solve_s": self.solve_s,
            "true_residual_max": self.true_residual_max,
            "excess_max": self.excess_max,
        }


class Comparison(KrylovFamily):
    """Solves every ``every``-th Newton system by each of ``names`` (``-compare``, ``-compare_every``).

    A name is a PETSc PC type or one of NAMED; its KSP has the prefix ``compare_<name>_`` for further options.
    Raises OptionError for a name that PETSc does not know.
    """

    def __init__(self, comm: MPI.Comm, names: list[str], every: int = 1):
        for name in names:
            _check_name(name, comm)
        super().__init__(comm)
        self.names, self.every = list(dict.fromkeys(names)), every
        self.records = {name: Record() for name in self.names}
        self._seen = 0
        self._entries_s = 0.0

    def due(self) -> bool:
        """Whether the next system is one to compare on; counts it."""
        self._seen += 1
        return (self._seen - 1) % self.every == 0

    def run(self, A: PETSc.Mat, b: PETSc.Vec, x: PETSc.Vec, rtol: float, P: Source = None) -> Solve:
        """All preconditioners on one system; x is of the first that converged, else of the best.

        The seconds of the others count in the phase `compare`, not in `solve`: a run without comparison does not spend
        them.
        """
        chosen: Solve | None = None
        with log.phase("CCPCompare"):
            self._make_entries(A, P)
            for name in self.names:
                done = self._solver(name).solve(A, b, x, rtol, P)
                self.records[name].add(done)
                better = chosen is None or done.converged or done.true_residual < chosen.true_residual
                if better and not (chosen and chosen.converged):
                    chosen, kept = done, x.array.copy()
        assert chosen is not None
        spent = log.take_seconds(("CCPCompare",))["CCPCompare"]
        log.move_seconds(spent - chosen.setup_s - chosen.solve_s, "solve", "compare")
        x.array[:] = kept
        return chosen

    def _make_entries(self, A: PETSc.Mat, P: Source) -> None:
        """Where S is a function, its entries, once for all that read them: no one's set-up."""
        if not is_shell(A) or isinstance(P, PETSc.Mat) or P is None:
            return
        if any(self._solver(name).needs_entries for name in self.names):
            start = time.perf_counter()
            P()
            self._entries_s += time.perf_counter() - start

    def summary(self) -> dict[str, dict[str, Any]]:
        """Figures by name. ``entries_s``: seconds that the matrix's entries took, of a preconditioner that reads them;
        they are made once for all, and in no one's ``setup_s``. ``pc_report``: lines, of the project's own."""
        figures: dict[str, dict[str, Any]] = {name: record.summary() for name, record in self.records.items()}
        for name, krylov in self._krylov.items():
            figures[name]["entries_s"] = self._entries_s if krylov.needs_entries else 0.0
            if lines := krylov.report():
                figures[name]["pc_report"] = lines
        return figures

    def take_solves(self) -> dict[str, list[list[Any]]]:
        """The solves by name, as of `Record.take_solves`."""
        return {name: record.take_solves() for name, record in self.records.items()}

    def labels(self) -> dict[str, str]:
        """What each name means on this number of ranks, where that is not plain from the name."""
        remark = " (within each rank)" if self.comm.size > 1 else ""
        return {name: name + remark * name.startswith(("ilu", "icc")) for name in self.names}

    def _solver(self, name: str) -> Krylov:
        if name not in self._krylov:
            defaults = NAMED.get(name, {"pc_type": name})
            self._krylov[name] = Krylov(self.comm, f"compare_{name}_", defaults)
        return self._krylov[name]


def _check_name(name: str, comm: MPI.Comm) -> None:
    pc = PETSc.PC().create(comm)
    try:
        pc.setType(NAMED.get(name, {"pc_type": name})["pc_type"])
    except PETSc.Error:
        known = [*NAMED, "none", "jacobi", "pbjacobi", "bjacobi", "sor", "ilu", "icc", "gamg", "hypre"]
        raise OptionError(
            f"-compare {name}: PETSc has no such preconditioner here; allowed are its PC types, such as "
            + ", ".join(known)
        ) from None
    finally:
        pc.destroy()
