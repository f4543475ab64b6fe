"""Random packings under pressure in a periodic cell: contacts, solid fraction, and the distribution of the forces."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from mpi4py import MPI
from scipy.optimize import minimize
from scipy.special import erfcx
from shared import spread
from validation.rows import Row, band, row

from dem.measures import bearing
from dem.packing import random_packing
from dem.scene import Scene
from pctt.simulation import Simulation

DIAMETER, DENSITY, PRESSURE = 0.01, 2500.0, 1000.0  # [m], [kg/m^3], [Pa]
COUNT, SEEDS, FRICTION = 1500, (1, 2), 0.3
AGNOLIN = "Agnolin, Roux 2007 (arXiv:0705.3194)"
MUETH = "Mueth, Jaeger, Nagel 1998: 1.5; Løvoll, Måløy, Flekkøy 1999: 1.8; Radjai et al. 1996: 1.4"


class Packing(NamedTuple):
    """A packing at rest."""

    fraction: float  #: solid fraction
    contacts: float  #: contacts of a grain, without the grains that bear nothing
    rattlers: float  #: share of these
    force: np.ndarray  #: (nc,) normal forces over their mean


def packing(friction: float, seed: int, first: float | None = None, tol: float = 1e-4) -> Packing:
    """Spheres that are pressed together, from a random packing of the solid fraction `first`; then the pressure falls
    to a tenth, so that they overlap by 5e-4 diameters. Without friction they begin denser (if `first` is not given), as
    a packing closes slowly near its end. Coulomb's law is solved to `tol`."""
    first = first or (0.45 if friction else 0.58)
    side = DIAMETER * (COUNT * np.pi / 6 / first) ** (1 / 3)
    place, radius = random_packing((side,) * 3, DIAMETER / 2, first, periodic=(True,) * 3, seed=seed)
    stress = (PRESSURE,) * 3
    scene = Scene(friction, (0, 0, 0), stiffness=1000 * PRESSURE * DIAMETER, period=(side,) * 3, stress=stress)
    scene.add_spheres(place, radius, DENSITY)
    sim = Simulation(scene, dt=0.003, solver="apgd", tol=tol, comm=MPI.COMM_SELF)
    sim.run(steps=400 if friction else 800)
    sim.change("cell", stress=(PRESSURE / 10,) * 3)
    sim.run(steps=200)
    sample, period = sim.sample, sim.period
    on = bearing(sample)
    held, alive = backbone(sample.bodies[on], sample.count, 2 if friction else 4)
    force = np.einsum("ck,ck->c", sample.force, sample.normal)[on][held]
    fraction = float(sample.volume.sum() / np.prod(period))
    return Packing(fraction, 2.0 * held.sum() / alive.sum(), 1.0 - float(alive.mean()), force / force.mean())


def backbone(bodies: np.ndarray, count: int, least: int) -> tuple[np.ndarray, np.ndarray]:
    """Masks of the contacts (nc,) of `bodies` (nc, 2) and of the grains (count,) that remain when grains with fewer
    than `least` contacts are taken away again and again."""
    alive = np.ones(count, bool)
    while True:
        held = alive[bodies].all(axis=1)
        loose = alive & (np.bincount(bodies[held].ravel(), minlength=count) < least)
        if not loose.any():
            return held, alive
        alive &= ~loose


def mueth(force: np.ndarray, b: float, beta: float) -> np.ndarray:
    """P(f) = a (1 - b exp(-f^2)) exp(-beta f) of forces (n,) over their mean, with an integral of 1: Mueth, Jaeger,
    Nagel (1998), Phys. Rev. E 57, 3164."""
    integral = 1.0 / beta - b * np.sqrt(np.pi) / 2.0 * erfcx(beta / 2.0)
    return (1.0 - b * np.exp(-(force**2))) * np.exp(-beta * force) / integral


def exponential_tail(force: np.ndarray) -> tuple[float, float]:
    """The most likely b and beta of `mueth` of forces (n,) over their mean."""

    def unlikely(given: np.ndarray) -> float:
        b, beta = given
        return -float(np.log(mueth(force, b, beta)).sum()) if b < 1.0 and beta > 0.0 else np.inf

    b, beta = minimize(unlikely, (0.75, 1.5), method="Nelder-Mead").x
    return float(b), float(beta)


def rows() -> tuple[list[Row], dict[str, Any]]:
    """Packings without friction and with it; means of the seeds."""
    smooth, rough = ([packing(friction, seed) for seed in SEEDS] for friction in (0.0, FRICTION))
    found = []
    for packs, what, z, phi, allowed in (
        (smooth, "no friction", 6.0, 0.639, 0.01),
        (rough, f"friction {FRICTION:g}", 4.5, 0.593, 0.05),
    ):
        mean, error = spread([pack.contacts for pack in packs])
        found.append(row("packing", f"{what}: contacts of a sphere that bears", z, mean, AGNOLIN, "", allowed, error))
        mean, error = spread([pack.fraction for pack in packs])
        found.append(row("packing", f"{what}: solid fraction", phi, mean, AGNOLIN, "", 0.01, error))
        mean, error = spread([exponential_tail(pack.force)[1] for pack in packs])
        found.append(band("packing", f"{what}: decay of the normal forces, beta", 1.4, 1.8, mean, MUETH, "", error))
    shown = {"no friction": smooth, f"friction {FRICTION:g}": rough}
    return found, {name: np.concatenate([pack.force for pack in packs]) for name, packs in shown.items()}
