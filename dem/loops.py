"""The compiled loops of the package, imported at their first use, as the import of numba takes long."""

from __future__ import annotations

from functools import cache
from types import ModuleType


@cache
def loops() -> ModuleType | None:
    """The module `dem.compiled`. None if numba is not there, is switched off by ``NUMBA_DISABLE_JIT=1``, or cannot keep
    its machine code on the disk; then the numpy code beside each caller gives the same, to rounding."""
    try:
        from numba import config

        from dem import compiled
    except (ImportError, RuntimeError):
        return None
    return None if config.DISABLE_JIT else compiled
