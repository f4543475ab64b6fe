"""A sleeper is pressed into a bed of ballast, stones that are convex polyhedra::

    python -m pctt.run -scene docs/examples/ballast.py -ccp_tol 1e-5 -steps 1600 -output_every 40 -output ballast
    python -m pctt.render ballast -color speed -size 640x480
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pctt import Box, Experiment, Guided, Plane, Scene, option

PHI = 0.5 * (1 + 5**0.5)
CUBE = np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
PENTAGONS = np.array([(0, y / PHI, z * PHI) for y in (-1, 1) for z in (-1, 1)])
SHAPES = {
    "tetrahedra": CUBE[[0, 3, 5, 6]],
    "cubes": CUBE,
    "dodecahedra": np.concatenate([CUBE, *(np.roll(PENTAGONS, k, axis=1) for k in range(3))]),
}
ALLOWED = ("stones", "boxes", "spheres", *SHAPES)


@dataclass(frozen=True)
class Ballast(Experiment):
    """Stones fall into a box and settle; then a load presses a sleeper, which moves up and down only, into them."""

    n: int = option(6, "stones along each side of the box")
    radius: float = option(0.03, "of the spheres that enclose the largest stones", unit="m")
    shape: str = option("stones", f"of the grains: {', '.join(ALLOWED)}")
    load: float = option(1000.0, "on the sleeper", unit="N")
    settling_time: float = option(0.6, "when the load begins", unit="s")
    dt = 0.0005

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.shape not in ALLOWED:
            raise ValueError(f"shape {self.shape}: allowed is one of {', '.join(ALLOWED)}")

    def build(self) -> Scene:
        """The scene, with the large bodies "box" and "sleeper"."""
        scene, rng, pitch = Scene(0.6, stiffness=1e7), np.random.default_rng(0), 2.05 * self.radius
        place = pitch * (np.stack(np.meshgrid(*[np.arange(self.n)] * 3, indexing="ij"), axis=-1).reshape(-1, 3) + 0.5)
        turns = rng.normal(size=(len(place), 4))
        if self.shape == "stones":  # of four shapes, with 12 to 18 corners on an ellipsoid
            for k in range(4):
                corners = rng.normal(size=(12 + 2 * k, 3))
                corners *= self.radius / np.linalg.norm(corners, axis=1)[:, None] * [1.0, 0.85, 0.7]
                scale = rng.uniform(0.7, 1.0, len(place[k::4]))
                scene.add_polyhedra(place[k::4], corners, 2700.0, scale=scale, quaternions=turns[k::4])
        elif self.shape == "boxes":
            scene.add_boxes(place, [self.radius / 3**0.5] * 3, 2700.0, quaternions=turns)
        elif self.shape == "spheres":
            scene.add_spheres(place + rng.uniform(-0.02, 0.02, place.shape) * self.radius, self.radius, 2700.0)
        else:
            scene.add_polyhedra(place, SHAPES[self.shape] * self.radius / 3**0.5, 2700.0, quaternions=turns)
        side, top = self.n * pitch, self.n * pitch + self.radius
        walls = [Plane(s * np.eye(3)[k], (0.5 - 0.5 * s) * side * np.eye(3)[k]) for k in (0, 1) for s in (-1, 1)]
        scene.add_body("box", [Plane((0, 0, 1)), *walls])
        half, middle = (0.2 * side, 0.45 * side, self.radius), (0.5 * side, 0.5 * side, top)
        scene.add_body("sleeper", [Box(half)], Guided((0, 0, 1)), position=middle, density=600.0)
        scene.add_load("press", on="sleeper", force=(0, 0, -self.load), start=self.settling_time)
        return scene

    def record(self, step):
        """Height of the bottom of the sleeper, and mean height of the stones."""
        z = step.world.grains.position[:, 2]
        return {"sleeper [m]": step.position("sleeper")[2] - self.radius, "stones [m]": step.total(z) / self.n**3}
