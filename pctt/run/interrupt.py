"""Ctrl-C and other signals that end a run: all ranks finish the present step, write the checkpoint and end together.

A signal reaches the ranks at different moments, or one rank only. So each rank notes it, and after every step the ranks
tell each other. The same signal once more ends the rank at once, and so does any before the first step, when nothing
is there to be kept: it might take hours until somebody looks.
"""

from __future__ import annotations

import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

from mpi4py import MPI

#: Ctrl-C; what mpiexec and batch systems send before they kill; what mpiexec passes on without killing; a terminal that
#: goes away; the limit of processor time.
SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGUSR1, signal.SIGHUP, signal.SIGXCPU)

_noted: list[int] = []
_taken: set[int] = set()  #: the signals that the program has taken


class InterruptError(RuntimeError):
    """A run that was asked to end; the message says how to go on. Raised on all ranks alike."""


def take_signals() -> None:
    """From now on signals end this process at once, without the pages of PETSc and of Python."""
    for number in SIGNALS:
        ignored = number == signal.SIGHUP and signal.getsignal(number) is signal.SIG_IGN  # under nohup
        signal.signal(number, signal.SIG_IGN if ignored else signal.SIG_DFL)
        _taken.update(() if ignored else (number,))
    signal.signal(signal.SIGPIPE, signal.SIG_DFL)  # `| head` ends it without a word; PETSc would print a page


def note_signals(comm: MPI.Comm) -> None:
    """From now on note the signals that the program has taken, instead of ending by them: steps begin."""

    def note(number: int, frame: FrameType | None) -> None:
        signal.signal(number, signal.SIG_DFL)
        if comm.rank == 0 and not _noted:
            sys.stderr.write("\npctt.run: the run will end after this step; the same signal again ends it at once\n")
            sys.stderr.flush()
        _noted.append(number)

    for number in _taken:
        signal.signal(number, note)


def is_requested(comm: MPI.Comm) -> bool:
    """Whether any rank was asked to end; collective."""
    return comm.allreduce(bool(_noted), MPI.LOR)


@contextmanager
def uninterrupted() -> Iterator[None]:
    """A block, or a function, in which Ctrl-C waits until its end: files and states are whole then, and no library is
    left amid a call. For scripts and notebooks; the program notes signals by itself."""
    mine = signal.getsignal(signal.SIGINT) is signal.default_int_handler
    if not mine or threading.current_thread() is not threading.main_thread():
        yield
        return
    asked: list[int] = []
    signal.signal(signal.SIGINT, lambda number, frame: asked.append(number))
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    if asked:
        raise KeyboardInterrupt
