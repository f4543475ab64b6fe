"""Texts of JSON, which has no infinity and no NaN: numbers that are not finite are written as null."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from typing import Any


def written(value: Any, indent: int | None = None) -> str:
    """Return the text of numbers and arrays, and of dicts and sequences of them."""

    def text(value: Any) -> str:
        return json.dumps(value, indent=indent, allow_nan=False, default=lambda array: array.tolist())

    try:
        return text(value)
    except ValueError:  # a number is not finite
        return text(_finite(value))


def read(text: str | bytes) -> Any:
    """Return what a text says. ValueError if it is not JSON."""
    return json.loads(text)


def figures(line: str) -> dict[str, Any]:
    """Return the figures of a text by name; null becomes infinity. ValueError if the text is not JSON."""
    return {name: math.inf if value is None else value for name, value in read(line).items()}


def _finite(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {name: _finite(item) for name, item in value.items()}
    if isinstance(value, Sequence) and not isinstance(value, str):
        return [_finite(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
