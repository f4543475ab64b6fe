"""Options of ``pctt.pc.TensorTrain``, and the account of what it did."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Optional

from pctt.options import AT_LEAST_ONE, COUNT, FRACTION, option

SPARSE_RANK, ENTRIES_RANK = 10, 100  # default caps


@dataclass(frozen=True)
class Options:
    """Options ``-pc_tt_*``, after the prefix of the PC."""

    eps: float = option(
        1e-2, "a compression ends at this relative Frobenius error, an inverse at this residual",
        check=FRACTION,
    )
    max_rank: Optional[int] = option(
        None, f"cap of the ranks of matrix and inverse; none: {SPARSE_RANK}, or {ENTRIES_RANK} for a matrix given by "
        "its entries", check=AT_LEAST_ONE,
    )
    rank: str = option("auto", "auto: the rank that pays, 1 included; fixed: max_rank", choices=("auto", "fixed"))
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
        "steps",
        "newton: use cores, index sets and block pairs of the last matrix with the same structure; steps: use its "
        "slots and cores for the next structure too; none: compute everything anew",
        choices=("none", "newton", "steps"),
    )
    keep: bool = option(
        True, "keep a train, with the new matrix's scaling, while new trains are hardly better; not with reuse none"
    )
    seed: int = option(0, "seed of the random starts", check=COUNT)
    monitor: bool = option(False, "print a line per set-up")

    def cap(self, default: int) -> int:
        return self.max_rank or default


@dataclass
class Account:
    """What the preconditioner has done so far, for ``-ksp_view`` and the summary of the run."""

    setups: int = 0
    reused: int = 0
    kept: int = 0
    resets: int = 0
    setup_s: float = 0.0
    fallbacks: list[str] = field(default_factory=list)
