"""STL files, as text or binary, whatever program wrote them; what is damaged is refused with its place."""

from __future__ import annotations

import re

import numpy as np

from dem.arrays import Floats

HEAD, EACH = 84, 50  #: bytes of a binary file before the triangles, and of a triangle


def corners(data: bytes) -> Floats:
    """The corners (m, 3, 3) of the triangles of a file, in its unit. ValueError, which says where, for a file that is
    damaged, truncated, or none of this format."""
    count = int.from_bytes(data[80:HEAD], "little") if len(data) >= HEAD else -1
    if len(data) == HEAD + EACH * count:
        return _binary(data, count)
    text = data.removeprefix(b"\xef\xbb\xbf").lstrip()
    if text[:5].lower() == b"solid" and b"\0" not in text:
        return _text(text.decode("latin1"))
    if not data:
        raise ValueError("the file is empty")
    if count < 0 or b"\0" not in data:
        raise ValueError("it is neither an STL file of text, which begins with the word solid, nor a binary one")
    there, rest = divmod(len(data) - HEAD, EACH)
    if there < count:
        raise ValueError(f"it says that it has {count} triangles, but only {there} are there: it is truncated")
    if there > count or any(data[-rest:]):
        more = len(data) - HEAD - EACH * count
        raise ValueError(f"it says that it has {count} triangles, but {more} bytes follow them")
    return _binary(data[:-rest], count)  # padded


def _binary(data: bytes, count: int) -> Floats:
    rows = np.frombuffer(data, np.uint8, offset=HEAD).reshape(count, EACH)
    found = rows[:, 12:48].copy().view("<f4").reshape(count, 3, 3).astype(float)
    bad = np.flatnonzero(~np.isfinite(found).all(axis=(1, 2)))
    if len(bad):
        raise ValueError(f"triangle {bad[0] + 1} of {count} has a corner that is NaN or infinite")
    return found


def _text(text: str) -> Floats:
    lines = text.lower().splitlines()  # ended by CR, LF or both
    heads = [line.split(maxsplit=1)[0] if line.strip() else "" for line in lines]
    rows = [k for k, head in enumerate(heads) if head == "vertex"]
    faces = heads.count("facet")
    if "endsolid" not in heads or faces != heads.count("endfacet") or len(rows) != 3 * faces:
        raise ValueError(
            f"line {len(lines)}: it ends with {len(rows)} corners of {faces} triangles and "
            f"{heads.count('endsolid')} endsolid: it is truncated or damaged"
        )
    found = []
    for k in rows:
        words = lines[k].replace(",", ".").split()[1:]  # of a program that writes decimal commas
        if len(words) != 3 or not all(re.fullmatch(r"[-+]?(\d+\.?\d*|\.\d+)(e[-+]?\d+)?", word) for word in words):
            raise ValueError(f"line {k + 1}: {lines[k].strip()!r}: allowed are three finite numbers")
        found.append([float(word) for word in words])
    return np.array(found, float).reshape(-1, 3, 3)
