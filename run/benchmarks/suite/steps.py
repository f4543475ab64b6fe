"""A time step of each scene, by default settings."""

from __future__ import annotations

import time
import warnings

from mpi4py import MPI

from pctt import Simulation
from pctt.scenes import SCENES

BEFORE = 40  # steps from the start, within which grains fall onto each other
SIZE = {"mixer": 4}  # else the scene's own


def after_the_fall(scene: str) -> Simulation:
    """The simulation of a scene some steps after its start."""
    size = {"n": SIZE[scene]} if scene in SIZE else {}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # what falls overlaps
        sim = Simulation(SCENES[scene](**size), comm=MPI.COMM_SELF)
        sim.run(steps=BEFORE)
    return sim


class Step:
    """CPU seconds of a step, its contacts and its iterations."""

    params = sorted(SCENES)
    param_names = ("scene",)
    number, warmup_time, timeout, timer = 1, 0.0, 600, time.process_time

    def setup(self, scene: str) -> None:
        self.sim = after_the_fall(scene)

    def teardown(self, scene: str) -> None:
        self.sim.close()

    def time_step(self, scene: str) -> None:
        self.sim.step()

    def track_contacts(self, scene: str) -> int:
        return self.sim.step()["contacts"]

    def track_iterations(self, scene: str) -> int:
        return self.sim.step()["iterations"]
