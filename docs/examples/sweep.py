"""A parameter sweep with `pctt.Simulation`: a box slides down a slope, for some friction coefficients and both laws of
contact. The acceleration of a case is compared with g (sin a - mu cos a), or zero where the box sticks. The ranks share
the cases, and each rank makes its simulations alone::

    mpiexec -n 2 python docs/examples/sweep.py sweep.png
"""

from __future__ import annotations

import itertools
import sys
from math import cos, radians, sin

from mpi4py import MPI

import pctt
from pctt import Plane, Scene

G, SLOPE = 9.81, radians(25.0)
FRICTIONS, LAWS = (0.0, 0.2, 0.4, 0.6), ("coulomb", "relaxation")


def acceleration(friction: float, law: str) -> float:
    """Of a box of 2 kg from rest, over 0.2 s [m/s^2]."""
    scene = Scene(friction, gravity=(G * sin(SLOPE), 0.0, -G * cos(SLOPE)))  # axes along and across the slope
    scene.add_body("slope", [Plane((0, 0, 1))])
    scene.add_boxes([0, 0, 0.1], (0.1, 0.1, 0.1), density=250.0)
    with pctt.Simulation(scene, dt=0.01, solver="apgd", tol=1e-8, law=law, comm=MPI.COMM_SELF) as sim:
        sim.run(until=0.2)
        return sim.velocities[0, 0] / sim.time


def main() -> list[tuple[float, str, float, float]]:
    """Friction, law, acceleration and that of the theory, for each case; on all ranks."""
    comm = MPI.COMM_WORLD
    cases = list(itertools.product(FRICTIONS, LAWS))
    found = [acceleration(friction, law) for friction, law in cases[comm.rank :: comm.size]]
    gathered = comm.allgather(found)
    rows = []
    for k, (friction, law) in enumerate(cases):
        theory = max(0.0, G * (sin(SLOPE) - friction * cos(SLOPE)))
        rows.append((friction, law, gathered[k % comm.size][k // comm.size], theory))
    return rows


def draw(table: list[tuple[float, str, float, float]], picture: str) -> None:
    """Accelerations against friction, and the theory as a line."""
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(figsize=(5, 4))
    for law, mark in zip(LAWS, "ox"):
        axes.plot(FRICTIONS, [value for _, name, value, _ in table if name == law], mark, label=law)
    axes.plot(FRICTIONS, [theory for *_, theory in table[:: len(LAWS)]], label="theory")
    axes.set(xlabel="friction coefficient", ylabel="acceleration [m/s$^2$]")
    axes.legend()
    figure.savefig(picture, dpi=100)


if __name__ == "__main__":
    table = main()
    if MPI.COMM_WORLD.rank == 0:
        print("friction  law         acceleration  theory   [m/s^2]")
        for friction, law, value, theory in table:
            print(f"{friction:8.1f}  {law:10}  {value:12.5f}  {theory:.5f}")
        if sys.argv[1:]:
            draw(table, sys.argv[1])
