"""The scenes that come with the package, by name. Each is an `Experiment`, see `dem.experiment`."""

from __future__ import annotations

from dem.experiment import Experiment
from dem.scenes.blade import Blade
from dem.scenes.drum import Drum
from dem.scenes.mixer import Mixer
from dem.scenes.shear import Shear
from dem.scenes.silo import Silo

SCENES: dict[str, type[Experiment]] = {"mixer": Mixer, "blade": Blade, "shear": Shear, "drum": Drum, "silo": Silo}

__all__ = ["SCENES", "Blade", "Drum", "Mixer", "Shear", "Silo"]
