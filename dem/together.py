"""Calls of the code of a scene, which end alike on all ranks.

The user's code runs on every rank, and may raise on some of them only. In the next collective call the other ranks
would wait for these for ever. So all ranks meet after each such call and exchange their errors. Collective functions
that the code of a scene may call itself (`dem.step.Step.total`) begin with a meeting too. So a rank in such a function
learns that another one has failed or has left the code.
"""

from __future__ import annotations

import hashlib
import math
import sys
import threading
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import lru_cache
from typing import TypeVar

import numpy as np
from mpi4py import MPI

from dem.arrays import Floats
from dem.exchange import common_error, reduced

Result = TypeVar("Result")

#: What the names of modules made of the files of scenes begin with.
SCENE_FILE = "scene_file_"


class SceneError(RuntimeError):
    """A scene that cannot go on; raised on all ranks alike."""


class Patience:
    """Says, once of each place, that this rank has waited there for others for some seconds: a call that some ranks do
    not make waits for ever. A thread looks, so that a wait costs nothing."""

    def __init__(self, seconds: float) -> None:
        self.seconds = seconds
        self._wait = ("", 0, math.inf)  # place, rank and time of the beginning
        self._thread: threading.Thread | None = None

    @contextmanager
    def waiting(self, where: str, rank: int) -> Iterator[None]:
        """A block that waits for other ranks."""
        if self._thread is None:
            self._thread = threading.Thread(target=self._look, daemon=True)
            self._thread.start()
        self._wait = where, rank, time.monotonic()
        try:
            yield
        finally:
            self._wait = "", 0, math.inf

    def _look(self) -> None:
        told = set()
        while True:
            time.sleep(0.5 * self.seconds)
            where, rank, since = self._wait
            if where not in told and time.monotonic() - since > self.seconds:
                told.add(where)
                says = f"rank {rank} has waited for {self.seconds:g} s for other ranks: {where}"
                sys.stderr.write(f"{says}. All ranks must make this call; without one it waits for ever\n")
                sys.stderr.flush()


PATIENCE = Patience(20.0)


def together(
    comm: MPI.Comm, what: str, call: Callable[[], Result], own: tuple[type[Exception], ...] = ()
) -> Result:
    """What `call` returns on this rank; collective.

    If it raised on any rank, all ranks raise: a SceneError that names `what` was called, or an exception of the types
    `own`.
    """
    failure = None
    try:
        result = call()
    except (SceneError, KeyboardInterrupt):  # the former from a meeting within the call: all ranks know
        raise
    except own as error:
        failure = (type(error), str(error))
    except BaseException as error:  # also SystemExit, which would end this rank alone
        failure = (SceneError, f"{_place(error)}{what}: {in_words(error)}")
    barrier(comm, f"the end of the {what}", failure)
    return result


def barrier(
    comm: MPI.Comm, where: str, failure: tuple[type[Exception], str] | None = None, number: float = 0.0
) -> float:
    """Wait for all ranks at a place in the code of a scene; the sum of a number over them. Raises if one has failed or
    is at another place."""
    if comm.size == 1 and failure is None:
        return number
    here = digest(where) >> 8  # 52 bits
    with PATIENCE.waiting(where, comm.rank):
        (total,), (wrong, most, least) = reduced(comm, (number,), (failure is not None, here, -here))
    if not wrong and most == -least:
        return total
    places, failures = zip(*comm.allgather((where, failure)))
    if any(failures):
        raise common_error(failures)
    listed = ", ".join(f"rank {rank} at {place}" for rank, place in enumerate(places))
    raise SceneError(f"a program must make the same calls on all ranks, but {listed}")


@lru_cache(maxsize=1024)
def digest(words: str) -> int:
    """A whole number of 60 bits that tells texts apart."""
    return int(hashlib.sha256(words.encode()).hexdigest()[:15], 16)


def first_differing_rank(comm: MPI.Comm, words: str, numbers: Sequence[Floats] = ()) -> int:
    """The first rank whose words or numbers are not those of rank 0; 0 if all are alike; collective.

    Of each array its shape and a sum with fixed weights are compared. Sums may differ by 1e-11 times the largest number
    and the root of their count, as processors of other kinds have other last bits."""
    sums, sizes = zip(*(_weighted(np.ravel(array)) for array in numbers)) if numbers else ((), ())
    here = np.array([digest(words + str([np.shape(array) for array in numbers])), *sums])
    first = comm.bcast(here)
    same = len(here) == len(first) and here[0] == first[0]
    if same:
        same = bool(np.all(np.abs(here - first)[1:] <= 1e-11 * np.array(sizes)))
    found = comm.allreduce(comm.size if same else comm.rank, MPI.MIN)
    return found % comm.size


def _weighted(numbers: Floats) -> tuple[float, float]:
    """The sum of numbers (n,) with fixed weights, and the largest number times the root of n."""
    total, most, many = 0.0, 0.0, 2**16
    for start in range(0, len(numbers), many):  # as the array may be large
        x = numbers[start : start + many].astype(float)
        place = np.arange(start + 1, start + len(x) + 1, dtype=np.uint64)
        weight = (place * np.uint64(0x9E3779B97F4A7C15)).astype(float) / 2.0**64
        total += float(weight @ np.where(np.isfinite(x), x, 0.25 * np.pi))
        most = max(most, float(np.abs(x[np.isfinite(x)]).max(initial=0.0)))
    return total, most * len(numbers) ** 0.5


def in_words(error: BaseException) -> str:
    """The kind of an exception and its words."""
    return f"{type(error).__name__}: {error}" if str(error) else type(error).__name__


def _place(error: BaseException) -> str:
    """File and line of the innermost call in the code of a scene, with a colon after them; empty if it is in none."""
    frames = [
        (frame.f_code.co_filename, line)
        for frame, line in traceback.walk_tb(error.__traceback__)
        if (name := frame.f_globals.get("__name__", "")).startswith(SCENE_FILE) or ".scenes." in name
    ]
    return f"{frames[-1][0]}, line {frames[-1][1]}: " if frames else ""
