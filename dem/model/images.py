"""Bodies in the cell of the world, and the images of grains that a search sees beside them.

Positions are kept as they go on, until a grain is a quarter of a period outside of the cell: then all grains are put
back into it. So lists of pairs hold as long as without periods, and what a step does depends on the state alone.

The search knows images: grains moved by at most one period along each axis. Contacts know none: theirs are the rows of
the bodies, with the `moved` way from body b to the image that touches body a.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from dem import bodies, quaternion
from dem.arrays import Bools, Floats, Ints
from dem.exchange import greatest, on_any
from dem.model.neighbourhood import Neighbourhood, chunk_boxes, seen_by
from dem.parts.cell import Cell
from dem.shapes import Plane, placed
from dem.together import SceneError

if TYPE_CHECKING:
    from dem.model.world import World


def wrap(world: World) -> None:
    """Put all grains back into the cell if one is too far outside; collective. SceneError for large bodies that the
    cell does not allow now."""
    cell = world.cell
    if not cell.periodic:
        return
    for row, body in enumerate(world.large_bodies):
        if wrong := cell.why_refused(body.name, body.motion, body.shapes, world.large.quaternion[row]):
            raise SceneError(wrong)
    if on_any(world.comm, cell.leaves(world.grains.position))[0]:
        world.grains, world.lists = cell.inside(world.grains), None


def refuse_short(world: World, margin: Floats) -> None:
    """SceneError, on all ranks, if a grain of one of the margins (grains,) [m] could meet another grain on both sides
    of it, or itself; collective."""
    if not world.cell.periodic:
        return
    reach = float((bodies.bounding_radius(world.grains) + margin).max(initial=0.0))
    reach = greatest(world.comm, reach)
    short = np.flatnonzero(world.cell.period <= 4.0 * reach)
    if len(short):
        raise SceneError(
            f"the period of {world.cell.period[short[0]]:g} m along {'xyz'[short[0]]} is too short: grains are sought "
            f"within {reach:.4g} m of a centre, and could meet a grain and its image; take more than {4.0 * reach:.4g} "
            "m, six diameters are always enough, or a smaller dt"
        )


@dataclass(frozen=True)
class Images:
    """The images of grains and ghosts that the search of a rank must see: further ghosts, behind the others."""

    source: Ints  #: (images,) rows of the grains and ghosts in the table of the neighbourhood
    steps: Floats  #: (images, 3) periods by which they are moved
    across: Floats  #: (images,) number of sheared boundaries between them and their grains
    way: Floats  #: (images, 3) by which they are moved [m]
    base: int  #: number of grains and ghosts

    def __len__(self) -> int:
        return len(self.source)

    def now(self, cell: Cell) -> Images:
        """The same where the shear and the size of the cell have brought them."""
        return replace(self, way=cell.moved(self.steps, self.across)) if len(self) else self

    @cached_property
    def rows(self) -> Ints:
        """(n,) rows of grains, ghosts and images in the table of the neighbourhood."""
        return np.concatenate([np.arange(self.base), self.source])

    def among(self, near: Neighbourhood) -> Neighbourhood:
        """The neighbourhood with the images as further ghosts."""
        if not len(self):
            return near
        count = len(near.bodies) - self.base
        rows = np.concatenate([self.rows, self.base + np.arange(count)])
        table = near.bodies.take(rows)
        table.position[self.base : len(self.rows)] += self.way
        ghosts = near.ghosts + len(self.source)
        return Neighbourhood(table, near.margin[self.rows], near.index[rows], near.grains, ghosts)

    def place(self, row: Ints) -> tuple[Ints, Floats]:
        """The rows (nc,) in the table of the neighbourhood of those in the table with images, and by what ways (nc, 3)
        images are moved [m]."""
        last, image = len(self.rows), np.flatnonzero((row >= self.base) & (row < len(self.rows)))
        way = np.zeros((len(row), 3))
        way[image] = self.way[row[image] - self.base]
        out = np.where(row >= last, row - len(self.source), row)
        out[image] = self.source[row[image] - self.base]
        return out, way

    def boundaries(self, row: Ints) -> Floats:
        """Numbers (nc,) of sheared boundaries between bodies in rows of the table with images and the cell."""
        out, image = np.zeros(len(row)), np.flatnonzero((row >= self.base) & (row < len(self.rows)))
        out[image] = self.across[row[image] - self.base]
        return out

    def once(self, pairs: Ints, index: Ints) -> Ints:
        """The pairs (m, 2) of rows, the lower first, with this global `index` (rows,), without those that are found at
        the other side of a period too: the grain of lower index owns a contact."""
        return pairs[index[pairs[:, 0]] < index[pairs[:, 1]]] if len(self) else pairs

    def own(self, grains: int) -> Bools:
        """Mask (ghosts and images,) of the images of local grains, in a neighbourhood of so many local grains."""
        mask = np.zeros(len(self.rows) - grains, bool)
        mask[self.base - grains :] = self.source < grains
        return mask


def _boxes(world: World) -> Floats:
    """Bounding boxes (k, 2, 3) of the parts of large bodies that are no half spaces [m]."""
    found = []
    for row, body in enumerate(world.large_bodies):
        for shape in body.shapes:
            if not isinstance(shape, Plane):
                kind, center, _, size = placed(shape)
                middle = world.large.position[row] + quaternion.rotate(world.large.quaternion[row], center)
                radius = bodies.enclosing_radius(np.array([kind]), size[None])[0]
                found.append([middle - radius, middle + radius])
    return np.reshape(found, (len(found), 2, 3))


def images(world: World, near: Neighbourhood) -> Images:
    """The images of the grains and ghosts of `near`, with its margins, that may touch local grains; and those of local
    grains that may touch large bodies, which are at rest but for planes."""
    count, cell = near.grains + near.ghosts, world.cell
    if not cell.periodic:
        return Images(np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros(0), np.zeros((0, 3)), count)
    position = near.bodies.position[:count]
    radius = bodies.enclosing_radius(near.bodies.shape[:count], near.bodies.size[:count]) + near.margin
    own = chunk_boxes(position[: near.grains], radius[: near.grains], 8)
    large = _boxes(world)
    steps, across = cell.images()
    seen = seen_by(position, radius, cell.image_vectors, own[None])[0]
    if len(large):
        of_grains = position[: near.grains], radius[: near.grains]
        seen[:, : near.grains] |= seen_by(*of_grains, cell.image_vectors, large[None])[0]
    seen[0] = False  # the bodies themselves
    which, source = seen.nonzero()
    steps, across = steps[which], across[which]
    return Images(source, steps, across, cell.moved(steps, across), count)
