"""The contacts of a rank."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from dem import bodies
from dem.arrays import Bools, Floats, Ints, Keys, places
from dem.bodies import CAPSULE, CLUMP, FORM, MESH, POLYHEDRON, SPHERE
from dem.compiled import inlined, loop
from dem.contact.ahead import Course
from dem.contact.candidates import Pairs, meeting
from dem.contact.lists import Lists, grain_lists
from dem.contact.primitives import Manifold, Primitives, touches, touches_ahead
from dem.model.images import Images, refuse_short
from dem.model.neighbourhood import Neighbourhood, refreshed
from dem.model.world import World
from dem.parts.cell import Cell
from dem.quaternion import cross, length
from dem.shapes.forms import arms
from dem.unconstrained.drives import free_directions, free_turns

if TYPE_CHECKING:
    from dem.unconstrained import UnconstrainedMotion

#: Margin of a grain over the way that it goes in a step without contact forces: those that push it on often add a part.
FURTHER = 1.25


@dataclass(frozen=True)
class Contacts:
    """The contacts of this rank. First come those that need no other rank, because it owns both bodies or their motion
    is prescribed, then the others. Each part is ordered by the row of the body that owns the contact, and then by
    key."""

    key: Keys  #: (nc,) the same for the same two shapes and feature at all times and on any number of ranks
    a: Ints  #: (nc,) row of the first body in `near.bodies`, the one of lower id
    b: Ints  #: (nc,) row of the second body in `near.bodies`
    point: Floats  #: (nc, 3) middle between the surfaces, as seen from body a [m]
    normal: Floats  #: (nc, 3) unit vector from a to b, as foreseen for the end of the step by `dem.contact.ahead`
    #: (nc,) signed distance at the start of the step, negative if the bodies overlap; of capsules, polyhedra and meshes
    #: the linear one, but no deeper than the two overlap [m]
    gap: Floats
    friction: Floats  #: (nc,) coefficient
    near: Neighbourhood  #: the bodies of the rows `a` and `b`
    shifts: Floats  #: (k, large, 6) the ways and turns of the large bodies that the search reckoned with [m, rad]
    owned: Floats  #: (grains,) how many contacts each of the local grains owns: the load of the balancer
    lists: Lists  #: of pairs that are close, from which the search found the contacts
    #: (nc, 3) from body b to where it is in the contact, as seen from body a: to its image, and ahead to the end of the
    #: step; None: nowhere [m]
    moved: Floats | None = None
    linear: Floats | None = None  #: (nc,) the gaps from which gaps linear in the velocities start; None: `gap` [m]
    #: (nc, 3) by how much the mean velocities along the surfaces in the step, of b relative to a, differ from those
    #: with these arms, as bodies turn; None: nothing [m/s]
    swing: Floats | None = None
    #: (nc, 4) of spheres that come to bodies of prescribed motion the normal at the time of touch, and that time after
    #: the start of the step [s], or zeros; None: nowhere on this rank, or `dem.step.impacts` has taken it
    touched: Floats | None = None
    drift: Floats | None = None  #: (nc, 3) what the shear adds to the velocity of b relative to a; None: nothing [m/s]
    #: (nc,) the normal velocities after impacts that `dem.step.impacts` follows; -inf where two do not meet, NaN where
    #: nothing is followed; None: nowhere [m/s]
    parting: Floats | None = None
    #: (grains, 3) by how much grains end beside the place to which their velocities after the step would bring them, as
    #: impacts begin at their times of touch; None: nowhere [m]
    lag: Floats | None = None
    held_overlap: float = 0.0  #: the deepest overlap of bodies that no force can part, left out of the contacts [m]

    def __len__(self) -> int:
        return len(self.key)

    @property
    def body(self) -> Ints:
        """Global indices (nc, 2) of the two bodies."""
        return self.near.index[np.stack([self.a, self.b], axis=1)]

    def columns(self) -> dict[str, np.ndarray]:
        """The arrays with a row per contact by name, without copies."""
        left = {"near", "shifts", "owned", "lists", "lag", "held_overlap", "frame"}
        maybe = "moved", "linear", "swing", "touched", "drift", "parting"
        left |= {name for name in maybe if getattr(self, name) is None}
        return {name: value for name, value in vars(self).items() if name not in left}

    @property
    def linear_gap(self) -> Floats:
        """The gaps (nc,) to which the normal velocities of a step times dt are added [m]."""
        return self.gap if self.linear is None else self.linear

    @cached_property
    def frame(self) -> Floats:
        """The `contact_frames` (nc, 3, 3) of the normals, which from then on are their first rows."""
        frame = contact_frames(np.ascontiguousarray(self.normal))
        vars(self)["normal"] = frame[:, 0]  # so that they take no memory beside the frames
        return frame

    def branch(self, position: Floats) -> Floats:
        """From the centre of body a to that of body b, or of its image (nc, 3), at these positions (rows, 3) [m]."""
        return branches(self.a, self.b, position, np.zeros((0, 3)) if self.moved is None else self.moved)

    def flow(self, cell: Cell, position: Floats) -> Floats | None:
        """What the cell adds to the velocities of b relative to a (nc, 3) in a step from these positions (rows, 3), by
        its shear and as it changes its size; None: nothing [m/s]."""
        if not cell.deforms:
            return self.drift
        affine: Floats = cell.rate * self.branch(position)
        return affine if self.drift is None else self.drift + affine

    def take(self, rows: np.ndarray) -> Contacts:
        """The contacts of the given rows (index array or mask)."""
        return replace(self, **{name: column[rows] for name, column in self.columns().items()})


@loop
def branches(a: Ints, b: Ints, position: Floats, moved: Floats) -> Floats:
    """The loop of `Contacts.branch`; `moved` (nc, 3) may have no row."""
    out = np.empty((len(a), 3))
    for c in range(len(a)):
        for k in range(3):
            out[c, k] = position[b[c], k] - position[a[c], k]
            if len(moved):
                out[c, k] += moved[c, k]
    return out


@loop
def contact_frames(normal: Floats) -> Floats:
    """Return orthonormal right-handed frames (nc, 3, 3), rows n, t1, t2, of unit normals (nc, 3).

    Duff et al. (2017), "Building an Orthonormal Basis, Revisited": a function of the normal alone, continuous
    but where the sign of its z component changes.
    """
    out = np.empty((len(normal), 9))
    for c in range(len(normal)):
        x, y, z = normal[c, 0], normal[c, 1], normal[c, 2]
        sign = np.copysign(1.0, z)
        p = -1.0 / (sign + z)
        q = x * y * p
        out[c, 0], out[c, 1], out[c, 2] = x, y, z
        out[c, 3], out[c, 4], out[c, 5] = 1.0 + sign * x * x * p, sign * q, -sign * x
        out[c, 6], out[c, 7], out[c, 8] = q, sign + y * y * p, -y
    return out.reshape((len(normal), 3, 3))


def find_contacts(
    world: World, delta: float, free: UnconstrainedMotion | None = None, margin: Floats | float = 0.0,
    shifts: Floats | None = None, lists: Lists | None = None, besides: Contacts | None = None,
    among: Callable[[Neighbourhood], Bools] | None = None,
) -> Contacts:  # fmt: skip
    """Return all contacts that this rank owns of the pairs whose margins meet; collective.

    The margin of a body is delta/2 [m], or the way that it goes in a step of the motion `free` without contacts, of a
    grain FURTHER times that, if it is longer; None: where bodies are, not where they will be. So a gap of at most
    `delta` is a contact, and so is a wider one that may close within the step, also when a third body stops one of the
    two. `margin` (grains,) [m] are the least margins of the local grains, `shifts` (k, large, 6) [m, rad] further ways
    and turns of the large bodies that their margins are to cover. A contact belongs to the rank that owns the body of
    lower global index. `lists`: those of an earlier search that may hold; None: those of the world. With `besides`,
    contacts that a search with margins not greater has found, only those are found that are not among them; `among`
    tells which grains and ghosts (n,) of a neighbourhood to find contacts of, with any others, if not all.
    """
    if not 0.0 <= delta < math.inf:
        raise ValueError(f"contact distance delta must not be negative, got {delta:g}")
    margin, travel, shifts = _margins(world, delta, free, margin, shifts)
    refuse_short(world, margin)
    lists = grain_lists(world, world.lists if lists is None else lists, margin, travel)
    base, images = refreshed(lists.near, lists.halo, world, margin), lists.images.now(world.cell)
    grown = _grown(base, shifts, besides) if among is None else among(base)
    near, grown = images.among(base), grown[images.rows]
    table = lists.table.now(near)
    pairs = _that_touch(world, near, table, meeting(world, near, lists, table, delta, shifts, grown))
    table, i, j, reach = table.of_members(*pairs)
    found, ahead = _narrow(world, near, images, table, (i, j, reach), free)
    key, a, b, friction, owned = named(
        *((table.kind, table.row), table.number, near.bodies.material, world.pairs.friction),
        *(table.hulls.features, near.grains, (i, j), (found.pair, found.feature)),
    )
    contacts = Contacts(key, a, b, *found.touch, friction, near, shifts, owned, lists, **ahead)
    if world.cell.periodic:
        contacts = _without_images(world, contacts, base, images)
    if table.members is not None or world.cell.periodic:
        _put_in_order(world, contacts)
    if besides is not None:
        contacts = contacts.take(places(besides.key, contacts.key) < 0)
    return _without_rigid(world, contacts)


def _margins(
    world: World, delta: float, free: UnconstrainedMotion | None, least: Floats | float, shifts: Floats | None
) -> tuple[Floats, Floats, Floats]:
    """The margins (grains,) of a search, of at least the `least`, the ways (grains,) of the grains in the step [m], and
    the shifts (k, large, 6) of the large bodies, by default those of the motion without contacts."""
    dt, velocity = (0.0, world.grains.velocity) if free is None else (free.dt, free.grains)
    if shifts is None:
        shifts = (np.zeros(world.large.velocity.shape) if free is None else dt * free.drives.free)[None]
    travel = greatest_travel(world, velocity, dt, FURTHER)
    return np.maximum(np.maximum(delta / 2, travel), least), travel, shifts


def _that_touch(world: World, near: Neighbourhood, table: Primitives, pairs: Pairs) -> Pairs:
    """The pairs of materials that touch each other, and of bodies that are not `World.apart`."""
    i, j, reach = pairs
    if not world.pairs.touching.all():
        material = near.bodies.material[table.row]
        touch = world.pairs.touching[material[i], material[j]] > 0.0
        i, j, reach = i[touch], j[touch], reach[touch]
    if len(world.apart):
        one, other = near.bodies.id[table.row[i]], near.bodies.id[table.row[j]]
        touch = ~np.isin(np.minimum(one, other) + 1j * np.maximum(one, other), world.apart)
        i, j, reach = i[touch], j[touch], reach[touch]
    return i, j, reach


def _narrow(
    world: World, near: Neighbourhood, images: Images, table: Primitives, pairs: Pairs, free: UnconstrainedMotion | None
) -> tuple[Manifold, dict[str, Any]]:
    """The contacts of pairs, and with a motion the columns of `Contacts` that look ahead to the end of the step."""
    if free is None:
        return touches(table, *pairs), {}
    motions = _motions(world, near, images, free.prescribed)
    course = Course(near.bodies.position, motions, bodies.is_dynamic(near.bodies), free.dt)
    found, moved, swing, linear, touched = touches_ahead(table, *pairs, course, near.grains + near.ghosts)
    return found, {"moved": moved, "swing": swing, "linear": linear, "touched": touched if len(touched) else None}


def _put_in_order(world: World, contacts: Contacts) -> None:
    """Order the rows of contacts of images and members of clumps, whose pairs are not in the order of contacts."""
    order = contact_order(world, contacts.near, contacts.a, contacts.b, contacts.key)
    for column in contacts.columns().values():
        column[:] = column.take(order, axis=0)


def _motions(world: World, near: Neighbourhood, images: Images, prescribed: Floats) -> Floats:
    """Velocities (rows, 6) before the step of the bodies of a neighbourhood, of prescribed ones those of the step;
    images and centres have those that a cell gives them."""
    velocity, seen = near.bodies.velocity.copy(), near.grains + near.ghosts
    velocity[seen:] = prescribed
    if world.cell.moves:
        velocity[:seen, 0] += world.cell.speed * images.boundaries(np.arange(seen))
        velocity[:seen, :3] += world.cell.rate * near.bodies.position[:seen]
    return velocity


def velocities_about(contacts: Contacts, velocity: Floats, large: Floats) -> Floats:
    """Return velocities (rows, 6) of all bodies of the neighbourhood of contacts, from those (owned, 6) of the bodies
    whose rows each rank owns and those (large, 6) of the large bodies; collective."""
    near = contacts.near
    table = np.zeros((len(near.bodies), 6))
    table[: near.grains] = velocity[: near.grains]
    contacts.lists.halo.update(table)
    table[near.grains + near.ghosts :] = large
    return table


def _without_images(world: World, contacts: Contacts, near: Neighbourhood, images: Images) -> Contacts:
    """The contacts of a table with images as contacts of the bodies of `near`, at the place of body a."""
    (a, shift), (b, moved) = images.place(contacts.a), images.place(contacts.b)
    moved = moved - shift
    if contacts.moved is not None:
        moved += contacts.moved
    found = replace(contacts, a=a, b=b, near=near, point=contacts.point - shift, moved=moved)
    if world.cell.moves:
        boundaries = images.boundaries(contacts.b) - images.boundaries(contacts.a)
        found = replace(found, drift=np.outer(world.cell.speed * boundaries, (1.0, 0.0, 0.0)))
    owner = np.minimum(a, b)
    return replace(found, owned=np.bincount(owner[owner < near.grains], minlength=near.grains).astype(float))


def _grown(near: Neighbourhood, shifts: Floats, besides: Contacts | None) -> Bools:
    """Which grains and ghosts (n,) may have contacts that are not among the known ones: those of greater margin than
    then, ghosts that may be others than then, and all if large bodies go further."""
    grown = np.ones(near.grains + near.ghosts, bool)
    if besides is not None and len(shifts) == len(besides.shifts):
        many = len(grown) if near.index is besides.near.index else near.grains
        grown[:many] = near.margin[:many] > besides.near.margin[:many]
    return grown


@loop
def named(shapes, number, material, friction, features, grains, pairs, contacts):
    """Of contacts, with the numbers (nc,) of their `pairs`, rows i, j (m,) of the shapes, and their features (nc,):
    key, rows a and b of the bodies, friction; and how many each of the `grains` owns.

    Keys are distinct, and the same at all times: the number of the one, and that of the other with the feature. A mesh
    takes further numbers for its features."""
    (kind, row), (i, j), (pair, feature) = shapes, pairs, contacts
    key, a, b = np.empty(len(pair), np.complex128), np.empty(len(pair), np.int64), np.empty(len(pair), np.int64)
    mu, owned = np.empty(len(pair)), np.zeros(grains)
    for c in range(len(pair)):
        p, q = i[pair[c]], j[pair[c]]
        one, two, own = number[p], number[q], feature[c]
        if own >= features:
            further, own = own // features, own % features
            if kind[p] == MESH:
                one += further
            else:
                two += further
        key[c] = complex(one, two * features + own)
        a[c], b[c] = row[p], row[q]
        mu[c] = friction[material[a[c]], material[b[c]]]
        owner = min(a[c], b[c])  # the local grains are the first rows, and ghosts come from higher ranks only
        if owner < grains:
            owned[owner] += 1.0
    return key, a, b, mu, owned


def contact_order(world: World, near: Neighbourhood, a: Ints, b: Ints, key: Keys) -> Ints:
    """Return the order of contacts of bodies in the rows a, b (nc,): first those whose solution needs no other rank, of
    bodies that this rank owns or whose motion is prescribed; each part by the row of the owner and by key."""
    foreign = np.zeros(len(near.bodies), dtype=bool)
    foreign[near.grains : near.grains + near.ghosts] = True
    if world.comm.rank < world.comm.size - 1:
        foreign[near.grains + near.ghosts :] = bodies.is_dynamic(world.large)
    return _order(foreign, a, b, key)


@loop
def _order(foreign, a, b, key):
    """The contacts by whether one of their rows is foreign, by the lower row, and by key. They are counted into places
    by the first two; of those with the same, which are few and nearly in order, each goes before the greater ones."""
    rows = len(foreign)
    place, start = np.empty(len(a), np.int64), np.zeros(2 * rows + 1, np.int64)
    for c in range(len(a)):
        place[c] = min(a[c], b[c])  # the local grains are the first rows, and ghosts come from higher ranks only
        if foreign[a[c]] or foreign[b[c]]:
            place[c] += rows
        start[place[c] + 1] += 1
    for n in range(2 * rows):
        start[n + 1] += start[n]
    order, end = np.empty(len(a), np.int64), start[:-1].copy()
    for c in range(len(a)):
        first, to, one, two = start[place[c]], end[place[c]], key[c].real, key[c].imag
        end[place[c]] += 1
        while to > first:
            other = key[order[to - 1]]
            if other.real < one or (other.real == one and other.imag <= two):
                break
            order[to] = order[to - 1]
            to -= 1
        order[to] = c
    return order


def exceeds_margin(world: World, contacts: Contacts, shift: Floats, delta: float) -> bool:
    """Return whether a free large body that moves and turns by `shift` (large, 6) goes further than delta/2, and not as
    in one of the shifts that its margin covers in the search for `contacts`, to a hundredth of delta."""
    if not world.large_moves:
        return False
    table, first = contacts.lists.table, len(contacts.lists.table.row) - len(contacts.lists.table.center)
    parts = table.row[first:] - first, table.center, table.radius[first:]
    return further(bodies.is_dynamic(world.large), parts, shift, contacts.shifts, delta)


@loop
def further(free, parts, shift, seen, delta):
    """The loop of `exceeds_margin`, over parts of bodies with these centres (parts, 3) and radii (parts,) in the frames
    of the bodies. A half space counts with a metre."""
    body, center, radius = parts
    size = np.zeros(len(free))
    for k in range(len(body)):
        x, y, z = center[k, 0], center[k, 1], center[k, 2]
        size[body[k]] = max(size[body[k]], np.sqrt(x * x + y * y + z * z) + radius[k])
    for n in range(len(free)):
        if free[n] and way(shift[n], size[n]) > 0.5 * delta:
            covered = False
            for s in range(len(seen)):
                covered = covered or not way(shift[n] - seen[s, n], size[n]) > 0.01 * delta
            if not covered:
                return True
    return False


@inlined
def way(shift, size):
    """How far points go at most that are as far from the centre as the `size`."""
    turn = np.sqrt(shift[3] ** 2 + shift[4] ** 2 + shift[5] ** 2)
    return np.sqrt(shift[0] ** 2 + shift[1] ** 2 + shift[2] ** 2) + size * turn


def greatest_travel(world: World, velocity: Floats, dt: float, further: float = 1.0) -> Floats:
    """Return about how far (grains,) a point of each local grain with these velocities (grains, 6) goes in dt, so many
    times; in a sheared cell, which has no large bodies, beside the flow, with what this brings pairs together [m]."""
    grains, cell = world.grains, world.cell
    beside = cell.beside_flow(grains.position, velocity)
    travel = _travel(grains.shape, grains.size, arms(world.forms), beside, further * dt)
    return travel + cell.margin(dt, grains) if cell.moves else travel


@loop
def _travel(shape: Ints, size: Floats, arms: Floats, velocity: Floats, dt: float) -> Floats:
    """At most two of the radii of each grain [m]. Turning moves the centres of spheres, not their surfaces: no single
    ones, those of clumps by their `arms` (forms,) [m], those of capsules by the half length. NaN where the velocity is
    not finite."""
    out = np.empty(len(shape))
    for n in range(len(shape)):
        v = velocity[n]
        speed, spin = np.sqrt(v[0] ** 2 + v[1] ** 2 + v[2] ** 2), np.sqrt(v[3] ** 2 + v[4] ** 2 + v[5] ** 2)
        radius = np.sqrt(size[n, 0] ** 2 + size[n, 1] ** 2 + size[n, 2] ** 2)
        arm = 0.0 if shape[n] == SPHERE else radius
        if shape[n] == CAPSULE:
            radius, arm = size[n, 0] + size[n, 1], size[n, 1]
        elif shape[n] >= FORM:
            radius = size[n, 0]
            arm = arms[shape[n] - CLUMP] if CLUMP <= shape[n] < POLYHEDRON else radius
        speed += arm * spin
        out[n] = min(dt * speed, 2.0 * radius) if np.isfinite(speed + spin) else np.nan
    return out


def _without_rigid(world: World, contacts: Contacts) -> Contacts:
    """The contacts without those that no force can open, and how deep these overlap.

    Their normals are across the free directions of a body, and they do not turn it about a free axis, and the other
    body is held too. Their normal impulse changes no velocity, and would allow any friction."""
    if not world.large_moves:
        return contacts
    near, moves = contacts.near, bodies.is_dynamic(world.large)[:, None, None]
    first = near.grains + near.ghosts
    rigid = np.minimum(contacts.a, contacts.b) >= first
    if not rigid.any():
        return contacts
    these = contacts.take(rigid)
    free, turns = free_directions(world.large_bodies) * moves, free_turns(world.large_bodies) * moves
    normal, opens = these.normal, np.zeros(len(these))
    moved = 0.0 if these.moved is None else these.moved
    for body, shift in ((these.a, 0.0), (these.b, moved)):
        arm = these.point - near.bodies.position[body] - shift
        lever = cross(arm / np.maximum(length(arm), 1e-300)[:, None], normal)
        opens += np.einsum("ci,cij,cj->c", normal, free[body - first], normal)
        opens += np.einsum("ci,cij,cj->c", lever, turns[body - first], lever)
    rigid[rigid] = opens <= 1e-8
    if not rigid.any():
        return contacts
    return replace(contacts.take(~rigid), held_overlap=-float(contacts.gap[rigid].min(initial=0.0)))
