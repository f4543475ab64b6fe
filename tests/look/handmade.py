"""An output folder written by hand, with bodies and forces that are known."""

from __future__ import annotations

import json
from pathlib import Path

import h5py
import numpy as np

HALF = np.sqrt(0.5)
#: sphere, box turned by 90 degrees about x, capsule laid along x
POSITION = np.array([[0, 0, 0.5], [1.5, 0, 0.8], [0, 1.5, 0.3], [0, 0, 0]])
QUATERNION = np.array([[1, 0, 0, 0], [HALF, HALF, 0, 0], [HALF, 0, HALF, 0], [1, 0, 0, 0]])
SHAPE, SIZE = np.array([0, 1, 3, 2]), np.array([[0.5, 0, 0], [0.2, 0.4, 0.8], [0.3, 0.6, 0], [0, 0, 0]])
VELOCITY = np.array([[3.0, 4, 0, 0, 0, 1], [0, 0, 0, 0, 0, 0], [0, 0, 2.5, 0, 0, 0], [0, 0, 0, 0, 0, 0]])
DT = 0.5
#: the sphere on the floor (along z), and the capsule against the sphere (along y)
CONTACT = {
    "body": np.array([[0, 3], [0, 2]]),
    "point": np.array([[0, 0, 0.0], [0, 0.5, 0.5]]),
    "frame": np.array([[[0, 0, -1.0], [1, 0, 0], [0, -1, 0]], [[0, 1.0, 0], [0, 0, 1], [1, 0, 0]]]),
    "gap": np.array([0.0, 0.01]),
    "impulse": np.array([[3.0, 4, 0], [2, 0, 0]]),
}


def write(path: Path, shapes: list[dict], steps: int = 1) -> Path:
    """A folder whose one large body, at rest, has the given shapes; the bodies do not move from step to step."""
    (path / "frames").mkdir(parents=True)
    with h5py.File(path / "frames" / "bodies.h5", "w") as file:
        file["shape"], file["size"], file["mass"] = SHAPE, SIZE, np.array([1.0, 1, 1, np.inf])
        file["material"], file["materials"] = np.array([2, 0, 2, 1]), np.array([b"steel", b"floor", b"glass"])
        file["large"] = np.bytes_(json.dumps([{"name": "floor", "shapes": shapes}]))
    with h5py.File(path / "state.h5", "w") as state:
        state["bodies"] = h5py.ExternalLink("frames/bodies.h5", "/")
        for step in range(1, steps + 1):
            with h5py.File(path / "frames" / f"{step:06d}.h5", "w") as file:
                file.attrs.update({"step": step, "time": step * DT})
                file["position"], file["quaternion"], file["velocity"] = POSITION, QUATERNION, VELOCITY
                for name, values in CONTACT.items():
                    file[f"contact/{name}"] = values
                file["contact"].attrs["dt"] = DT
            state[f"steps/{step:06d}"] = h5py.ExternalLink(f"frames/{step:06d}.h5", "/")
    (path / "summary.json").write_text(json.dumps({"steps": 0, "compare": {}}))
    return path


FLOOR = [{"kind": "Plane", "normal": [0, 0, 1], "center": [0, 0, 0]}]
