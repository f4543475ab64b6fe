"""Where grains come into a scene and leave it: its sources and outlets, and what has passed them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np

from dem import checks
from dem.arrays import Bools, Floats
from dem.bodies import Bodies, concatenate, none
from dem.geometry.region import Block, Cylinder, refuse_region
from dem.parts.sources import Source, Tally, bounds

#: In scenes with sources grains have ids below this number, and large bodies from it on.
MOST_IDS = 10**12


@dataclass(frozen=True)
class Outlet:
    """Grains whose centres are in the region leave; with `outside` those whose centres are not in it."""

    region: Block | Cylinder
    outside: bool = False

    def __post_init__(self) -> None:
        refuse_region("an outlet", self.region)

    def takes(self, position: Floats) -> Bools:
        """Mask (n,) of the centres (n, 3) [m] that leave."""
        inside: Bools = self.region.contains(position)
        return ~inside if self.outside else inside


@dataclass(frozen=True)
class Passages:
    """The sources and outlets of a scene by name, and what has passed each of them up to now.

    What comes and goes in a step is found by `dem.record.passage.insert_and_remove`; the rest asks these methods alone.
    """

    sources: dict[str, Source] = field(default_factory=dict)
    outlets: dict[str, Outlet] = field(default_factory=dict)
    tallies: dict[str, Tally] = field(default_factory=dict)  #: of sources, then of outlets

    @property
    def names(self) -> list[str]:
        return [*self.sources, *self.outlets]

    def __len__(self) -> int:
        return len(self.names)

    def add(self, name: str, part: Source | Outlet) -> None:
        """Put a part under a name of its own; ValueError for another one."""
        checks.new_name("sources and outlets", name, self.names)
        if set(name) & set(',"\n'):
            raise ValueError(f"sources and outlets need names without commas, got {name!r}")
        if isinstance(part, Source):
            self.sources[name] = part
        else:
            self.outlets[name] = part

    def counted(self, sources: dict[str, Source] | None = None) -> Passages:
        """The same with other tallies, which are as these, and with a world's own `sources`."""
        if sources is None and not self.tallies:
            return self
        tallies = {name: replace(self.tallies.get(name, Tally())) for name in self.names}
        return Passages(self.sources if sources is None else sources, dict(self.outlets), tallies)

    @property
    def inserted_count(self) -> int:
        """Number of grains that have come."""
        return sum(self.tallies[name].count for name in self.sources)

    @property
    def removed_count(self) -> int:
        """Number of grains that have left."""
        return sum(self.tallies[name].count for name in self.outlets)

    @property
    def removes(self) -> bool:
        """Whether grains may leave."""
        return bool(self.outlets)

    @property
    def most(self) -> float:
        """How many grains may come."""
        return np.inf if self.sources else 0.0

    def first_large(self, count: int) -> int:
        """The id of the first large body of a scene with so many grains: more than that of any that may come."""
        return MOST_IDS if self.sources else count

    def extremes(self) -> Bodies:
        """The grains that may come: of each source the smallest and the largest one."""
        return concatenate([none(), *(source.extremes() for source in self.sources.values())])

    def boxes(self) -> Floats:
        """Lower and upper corners (sources, 2, 3) of the boxes about the regions in which grains come [m]."""
        return np.array([bounds(source.region) for source in self.sources.values()]).reshape(-1, 2, 3)

    @property
    def density(self) -> float:
        """The greatest of grains that may come; 0 without [kg/m^3]."""
        return max((source.density for source in self.sources.values()), default=0.0)

    def passed(self, what: str, name: str) -> Tally:
        """What has passed the "source" or "outlet" of this name; ValueError if there is none."""
        there: Mapping[str, Any] = self.sources if what == "source" else self.outlets
        if name not in there:
            raise ValueError(f"no {what} {name!r}; there are: {', '.join(there) or 'none'}")
        return replace(self.tallies[name])

    def record(self) -> dict[str, float]:
        """What has passed each up to now, how many steps a source had no room, and the energies that came and went with
        grains before this step [J]; nothing without."""
        out: dict[str, float] = {}
        for name, tally in self.tallies.items():
            out |= {f"count_{name}": tally.count, f"mass_{name} [kg]": tally.mass}
            if name in self.sources:
                out[f"refused_{name}"] = tally.refused
        for kind, names in (("sources", self.sources), ("outlets", self.outlets)) if out else ():
            out[f"energy_of_{kind} [J]"] = sum(self.tallies[name].energy for name in names)
        return out

    def state(self) -> dict[str, np.ndarray]:
        """The arrays of a checkpoint, for `restored`."""
        rows = [[float(getattr(tally, each.name)) for each in fields(Tally)] for tally in self.tallies.values()]
        return {"tallies": np.array(rows)} if rows else {}

    def restored(self, kept: Mapping[str, np.ndarray]) -> Passages:
        """These of a scene, with the tallies of a checkpoint. ValueError if it has none of them."""
        rows, names = np.array(kept.get("tallies", np.zeros((0, 4)))), self.names
        if rows.shape != (len(names), 4) or not (np.isfinite(rows).all() and (rows[:, [0, 1, 3]] >= 0.0).all()):
            raise ValueError(f"the state has no counts of the sources and outlets {', '.join(names) or 'none'}")
        tallies = (Tally(int(count), mass, energy, int(refused)) for count, mass, energy, refused in rows.tolist())
        return replace(self, tallies=dict(zip(names, tallies)))
