from __future__ import annotations

import numpy as np
import pytest

from dem.record import analysis
from pctt.scenes import Blade, Shear

TIME = np.arange(0.0, 8.0, 0.01)


def test_the_filter_keeps_what_is_slow_in_place_and_removes_what_is_fast():
    slow = 3.0 + np.sin(2 * np.pi * 0.25 * TIME)
    both = slow + np.sin(2 * np.pi * 20.0 * TIME)
    inner = slice(100, -100)
    np.testing.assert_allclose(analysis.low_pass(TIME, slow, 2.0)[inner], slow[inner], atol=1e-3)
    np.testing.assert_allclose(analysis.low_pass(TIME, both, 2.0)[inner], slow[inner], atol=1e-3)


def test_the_filter_halves_the_amplitude_at_the_cutoff():
    """1/sqrt(2) for each of the two ways of a Butterworth filter."""
    wave = np.sin(2 * np.pi * 2.0 * TIME)
    filtered = analysis.low_pass(TIME, wave, 2.0)[200:-200]
    assert np.abs(filtered).max() == pytest.approx(0.5, abs=5e-3)


@pytest.mark.parametrize("place", [1, 5, 9])
def test_a_peak_near_the_start_is_spread_as_any_other(place):
    """There its mirror image, of the other sign, comes to it: in all at most twice the height."""
    height = analysis.low_pass(TIME, (np.arange(len(TIME)) == 400).astype(float), 2.0).max()
    near = analysis.low_pass(TIME, (np.arange(len(TIME)) == place).astype(float), 2.0)
    assert np.abs(near).max() <= 2 * height


@pytest.mark.parametrize("count", [0, 1, 2, 3, 5, 30])
def test_few_records_are_filtered_too(count):
    assert analysis.low_pass(TIME[:count], np.ones(count), 2.0) == pytest.approx(np.ones(count))


def test_the_steady_draft_force_is_the_mean_while_the_blade_is_fast():
    scene = Blade(n=4)
    time = np.arange(0.0, scene.settling_time + 5.0, 0.01)
    fast = np.sin(2 * np.pi * (time - scene.settling_time) / scene.period) > np.sqrt(0.5) - 1e-6
    fast &= (time > scene.settling_time) & (time < scene.settling_time + 2.0)
    records = {f"force_blade_{a} [N]": 0 * time for a in "xyz"} | {f"torque_blade_{a} [N m]": 0 * time for a in "xyz"}
    records |= {"time [s]": time, "draft_force [N]": np.where(fast, 7.0, 100.0), "blade_position [m]": time}
    jump = time == time[len(time) // 2 + 70]
    records |= {"energy_jump [J]": np.where(jump, 1.0, 0.0)}
    records["draft_force [N]"][jump] = 1e6  # means are without the step of a jump
    found = scene.analyse(records)
    assert found["steady_draft_force [N]"] == pytest.approx(7.0)
    assert found["draft_force_deviation [N]"] == pytest.approx(0.0, abs=1e-12)
    assert found["draft_force_filtered [N]"].shape == time.shape
    before = {name: values[:50] for name, values in records.items()}
    assert "steady_draft_force [N]" not in scene.analyse(before)  # nothing was drawn yet


def test_friction_angles_of_a_shear_test_with_known_stresses():
    scene = Shear(n=4)
    time = scene.settling_time + np.arange(0.0, 4.0, 0.01)
    ratio = 0.3 + 0.2 * np.exp(-(((time - scene.settling_time - 0.4) / 0.1) ** 2))  # a peak before the steady part
    records = {"time [s]": time, "normal_stress [Pa]": np.full(len(time), 5e4), "shear_stress [Pa]": 5e4 * ratio}
    records |= {"energy_jump [J]": 0 * time}
    records |= {"shear_displacement [m]": 0 * time, "sample_height [m]": 1.0 + 0.01 * (time - time[0])}
    found = scene.analyse(records)
    assert found["steady_friction_angle [degrees]"] == pytest.approx(np.degrees(np.arctan(0.3)), abs=0.7)
    assert found["peak_friction_angle [degrees]"] > 22.0
    assert found["normal_stress_swing"] == pytest.approx(0.0, abs=1e-12)
    rough = records | {"normal_stress [Pa]": 5e4 * (1 + 0.4 * (-1.0) ** np.arange(len(time)))}
    assert scene.analyse(rough)["normal_stress_swing"] == pytest.approx(0.4, abs=0.01)
    assert found["volume_strain"][-1] == pytest.approx(0.0399)
