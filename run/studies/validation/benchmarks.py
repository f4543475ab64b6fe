"""Runs against published benchmarks; each function reads folders of ``python -m pctt.run``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from shared import spread
from validation.laws import DENSITY, DIAMETER, GRAVITY, PACKING
from validation.rows import Row, band, row

from dem.arrays import Floats
from pctt.folder import Folder

MANKOC = "Mankoc et al. 2007 (arXiv:0707.4550)"
DOSTA = "Dosta et al. 2024, eight codes, as Peclet tells"
CODES = "MUSEN and LIGGGHTS by Peclet, on the case of Dosta et al. 2024"
LUBE = "Lajeunesse et al. 2004; Lube et al. 2004"
VESIC = "bearing capacity: Prandtl, Reissner; Vesić 1973 for a disc"
BRZINSKI = "Brzinski, Mayor, Durian 2013 (arXiv:1307.4638): 35 tan(angle)"

INTERNAL = (20.6, 26.8)  # degrees: such spheres in plane shear (docs/periodic.md), and in a heap

#: Times [s] and parts of M1 in the quadrant x < 0, z < 0 of the drum: its maximum, its fall to 0.1 and return to it.
DRUM = ((0.6, 0.765), (1.22, 0.1), (1.91, 0.1))

Found = tuple[list[Row], dict[str, Any]]


def mankoc_flow(outlet: Floats) -> Floats:
    """Spheres through an outlet of so many diameters, in sqrt(g / d) [1/s]: 64.6 of glass of 1 mm in a second and b =
    0.051 by Mankoc et al. (2007)."""
    wide = np.asarray(outlet) - 1.0
    return 64.6 / np.sqrt(GRAVITY / 0.001) * (1.0 - 0.5 * np.exp(-0.051 * wide)) * wide**2.5


def mankoc(folders: Mapping[float, Sequence[Path]], since: float = 0.2) -> Found:
    """Flows of a silo as wide and as full as the law asks, from `since` after the gate has opened [s]; means of some
    beds for each outlet."""
    sphere = DENSITY * np.pi / 6 * DIAMETER**3 * np.sqrt(GRAVITY / DIAMETER)

    def flow(folder: Path) -> float:
        records = Folder(folder).records()
        time, out = records["time [s]"], records["discharged [kg]"]
        late = time > time[out > 0.0][0] + since
        return float(np.polyfit(time[late], out[late], 1)[0] / sphere)

    outlet, found = np.array(list(folders)), []
    means, errors = zip(*(spread([flow(folder) for folder in several]) for several in folders.values()))
    for D, law, mean, error in zip(outlet, mankoc_flow(outlet), means, errors):
        what = f"spheres a second over sqrt(g/d), outlet of {D:g} diameters"
        found.append(row("mankoc", what, float(law), mean, MANKOC, "", 0.1, error))
    return found, {"outlet": outlet, "flow": np.array(means), "error": np.array(errors)}


def dosta(small: Path, large: Path, drum: Path) -> Found:
    """Spheres that flow out of the two silos in a second; and the part of the small ones in the quadrant x < 0, z < 0
    of the drum since it turns: its maximum, and when it falls to a tenth and is back."""
    sphere = 1000 * 2500.0 * 4 / 3 * np.pi * 0.002**3  # the mass of a thousand
    slow, fast = (Folder(folder).summary["analysis"]["mass_flow [kg/s]"] / sphere for folder in (small, large))
    run = Folder(drum)
    records = run.records()
    time, share = records["time [s]"] - 0.4, records["M1"]
    few = time[(time > 0.7) & (share < 0.1)]  # the times between; none if it does not fall so far
    gone, back = (float(few[0]), float(few[-1])) if len(few) else (np.nan, np.nan)
    most = float(share[time > 0.3].max())
    found = [
        band("dosta", "silo, large orifice: thousands of spheres a second", 22.04, 24.36, fast, DOSTA, ""),
        band("dosta", "silo, small orifice: thousands of spheres a second", 7.11, 7.86, slow, DOSTA, ""),
        band("dosta", "silo: flow of the large orifice over that of the small one", 3.04, 3.16, fast / slow, DOSTA, ""),
        row("dosta", "drum: largest part of the small spheres in a quadrant", DRUM[0][1], most, CODES, "", 0.1),
        row("dosta", "drum: time at which this part falls to 0.1", DRUM[1][0], gone, CODES, "s", 0.1),
        row("dosta", "drum: time at which it is back at 0.1", DRUM[2][0], back, CODES, "s", 0.1),
    ]
    return found, {"time": time, "share": share}


def runout(aspect: float) -> tuple[float, float]:
    """How much the radius of a column grows, over the radius, by Lajeunesse et al. and by Lube et al., in order; a is
    the height over the radius."""
    one = aspect if aspect < 3.0 else np.sqrt(3.0 * aspect)
    other = 1.24 * aspect if aspect < 1.7 else 1.6 * np.sqrt(aspect)
    return min(one, other), max(one, other)


def front(place: Floats, volume: Floats, least: float = 0.5 * DIAMETER) -> float:
    """Radius to which the bed of grains at `place` (n, 3) reaches [m]: where its thickness, in rings as wide as a
    grain, falls below `least` [m] first."""
    ring = (np.hypot(place[:, 0], place[:, 1]) / DIAMETER).astype(int)
    edges = np.arange(ring.max() + 2) * DIAMETER
    thick = np.append(np.bincount(ring, volume) / PACKING / (np.pi * np.diff(edges**2)), 0.0)
    k = int(np.argmax(thick < least))  # between the middles of the rings k - 1 and k
    return float((k - 0.5 + (thick[k - 1] - least) / (thick[k - 1] - thick[k])) * DIAMETER)


def collapse(beds: Sequence[tuple[float, Sequence[Path]]]) -> Found:
    """Run-out of columns of such radii [sphere diameters], means of some beds of each, by two experiments."""
    found: list[Row] = []
    shown: dict[str, list[float]] = {"aspect": [], "runout": [], "error": []}
    for wide, folders in beds:
        aspects, growths = zip(*(_fallen(Folder(folder), wide * DIAMETER) for folder in folders))
        aspect, grown = float(np.mean(aspects)), float(np.mean(growths))
        error = spread(growths)[1] if len(growths) > 1 else 0.0
        what = f"column of {aspect:.2f} radii, {wide:g} diameters to a radius: growth of the radius"
        found.append(band("collapse", what, *np.round(runout(aspect), 2), grown, LUBE, "radii", error))
        for name, value in zip(shown, (aspect, grown, error)):
            shown[name].append(value)
    return found, shown


def _fallen(run: Folder, radius: float, start: float = 0.5) -> tuple[float, float]:
    """Height of a column over its radius [m] at the time `start` [s], and by how much its radius grows, over it."""
    run.require_frames()
    frames = [run.frame(step) for step in run.steps]
    before, after = next(frame for frame in reversed(frames) if frame.time <= start), frames[-1]
    spheres = slice(run.grains)
    mass = run.mass[spheres]
    height = 2.0 * float(mass @ before.position[spheres, 2] / mass.sum())
    return height / radius, front(after.position[spheres], mass / DENSITY) / radius - 1.0


def bearing_capacity(degrees: float) -> tuple[float, float]:
    """Factors of the pressure on a disc of width B at depth z, q rho g z + s rho g B: with t the tangent of the angle,
    q = N (1 + t), s = 0.6 (N + 1) t, N = exp(pi t) tan(45 + angle/2)^2 (Vesić 1973)."""
    angle = np.radians(degrees)
    t = np.tan(angle)
    N = np.exp(np.pi * t) * np.tan(np.pi / 4 + angle / 2) ** 2
    return float(N * (1.0 + t)), float(0.6 * (N + 1.0) * t)


def intrusion(folders: Sequence[Path], radius: float = 3 * DIAMETER) -> Found:
    """Pressure on a plate from a depth of one sphere on, means of some beds: its slope, and its value at a depth of one
    radius; the first bed is shown."""
    curves = [_pressure(Folder(folder), radius) for folder in folders]
    fits = [np.polyfit(depth[depth > DIAMETER], pressure[depth > DIAMETER], 1) for depth, pressure in curves]
    weight = PACKING * DENSITY * GRAVITY
    K, K_error = spread([float(slope / weight) for slope, _ in fits])
    total, error = spread([float((slope + level / radius) / weight) for slope, level in fits])
    (q, s), (q2, s2) = map(bearing_capacity, INTERNAL)
    friction = [35.0 * float(np.tan(np.radians(angle))) for angle in INTERNAL]
    slopes, totals = np.round((q, q2), 1), np.round((q + 2 * s, q2 + 2 * s2), 1)
    what = "pressure on a plate at a depth of its radius, over that of the bed"
    return [
        band("intrusion", "slope of the pressure on a plate, over that of the bed", *slopes, K, VESIC, "", K_error),
        band("intrusion", what, *totals, total, VESIC, "", error),
        band("intrusion", "the same", *np.round(friction, 1), total, BRZINSKI, "", error),
    ], {"depth": curves[0][0], "pressure": curves[0][1], "fit": tuple(fits[0])}


def _pressure(run: Folder, radius: float) -> tuple[Floats, Floats]:
    """Depth [m] of a plate and pressure on it [Pa], at each step."""
    records = run.records()
    return records["surface [m]"] - records["plate [m]"], records["force_plate_z [N]"] / (np.pi * radius**2)
