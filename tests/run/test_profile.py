"""Performance profiles over folders of problems (run/study profile_problems)."""

from __future__ import annotations

import numpy as np
import profile_problems
import pytest

SLIDES = "3 1 0 3 3 3 3  1 0 0  0 1 0  0 0 1  -1 2 0  0.3"  # the impulse is the projection of (1, -2, 0) on the cone


def row(problem: str, method: str, seconds: float | None, reason: str = "", law: str = "convex") -> dict:
    return {"law": law, "problem": problem, "contacts": 7, "method": method, "tol": 1e-8, "reason": reason,
            "reached": seconds is not None, "seconds": seconds, "residual": 3e-7}  # fmt: skip


def test_ratios_are_to_the_fastest_and_failures_stay_in_the_count():
    rows = [row("a", "one", 1.0), row("a", "two", 3.0), row("b", "one", None, "stalled"), row("b", "two", 0.5)]
    rows += [row("c", "one", None), row("c", "two", None), row("a", "one", 9.0, law="coulomb")]
    solvers, ratios = profile_problems.ratios(rows, "convex", 1e-8)
    assert solvers == ["one", "two"]
    assert np.array_equal(ratios, [[1.0, np.inf, np.inf], [3.0, 1.0, np.inf]])


def test_the_tables_count_and_name_failures():
    rows = [row("a", "one", 1.0), row("a", "two", 3.0), row("b", "one", None, "stalled"), row("b", "two", 0.5)]
    rows += [r | {"tol": tol} for r in rows for tol in (1e-4, 1e-6)]
    text = profile_problems.tables(rows)
    assert "| `one` | 1; 1, 1, 1 | 1; 1, 1, 1 | 1; 1, 1, 1 |" in text
    assert "| `two` | 2; 1, 1, 2 | 2; 1, 1, 2 | 2; 1, 1, 2 |" in text
    assert "| a | 7 | 1 | 3 |\n| b | 7 | (3.0e-07) | 0.5 |" in text
    assert "- `one`, b: stalled" in text


@pytest.mark.parametrize(
    ("law", "solver"), [("convex", "conic"), ("convex", "apgd"), ("coulomb", "apgd")]
)
def test_a_problem_of_a_folder_is_solved_to_every_tolerance(tmp_path, law, solver):
    (tmp_path / "good.dat").write_text(SLIDES)
    (tmp_path / "odd.dat").write_text("5" + SLIDES[1:])
    (tmp_path / "notes.md").write_text("no problem")
    found, refused = profile_problems.problems([tmp_path], tmp_path / "converted")
    assert [(name, contacts) for name, _, contacts in found] == [("good.dat", 1)]
    assert len(refused) == 1
    assert "odd.dat: no Siconos problem: dimension 5" in refused[0]
    lines = list(profile_problems.solve(str(found[0][1]), law, solver, 10.0))
    assert [line["tol"] for line in lines] == [1e-4, 1e-6, 1e-8]
    assert all(line["reached"] and line["residual"] <= 1.01 * line["tol"] for line in lines)
    if law == "convex":
        assert lines[-1]["objective"] == pytest.approx(-0.5 * (1 + 0.3 * 2) ** 2 / 1.09, rel=1e-7)
