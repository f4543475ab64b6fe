"""Figures as JSON, which has no word for infinity and for what is no number: there it gets null."""

from __future__ import annotations

import json
import math
from typing import Any


def dumps(figures: Any, indent: int | None = None) -> str:
    """The text of figures by name, and of what they hold."""
    return json.dumps(_finite(figures), indent=indent)


def loads(line: str) -> dict[str, Any]:
    """The figures of a text; those that were no numbers are infinite. ValueError if it is no JSON."""
    return {name: math.inf if value is None else value for name, value in json.loads(line).items()}


def _finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {name: _finite(item) for name, item in value.items()}
    if isinstance(value, list):
        return [_finite(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
