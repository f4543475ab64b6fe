"""Constraints of the bodies of a world in a step, such as joints: what they do without contacts, and to these.

Constraints have rows J of the velocities of their bodies. In a step with the free velocities v* the velocity is

    v = v* + M^-1 J' g,    J v + e (g - f) = t,

with t for what is held such that its error is gone at the end of the step, see `coupling`.
Swings that a step does not resolve have rows of their own, see `_swings`.
Motors have t = their speed. Their e is 0 if nothing bounds them. A bounded one gives the impulse f which brings it to
its speed without contacts, within its strength, and e as `dem.motion.Driven` has its grip. Contacts see constraints in
the inverse mass (`dem.contact_map.mass`), so they are solved together. Which limits are reached and which motors are
too weak is found without contacts first (`coupling`). Where the contacts of the step show another set, they are solved
once more with it (`refound`).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from mpi4py import MPI
from scipy.linalg.lapack import dpotrf, dpotri

from dem import quaternion
from dem.arrays import Bools, Floats, Ints
from dem.compiled import inner, loop
from dem.exchange import broadcast
from dem.free_motion import free_spin, unequal
from dem.model.world import World
from dem.motion import DROOP
from dem.parts.cell import Cell
from dem.parts.ends import HELD, LOWER, MOTOR, UPPER, Constraint, Ends, Geometry, Place
from dem.scene import kinds_of
from dem.unconstrained.applied import Applied, ends_of, rows_of, slots_of

Kinds = Sequence[tuple[type[Constraint], Sequence[Constraint]]]

ROUNDS = 8  #: of the iteration for what is not linear in the velocities, at most
FAR = 0.5  #: radians in a step above which it does not converge, and the step takes constraints as linear
SWING = 0.1  #: (w dt)^2 / 2 of the frequency w [1/s] from which on swings are implicit
DEPENDENT = 1e-8  #: what is left of the diagonal of a row, over it, where the row depends on those before
SWINGS = -1  #: the kind of their rows, see `_swings`


@dataclass(frozen=True)
class Coupling:
    """The conditions of the constraints of a step, and what they do to n bodies without contacts."""

    rows: Floats  #: (k, n, 6) J
    scaled: Floats  #: (k, 6 n) B = J M^-1/2
    root: Floats  #: (n, 6, 6) M^-1/2
    part: Ints  #: (k,) of which constraint each row is, -1: of none
    coordinate: Ints  #: (k,) which of its six coordinates
    kind: Ints  #: (k,) HELD, MOTOR, LOWER, UPPER, or SWINGS of what is added by `_swings`
    target: Floats  #: (k,) t
    bound: Floats  #: (k,) greatest impulses, inf: none
    free: Floats  #: (k,) J v*
    slip: Floats  #: (k,) what bounded motors lose to the load that they can just bear, with its sign
    axes: Floats  #: (constraints, 3, 3) rows x, y, z in the world
    on: Bools  #: (k,) the rows that hold
    saturated: Floats  #: (k,) impulses of the others: of motors that are too weak
    solver: Floats  #: (k, k) (B B' + e)^-1 of the rows that hold
    impulse: Floats  #: (k,) without contacts [N s, N m s]
    change: Floats  #: (n, 6) of velocities, by these impulses
    matrix: Floats  #: (6 n, 6 n) K of `dem.contact_map.mass`
    spin: Floats  #: (n, 3) angular velocities without all of that; NaN where all moments are equal, or infinite
    middle: Floats  #: (n, 3) about which they are linear in the impulses, see `dem.free_motion.free_spin`

    def impulses(self, push: Floats) -> Floats:
        """Impulses (k,) of the rows where contacts give the bodies the mass-scaled momenta `push` (n, 6)."""
        return self.impulse - self.solver @ (self.scaled @ push.ravel())

    @property
    def decides(self) -> bool:
        """Whether contacts may change which rows hold: those of limits and of motors with a bound."""
        return bool(((self.kind > MOTOR) | np.isfinite(self.bound)).any())


def _geometry(parts: Kinds, row: Ints, cell: Cell) -> Place:
    """Of the constraints of all kinds, see `Constraint.geometry`."""
    ends = np.cumsum([0, *(len(members) for _, members in parts)])
    rows = [row[first:end] for first, end in zip(ends, ends[1:])]
    places = [kind.geometry(members, own, cell) for (kind, members), own in zip(parts, rows)]

    def now(position: Floats, turn: Floats) -> Geometry:
        found = [of_kind(position, turn) for of_kind in places]
        return found[0] if len(found) == 1 else Geometry(*(np.concatenate(each) for each in zip(*found)))

    return now


def coupling(parts: Kinds, ends: Ends, dt: float, cell: Cell, push: Floats) -> Coupling:
    """Of constraints, by kind, between these ends in a step of dt [s], in a cell, where contacts are
    expected to give the bodies the mass-scaled momenta `push` (n, 6).

    Motors that are too weak, and limits that are reached, are found without contacts, by an active set. What is not
    linear is found by a fixed-point iteration, whose error falls by about the angle of a step each time: the angular
    momentum of bodies that are no spheres, and the errors of constraints at the end of the step. So they hold there, as
    in the method SHAKE, with forces of the start of the step, and energy does not drift (Hairer, Lubich, Wanner,
    "Geometric Numerical Integration", section VII.1.4). Near dead points it diverges, and the best round counts."""
    row, geometry = ends.row, _geometry(parts, ends.row, cell)
    found = geometry(ends.position, ends.quaternion)
    count, every = len(ends.free), [part for _, members in parts for part in members]
    asked = [(n, *each) for n, part in enumerate(every) for each in part.conditions(found.error[n], dt)]
    which, coordinates, kind, t, bound, way = (np.array(column) for column in zip(*asked))
    root, (flat, B) = ends.root, rows_of_conditions(found.rows[which, coordinates], row[which], ends.root)
    J, A, expected = flat.reshape(len(t), count, 6), gram(B), push.ravel()
    on: Bools = kind <= MOTOR
    inverse = _inverse(A, on)
    g = _impulses(A, inverse, t, flat @ ends.free.ravel() + B @ expected, on, np.zeros(len(t)))
    force = np.zeros((len(every), 6))
    np.add.at(force, (which, coordinates), g / dt)
    swings, kept = _swings(ends, found.arms, np.einsum("ni,nij->nj", force[:, :3], found.axes), B, inverse, dt)
    if more := len(swings):
        flat = np.concatenate([flat, swings])
        B = np.concatenate([B, np.matmul(swings.reshape(more, count, 1, 6), root).reshape(more, -1)])
        J = np.concatenate([J, np.zeros((more, count, 6))])  # they do no work
        given = (which, -1), (coordinates, 0), (kind, SWINGS), (bound, np.inf), (way, np.inf)
        which, coordinates, kind, bound, way = (np.append(known, [value] * more) for known, value in given)
        t, on = np.append(t, kept * (swings @ ends.velocity.ravel())), kind <= MOTOR
        A = _delassus(B, kind)
        inverse = _inverse(A, on)
    held = kind == HELD
    now = flat @ ends.velocity.ravel()
    left = _braked(A, t, bound, np.abs(way), held, now, flat @ ends.free.ravel(), dt)
    slip = np.maximum(DROOP * np.abs(left), np.abs(left - now))
    motors = np.isfinite(bound)
    slip[motors] = np.maximum(slip, 1e-9 * np.diag(A) * np.where(motors, bound, 0.0))[motors]
    slip = np.copysign(slip, left - now)
    saturated, decides = np.zeros(len(t)), motors.any() or (kind > MOTOR).any()
    rows = unequal(ends.moments).nonzero()[0]
    known = ends.quaternion[rows], ends.velocity[rows, 3:], ends.moments[rows]
    t, least, pushed = left.copy(), np.inf, B @ expected
    for number in range(ROUNDS):
        velocity, (spin, middle) = ends.free.copy(), np.full((2, count, 3), np.nan)
        change = _changes(root, expected)
        spun, middle[rows] = free_spin(*known, dt, change[rows, 3:] + ends.spin_change[rows])
        spin[rows] = velocity[rows, 3:] = spun + ends.spin_change[rows]
        free = flat @ velocity.ravel()
        for _ in range(2 * len(t) + 1):
            g = _impulses(A, inverse, t, free, on, saturated)
            if not decides or not (wrong := _wrong(kind, t, bound, on, g, free + A @ g, 0.0)).any():
                break
            on, saturated = _turned(kind, bound, on, saturated, g, wrong)
            inverse = _inverse(A, on)
        last, expected = expected, B.T @ g
        if pushed.any():
            expected = push.ravel() + B.T @ _impulses(A, inverse, t, free + pushed, on, saturated)
        differs = np.abs(expected - last).max()
        if number and differs >= least:
            break
        best = t, free, on, saturated, inverse, spin, middle
        if number:
            least = differs
        if least <= 1e-7 * np.abs(expected).max():
            break
        after = velocity + _changes(root, expected)
        if dt * np.abs(after[:, 3:]).max(initial=0.0) > FAR:
            best = left, *best[1:]
            break
        place, turn = ends.position + dt * after[:, :3], quaternion.integrate(ends.quaternion, after, dt)
        error = geometry(place, turn).error
        bent = (error - found.error)[which, coordinates] / dt - flat @ after.ravel()
        t = np.where(held, left - bent, left)
    t, free, on, saturated, inverse, spin, middle = best
    fixed = (J, B, root, which, coordinates, kind, t, bound, free, slip, found.axes)
    solved = _solved(A, B, root, kind, t, bound, free, slip, on, saturated, inverse)
    return Coupling(*fixed, on, saturated, *solved, spin=spin, middle=middle)


def _braked(
    A: Floats, t: Floats, bound: Floats, way: Floats, held: Bools, now: Floats, free: Floats, dt: float
) -> Floats:
    """The velocities t (k,), of motors with a bound that go to a target at most those from which they stop on the `way`
    (k,) that is left [m, rad], where the loads of this step last: else they go to and fro for ever. Of a motor that can
    hardly bear its load a tenth of its bound brakes."""
    t = t.copy()
    for row in (np.isfinite(bound) & np.isfinite(way)).nonzero()[0]:
        share = np.linalg.lstsq(A[held][:, held], A[held, row], rcond=1e-12)[0]
        yields = A[row, row] - A[row, held] @ share
        load = abs(free[row] - share @ free[held] - now[row])
        brakes = max(yields * bound[row] - load, 0.1 * yields * bound[row])  # in a step
        if brakes > 0.0:
            most = brakes * (np.sqrt(0.25 + 2.0 * way[row] / (brakes * dt)) - 0.5)
            t[row] = min(max(t[row], -most), most)
    return t


def refound(known: Coupling, push: Floats) -> Coupling | None:
    """The coupling with other rows that hold, where contacts give the bodies the mass-scaled momenta `push` (n, 6) with
    the known one and show by it that a limit is passed or pulls, or that a motor is too weak, or strong enough. None if
    all rows are right; the contacts of the other one are to be solved anew."""
    g = known.impulses(push)
    after = known.free + known.scaled @ (push.ravel() + known.scaled.T @ g)
    wrong = _wrong(known.kind, known.target, known.bound, known.on, g, after, DROOP)
    if not wrong.any():
        return None
    on, saturated = _turned(known.kind, known.bound, known.on, known.saturated, g, wrong)
    numbers, A = (known.kind, known.target, known.bound, known.free, known.slip), _delassus(known.scaled, known.kind)
    solved = _solved(A, known.scaled, known.root, *numbers, on, saturated, _inverse(A, on))
    solver, impulse, change, matrix = solved
    return dataclasses.replace(
        known, on=on, saturated=saturated, solver=solver, impulse=impulse, change=change, matrix=matrix
    )


def _swings(ends: Ends, arms: Floats, force: Floats, B: Floats, inverse: Floats, dt: float) -> tuple[Floats, Floats]:
    """Rows a (m, 6 n) of velocities, by which bodies get the inertia a' a beside their own, and which part (m,) of
    their velocities before the step they keep: those of swings which a step does not resolve, as those of links of a
    light chain with a heavy load.

    The `force` (constraints, 3) on the second ends [N] turns with no body, the `arms` (constraints, 2, 3) do. So the
    torque r x f swings a body back with the stiffness K = (r f) I - (r f' + f r') / 2, as that of a pendulum. The step
    is explicit in it, and stable while w dt < 2. With the inertia dt^2 / 2 K it is stable and without loss whatever dt
    is, if K does not change. But swings change it at twice their frequency, and where no step resolves that the load
    feeds them until a chain bursts. So swings faster than `SWING`, as the bodies move with constraints of rows B with
    their `_inverse`, get this inertia, and the faster they are the more of an implicit step: four times the inertia,
    and nothing of the velocity. Of twelve steps they lose 0.2 % a period, of six four fifths.
    Source: Andrews, Teichmann, Kry, "Geometric stiffness for real-time constrained multibody dynamics", Computer
    Graphics Forum 36 (2017)."""
    count, turning = len(ends.free), ends.root[:, 3:, 3:]
    torque = quaternion.length(arms) * quaternion.length(force)[:, None]
    most = np.bincount(ends.row.ravel(), torque.ravel(), count) * (turning**2).sum(axis=(1, 2))
    fast = (0.5 * dt**2 * most > SWING).nonzero()[0]
    if not len(fast):
        return np.zeros((0, B.shape[1])), np.zeros(0)
    K = np.zeros((count, 3, 3))
    for side, sign in ((0, -1.0), (1, 1.0)):
        np.add.at(K, ends.row[:, side], sign * arms[:, side, :, None] * force[:, None])
    K = np.trace(K, axis1=1, axis2=2)[:, None, None] * np.eye(3) - 0.5 * (K + K.transpose(0, 2, 1))
    value, vector = np.linalg.eigh(0.5 * dt**2 * K[fast])
    along = np.sqrt(np.clip(value, 0.0, None))[:, :, None] * vector.transpose(0, 2, 1)
    rows, C = np.zeros((2, len(fast), 3, count, 6))
    rows[np.arange(len(fast)), :, fast, 3:] = along
    C[np.arange(len(fast)), :, fast, 3:] = along @ turning[fast]
    rows, C = rows.reshape(3 * len(fast), -1), C.reshape(3 * len(fast), -1)
    across = C @ B.T
    size, mode = np.linalg.eigh(C @ C.T - across @ inverse @ across.T)
    kept = size > SWING
    unresolved = 1.0 - SWING / size[kept]
    implicit = unresolved**4
    found: Floats = (mode[:, kept] * np.sqrt(unresolved * (1.0 + 3.0 * implicit))).T @ rows
    return found, 1.0 - implicit


def _delassus(B: Floats, kind: Ints) -> Floats:
    """B B' of rows with a compliance of 1 in those of swings, whose targets are the velocities before the step: so the
    mass is M + a' a."""
    return gram(B) + np.diag((kind == SWINGS).astype(float))


@loop
def rows_of_conditions(along: Floats, body: Ints, root: Floats) -> tuple[np.ndarray, np.ndarray]:
    """J and B (k, 6 n) of relative velocities `along` (k, 2, 6) of two bodies (k, 2), with roots (n, 6, 6) of M^-1."""
    J, B = np.zeros((len(along), 6 * len(root))), np.zeros((len(along), 6 * len(root)))
    for r in range(len(along)):
        for side in range(2):
            n = body[r, side]
            for k in range(6):
                J[r, 6 * n + k] += along[r, side, k]
                for c in range(6):
                    B[r, 6 * n + c] += along[r, side, k] * root[n, k, c]
    return J, B


@inner
def bodies_of(B):
    """Where the bodies of each row (k, 6 n) begin in their list, and these: most columns are zero."""
    start, body, found = np.zeros(len(B) + 1, np.int64), np.empty(B.size // 6, np.int64), 0
    for r in range(len(B)):
        for n in range(B.shape[1] // 6):
            if B[r, 6 * n : 6 * n + 6].any():
                body[found] = n
                found += 1
        start[r + 1] = found
    return start, body


@loop
def gram(B: Floats) -> Floats:
    """B B' (k, k) of rows (k, 6 n)."""
    (start, body), out = bodies_of(B), np.empty((len(B), len(B)))
    for r in range(len(B)):
        for s in range(r + 1):
            p, q, total = start[r], start[s], 0.0
            while p < start[r + 1] and q < start[s + 1]:
                n = body[p]
                if n == body[q]:
                    for k in range(6 * n, 6 * n + 6):
                        total += B[r, k] * B[s, k]
                p, q = p + (n <= body[q]), q + (n >= body[q])
            out[r, s] = out[s, r] = total
    return out


@loop
def between(B: Floats, S: Floats) -> Floats:
    """B' S B (6 n, 6 n) of rows (k, 6 n) and a matrix (k, k)."""
    (start, body), right, out = bodies_of(B), np.zeros(B.shape), np.zeros((B.shape[1], B.shape[1]))
    for r in range(len(B)):
        for s in range(len(B)):
            for p in range(start[s], start[s + 1]):
                for k in range(6 * body[p], 6 * body[p] + 6):
                    right[r, k] += S[r, s] * B[s, k]
    for r in range(len(B)):
        for p in range(start[r], start[r + 1]):
            for k in range(6 * body[p], 6 * body[p] + 6):
                for c in range(B.shape[1]):
                    out[k, c] += B[r, k] * right[r, c]
    return out


def _inverse(A: Floats, on: Bools) -> Floats:
    """The pseudo-inverse (k, k) of the symmetric A of the rows that hold, zero in the others. Rows that depend on
    others, as those of a closed chain, take its eigenvalues, which cost some times as much as a factor."""
    rows = on.nonzero()[0]
    held, out = A[rows[:, None], rows], np.zeros(A.shape)
    if not len(rows):
        return out
    factor, failed = dpotrf(held, lower=True)
    if not failed and (factor.diagonal() ** 2 > DEPENDENT * held.diagonal()).all():
        lower = np.tril(dpotri(factor, lower=True)[0])
        found = lower + np.tril(lower, -1).T
    else:
        value, vector = np.linalg.eigh(held)
        size = np.abs(value)
        kept = size > 1e-12 * size.max()
        found = (vector[:, kept] / value[kept]) @ vector[:, kept].T
    out[rows[:, None], rows] = found
    return out


def _impulses(A: Floats, inverse: Floats, t: Floats, free: Floats, on: Bools, saturated: Floats) -> Floats:
    """Impulses (k,) that bring the rows that hold to t, with the `_inverse` of A; of the others those that saturate
    them."""
    return np.where(on, inverse @ (t - free - A @ saturated), saturated)


def _wrong(kind: Ints, t: Floats, bound: Floats, on: Bools, g: Floats, after: Floats, loose: float) -> Bools:
    """Which rows (k,) should hold and do not, or the other way round, with impulses g and velocities `after`. Where
    solvers are not exact, a part `loose` of the impulses does not count."""
    little, speed = loose * np.abs(g).max(initial=0.0), 1e-12 + 1e-6 * loose * np.abs(after - t).max(initial=0.0)
    weak = on & (kind == MOTOR) & (np.abs(g) > (1.0 + loose) * bound)
    strong = ~on & (kind == MOTOR) & (np.sign(g) * (after - t) > speed)
    reached = ~on & (((kind == LOWER) & (after < t - speed)) | ((kind == UPPER) & (after > t + speed)))
    pulls = on & (((kind == LOWER) & (g < -little)) | ((kind == UPPER) & (g > little)))
    wrong: Bools = weak | strong | reached | pulls
    return wrong


def _turned(kind: Ints, bound: Floats, on: Bools, saturated: Floats, g: Floats, wrong: Bools) -> tuple[Bools, Floats]:
    """The rows that hold and the saturated impulses of the others, after the wrong ones have changed sides."""
    saturated = saturated.copy()
    saturated[wrong] = 0.0
    weak = wrong & on & (kind == MOTOR)
    saturated[weak] = np.sign(g[weak]) * bound[weak]
    return on ^ wrong, saturated


def _solved(
    A: Floats, B: Floats, root: Floats, kind: Ints, t: Floats, bound: Floats, free: Floats, slip: Floats, on: Bools,
    saturated: Floats, inverse: Floats,
) -> tuple[Floats, Floats, Floats, Floats]:  # fmt: skip
    """`solver`, `impulse`, `change` and `matrix` of a `Coupling`, with A, see `_delassus`, and its `_inverse` for the
    rows that hold."""
    g = _impulses(A, inverse, t, free, on, saturated)
    # Beyond what motors give without contacts; not positive where only these bring one to its speed: it is held there.
    room = bound - np.copysign(g, g * slip)
    yields = np.isfinite(bound) & (room > 0.0)
    e = np.divide(np.abs(slip), room, out=np.zeros(slip.shape), where=yields)
    solver = _inverse(A + np.diag(e), on) if yields.any() else inverse
    K = between(B, solver)
    if yields.any() or (kind == SWINGS).any():  # else it is a projector, and I - K its own root
        value, vector = np.linalg.eigh(K)
        K = (vector * (1.0 - np.sqrt(np.clip(1.0 - value, 0.0, 1.0)))) @ vector.T
    return solver, g, _changes(root, B.T @ g), K


def _changes(root: Floats, momenta: Floats) -> Floats:
    """What mass-scaled momenta (6 n,) change of velocities (n, 6), with the roots (n, 6, 6) of M^-1."""
    return (root @ momenta.reshape(-1, 6, 1))[:, :, 0]


def constrained(world: World) -> tuple[Ints, Ints]:
    """The ids of the grains at the ends of constraints, in order, and the rows (constraints, 2) of the ends among
    these, the large bodies and the world."""
    return rows_of(world, [part for _, members in _parts(world) for part in members])


def _parts(world: World) -> Kinds:
    return [(kind, [*members.values()]) for _, kind, members in kinds_of(Constraint, world.named)]


def coupling_of(
    world: World, applied: Applied | None, motion_velocities: Floats, dt: float, push: Floats | None
) -> Coupling | None:
    """The constraints in the next step of dt [s] with what is applied, in which large bodies have the
    `motion_velocities` (large, 6) that motions give; None without any. `push` (owned, 6): the mass-scaled momenta that
    contacts are expected to give the bodies whose rows this rank owns. Collective."""
    parts = _parts(world)
    if not parts:
        return None
    grains, large = np.zeros(world.grains.velocity.shape), np.zeros(world.large.velocity.shape)
    if applied is not None:
        grains, large = applied.grains, applied.large
    ends = ends_of(world, [part for _, members in parts for part in members], grains, large, motion_velocities, dt)
    gathered = np.zeros(ends.free.shape)
    if push is not None:
        id = np.concatenate([world.grains.id, world.large.id])[: len(push)]
        here, slot = slots(world, id)
        gathered[slot] = push[here]
        world.comm.Allreduce(MPI.IN_PLACE, gathered)
    found = coupling(parts, ends, dt, world.cell, gathered) if world.comm.rank == 0 else None
    return broadcast(world.comm, found)


def coupling_refound(world: World, known: Coupling, push: Floats) -> Coupling | None:
    """`refound`, by the first rank for all; collective."""
    found = refound(known, push) if world.comm.rank == 0 else None
    return broadcast(world.comm, found)


def slots(world: World, id: Ints) -> tuple[Ints, Ints]:
    """Which rows of bodies with these ids (n,) are among the bodies that constraints know, and their rows there."""
    return slots_of(constrained(world)[0], world.first_large, id)


def number_of(world: World, kind: str, name: str) -> int:
    """The number of a constraint among all of them."""
    names = [(each, own) for each, _, members in kinds_of(Constraint, world.named) for own in members]
    return names.index((kind, name))


def constraints_now(world: World) -> tuple[Geometry, Floats]:
    """The constraints as they are, and the velocities (constraints, 2, 6) of their ends; collective."""
    (ids, row), grains, large = constrained(world), world.grains, world.large
    here, slot = slots_of(ids, world.first_large, grains.id)
    own, gathered = grains.take(here), np.zeros((len(ids), 13))
    gathered[slot] = np.concatenate([own.position, own.quaternion, own.velocity], axis=1)
    world.comm.Allreduce(MPI.IN_PLACE, gathered)  # each row is that of one rank
    tools = np.concatenate([large.position, large.quaternion, large.velocity], axis=1)
    rest = np.concatenate([np.zeros((1, 3)), [[1.0, 0.0, 0.0, 0.0]], np.zeros((1, 6))], axis=1)
    position, turn, velocity = np.split(np.concatenate([gathered, tools, rest]), [3, 7], axis=1)
    return _geometry(_parts(world), row, world.cell)(position, turn), velocity[row]
