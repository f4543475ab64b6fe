"""The scenes of periodic cells: triaxial test and plane shear, and their layers."""

from dataclasses import replace

import numpy as np
import pytest
from mpi4py import MPI

import pctt
from dem import measures
from pctt.scenes import PlaneShear, Triaxial

SMALL = Triaxial(n=6, height=1.0, fraction=0.58, start=0.08, strain_rate=1.0)
LOOSE = Triaxial(n=6, height=1.0, fraction=0.4, start=0.008, strain_rate=1.0)  # a packing that is made at once
OF_RUNS = {"solver": "apgd", "tol": 1e-5}


def stress(sim):
    return np.array([sim.figures[f"stress_{axis}{axis} [Pa]"] for axis in "xyz"])


def test_triaxial_is_isotropic_then_compressed_at_its_rate():
    sim = pctt.Simulation(SMALL, comm=MPI.COMM_SELF, **OF_RUNS)
    dt = sim.settings.dt
    sim.run(until=0.08)
    np.testing.assert_allclose(stress(sim), SMALL.pressure, rtol=0.02)
    assert sim.figures["axial_strain"] == 0.0
    height, first = sim.period[2], sim.steps
    for _ in range(15):
        sim.step()
        figures = sim.figures
        x, y, z = stress(sim)
        assert figures["q_over_p"] == pytest.approx(3.0 * (z - 0.5 * (x + y)) / (x + y + z))
    assert sim.period[2] == pytest.approx(height * (1.0 - dt * SMALL.strain_rate) ** (sim.steps - first), rel=1e-9)
    assert figures["axial_strain"] == pytest.approx(sim.time - 0.08)
    np.testing.assert_allclose(stress(sim)[:2], SMALL.pressure, rtol=0.05)
    assert figures["q_over_p"] > 0.3
    # the stress of the records is that which the measures find in the contacts, with the motion of the grains
    every, volume = np.ones(len(sim.ids), bool), sim.period.prod()
    borne = measures.stress(sim.sample, every, volume)
    speed = sim.velocities[:, :3] - np.average(sim.velocities[:, :3], axis=0, weights=sim._of_grains("mass"))
    moving = (speed.T * sim._of_grains("mass")) @ speed / volume
    np.testing.assert_allclose(np.diag(borne + moving), stress(sim), rtol=1e-3)


def test_plane_strain_keeps_the_width():
    sim = pctt.Simulation(replace(LOOSE, plane=True), comm=MPI.COMM_SELF, **OF_RUNS)
    sim.run(steps=5)
    width = sim.period[1]
    sim.run(steps=5)
    assert sim.period[1] == width
    assert sim.figures["lateral_stress [Pa]"] == sim.figures["stress_xx [Pa]"]


def test_analysis_of_a_triaxial_test_finds_the_angles_it_was_given():
    strain = np.concatenate([np.zeros(10), np.linspace(0.0005, 0.4, 800)])
    sine = np.where(strain < 0.1, 0.5, 0.4)
    lateral = np.full(810, 1000.0)
    records = {
        "axial_strain": strain, "lateral_stress [Pa]": lateral, "axial_stress [Pa]": lateral * (1 + sine) / (1 - sine),
        "solid_fraction": 0.6 * np.exp(-np.minimum(0.2 * strain, 0.03)), "coordination_number": np.full(810, 4.5),
        "energy_jump [J]": np.zeros(810),
    }  # fmt: skip
    found = SMALL.analyse(records)
    assert found["peak_angle [degrees]"] == pytest.approx(30.0)
    assert found["late_angle [degrees]"] == pytest.approx(np.degrees(np.arcsin(0.4)))
    assert found["late_coordination"] == pytest.approx(4.5)
    assert found["late_dilation"] == pytest.approx(0.0, abs=1e-9)
    assert found["volumetric_strain"][-1] == pytest.approx(0.03, abs=2e-4)
    assert SMALL.analyse({name: column[:10] for name, column in records.items()}) == {}


def test_triaxial_goes_on_after_a_restart_with_the_same_bits(tmp_path):
    sim = pctt.Simulation(LOOSE, comm=MPI.COMM_SELF, **OF_RUNS)
    sim.run(steps=6)
    sim.save(tmp_path / "state.h5")
    other = pctt.Simulation.load(tmp_path / "state.h5", LOOSE, comm=MPI.COMM_SELF, **OF_RUNS)
    for each in (sim, other):
        each.run(steps=2)
    assert np.array_equal(sim.period, other.period)
    assert np.array_equal(sim.positions, other.positions)
    assert np.array_equal(sim.velocities, other.velocities)


@pytest.mark.parallel(2)
def test_ranks_change_nothing_in_a_triaxial_test():
    alone, together = (pctt.Simulation(LOOSE, comm=comm, **OF_RUNS) for comm in (MPI.COMM_SELF, MPI.COMM_WORLD))
    for sim in (alone, together):
        sim.run(steps=8)
    np.testing.assert_allclose(together.period, alone.period, rtol=1e-4)
    np.testing.assert_allclose(together.positions, alone.positions, atol=1e-5)


def test_a_layer_stays_in_its_plane():
    scene = PlaneShear(layer=True, n=8, inertial=0.2, friction=0.4)
    sim = pctt.Simulation(scene, comm=MPI.COMM_SELF, solver="apgd")
    assert sim.ids.size == 8 * 13
    sim.run(steps=60)
    assert sim.figures["active_contacts"] > 80
    assert not sim.velocities[:, [1, 3, 5]].any()
    assert (sim.positions[:, 1] == 0.5 * sim.period[1]).all()
    assert np.abs(sim.velocities[:, [0, 2, 4]]).min(axis=0).max() > 0.0
    contacts = sim.contacts
    assert not contacts.force[:, 1].any()
    assert sim.figures["stress_zz [Pa]"] == pytest.approx(scene.pressure / 6.0, rel=0.05)
    area = np.pi * (sim._of_grains("size")[:, 0] ** 2).sum() / (sim.period[0] * sim.period[2])
    assert sim.figures["solid_fraction"] == pytest.approx(area)
