"""``python -m pctt.run``: simulate a scene, settle one, or solve a cone problem from a file."""

from __future__ import annotations

import os
import platform
import sys
import traceback
import warnings

import petsc4py

HELP, VERSION = {"-help", "--help", "-h"}, {"-version", "--version"}


def _text(word: str) -> str:
    """A word of the command line with a question mark for each byte that is not UTF-8, which PETSc cannot hold."""
    return word.encode(errors="replace").decode()


# before anything else imports PETSc; these are answered here, without PETSc's own hundred lines
try:
    petsc4py.init([_text(word) for word in sys.argv if word not in HELP | VERSION])
except RuntimeError as error:  # of PETSc, which has printed more
    code = str(error).splitlines()[0]
    where = "-options_file, PETSC_OPTIONS or .petscrc"
    sys.stderr.write(f"pctt.run: PETSc refuses {where}: no file, or a bad line ({code})\n")
    sys.exit(2)

from mpi4py import MPI
from petsc4py import PETSc

try:
    import pctt.petsc
except ImportError as error:
    sys.exit(str(error))

from dem.together import SceneError, first_differing_rank
from pctt.disk import FileError
from pctt.ksp_options import entered, mark_used, refuse_stray, taken_over
from pctt.options import OptionError
from pctt.petsc import options_database
from pctt.run.help import help_text
from pctt.run.interrupt import InterruptError, take_signals
from pctt.run.options import read_options
from pctt.run.settings import DEMO_SOLVERS
from pctt.run.simulate import NotConvergedError, simulate, solve_file


def main(comm: MPI.Comm) -> None:
    database = options_database()
    if HELP & set(sys.argv):
        text = help_text(database, _topic(sys.argv))
        if comm.rank == 0:
            answer(text)
        return
    if VERSION & set(sys.argv):
        if comm.rank == 0:
            answer(versions())
        return
    _refuse_unreadable()
    refuse_stray(sys.argv[1:])
    options = read_options(database, comm)
    users = DEMO_SOLVERS if options.demo else database
    with entered(users if options.demo else {}), taken_over(users):
        if options.run.problem:
            solve_file(options, comm)
        else:
            simulate(options, comm)


def _refuse_unreadable() -> None:
    """OptionError for what does not come to PETSc's database as it was given."""
    for word in sys.argv[1:]:
        if word != _text(word):
            raise OptionError(f"{_text(word)}: has bytes that are no text; allowed are words in UTF-8")
    if "'" in (given := os.environ.get("PETSC_OPTIONS", "")):  # PETSc would part the value at its blanks
        raise OptionError(f"PETSC_OPTIONS {given}: has a single quote; allowed are double ones about blanks")


def answer(text: str) -> None:
    """Print what was asked for; FileError if there is no room for it."""
    try:
        print(text, flush=True)
    except OSError as error:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # Python writes the rest at its end
        raise FileError(f"the answer cannot be written ({error.strerror})") from None


def _topic(words: list[str]) -> str:
    """The word behind -help, if it is no option."""
    after = words[next(i for i, word in enumerate(words) if word in HELP) + 1 :][:1]
    return after[0] if after and not after[0].startswith("-") else ""


def versions() -> str:
    """This program and what it stands on."""
    import numba  # takes half a second

    petsc = ".".join(map(str, PETSc.Sys.getVersion()))
    loops = f"numba {numba.__version__}"
    return f"pctt {pctt.__version__} (PETSc {petsc}, Python {platform.python_version()}, {loops})"


#: Exit status by what ends a run; raised on all ranks alike.
STATUS: dict[type[Exception], int] = {
    OptionError: 2, FileError: 2, SceneError: 1, NotConvergedError: 3, InterruptError: 130
}  # fmt: skip


def run() -> int:
    """Exit status: 0; 1 if a scene fails; 2 for a bad option or file; 3 if the problem of -problem is not
    solved; 130, the status of Ctrl-C in shells, if a signal has ended the run. One message says what went wrong. Other
    errors abort all ranks."""
    comm = MPI.COMM_WORLD.Dup()  # a message of a user's scene meets none of ours
    take_signals()
    try:
        if other := first_differing_rank(comm, repr((sys.argv[1:], sorted(options_database().items())))):
            raise OptionError(f"rank {other} has other options than rank 0; allowed are the same options on all ranks")
        main(comm)
    except tuple(STATUS) as error:
        status = next(status for kind, status in STATUS.items() if isinstance(error, kind))
        if comm.rank == 0:
            print(f"pctt.run: {error}", file=sys.stderr, flush=True)
        mark_used(options_database())
        return status
    except BaseException as error:
        if comm.size == 1 or isinstance(error, SystemExit):
            raise
        traceback.print_exc()
        sys.stderr.flush()
        comm.Abort(1)
    return 0


if __name__ == "__main__":
    # a line of the user's program would be one of ours here
    warnings.formatwarning = lambda message, *_: f"WARNING: {message}\n"
    sys.exit(run())
