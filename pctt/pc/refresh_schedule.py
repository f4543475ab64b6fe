"""The schedule that decides when a new train replaces a train of earlier matrices.

If each matrix is scaled by the Cholesky factors of its own diagonal blocks, the matrix of the next Newton step or time
step is similar to the last one. The train of the last matrix, with the new scaling, is often as good as a new train,
and it costs nothing. So a train is kept. From time to time a new one is tried, and the better of the two stays in use.
After a trial without gain the wait for the next trial doubles.
"""

from __future__ import annotations

from dataclasses import dataclass

GAIN = 1.1  # a new train is taken if its residual is less than that of the kept train divided by GAIN
LONGEST = 64  # longest wait, in set-ups


@dataclass
class RefreshSchedule:
    """Counts the set-ups in which a train is used."""

    wait: int = 1
    served: int = 0

    def over(self) -> bool:
        """Whether it is time for a trial; counts one set-up."""
        self.served += 1
        return self.served > self.wait

    def decide(self, kept: float, new: float) -> bool:
        """Whether to take the new train; ``kept`` and ``new`` are the residuals of both for a random right side."""
        better = not new * GAIN >= kept  # True if kept is nan
        self.wait = 1 if better else min(max(1, 2 * self.wait), LONGEST)
        self.served = 0
        return better

    def lose(self) -> None:
        """Make the next set-up a trial."""
        self.wait = self.served = 0
