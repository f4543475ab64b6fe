"""A box slides and a sphere rolls down a slope, as fast as the textbook says::

    python -m pctt.run -scene docs/examples/incline.py -ccp_type apgd -ccp_tol 1e-8 -steps 100 \
        -output_every 10 -output incline
    python -m pctt.render incline -color speed -azimuth -90 -elevation 15 -size 640x480
"""

from __future__ import annotations

from dataclasses import dataclass
from math import cos, radians, sin

import numpy as np

from pctt import Experiment, Plane, Scene, option

GRAVITY = 9.81  # [m/s^2]


@dataclass(frozen=True)
class Incline(Experiment):
    """A box and a sphere start at rest on a slope that falls along x; the slope is steep enough for the box to slide,
    and rough enough for the sphere to roll."""

    angle: float = option(25.0, "of the slope, from the horizontal", unit="degrees")
    friction: float = option(0.3, "friction coefficient of all contacts")
    dt = 0.01
    delta = 0.005
    half, radius = 0.05, 0.05  # m

    def __post_init__(self) -> None:
        super().__post_init__()
        slope = np.tan(radians(self.angle))
        if not self.friction < slope < 3.5 * self.friction:
            raise ValueError(
                f"angle {self.angle:g}: its tangent must be between friction and 3.5 friction, "
                f"{self.friction:g} and {3.5 * self.friction:g}, for the box to slide and the sphere to roll"
            )

    @property
    def down(self) -> np.ndarray:
        """Unit vector down the slope."""
        return np.array([cos(radians(self.angle)), 0, -sin(radians(self.angle))])

    def build(self) -> Scene:
        """The scene, with the large body "slope"."""
        scene = Scene(self.friction, gravity=(0, 0, -GRAVITY))
        turn, up = radians(self.angle) / 2, (sin(radians(self.angle)), 0, cos(radians(self.angle)))
        along_slope = (cos(turn), 0, sin(turn), 0)  # turned by the angle about y
        scene.add_boxes(self.half * np.array([up]) + [0, -0.1, 0], [self.half] * 3, 1000.0, quaternions=along_slope)
        scene.add_spheres(self.radius * np.array([up]) + [0, 0.1, 0], self.radius, 1000.0)
        scene.add_body("slope", [Plane(up)])
        return scene

    def record(self, step):
        """The speeds down the slope."""
        grains = step.world.grains
        speed = grains.velocity[:, :3] @ self.down
        return {f"{name}_speed [m/s]": step.total(speed[grains.id == k]) for k, name in enumerate(("box", "sphere"))}

    def analyse(self, records):
        """Accelerations: g (sin a - mu cos a) of a sliding box, 5/7 g sin a of a rolling sphere, and those found."""
        a, time = radians(self.angle), records["time [s]"][-1]
        exact = {"box": GRAVITY * (sin(a) - self.friction * cos(a)), "sphere": 5 / 7 * GRAVITY * sin(a)}
        found = {name: records[f"{name}_speed [m/s]"][-1] / time for name in exact}
        return {
            **{f"{name}_acceleration [m/s^2]": value for name, value in found.items()},
            **{f"{name}_error [m/s^2]": found[name] - exact[name] for name in exact},
        }
