"""What grains of each shape cost: run/study shapes [-n N] [-steps K] [-shapes A,B]

docs/examples/ballast.py with N^3 grains of each shape, after K steps of 1 ms, by which they lie. The simulations take
the last 20 steps in turn. Processor time of one core: nanoseconds of the narrow phase per pair (mean), milliseconds of
the narrow phase and of a step (medians). Narrow phases of a step are two where grains turn (docs/mechanics.md).
Writes results/shapes.json.
"""

from __future__ import annotations

import statistics
import time

import shared

from dem.contact import primitives, search
from dem.experiment import from_file
from pctt.simulation import Simulation

ROUNDS = 20
touches = search.touches


def main() -> None:
    """Settle all, then take the steps in turn."""
    line = shared.parser("shapes", __doc__)
    line.add_argument("-n", type=int, default=10)
    line.add_argument("-steps", type=int, default=500)
    line.add_argument("-shapes", type=shared.listed(), default="spheres,boxes,cubes,tetrahedra,dodecahedra,stones")
    given = line.parse_args()
    machine, spent = shared.say_machine(), [0.0, 0]

    def timed(table, i, j, *more):
        start = time.process_time()
        found = touches(table, i, j, *more)
        spent[0], spent[1] = spent[0] + time.process_time() - start, spent[1] + len(i)
        return found

    primitives.touches = search.touches = timed
    ballast = from_file(shared.ROOT / "docs" / "examples" / "ballast.py")
    runs = {name: Simulation(ballast(n=given.n, shape=name), dt=1e-3, solver="apgd", tol=1e-3) for name in given.shapes}
    for sim in runs.values():
        sim.run(steps=given.steps)
    costs = {name: [] for name in given.shapes}
    for _ in range(ROUNDS):
        for name, sim in runs.items():
            spent[:], start = [0.0, 0], time.process_time()
            row = sim.step()
            costs[name].append((time.process_time() - start, *spent, row["contacts"]))
    rows = []
    for name, found in costs.items():
        step, narrow, pairs, contacts = zip(*found)
        figures = {
            "pairs": statistics.mean(pairs), "contacts": statistics.mean(contacts),
            "ns a pair": 1e9 * sum(narrow) / sum(pairs), "narrow ms": 1e3 * statistics.median(narrow),
            "step ms": 1e3 * statistics.median(step),
        }  # fmt: skip
        rows.append({"shape": name, **figures})
    cells = [[row["shape"], *(f"{figure:.3g}" for figure in [*row.values()][1:])] for row in rows]
    print(shared.markdown([*rows[0]], cells))
    shared.record("shapes", machine, rows)


if __name__ == "__main__":
    main()
