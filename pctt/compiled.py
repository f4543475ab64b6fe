"""Loops that numba compiles, where it is installed: one pass over the memory for what numpy does in many.

A function on arrays is then written twice. With numpy it is ``compiled`` and runs everywhere. The loop of the same name
is in the module beside it (``cone_loops`` for ``cone``), which the first call imports (numba takes its time).
tests/ccp/test_loops.py compares both.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache, wraps
from importlib import import_module
from typing import Any, TypeVar

import numpy as np

Function = TypeVar("Function", bound=Callable[..., Any])


@cache
def available() -> bool:
    """Whether numba is here and works with this numpy; ``NUMBA_DISABLE_JIT=1`` says no."""
    try:
        import numba
    except ImportError:
        return False
    return not numba.config.DISABLE_JIT


def compiled(function: Function) -> Function:
    """Have the loop run in place of ``function``, where numba is available and all arrays are of float64, contiguous
    and writable: then one machine code per loop serves. All arguments are arrays or numbers, given in order."""

    @wraps(function)
    def call(*arguments: Any) -> Any:
        if available() and all(map(_fits, arguments)):
            return loop_of(function)(*(a if isinstance(a, np.ndarray) else float(a) for a in arguments))
        return function(*arguments)

    return call  # type: ignore[return-value]


def _fits(argument: Any) -> bool:
    return not isinstance(argument, np.ndarray) or (argument.dtype == np.float64 and argument.flags.carray)


@cache
def loop_of(function: Callable[..., Any]) -> Callable[..., Any]:
    return getattr(import_module(f"{function.__module__}_loops"), function.__name__)


def loop(function: Function) -> Function:
    """Compile at the first call and keep the machine code on disk.

    Products and sums may be fused, and a division by zero gives inf or nan as in numpy. What is kept is made anew when
    the file of ``function`` changes, that file alone: so a loop calls none of another file."""
    import numba

    options: dict[str, Any] = {"fastmath": {"contract"}, "error_model": "numpy"}
    try:
        return numba.njit(cache=True, **options)(function)
    except RuntimeError:  # there is no folder to keep it in
        return numba.njit(**options)(function)


def tell_first_compilation(say: Callable[[str], None]) -> None:
    """Have ``say`` told, once, when numba compiles a loop of this program rather than reading what it kept."""
    if not available():
        return
    from numba.core import event

    class First(event.Listener):
        told = False

        def on_start(self, event: Any) -> None:
            if not self.told:
                self.told = True
                say("compiling loops for this processor: some seconds, once")

        def on_end(self, event: Any) -> None:
            pass

    event.register("numba:compile", First())
