"""Every listed preconditioner on the same Newton systems, with the same KSP, tolerance and iteration cap."""

from __future__ import annotations

import re
import time
from collections.abc import Sequence
from typing import Any

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from pctt import log
from pctt.blocks import shell_of
from pctt.ccp.newton.krylov import Krylov, Pmat, Solve
from pctt.ksp_options import OWN
from pctt.options import OptionError

# names beside PETSc's own PC types: options that make them
NAMED: dict[str, dict[str, str]] = {
    "ilu-shifted": {"pc_type": "ilu", "pc_factor_shift_type": "positive_definite"},
    "icc-shifted": {"pc_type": "icc", "pc_factor_shift_type": "positive_definite"},
    "cholesky": {"pc_type": "cholesky", "ksp_type": "gmres"},
    "bic": {"pc_type": "python", "pc_python_type": "pctt.pc.BlockICC"},
    "tt": {"pc_type": "python", "pc_python_type": "pctt.pc.TensorTrain"},
}


class Comparison:
    """Solves every ``every``-th Newton system by each of ``entries`` (``-compare``, ``-compare_every``), of the form
    TYPE or LABEL:TYPE (`labelled`).

    A type is a PETSc PC type or one of NAMED. Its KSP has the prefix ``ccp_compare_<label>_`` for further options.
    Raises OptionError for a type that PETSc does not know.

    Attributes
    ----------
    names : the labels
    solves : by label, of all systems so far
    """

    def __init__(self, comm: MPI.Comm, entries: Sequence[str], every: int = 1):
        self.kinds = labelled(entries)
        for kind in self.kinds.values():
            _check_kind(kind, comm)
        self.comm, self.names, self.every = comm, list(self.kinds), every
        self.solves: dict[str, list[Solve]] = {name: [] for name in self.names}
        self._krylov: dict[str, Krylov] = {}
        self._seen = self._taken = 0
        self._entries_s = 0.0

    def due(self) -> bool:
        """Whether the next system is one to compare on; counts it."""
        self._seen += 1
        return (self._seen - 1) % self.every == 0

    def run(self, A: PETSc.Mat, b: PETSc.Vec, x: PETSc.Vec, rtol: float, P: Pmat = None) -> Solve:
        """All preconditioners on one system; x is of the first that converged, else of the best.

        The seconds of the others count in the phase `compare`, not in `solve`: a run without comparison does not spend
        them.
        """
        start, chosen = time.perf_counter(), None
        with log.phase("CCPCompare"):
            A.mult(b, x)  # no one's seconds: the first product on a machine compiles its loops
            self._make_entries(A, P)
            for name in self.names:
                done = self._solver(name).solve(A, b, x, rtol, P)
                self.solves[name].append(done)
                better = chosen is None or done.converged or done.true_residual < chosen.true_residual
                if better and not (chosen and chosen.converged):
                    chosen, kept = done, x.array.copy()
        assert chosen is not None
        log.move_seconds(time.perf_counter() - start - chosen.setup_s - chosen.solve_s, "solve", "compare")
        x.array[:] = kept
        return chosen

    @property
    def readers(self) -> list[str]:
        """The preconditioners that read entries beside the diagonal blocks."""
        return [name for name in self.names if self._solver(name).needs_entries]

    def _make_entries(self, A: PETSc.Mat, P: Pmat) -> None:
        """Where A is a function, its entries, once for all that read them: no one's set-up."""
        if callable(P) and shell_of(A) and self.readers:
            start = time.perf_counter()
            P()
            self._entries_s += time.perf_counter() - start

    def summary(self) -> dict[str, dict[str, Any]]:
        """Figures over the systems by label. ``what``: what the preconditioner really was, where its type does not say
        it. ``excess_max``: the greatest true residual, as a multiple of what was asked for. ``entries_s``: seconds that
        the matrix's entries took, of a preconditioner that reads them; they are made once for all, and in no one's
        ``setup_s``. ``pc_report``: lines, of the project's own."""
        figures: dict[str, dict[str, Any]] = {}
        for name, solves in self.solves.items():
            its = [solve.iterations for solve in solves]
            figures[name] = {
                "type": self.kinds[name],
                "what": "",
                "systems": len(solves),
                "converged": sum(solve.converged for solve in solves),
                "ksp_its_mean": float(np.mean(its or [0])),
                "ksp_its_max": max(its, default=0),
                "setup_s": sum(solve.setup_s for solve in solves),
                "solve_s": sum(solve.solve_s for solve in solves),
                "true_residual_max": max((float(solve.true_residual) for solve in solves), default=0.0),
                "excess_max": max((float(solve.true_residual) / solve.asked for solve in solves), default=0.0),
            }
        for name, krylov in self._krylov.items():
            figures[name]["what"] = krylov.what()
            figures[name]["entries_s"] = self._entries_s if krylov.needs_entries else 0.0
            if lines := krylov.report():
                figures[name]["pc_report"] = lines
        return figures

    def take_solves(self) -> dict[str, list[list[Any]]]:
        """By label: converged, iterations, seconds and true residual of each solve since this was last asked."""
        fresh = {name: solves[self._taken :] for name, solves in self.solves.items()}
        self._taken = max(map(len, self.solves.values()), default=0)
        return {
            name: [[s.converged, s.iterations, s.setup_s + s.solve_s, s.true_residual] for s in solves]
            for name, solves in fresh.items()
        }

    def make_all(self) -> None:
        """Make the KSPs of all entries; OptionError for a bad option of one."""
        for name in self.names:
            self._solver(name)

    def _solver(self, name: str) -> Krylov:
        if name not in self._krylov:
            kind = self.kinds[name]
            self._krylov[name] = Krylov(self.comm, OWN + prefix(name), NAMED.get(kind, {"pc_type": kind}), timed=True)
        return self._krylov[name]

    def forget(self) -> None:
        """The next matrix has another structure."""
        for krylov in self._krylov.values():
            krylov.forget()

    def destroy(self) -> None:
        for krylov in self._krylov.values():
            krylov.destroy()
        self._krylov.clear()


def prefix(label: str) -> str:
    """What the options of a compared preconditioner begin with, after `OWN`."""
    return f"compare_{label}_"


def labelled(entries: Sequence[str]) -> dict[str, str]:
    """The types of the preconditioners by label: of entries LABEL:TYPE, or TYPE, which is its own label. OptionError
    for a bad label, for one that is there twice, and for one whose options another one would take for its own."""
    kinds: dict[str, str] = {}
    for entry in entries:
        before, colon, kind = entry.rpartition(":")
        label = before if colon else kind
        if colon and not re.fullmatch(r"[A-Za-z0-9_-]+", label):
            allowed = "TYPE or LABEL:TYPE with a label of letters, digits, _ and -"
            raise OptionError(f"-compare {entry}: allowed is {allowed}")
        if label in kinds:
            raise OptionError(f"-compare {entry}: the label {label} is there twice; allowed is LABEL:{kind}")
        kinds[label] = kind
    for label in kinds:
        for other in kinds:
            if other != label and prefix(other).startswith(prefix(label)):
                clash = f"-{prefix(other)}... would be an option of {label} too"
                raise OptionError(f"-compare {','.join(entries)}: {clash}; allowed are other labels")
    return kinds


def _check_kind(name: str, comm: MPI.Comm) -> None:
    pc = PETSc.PC().create(comm)
    try:
        pc.setType(NAMED.get(name, {"pc_type": name})["pc_type"])
    except PETSc.Error:
        known = ", ".join([*NAMED, "none", "jacobi", "pbjacobi", "bjacobi", "sor", "ilu", "icc", "gamg", "hypre"])
        allowed = f"PETSc has no such preconditioner here; allowed are its PC types, such as {known}"
        raise OptionError(f"-compare {name}: {allowed}") from None
    finally:
        pc.destroy()
