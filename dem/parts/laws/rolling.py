"""Resistance of contacts to rolling and spinning: the greatest moments, over the normal force, are lengths [m], or
shares of the effective radius 1 / (1/r + 1/r') (Ai, Chen, Rotter, Ooi, Powder Technology 206, 2011)."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from dem import checks
from dem.arrays import Floats
from dem.parts.laws import ContactState, Law, coefficient


@dataclass(frozen=True)
class Rolling(Law):
    """The law of moments, see `dem.step.resistance`."""

    rolling: Any = coefficient(checks.not_negative, 0.0)  #: greatest moment against it, over the normal force [m]
    spinning: Any = coefficient(checks.not_negative, 0.0)  #: the same about the normal [m]
    rolling_coefficient: Any = coefficient(checks.not_negative, 0.0)  #: in place of `rolling`: over 1 / (1/r + 1/r')
    spinning_coefficient: Any = coefficient(checks.not_negative, 0.0)  #: the same of `spinning`

    RESISTS = True

    def refuse(self) -> None:
        for name in "rolling", "spinning":
            length, share = getattr(self, name), getattr(self, f"{name}_coefficient")
            if np.any((np.asarray(length) > 0.0) & (np.asarray(share) > 0.0)):
                raise ValueError(f"{name}, a length, and {name}_coefficient, of the radius, are above zero: give one")

    def doubt(self, radius: float) -> str:
        most = max(self.rolling, self.spinning)
        words = f"rolling or spinning of {most:g} m, a length, is more than the greatest radius, {radius:g} m"
        return f"{words}: do you mean a rolling_coefficient, which is times the radius?" if most > radius else ""

    def acts(self) -> bool:
        return any(np.any(getattr(self, f.name)) for f in fields(Rolling) if f.name not in _OF_ALL)

    def moments(self, met: ContactState) -> tuple[Floats, Floats] | None:
        radius = np.where(np.isfinite(met.radius), 0.5 * met.radius, 0.0)  # flat bodies neither roll nor spin so
        rolling = self.rolling[met.pair] + self.rolling_coefficient[met.pair] * radius
        return rolling, self.spinning[met.pair] + self.spinning_coefficient[met.pair] * radius


_OF_ALL = {each.name for each in fields(Law)}
