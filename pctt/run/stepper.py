"""One time step after another: search contacts, assemble and solve the cone problem, move the bodies."""

from __future__ import annotations

import resource
import sys
from typing import Any

import numpy as np
from mpi4py import MPI

from dem.arrays import Ints, Keys
from dem.contact import Contacts, find_contacts
from dem.exchange import reduced
from dem.fast import refuse_passages
from dem.impacts import in_order
from dem.impulses import ImpulseMemory
from dem.joints import Coupling
from dem.partition import rebalance
from dem.passage import come_and_go
from dem.period import put_back
from dem.step import advance, carried, find_overrun, find_turned
from dem.system import ContactSystem, contact_frames
from dem.together import SceneError
from dem.unconstrained import UnconstrainedMotion, large_velocity, unconstrained
from dem.world import World
from pctt import ccp, log
from pctt.ccp.cones import Array, Cones
from pctt.options import OptionError
from pctt.run import rest
from pctt.run.dump import Dump
from pctt.run.settings import Settings


class NoSolutionError(SceneError):
    """The contacts of a step have no solution; the bodies are where they were before it."""


class Stepper:
    """One time step after another of a world; keeps the last step's contacts and impulses for output.

    Owns its ``newton`` and the PETSc objects of the present step; `destroy` frees them.
    """

    contacts: Contacts
    motion: UnconstrainedMotion
    system: ContactSystem
    impulse: np.ndarray
    moment: np.ndarray | None  #: where contacts resist rolling or spinning
    history: list[float]  #: natural residual by iteration

    def __init__(
        self,
        settings: Settings,
        world: World,
        memory: ImpulseMemory,
        newton: ccp.Newton | None = None,
        dump: Dump | None = None,
    ):
        self.settings, self.world, self.memory, self.newton, self.dump = settings, world, memory, newton, dump
        self._problem: ccp.ConeProblem | None = None
        self._corrections = 0  # of the present step
        # what joints hold in the present step, once its contacts have shown it, and how often
        self._joints: Coupling | None = None
        self._push: Array | None = None  # momenta that the contacts of the present step are expected to give
        self._shown = 0
        self._slabs: Ints | None = None  # those of the last step, or of a solution that is remembered within this one
        if settings.stiffness is not None:
            world.pairs.stiffness[:] = settings.stiffness
        if world.servo is not None and not np.isfinite(world.pairs.stiffness).all():
            raise OptionError("-stiffness inf: a cell of given stress needs contacts that give way; allowed is less")

    def __enter__(self) -> Stepper:
        return self

    def __exit__(self, *exception: object) -> None:
        self.destroy()

    def destroy(self) -> None:
        self._release()
        if self.newton is not None:
            self.newton.destroy()

    def _release(self) -> None:
        """Free the PETSc objects of the present problem."""
        if self._problem is not None:
            self._problem.destroy()
            self._problem = None

    def step(self) -> dict[str, Any]:
        """Advance the world by dt; the step's figures. SceneError if a body is lost (its position is no number), or if
        the contacts have no solution: any impulses would be invented, and those of the solver throw bodies away."""
        servo = self.world.servo
        try:
            return self._step()
        except FloatingPointError as error:  # raised on all ranks alike
            self.world.servo = servo
            raise SceneError(f"step {self.world.step + 1}: {error}") from None
        except SceneError:
            self.world.servo = servo
            raise

    def _step(self) -> dict[str, Any]:
        self._corrections, self._shown, self._joints, self._push = 0, 0, None, None
        self._eased: tuple[Keys, Array] | None = None
        self._smooth = False  # whether impacts of the present step are without friction
        with log.phase("search"):
            come_and_go(self.world)
            put_back(self.world)
            rebalance(self.world)
            self.motion = unconstrained(self.world, self.settings.dt)
            contacts = find_contacts(self.world, self.settings.delta, self.motion)
            contacts = in_order(self.world, contacts, self.motion)
        problem, guess, result = self._solved(contacts)
        with log.phase("output"):
            files = self.dump.step(self.system, problem, guess, result, result.asked or result) if self.dump else {}
        if result.status is ccp.Status.UNBOUNDED:
            raise NoSolutionError(
                f"step {self.world.step + 1}: {result.reason}: rigid bodies are squeezed, and no impulses stop it; the "
                "run ends with the state before. What helps: a -stiffness, a smaller -dt, or tools of bounded force"
            )
        with log.phase("advance"):
            forces, moments = np.split(result.impulse, [len(self.contacts)])
            self.impulse, self.history = self.system.net(forces), result.history
            self.moment = None if self.system.resistance is None else moments
            self.system.take_flow(self.world, self.contacts)
            velocity = self.system.velocity_with(result.momentum)
            kept = self.system.kept(self.world, velocity) if self.system.middle is not None else None
            advance(self.world, self.motion, self.contacts, velocity, kept)
            kept = self.system.held_after(result.impulse)  # with which springs begin the next step
            self.memory.remember(self.system.key, kept, self.system.frame)
            self._slabs = self.world.slabs
        self._release()
        return self._figures(problem.size, result, files)

    def _solved(self, contacts: Contacts) -> tuple[ccp.ConeProblem, Array, ccp.Result]:
        """The paper's step: contacts that close within it act from its start, and no gap is negative at its end."""
        problem, guess = self._assemble(contacts)
        result = self.solve(problem, guess)
        while True:
            if self._locks(result):
                problem, guess = self._assemble(self.contacts)
            else:
                again = self._unseen(result.momentum)
                if again is None and self._machines_are(result) and not self._gains(result):
                    return problem, guess, result
                problem, guess = self._assemble(self.contacts if again is None else again, self._remembered(result))
            result = self.solve(problem, guess).after(result)

    def _figures(self, contacts: int, result: ccp.Result, files: dict[str, Any]) -> dict[str, Any]:
        """The line of a step in steps.jsonl."""
        newton = self.newton
        pc_report = newton.linear.report() if newton is not None else []
        compare = newton.compare if newton is not None else None
        phases = ("search", "assembly", "solve", *(("compare",) if compare else ()), "advance")
        return {
            "step": self.world.step,
            "time": self.world.time,
            "contacts": contacts,
            "newton_its": result.newton_its,
            "iterations": result.iterations,
            "ksp_its": result.ksp_its,
            "cone_problems": result.cone_problems,
            **vars(result.accuracy),
            "converged": result.converged,
            "status": result.status.value,
            "reason": result.reason,
            "fallbacks": result.fallbacks,
            "solver": result.solver,
            "law": result.law,
            "asked_solver": self.settings.solver,
            "tolerance": self.settings.tol,
            **({"pc_report": pc_report} if pc_report else {}),
            **files,
            **({"compare": compare.take_solves()} if compare else {}),
            "peak_memory": _peak_memory(self.world.comm),
            "phases": log.take_seconds(phases),
        }

    def _assemble(self, contacts: Contacts, found: ImpulseMemory | None = None) -> tuple[ccp.ConeProblem, Array]:
        """The problem of these contacts, which takes the place of the last, and a guess: the impulses of the last step,
        or those found within this one."""
        self._release()
        given = self.motion, self.settings.recovery_speed, self._joints
        within = self._push, self._eased, self._smooth
        with log.phase("assembly"):
            place = contacts.key, contact_frames(contacts.normal)
            last, _ = self.memory.recall(*place, self._slabs is not self.world.slabs)
            self.contacts, self.system = contacts, ContactSystem(self.world, contacts, *given, last, *within)
            self._push = self.system.push
            guess = last if found is None else found.recall(*place, elsewhere=False)[0]
            self.system.take_hold(last[: len(contacts)])
            self._problem = cone_problem(self.system, self.world.comm)
        return self._problem, guess

    def _locks(self, result: ccp.Result) -> bool:
        """Whether no impulses let bodies bounce as they are to, so that their impacts are to be without friction: in a
        corner it may press a body on one wall as fast as the other sends it off."""
        locked = result.status is ccp.Status.UNBOUNDED and not self._smooth
        self._smooth = self._smooth or (locked and bool(self.world.pairs.restitution.any()))
        return locked and self._smooth

    def _unseen(self, momentum: Array) -> Contacts | None:
        """The present contacts, with those that these momenta show to be missed; None if there are none. Three times a
        step at most with those that overlap at its end because bodies turn, by a tenth of delta."""
        world, settings, contacts, motion = self.world, self.settings, self.contacts, self.motion
        delta, dt, recovery = settings.delta, settings.dt, settings.recovery_speed
        with log.phase("search"):
            velocity = self.system.velocity_with(momentum)
            self.system.set_rate(world, momentum)
            left = dt * settings.limits.closing_speed  # what a solution may leave of an overlap
            deep = max(0.01 * delta, left if left < np.inf else 0.0)
            wider = find_overrun(world, motion, contacts, velocity, delta, deep, recovery)
            if wider is not None:
                wider = in_order(world, wider, motion)
                return carried(world, contacts, wider) if self._corrections else wider
            if self._corrections < 3 and not world.only_spheres:
                turned = find_turned(world, motion, contacts, velocity, 0.1 * delta, recovery, self._corrections)
                if turned is not None:
                    self._corrections += 1
                    return turned
            refuse_passages(world, motion, contacts, velocity, delta)
            return None

    def _remembered(self, found: ccp.Result) -> ImpulseMemory:
        """A memory of these impulses of the present contacts."""
        memory = ImpulseMemory(self.world.comm, self.world.pairs.parts)
        memory.remember(self.system.key, found.impulse, self.system.frame)
        return memory

    def _machines_are(self, result: ccp.Result) -> bool:
        """Whether the limits and motors that the step takes as holding, and the drives that it takes as strong enough,
        are those with these impulses, or three others were tried; else the others are set. Collective."""
        if self._shown == 3:
            return True
        with log.phase("assembly"):
            joints, spent = self._joints_with(result), None
            if self.system.drives.most.any():
                velocity = self.system.velocity_with(result.momentum)
                spent = self.system.spent_with(large_velocity(self.world, self.motion, velocity))
        if joints is None and spent is None:
            return True
        self._joints = self._joints if joints is None else joints
        self.motion = self.motion if spent is None else self.motion.with_spent(self.world, spent)
        self._shown += 1
        return False

    def _gains(self, result: ccp.Result) -> bool:
        """Whether impacts with these impulses make energy, and are to bounce less; collective."""
        if not self.world.pairs.restitution.any():
            return False
        with log.phase("assembly"):
            eased = self.system.eased(result.impulse, result.momentum)
        self._eased = self._eased if eased is None else eased
        return eased is not None

    def _joints_with(self, result: ccp.Result) -> Coupling | None:
        """The joints of the step with the limits and motors that hold with these impulses; None if they are those that
        it takes. Collective."""
        if self.system.joints is None:
            return None
        forces, moments = np.split(result.impulse, [len(self.contacts)])
        resists = None if self.system.resistance is None else moments
        return self.system.joints_with(self.world, self.system.net(forces), resists)

    def solve(self, problem: ccp.ConeProblem, guess: Array) -> ccp.Result:
        """Solve a problem of the step as the settings say."""
        settings = self.settings
        with log.phase("solve"):
            limits = rest.limits_of(settings.limits, self.world, self.system)
            result = ccp.solve(problem, guess, settings.solver, limits, settings.options, self.newton, settings.law)
            rest.account(self.world, limits, result)
            return result


def cone_problem(system: ContactSystem, comm: MPI.Comm) -> ccp.ConeProblem:
    """The cone problem of a step's contacts."""
    G, point, key, soft = system.problem_map, system.point, system.key, system.compliance
    r: Array = system.r
    cones: Cones = ccp.FrictionCones(system.mu)
    if (resists := system.resistance) is not None:
        r = np.concatenate([r, resists.velocity])
        cones = ccp.RollingCones(system.mu, resists.rolling, resists.spinning)
    return ccp.ConeProblem(comm, r, cones=cones, G=G, point=point, key=key, compliance=soft)


def _peak_memory(comm: MPI.Comm) -> int:
    """The most memory that the ranks have had so far, their sum [bytes]; collective."""
    unit = 1 if sys.platform == "darwin" else 1024
    (most,), _ = reduced(comm, (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit,), ())
    return int(most)
