"""When a train that has served for earlier matrices is replaced by a new one.

Scaled by the Cholesky factors of its own diagonal blocks, the matrix of the next Newton step or time step is much like
the last: a train for the last one, with the new scaling, is often as good as one made for it, and costs nothing. So a
train is kept. From time to time a new one is tried, and the better of the two goes on; a trial without gain doubles the
wait for the next.
"""

from __future__ import annotations

from dataclasses import dataclass

GAIN = 1.1  # a new train is taken if it leaves less than 1 / GAIN of what the kept one leaves
LONGEST = 64  # wait, in set-ups


@dataclass
class RefreshSchedule:
    """Counts the set-ups that a train serves."""

    wait: int = 1
    served: int = 0

    def over(self) -> bool:
        """Whether it is time for a trial; counts one set-up."""
        self.served += 1
        return self.served > self.wait

    def decide(self, kept: float, new: float) -> bool:
        """Whether the new train is taken, by what both leave of a random right side."""
        better = not new * GAIN >= kept  # a kept train that leaves nan goes
        self.wait = 1 if better else min(max(1, 2 * self.wait), LONGEST)
        self.served = 0
        return better

    def lose(self) -> None:
        """The next set-up is a trial."""
        self.wait = self.served = 0
