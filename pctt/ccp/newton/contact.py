"""The Newton system of the contacts, S = N + C + B (3Nc x 3Nc, block size 3): the paper's Schur complement.

With compiled loops S is a function, S g = G G'g + (C + B) g, and its entries are made only for a preconditioner that
reads them. Else N's structure and values are copied once per cone problem, and a Newton step writes the diagonal blocks
alone. Bodies with very many contacts (a press, a drum) would fill N: they enter its product as a low-rank term U U'
(``MATLRC``), and preconditioners get the sparse part with the full diagonal blocks.
"""

from __future__ import annotations

from petsc4py import PETSc

from pctt.block_diagonal import put_diagonal_blocks, set_diagonal_blocks
from pctt.ccp.cone import Array
from pctt.ccp.problem import ConeProblem
from pctt.shell import symmetric_shell


class ContactForm:
    """The `NewtonForm` S dg = q + G r_v, dv = G' dg - r_v."""

    symmetric = definite = True

    def __init__(self, problem: ConeProblem):
        self.problem = problem
        self._entries: Entries | None = None
        self._low_rank: PETSc.Mat | None = None
        if problem.free_map is not None:
            self.matrix = symmetric_shell(problem.comm, problem.r.size, 3, self._product)
            return
        self._entries = Entries(problem)
        self.matrix = self._entries.mat
        if problem.low_rank is not None:
            self._low_rank = problem.N.duplicate(copy=True)
            self._low_rank.setOption(PETSc.Mat.Option.SYMMETRIC, True)
            self.matrix = _with_low_rank(self._low_rank, problem.low_rank)

    def load(self, problem: ConeProblem) -> None:
        self.problem = problem
        if self._entries is not None:
            self._entries.load(problem)
        if self._low_rank is not None:
            problem.N.copy(self._low_rank, PETSc.Mat.Structure.SAME_NONZERO_PATTERN)
            self.matrix.destroy()
            self.matrix = _with_low_rank(self._low_rank, problem.low_rank)

    def update(self, barrier: Array, inverse: Array | None = None, symmetric: bool = True) -> None:
        """Put the barrier blocks (nc, 3, 3) in."""
        self._barrier = barrier
        self._made = False
        G = self.problem.free_map
        if G is not None:
            self._local = G.pack(barrier + self.problem.compliance_blocks)
            describe(self.matrix, self.problem)
            set_diagonal_blocks(self.matrix, self.problem.diagonal_blocks + barrier)
            self.matrix.stateIncrease()
            return
        self.entries()
        if self._low_rank is not None:
            put_diagonal_blocks(self._low_rank, self.problem.sparse_diagonal_blocks + barrier)
            self.matrix.assemble()

    def _product(self, g: Array, out: Array) -> None:
        G = self.problem.free_map
        assert G is not None
        g, out = g.reshape(-1, 3), out.reshape(-1, 3)
        G.local_product(self._local, g, out)
        G.add_delassus(g, out)

    def entries(self) -> PETSc.Mat:
        """S, or its sparse part, as a matrix that preconditioners can read; collective."""
        if self._entries is None:
            self._entries = Entries(self.problem)
        if not self._made:
            self._entries.update(self._barrier)
            self._made = True
        return self._entries.mat

    def right_hand_side(self, q: Array, r_v: Array | None, uncoupled: Array | None) -> Array:
        return q.ravel() if r_v is None else (q + self.problem.velocity_of(r_v)).ravel()

    def impulses(self, x: Array, q: Array, uncoupled: Array | None) -> Array:
        return x.reshape(-1, 3).copy()

    def destroy(self) -> None:
        self.matrix.destroy()
        if self._entries is not None:
            self._entries.mat.destroy()
        if self._low_rank is not None:
            self._low_rank.destroy()


class Entries:
    """S without its low-rank term, but for the diagonal blocks, as the BAIJ Mat ``mat``."""

    def __init__(self, problem: ConeProblem):
        self.problem = problem
        self.mat = problem.N.duplicate(copy=True)
        self.mat.setOption(PETSc.Mat.Option.SYMMETRIC, True)

    def load(self, problem: ConeProblem) -> None:
        """Take another problem with the same contacts between the same bodies."""
        self.problem = problem
        problem.N.copy(self.mat, PETSc.Mat.Structure.SAME_NONZERO_PATTERN)

    def update(self, barrier: Array) -> None:
        """Put the barrier blocks (nc, 3, 3) in."""
        describe(self.mat, self.problem)
        blocks = self.problem.diagonal_blocks + barrier
        put_diagonal_blocks(self.mat, blocks)
        set_diagonal_blocks(self.mat, blocks)


def _with_low_rank(A: PETSc.Mat, U: PETSc.Mat) -> PETSc.Mat:
    """A + U U'."""
    ones = U.createVecRight()  # petsc4py of 3.22 does not take None
    ones.set(1.0)
    mat = PETSc.Mat().createLRC(A, U, ones, U)
    ones.destroy()
    return mat


def describe(mat: PETSc.Mat, problem: ConeProblem) -> None:
    """What preconditioners may ask for: the places and names of the contacts."""
    for name, value in (("coordinates", problem.point), ("key", problem.key)):
        if value is not None:
            mat.setAttr(name, value)
