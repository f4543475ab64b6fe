"""Dense matrices of `run/study kernels`: conjugate gradients to 1e-8, with what the preconditioner costs to set up."""

from __future__ import annotations

import time

from kernels import nineteen
from solutions import solve


class Kernel:
    """A line of 4,096 points, a square of 64^2 and a cube of 16^3; `TensorTrain` by its defaults, as a train of rank
    100 at most, and no preconditioner."""

    params = (["imq1", "exp02", "yukawa50"], ["auto", "train", "plain"])
    param_names = ("matrix", "preconditioner")
    number, warmup_time, timeout, timer = 1, 0.0, 600, time.process_time

    def setup(self, matrix: str, preconditioner: str) -> None:
        self.system = nineteen()[matrix]()

    def time_solve(self, matrix: str, preconditioner: str) -> None:
        solve(self.system, preconditioner)

    def track_iterations(self, matrix: str, preconditioner: str) -> int:
        return solve(self.system, preconditioner)["iterations"]
