"""The scenes that come with the package, by name. Each is an `Experiment`, see `dem.experiment`."""

from __future__ import annotations

from dem.experiment import Experiment
from dem.scenes.blade import Blade
from dem.scenes.mixer import Mixer
from dem.scenes.shear import Shear

SCENES: dict[str, type[Experiment]] = {"mixer": Mixer, "blade": Blade, "shear": Shear}

__all__ = ["SCENES", "Blade", "Mixer", "Shear"]
