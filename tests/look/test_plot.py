"""The figures of a run."""

from __future__ import annotations

import shutil
import sys

import numpy as np
import pytest
import scipy.sparse as sp

pytest.importorskip("matplotlib", reason="matplotlib is not installed")

import structure
from matplotlib.image import imread

from pctt.folder import Folder
from pctt.look import figures


def test_all_figures_are_drawn(show, folder, tmp_path, monkeypatch):
    # the layout, half of the work, is that of the next test
    monkeypatch.setitem(figures.STYLE, "figure.constrained_layout.use", False)
    done = show("plot", "-output", tmp_path)
    names = {"steps", "compare", "forces", "torques", "energy", "lengths", "statistics"}
    assert {path.name for path in tmp_path.iterdir()} == {f"{name}.png" for name in names}
    assert all(f"{name}.png" in done.stdout for name in names)
    for name in names:
        picture = imread(tmp_path / f"{name}.png")[..., :3]
        assert min(picture.shape[:2]) > 300
        assert picture.std() > 0.05, name
        assert (picture.min(axis=2) < 0.9).mean() > 0.003, name  # something is drawn


def test_figures_as_pdf(show, folder, tmp_path):
    """Of a run that wrote no steps down, so that one figure is left."""
    shutil.copy(folder / "summary.json", tmp_path)
    show("plot", "-format", "pdf", folder=tmp_path)
    assert [path.name for path in (tmp_path / "figures").iterdir()] == ["compare.pdf"]
    assert (tmp_path / "figures" / "compare.pdf").read_bytes().startswith(b"%PDF")


def test_stresses_against_displacement_and_forces_against_position():
    way = np.array([0.0, 1.0, 2.0])
    rows = {"time [s]": way, "cart_displacement [m]": way, "shear_stress [Pa]": way**2, "force_x [N]": way}
    made = figures.curves(rows, {"shear_stress_filtered [Pa]": way, "volume_strain": 0.1 * way})
    assert set(made) == {"cart_stress"}
    stress, strain = made["cart_stress"].axes
    drawn = [line.get_xydata().T for line in stress.lines]
    np.testing.assert_array_equal(drawn, [[way, way**2], [way, way]])
    np.testing.assert_array_equal(strain.lines[0].get_ydata(), 0.1 * way)
    made = figures.curves({"time [s]": way, "blade_position [m]": way, "draft_force [N]": way, "force_x [N]": way}, {})
    (axes,) = made["blade_force"].axes
    assert len(axes.lines) == 1
    assert figures.curves({"time [s]": way, "worst_overlap [m]": way, "force_x [N]": way}, {}) == {}


def test_filtered_values_that_raw_ones_do_not_reach_are_in_the_figure():
    way, raw, filtered = np.arange(4.0), np.array([3.0, 6, 6, 5]), np.array([1.0, 2, 8, 2])
    rows = {"blade_position [m]": way, "draft_force [N]": raw}
    (axes,) = figures.curves(rows, {"draft_force_filtered [N]": filtered})["blade_force"].axes
    low, high = axes.get_ylim()
    assert low < 1
    assert high > 8


def test_the_energy_figure_is_a_balance():
    """Energies that obey the balance but for a drift of 1 J per step, in the figure's curves."""
    time, work, friction, impact = np.arange(1.0, 6.0), np.arange(5.0) ** 2, np.arange(5.0), np.full(5, 0.5)
    kinetic = np.array([3.0, 1, 4, 1, 5])
    total = 1e6 + np.cumsum(work - friction - impact + 1)
    spring = np.linspace(0.0, 2.0, 5)
    values = (kinetic, total - kinetic - spring, spring, work, friction, impact, np.ones(5))
    columns = {"step": time, "time [s]": time} | {f"{k} [J]": v for k, v in zip(figures.BALANCE, values)}
    made = figures.records(columns)
    assert set(made) == {"energy"}
    above, below = made["energy"].axes
    drawn = {line.get_label(): line.get_ydata() for line in above.lines}
    assert len(drawn) == 6
    np.testing.assert_allclose(drawn["kinetic energy"], kinetic)
    potential = total - kinetic - spring
    np.testing.assert_allclose(drawn["potential energy, change"], potential - potential[0])
    np.testing.assert_allclose(drawn["work of moving bodies, sum"], [0, 1, 5, 14, 30])
    np.testing.assert_allclose(drawn["friction loss, sum"], [0, 1, 3, 6, 10])
    np.testing.assert_allclose(np.diff(drawn["kinetic + potential + spring + losses - work"]), 1, atol=1e-9)
    np.testing.assert_allclose(below.lines[-1].get_ydata(), time, atol=1e-9)


def test_vectors_share_axes():
    time = np.arange(3.0)
    columns = {"time [s]": time, "a [Pa]": time, "b [Pa]": 2 * time}
    made = figures.records({**columns, "force_x [N]": time, "force_y [N]": 1e6 * time, "push [N]": time})
    labels = {name: [(axes.get_ylabel(), len(axes.lines)) for axes in made[name].axes] for name in made}
    assert labels == {"stresses": [("a", 1), ("b", 1)], "forces": [("force", 2), ("push", 1)]}


def test_nothing_to_plot_is_an_error(show, tmp_path):
    (tmp_path / "summary.json").write_text("{}")
    assert "nothing to plot" in show("plot", folder=tmp_path, status=2).stderr


def test_the_pattern_is_that_of_the_delassus_matrix(folder):
    """Against G G' with a random 3 x 6 block for every contact and body of finite mass."""
    read = Folder(folder)
    read.require_frames()
    frame = read.frame(4)
    pair = frame.contacts.bodies
    moves, count = pair < 125, len(pair)
    blocks = np.random.default_rng(1).uniform(size=(moves.sum(), 3, 6))
    first = np.concatenate([[0], np.cumsum(moves.sum(axis=1))])
    G = sp.bsr_matrix((blocks, pair[moves], first), shape=(3 * count, 6 * 125))
    there = (G @ G.T).toarray().reshape(count, 3, count, 3).any(axis=(1, 3)) | np.eye(count, dtype=bool)
    np.testing.assert_array_equal(structure.coupling(read, frame).toarray() > 0, there)


@pytest.mark.slow
def test_figures_of_a_small_cluster(folder, tmp_path, monkeypatch):
    read = Folder(folder)
    read.require_frames()
    frame = read.frame(4)
    rows = structure.example(read, frame)
    assert len(rows) >= 1
    assert 1 <= (np.unique(frame.contacts.bodies[rows]) < 125).sum() <= 13
    monkeypatch.setattr(sys, "argv", ["structure", str(folder)])
    monkeypatch.chdir(tmp_path)
    structure.main()
    for name in ("sparsity", "graphs"):
        assert imread(tmp_path / "results" / f"{name}.png")[..., :3].std() > 0.05
