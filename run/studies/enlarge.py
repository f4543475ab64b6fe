"""A mixer of size 2N from copies of the settled one of size N, which falling would take hours: run/study enlarge N
writes the checkpoint results/mixer_n(2N).h5. The copies leave holes where their paddles were, and there is air
between the layers: go on with some fifty steps, e.g.

    .venv/bin/mpiexec -n 2 .venv/bin/python -m pctt.run -scene_n 32 -restart results/mixer_n32.h5 -steps 50
        -ccp_type apgd -ccp_tol 1e-3 -output results/n32
"""

from __future__ import annotations

import sys
from pathlib import Path

import h5py
import numpy as np
from mpi4py import MPI

from dem.arrays import Floats
from dem.impulses import ImpulseMemory
from dem.scenes import Mixer
from dem.start import new_world
from pctt.run import checkpoint


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
    small, large = Mixer(n=n), Mixer(n=2 * n)
    settled = newest(n)
    with h5py.File(settled) as file:
        bed = file["grains/position"][:]
    places = copies(bed, small.radius, small.width)
    places = spread(places[fits(places, large)], (4 * n + 1) ** 3, large)
    world = new_world(large.build(), MPI.COMM_SELF)
    world.grains.position[:] = places
    path = Path("results") / f"mixer_n{2 * n}.h5"
    path.parent.mkdir(exist_ok=True)
    made_with = checkpoint.origin("mixer", large, large.dt)
    checkpoint.save(path, made_with, world, ImpulseMemory(MPI.COMM_SELF))
    print(f"{path}: {len(places)} spheres, of copies of {settled}")


def newest(n: int) -> Path:
    """The cached settled state of the mixer of size n; FileNotFoundError if there is none."""
    cache = checkpoint.settled_path(checkpoint.scene_record("mixer", Mixer(n=n)), {}).parent
    found = sorted(cache.glob(f"mixer_n{n}_*.h5"), key=lambda path: path.stat().st_mtime)
    if not found:
        raise FileNotFoundError(f"no settled mixer of size {n} in {cache}: run/settle mixer {n} makes it")
    return found[-1]


if __name__ == "__main__":
    if len(sys.argv) != 2 or not sys.argv[1].isdigit() or int(sys.argv[1]) < 1:
        sys.exit("run/study enlarge N: N is the size of a settled mixer, a whole number >= 1")
    main(int(sys.argv[1]))
