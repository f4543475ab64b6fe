"""run/study and the list of studies."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import scipy.sparse as sp

ROOT = Path(__file__).parents[1]
STUDIES = ROOT / "run" / "studies"
PAGE = (STUDIES / "README.md").read_text()


def test_the_page_lists_every_study_and_every_shared_file():
    files = {path.stem for path in STUDIES.glob("*.py")}
    listed = set(re.findall(r"^\| `([a-z_]+)", PAGE, re.MULTILINE))
    shared = {name.removesuffix(".py") for name in re.findall(r"`([a-z_]+\.py)`", PAGE)}
    assert listed <= files
    assert files - listed == shared


def test_a_study_that_is_not_there_is_answered_with_those_that_are():
    done = subprocess.run([ROOT / "run" / "study", "nonsense"], capture_output=True, text=True)
    assert done.returncode == 2
    assert "there is no study nonsense" in done.stderr
    assert "measure" in done.stderr.split()


def test_pages_name_studies_that_there_are():
    for page in [ROOT / "README.md", *ROOT.glob("docs/*.md")]:
        for name in re.findall(r"run/study ([a-z_]+)", page.read_text()):
            assert (STUDIES / f"{name}.py").is_file(), f"{page}: run/study {name}"
        for name in re.findall(r"(?<!tests/)\brun/([a-z_]+)", page.read_text()):
            assert (ROOT / "run" / name).exists() or (ROOT / "pctt" / "run" / name).exists(), f"{page}: run/{name}"


#: Every study at a small size, but those of other programs, which have to be there, and `convert_problems`, whose
#: files tests/ccp/test_convert_problems.py has.
SMALL = [
    "ranks unfoldings 1", "trains ranks 1 -caps 10 -every 12",
    "trains reuse 1 -steps 2", "trains scaling 1", "measure steps 1",
    "measure preconditioners 1 -every 8 -names pbjacobi,tt", "measure laws 1", "measure paper -n 1",
    "measure pdip -n 1", "time_steps mixer4 --starts 1 --settings 6", "windows shear4 --states 1 --settings default "
    "--small dt=.005,tol=1e-3", "profile_problems tests/ccp/hard apgd conic --seconds 2 --laws convex",
    "cluster_model 2 -sizes 1,2 -copies 2,1,1", "cluster_start 12 -ranks 4 -of 0,3 -real 8 -steps 1",
    "validate closed_forms", "seeds 1,2 -scene plane_shear -seconds 0.02", "h_stop 2 --rate 40",
    "features loads --side 4 --steps 1 --rounds 1", "shapes -n 3 -steps 5 -shapes spheres,cubes",
    "torture plant cell -n 2 -kills 3 -steps 20", "structure run", "sparse -names pbjacobi",
    "random_scenes 0 3 --steps 3 --processes 1", "drawn_kernels 0 2", "ranks functions",
    "kernels -only imq1 -ways auto plain", "table_plots", "pictures incline -n 2",
]  # fmt: skip
ELSEWHERE = {"compare_chrono", "compare_liggghts", "compare_mujoco", "convert_problems"}
DRAWS = {"structure": "matplotlib", "table_plots": "matplotlib", "pictures": "vtkmodules"}  # and nothing else


def test_the_small_studies_are_all():
    files = {name for name in re.findall(r"^\| `([a-z_]+)", PAGE, re.MULTILINE)}
    assert files - ELSEWHERE == {words.split()[0] for words in SMALL}


@pytest.fixture(scope="module")
def copy(tmp_path_factory):
    """A checkout whose docs and results may change, with the environment and a small run of this one."""
    if not (ROOT / ".venv/bin/mpiexec").exists():
        pytest.skip("no .venv: run/setup makes it")
    place = tmp_path_factory.mktemp("checkout")
    for name in (".venv", "pctt", "dem", "tests", "README.md", "pyproject.toml"):
        (place / name).symlink_to(ROOT / name)
    for name in ("run", "docs"):
        shutil.copytree(ROOT / name, place / name)
    words = ["-m", "pctt.run", "-scene", "mixer", "-scene_n", "1", "-steps", "30", "-output", "run-1", "-quiet"]
    subprocess.run([place / ".venv/bin/python", *words], cwd=place, check=True)
    return place


@pytest.mark.slow
@pytest.mark.mpi
@pytest.mark.parametrize("words", SMALL)
def test_every_study_runs(words, copy):
    name, *rest = words.replace(" run", " run-1").split()
    if name in DRAWS:
        pytest.importorskip(DRAWS[name], reason=f"run/study {name} installs it")
    command = [copy / ".venv/bin/python", copy / "run" / "studies" / f"{name}.py", *rest]
    done = subprocess.run(command, cwd=copy, capture_output=True, text=True, check=False, timeout=600)
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-3000:]
    assert done.stdout.strip()


def test_a_study_writes_its_table_and_its_commit_and_nothing_else(monkeypatch, tmp_path):
    monkeypatch.syspath_prepend(STUDIES)
    shared, page = __import__("shared"), tmp_path / "page.md"
    monkeypatch.setattr(shared, "commit", lambda: "89abcdef0")
    text = "# A\n\n| a | b |\n|---|---|\n| 1 | 2 |\n\n## B\nAt commit 01234567:\n\n{}\nAt commit 01234567.\n"
    old, new = (shared.markdown(["c", "d"], [[value, value]]) for value in (3, 4))
    page.write_text(text.format(old + "\n"))
    shared.replace_table(page, "## B\n", new)
    assert page.read_text() == text.format(new + "\n").replace("01234567", "89abcdef0", 1)


def test_the_ranks_of_unfoldings_are_those_of_the_train_that_svd_makes(monkeypatch):
    from pctt.tt.train import decompose_matrix

    monkeypatch.syspath_prepend(STUDIES)
    ranks = __import__("ranks")
    A = np.random.default_rng(0).standard_normal((24, 24)) * (np.random.default_rng(1).random((24, 24)) < 0.2)
    values = ranks.singular_values(sp.csr_matrix(A), 6)
    assert np.linalg.norm(values) == pytest.approx(np.linalg.norm(A))
    for eps in (0.3, 0.1, 1e-6):
        assert ranks.rank_at(values, eps) == decompose_matrix(A, [4, 6], eps=eps).ranks[1]
    left = np.linalg.norm(A - decompose_matrix(A, [4, 6], max_rank=2, eps=0).full()) / np.linalg.norm(A)
    assert ranks.captured(values, 2) == pytest.approx(1 - left**2)


def random_scenes(monkeypatch):
    monkeypatch.syspath_prepend(STUDIES)
    return __import__("random_scenes")


def overlapping(cause: str, turn: float = 0.0) -> SimpleNamespace:
    """Return what the study reads of a run with overlaps of ``cause`` and bodies that turn by ``turn`` [rad] a step."""
    velocity = np.array([[0.0, 0.0, 0.0, 0.0, 0.0, -turn / 0.1]])
    local, settings = SimpleNamespace(velocity=velocity), SimpleNamespace(dt=0.1)
    return SimpleNamespace(overlap_watch=SimpleNamespace(cause=cause), local=local, settings=settings)


def test_notes_of_random_scenes_tell_faults_from_what_is_known(monkeypatch):
    """Steps that are not solved, deep overlaps, energy from nothing, and ends of runs."""
    study = random_scenes(monkeypatch)
    scene = study.mixture(0).scene
    bare, pressed = study.Mixture(scene, 0.1, []), study.Mixture(scene, 0.1, [], rigid=True, pressed=True)
    figures = {"step": 1, "status": "converged", "coulomb_residual": 1e-4, "tolerance": 5e-4, "iterations": 3}
    assert study.solves(bare, [figures]) == []
    wrongs = {"status": "stalled"}, {"coulomb_residual": 6e-4}, {"coulomb_residual": np.nan}, {"iterations": 20_000}
    for wrong in wrongs:
        (note,) = study.solves(bare, [figures, figures | wrong])
        assert not note.reason
    hard = study.Mixture(scene, 0.1, [], hard=True)
    stalled = figures | {"status": "stalled", "coulomb_residual": 1e-3}
    for counts, known in (((1, 19), True), ((3, 17), False)):
        (note,) = study.solves(hard, [stalled] * counts[0] + [figures] * counts[1])
        assert bool(note.reason) == known
    assert study.overlaps(bare, overlapping("stiffness"), [{"worst_overlap": 1e-4}]) == []
    overlaps = (bare, "stiffness", 0, False), (pressed, "stiffness", 0, True), (pressed, "dt", 0, False)
    for made, cause, turn, known in (*overlaps, (bare, "dt", 0.5, False), (bare, "dt", 3.0, True)):
        (note,) = study.overlaps(made, overlapping(cause, turn), [{"worst_overlap": 0.02}])
        assert bool(note.reason) == known
    energies = [dict(zip(study.STATES, values)) for values in ([3.0, 1.0, 0.0], [2.0, 1.5, 0.0], [2.5, 1.5, 0.0])]
    assert study.energies(energies[:2], False, 0.1) == study.energies(energies, True, 0.1) == []
    assert study.energies(energies, False, 100.0) == []
    assert "energy from nothing" in study.energies(energies, False, 0.1)[0].fault
    fast = study.SceneError("grain 1 moves at 8 m/s, too far in a time step of 0.1 s")
    assert [bool(study.end_of(bare, speed, fast).reason) for speed in (5.0, 0.1)] == [True, False]
    unbounded = study.SceneError("step 3: unbounded: impulses grow")
    assert [bool(study.end_of(made, 1.0, unbounded).reason) for made in (bare, pressed)] == [False, True]
    assert not study.end_of(bare, 1.0, IndexError("out of range")).reason


def test_a_random_scene_is_that_of_its_seed(monkeypatch):
    study = random_scenes(monkeypatch)
    one, two = (study.simulated(6, 3) for _ in range(2))
    assert one == two
    assert (one["steps"], one["solved"], one["notes"]) == (3, 3, [])


@pytest.mark.slow
def test_random_scenes_have_no_fault_without_a_reason(tmp_path):
    words = [sys.executable, STUDIES / "random_scenes.py"]
    done = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr
