"""Coarse-grained fields on a grid."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from dem.arrays import Floats
from dem.checks import counts, positive
from dem.compiled import loop
from dem.geometry.region import Block, refuse_region
from dem.measures.grains import branches, ends
from dem.measures.sample import Sample, measure, summed

#: The functions W of `fields`.
KERNELS = ("gauss", "lucy")
CUT = 3.0  #: standard deviations at which "gauss" ends


class Fields(NamedTuple):
    """Fields at the middles of the cells of a grid from `low` with the distances `spacing` (3,) [m]."""

    low: Floats
    spacing: Floats
    density: Floats  #: (nx, ny, nz) [kg/m^3]
    momentum: Floats  #: (nx, ny, nz, 3) [kg/(m^2 s)]
    velocity: Floats  #: (nx, ny, nz, 3) momentum over density, 0 where there is none [m/s]
    stress: Floats  #: (nx, ny, nz, 3, 3) of contacts [Pa]
    kinetic_stress: Floats  #: (nx, ny, nz, 3, 3) [Pa]


@measure
def fields(sample: Sample, region: Block, cells: Sequence[int], width: float, kernel: str = "lucy") -> Fields:
    """Return coarse-grained fields on a grid of so many `cells` (3,) in the region.

    `width` [m]: of the kernel "lucy" its range; of "gauss" the standard deviation, and it is cut at three of these
    and normalised. The integral of a contact's force along its branch takes three Gauss points on every branch.
    Source: Goldhirsch (2010), Granular Matter 12, 239-252; Weinhart et al. (2012), Granular Matter 14, 289-294.
    ValueError for another region, a bad kernel, width or number of cells."""
    refuse_region("fields", region, Block)
    positive("width of the kernel", width)
    if kernel not in KERNELS:
        raise ValueError(f"kernel {kernel!r}: allowed is one of {', '.join(KERNELS)}")
    (low, high), shape, gauss = region.bounds, counts("cells", cells), kernel == "gauss"
    spacing, reach = (high - low) / shape, float(width) * (CUT if gauss else 1.0)
    grid = low, spacing, shape, float(width), gauss
    row, place, v = sample.grains_in(low, high, reach)
    mass = sample.mass[row, None]
    flow = mass[:, :, None] * v[:, :, None] * v[:, None, :]
    grains = deposited(place, np.concatenate([mass, mass * v, flow.reshape(-1, 9)], axis=1), *grid)
    end = ends(sample)
    row, point, branch = branches(sample, end, low, high, reach)
    moment = (end.force[row, :, None] * branch[:, None, :]).reshape(-1, 9)
    nodes, weights = np.polynomial.legendre.leggauss(3)
    contact = np.zeros((*shape, 9))
    for node, weight in zip(nodes, weights):  # of the interval from -1 to 1
        contact += deposited(point + 0.5 * (1.0 + node) * branch, 0.5 * weight * moment, *grid)
    grains, contact = summed(sample, grains), summed(sample, contact)
    density, momentum = grains[..., 0], grains[..., 1:4]
    velocity = momentum / np.where(density > 0.0, density, 1.0)[..., None]
    kinetic = grains[..., 4:].reshape(*shape, 3, 3) - momentum[..., :, None] * velocity[..., None, :]
    return Fields(low, spacing, density, momentum, velocity, contact.reshape(*shape, 3, 3), kinetic)


@loop
def deposited(point, value, low, spacing, shape, width, gauss):
    """Sums (nx, ny, nz, k) over points (m, 3) of their values (m, k) times the kernel at the middles of the cells."""
    out = np.zeros((shape[0], shape[1], shape[2], value.shape[1]))
    reach = CUT * width if gauss else width
    if gauss:  # erf(3 / sqrt 2) - sqrt(2 / pi) 3 exp(-9 / 2) of the Gaussian is within the cut
        scale = 1.0 / (0.9707091134651118 * (2.0 * np.pi) ** 1.5 * width**3)
    else:
        scale = 105.0 / (16.0 * np.pi * width**3)
    first, last = np.zeros(3, np.int64), np.zeros(3, np.int64)
    for n in range(len(point)):
        for k in range(3):
            place = (point[n, k] - low[k]) / spacing[k] - 0.5
            first[k] = max(int(np.ceil(place - reach / spacing[k])), 0)
            last[k] = min(int(np.floor(place + reach / spacing[k])), shape[k] - 1)
        for i in range(first[0], last[0] + 1):
            x = low[0] + (i + 0.5) * spacing[0] - point[n, 0]
            for j in range(first[1], last[1] + 1):
                y = low[1] + (j + 0.5) * spacing[1] - point[n, 1]
                for l in range(first[2], last[2] + 1):  # noqa: E741
                    z = low[2] + (l + 0.5) * spacing[2] - point[n, 2]
                    q = np.sqrt(x * x + y * y + z * z) / width
                    if q * width >= reach:
                        continue
                    w = scale * (np.exp(-0.5 * q * q) if gauss else (1.0 + 3.0 * q) * (1.0 - q) ** 3)
                    for c in range(value.shape[1]):
                        out[i, j, l, c] += w * value[n, c]
    return out
