"""A heap that falls and lands moves the same on one to four ranks.

With a given number of iterations per step only the order of sums differs; steps that are solved to a
tolerance also stop at other points within it.
"""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest
from drive import by_id, steps
from mpi4py import MPI
from several_ranks import alone

from dem.start import new_world, restart_rows, restored_world
from pctt.scenes import Mixer

# settings, and ten times what was measured between ranks (of six states `pdip` leaves 4e-7 to 1.4e-5 m): m, m/s, rad/s
CASES = {
    "given iterations": ({"solver": "apgd", "iterations": 20}, (1e-13, 1e-12, 1e-11)),
    "pdip": ({"solver": "pdip", "tol": 1e-5}, (4e-5, 1e-3, 2e-2)),
    "apgd": ({"solver": "apgd", "tol": 1e-6}, (4e-5, 1e-3, 2e-2)),
}


def fallen() -> dict[str, np.ndarray]:
    """A mixer whose spheres have come down upon each other, as an array of each name."""
    world = new_world(Mixer(n=1).build(), MPI.COMM_SELF)
    for _ in steps(world, 28, 0.025, tol=1e-3, delta=0.1, recovery_speed=1.0):
        pass
    local, replicated = world.state()
    return {**replicated, **{f"local_{name}": column for name, column in local.items()}}


def two_steps(comm: MPI.Comm, state: dict[str, np.ndarray], **settings) -> dict[str, np.ndarray]:
    rows = restart_rows(state["slabs"], comm)
    local = {name[6:]: state[name][rows] for name in state if name.startswith("local_")}
    world = restored_world(Mixer(n=1).build(), comm, local, state)
    for step in steps(world, 2, 0.025, delta=0.02, recovery_speed=1.0, **settings):
        assert comm.allreduce(int((step.impulse[:, 0] > 1e-3).sum())) > 40
    return by_id(world)


@pytest.mark.parallel(2, 3)
@pytest.mark.parametrize(
    "cases", [("given iterations", "pdip"), pytest.param(("apgd",), marks=pytest.mark.slow)], ids=" and ".join
)
def test_the_trajectory_does_not_depend_on_the_number_of_ranks(cases, ranks, double):
    state = alone(lambda comm: fallen())
    for case in cases:
        settings, limits = CASES[case]
        go_on = partial(two_steps, state=state, **settings)
        both = go_on(MPI.COMM_WORLD), alone(go_on)
        here, there = ((table["position"], *np.split(table["velocity"], 2, axis=1)) for table in both)
        for name, one, other, limit in zip(("x", "v", "w"), here, there, limits):
            np.testing.assert_allclose(one, other, rtol=0, atol=limit, err_msg=f"{case}: {name} on {ranks} ranks")
