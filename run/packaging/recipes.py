"""Checks what is in dist/, and writes the recipes of this folder there, filled with its version and checksum."""

from __future__ import annotations

import hashlib
import os
import re
import sys
import tarfile
import zipfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
RECIPES = ("conda/recipe.yaml", "spack/package.py", "Containerfile")
LARGEST = 2_000_000  # bytes of an sdist: text and small problems of tests, no pictures and no results


def project(name: str) -> str:
    """The value of a line of pyproject.toml, read without a parser: Python 3.9 has none."""
    found = re.search(rf'^{name} = "([^"]*)"', (ROOT / "pyproject.toml").read_text(), re.MULTILINE)
    assert found, name
    return found[1]


def version() -> str:
    """That of pctt/__init__.py, the only one that is not checked against another."""
    found = re.search(r'^__version__ = "([^"]*)"', (ROOT / "pctt" / "__init__.py").read_text(), re.MULTILINE)
    assert found
    return found[1]


def filled(recipe: str, **values: str) -> str:
    """A recipe with its @names@ replaced."""
    return re.sub(r"@(\w+)@", lambda name: values[name[1]], (ROOT / "run" / "packaging" / recipe).read_text())


def wrong_content(sdist: Path, wheel: Path) -> list[str]:
    """What an sdist and a wheel lack, and what they have too much."""
    with tarfile.open(sdist) as archive:
        source = {member.name.partition("/")[2] for member in archive if member.isfile()}
    installed = set(zipfile.ZipFile(wheel).namelist())
    ours = {str(path.relative_to(ROOT)) for part in ("pctt", "dem") for path in (ROOT / part).rglob("*.py")}
    ours |= {"pctt/py.typed", "dem/py.typed"}
    needed = ours | {"pyproject.toml", "README.md", "LICENSE", "CHANGELOG.md", "CITATION.cff"}
    strange = {name for name in installed if not name.startswith(("pctt/", "dem/", wheel.name.split("-py3")[0]))}
    lost = {name for name in source if name.startswith("results/") or name.endswith((".png", ".gif", ".pyc", ".nbc"))}
    wrong = [f"the sdist lacks {name}" for name in sorted(needed - source)]
    wrong += [f"the wheel lacks {name}" for name in sorted(ours - installed)]
    wrong += [f"the wheel should not have {name}" for name in sorted(strange)]
    wrong += [f"the sdist should not have {name}" for name in sorted(lost)]
    if sdist.stat().st_size > LARGEST:
        wrong.append(f"the sdist has {sdist.stat().st_size} bytes, more than {LARGEST}")
    return wrong


def main() -> int:
    dist = ROOT / "dist"
    sdist, wheel = dist / f"pctt-{version()}.tar.gz", dist / f"pctt-{version()}-py3-none-any.whl"
    wrong = wrong_content(sdist, wheel)
    values = {
        "version": version(),
        "sha256": hashlib.sha256(sdist.read_bytes()).hexdigest(),
        "address": project("Source"),
        "maintainer": os.environ.get("MAINTAINER", "MAINTAINER"),
    }
    for recipe in RECIPES:
        (dist / recipe).parent.mkdir(exist_ok=True)
        (dist / recipe).write_text(filled(recipe, **values))
    for line in wrong:
        print("run/release:", line, file=sys.stderr)
    if "example.org" in values["address"]:
        print("run/release: before the recipes go out, set the address, Source in pyproject.toml", file=sys.stderr)
    print(f"dist/ has pctt {values['version']}, sdist {values['sha256']}")
    return bool(wrong)


if __name__ == "__main__":
    sys.exit(main())
