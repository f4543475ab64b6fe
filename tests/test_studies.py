"""run/study and the list of studies."""

from __future__ import annotations

import re
import subprocess
from pathlib import Path

import numpy as np
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


def test_newton_systems_are_those_of_the_steps(monkeypatch, tmp_path):
    """On a crystal of 27 spheres: as many as Newton steps or twice as many, symmetric and positive definite."""
    monkeypatch.syspath_prepend(str(STUDIES))
    monkeypatch.chdir(tmp_path)
    from newton_systems import Replay, replay_steps

    seen = []

    def look(replay: Replay) -> None:
        for matrix, b in replay.matrices():
            indptr, indices, values = matrix.getValuesCSR()
            S = sp.csr_matrix((values, indices, indptr)).toarray()
            np.testing.assert_allclose(S, S.T, atol=1e-12 * np.abs(S).max())
            assert np.linalg.eigvalsh(S)[0] > 0
            assert b.shape == (3 * replay.contacts,)
            seen.append(np.linalg.norm(b))

    (line,) = replay_steps(["-scene", STUDIES / "crystal.py", "-scene_n", 1, "-scene_lattice", "cubic"], 1, look)
    assert line["converged"]
    assert len(seen) in (line["newton_its"], 2 * line["newton_its"])
    assert min(seen) > 0


def test_a_study_that_is_not_there_is_answered_with_those_that_are():
    done = subprocess.run([ROOT / "run" / "study", "nonsense"], capture_output=True, text=True)
    assert done.returncode == 2
    assert "there is no study nonsense" in done.stderr
    assert "compare_solvers" in done.stderr.split()


def test_pages_name_studies_that_there_are():
    for page in [ROOT / "README.md", ROOT / "CHANGELOG.md", *ROOT.glob("docs/*.md")]:
        for name in re.findall(r"run/study ([a-z_]+)", page.read_text()):
            assert (STUDIES / f"{name}.py").is_file(), f"{page}: run/study {name}"
        for name in re.findall(r"\brun/([a-z_]+)", page.read_text()):
            assert (ROOT / "run" / name).exists() or (ROOT / "pctt" / "run" / name).exists(), f"{page}: run/{name}"
