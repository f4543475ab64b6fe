"""OBJ files: their corners and faces, whatever texture, normals and materials they have; what is damaged is refused
with its place."""

from __future__ import annotations

import re
from collections import defaultdict

import numpy as np

from dem.arrays import Floats, Ints
from dem.quaternion import cross


def triangles(data: bytes) -> tuple[Floats, Ints]:
    """The vertices (n, 3), in the unit of the file, and triangles (m, 3), rows of vertices, into which faces are cut.
    ValueError, which says where, for what is damaged, and for a face that no corner of it sees whole."""
    vertices: list[list[float]] = []
    faces: dict[int, list[list[int]]] = defaultdict(list)  # by how many corners they have
    lines: dict[int, list[int]] = defaultdict(list)
    whole = re.sub(r"\\\r?\n", " ", data.decode("utf-8-sig", "replace"))
    for number, line in enumerate(whole.splitlines(), 1):
        key, *words = line.partition("#")[0].split() or [""]
        try:
            if key == "v":
                vertices.append([float(word) for word in words[:3]])
                if len(words) < 3 or not np.isfinite(vertices[-1]).all():
                    raise ValueError
            elif key == "f":
                face = [_row(int(word.partition("/")[0]), len(vertices)) for word in words]
                if len(face) < 3 or min(face) < 0:
                    raise ValueError
                faces[len(face)].append(face)
                lines[len(face)].append(number)
        except ValueError:
            allowed = "three finite numbers" if key == "v" else "three or more corners, from 1 on or back from -1"
            raise ValueError(f"line {number}: {line.strip()!r}: allowed are {allowed}") from None
    corners, found = np.array(vertices, float).reshape(-1, 3), [np.zeros((0, 3), np.int64)]
    for count, rows in faces.items():
        polygons, at = np.array(rows, np.int64), np.array(lines[count])
        beyond = polygons.max(axis=1) >= len(corners)
        if beyond.any():
            where = f"line {at[beyond][0]}: corner {polygons[beyond][0].max() + 1}"
            raise ValueError(f"{where}, where there are {len(corners)}: the file is damaged or truncated")
        found.append(_cut(corners, polygons, at))
    return corners, np.concatenate(found)


def _row(number: int, before: int) -> int:
    """The row of a corner, whose number counts from 1, or if it is negative back from the `before` vertices."""
    return number + before if number < 0 else number - 1


def _cut(corners: Floats, polygons: Ints, lines: Ints) -> Ints:
    """The triangles from one corner of each polygon (m, k) to all others: from the first that sees the polygon whole,
    so that none of them is turned over. ValueError if there is none."""
    count, left = polygons.shape[1], np.ones(len(polygons), bool)
    fans = np.zeros((len(polygons), count - 2, 3), np.int64)
    for first in range(count):
        turned = np.roll(polygons[left], -first, axis=1)
        fan = np.stack([np.broadcast_to(turned[:, :1], turned[:, 2:].shape), turned[:, 1:-1], turned[:, 2:]], axis=2)
        place = corners[fan]
        area = cross(place[:, :, 1] - place[:, :, 0], place[:, :, 2] - place[:, :, 0])
        whole = area.sum(axis=1, keepdims=True)
        sees = ((area * whole).sum(axis=2) >= -1e-6 * (whole * whole).sum(axis=2)).all(axis=1)
        rows = left.nonzero()[0][sees]
        fans[rows], left[rows] = fan[sees], False
        if not left.any():
            return fans.reshape(-1, 3)
    raise ValueError(
        f"line {lines[left][0]}: a face of {count} corners of which none sees all others; allowed are triangles: "
        "let the program that drew it cut its faces"
    )
