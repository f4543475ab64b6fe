"""Common parts of the programs that show the output folder of a run: command lines, errors, ranks."""

from __future__ import annotations

import argparse
import math
import sys
import traceback
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from mpi4py import MPI

from pctt.disk import FileError, naming
from pctt.folder import Folder
from pctt.options import AT_LEAST_ONE, POSITIVE, OptionError, nearest, option

LIBRARIES = ("matplotlib", "vtkmodules", "PIL", "imageio_ffmpeg")
EXTRA = "the extra `pictures` has the libraries that draw: pip install 'pctt[pictures]', in a checkout -e '.[pictures]'"

ANGLE = ("a number between -90 and 90", lambda degrees: -90 < degrees < 90)
OPACITY = ("a number from 0 to 1", lambda opacity: 0 <= opacity <= 1)
FOLDER = ("the name of a folder", bool)
PIXELS = ("a whole number from 32", lambda pixels: pixels >= 32)


@dataclass(frozen=True)
class View:
    """How a scene is shown."""

    azimuth: float = option(-60.0, "camera around the vertical, from x [degrees]")
    elevation: float = option(25.0, "camera above the horizon [degrees]", check=ANGLE)
    zoom: float = option(1.0, "1 shows the whole scene", check=POSITIVE)
    opacity: float = option(1.0, "opacity of large bodies such as blades", check=OPACITY)
    cut: bool = option(False, "leave out the grains in the half nearer to the camera")
    width: int = option(1280, "of a picture [pixels]", check=PIXELS)
    height: int = option(960, "of a picture [pixels]", check=PIXELS)
    #: colours of large bodies by their names, as matplotlib knows them, such as {"blade": "orange", "box": "none"};
    #: their alpha is the opacity, and what is not seen at all, such as "none", does not count for the camera either
    bodies: Mapping[str, Any] = field(default_factory=dict)

    def colours(self, names: Sequence[str]) -> dict[int, tuple[float, float, float, float]]:
        """The colours (red, green, blue, alpha) of `bodies` by their places in ``names``; OptionError for a name that
        is not there, and for what is no colour."""
        from matplotlib.colors import to_rgba  # imported here, because -help does not need it

        found = {}
        for name, colour in self.bodies.items():
            if name not in names:
                there = f"allowed is one of {', '.join(names) or 'none'}"
                raise OptionError(f"bodies: there is no large body {name!r}; {there}{nearest(name, names)}")
            try:
                with_alpha = isinstance(colour, tuple) and len(colour) == 2  # which matplotlib takes from 3.8 on
                found[names.index(name)] = to_rgba(*colour) if with_alpha else to_rgba(colour)
            except ValueError:
                allowed = "allowed is one that matplotlib knows, such as orange, #ff8800, #ff880080, none"
                raise OptionError(f"bodies: the colour {colour!r} of {name!r}; {allowed}") from None
        return found


def parser(program: str, text: str, folder: str = "", steps: bool = True) -> argparse.ArgumentParser:
    """The parser of a command line whose first word is the folder of a run.

    With ``folder``, the default of -output within that of the run; with ``steps``, the options that `chosen` reads.
    """
    line = argparse.ArgumentParser(
        f"python -m pctt.{program}",
        description=text,
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
        allow_abbrev=False,
        add_help=False,
    )
    line.add_argument("-help", "--help", "-h", action="help", help="print this")
    line.add_argument("folder", type=Path, help="output folder of a run (-output of python -m pctt.run)")
    target = f"folder to write to; without: {folder}/ in the folder"
    line.add_argument("-output", type=checked(str, FOLDER), metavar="DIR", help=target)
    if steps:
        line.add_argument("-first", type=int, default=0, metavar="STEP", help="first step")
        line.add_argument("-last", type=int, default=math.inf, metavar="STEP", help="last step")
        every = "one of K recorded steps"
        line.add_argument("-every", type=checked(int, AT_LEAST_ONE), default=1, metavar="K", help=every)
    return line


def checked(kind: Callable[[str], Any], check: tuple[str, Callable[[Any], bool]]) -> Callable[[str], Any]:
    """The argparse type of an option with the ``check`` of `pctt.options.option`."""

    def read(text: str) -> Any:
        try:
            value = kind(text)
        except ValueError:
            value = None
        if value is None or not check[1](value):
            raise argparse.ArgumentTypeError(f"{text}: allowed is {check[0]}")
        return value

    return read


def chosen(steps: list[int], given: argparse.Namespace) -> list[int]:
    """The steps that -first, -last and -every choose; FileError if there is none."""
    picked = [step for step in steps if given.first <= step <= given.last][:: given.every]
    if not picked:
        there = f"there are {steps[0]} to {steps[-1]}"
        raise FileError(f"{given.folder}: no recorded step from -first to -last; {there}")
    return picked


def described_steps(folder: Folder, steps: list[int]) -> str:
    """How many of the recorded steps these are, and a remark if frames of the run are missing."""
    lost = ", ".join(str(step) for step in folder.lost)
    return f"{len(steps)} of {len(folder.steps)} recorded steps{f' (missing: {lost})' if lost else ''}"


def run(main: Callable[[MPI.Comm], None], program: str) -> int:
    """Run ``main(comm)`` and return the exit status: 0, or 2 after an error that the user can repair.

    Such errors are a folder that cannot be shown and a missing library. The message is printed once. Other errors abort
    all ranks.
    """
    comm = MPI.COMM_WORLD
    try:
        main(comm)
    except (FileError, OptionError) as error:
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


def made_folder(path: str | Path) -> Path:
    """Make the folder if it does not exist, and return it; FileError if this is not possible."""
    folder = Path(path)
    with naming(folder):
        folder.mkdir(parents=True, exist_ok=True)
    return folder
