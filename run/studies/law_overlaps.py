"""Overlaps that Coulomb's law and its relaxation leave, of the same problems at several tolerances, beside those of the
relaxation without its openings: run/study law_overlaps [SCENE N STEPS EVERY], default blade 4 20 2. Writes
results/law_overlaps.json."""

from __future__ import annotations

import statistics
import sys

import numpy as np
from measure import record, say_machine
from mpi4py import MPI

from pctt import ccp
from pctt.ccp.cone import tangential
from pctt.run.options import read_options
from pctt.run.report import Progress
from pctt.run.simulate import first_state
from pctt.run.stepper import Stepper

LAWS = {"relaxation": (None, (1e-4, 1e-5, 1e-6)), "Coulomb": (ccp.Coulomb(max_it=20), (1e-4, 1e-5))}


class Compared(Stepper):
    """Steps as asked; every so many of them are also solved with both laws."""

    every = 1

    def solve(self, problem: ccp.ConeProblem, guess: np.ndarray) -> ccp.Result:
        if self.world.step % self.every == 0:
            for law, (coulomb, tolerances) in LAWS.items():
                start = guess
                for tol in tolerances:
                    result = ccp.solve(problem, start, "apgd", ccp.Limits(tol, closing_work=np.inf), coulomb=coulomb)
                    start = result.impulse
                    rows.append({"law": law, "tol": tol, **self.overlaps(problem, result)})
        return super().solve(problem, guess)

    def overlaps(self, problem: ccp.ConeProblem, result: ccp.Result) -> dict[str, float]:
        """The deepest overlap that the velocities make, and that of the velocities less the openings [mm]."""
        y, unit = problem.product(result.impulse) + problem.r, -1e3 * self.settings.dt
        closing = (y[:, 0], y[:, 0] - problem.mu * tangential(y))
        made, net = (unit * float(values.min(initial=0.0)) for values in closing)
        return {"overlap [mm]": made, "less opening [mm]": net, "converged": result.converged}


rows: list[dict] = []


def main(scene: str, n: str, steps: int, every: int) -> None:
    about = say_machine()
    words = {"scene": scene, "scene_n": n, "restart": "settled", "ccp_type": "apgd", "ccp_coulomb": "true"}
    options = read_options({**words, "output": "results", "overwrite": "true"}, MPI.COMM_WORLD)
    sim = first_state(options, MPI.COMM_WORLD, Progress(False))
    with Compared(sim.settings, sim.world, sim.memory) as stepper:
        stepper.every = every
        for _ in range(steps):
            stepper.step()
    print("law            tol  overlap mm: worst  median   less opening: worst  median   converged")
    for law, tol in dict.fromkeys((row["law"], row["tol"]) for row in rows):
        same = [row for row in rows if (row["law"], row["tol"]) == (law, tol)]
        made, net = ([row[name] for row in same] for name in ("overlap [mm]", "less opening [mm]"))
        shown = f"{max(net):20.4f} {statistics.median(net):7.4f}" if law == "relaxation" else f"{'':28}"
        solved = f"{sum(row['converged'] for row in same):6d} of {len(same)}"
        print(f"{law:10} {tol:7.0e} {max(made):18.4f} {statistics.median(made):7.4f} {shown} {solved}")
    record("law_overlaps", {**about, "words": words}, rows)


if __name__ == "__main__":
    given = [*sys.argv[1:], *("blade", "4", "20", "2")[len(sys.argv) - 1 :]]
    main(given[0], given[1], int(given[2]), int(given[3]))
