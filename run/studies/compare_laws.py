"""Coulomb's law beside its relaxation, steps from settled states: seconds, iterations, overlap, Coulomb residual;
and how high a sliding box and a sphere on a turning table fly: run/study compare_laws [N ...], default 4. Writes
results/compare_laws.json."""

from __future__ import annotations

import statistics
import sys

from measure import record, results, say_machine
from mpi4py import MPI

from dem.contact import find_contacts
from dem.motion import Rotation
from dem.scene import Scene
from dem.shapes import Box
from dem.start import new_world
from dem.step import advance
from dem.system import ContactSystem
from dem.world import World
from pctt import ccp
from pctt.run.stepper import cone_problem

SCENES = ("mixer", "blade", "shear")
METHODS = {("apgd", "1e-4"): 20, ("conic", "1e-6"): 5}  # and how many steps
MOST = 10  # cone problems where a method's own way to the law ends early
DT = 0.01


def main(sizes: list[int]) -> None:
    about = say_machine()
    rows: list[dict] = []
    print("scene   n  method      law         seconds  solve s  iterations  overlap mm  Coulomb residual", end="")
    print("  not converged")
    for n in sizes:
        for scene in SCENES:
            for (method, tol), count in METHODS.items():
                rows += _both_laws(scene, n, method, tol, count)
    for law, coulomb in (("relaxation", None), ("Coulomb", ccp.Coulomb())):
        lifts = {name: 1e3 * lift(world, coulomb) for name, world in (("box", box()), ("sphere", sphere()))}
        print(f"{law:11} lift of the sliding box {lifts['box']:.3f} mm, of the sphere {lifts['sphere']:.3f} mm")
        rows.append({"law": law, **{f"lift_{name} [mm]": value for name, value in lifts.items()}})
    record("compare_laws", about, rows)


def _both_laws(scene: str, n: int, method: str, tol: str, count: int) -> list[dict]:
    """A row per law: medians of the steps, and the worst of the run."""
    rows = []
    for law, flags in (("relaxation", ("false",)), ("Coulomb", ("true", "-ccp_coulomb_max_it", MOST))):
        options = ("-scene", scene, "-scene_n", n, "-restart", "settled", "-steps", count, "-output_every", 0)
        options += ("-ccp_closing_work", "inf")
        _, steps = results(1, *options, "-ccp_type", method, "-ccp_tol", tol, "-ccp_coulomb", *flags)
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


def box() -> World:
    """A cube of half extent .1 m, flush on a floor, at 2 m/s."""
    scene = Scene(friction=0.5)
    scene.add_body("floor", [Box((2, 2, 0.1))], position=(0, 0, -0.1))
    scene.add_boxes([0, 0, 0.1], (0.1, 0.1, 0.1), 1000.0, velocity=(2, 0, 0))
    return new_world(scene, MPI.COMM_SELF)


def sphere() -> World:
    """A sphere of .1 m at rest on a table that turns once a second, .5 m from its axis."""
    scene = Scene(friction=0.5)
    scene.add_body("table", [Box((2, 2, 0.1))], Rotation((0, 0, 6.2832)), position=(0, 0, -0.1))
    scene.add_spheres([0.5, 0, 0.1], 0.1, 1000.0)
    return new_world(scene, MPI.COMM_SELF)


def lift(world: World, coulomb: ccp.Coulomb | None, count: int = 30) -> float:
    """How high the only grain gets above z = .1 m [m]."""
    highest = 0.0
    for _ in range(count):
        system = ContactSystem(world, find_contacts(world, 0.01, DT), DT)
        with cone_problem(system, world.comm) as problem:
            result = ccp.solve(problem, None, "apgd", ccp.Limits(1e-8), coulomb=coulomb)
        advance(world, system.velocity(result.impulse), DT)
        highest = max(highest, float(world.grains.position[0, 2]) - 0.1)
    return highest


if __name__ == "__main__":
    main([int(word) for word in sys.argv[1:]] or [4])
