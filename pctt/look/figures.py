"""Figures of a run, by matplotlib: each function makes one."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import scipy.sparse as sp
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from pctt.look.folder import Folder, Frame

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

# names of the figures of what records.csv holds, by the unit in the heads of its columns
UNITS = {"N": "forces", "N m": "torques", "J": "energy", "m": "lengths", "m/s": "velocities", "Pa": "stresses"}


def steps(lines: Sequence[Mapping[str, Any]]) -> Figure:
    """Contacts, iterations, residual, peak memory and seconds of each step; ``lines``: the steps of summary.json."""
    time = np.array([line["time"] for line in lines])
    figure = Figure(figsize=(12.5, 6.4))
    panels = figure.subplot_mosaic([["contacts", "its", "seconds"], ["residual", "memory", "seconds"]])
    contacts, its, residual, memory, seconds = (
        panels[name] for name in ("contacts", "its", "residual", "memory", "seconds")
    )
    marker = "o" if len(lines) < 60 else None
    look = {"marker": marker, "markersize": 3, "linewidth": 1.2}

    contacts.plot(time, [line["contacts"] for line in lines], color="C0", **look)
    contacts.set_ylabel("contacts")
    contacts.yaxis.set_major_locator(MaxNLocator(integer=True))

    first_order = np.array([line["iterations"] if line["solver"] == "apgd" else 0 for line in lines])
    for label, counts in {
        "Newton steps": np.array([line["newton_its"] for line in lines]),
        "Krylov iterations": np.array([line["ksp_its"] for line in lines]),
        "APGD iterations": first_order,
    }.items():
        if counts.any():
            its.plot(time, counts, label=label, **look)
    its.set_yscale("symlog", linthresh=1)
    its.set_ylabel("per step")
    its.set_ylim(bottom=0)
    if its.lines:
        its.legend()

    values = np.array([line["natural_residual"] for line in lines])
    good = np.array([line["converged"] for line in lines])
    positive = values > 0
    residual.semilogy(time[positive], values[positive], color="C0", **look)
    if not good.all():
        bad = positive & ~good
        residual.semilogy(time[bad], values[bad], "x", color="C3", label="not converged")
        residual.legend()
    residual.set_ylabel("natural residual")

    memory.plot(time, [line.get("peak_memory", np.nan) / 2**20 for line in lines], color="C0", **look)
    memory.set_ylabel("peak memory of all ranks [MiB]")
    memory.set_ylim(bottom=0)

    names = list(dict.fromkeys(name for line in lines for name in line["phases"]))
    table = np.array([[line["phases"].get(name, 0.0) for line in lines] for name in names])
    order = np.argsort(-table.sum(axis=1))
    shown, labels = table[order], [names[k] for k in order]
    if len(time) > 1:
        seconds.stackplot(time, shown, labels=labels, step="mid", alpha=0.85)
        seconds.legend(ncols=3, fontsize="small", loc="lower center", bbox_to_anchor=(0.5, 1.0))
    else:
        seconds.bar(labels, shown[:, 0])
    seconds.set_ylabel("seconds per step")
    for axes in (residual, memory, seconds) if len(time) > 1 else (residual, memory):
        axes.set_xlabel("time [s]")
    return figure


def curves(records: Mapping[str, np.ndarray], analysis: Mapping[str, np.ndarray]) -> dict[str, Figure]:
    """What an experiment measures against how far its tool has gone: for a column ``TOOL_position [m]`` the columns of
    forces, for ``..._displacement [m]`` those of stresses and the volume strain; raw, and filtered where the analysis
    has it. The columns are those of records.csv and analysis.csv; no figure without them."""
    made = {}
    for way in [head for head in records if re.search(r"_(position|displacement) \[m\]$", head)]:
        unit = "N" if "position" in way else "Pa"
        heads = [head for head in records if head.endswith(f" [{unit}]") and not re.match("(force|torque)_", head)]
        strain = analysis.get("volume_strain") if unit == "Pa" else None
        if not heads:
            continue
        figure = Figure(figsize=(9, 4.8 if strain is None else 7.2))
        axes, *below = figure.subplots(1 if strain is None else 2, 1, sharex=True, squeeze=False)[:, 0]
        for k, head in enumerate(heads):
            filtered = analysis.get(head.replace(" [", "_filtered [", 1))
            name, raw = head.rpartition(" [")[0].replace("_", " "), records[head]
            axes.plot(records[way], raw, color=f"C{k}", alpha=1 if filtered is None else 0.3, linewidth=0.9,
                      label=name if filtered is None else f"{name}, raw")
            if filtered is not None:
                axes.plot(records[way], filtered, color=f"C{k}", linewidth=1.6, label=f"{name}, filtered")
        low, high = np.nanpercentile([records[head] for head in heads], [0.5, 99.5])
        axes.set_ylim(low - 0.08 * (high - low), high + 0.08 * (high - low) or 1.0)  # few peaks would flatten the rest
        axes.set_ylabel(f"{UNITS[unit]} [{unit}]")
        axes.legend(fontsize="small")
        for panel in below:
            panel.plot(records[way], strain, color="C0", linewidth=1.4)
            panel.set_ylabel("volume strain")
        figure.axes[-1].set_xlabel(way.replace("_", " "))
        made[way.rpartition("_")[0] + ("_force" if unit == "N" else "_stress")] = figure
    return made


def records(columns: Mapping[str, np.ndarray]) -> dict[str, Figure]:
    """What records.csv holds over time, a figure for each unit in the heads ``name [unit]`` of its columns."""
    units: dict[str, list[str]] = {}
    for head in columns:
        found = re.search(r"\[(.*)\]$", head)
        if head not in ("step", "time [s]"):
            units.setdefault(found.group(1) if found else "", []).append(head)
    time = columns["time [s]"]
    figures = {}
    for unit, heads in units.items():
        figure = Figure(figsize=(9, 4.5))
        axes = figure.subplots()
        for k, head in enumerate(heads):
            label = head.rpartition(" [")[0] or head
            dashes = ("-", "--", ":")[k // 10 % 3]  # colours repeat after ten
            axes.plot(time, columns[head], dashes, label=label.replace("_", " "), linewidth=1.2)
        axes.set_xlabel("time [s]")
        axes.set_ylabel(f"{UNITS.get(unit, '')} [{unit}]".strip() if unit else "")
        axes.legend(fontsize="small", ncols=1 + len(heads) // 12, loc="center left", bbox_to_anchor=(1.0, 0.5))
        figures[UNITS.get(unit, re.sub(r"\W+", "_", unit).strip("_") or "figures")] = figure
    return figures


def compare(summary: Mapping[str, Mapping[str, float]]) -> Figure:
    """The compared preconditioners, the losers too: Krylov iterations, and seconds for all systems of the run."""
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


def sparsity(folder: Folder, frame: Frame) -> Figure:
    """The pattern of the Newton system of a small example (the contacts of `example`), and that of the Schur
    complement S = N + B of the whole frame, in its order. Two contacts are coupled if they share a body that can move.

    Newton system: the 3 Nc impulses and the Nc multipliers; N + lambda hess f, grad f, its transpose, diag f.
    """
    figure = Figure(figsize=(9, 4.9))
    left, right = figure.subplots(1, 2)
    few = example(folder, frame)
    coupling = _coupling(folder, frame)
    near = sp.kron(coupling[few][:, few], np.ones((3, 3)))
    gradient = sp.kron(sp.identity(len(few)), np.ones((3, 1)))
    newton = sp.bmat([[near, gradient], [gradient.T, sp.identity(len(few))]])
    _spy(left, newton, 300 / newton.shape[0])
    left.axhline(3 * len(few) - 0.5, color="C1", linewidth=0.8)
    left.axvline(3 * len(few) - 0.5, color="C1", linewidth=0.8)
    left.set_title(f"Newton matrix of {len(few)} contacts: impulses, multipliers", fontsize=10)
    _spy(right, coupling, max(0.25, 300 / coupling.shape[0]))
    per_row = coupling.nnz / coupling.shape[0]
    right.set_title(f"3 x 3 blocks of S, all {coupling.shape[0]} contacts: {per_row:.1f} per row", fontsize=10)
    return figure


def graphs(folder: Folder, frame: Frame) -> Figure:
    """A small example as in Figure 4 of the paper: bodies, the graph of the bodies, the graph of the contacts; seen
    along the direction in which it is thinnest."""
    few = example(folder, frame)
    pair, point = frame.contacts.body[few], frame.contacts.point[few]
    grains = np.unique(pair[pair < folder.grains])
    middle = frame.position[grains].mean(axis=0)
    axes3 = np.linalg.svd(frame.position[grains] - middle, full_matrices=True)[2][:2]
    spot, centers = (point - middle) @ axes3.T, (frame.position - middle) @ axes3.T
    for body in np.unique(pair[pair >= folder.grains]):  # a large body stands outside of its contacts
        touched = spot[(pair == body).any(axis=1)].mean(axis=0)
        centers[body] = 1.35 * touched
    radius = np.linalg.norm(folder.size, axis=1)

    figure = Figure(figsize=(12, 4.4))
    bodies, body_graph, contact_graph = figure.subplots(1, 3, sharex=True, sharey=True)
    circle = np.exp(2j * np.pi * np.linspace(0, 1, 60))
    for body in grains:
        bodies.fill(
            centers[body, 0] + radius[body] * circle.real, centers[body, 1] + radius[body] * circle.imag,
            facecolor="C0", edgecolor="C0", alpha=0.18,
        )
    bodies.plot(*centers[grains].T, "o", color="C3", label="centres")
    bodies.plot(*spot.T, "s", color="white", markeredgecolor="black", label="contacts")
    bodies.legend(loc="upper center", bbox_to_anchor=(0.5, -0.02), ncols=2)

    for a, b in pair:
        body_graph.plot(*centers[[a, b]].T, color="0.6", linewidth=1, zorder=1)
    body_graph.plot(*centers[grains].T, "o", color="C3")
    for body in np.unique(pair[pair >= folder.grains]):
        body_graph.plot(*centers[body], "D", color="C1")
        name = folder.large[body - folder.grains]["name"]
        body_graph.annotate(name, centers[body], xytext=(7, 5), textcoords="offset points")

    coupling = sp.triu(_coupling(folder, frame)[few][:, few], k=1).tocoo()
    for i, j in zip(coupling.row, coupling.col):
        contact_graph.plot(*spot[[i, j]].T, color="0.7", linewidth=0.7, zorder=1)
    contact_graph.plot(*spot.T, "s", color="white", markeredgecolor="black")
    titles = {
        bodies: f"{len(grains)} grains, {len(few)} contacts",
        body_graph: "bodies, joined by contacts",
        contact_graph: "contacts, joined by bodies: blocks of N and S",
    }
    for axes, title in titles.items():
        axes.set_title(title, fontsize=10)
        axes.set_aspect("equal")
        axes.axis("off")
        axes.margins(0.08)
    return figure


def example(folder: Folder, frame: Frame) -> np.ndarray:
    """Rows of the contacts of a small cluster: a grain that touches a large body if any does, the one with most
    contacts, its neighbours, and what these touch of each other and of the large bodies."""
    pair = frame.contacts.body
    degree = np.bincount(pair.ravel(), minlength=len(frame.position))[: folder.grains]
    at_large = np.unique(pair[(pair >= folder.grains).any(axis=1)].min(axis=1, initial=folder.grains))
    at_large = at_large[at_large < folder.grains]
    middle = at_large[np.argmax(degree[at_large])] if len(at_large) else np.argmax(degree)
    cluster = np.zeros(len(frame.position), dtype=bool)
    cluster[pair[(pair == middle).any(axis=1)].ravel()] = True
    cluster[folder.grains :] = True
    inside = cluster[pair].all(axis=1) & (pair < folder.grains).any(axis=1)
    return np.flatnonzero(inside)


def _coupling(folder: Folder, frame: Frame) -> sp.csr_matrix:
    """Pattern (nc, nc) of the blocks of N: contacts that share a body of finite mass, and the diagonal."""
    pair = frame.contacts.body
    row, body = np.repeat(np.arange(len(pair)), 2), pair.ravel()
    moves = np.isfinite(folder.mass[body])
    touch = sp.csr_matrix(
        (np.ones(moves.sum()), (row[moves], body[moves])), shape=(len(pair), len(folder.mass))
    )
    return (touch @ touch.T + sp.identity(len(pair))).tocsr()


def _spy(axes: Axes, pattern: Any, size: float) -> None:
    entries = sp.coo_matrix(pattern)
    axes.plot(entries.col, entries.row, "s", color="C0", markersize=size, markeredgewidth=0, rasterized=True)
    n = entries.shape[0]
    axes.set(xlim=(-0.5, n - 0.5), ylim=(n - 0.5, -0.5), aspect="equal")
    axes.xaxis.tick_top()
    axes.grid(visible=False)
    axes.spines[["right", "top"]].set_visible(True)
