"""-compare: every preconditioner on the same Newton systems."""

from __future__ import annotations

import pytest
from program import SETTLED, steps_of, summary_of

# accurate Newton steps, so that every cone problem is solved by PDIP alone
ACCURATE = ("-ksp_rtol", "1e-6", "-ksp_max_it", "500", "-ccp_tol", "1e-3")

PDIP = ("-ccp_type", "pdip")
FACTOR = ("-pc_type", "python", "-pc_python_type", "pctt.pc.BlockICC")
TRAIN = ("-pc_type", "python", "-pc_python_type", "pctt.pc.TensorTrain")


def compared(program, folder, *options):
    done = program(*SETTLED, *ACCURATE, "-steps", 2, "-overwrite", *options)
    summary = summary_of(folder / "results")
    assert summary["newton_its"] == sum(line["newton_its"] for line in steps_of(folder / "results"))
    table = done.stdout.partition("preconditioner  ")[2].splitlines()
    rows = [line.split(maxsplit=8) for line in table[2:] if line.strip()]
    return summary, {entry: [*cells, ""][:8] for entry, *cells in rows[:-1]}


def test_all_see_the_same_systems_and_the_table_agrees_with_the_summary(program, settled, tmp_path):
    """The records themselves are asked in ccp/test_compare.py."""
    summary, table = compared(program, tmp_path, "-compare", "none,ilu,pbjacobi")
    count = summary["compare"]["pbjacobi"]["systems"]
    assert count >= summary["newton_its"] > 20  # one system or more in a step
    solves = [line["compare"] for line in steps_of(tmp_path / "results")]
    assert list(summary["compare"]) == list(table) == ["none", "ilu", "pbjacobi"]
    for name, record in summary["compare"].items():
        assert record["systems"] == sum(len(step[name]) for step in solves) == count
        assert sum(converged for step in solves for converged, *_ in step[name]) == record["converged"]
        systems, converged, mean, most, _, _, worst, what = table[name]
        assert (record["type"], what) == (name, record["what"])
        assert (int(systems), int(converged), int(most)) == (count, record["converged"], record["ksp_its_max"])
        assert float(mean) == pytest.approx(record["ksp_its_mean"], abs=0.06)
        assert float(worst) == pytest.approx(record["excess_max"], rel=0.06)
    assert summary["phases"]["compare"] > 0
    for line in steps_of(tmp_path / "results"):
        assert sum(line["phases"].values()) == pytest.approx(line["seconds"])
    assert summary["compare"]["pbjacobi"]["converged"] == count


@pytest.mark.slow
@pytest.mark.mpi
def test_without_options_the_program_is_the_demo(program, tmp_path):
    done = program(ranks=2, cache=tmp_path / "cache")
    summary = summary_of(tmp_path / "results" / "demo")
    assert (summary["bodies"], summary["ranks"], summary["steps"]) == (731, 2, 5)
    kinds = {name: record["type"] for name, record in summary["compare"].items()}
    assert kinds == {"auto": "tt", "ten": "tt", "pbjacobi": "pbjacobi", "ilu": "ilu", "none": "none"}
    assert summary["natural_residual"] <= 1e-4
    assert "NOT CONVERGED" not in done.stdout
    assert not any(line.startswith("WARNING") for line in done.stdout.splitlines()[-8:])
    assert "\nNewton systems: BiCGStab (right), pctt.pc.TensorTrain\n" in done.stdout
    assert "\nNewton systems: pctt.pc.TensorTrain was rank " in done.stdout
    assert "options without effect" not in done.stdout
    assert "results: " in done.stdout.splitlines()[-1]


def test_fallbacks_of_a_train_reach_the_summary(program, settled, tmp_path):
    summary, _ = compared(program, tmp_path, "-compare", "pbjacobi,tt", "-compare_tt_pc_tt_rank", "4")
    assert "pc_report" not in summary["compare"]["pbjacobi"]
    report = summary["compare"]["tt"]["pc_report"]
    assert report[0].startswith("tensor train")
    assert f"set-ups {summary['newton_its']} " in report[1]
    assert all("pc_report" not in line for line in steps_of(tmp_path / "results"))
    program(*SETTLED, *PDIP, "-steps", 1, *TRAIN, "-output", "train")
    (step,) = steps_of(tmp_path / "train")
    assert step["pc_report"][0].startswith("tensor train")

@pytest.mark.parametrize(
    ("options", "start", "end"),
    [
        ((*PDIP,), "BiCGStab (right), pbjacobi, pctt.pc.BlockICC where that takes long", None),
        ((*PDIP, *FACTOR), "BiCGStab (right), pctt.pc.BlockICC", "pctt.pc.BlockICC was fill"),
        ((*PDIP, "-ksp_type", "cg", "-pc_type", "ilu"), "CG, ilu", None),
        (("-ccp_type", "conic"), "CG, pbjacobi until it takes long, then cholesky", None),
        ((*PDIP, *TRAIN), "BiCGStab (right), pctt.pc.TensorTrain", "pctt.pc.TensorTrain was rank 1: block Jacobi"),
        (("-ccp_type", "apgd"), None, None),
    ],
)
def test_a_run_says_what_solves_its_newton_systems(options, start, end, program, settled):
    said = program(*SETTLED, "-steps", 1, "-overwrite", *options).stdout
    lines = [line.partition(": ")[2] for line in said.splitlines() if line.startswith("Newton systems: ")]
    assert [line for line in lines if not line.startswith(end or "-")] == [start] * bool(start)
    assert len(lines) == bool(start) + bool(end)


def test_a_run_without_steps_prints_no_empty_tables(program, settled):
    said = program(*SETTLED, "-steps", 0, "-compare", "none").stdout
    assert "Newton systems: " in said
    assert "residual" not in said.replace("to 0.0001", "")
