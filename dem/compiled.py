"""Loops over contacts, pairs and bodies that numba compiles. A loop passes once over the memory, numpy many times.

numba is imported, and a loop compiled, at its first call: the import takes half a second. The machine code is kept on
disk. Arrays are C-contiguous; of other types or layouts a loop would be compiled once more.
"""

from __future__ import annotations

from collections.abc import Callable
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
            return numba.njit(cache=True, **self._options)(self._function)
        except RuntimeError:  # no folder to keep the machine code in
            return numba.njit(**self._options)(self._function)


def loop(function: Function) -> Function:
    """A function that numba compiles.

    Products and sums may be fused, and a division by zero gives inf or nan as in numpy. (What else numba calls fast
    assumes that there are no NaNs.) numba compiles again only when the file of ``function`` itself changes. So a loop
    must not call a loop of another file. In its own file it calls functions that are `inlined`, or both are
    `unfused`."""
    return cast(Function, Loop(function, {"fastmath": {"contract"}}))


def inlined(function: Function) -> Function:
    """A function that is compiled as a part of each loop that calls it."""
    return cast(Function, Loop(function, {"fastmath": {"contract"}, "inline": "always"}))


def unfused(function: Function) -> Function:
    """A `loop` in which products and sums are not fused.

    If a loop calls another, the machine code on disk differs from that of the process that compiled both: there the
    compiler has seen the called loop once more. Fused differently, the first run on a machine would not have the bits
    of the later ones."""
    return cast(Function, Loop(function, {}))


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
