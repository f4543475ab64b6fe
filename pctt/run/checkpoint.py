"""Checkpoints: all that a run needs to go on, and the cache of settled states."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import os
from pathlib import Path
from typing import Any

from mpi4py import MPI

from dem.bodies import Bodies
from dem.impulses import ImpulseMemory
from dem.world import World, restart_rows
from pctt.options import OptionError
from pctt.run.hdf5 import FileError, readable, write_text, written

FORMAT = "pctt checkpoint 1"

_COLUMNS = [field.name for field in dataclasses.fields(Bodies)]
_LARGE = [f"large_{name}" for name in _COLUMNS]


def scene_record(name: str, scene: Any) -> str:
    """A scene and its options as text, equal for equal scenes."""
    return json.dumps({"scene": name, **dataclasses.asdict(scene)}, sort_keys=True)


def save(path: Path, record: str, world: World, memory: ImpulseMemory) -> None:
    """Write a checkpoint; collective. The previous one under this name stays until this one is complete."""
    local, replicated = world.state()
    key, impulse = memory.state()
    with written(path, world.comm) as file:
        for name, column in local.items():
            file.rows(f"grains/{name}", column)
        for name, array in replicated.items():
            file.whole(f"world/{name}", array)
        file.rows("contacts/key", key)
        file.rows("contacts/impulse", impulse)
        file.attributes("/", {"format": FORMAT, "scene": record})


def load(path: Path, name: str, scene: Any, comm: MPI.Comm) -> tuple[World, ImpulseMemory]:
    """The world and the impulses of a checkpoint; collective.

    On the number of ranks that wrote it the world is the same to the last bit. Raises FileError if it is no
    checkpoint, OptionError if it is one of another scene.
    """
    with readable(path, comm) as file:
        if file.attrs.get("format") != FORMAT:
            raise FileError(f"{path}: no checkpoint of this program (it is not marked '{FORMAT}')")
        failure = None
        try:
            stored = json.loads(file.attrs["scene"])
            replicated = {n: file[f"world/{n}"][()] for n in (*_LARGE, "slabs", "time", "step")}
            rows = restart_rows(replicated["slabs"], comm)
            local = {n: file[f"grains/{n}"][rows] for n in _COLUMNS}
            count = len(file["contacts/key"])
            part = slice(count * comm.rank // comm.size, count * (comm.rank + 1) // comm.size)
            key, impulse = file["contacts/key"][part], file["contacts/impulse"][part]
        except (KeyError, OSError, ValueError) as error:
            failure = str(error)
        failures = [text for text in comm.allgather(failure) if text]
        if failures:
            raise FileError(f"{path}: incomplete checkpoint ({failures[0]})")
    _refuse_other_scene(path, stored, json.loads(scene_record(name, scene)))
    world = World.restore(scene.build(), comm, local, replicated)
    memory = ImpulseMemory(comm)
    memory.restore(key, impulse)
    return world, memory


def _refuse_other_scene(path: Path, old: dict[str, Any], new: dict[str, Any]) -> None:
    if old["scene"] != new["scene"]:
        raise OptionError(f"-scene {new['scene']}: {path} holds the scene {old['scene']}")
    for field, value in new.items():
        if old.get(field) != value:
            raise OptionError(
                f"-scene_{field} {value}: {path} was made with {old.get(field)}; allowed is the same"
            )


# -- settled states, outside the project's folder ------------------------------------------------------------


def settled_path(record: str, settings: dict[str, Any]) -> Path:
    """Where the settled state of a scene is kept: a file named by scene and digest of what shaped it."""
    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "pctt"
    scene = json.loads(record)
    digest = hashlib.sha256((record + json.dumps(settings, sort_keys=True)).encode()).hexdigest()[:12]
    size = f"_n{scene['n']}" if "n" in scene else ""
    return cache / f"{scene['scene']}{size}_{digest}.h5"


def write_checksum(path: Path) -> None:
    """Put ``FILE.sha256`` beside a file, as ``sha256sum -c`` reads it; one rank."""
    write_text(Path(f"{path}.sha256"), f"{_digest(path)}  {path.name}\n")


def intact(path: Path) -> bool:
    """Whether a settled state and its checksum are there and agree; FileError if they do not agree."""
    checksum = Path(f"{path}.sha256")
    if not (path.exists() and checksum.exists()):
        return False
    if checksum.read_text().split()[0] != _digest(path):
        raise FileError(f"{path}: does not agree with its checksum; delete it to have it made again")
    return True


def _digest(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()

