"""records.csv and analysis.csv, and what the records of the scenes show."""

from __future__ import annotations

import h5py
import numpy as np
import pytest
from mpi4py import MPI
from program import SETTLED, steps_of, summary_of, table

from pctt.scenes import Shear
from pctt.simulation import Simulation

APGD = ("-ccp_type", "apgd")


def test_a_row_per_step_that_state_and_summary_know_too(program, settled, tmp_path):
    done = program(*SETTLED, *APGD, "-steps", 3)
    rows = table(tmp_path / "results" / "records.csv")
    assert list(rows)[:2] == ["step", "time [s]"]
    summary, lines = summary_of(tmp_path / "results"), steps_of(tmp_path / "results")
    for name, own in (("step", "step"), ("time", "time [s]"), ("contacts", "contacts")):
        np.testing.assert_array_equal([line[name] for line in lines], rows[own])
    with h5py.File(tmp_path / "results" / "state.h5", "r") as file:
        for k, step in enumerate(rows["step"]):
            recorded = dict(file[f"steps/{int(step):06d}/record"].attrs)
            assert recorded == {name: column[k] for name, column in rows.items()}
    (figure,) = summary["analysis"].items()
    assert figure == ("mean_torque [N m]", pytest.approx(-rows["torque_mixer_z [N m]"].mean()))
    assert f"{figure[0]}  {figure[1] + 0.0:.6g}" in done.stdout
    weight = 27 * 2500.0 * 4 / 3 * np.pi * 0.1**3 * 9.81
    carried = -(rows["force_box_z [N]"] + rows["force_mixer_z [N]"])
    np.testing.assert_allclose(carried.mean(), weight, rtol=0.1)  # settled, and stirred slowly
    assert (rows["grains_outside"] == 0).all()


def test_the_series_of_the_analysis_go_to_a_file(program, tmp_path):
    program("-scene", "shear", "-scene_n", 1, *APGD, "-steps", 3)
    rows, series = (table(tmp_path / "results" / f"{name}.csv") for name in ("records", "analysis"))
    assert list(series)[:2] == ["step", "time [s]"]
    assert {"shear_displacement [m]", "shear_stress_filtered [Pa]", "volume_strain"} < set(series)
    np.testing.assert_array_equal(series["step"], rows["step"])
    assert rows["press_stress [Pa]"] == pytest.approx(0.0)  # it falls with the grains
    assert rows["sample_height [m]"] == pytest.approx(0.75 - 9.81 * 1e-4 * np.array([1, 3, 6]))


def test_the_settled_press_is_carried_and_smooth_walls_leave_its_whole_weight_to_the_floor(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    scene = Shear(n=1, wall_friction=0.0)
    sim, rows = Simulation(scene, dt=0.02, solver="apgd", tol=1e-3, comm=MPI.COMM_SELF), []
    sim.run(until=scene.settling_time, call=lambda sim: rows.append(sim.figures))
    mean = {name: np.mean([row[name] for row in rows[-40:]]) for name in rows[0] if "[" in name}
    world = sim.world
    press, grains = world.large.mass[2] * 9.81, world.grains.mass.sum() * 9.81
    assert mean["press_stress [Pa]"] * scene.area == pytest.approx(press, rel=0.02)
    assert mean["force_press_z [N]"] == pytest.approx(press, rel=0.02)
    assert -mean["force_lower_z [N]"] == pytest.approx(press + grains, rel=0.02)
    assert mean["force_upper_z [N]"] == pytest.approx(0.0, abs=0.02 * press)
    above = 9.81 * world.grains.mass[world.grains.position[:, 2] >= scene.split_height].sum()
    assert mean["normal_stress [Pa]"] * scene.area == pytest.approx(press + above, rel=0.02)
    assert rows[-1]["grains_outside"] == 0
    np.testing.assert_array_equal(world.large.position[2, :2], 0.0)
    np.testing.assert_array_equal(world.large.quaternion[2], [1, 0, 0, 0])
