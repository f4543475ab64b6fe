"""Stress, fabric and solid fraction of regions."""

from __future__ import annotations

import numpy as np

from dem.arrays import Bools, Floats
from dem.bodies import SPHERE
from dem.checks import positive
from dem.compiled import loop
from dem.geometry.region import Block, Cylinder, Region, refuse_region
from dem.measures.grains import bearing, branches, ends
from dem.measures.images import images
from dem.measures.sample import Sample, measure, summed

OR = "a Block, a Cylinder, or "  #: what a region may be that is no mask


@measure
def stress(sample: Sample, region: Region | Bools, volume: float | None = None) -> Floats:
    """Return the mean contact stress (3, 3) of a region, or of the grains of a mask (n,) over a given volume [m^3]: the
    sum of force times branch over the volume [Pa]. A region counts of each branch the part within it, so neighbouring
    regions leave nothing out. ValueError for a mask without volume, and for a region with one beside its own."""
    end = ends(sample)
    if isinstance(region, (Block, Cylinder)):
        row, point, branch = branches(sample, end, *region.bounds)
        part, force = region.part(point, point + branch), end.force.take(row, axis=0)
    else:
        mask = sample.marked(region, OR)
        part, force, branch = _everywhere(sample, mask)[end.grain], end.force, end.center - end.point
    return summed(sample, (part[:, None] * force).T @ branch) / _volume(region, volume)


@measure
def kinetic_stress(sample: Sample, region: Region | Bools, volume: float | None = None) -> Floats:
    """Return the kinetic part (3, 3) of the stress: the sum of m v' v' over the volume, of the grains with their
    centres in a region, or of those of a mask; v' is the velocity beyond the mean one of these [Pa]."""
    if isinstance(region, (Block, Cylinder)):
        row, place, velocity = sample.grains_in(*region.bounds)
        inside = region.contains(place)
        mass, velocity = sample.mass[row[inside]], velocity[inside]
    else:
        rows = sample.marked(region, OR)
        mass, velocity = sample.mass[rows], sample.velocity[rows, :3]
    total = summed(sample, np.append(mass @ velocity, mass.sum()))
    beyond = velocity - total[:3] / (total[3] or 1.0)
    return summed(sample, (beyond.T * mass) @ beyond) / _volume(region, volume)


@measure
def fabric(sample: Sample, region: Region) -> Floats:
    """Return the fabric tensor (3, 3): the mean of n n over the contacts that bear force and have their points in the
    region; its trace is 1, and 0 if there are no such contacts. ValueError for a mask."""
    refuse_region("a fabric tensor", region)
    bears = np.flatnonzero(bearing(sample))
    row, step = images(sample.point[bears], sample.lattice, *region.bounds)
    inside = region.contains(sample.point[bears[row]] + step @ sample.lattice)
    normal = sample.normal[bears[row[inside]]]
    total = summed(sample, np.append((normal.T @ normal).ravel(), len(normal)))
    return total[:9].reshape(3, 3) / (total[9] or 1.0)


@measure
def solid_fraction(sample: Sample, region: Region) -> float:
    """Return the volume of the grains in a region over its volume. Spheres that the faces of a Block cut count with the
    part inside, to 1e-3 of a sphere where several faces cut it and exactly where one does; other grains, and all in a
    Cylinder, count whole if their centre is inside. ValueError for a mask."""
    refuse_region("a solid fraction", region)
    row, place, _ = sample.grains_in(*region.bounds, float(sample.size[sample.shape == SPHERE, 0].max(initial=0.0)))
    volume = sample.volume[row] * region.contains(place)
    if isinstance(region, Block):
        balls = np.flatnonzero(sample.shape[row] == SPHERE)
        volume[balls] = cut_balls(place[balls], sample.size[row[balls], 0], *region.bounds)
    return float(summed(sample, volume.sum())) / region.volume


@loop
def cut_balls(center: Floats, radius: Floats, low: Floats, high: Floats) -> Floats:
    """Volumes (n,) of balls within a box. A ball that one face cuts is a cap. Of one that several cut, columns along z
    are summed, by the midpoint rule over 64 x 64 of them."""
    cells = 64
    out = np.zeros(len(radius))
    for n in range(len(radius)):
        r, cut = radius[n], 0
        volume = 4.0 / 3.0 * np.pi * r**3
        away = False
        for k in range(3):
            for d in (center[n, k] - low[k], high[k] - center[n, k]):
                if d <= -r:
                    away = True
                elif d < r:
                    cut += 1
                    volume -= np.pi / 3.0 * (r - d) ** 2 * (2.0 * r + d)
        if away:
            continue
        if cut > 1:
            volume = 0.0
            x0, x1 = max(low[0] - center[n, 0], -r), min(high[0] - center[n, 0], r)
            y0, y1 = max(low[1] - center[n, 1], -r), min(high[1] - center[n, 1], r)
            hx, hy = (x1 - x0) / cells, (y1 - y0) / cells
            for i in range(cells):
                x = x0 + (i + 0.5) * hx
                for j in range(cells):
                    y = y0 + (j + 0.5) * hy
                    h = np.sqrt(max(r * r - x * x - y * y, 0.0))
                    column = min(high[2] - center[n, 2], h) - max(low[2] - center[n, 2], -h)
                    volume += max(column, 0.0) * hx * hy
        out[n] = volume
    return out


def _everywhere(sample: Sample, mask: Bools) -> Floats:
    """A mask (n,) of this rank's grains as numbers 0 and 1 of all grains (count,)."""
    out = np.zeros(sample.count)
    out[sample.id] = mask
    return np.asarray(summed(sample, out))


def _volume(region: Region | Bools, volume: float | None) -> float:
    """That of a region, or the one given with a mask [m^3]."""
    if isinstance(region, (Block, Cylinder)):
        if volume is not None:
            own = f"a {type(region).__name__} has its own, {region.volume:g} m^3"
            raise ValueError(f"volume {volume:g}: {own}; give none")
        return region.volume
    if volume is None:
        raise ValueError("volume: a mask of grains needs the volume over which its stress is a mean")
    return float(positive("volume", volume))
