"""Seconds per phase of settled mixer steps; see run/measure_steps."""

from __future__ import annotations

import json
import os
import platform
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy
import petsc4py
import scipy

STEPS, RANKS = 3, (1, 2)


def machine() -> dict[str, object]:
    """What the figures were measured on."""
    petsc = petsc4py.__version__
    lines = Path("/proc/cpuinfo").read_text().splitlines()
    cpu = next((line.split(":")[1].strip() for line in lines if line.startswith("model name")), "?")
    versions = {"python": platform.python_version(), "numpy": numpy.__version__, "scipy": scipy.__version__}
    threads = os.environ.get("OMP_NUM_THREADS", "1")
    return {"cpu": cpu, "cores": os.cpu_count(), "OMP_NUM_THREADS": threads, "petsc4py": petsc, **versions}


def run(n: int, ranks: int, folder: Path) -> list[dict]:
    """The steps of one run from the settled state."""
    options = f"-scene mixer -scene_n {n} -restart settled -steps {STEPS} -output {folder}".split()
    command = [".venv/bin/mpiexec", "-n", str(ranks), ".venv/bin/python", "-m", "pctt.run", *options]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    return json.loads((folder / "summary.json").read_text())["steps"]


def main(sizes: list[int]) -> None:
    about = machine()
    print(", ".join(f"{name} {value}" for name, value in about.items()))
    print(f"medians of {STEPS} steps, pdip to 1e-4, BiCGStab with block Jacobi; seconds")
    phases = ("search", "assembly", "solve", "advance", "output")
    print(f"{'n':>3} {'ranks':>5} {'contacts':>9} {'Newton':>7} {'Krylov':>7} " + " ".join(f"{p:>9}" for p in phases)
          + f" {'total':>9} {'spread':>15}")
    rows = []
    for n in sizes:
        for ranks in RANKS:
            with tempfile.TemporaryDirectory() as folder:
                steps = run(n, ranks, Path(folder))
            row = {"n": n, "ranks": ranks}
            for name in ("contacts", "newton_its", "ksp_its", "seconds"):
                row[name] = statistics.median(line[name] for line in steps)
            row |= {p: statistics.median(line["phases"].get(p, 0.0) for line in steps) for p in phases}
            row["spread"] = [min(line["seconds"] for line in steps), max(line["seconds"] for line in steps)]
            rows.append(row)
            cells = " ".join(f"{row[p]:9.3f}" for p in phases)
            print(f"{n:3d} {ranks:5d} {row['contacts']:9.0f} {row['newton_its']:7.0f} {row['ksp_its']:7.0f} {cells}"
                  f" {row['seconds']:9.2f} {row['spread'][0]:7.2f}-{row['spread'][1]:.2f}", flush=True)
        one, two = rows[-2]["seconds"], rows[-1]["seconds"]
        print(f"    n = {n}: 1 rank / 2 ranks = {one / two:.2f}")
    Path("results").mkdir(exist_ok=True)
    Path("results/measure_steps.json").write_text(json.dumps({"machine": about, "rows": rows}, indent=1) + "\n")
    print("results/measure_steps.json")


if __name__ == "__main__":
    main([int(word) for word in sys.argv[1:]] or [4, 8])
