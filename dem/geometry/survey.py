"""What a scene's grains are like as a whole: a few of them that stand for all, their mass, and where they are.

Time steps, contact distances and stiffnesses follow from it. It is found in parts of the grains, of which each rank
makes some, so no rank ever has all grains. The parts are the same on any number of ranks, and so are the figures.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np
from mpi4py import MPI

from dem import bodies
from dem.arrays import Floats, Rule
from dem.bodies import Bodies
from dem.together import together


@dataclass(frozen=True)
class Survey:
    """Of some grains."""

    count: int
    #: the thinnest, the widest over its half thickness, the heaviest over this and over its square, and those that go
    #: and turn fastest
    extremes: Bodies
    mass: float  #: sum [kg]
    radius: float  #: sum of the radii of the spheres about them [m]
    centre: Floats  #: (3,) mean of the positions [m]
    spread: Floats  #: (3, 3) sum of (x - centre) (x - centre)' [m^2]
    low: Floats  #: (3,) corner of the box about the positions [m]
    high: Floats  #: (3,) the other one [m]


def survey(
    rows: Callable[[int, int], Bodies], count: int, speed: Callable[[Bodies], Floats], comm: MPI.Comm = MPI.COMM_SELF
) -> Survey:
    """The survey of so many grains, of which `rows(a, b)` makes those from a on and before b; `speed` gives their
    speeds (n,) [m/s]. Collective. ValueError or SceneError on all ranks if rows cannot be made."""
    starts = range(0, count, Rule.CHUNK)
    mine = starts[len(starts) * comm.rank // comm.size : len(starts) * (comm.rank + 1) // comm.size]

    def look() -> list[Survey]:
        return [_of(rows(first, min(first + Rule.CHUNK, count)), speed) for first in mine]

    found = together(comm, "rows of the grains of a scene", look, own=(ValueError,))
    return _together((part for parts in comm.allgather(found) for part in parts), speed)


def _of(grains: Bodies, speed: Callable[[Bodies], Floats]) -> Survey:
    centre = grains.position.mean(axis=0)
    offset, radius = grains.position - centre, bodies.bounding_radius(grains)
    sums, place = (float(grains.mass.sum()), float(radius.sum())), grains.position
    return Survey(
        len(grains), _extremes(grains, speed), *sums, centre, offset.T @ offset, place.min(axis=0), place.max(axis=0)
    )


def _extremes(grains: Bodies, speed: Callable[[Bodies], Floats]) -> Bodies:
    radius, half = bodies.bounding_radius(grains), bodies.least_half_thickness(grains)
    with np.errstate(over="ignore", divide="ignore"):
        heavy = grains.mass / half, grains.mass / half**2
        tests = (-half, radius * (radius / half), *heavy, speed(grains), bodies.turning(grains))
    return grains.take(np.array([np.argmax(values) for values in tests]))


def _together(parts: Iterable[Survey], speed: Callable[[Bodies], Floats]) -> Survey:
    """Of the grains of all parts, which is empty without parts (Chan, Golub, LeVeque, Am. Stat. 37 (1983))."""
    none = np.full(3, np.inf)
    whole = Survey(0, bodies.none(), 0.0, 0.0, np.zeros(3), np.zeros((3, 3)), none, -none)
    for part in parts:
        count, offset = whole.count + part.count, part.centre - whole.centre
        whole = Survey(
            count,
            _extremes(bodies.concatenate([whole.extremes, part.extremes]), speed),
            whole.mass + part.mass,
            whole.radius + part.radius,
            whole.centre + part.count / count * offset,
            whole.spread + part.spread + whole.count * part.count / count * np.outer(offset, offset),
            np.minimum(whole.low, part.low),
            np.maximum(whole.high, part.high),
        )
    return whole
