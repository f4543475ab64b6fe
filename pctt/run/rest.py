"""Whether the bodies are at rest, and how far steps then go beyond the limits of the solver.

A step begins with the impulses of the last one. What these lack of a solution moves bodies, and so it is what the next
step has to mend: in a bed that is stirred the motion itself changes more. At rest it is all that there is to do. A
solver that stops as soon as the limits are met shakes bodies at rest for ever, by as much as these allow; one that goes
on stops the shaking, and then each step has nothing left to do. So at rest going on costs no more iterations, in all.

So it is with an island, bodies that touch no other that moves, beside others that do: its part of the problem is solved
once more, by itself.

Nor may impacts have errors, where bodies do little else: APGD, which stops on its way past the solution, leaves all of
them too strong, and a gas that loses nothing gains some per cent of its energy in a second.

The natural residual has one step and one norm for all contacts. Where masses are unlike, it does not see whether heavy
bodies slide as friction wants, and light ones may be thrown up by what it allows. So there a step is judged in the
units of each contact, too, and goes on where it falls short.

Many contacts may need more iterations than that is worth, in a bed, say. So the iterations beyond the limits are
counted (`World.spare`): so many as SPARE, and a SHARE of all iterations, may lead nowhere.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from dem import bodies
from dem.arrays import Floats
from dem.compiled import loop
from dem.exchange import reduced
from dem.model.world import World
from dem.record.energies import add_kinetic
from dem.step.islands import contacts_at_rest
from dem.step.system import ContactSystem
from pctt.arrays import TINY, Array
from pctt.ccp import RELAXATION, ConeProblem, Limits, Result, with_part

Solve = Callable[[ConeProblem, Array, Limits], Result]

SLOW = 0.3  #: kinetic energy of bodies at rest, over that of a step of free fall: loose steps shake them by 0.2
STILL = 2e-3  #: the same where many contacts are worth iterations: beds that settle have 0.004 to 0.07
AIM = 1e-4  #: residual to go on to, over that of the limits: with 1e-3 boxes with masses 1 : 1e4 creep by 4 um/s
UNLIKE = 100.0  #: greatest over least number of the diagonal of N: of spheres with radii 1 : 3 it is about 50
LOOSER = 10.0  #: tolerance in units of each contact, over the natural one: with 1 beds of radii 1 : 6 take 1.6 times
ATTEMPT = 100  #: iterations beyond the limits in a step, of more than few contacts
SPARE = World.spare  #: and all that may lead nowhere: a wall of 144 boxes takes 2,400 until each step needs 20
SHARE = 0.1  #: and this part of all iterations


def limits_of(limits: Limits, world: World, system: ContactSystem) -> Limits:
    """The limits of a step: with an aim beyond them where bodies are at rest, or fly from impact to impact;
    collective."""
    part = 0.0 if _of_impacts(world, system) else _kinetic_part(world, system)
    return limits if part >= SLOW else _aimed(limits, world, part)


def _aimed(limits: Limits, world: World, part: float) -> Limits:
    """The same limits with an aim, for bodies with this part of the energy of a free fall."""
    spare = ATTEMPT if part < STILL and world.spare >= ATTEMPT else 0
    return limits.but(aim=AIM, spare=spare)


def with_islands(
    world: World, system: ContactSystem, problem: ConeProblem, guess: Array, limits: Limits, solve: Solve, found: Result
) -> Result:
    """The result ``found`` by limits without an aim, with impulses of islands at rest that meet the aim: a part of the
    problem, to which ``solve`` is applied. Collective."""
    if limits.aim < 1.0 or not found.converged or not problem.size:
        return found
    contacts, part = contacts_at_rest(world, system, _passing(world, system), SLOW)
    (count,), (part,) = reduced(world.comm, (len(contacts),), (part,))
    if not count:
        return found
    limits, rows = _aimed(limits, world, part), problem.cones.rows_of(contacts)
    with problem.part(contacts) as part_problem:
        finer = solve(part_problem, guess[rows], limits)
    account(world, limits, finer)
    if not finer.converged:
        return found
    # The residual is relative: where the island's impulses become smaller, that of all others may be above its limit.
    whole = with_part(problem, found, rows, finer)
    assert whole.accuracy is not None
    return whole if whole.residual_of(whole.accuracy) <= limits.tol else found.after(finer)


def with_unlike_masses(problem: ConeProblem, limits: Limits, solve: Solve, found: Result) -> Result:
    """The result, or what ``solve`` makes of it beyond the limits where masses are unlike, and it is far from a
    solution in the units of each contact. Collective."""
    if not found.converged or problem.spread <= UNLIKE:
        return found
    assert found.accuracy is not None
    over = _over_limits(problem, limits, found)
    if over <= 1.0:
        return found
    aim = 0.5 / over * found.residual_of(found.accuracy) / limits.tol
    finer = solve(problem, found.impulse, limits.but(aim=aim, spare=ATTEMPT))
    return finer.after(found) if finer.converged else found.after(finer)


def _over_limits(problem: ConeProblem, limits: Limits, found: Result) -> float:
    """The natural residual with steps of 1 / diag N, and norms that these weigh, over the tolerance; or the greatest
    speed [m/s] that its own impulse gives a contact that opens, over that of closing. Collective."""
    N = problem.diagonal[: problem.cones.count, 0]
    N = np.where(N > 0.0, N, problem.mean_diagonal)
    g, weight = found.impulse, N[:, None]
    y = problem.velocity_of(found.momentum) + problem.compliance * g + problem.r
    steps = np.tile(1.0 / weight, (problem.cones.parts, 1))
    move = problem.cones.move(g, y, steps, found.law != RELAXATION)[: len(N)]
    y, g = y[: len(N)], g[: len(N)]
    moved, whole = problem.sums(float((weight * move**2).sum()), float((weight * g**2).sum()))
    opens = problem.max(float(np.minimum(y[:, 0], N * g[:, 0]).max(initial=0.0)))
    return max(np.sqrt(moved / max(whole, TINY)) / (LOOSER * limits.tol), opens / limits.closing_speed)


def account(world: World, limits: Limits, result: Result) -> None:
    """Count what a step has spent beyond its limits, unless these iterations reached the aim: then the next may spend
    all. Where the conic method reached it, for few contacts, they did not."""
    if limits.spare and result.residual <= limits.aimed and not result.newton_its:
        world.spare = SPARE
    else:
        world.spare = min(SPARE, world.spare - result.beyond + SHARE * result.iterations)


def _of_impacts(world: World, system: ContactSystem) -> bool:
    """Whether most contacts that close without impulses are impacts. Collective."""
    if not world.pairs.bounces:
        return False
    strikes = system.strikes[system.r[:, 0] < 0.0]
    (more,), _ = reduced(world.comm, (2 * int(strikes.sum()) - len(strikes),), ())
    return more > 0


def _kinetic_part(world: World, system: ContactSystem) -> float:
    """The kinetic energy of the bodies over that which a step of free motion would give them; inf where a tool, a belt
    or a flow passes them faster than that. Collective."""
    grains, large = world.grains, world.large
    own = [(grains, system.free_velocity)]
    if world.large_moves and world.comm.rank == 0:  # as in a record
        own.append((large, system.free_large))
    each = [energies_of_fall(of.quaternion, of.velocity, of.mass, of.inertia, free) for of, free in own]
    (kinetic, fall, mass), _ = reduced(world.comm, [*map(sum, zip(*each))], ())
    if kinetic >= SLOW * fall:  # so a bed that is stirred pays for two sums
        return np.inf
    _, (fastest,) = reduced(world.comm, (), (_passing(world, system).max(initial=0.0),))
    passes = 0.5 * mass * fastest**2 > fall
    return np.inf if passes else float(kinetic / fall)


@loop
def energies_of_fall(
    turn: Floats, velocity: Floats, mass: Floats, inertia: Floats, free: Floats
) -> tuple[float, float, float]:
    """Of the n bodies of finite mass the kinetic energy [J], that of the changes of their linear velocities to those of
    a `free` motion (n or more, 6) [J], and their mass [kg]."""
    kinetic, fall, total = 0.0, 0.0, 0.0
    for n in range(len(mass)):
        if np.isfinite(mass[n]):
            kinetic, total = add_kinetic(kinetic, turn[n], velocity[n], mass[n], inertia[n]), total + mass[n]
            for k in range(3):
                fall += 0.5 * mass[n] * (free[n, k] - velocity[n, k]) ** 2
    return kinetic, fall, total


def _passing(world: World, system: ContactSystem) -> Floats:
    """The greatest component (nc,) [m/s] of the velocity that tools, which are bodies of prescribed motion, belts and
    the flow of a cell have at each contact."""
    tools, first = system.free_large, len(system.near.bodies) - len(system.free_large)
    if world.large_moves:
        tools = np.where(bodies.is_dynamic(world.large)[:, None], 0.0, tools)
    most = np.zeros(len(system.contacts))
    if tools.any():
        table = np.zeros(system.near.bodies.velocity.shape)
        table[first:] = tools
        most = system.contact_map.greatest_velocities(table, first)
    for known in (system.surface, system.drift):
        if known is not None:
            most = np.maximum(most, np.abs(known).max(axis=1, initial=0.0))
    return most
