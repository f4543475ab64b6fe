"""Options of ``pctt.pc.TensorTrain``, and the account of what it did."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from typing import Optional

from pctt.options import AT_LEAST_ONE, FRACTION, POSITIVE, OptionError, number, option


@dataclass(frozen=True)
class Options:
    """Options ``-pc_tt_*``, after the prefix of the PC."""

    eps: float = option(
        1e-2, "a compression ends at this relative Frobenius error, an inverse at this residual",
        check=FRACTION,
    )
    rank: str = option(
        "auto", "cap of the ranks of matrix and inverse; auto: by counted operations up to max_rank for a matrix given "
        "by its entries, 1 (block Jacobi) for a sparse one",
        check=("auto or a whole number >= 1", lambda x: x == "auto" or (x.isdecimal() and int(x) >= 1)),
    )
    max_rank: Optional[int] = option(
        None, "largest rank that auto takes; none: 100", check=AT_LEAST_ONE
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
    reuse: str = option(
        "trains",
        "none: compute everything anew; newton: start from cores, index sets and block pairs of the last matrix with "
        "the same structure; steps: take its slots and cores for the next structure too; trains: also keep a whole "
        "train, with the new matrix's scaling, while new ones are hardly better",
        choices=("none", "newton", "steps", "trains"),
    )
    precision: str = option(
        "auto",
        "of products with the inverse; auto: single where that can do no harm (entries, eps >= 1e-5, CG or a flexible "
        "Krylov method), else double",
        choices=("auto", "single", "double"),
    )
    fallback: str = option(
        "jacobi",
        "if a train cannot be used; jacobi: block Jacobi takes over; none: the set-up fails, and the KSP ends with "
        "PETSc's reason",
        choices=("jacobi", "none"),
    )
    setup_limit: Optional[float] = option(
        None,
        "for matrices given by their entries: operations (about a nanosecond each) that the set-up of a train may "
        "take; none: as many as a solution without a train takes",
        check=POSITIVE,
    )
    monitor: bool = option(False, "print a line per set-up")
    coarse: float = number(1e-2, "auto: a smaller eps asks for an accurate inverse, which a transform is not")
    pays: float = number(5e8, "operations that a train may take in any case; auto looks for none in cheaper solutions")
    part: float = number(0.25, "auto: a train may take this part of the operations of a solution with a transform")
    single_eps: float = number(1e-5, "auto: a smaller eps needs double precision, whose rounding is 1e-7 in single")
    seed: int = number(0, "of the random starts of sparse trains")

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


@dataclass
class Account:
    """What the preconditioner has done so far, for ``-ksp_view`` and the summary of the run.

    used : solves by the greatest rank of the inverse that they ended with, or by what else they ended with
    """

    setups: int = 0
    reused: int = 0
    kept: int = 0
    resets: int = 0
    setup_s: float = 0.0
    fallbacks: Counter[str] = field(default_factory=Counter)
    last: str = ""  # the last reason of a fall-back
    used: Counter[int | str] = field(default_factory=Counter)

    def fall_back(self, why: str) -> None:
        self.fallbacks[why] += 1
        self.last = why

    def what(self) -> str:
        """What most of the solves used, and how many something else; empty if there were none."""
        ranks = sorted(kind for kind in self.used if isinstance(kind, int))
        counts = Counter({kind: count for kind, count in self.used.items() if isinstance(kind, str)})
        if ranks:
            name = f"rank {ranks[0]} to {ranks[-1]}" if len(ranks) > 1 else f"rank {ranks[0]}"
            counts[name] = sum(self.used[rank] for rank in ranks)
        if not counts:
            return ""
        (most, _), *others = counts.most_common()
        total, fewer = sum(counts.values()), sum(count for _, count in others)
        return most + (f", {fewer} of {total} systems {' or '.join(name for name, _ in others)}" if others else "")
