"""The machine code of compiled loops on disk, as numba keeps it, with less that can go wrong. Imports numba."""

from __future__ import annotations

import warnings
from contextlib import suppress
from typing import Any

from numba.core import caching, config

with suppress(ImportError):  # where there is colorama, numba lets it end every output by an escape sequence
    from colorama import initialise

    initialise.atexit_done = True

_InTree: Any = getattr(caching, "InTreeCacheLocator", None) or caching._InTreeCacheLocator  # of older releases


class _Beside(_InTree):
    """The folder beside the source, also if this user cannot write there: in a container, say."""

    def ensure_cache_path(self) -> None:
        pass


class _InstalledFiles(caching.CompileResultCacheImpl):
    _locator_classes = [_Beside]


class _AllFiles(caching.CompileResultCacheImpl):
    _locator_classes = [*caching.CompileResultCacheImpl._locator_classes, _Beside]


class _Cache(caching.FunctionCache):
    """Damaged files are made anew, with a warning, and files that cannot be written are done without: numba itself
    would end the program."""

    _impl_class = _AllFiles

    def load_overload(self, *arguments: Any) -> Any:
        try:
            return super().load_overload(*arguments)
        except Exception as error:  # of any kind, as the files are pickles
            warnings.warn(f"machine code in {self.cache_path} is damaged ({error}), and made anew", stacklevel=2)
            with suppress(OSError):
                self.flush()
            return None

    def save_overload(self, *arguments: Any) -> None:
        with suppress(OSError):
            super().save_overload(*arguments)


class _Installed(_Cache):
    _impl_class = _InstalledFiles


class MachineCode(_Cache):
    """Machine code of a function: in NUMBA_CACHE_DIR, if that is set; else where numba can write, and what is not there
    is taken from beside the source, where an installation may have put it."""

    def __init__(self, function: Any):
        super().__init__(function)
        self._installed = None if config.CACHE_DIR else _Installed(function)

    def load_overload(self, *arguments: Any) -> Any:
        found = super().load_overload(*arguments)
        if found is None and self._installed is not None and self._installed.cache_path != self.cache_path:
            return self._installed.load_overload(*arguments)
        return found
