"""Figures of the steps, records and comparisons of a run, made with matplotlib. Each public function makes one figure
or one kind of figures."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter, MaxNLocator

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
BALANCE = ("kinetic_energy", "potential_energy", "work_of_motions", "friction_loss", "impact_loss", "time_stepping")
ALIKE = 5  # curves share axes if their greatest values differ by less than this factor


def steps(lines: Sequence[Mapping[str, Any]]) -> Figure:
    """Contacts, iterations, residual, peak memory and seconds of each step; ``lines`` are those of steps.jsonl."""
    time = np.array([line["time"] for line in lines])
    figure = Figure(figsize=(12.5, 6.4))
    panels = figure.subplot_mosaic([["contacts", "its", "seconds"], ["residual", "memory", "seconds"]])
    look = {"marker": "o" if len(lines) < 60 else None, "markersize": 3, "linewidth": 1.2}
    panels["contacts"].plot(time, [line["contacts"] for line in lines], color="C0", **look)
    panels["contacts"].set_ylabel("contacts")
    panels["contacts"].yaxis.set_major_locator(MaxNLocator(integer=True))
    _iterations(panels["its"], time, lines, look)
    _residuals(panels["residual"], time, lines, look)
    used = np.array([line.get("peak_memory", np.nan) / 2**20 for line in lines])
    panels["memory"].plot(time, used, color="C0", **look)
    panels["memory"].set_ylabel("peak memory of all ranks [MiB]")
    panels["memory"].set_ylim(0, 1.15 * max(np.nanmax(used, initial=0), 1))
    _seconds(panels["seconds"], time, lines)
    for name in ("residual", "memory", "seconds") if len(time) > 1 else ("residual", "memory"):
        panels[name].set_xlabel("time [s]")
    return figure


def _iterations(axes: Axes, time: np.ndarray, lines: Sequence[Mapping[str, Any]], look: Mapping[str, Any]) -> None:
    for label, counts in {
        "Newton steps": [line["newton_its"] for line in lines],
        "Krylov iterations": [line["ksp_its"] for line in lines],
        "APGD iterations": [line["iterations"] if line["solver"] == "apgd" else 0 for line in lines],
    }.items():
        if any(counts):
            axes.plot(time, counts, label=label, **look)
    axes.set_yscale("symlog", linthresh=1)
    axes.set_ylabel("iterations per step")
    axes.set_ylim(0, 2 * axes.get_ylim()[1])
    if axes.lines:
        axes.legend()


def _residuals(axes: Axes, time: np.ndarray, lines: Sequence[Mapping[str, Any]], look: Mapping[str, Any]) -> None:
    relaxed = [line.get("law", "relaxation") == "relaxation" for line in lines]
    values = np.array([line["natural_residual" if r else "coulomb_residual"] for line, r in zip(lines, relaxed)])
    positive = (values > 0) & np.isfinite(values)
    axes.semilogy(time[positive], values[positive], color="C0", **look)
    bad = np.array([not line["converged"] for line in lines])
    if bad.any():
        axes.semilogy(time[positive & bad], values[positive & bad], "x", color="C3", label="not converged")
    asked = np.array([line.get("tolerance", np.nan) for line in lines])
    if np.isfinite(asked).any():
        axes.plot(time, asked, color="black", linewidth=0.8, linestyle="--", label="tolerance")
    if axes.get_legend_handles_labels()[0]:
        axes.legend(fontsize="small")
    if positive.any():  # the axis has at least a decade, because it would have too few labels otherwise
        middle = np.sqrt(values[positive].min() * values[positive].max())
        low, high = axes.get_ylim()
        axes.set_ylim(min(low, 0.3 * middle), max(high, 3 * middle))
    axes.set_ylabel("natural residual" if all(relaxed) else "residual")


def _seconds(axes: Axes, time: np.ndarray, lines: Sequence[Mapping[str, Any]]) -> None:
    names = list(dict.fromkeys(name for line in lines for name in line["phases"]))
    table = np.array([[line["phases"].get(name, 0.0) for line in lines] for name in names])
    order = np.argsort(-table.sum(axis=1))
    shown, labels = table[order], [names[k] for k in order]
    if len(time) > 1:
        between = (time[1:] + time[:-1]) / 2
        edges = np.concatenate([[2 * time[0] - between[0]], between, [2 * time[-1] - between[-1]]])
        axes.stackplot(edges, np.hstack([shown, shown[:, -1:]]), labels=labels, step="post", alpha=0.85)
        axes.legend(ncols=3, fontsize="small", loc="lower center", bbox_to_anchor=(0.5, 1.0))
    else:
        axes.bar(labels, shown[:, 0])
    axes.set_ylabel("seconds per step")


def curves(records: Mapping[str, np.ndarray], analysis: Mapping[str, np.ndarray]) -> dict[str, Figure]:
    """The measured quantities of an experiment against the way of its tool, a figure per tool.

    For a column ``TOOL_position [m]`` the figure shows the columns of forces. For ``..._displacement [m]`` it shows the
    columns of stresses and the volume strain. It shows the raw values of records.csv, and the filtered values if
    analysis.csv has them. There is no figure without such columns.
    """
    made = {}
    for way in [head for head in records if re.search(r"_(position|displacement) \[m\]$", head)]:
        unit = "N" if "position" in way else "Pa"
        heads = [head for head in records if head.endswith(f" [{unit}]") and not re.match("(force|torque)_", head)]
        strain = analysis.get("volume_strain") if unit == "Pa" else None
        if not heads:
            continue
        figure = Figure(figsize=(9, 4.8 if strain is None else 7.2))
        axes, *below = figure.subplots(1 if strain is None else 2, 1, sharex=True, squeeze=False)[:, 0]
        shown = []
        for k, head in enumerate(heads):
            filtered = analysis.get(head.replace(" [", "_filtered [", 1))
            name, raw = head.rpartition(" [")[0].replace("_", " "), records[head]
            axes.plot(records[way], raw, color=f"C{k}", alpha=1 if filtered is None else 0.3, linewidth=0.9,
                      label=name if filtered is None else f"{name}, raw")
            shown.append(np.nanpercentile(raw, [0.5, 99.5]))  # peaks would flatten the rest
            if filtered is not None:
                axes.plot(records[way], filtered, color=f"C{k}", linewidth=1.6, label=f"{name}, filtered")
                shown.append(np.nanpercentile(filtered, [0, 100]))
        low, high = np.nanmin(shown), np.nanmax(shown)
        axes.set_ylim(low - 0.08 * (high - low), high + 0.08 * (high - low) or 1.0)
        axes.set_ylabel(f"{UNITS[unit]} [{unit}]")
        axes.legend(fontsize="small")
        for panel in below:
            panel.plot(records[way], strain, color="C0", linewidth=1.4)
            panel.set_ylabel("volume strain")
        figure.axes[-1].set_xlabel(way.replace("_", " "))
        made[way.rpartition("_")[0] + ("_force" if unit == "N" else "_stress")] = figure
    return made


def records(columns: Mapping[str, np.ndarray]) -> dict[str, Figure]:
    """The columns of records.csv over time: a figure for the energy balance, and a figure for each other unit in the
    heads ``name [unit]`` of the columns.

    Vectors have axes of their own. Columns whose values differ much in size do not share axes.
    """
    balance = [f"{name} [J]" for name in BALANCE]
    figures = {}
    if set(balance) <= set(columns):
        figures["energy"] = energy(columns)
    else:
        balance = []
    units: dict[str, list[str]] = {}
    for head in columns:
        found = re.search(r"\[(.*)\]$", head)
        if head not in ("step", "time [s]", *balance):
            units.setdefault(found.group(1) if found else "", []).append(head)
    for unit, heads in units.items():
        groups = _panels(columns, heads)
        wide = 1 if len(groups) < 4 else 2
        tall = -(-len(groups) // wide)
        figure = Figure(figsize=(6.5 + 3 * wide, max(4.2, 2.3 * tall)))
        panels = figure.subplots(tall, wide, sharex=True, squeeze=False)
        for axes, (name, members) in zip(panels.ravel(), groups.items()):
            for head in members:
                label = (head.rpartition(" [")[0] or head).removeprefix(f"{name}_").replace("_", " ")
                axes.plot(columns["time [s]"], columns[head], label=label, linewidth=1.2)
            _with_unit(axes, name.replace("_", " ").strip() or (UNITS.get(unit, "") if unit else ""), unit)
            if not any(np.any(columns[head]) for head in members):
                axes.set_ylim(-0.05, 1.0)
            if len(members) > 1:
                axes.legend(fontsize="small", ncols=3)
        for axes in panels.ravel()[len(groups) :]:
            axes.remove()
        for axes in panels.ravel()[len(groups) - wide : len(groups)]:
            axes.set_xlabel("time [s]")
            axes.tick_params(labelbottom=True)
        figures[UNITS.get(unit, re.sub(r"\W+", "_", unit).strip("_") or "others")] = figure
    return figures


def _panels(columns: Mapping[str, np.ndarray], heads: Sequence[str]) -> dict[str, list[str]]:
    """The columns that share axes, by the name of these axes.

    The components x, y, z of a vector share axes, and the name is that of the vector. Other columns of similar size
    share axes, and the name has only blanks. For a column alone it is the name of the column.
    """
    panels: dict[str, list[str]] = {}
    sizes: list[tuple[float, list[str]]] = []
    for head in heads:
        vector = re.fullmatch(r"(.+)_[xyz]( \[.*\])?", head)
        if vector:
            panels.setdefault(vector[1], []).append(head)
            continue
        size = float(np.nanmax(np.abs(columns[head]), initial=0.0))
        for other, members in sizes:
            if size == other or (min(size, other) > 0 and 1 / ALIKE < size / other < ALIKE):
                members.append(head)
                break
        else:
            sizes.append((size, [head]))
    for k, (_, members) in enumerate(sizes):
        single = members[0].rpartition(" [")[0] or members[0]
        panels[single if len(members) == 1 else " " * k] = members
    return panels


def _with_unit(axes: Axes, name: str, unit: str) -> None:
    """Label the vertical axis, with prefixes such as k and m before SI units."""
    if unit in ("N", "N m", "J", "Pa", "m", "W"):
        axes.yaxis.set_major_formatter(EngFormatter(unit=unit))
        axes.set_ylabel(name)
    else:
        axes.set_ylabel(f"{name} [{unit}]".strip() if unit else name)


def energy(columns: Mapping[str, np.ndarray]) -> Figure:
    """Energies, and the sums of the work and of the losses, over time. The lower axes show the drift: the change of

        kinetic + potential + losses - work

    since the beginning of the first step. The drift is the error of the time stepping. Potential energy counts from the
    first record."""
    time = columns["time [s]"]
    kinetic, potential, work, friction, impact, stepping = (columns[f"{name} [J]"] for name in BALANCE)
    curves = {
        "kinetic energy": kinetic,
        "potential energy, change": potential - potential[0],
        "work of moving bodies, sum": np.cumsum(work),
        "friction loss, sum": np.cumsum(friction),
        "impact loss, sum": np.cumsum(impact),
    }
    total = kinetic + curves["potential energy, change"] + np.cumsum(friction + impact - work)
    figure = Figure(figsize=(9.5, 6.4))
    above, below = figure.subplots(2, 1, sharex=True, height_ratios=(3, 2))
    for k, (label, values) in enumerate(curves.items()):
        above.plot(time, values, ("-", "-", "--", "-.", ":")[k], color=f"C{k}", label=label, linewidth=1.5)
    above.plot(time, total, color="black", linewidth=1.8, label="kinetic + potential + losses - work")
    below.plot(time, total - (total[0] - stepping[0]), color="black", linewidth=1.2, label="drift of the sum above")
    for axes, name in ((above, "energy"), (below, "drift")):
        _with_unit(axes, name, "J")
        axes.legend(fontsize="small", loc="center left", bbox_to_anchor=(1.0, 0.5))
    below.set_xlabel("time [s]")
    return figure


def compare(summary: Mapping[str, Mapping[str, float]]) -> Figure:
    """All compared preconditioners, also those that failed: Krylov iterations, and seconds for all systems of the
    run."""
    names = list(summary)
    rows = np.arange(len(names))
    keys = next(iter(summary.values()))
    column = {key: np.array([summary[name][key] for name in names], dtype=float) for key in keys}
    failed = column["converged"] < column["systems"]
    figure = Figure(figsize=(9, 1.6 + 0.42 * len(names)))
    its, seconds = figure.subplots(1, 2, sharey=True)
    its.barh(rows, column["ksp_its_mean"], color=["C3" if bad else "C0" for bad in failed], height=0.6)
    its.plot(column["ksp_its_max"], rows, "|", color="black", markersize=12, label="most for one system")
    its.set_xlabel("Krylov iterations per system")
    its.legend(loc="upper center", bbox_to_anchor=(0.5, 1.18), fontsize="small")
    seconds.barh(rows, column["setup_s"], color="C1", height=0.6, label="set-up")
    seconds.barh(rows, column["solve_s"], left=column["setup_s"], color="C0", height=0.6, label="solve")
    total = column["setup_s"] + column["solve_s"]
    for row, bad in enumerate(failed):
        text = f" {total[row]:.3g} s"
        if bad:
            text += f", {column['systems'][row] - column['converged'][row]:.0f} of {column['systems'][row]:.0f} failed"
        beyond = total[row] > 0.6 * total.max()
        seconds.text(
            total[row], row, text + " " * beyond, va="center", ha="right" if beyond else "left",
            color="white" if beyond else "C3" if bad else "black", fontsize="small",
        )
    seconds.set_xlabel(f"seconds for {column['systems'].max():.0f} systems")
    seconds.legend(ncols=2, loc="upper center", bbox_to_anchor=(0.5, 1.18), fontsize="small")
    its.set_yticks(rows, [f"{name}{' (fails)' if bad else ''}" for name, bad in zip(names, failed)])
    its.invert_yaxis()
    for axes in (its, seconds):
        axes.grid(axis="y", visible=False)
    return figure
