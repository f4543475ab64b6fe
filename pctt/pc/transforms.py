"""The preconditioner of a matrix whose entries depend on differences of points of a grid: fast transforms, or none."""

from __future__ import annotations

from math import log2, prod

import numpy as np
from petsc4py import PETSc

from dem.exchange import on_first
from pctt.mat.differences import differences_in
from pctt.mat.entries import Entries, is_symmetric
from pctt.mat.grid_train import WholeVectors
from pctt.mat.order import Layout
from pctt.tt import differences
from pctt.tt.conjugate import CostEstimate
from pctt.tt.train import Array


class DifferencesInverse:
    """The inverse with which conjugate gradients cost least, of those that fast transforms give, or the identity.

    inverse : see `pctt.tt.differences.FastInverse`
    cost_estimate : what trials on parts of the grid have shown
    """

    def __init__(self, layout: Layout, inverse: differences.FastInverse, cost_estimate: CostEstimate) -> None:
        self.gather, self.order = WholeVectors(layout.comm, layout.counts), layout.rows
        self.inverse, self.cost_estimate = inverse, cost_estimate

    @classmethod
    def best_of(cls, P: PETSc.Mat, layout: Layout) -> DifferencesInverse | None:
        """For a Mat with entries; None if they do not depend on differences, or are not symmetric and positive.

        Collective; ValueError on all ranks.
        """
        entries, shape, comm, block = Entries.of(P), layout.digits.shape, layout.comm, P.getBlockSize()
        a = differences_in(P) if layout.rows is None else None
        if a is not None and not a.symmetric:
            return None
        if a is None:
            where = shape, block, layout.rows
            even = differences.depend_on_differences(entries, *where, np.random.default_rng(0))
            if even is None or not is_symmetric(entries, layout.digits.rows):
                return None
            a = differences.differences_of(entries, *where, even)
        # what other ranks find best may differ by rounding
        found = on_first(comm, lambda: differences.choose(a))
        if found is None:
            return None
        inverse = differences.FastInverse(a, found.kind)
        return cls(layout, inverse, found.cost_estimate) if comm.bcast(inverse.positive) else None

    def __call__(self, x: Array) -> Array:
        """This rank's part of the product, from its part of x, (n,) or (k, n). Every rank transforms whole vectors."""
        if not self.inverse.kind:
            return x
        x = self.gather(x)
        if self.order is None:
            return self.inverse.solve(x)[..., self.gather.mine]
        out = np.empty_like(x)
        out[..., self.order] = self.inverse.solve(x[..., self.order])
        return out[..., self.gather.mine]

    @property
    def name(self) -> str:
        return self.inverse.name

    @property
    def iterations(self) -> int:
        """Of conjugate gradients to 1e-8, on a part of the grid."""
        return self.cost_estimate.iterations

    @property
    def flops(self) -> int:
        """Operations of this rank in a product: two transforms for each matrix."""
        rows = prod(self.inverse.shape) * self.inverse.block
        return int(20 * self.inverse.each * rows * log2(max(2, rows)))

    @property
    def words(self) -> str:
        """For the view."""
        grid = " x ".join(map(str, self.inverse.shape))
        return f"{self.name} of a grid of {grid}" if self.inverse.kind else self.name
