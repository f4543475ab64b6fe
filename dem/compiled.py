"""Loops over contacts, pairs and bodies that numba compiles. A loop passes once over the memory, numpy many times.

numba is imported, and a loop compiled, at its first call: the import takes half a second. The machine code is kept on
disk. Arrays are C-contiguous; of other types or layouts a loop would be compiled once more.
Tables that loops take are plain tuples (`named[:]`) of at most four arrays: of longer and of named ones numba finds the
type in Python, at every call. Within compiled code tuples and named tuples of any length cost nothing but the counts of
their arrays. A loop has nine parameters at most.

A loop over `prange` whose passes do not depend on each other is compiled twice, for one thread and for several
(`set_threads`). Sums are of parts of fixed length, so that they do not depend on the number of threads.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from functools import cached_property, update_wrapper
from types import FunctionType
from typing import Any, TypeVar, cast

Function = TypeVar("Function", bound=Callable[..., Any])

prange = range  #: in compiled loops that of numba: passes of the loop go to threads, where there are several
PART = 4096  #: rows of a sum's part: 100 kB of impulses, enough work for a thread

_INNER = {"no_cpython_wrapper": True}  # of what compiled loops alone call
_threads = 1
_spreading: list[Loop] = []  # the loops whose passes go to threads


def threads() -> int:
    """The number of threads that loops run on."""
    return _threads


def set_threads(count: int) -> None:
    """Let compiled loops over contacts and bodies run on so many threads of this process, 1 or more.

    Results do not depend on the number, but on whether it is 1, by rounding. ValueError for more threads than the
    process may use cores; mpiexec often binds each rank to one."""
    global _threads
    if count < 1:
        raise ValueError(f"threads {count}: allowed are whole numbers >= 1")
    if count > 1:
        import numba

        if count > (most := numba.config.NUMBA_NUM_THREADS):
            raise ValueError(
                f"threads {count}: this process may use {most} cores; give a rank more of them, for example with "
                f"mpiexec --bind-to none, or set NUMBA_NUM_THREADS={count}"
            )
        numba.set_num_threads(count)
    _threads = count
    for each in _spreading:
        each.__call__ = each._first


class Loop:
    """A function that is compiled at its first call."""

    #: What is called in its place, which Python looks up in the class, and finds here: a method would be one more call
    #: of Python each time, and loops over few rows cost what their calls cost.
    __slots__ = ("__call__", "__dict__")
    __call__: Callable[..., Any]

    def __init__(self, function: Callable[..., Any], options: dict[str, Any]):
        update_wrapper(self, function)
        self._function, self._options = function, {"error_model": "numpy", "no_cfunc_wrapper": True, **options}
        self._spreads = "prange" in function.__code__.co_names
        self.__call__ = self._first
        if self._spreads:
            _spreading.append(self)

    def _first(self, *arguments: Any) -> Any:
        """The first call, for this number of threads."""
        self.__call__ = self._on_threads if self._spreads and _threads > 1 else self.compiled
        return self.__call__(*arguments)

    @cached_property
    def compiled(self) -> Callable[..., Any]:
        """What numba makes of the function, on one thread."""
        self.compiled = self._dispatcher(self._function, self._options)  # first, as a loop that it reaches may reach it
        return self._with_all_reached(self.compiled)

    @cached_property
    def _on_threads(self) -> Callable[..., Any]:
        f = self._function
        other = FunctionType(f.__code__, f.__globals__, f.__name__, f.__defaults__, f.__closure__)
        other.__module__, other.__qualname__ = f.__module__, f.__qualname__ + "_on_threads"  # a file of its own on disk
        return self._with_all_reached(self._dispatcher(other, {**self._options, "parallel": True}))

    def _dispatcher(self, function: Callable[..., Any], options: dict[str, Any]) -> Callable[..., Any]:
        import numba

        if self._spreads:
            function.__globals__["prange"] = numba.prange
        compiled = cast(Callable[..., Any], numba.njit(**options)(function))
        if "no_cpython_wrapper" in options and hasattr(compiled, "py_func"):
            from dem.machine_code import Inner

            compiled.__class__ = Inner
        return compiled

    def _with_all_reached(self, compiled: Any) -> Any:
        """The same; the compiler knows no loop that it has not made, nor what is compiled anew if it changes."""
        from dem.machine_code import MachineCode, global_names

        function = self._function
        for space, name in global_names(function):
            if isinstance(space[name], Loop):
                space[name] = space[name].compiled
        for cell in function.__closure__ or ():
            if isinstance(cell.cell_contents, Loop):
                cell.cell_contents = cell.cell_contents.compiled
        if hasattr(compiled, "py_func"):  # not with NUMBA_DISABLE_JIT
            with suppress(RuntimeError):  # no file of its own: typed at a prompt
                compiled._cache = MachineCode(compiled)
        return compiled


def loop(function: Function) -> Function:
    """A function that numba compiles, to operations that each round as IEEE 754 says.

    So its bits are the same on all processors and after each compilation. Were products and sums fused, they would
    not be: which product is fused with a sum depends on the order in which numba visits the variables, and that changes
    from process to process. (What numba calls fast also assumes that there are no NaNs.)"""
    return cast(Function, Loop(function, {}))


def inlined(function: Function) -> Function:
    """A function that becomes a part of each loop that calls it, at the hands of LLVM: numba's own ``inline`` copies
    its tree of the function at every call, and took half of the seconds of compilation."""
    return cast(Function, Loop(function, {**_INNER, "forceinline": True}))


def inner(function: Function) -> Function:
    """A loop that other loops alone call. numba makes no wrapper for calls from Python, into which LLVM would copy the
    loop again: a loop of polyhedra is compiled in half the time. Python runs it as Python."""
    return cast(Function, Loop(function, _INNER))


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
