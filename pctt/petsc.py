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


@contextmanager
def own_errors() -> Iterator[None]:
    """Have what our Python raises when PETSc calls it come out as it was raised. petsc4py does so up to 3.18; newer
    releases make it the cause of an error of PETSc, and forget it where a dead python PC is collected on the way."""
    collects = gc.isenabled()
    gc.disable()
    try:
        yield
    except PETSc.Error as error:
        raise origin(error) from None
    finally:
        if collects:
            gc.enable()


def origin(error: BaseException) -> BaseException:
    """What first went wrong: the Python error behind one of PETSc, if there is one."""
    while isinstance(error, PETSc.Error) and error.__cause__ is not None:
        error = error.__cause__
    return error
