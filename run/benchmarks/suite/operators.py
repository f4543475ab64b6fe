"""Products, assembly and search on a settled mixer (2,590 contacts at n = 4), and its cone problem by each solver."""

from __future__ import annotations

import time

import numpy as np
from shared import next_problem, settled

from dem.contact import find_contacts
from dem.step.system import ContactSystem
from dem.unconstrained import unconstrained
from pctt import ccp
from pctt.body_matrix import BodyOperator
from pctt.scenes import SCENES


class Mixer:
    """The parts of a step, each alone."""

    timeout, timer = 600, time.process_time

    def setup(self) -> None:
        self.sim = settled(SCENES["mixer"](n=4))
        self.problem = next_problem(self.sim)
        rng = np.random.default_rng(0)
        G = self.problem.contact_map
        self.g = rng.normal(size=(G.rows, 3))
        self.v = G.momenta(self.g)
        self.y = np.zeros_like(self.g)
        self.operator = BodyOperator(G)
        self.operator.update(np.tile(np.eye(3), (G.rows, 1, 1)))
        self.out = np.zeros_like(self.v)
        self.contacts = self.find()
        for name in dir(self):
            if name.startswith("time_"):
                getattr(self, name)()  # compiles

    def teardown(self) -> None:
        self.operator.destroy()
        self.problem.destroy()
        self.sim.close()

    def find(self):
        free = unconstrained(self.sim.world, self.sim.settings.dt)
        return find_contacts(self.sim.world, self.sim.settings.delta, free)

    def time_velocities(self) -> None:
        self.problem.contact_map.velocities(self.v)

    def time_momenta(self) -> None:
        self.problem.contact_map.momenta(self.g)

    def time_products_S(self) -> None:
        self.problem.contact_map.add_delassus(self.g, self.y)

    def time_products_K(self) -> None:
        self.operator._product(self.v, self.out)

    def time_search(self) -> None:
        self.find()

    def time_assembly(self) -> None:
        settings = self.sim.settings
        free = unconstrained(self.sim.world, settings.dt)
        ContactSystem(self.sim.world, self.contacts, free, settings.recovery_speed)

    def time_residual(self) -> None:
        self.problem.natural_residual(self.g, self.y)


class Solver:
    """A cone problem from zero to a natural residual: seconds and iterations."""

    params = (["apgd", "conic", "pdip"], [1e-4, 1e-6])
    param_names = ("solver", "tol")
    timeout, timer = 600, time.process_time

    def setup(self, solver: str, tol: float) -> None:
        self.sim = settled(SCENES["mixer"](n=4))
        self.problem = next_problem(self.sim)
        self.limits = ccp.Limits(tol, closing_work=np.inf, fallback=False)
        self.time_solve(solver, tol)  # compiles

    def teardown(self, solver: str, tol: float) -> None:
        self.problem.destroy()
        self.sim.close()

    def time_solve(self, solver: str, tol: float) -> None:
        self.result = ccp.solve(self.problem, None, solver, self.limits, law=ccp.RELAXATION)

    def track_iterations(self, solver: str, tol: float) -> int:
        return self.result.iterations

    track_iterations.unit = "iterations"
