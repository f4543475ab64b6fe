"""What a simulation leaves in its folder: the files of a step, and those that are due at the end."""

from __future__ import annotations

from typing import Any

from dem.experiment import Experiment
from dem.impulses import ImpulseMemory
from dem.step import Step
from dem.together import together
from dem.world import World
from pctt import ccp
from pctt.run import checkpoint
from pctt.run.hdf5 import FileError
from pctt.run.place import Place
from pctt.run.results import Results


class Output:
    """The files of a simulation from now on. Methods are collective.

    A frame of state.h5 is recorded every ``every`` steps (0: never), and a checkpoint written every
    ``checkpoint_every``. `complete` writes those of the last step, if they are missing.
    """

    def __init__(
        self, place: Place, world: World, memory: ImpulseMemory, made_with: dict[str, Any], compare: ccp.Comparison,
        every: int, checkpoint_every: int,
    ):  # fmt: skip
        self.place, self._world, self._memory, self._made_with, self._compare = place, world, memory, made_with, compare
        self._every, self._checkpoint_every = every, checkpoint_every
        self._start = self._recorded = self._saved = self._analysed = world.step
        self.results = Results(place, world.comm, made_with["scene"], world)

    def record(self, step: Step, row: dict[str, float], last: bool) -> None:
        """Write the row of a step's records, and its frame if that is due, or if the step is the ``last``."""
        self.results.records.add(row)
        if self._every and (step.world.step % self._every == 0 or last):
            self._record(step, row)

    def _record(self, step: Step, row: dict[str, float]) -> None:
        self.results.record_step(step, row)
        self._recorded = step.world.step

    def add(self, figures: dict[str, Any], last: bool) -> None:
        """Write the figures of a step, and its checkpoint if that is due."""
        # figures first: a run that goes on from the checkpoint must find the step
        self.results.add_step(self._world, figures, self._compare.summary())
        if (self._world.step - self._start) % self._checkpoint_every == 0 or last:
            self._save()
        self.results.stands(self._world, figures)

    def _save(self) -> None:
        checkpoint.save(self.results.checkpoint, self._made_with, self._world, self._memory)
        self._saved = self._world.step

    def complete(self, step: Step, row: dict[str, float]) -> None:
        """Write the frame and the checkpoint of the last step, if they are not there, and let state.h5 have all."""
        if self._every and self._recorded < self._world.step:
            self._record(step, row)
        if self._saved < self._world.step:
            self._save()
        self.results.link(self._world)

    def analyse(self, scene: Experiment) -> dict[str, float]:
        """The numbers that the scene finds in the records, which also go to summary.json; SceneError if it fails."""
        comm, results = self._world.comm, self.results
        what = f"analyse of the scene {type(scene).__name__}"

        def analyse() -> dict[str, float]:
            return results.records.analyse(scene) if comm.rank == 0 else {}

        figures = comm.bcast(together(comm, what, analyse, own=(FileError,)))
        results.write_summary(self._world, self._compare.summary(), analysis=figures)
        self._analysed = self._world.step
        return figures

    @property
    def analysed(self) -> bool:
        """Whether `analyse` has seen all steps."""
        return self._analysed == self._world.step
