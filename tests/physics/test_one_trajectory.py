"""A heap that falls and lands moves the same on one to four ranks.

With a given number of iterations per step only the order of sums differs; steps that are solved to a
tolerance also stop at other points within it.
"""

from __future__ import annotations

import json

import numpy as np
import pytest
from drive import steps
from mpi4py import MPI

from dem.scenes import Mixer
from dem.world import World

PROGRAM = """
import json
import sys

import numpy as np
from drive import by_id, steps
from mpi4py import MPI

from dem.scenes import Mixer
from dem.world import World, restart_rows

folder, cases = sys.argv[1], json.loads(sys.argv[2])
comm = MPI.COMM_WORLD
state = np.load(f"{folder}/state.npz")
rows = restart_rows(state["slabs"], comm)
local = {name[6:]: state[name][rows] for name in state if name.startswith("local_")}
for case, settings in cases.items():
    world = World.restore(Mixer(n=2).build(), comm, local, state)
    for step in steps(world, 2, 0.025, delta=0.02, recovery_speed=1.0, **settings):
        pushing = comm.allreduce(int((step.impulse[:, 0] > 1e-3).sum()))
        assert pushing > 200, pushing
    table = by_id(world)
    if comm.rank == 0:
        np.savez(f"{folder}/{case} {comm.size}.npz", **table)
"""

# settings, and ten times what was measured between ranks: m, m/s, rad/s
CASES = {
    "given iterations": ({"solver": "apgd", "iterations": 20}, (1e-13, 1e-12, 1e-11)),
    "pdip": ({"solver": "pdip", "tol": 1e-6}, (4e-6, 2e-4, 3e-3)),
    "apgd": ({"solver": "apgd", "tol": 1e-6}, (4e-5, 1e-3, 2e-2)),
}


def fallen() -> dict[str, np.ndarray]:
    """A mixer whose spheres have come down upon each other, as an array of each name."""
    world = World.from_scene(Mixer(n=2).build(), MPI.COMM_SELF)
    for _ in steps(world, 28, 0.025, tol=1e-3, delta=0.1, recovery_speed=1.0):
        pass
    local, replicated = world.state()
    return {**replicated, **{f"local_{name}": column for name, column in local.items()}}


@pytest.mark.mpi
@pytest.mark.parametrize(
    "cases", [("given iterations", "pdip"), pytest.param(("apgd",), marks=pytest.mark.slow)], ids=" and ".join
)
def test_the_trajectory_does_not_depend_on_the_number_of_ranks(cases, mpirun, tmp_path):
    np.savez(tmp_path / "state.npz", **fallen())
    settings = json.dumps({case: CASES[case][0] for case in cases})
    for ranks in (1, 2, 3, 4):
        mpirun(PROGRAM, ranks, tmp_path, settings)
    for case in cases:
        tables = {ranks: np.load(tmp_path / f"{case} {ranks}.npz") for ranks in (1, 2, 3, 4)}
        for ranks in (2, 3, 4):
            here, alone = (
                (tables[k]["position"], *np.split(tables[k]["velocity"], 2, axis=1)) for k in (ranks, 1)
            )
            for name, one, other, limit in zip(("x", "v", "w"), here, alone, CASES[case][1]):
                message = f"{case}: {name} on {ranks} ranks"
                np.testing.assert_allclose(one, other, rtol=0, atol=limit, err_msg=message)
