"""Many rigid bodies with hard contacts, cone complementarity problems with friction, tensor trains; on PETSc.

A scene is built of ``Scene``, shapes and motions, and ``Simulation`` makes its steps; all names of ``__all__`` are here
at first use (`pctt.ccp` solves cone problems, and `pctt.pc` has preconditioners, without any of them)::

    from pctt import Plane, Scene, Simulation

    scene = Scene(friction=0.5)
    scene.add_body("floor", [Plane((0, 0, 1))])
    scene.add_spheres([0, 0, 0.3], radius=0.1, density=2500.0)
    sim = Simulation(scene)
    sim.run(until=0.5)
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from dem import measures as measures
    from dem.experiment import Experiment as Experiment
    from dem.experiment import option as option
    from dem.measures import Block as Block
    from dem.mesh import Mesh as Mesh
    from dem.motion import Dynamic as Dynamic
    from dem.motion import Fixed as Fixed
    from dem.motion import Glide as Glide
    from dem.motion import Guided as Guided
    from dem.motion import Held as Held
    from dem.motion import Hinged as Hinged
    from dem.motion import Oscillation as Oscillation
    from dem.motion import Path as Path
    from dem.motion import Rotation as Rotation
    from dem.packing import perturbed as perturbed
    from dem.packing import random_packing as random_packing
    from dem.parts.sizes import Listed as Listed
    from dem.parts.sizes import Uniform as Uniform
    from dem.scene import Scene as Scene
    from dem.shapes import Box as Box
    from dem.shapes import Capsule as Capsule
    from dem.shapes import Clump as Clump
    from dem.shapes import Cylinder as Cylinder
    from dem.shapes import Plane as Plane
    from dem.shapes import Sphere as Sphere
    from dem.shapes import Superellipsoid as Superellipsoid
    from pctt.beds import read_spheres as read_spheres
    from pctt.folder import Folder as Folder
    from pctt.simulation import Settings as Settings
    from pctt.simulation import Simulation as Simulation

__version__ = "0.4.0"

#: Where the names are at home. They are found at first use: PETSc starts with some, and ``petsc4py.init`` may come
#: before, and a user of preconditioners alone needs none.
_HOMES = {
    "dem": "measures",
    "dem.experiment": "Experiment option",
    "dem.measures": "Block",
    "dem.mesh": "Mesh",
    "dem.motion": "Dynamic Fixed Glide Guided Held Hinged Oscillation Path Rotation",
    "dem.packing": "perturbed random_packing",
    "dem.parts.sizes": "Listed Uniform",
    "dem.scene": "Scene",
    "dem.shapes": "Box Capsule Clump Cylinder Plane Sphere Superellipsoid",
    "pctt.beds": "read_spheres",
    "pctt.folder": "Folder",
    "pctt.simulation": "Settings Simulation",
}
_HOME = {name: home for home, names in _HOMES.items() for name in names.split()}
__all__ = sorted(_HOME)  # noqa: PLE0605


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        from dem.checks import nearest

        raise AttributeError(f"module 'pctt' has no attribute {name!r}{nearest(name, __all__)}")
    home = import_module(_HOME[name])
    return import_module("dem.measures") if name == "measures" else getattr(home, name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
