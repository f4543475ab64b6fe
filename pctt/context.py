"""Python that PETSc calls: what the contexts of the project's PCs and Mats of type python share.

petsc4py leaves three things to them: a context that is alive when Python ends is called after that end (a crash), an
error that a context raises may lose its words on the way out, and the last collection of garbage waits for ever where
one rank has no object of PETSc left and another has.
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

#: What PETSc calls by name.
CALLED = ("setFromOptions", "setUp", "apply", "applyTranspose", "mult", "multTranspose", "getDiagonal", "view")


class Context:
    """Base class; what a subclass raises in a method of `CALLED` is remembered for `pctt.petsc.own_errors`."""

    without: str  # the type of PC or Mat that goes on where the context leaves

    def __init_subclass__(cls, **more: Any) -> None:
        super().__init_subclass__(**more)
        for name in CALLED:
            if name in cls.__dict__:
                setattr(cls, name, _remembering(cls.__dict__[name]))

    def create(self, owner: PETSc.Object) -> None:
        """PETSc's call where the context comes to its PC or Mat."""
        owner.decRef()  # a reference that does not keep the owner alive; `destroy` gives it back
        self._owner: PETSc.Object | None = owner
        _living.add(self)
        _keep_communicator(owner)

    def destroy(self, owner: PETSc.Object) -> None:
        """PETSc's call at the end of the PC or Mat."""
        if self._owner is not None:
            self._owner.incRef()
            self._owner = None

    def leave(self) -> None:
        """Have the owner go on without this context."""
        if self._owner is not None:
            self._owner.setType(self.without)


def _remembering(method: Callable[..., Any]) -> Callable[..., Any]:
    @functools.wraps(method)
    def called(*arguments: Any) -> Any:
        try:
            return method(*arguments)
        except BaseException as error:
            remember(error)
            gc.collect()  # not on the error's way through PETSc, where a dead context cannot be destroyed
            raise

    return called


_living: weakref.WeakSet[Context] = weakref.WeakSet()
_kept: list[PETSc.Vec] = []


def _keep_communicator(owner: PETSc.Object) -> None:
    """Have PETSc's own copy of the world's communicator stay: at Python's end PETSc would make a new one, with all
    ranks, on those where it has gone with the last object."""
    if not _kept and owner.comm.size == PETSc.COMM_WORLD.size:
        _kept.append(PETSc.Vec().create(comm=owner.comm))  # never set up: no memory, no message


@atexit.register
def _leave_all() -> None:
    """Take the contexts out of owners that are still there, say in the traceback of an error, and let PETSc destroy
    what petsc4py has let go of."""
    for living in list(_living):
        living.leave()
    gc.collect()
    PETSc.garbage_cleanup()
