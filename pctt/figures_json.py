"""Figures as JSON. JSON has no infinity and no NaN, so they are written as null."""

from __future__ import annotations

import json
import math
from typing import Any


def dumps(figures: Any, indent: int | None = None) -> str:
    """The JSON text of figures: numbers, and dicts and lists of them."""
    return json.dumps(_finite(figures), indent=indent)


def loads(line: str) -> dict[str, Any]:
    """The figures of a JSON text by name; null becomes infinity. ValueError if the text is not JSON."""
    return {name: math.inf if value is None else value for name, value in json.loads(line).items()}


def _finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {name: _finite(item) for name, item in value.items()}
    if isinstance(value, list):
        return [_finite(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
