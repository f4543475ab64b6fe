"""Settled states of scenes, made by simulation and kept in the cache."""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

from mpi4py import MPI

from dem.experiment import Experiment
from dem.impulses import ImpulseMemory
from dem.scene import Scene
from dem.start import new_world
from dem.together import together
from dem.world import World
from pctt.disk import Lock
from pctt.options import OptionError
from pctt.run import checkpoint, interrupt, report
from pctt.run.hdf5 import told
from pctt.run.settings import SETTLE_TOL, Options, Settings, scene_name
from pctt.run.stepper import Stepper


class Settling(NamedTuple):
    """What settles how."""

    experiment: Experiment
    settings: Settings  #: of the run that is to begin with the settled state
    delta: float  #: contact distance in the first nine tenths [m]
    tol: float = SETTLE_TOL  #: natural residual in the first nine tenths
    name: str = ""  #: of the scene in messages; none: that of the experiment

    @classmethod
    def asked(cls, options: Options) -> Settling:
        """As the options of the program say."""
        return cls(options.scene, options.settings, options.run.settle_delta, options.run.settle_tol, options.run.scene)

    @property
    def steps(self) -> int:
        """The steps of a settling from the start."""
        return math.ceil(self.experiment.settling_time / self.settings.dt * (1 - 1e-12))

    @property
    def title(self) -> str:
        return self.name or scene_name(self.experiment)


def settled_state(
    how: Settling, scene: Scene, comm: MPI.Comm, progress: report.Progress, anew: bool = False
) -> Path:
    """The cached settled state of ``scene``, which the experiment has `built`. It is made if it is missing, or with
    ``anew``. Settling takes the settling time with APGD. The last tenth has the contact distance of the scene and ten
    times the accuracy: otherwise overlaps remain, and the first accurate step of a run would push them apart. An
    interrupted or killed settling is continued."""
    path, made_with = cache(how, scene)
    if not anew and comm.bcast(checkpoint.intact(path) if comm.rank == 0 else None):
        return path
    if comm.rank == 0:
        with told(path.parent):
            path.parent.mkdir(parents=True, exist_ok=True)
    with _alone(path, comm, progress):
        if anew or not comm.bcast(checkpoint.intact(path) if comm.rank == 0 else None):
            _make(path, made_with, how, scene, comm, progress)
    return path


@contextmanager
def _alone(path: Path, comm: MPI.Comm, progress: report.Progress) -> Iterator[None]:
    """Other runs that settle the same scene have ended, and wait for the end of the block; collective."""
    lock = Lock(path.with_suffix(".lock"))
    try:
        waits = False
        while not comm.bcast(comm.rank > 0 or lock.take()):
            if not waits:
                progress.say(f"waits for another run that settles the same scene, {path}")
            waits = True
            if interrupt.asked(comm):
                raise interrupt.InterruptError("interrupted while another run settled the scene")
            time.sleep(0.2)
        yield
    finally:
        lock.release()


def _make(
    path: Path, made_with: dict[str, Any], how: Settling, scene: Scene, comm: MPI.Comm, progress: report.Progress
) -> None:
    """Settle the scene and keep the state, with its checksum."""
    progress.say(f"settling {how.title}, {how.steps} steps with APGD to {how.tol:g}:")
    if comm.bcast(unfinished(path).exists()):
        world, memory = checkpoint.load(unfinished(path), scene, made_with, comm)
        progress.say(f"  goes on after step {world.step}, from {unfinished(path)}")
    else:
        world, memory = world_at_start(how.experiment, scene, comm), ImpulseMemory(comm)
    _settle(how, world, memory, unfinished(path), made_with, progress)
    checkpoint.save(path, made_with, world, memory)
    if comm.rank == 0:
        checkpoint.write_checksum(path)
        unfinished(path).unlink(missing_ok=True)
    comm.Barrier()


def cache(how: Settling, scene: Scene) -> tuple[Path, dict[str, Any]]:
    """The file of a scene's settled state, and what it is made with; OptionError if the scene never settles."""
    if not how.experiment.settling_time:
        raise OptionError(f"-scene {how.title}: has no settling_time and so no settled state")
    made_with = checkpoint.origin(how.experiment, how.settings.dt)
    settings: dict[str, Any] = {
        "dt": how.settings.dt,
        "delta": [how.delta, how.settings.delta],
        "recovery_speed": how.settings.recovery_speed,
        "tol": how.tol,
    }
    if how.experiment.digest:
        settings["file"] = how.experiment.digest  # a file that was changed may build another scene
    if triangles := checkpoint.surfaces(scene.large_bodies):
        settings["surfaces"] = {name: [f"{value:.5g}" for value in figures] for name, figures in triangles.items()}
    return checkpoint.settled_path(made_with["scene"], settings), made_with


def unfinished(path: Path) -> Path:
    """The checkpoint that an interrupted settling leaves beside its settled state."""
    return path.with_suffix(".unfinished.h5")


def _settle(
    how: Settling,
    world: World,
    memory: ImpulseMemory,
    path: Path,
    made_with: dict[str, Any],
    progress: report.Progress,
) -> None:
    """The steps of settling, with a checkpoint ``path`` after every tenth of them."""
    given = how.settings
    loose = Settings(
        given.dt, how.delta, "apgd", how.tol, coulomb=False, recovery_speed=given.recovery_speed,
    ).of(how.experiment)  # fmt: skip
    end = how.steps
    tenth = max(1, end // 10)
    start = time.perf_counter()
    progress.start(end - world.step)
    with Stepper(loose, world, memory) as stepper:
        while world.step < end:
            progress.doing(f"settling, time {world.time:.3f} s")
            if world.step + 1 >= end - end // 10:
                stepper.settings = dataclasses.replace(loose, delta=given.delta, tol=0.1 * how.tol)
            line = stepper.step()
            interrupted = interrupt.asked(world.comm)
            if world.step % tenth == 0 or world.step == end or interrupted:
                checkpoint.save(path, made_with, world, memory)
                spent = time.perf_counter() - start
                progress.say(
                    f"  step {world.step:5d}  time {line['time']:6.2f} s  contacts {line['contacts']:8d}"
                    f"  residual {line['natural_residual']:.1e}  {spent:7.1f} s spent"
                )
            if interrupted:
                words = f"settling interrupted after step {world.step} of {end}; the same command goes on there"
                raise interrupt.InterruptError(words)


def world_at_start(experiment: Experiment, scene: Scene, comm: MPI.Comm) -> World:
    """What the experiment built, at time zero; OptionError if it cannot start so."""
    try:
        return new_world(scene, comm)
    except (ValueError, FloatingPointError) as error:  # the latter of velocities whose squares overflow
        raise OptionError(f"scene {type(experiment).__name__}: {error}") from None


def built(scene: Experiment, comm: MPI.Comm) -> Scene:
    """What the scene builds; SceneError on all ranks if that fails on any."""

    def build() -> Scene:
        built = scene.build()
        if not isinstance(built, Scene):
            raise TypeError(f"build must return a dem.scene.Scene, not {type(built).__name__}")
        return built

    return together(comm, f"build of the scene {type(scene).__name__}", build)
