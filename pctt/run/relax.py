"""Bodies that overlap at the start are pushed apart before the first step, without a speed.

Beds of codes with soft contacts overlap by percents of a radius. As springs of the stiffness of a scene these overlaps
hold more energy than the bed has under gravity, and would throw it up. So here bodies only change places: a step of no
time with rigid contacts without friction moves them by the least way, in the norm of their masses, that opens what
overlaps. As surfaces are curved and contacts come anew, there are some such steps. Velocities are then those of before.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from dem.model.world import World
from dem.parts.passages import Passages
from dem.scene import Scene, least_half
from dem.start import refuse_overlap
from dem.step.impulses import ImpulseMemory
from dem.step.overlaps import overlaps
from pctt import ccp
from pctt.options import OptionError
from pctt.run.settings import CLOSING, Settings
from pctt.run.stepper import NoSolutionError, Stepper

LEFT = 1e-3  #: overlap over half thickness to which they are opened
MOMENT = 1e-6  #: the step, over that of a run: gravity, loads and motions do nothing in it
MOST = 30  #: steps; beds of LIGGGHTS with overlaps of 3 % take 3 to 5


def relax(world: World, scene: Scene, settings: Settings) -> None:
    """Push apart the bodies of a world at time zero; collective. OptionError if they have no room."""
    dt, trial = MOMENT * settings.dt, world.trial()
    speed = world.large.velocity.copy()
    names = [each.name for each in dataclasses.fields(world.pairs) if each.name != "touching"]
    none = {name: np.zeros_like(getattr(world.pairs, name)) for name in names}
    trial.pairs = dataclasses.replace(world.pairs, **none)  # the stepper makes them rigid
    trial.cell, trial.passages = dataclasses.replace(world.cell, deforms=False), Passages()
    closing = CLOSING * settings.delta / dt if settings.delta else math.inf
    still = dataclasses.replace(settings, dt=dt, stiffness=math.inf, closing_speed=closing, law=ccp.RELAXATION)
    still = dataclasses.replace(still, recovery_speed=math.inf)
    half = np.array([least_half(body) for body in scene.large_bodies], float)
    newton = ccp.newton_for(world.comm, still.solver, still.newton, ccp.Comparison(world.comm, []))
    with Stepper(still, trial, ImpulseMemory(world.comm, trial.pairs.parts), newton) as stepper:
        for _ in range(MOST):
            trial.grains.velocity, trial.large.velocity = np.zeros((len(trial.grains), 6)), np.zeros_like(speed)
            try:
                made = stepper.step()
            except NoSolutionError:
                break
            if overlaps(made.step, half)[0] <= LEFT:
                break
            stepper.take(made)
    grains, large, ids = trial.grains, trial.large, trial.grains.id
    first = int(ids.min(initial=scene.count))
    grains.velocity = scene.grains(first, int(ids.max(initial=first - 1)) + 1).velocity[ids - first]
    grains = world.cell.inside(grains)
    large.velocity = speed
    world.set_grains(grains)
    world.large = large
    try:
        refuse_overlap(world, 0.01)
    except ValueError as error:
        raise OptionError(f"overlap relax: there is no room to push bodies apart: {error}") from None
