"""Figures 3 and 4 of the paper for one recorded step of any run: run/study structure FOLDER [-step K], default the last
step with contacts. Writes results/sparsity.png, the patterns of the Newton matrix of a few contacts and of S for all,
and results/graphs.png, which bodies and contacts touch."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import scipy.sparse as sp
from matplotlib.figure import Figure
from shared import called_from, parser

from pctt.folder import Folder, Frame

NEIGHBOURS = 12  # number of neighbours of the middle grain in an `example`


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


def main() -> None:
    words = parser("structure", __doc__)
    words.add_argument("folder", type=Path, help="output folder of a run")
    words.add_argument("-step", type=int, help="recorded step; without: the last with contacts")
    given = words.parse_args()
    folder = Folder(called_from(given.folder))
    folder.require_frames()
    frames = (folder.frame(step) for step in ([given.step] if given.step is not None else reversed(folder.steps)))
    frame = next((frame for frame in frames if len(frame.contacts)), None)
    if frame is None:
        raise SystemExit(f"run/study structure: {given.folder}: no recorded step with contacts")
    Path("results").mkdir(exist_ok=True)
    for name, figure in {"sparsity": sparsity(folder, frame), "graphs": graphs(folder, frame)}.items():
        figure.savefig(f"results/{name}.png", dpi=150)
        print(f"results/{name}.png")


if __name__ == "__main__":
    main()
