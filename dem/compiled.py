"""Loops over contacts, pairs and bodies that numba compiles. A loop passes once over the memory, numpy many times.

numba is imported, and a loop compiled, at its first call: the import takes half a second. The machine code is kept on
disk. Arrays are C-contiguous; of other types or layouts a loop would be compiled once more.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from contextlib import suppress
from functools import cached_property, update_wrapper
from typing import Any, TypeVar, cast

Function = TypeVar("Function", bound=Callable[..., Any])


class Loop:
    """A function that is compiled at its first call."""

    def __init__(self, function: Callable[..., Any], options: dict[str, Any]):
        update_wrapper(self, function)
        self._function, self._options = function, {"error_model": "numpy", **options}

    def __call__(self, *arguments: Any) -> Any:
        return self.compiled(*arguments)

    @cached_property
    def compiled(self) -> Callable[..., Any]:
        """What numba makes of the function."""
        import numba

        names = self._function.__globals__
        for name in self._function.__code__.co_names:  # the compiler knows no loop that it has not made
            if isinstance(names.get(name), Loop):
                names[name] = names[name].compiled
        try:
            compiled = numba.njit(cache=True, **self._options)(self._function)
        except RuntimeError:  # no folder to keep the machine code in
            return numba.njit(**self._options)(self._function)
        if compiled is not self._function:  # as NUMBA_DISABLE_JIT leaves it
            _mend_cache(compiled._cache)
        return compiled


def _mend_cache(cache: Any) -> None:
    """Let numba's cache of a loop make damaged files anew, with a warning, and do without files that it cannot write:
    numba itself would end the program."""
    load, save = cache.load_overload, cache.save_overload

    def load_overload(*arguments: Any) -> Any:
        try:
            return load(*arguments)
        except Exception as error:  # of any kind, as the files are pickles
            warnings.warn(f"machine code in {cache.cache_path} is damaged ({error}), and made anew", stacklevel=2)
            with suppress(OSError):
                cache.flush()
            return None

    def save_overload(*arguments: Any) -> None:
        with suppress(OSError):
            save(*arguments)

    cache.load_overload, cache.save_overload = load_overload, save_overload


def loop(function: Function) -> Function:
    """A function that numba compiles, to operations that each round as IEEE 754 says.

    So its bits are the same on all processors and after each compilation. Were products and sums fused, they would
    not be: which product is fused with a sum depends on the order in which numba visits the variables, and that changes
    from process to process. (What numba calls fast also assumes that there are no NaNs.) numba compiles again only when
    the file of ``function`` itself changes: a loop must not call a loop of another file."""
    return cast(Function, Loop(function, {}))


def inlined(function: Function) -> Function:
    """A function that is compiled as a part of each loop that calls it."""
    return cast(Function, Loop(function, {"inline": "always"}))


def tell_first_compilation(say: Callable[[str], None]) -> None:
    """Call ``say``, once, when numba compiles a loop of this program because it has no machine code for it on disk."""
    from numba.core import event

    class First(event.Listener):
        told = False

        def on_start(self, event: Any) -> None:
            if not self.told:
                self.told = True
                say("compiling loops for this processor: up to half a minute, once")

        def on_end(self, event: Any) -> None:
            pass

    event.register("numba:compile", First())
