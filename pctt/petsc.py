"""What differs between builds and releases of PETSc: scalars, and how errors come back."""

from __future__ import annotations

import gc
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
from petsc4py import PETSc


def require_real_double(scalar: type = PETSc.ScalarType) -> None:
    """ImportError, in words, for a build of PETSc with other scalars."""
    if np.dtype(scalar) != np.float64:
        version = ".".join(map(str, PETSc.Sys.getVersion()))
        raise ImportError(
            f"pctt: the scalars of this PETSc {version} are {np.dtype(scalar).name}; allowed is a build with real "
            "scalars of double precision (in Debian python3-petsc4py-real; PETSC_DIR and PETSC_ARCH choose a build)"
        )


_raised: list[BaseException] | None = None  # by contexts, since the innermost `own_errors` began


@contextmanager
def own_errors() -> Iterator[None]:
    """Have what our Python raises when PETSc calls it come out as it was raised. petsc4py does so up to 3.18; newer
    releases make it the cause of an error of PETSc, or forget it, or crash, where the collector meets a dead python PC
    on the way: it rests."""
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
    """Keep an error until the `own_errors` around it ends."""
    if _raised is not None:
        _raised.append(error)


def origin(error: BaseException) -> BaseException:
    """What first went wrong: the Python error behind one of PETSc, if there is one."""
    while isinstance(error, PETSc.Error) and error.__cause__ is not None:
        error = error.__cause__
    return error
