"""What an installation puts where: packages, commands and version."""

from __future__ import annotations

import importlib
from pathlib import Path

import pytest

import pctt

tomllib = pytest.importorskip("tomllib")  # of Python 3.11
setuptools = pytest.importorskip("setuptools")

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())


def test_the_packages_are_dem_and_pctt_alone():
    include = PROJECT["tool"]["setuptools"]["packages"]["find"]["include"]
    found = setuptools.find_packages(str(ROOT), include=include)
    assert {name.partition(".")[0] for name in found} == {"dem", "pctt"}
    files = {path.parent for part in ("dem", "pctt") for path in (ROOT / part).rglob("*.py")}
    assert {".".join(folder.relative_to(ROOT).parts) for folder in files} == set(found)


def test_commands_are_functions():
    for place in PROJECT["project"]["scripts"].values():
        module, _, name = place.partition(":")
        assert callable(getattr(importlib.import_module(module), name))


def test_the_version_is_the_same_everywhere():
    assert f"version: {pctt.__version__}\n" in (ROOT / "CITATION.cff").read_text()
    assert f"\n## {pctt.__version__} - " in (ROOT / "CHANGELOG.md").read_text()
