"""One time step after another: search contacts, assemble and solve the cone problem, move the bodies."""

from __future__ import annotations

import resource
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from mpi4py import MPI

from dem.arrays import Floats, Ints, Keys
from dem.contact import Contacts, find_contacts
from dem.contact.lists import shared
from dem.exchange import reduced
from dem.model.images import wrap
from dem.model.partition import rebalance
from dem.model.world import World
from dem.record.passage import insert_and_remove
from dem.step import Step, advance
from dem.step.fast import refuse_passages
from dem.step.impacts import in_order
from dem.step.impulses import ImpulseMemory
from dem.step.missed import carried, find_overrun, find_turned
from dem.step.system import ContactSystem
from dem.together import SceneError
from dem.unconstrained import UnconstrainedMotion, unconstrained
from pctt import ccp, log
from pctt.arrays import Array
from pctt.options import OptionError
from pctt.run import rest

if TYPE_CHECKING:
    from pctt.run.dump import Dump
    from pctt.run.settings import Settings

TRIES = 3  #: linearisations of turned contacts in a step, and of limits and motors that contacts have shown


class NoSolutionError(SceneError):
    """The contacts of a step have no solution; the bodies are where they were before it."""


@dataclass(frozen=True)
class NewStep:
    """A step that is made, and whose world no `Stepper` has taken yet."""

    step: Step  #: its world is that at the end of the step
    figures: dict[str, Any]  #: the line of the step in steps.jsonl
    held: Array  #: (parts nc, 3) impulses with which springs begin the next step
    kept: Array  #: (nc, columns) what the laws of contact keep


@dataclass(frozen=True)
class _Attempt:
    """What a step is tried with; a solution may show that it lacks something."""

    free: UnconstrainedMotion
    contacts: Contacts
    eased: tuple[Keys, Floats] | None = None  #: contacts that bounce with a part of e alone
    smooth: bool = False  #: impacts without friction
    turned: int = 0  #: how often turned contacts were linearised
    shown: int = 0  #: how often contacts have shown limits, or motors that are too weak
    impulses: ImpulseMemory | None = None  #: those of the attempt before, of other contacts
    before: ccp.Result | None = None  #: what the attempts before have cost


class Stepper:
    """Makes the steps of a world, one after another.

    Owns its ``newton`` and keeps the impulses of the last step; `destroy` frees them.
    """

    def __init__(self, settings: Settings, world: World, memory: ImpulseMemory, newton: ccp.Newton | None = None):
        self.world, self.memory, self.newton = world, memory, newton
        self.dump: Dump | None = None
        self.use(settings)
        self._slabs: Ints | None = None  # those of the last step, whose impulses the memory has
        if settings.stiffness is not None:
            world.pairs.stiffness[:] = settings.stiffness
        if world.cell.deforms and not np.isfinite(world.pairs.stiffness).all():
            raise OptionError("stiffness inf: a cell of given stress needs contacts that give way; allowed is less")

    def use(self, settings: Settings) -> None:
        """Make the next steps by these settings."""
        self.settings, self._limits = settings, ccp.watched(self.world.comm, settings.limits)

    def __enter__(self) -> Stepper:
        return self

    def __exit__(self, *exception: object) -> None:
        self.destroy()

    def destroy(self) -> None:
        if self.newton is not None:
            self.newton.destroy()

    def step(self) -> NewStep:
        """Make a step of dt; the world stays as it is until `take`. SceneError if a body is lost (its position is no
        number), if code of the scene fails, or if the contacts have no solution: any impulses would be invented, and
        those of the solver throw bodies away."""
        try:
            return self._next_step(self.world.trial())
        except FloatingPointError as error:  # raised on all ranks alike
            raise SceneError(f"step {self.world.step + 1}: {error}") from None

    def take(self, made: NewStep) -> None:
        """Let the world and the memory be those at the end of this step."""
        system = made.step.system
        self.world.take(made.step.world)
        self.memory.remember(system.key, made.held, system.frame, made.kept)
        self._slabs = self.world.slabs

    def _next_step(self, world: World) -> NewStep:
        """The paper's step: contacts that close within it act from its start, and no gap is negative at its end."""
        attempt = self._begun(world)
        while True:
            system, problem, guess = self._assembled(world, attempt)
            with problem:
                result = self._solved(world, system, problem, guess, attempt.before)
                velocity, again = self._tested(world, attempt, system, result)
                files = {} if again else self._dumped(system, problem, guess, result)
            if again is None:
                break
            del attempt, system, problem, guess, result, velocity  # before others take as much memory
            attempt = again()
        _refuse_squeezed(world, result)
        with log.phase("advance"):
            system.take_flow(world, attempt.contacts)
            advance(world, attempt.free, attempt.contacts, velocity, system.kept(velocity, result.impulse))
            step = Step(world, attempt.contacts, system, *system.parts(result.impulse))
            held, kept = system.held_after(result.impulse), system.keep(world, result.impulse, result.momentum)
        return NewStep(step, self._figures(world, problem.size, result, files), held, kept)

    def _begun(self, world: World) -> _Attempt:
        """The first attempt of a step."""
        with log.phase("search"):
            insert_and_remove(world)  # grains that leave, and those that are due
            wrap(world)  # into the periodic cell
            rebalance(world)
            free = unconstrained(world, self.settings.dt)  # gravity, spin, loads, springs, drives, motions
            found = find_contacts(world, self.settings.delta, free)
            return _Attempt(free, self._shared(world, in_order(world, found, free)))

    def _assembled(self, world: World, attempt: _Attempt) -> tuple[ContactSystem, ccp.ConeProblem, Array]:
        """The contacts of an attempt, their cone problem, and a guess of its solution (parts nc, 3)."""
        with log.phase("assembly"):
            contacts, recovery = attempt.contacts, self.settings.recovery_speed
            elsewhere = self._slabs is not world.slabs
            guess, _, kept = self.memory.recall(contacts.key, contacts.frame, elsewhere)
            system = ContactSystem(world, contacts, attempt.free, recovery, guess, attempt.eased, attempt.smooth, kept)
            if attempt.impulses is not None:
                guess = attempt.impulses.recall(system.key, system.frame, elsewhere=False)[0]
            return system, cone_problem(system, world.comm), guess

    def _tested(
        self, world: World, attempt: _Attempt, system: ContactSystem, result: ccp.Result
    ) -> tuple[Array, Callable[[], _Attempt] | None]:
        """The velocities (owned, 6) of a solution, and what makes the next attempt if they show that the problem lacks
        something; collective. No result is kept for it: it takes memory while others are made."""
        # no impulses let bodies bounce as they are to, or only such as make energy: in a corner friction may press one
        # on a wall as fast as another sends it off
        if not attempt.smooth and result.status is ccp.Status.UNBOUNDED and world.pairs.bounces:
            return np.zeros((0, 6)), _smooth(attempt, system, result)
        other = less = None
        with log.phase("search"):  # bodies that meet unforeseen
            system.set_rate(world, result.momentum)
            velocity = system.velocity_with(result.momentum)  # v_free + M^-1 D g
            missed, turned = self._missed(world, system, velocity, attempt.turned)
        with log.phase("assembly"):
            if missed is None and attempt.shown < TRIES:  # limits reached, motors too weak
                other = system.refound(world, result.impulse, velocity)
            if missed is other is None:  # impacts that would make energy
                less = system.eased(world, result.impulse, result.momentum)
                if less is None and system.jams and not attempt.smooth:
                    return velocity, _smooth(attempt, system, result)
        if missed is other is less is None:
            return velocity, None
        more: dict[str, Any] = {
            "free": other or system.motion,
            "eased": less or attempt.eased,
            "smooth": attempt.smooth,
            "turned": turned,
            "shown": attempt.shown + (other is not None),
            "impulses": _remembered(world, system, result),
            "before": result.cost,
        }
        if missed is None:
            return velocity, partial(_Attempt, contacts=attempt.contacts, **more)
        return velocity, partial(self._searched, world, missed, more)

    def _searched(self, world: World, search: Callable[[], Contacts], more: dict[str, Any]) -> _Attempt:
        """The attempt with the contacts of another search."""
        with log.phase("search"):
            return _Attempt(contacts=self._shared(world, search()), **more)

    def _shared(self, world: World, contacts: Contacts) -> Contacts:
        """The contacts, whose lists and table the worlds before and after the step share."""
        lists = shared(contacts.lists, contacts.near, self.world, world)
        return contacts if lists is contacts.lists else replace(contacts, lists=lists)

    def _solved(
        self, world: World, system: ContactSystem, problem: ccp.ConeProblem, guess: Array, before: ccp.Result | None
    ) -> ccp.Result:
        """The solution of a problem of the step as the settings say, with what that `before` has cost."""
        with log.phase("solve"):
            limits = rest.limits_of(self._limits, world, system)
            result = self._by(problem, guess, limits, self.newton)
            rest.account(world, limits, result)
            of_parts = partial(self._by, newton=None if self.newton is None else self.newton.of_parts)
            result = rest.with_islands(world, system, problem, guess, limits, of_parts, result)
            result = rest.with_unlike_masses(problem, limits, partial(self._by, newton=self.newton), result)
        return result if before is None else result.after(before)

    def _by(
        self, problem: ccp.ConeProblem, guess: Array, limits: ccp.Limits, newton: ccp.Newton | None
    ) -> ccp.Result:
        """What the method of the settings makes of a problem."""
        settings = self.settings
        return ccp.solved(problem, guess, settings.solver, limits, settings.options, newton, settings.law)

    def _missed(
        self, world: World, system: ContactSystem, velocity: Array, turned: int
    ) -> tuple[Callable[[], Contacts] | None, int]:
        """What finds the contacts, with those that these velocities (owned, 6) show to be missed; None if there are
        none. A few times a step with those that overlap at its end because bodies turn, by a tenth of delta: and how
        often now."""
        settings, contacts, free = self.settings, system.contacts, system.motion
        delta, recovery = settings.delta, settings.recovery_speed
        left = settings.dt * self._limits.closing_speed  # what a solution may leave of an overlap
        deep = max(0.01 * delta, left if left < np.inf else 0.0)
        search = find_overrun(world, free, contacts, velocity, delta, deep, recovery)
        if search is not None:
            return partial(_wider, world, free, search, contacts if turned else None), turned
        if turned < TRIES and not world.only_spheres:
            anew = find_turned(world, free, contacts, velocity, 0.1 * delta, recovery, turned)
            if anew is not None:
                return lambda: anew, turned + 1
        refuse_passages(world, free, contacts, velocity, delta)
        return None, turned

    def _dumped(
        self, system: ContactSystem, problem: ccp.ConeProblem, guess: Array, result: ccp.Result
    ) -> dict[str, Any]:
        """The entries of the figures for the files of the problem, if it is written."""
        if self.dump is None:
            return {}
        with log.phase("output"):
            return self.dump.step(system, problem, guess, result, result.asked or result)

    def _figures(self, world: World, contacts: int, result: ccp.Result, files: dict[str, Any]) -> dict[str, Any]:
        """The line of a step in steps.jsonl."""
        newton = self.newton
        pc_report = newton.linear.report() if newton is not None else []
        compare = newton.compare if newton is not None else None
        phases = ("search", "assembly", "solve", *(("compare",) if compare else ()), "advance")
        return {
            "step": world.step,
            "time": world.time,
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
            "peak_memory": _peak_memory(world.comm),
            "phases": log.take_seconds(phases),
        }


def _smooth(attempt: _Attempt, system: ContactSystem, result: ccp.Result) -> Callable[[], _Attempt]:
    """What makes the same attempt with impacts without friction."""
    return partial(replace, attempt, free=system.motion, smooth=True, before=result.cost)


def _wider(
    world: World, free: UnconstrainedMotion, search: Callable[[], Contacts], turned: Contacts | None
) -> Contacts:
    """The contacts of a search, with those that were linearised anew."""
    wider = in_order(world, search(), free)
    return wider if turned is None else carried(world, turned, wider)


def _remembered(world: World, system: ContactSystem, found: ccp.Result) -> ImpulseMemory:
    """A memory of these impulses of the contacts of a system."""
    memory = ImpulseMemory(world.comm, world.pairs.parts)
    memory.remember(system.key, found.impulse, system.frame)
    return memory


def _refuse_squeezed(world: World, result: ccp.Result) -> None:
    if result.status is ccp.Status.UNBOUNDED:
        raise NoSolutionError(
            f"step {world.step + 1}: {result.reason}: rigid bodies are squeezed, and no impulses stop it; the "
            "run ends with the state before. What helps: a stiffness, a smaller dt, or tools of bounded force"
        )


def cone_problem(system: ContactSystem, comm: MPI.Comm) -> ccp.ConeProblem:
    """The cone problem of a step's contacts."""
    r: Array = system.r
    cones: ccp.FrictionCones | ccp.RollingCones = ccp.FrictionCones(system.mu)
    if (resists := system.resistance) is not None:
        r, cones = np.concatenate([r, resists.velocity]), ccp.RollingCones(system.mu, *resists.most)
    of_contacts = system.point, system.key, system.compliance
    return ccp.ConeProblem.of_bodies(comm, r, cones, system.problem_map, *of_contacts)


def _peak_memory(comm: MPI.Comm) -> int:
    """The most memory that the ranks have had so far, their sum [bytes]; collective."""
    unit = 1 if sys.platform == "darwin" else 1024
    (most,), _ = reduced(comm, (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit,), ())
    return int(most)
