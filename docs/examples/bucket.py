"""A bucket from an STL file goes round and scoops stones, or spheres, out of a tray::

    python docs/examples/bucket.py bucket.stl  # writes the file, in millimetres; a drawing of your own does as well
    python -m pctt.run -scene docs/examples/bucket.py -scene_file bucket.stl -scene_grains stones \
        -dt 1e-3 -delta 1e-4 -ccp_type apgd -steps 1600 -output_every 20 -output bucket
    python -m pctt.render bucket -size 640x480
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from math import pi, sqrt

import numpy as np

from pctt import Experiment, Mesh, Plane, Rotation, Scene, option, perturbed

RADIUS = 0.004  # of a sphere [m]
ARM = 0.072  # from the axis to the middle of the bucket's bottom [m]


@dataclass(frozen=True)
class Bucket(Experiment):
    """Grains settle in a tray; then a bucket at the end of an arm turns once about a horizontal axis."""

    file: str = option("bucket.stl", "STL or OBJ file of the bucket, which opens along its z axis")
    scale: float = option(1e-3, "unit of the numbers in the file", unit="m")
    period: float = option(1.5, "time of a turn", unit="s")
    grains: str = option("spheres", "shape of the grains: spheres or stones")
    friction: float = option(0.5, "friction coefficient of all contacts")
    dt = 0.005
    delta = 0.001
    settling_time = 0.4

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.grains not in ("spheres", "stones"):
            raise ValueError(f"grains {self.grains}: allowed are spheres and stones")

    def build(self) -> Scene:
        """The scene, with the large bodies "tray" and "bucket"."""
        scene = Scene(self.friction)
        layers = 9 if self.grains == "stones" else 6
        x, y, z = ((np.arange(count) - (count - 1) / 2) * 2.4 * RADIUS for count in (20, 8, layers))
        places = perturbed(x, y, z - z[0] + 1.5 * RADIUS, 0.1 * RADIUS, 1)
        if self.grains == "stones":
            rng = np.random.default_rng(1)
            corners = rng.normal(size=(14, 3))
            corners *= 1.2 * RADIUS * np.array([1.0, 0.85, 0.7]) / np.linalg.norm(corners, axis=1)[:, None]
            turns, scale = rng.normal(size=(len(places), 4)), rng.uniform(0.7, 1.0, len(places))
            scene.add_polyhedra(places, corners, 2500.0, scale=scale, quaternions=turns)
        else:
            scene.add_spheres(places, RADIUS, 2500.0)
        walls = [Plane((0, 0, 1))]
        walls += [Plane((-side, 0, 0), (side * 0.1, 0, 0)) for side in (-1, 1)]
        walls += [Plane((0, -side, 0), (0, side * 0.042, 0)) for side in (-1, 1)]
        scene.add_body("tray", walls)
        # At the top of its way the bucket opens along x, the way that it goes.
        bucket = Mesh.read(self.file, self.scale, center=(-0.01, 0, ARM), quaternion=(sqrt(0.5), 0, sqrt(0.5), 0))
        axis = (0.0, 0.0, ARM + 0.036)
        turn = Rotation((0, 2 * pi / self.period, 0), axis, self.settling_time, self.settling_time + self.period)
        scene.add_body("bucket", [bucket], turn, position=axis)
        return scene

    def record(self, step):
        """The mass of the grains above the tray, and the torque that the arm bears."""
        grains = step.world.grains
        lifted = step.total(grains.mass[grains.position[:, 2] > ARM])
        return {"lifted [kg]": lifted, "arm_torque [N m]": -step.force_on("bucket")[4]}


if __name__ == "__main__":
    Mesh.revolved([(0, 0), (20, 0), (26, 32)], 24).write(sys.argv[1])  # a pail: bottom and side, in millimetres
