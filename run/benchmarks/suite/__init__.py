"""Benchmarks of asv: one thread, one rank. `setup` makes what a benchmark starts from, and compiles."""

import os
import sys
from pathlib import Path

os.environ["OMP_NUM_THREADS"] = os.environ["OPENBLAS_NUM_THREADS"] = "1"
sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "studies"))  # shared by the studies and this

import petsc4py

petsc4py.init(["asv"])  # before PETSc reads asv's command line
