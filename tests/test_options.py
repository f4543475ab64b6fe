"""Options: conversion, errors that name option, value and what is allowed, unknown names, descriptions."""

from __future__ import annotations

import dataclasses
from typing import Optional

import pytest

from dem.checks import nearest, positive
from dem.experiment import Experiment
from pctt.ksp_options import refuse_unknown
from pctt.options import (
    AT_LEAST_ONE,
    COUNT,
    FRACTION,
    NOT_NEGATIVE,
    POSITIVE,
    OptionError,
    describe,
    option,
    read,
)


@dataclasses.dataclass(frozen=True)
class Group:
    """One option of each kind."""

    count: int = option(3, "bodies along a side", check=COUNT)
    every: int = option(1, "steps between two records", check=AT_LEAST_ONE)
    number: int = option(-1, "any whole number")
    dt: float = option(0.025, "time step", unit="s", check=POSITIVE)
    gap: float = option(0.0, "gap", unit="m", check=NOT_NEGATIVE)
    part: float = option(0.5, "part", check=FRACTION)
    angle: float = option(1.0, "any finite number", unit="rad")
    maybe: Optional[float] = option(None, "none: the scene's own", unit="s", check=POSITIVE)
    steps: Optional[int] = option(None, "none: all")
    on: bool = option(False, "whether")
    off: bool = option(True, "whether not")
    shape: str = option("sphere", "form of a body", choices=("sphere", "box", "tetrahedron"))
    path: str = option("", "file to read")


def value(name: str, text: str | None):
    return getattr(read(Group, {"x_" + name: text}, "x_"), name)


def error(name: str, text: str | None) -> str:
    with pytest.raises(OptionError) as raised:
        read(Group, {"x_" + name: text}, "x_")
    return str(raised.value)


def test_without_options_all_defaults_hold():
    assert read(Group, {}) == Group()
    assert read(Group, {"count": "7"}, "x_") == Group()  # the name of another group


@pytest.mark.parametrize(
    ("name", "text", "expected"),
    [
        ("count", "12", 12),
        ("number", "-7", -7),
        ("dt", "1e-3", 0.001),
        ("gap", "0", 0.0),
        ("maybe", "0.5", 0.5),
        ("steps", "4", 4),
        ("shape", "box", "box"),
        ("path", "a/b c.h5", "a/b c.h5"),
        ("path", None, ""),
        *[("on", text, True) for text in ("true", "True", "1", "yes", "on", "", None)],
        *[("off", text, False) for text in ("false", "FALSE", "0", "no", "off")],
    ],
)
def test_values_are_converted(name, text, expected):
    found = value(name, text)
    assert found == expected
    assert type(found) is type(expected)


@pytest.mark.parametrize(
    ("name", "text", "allowed"),
    [
        ("count", "-1", "a whole number >= 0"),
        ("count", "1.5", "a whole number >= 0"),
        ("count", "1e3", "a whole number >= 0"),
        ("every", "0", "a whole number >= 1"),
        ("number", "", "a whole number"),
        ("dt", "0", "a positive number"),
        ("dt", "nan", "a positive number"),
        ("dt", "inf", "a positive number"),
        ("gap", "-1e-9", "a number >= 0"),
        ("gap", "nan", "a number >= 0"),
        ("part", "1", "a number between 0 and 1, both excluded"),
        ("part", "nan", "a number between 0 and 1, both excluded"),
        ("angle", "-inf", "a finite number"),
        ("angle", "steep", "a number"),
        ("maybe", "-2", "a positive number"),
        ("steps", "2.5", "a whole number"),
        ("on", "maybe", "true or false"),
        ("shape", "Box", "one of sphere, box, tetrahedron"),
    ],
)
def test_errors_name_option_value_and_what_is_allowed(name, text, allowed):
    assert error(name, text).startswith(f"{f'-x_{name} {text}'.rstrip()}: allowed is {allowed}")


def test_a_misspelt_choice_gets_the_nearest():
    assert error("shape", "tetrahedon").endswith("; did you mean tetrahedron?")
    assert "did you mean" not in error("shape", "cylinder")


# -- unknown names ------------------------------------------------------------------------------------------

KNOWN = ["scene", "scene_n", "steps", "dt", "restart", "output", "compare", "compare_every", "ccp_tol"]


@pytest.mark.parametrize(
    ("name", "nearest"), [("sceen", "scene"), ("step", "steps"), ("ccp_toll", "ccp_tol")]
)
def test_a_misspelt_name_gets_the_nearest(name, nearest):
    with pytest.raises(OptionError, match=f"^-{name}: no such option; did you mean -{nearest}\\?$"):
        refuse_unknown(["scene", name], KNOWN)


def test_a_group_or_a_name_that_is_little_alike_is_not_what_was_meant():
    assert nearest("scene_angular_velocity", KNOWN) == nearest("scale", ["shape"]) == ""
    assert nearest("tolerance", ["tol"]) == "; did you mean tol?"


def test_a_name_like_none_of_ours_gets_a_pointer_to_the_help():
    with pytest.raises(OptionError, match="^-qqq: no such option; -help lists the options$"):
        refuse_unknown(["qqq"], KNOWN)


@pytest.mark.parametrize("name", [
    "ksp_type", "pc_tt_rank", "mat_mumps_icntl_14", "sub_pc_type", "log_view", "options_file", "help",
    "malloc_debug", "on_error_abort", "start_in_debugger", "citations", "viewer_binary_skip_info",
    "compare_ilu_pc_factor_levels",
])  # fmt: skip
def test_known_names_and_those_of_petsc_pass(name):
    assert refuse_unknown([*KNOWN, name], KNOWN) is None


# -- descriptions -------------------------------------------------------------------------------------------


def test_described_defaults_pass_their_own_checks():
    """Of the groups of the project: what -help shows as a default can be given as a value."""
    from pctt import ccp
    from pctt.run.settings import Run, Settings

    groups = [(Run, ""), (Settings, "ccp_"), *((s.options, f"ccp_{n}_") for n, s in ccp.SOLVERS.items())]
    described = [describe(group, prefix) for group, prefix in groups]
    assert sum(map(len, described)) > 20
    for (group, prefix), lines in zip(groups, described):
        given = {line.name: str(line.default) for line in lines if line.default not in (None, "")}
        assert read(group, given, prefix) == group()


@dataclasses.dataclass(frozen=True)
class Checked(Experiment):
    pair: float = option(1.0, "as options of programs have it", check=POSITIVE)
    function: float = option(1.0, "of dem.checks", check=positive)


def test_a_scene_takes_both_kinds_of_checks():
    assert read(Checked, {"pair": "2"}).pair == 2.0
    with pytest.raises(OptionError, match="-pair -1: allowed is a positive number"):
        read(Checked, {"pair": "-1"})
    with pytest.raises(ValueError, match="pair -1.0: allowed is a positive number"):
        Checked(pair=-1.0)
    with pytest.raises(ValueError, match="function must be positive, got -1"):
        Checked(function=-1.0)
