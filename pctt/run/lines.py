"""Text files with a line per step."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import chain
from pathlib import Path

from pctt import disk
from pctt.run.hdf5 import replaced, told
from pctt.run.place import Place


class StepLines:
    """A file of a run that grows by a line per step; one rank.

    Earlier lines stay up to the step ``last``. The first new line replaces the file at one stroke, with the lines that
    stay; every other new line is a single write, whatever the length of the file.
    """

    def __init__(self, place: Place, name: str, step_of: Callable[[str], int], last: int):
        self._place, self._name, self._step_of, self._last = place, name, step_of, last
        self._begun = False

    @property
    def path(self) -> Path:
        return self._place.now / self._name

    def __iter__(self) -> Iterator[str]:
        """The present lines, without those that the first new line will remove. ValueError for a line without a
        step."""
        lines = disk.lines(self.path)
        return lines if self._begun else (line for line in lines if self._step_of(line) <= self._last)

    def add(self, line: str) -> None:
        """Add a line; the first one makes the folder. FileError if it cannot be written; the earlier lines then stay as
        they are."""
        if self._begun:
            with told(self.path):
                disk.append(self.path, line)
            return
        with told(self.path):
            self.path.parent.mkdir(exist_ok=True)
        with replaced(self.path) as temporary, open(temporary, "w") as file:
            file.writelines(f"{text}\n" for text in chain(self, [line]))
        self._begun = True
