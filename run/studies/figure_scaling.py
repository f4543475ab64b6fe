"""Seconds of compression, inversion and application of a train against the number of contacts, with exponents, on
settled mixers and on copies of the largest side by side: run/study figure_scaling [N ...] [-contacts NC] [-rank
R], default 2 4 8 16 and 400000. Writes results/figure_scaling.json and .png."""

from __future__ import annotations

import argparse
import statistics
from typing import Any

import numpy as np
import scipy.sparse as sp
from mpi4py import MPI
from newton_systems import Replay, replay_steps, set_up, settled, train_pc
from petsc4py import PETSc
from shared import exponent, figure, median_seconds, record, say_machine

from pctt.blocks import square_block_matrix

NEWTON = 6  # Newton systems of a step until the two that are measured: costs hardly depend on the values
REPEAT = 3
PHASES = (
    "als cold", "als warm", "cross cold", "cross warm", "invert cold", "invert warm", "set-up cold", "set-up warm",
    "set-up kept", "apply", "product",
)  # fmt: skip


def tiled(matrix: PETSc.Mat, copies: int) -> PETSc.Mat:
    """Copies of a system side by side in the plane, without contact between them."""
    indptr, indices, values = matrix.getValuesCSR()
    rows = sp.csr_matrix((values, indices, indptr), shape=matrix.getSize()).tobsr((3, 3))
    nb = len(rows.indptr) - 1
    which = np.arange(copies)
    whole = sp.bsr_matrix(
        (
            np.tile(rows.data, (copies, 1, 1)),
            (rows.indices + nb * which[:, None]).ravel(),
            np.append((rows.indptr[:-1] + len(rows.indices) * which[:, None]).ravel(), copies * len(rows.indices)),
        ),
        shape=(3 * nb * copies, 3 * nb * copies),
    )
    points, keys = matrix.getAttr("coordinates"), np.asarray(matrix.getAttr("key"))
    side = int(np.ceil(copies**0.5))
    shift = np.stack([which // side, which % side, 0 * which], axis=1) * np.ptp(points, axis=0)
    out = square_block_matrix(matrix.comm.tompi4py(), whole)
    out.setAttr("coordinates", (points + shift[:, None, :]).reshape(-1, 3))
    out.setAttr("key", np.arange(copies * len(keys)))
    return out


def measure(first: PETSc.Mat, second: PETSc.Mat, rank: int) -> dict[str, Any]:
    """Figures for a cold start with the first matrix and a warm one with the second; medians."""
    runs: list[dict[str, float]] = []
    work = first.duplicate(copy=True)
    for name in ("coordinates", "key"):
        work.setAttr(name, first.getAttr(name))
    x, y = work.createVecs()
    x.array[:] = np.random.default_rng(0).standard_normal(x.getLocalSize())
    for _ in range(REPEAT):
        run: dict[str, float] = {}
        for way in ("als", "cross"):
            pc, _ = train_pc(MPI.COMM_WORLD, compress=way, rank=rank, eps=1e-2, reuse="steps")
            for state, matrix in (("cold", first), ("warm", second)):
                matrix.copy(work, PETSc.Mat.Structure.SAME_NONZERO_PATTERN)
                done = set_up(pc, work)
                run |= {f"{way} {state}": done["compress_s"], f"{way} {state} error": done["error"]}
                if way == "als":
                    run |= {f"invert {state}": done["invert_s"], f"set-up {state}": done["setup_s"]}
                    run[f"rank {state}"] = done["rank"]
            pc.destroy()
        pc, _ = train_pc(MPI.COMM_WORLD, rank=rank, eps=1e-2)
        for matrix in (first, second):
            matrix.copy(work, PETSc.Mat.Structure.SAME_NONZERO_PATTERN)
            run["set-up kept"] = set_up(pc, work)["setup_s"]
        pc.destroy()
        runs.append(run)
    row: dict[str, Any] = {name: statistics.median(run[name] for run in runs) for name in runs[0]}
    pc, _ = train_pc(MPI.COMM_WORLD, rank=rank, eps=1e-2)
    if set_up(pc, work)["rank"] == rank:
        row["apply"] = median_seconds(lambda: pc.apply(x, y))
    pc.destroy()
    row["product"] = median_seconds(lambda: work.mult(x, y))
    work.destroy()
    return row


def main(given: argparse.Namespace) -> None:
    about = say_machine()
    rows: list[dict[str, Any]] = []
    print(f"rank {given.rank}, eps 1e-2, 1 rank; medians of {REPEAT} set-ups, 5 applications; seconds")
    heads = " ".join(f"{phase:>12}" for phase in PHASES)
    print(f"{'n':>3} {'copies':>6} {'contacts':>9} {heads} {'S x per apply':>14}")

    def look(replay: Replay) -> None:
        sizes = [1]
        while n == max(given.n) and replay.contacts * sizes[-1] < given.contacts:
            sizes.append(min(2 * sizes[-1], -(-given.contacts // replay.contacts)))
        pair = replay.systems[-2:]
        for copies in sizes:
            matrices = [tiled(replay.matrix(system), copies) for system in pair]
            row = {"n": n, "copies": copies, "contacts": replay.contacts * copies}
            row |= measure(matrices[0], matrices[1], given.rank)
            for matrix in matrices:
                matrix.destroy()
            rows.append(row)
            cells = " ".join(f"{row.get(phase, np.nan):12.4f}" for phase in PHASES)
            products = row.get("apply", np.nan) / row["product"]
            print(f"{n:3d} {copies:6d} {row['contacts']:9d} {cells} {products:14.1f}", flush=True)

    for n in given.n:
        replay_steps(settled(n, "-ccp_max_it", NEWTON), 1, look)
    exponents = {phase: exponent(*against_contacts(rows, phase)) for phase in PHASES}
    cells = " ".join(f"{exponents[phase]:12.2f}" for phase in PHASES)
    print(f"{'seconds ~ Nc to the power':>20} {cells}")
    record("figure_scaling", about, [*rows, {"exponents": exponents}])
    draw(rows, exponents)


def against_contacts(rows: list[dict[str, Any]], phase: str) -> np.ndarray:
    """Contacts and seconds (2, points) of a phase, by the number of contacts."""
    points = sorted((row["contacts"], row[phase]) for row in rows if phase in row)
    return np.array(points).reshape(-1, 2).T


def draw(rows: list[dict[str, Any]], exponents: dict[str, float]) -> None:
    with figure("figure_scaling", 2) as axes:
        for ax, phases, title in zip(axes, (PHASES[:9], PHASES[9:]), ("set-up", "application")):
            for phase in phases:
                style = "o--" if "warm" in phase else "o-"
                points = against_contacts(rows, phase)
                if points.size:
                    ax.plot(*points, style, label=f"{phase}: Nc^{exponents[phase]:.2f}")
            ax.set(xscale="log", yscale="log", xlabel="contacts Nc", ylabel="seconds", title=title)
            ax.legend(fontsize="small")


if __name__ == "__main__":
    words = argparse.ArgumentParser("run/study figure_scaling", description=__doc__)
    words.add_argument("n", type=int, nargs="*", default=[2, 4, 8, 16], help="sizes of the mixer (2 4 8 16)")
    words.add_argument("-contacts", type=int, default=400_000, help="to which the largest is tiled (400000)")
    words.add_argument("-rank", type=int, default=10, help="cap of the ranks (10)")
    main(words.parse_args())
