"""What is likely a mistake in a scene, though it can be simulated."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from dem.bodies import bounding_radius
from dem.mesh import Mesh
from dem.start.falls import ends

if TYPE_CHECKING:
    from dem.scene import Scene

HUGE = 50.0  #: lengths of the bed; in millimetres a mesh as long as a twentieth of it is longer
LIGHT = 10.0  #: less than foams have [kg/m^3]; solids have 0.5 to 22.6 g/cm^3


def doubts(scene: Scene) -> str:
    """What is likely a mistake, in words: of materials, laws, densities, sizes, of what bears grains; empty if nothing
    is."""
    return "; ".join(filter(None, (scene.doubts(), _light(scene), _huge(scene), _bottomless(scene))))


def _light(scene: Scene) -> str:
    """Of a density that would be one in g/cm^3."""
    given = [float(part.given["density"].sample().min(initial=math.inf)) for part in scene.parts]
    least = min(given + [source.density for source in scene.passages.sources.values()], default=math.inf)
    return f"a density of {least:.3g} kg/m^3: is it in g/cm^3, which are 1000 kg/m^3?" if least < LIGHT else ""


def _huge(scene: Scene) -> str:
    """Of a mesh whose file is in millimetres, beside the grains at time zero."""
    if not scene.count:
        return ""
    grains = scene.survey()
    most = HUGE * float((grains.high - grains.low).max() + 2.0 * bounding_radius(grains.extremes).max())
    sizes = {body.name: 2.0 * float(shape.surface.half.max()) for body in scene.large_bodies for shape in body.shapes
             if isinstance(shape, Mesh)}  # fmt: skip
    found = [f"the mesh of {name!r} is {size:.3g} m long: is it in mm, scale=1e-3?" for name, size in sizes.items()
             if size > most]  # fmt: skip
    return "; ".join(found)


def _bottomless(scene: Scene) -> str:
    """Of grains that gravity drives, and that nothing can stop: neither a surface, nor what holds them or takes them
    away."""
    weight = math.hypot(*scene.gravity)
    held = any(scene.named.values()) or scene.passages.removes or scene.cell.periodic
    if not weight or held or not scene.count or any(map(len, ends(scene, scene.gravity / weight))):
        return ""
    return "the grains fall for ever, as no part of a large body is below them: a floor is Plane((0, 0, 1))"
