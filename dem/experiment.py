"""The interface between a scene and the program: options, recommended numerics, bodies, quantities to record.

A scene of one's own is a class derived from `Experiment`; docs/tutorial.md writes one. The scenes of the package
(`-scene NAME`) are written in the same way and need nothing else.
"""

from __future__ import annotations

import dataclasses
import hashlib
import numbers
import sys
import traceback
import typing
from collections.abc import Mapping
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any, ClassVar

from dem import checks
from dem.arrays import Floats
from dem.options import option
from dem.scene import Scene
from dem.together import SCENE_FILE, in_words

if TYPE_CHECKING:
    from dem.step import Step

__all__ = ["Experiment", "SceneExperiment", "SceneFileError", "from_file", "option"]

#: What a value of an option may be, by the name of the type that its field has.
KINDS: dict[Any, tuple[str, type]] = {
    "int": ("a whole number", numbers.Integral), "float": ("a number", numbers.Real), "bool": ("True or False", bool),
    "str": ("a text", str),
}  # fmt: skip


@dataclasses.dataclass(frozen=True)
class Experiment:
    """Base of all scenes. A scene is a frozen dataclass; its fields, each with a default, are its options.

    A scene defines `build`, and may define the rest. The attributes may be properties that depend on the options.
    """

    #: Recommended time step [s]; None: `dem.start.time_step.recommended`.
    dt: ClassVar[Any] = None
    #: Recommended contact distance: pairs with smaller gaps are contacts [m]; None: a twentieth of the smallest radius.
    delta: ClassVar[Any] = None
    #: Contact distance while settling, as falling bodies come closer within a step [m]; None: the smallest radius.
    settle_delta: ClassVar[Any] = None
    #: Time after which the start may be taken as settled [s]. A motion that is to begin then has it as its `start`.
    settling_time: ClassVar[Any] = 0.0
    #: Lower and upper corner of the box that no centre of a grain should leave [m]; None: there is none.
    domain: ClassVar[Any] = None
    #: Digest of the file that the scene was read from; empty for a scene of the package.
    digest: ClassVar[str] = ""

    def __post_init__(self) -> None:
        """ValueError for values of another type than that of their option, and for numbers that fail its check, or are
        not finite where it has none. The message starts with the name of the option. Extend this to check more."""
        for field in dataclasses.fields(self):
            value, check = getattr(self, field.name), field.metadata.get("check")
            allowed, kind = KINDS.get(getattr(field.type, "__name__", field.type), ("", object))
            if value is not field.default and not isinstance(value, kind):
                raise ValueError(f"{field.name} {value!r}: allowed is {allowed}")
            if isinstance(check, tuple) and not check[1](value):
                raise ValueError(f"{field.name} {value}: allowed is {check[0]}")
            if callable(check):
                check(field.name, value)
            elif check is None and isinstance(value, float):
                checks.finite(field.name, value)

    def refuse(self, name: str, why: str) -> None:
        """ValueError with the name of an option, its value and its unit before the reason."""
        unit = {field.name: field.metadata.get("unit", "") for field in dataclasses.fields(self)}[name]
        raise ValueError(" ".join([name, f"{getattr(self, name):g}", *([unit] if unit else []), why]))

    def refuse_idle(self, why: str, *names: str) -> None:
        """As `refuse`, of the first of these options that does not have its default: it would have no effect."""
        for field in dataclasses.fields(self):
            if field.name in names and getattr(self, field.name) != field.default:
                self.refuse(field.name, f"has no effect on {why}")

    def build(self) -> Scene:
        """The bodies, materials and motions at time zero."""
        raise NotImplementedError(f"scene {type(self).__name__} has no method build")

    def record(self, step: Step) -> Mapping[str, float]:
        """Quantities of the scene's own to record after every step, by name with the unit in brackets: "depth [m]".

        It is called on all ranks, and must return the same on all. All results of `Step` are the same on all ranks.
        """
        return {}

    def analyse(self, records: Mapping[str, Floats]) -> Mapping[str, float | Floats]:
        """Results of a run, from its records (by name, one entry per step).

        Numbers are printed and go to summary.json; arrays, with an entry per record, become columns of analysis.csv.
        """
        return {}


class SceneExperiment(Experiment):
    """A scene that is built already."""

    def __init__(self, scene: Scene):
        self.scene = scene

    def build(self) -> Scene:
        return self.scene


class SceneFileError(ValueError):
    """A file that holds no scene, or more than one."""


def from_file(path: Path) -> type[Experiment]:
    """Return the one class derived from `Experiment` that a Python file defines. SceneFileError if there is not just
    one, if the file cannot be run, or if an option has no default or an unknown type."""
    try:
        text = path.read_text()
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "no text"
        raise SceneFileError(f"cannot be read ({reason})") from None
    name = f"{SCENE_FILE}{path.stem}"
    module = ModuleType(name)
    module.__file__ = str(path.absolute())
    sys.modules[name] = module  # dataclasses and type hints look their module up
    try:
        exec(compile(text, str(path), "exec"), module.__dict__)
    except (Exception, SystemExit) as error:
        own = [frame.lineno for frame in traceback.extract_tb(error.__traceback__) if frame.filename == str(path)]
        if isinstance(error, SyntaxError) and error.filename == str(path):
            raise SceneFileError(f"line {error.lineno}: {error.msg}") from None
        raise SceneFileError(f"line {own[-1] if own else '?'}: {in_words(error)}") from None
    classes = dict.fromkeys(item for item in vars(module).values() if isinstance(item, type))  # one may have two names
    found = [item for item in classes if issubclass(item, Experiment) and item.__module__ == name]
    if len(found) != 1:
        what = ", ".join(item.__name__ for item in found) or "no class derived from dem.experiment.Experiment"
        raise SceneFileError(f"must define one scene, has {what}")
    _check_options(found[0])
    found[0].digest = hashlib.sha256(text.encode()).hexdigest()
    return found[0]


def _check_options(scene: type[Experiment]) -> None:
    if "__dataclass_fields__" not in vars(scene):
        raise SceneFileError(f"{scene.__name__} must be marked @dataclass(frozen=True)")
    if scene.build is Experiment.build:
        raise SceneFileError(f"{scene.__name__} has no method build")
    try:
        kinds = typing.get_type_hints(scene)
    except Exception as error:
        raise SceneFileError(f"types of {scene.__name__}: {error}") from None
    for field in dataclasses.fields(scene):
        if field.default is dataclasses.MISSING:
            raise SceneFileError(f"option {field.name} of {scene.__name__} has no default")
        if kinds[field.name] not in (int, float, bool, str):
            raise SceneFileError(f"option {field.name} of {scene.__name__}: the type must be int, float, bool or str")
