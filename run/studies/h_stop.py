"""Where flows down a rough incline stop: the scene `incline` is tilted less and less, until it rests.

    run/study h_stop [LAYERS ...] [--rate DEGREES] [--seeds M]

A bed of so many layers (default 2 3 4 6 8 12) flows for two seconds at three degrees more than the law below. Then the
angle falls at the rate (0.25) in degrees a second; a bed takes a while to stop, so a faster fall finds too low an
angle. It has stopped when its mean speed is below a hundredth of sqrt(g d), over half a second. Prints the height
h / d, from the mass with a solid fraction of 0.59, the angle at which it stops, and that of the law of glass beads,
h_stop = 1.65 d (tan 32.8 - tan a) / (tan a - tan 20.9); of several seeds the mean angle, with its standard error. The
form of the law is that of Pouliquen, Phys. Fluids 11 (1999) 542, with constants of Jop, Forterre, Pouliquen, Nature 441
(2006) 727, and Forterre, Pouliquen, J. Fluid Mech. 486 (2003) 21. Writes results/h_stop.json, and its table of
docs/scenes.md if there are several seeds.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import atan, degrees, pi, radians, sqrt, tan
from typing import Any

import numpy as np
from shared import ROOT, Row, Table, at_least_one, markdown, parser, record, replace_table, say_machine, spread

import pctt
from dem.experiment import option
from dem.scene import Scene
from pctt.scenes import Incline

FLOWS, ABOVE = 2.0, 3.0  # s at the first angle; degrees of it above the law
SLOW, LASTING = 0.01, 0.5  # of sqrt(g d); s
FRACTION = 0.59
LOW, HIGH, LENGTH = 20.9, 32.8, 1.65  # degrees, degrees, diameters


@dataclass(frozen=True)
class Levelled(Incline):
    """An incline whose angle falls after a while."""

    fall: float = option(0.5, "rate at which the angle falls after two seconds", unit="deg/s")

    def angle_at(self, time: float) -> float:
        """[degrees]"""
        return self.angle - self.fall * max(time - FLOWS, 0.0)

    def build(self) -> Scene:
        """The scene: a load turns the gravity of the first angle."""
        scene = super().build()

        def turn(time: float, table: Any) -> Any:
            now = radians(self.angle_at(time))
            pull = self.gravity * np.array([np.sin(now), 0.0, -np.cos(now)])
            return table.mass[:, None] * (pull - np.asarray(scene.gravity))

        scene.add_load("tilt", force=turn)
        return scene

    @property
    def layer_height(self) -> float:
        """Of the bed at rest over the diameter."""
        return self.n * pi / 6.0 / ((self.pitch / 2.0) ** 2 * FRACTION)


def law(height: float) -> float:
    """The angle [degrees] at which a bed of glass beads of this height over diameter stops."""
    low, high = tan(radians(LOW)), tan(radians(HIGH))
    return degrees(atan((height * low + LENGTH * high) / (height + LENGTH)))


def stopped(layers: int, rate: float, seed: int) -> dict[str, Any]:
    """The angle at which a bed stops, and what it took."""
    scene = Levelled(n=layers, fall=rate, seed=seed)
    scene = replace(scene, angle=law(scene.layer_height) + ABOVE)
    sim = pctt.Simulation(scene, solver="apgd")
    limit, calm = SLOW * sqrt(2.0 * scene.gravity * scene.radius), 0
    steps, missed = round(LASTING / sim.settings.dt), 0
    while scene.angle_at(sim.time) > 10.0 and calm < steps:
        sim.step()
        missed += not sim.figures["converged"]
        calm = calm + 1 if sim.figures["speed [m/s]"] < limit else 0
    angle, height = scene.angle_at(sim.time - LASTING), scene.layer_height
    found = {"layers": layers, "seed": seed, "spheres": len(sim.ids), "height [d]": height, "angle": angle}
    return found | {"glass beads": law(height), "steps": sim.steps, "missed": missed}


def write_page(rows: list[Row]) -> None:
    """The table of docs/scenes.md."""
    lines = []
    for layers in dict.fromkeys(row["layers"] for row in rows):
        mine = [row for row in rows if row["layers"] == layers]
        angles = [row["angle"] for row in mine]
        mean, error = spread(angles)
        each = ", ".join(f"{angle:.1f}" for angle in angles)
        lines.append([layers, f"{mine[0]['height [d]']:.1f}", each, f"{mean:.1f} ± {error:.1f}",
                      f"{mine[0]['glass beads']:.1f}"])  # fmt: skip
    heads = ["layers", "h / d", "stops at", "mean [degrees]", "glass beads"]
    replace_table(ROOT / "docs" / "scenes.md", "**Where flows stop.**", markdown(heads, lines))


def main() -> None:
    words = parser("h_stop", __doc__)
    words.add_argument("layers", nargs="*", type=at_least_one, metavar="LAYERS", help="(2 3 4 6 8 12)")
    words.add_argument("--rate", type=float, default=0.25, help="at which the angle falls, degrees a second (0.25)")
    words.add_argument("--seeds", type=at_least_one, default=1, help="beds of each height (1)")
    given = words.parse_args()
    about, rows = say_machine(), list[Row]()
    table = Table(layers=("layers", "6d"), seed=("seed", "4d"), h_over_d=("height [d]", "8.2f"),
                  stops_at=("angle", "8.2f"), glass_beads=("glass beads", "11.2f"),
                  missed=("missed", "6d"))  # fmt: skip
    for layers in given.layers or (2, 3, 4, 6, 8, 12):
        for seed in range(1, given.seeds + 1):
            rows.append(stopped(layers, given.rate, seed))
            table.add(rows[-1])
        if given.seeds > 1:
            mean, error = spread([row["angle"] for row in rows[-given.seeds :]])
            print(f"{layers:6d}  mean {mean:.2f} +- {error:.2f}", flush=True)
    record("h_stop", about, rows)
    if given.seeds > 1:
        write_page(rows)


if __name__ == "__main__":
    main()
