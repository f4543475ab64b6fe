"""Coulomb's law beside its relaxation: run/study compare_laws [N ...], default 4. Steps from settled states: seconds,
iterations, overlap, Coulomb residual; and how high a sliding box and a sphere on a turning table fly. Writes
results/compare_laws.json."""

from __future__ import annotations

import argparse
import statistics

from mpi4py import MPI
from shared import record, results, say_machine

from dem.motion import Rotation
from dem.scene import Scene
from dem.shapes import Box
from pctt import ccp
from pctt.simulation import Simulation

COMM = MPI.COMM_SELF
SCENES = ("mixer", "blade", "shear")
METHODS = {("apgd", "1e-4"): 20, ("conic", "1e-6"): 5}  # and how many steps


def laws(sizes: list[int]) -> None:
    """Coulomb's law beside its relaxation: steps from settled states, and how high grains fly that slide."""
    about = say_machine()
    rows: list[dict] = []
    print("scene   n  method      law         seconds  solve s  iterations  overlap mm  Coulomb residual", end="")
    print("  not converged")
    for n in sizes:
        for scene in SCENES:
            for (method, tol), count in METHODS.items():
                rows += _both_laws(scene, n, method, tol, count)
    for law in ccp.LAWS:
        lifts = {name: 1e3 * lift(scene, law) for name, scene in (("box", box()), ("sphere", sphere()))}
        print(f"{law:11} lift of the sliding box {lifts['box']:.3f} mm, of the sphere {lifts['sphere']:.3f} mm")
        rows.append({"law": law, **{f"lift_{name} [mm]": value for name, value in lifts.items()}})
    record("compare_laws", about, rows)


def _both_laws(scene: str, n: int, method: str, tol: str, count: int) -> list[dict]:
    """A row per law: medians of the steps, and the worst of the run."""
    rows = []
    for law in ccp.LAWS:
        options = ("-scene", scene, "-scene_n", n, "-restart", "settled", "-steps", count, "-output_every", 0)
        options += ("-ccp_closing_work", "inf")
        _, steps = results(1, *options, "-ccp_type", method, "-ccp_tol", tol, "-law", law)
        row = {
            "scene": scene,
            "n": n,
            "method": f"{method} {tol}",
            "law": law,
            "seconds": statistics.median(line["seconds"] for line in steps),
            "solve": statistics.median(line["phases"]["solve"] for line in steps),
            "iterations": statistics.mean(line["iterations"] for line in steps),
            "overlap [mm]": 1e3 * max(line["worst_overlap"] for line in steps),
            "coulomb_residual": max(line["coulomb_residual"] for line in steps),
            "not_converged": sum(not line["converged"] for line in steps),
            "laws": sorted({line["law"] for line in steps}),
        }
        print(
            f"{scene:6} {n:2d}  {row['method']:10}  {law:10} {row['seconds']:8.3f} {row['solve']:8.3f}"
            f" {row['iterations']:11.0f} {row['overlap [mm]']:11.2f} {row['coulomb_residual']:17.1e}"
            f" {row['not_converged']:14d}",
            flush=True,
        )
        rows.append(row)
    return rows


def box() -> Scene:
    """A cube of half extent .1 m, flush on a floor, at 2 m/s."""
    scene = Scene(friction=0.5)
    scene.add_body("floor", [Box((2, 2, 0.1))], position=(0, 0, -0.1))
    scene.add_boxes([0, 0, 0.1], (0.1, 0.1, 0.1), 1000.0, velocity=(2, 0, 0))
    return scene


def sphere() -> Scene:
    """A sphere of .1 m at rest on a table that turns once a second, .5 m from its axis."""
    scene = Scene(friction=0.5)
    scene.add_body("table", [Box((2, 2, 0.1))], Rotation((0, 0, 6.2832)), position=(0, 0, -0.1))
    scene.add_spheres([0.5, 0, 0.1], 0.1, 1000.0)
    return scene


def lift(scene: Scene, law: str) -> float:
    """How high the only grain gets above z = .1 m in 30 steps [m]."""
    sim, highest = Simulation(scene, dt=0.01, solver="apgd", tol=1e-8, law=law, comm=COMM), 0.0
    for _ in range(30):
        sim.step()
        highest = max(highest, float(sim.positions[0, 2]) - 0.1)
    return highest


if __name__ == "__main__":
    words = argparse.ArgumentParser("run/study compare_laws", description=__doc__)
    words.add_argument("n", type=int, nargs="*", default=[4], help="sizes of the scenes (4)")
    laws(words.parse_args().n)
