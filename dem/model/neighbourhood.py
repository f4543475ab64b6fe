"""The bodies that a rank's contacts can involve: its own grains, ghosts of other ranks' grains, large bodies.

A contact belongs to the rank of the lower global body index: ghosts only travel from higher to lower ranks.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from dem import bodies
from dem.arrays import Bools, Floats, Ints
from dem.bodies import Bodies
from dem.compiled import inlined, loop
from dem.contact_map.halo import Halo
from dem.exchange import exchange

if TYPE_CHECKING:
    from dem.model.world import World

#: Columns of bodies that steps change, and their parts of a message.
MOVING = {"position": slice(3), "quaternion": slice(3, 7), "velocity": slice(7, 13)}


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
    rank, row = seen_by(grains.position, radius, world.cell.image_vectors, boxes[: comm.rank]).any(axis=1).nonzero()
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
    columns = {
        name: np.concatenate([getattr(world.grains, name), ghosts[:, part], getattr(world.large, name)])
        for name, part in MOVING.items()
    }
    table = Bodies(**(vars(near.bodies) | columns))
    return Neighbourhood(table, np.concatenate([margin, ghosts[:, 13]]), near.index, grains, near.ghosts)


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


@loop
def seen_by(position: Floats, radius: Floats, ways: Floats, boxes: Floats) -> Bools:
    """Whether balls (n,), moved by these ways (w, 3), touch a box of a rank (ranks, w, n); boxes (ranks, k, 2, 3)."""
    out = np.zeros((len(boxes), len(ways), len(radius)), np.bool_)
    for rank in range(len(boxes)):
        low, high = np.empty(3), np.empty(3)  # about all of them
        low[:], high[:] = np.inf, -np.inf
        for box in boxes[rank]:
            for k in range(3):
                low[k], high[k] = min(low[k], box[0, k]), max(high[k], box[1, k])
        for w in range(len(ways)):
            for n in range(len(radius)):
                x, y, z = position[n, 0] + ways[w, 0], position[n, 1] + ways[w, 1], position[n, 2] + ways[w, 2]
                if _outside(x, y, z, low, high) <= radius[n]:
                    for box in boxes[rank]:
                        if _outside(x, y, z, box[0], box[1]) <= radius[n]:
                            out[rank, w, n] = True
                            break
    return out


@inlined
def _outside(x, y, z, low, high):
    """How far a point is from a box along the axis where that is the most; negative inside."""
    along_z = max(low[2] - z, z - high[2])
    return max(max(low[0] - x, x - high[0]), max(low[1] - y, y - high[1]), along_z)
