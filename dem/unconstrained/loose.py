"""Constraints that do not hold, as no force can: of bodies that are held otherwise, or that turn too far in a step."""

from __future__ import annotations

import numpy as np

from dem.model.world import World
from dem.parts.ends import HELD, Constraint
from dem.scene import kinds_of
from dem.unconstrained.constraints import constraints_now

EVERY = 10  #: steps from one look to the next: what does not hold comes further apart
APART = 0.1  #: of a half thickness, or radians, that the sides of what is held may be apart after a step


class LooseWatch:
    """Tells once of a constraint whose sides come apart, in a scene with grains of a half thickness [m]."""

    def __init__(self, half: float) -> None:
        self._most = APART * np.repeat([half, 1.0], 3)
        self._told, self._steps = False, 0

    def look(self, world: World, dt: float) -> str:
        """What to say after a step of dt [s], most often nothing; collective."""
        self._steps += 1
        kinds = [] if self._told or self._steps % EVERY else kinds_of(Constraint, world.named)
        parts = [(f"{kind} {name!r}", part) for kind, _, named in kinds for name, part in named.items()]
        if not parts:
            return ""
        error = world.comm.bcast(constraints_now(world)[0].error)
        for (name, part), apart in zip(parts, np.abs(error)):
            held = [each.coordinate for each in part.conditions(apart, dt) if each.kind == HELD]
            if (apart > self._most)[held].any():
                self._told = True
                off = ", ".join(f"{apart[k]:.2g} {'m' if k < 3 else 'rad'}" for k in held if apart[k] > self._most[k])
                why = "its bodies are held otherwise, or turn too far in a step"
                helps = "What helps: other motions, a smaller dt"
                return f"{name} does not hold, its sides are {off} apart: {why}. {helps}"
        return ""
