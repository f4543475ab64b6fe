"""The Newton systems of a run's time steps, handed out again and again, and the set-up of a train watched."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import petsc4py

petsc4py.init([sys.argv[0]])

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from dem.impulses import ImpulseMemory
from dem.world import World
from pctt import ccp
from pctt.ccp.newton.contact import ContactForm
from pctt.ksp_options import entered
from pctt.options import OptionError
from pctt.pc import TensorTrain
from pctt.pc.sparse_train import SparseTrain
from pctt.run.options import read_options
from pctt.run.settings import Settings
from pctt.run.stepper import Stepper
from pctt.simulation import Simulation


@dataclass
class System:
    """One Newton system S x = b: barrier blocks (nc, 3, 3) of S, and b (3 nc,)."""

    barrier: np.ndarray
    b: np.ndarray


class Recorder(ccp.Newton):
    """Newton systems as pdip has them solved by block Jacobi, kept for later."""

    def begin(self, problem: ccp.ConeProblem) -> None:
        super().begin(problem)
        self.systems: list[System] = []

    def update(self, barrier: np.ndarray, *more: Any, **named: Any) -> None:
        self._barrier = barrier.copy()
        super().update(barrier, *more, **named)

    def solve(self, q: np.ndarray, *more: Any, **named: Any) -> tuple[np.ndarray, np.ndarray]:
        self.systems.append(System(self._barrier, q.ravel().copy()))
        return super().solve(q, *more, **named)


class Replay:
    """The recorded systems of one cone problem."""

    def __init__(self, problem: ccp.ConeProblem, systems: list[System]):
        self.contacts, self.systems = problem.size, systems
        self._of = ContactForm(problem)

    def matrices(self) -> Iterator[tuple[PETSc.Mat, np.ndarray]]:
        """S, the same Mat with new values, and b of one system after another."""
        for system in self.systems:
            yield self.matrix(system), system.b

    def matrix(self, system: System) -> PETSc.Mat:
        self._of.update(system.barrier)
        return self._of.entries()

    def destroy(self) -> None:
        self._of.destroy()


class ReplayingStepper(Stepper):
    """Steps with pdip and hands the Newton systems of each to ``look`` before the next.

    newton_steps : of pdip, after which APGD makes the time step; None: pdip makes it
    """

    def __init__(
        self, settings: Settings, world: World, memory: ImpulseMemory, look: Callable[[Replay], None],
        newton_steps: int | None = None,
    ):  # fmt: skip
        super().__init__(settings, world, memory, Recorder(world.comm))
        self.look, self.newton_steps = look, newton_steps

    def solve(self, problem: ccp.ConeProblem, guess: np.ndarray) -> ccp.Result:
        assert isinstance(self.newton, Recorder)
        limits, options = self.settings.limits, self.settings.options
        if self.newton_steps is not None:
            limits = replace(limits, max_it=self.newton_steps, fallback=False)
        result = ccp.solve(problem, guess, "pdip", limits, options, self.newton)
        replay = Replay(problem, self.newton.systems)
        self.look(replay)
        replay.destroy()
        if self.newton_steps is not None:
            result = ccp.solve(problem, guess, "apgd", self.settings.limits)
        return result


def replay_steps(
    words: list[Any], steps: int, look: Callable[[Replay], None], newton_steps: int | None = None
) -> list[dict[str, Any]]:
    """Make time steps with these options of pctt.run, ``["-scene_n", 4, ...]``; the figures of each step. They end at
    the natural residual alone, as the paper's.

    newton_steps : how many Newton systems of each are looked at; the steps are then made by APGD
    """
    database = {"ccp_closing_work": "inf"} | {str(name)[1:]: str(value) for name, value in zip(words[::2], words[1::2])}
    comm = MPI.COMM_WORLD
    try:
        options = read_options(database | {"output": "results", "overwrite": "true"}, comm)
    except OptionError as error:
        sys.exit(str(error))
    sim = Simulation(options.scene, options.settings, comm=comm, restart=options.run.restart)
    with ReplayingStepper(sim.settings, sim.world, sim.memory, look, newton_steps) as stepper:
        return [stepper.step() for _ in range(steps)]


def settled(n: int, *more: Any) -> list[Any]:
    """Options of the settled mixer."""
    return ["-scene", "mixer", "-scene_n", n, "-restart", "settled", *more]


class WatchedSparseTrain(SparseTrain):
    """Whose phases are timed into ``rows[-1]``, the list of its `WatchedTrain`."""

    rows: list[dict[str, Any]]

    def _compress(self, warm: bool):
        start = time.perf_counter()
        found = super()._compress(warm)
        self.rows[-1] |= {"compress_s": time.perf_counter() - start, "error": found.error}
        self.rows[-1] |= {"matrix_rank": mean_rank(found.train.ranks), "warm": warm}
        return found

    def _invert(self, warm: bool):
        start = time.perf_counter()
        inverse = super()._invert(warm)
        self.rows[-1] |= {"invert_s": time.perf_counter() - start, "residual": inverse.residual}
        # what is stored of I + Z is Z, of one rank less
        self.rows[-1] |= {"inverse_rank": mean_rank(inverse.applied.ranks) + inverse.identity}
        return inverse

    def _is_positive(self, P: PETSc.Mat) -> bool:
        self.rows[-1] |= {"positive": super()._is_positive(P)}
        return self.rows[-1]["positive"]


class WatchedTrain(TensorTrain):
    """A tensor train whose set-ups are timed phase by phase; a rank that failed is tried again at the next matrix.

    Attributes
    ----------
    rows : a dict of figures per set-up; ``rank`` is 1 where no positive inverse came of it
    """

    sparse_train = WatchedSparseTrain

    def create(self, pc: PETSc.PC) -> None:
        super().create(pc)
        self.rows: list[dict[str, Any]] = []

    def update(self, pc: PETSc.PC, P: PETSc.Mat) -> None:
        assert isinstance(self.made, WatchedSparseTrain)
        self.made.rows, self.made.failure = self.rows, ""
        self.rows.append({})
        super().update(pc, P)
        self.rows[-1] |= {"setup_s": self._made_in, "rank": self.rank}


def mean_rank(ranks: tuple[int, ...]) -> float:
    """Of the inner bonds of a train."""
    return float(np.mean(ranks[1:-1])) if len(ranks) > 2 else 1.0


def train_pc(comm: MPI.Comm, **options: Any) -> tuple[PETSc.PC, WatchedTrain]:
    """A train with these options -pc_tt_*, of a fixed rank if they have one."""
    context = WatchedTrain()
    pc = PETSc.PC().create(comm)
    pc.setOptionsPrefix("watched_")
    pc.setType("python")
    pc.setPythonContext(context)
    with entered({f"watched_pc_tt_{name}": str(value) for name, value in options.items()}):
        pc.setFromOptions()
    return pc, context


def set_up(pc: PETSc.PC, matrix: PETSc.Mat) -> dict[str, Any]:
    """Make the preconditioner; the figures of the set-up."""
    pc.setOperators(matrix)
    pc.setUp()
    return pc.getPythonContext().rows[-1]
