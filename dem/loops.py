"""Where the compiled loops of the package are asked for: at their first use, as the import of numba takes long."""

from __future__ import annotations

from functools import cache
from types import ModuleType


@cache
def loops() -> ModuleType | None:
    """The module `dem.compiled`, or None without numba, or where numba can keep nothing: then the numpy code beside
    each caller does the same, to rounding."""
    try:
        from dem import compiled
    except (ImportError, RuntimeError):
        return None
    return compiled
