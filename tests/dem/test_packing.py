"""Random packings: no overlap, the solid fraction, the sizes, and what is refused."""

import re

import numpy as np
import pytest

from dem import packing
from dem.packing import perturbed, random_packing
from dem.parts.sizes import Listed, Uniform


def gaps(position, radius, box, periodic):
    """The least gap of two spheres or their images, and of spheres and walls."""
    way = position[:, None] - position
    way -= np.array(periodic) * box * np.round(way / box)
    gap = np.linalg.norm(way, axis=2) - radius[:, None] - radius
    walls = np.minimum(position, box - position) - radius[:, None]
    return gap[~np.eye(len(radius), dtype=bool)].min(), np.where(periodic, np.inf, walls).min()


@pytest.mark.parametrize(("fraction", "periodic"), [
    (0.15, (False, False, False)), (0.5, (True, True, False)), (0.55, (True, True, True)),
    pytest.param(0.6, (True, True, True), marks=pytest.mark.slow),
])  # fmt: skip
def test_a_packing_has_its_fraction_and_no_overlap(fraction, periodic):
    box = np.array([1.0, 0.8, 0.9])
    position, radius = random_packing(box, Uniform(0.06, 0.09), fraction, periodic=periodic, seed=3)
    volume = 4 / 3 * np.pi * (radius**3).sum()
    assert fraction <= volume / box.prod() * (1 + 1e-9) < fraction + 4 / 3 * np.pi * 0.09**3 / box.prod()
    assert min(gaps(position, radius, box, periodic)) >= 0.0
    assert radius.min() >= 0.06
    assert radius.max() <= 0.09


@pytest.mark.slow
def test_equal_spheres_fill_half_of_a_small_box_between_walls():
    position, radius = random_packing((1, 1, 1), 0.1, 0.5)
    assert 4 / 3 * np.pi * (radius**3).sum() >= 0.5
    assert min(gaps(position, radius, np.ones(3), (False,) * 3)) >= 0.0


def test_a_packing_follows_from_its_seed():
    one, two, other = (random_packing((1, 1, 1), 0.1, 0.3, seed=seed)[0] for seed in (1, 1, 2))
    np.testing.assert_array_equal(one, two)
    assert len(one) == len(other)
    assert np.abs(one - other).max() > 0.1


def test_sizes_of_a_packing_have_their_shares():
    radius = random_packing((1, 1, 1), Listed((0.03, 0.06), (3, 1)), 0.3, seed=1)[1]
    assert (radius == 0.06).mean() == pytest.approx(0.25, abs=4 * np.sqrt(0.25 * 0.75 / len(radius)))


def test_shares_of_a_sieve_curve_are_those_of_the_mass():
    sizes = Listed.by_mass((0.03, 0.06), (1, 3))
    assert sizes.shares == pytest.approx((8 / 11, 3 / 11))
    radius = random_packing((1, 1, 1), Listed.by_mass((0.03, 0.06), (1, 1)), 0.3, seed=1)[1]
    assert (radius == 0.03).mean() == pytest.approx(8 / 9, abs=4 * np.sqrt(8 / 81 / len(radius)))


def test_several_sizes_of_a_packing_are_alike():
    radius = random_packing((1, 1, 1), [0.03, 0.06], 0.3, seed=1)[1]
    assert (radius == 0.06).mean() == pytest.approx(0.5, abs=4 * np.sqrt(0.25 / len(radius)))


def test_a_packing_that_takes_long_says_how_far_it_is(monkeypatch, capfd):
    monkeypatch.setattr(packing, "WAIT", 0.0)
    random_packing((1, 1, 1), 0.1, 0.4, periodic=(True, True, True))
    lines = capfd.readouterr().err.splitlines()
    stages = [int(re.fullmatch(r"packing 96 spheres: stage (\d+) of 16(, which takes about \d+ s more)?", line)[1])
              for line in lines]  # fmt: skip
    assert stages == sorted(stages)
    assert stages[-1] == 16


def test_what_cannot_be_packed_is_refused():
    with pytest.raises(ValueError, match="take a lower solid fraction"):
        random_packing((1, 1, 1), 0.12, 0.73, periodic=(True, True, True), most=200)
    with pytest.raises(ValueError, match="do not fit into a box"):
        random_packing((1, 0.1, 1), 0.1, 0.1)
    with pytest.raises(ValueError, match="size of a grain"):
        random_packing((1, 1, 1), [0.1, -0.1], 0.3)
    with pytest.raises(ValueError, match="between 0 and 0.74"):
        random_packing((1, 1, 1), 0.1, 0.8)
    for periodic in (True, "xyz", (True, True)):
        with pytest.raises(ValueError, match="periodic .*: allowed are three, for x, y and z"):
            random_packing((1, 1, 1), 0.1, 0.3, periodic=periodic)
    for seed in (None, 1.5, -1, True):  # None would be another packing on every rank
        with pytest.raises(ValueError, match=f"seed of a packing {seed}: allowed is a whole number from 0 on"):
            random_packing((1, 1, 1), 0.1, 0.3, seed=seed)


def test_points_of_a_lattice_stay_near_it():
    x = np.arange(4.0)
    found = perturbed(x, x, x[:1], 0.1, 2)[:]
    assert found.shape == (16, 3)
    assert 0.05 < np.abs(found - np.round(found)).max() <= 0.1
