"""What run/validate makes of runs, on figures that are known."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import pytest

from dem.experiment import from_file

RUN = Path(__file__).resolve().parents[2] / "run" / "studies"


@pytest.fixture
def laws(monkeypatch):
    monkeypatch.syspath_prepend(str(RUN))
    from validation import laws, rows

    yield laws
    for name in [name for name in sys.modules if name.startswith("validation")]:
        del sys.modules[name]
    assert rows


def test_flows_of_beverloo_give_his_constants(laws, tmp_path):
    folders = {}
    for outlet in (4.5, 5.5, 6.5):
        flow = 0.58 * 0.58 * 2500 * np.sqrt(9.81) * (0.01 * (outlet - 1.4)) ** 2.5
        folders[outlet] = tmp_path / str(outlet)
        folders[outlet].mkdir()
        (folders[outlet] / "summary.json").write_text(json.dumps({"analysis": {"mass_flow [kg/s]": flow}}))
    found, _ = laws.silo(folders)
    exponent, straight, k, c = (row["found"] for row in found)
    assert exponent == pytest.approx(2.5)
    assert straight == pytest.approx(0.0, abs=1e-9)
    assert (k, c) == pytest.approx((1.4, 0.58))
    assert all(row["agrees"] for row in found)


def test_a_band_tells_how_far_off_a_figure_is(laws):
    from validation.rows import band, row

    inside, below = (band("drum", "angle", 20.0, 30.0, angle, "", "degrees") for angle in (25.0, 18.0))
    assert (inside["agrees"], inside["deviation"]) == (True, 0.0)
    assert below["agrees"] is False
    assert below["deviation"] == pytest.approx(-0.1)
    assert row("sliding", "way", 2.0, 2.1, "", "m", 0.01)["agrees"] is False
    assert row("sliding", "lift", 0.0, 1e-9, "", "m", 1e-6)["agrees"] is True


def test_the_page_has_all_that_it_shows(laws):
    text = (RUN / "validation" / "page.md").read_text()
    filled = text.format(
        minutes=9.0, cores=2, cpu="a processor", table="", outlets="4.5", rubs=0.24, unsolved=1, steps=9
    )
    assert "about 9 minutes on 2 cores with nothing else to do (a processor)" in filled


@pytest.mark.parametrize("name", ["heap", "column"])
def test_the_scenes_build(name):
    scene = from_file(RUN / "validation" / f"{name}.py")()
    built = scene.build()
    assert 500 < len(built.grains()) < 1100
    assert len(built.large_bodies) >= 2
