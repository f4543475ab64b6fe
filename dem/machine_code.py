"""The machine code of compiled loops on disk, as numba keeps it, with less that can go wrong. Imports numba.

numba asks whether the file of a loop has changed since. But functions and constants of other files become a part of the
machine code as well. So here files are named by a hash of all that was compiled: code of another content is not found.
"""

from __future__ import annotations

import enum
import gc
import hashlib
import warnings
from collections.abc import Callable, Iterator
from contextlib import suppress
from types import CodeType, ModuleType
from typing import Any

import numpy as np
from numba.core import caching, compiler_machinery, config, event, types
from numba.core.dispatcher import Dispatcher
from numba.core.registry import CPUDispatcher

with suppress(ImportError):  # where there is colorama, numba lets it end every output by an escape sequence
    from colorama import initialise

    initialise.atexit_done = True

_InTree: Any = getattr(caching, "InTreeCacheLocator", None) or caching._InTreeCacheLocator  # of older releases


class _NoCollection(event.Listener):
    """Keeps the collector of cycles out of compilations, where it takes a seventh of the time; it collects later."""

    inner, wanted = 0, False

    def on_start(self, event: Any) -> None:
        if not self.inner:
            self.wanted = gc.isenabled()
            gc.disable()
        self.inner += 1

    def on_end(self, event: Any) -> None:
        self.inner -= 1
        if self.wanted and not self.inner:
            gc.enable()


event.register("numba:compile", _NoCollection())


def _remembered(ask: Callable[..., Any]) -> Callable[..., Any]:
    """What operators and indices of arrays and numbers return, asked once: numba tries all that it knows at each place,
    of lists and texts too, which took a seventh of the seconds of compilation."""
    known: dict[Any, Any] = {}

    def answer(self: Any, context: Any, args: Any, kws: Any) -> Any:
        plain = args and isinstance(args[0], (types.Array, types.Number, types.Boolean))
        if kws or not plain or getattr(self.typing_key, "__module__", "") != "_operator":
            return ask(self, context, args, kws)
        key = self.key, context, tuple(args)
        if key not in known:
            known[key] = ask(self, context, args, kws), self  # which knows what does it
        return known[key][0]

    return answer


compiler_machinery.pformat = repr  # numba lays out its flags for each pass of each function: a 20th of the time
types.BaseFunction.get_call_type = _remembered(types.BaseFunction.get_call_type)

_PLAIN = (int, float, complex, str, bytes, type(None), np.generic, np.dtype, enum.Enum)


class Inner(CPUDispatcher):
    """A function without a wrapper for calls from Python, which runs it as Python: the machine code that a call would
    look for is not there."""

    def __call__(self, *arguments: Any) -> Any:
        return self.py_func(*arguments)


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

    def __init__(self, compiled: Dispatcher):
        super().__init__(compiled.py_func)
        content = digest(compiled)
        name = f"{self._impl.filename_base}-{content[:16]}"  # no rank can read an older file of the same name
        self._cache_file = caching.IndexDataCacheFile(self._cache_path, name, content)

    def _index_key(self, arguments: Any, codegen: Any) -> tuple[Any, ...]:
        return arguments, codegen.magic_tuple(), *_fields(getattr(arguments, "args", arguments))

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

    def __init__(self, compiled: Dispatcher):
        super().__init__(compiled)
        self._installed = None if config.CACHE_DIR else _Installed(compiled)

    def load_overload(self, *arguments: Any) -> Any:
        found = super().load_overload(*arguments)
        if found is None and self._installed is not None and self._installed.cache_path != self.cache_path:
            return self._installed.load_overload(*arguments)
        return found


def digest(compiled: Dispatcher) -> str:
    """A hash of what becomes machine code of a function: code and options, its own and those of all compiled functions
    that it reaches, in whatever file, and the constants that they read."""
    reached, whole = [compiled], hashlib.sha256()
    for each in reached:  # which grows
        function = each.py_func
        described = [repr(sorted(each.targetoptions.items()))]
        described += [_code(code) for code in _codes(function)]
        described += [f"{name} = {_value(value, reached)}" for name, value in _constants(function)]
        described += [_value(value, reached) for value in function.__defaults__ or ()]
        whole.update("\n".join(described).encode())
    return whole.hexdigest()


def _codes(function: Callable[..., Any]) -> list[CodeType]:
    """The code of a function, and of the comprehensions and functions in it."""
    codes = [function.__code__]
    for code in codes:  # which grows
        codes += [inner for inner in code.co_consts if isinstance(inner, CodeType)]
    return codes


def global_names(function: Callable[..., Any]) -> Iterator[tuple[dict[str, Any], str]]:
    """The global names that a function may read, also as attributes of modules, each with the space that it is in."""
    names = dict.fromkeys(name for code in _codes(function) for name in code.co_names)
    spaces = [function.__globals__]
    for space in spaces:  # which grows
        for name in names:
            if name in space:
                yield space, name
                if isinstance(space[name], ModuleType) and not any(vars(space[name]) is known for known in spaces):
                    spaces.append(vars(space[name]))


def _constants(function: Callable[..., Any]) -> list[tuple[str, Any]]:
    """The values that a compiler takes for constants of a function: global ones, and those of functions around it."""
    named = [(name, space[name]) for space, name in global_names(function)]
    cells = zip(function.__code__.co_freevars, function.__closure__ or ())
    return named + [(name, cell.cell_contents) for name, cell in cells]


def _code(code: CodeType) -> str:
    values = [value for value in code.co_consts if not isinstance(value, CodeType)]
    return repr((code.co_code, code.co_names, code.co_varnames, code.co_freevars, code.co_cellvars, values))


def _value(value: Any, reached: list[Dispatcher]) -> str:
    """What is compiled of a constant; functions join those that are reached."""
    value = getattr(value, "compiled", value)  # a loop of a circle, which is closed later
    if isinstance(value, Dispatcher):
        if value not in reached:
            reached.append(value)
        return f"function {reached.index(value)}"
    if isinstance(value, tuple):
        return f"{type(value).__qualname__}({', '.join(_value(item, reached) for item in value)})"
    if isinstance(value, np.ndarray):
        return repr((value.dtype.descr, value.shape, value.strides, hashlib.sha256(value.tobytes()).hexdigest()))
    if isinstance(value, _PLAIN):
        return f"{type(value).__qualname__} {value!r}"
    if isinstance(value, type):
        members = list(value) if issubclass(value, enum.Enum) else getattr(value, "_fields", None)
        return f"{value.__module__}.{value.__qualname__} {members!r}"
    return f"{type(value).__qualname__} {getattr(value, '__name__', '')}"  # modules and functions of numpy


def _fields(arguments: Any) -> Iterator[tuple[str, ...]]:
    """The names of the fields of named tuples: numba takes two of the same name and types for one."""
    for argument in arguments:
        if isinstance(argument, types.BaseNamedTuple):
            yield argument.fields
        if isinstance(argument, types.BaseTuple):
            yield from _fields(argument)
