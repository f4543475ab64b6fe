"""The scenes that come with the package, by name. Each is an `Experiment`, see `dem.experiment`."""

from __future__ import annotations

from dem.experiment import Experiment
from pctt.scenes.belt import Belt
from pctt.scenes.blade import Blade
from pctt.scenes.drum import Drum
from pctt.scenes.incline import Incline
from pctt.scenes.mixer import Mixer
from pctt.scenes.plane_shear import PlaneShear
from pctt.scenes.shear import Shear
from pctt.scenes.silo import Silo
from pctt.scenes.triaxial import Triaxial
from pctt.scenes.wheel import Wheel

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
