"""Islands: bodies that contacts or joints connect, directly or through others. In a step no impulse of one reaches
another, so each may have an accuracy of its own."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from dem import bodies
from dem.arrays import Bools, Floats, Ints
from dem.compiled import loop
from dem.contact_map.halo import Halo
from dem.exchange import exchange, on_any
from dem.model.world import World
from dem.unconstrained.constraints import slots

if TYPE_CHECKING:
    from dem.step.system import ContactSystem

ROUND = 3  #: contacts that a single sphere may have at rest


def contacts_at_rest(world: World, system: ContactSystem, passing: Floats, slow: float) -> tuple[Ints, float]:
    """Find the contacts of islands at rest: those whose kinetic energy is below ``slow`` times that which a step of
    free fall would give them, and which nothing passes faster than that.

    passing : (nc,) speeds of tools, belts and flows at the contacts [m/s]

    Returns the contacts of this rank, ascending, and the greatest part of that energy that one of its islands has. A
    single sphere is no island, and a cell that deforms connects all bodies. Collective."""
    if system.cell is not None:
        return np.zeros(0, np.intp), 0.0
    moves, root, name = _shares(world, system)
    sums, fastest = np.zeros((len(moves), 5)), np.zeros(len(moves))
    table, body = system.near.bodies, system.contact_map.body
    _add_energies(root, moves, table.mass, table.inertia, table.velocity, system.free_velocity, sums)
    _add_contacts(body, root, moves, passing, sums, fastest)
    # where no rank has a share that rests no island does, as its sums are those of its shares
    if not on_any(world.comm, bool((sums[:, 0] < slow * sums[:, 1]).any()))[0]:
        return np.zeros(0, np.intp), 0.0
    name = _names(system.contact_map.halo, root, name)
    rows = np.flatnonzero((sums[:, 2:] > 0.0).any(axis=1))
    resting, part = np.zeros(len(moves), np.bool_), _parts_at_rest(world, name[rows], sums[rows], fastest[rows], slow)
    resting[rows] = part >= 0.0
    a, b = body.T
    return np.flatnonzero(resting[root[np.where(moves[a], a, b)]]), float(part.max(initial=0.0))


def _shares(world: World, system: ContactSystem) -> tuple[Bools, Ints, Ints]:
    """Of the bodies near this rank: which move, the row that stands for this rank's share of the island of each, and a
    name for each, that joints connect by the same one."""
    near = system.near
    moves = bodies.is_dynamic(near.bodies)
    jointed = np.zeros(len(moves), np.bool_)
    if system.coupling is not None:
        jointed[slots(world, near.bodies.id)[0]] = True
    jointed &= moves
    return moves, _roots(system.contact_map.body, moves, jointed), np.where(jointed, -1, near.index)


def _parts_at_rest(world: World, name: Ints, sums: Floats, fastest: Floats, slow: float) -> Floats:
    """The part (s,) that the kinetic energy of the island of each share is of that of free fall, -1 if it does not
    rest. Every island is added up by the rank that owns its name. Collective."""
    owner = np.clip(np.searchsorted(world.slabs, name, side="right") - 1, 0, world.comm.size - 1)
    columns = {"name": name, "sums": sums, "fastest": fastest, "row": np.arange(len(name))}
    shares = exchange(world.comm, columns | {"rank": np.full(len(name), world.comm.rank)}, owner)
    names, island = np.unique(shares["name"], return_inverse=True)
    whole, most = np.zeros((len(names), 5)), np.zeros(len(names))
    np.add.at(whole, island, shares["sums"])
    np.maximum.at(most, island, shares["fastest"])
    kinetic, fall, mass, many, count = whole.T
    rests = (kinetic < slow * fall) & (0.5 * mass * most**2 <= fall) & ((many > 1.0) | (count > ROUND))
    part = np.divide(kinetic, fall, out=np.full(len(names), -1.0), where=rests)
    answer = exchange(world.comm, {"row": shares["row"], "part": part[island]}, shares["rank"])
    found = np.full(len(name), -1.0)
    found[answer["row"]] = answer["part"]
    return found


def _names(halo: Halo, root: Ints, name: Ints) -> Ints:
    """The least name (n,) that the rows connected on any ranks have; `root`: the row that stands for what is connected
    on this one. Collective."""
    while True:
        before = name.copy()
        _spread(root, name)
        if halo.comm.size == 1:
            return name
        halo.lower(name)
        halo.update(name)
        if not on_any(halo.comm, bool((name != before).any()))[0]:
            return name


@loop
def _roots(body, moves, jointed):
    """The first rows (n,) that contacts of the rows `body` (nc, 2) connect with each row, through rows that move; those
    that are jointed are connected. Union by the smaller row, with halved paths (Tarjan 1975)."""
    parent = np.arange(len(moves))
    first = -1
    for n in range(len(moves)):
        if jointed[n]:
            first = n if first < 0 else first
            parent[n] = first
    for c in range(len(body)):
        a, b = body[c, 0], body[c, 1]
        if moves[a] and moves[b]:
            while parent[a] != a:
                parent[a] = parent[parent[a]]
                a = parent[a]
            while parent[b] != b:
                parent[b] = parent[parent[b]]
                b = parent[b]
            parent[max(a, b)] = min(a, b)
    for n in range(len(moves)):  # parents come before their children
        parent[n] = parent[parent[n]]
    return parent


@loop
def _spread(root, name):
    """Give all rows of a root the least of their names."""
    for n in range(len(root)):
        name[root[n]] = min(name[root[n]], name[n])
    for n in range(len(root)):
        name[n] = name[root[n]]


@loop
def _add_energies(root, moves, mass, inertia, velocity, free, sums):
    """sums (n, 5) += kinetic energy, that of the change of the linear velocities to `free` (owned, 6), mass and number
    of the own bodies, which are the first rows, at their roots. The spin has the greatest of the moments of a body."""
    for n in range(len(free)):
        if moves[n]:
            moment, to = max(inertia[n, 0], inertia[n, 1], inertia[n, 2]), root[n]
            for i in range(3):
                turn = moment * velocity[n, 3 + i] ** 2 if velocity[n, 3 + i] != 0.0 else 0.0
                sums[to, 0] += 0.5 * (mass[n] * velocity[n, i] ** 2 + turn)
                sums[to, 1] += 0.5 * mass[n] * (free[n, i] - velocity[n, i]) ** 2
            sums[to, 2] += mass[n]
            sums[to, 3] += 1.0


@loop
def _add_contacts(body, root, moves, passing, sums, fastest):
    """Count the contacts (nc, 2) at the roots of their bodies, in the last of the sums (n, 5), and find the greatest of
    the speeds `passing` (nc,) there."""
    for c in range(len(body)):
        a, b = body[c, 0], body[c, 1]
        to = root[a] if moves[a] else root[b]
        sums[to, 4] += 1.0
        fastest[to] = max(fastest[to], passing[c])
