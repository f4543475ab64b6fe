"""A settled mixer of size 2N from copies of the settled one of size N, which falling would take hours:

    run/study enlarge N
    RANKS=1 run/settle mixer 2N

The first command writes an unfinished settling in ~/.cache/pctt, and the second one goes on there. The copies leave
holes where their paddles were, and there is air between the layers: `LANDING` of the scene's settling time is left.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from mpi4py import MPI

from dem.arrays import Floats
from dem.impulses import ImpulseMemory
from dem.scenes import Mixer
from dem.start import new_world
from pctt.run import state
from pctt.run.settings import Settings

LANDING = 1.75  # s: the layers land within .6 s, the bed comes to rest, the last tenth of the settling is accurate


def copies(bed: Floats, radius: float, width: float) -> Floats:
    """Places of copies of a bed (n, 3) in a box of this width, two by two side by side, in three layers."""
    height = bed[:, 2].max() - bed[:, 2].min() + 2 * radius
    x, y, z = np.meshgrid([-0.5, 0.5], [-0.5, 0.5], [0.0, 1.0, 2.0], indexing="ij")
    shift = np.stack([x.ravel() * width, y.ravel() * width, z.ravel() * height], axis=1)
    return (bed + shift[:, None, :]).reshape(-1, 3)


def fits(places: Floats, scene: Mixer) -> np.ndarray:
    """Mask of the places (n, 3) at which a sphere touches neither the walls nor the paddle of a scene."""
    r = scene.radius
    within = (np.abs(places[:, :2]) < scene.width / 2 - r).all(axis=1)
    half = np.array([scene.paddle_length, scene.paddle_thickness]) * scene.width / 2 + r
    top = scene.clearance + scene.paddle_height * scene.width + r
    in_paddle = (np.abs(places[:, :2]) < half).all(axis=1) & (places[:, 2] < top)
    return within & ~in_paddle


def spread(places: Floats, spheres: int, scene: Mixer) -> Floats:
    """As many places as there are spheres, the lowest; ValueError if there are too few."""
    if len(places) < spheres:
        raise ValueError(f"the copies leave {len(places)} places for {spheres} spheres")
    return places[np.argsort(places[:, 2])[:spheres]]


def main(n: int) -> None:
    small = Mixer(n=n)
    settled = _cached(small)[0]
    if not settled.exists():
        raise FileNotFoundError(f"no settled mixer of size {n} in {settled.parent}: run/settle mixer {n} makes it")
    with h5py.File(settled) as file:
        bed = file["grains/position"][:]
    large = Mixer(n=2 * n)
    path, made_with, settings = _cached(large)
    places = copies(bed, small.radius, small.width)
    places = spread(places[fits(places, large)], (4 * n + 1) ** 3, large)
    world = new_world(large.build(), MPI.COMM_SELF)
    world.grains.position[:] = places
    # at time zero the paddle is where `fits` has it
    world.step = state.settling_steps(large, settings) - round(LANDING / settings.dt)
    state.save(state.unfinished(path), made_with, world, ImpulseMemory(MPI.COMM_SELF))
    print(f"{state.unfinished(path)}: {len(places)} spheres, of copies of {settled}")


def _cached(scene: Mixer) -> tuple[Path, dict[str, Any], Settings]:
    """The file in which `run/settle` keeps the settled state of a scene, what it is made with, and how."""
    settings = Settings().of(scene)
    made_with = state.origin(scene, scene.build(), settings.dt)
    return state.settled_path(scene, settings, made_with), made_with, settings


if __name__ == "__main__":
    if len(sys.argv) != 2 or not sys.argv[1].isdigit() or int(sys.argv[1]) < 1:
        sys.exit("run/study enlarge N: N is the size of a settled mixer, a whole number >= 1")
    main(int(sys.argv[1]))
