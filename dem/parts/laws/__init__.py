"""What a law of contact tells: its coefficients, and what they add to the system of a step.

Each law is a file of this package; `dem.parts.contact_law.ContactLaw` lists them. What a step does with them is the
same for all: it takes their attraction, friction and moments, and keeps a number of each contact for the next step
where a law asks for one.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import MISSING, dataclass, field
from typing import Any, ClassVar, NamedTuple

import numpy as np

from dem import checks
from dem.arrays import Floats, Ints


def coefficient(check: Callable[[str, Any], Any], default: Any = MISSING) -> Any:
    """A field that a scene may set; `check` gets its name and the number."""
    return field(default=default, metadata={"check": check})


class ContactState(NamedTuple):
    """The contacts of a step, as laws see them at its start."""

    dt: float  #: [s]
    pair: tuple[Ints, Ints]  #: (nc,) materials of the two bodies: the rows and columns of tables
    gap: Floats  #: (nc,) [m]
    #: (nc,) 2 / (1 / r + 1 / r'), with the greatest spheres that fit into grains; large bodies are flat [m]
    radius: Floats
    mobility: Floats  #: (nc,) sum of the inverse masses [1/kg]
    slip: Floats  #: (nc,) relative speeds along the surfaces [m/s]


class Solved(NamedTuple):
    """What the solution of a step says of its contacts."""

    impulse: Floats  #: (nc, 3) in the friction cones [N s]
    friction: Floats  #: (nc,) coefficients of these cones
    slip: Floats  #: (nc,) speeds along the surfaces that springs do not take up [m/s]


@dataclass(frozen=True)
class Law:
    """What every law begins with: the coefficients of all contacts, and methods that add nothing.

    The methods are those of tables (materials, materials). `kept` (nc,) is what the law kept of these contacts in the
    last step, and zero of those that were not there."""

    friction: Any = coefficient(checks.not_negative)  #: of Coulomb's law
    stiffness: Any = coefficient(checks.positive_or_inf, None)  #: inf: rigid; None: what the scene needs [N/m]
    restitution: Any = coefficient(checks.between(0.0, 1.0), 0.0)  #: of impacts
    touching: Any = coefficient(checks.zero_or_one, 1.0)  #: 0: the two never touch, and go through each other

    KEEPS: ClassVar[bool] = False  #: whether the law keeps a number of each contact
    RESISTS: ClassVar[bool] = False  #: whether it resists the turning of bodies against each other

    def refuse(self) -> None:
        """ValueError for coefficients that do not go together."""

    def doubt(self, radius: float) -> str:
        """What is likely a mistake among bodies of at most this radius [m], in words; empty if there is nothing."""
        return ""

    def acts(self) -> bool:
        """Whether the law adds anything to contacts of any pair."""
        return False

    def reach(self) -> float:
        """The greatest gap at which contacts matter [m]."""
        return 0.0

    def strongest(self, radius: Floats) -> Any:
        """The greatest attraction of bodies (n,) of such radii [N]."""
        return 0.0

    def attraction(self, met: ContactState, kept: Floats) -> Floats | None:
        """The attraction (nc,) of contacts [N]; None: nothing."""
        return None

    def cone(self, met: ContactState, kept: Floats, friction: Floats) -> Floats:
        """The coefficients of friction (nc,), which were these before."""
        return friction

    def moments(self, met: ContactState) -> tuple[Floats, Floats] | None:
        """The greatest moments (nc,) about the tangents and about the normal, over the normal force [m], if it RESISTS
        them."""
        return None

    def keep(self, met: ContactState, kept: Floats, solved: Solved) -> Floats:
        """What to keep (nc,) for the next step."""
        return np.zeros_like(kept)
