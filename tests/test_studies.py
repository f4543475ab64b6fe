"""run/study and the list of studies."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

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


@pytest.mark.parametrize(
    "words",
    [
        "trains ranks 1 -caps 10 -every 12",
        "trains reuse 1 -steps 2",
        "trains scaling 1",
        "ranks unfoldings 1",
    ],
)
def test_a_study_of_the_smallest_size_runs(words, tmp_path):
    name, *rest = words.split()
    done = subprocess.run([sys.executable, STUDIES / f"{name}.py", *rest], cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert list((tmp_path / "results").glob(f"{name}*.json"))


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
