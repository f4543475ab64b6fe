"""Resistance of contacts to rolling and spinning: the greatest moments, over the normal force, are lengths [m]."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from dem import checks
from dem.arrays import Floats
from dem.parts.laws import Law, coefficient


@dataclass(frozen=True)
class Rolling(Law):
    """The law of moments, see `dem.step.resistance`."""

    rolling: Any = coefficient(checks.not_negative, 0.0)  #: greatest moment against it, over the normal force [m]
    spinning: Any = coefficient(checks.not_negative, 0.0)  #: the same about the normal [m]

    def doubt(self, radius: float) -> str:
        most = max(self.rolling, self.spinning)
        words = f"rolling or spinning of {most:g} m, a length, is more than the greatest radius, {radius:g} m"
        return f"{words}: a coefficient times the radius?" if most > radius else ""

    def acts(self) -> bool:
        return bool(np.any(self.rolling) or np.any(self.spinning))

    def moments(self) -> tuple[Floats, Floats] | None:
        return (self.rolling, self.spinning) if self.acts() else None
