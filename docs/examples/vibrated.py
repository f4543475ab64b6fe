"""Large spheres rise among small ones in a shaken box, the Brazil nut effect::

    python -m pctt.run -scene docs/examples/vibrated.py -ccp_type apgd -steps 1500 -output_every 10 -output vibrated
    python -m pctt.render vibrated -color size -size 640x480
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pctt import Experiment, Oscillation, Plane, Scene, measures, option, perturbed


@dataclass(frozen=True)
class Vibrated(Experiment):
    """Spheres of two sizes settle in a box, which then oscillates upwards and downwards."""

    n: int = option(8, "spheres along each side of the box")
    radius: float = option(0.02, "radius of a large sphere; a small one has half of it", unit="m")
    amplitude: float = option(0.01, "of the oscillation", unit="m")
    frequency: float = option(10.0, "of the oscillation", unit="Hz")
    settling_time: float = option(0.8, "when the oscillation begins", unit="s")
    dt = 0.002

    def build(self) -> Scene:
        """The scene, with the large body "can"."""
        scene, pitch = Scene(0.3), 2.2 * self.radius
        line, side = (np.arange(self.n) + 0.5) * pitch, self.n * pitch
        places = perturbed(line, line, line, 0.05 * self.radius, 1)
        large = np.random.default_rng(0).random(len(places)) < 0.2
        scene.add_spheres(places[large], self.radius, 2500.0, material="large")
        scene.add_spheres(places[~large], 0.5 * self.radius, 2500.0, material="small")
        walls = [Plane(s * np.eye(3)[k], (0.5 - 0.5 * s) * side * np.eye(3)[k]) for k in (0, 1) for s in (-1, 1)]
        shaking = Oscillation((0, 0, 1), self.amplitude, 1 / self.frequency, start=self.settling_time)
        scene.add_body("can", [Plane((0, 0, 1)), *walls], shaking)
        return scene

    def record(self, step):
        """Mean heights of both sizes, and their difference over their sum."""
        sample = step.sample
        large, small = (measures.mean_position(sample, sample.of_material(name))[2] for name in ("large", "small"))
        return {"large_z [m]": large, "small_z [m]": small, "segregation": (large - small) / (large + small)}
