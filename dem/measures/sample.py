"""The grains and contacts that are measured."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import wraps
from typing import Any, TypeVar, cast

import numpy as np
from mpi4py import MPI

from dem.arrays import Bools, Floats, Ints
from dem.measures.images import images
from dem.shapes import volumes
from dem.together import barrier

Measure = TypeVar("Measure", bound=Callable[..., Any])


@dataclass(frozen=True, repr=False)
class Sample:
    """The grains (n) and contacts (nc) of this rank: grains as they are now, contacts as of the step that led there."""

    comm: MPI.Comm
    count: int  #: grains that there have been on all ranks; larger numbers are large bodies
    id: Ints  #: (n,) numbers in the order of the scene
    position: Floats  #: (n, 3) [m]
    velocity: Floats  #: (n, 6) [m/s, rad/s]
    mass: Floats  #: (n,) [kg]
    shape: Ints  #: (n,) kinds, as of `dem.bodies`
    size: Floats  #: (n, 3) [m]
    material: Ints  #: (n,) indices into `materials`
    materials: tuple[str, ...]
    bodies: Ints  #: (nc, 2) numbers of the two bodies of each contact
    center: Floats  #: (nc, 2, 3) their centres at the start of the step [m]
    point: Floats  #: (nc, 3) [m]
    normal: Floats  #: (nc, 3) from the first to the second
    gap: Floats  #: (nc,) [m]
    force: Floats  #: (nc, 3) on the second, mean over the step [N]
    moment: Floats | None = None  #: (nc, 3) on the second, of contacts that resist rolling or spinning [N m]
    #: (3, 3) the ways to the next images along each axis [m], and their velocities [m/s]; 0: no period
    lattice: Floats = field(default_factory=lambda: np.zeros((3, 3)))
    drift: Floats = field(default_factory=lambda: np.zeros((3, 3)))

    def __repr__(self) -> str:
        return f"<Sample of this rank: {len(self.id)} grains, {len(self.gap)} contacts>"

    def of_material(self, material: str) -> Bools:
        """Mask (n,) of the grains of a material; ValueError if there is none of that name."""
        if material not in self.materials:
            raise ValueError(f"material {material!r}: allowed is one of {', '.join(self.materials)}")
        return self.material == self.materials.index(material)

    def marked(self, mask: Any, also: str = "") -> Bools:
        """A mask of the grains as an array (n,); ValueError for anything else, as numbers would be taken for rows."""
        array = np.asarray(mask)
        if array.shape != self.mass.shape or (array.dtype != bool and len(array)):
            allowed = f"{also}True or False for each of the {len(self.mass)} grains here"
            raise ValueError(f"mask: allowed is {allowed}, got {array.shape} of {array.dtype}")
        return array.astype(bool)

    def grains_in(self, low: Floats, high: Floats, reach: float = 0.0) -> tuple[Ints, Floats, Floats]:
        """Rows (m,), positions (m, 3) and linear velocities (m, 3) of this rank's grains and their images with centres
        in the box from `low` to `high` (3,) or within `reach` of it [m]."""
        row, step = images(self.position, self.lattice, low, high, reach)
        return row, self.position[row] + step @ self.lattice, self.velocity[row, :3] + step @ self.drift

    @property
    def volume(self) -> Floats:
        """Volumes (n,) of the grains [m^3]."""
        return volumes(self.shape, self.size)


def measure(function: Measure) -> Measure:
    """A function of a sample: TypeError for anything else, such as the simulation that has it."""

    @wraps(function)
    def checked(sample: Sample, *given: Any, **named: Any) -> Any:
        if not isinstance(sample, Sample):
            allowed = "allowed is a Sample, such as sim.sample"
            raise TypeError(f"measures.{function.__name__}: {allowed}, got {type(sample).__name__}")
        return function(sample, *given, **named)

    return cast(Measure, checked)


def summed(sample: Sample, values: Any) -> Any:
    """The sum over the ranks of a number or an array."""
    barrier(sample.comm, "a measure")
    out = np.array(values)
    sample.comm.Allreduce(MPI.IN_PLACE, out)
    return out[()]
