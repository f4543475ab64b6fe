"""Ctrl-C and other signals that end a run: all ranks finish the present step, write the checkpoint and end together.

A signal reaches the ranks at different moments, or one rank only. So each rank notes it, and after every step the ranks
tell each other. The same signal once more ends the rank at once.
"""

from __future__ import annotations

import _signal  # that of `signal` looks up names for numbers, which each step would wait for
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



class InterruptError(RuntimeError):
    """A run that was asked to end; the message says how to go on. Raised on all ranks alike."""


def catch_signals(comm: MPI.Comm) -> None:
    """From now on note signals instead of ending by them."""

    def note(number: int, frame: FrameType | None) -> None:
        signal.signal(number, signal.SIG_DFL)
        if comm.rank == 0 and not _noted:
            sys.stderr.write("\npctt.run: the run will end after this step; the same signal again ends it at once\n")
            sys.stderr.flush()
        _noted.append(number)

    for number in SIGNALS:
        ignored = number == signal.SIGHUP and signal.getsignal(number) is signal.SIG_IGN  # under nohup
        signal.signal(number, signal.SIG_IGN if ignored else note)
    signal.signal(signal.SIGPIPE, signal.SIG_DFL)  # `| head` ends it without a word; PETSc would print a page


def is_requested(comm: MPI.Comm) -> bool:
    """Whether any rank was asked to end; collective."""
    return comm.allreduce(bool(_noted), MPI.LOR)


@contextmanager
def uninterrupted() -> Iterator[None]:
    """A block, or a function, in which Ctrl-C waits until its end: files and states are whole then, and no library is
    left amid a call. For scripts and notebooks; the program notes signals by itself."""
    mine = _signal.getsignal(signal.SIGINT) is signal.default_int_handler
    if not mine or threading.current_thread() is not threading.main_thread():
        yield
        return
    asked: list[int] = []
    _signal.signal(signal.SIGINT, lambda number, frame: asked.append(number))
    try:
        yield
    finally:
        _signal.signal(signal.SIGINT, signal.default_int_handler)
    if asked:
        raise KeyboardInterrupt
