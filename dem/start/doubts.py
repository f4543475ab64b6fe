"""What is likely a mistake in a scene, though it can be simulated."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from dem import bodies
from dem.mesh import Mesh
from dem.parts.ends import Tie
from dem.scene import Scene, kinds_of
from dem.start.falls import ends
from dem.start.time_step import contact_distance
from dem.start.tools import hull

if TYPE_CHECKING:
    from dem.model.world import World

HUGE = 50.0  #: lengths of the bed; in millimetres a mesh as long as a twentieth of it is longer
HEAVY = 1e7  #: hundreds of times osmium: a body that is to be heavy beside others has less [kg/m^3]
ROUNDING = 1e-3  #: of places over the contact distance: by it rigid contacts shake grains with a hundredth of gravity
LIGHT = 10.0  #: less than foams have [kg/m^3]; solids have 0.5 to 22.6 g/cm^3
STEPS = 100  #: without room for the first grain of a source


def doubts(scene: Scene) -> str:
    """What is likely a mistake, in words: of materials, laws, densities, sizes, of what bears grains; empty if nothing
    is."""
    found = (look(scene) for look in (Scene.doubts, _density, _huge, _far, _remote, _bottomless))
    return "; ".join(filter(None, found))


def _density(scene: Scene) -> str:
    """Of densities that would be in g/cm^3, or that nothing has."""
    large = [body.density for body in scene.large_bodies if body.density is not None]
    sources = [source.density for source in scene.passages.sources.values()]
    every = np.hstack([np.zeros(0), *(part.given["density"].sample() for part in scene.parts), *large, *sources])
    least, most = every.min(initial=math.inf), every.max(initial=0.0)
    light = f"a density of {least:.3g} kg/m^3: is it in g/cm^3, which are 1000 kg/m^3?" if least < LIGHT else ""
    heavy = f"a density of {most:.3g} kg/m^3: no solid has more than 22600" if most > HEAVY else ""
    return "; ".join(filter(None, (light, heavy)))


def _huge(scene: Scene) -> str:
    """Of a mesh whose file is in millimetres, beside the grains at time zero."""
    most = HUGE * _bed(scene) or math.inf
    sizes = {body.name: 2.0 * float(shape.surface.half.max()) for body in scene.large_bodies for shape in body.shapes
             if isinstance(shape, Mesh)}  # fmt: skip
    found = [f"the mesh of {name!r} is {size:.3g} m long: is it in mm, scale=1e-3?" for name, size in sizes.items()
             if size > most]  # fmt: skip
    return "; ".join(found)


def _bed(scene: Scene) -> float:
    """The greatest length of the bed of grains at time zero along an axis [m]; 0 without."""
    if not scene.count:
        return 0.0
    grains = scene.survey()
    return float((grains.high - grains.low).max() + 2.0 * bodies.bounding_radius(grains.extremes).max())


def _far(scene: Scene) -> str:
    """Of anchors of joints and springs that are away from their bodies as if in millimetres."""
    hulls = map(hull, scene.large_bodies)
    widest = max([float((np.linalg.norm(point, axis=1) + radius).max()) for point, radius in hulls] + [_bed(scene)])
    found = [
        f"an anchor of the {kind} {name!r} is {away:.3g} m away from {end!r}: is it in mm?"
        for kind, _, members in kinds_of(Tie, scene.named) for name, tie in members.items()
        for end, anchor in zip(tie.ends, tie.anchors)
        if end is not None and (away := math.hypot(*anchor)) > HUGE * widest
    ]  # fmt: skip
    return "; ".join(found)


def _remote(scene: Scene) -> str:
    """Of grains so far from the origin that gaps drown in the rounding of their places."""
    if not scene.count:
        return ""
    grains, delta = scene.survey(), contact_distance(scene)
    away = float(np.abs([grains.low, grains.high]).max())
    coarse = float(np.spacing(away))
    if coarse <= ROUNDING * delta:
        return ""
    too = f"places are apart by {coarse:.2g} m in double precision, too coarse for contacts within {delta:.2g} m"
    return f"grains are up to {away:.3g} m away from the origin, where {too}: put the origin among the grains"


def _bottomless(scene: Scene) -> str:
    """Of grains that gravity drives, and that nothing can stop: neither a surface, nor what holds them or takes them
    away."""
    weight = math.hypot(*scene.gravity)
    held = any(scene.named.values()) or scene.passages.removes or scene.cell.axes[scene.gravity != 0.0].any()
    if not weight or held or not scene.count or any(map(len, ends(scene, scene.gravity / weight))):
        return ""
    return "the grains fall for ever, as no part of a large body is below them: a floor is Plane((0, 0, 1))"


class RoomWatch:
    """Tells once of sources whose first grains have found no room in STEPS steps."""

    def __init__(self) -> None:
        self._told: set[str] = set()

    def look(self, world: World, dt: float) -> str:
        """What to say after a step, most often nothing; on all ranks alike."""
        tallies = {name: world.passages.tallies[name] for name in world.passages.sources.keys() - self._told}
        found = sorted(name for name, tally in tallies.items() if tally.count == 0 and tally.refused >= STEPS)
        self._told.update(found)
        words = f"no grain in {STEPS} steps, as nowhere in its region there is room: is it within a body, or too small?"
        return "; ".join(f"source {name!r} makes {words}" for name in found)
