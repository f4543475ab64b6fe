"""Figures of a run, made with matplotlib. Each public function makes one figure or one kind of figures."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import scipy.sparse as sp
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter

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

# names of the figures for the columns of records.csv, by the unit in the heads of the columns
UNITS = {
    "": "statistics", "N": "forces", "N m": "torques", "J": "energies", "m": "lengths", "m/s": "velocities",
    "Pa": "stresses", "kg": "masses", "degrees": "angles",
}
# columns of the energy balance (dem.record.energy_balance)
BALANCE = ("kinetic_energy", "potential_energy", "work_of_motions", "friction_loss", "impact_loss", "time_stepping")
NEIGHBOURS = 12  # number of neighbours of the middle grain in an `example`


def figures(folder: Folder, step: int | None) -> dict[str, Figure]:
    """All figures of a run by name; ``step`` is that of `sparsity` and `graphs`, by default the last with contacts."""
    lines, columns, compared = folder.lines(), folder.records(), folder.summary.get("compare")
    made = {"steps": steps(lines)} if lines else {}
    if columns:
        made |= {**records(columns), **curves(columns, folder.analysis())}
    if compared:
        made["compare"] = compare(compared)
    if folder.steps:
        folder.require_frames()
    for candidate in reversed(folder.steps) if step is None else [step]:
        frame = folder.frame(candidate)
        if len(frame.contacts):
            return made | {"sparsity": sparsity(folder, frame), "graphs": graphs(folder, frame)}
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
            filtered = analysis.get(head.replace(" [", "_filtered [", 1), np.full_like(records[way], np.nan))
            name, raw = head.rpartition(" [")[0].replace("_", " "), records[head]
            axes.plot(records[way], raw, color=f"C{k}", alpha=0.4, linewidth=0.9, label=f"{name}, raw")
            shown += [*np.nanpercentile(raw, [0.5, 99.5])]  # peaks would flatten the rest
            if np.isfinite(filtered).any():
                axes.plot(records[way], filtered, color=f"C{k}", linewidth=1.6, label=f"{name}, filtered")
                shown += [np.nanmin(filtered), np.nanmax(filtered)]
        room = 0.08 * (max(shown) - min(shown)) or 1.0
        axes.set_ylim(min(shown) - room, max(shown) + room)
        axes.set_ylabel(f"{UNITS[unit]} [{unit}]")
        axes.legend(fontsize="small")
        for panel in below:
            panel.plot(records[way], strain)
            panel.set_ylabel("volume strain")
        figure.axes[-1].set_xlabel(way.replace("_", " "))
        made[way.rpartition("_")[0] + ("_force" if unit == "N" else "_stress")] = figure
    return made


def records(columns: Mapping[str, np.ndarray]) -> dict[str, Figure]:
    """The columns of records.csv over time: a figure for the energy balance, and a figure for each other unit in the
    heads ``name [unit]`` of the columns. The components of a vector share axes."""
    balance = {f"{name} [J]" for name in BALANCE}
    made = {"energy": energy(columns)} if balance <= set(columns) else {}
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

        kinetic + potential + losses - work

    since the beginning of the first step. The drift is the error of the time stepping. Potential energy counts from the
    first record."""
    time = columns["time [s]"]
    kinetic, potential, work, friction, impact, stepping = (columns[f"{name} [J]"] for name in BALANCE)
    total = kinetic + potential - potential[0] + np.cumsum(friction + impact - work)
    figure = Figure(figsize=(9.5, 6.4))
    above, below = figure.subplots(2, 1, sharex=True, height_ratios=(3, 2))
    above.plot(time, kinetic, label="kinetic energy")
    above.plot(time, potential - potential[0], label="potential energy, change")
    above.plot(time, np.cumsum(work), "--", label="work of moving bodies, sum")
    above.plot(time, np.cumsum(friction), "-.", label="friction loss, sum")
    above.plot(time, np.cumsum(impact), ":", label="impact loss, sum")
    above.plot(time, total, color="black", linewidth=1.8, label="kinetic + potential + losses - work")
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


def sparsity(folder: Folder, frame: Frame) -> Figure:
    """Two patterns: the Newton matrix for the contacts of `example`, and the Schur complement S = N + B for all
    contacts in the order of the frame. Two contacts are coupled if they share a body that can move.

    The unknowns of the Newton system are the 3 Nc impulses and the Nc multipliers. Its blocks are N + lambda hess f,
    grad f, the transpose of grad f, and diag f.
    """
    few, all_pairs = example(folder, frame), coupling(folder, frame)
    gradient = sp.kron(sp.identity(len(few)), np.ones((3, 1)))
    near = sp.kron(all_pairs[few][:, few], np.ones((3, 3)))
    newton = sp.bmat([[near, gradient], [gradient.T, sp.identity(len(few))]])
    figure = Figure(figsize=(9, 4.9))
    left, right = figure.subplots(1, 2)
    for axes, pattern in ((left, newton), (right, all_pairs)):
        axes.spy(pattern, markersize=max(0.25, 300 / pattern.shape[0]), color="C0", rasterized=True)
        axes.grid(visible=False)
    left.axhline(3 * len(few) - 0.5, color="C1", linewidth=0.8)
    left.axvline(3 * len(few) - 0.5, color="C1", linewidth=0.8)
    left.set_title(f"Newton matrix of {len(few)} contacts: impulses, multipliers", fontsize=10)
    count = all_pairs.shape[0]
    right.set_title(f"3 x 3 blocks of S, all {count} contacts: {all_pairs.nnz / count:.1f} per row", fontsize=10)
    return figure


def graphs(folder: Folder, frame: Frame) -> Figure:
    """The contacts of `example` as in Figure 4 of the paper: bodies, graph of the bodies, graph of the contacts.

    The cluster is seen along the direction in which it is thinnest.
    """
    few = example(folder, frame)
    pair, point = frame.contacts.bodies[few], frame.contacts.point[few]
    grains, large = np.unique(pair[pair < folder.grains]), np.unique(pair[pair >= folder.grains])
    middle = frame.position[grains].mean(axis=0)
    plane = np.linalg.svd(frame.position[grains] - middle, full_matrices=True)[2][:2]
    spot, centers = (point - middle) @ plane.T, (frame.position - middle) @ plane.T
    beyond = 1.15 * (np.linalg.norm(centers[grains], axis=1) + 0.5 * folder.radius[grains]).max()
    for body in large:  # outside of the grains
        way = spot[(pair == body).any(axis=1)].mean(axis=0)
        centers[body] = beyond * way / max(np.linalg.norm(way), 1e-9 * beyond)

    figure = Figure(figsize=(12, 4.4), layout="constrained")
    bodies, body_graph, contact_graph = figure.subplots(1, 3, sharex=True, sharey=True)
    circle = np.exp(2j * np.pi * np.linspace(0, 1, 60))
    for body in grains:
        x, y = centers[body][:, None] + folder.radius[body] * np.array([circle.real, circle.imag])
        bodies.fill(x, y, facecolor="C0", edgecolor="C0", alpha=0.18)
    body_graph.plot(*centers[pair].transpose(2, 1, 0), color="0.6", linewidth=1, zorder=1)
    body_graph.plot(*centers[large].T, "D", color="C1")
    for body in large:
        name = folder.large[body - folder.grains]["name"]
        body_graph.annotate(name, centers[body], xytext=(7, 5), textcoords="offset points")
    joined = np.transpose(sp.triu(coupling(folder, frame)[few][:, few], k=1).nonzero())
    contact_graph.plot(*spot[joined].transpose(2, 1, 0), color="0.7", linewidth=0.7, zorder=1)
    for axes in (bodies, body_graph):
        axes.plot(*centers[grains].T, "o", color="C3")
    for axes in (bodies, contact_graph):
        axes.plot(*spot.T, "s", color="white", markeredgecolor="black")
    bodies.set_title(f"{len(grains)} grains (centres: dots), {len(few)} contacts (squares)", fontsize=10)
    body_graph.set_title("bodies, joined by contacts", fontsize=10)
    contact_graph.set_title("contacts, joined by bodies: blocks of N and S", fontsize=10)
    for axes in figure.axes:
        axes.set_aspect("equal")
        axes.axis("off")
        axes.margins(0.08)
    return figure


def example(folder: Folder, frame: Frame) -> np.ndarray:
    """Indices of the contacts of a small cluster.

    The middle of the cluster is the grain with the most contacts among those that touch a large body, or among all
    grains if none touches one. The cluster has this grain, its NEIGHBOURS nearest neighbours and the large bodies. The
    contacts are those between these bodies.
    """
    pair = frame.contacts.bodies
    degree = np.bincount(pair.ravel(), minlength=len(frame.position))[: folder.grains]
    touches = np.zeros(folder.grains, dtype=bool)
    touches[pair[(pair >= folder.grains).any(axis=1) & (pair < folder.grains).any(axis=1)].min(axis=1)] = True
    middle = np.argmax(np.where(touches | ~touches.any(), degree, -1))
    own = np.flatnonzero((pair == middle).any(axis=1))
    nearest = own[np.argsort(frame.contacts.gap[own], kind="stable")[:NEIGHBOURS]]
    cluster = np.arange(len(frame.position)) >= folder.grains
    cluster[pair[nearest].ravel()] = True
    return np.flatnonzero(cluster[pair].all(axis=1) & (pair < folder.grains).any(axis=1))


def coupling(folder: Folder, frame: Frame) -> sp.csr_matrix:
    """Pattern (nc, nc) of the blocks of N: pairs of contacts that share a body of finite mass, and the diagonal."""
    pair = frame.contacts.bodies
    moves = np.isfinite(folder.mass[pair]).astype(float)
    rows = np.repeat(np.arange(len(pair)), 2)
    touch = sp.csr_matrix((moves.ravel(), (rows, pair.ravel())), shape=(len(pair), len(folder.mass)))
    touch.eliminate_zeros()
    return (touch @ touch.T + sp.identity(len(pair))).tocsr()
