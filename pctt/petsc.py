"""What petsc4py leaves to us: the scalars of a build, the life and the errors of python contexts, warnings on all
ranks, and functions that it has no name for in every release from 3.18 on."""

from __future__ import annotations

import atexit
import ctypes
import functools
import gc
import sys
import warnings
import weakref
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from pctt.options import describe, no_such_option


def require_real_double(scalar: type = PETSc.ScalarType) -> None:
    """Raise ImportError with a clear message if this build of PETSc has other scalars."""
    if np.dtype(scalar) != np.float64:
        version = ".".join(map(str, PETSc.Sys.getVersion()))
        raise ImportError(
            f"pctt: the scalars of this PETSc {version} are {np.dtype(scalar).name}; allowed is a build with real "
            "scalars of double precision (in Debian python3-petsc4py-real; PETSC_DIR and PETSC_ARCH choose a build)"
        )


require_real_double()  # here, as every package that uses PETSc imports this module

# -- contexts: the Python objects that PETSc calls for the project's PCs and Mats of type python ---------------------

#: The methods that PETSc calls by name.
CALLED = (
    "setFromOptions", "setUp", "apply", "applyTranspose", "matApply", "mult", "multTranspose", "getDiagonal", "view",
    "scale", "shift", "zeroEntries", "diagonalScale", "norm", "duplicate", "copy",
)  # fmt: skip
_raised: list[BaseException] | None = None  # errors that contexts raised since the innermost `own_errors` began


@contextmanager
def own_errors() -> Iterator[None]:
    """Within the block, an error that our Python raises while PETSc calls it comes out as it was raised.

    petsc4py 3.18 does this by itself. Newer releases make our error the cause of a PETSc error, or lose it. If the
    garbage collector meets a dead python PC before the error is out, they print it amid others (3.25) or crash. So the
    collector is off in the block.
    """
    global _raised
    before, _raised = _raised, []
    collects = gc.isenabled()
    gc.disable()
    try:
        yield
    except PETSc.Error as error:
        first: BaseException = error
        while isinstance(first, PETSc.Error) and first.__cause__ is not None:
            first = first.__cause__
        raise _raised[0] if isinstance(first, PETSc.Error) and _raised else first from None
    finally:
        _raised = before
        if collects:
            gc.enable()


def remember(error: BaseException) -> None:
    """Keep an error until the surrounding `own_errors` ends."""
    if _raised is not None:
        _raised.append(error)


class Context:
    """The base class of contexts. It remembers the errors that methods of `CALLED` raise for `own_errors`, and leaves
    its PC or Mat before Python ends: PETSc would call it after that, and crash."""

    without: str  #: the type that the PC or Mat gets when the context leaves it

    def __init_subclass__(cls, **more: Any) -> None:
        super().__init_subclass__(**more)
        for name in CALLED:
            if name in cls.__dict__:
                setattr(cls, name, _remembering(cls.__dict__[name]))

    def create(self, owner: PETSc.Object) -> None:
        """PETSc calls this when its PC or Mat gets the context."""
        owner.decRef()  # our reference must not keep the owner alive; `destroy` gives it back
        self._owner: PETSc.Object | None = owner
        _living.add(self)
        # PETSc frees its copy of the world communicator with the last object on a rank. At the end it would make a new
        # one on such ranks, which waits for all ranks for ever. An empty Vec keeps it.
        if not _kept and owner.comm.size == PETSc.COMM_WORLD.size:
            _kept.append(PETSc.Vec().create(comm=owner.comm))

    def destroy(self, owner: PETSc.Object) -> None:
        """PETSc calls this at the end of the PC or Mat."""
        if self._owner is not None:
            self._owner.incRef()
            self._owner = None


def _remembering(method: Callable[..., Any]) -> Callable[..., Any]:
    @functools.wraps(method)
    def called(*arguments: Any) -> Any:
        try:
            return method(*arguments)
        except BaseException as error:
            remember(error)
            raise

    return called


_living: weakref.WeakSet[Context] = weakref.WeakSet()
_kept: list[PETSc.Vec] = []


@atexit.register
def _leave_all() -> None:
    """Remove the contexts from owners that still exist, for example in the traceback of an error. Then PETSc destroys
    the objects that petsc4py has released."""
    for context in list(_living):
        if context._owner is not None:
            context._owner.setType(context.without)
    gc.collect()
    PETSc.garbage_cleanup()


# -- options and warnings --------------------------------------------------------------------------------------------


def is_used(name: str) -> bool:
    """Whether anybody has asked PETSc's database for this option (``PetscOptionsUsed``; petsc4py 3.18 lacks it)."""
    flag = ctypes.c_int(0)  # at least as wide as PetscBool in any version
    _library.PetscOptionsUsed(None, name.encode(), ctypes.byref(flag))
    return flag.value != 0


def options_database(prefix: str = "") -> dict[str, str]:
    """The options in PETSc's database whose names begin with the prefix, by the rest of their names, with their values;
    "" for those without one.

    ``PETSc.Options().getAll()`` cuts a value at its blanks, and takes words of it for options. So PETSc lists those
    that nobody has asked for, and each of the others is looked up. So none counts as asked for that did not before.
    """
    every = PETSc.Options().getAll()
    if not every:
        return {}
    count, names, values = _INT(), ctypes.POINTER(ctypes.c_char_p)(), ctypes.POINTER(ctypes.c_char_p)()
    left = ctypes.byref(count), ctypes.byref(names), ctypes.byref(values)
    _library.PetscOptionsLeftGet(None, *left)
    found = {names[k].decode(): (values[k] or b"").decode() for k in range(count.value)}
    _library.PetscOptionsLeftRestore(None, *left)
    found |= {name: _looked_up(name) for name in every if name not in found and is_used(name)}
    return {name[len(prefix) :]: value for name, value in sorted(found.items()) if name.startswith(prefix)}


def _looked_up(name: str) -> str:
    """The value of an option in PETSc's database, which counts as asked for from now on; "" if it has none."""
    value, there = ctypes.c_char_p(), ctypes.c_int(0)
    _library.PetscOptionsFindPair(None, None, f"-{name}".encode(), ctypes.byref(value), ctypes.byref(there))
    return (value.value or b"").decode()


def given_options(group: type, prefix: str) -> dict[str, str]:
    """The values that the options database has for a group of options (`pctt.options`), by their names with the prefix.

    OptionError for a name with this prefix that the group does not have. PETSc looks the names up, because the options
    of mg_levels_ are also those of mg_levels_1_.
    """
    known = [line.name for line in describe(group, prefix)]
    for rest in options_database(prefix):
        if prefix + rest not in known:
            raise no_such_option(prefix + rest, known)
    return {name: _looked_up(name) for name in known if PETSc.Options().hasName(name)}


def warn(comm: MPI.Comm, words: str) -> None:
    """A warning of Python, once for all ranks; collective. If the filters make it an error, all ranks raise it."""
    raised = None
    if comm.rank == 0:
        try:
            warnings.warn(words, stacklevel=_levels_of_ours())
        except Warning as warning:
            raised = warning
    raised = comm.bcast(raised)
    if raised is not None:
        raise raised


def _levels_of_ours() -> int:
    """The ``stacklevel`` with which a warning of the caller shows the line outside of this package."""
    frame, level = sys._getframe(1), 1
    while frame.f_back is not None and frame.f_globals.get("__name__", "").partition(".")[0] == "pctt":
        frame, level = frame.f_back, level + 1
    return level


# -- functions of the library that petsc4py stands on ----------------------------------------------------------------

_library = ctypes.CDLL(PETSc.__file__)
_INT = ctypes.c_int64 if np.dtype(PETSc.IntType).itemsize == 8 else ctypes.c_int32
_SET_COORDINATES = ctypes.CFUNCTYPE(ctypes.c_int, ctypes.c_void_p, _INT, _INT, ctypes.POINTER(ctypes.c_double))


def set_failed(pc: PETSc.PC, failed: bool) -> None:
    """``PCSetFailedReason``: a KSP with this PC ends with KSP_DIVERGED_PC_FAILED, or not any more."""
    _library.PCSetFailedReason(ctypes.c_void_p(pc.handle), ctypes.c_int(-1 if failed else 0))  # PC_SETUP_ERROR


@contextmanager
def set_skip_pc(ksp: PETSc.KSP) -> Iterator[None]:
    """Within the block ``KSPSetFromOptions`` leaves the preconditioner alone (``KSPSetSkipPCSetFromOptions``)."""
    _library.KSPSetSkipPCSetFromOptions(ctypes.c_void_p(ksp.handle), ctypes.c_int(1))
    try:
        yield
    finally:
        _library.KSPSetSkipPCSetFromOptions(ctypes.c_void_p(ksp.handle), ctypes.c_int(0))


def on_coordinates(pc: PETSc.PC, take: Callable[[np.ndarray], None] | None) -> Any:
    """Let ``PCSetCoordinates`` call ``take`` with the points (n, d); None: nothing is called any more.

    The result has to live as long as ``take`` is to be called.
    """

    def called(_: Any, width: int, count: int, points: Any) -> int:
        take(np.ctypeslib.as_array(points, (count, width)).copy() if count else np.zeros((0, width)))  # type: ignore
        return 0

    function = _SET_COORDINATES(called) if take is not None else ctypes.c_void_p(None)
    _library.PetscObjectComposeFunction_Private(ctypes.c_void_p(pc.handle), b"PCSetCoordinates_C", function)
    return function


def block_values(mat: PETSc.Mat) -> np.ndarray:
    """The blocks (nb, b, b) of a sequential BAIJ Mat, transposed, in its own memory: valid while it has them."""
    size, count = mat.getBlockSize(), len(mat.getRowIJ(compressed=True)[1])
    values = ctypes.POINTER(ctypes.c_double)()
    of = ctypes.c_void_p(mat.handle)
    if count == 0 or _library.MatSeqBAIJGetArray(of, ctypes.byref(values)):
        return np.zeros((0, size, size))
    array = np.ctypeslib.as_array(values, (count, size, size))
    _library.MatSeqBAIJRestoreArray(of, ctypes.byref(values))
    return array


_MAT = ctypes.PYFUNCTYPE(ctypes.py_object, ctypes.c_void_p)
_pointer = ctypes.pythonapi.PyCapsule_GetPointer
_pointer.restype, _pointer.argtypes = ctypes.c_void_p, [ctypes.py_object, ctypes.c_char_p]
_mat_of = _MAT(_pointer(PETSc.__pyx_capi__["PyPetscMat_New"], b"PyObject *(Mat)"))
_AXPY = ctypes.CFUNCTYPE(ctypes.c_int, ctypes.c_void_p, ctypes.c_double, ctypes.c_void_p, ctypes.c_int)
_GETINFO = ctypes.CFUNCTYPE(ctypes.c_int, ctypes.c_void_p, ctypes.c_int, ctypes.POINTER(ctypes.c_double))
_MATOP_GETINFO, _MATOP_AXPY = 15, 39
_PETSC_ERR_USER = 83
_INFO = 10  # numbers of a MatInfo
_USED, _MEMORY = 2, 4  # the places of nz_used and memory among them


def on_axpy(mat: PETSc.Mat, add: Callable[[PETSc.Mat, float, PETSc.Mat], None]) -> Any:
    """Let ``MatAXPY`` call ``add(Y, factor, X)``, for which petsc4py does not ask contexts. The result has to live as
    long as the Mat has this context."""

    def called(Y: int, factor: float, X: int, structure: int) -> int:
        try:
            add(_mat_of(Y), factor, _mat_of(X))
        except Exception as error:
            remember(error)
            return _PETSC_ERR_USER
        return 0

    function = _AXPY(called)
    _library.MatSetOperation(ctypes.c_void_p(mat.handle), _MATOP_AXPY, function)
    return function


def on_getinfo(mat: PETSc.Mat, figures: Callable[[], tuple[float, float]]) -> Any:
    """Let ``MatGetInfo`` tell the numbers that are stored, and their bytes, by ``figures``; else as `on_axpy`."""

    def called(A: int, kind: int, info: Any) -> int:
        for place in range(_INFO):
            info[place] = 0.0
        info[_USED], info[_MEMORY] = figures()
        return 0

    function = _GETINFO(called)
    _library.MatSetOperation(ctypes.c_void_p(mat.handle), _MATOP_GETINFO, function)
    return function
