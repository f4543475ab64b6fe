"""The watch of overlaps: whether a run keeps what it promises, and if not, which option helps."""

from __future__ import annotations

import math

import numpy as np

from dem.scene import Scene, least_half
from dem.start.stiffness import expected_overlap
from dem.start.time_step import smallest
from dem.start.tools import DRIVEN
from dem.step import Step
from dem.step.overlaps import overlaps
from pctt.run.report import remedy
from pctt.run.settings import CLOSING, Settings

SOFT = 0.5  #: parts of a half thickness, beyond which bodies are no longer rigid at all
TWICE = 2.0  #: overlaps are told of that are so many times what is promised

#: What makes overlaps, by the field of `Settings` that helps.
CAUSES = {
    "stiffness": "contacts bear more than their stiffness was chosen for",
    "dt": "bodies go or turn too far in a step",
    "tol": "the solver lets contacts close",
}


class OverlapWatch:
    """What the contacts of a scene may overlap by, as parts of half thicknesses, and what steps show.

    Attributes: elastic: by weight, tools and falls, 0 of rigid contacts; steps: by the way of bodies and the solver in
    a step; cause: of the worst overlap so far, a key of CAUSES, "" if there is none
    """

    def __init__(self, scene: Scene, settings: Settings, stiffness: float) -> None:
        self.elastic = expected_overlap(scene, stiffness, settings.dt)
        half = np.array([least_half(body) for body in scene.large_bodies], float)
        self._large = np.where(half > 0.0, half, np.inf)  # a flat mesh has no thickness
        self._size, self._dt = smallest(scene), settings.dt
        closing = settings.limits.closing_speed
        closes = closing * settings.dt if math.isfinite(closing) else CLOSING * settings.delta
        self.steps = closes / self._size + 0.25 * DRIVEN**2  # the sagitta of two spheres over that way
        self.cause = ""
        self._worst = self._held = self._loose = 0.0
        self._start: float | None = None  #: the overlap with which the run starts, which it does not make
        self._told: set[str] = set()

    def soft(self, program: bool) -> str:
        """What is said before the first step if contacts are too soft for what they bear; empty if they are not."""
        if self.elastic <= SOFT:
            return ""
        words = "contacts are so soft that weight, tools and falls press bodies into each other by up to"
        return f"{words} {self.elastic:.3g} half thicknesses. What helps: {remedy('stiffness', program)} [N/m]"

    def look(self, step: Step, closing_speed: float) -> str:
        """The field of `Settings` that helps, if a step shows more than TWICE of what is promised and it was not told
        yet; the same on all ranks; collective."""
        found, held = overlaps(step, self._large)
        if self._start is None:
            self._start = found
        least, elastic = 0.5 * found, max(held, self._held)
        cause = "stiffness" if elastic >= least else "tol" if self._loose >= least else "dt"
        self._held, self._loose = held, closing_speed * self._dt / self._size
        if found > self._worst:
            self._worst, self.cause = found, cause
        if found <= max(TWICE * (self.elastic + self.steps), self._start) or cause in self._told:
            return ""
        self._told.add(cause)
        return cause

    def words(self, cause: str, step: int, program: bool) -> str:
        """What is said of that; the program has other names of options than Python."""
        promised = self.elastic + self.steps
        return (
            f"step {step}: bodies overlap by {self._worst:.2g} half thicknesses, where up to {promised:.2g} were "
            f"expected: {CAUSES[cause]}. What helps: {remedy(cause, program)}"
        )
