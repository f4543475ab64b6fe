"""Beds of spheres from files of other programs::

    scene.add_spheres(**read_spheres("settled.data"))  # of LAMMPS or LIGGGHTS
    scene.add_spheres(**read_spheres("points.csv", density=2500.0, length=1e-3))  # in millimetres

Read are data files of LAMMPS and LIGGGHTS (`write_data`) and their text dumps (`dump custom`), text of Yade (x y z r),
tables with a line or a comment of names (CSV, also those of ParaView, numpy.savetxt), and points of VTK (.vtk, .vtp,
.vtu); each also as .gz.
"""

from __future__ import annotations

import base64
import gzip
import re
import zlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, NoReturn
from urllib.parse import unquote
from xml.etree import ElementTree

import numpy as np

from dem import checks
from dem.arrays import ArrayLike, Floats

#: Columns of the section Atoms of a data file, by the style in its head. A line may have three flags of images more.
STYLES = {
    "sphere": "id type diameter density x y z",
    "granular": "id type diameter density x y z",
    "bpm/sphere": "id molecule type diameter density x y z",
    "hybrid": "id type x y z diameter density",  # of styles of which the first with values is sphere
    "atomic": "id type x y z",
    "charge": "id type charge x y z",
    **dict.fromkeys(("bond", "angle", "molecular"), "id molecule type x y z"),
    "full": "id molecule type charge x y z",
}
#: What else columns are called; of vectors also with x, y, z or 0, 1, 2 behind the name.
SCALARS = {
    "r": "radius", "radii": "radius", "rad": "radius", "d": "diameter", "rho": "density", "m": "mass",
    "matid": "type", "material": "type",
}  # fmt: skip
VECTORS = {
    **dict.fromkeys(("", "points", "position", "coordinates"), ""),
    **dict.fromkeys(("v", "velocity", "linvelvec"), "v"),
    **dict.fromkeys(("w", "omega", "angular_velocity", "angvelvec"), "w"),
}
#: The quantities that this module knows.
KNOWN = {"x", "y", "z", "vx", "vy", "vz", "wx", "wy", "wz", "id", *SCALARS.values()}
#: Types of numbers in VTK files, as numpy has them.
LEGACY = {
    "float": "f4", "double": "f8", "int": "i4", "unsigned_int": "u4", "long": "i8", "unsigned_long": "u8",
    "short": "i2", "unsigned_short": "u2", "char": "i1", "unsigned_char": "u1", "vtktypeint64": "i8", "vtkidtype": "i4",
}  # fmt: skip


@dataclass(frozen=True)
class Found:
    """What a file says of its spheres."""

    columns: dict[str, np.ndarray]  #: (n,) of numbers or words, by name
    place: Callable[[int], str]  #: where in the file a row is


class Unreadable(ValueError):  # noqa: N818 - the reader adds the name of the file
    """What is wrong with a file."""


def read_spheres(
    path: str | Path, density: ArrayLike | None = None, radius: ArrayLike | None = None, type: int | str | None = None,
    frame: int = -1, length: float | None = None,
) -> dict[str, Any]:  # fmt: skip
    """Read the spheres of a file; what `Scene.add_spheres` takes: positions (n, 3) [m], radius [m] and density
    [kg/m^3], and if the file has them velocities (n, 3) [m/s, rad/s] and material, the types as "type 1", "type 2".

    `density` [kg/m^3] and `radius` [m], one for all or (n,), take the place of those of the file. `type`: only spheres
    of this one. `frame`: which one of a dump, -1 the last. `length`: the file's unit of length [m], 1e-3 for
    millimetres, which a file has to have with it whose heading says mm, cm or um; its masses are kg, its densities
    kg/m^3. Spheres with ids are in their order. ValueError, which names the file and the line, for what cannot be read,
    is no number, or is missing.
    """
    checks.positive("length", 1.0 if length is None else length)
    if not isinstance(frame, (int, np.integer)):
        raise ValueError(f"frame {frame!r}: allowed is a whole number, -1 for the last one")
    try:
        data = Path(path).read_bytes()
        data = gzip.decompress(data) if data[:2] == b"\x1f\x8b" else data
        if length is None and (unit := re.search(rb"[\[(](mm|cm|um)[\])]", data[:4096])):
            raise Unreadable(f"its heading has {unit[0].decode()}; give length=, which is 1e-3 for millimetres")
        return _spheres(_read(data, frame), density, radius, type, length or 1.0)
    except OSError as error:
        raise ValueError(f"{path}: cannot be read ({error.strerror or error})") from None
    except EOFError:
        raise ValueError(f"{path}: the compressed file is truncated") from None
    except Unreadable as error:
        raise ValueError(f"{path}: {error}") from None
    except (ArithmeticError, LookupError, TypeError, ValueError) as error:  # what damage makes of a reader
        raise ValueError(f"{path}: damaged or truncated ({str(error)[:100]})") from None


def _read(data: bytes, frame: int) -> Found:
    """The frame of a file of any kind, which its beginning tells."""
    head = data[:4096]
    read = next(read for begins, read in READERS.items() if re.search(begins, head))
    frames = read(data)
    if not -len(frames) <= frame < len(frames):
        raise Unreadable(f"frame {frame}: the file has {len(frames)}; allowed is {-len(frames)} to {len(frames) - 1}")
    return frames[frame]()


def _spheres(found: Found, density: Any, radius: Any, type: int | str | None, length: float) -> dict[str, Any]:
    """The arguments of `Scene.add_spheres`."""
    columns, rows = {_name(key): column for key, column in found.columns.items()}, None
    kinds = columns.get("type")
    if kinds is not None:
        names, which = np.unique(kinds, return_inverse=True)
        kinds = np.array([_kind(str(name)) for name in names.tolist()])[which]
    if type is not None:
        if kinds is None:
            raise Unreadable(f"type {type}: {_lacks(columns, 'type')}")
        rows = np.flatnonzero(kinds == _kind(str(type)))
        if not len(rows):
            raise Unreadable(f"type {type}: no sphere has it; there are {', '.join(np.unique(kinds))}")
    order = np.argsort(_numbers(columns["id"], "id", found.place), kind="stable") if "id" in columns else None
    order = np.arange(len(next(iter(columns.values())))) if order is None else order
    order = order if rows is None else order[np.isin(order, rows)]

    def taken(*names: str) -> Floats | None:
        if not all(name in columns for name in names):
            return None
        return np.stack([_numbers(columns[name], name, found.place)[order] for name in names], axis=-1)

    positions = taken("x", "y", "z")
    if positions is None:
        raise Unreadable(_lacks(columns, "x, y, z"))
    if radius is None:
        of, times = ("radius", length) if "radius" in columns else ("diameter", 0.5 * length)
        given = taken(of)
        if given is None:
            raise Unreadable(f"{_lacks(columns, 'radius or diameter')}; give radius= in metres")
        radius = _positive(given[:, 0], of, order, found.place) * times
    if density is None:
        of = "density" if "density" in columns else "mass"
        given = taken(of)
        if given is None:
            raise Unreadable(f"{_lacks(columns, 'density or mass')}; give density= in kg/m^3")
        density = _positive(given[:, 0], of, order, found.place)
        density = density if of == "density" else density / (4.0 / 3.0 * np.pi * np.asarray(radius) ** 3)
    spheres: dict[str, Any] = {"positions": length * positions, "radius": radius, "density": density}
    for name, what, times in (("velocity", "v", length), ("angular_velocity", "w", 1.0)):
        if (values := taken(f"{what}x", f"{what}y", f"{what}z")) is not None:
            spheres[name] = times * values
    if kinds is not None:
        spheres["material"] = [f"type {kind}" if kind.isdigit() else kind for kind in kinds[order].tolist()]
    return spheres


def _name(text: str) -> str:
    """The name of a column as this module has it."""
    plain = re.sub(r"[\[(].*", "", text.strip().strip("\"'")).strip().lower().replace(" ", "_")
    axis = re.fullmatch(r"(.*?)[:_]?([xyz012])u?", plain)
    if axis and axis[1] in VECTORS and plain not in ("0", "1", "2"):
        return VECTORS[axis[1]] + axis[2].translate(str.maketrans("012", "xyz"))
    return SCALARS.get(plain, plain)


def _kind(word: str) -> str:
    """What a type is called: a whole number without the point that tables of floats give it."""
    return str(int(float(word))) if _is_number(word) and float(word).is_integer() else word


def _lacks(columns: dict[str, Any], what: str) -> str:
    return f"has no {what}; its columns are {', '.join(columns)}"


def _numbers(column: np.ndarray, name: str, place: Callable[[int], str]) -> Floats:
    """A column as finite numbers; Unreadable for the first that is none."""
    try:
        values = column.astype(float)
    except ValueError:
        row, word = next((row, word) for row, word in enumerate(column.tolist()) if not _is_number(word))
        raise Unreadable(f"{place(row)}: {name} is {word!r}, no number") from None
    bad = np.flatnonzero(~np.isfinite(values))
    if len(bad):
        raise Unreadable(f"{place(bad[0])}: {name} is {values[bad[0]]}; allowed is a finite number")
    return values


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def _positive(values: Floats, name: str, rows: np.ndarray, place: Callable[[int], str]) -> Floats:
    bad = np.flatnonzero(values <= 0.0)
    if len(bad):
        raise Unreadable(f"{place(rows[bad[0]])}: {name} is {values[bad[0]]:g}; allowed is a positive number")
    return values


# -- lines of text -------------------------------------------------------------------------------------------


def _lines(data: bytes) -> list[str]:
    """With their ends, of which the last one of a truncated file has none."""
    return data.decode("utf-8-sig", "replace").splitlines(keepends=True)


def _rows(lines: Sequence[str], first: int, count: int | None, names: Sequence[str], more: Sequence[int] = (0,),
          cut: str | None = None) -> Found:  # fmt: skip
    """The table in the next `count` lines (None: all) from the one `first`, blank ones and comments left out, with
    these columns and so many `more`."""
    numbered = ((k, line.split("#")[0].strip()) for k, line in enumerate(lines[first:], first + 1))
    kept: list[int] = []
    rows: list[list[str]] = []
    for number, line in numbered:
        if len(rows) == count:
            break
        if not line:
            continue
        row = [word.strip().strip("\"'") for word in line.split(cut)]
        if len(row) - len(names) not in more:
            words = f"{len(row)} values where {len(names)} are needed ({' '.join(names)})"
            short = len(row) < len(names) + max(more) and not lines[number - 1].endswith(("\n", "\r"))
            raise Unreadable(f"line {number}: {words}{'; the file is truncated' if short else ''}")
        rows.append(row[: len(names)])
        kept.append(number)
    if not rows or len(rows) < (count or 0):
        ends = f"the file ends after {len(rows)} of {count} spheres: it is truncated"
        raise Unreadable(f"line {len(lines)}: {ends}" if count else "has no sphere")
    table = np.array(rows)
    return Found({name: table[:, k] for k, name in enumerate(names)}, lambda row: f"line {kept[row]}")


def _data(data: bytes) -> list[Callable[[], Found]]:
    """Of a data file of LAMMPS or LIGGGHTS."""
    lines = _lines(data)

    def section(name: str) -> tuple[int, str] | None:
        """The line behind a head, and its comment."""
        heads = (re.match(rf"\s*{name}\s*(?:#\s*(.*?)\s*)?$", line) for line in lines)
        return next(((k, head[1] or "") for k, head in enumerate(heads, 1) if head), None)

    def read() -> Found:
        count = next(int(line.split()[0]) for line in lines if re.match(r"\s*\d+\s+atoms\b", line))
        atoms, speeds = section("Atoms"), section("Velocities")
        if atoms is None:
            raise Unreadable(f"line {len(lines)}: the file ends before the section Atoms: it is truncated")
        start, style = atoms
        style = style.split()[0] if style else "sphere"  # LIGGGHTS writes none
        if style not in STYLES:
            raise Unreadable(f"line {start}: atoms of style {style}; allowed is one of {', '.join(STYLES)}")
        more = range(20) if style == "hybrid" else (0, 3)
        found = _rows(lines, start, count, STYLES[style].split(), more)
        if speeds is None:
            return found
        names = ["id", "vx", "vy", "vz"] + ["wx", "wy", "wz"] * ("diameter" in found.columns)
        moving = _rows(lines, speeds[0], count, names, more)
        here, there = (np.argsort(each.columns["id"]) for each in (found, moving))
        if (found.columns["id"][here] != moving.columns["id"][there]).any():
            raise Unreadable(f"line {speeds[0]}: Velocities has other ids than Atoms")
        row = np.empty(count, np.int64)
        row[here] = there
        return Found({**{name: column[row] for name, column in moving.columns.items()}, **found.columns}, found.place)

    return [read]


def _dump(data: bytes) -> list[Callable[[], Found]]:
    """Of a text dump of LAMMPS or LIGGGHTS, a frame for each of its heads ITEM: ATOMS."""
    lines = _lines(data)
    items = [k for k, line in enumerate(lines) if line.startswith("ITEM:")]
    frames: list[Callable[[], Found]] = []
    sections: dict[str, int] = {}
    for k in items:
        what = lines[k][5:].strip()
        sections[" ".join(what.split()[:2])] = k
        if what.startswith("ATOMS"):
            frames.append(partial(_frame, lines, dict(sections), k, what.split()[1:]))
    if not frames:
        raise Unreadable(f"line {len(lines)}: the dump ends before its first ITEM: ATOMS: it is truncated")
    return frames


def _frame(lines: list[str], at: dict[str, int], head: int, names: list[str]) -> Found:
    """One frame, from the lines of its heads. Scaled places are turned to places by the box, which may be tilted."""
    if "NUMBER OF" not in at or not lines[at["NUMBER OF"] + 1].strip().isdigit():
        raise Unreadable(f"line {head + 1}: no ITEM: NUMBER OF ATOMS before it")
    found = _rows(lines, head + 1, int(lines[at["NUMBER OF"] + 1]), names)
    columns, scaled = found.columns, [name for name in ("xs", "xsu") if name in found.columns]
    if "x" in columns or "xu" in columns or not scaled:
        return found
    names = [scaled[0].replace("x", axis) for axis in "xyz"]
    if not set(names) <= set(columns):
        needed = f"{scaled[0]} needs {' and '.join(names[1:])}"
        raise Unreadable(f"line {head + 1}: {needed}; the columns are {', '.join(columns)}")
    if "BOX BOUNDS" not in at:
        raise Unreadable(f"line {head + 1}: {scaled[0]} needs ITEM: BOX BOUNDS, which is not there")
    box = _rows(lines, at["BOX BOUNDS"] + 1, 3, ["low", "high"], (0, 1))
    low, high = (_numbers(box.columns[name], name, box.place) for name in ("low", "high"))
    tilt = [float((lines[at["BOX BOUNDS"] + k].split() + ["0"])[2]) for k in (1, 2, 3)]
    xy, xz, yz = tilt
    low -= [min(0.0, xy, xz, xy + xz), min(0.0, yz), 0.0]
    high -= [max(0.0, xy, xz, xy + xz), max(0.0, yz), 0.0]
    edges = np.diag(high - low) + np.array([[0.0, xy, xz], [0.0, 0.0, yz], [0.0, 0.0, 0.0]])
    parts = [_numbers(columns[name], name, found.place) for name in names]
    return Found({**columns, **dict(zip("xyz", low[:, None] + edges @ np.array(parts)))}, found.place)


def _table(data: bytes) -> list[Callable[[], Found]]:
    """Of a table with a line of names, or a comment that has them: #format of Yade, or one with x, y and z, as of
    numpy.savetxt; without them they are x y z, and r if there are more."""
    lines = _lines(data)
    first = next((k for k, line in enumerate(lines) if line.strip() and not line.lstrip().startswith("#")), len(lines))
    if first == len(lines):
        raise Unreadable("has no sphere")
    cut = next((mark for mark in ";,\t" if mark in lines[first]), None)
    words = [word.strip() for word in lines[first].split(cut)]
    named = any(re.match(r"[\"']?[A-Za-z_]", word) and word.lower() not in ("nan", "inf") for word in words)
    formats = [match[1] for line in lines[:first] if (match := re.match(r"#\s*format\s+(\S+)", line))]
    if named:
        names, first = words, first + 1
    else:
        told = (_heading(comment, len(words)) for comment in lines[:first])
        heads = [formats[-1].split("_")] if formats else [*filter(_places, told)]
        names = heads[-1] if heads else ["x", "y", "z", "r", "clump"][: min(max(len(words), 3), 5)]
    return [lambda: _rows(lines, first, None, names, range(20) if "attrs" in names else (0,), cut)]


def _heading(comment: str, count: int) -> list[str]:
    """The words of a comment, without units in brackets and what announces them, such as "columns:"; of a sentence
    those that name quantities, if that makes ``count``."""
    plain = re.sub(r"^[#\s]*(\w+:\s)?|[\[(].*?[\])]", "", comment.rstrip())
    words = [word.strip() for word in plain.split(next((mark for mark in ";,\t" if mark in plain), None))]
    known = [word for word in words if _name(word) in KNOWN]
    return known if len(known) == count else words


def _places(names: list[str]) -> bool:
    return {"x", "y", "z"} <= set(map(_name, names))


# -- VTK -----------------------------------------------------------------------------------------------------


def _points(arrays: dict[str, np.ndarray]) -> Found:
    """The columns of named arrays (n,) or (n, parts) of the same length."""
    columns = {}
    for name, array in arrays.items():
        if array.ndim == 1 or array.shape[1] == 1:
            columns[name] = array.reshape(len(array))
        elif array.shape[1] == 3:
            columns |= {f"{name}:{k}": array[:, k] for k in range(3)}
    if not len(arrays.get("points", ())):
        raise Unreadable("has no points")
    if short := [name for name, column in columns.items() if len(column) != len(arrays["points"])]:
        raise Unreadable(f"{len(columns[short[0]])} values of {short[0]} for {len(arrays['points'])} points")
    return Found(columns, lambda row: f"point {row}")


class _Legacy:
    """The words and numbers of a legacy file, one after another."""

    def __init__(self, data: bytes) -> None:
        self.data, self.at = data, 0
        self.title = [self.line() for _ in range(3)]
        self.binary = self.title[2].strip().upper() == "BINARY"

    def line(self) -> str:
        end = self.data.find(b"\n", self.at)
        text, self.at = self.data[self.at : end if end >= 0 else None], end + 1 if end >= 0 else len(self.data)
        return text.decode("latin1")

    def lines(self) -> Iterator[list[str]]:
        while self.at < len(self.data):
            words = self.line().split()
            if words[:1] == ["METADATA"]:  # of an array, up to a blank line
                while self.line().strip():
                    pass
            elif words:
                yield words

    def numbers(self, count: int, kind: str) -> np.ndarray:
        if (numpy := LEGACY.get(kind.lower())) is None:
            raise Unreadable(f"values of type {kind}; allowed is one of {', '.join(LEGACY)}")
        if self.binary:
            size = count * np.dtype(numpy).itemsize
            part, self.at = self.data[self.at : self.at + size], self.at + size
            if len(part) < size:
                self._ends()
            return np.frombuffer(part, ">" + numpy).astype(numpy)
        words = self.data[self.at :].split(None, count)
        if len(words) < count:
            self._ends()
        self.at = len(self.data) - len(words[count]) if len(words) > count else len(self.data)
        try:
            return np.array(words[:count], dtype="f8")
        except ValueError as error:
            line = self.data.count(b"\n", 0, self.at) + 1
            raise Unreadable(f"before line {line}: no number ({str(error)[:100]})") from None

    def _ends(self) -> NoReturn:
        raise Unreadable(f"line {self.data.count(10) + 1}: the file is truncated")


def _legacy(data: bytes) -> list[Callable[[], Found]]:
    """Of a legacy VTK file with points."""

    def read() -> Found:
        file, arrays, cells, of_points, rows = _Legacy(data), {}, (0, 0), True, 0
        for key, *words in file.lines():
            word = key.upper()
            if word == "DATASET" and words[0].upper() not in ("POLYDATA", "UNSTRUCTURED_GRID"):
                raise Unreadable(f"dataset {words[0]}; allowed is POLYDATA or UNSTRUCTURED_GRID with points")
            if word in ("POINT_DATA", "CELL_DATA"):
                of_points, rows = word == "POINT_DATA", int(words[0])
            elif word == "POINTS":
                arrays["points"] = file.numbers(3 * int(words[0]), words[1]).reshape(-1, 3)
            elif word in ("VERTICES", "LINES", "POLYGONS", "TRIANGLE_STRIPS", "CELLS"):
                cells = int(words[0]), int(words[1])
                if "vtk DataFile Version 5" not in file.title[0]:
                    file.numbers(cells[1], "int")
            elif word in ("OFFSETS", "CONNECTIVITY"):
                file.numbers(cells[word == "CONNECTIVITY"], words[0])
            elif word == "CELL_TYPES":
                file.numbers(int(words[0]), "int")
            elif word in ("SCALARS", "VECTORS", "NORMALS"):
                parts = 3 if word != "SCALARS" else int(words[2]) if len(words) > 2 else 1
                if word == "SCALARS":
                    file.line()  # LOOKUP_TABLE
                values = file.numbers(parts * rows, words[1])
                arrays |= {unquote(words[0]): values.reshape(-1, parts)} if of_points else {}
            elif word == "FIELD":
                for _ in range(int(words[1])):
                    name, parts_, rows_, kind = next(file.lines(), [])
                    values = file.numbers(int(parts_) * int(rows_), kind)
                    arrays |= {unquote(name): values.reshape(-1, int(parts_))} if of_points else {}
        return _points(arrays)

    return [read]


def _xml(data: bytes) -> list[Callable[[], Found]]:
    """Of a VTK file in XML with points."""

    def read() -> Found:
        text, found, rest = data.partition(b"<AppendedData")
        try:
            root = ElementTree.fromstring(text + b"</VTKFile>" * bool(found))
        except ElementTree.ParseError as error:
            raise Unreadable(f"line {error.position[0]}: damaged or truncated XML ({error})") from None
        head, _, appended = rest.partition(b"_")
        encoded = b"base64" in head
        pieces: dict[str, list[np.ndarray]] = {}
        for piece in root.iter("Piece"):
            for array in [*piece.findall("Points/DataArray"), *piece.findall("PointData/DataArray")]:
                parts = int(array.get("NumberOfComponents") or 1)
                inside = array in piece.findall("Points/DataArray")
                kind = array.get("type", "").lower().replace("float", "f").replace("uint", "u").replace("int", "i")
                if kind in ("string", "bit"):
                    continue
                kind = f"{kind[0]}{int(kind[1:]) // 8}"
                values = _values(array, root, kind, appended, encoded)
                pieces.setdefault("points" if inside else array.get("Name", ""), []).append(values.reshape(-1, parts))
        return _points({name: np.concatenate(parts) for name, parts in pieces.items()})

    return [read]


def _values(array: Any, root: Any, kind: str, appended: bytes, encoded: bool) -> np.ndarray:
    """The numbers of a DataArray: as text, in base64, or in what is appended."""
    name, form = array.get("Name", "Points"), array.get("format", "ascii")
    try:
        if form == "ascii":
            return np.array((array.text or "").split(), dtype="f8")
        order = "<" if root.get("byte_order", "LittleEndian") == "LittleEndian" else ">"
        word = order + ("u8" if root.get("header_type") == "UInt64" else "u4")
        block = appended[int(array.get("offset", 0)) :] if form == "appended" else (array.text or "").strip().encode()
        packed = root.get("compressor", "")
        if packed not in ("", "vtkZLibDataCompressor"):
            raise Unreadable(f"compressed by {packed}; allowed is none or vtkZLibDataCompressor")
        bytes_ = _inflated(block, word, encoded or form == "binary", bool(packed))
        return np.frombuffer(bytes_, order + kind).astype(kind)
    except (ValueError, IndexError, zlib.error) as error:
        if isinstance(error, Unreadable):
            raise
        raise Unreadable(f"array {name}: damaged or truncated ({str(error)[:100]})") from None


def _inflated(block: bytes, word: str, encoded: bool, packed: bool) -> bytes:
    """The bytes of an array behind its head: their number; or if they are packed, how many parts, their size, that of
    the last one, and what each has packed."""
    size = np.dtype(word).itemsize

    def cut(first: int, count: int) -> bytes:
        """So many bytes from the one `first` on, of base64 that begins there."""
        if encoded:
            return base64.b64decode(block[first : first + -(-count // 3) * 4])[:count]
        return block[first : first + count]

    if not packed:
        count = int(np.frombuffer(cut(0, size), word)[0])
        whole = cut(0, size + count)
        if len(whole) < size + count:
            raise ValueError(f"{len(whole)} of {size + count} bytes")
        return whole[size:]
    parts = int(np.frombuffer(cut(0, size), word)[0])
    head = (3 + parts) * size
    sizes = np.frombuffer(cut(0, head), word)[3:].astype(int)
    rest, at, found = cut(-(-head // 3) * 4 if encoded else head, int(sizes.sum())), 0, []
    for count in sizes.tolist():
        found.append(zlib.decompress(rest[at : at + count]))
        at += count
    return b"".join(found)


def _binary(data: bytes) -> NoReturn:
    raise Unreadable(
        "a binary file that is no VTK; allowed is text: a binary dump of LAMMPS is turned into text by its binary2txt, "
        "a checkpoint of this program is read by Simulation.load"
    )


#: The readers by what the beginning of a file has. Each returns what makes the frames.
READERS: dict[bytes, Callable[[bytes], list[Callable[[], Found]]]] = {
    rb"\A# vtk DataFile": _legacy,
    rb"<VTKFile": _xml,
    rb"\0": _binary,
    rb"\AITEM:": _dump,
    rb"(?m)^\s*\d+\s+atoms\b": _data,
    rb"": _table,
}
