"""Cone problems from files with known optima (docs/ccp.md): two unrelated algorithms agree on them to 7e-12."""

from __future__ import annotations

import json

import pytest
from program import ROOT

FOLDER = ROOT.parent / "shared" / "fclib"

# contacts, objective, norm of W r + q
OPTIMA = {
    "LMGC_100_PR_PerioBox-i00361-60-03000.hdf5": (60, -1.168364218784e5, 3.1195242e-1),
    "Box_Stacks-i0122-82-5.hdf5": (82, -2.320918201378e-5, 2.31837e-3),
    "Spheres-i099-356-679.hdf5": (356, -2.084946581043e2, 1.0829370),
}
FIELDS = {"objective": float, "natural_residual": float, "newton_its": int, "seconds": float, "converged": bool}


@pytest.mark.parallel(1, 2)
@pytest.mark.parametrize("solver", ["pdip", "apgd"])
@pytest.mark.parametrize("name", OPTIMA)
def test_the_known_optimum_is_found(name, solver, ranks, program, tmp_path):
    path = FOLDER / name
    if not path.exists():
        pytest.skip(f"no {path}")
    contacts, objective, speed = OPTIMA[name]
    done = program("-problem", path, "-ccp_type", solver, "-ccp_tol", 1e-7)
    summary = json.loads((tmp_path / "results" / "summary.json").read_text())
    for field, kind in FIELDS.items():
        assert type(summary[field]) is kind, f"{field}: {summary[field]!r}"
        assert field in done.stdout
    assert summary["converged"]
    assert summary["contacts"] == contacts
    assert summary["ranks"] == ranks
    assert summary["natural_residual"] <= 1.1e-7
    assert summary["objective"] == pytest.approx(objective, rel=1e-6)
    assert summary["objective"] >= objective * (1 + 1e-9)  # no better than the optimum
    assert summary["velocity_norm"] == pytest.approx(speed, rel=3e-5)
    assert (summary["newton_its"] > 0) == (solver == "pdip")
    assert summary["newton_systems"] == ("BiCGStab (right), pbjacobi" if solver == "pdip" else "")
    assert summary["newton_its"] < 60
    assert sorted(p.name for p in (tmp_path / "results").iterdir()) == ["summary.json"]


def test_a_problem_that_is_not_solved_says_so(program, tmp_path):
    path = FOLDER / "Spheres-i099-356-679.hdf5"
    if not path.exists():
        pytest.skip(f"no {path}")
    done = program("-problem", path, "-ccp_max_it", 3, "-ccp_tol", 1e-9, "-ccp_fallback", 0)
    summary = json.loads((tmp_path / "results" / "summary.json").read_text())
    assert summary["converged"] is False
    assert summary["newton_its"] == 3
    assert "NOT CONVERGED" in done.stdout
