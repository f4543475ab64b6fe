"""What run/validate makes of runs, on figures that are known."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from validation import benchmarks, laws, packings


def test_flows_of_beverloo_give_his_constants(tmp_path):
    """Of three beds for each outlet, each with a tenth more flow than the one before."""
    folders = {}
    for outlet in (4.5, 5.5, 6.5):
        folders[outlet] = [tmp_path / f"{outlet}_{more}" for more in (0.9, 1.0, 1.1)]
        for folder, more in zip(folders[outlet], (0.9, 1.0, 1.1)):
            flow = more * 0.58 * 0.58 * 2500 * np.sqrt(9.81) * (0.01 * (outlet - 1.4)) ** 2.5
            folder.mkdir()
            (folder / "summary.json").write_text(json.dumps({"analysis": {"mass_flow [kg/s]": flow}}))
    found, _ = laws.silo(folders)
    exponent, straight, k, c = (row["found"] for row in found)
    assert exponent == pytest.approx(2.5)
    assert straight == pytest.approx(0.0, abs=1e-2)
    assert (k, c) == pytest.approx((1.4, 0.58))
    assert found[2]["error"] == pytest.approx(0.0, abs=1e-9)
    assert found[3]["error"] == pytest.approx(0.058 / np.sqrt(3))
    assert all(row["agrees"] for row in found)


def test_a_band_tells_how_far_off_a_figure_is():
    from validation.rows import band, row

    inside, below = (band("drum", "angle", 20.0, 30.0, angle, "", "degrees") for angle in (25.0, 18.0))
    assert (inside["agrees"], inside["deviation"]) == (True, 0.0)
    assert below["agrees"] is False
    assert below["deviation"] == pytest.approx(-0.1)
    assert band("silo", "C", 0.55, 0.65, 0.66, "", "", error=0.01)["agrees"] is True  # within two of its errors
    assert band("silo", "C", 0.55, 0.65, 0.68, "", "", error=0.01)["agrees"] is False
    assert row("sliding", "way", 2.0, 2.1, "", "m", 0.01)["agrees"] is False
    assert row("sliding", "lift", 0.0, 1e-9, "", "m", 1e-6)["agrees"] is True


def test_what_repeats_in_the_table_stands_in_its_first_row():
    from validate import table
    from validation.rows import row

    which = [("silo", "Beverloo"), ("silo", "Beverloo"), ("silo", "Mankoc"), ("drum", "Mankoc")]
    rows = table([row(check, "flow", 1.0, 1.0, source, "", 0.1) for check, source in which]).splitlines()[2:]
    cells = [[cell.strip() for cell in line.split("|")[1:-1]] for line in rows]
    assert [(line[0], line[-1]) for line in cells] == [("silo", "Beverloo"), ("", ""), ("", "Mankoc"), ("drum", "")]


def test_angles_of_a_heap_are_means_with_an_error(monkeypatch):
    """Two beds a degree apart: a scatter of sqrt(1/2), an error of the mean of 1/2, of a difference of sqrt(1/2)."""
    angles = {"a": 14.0, "b": 15.0, "c": 24.0, "d": 25.0, "e": 25.0, "f": 26.0}
    line = np.arange(11.0)
    monkeypatch.setattr(laws, "profile", lambda name: laws.Profile(line, line, angles[name], 0.01))
    found, shown = laws.heap({0.1: "ab", 0.3: "cd", 0.6: "ef"})
    rest, *repose, first, second = found
    assert rest["agrees"]
    assert [row["found"] for row in repose] == pytest.approx([14.5, 24.5, 25.5])
    assert [row["error"] for row in repose] == pytest.approx([0.5] * 3)
    assert (first["found"], first["error"], first["agrees"]) == pytest.approx((10.0, 0.5**0.5, True))
    assert (second["found"], second["agrees"]) == (pytest.approx(1.0), False)
    assert shown["scatter"] == pytest.approx(0.5**0.5)
    assert shown["height"].shape == (3, 2, 11)


def test_a_wedge_has_its_angle(monkeypatch):
    """Small spheres that fill the space below a slope of 25 degrees; a tenth of them still moves; others fell."""
    rng = np.random.default_rng(1)
    x, z = rng.uniform(0.0, 0.13, 40000), rng.uniform(0.0, 0.08, 40000)
    below = z < 0.01 + x * np.tan(np.radians(25.0))
    place = np.stack([-x[below], 0.0 * x[below], z[below]], axis=1)
    fallen = np.array([[0.1, 0.0, -0.1], [-0.1, 0.0, -0.1]])
    count = len(place) + len(fallen)
    speed = np.where(np.arange(count) % 10 == 0, 0.1, 0.0)
    frame = SimpleNamespace(position=np.concatenate([place, fallen]), speed=speed)
    run = SimpleNamespace(
        grains=count, steps=[5], mass=np.ones(count), require_frames=lambda: None, frame=lambda step: frame
    )
    monkeypatch.setattr(laws, "Folder", lambda path: run)
    found = laws.profile(Path())
    assert found.angle == pytest.approx(25.0, abs=0.5)
    assert found.x == pytest.approx(0.015 + 0.01 * np.arange(11))
    assert found.height == pytest.approx(0.01 + found.x * np.tan(np.radians(25.0)), rel=0.1)
    assert found.moving == pytest.approx(0.1, abs=0.001)


def test_flow_of_small_outlets_is_that_of_large_ones_in_the_limit_and_half_of_it_at_a_diameter():
    """Glass of 1 mm: 64.6 spheres a second; the laws agree where D/d - 1 is far above 1/b = 20."""
    outlet = np.array([1.001, 1001.0])
    flow = benchmarks.mankoc_flow(outlet) * np.sqrt(9.81 / 0.001) / (outlet - 1.0) ** 2.5
    assert flow == pytest.approx([64.6 / 2, 64.6], rel=1e-3)


def test_run_outs_of_two_experiments_are_a_band():
    assert benchmarks.runout(1.0) == pytest.approx((1.0, 1.24))
    assert benchmarks.runout(2.0) == pytest.approx((2.0, 1.6 * 2**0.5))
    assert benchmarks.runout(12.0) == pytest.approx((1.6 * 12**0.5, 6.0))


def test_the_front_of_a_disc_of_grains_is_its_edge():
    """Grains at random in a cylinder 0.1 m wide and 20 mm high, with a solid fraction of 0.58, and some far away."""
    rng = np.random.default_rng(1)
    radius, angle = 0.1 * np.sqrt(rng.random(20000)), rng.uniform(0.0, 2 * np.pi, 20000)
    place = np.stack([radius * np.cos(angle), radius * np.sin(angle), 0.02 * rng.random(20000)], axis=1)
    place[:20, 0] += 0.3
    volume = np.full(20000, 0.58 * np.pi * 0.1**2 * 0.02 / 20000)
    assert benchmarks.front(place, volume) == pytest.approx(0.1, abs=0.005)


def test_bearing_capacity_is_that_of_the_tables():
    """N_q = 1 without friction; at 30 degrees N_q = 18.4, N_gamma = 22.4; a disc has the factors 1 + tan 30 and 0.6."""
    assert benchmarks.bearing_capacity(0.0) == pytest.approx((1.0, 0.0))
    assert benchmarks.bearing_capacity(30.0) == pytest.approx((18.4 * (1 + 3**-0.5), 0.3 * 22.4), rel=1e-3)


def test_grains_that_bear_nothing_are_taken_away_with_those_that_hung_on_them():
    """A tetrahedron, and a chain that hangs on it and ends nowhere."""
    bodies = np.array([[0, 1], [0, 2], [0, 3], [1, 2], [1, 3], [2, 3], [3, 4], [4, 5], [5, 6]])
    held, alive = packings.backbone(bodies, 8, 2)
    assert held.tolist() == [True] * 6 + [False] * 3
    assert alive.tolist() == [True] * 4 + [False] * 4


@pytest.mark.parametrize("b", [0.0, 0.75])
def test_the_decay_of_forces_is_found_again(b):
    """Exponential forces with a decay of 1.5, of which a part b exp(-f^2) is thrown away."""
    rng = np.random.default_rng(1)
    force = rng.exponential(1 / 1.5, 100000)
    force = force[rng.random(len(force)) > b * np.exp(-(force**2))]
    assert packings.exponential_tail(force) == pytest.approx((b, 1.5), abs=0.05)
    f = np.linspace(0.0, 20.0, 20001)
    assert 0.001 * packings.mueth(f, b, 1.5).sum() == pytest.approx(1.0, abs=1e-3)


@pytest.mark.slow
def test_a_packing_without_friction_has_as_many_contacts_as_degrees_of_freedom(monkeypatch):
    """Within what a few hundred spheres scatter; random close packing has a solid fraction of 0.64."""
    monkeypatch.setattr(packings, "COUNT", 400)
    found = packings.packing(0.0, 1)
    assert found.contacts == pytest.approx(6.0, rel=0.03)
    assert found.fraction == pytest.approx(0.64, abs=0.015)
    assert packings.exponential_tail(found.force)[1] == pytest.approx(1.6, abs=0.4)


def test_impacts_keep_momentum_and_lose_what_walton_says():
    """Unequal spheres with spins; and a sphere that sticks to a plate keeps 5/7 of its speed along it."""
    from validation.impacts import DENSITY, Meeting, closed_form, on_plate

    case = Meeting((0.02, 0.05), ((0.1, 0.2, 1.0), (0.0, -0.1, -0.5)), ((3.0, -2.0, 1.0), (1.0, 4.0, 0.0)), 0.7, 0.2)
    radius = np.array(case.radii)
    mass = DENSITY * 4 / 3 * np.pi * radius**3
    before, after = np.concatenate([case.velocity, case.spin], axis=1), closed_form(case)
    np.testing.assert_allclose(mass @ after[:, :3], mass @ before[:, :3])
    arms = np.array([[0, 0, -radius[0]], [0, 0, radius[1]]])  # of the centres about the place of touch
    turning = [
        sum(m * np.cross(arm, row[:3]) + 0.4 * m * r**2 * row[3:] for m, r, arm, row in zip(mass, radius, arms, rows))
        for rows in (before, after)
    ]
    np.testing.assert_allclose(turning[1], turning[0])
    assert after[1, 2] - after[0, 2] == pytest.approx(0.7 * 1.5)
    stuck = closed_form(on_plate(0.01, 2.0, 10.0, 0.5, 0.9))[0]
    assert stuck[0] == pytest.approx(5 / 7 * 2.0 * np.sin(np.radians(10)))
    assert stuck[2] == pytest.approx(-0.5 * 2.0 * np.cos(np.radians(10)))
    assert abs(stuck[4]) * 0.01 == pytest.approx(stuck[0])  # its surface is at rest


def test_the_structures_touch_and_do_not_overlap():
    from mpi4py import MPI
    from validation import structures

    from dem.contact import find_contacts
    from dem.start import new_world

    for scene in (structures.arch(0.11), structures.overhang(0.9), structures.cards(20.0, 0.5)):
        gap = find_contacts(new_world(scene, MPI.COMM_SELF), 1e-6).gap
        assert len(gap) > 2
        assert abs(gap).max() < 2e-6
