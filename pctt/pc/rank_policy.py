"""The choice of the rank of the next preconditioner: the rank with the fewest measured seconds per digit of residual.

Rank 1 is block Jacobi, which costs nothing to set up. A higher rank needs compression and inversion, and its
application is more expensive. It must save enough iterations to pay for this. On random packings it seldom does, and
then trials must be cheap too: all trials together may take a small part of the time of the solves.
"""

from __future__ import annotations

from dataclasses import dataclass, field

BUDGET = 0.03  # part of the seconds of all solves that trials may take
MEMORY = 0.5  # weight of the newest figure in the average of a rank


@dataclass
class Figures:
    """Running averages of a rank: ``cost`` is seconds per digit, ``seconds`` is the time of one use with set-up."""

    cost: float = float("inf")
    seconds: float = 0.0
    uses: int = 0
    banned: bool = False

    def add(self, seconds: float, digits: float) -> None:
        cost = seconds / max(digits, 1e-3)
        self.cost = cost if self.uses == 0 else (1 - MEMORY) * self.cost + MEMORY * cost
        self.seconds = seconds if self.uses == 0 else (1 - MEMORY) * self.seconds + MEMORY * seconds
        self.uses += 1


@dataclass
class RankPolicy:
    """The policy for rank 1 and the ranks of ``ladder``. If ``automatic`` is False, it always takes the last rank of
    the ladder that is not banned.

    A rank is banned until ``forgive`` if its preconditioner was not positive or the Krylov method stalled with it.
    """

    ladder: tuple[int, ...]
    automatic: bool = True
    figures: dict[int, Figures] = field(init=False)
    spent: float = 0.0
    on_trials: float = 0.0

    def __post_init__(self) -> None:
        self.ladder = tuple(sorted({1, *self.ladder}))
        self.figures = {rank: Figures() for rank in self.ladder}

    def choose(self) -> int:
        """The rank of the next preconditioner."""
        allowed = [rank for rank in self.ladder if not self.figures[rank].banned]
        if not self.automatic:
            return allowed[-1]
        best = min(allowed, key=lambda rank: (self.figures[rank].cost, rank))
        untried = [rank for rank in allowed if rank != best]
        if not untried or self.figures[best].uses == 0:
            return best
        candidate = min(untried, key=lambda rank: (self.figures[rank].uses, rank))
        # the known seconds, or a guess; the first trial also builds the tables of the structure
        price = self.figures[candidate].seconds or 10 * self.figures[best].seconds
        if self.on_trials + price <= BUDGET * self.spent:
            return candidate
        return best

    def report(self, rank: int, seconds: float, digits: float, sound: bool = True) -> None:
        """Report a use of a rank: its seconds (set-up and solve) and the digits that it gained.

        ``sound`` is False for a failure, which bans the rank.
        """
        best = min(self.figures.values(), key=lambda f: f.cost)
        self.figures[rank].add(seconds, digits)
        self.spent += seconds
        if self.figures[rank] is not best:
            expected = best.cost * max(digits, 1e-3) if best.uses else seconds
            self.on_trials += max(0.0, seconds - expected)
        if not sound and rank > 1:
            self.figures[rank].banned = True

    def forgive(self) -> None:
        """Allow all ranks again, for a new problem."""
        for figures in self.figures.values():
            figures.banned = False
