"""Options of ``pctt.pc.TensorTrain``, and the account of what it did."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from typing import Optional

from pctt.options import FRACTION, POSITIVE, number, option


@dataclass(frozen=True)
class Options:
    """Options ``-pc_tt_*``, after the prefix of the PC."""

    eps: float = option(
        1e-2, "a compression ends at this relative Frobenius error, an inverse at this residual",
        check=FRACTION,
    )
    rank: str = option(
        "auto", "cap of the ranks of matrix and inverse; auto: by counted operations up to 100 for a matrix given "
        "by its entries, 1 (block Jacobi) for a sparse one",
        check=("auto or a whole number >= 1", lambda x: x == "auto" or (x.isdecimal() and int(x) >= 1)),
    )
    variant: str = option(
        "own", "of sparse trains; paper: AMEn cross and no scaling; cross: only that; unscaled: only that; own: "
        "alternating least squares over the nonzeros, scaled by Cholesky factors of the diagonal blocks",
        choices=("own", "cross", "unscaled", "paper"),
    )
    order: str = option(
        "auto",
        "order of the rows; grid: the attribute grid or the DMDA, one axis after the other; morton: along a curve "
        "through the attribute coordinates; rcm: reverse Cuthill-McKee; natural: as numbered; auto: the first for "
        "which the matrix has the data (with names of rows: morton)",
        choices=("auto", "grid", "morton", "rcm", "natural"),
    )
    reuse: str = option(
        "none",
        "none: each matrix gets a train of its own; cores: which starts from the cores of the last matrix; trains: a "
        "whole train is kept, with the new matrix's scaling, while new ones are hardly better (Newton steps)",
        choices=("none", "cores", "trains"),
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
    max_rank: int = number(100, "largest rank that auto takes")
    precision: str = number(
        "auto", "of products with the inverse, single or double; auto: single where that can do no harm (entries, eps "
        ">= single_eps, CG or a flexible Krylov method)"
    )
    coarse: float = number(1e-2, "auto: a smaller eps asks for an accurate inverse, which a transform is not")
    pays: float = number(5e8, "operations that a train may take in any case; auto looks for none in cheaper solutions")
    part: float = number(0.25, "auto: a train may take this part of the operations of a solution with a transform")
    single_eps: float = number(1e-5, "auto: a smaller eps needs double precision, whose rounding is 1e-7 in single")
    seed: int = number(0, "of the random starts of sparse trains")

    @property
    def automatic(self) -> bool:
        """Whether the rank is chosen here."""
        return self.rank == "auto"

    @property
    def scaled(self) -> bool:
        """Whether the diagonal blocks scale a sparse matrix."""
        return self.variant in ("own", "cross")

    @property
    def by_cross(self) -> bool:
        """Whether a cross compresses a sparse matrix."""
        return self.variant in ("cross", "paper")


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
