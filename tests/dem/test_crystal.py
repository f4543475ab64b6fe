"""The scene run/studies/crystal.py: every sphere touches its neighbours, none overlaps."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree

from dem.experiment import from_file

SCENE = Path(__file__).resolve().parents[2] / "run" / "studies" / "crystal.py"


@pytest.mark.parametrize(("lattice", "neighbours"), [("fcc", 12), ("cubic", 6)])
def test_spheres_touch_and_do_not_overlap(lattice, neighbours):
    crystal = from_file(SCENE)(n=3, lattice=lattice)
    centres = crystal.positions()
    pairs = cKDTree(centres).query_pairs(2 * crystal.radius * 1.001, output_type="ndarray")
    distances = np.linalg.norm(np.diff(centres[pairs], axis=1), axis=-1)
    assert np.allclose(distances, 2 * crystal.radius, rtol=1e-12)
    assert np.bincount(pairs.ravel()).max() == neighbours
    wall = 7 * crystal.radius
    assert np.allclose(np.abs(centres[:, :2]).max(axis=0), wall - crystal.radius)
    assert np.isclose(centres[:, 2].min(), crystal.radius)
    crystal.build()
