"""The state that a run begins with: of time zero, of a checkpoint, or settled and kept in the cache."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math
import os
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from mpi4py import MPI

from dem.arrays import Floats
from dem.bodies import Bodies
from dem.exchange import refuse
from dem.experiment import Experiment, SceneExperiment
from dem.mesh import Mesh
from dem.model.changes import changes, restore
from dem.model.world import World
from dem.quaternion import cross
from dem.scene import LargeBody, Scene
from dem.shapes import placed
from dem.start import even_slice, new_world, refuse_overlap, restart_rows, restored_world, stiffness, time_step
from dem.step.impulses import ImpulseMemory
from dem.together import SceneError, first_differing_rank, together
from pctt import ccp, json_text
from pctt.disk import FileError, Lock, on_first, read, same_rows, texts, write_rows
from pctt.memory import available
from pctt.options import OptionError
from pctt.petsc import warn
from pctt.run import interrupt
from pctt.run.relax import relax
from pctt.run.settings import RELAX, Settings, scene_name
from pctt.run.stepper import Stepper

CONTACTS = ("contacts/key", "contacts/impulse")  #: the data sets that have a row for each contact
FORMAT = "pctt checkpoint 4"

#: Memory of a grain at the start and in a step of a dense bed [bytes], measured in a mixer (docs/cluster.md).
START_BYTES, STEP_BYTES = 600, 3200

Say = Callable[[str], object]  #: told on the first rank


def built(scene: Experiment, comm: MPI.Comm) -> Scene:
    """What the scene builds; SceneError on all ranks if that fails on any, or if the ranks build different things."""

    def build() -> Scene:
        built = scene.build()
        if not isinstance(built, Scene):
            raise TypeError(f"build must return a dem.scene.Scene, not {type(built).__name__}")
        return built

    what = f"build of the scene {type(scene).__name__}"
    found = together(comm, what, build)
    words, numbers = together(comm, what, lambda: _facts(found))
    if other := first_differing_rank(comm, words, numbers):
        allowed = "allowed is the same scene on all ranks (random numbers need a seed, and no rank a part of its own)"
        raise SceneError(f"{what}: rank {other} has built other bodies or materials than rank 0; {allowed}")
    _refuse_too_large(what, found.count, comm)
    found.survey(comm)
    return found


def _refuse_too_large(what: str, count: int, comm: MPI.Comm) -> None:
    """SceneError if the ranks have no memory for so many grains, a warning if hardly; collective."""
    there = available(comm) * comm.size
    needed, words = count * STEP_BYTES, f"{what}: {count:.4g} grains need about"
    has = f"{there / 1e9:.3g} GB that there are; take fewer grains, or more nodes"
    if count * START_BYTES > there:
        raise SceneError(f"{words} {needed / 1e9:.3g} GB of memory, and cannot even start in the {has}")
    if needed > there:
        warn(comm, f"{words} {needed / 1e9:.3g} GB of memory once they lie on each other, more than the {has}")


def _facts(scene: Scene) -> tuple[str, list[Floats]]:
    """What a scene is made of, in words and numbers, for `unlike`."""
    large = scene.large_bodies
    motions = [(body.name, type(body.motion).__name__) for body in large]
    words: list[Any] = [scene.materials, sorted(scene.leaving), motions, repr(scene.passages)]
    words.append([(part.count, part.kind) for part in scene.parts])
    named = [(kind, name, vars(part)) for kind, there in scene.named.items() for name, part in there.items()]
    words += [(kind, name, [repr(each) for each in given.values() if not _numeric(each) and not callable(each)])
              for kind, name, given in named]  # fmt: skip
    numbers: list[Any] = [column.sample() for part in scene.parts for column in part.given.values()]
    numbers += [part.material for part in scene.parts]
    numbers += scene.large().columns().values()
    numbers += [value for body in large for shape in body.shapes for value in placed(shape)]
    numbers += [scene.gravity, *vars(scene.pairs(np.inf)).values(), *(body.surface for body in large)]
    motion = [getattr(body.motion, "__dict__", {}) for body in large]
    cell = {each.name: getattr(scene.cell, each.name) for each in dataclasses.fields(scene.cell)}
    for values in (cell, *motion, *(given for *_, given in named)):
        numbers += values.values()
    return repr(words), [np.asarray(value) for value in numbers if _numeric(value)]


def _numeric(value: Any) -> bool:
    return np.asarray(value).dtype.kind in "fiub"


def scene_words(experiment: Experiment) -> str:
    """What messages call a scene."""
    return "the scene" if isinstance(experiment, SceneExperiment) else f"scene {scene_name(experiment)}"


def world_at_start(
    experiment: Experiment, settings: Settings, scene: Scene, comm: MPI.Comm, program: bool = False
) -> World:
    """What the experiment built, at time zero; OptionError if it cannot start so, which names options as Python or, if
    so, the program has them."""
    what = scene_words(experiment)
    try:
        world = new_world(scene, comm, math.inf)
    except (ValueError, FloatingPointError) as error:  # the latter of velocities whose squares overflow
        raise OptionError(f"{what}: {error}") from None
    if settings.overlap == RELAX:
        relax(world, scene, settings)
        return world
    try:
        refuse_overlap(world, float(settings.overlap))
    except ValueError as error:
        option = f"-overlap {RELAX}" if program else f'overlap="{RELAX}"'
        helps = f"{option} opens overlaps before the first step, a number allows greater ones"
        raise OptionError(f"{what}: {error}. What helps: {helps}") from None
    return world


# -- checkpoints ---------------------------------------------------------------------------------------------


def origin(experiment: Experiment, scene: Scene, dt: float) -> dict[str, Any]:
    """What a run should share with the run whose checkpoint it continues, as attributes of a checkpoint: the name and
    the options of the scene as JSON, the time step [s], the digest of the user's scene file or "", what tells the
    surfaces of large bodies apart, and the figures of the scene, as JSON."""
    return {
        "scene": json.dumps({"scene": scene_name(experiment), **dataclasses.asdict(experiment)}, sort_keys=True),
        "dt": dt,
        "scene_file": experiment.digest,
        "surfaces": json.dumps(_surfaces(scene.large_bodies), sort_keys=True),
        "figures": json.dumps(scene.figures()),
    }


def _surfaces(large_bodies: Iterable[LargeBody]) -> dict[str, list[str]]:
    """Of each body that has triangles, by its name: their number, area [m2], centroid [m] (3) and the root mean squares
    of their places [m] (3), to five digits.

    Not the digest of the vertices: those of a turned profile differ between processors in their last bits."""

    def figures(corners: Floats) -> list[str]:
        twice = np.linalg.norm(cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
        middle, weight = corners.mean(axis=1), twice / twice.sum()
        spread = np.sqrt(weight @ middle**2)
        return [f"{value:.5g}" for value in (len(corners), 0.5 * twice.sum(), *(weight @ middle), *spread)]

    found = {}
    for body in large_bodies:
        meshes = [shape for shape in body.shapes if isinstance(shape, Mesh)]
        if meshes:
            corners = [np.asarray(mesh.vertices)[np.asarray(mesh.triangles)] for mesh in meshes]
            found[body.name] = figures(np.concatenate(corners))
    return found


def save(path: Path, made_with: dict[str, Any], world: World, memory: ImpulseMemory) -> None:
    """Write a checkpoint with its `origin`; collective. An earlier file of this name stays until the new one is
    complete."""
    local, replicated = world.state()
    key, impulse = memory.state()
    rows = {f"grains/{name}": column for name, column in local.items()}
    shared = {f"world/{name}": array for name, array in replicated.items()}
    shared["world/materials"] = texts(world.materials)
    shared["world/changes"] = texts([changes(world)])
    rows |= {"contacts/key": key, "contacts/impulse": impulse}
    write_rows(path, world.comm, rows, shared, {"/": {"format": FORMAT, **made_with}})


@dataclasses.dataclass(frozen=True)
class RunState:
    """The state of a run on this rank, in the place of a checkpoint: arrays that no step changes."""

    local: dict[str, np.ndarray]  #: rows of grains
    replicated: dict[str, np.ndarray]
    changed: str  #: of `dem.model.changes.changes`
    impulses: tuple[np.ndarray, ...]  #: keys and impulses of the last step's contacts


def run_state(world: World, memory: ImpulseMemory) -> RunState:
    """The state of a world now."""
    local, replicated = ({name: array.copy() for name, array in arrays.items()} for arrays in world.state())
    return RunState(local, replicated, changes(world), tuple(array.copy() for array in memory.state()))


def restored(kept: RunState, scene: Scene, comm: MPI.Comm, times: float = 1.0) -> tuple[World, ImpulseMemory]:
    """The world and the impulses, so many ``times`` as great, of a state of the scene on as many ranks; collective.
    ValueError and others for what is none."""
    world = restored_world(scene, comm, kept.local, kept.replicated)
    restore(world, kept.changed)
    memory, (key, impulse) = ImpulseMemory(comm, world.pairs.parts, world.pairs.columns), kept.impulses
    right = np.isfinite(impulse).all() and impulse.shape == (len(key), memory.width)
    right = right and len(np.unique(key)) == len(key)
    refuse(comm, "" if right else "impulses of contacts that are no numbers, or two of one contact")
    if times != 1.0:
        impulse = impulse.copy()
        impulse[:, : 4 * world.pairs.parts] *= times
    memory.restore(key, impulse)
    return world, memory


def load(
    path: Path, scene: Scene, made_with: dict[str, Any], comm: MPI.Comm, program: bool = False
) -> tuple[World, ImpulseMemory]:
    """The world and the impulses of a checkpoint of the scene; collective. ``program`` as of `world_at_start`.

    If the number of ranks is that of the writing run, the world is the same to the last bit. Raises FileError if the
    file is no checkpoint or damaged, and OptionError if it is of another scene or option; warns of another text of the
    scene file, surface of a body or figure of the scene. Where the time step is another, impulses are scaled to it.
    """
    columns = [field.name for field in dataclasses.fields(Bodies)]

    def take(file: h5py.File) -> tuple[Any, ...]:
        _refuse_other_format(file)
        same_rows(file, (f"world/large_{name}" for name in columns))
        count, number = same_rows(file, (f"grains/{name}" for name in columns)), same_rows(file, CONTACTS)
        replicated = {name: file[f"world/{name}"][()] for name in file["world"]}
        _refuse_other_slabs(replicated["slabs"], count)
        rows, contacts = restart_rows(replicated["slabs"], comm), even_slice(number, comm)
        local = {name: file[f"grains/{name}"][rows] for name in columns}
        changed = replicated.pop("changes")[0].decode()
        old = {name: file.attrs[name] for name in made_with if name != "figures"}
        old["figures"] = file.attrs.get("figures", made_with["figures"])  # older files have none
        impulses = tuple(file[name][contacts] for name in CONTACTS)
        return old, json_text.read(file.attrs["scene"]), replicated, changed, local, impulses

    old, scene_of, replicated, changed, local, impulses = read(path, comm, take)
    _refuse_other_origin(path, old, scene_of, made_with, program)
    times = 1.0 if old["dt"] == made_with["dt"] else made_with["dt"] / old["dt"]
    try:
        found = restored(RunState(local, replicated, changed, impulses), scene, comm, times)
    except (AttributeError, KeyError, TypeError, ValueError) as error:  # of another scene file
        raise OptionError(f"{'-restart ' * program}{path}: {error}") from None
    _tell_other_origin(path, old, made_with, comm)
    return found


def _refuse_other_format(file: h5py.File) -> None:
    if (found := file.attrs.get("format")) != FORMAT:
        raise ValueError(f"its format is {found!r}; allowed is {FORMAT!r}")


def _refuse_other_slabs(slabs: np.ndarray, count: int) -> None:
    """ValueError unless these are the first rows of the grains of each rank, and behind the last their ``count``."""
    whole = slabs.dtype.kind == "i" and slabs.ndim == 1 and [*slabs[:1], *slabs[-1:]] == [0, count]
    if not (whole and (np.diff(slabs) >= 0).all()):
        raise ValueError(f"world/slabs is {slabs.tolist()}; allowed are numbers that rise from 0 to {count} grains")


def _refuse_other_origin(
    path: Path, old: dict[str, Any], old_scene: dict[str, Any], new: dict[str, Any], program: bool
) -> None:
    """OptionError for the first option in which two origins differ."""
    new_scene = json_text.read(new["scene"])
    pairs = [("-scene" if program else "scene", old_scene["scene"], new_scene["scene"])]
    absent = "(no such option)"
    names = [name for name in {**new_scene, **old_scene} if name != "scene"]
    pairs += [("-scene_" * program + name, old_scene.get(name, absent), new_scene.get(name, absent)) for name in names]
    for option, was, now in pairs:
        if was != now:
            raise OptionError(f"{option} {now}: {path} was made with {option} {was}; allowed is the same")


def _tell_other_origin(path: Path, old: dict[str, Any], new: dict[str, Any], comm: MPI.Comm) -> None:
    """Warn of what else differs between two origins."""

    def value(figures: dict[str, str], name: str) -> str:  # of a pair without coefficients of its own those of all
        return figures.get(name, figures.get(name.partition(" of ")[0], "none"))

    before, now = json_text.read(old["figures"]), json_text.read(new["figures"])
    names = [name for name in {**now, **before} if before.get(name) != now.get(name)]
    if names:
        differences = ", ".join(f"{name} {value(before, name)}, now {value(now, name)}" for name in names[:10])
        holds = "gravity and laws of contact are those of now, masses, sizes and materials those of before"
        warn(comm, f"{path} was made with {differences}{', and more' * (len(names) > 10)}; {holds}")
    for name, what in {"scene_file": "another text of the scene file", "surfaces": "other surfaces of bodies"}.items():
        if old[name] != new[name]:
            warn(comm, f"{path} was made with {what}: {old[name][:200] or 'none'}, now {new[name][:200] or 'none'}")


# -- settled states, outside the project's folder ------------------------------------------------------------


def settled_path(experiment: Experiment, settings: Settings, scene: Scene, made_with: dict[str, Any]) -> Path:
    """The file of a scene's settled state. Its name has the scene and a digest of all that influences the state: of a
    run's settings that is ``settle_tol``. OptionError if the scene never settles."""
    about = json_text.read(made_with["scene"])
    if not experiment.settling_time:
        raise OptionError(f"{scene_words(experiment)}: has no settling_time and so no settled state")
    how: dict[str, Any] = {
        "dt": time_step.for_settling(scene),
        "delta": settling_distances(experiment, scene),
        "recovery_speed": Settings.recovery_speed,
        "stiffness": stiffness.pairs(scene).stiffness.tolist(),
        "tol": settings.settle_tol,
    }
    if settings.overlap != Settings.overlap:
        how["overlap"] = settings.overlap
    if experiment.digest:
        how["file"] = experiment.digest  # a file that was changed may build another scene
    if surfaces := json_text.read(made_with["surfaces"]):
        how["surfaces"] = surfaces
    digest = hashlib.sha256((made_with["scene"] + json.dumps(how, sort_keys=True)).encode()).hexdigest()[:12]
    size = f"_n{about['n']}" if "n" in about else ""
    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    return cache / "pctt" / f"{about['scene']}{size}_{digest}.h5"


def unfinished(path: Path) -> Path:
    """The checkpoint that an interrupted settling leaves beside its settled state."""
    return path.with_suffix(".unfinished.h5")


def settling_distances(experiment: Experiment, scene: Scene) -> tuple[float, float]:
    """The contact distances of falling grains and of those at rest [m]."""
    falling = time_step.smallest(scene) if experiment.settle_delta is None else experiment.settle_delta
    at_rest = time_step.contact_distance(scene) if experiment.delta is None else experiment.delta
    return max(falling, at_rest), at_rest


def settled_state(
    experiment: Experiment, settings: Settings, scene: Scene, comm: MPI.Comm, say: Say, anew: bool = False
) -> Path:
    """The cached settled state of ``scene``, which the experiment has `built`. It is made if it is missing or damaged,
    or with ``anew``. An interrupted or killed settling is continued."""
    say = say if comm.rank == 0 else lambda text: None
    made_with = origin(experiment, scene, time_step.for_settling(scene))
    path = comm.bcast(settled_path(experiment, settings, scene, made_with))  # processors may round in other ways
    if not anew and comm.bcast(path.exists()):
        try:
            read(path, comm, _refuse_other_format)
            return path
        except FileError as error:
            say(f"{error}; it is made anew")
            anew = True
    on_first(comm, path.parent, lambda: path.parent.mkdir(parents=True, exist_ok=True))
    with _exclusive(path, comm, say):
        if anew or not comm.bcast(path.exists()):
            _settle(path, made_with, experiment, settings, scene, comm, say)
    return path


@contextmanager
def _exclusive(path: Path, comm: MPI.Comm, say: Say) -> Iterator[None]:
    """Other runs that settle the same scene have ended, and wait for the end of the block; collective."""
    lock, waits = Lock(path.with_suffix(".lock")), False
    try:
        while not comm.bcast(comm.rank > 0 or lock.take()):
            if not waits:
                say(f"waits for another run that settles the same scene, {path}")
            waits = True
            time.sleep(0.2)
        yield
    finally:
        lock.release()


def _settle(
    path: Path, made_with: dict[str, Any], experiment: Experiment, settings: Settings, scene: Scene, comm: MPI.Comm,
    say: Say,
) -> None:  # fmt: skip
    """Make steps with APGD for the settling time, with a checkpoint after every tenth of them, and keep the state.

    The last tenth has the contact distance of the scene and ten times the accuracy: otherwise overlaps remain, and the
    first accurate step of a run would push them apart."""
    dt, (falling, at_rest) = time_step.for_settling(scene), settling_distances(experiment, scene)
    end = math.ceil(experiment.settling_time / dt * (1 - 1e-12))
    tenth, tol, begun = max(1, end // 10), settings.settle_tol, time.perf_counter()
    say(f"settling {scene_name(experiment)}, {end} steps with APGD to {tol:g}:")
    loose = Settings(dt=dt, delta=falling, solver="apgd", tol=tol, law=ccp.RELAXATION, overlap=settings.overlap)
    loose = loose.completed_for(experiment)
    world = world_at_start(experiment, loose, scene, comm)
    memory = ImpulseMemory(comm, world.pairs.parts, world.pairs.columns)
    if comm.bcast(unfinished(path).exists()):
        try:
            world, memory = load(unfinished(path), scene, made_with, comm)
            say(f"  goes on after step {world.step}, from {unfinished(path)}")
        except FileError as error:
            say(f"  {error}; settled from the beginning")
    interrupt.note_signals(comm)
    with Stepper(loose, world, memory) as stepper:
        while world.step < end:
            if world.step + 1 >= end - end // 10:
                stepper.use(dataclasses.replace(loose, delta=at_rest, tol=0.1 * tol))
            made = stepper.step()
            stepper.take(made)
            line = made.figures
            interrupted = interrupt.is_requested(comm)
            if world.step % tenth == 0 or world.step == end or interrupted:
                save(unfinished(path), made_with, world, memory)
                say(
                    f"  step {world.step:5d}  time {line['time']:6.2f} s  contacts {line['contacts']:8d}"
                    f"  residual {line['natural_residual']:.1e}  {time.perf_counter() - begun:7.1f} s spent"
                )
            if interrupted:
                words = f"settling interrupted after step {world.step} of {end}; the same command goes on there"
                raise interrupt.InterruptError(words)
    save(path, made_with, world, memory)
    if comm.rank == 0:
        unfinished(path).unlink(missing_ok=True)
    comm.Barrier()
