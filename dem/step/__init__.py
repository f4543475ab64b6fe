"""The semi-implicit step: new velocities come from the contact problem, and positions follow them.

Where impulses send bodies so far, or bodies turn so fast, that the contacts found at the start of a step do not keep
them apart, `find_overrun` and `find_turned` find the others.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np

from dem import quaternion
from dem.arrays import ArrayLike, Bools, Floats, Ints, Keys, places
from dem.bodies import BOX, CLUMP, COMPOUND, CONVEX, POLYHEDRON, SPHERE, Bodies, radius_about
from dem.compiled import loop
from dem.contact import Contacts, contact_order, exceeds_margin, find_contacts, greatest_travel, velocities_about
from dem.contact_map.loops import relative_velocities
from dem.exchange import on_any
from dem.measures import Sample
from dem.model.neighbourhood import Neighbourhood
from dem.model.world import World
from dem.shapes.forms import Form, arms
from dem.step.laws import along_normal
from dem.step.system import ContactSystem, contact_arms, gap_velocities
from dem.together import barrier
from dem.unconstrained import UnconstrainedMotion, large_velocity

#: Of two linearisations of a contact the later one replaces the other: cosine between their normals, at least, and way
#: between their points over the overlap that is let pass, at most.
ALIKE, NEAR = 0.99, 10.0
BESIDE = (0.0, 0.5j, 0.25j)  #: what keys of later linearisations have more, by how often it was tried before


@dataclass(frozen=True, repr=False)
class Step:
    """A step that was just made, with its forces, places and sums: the argument of a scene's `record`.

    `advance` was called, the grains are not yet balanced anew.
    """

    world: World  #: at the end of the step
    contacts: Contacts
    system: ContactSystem
    impulse: Floats  #: (nc, 3) of the local contacts: normal, t1, t2; with their attraction [N s]
    moment: Floats | None = None  #: (nc, 3) about normal, t1, t2, over `Resistance.length`; None without [N s]

    def __repr__(self) -> str:
        return f"<Step to {self.world.time:g} s: {len(self.impulse)} contacts of this rank>"

    def force_on(self, name: str) -> Floats:
        """Contact force and torque (6,) [N, N m] on a large body, about its reference point, averaged over the step."""
        return self.impulse_on_large[self.world.large_row(name)] / self.system.dt

    def spring_force(self, name: str) -> Floats:
        """Force (3,) of a spring on its second end, averaged over the step [N]; the first has the opposite one."""
        names = list(self.world.named["spring"])
        if name not in names:
            raise KeyError(f"no spring {name!r}; there are: {', '.join(names) or 'none'}")
        force: Floats = self.world.memory["spring"][names.index(name), :3] / self.system.dt
        return force

    @cached_property
    def constraint_impulses(self) -> Floats:
        """`ContactSystem.constraint_impulses` of this step; collective at its first use."""
        return self.system.constraint_impulses(self.impulse, self.moment)

    def position(self, name: str) -> Floats:
        """Position (3,) of a large body [m]."""
        return self.world.large.position[self.world.large_row(name)].copy()

    def velocity(self, name: str) -> Floats:
        """Linear and angular velocity (6,) of a large body [m/s, rad/s]."""
        return self.world.large.velocity[self.world.large_row(name)].copy()

    def total(self, values: ArrayLike) -> float:
        """The sum of values (grains,) over all grains; each rank passes those of its `world.grains`. Collective: the
        `record` of a scene must call it on all ranks."""
        return barrier(self.world.comm, "Step.total", number=float(np.sum(values)))

    @property
    def in_cone(self) -> Floats:
        """The impulses (nc, 3) without the attraction of contacts, which are in the friction cones [N s]."""
        attraction = self.system.attraction
        return self.impulse if attraction is None else self.impulse + along_normal(attraction)

    @cached_property
    def force(self) -> Floats:
        """Forces (nc, 3) on the second bodies in the world, averaged over the step [N]."""
        force: Floats = np.einsum("ci,cij->cj", self.impulse, self.system.frame) / self.system.dt
        return force

    @property
    def moments(self) -> Floats | None:
        """Moments (nc, 3) on the second bodies, beside those of the forces, in the world, of contacts that resist
        rolling or spinning, averaged over the step [N m]."""
        if self.moment is None or self.system.resistance is None:
            return None
        size = self.moment * self.system.resistance.length[:, None] / self.system.dt
        return np.einsum("ci,cij->cj", size, self.system.frame)

    @cached_property
    def point(self) -> Floats:
        """The points (nc, 3) of the contacts at the start of the step, in the cell that there was [m]."""
        return self.world.cell.before(self.system.dt).wrapped(self.contacts.point)

    @cached_property
    def sample(self) -> Sample:
        """This rank's grains and contacts for the functions of `dem.measures`; not collective."""
        contacts, grains, near = self.contacts, self.world.cell.inside(self.world.grains), self.contacts.near.bodies
        pair = np.stack([contacts.a, contacts.b], axis=1)
        center = near.position[pair]
        if contacts.moved is not None:
            center[:, 1] += contacts.moved
            center += (self.point - contacts.point)[:, None]
        vectors, drift = self.world.cell.lattice
        number, first, count = near.id[pair], self.world.first_large, self.world.ids
        names = ("id", "position", "velocity", "mass", "shape", "size", "material")
        return Sample(
            comm=self.world.comm,
            count=count,
            **{name: getattr(grains, name) for name in names},
            materials=self.world.materials,
            bodies=np.where(number < first, number, number - first + count),
            center=center,
            point=self.point,
            normal=contacts.normal,
            gap=contacts.gap,
            force=self.force,
            moment=self.moments,
            lattice=vectors,
            drift=drift,
        )

    @cached_property
    def impulse_on_large(self) -> Floats:
        """Impulses and angular impulses (large, 6) of the contacts on the large bodies; the same on all ranks."""
        return self.system.impulse_on_large(self.impulse, self.moment)


def advance(
    world: World, free: UnconstrainedMotion, contacts: Contacts, velocity: Floats, kept: Floats | None = None
) -> None:
    """Take the velocities (owned, 6) of `ContactSystem` and move all bodies by the step of the motion `free` with these
    contacts; `kept` (owned, 6) are those with which they go into the next step, if they are others. Collective.

    x <- x + dt (v + E x) + lag, q <- exp(dt w) q, with the rate E of a cell that changes its size, and the lag
    (grains, 3) of `Contacts` [m]; grains outside of a sheared cell go with the images there. The next search begins
    with the lists of this one, and the balancer goes by the contacts that grains own.
    Prescribed motions are followed exactly, whatever dt.
    """
    dt, start, of_large = free.dt, world.grains.position, large_velocity(world, free, velocity)
    large_kept = None if kept is None else large_velocity(world, free, kept)
    _move(world.grains, velocity[: len(world.grains)], dt)
    _move(world.large, of_large, dt)
    if kept is not None and large_kept is not None:
        world.grains.velocity, world.large.velocity = kept[: len(world.grains)].copy(), large_kept
    if contacts.lag is not None:
        world.grains.position = world.grains.position + contacts.lag
    world.lists, world.grains.weight = contacts.lists, contacts.owned
    if world.cell.deforms:
        world.grains.position = world.grains.position + dt * world.cell.rate * start
    if free.applied is not None:
        world.memory = free.applied.memory
    then, world.cell = world.cell, world.cell.after(dt)
    world.grains.velocity = world.cell.taken_along(then, start, world.grains.velocity)
    world.time += dt
    world.step += 1
    world.put_large(free.poses)


def advanced(world: World, free: UnconstrainedMotion, contacts: Contacts, velocity: Floats) -> World:
    """Return the world that `advance` leads to; this one stays as it is. Collective."""
    after = world.trial()
    advance(after, free, contacts, velocity)
    return after


def _move(table: Bodies, velocity: Floats, dt: float) -> None:
    table.velocity = velocity.copy()
    table.position = table.position + dt * velocity[:, :3]
    table.quaternion = quaternion.integrate(table.quaternion, velocity, dt)


def find_overrun(
    world: World, free: UnconstrainedMotion, contacts: Contacts, velocity: Floats, delta: float, depth: float,
    recovery_speed: float,
) -> Callable[[], Contacts] | None:  # fmt: skip
    """Return the search for the contacts of wider margins, if with these velocities (owned, 6) bodies go further in the
    step than their margins in the search for `contacts`, and overlap by more than `depth` [m] with others that it has
    not seen. None if none do; collective, as the search is, before which these contacts may go.

    The search may be repeated for the contacts that it finds: margins only grow.
    """
    dt, seen = free.dt, contacts.near.margin[: contacts.near.grains]
    travel = greatest_travel(world, velocity[: len(seen)], dt)
    large = large_velocity(world, free, velocity)
    # the ranks tell each other also of large bodies, which all know: processors of other kinds may round otherwise
    gone = bool((travel > seen).any()), exceeds_margin(world, dt * large, contacts.shifts, delta)
    further, beyond = on_any(world.comm, *gone)
    if not (further or beyond):
        return None
    shifts = np.concatenate([contacts.shifts, dt * large[None]]) if beyond else contacts.shifts
    margin = np.maximum(seen, travel)
    unseen = find_contacts(world, delta, free, margin, shifts, contacts.lists, besides=contacts)
    table = velocities_about(unseen, velocity, large)
    opening = _opening(world, unseen, unseen.near.bodies.position, table)
    overlap = -dt * (gap_velocities(world, unseen, dt, recovery_speed)[2] + opening)
    if not on_any(world.comm, bool((overlap > depth).any()))[0]:
        return None
    return partial(find_contacts, world, delta, free, margin, shifts, unseen.lists)


def _opening(world: World, contacts: Contacts, position: Floats, velocity: Floats) -> Floats:
    """Normal velocities (nc,) of contacts of bodies with these positions and velocities (rows, 3 and 6)."""
    row = np.stack([contacts.a, contacts.b], axis=1).astype(np.uint32)
    arm = contact_arms(contacts, position, row)
    opening: Floats = relative_velocities(contacts.frame.reshape(-1, 9), arm, row, velocity)[:, 0]
    flow = contacts.flow(world.cell, position)
    return opening if flow is None else opening + np.einsum("ci,ci->c", contacts.normal, flow)


def find_turned(
    world: World, free: UnconstrainedMotion, contacts: Contacts, velocity: Floats, depth: float,
    recovery_speed: float, tried: int,
) -> Contacts | None:  # fmt: skip
    """The contacts, with those that overlap by more than `depth` [m] if bodies go on for a step with these velocities
    (owned, 6), and that deeper than foreseen; None if there are none, or if the grains that are no spheres turn by less
    than that; collective.

    A step takes the gap of a contact as linear in the velocities. Where bodies turn, its point and its normal move, and
    other points may meet. What overlaps at the end of the step is linearised there: with the normal n of the end, and
    the gap at the start that leads to the gap of the end with these velocities. A contact that is there with nearly
    this normal stays, with a gap that is corrected (`_corrected`). This is a step of Newton's method (of sequential
    quadratic programming) for the gaps at the end of the step. What springs bear, and what a solution leaves, is
    foreseen. Where it was `tried` in this time step, what turns between two features, or rocks on a flat side, would go
    to and fro for ever: a linearisation with another normal or point then stays, and the new one is a contact beside
    it.
    """
    dt = free.dt
    if not _turn(world, velocity[: len(world.grains)], dt, depth):
        return None
    turn = None if world.large_moves else partial(_turning, forms=world.forms, dt=dt, depth=depth)
    end = find_contacts(advanced(world, free, contacts, velocity), 0.0, among=turn)
    end = end.take(end.gap < -depth)
    large = large_velocity(world, free, velocity)
    foreseen = _foreseen(world, contacts, velocities_about(contacts, velocity, large), dt, end.key)
    start, approach = _at_start(world, end, velocities_about(end, velocity, large), dt)
    overlap = -(dt * gap_velocities(world, start, dt, recovery_speed)[2] + approach)
    a, b, known = _rows_in(contacts, end)
    missed = known & (overlap > depth) & (end.gap < foreseen - 1e-3 * depth)  # rounding is no reason
    if not on_any(world.comm, bool(missed.any()))[0]:
        return None
    if contacts.linear is not None:
        moved = np.zeros_like(start.point) if start.moved is None else start.moved
        real = np.maximum(start.gap, -_overlaps_of(contacts, start.body))
        start = replace(start, moved=moved, linear=start.gap, gap=real)
    found = replace(start, a=a, b=b, near=contacts.near).take(missed)
    if contacts.linear is not None:
        contacts, found = _corrected(contacts, found, (end.gap - foreseen)[missed], tried, NEAR * depth)
    if tried and len(contacts):
        place = places(contacts.key, found.key)
        others = np.einsum("ci,ci->c", contacts.normal[place], found.normal) < ALIKE
        others |= quaternion.length(contacts.point[place] - found.point) > NEAR * depth
        found = replace(found, key=np.where((place >= 0) & others, found.key + BESIDE[tried], found.key))
    return _joined(world, contacts.take(places(found.key, contacts.key) < 0), found)


def _corrected(
    contacts: Contacts, found: Contacts, deeper: Floats, tried: int, near: float
) -> tuple[Contacts, Contacts]:
    """The contacts, whose gaps with large bodies are corrected where `found` has them again by how much they are
    `deeper` (n,) at the end of the step than foreseen, and what is found beside them: with another normal, deeper by
    more than `near` [m], or of bodies with corners, where it was `tried` before, at a point further off than that.

    What stays has the arms of the start of the step: with those of the end each step would brake a body that rolls,
    rocks or wobbles (see `dem.contact.ahead`). Between two grains, which both turn, corrections alone do not converge
    in a few tries: beds of mixed shapes would overlap four times as deep."""
    place, shape = places(contacts.key, found.key), found.near.bodies.shape
    same = (place >= 0) & (shape[found.b] == COMPOUND)
    at, own, shape = place[same], found.take(same), shape[found.a[same]]
    alike = (np.einsum("ci,ci->c", contacts.normal[at], own.normal) >= ALIKE) & (deeper[same] > -near)
    if tried:
        corners = (shape == BOX) | (shape == COMPOUND) | ((shape >= POLYHEDRON) & (shape < CONVEX))
        alike &= ~corners | (quaternion.length(contacts.point[at] - own.point) <= near)
    same[same] = alike
    linear = contacts.linear_gap.copy()
    linear[place[same]] += deeper[same]
    return replace(contacts, linear=linear), found.take(~same)


def _overlaps_of(contacts: Contacts, body: Ints) -> Floats:
    """How deep the pairs of bodies (n, 2) overlap in these contacts; 0 where they do not [m]."""
    over = contacts.take(contacts.gap < 0.0)
    pairs, row = np.unique(body @ [1.0, 1.0j], return_inverse=True)
    deepest, pair = np.zeros(len(pairs)), over.body @ [1.0, 1.0j]  # several contacts have one pair
    here = np.isin(pair, pairs)
    np.maximum.at(deepest, np.searchsorted(pairs, pair[here]), -over.gap[here])
    return deepest[row]


def _foreseen(world: World, contacts: Contacts, velocity: Floats, dt: float, key: Keys) -> Floats:
    """The gaps (n,) at the end of a step with these velocities (rows, 6) that contacts of these keys foresee, the least
    of those of a pair of features; inf where there are none [m]."""
    gap = np.full(len(key), np.inf)
    for tried in BESIDE:
        place = places(contacts.key, key + tried)
        of = contacts.take(place[place >= 0])
        end = of.linear_gap + dt * _opening(world, of, of.near.bodies.position, velocity)
        gap[place >= 0] = np.minimum(gap[place >= 0], end)
    return gap


def _turn(world: World, velocity: Floats, dt: float, depth: float) -> bool:
    """Whether grains that are no spheres turn so that contacts may be deeper by more than `depth` than foreseen, on any
    rank. False if a velocity is not finite.

    Points of their surfaces move by more than that, which brings others near. Of a clump these are on spheres, whose
    centres go on arcs: at most c w^2 / 2 off their tangents, for a distance c from the centre, of each of a pair."""
    if world.only_spheres:
        return False
    grains = world.grains
    fast = turned(velocity, grains.shape, grains.size, arms(world.forms), dt, depth)
    any_fast, not_finite = on_any(world.comm, bool(fast.any()), not np.isfinite(velocity).all())
    return any_fast and not not_finite


def _turning(near: Neighbourhood, forms: tuple[Form, ...], dt: float, depth: float) -> Bools:
    """Which grains and ghosts turn so."""
    table, seen = near.bodies, near.grains + near.ghosts
    return turned(table.velocity[:seen], table.shape[:seen], table.size[:seen], arms(forms), dt, depth)


@loop
def turned(velocity: Floats, shape: Ints, size: Floats, arms: Floats, dt: float, depth: float) -> Bools:
    """Which grains of shapes (n,) and sizes (n, 3), with the `arms` (forms,) of clumps, turn as `_turn` says."""
    fast = np.zeros(len(shape), np.bool_)
    for n in range(len(shape)):
        x, y, z = velocity[n, 3], velocity[n, 4], velocity[n, 5]
        angle = dt * np.sqrt(x * x + z * z + y * y)
        way = radius_about(shape[n], size[n]) * angle
        if CLUMP <= shape[n] < POLYHEDRON:
            way = arms[shape[n] - CLUMP] * angle**2
        fast[n] = shape[n] != SPHERE and way > depth
    return fast


def _at_start(world: World, end: Contacts, velocity: Floats, dt: float) -> tuple[Contacts, Floats]:
    """The contacts of the end of a step with these velocities (rows, 6) as contacts of its start, and by how much (nc,)
    their gaps grow in it [m]."""
    start = replace(end, point=end.point - 0.5 * dt * (velocity[end.a, :3] + velocity[end.b, :3]))
    position = end.near.bodies.position - dt * velocity[:, :3]
    flow = end.flow(world.cell, end.near.bodies.position)
    if flow is not None and end.moved is not None:
        start = replace(start, point=start.point - 0.5 * dt * flow, moved=end.moved - dt * flow)
    growth = dt * _opening(world, start, position, velocity)
    if world.cell.deforms and start.moved is not None:
        shift = dt * world.cell.rate * position  # of the centres, which the cell takes with it
        start = replace(start, point=start.point - shift[end.a], moved=start.moved + shift[end.b] - shift[end.a])
    return replace(start, gap=end.gap - growth), growth


def _rows_in(contacts: Contacts, end: Contacts) -> tuple[Ints, Ints, Bools]:
    """Rows (nc,) of the bodies a and b of `end` in the table of `contacts`, and whether both are there."""
    index = contacts.near.index
    order = np.argsort(index)
    place = np.searchsorted(index, end.body, sorter=order)
    row = order[np.minimum(place, len(index) - 1)]
    known: Bools = (index[row] == end.body).all(axis=1)
    return row[:, 0], row[:, 1], known


def carried(world: World, contacts: Contacts, wider: Contacts) -> Contacts:
    """Return the contacts of a wider search, where they are among these as these: `find_turned` has linearised some
    anew."""
    a, b, known = _rows_in(wider, contacts)
    kept = replace(contacts, a=a, b=b, near=wider.near, shifts=wider.shifts).take(known)
    return _joined(world, wider.take(places(kept.key, wider.key) < 0), kept)


def _joined(world: World, one: Contacts, other: Contacts) -> Contacts:
    """Both, in the order of contacts."""
    if (one.parting is None) != (other.parting is None):
        one, other = (x if x.parting is not None else replace(x, parting=np.full(len(x), np.nan)) for x in (one, other))
    if (one.swing is None) != (other.swing is None):
        one, other = (x if x.swing is not None else replace(x, swing=np.zeros_like(x.point)) for x in (one, other))
    more = other.columns()
    both = {name: np.concatenate([column, more[name]]) for name, column in one.columns().items()}
    order = contact_order(world, one.near, both["a"], both["b"], both["key"])
    return replace(one, **{name: column.take(order, axis=0) for name, column in both.items()})
