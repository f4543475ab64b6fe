"""Options of ``pctt.pc.TensorTrain``, and the account of what it did."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Optional

from pctt.options import AT_LEAST_ONE, COUNT, FRACTION, POSITIVE, OptionError, option

SPARSE_RANK, ENTRIES_RANK = 10, 100  # default caps


@dataclass(frozen=True)
class Options:
    """Options ``-pc_tt_*``, after the prefix of the PC."""

    eps: float = option(
        1e-2, "a compression ends at this relative Frobenius error, an inverse at this residual",
        check=FRACTION,
    )
    rank: str = option(
        "auto", "cap of the ranks of matrix and inverse; auto: the rank that pays, 1 included, up to max_rank",
        check=("auto or a whole number >= 1", lambda x: x == "auto" or (x.isdecimal() and int(x) >= 1)),
    )
    max_rank: Optional[int] = option(
        None, f"largest rank that auto takes; none: {SPARSE_RANK}, or {ENTRIES_RANK} for a matrix given by its entries",
        check=AT_LEAST_ONE,
    )
    compress: str = option(
        "als", "for sparse matrices; als: alternating least squares over the nonzeros; cross: AMEn cross (the paper)",
        choices=("als", "cross"),
    )
    scaling: str = option(
        "block", "block: by Cholesky factors of the diagonal blocks; none: the matrix as it is (the paper)",
        choices=("block", "none"),
    )
    order: str = option(
        "auto",
        "order of the rows; grid: the attribute grid or the DMDA, one axis after the other; morton: along a curve "
        "through the attribute coordinates; rcm: reverse Cuthill-McKee; natural: as numbered; auto: the first for "
        "which the matrix has the data (with names of rows: morton)",
        choices=("auto", "grid", "morton", "rcm", "natural"),
    )
    leaf: int = option(16, "least number of blocks in the first and last mode", check=AT_LEAST_ONE)
    reuse: str = option(
        "trains",
        "none: compute everything anew; newton: start from cores, index sets and block pairs of the last matrix with "
        "the same structure; steps: take its slots and cores for the next structure too; trains: also keep a whole "
        "train, with the new matrix's scaling, while new ones are hardly better",
        choices=("none", "newton", "steps", "trains"),
    )
    seed: int = option(0, "seed of the random starts", check=COUNT)
    setup_limit: Optional[float] = option(
        None,
        "for matrices given by their entries: operations (about a nanosecond each) that the set-up of a train may "
        "take; none: as many as a solution without a train takes",
        check=POSITIVE,
    )
    monitor: bool = option(False, "print a line per set-up")

    def __post_init__(self) -> None:
        if self.automatic or self.max_rank is None:
            return
        raise OptionError(
            f"-pc_tt_max_rank {self.max_rank}: has no effect with -pc_tt_rank {self.rank}; allowed is one of the two"
        )

    @property
    def automatic(self) -> bool:
        """Whether the rank is chosen here."""
        return self.rank == "auto"

    def cap(self, default: int) -> int:
        """The largest rank that is allowed; ``default`` if the user has not said one."""
        return (self.max_rank or default) if self.automatic else int(self.rank)


@dataclass
class Account:
    """What the preconditioner has done so far, for ``-ksp_view`` and the summary of the run."""

    setups: int = 0
    reused: int = 0
    kept: int = 0
    resets: int = 0
    setup_s: float = 0.0
    fallbacks: list[str] = field(default_factory=list)
