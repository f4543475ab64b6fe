"""Solve the cone problem of an FCLIB file: ``python -m pctt.run -problem FILE``."""

from __future__ import annotations

import json
import time
from pathlib import Path

from mpi4py import MPI

from pctt import ccp
from pctt.ccp import fclib
from pctt.run.hdf5 import FileError, write_text
from pctt.run.options import Options
from pctt.run.report import Progress, compare_table


def solve_file(options: Options, comm: MPI.Comm) -> None:
    """Solve, print the figures, and write them to summary.json in the output folder."""
    assert options.problem is not None
    try:
        problem = fclib.read(options.problem, comm)
    except fclib.FileFormatError as error:
        raise FileError(str(error)) from None
    compare = ccp.Comparison(comm, options.compare_names(), options.run.compare_every)
    start = time.perf_counter()
    result = ccp.solve(
        problem,
        None,
        options.run.ccp_type,
        options.limits,
        options.solver,
        compare if compare.names else None,
    )
    seconds = time.perf_counter() - start
    accuracy = ccp.measure(problem, result.impulse)
    newton = ccp.SOLVERS[options.run.ccp_type].newton
    summary = {
        "problem": str(options.problem),
        "contacts": problem.size,
        "ranks": comm.size,
        "solver": options.run.ccp_type,
        "objective": accuracy.objective,
        "natural_residual": accuracy.natural_residual,
        "newton_its": result.iterations if newton else 0,
        "iterations": result.iterations,
        "ksp_its": result.ksp_its,
        "seconds": seconds,
        "converged": result.converged,
        "reason": result.reason,
        "cone_violation": accuracy.cone_violation,
        "dual_violation": accuracy.dual_violation,
        "complementarity": accuracy.complementarity,
        "velocity_norm": accuracy.velocity_norm,
        "compare": compare.summary(),
    }
    progress = Progress(comm.rank == 0 and not options.run.quiet)
    width = max(map(len, summary))
    for name, value in summary.items():
        if name != "compare":
            shown = f"{value:.12g}" if isinstance(value, float) else value
            progress.say(f"{name:{width}}  {shown}")
    if compare.names:
        progress.say("\n" + compare_table(compare.summary(), compare.labels()))
    if not result.converged:
        progress.say(f"NOT CONVERGED: {result.reason}")
    if comm.rank == 0:
        write_text(Path(options.run.output) / "summary.json", json.dumps(summary, indent=1) + "\n")
