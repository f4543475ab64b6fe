"""Common parts of the programs that show the output folder of a run: command lines, errors, ranks."""

from __future__ import annotations

import argparse
import sys
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from mpi4py import MPI

from pctt import disk
from pctt.folder import FolderError

LIBRARIES = ("matplotlib", "vtkmodules", "PIL", "imageio_ffmpeg")
EXTRA = "the extra `pictures` has the libraries that draw: pip install -e '.[pictures]' in the project's folder"


def parser(program: str, text: str) -> argparse.ArgumentParser:
    """The parser of a command line whose first word is the folder."""
    line = argparse.ArgumentParser(
        f"python -m pctt.{program}",
        description=text,
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
        allow_abbrev=False,
        add_help=False,
    )
    line.add_argument("-help", "--help", "-h", action="help", help="print this")
    line.add_argument("folder", help="output folder of a run (-output of python -m pctt.run)")
    return line


def add_steps(line: argparse.ArgumentParser) -> None:
    """Add the options that choose some of the recorded steps."""
    line.add_argument("-first", type=int, default=0, metavar="STEP", help="first step")
    line.add_argument("-last", type=int, default=sys.maxsize, metavar="STEP", help="last step")
    line.add_argument("-every", type=positive(int), default=1, metavar="K", help="only every k-th recorded step")


def chosen(steps: list[int], arguments: argparse.Namespace) -> list[int]:
    """The steps that the options of ``add_steps`` choose; FolderError if there is none."""
    picked = [step for step in steps if arguments.first <= step <= arguments.last][:: arguments.every]
    if not picked:
        there = f"there are {steps[0]} to {steps[-1]}"
        raise FolderError(f"{arguments.folder}: no recorded step from -first to -last; {there}")
    return picked


def positive(kind: Callable[[str], float]) -> Callable[[str], float]:
    """The argparse type of an option whose value must be positive."""

    def read(text: str) -> float:
        value = kind(text)
        if not 0 < value < float("inf"):
            raise argparse.ArgumentTypeError(f"{text}: allowed is a positive number")
        return value

    read.__name__ = "positive number"
    return read


def run(main: Callable[[MPI.Comm], None], program: str) -> int:
    """Run ``main(comm)`` and return the exit status: 0, or 2 after an error that the user can repair.

    Such errors are a folder that cannot be shown and a missing library. The message is printed once. Other errors abort
    all ranks.
    """
    comm = MPI.COMM_WORLD
    try:
        main(comm)
    except FolderError as error:
        print(f"pctt.{program}: {error}", file=sys.stderr, flush=True)
        if comm.size > 1:  # the error may be on this rank only
            comm.Abort(2)
        return 2
    except ImportError as error:
        if (error.name or "").partition(".")[0] not in LIBRARIES:
            raise
        if comm.rank == 0:
            print(f"pctt.{program}: {error}; {EXTRA}", file=sys.stderr)
        return 2
    except Exception:
        if comm.size == 1:
            raise
        traceback.print_exc()
        sys.stderr.flush()
        comm.Abort(1)  # the other ranks may wait for this one
    return 0


def made_folder(path: Path) -> Path:
    """Make the folder if it does not exist, and return it; FolderError if this is not possible."""
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise FolderError(f"{path}: cannot write there ({error.strerror})") from None
    return path


@contextmanager
def whole(path: Path) -> Iterator[Path]:
    """A temporary name for a file, which is renamed to ``path`` when the block ends.

    FolderError if the file cannot be written.
    """
    try:
        with disk.whole(path) as temporary:
            yield temporary
    except OSError as error:
        raise FolderError(f"{path}: cannot write ({error.strerror or error})") from None
