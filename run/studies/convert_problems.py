"""FCLIB files of cone problems in Siconos' text files (docs/files.md): run/study convert_problems FILE [FILE ...] -to
DIR. DIR/NAME.h5 holds what FILE NAME.* does. A file there is not replaced.

A local problem stays local and a global one global. W is made symmetric, and so is M, whose entries have six digits;
where only one triangle is stored, it is mirrored.
"""

from __future__ import annotations

import os
import sys
import tempfile
from pathlib import Path

import scipy.sparse as sp
import siconos_text
from mpi4py import MPI
from shared import called_from, parser

from pctt.arrays import Array
from pctt.blocks import square_block_matrix
from pctt.ccp import ConeProblem, fclib
from pctt.ccp.fclib import FileFormatError, symmetric_blocks, symmetric_masses

#: Of masses in Siconos' files, as `symmetric_masses` takes it: %g and %e print six and seven digits.
ROUNDING = 1e-5

HDF5_BEGINNING = b"\x89HDF\r\n\x1a\n"


def convert(path: Path, folder: Path) -> tuple[Path, str]:
    """Write ``folder``/NAME.h5 for ``path`` NAME.*; the new file, and what was done to the data in words.

    Raises FileFormatError with the path if there is no problem in the file, OSError if a file cannot be read or
    written, or is there already.
    """
    target = folder / f"{path.stem}.h5"
    if target.exists():
        raise FileExistsError(f"{target} is there already, and is not replaced")
    with open(path, "rb") as file:
        beginning = file.read(8)
    if beginning == HDF5_BEGINNING:
        raise FileFormatError(f"{path}: it is HDF5; pctt.run -problem reads FCLIB files as they are")
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=folder) as temporary:
        made = Path(temporary) / target.name
        try:
            note = _from_text(path, made)
            fclib.read(made, MPI.COMM_SELF).destroy()
        except OSError:
            raise
        except Exception as error:  # of any kind: bad data surprise numpy and scipy
            reason = str(error).replace(f"{made}: no FCLIB problem: ", "")
            raise FileFormatError(f"{path}: no Siconos problem: {reason}") from None
        os.replace(made, target)
    return target, note


def _from_text(path: Path, made: Path) -> str:
    """Write the problem of a text file of Siconos; what was done to its matrix."""
    matrices, vectors = siconos_text.read(path)
    if "W" in matrices:
        return _write_local(path, made, matrices["W"], vectors["q"], vectors["mu"])
    M, H, f, w, mu = matrices["M"], matrices["H"], vectors["f"], vectors["w"], vectors["mu"]
    if M.shape != (len(f), len(f)):
        raise FileFormatError(f"its mass matrix {M.shape} is not square")
    if not (M.diagonal() > 0).all():
        raise FileFormatError("its mass matrix is not positive")
    M, note = symmetric_masses(M, ROUNDING)
    fclib.write_global(made, MPI.COMM_SELF, M, H.T, f, w.reshape(-1, 3), mu, _info(path, note))
    return note


def _write_local(path: Path, made: Path, W: sp.csr_matrix, q: Array, mu: Array) -> str:
    """Write W (3 nc, 3 nc), made symmetric, q (3 nc,) and mu (nc,); what was done to W."""
    if W.shape[0] != 3 * len(mu) or len(q) != 3 * len(mu):
        raise FileFormatError(f"{len(mu)} friction coefficients, but a matrix {W.shape} and a vector {q.shape}")
    blocks, note = symmetric_blocks(W)
    N = square_block_matrix(MPI.COMM_SELF, blocks)
    with ConeProblem(MPI.COMM_SELF, q.reshape(-1, 3), mu, N=N) as problem:
        fclib.write_local(made, problem, _info(path, note))
    N.destroy()
    return note


def _info(path: Path, note: str) -> fclib.Info:
    return fclib.Info(path.name, f"Converted from {path.name}. {note}".strip())


def main() -> int:
    line = parser("convert_problems", __doc__)
    line.add_argument("files", nargs="+", metavar="FILE", help="text file of Siconos")
    line.add_argument("-to", required=True, metavar="DIR", help="folder for the FCLIB files, made if need be")
    words, status = line.parse_args(), 0
    for name in words.files:
        try:
            target, note = convert(called_from(name), called_from(words.to))
            print(f"{target}{note and ': ' + note}")
        except (FileFormatError, OSError) as error:  # noqa: PERF203 - as many files as there are
            print(f"run/study convert_problems: {error}", file=sys.stderr)
            status = 1
    return status


if __name__ == "__main__":
    sys.exit(main())
