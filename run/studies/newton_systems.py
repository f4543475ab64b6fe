"""Newton systems of `pdip` from steps of a settled mixer, recorded and handed to many configurations."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc
from shared import next_problem, settled

from pctt import ccp
from pctt.ccp.interior.pdip import PDIP
from pctt.ccp.newton.forms import ContactForm
from pctt.ccp.newton.kkt import KKT
from pctt.scenes import Mixer

COMM = MPI.COMM_SELF
TOL = 1e-4  # natural residual at which the Newton systems end
#: The options of `pdip`: those of the program, and those nearest to the paper.
FORMS = {"program": PDIP(), "paper": PDIP(form="paper")}


class System(NamedTuple):
    """One Newton system S x = b: barrier blocks (nc, 3, 3) of S, and b (3 nc,)."""

    barrier: np.ndarray
    b: np.ndarray


class Recorder(ccp.Newton):
    """Newton systems as pdip has them solved by block Jacobi, kept for later: of each matrix the first."""

    def begin(self, problem: ccp.ConeProblem) -> ccp.ConeProblem:
        self.systems: list[System] = []
        return super().begin(problem)

    def linearise(self, kkt: KKT) -> None:
        self._new: KKT | None = kkt
        super().linearise(kkt)

    def step(self, r_g: np.ndarray, r_lam: np.ndarray, *more: Any, **named: Any) -> tuple[np.ndarray, ...]:
        if self._new is not None:
            self.systems.append(System(self._new.schur(), self._new.reduced(r_g, r_lam).ravel()))
            self._new = None
        return super().step(r_g, r_lam, *more, **named)


class Replay:
    """The recorded systems of one cone problem."""

    def __init__(self, problem: ccp.ConeProblem, systems: list[System]):
        self.problem, self.contacts, self.systems = problem, problem.size, systems
        self._of = ContactForm(problem)

    def matrix(self, system: System) -> PETSc.Mat:
        """S, the same Mat with new values."""
        self._of.update(system.barrier)
        return self._of.entries()

    def destroy(self) -> None:
        self._of.destroy()


def replays(n: int, steps: int = 1, max_it: int = -1, form: str = "program") -> Iterator[Replay]:
    """The systems of each of some steps from the settled mixer; ``max_it``: of each, at most; ``form``: of FORMS."""
    sim = settled(Mixer(n=n), dt=0.025, solver="apgd", stiffness=np.inf)
    for _ in range(steps):
        newton = Recorder(COMM)
        with next_problem(sim) as problem:
            limits = ccp.Limits(TOL, max_it, np.inf, fallback=False)
            ccp.solve(problem, None, "pdip", limits, FORMS[form], newton=newton, law=ccp.RELAXATION)
            replay = Replay(problem, newton.systems)
            yield replay
            replay.destroy()
        newton.destroy()
        sim.step()
