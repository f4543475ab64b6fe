"""Distributions of the sizes of grains, by number."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Union

import numpy as np

from dem import checks
from dem.arrays import Floats


@dataclass(frozen=True)
class Uniform:
    """Sizes that are uniform between two, by number."""

    low: float
    high: float

    def __post_init__(self) -> None:
        checks.check_fields(self, low=checks.positive, high=checks.positive)
        if self.high < self.low:
            raise ValueError(f"sizes from {self.low:g} to {self.high:g}: the second must not be less")

    @property
    def ends(self) -> tuple[float, float]:
        """The least and the greatest size [m]."""
        return self.low, self.high

    def at(self, share: Floats) -> Floats:
        """The sizes (n,) below which these shares (n,) of the grains are."""
        return self.low + share * (self.high - self.low)


@dataclass(frozen=True)
class Listed:
    """Some sizes, each of which a share of the grains has, by number; without shares all alike."""

    values: Sequence[float]
    shares: Sequence[float] = ()

    def __post_init__(self) -> None:
        checks.positive("size of a grain", self.values)
        if not len(self.values) or (len(self.shares) and len(self.shares) != len(self.values)):
            raise ValueError(f"{len(self.values)} sizes of grains with {len(self.shares)} shares")
        checks.not_negative("share of grains", self.shares)
        if len(self.shares) and not sum(self.shares) > 0.0:
            raise ValueError("shares of grains are all zero")

    @classmethod
    def by_mass(cls, values: Sequence[float], shares: Sequence[float]) -> Listed:
        """The sizes of grains of one density and shape that have these shares of the mass, as sieves tell them."""
        by_number = np.array(cls(values, shares).shares) / np.array(values, float) ** 3
        return cls(values, tuple((by_number / by_number.sum()).tolist()))

    @property
    def ends(self) -> tuple[float, float]:
        """The least and the greatest size [m]."""
        return min(self.values), max(self.values)

    def at(self, share: Floats) -> Floats:
        """As of `Uniform`."""
        parts = np.cumsum(self.shares if len(self.shares) else np.ones(len(self.values)))
        return np.array(self.values)[np.searchsorted(parts / parts[-1], share, side="right")]


Sizes = Union[Uniform, Listed]


def sizes(given: float | Sequence[float] | Sizes) -> Sizes:
    """A distribution, or that of one or several sizes alike. ValueError for a bad one."""
    if isinstance(given, (Uniform, Listed)):
        return given
    return Listed(tuple(np.ravel(checks.positive("size of a grain", given)).tolist()))
