"""A release: what is installed, what the recipes say, and that version, address and licence are the same everywhere."""

from __future__ import annotations

import ast
import importlib
import json
import re
from pathlib import Path

import pytest

import pctt

tomllib = pytest.importorskip("tomllib")  # of Python 3.11

ROOT = Path(__file__).parents[1]
FILE = tomllib.loads((ROOT / "pyproject.toml").read_text())
PROJECT = FILE["project"]
PACKAGING = ROOT / "run" / "packaging"
ADDRESS = PROJECT["urls"]["Source"]
VALUES = {"version": pctt.__version__, "sha256": 64 * "0", "address": ADDRESS, "maintainer": "somebody"}


@pytest.fixture(scope="module")
def recipes():
    spec = importlib.util.spec_from_file_location("recipes", PACKAGING / "recipes.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def requirements(specs):
    """{name: least version} of `name>=version`, also with a space, and of Spack's `py-name@version:`."""
    pattern = r"(?:py-)?([\w-]+?)\s*(?:>=|@)\s*([\d.]+)"
    return {found[1]: found[2] for found in (re.match(pattern, spec) for spec in specs) if found}


def test_commands_are_functions():
    for place in PROJECT["scripts"].values():
        module, _, name = place.partition(":")
        assert callable(getattr(importlib.import_module(module), name))


def test_version_and_licence_are_the_same_everywhere(recipes):
    citation = (ROOT / "CITATION.cff").read_text()
    assert f"\nversion: {pctt.__version__}\n" in citation
    dated = re.search(rf"^## {re.escape(pctt.__version__)} - (\S+)$", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)
    assert f'\ndate-released: "{dated[1]}"\n' in citation
    assert f"\nlicense: {PROJECT['license']}\n" in citation
    zenodo = json.loads((ROOT / ".zenodo.json").read_text())
    assert zenodo["license"] == PROJECT["license"].lower()  # as Zenodo spells them
    assert f'title: "{zenodo["title"]}"' in citation
    assert recipes.version() == pctt.__version__


def test_an_address_of_the_project_is_that_of_pyproject(recipes):
    assert recipes.project("Source") == ADDRESS
    recipes_of = [path for path in PACKAGING.rglob("*.*") if path.suffix != ".pyc"]
    texts = [*ROOT.glob("*.md"), *ROOT.glob("docs/**/*.md"), *recipes_of, ROOT / "CITATION.cff"]
    found = {url for path in texts for url in re.findall(r"https?://[^\s\"'<>)]*/pctt\b", path.read_text())}
    assert {url for url in found if "pypi.org/" not in url} <= {ADDRESS}


def test_the_recipe_of_conda_has_the_requirements_and_commands(recipes):
    yaml = pytest.importorskip("yaml")
    recipe = yaml.safe_load(recipes.filled("conda/recipe.yaml", **VALUES))
    asked, builds = requirements(PROJECT["dependencies"]), requirements(FILE["build-system"]["requires"])
    assert asked.items() <= requirements(recipe["requirements"]["run"]).items()
    assert builds.items() <= requirements(recipe["requirements"]["host"]).items()
    assert recipe["build"]["python"]["entry_points"] == [f"{a} = {b}" for a, b in PROJECT["scripts"].items()]
    assert recipe["context"]["version"] == pctt.__version__
    environment = yaml.safe_load((PACKAGING / "conda" / "environment.yml").read_text())
    assert asked.items() <= requirements(environment["dependencies"]).items()


def test_the_recipe_of_spack_has_the_requirements(recipes):
    tree = ast.parse(recipes.filled("spack/package.py", **VALUES))
    calls = [node for node in ast.walk(tree) if isinstance(node, ast.Call)]
    named = requirements(call.args[0].value for call in calls if getattr(call.func, "id", "") == "depends_on")
    assert requirements(PROJECT["dependencies"] + FILE["build-system"]["requires"]).items() <= named.items()
    assert named["python"] == PROJECT["requires-python"].strip(">=")


def test_workflows_parse_and_run_commands_that_there_are():
    yaml = pytest.importorskip("yaml")
    for path in (ROOT / ".github" / "workflows").glob("*.yml"):
        for job in yaml.safe_load(path.read_text())["jobs"].values():
            for step in job["steps"]:
                for command in re.findall(r"(?:^|\s)(run/\S+)", step.get("run", "")):
                    assert (ROOT / command).exists(), command


def test_the_paper_cites_what_its_list_has():
    paper, bib = ((ROOT / "docs" / "paper" / name).read_text() for name in ("paper.md", "paper.bib"))
    entries = re.findall(r"^@\w+\{(\w+),$", bib, re.MULTILINE)
    assert set(re.findall(r"@(\w+)", paper)) == set(entries)
    assert len(entries) == len(set(entries))


@pytest.mark.slow
def test_an_sdist_builds_the_same_wheel_as_the_checkout(recipes, tmp_path, monkeypatch):
    """With all that belongs into both, and nothing else."""
    build = pytest.importorskip("hatchling.build")
    import tarfile

    monkeypatch.chdir(ROOT)
    sdist, wheel = tmp_path / build.build_sdist(str(tmp_path)), tmp_path / build.build_wheel(str(tmp_path))
    assert recipes.wrong_content(sdist, wheel) == []
    with tarfile.open(sdist) as archive:
        archive.extractall(tmp_path)
    monkeypatch.chdir(tmp_path / f"pctt-{pctt.__version__}")
    (tmp_path / "again").mkdir()
    again = tmp_path / "again" / build.build_wheel(str(tmp_path / "again"))
    assert again.read_bytes() == wheel.read_bytes()
