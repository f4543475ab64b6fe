"""The scenes that come with the package, by name. Each is an `Experiment`, see `dem.experiment`."""

from __future__ import annotations

from dem.experiment import Experiment
from dem.scenes.belt import Belt
from dem.scenes.blade import Blade
from dem.scenes.drum import Drum
from dem.scenes.incline import Incline
from dem.scenes.mixer import Mixer
from dem.scenes.plane_shear import PlaneShear
from dem.scenes.shear import Shear
from dem.scenes.silo import Silo
from dem.scenes.triaxial import Triaxial
from dem.scenes.wheel import Wheel

SCENES: dict[str, type[Experiment]] = {
    "mixer": Mixer,
    "blade": Blade,
    "shear": Shear,
    "drum": Drum,
    "silo": Silo,
    "belt": Belt,
    "wheel": Wheel,
    "incline": Incline,
    "plane_shear": PlaneShear,
    "triaxial": Triaxial,
}

__all__ = ["SCENES", "Belt", "Blade", "Drum", "Incline", "Mixer", "PlaneShear", "Shear", "Silo", "Triaxial", "Wheel"]
