"""Loops that numba compiles, if it is installed. A loop passes once over the memory, numpy passes many times.

A function on arrays is written twice. The numpy version has the decorator `compiled` and runs everywhere. The loop has
the same name and is in the module beside it (``cone_loops`` for ``cone``). The first call imports this module, because
the import of numba takes time. tests/ccp/test_loops.py compares both versions.
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
    """Whether numba is installed, works with this numpy, and is not switched off by ``NUMBA_DISABLE_JIT=1``."""
    try:
        import numba
    except ImportError:
        return False
    return not numba.config.DISABLE_JIT


def compiled(function: Function) -> Function:
    """Run the loop instead of ``function`` if numba is available and all arrays are contiguous and writable, and all of
    double or all of single precision.

    With this condition each loop is compiled at most twice. All arguments are arrays or numbers, and have no keywords.
    """

    @wraps(function)
    def call(*arguments: Any) -> Any:
        if available() and _fit(arguments):
            return loop_of(function)(*(a if isinstance(a, np.ndarray) else float(a) for a in arguments))
        return function(*arguments)

    return call  # type: ignore[return-value]


def _fit(arguments: tuple[Any, ...]) -> bool:
    arrays = [argument for argument in arguments if isinstance(argument, np.ndarray)]
    return {a.dtype.char for a in arrays} in ({"d"}, {"f"}) and all(a.flags.carray for a in arrays)


@cache
def loop_of(function: Callable[..., Any]) -> Callable[..., Any]:
    return getattr(import_module(f"{function.__module__}_loops"), function.__name__)


def loop(function: Function) -> Function:
    """Compile at the first call and keep the machine code on disk.

    Products and sums may be fused, and a division by zero gives inf or nan as in numpy. numba compiles again only when
    the file of ``function`` itself changes. So a loop must not call a loop of another file. In its own file it calls
    functions that are `inlined`, or both are `unfused`."""
    return _compile(function, fastmath={"contract"})


def inlined(function: Function) -> Function:
    """Compile as a part of each loop that calls it."""
    return _compile(function, fastmath={"contract"}, inline="always")


def unfused(function: Function) -> Function:
    """A `loop` in which products and sums are not fused.

    If a loop calls another, the machine code on disk differs from that of the process that compiled both: there the
    compiler has seen the called loop once more. Fused differently, the first run on a machine would not have the bits
    of the later ones."""
    return _compile(function)


def _compile(function: Function, **options: Any) -> Function:
    import numba

    options["error_model"] = "numpy"
    try:
        return numba.njit(cache=True, **options)(function)
    except RuntimeError:  # no folder to keep the machine code in
        return numba.njit(**options)(function)


def tell_first_compilation(say: Callable[[str], None]) -> None:
    """Call ``say``, once, when numba compiles a loop of this program because it has no machine code for it on disk."""
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
