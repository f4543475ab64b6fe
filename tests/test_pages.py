"""The programs in README and docs run as they are printed; what a page presumes is given to them here. What pages name
exists: links, files, modules and their members, extras."""

from __future__ import annotations

import dataclasses
import re
from inspect import signature
from pathlib import Path
from pkgutil import resolve_name
from typing import Any

import numpy as np
import pytest
import tomllib
from mpi4py import MPI
from petsc4py import PETSc

from dem.parts.contact_law import ContactLaw
from dem.scene import Scene
from pctt import Folder, Simulation, ccp
from pctt.ccp import fclib
from pctt.render import Picture
from pctt.run.settings import Settings

ROOT = Path(__file__).resolve().parents[1]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted(ROOT.glob("docs/*.md"))]


def blocks(page: str) -> list[str]:
    return re.findall(r"```python\n(.*?)```", (ROOT / page).read_text(), re.DOTALL)


def stored_problem(path: Path) -> ccp.ConeProblem:
    """A file with a problem of three contacts."""
    rng = np.random.default_rng(0)
    W = rng.standard_normal((9, 9))
    N = PETSc.Mat().createDense((9, 9), array=W @ W.T + 9 * np.eye(9), comm=MPI.COMM_SELF)
    problem = ccp.ConeProblem(MPI.COMM_SELF, rng.standard_normal((3, 3)) - [1, 0, 0], np.full(3, 0.5), N=N)
    fclib.write_local(path, problem, fclib.Info("three contacts"))
    return problem


@pytest.fixture
def in_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_the_column_of_the_readme_spreads_on_its_floor(in_folder, monkeypatch):
    names: dict[str, Any] = {}
    monkeypatch.setattr(Simulation, "render", lambda sim, color: Picture(np.zeros((2, 2, 3), np.uint8)))
    monkeypatch.setattr(Picture, "save", lambda picture, path: Path(path).write_bytes(b""))  # may lack what draws
    exec(blocks("README.md")[0].replace("until=2.0", "until=1.0"), names)  # it has spread by then
    sim, before = names["sim"], names["centres"]
    assert len(blocks("README.md")[0].split("\n\n")) == 3
    assert sim.time == pytest.approx(1.0, abs=sim.settings.dt)
    assert sim.positions[:, 2].min() > 0.099
    assert sim.positions[:, 2].max() < 0.5 * before[:, 2].max()
    assert np.ptp(sim.positions[:, 0]) > 2 * np.ptp(before[:, 0])
    assert len(Folder("column").steps) >= sim.steps // 4
    assert Path("column.png").exists()


def test_the_measures_of_their_page_are_those_of_a_lattice(in_folder, capsys):
    (text,) = blocks("docs/measuring.md")
    exec(text, {})
    numbers = [re.findall(r"[\d.]+", line) for line in capsys.readouterr().out.splitlines()]
    said = [float(found[0]) for found in numbers if found]  # what warns has none
    weight = np.pi / 6 * 2500 * 9.81 * 0.25  # mean of what is above
    assert said[:4] == pytest.approx([weight, np.pi / 6, (4 * 2 + 1 * 1) / 5, 1.0], rel=0.01)
    assert said[4] == pytest.approx(weight, rel=0.1)  # the kernel takes a part out of the box
    assert (in_folder / "fields.vtkhdf").exists()


def test_the_loads_of_their_page_give_what_it_says(in_folder, capsys):
    exec(blocks("docs/loads.md")[0], {})
    said = [float(word) for word in re.findall(r"-?\d+\.\d+", capsys.readouterr().out)]
    pull = 0.3 * 2.0 * 9.81
    assert said == pytest.approx([0.3 * 9.81 - 1.0, -pull, pull, 0.2], rel=0.01)


@pytest.mark.slow
def test_the_hopper_of_the_page_of_sources_fills_and_runs_out(in_folder, capsys):
    (text,) = blocks("docs/sources.md")
    exec(text, {})
    said = re.findall(r"(\d+) grains, ([\d.]+) kg", capsys.readouterr().out)
    assert said[0] == said[1]
    assert said[0][0] == "60"
    assert float(said[0][1]) == pytest.approx(60 * 2500 * 4 / 3 * 3.14159 * 0.02**3, rel=0.05)


def test_the_joints_of_their_page_give_what_it_says(in_folder, capsys):
    exec(blocks("docs/loads.md")[1], {})
    said = [float(word) for word in re.findall(r"-?\d+\.\d+", capsys.readouterr().out)]
    weight = 9.81 * (4.0 * 0.5 + 4000.0 / 3.0 * np.pi * 0.1**3 * 1.15)
    angle = np.arcsin(0.1 / 1.15)
    arm = 1.15 * np.cos(angle)
    floor = (100.0 + weight * np.cos(angle)) / arm, (weight * np.cos(angle) - 50.0) / arm
    assert said == pytest.approx([-weight, floor[0], angle, floor[1], -0.3, -weight * np.cos(0.3)], rel=2e-3)


def test_the_simulation_of_its_page_runs(in_folder, capsys):
    (text,) = blocks("docs/python.md")
    before = PETSc.Options().getAll()
    names: dict[str, Any] = {}
    exec(text, names)
    assert PETSc.Options().getAll() == before
    said = capsys.readouterr().out.splitlines()
    assert "at rest after 0.255 s" in said[0]
    assert [line.split()[:2] for line in said[1:]] == [["2", "rad/s:"], ["4", "rad/s:"], ["8", "rad/s:"]]
    words = {"dt": 0.005, "delta": 0.005, "solver": "apgd", "tol": 1e-4}
    assert names["pctt"].Simulation.load("stirred.h5", names["scene"], **words).time == names["sim"].time


def test_the_program_of_the_readme_solves_by_a_train(in_folder, capfd):
    """In the iterations that the text says, by a train that is not block Jacobi."""
    names: dict[str, Any] = {}
    exec(blocks("README.md")[1], names)
    ksp, claimed = names["ksp"], re.findall(r"It takes (\d+) iterations", (ROOT / "README.md").read_text())
    assert names["mat"].getSize()[0] == names["n"] ** 3 >= 2**16
    assert [str(ksp.getIterationNumber())] == claimed
    assert names["residual"] < 1e-8
    assert int(ksp.pc.getPythonContext().what().split()[1]) > 1
    ksp.destroy()


def test_a_cone_problem_handed_over(capsys):
    names: dict[str, Any] = {}
    exec(blocks("docs/ccp.md")[0], names)
    result, K = names["result"], names["K"].toarray()
    moved = names["r"].ravel() + np.linalg.solve(K, result.impulse.ravel())
    assert result.velocity.ravel() == pytest.approx(moved, abs=1e-12)
    assert result.velocity[:, 0].min() > -1e-3
    assert "status      converged" in capsys.readouterr().out


def test_poisson_with_a_train(in_folder, capfd):
    before = PETSc.Options().getAll()
    names: dict[str, Any] = {}
    exec(blocks("docs/preconditioners.md")[0], names)
    assert names["ksp"].getConvergedReason() > 0
    names["ksp"].destroy()
    for name in set(PETSc.Options().getAll()) - set(before):
        PETSc.Options().delValue(name)


def test_a_problem_is_solved_and_copied_as_on_the_page_of_files(in_folder, capsys):
    stored_problem(in_folder / "problem.hdf5")
    lines = [line for line in blocks("docs/files.md")[0].splitlines() if "write_global" not in line]
    exec("\n".join(lines), {"comm": MPI.COMM_SELF})
    assert "natural residual and closing work below the tolerance" in capsys.readouterr().out
    copy = fclib.load(in_folder / "copy.hdf5", MPI.COMM_SELF)
    assert (copy.title, copy.problem.size) == ("a title", 3)


# -- what pages name -------------------------------------------------------------------------------------------------


def anchors(page: Path) -> set[str]:
    """Those of the headings of a page, as GitHub and the site make them."""
    text = re.sub(r"```.*?```", "", page.read_text(), flags=re.DOTALL)
    heads = [re.sub(r"\[(.*?)\]\(.*?\)", r"\1", head) for head in re.findall(r"^#{1,3} (.+)$", text, re.MULTILINE)]
    return {re.sub(r"[^\w\- ]", "", head.lower()).replace(" ", "-") for head in heads}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_lead_to_pages_and_headings(page):
    for file, anchor in re.findall(r"\]\((?!https?:)([^)#\s]*)#?([^)\s]*)\)", page.read_text()):
        place = (page.parent / file) if file else page
        if "made" in place.parts or place.name == "options.md":
            continue  # made of the code when the site is built
        assert place.exists(), file
        assert not anchor or anchor in anchors(place), f"{file}#{anchor}"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_files_modules_members_and_extras_exist(page):
    text = page.read_text()
    for file in re.findall(r"`((?:dem|pctt|tests|run|docs)/[\w./]+)`", text):
        assert (ROOT / file).exists(), file
    for name in set(re.findall(r"`((?:dem|pctt)(?:\.\w+)+)\b", text)):
        resolve_name(name)
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    assert {extra for extra in re.findall(r"'\.\[(\w+)\]'", text)} <= set(extras)


def table(page: str, head: str) -> list[list[str]]:
    """The cells of the rows of a page's table that begins with this head."""
    rows = (ROOT / page).read_text().partition(f"{head}\n|")[2].splitlines()[1:]
    ends = next(k for k, row in enumerate(rows) if not row.startswith("|"))
    return [[cell.strip() for cell in row[1:-1].split(" | ")] for row in rows[:ends]]


def test_tables_of_coefficients_and_arguments_are_whole():
    """Every field of the code has a row, and every row a field."""
    laws = " ".join(row[0] for row in table("docs/contact_laws.md", "| coefficient | unit | default | law |"))
    assert set(re.findall(r"`(\w+)`", laws)) == {field.name for field in dataclasses.fields(ContactLaw)}
    sources = " ".join(row[0] for row in table("docs/sources.md", "| argument | default | meaning | unit |"))
    assert set(re.findall(r"`(\w+)`", sources)) == {*signature(Scene.add_source).parameters} - {"self", "name"}


def test_the_defaults_of_the_limits_are_those_of_the_code():
    rows = table("docs/accuracy.md", "| | `-ccp_tol` | `-ccp_closing_work` | `-ccp_closing_speed` |")
    for (_, tol, work, _), limits in zip(rows, (Settings(), ccp.Limits())):
        assert (float(tol), float(work)) == (limits.tol, limits.closing_work)
