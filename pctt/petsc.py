"""Differences between builds and releases of PETSc: the scalars, and the way in which errors return to Python."""

from __future__ import annotations

import gc
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
from petsc4py import PETSc


def require_real_double(scalar: type = PETSc.ScalarType) -> None:
    """Raise ImportError with a clear message if this build of PETSc has other scalars."""
    if np.dtype(scalar) != np.float64:
        version = ".".join(map(str, PETSc.Sys.getVersion()))
        raise ImportError(
            f"pctt: the scalars of this PETSc {version} are {np.dtype(scalar).name}; allowed is a build with real "
            "scalars of double precision (in Debian python3-petsc4py-real; PETSC_DIR and PETSC_ARCH choose a build)"
        )


require_real_double()  # here, as every package that uses PETSc imports this module

_raised: list[BaseException] | None = None  # errors that contexts raised since the innermost `own_errors` began


@contextmanager
def own_errors() -> Iterator[None]:
    """Within the block, an error that our Python raises while PETSc calls it comes out as it was raised.

    petsc4py does this up to 3.18. Newer releases make our error the cause of a PETSc error, or lose it. They also crash
    if the garbage collector meets a dead python PC before the error is out. So the collector is off in the block.
    """
    global _raised
    before, _raised = _raised, []
    collects = gc.isenabled()
    gc.disable()
    try:
        yield
    except PETSc.Error as error:
        first = origin(error)
        raise _raised[0] if isinstance(first, PETSc.Error) and _raised else first from None
    finally:
        _raised = before
        if collects:
            gc.enable()


def remember(error: BaseException) -> None:
    """Keep an error until the surrounding `own_errors` ends."""
    if _raised is not None:
        _raised.append(error)


def origin(error: BaseException) -> BaseException:
    """The first error of a chain: the Python error that caused a PETSc error, or ``error`` itself."""
    while isinstance(error, PETSc.Error) and error.__cause__ is not None:
        error = error.__cause__
    return error
