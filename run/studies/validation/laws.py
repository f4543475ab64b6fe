"""Runs of silo, heap, drum and column against published laws; each function reads folders of ``python -m pctt.run``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from validation.rows import Row, above, band, row

from pctt.folder import Folder

BEVERLOO = "Beverloo, Leniger, van de Velde 1961; Mankoc et al. 2007 (arXiv:0707.4550)"
JOP = "Jop, Forterre, Pouliquen 2006: glass beads, mu(I) from tan 20.9 to tan 32.8 degrees"
ZHOU = "Zhou, Xu, Yu, Zulli 2001: the angle grows with the friction"
ROUX = "Peyneau, Roux 2008: 5.76 degrees without friction; Jop et al. 2006: 20.9 to 32.8 for glass beads"
REST = "a heap is at rest"
JANSSEN = "Janssen 1895 (Sperl 2006)"
RANKINE = "Rankine's active state of 20.9 degrees, and equal stresses"

DIAMETER, DENSITY, GRAVITY, PACKING, WALL_FRICTION = 0.01, 2500.0, 9.81, 0.58, 0.5


def silo(folders: Mapping[float, Sequence[Path]]) -> tuple[list[Row], dict]:
    """Flow against the diameter of the outlet [sphere diameters]; a fit for each bed, and means of the fits."""
    outlet = np.array(list(folders))
    flow = np.array([[_analysis(folder)["mass_flow [kg/s]"] for folder in several] for several in folders.values()])
    slope, level = np.polyfit(outlet, flow**0.4, 1)
    unit = PACKING * DENSITY * np.sqrt(GRAVITY) * DIAMETER**2.5
    fits = np.array([np.polyfit(np.log(outlet - 1.4), np.log(flow), 1)[0], -level / slope, slope**2.5 / unit])
    (exponent, k, C), errors = fits.mean(axis=1), fits.std(axis=1, ddof=1) / np.sqrt(flow.shape[1])
    straight = float(np.abs((outlet * slope.mean() + level.mean()) ** 2.5 / flow.mean(axis=1) - 1.0).max())
    found = [
        row("silo", "exponent of the flow in D - 1.4 d", 2.5, float(exponent), BEVERLOO, "", 0.1, float(errors[0])),
        row("silo", "worst deviation of a mean flow from the fitted law", 0.0, straight, BEVERLOO, "", 0.1),
        band("silo", "k of the fitted law (D - k d)^5/2", 1.0, 2.0, float(k), BEVERLOO, "", float(errors[1])),
        band("silo", "C of the fitted law", 0.55, 0.65, float(C), BEVERLOO, "", float(errors[2])),
    ]
    return found, {"outlet": outlet, "flow": flow, "slope": slope.mean(), "level": level.mean()}


def _analysis(folder: Path) -> dict[str, float]:
    """What the scene of a run found."""
    return Folder(folder).summary["analysis"]


def heap(folders: Mapping[float, Sequence[Path]]) -> tuple[list[Row], dict]:
    """Slopes of what rests, against friction; means of as many beds for each.

    Beds of one friction differ by chance, and no more or less for another friction: all of them tell how much.
    """
    frictions = list(folders)
    beds = [[profile(folder) for folder in several] for several in folders.values()]
    angles = np.array([[bed.angle for bed in several] for several in beds])
    angle, scatter = angles.mean(axis=1), float(np.sqrt(angles.var(axis=1, ddof=1).mean()))
    error = scatter / np.sqrt(angles.shape[1])
    moving = float(np.mean([bed.moving for several in beds for bed in several]))
    found = [row("heap", "share of a heap's spheres that still move, mean of all beds", 0.0, moving, REST, "", 0.05)]
    for mu, degrees in zip(frictions, angle):
        what = f"angle of repose at friction {mu:g}, spheres without rolling resistance"
        high = 20.9 if mu < 0.3 else 32.8
        found.append(band("heap", what, 5.76, high, float(degrees), ROUX, "degrees", error))
    for mu, more, growth in zip(frictions, frictions[1:], np.diff(angle)):
        what = f"growth of this angle from friction {mu:g} to {more:g}"
        found.append(above("heap", what, 0.0, float(growth), np.sqrt(2.0) * error, ZHOU, "degrees"))
    height = np.array([[bed.height for bed in several] for several in beds])
    shown = {"friction": frictions, "angle": angle, "error": error, "scatter": scatter}
    return found, {**shown, "x": beds[0][0].x, "height": height}


class Profile(NamedTuple):
    """The surface of a heap at the end of a run."""

    x: np.ndarray  #: distance from the edge of the middles of bins a diameter wide [m]
    height: np.ndarray  #: of the surface in the bins [m]
    angle: float  #: of the line through them [degrees]
    moving: float  #: share of the heap's spheres that are faster than 10 mm/s


def profile(folder: Path) -> Profile:
    """The last frame. The surface is at twice the mean height of the mass in a bin: this scatters less than the highest
    of a few spheres. The line weighs the bins by their mass; those at the lip and at the wall do not count."""
    run = Folder(folder)
    run.require_frames()
    frame = run.frame(run.steps[-1])
    place = frame.position[: run.grains]
    heap = (place[:, 0] < 0.0) & (place[:, 2] > 0.0)
    place, mass = place[heap], run.mass[: run.grains][heap]
    column = (-place[:, 0] / DIAMETER).astype(int)
    held, moment = (np.bincount(column, weights)[1:-1] for weights in (mass, mass * place[:, 2]))
    x, height = (np.arange(len(held)) + 1.5) * DIAMETER, 2.0 * moment / held
    slope = np.polyfit(x, height, 1, w=np.sqrt(held))[0]
    moving = float((frame.speed[: run.grains][heap] > 0.01).mean())
    return Profile(x, height, float(np.degrees(np.arctan(slope))), moving)


def drum(folder: Path) -> tuple[list[Row], dict]:
    """Angle of the flowing bed."""
    angle, columns = _analysis(folder)["dynamic_angle [degrees]"], Folder(folder).records()
    found = [band("drum", "dynamic angle at Froude number 0.01, friction 0.5", 20.9, 32.8, angle, JOP, "degrees")]
    return found, {"time": columns["time [s]"], "angle": columns["bed_angle [degrees]"], "mean": angle}


def column(folder: Path, radius: float = 0.04, bins: int = 8) -> tuple[list[Row], dict]:
    """Stresses on the wall and the bottom of a column whose bottom has been lowered, mean of the last steps."""
    run = Folder(folder)
    run.require_frames()
    frames = [run.frame(step) for step in run.steps if step >= 0.66 * run.steps[-1]]
    wall, bottom = run.grains, run.grains + 1
    height = float(np.mean([frame.position[:wall, 2].max() for frame in frames])) + 0.5 * DIAMETER
    edges = np.linspace(0.0, height, bins + 1)
    normal, upwards, borne = np.zeros(bins), np.zeros(bins), 0.0
    for frame in frames:
        contact = frame.contacts
        on = (contact.bodies == wall).any(axis=1)
        part = np.clip(np.digitize(contact.point[on, 2], edges) - 1, 0, bins - 1)
        on_grain = np.where(contact.bodies[on, 1] == wall, -1.0, 1.0) * contact.force[on, 2]
        normal += np.bincount(part, contact.impulse[on, 0] / contact.dt, bins) / len(frames)
        upwards += np.bincount(part, on_grain, bins) / len(frames)
        borne += np.abs(contact.force[(contact.bodies == bottom).any(axis=1), 2]).sum() / len(frames)
    weight = float(run.mass[:wall].sum()) * GRAVITY
    area, side = np.pi * radius**2, 2.0 * np.pi * radius * height / bins
    middle = 0.5 * (edges[1:] + edges[:-1])
    above = weight * (1.0 - middle / height) - (np.cumsum(upwards[::-1])[::-1] - 0.5 * upwards)
    vertical, pressure = above / area, normal / side
    deep = slice(0, bins - 2)  # near the surface there is little of either
    ratio = float(pressure[deep].sum() / vertical[deep].sum())
    rubs = float(upwards[deep].sum() / normal[deep].sum())
    length = radius / (2.0 * ratio * rubs)

    def janssen(friction: float) -> float:
        """Force on the bottom by Janssen's law with this friction of the wall [N]."""
        length = radius / (2.0 * ratio * friction)
        return weight / height * length * (1.0 - np.exp(-height / length))

    law = weight / height / area * length * (1.0 - np.exp(-(height - middle) / length))
    off = float(np.abs(pressure[deep] / (ratio * law[deep]) - 1.0).max())
    found = [
        row("column", "force on the bottom, by K and friction of the run", janssen(rubs), borne, JANSSEN, "N", 0.1),
        row("column", "the same, by the coefficient of friction", janssen(WALL_FRICTION), borne, JANSSEN, "N", 0.1),
        row("column", "worst deviation of the wall's pressure from Janssen's profile", 0.0, off, JANSSEN, "", 0.2),
        band("column", "K, wall's pressure over vertical stress", 0.474, 1.0, ratio, RANKINE, ""),
    ]
    weight_only = weight / area * (1.0 - middle / height)
    shown = {"height": middle, "pressure": pressure, "vertical": vertical, "law": law}
    return found, {**shown, "ratio": ratio, "weight": weight_only, "rubs": rubs}
