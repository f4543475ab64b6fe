"""The panels of the pictures: each draws on axes what a check shows."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from validation import benchmarks, packings

Shown = Mapping[str, Any]


def silo(panel: Any, shown: Shown) -> None:
    wide = np.linspace(-shown["level"] / shown["slope"], 7.0)
    panel.plot(wide, shown["slope"] * wide + shown["level"], color="C7", label="Beverloo's law, fitted")
    panel.plot(shown["outlet"], shown["flow"] ** 0.4, "o", color="C0")
    panel.plot([], [], "o", color="C0", label="silo")
    panel.set(xlabel="outlet [sphere diameters]", ylabel="flow$^{2/5}$ [(kg/s)$^{2/5}$]")


def mankoc(panel: Any, shown: Shown) -> None:
    wide = np.linspace(1.5, 7.0)
    panel.plot(wide, benchmarks.mankoc_flow(wide), color="C7", label="Mankoc et al., glass")
    panel.errorbar(shown["outlet"], shown["flow"], shown["error"], fmt="o", color="C0", label="means of beds")
    panel.set(xlabel="outlet [sphere diameters]", ylabel="spheres a second / (g/d)$^{1/2}$")


def heap(panel: Any, shown: Shown) -> None:
    for mu, angle, z in zip(shown["friction"], shown["angle"], shown["height"]):
        label = f"friction {mu:g}: {angle:.1f} $\\pm$ {shown['error']:.1f} degrees"
        (line,) = panel.plot(1e3 * shown["x"], 1e3 * z.mean(axis=0), "o-", markersize=3, label=label)
        low, high = 1e3 * z.min(axis=0), 1e3 * z.max(axis=0)
        panel.fill_between(1e3 * shown["x"], low, high, color=line.get_color(), alpha=0.15)
    panel.set(xlabel="distance from the edge [mm]", ylabel="surface, mean and range of beds [mm]", ylim=(0.0, None))


def drum(panel: Any, shown: Shown) -> None:
    panel.plot(shown["time"], shown["angle"], linewidth=0.9, label="drum")
    panel.axhspan(20.9, 32.8, color="C7", alpha=0.25, label="glass beads, mu(I)")
    panel.axhline(shown["mean"], color="C0", linestyle=":", label=f"mean, {shown['mean']:.1f} degrees")
    panel.set(xlabel="time [s]", ylabel="angle of the bed [degrees]")


def column(panel: Any, shown: Shown) -> None:
    height, law = 1e3 * shown["height"], shown["law"]
    for stress, style, label in (
        (shown["weight"], "C7--", "weight above"),
        (law, "C0-", "vertical stress, Janssen"),
        (shown["vertical"], "C0o", "vertical stress"),
        (shown["ratio"] * law, "C1-", "wall's pressure, Janssen"),
        (shown["pressure"], "C1o", "wall's pressure"),
    ):
        panel.plot(stress, height, style, label=label)
    panel.set(xlabel="stress [Pa]", ylabel="height [mm]")


def dosta(panel: Any, shown: Shown) -> None:
    panel.plot(*zip(*benchmarks.DRUM), "o", color="C7", label="MUSEN, LIGGGHTS")
    panel.plot(shown["time"], shown["share"], color="C0", label="drum of Dosta et al., a slice")
    panel.set(xlabel="time since the drum turns [s]", ylabel="part of M1 in a quadrant", xlim=(0.0, None))


def collapse(panel: Any, shown: Shown) -> None:
    aspect = np.linspace(0.2, 3.5)
    band = np.array([benchmarks.runout(a) for a in aspect])
    panel.fill_between(aspect, *band.T, color="C7", alpha=0.4, label="Lajeunesse et al., Lube et al.")
    panel.errorbar(shown["aspect"], shown["runout"], shown["error"], fmt="o", color="C0", label="means of beds")
    panel.set(xlabel="height over radius", ylabel="growth of the radius, over the radius")


def packing(panel: Any, shown: Shown) -> None:
    edges = np.arange(0.0, 5.2, 0.2)
    f = np.linspace(0.0, 5.0)
    for (name, force), color in zip(shown.items(), ("C0", "C1")):
        b, beta = packings.exponential_tail(force)
        density, _ = np.histogram(force, edges, density=True)
        label = f"{name}: $\\beta$ = {beta:.2f}"
        panel.semilogy(0.5 * (edges[1:] + edges[:-1]), density, "o", color=color, markersize=4, label=label)
        panel.semilogy(f, packings.mueth(f, b, beta), color=color, linewidth=0.9)
    panel.set(xlabel="normal force over its mean", ylabel="probability density, and fits")


def intrusion(panel: Any, shown: Shown) -> None:
    depth, (slope, level) = shown["depth"], shown["fit"]
    there = depth > 0.0
    panel.plot(1e3 * depth[there], 1e-3 * shown["pressure"][there], linewidth=0.9, label="plate")
    panel.plot(1e3 * depth[there], 1e-3 * (slope * depth[there] + level), color="C7", label="fit")
    panel.set(xlabel="depth [mm]", ylabel="pressure [kPa]")


PANELS: dict[str, Callable[[Any, Shown], None]] = {
    "silo": silo, "heap": heap, "drum": drum, "column": column, "mankoc": mankoc, "dosta": dosta,
    "collapse": collapse, "packing": packing, "intrusion": intrusion,
}  # fmt: skip
