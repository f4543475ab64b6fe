"""The scenes that come with the package, by name.

A scene class is a frozen dataclass: its fields, with "help" and "unit" in their metadata, are its options,
`build` makes the scene, and `settling_time`, `dt` and `delta` are what it recommends for its simulation.
"""

from dem.scenes.mixer import Mixer

SCENES = {"mixer": Mixer}

__all__ = ["SCENES", "Mixer"]
