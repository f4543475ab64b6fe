"""Figures of a run, made with matplotlib. Each public function makes one figure or one kind of figures."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter

from pctt.folder import Folder

STYLE = {
    "axes.axisbelow": True,
    "axes.grid": True,
    "axes.spines.right": False,
    "axes.spines.top": False,
    "figure.constrained_layout.use": True,
    "font.size": 10,
    "grid.alpha": 0.3,
    "legend.frameon": False,
    "savefig.dpi": 150,
}

# names of the figures for the columns of records.csv, by the unit in the heads of the columns
UNITS = {
    "": "statistics", "N": "forces", "N m": "torques", "J": "energies", "m": "lengths", "m/s": "velocities",
    "Pa": "stresses", "kg": "masses", "degrees": "angles",
}
# columns of the energy balance (dem.record.energy_balance)
BALANCE = (
    "kinetic_energy", "potential_energy", "spring_energy", "work_of_motions", "friction_loss", "impact_loss",
    "time_stepping",
)  # fmt: skip
# energies that some runs have in the balance too, with the sign of what they bring, and those that it explains
OTHERS = {
    "work_of_cohesion": 1, "energy_of_sources": 1, "energy_of_outlets": -1, "spring_energy_before": 0, "energy_jump": 0
}  # fmt: skip


def figures(folder: Folder) -> dict[str, Figure]:
    """All figures of a run by name."""
    lines, columns, compared = folder.lines(), folder.records(), folder.summary.get("compare")
    made = {"steps": steps(lines)} if lines else {}
    if columns:
        made |= {**records(columns), **curves(columns, folder.analysis())}
    if compared:
        made["compare"] = compare(compared)
    return made


def steps(lines: Sequence[Mapping[str, Any]]) -> Figure:
    """Contacts, iterations, residual, peak memory and seconds of each step; ``lines`` are those of steps.jsonl."""
    time = np.array([line["time"] for line in lines])
    figure = Figure(figsize=(12.5, 6.4))
    panels = figure.subplot_mosaic([["contacts", "its", "seconds"], ["residual", "memory", "seconds"]])
    panels["contacts"].plot(time, [line["contacts"] for line in lines])
    panels["contacts"].set_ylabel("contacts")
    for label, counts in {
        "Newton steps": [line["newton_its"] for line in lines],
        "Krylov iterations": [line["ksp_its"] for line in lines],
        "APGD iterations": [line["iterations"] if line["solver"] == "apgd" else 0 for line in lines],
    }.items():
        if any(counts):
            panels["its"].plot(time, counts, label=label)
            panels["its"].legend()
    panels["its"].set_yscale("symlog", linthresh=1)
    panels["its"].set_ylabel("iterations per step")
    relaxed = [line.get("law", "relaxation") == "relaxation" for line in lines]
    values = np.array([line["natural_residual" if r else "coulomb_residual"] for line, r in zip(lines, relaxed)])
    values[~(np.isfinite(values) & (values > 0))] = np.nan
    bad = np.array([not line["converged"] for line in lines])
    panels["residual"].semilogy(time, values)
    panels["residual"].semilogy(time[bad], values[bad], "x", color="C3", label="not converged")
    tolerances = [line.get("tolerance", np.nan) for line in lines]
    panels["residual"].plot(time, tolerances, color="black", linewidth=0.8, linestyle="--", label="tolerance")
    panels["residual"].legend(fontsize="small")
    panels["residual"].set_ylabel("natural residual" if all(relaxed) else "residual")
    panels["memory"].plot(time, [line.get("peak_memory", np.nan) / 2**20 for line in lines])
    panels["memory"].set_ylabel("peak memory of all ranks [MiB]")
    panels["memory"].set_ylim(bottom=0)
    table = {name: [line["phases"].get(name, 0.0) for line in lines] for line in lines for name in line["phases"]}
    names = sorted(table, key=lambda name: -sum(table[name]))
    if len(time) > 1:
        panels["seconds"].stackplot(time, [table[name] for name in names], labels=names, alpha=0.85)
        panels["seconds"].legend(ncols=3, fontsize="small", loc="lower center", bbox_to_anchor=(0.5, 1.0))
    else:
        panels["seconds"].bar(names, [table[name][0] for name in names])
    panels["seconds"].set_ylabel("seconds per step")
    for axes in panels.values():
        axes.set_xlabel("time [s]" if axes is not panels["seconds"] or len(time) > 1 else "")
        for curve in axes.lines if len(time) < 60 else ():
            curve.set(marker=curve.get_marker().replace("None", "o"), markersize=4)
    return figure


def curves(records: Mapping[str, np.ndarray], analysis: Mapping[str, np.ndarray]) -> dict[str, Figure]:
    """The measured quantities of an experiment against the way of its tool, a figure per tool.

    For a column ``TOOL_position [m]`` the figure shows the columns of forces. For ``..._displacement [m]`` it shows the
    columns of stresses and the volume strain. It shows the raw values of records.csv, and the filtered values if
    analysis.csv has them. There is no figure without such columns.
    """
    made = {}
    for abscissa in [head for head in records if re.search(r"_(position|displacement) \[m\]$", head)]:
        unit = "N" if "position" in abscissa else "Pa"
        heads = [head for head in records if head.endswith(f" [{unit}]") and not re.match("(force|torque)_", head)]
        strain = analysis.get("volume_strain") if unit == "Pa" else None
        if not heads:
            continue
        figure = Figure(figsize=(9, 4.8 if strain is None else 7.2))
        axes, *below = figure.subplots(1 if strain is None else 2, 1, sharex=True, squeeze=False)[:, 0]
        shown = []
        for k, head in enumerate(heads):
            filtered = analysis.get(head.replace(" [", "_filtered [", 1), np.full_like(records[abscissa], np.nan))
            name, raw = head.rpartition(" [")[0].replace("_", " "), records[head]
            axes.plot(records[abscissa], raw, color=f"C{k}", alpha=0.4, linewidth=0.9, label=f"{name}, raw")
            shown += [*np.nanpercentile(raw, [0.5, 99.5])]  # peaks would flatten the rest
            if np.isfinite(filtered).any():
                axes.plot(records[abscissa], filtered, color=f"C{k}", linewidth=1.6, label=f"{name}, filtered")
                shown += [np.nanmin(filtered), np.nanmax(filtered)]
        room = 0.08 * (max(shown) - min(shown)) or 1.0
        axes.set_ylim(min(shown) - room, max(shown) + room)
        axes.set_ylabel(f"{UNITS[unit]} [{unit}]")
        axes.legend(fontsize="small")
        for panel in below:
            panel.plot(records[abscissa], strain)
            panel.set_ylabel("volume strain")
        figure.axes[-1].set_xlabel(abscissa.replace("_", " "))
        made[abscissa.rpartition("_")[0] + ("_force" if unit == "N" else "_stress")] = figure
    return made


def records(columns: Mapping[str, np.ndarray]) -> dict[str, Figure]:
    """The columns of records.csv over time: a figure for the energy balance, and a figure for each other unit in the
    heads ``name [unit]`` of the columns. The components of a vector share axes."""
    balance = {f"{name} [J]" for name in BALANCE}
    made = {"energy": energy(columns)} if balance <= set(columns) else {}
    balance |= {f"{name} [J]" for name in OTHERS}
    units: dict[str, dict[str, list[str]]] = {}
    for head in columns:
        if head not in ("step", "time [s]") and not (made and head in balance):
            name, unit = re.fullmatch(r"(.*?)(?: \[(.*)\])?", head).groups("")  # type: ignore[union-attr]
            units.setdefault(unit, {}).setdefault(re.sub("_[xyz]$", "", name), []).append(head)
    for unit, panels in units.items():
        wide = 1 if len(panels) < 4 else 2
        tall = -(-len(panels) // wide)
        figure = Figure(figsize=(6.5 + 3 * wide, max(4.2, 2.3 * tall)))
        for axes, (name, heads) in zip(figure.subplots(tall, wide, squeeze=False).ravel(), panels.items()):
            for head in heads:
                axes.plot(columns["time [s]"], columns[head], label=head[len(name) + 1 :][:1])
            _with_unit(axes, name.replace("_", " "), unit)
            if len(heads) > 1:
                axes.legend(fontsize="small", ncols=3)
        for axes in figure.axes[len(panels) - wide :]:
            axes.set_xlabel("time [s]")
        for axes in figure.axes[len(panels) :]:
            axes.remove()
        made[UNITS.get(unit, re.sub(r"\W+", "_", unit).strip("_") or "others")] = figure
    return made


def _with_unit(axes: Axes, name: str, unit: str) -> None:
    """Label the vertical axis, with prefixes such as k and m before SI units."""
    if unit in ("N", "N m", "J", "Pa", "m", "W"):
        axes.yaxis.set_major_formatter(EngFormatter(unit=unit))
        unit = ""
    axes.set_ylabel(f"{name} [{unit}]" if unit else name)


def energy(columns: Mapping[str, np.ndarray]) -> Figure:
    """Energies, and the sums of the work and of the losses, over time. The lower axes show the drift: the change of

        kinetic + potential + spring + losses - work

    since the beginning of the first step. The drift is the error of the time stepping. Potential energy counts from the
    first record."""
    time = columns["time [s]"]
    kinetic, potential, elastic, work, friction, impact, stepping = (columns[f"{name} [J]"] for name in BALANCE)
    work = work + sum(sign * columns.get(f"{name} [J]", 0.0) for name, sign in OTHERS.items())
    total = kinetic + elastic + potential - potential[0] + np.cumsum(friction + impact - work)
    figure = Figure(figsize=(9.5, 6.4))
    above, below = figure.subplots(2, 1, sharex=True, height_ratios=(3, 2))
    above.plot(time, kinetic, label="kinetic energy")
    above.plot(time, potential - potential[0], label="potential energy, change")
    above.plot(time, np.cumsum(work), "--", label="work of moving bodies, sum")
    above.plot(time, np.cumsum(friction), "-.", label="friction loss, sum")
    above.plot(time, np.cumsum(impact), ":", label="impact loss, sum")
    above.plot(time, total, color="black", linewidth=1.8, label="kinetic + potential + spring + losses - work")
    below.plot(time, total - (total[0] - stepping[0]), color="black", label="drift of the sum above")
    for axes, name in ((above, "energy"), (below, "drift")):
        _with_unit(axes, name, "J")
        axes.legend(fontsize="small", loc="center left", bbox_to_anchor=(1.0, 0.5))
    below.set_xlabel("time [s]")
    return figure


def compare(summary: Mapping[str, Mapping[str, float]]) -> Figure:
    """All compared preconditioners, also those that failed: Krylov iterations, and seconds for all systems of the
    run."""
    column = {key: np.array([row[key] for row in summary.values()]) for key in next(iter(summary.values()))}
    lost = column["systems"] - column["converged"]
    names = [f"{name} ({n:.0f} fail)" if n else name for name, n in zip(summary, lost)]
    figure = Figure(figsize=(9, 1.6 + 0.42 * len(names)))
    its, seconds = figure.subplots(1, 2, sharey=True)
    its.barh(names, column["ksp_its_mean"], color=np.where(lost > 0, "C3", "C0"), height=0.6)
    its.plot(column["ksp_its_max"], names, "|", color="black", markersize=12, label="most for one system")
    its.set_xlabel("Krylov iterations per system")
    seconds.barh(names, column["setup_s"], color="C1", height=0.6, label="set-up")
    bars = seconds.barh(names, column["solve_s"], left=column["setup_s"], color="C0", height=0.6, label="solve")
    seconds.bar_label(bars, [f" {total:.3g} s" for total in column["setup_s"] + column["solve_s"]], fontsize="small")
    seconds.set_xlabel(f"seconds for {column['systems'].max():.0f} systems")
    its.invert_yaxis()
    for axes in (its, seconds):
        axes.grid(axis="y", visible=False)
        axes.legend(ncols=2, loc="upper center", bbox_to_anchor=(0.5, 1.18), fontsize="small")
    return figure
