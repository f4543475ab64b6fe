"""Figures of the structure of one step: which contacts and bodies touch, and the patterns of its matrices."""

from __future__ import annotations

from typing import Any

import numpy as np
import scipy.sparse as sp
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure

from pctt.folder import Folder, Frame

NEIGHBOURS = 12  # number of neighbours of the middle grain in an `example`


def sparsity(folder: Folder, frame: Frame) -> Figure:
    """Two patterns: the Newton matrix for the contacts of `example`, and the Schur complement S = N + B for all
    contacts in the order of the frame. Two contacts are coupled if they share a body that can move.

    The unknowns of the Newton system are the 3 Nc impulses and the Nc multipliers. Its blocks are N + lambda hess f,
    grad f, the transpose of grad f, and diag f.
    """
    figure = Figure(figsize=(9, 4.9))
    left, right = figure.subplots(1, 2)
    few = example(folder, frame)
    coupling = _coupling(folder, frame)
    near = sp.kron(coupling[few][:, few], np.ones((3, 3)))
    gradient = sp.kron(sp.identity(len(few)), np.ones((3, 1)))
    newton = sp.bmat([[near, gradient], [gradient.T, sp.identity(len(few))]])
    _spy(left, newton)
    left.axhline(3 * len(few) - 0.5, color="C1", linewidth=0.8)
    left.axvline(3 * len(few) - 0.5, color="C1", linewidth=0.8)
    left.set_title(f"Newton matrix of {len(few)} contacts: impulses, multipliers", fontsize=10)
    _spy(right, coupling)
    per_row = coupling.nnz / coupling.shape[0]
    right.set_title(f"3 x 3 blocks of S, all {coupling.shape[0]} contacts: {per_row:.1f} per row", fontsize=10)
    return figure


def graphs(folder: Folder, frame: Frame) -> Figure:
    """The contacts of `example` as in Figure 4 of the paper: bodies, graph of the bodies, graph of the contacts.

    The cluster is seen along the direction in which it is thinnest.
    """
    few = example(folder, frame)
    pair, point = frame.contacts.bodies[few], frame.contacts.point[few]
    grains = np.unique(pair[pair < folder.grains])
    middle = frame.position[grains].mean(axis=0)
    axes3 = np.linalg.svd(frame.position[grains] - middle, full_matrices=True)[2][:2]
    spot, centers = (point - middle) @ axes3.T, (frame.position - middle) @ axes3.T
    radius = folder.radius
    beyond = 1.15 * (np.linalg.norm(centers[grains], axis=1) + 0.5 * radius[grains]).max()
    for body in np.unique(pair[pair >= folder.grains]):  # draw a large body outside of the grains
        way = spot[(pair == body).any(axis=1)].mean(axis=0)
        length = np.linalg.norm(way)
        centers[body] = beyond * (way / length if length > 1e-9 * beyond else np.array([0.0, -1.0]))

    figure = Figure(figsize=(12, 4.4), layout="constrained")
    bodies, body_graph, contact_graph = figure.subplots(1, 3, sharex=True, sharey=True)
    circle = np.exp(2j * np.pi * np.linspace(0, 1, 60))
    for body in grains:
        bodies.fill(
            centers[body, 0] + radius[body] * circle.real, centers[body, 1] + radius[body] * circle.imag,
            facecolor="C0", edgecolor="C0", alpha=0.18,
        )
    bodies.plot(*centers[grains].T, "o", color="C3", label="centres")
    bodies.plot(*spot.T, "s", color="white", markeredgecolor="black", label="contacts")
    figure.legend(*bodies.get_legend_handles_labels(), loc="lower left", ncols=2)
    # room for the legend and for the titles; axes with equal scales let the titles stand out
    figure.get_layout_engine().set(rect=(0, 0.08, 1, 0.9))

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
    """Indices of the contacts of a small cluster.

    The middle of the cluster is the grain with the most contacts among those that touch a large body, or among all
    grains if none touches one. The cluster has this grain, its NEIGHBOURS nearest neighbours and the large bodies. The
    contacts are those between these bodies.
    """
    pair = frame.contacts.bodies
    degree = np.bincount(pair.ravel(), minlength=len(frame.position))[: folder.grains]
    at_large = np.unique(pair[(pair >= folder.grains).any(axis=1)].min(axis=1, initial=folder.grains))
    at_large = at_large[at_large < folder.grains]
    middle = at_large[np.argmax(degree[at_large])] if len(at_large) else np.argmax(degree)
    cluster = np.zeros(len(frame.position), dtype=bool)
    own = np.flatnonzero((pair == middle).any(axis=1))
    nearest = own[np.argsort(frame.contacts.gap[own], kind="stable")[:NEIGHBOURS]]
    cluster[pair[nearest].ravel()] = True
    cluster[folder.grains :] = True
    inside = cluster[pair].all(axis=1) & (pair < folder.grains).any(axis=1)
    return np.flatnonzero(inside)


def _coupling(folder: Folder, frame: Frame) -> sp.csr_matrix:
    """Pattern (nc, nc) of the blocks of N: pairs of contacts that share a body of finite mass, and the diagonal."""
    pair = frame.contacts.bodies
    row, body = np.repeat(np.arange(len(pair)), 2), pair.ravel()
    moves = np.isfinite(folder.mass[body])
    touch = sp.csr_matrix(
        (np.ones(moves.sum()), (row[moves], body[moves])), shape=(len(pair), len(folder.mass))
    )
    return (touch @ touch.T + sp.identity(len(pair))).tocsr()


def _spy(axes: Axes, pattern: Any) -> None:
    entries = sp.coo_matrix(pattern)
    n = entries.shape[0]
    if n <= 300:  # an image, because markers of this size would leave gaps
        filled = np.ma.masked_equal(entries.toarray() != 0, False)
        axes.imshow(filled, cmap=ListedColormap(["C0"]), interpolation="nearest")
    else:
        size = max(0.25, 300 / n)
        axes.plot(entries.col, entries.row, "s", color="C0", markersize=size, markeredgewidth=0, rasterized=True)
    axes.set(xlim=(-0.5, n - 0.5), ylim=(n - 0.5, -0.5), aspect="equal")
    axes.xaxis.tick_top()
    axes.grid(visible=False)
    axes.spines[["right", "top"]].set_visible(True)
