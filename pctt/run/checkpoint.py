"""Checkpoints: all that a run needs to go on, and the cache of settled states."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import os
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from mpi4py import MPI

from dem.arrays import Floats
from dem.bodies import Bodies
from dem.experiment import Experiment
from dem.impulses import ImpulseMemory
from dem.mesh import Mesh
from dem.quaternion import cross
from dem.scene import LargeBody, Scene
from dem.start import even_slice, restart_rows, restored_world
from dem.world import World, changed_motions, restore_motions
from pctt.options import OptionError
from pctt.run.hdf5 import FileError, raise_together, readable, write_text, written
from pctt.run.settings import scene_name

FORMAT = "pctt checkpoint 1"

_COLUMNS = [field.name for field in dataclasses.fields(Bodies)]
_LARGE = [f"large_{name}" for name in _COLUMNS]


def scene_record(name: str, scene: Any) -> str:
    """A scene and its options as text, equal for equal scenes."""
    return json.dumps({"scene": name, **dataclasses.asdict(scene)}, sort_keys=True)


def origin(scene: Experiment, dt: float) -> dict[str, Any]:
    """What a run must share with the run whose checkpoint it continues, as attributes of a checkpoint: the
    `scene_record`, the time step [s], and the digest of the user's scene file or ""."""
    return {"scene": scene_record(scene_name(scene), scene), "dt": dt, "scene_file": scene.digest}


def surfaces(large_bodies: Iterable[LargeBody]) -> dict[str, list[float]]:
    """What tells the surfaces of large bodies apart, by the names of the bodies that have triangles: the number of
    triangles, their area [m2], their centroid [m] (3) and the root mean squares of their places [m] (3).

    Not the digest of the vertices: those of a turned profile differ between processors in their last bits."""

    def figures(corners: Floats) -> list[float]:
        twice = np.linalg.norm(cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
        middle, weight = corners.mean(axis=1), twice / twice.sum()
        spread = np.sqrt(weight @ middle**2)
        return [float(len(corners)), float(0.5 * twice.sum()), *(weight @ middle).tolist(), *spread.tolist()]

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
    with written(path, world.comm) as file:
        for name, column in local.items():
            file.rows(f"grains/{name}", column)
        for name, array in replicated.items():
            file.whole(f"world/{name}", array)
        file.texts("world/materials", world.materials)
        if motions := changed_motions(world):
            file.texts("world/motions", [motions])
        file.rows("contacts/key", key)
        file.rows("contacts/impulse", impulse)
        about = {"format": FORMAT, **made_with}
        if triangles := surfaces(world.large_bodies):
            about["surfaces"] = json.dumps(triangles, sort_keys=True)
        file.attributes("/", about)


def load(
    path: Path, scene: Scene, made_with: dict[str, Any], comm: MPI.Comm, changed_file: bool = False
) -> tuple[World, ImpulseMemory]:
    """The world and the impulses of a checkpoint of the scene; collective.

    If the number of ranks is that of the writing run, the world is the same to the last bit. Raises FileError if the
    file is no checkpoint, and OptionError if it has another `origin` or a large body has another surface; with
    ``changed_file`` the scene file and the surfaces may differ.
    """
    with readable(path, comm) as file:
        if file.attrs.get("format") != FORMAT:
            raise FileError(f"{path}: no checkpoint of this program (it is not marked '{FORMAT}')")
        failure = None
        try:
            json.loads(file.attrs["scene"])
            triangles = json.loads(file.attrs.get("surfaces", "{}"))
            stored = {name: file.attrs[name] for name in made_with if name in file.attrs}
            replicated = {n: file[f"world/{n}"][()] for n in (*_LARGE, "slabs", "time", "step")}
            motions = file["world/motions"].asstr()[0] if "world/motions" in file else "{}"
            rows = restart_rows(replicated["slabs"], comm)
            local = {n: file[f"grains/{n}"][rows] for n in _COLUMNS}
            part = even_slice(len(file["contacts/key"]), comm)
            key, impulse = file["contacts/key"][part], file["contacts/impulse"][part]
        except (KeyError, OSError, ValueError) as error:
            failure = str(error)
        raise_together(f"{path}: incomplete checkpoint", failure, comm)
    _refuse_other_origin(path, stored, made_with, changed_file)
    if not changed_file:
        _refuse_other_surfaces(path, triangles, surfaces(scene.large_bodies))
    try:
        world = restored_world(scene, comm, local, replicated)
        restore_motions(world, motions)
    except (KeyError, TypeError, ValueError) as error:  # another text of the scene file may build other bodies
        raise OptionError(f"-restart {path}: {error}") from None
    memory = ImpulseMemory(comm)
    memory.restore(key, impulse)
    return world, memory


def _refuse_other_origin(path: Path, old: dict[str, Any], new: dict[str, Any], changed_file: bool) -> None:
    """OptionError for the first property in which two origins differ. Checkpoints of earlier versions lack some
    properties."""
    old_scene, new_scene = json.loads(old["scene"]), json.loads(new["scene"])
    was, now = (f"-scene {scene['scene']}" for scene in (old_scene, new_scene))
    if was != now:
        raise OptionError(f"{now}: {path} was made with {was}; allowed is the same")
    digests = old.get("scene_file", new["scene_file"]), new["scene_file"]
    if digests[0] != digests[1] and not changed_file:
        old_file, new_file = (f"a file with SHA-256 {d[:12]}..." if d else "the package's scene" for d in digests)
        raise OptionError(
            f"{now}: {path} was made with {old_file}, given is {new_file}; allowed is the same text, or another with "
            "-restart_changed_file"
        )
    for field in {**new_scene, **old_scene}:
        was, now = (f"-scene_{field} {scene.get(field, '(no such option)')}" for scene in (old_scene, new_scene))
        if was != now:
            raise OptionError(f"{now}: {path} was made with {was}; allowed is the same")
    if old.get("dt", new["dt"]) != new["dt"]:
        raise OptionError(f"-dt {new['dt']}: {path} was made with -dt {old['dt']}; allowed is the same")


def _refuse_other_surfaces(path: Path, old: dict[str, list[float]], new: dict[str, list[float]]) -> None:
    """OptionError for the first body whose `surfaces` differ; checkpoints of earlier versions know none."""
    for name in sorted(old.keys() & new.keys()):
        if not np.allclose(old[name], new[name], rtol=1e-6, atol=1e-6 * max(new[name][-3:])):
            was, now = (f"{triangles:.0f} triangles, {area:.6g} m2" for triangles, area, *_ in (old[name], new[name]))
            raise OptionError(
                f"-restart {path}: body {name!r} has another surface ({now}) than when it was made ({was}); allowed is "
                "the same, or another with -restart_changed_file"
            )


# -- settled states, outside the project's folder ------------------------------------------------------------


def settled_path(record: str, settings: dict[str, Any]) -> Path:
    """The file of a scene's settled state. Its name has the scene and a digest of all options that influence the
    state."""
    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "pctt"
    scene = json.loads(record)
    digest = hashlib.sha256((record + json.dumps(settings, sort_keys=True)).encode()).hexdigest()[:12]
    size = f"_n{scene['n']}" if "n" in scene else ""
    return cache / f"{scene['scene']}{size}_{digest}.h5"


def write_checksum(path: Path) -> None:
    """Put ``FILE.sha256`` beside a file, as ``sha256sum -c`` reads it; one rank."""
    write_text(Path(f"{path}.sha256"), f"{_digest(path)}  {path.name}\n")


def intact(path: Path) -> bool:
    """Whether a settled state and its checksum are there and agree; FileError if they do not agree; one rank."""
    checksum = Path(f"{path}.sha256")
    if not (path.exists() and checksum.exists()):
        return False
    if checksum.read_text().split()[0] != _digest(path):
        remedy = "delete it to have it made again"
        raise FileError(f"{path}: does not agree with its checksum; {remedy}", one_rank=True)
    return True


def _digest(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()

