"""Settled states of scenes, made by simulation and kept in the cache."""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from mpi4py import MPI

from dem.experiment import Experiment
from dem.impulses import ImpulseMemory
from dem.scene import Scene
from dem.start import new_world
from dem.together import together
from dem.world import World
from pctt import ccp
from pctt.disk import Lock
from pctt.options import OptionError
from pctt.run import checkpoint, interrupt, report
from pctt.run.hdf5 import told
from pctt.run.settings import Options, scene_name
from pctt.run.stepper import Stepper


def settled_state(
    options: Options, scene: Scene, comm: MPI.Comm, progress: report.Progress, anew: bool = False
) -> Path:
    """The cached settled state of ``scene``, which the experiment of the options has `built`. It is made if it is
    missing, or with ``anew``. Settling takes the settling time with APGD. The last tenth has the contact distance of
    the scene and ten times the accuracy: otherwise overlaps remain, and the first accurate step of a run would push
    them apart. An interrupted or killed settling is continued."""
    path, made_with = cache(options, scene)
    if not anew and comm.bcast(checkpoint.intact(path) if comm.rank == 0 else None):
        return path
    if comm.rank == 0:
        with told(path.parent):
            path.parent.mkdir(parents=True, exist_ok=True)
    with _alone(path, comm, progress):
        if anew or not comm.bcast(checkpoint.intact(path) if comm.rank == 0 else None):
            _make(path, made_with, options, scene, comm, progress)
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
    path: Path, made_with: dict[str, str], options: Options, scene: Scene, comm: MPI.Comm, progress: report.Progress
) -> None:
    """Settle the scene and keep the state, with its checksum."""
    progress.say(f"settling {options.run.scene}, {steps(options)} steps with APGD to {options.run.settle_tol:g}:")
    if comm.bcast(unfinished(path).exists()):
        world, memory = checkpoint.load(unfinished(path), scene, made_with, comm)
        progress.say(f"  goes on after step {world.step}, from {unfinished(path)}")
    else:
        world, memory = world_at_start(options.scene, scene, comm), ImpulseMemory(comm)
    _settle(options, world, memory, unfinished(path), made_with, progress)
    checkpoint.save(path, made_with, world, memory)
    if comm.rank == 0:
        checkpoint.write_checksum(path)
        unfinished(path).unlink(missing_ok=True)
    comm.Barrier()


def cache(options: Options, scene: Scene) -> tuple[Path, dict[str, str]]:
    """The file of a scene's settled state, and what it is made with; OptionError if the scene never settles."""
    if not options.scene.settling_time:
        raise OptionError(f"-scene {options.run.scene}: has no settling_time and so no settled state")
    made_with = checkpoint.origin(scene_name(options.run.scene), options.scene, options.dt)
    settings: dict[str, Any] = {
        "dt": options.dt,
        "delta": [options.run.settle_delta, options.delta],
        "recovery_speed": options.run.recovery_speed,
        "tol": options.run.settle_tol,
    }
    if options.scene.digest:
        settings["file"] = options.scene.digest  # a file that was changed may build another scene
    if triangles := checkpoint.surfaces(scene.large_bodies):
        settings["surfaces"] = {name: [f"{value:.5g}" for value in figures] for name, figures in triangles.items()}
    return checkpoint.settled_path(made_with["scene"], settings), made_with


def unfinished(path: Path) -> Path:
    """The checkpoint that an interrupted settling leaves beside its settled state."""
    return path.with_suffix(".unfinished.h5")


def steps(options: Options) -> int:
    """The steps of a settling from the start."""
    return math.ceil(options.scene.settling_time / options.dt * (1 - 1e-12))


def _settle(
    options: Options,
    world: World,
    memory: ImpulseMemory,
    path: Path,
    made_with: dict[str, str],
    progress: report.Progress,
) -> None:
    """The steps of settling, with a checkpoint ``path`` after every tenth of them."""
    settling = dataclasses.replace(
        options,
        run=dataclasses.replace(options.run, ccp_type="apgd", ccp_compliance=None),
        delta=options.run.settle_delta,
        limits=ccp.Limits(tol=options.run.settle_tol),
        solver=ccp.SOLVERS["apgd"].options(),
        coulomb=None,
    )
    end = steps(options)
    tenth = max(1, end // 10)
    start = time.perf_counter()
    progress.start(end - world.step)
    with Stepper(settling, world, memory) as stepper:
        while world.step < end:
            progress.doing(f"settling, time {world.time:.3f} s")
            if world.step + 1 >= end - end // 10:
                limits = ccp.Limits(tol=0.1 * options.run.settle_tol)
                stepper.options = dataclasses.replace(settling, delta=options.delta, limits=limits)
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
