"""Options ``-mat_tt_*`` of ``pctt.mat.TensorTrain``."""

from __future__ import annotations

import dataclasses
import numbers
from dataclasses import dataclass

from mpi4py import MPI
from petsc4py import PETSc

from dem.exchange import refuse
from pctt.options import AT_LEAST_ONE, FRACTION, describe, option, read
from pctt.petsc import given_options

PREFIX = "mat_tt_"
MAX_RANK = 200


@dataclass(frozen=True)
class Options:
    """Options of a Mat that is a train, after the prefix of the Mat."""

    eps: float = option(
        1e-8, "the compression ends at this error relative to ||A - c I||_F; c is the mean of the diagonal",
        check=FRACTION,
    )  # fmt: skip
    max_rank: int = option(MAX_RANK, "largest allowed rank", check=AT_LEAST_ONE)

    def check(self, comm: MPI.Comm) -> None:
        """ValueError on all ranks if a value is not allowed or differs between ranks; collective."""
        wrong = ""
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            allowed, test = field.metadata["check"]
            kind = numbers.Integral if field.name == "max_rank" else numbers.Real
            if not isinstance(value, kind) or not test(value):
                wrong = wrong or f"{field.name} {value!r}: allowed is {allowed}"
        refuse(comm, wrong)
        found = comm.allgather(repr(self))
        if len(set(found)) > 1:
            raise ValueError(f"eps or max_rank differ between ranks: {', '.join(found)}")

    def given_for(self, mat: PETSc.Mat) -> Options:
        """These options with those of the database; OptionError for a bad value or a misspelt name."""
        prefix = (mat.getOptionsPrefix() or "") + PREFIX
        given = given_options(Options, prefix)
        found = dataclasses.asdict(read(Options, given, prefix))
        return dataclasses.replace(self, **{name: found[name] for name in found if prefix + name in given})

    @staticmethod
    def help(mat: PETSc.Mat) -> list[str]:
        """Lines for ``-help``."""
        return list(map(str, describe(Options, (mat.getOptionsPrefix() or "") + PREFIX)))
