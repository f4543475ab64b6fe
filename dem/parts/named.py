"""Parts that a scene names: what the program asks alike of all kinds of them.

A kind is a class in a file of its own, and a line of `dem.scene.KINDS`; `Scene.named` and `World.named` have its parts
by their names. A part is described, checked, changed and kept (`Named`). It may give impulses before contacts do
(`Force`), join two bodies (`dem.parts.ends.Tie`), and hold these (`dem.parts.ends.Constraint`).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any, ClassVar, NamedTuple, TypeVar

from dem.arrays import Floats

P = TypeVar("P", bound="Named")


class Pressing(NamedTuple):
    """What presses bodies together beside the weight of the grains at time zero."""

    force: float = 0.0  #: the greatest on one body [N]
    spread: tuple[Floats, ...] = ()  #: forces (3,) on all grains together [N]
    accelerations: tuple[Floats, ...] = ()  #: (3,) of grains, with gravity [m/s^2]
    pushes: tuple[tuple[str, Floats, float], ...] = ()  #: on large bodies by name: forces (3,) [N], torques [N m]
    impacts: tuple[tuple[float, float], ...] = ()  #: masses [kg] that come with speeds [m/s]
    steps: tuple[tuple[str, float], ...] = ()  #: what needs a time step, and which [s]


class Named:
    """A part of a scene with a name, a frozen dataclass that refuses bad values when it is made."""

    CHANGED: ClassVar[tuple[str, ...]]  #: the fields that a run may change
    KEPT: ClassVar[tuple[str, ...]]  #: the fields that follow from changes, which checkpoints keep
    BEGINS: ClassVar[str] = ""  #: the field with which a run may begin a part that the scene does not have

    def changed(self: P, time: float, tally: Any, **values: Any) -> P:
        """The part with other values of `CHANGED` from the time [s] on; `tally`: what has come of a source so far."""
        return dataclasses.replace(self, **values)  # type: ignore[type-var]

    def refuse(self, name: str, world: Any) -> None:
        """ValueError where a `dem.model.world.World` cannot have this part; not collective."""

    @classmethod
    def pressing(cls, members: Mapping[str, Any], scene: Any, body: Callable[[Any], tuple[float, ...]]) -> Pressing:
        """Of all parts of the kind in a `dem.scene.Scene`; `body` gives mass [kg], least moment [kg m^2] and radius [m]
        of the body at an end."""
        return Pressing()


class Force(Named):
    """A part that gives bodies impulses which do not depend on the contacts of the step."""

    MEMORY: ClassVar[int] = 0  #: numbers of each part for the next step and reports; first the impulse (3,)

    @classmethod
    def act(cls, members: Mapping[str, Any], world: Any, applied: Any) -> Floats | None:
        """Add the impulses of all parts of the kind in the next step to a `dem.unconstrained.applied.Applied`, which
        has those of the kinds before; their memory (members, MEMORY). Collective. SceneError if a part fails."""
        raise NotImplementedError
