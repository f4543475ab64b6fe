"""``python -m pctt.run``: simulate a scene, settle one, or solve a cone problem from a file."""

from __future__ import annotations

import sys
import traceback

import petsc4py

# before anything else imports PETSc; -help is answered here, without PETSc's own hundred lines
petsc4py.init([word for word in sys.argv if word not in ("-help", "--help", "-h")])

from mpi4py import MPI
from petsc4py import PETSc

from pctt.petsc import require_real_double

try:
    require_real_double()
except ImportError as error:
    sys.exit(str(error))

from dem.together import SceneError
from pctt.options import OptionError
from pctt.run.hdf5 import FileError
from pctt.run.interrupt import InterruptError, heed
from pctt.run.leftovers import keep_from_petsc, refuse_stray
from pctt.run.options import help_text, read_options
from pctt.run.problem import solve_file
from pctt.run.simulate import simulate


def main(comm: MPI.Comm) -> None:
    database = PETSc.Options().getAll()
    if {"-help", "--help", "-h"} & set(sys.argv):
        if comm.rank == 0:
            print(help_text(database))
        return
    refuse_stray(sys.argv[1:])
    options = read_options(database, comm)
    if options.problem is not None:
        solve_file(options, comm)
    else:
        simulate(options, comm)


#: Exit status by what ends a run; raised on all ranks alike, but for a FileError that says that it is `alone`.
STATUS: dict[type[Exception], int] = {OptionError: 2, FileError: 2, SceneError: 1, InterruptError: 130}


def run() -> int:
    """Exit status: 0; 1 if a scene fails; 2 for a bad option or file; 130, as shells have it for Ctrl-C, if a signal
    has ended the run. What went wrong is told once. Other errors abort all ranks."""
    comm = MPI.COMM_WORLD
    heed(comm)
    try:
        main(comm)
    except tuple(STATUS) as error:
        status = STATUS[type(error)]
        if comm.rank == 0:
            print(f"pctt.run: {error}", file=sys.stderr, flush=True)
        if comm.size > 1 and getattr(error, "alone", False):  # the others wait for this rank
            comm.Abort(status)
        keep_from_petsc(PETSc.Options().getAll())
        return status
    except BaseException as error:
        if comm.size == 1 or isinstance(error, SystemExit):
            raise
        traceback.print_exc()
        sys.stderr.flush()
        comm.Abort(1)
    return 0


if __name__ == "__main__":
    sys.exit(run())
