"""The stiffness of contacts: what a scene needs, what a material has, and what a time step makes of it.

Bodies in contact push each other apart with the force k d + c d', where d is their overlap, k the stiffness and c a
damping that takes nearly all speed of an impact. The step is implicit in it. With the normal velocity v_n and the
impulse g = dt (k d + c d') at its end, d = -(gap + dt v_n) and d' = -v_n,

    v_n + (k dt gap + g) / (k dt^2 + c dt) = 0:

a compliance C = 1 / (k dt^2 + c dt) on the diagonal of the Delassus matrix, and a share of gap / dt. So dt has no
limit, the overlap of bodies at rest does not depend on it, and no step adds energy: an implicit spring gives back what
it holds at most. Rigid contacts are k = inf.

Along the surfaces there is a spring with a damper, too, of TANGENTIAL times the constants, which friction stretches no
further than it holds. With the impulse h that the spring held at the end of the last step, a contact that sticks has

    v_t + C_t (g_t - h) = 0,    C_t = C / TANGENTIAL,

and then its spring holds h + share (g_t - h), with the share k dt^2 C; where it slides, v_t less the slip takes the
place of v_t. A contact that sticks under a constant load does not move: the spring remembers.

Source: Negrut, Serban, Tasora, "Posing multibody dynamics with friction and contact as a differential complementarity
problem", J. Comput. Nonlinear Dynam. 13 (2017), for the compliance; Schwager, Poeschel, "Coefficient of restitution
and linear-dashpot model revisited", Granular Matter 9 (2007), for impacts with springs that do not pull; Cundall,
Strack, "A discrete numerical model for granular assemblies", Geotechnique 29 (1979), for the tangential spring.
"""

from __future__ import annotations

import math

import numpy as np

from dem import bodies, checks, quaternion
from dem.arrays import ArrayLike, Floats, Ints
from dem.compiled import inlined, loop
from dem.motion import Dynamic
from dem.parts.contact_law import ContactLaw
from dem.parts.named import Pressing
from dem.scene import Scene
from dem.shapes import Plane, placed
from dem.start.falls import DENSE, area, fall
from dem.start.pressing import CHAINS, pressing
from dem.start.time_step import fastest_grain, fastest_tool
from dem.start.time_step import recommended as recommended_step
from dem.start.toppling import toppling

OVERLAP = 0.003  #: the greatest overlap that `recommended` allows, as a part of a grain's half thickness
FALLEN = 0.005  #: the same for a moment, of a grain that has fallen
RESISTS = 10.0  #: the strongest forces between grains that a tool pushes over those of a bed at rest
STOPPED = 0.22  #: of v sqrt(m / k): how far a grain of speed v goes into a contact of this DAMPING
TANGENTIAL = 2.0 / 7.0  #: k_t / k: both directions of an impact of spheres take as long (Silbert et al., PRE 64, 2001)
DAMPING = 2.0  #: c as a part of 2 sqrt(k m): an impact leaves 5 % of the speed (Schwager, Poeschel); 1: 14 %


def pairs(scene: Scene) -> ContactLaw:
    """Return the coefficients of contacts by pair of materials, with the recommended stiffness where none is stated."""
    return scene.pairs(recommended(scene))


def recommended(scene: Scene) -> float:
    """Return the stiffness [N/m] with which no grain of a scene overlaps by more than OVERLAP half thicknesses, whether
    under the weight of the bed above it, pressed by a spring, a load, a motor or a tool, pushed by the fastest tool or
    met by the fastest grain, nor by more than FALLEN of them after a fall, to two digits; inf if there is none of them.

    The weight on a grain is that of all bodies over the area of the bed, times the square of the grain's width, and
    four times as much where a chain of force goes (Radjai, Jean, Moreau, Roux, Phys. Rev. Lett. 77 (1996): a share of
    exp(-1.4 f) bears more than f times the mean). The stress that a periodic cell is to have takes the place of the
    weight over the area. Sources may fill the scene up to their height (`_bed`). Cohesion c presses grains together by
    c / k.

    A speed v that reaches a row of grains of mass m makes the force k d = v sqrt(k m), a wave along the row. A bed
    gives way to a tool before that: with at most RESISTS times the force of its weight (docs/mechanics.md), or with
    that of the single grain that the tool throws. What has fallen (`dem.start.falls`) is stopped in a step of the
    time step that the scene needs. What topples and is smooth rolls on over its flat side (`dem.start.toppling`).
    """
    grains, pressed, dt = scene.expected(), pressing(scene), recommended_step(scene)
    half = bodies.least_half_thickness(grains)
    allowed = OVERLAP * half
    with np.errstate(over="ignore", invalid="ignore"):  # inf: rigid
        speeds = _fastest_point(scene), fastest_tool(scene, about=True)
        thrown, pushed = (grains.mass * (speed / allowed) ** 2 for speed in speeds)
        needed = [_strongest(_load(scene, pressed) / allowed, thrown, pushed, STOPPED**2), pressed.force / allowed]
        needed += [_stopping(*impact, dt, FALLEN * half) for impact in _impacts(scene, pressed, dt)]
        stiffness = max(toppling(scene).stiffness, *(float(values.max()) for values in needed))
    return float(f"{stiffness:.1e}") if stiffness > 0.0 else np.inf  # the same on processors that round in other ways


def _fastest_point(scene: Scene) -> float:
    """The greatest speed of a point of a grain at time zero [m/s]: tips of what is no sphere turn, too."""
    grains = scene.expected()
    tips = bodies.turning(grains) * bodies.bounding_radius(grains)
    return float((scene.speeds(grains) + tips).max(initial=0.0))


def expected_overlap(scene: Scene, stiffness: float, dt: float) -> float:
    """Return the greatest overlap, as a part of a half thickness, that `recommended` would expect of a stiffness [N/m]
    in steps of dt [s]."""
    if np.isinf(stiffness):
        return 0.0
    grains, pressed = scene.expected(), pressing(scene)
    speeds = _fastest_point(scene), fastest_tool(scene, about=True)
    thrown, pushed = (speed * np.sqrt(grains.mass / stiffness) for speed in speeds)
    half = bodies.least_half_thickness(grains)
    overlaps = [_strongest(_load(scene, pressed) / stiffness, thrown, pushed, STOPPED)]
    overlaps.append(np.full(len(half), pressed.force / stiffness))
    overlaps += [_stopped(*impact, dt, stiffness) for impact in _impacts(scene, pressed, dt)]
    return max(toppling(scene).overlap(stiffness), *(float((values / half).max()) for values in overlaps))


def of_youngs_modulus(modulus: ArrayLike, radius: ArrayLike) -> float:
    """Return the stiffness E R [N/m] of the contact of two equal spheres of Young's modulus E [Pa] and radius R [m].

    Source: the linear law of Yade (Smilauer et al., documentation of `Ip2_FrictMat_FrictMat_FrictPhys`), for equal
    spheres; for others take the harmonic mean of E R of both."""
    return float(checks.positive("Young's modulus", modulus)) * float(checks.positive("radius", radius))


@loop
def gap_velocities(
    stiffness: Floats, material: Ints, mass: Floats, a: Ints, b: Ints, gap: Floats, dt: float, recovery_speed: float
) -> tuple[Floats, Floats, Floats]:
    """Stiffness (nc,), compliance (nc, 3) of normals and tangents, and the part of r (nc,) that closes gaps or pushes
    overlaps apart: gap / dt, of stiff contacts that overlap the share of `compliance`, of rigid ones at most the
    recovery speed.

    `stiffness` (materials, materials); `material` and `mass` of the bodies, which have the rows a, b (nc,)."""
    k, C, speed = np.empty(len(gap)), np.empty((len(gap), 3)), np.empty(len(gap))
    last, one, two, normal, tangent, share = -1.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for c in range(len(gap)):
        k[c] = stiffness[material[a[c]], material[b[c]]]
        if k[c] != last or mass[a[c]] != one or mass[b[c]] != two:  # many contacts are those of like bodies
            last, one, two = k[c], mass[a[c]], mass[b[c]]
            normal, tangent, share = compliance(last, 1.0 / (1.0 / one + 1.0 / two), dt)
        C[c, 0], C[c, 1], C[c, 2] = normal, tangent, tangent
        speed[c] = gap[c] / dt
        if speed[c] < 0.0:
            speed[c] *= share
        if np.isinf(k[c]) and speed[c] < -recovery_speed:
            speed[c] = -recovery_speed
    return k, C, speed


@loop
def compliance(stiffness: float, mass: float, dt: float) -> tuple[float, float, float]:
    """C of the normal and of the tangents [1/kg], and the share of gap / dt of an overlapping contact, for its
    stiffness [N/m] and the reduced mass of its bodies [kg]; 0, 0 and 1 of a rigid one."""
    if np.isinf(stiffness):
        return 0.0, 0.0, 1.0
    elastic = stiffness * dt**2
    C = 1.0 / (elastic + 2.0 * DAMPING * np.sqrt(stiffness * mass) * dt)
    return C, C / TANGENTIAL, elastic * C


@loop
def held_after(stiffness: Floats, compliance: Floats, dt: float, held: Floats, impulse: Floats) -> Floats:
    """The impulses (nc or more, 3) of a step, with what tangential springs hold after it in the place of the tangential
    ones of the first nc: all of these in rigid contacts, and nothing in those that bounce, whose C is zero."""
    out = np.empty((len(impulse), 3))
    for c in range(len(held)):
        out[c, 0] = impulse[c, 0]
        out[c, 1], out[c, 2] = _held_after(stiffness, compliance, dt, held, impulse, c)
    out[len(held) :] = impulse[len(held) :]
    return out


@inlined
def _held_after(stiffness, compliance, dt, held, impulse, c):
    share = 1.0 if np.isinf(stiffness[c]) else stiffness[c] * dt**2 * compliance[c, 0]
    one = held[c, 0] + share * (impulse[c, 1] - held[c, 0]) if share > 0.0 else 0.0
    other = held[c, 1] + share * (impulse[c, 2] - held[c, 1]) if share > 0.0 else 0.0
    return one, other


@loop
def elastic_energies(
    stiffness: Floats, compliance: Floats, dt: float, gap: Floats, linear: Floats, came: Floats, opening: Floats,
    before: tuple[Floats, Floats], impulse: Floats,
) -> tuple[float, float, float, float]:  # fmt: skip
    """What contacts hold as springs at the start and at the end of a step, along the normals and then along the
    tangents [J]. Rigid ones hold nothing.

    That is k/2 d^2 of an overlap d, of the `gap` (nc,) at the start, and after the step of the `linear` one (nc,) with
    the normal velocity `opening` (nc,). But of no more overlap than the normal impulses make, of this step and of the
    last one, which began with the gaps from which the contacts `came` (nc,) [m/s]: what a solver or the curves of
    surfaces leave beyond has done no work, and an implicit step does not give it back. And h^2 / (2 k_t dt^2) of the
    impulse h that a tangential spring holds. `before` is the normal impulse (nc,) of the last step, and what tangential
    springs hold at the start (nc, 2)."""
    last, held = before
    start, end, strained, strained_at_end = 0.0, 0.0, 0.0, 0.0
    for c in range(len(gap)):
        if np.isinf(stiffness[c]):
            continue
        k, per = stiffness[c], TANGENTIAL * stiffness[c] * dt**2
        start += 0.5 * k * _loaded_overlap(k, compliance[c, 0], dt, gap[c] - dt * came[c], gap[c], last[c]) ** 2
        after = linear[c] + dt * opening[c]
        end += 0.5 * k * _loaded_overlap(k, compliance[c, 0], dt, gap[c], after, impulse[c, 0]) ** 2
        one, other = _held_after(stiffness, compliance, dt, held, impulse, c)
        strained += 0.5 * (held[c, 0] ** 2 + held[c, 1] ** 2) / per
        strained_at_end += 0.5 * (one**2 + other**2) / per
    return start, end, strained, strained_at_end


@inlined
def _loaded_overlap(stiffness, compliance, dt, begin, gap, impulse):
    left = (1.0 - stiffness * dt**2 * compliance) * max(-begin, 0.0)  # of an overlap that no impulse has changed
    return max(min(-gap, dt * compliance * impulse + left), 0.0)


def _impacts(scene: Scene, pressed: Pressing, dt: float) -> list[tuple[Floats, float, float]]:
    """What meets a body or the bed in steps of dt [s]: masses (n,) for the grains that stand for all, speed [m/s], and
    how many layers of them come in a step."""
    every, start = scene.expected(), fastest_grain(scene)
    found = [(np.full(len(every), mass), speed, 1.0) for mass, speed in pressed.impacts]
    for acceleration in pressed.accelerations:
        last, block, gap, column = fall(scene, acceleration, start)
        found.append((every.mass, last, 1.0))
        if block > 0.0:
            most = float((column * (2.0 * bodies.bounding_radius(every)) ** 2 / every.mass).max())
            layers = min(most, block * dt / max(gap, 1e-300))
            found.append((every.mass, block, max(layers, 1.0)))
    return found


def _stopping(mass: Floats, speed: float, layers: float, dt: float, allowed: Floats) -> Floats:
    """The stiffness (n,) that stops these masses within the overlaps `allowed` (n,): the other way round as
    `_stopped`."""
    travel = layers * speed * dt / allowed
    x = np.sqrt(np.maximum(4.0 - layers + travel, 0.0)) - 2.0
    return mass * (np.where(x > 1.0, x, np.minimum(STOPPED * travel / layers, 1.0)) / dt) ** 2


def _stopped(mass: Floats, speed: float, layers: float, dt: float, stiffness: float) -> Floats:
    """How far (n,) masses (n,) that come with a speed go into a contact that stops them [m].

    An implicit step that is long beside t = sqrt(m / k) stops so many layers within v dt / (1 + 4 x + x^2), x = dt / t,
    of one layer; shorter ones resolve STOPPED of v t."""
    x = dt * np.sqrt(stiffness / mass)
    return speed * dt * np.where(x > 1.0, layers / (layers + 4.0 * x + x**2), STOPPED / x)


def _strongest(weight: Floats, thrown: Floats, pushed: Floats, single: float) -> Floats:
    """Of what the weight, the fastest grain and the fastest tool ask for on each grain (n,), the most: of the tool no
    more than the bed, or a `single` grain's part of it, resists. Without weight the bed is taken as stiff."""
    bed = np.where(weight > 0.0, np.maximum(RESISTS * weight, single * pushed), np.inf)
    strongest: Floats = np.maximum(np.maximum(weight, thrown), np.minimum(pushed, bed))
    return strongest


def _load(scene: Scene, pressed: Pressing) -> Floats:
    """The weight that the whole bed, or the stress of the cell, would lay on each of the grains that stand for all, and
    the strongest attraction (n,) [N]."""
    every, gravity = scene.expected(), math.hypot(*scene.gravity)
    pressure = scene.cell.pressure
    if gravity > 0.0:
        down = np.asarray(scene.gravity) / gravity
        pressure = max(_pressure(scene, gravity, down), _bed(scene, gravity, down))
    if scene.count:
        sizes = [(float(np.linalg.norm(force)), force) for force in pressed.spread]
        pressure += sum(size / area(scene, force / size) for size, force in sizes if size > 0.0)
    radius = bodies.bounding_radius(every)
    pull = scene.pairs(np.inf).strongest(2.0 * radius)
    load: Floats = np.maximum(CHAINS * pressure * (2.0 * radius) ** 2, gravity * every.mass) + pull
    return load


def _pressure(scene: Scene, gravity: float, down: Floats) -> float:
    """The weight of all bodies at time zero over the area of the bed [Pa]."""
    grains = scene.survey()
    if not grains.count:
        return 0.0
    free = [(body.mass, body.motion) for body in scene.large_bodies if isinstance(body.motion, Dynamic)]
    others = sum(mass * float(down @ motion.free_directions() @ down) for mass, motion in free)  # the rest is borne
    return gravity * (grains.mass + others) / area(scene, down)


def _bed(scene: Scene, gravity: float, down: Floats) -> float:
    """The pressure [Pa] at the bottom of a dense bed that reaches from the lowest body to the highest source: no source
    fills a scene further than that. 0 without sources."""
    top = scene.passages.boxes() @ down
    if not len(top):
        return 0.0
    places = [body.position + quaternion.rotate(body.quaternion, placed(shape)[1])
              for body in scene.large_bodies for shape in body.shapes]  # fmt: skip
    reach = [0.0 if isinstance(shape, Plane) else float(np.linalg.norm(placed(shape)[3]))
             for body in scene.large_bodies for shape in body.shapes]  # fmt: skip
    low = [place @ down + far for place, far in zip(places, reach)] + [ends.max() for ends in top]
    height = max(low) - min(ends.min() for ends in top)
    return DENSE * scene.passages.density * gravity * height
