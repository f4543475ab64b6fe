"""The bodies that a rank's contacts can involve: its own grains, ghosts of other ranks' grains, large bodies.

A contact belongs to the rank of the lower global body index: ghosts only travel from higher to lower ranks.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from dem import bodies
from dem.arrays import Floats, Ints
from dem.bodies import Bodies
from dem.contact_map.halo import Halo
from dem.exchange import exchange

if TYPE_CHECKING:
    from dem.model.world import World


@dataclass(frozen=True)
class Neighbourhood:
    """Rows: the local grains, then the ghosts in the order of global indices, then the large bodies."""

    bodies: Bodies
    margin: Floats  #: (grains + ghosts,) within which a grain is seen by others [m]
    index: Ints  #: (rows,) global body index
    grains: int  #: number of local grains
    ghosts: int  #: number of ghosts


def neighbourhood(world: World, margin: Floats) -> Neighbourhood:
    """Return all bodies whose margin may meet the margin of a local grain; `margin` (grains,) [m] of the local grains;
    collective.

    FloatingPointError, on all ranks, if a position or margin is not finite.
    """
    comm, grains = world.comm, world.grains
    radius = bodies.bounding_radius(grains) + margin
    own = chunk_boxes(grains.position, radius, 8)  # enough to tell a piece of the curve from its bounding box
    boxes = np.empty((comm.size, *own.shape))
    comm.Allgather(own, boxes)
    if np.isnan(boxes).any():
        raise FloatingPointError(
            f"a grain has no finite position or velocity at step {world.step} (time {world.time:g} s), or its square "
            "overflows"
        )
    mine, large = world.slabs[comm.rank] + np.arange(len(grains)), world.slabs[-1] + np.arange(len(world.large))
    columns = dict(grains.columns(), margin=margin, index=mine)
    seen = [touched(grains.position + vector, radius, boxes[: comm.rank]) for vector in world.cell.image_vectors]
    row, rank = np.concatenate(seen, axis=1)
    rank, row = np.divmod(np.unique(rank * len(grains) + row), max(len(grains), 1))
    ghosts = exchange(comm, {name: column[row] for name, column in columns.items()}, rank)
    index, ghost_margin = ghosts.pop("index"), ghosts.pop("margin")
    return Neighbourhood(
        bodies=bodies.concatenate([grains, Bodies(**ghosts), world.large]),
        margin=np.concatenate([margin, ghost_margin]),
        index=np.concatenate([mine, index, large]),
        grains=len(grains),
        ghosts=len(index),
    )


def refreshed(near: Neighbourhood, halo: Halo, world: World, margin: Floats) -> Neighbourhood:
    """Return the same bodies as they are now, with these margins (grains,) [m] of the local ones; the halo is that of
    the grains of `near`; collective."""
    grains, count = near.grains, near.grains + near.ghosts
    ghosts = np.empty((0, 14))
    if world.comm.size > 1:  # one message with all that steps change
        moved = np.empty((count, 14))
        own = world.grains.position, world.grains.quaternion, world.grains.velocity, margin[:, None]
        np.concatenate(own, axis=1, out=moved[:grains])
        halo.update(moved)
        ghosts = moved[grains:]
    columns: dict[str, Any] = {
        name: np.concatenate([getattr(world.grains, name), ghosts[:, part], getattr(world.large, name)])
        for name, part in (("position", slice(3)), ("quaternion", slice(3, 7)), ("velocity", slice(7, 13)))
    }
    return replace(near, bodies=replace(near.bodies, **columns), margin=np.concatenate([margin, ghosts[:, 13]]))


def chunk_boxes(position: Floats, radius: Floats, count: int) -> Floats:
    """Return bounding boxes (count, 2, 3) of equal pieces of a slab; empty ones reach from +inf to -inf."""
    boxes = np.empty((count, 2, 3))
    boxes[:, 0], boxes[:, 1] = np.inf, -np.inf
    if not (np.isfinite(position).all() and np.isfinite(radius).all()):
        boxes[:] = np.nan  # seen by every rank, so that all of them stop
        return boxes
    cuts = np.linspace(0, len(position), count + 1).astype(int)
    some = cuts[:-1] < cuts[1:]
    boxes[some, 0] = np.minimum.reduceat(position - radius[:, None], cuts[:-1][some], axis=0)
    boxes[some, 1] = np.maximum.reduceat(position + radius[:, None], cuts[:-1][some], axis=0)
    return boxes


def touched(position: Floats, radius: Floats, boxes: Floats) -> tuple[Ints, Ints]:
    """Return pairs (row, rank) of the balls that touch a box of a rank; boxes (ranks, k, 2, 3)."""
    rows, ranks = [np.zeros(0, np.int64)], [np.zeros(0, np.int64)]
    if len(position) and len(boxes):
        low, high = (position - radius[:, None]).min(axis=0), (position + radius[:, None]).max(axis=0)
        meets = ((boxes[:, :, 0] <= high) & (boxes[:, :, 1] >= low)).all(axis=2)
        for rank in np.flatnonzero(meets.any(axis=1)):
            near = boxes[rank, meets[rank]]
            outside = np.maximum(near[:, 0] - position[:, None], position[:, None] - near[:, 1]).max(axis=2)
            row = np.flatnonzero((outside <= radius[:, None]).any(axis=1))
            rows.append(row)
            ranks.append(np.full(len(row), rank))
    return np.concatenate(rows), np.concatenate(ranks)
