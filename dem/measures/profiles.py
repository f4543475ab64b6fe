"""Profiles, mean positions and mixing."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from dem.arrays import ArrayLike, Bools, Floats
from dem.checks import counts, unit_vector
from dem.geometry.region import Block, refuse_region
from dem.measures.sample import Sample, measure, summed


class Profile(NamedTuple):
    """Sums and means over the grains with their centres in each of the bins along an axis."""

    middle: Floats  #: (bins,) [m]
    grains: Floats  #: (bins,) their number
    mass: Floats  #: (bins,) [kg]
    velocity: Floats  #: (bins, 3) mean, weighted by mass; 0 in empty bins [m/s]


@measure
def profile(sample: Sample, axis: ArrayLike, edges: ArrayLike) -> Profile:
    """Return what is where along a direction `axis` (3,), in bins between the ascending `edges` (bins + 1,) [m].

    Along an axis with a period the edges may go on beyond the cell, with images of its grains; along other directions
    each grain counts once. ValueError for an axis that is no direction, and edges that do not ascend."""
    edge, along = np.asarray(edges, float), _direction(axis)
    if edge.ndim != 1 or len(edge) < 2 or not (np.diff(edge) >= 0.0).all():
        raise ValueError(f"edges {edges!r}: allowed are two or more numbers, none below the one before")
    own = np.abs(along) > 1.0 - 1e-12
    ends = np.where(own[:, None], np.sort(np.sum(along * own) * edge[[0, -1]]), [-np.inf, np.inf])
    repeated = replace(sample, lattice=sample.lattice * own[:, None])
    row, position, velocity = repeated.grains_in(ends[:, 0], ends[:, 1])
    place = np.searchsorted(edge, position @ along, "right") - 1
    rows = (place >= 0) & (place < len(edge) - 1)
    mass = sample.mass[row]
    columns = np.column_stack([np.ones(len(place)), mass, mass[:, None] * velocity])
    table = np.zeros((len(edge) - 1, 5))
    np.add.at(table, place[rows], columns[rows])
    table = summed(sample, table)
    velocity = table[:, 2:] / np.where(table[:, 1] > 0.0, table[:, 1], 1.0)[:, None]
    return Profile(0.5 * (edge[1:] + edge[:-1]), table[:, 0], table[:, 1], velocity)


def _direction(axis: ArrayLike) -> Floats:
    try:
        return unit_vector("axis", axis)
    except (TypeError, ValueError):
        allowed = "allowed are three numbers that are not all zero, such as (0, 0, 1)"
        raise ValueError(f"axis {axis!r}: {allowed}") from None


@measure
def mean_position(sample: Sample, mask: Bools) -> Floats:
    """Return the mean (3,) of the centres of the grains of a mask (n,) [m]; NaN if there are none."""
    mask = sample.marked(mask)
    total = summed(sample, np.append(sample.position[mask].sum(axis=0), mask.sum()))
    return total[:3] / (total[3] or np.nan)


class Mixing(NamedTuple):
    """How well the grains of a mask are mixed with the others."""

    lacey: float  #: 0: apart, 1: as by chance (Lacey 1954)
    intensity: float  #: of segregation, variance over p (1 - p); 1: apart, 0: even (Danckwerts 1952)


@measure
def mixing(sample: Sample, mask: Bools, region: Block, cells: Sequence[int]) -> Mixing:
    """Return the mixing of the grains of a mask (n,) with the others, by centres in the cells of a grid.

    With p the fraction of them among all, and s^2 the variance of the fractions in the cells, each with the weight of
    its grains: Lacey's index is (p (1 - p) - s^2) / (p (1 - p) - p (1 - p) / m) for cells of m grains on average that
    are not empty. NaN if there is one grain per cell, or, with a warning, one kind alone."""
    refuse_region("mixing", region, Block)
    shape, (low, high), mask = counts("cells", cells), region.bounds, sample.marked(mask)
    rows, position, _ = sample.grains_in(low, high)
    inside = region.contains(position)
    rows, place = rows[inside], ((position[inside] - low) / ((high - low) / shape)).astype(np.int64)
    cell = np.ravel_multi_index(tuple(np.minimum(place, shape - 1).T), tuple(shape))
    size = int(shape.prod())
    found = np.stack([np.bincount(cell, minlength=size), np.bincount(cell, mask[rows], size)])
    count, marked = summed(sample, found)
    some = count > 0
    count, fraction = count[some], marked[some] / count[some]
    total = max(count.sum(), 1.0)
    p = float(count @ fraction) / total
    apart, variance = p * (1.0 - p), float(count @ (fraction - p) ** 2) / total
    by_chance = apart * len(count) / total
    if apart <= 0.0:
        if sample.comm.rank == 0:
            few = "no" if p == 0.0 else "every"
            warnings.warn(f"mixing: the mask has {few} grain of the region, so there is no index", stacklevel=3)
        return Mixing(np.nan, np.nan)
    lacey = (apart - variance) / (apart - by_chance) if by_chance < apart else np.nan
    return Mixing(lacey, variance / apart)
