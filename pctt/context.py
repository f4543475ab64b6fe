"""The base class of contexts: the Python objects that PETSc calls for the project's PCs and Mats of type python.

The class solves three problems of petsc4py:

- If a context is alive when Python ends, PETSc calls it after that end, and the program crashes.
- An error that a context raises may lose its message on its way through PETSc.
- If one rank has no PETSc object left at the end and another rank has one, the last garbage collection waits for ever.
"""

from __future__ import annotations

import atexit
import functools
import gc
import weakref
from collections.abc import Callable
from typing import Any

from petsc4py import PETSc

from pctt.petsc import remember

#: The methods that PETSc calls by name.
CALLED = (
    "setFromOptions", "setUp", "apply", "applyTranspose", "mult", "multTranspose", "getDiagonal", "view",
    "scale", "shift", "zeroEntries", "diagonalScale", "norm", "duplicate", "copy",
)


class Context:
    """Base class. If a subclass raises an error in a method of `CALLED`, the error is remembered for
    `pctt.petsc.own_errors`."""

    without: str  # the type that the PC or Mat gets when the context leaves it

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
        _keep_communicator(owner)

    def destroy(self, owner: PETSc.Object) -> None:
        """PETSc calls this at the end of the PC or Mat."""
        if self._owner is not None:
            self._owner.incRef()
            self._owner = None

    def leave(self) -> None:
        """Give the owner a type that does not need this context."""
        if self._owner is not None:
            self._owner.setType(self.without)


def _remembering(method: Callable[..., Any]) -> Callable[..., Any]:
    @functools.wraps(method)
    def called(*arguments: Any) -> Any:
        try:
            return method(*arguments)
        except BaseException as error:
            remember(error)
            gc.collect()  # now, because PETSc cannot destroy a dead context while the error passes through it
            raise

    return called


_living: weakref.WeakSet[Context] = weakref.WeakSet()
_kept: list[PETSc.Vec] = []


def _keep_communicator(owner: PETSc.Object) -> None:
    """Keep PETSc's own copy of the world communicator until Python ends.

    PETSc frees the copy with the last object on a rank. At the end it would make a new copy on such ranks, and this
    needs all ranks.
    """
    if not _kept and owner.comm.size == PETSc.COMM_WORLD.size:
        _kept.append(PETSc.Vec().create(comm=owner.comm))  # not set up, so it needs no memory and sends no message


@atexit.register
def _leave_all() -> None:
    """Remove the contexts from owners that still exist, for example in the traceback of an error.

    Then PETSc destroys the objects that petsc4py has released.
    """
    for living in list(_living):
        living.leave()
    gc.collect()
    PETSc.garbage_cleanup()
