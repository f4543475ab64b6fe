"""The time step and the contact distance that a scene needs, from its sizes and speeds.

Four times matter: that in which the fastest tool goes a radius, that in which a grain falls about half of one,
sqrt(R / g), that in which a tool swings by a radian of its phase, and that in which a body that is no sphere turns by
one. docs/choose.md has the errors of forces on tools over dt.
"""

from __future__ import annotations

import math

import numpy as np

from dem import bodies, quaternion
from dem.arrays import Floats
from dem.contact.primitives import extents
from dem.parts.named import Pressing
from dem.scene import LargeBody, Scene
from dem.shapes import Plane
from dem.start.falls import fall
from dem.start.pressing import pressing
from dem.start.tools import DRIVEN, greatest_speed, hull, swing, top_speed
from dem.start.toppling import toppling
from dem.start.turns import TURN, held_beside, turning_of_grains, turning_of_large

FALLING = 0.1  #: the step in units of sqrt(R / g), where no tool is fast
FALLS = 1.5  #: the way in a step, in radii, of a grain that has fallen; two are the limit of `dem.step.fast`
FEW = 1e-3  #: of the recommended step: codes of soft contacts need such steps
PARTS = 20.0  #: radii over the contact distance; with 5, forces are the same and steps take a quarter longer


def recommended(scene: Scene) -> float:
    """Return the time step [s] with which forces on tools are within a few per cent of those of smaller steps, grains
    that fall go no further than FALLS of their half thicknesses, tools that swing go on by no more than TURN of their
    phase, bodies that are no spheres turn by no more than TURN at time zero, and the contacts of those that topple are
    foreseen, to two digits; 0.01 s for a scene without all that."""
    return min(needs(scene).values())


def needs(scene: Scene) -> dict[str, float]:
    """Return the time steps [s] that a scene needs, by what needs them."""
    found = {"grains that come to rest": for_settling(scene)}
    speed, pressed = fastest(scene), pressing(scene)
    pushed = max(math.hypot(*acceleration) for acceleration in pressed.accelerations)
    falls = max([falling(scene, pressed), *(speed for _, speed in pressed.impacts)])
    if speed > 0.0:
        found[f"what moves at {speed:.3g} m/s"] = _rounded(DRIVEN * smallest(scene) / speed)
    if falls > 0.0:
        found[f"falls to {falls:.3g} m/s"] = _rounded(FALLS * smallest(scene) / falls)
    if pushed > math.hypot(*scene.gravity):
        found[f"loads of {pushed:.3g} m/s^2"] = _rounded(FALLING * math.sqrt(smallest(scene) / pushed))
    found |= {what: _rounded(dt) for what, dt in scene.cell.needs(scene.expected()).items()}
    if (spin := fastest_turn(scene)) > 0.0:
        found[f"bodies that turn at {spin:.3g} rad/s"] = _rounded(TURN / spin)
    if (swings := max((swing(body, for_settling(scene)) for body in _staying(scene)), default=0.0)) > 0.0:
        found[f"tools that swing with {swings:.3g} rad/s"] = _rounded(TURN / swings)
    if (toppled := toppling(scene)).dt < np.inf:
        found[f"bodies that topple to {toppled.turn.max():.3g} rad/s"] = _rounded(toppled.dt)
    return found | {what: _rounded(step) for what, step in pressed.steps}


def reason(scene: Scene) -> str:
    """Return what the recommended time step is for."""
    found = needs(scene)
    return min(found, key=lambda name: found[name])


def fall_remark(scene: Scene, dt: float) -> str:
    """Return what to say of a dt [s] in which grains that fall go so far that `dem.step.fast` may end the run; empty if
    none do."""
    speed, size = falling(scene, pressing(scene)), smallest(scene)
    if dt * speed <= 2.0 * size:
        return ""
    most = _rounded(FALLS * size / speed)
    return f"dt {dt:g} s is too large: falls lead to {speed:.3g} m/s, further than two radii in a step; take {most:g} s"


def small_remark(scene: Scene, dt: float) -> str:
    """Return what to say of a dt [s] that is much less than the recommended one; empty if it is not."""
    usual = recommended(scene)
    if dt >= FEW * usual:
        return ""
    return f"dt {dt:g} s is {usual / dt:.1g} times less than this scene needs, and as many more steps; take {usual:g} s"


def falling(scene: Scene, pressed: Pressing) -> float:
    """Return the greatest speed with which a grain may meet a body or the bed, by gravity and loads [m/s]."""
    start = fastest_grain(scene)
    return max(fall(scene, acceleration, start).last for acceleration in pressed.accelerations)


def for_settling(scene: Scene) -> float:
    """Return the time step [s] in which grains fall and come to rest; 0.01 s without gravity."""
    gravity = math.hypot(*scene.gravity)
    return _rounded(FALLING * (float(np.sqrt(smallest(scene) / gravity)) if gravity > 0.0 else 0.1))


def contact_distance(scene: Scene) -> float:
    """Return the gap [m] below which a pair of bodies is a contact. What moves further within a step has a margin of
    its own, see `dem.contact.search`. Cohesion has a range that it covers."""
    return max(smallest(scene) / PARTS, scene.reach)


def distance_remark(scene: Scene, delta: float) -> str:
    """Return what to say of a contact distance [m] that is more than the greatest grain; empty if it is not."""
    widest = 2.0 * float(bodies.bounding_radius(scene.expected()).max(initial=0.0))
    if delta <= max(widest, scene.reach) or not widest:
        return ""
    usual = f"0.05 of the smallest radius, {contact_distance(scene):.3g} m, is usual"
    return f"delta {delta:g} m is more than the greatest grain, {widest:.3g} m: distant bodies become pairs; {usual}"


def smallest(scene: Scene) -> float:
    """Return the half thickness of the thinnest grain [m]; 0.1 m if there is none."""
    half: Floats = bodies.least_half_thickness(scene.expected())
    return float(half.min()) if len(half) else 0.1


def fastest(scene: Scene) -> float:
    """Return the greatest speed of a tool, or of a grain at time zero [m/s]."""
    return max(fastest_tool(scene), fastest_grain(scene))


def fastest_tool(scene: Scene, about: bool = False) -> float:
    """Return the greatest speed of a large body that stays with the grains [m/s]; of the balls about their places
    if `about`, by which the stiffness is chosen."""
    return max((_top_speed(body, about, for_settling(scene)) for body in _staying(scene)), default=0.0)


def fastest_grain(scene: Scene) -> float:
    """Return the greatest speed of a grain at time zero [m/s]; in a sheared cell beside the flow."""
    return float(scene.speeds(scene.expected()).max(initial=0.0))


def fastest_turn(scene: Scene) -> float:
    """Return the greatest angular speed at time zero of a body that forces move and that is no sphere, or that is held
    beside its centre [rad/s]."""
    grains, large = bodies.turning(scene.expected()), turning_of_large(scene.large(), scene.large_bodies)
    held = [turning_of_grains(scene.row(id), [id]) for id in held_beside(scene.named)]
    return float(np.concatenate([grains, large, *held]).max(initial=0.0))


def _staying(scene: Scene) -> list[LargeBody]:
    return [body for body in scene.large_bodies if body.name not in scene.leaving]


def _top_speed(body: LargeBody, about: bool, step: float) -> float:
    """The greatest speed of a point of a large body [m/s], or of the ball `about` its place; a plane has no end, and
    counts by the body's centre. `step` [s]: as of `dem.start.tools.top_speed`."""
    if about:
        shapes = tuple(shape for shape in body.shapes if not isinstance(shape, Plane))
        point, radius = np.zeros((1, 3)), extents([shapes]) if shapes else np.zeros(1)
    else:
        point, radius = hull(body)
    point = body.position + quaternion.rotate(body.quaternion, point)
    start = greatest_speed(body.velocity, body.position, point, radius)
    return max(start, top_speed(body, point, radius, step))


def _rounded(seconds: float) -> float:
    """Two digits, downwards: the same on processors that round in other ways."""
    digits = 10.0 ** (np.floor(np.log10(seconds * (1 + 1e-9))) - 1)
    return float(f"{np.floor(seconds * (1 + 1e-9) / digits) * digits:.2g}")
