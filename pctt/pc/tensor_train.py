"""``-pc_type python -pc_python_type pctt.pc.TensorTrain``: a tensor train as approximate inverse.

The blocks of the matrix are ordered along a space-filling curve, scaled by the Cholesky factors of the diagonal
blocks, their off-diagonal part is compressed into a quantized tensor train T (paper, section 3), and I + T is inverted
as a train. At rank 1 there is no train: the scaled diagonal alone, which is block Jacobi. By default the rank is the
one that has paid in measured seconds per digit (``rank_policy.py``).
"""

from __future__ import annotations

import time
import warnings
from dataclasses import dataclass, field

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from pctt.options import AT_LEAST_ONE, COUNT, FRACTION, OptionError, option
from pctt.pc.approximate_inverse import ApproximateInverse, approximate_inverse
from pctt.pc.base import PythonPC
from pctt.pc.block_diagonal import block_diagonal
from pctt.pc.mat import check_coordinates, is_symmetric
from pctt.pc.patience import Patience
from pctt.pc.rank_policy import RankPolicy
from pctt.pc.second_solve import solve_again
from pctt.pc.slots import Slots, capacity
from pctt.pc.slotted import SlottedMatrix
from pctt.tt.als import Compression, compress
from pctt.tt.apply import Apply
from pctt.tt.cross import Cross, compress_cross
from pctt.tt.quantise import check_modes, choose_modes
from pctt.tt.sparse import SparseHierarchy
from pctt.tt.train import Train

NOT_SYMMETRIC = "the matrix is not symmetric, and a train for its inverse may not be of use"
LOWER = 3  # the cap divided by this is the rank that is tried where the cap fails or does not pay


@dataclass(frozen=True)
class Options:
    """Options ``-pc_tt_*``, behind the prefix of the PC."""

    eps: float = option(1e-2, "relative Frobenius error at which a compression ends", check=FRACTION)
    max_rank: int = option(10, "cap of the ranks of matrix and inverse", check=AT_LEAST_ONE)
    rank: str = option("auto", "auto: the rank that pays, 1 included; fixed: max_rank", choices=("auto", "fixed"))
    compress: str = option(
        "als", "als: alternating least squares over the nonzeros; cross: AMEn cross (the paper)",
        choices=("als", "cross"),
    )
    scaling: str = option(
        "block", "block: by Cholesky factors of the diagonal blocks; none: the matrix as it is (the paper)",
        choices=("block", "none"),
    )
    leaf: int = option(16, "least number of blocks in the first and last mode", check=AT_LEAST_ONE)
    modes: str = option("", "modes of the blocks with commas between; none: chosen for little padding")
    precision: str = option("double", "of the application; single is watched", choices=("double", "single"))
    reuse: str = option(
        "steps",
        "newton: cores, index sets and block pairs of the last matrix of the same structure; steps: also its slots and "
        "cores for the next structure; none: everything anew",
        choices=("none", "newton", "steps"),
    )
    keep: bool = option(
        True, "keep a train, with the new matrix's scaling, while new trains are hardly better; not with reuse none"
    )
    seed: int = option(0, "seed of the random starts", check=COUNT)
    monitor: bool = option(False, "print a line per set-up")


@dataclass
class Account:
    """What the preconditioner did so far, for ``-ksp_view`` and the run's summary."""

    setups: int = 0
    reused: int = 0
    kept: int = 0
    resets: int = 0
    setup_s: float = 0.0
    fallbacks: list[str] = field(default_factory=list)


class TensorTrain(PythonPC):
    """The python PC; see the module and ``Options``. Works on symmetric positive definite Mats of any block size."""

    options_class = Options
    options_prefix = "pc_tt_"
    options: Options

    def create(self, pc: PETSc.PC) -> None:
        super().create(pc)
        self.account = Account()
        self.policy: RankPolicy | None = None
        self.rank = 1
        self.symmetric = True
        self._double = False  # single precision was found wanting
        self._jacobi: PETSc.PC | None = None
        self._diagonal: PETSc.Mat | None = None  # what block Jacobi is made from
        self.tree: Slots | None = None
        self._forget_structure()
        self._forget_trains()

    def _forget_structure(self) -> None:
        self.slots: SlottedMatrix | None = None
        self.hierarchy: SparseHierarchy | None = None

    def _forget_trains(self) -> None:
        self.tree = None
        self.compression: Compression | Cross | None = None
        self.inverse: ApproximateInverse | None = None
        self._opening: ApproximateInverse | None = None  # the inverse for the first matrix of a structure
        self._patience = Patience()
        self._apply: Apply | None = None

    # -- set-up ---------------------------------------------------------------------------------------------

    def build(self, pc: PETSc.PC, P: PETSc.Mat) -> None:
        """ValueError, on all ranks alike, for coordinates or modes that do not fit the matrix."""
        self.comm = P.comm.tompi4py()
        check_coordinates(P)
        self._check_modes(self.comm.allreduce(capacity(P, self.options.leaf)))
        self.symmetric = is_symmetric(P)
        if not self.symmetric and self.comm.rank == 0:
            warnings.warn(f"{self.name}: {NOT_SYMMETRIC}", stacklevel=2)
        self._forget_structure()
        if self.options.reuse != "steps":
            self._forget_trains()
        if self.policy is None:
            cap = self.options.max_rank
            self.policy = RankPolicy((max(1, cap // LOWER), cap), self.options.rank == "auto")
        else:
            self.policy.forgive()  # what failed on another matrix may do here
        self.release()
        self._jacobi = PETSc.PC().create(P.comm)
        self._jacobi.setType(PETSc.PC.Type.PBJACOBI)

    def update(self, pc: PETSc.PC, P: PETSc.Mat) -> None:
        """A preconditioner of the rank that the policy chooses; one that fails is replaced by block Jacobi."""
        assert self.policy is not None
        start = time.perf_counter()
        # the rank of all: figures that differ in a last bit must not part the ways of the processes
        self.rank = self.comm.bcast(self.policy.choose())
        if self.rank > 1 and not self._make_train(P, self.rank):
            self.policy.report(self.rank, self._slowest(time.perf_counter() - start), 0.0, sound=False)
            self.rank = 1
        if self.rank == 1:
            self._make_block_jacobi(P)
        self._setup_seconds = self._slowest(time.perf_counter() - start)
        self.account.setups += 1
        self.account.setup_s += self._setup_seconds
        if self.options.monitor:
            PETSc.Sys.Print(f"  {self.name}: {self._line()}", comm=P.comm)

    def _make_block_jacobi(self, P: PETSc.Mat) -> None:
        assert self._jacobi is not None
        old, self._diagonal = self._diagonal, block_diagonal(P)
        self._jacobi.setOperators(self._diagonal)
        self._jacobi.setUp()
        if old is not None:
            old.destroy()

    def _make_train(self, P: PETSc.Mat, rank: int) -> bool:
        """Keep the train or make one; False, with the reason on the account, if there is no positive inverse."""
        if self.options.reuse == "none":
            self._forget_structure()
            self._forget_trains()
        first = self.slots is None
        if first:
            self._take_slots(P)
        assert self.slots is not None
        try:
            self.slots.scale(P)
            singular = False
        except np.linalg.LinAlgError:
            singular = True
        if self.comm.allreduce(singular, op=MPI.LOR):
            return self._refuse("a diagonal block is not positive definite")
        if self.inverse is not None and self.inverse.cap != rank:
            self.compression = self.inverse = self._opening = None
        kept = (self._opening if first else self.inverse) if self.options.keep else None
        if kept is not None and not self._patience.over():
            self._use(kept)
            self.account.kept += 1
        elif not self._try_new(P, rank, kept):
            return False
        if first:
            self._opening = self.inverse
        return True

    def _try_new(self, P: PETSc.Mat, rank: int, kept: ApproximateInverse | None) -> bool:
        """Make a train for P and use it, or the kept one where that is as good; False without a positive one."""
        assert self.slots is not None
        if self.hierarchy is None:
            with PETSc.Log.Event("TTBuild"):
                self._list_block_pairs(P)
        assert self.hierarchy is not None
        self.hierarchy.set_values(self.slots.load(P))
        warm = self.compression is not None
        with PETSc.Log.Event("TTCompress"):
            self.compression = self._compress(rank, warm)
        with PETSc.Log.Event("TTInvert"):
            # every rank inverts the same train; a last bit of difference must not part their ways
            new, positive = self.comm.bcast(self._invert(rank, warm))
        self.account.reused += warm
        if kept is None:
            if not positive:
                return self._refuse(f"the inverse of rank {rank} is not positive")
            self._patience = Patience()
            self._use(new)
            return True
        left = []
        for inverse in (kept, new):
            self._use(inverse)
            left.append(self._left(P) if positive or inverse is kept else np.inf)
        if not self._patience.decide(*self.comm.bcast(left)):
            self._use(kept)
            self.account.kept += 1
        return True

    def _use(self, inverse: ApproximateInverse) -> None:
        self.inverse = inverse
        self._prepare_apply(inverse.train)

    def _left(self, P: PETSc.Mat) -> float:
        """||w - S X w|| / ||w|| of a random vector w, S the scaled matrix."""
        assert self.slots is not None
        slots = self.slots
        w = np.zeros((slots.capacity, slots.block))
        w[slots.place] = np.random.default_rng(self.options.seed).standard_normal((len(slots.place), slots.block))
        x, y = P.createVecs()
        x.array_w[:] = self._from_slots(self._inverse_times(w.ravel()))
        P.mult(x, y)
        left = w.ravel() - self._to_slots(y.array_r)
        squares = self.comm.allreduce(np.array([left @ left, w.ravel() @ w.ravel()]))
        x.destroy()
        y.destroy()
        return float(np.sqrt(squares[0] / squares[1]))

    def _take_slots(self, P: PETSc.Mat) -> None:
        """The slots of P's block rows, those of the last structure where they fit."""
        if self.tree is not None and not self.tree.follow(P, self._agree):
            self.account.resets += 1
            self._forget_trains()
        if self.tree is None:
            self.tree = Slots(P, self.options.leaf)
        self.slots = SlottedMatrix(P, self.tree, self.comm, self.options.scaling == "block")

    def _list_block_pairs(self, P: PETSc.Mat) -> None:
        assert self.slots is not None
        self.slots.list_blocks(P)
        slots = self.slots
        modes = self._modes(slots.size)
        self.hierarchy = SparseHierarchy(slots.rows, slots.columns, modes, slots.block, self._add, self.comm.bcast)

    def _agree(self, here: bool) -> bool:
        return bool(self.comm.allreduce(here, op=MPI.LAND))

    def _compress(self, rank: int, warm: bool) -> Compression | Cross:
        assert self.hierarchy is not None
        options, rng = self.options, np.random.default_rng(self.options.seed)
        if options.compress == "cross":
            start = self.compression if warm and isinstance(self.compression, Cross) else None
            return compress_cross(self.hierarchy, rank, options.eps, start, rng=rng)
        train = self.compression.train if warm and self.compression is not None else None
        return compress(self.hierarchy, rank, options.eps, train, rng=rng)

    def _invert(self, rank: int, warm: bool) -> tuple[ApproximateInverse, bool]:
        """The inverse and whether no direction was found in which it is negative."""
        assert self.compression is not None
        options, rng = self.options, np.random.default_rng(self.options.seed)
        start = self.inverse.train if warm and self.inverse is not None else None
        return approximate_inverse(self.compression, rank, options.eps, options.scaling == "block", start, rng)

    def _modes(self, slots: int) -> tuple[int, ...]:
        return self._check_modes(slots) or choose_modes(slots, self.options.leaf)

    def _check_modes(self, slots: int) -> tuple[int, ...]:
        """The modes that the user gave, none if none; OptionError if they are no numbers or too few."""
        text = self.options.modes
        if not text:
            return ()
        try:
            return check_modes([int(word) for word in text.split(",")], slots)
        except ValueError:
            raise OptionError(
                f"-{self.prefix}pc_tt_modes {text}: allowed are whole numbers >= 1 with commas between, whose product "
                f"is at least {slots}"
            ) from None

    def _prepare_apply(self, train: Train) -> None:
        assert self.slots is not None
        slots = self.slots
        if self._apply is None:
            bs = slots.block
            rows = (slots.first * bs, (slots.first + slots.capacity) * bs)
            dtype = np.float32 if self.options.precision == "single" and not self._double else np.float64
            self._apply = Apply(train, slots.size * bs, rows, dtype)
            self._local = np.empty((slots.capacity, bs))
            self._scaled = np.empty((slots.capacity, bs, 1))
            self._whole = np.empty(slots.size * bs)
        else:
            self._apply.set_train(train)

    def _refuse(self, why: str) -> bool:
        self.account.fallbacks.append(why)
        self.compression = self.inverse = None
        return False

    def _add(self, x: np.ndarray) -> np.ndarray:
        if self.comm.size > 1:
            out = np.empty_like(x)
            self.comm.Allreduce(np.ascontiguousarray(x), out)
            return out
        return x

    # -- application ----------------------------------------------------------------------------------------

    def apply(self, pc: PETSc.PC, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """y = M x with M block Jacobi or L^-T X L^-1, X the train of the inverse."""
        if self.rank == 1:
            assert self._jacobi is not None
            self._jacobi.apply(x, y)
            return
        assert self.slots is not None
        assert self._apply is not None
        with PETSc.Log.Event("TTApply"):
            y.array_w[:] = self._from_slots(self._inverse_times(self._to_slots(x.array_r)))

    def _to_slots(self, x: np.ndarray) -> np.ndarray:
        """L^-1 x in slot order, (capacity bs,), in a buffer that the next call reuses."""
        assert self.slots is not None
        slots = self.slots
        if slots.capacity > len(slots.place):
            self._local[:] = 0.0
        self._local[slots.place] = x.reshape(-1, slots.block)
        np.matmul(slots.root, self._local[:, :, None], out=self._scaled)
        return self._scaled.ravel()

    def _from_slots(self, z: np.ndarray) -> np.ndarray:
        """L^-T z in the order of the block rows."""
        assert self.slots is not None
        slots = self.slots
        np.matmul(slots.root.transpose(0, 2, 1), z.reshape(self._scaled.shape), out=self._scaled)
        return self._scaled[slots.place].ravel()

    def _inverse_times(self, x: np.ndarray) -> np.ndarray:
        """This rank's part of X x in slot order, from its part of x."""
        assert self.inverse is not None
        product = self._times(self._apply, x)
        return x + product if self.inverse.identity else product

    def _times(self, apply: Apply | None, x: np.ndarray) -> np.ndarray:
        assert self.slots is not None
        assert apply is not None
        self.slots.gather_slots(x, self._whole)
        apply.x[: apply.n] = self._whole
        return apply.product()

    # -- watching the solves --------------------------------------------------------------------------------

    def preSolve(self, pc: PETSc.PC, ksp: PETSc.KSP, b: PETSc.Vec, x: PETSc.Vec) -> None:
        self._solve_start = time.perf_counter()

    def postSolve(self, pc: PETSc.PC, ksp: PETSc.KSP, b: PETSc.Vec, x: PETSc.Vec) -> None:
        """Tell the policy what the solve took and reached; ban a rank with which the method stalled."""
        assert self.policy is not None
        reason, rank = ksp.getConvergedReason(), self.rank
        spoilt = rank > 1 and solve_again(ksp, self.P, b, x)
        if spoilt:  # nor is another solve with this matrix to meet it
            self.rank = 1
            self._make_block_jacobi(self.P)
            what = f"{ksp.getType()} broke down ({reason}) at rank {rank}"
            self.account.fallbacks.append(f"{what}, solved again with block Jacobi")
        seconds = self._slowest(time.perf_counter() - self._solve_start)
        reference = b.norm()
        if reference == 0 or ksp.getIterationNumber() == 0:
            return
        residual = b.duplicate()
        pc.getOperators()[0].mult(x, residual)
        residual.aypx(-1.0, b)
        true = self.comm.bcast(residual.norm() / reference)
        residual.destroy()
        rtol = ksp.getTolerances()[0]
        stalled = ksp.getConvergedReason() < 0 and ksp.getType() not in ("preonly", "richardson")
        drifted = not stalled and true > 10 * rtol and self.options.precision == "single" and not self._double
        if drifted and self.rank > 1 and self.inverse is not None:
            self._double, self._apply = True, None
            self._prepare_apply(self.inverse.train)
            self.account.fallbacks.append(f"single precision left a true residual of {true:.1e}: double from now on")
        digits = -np.log10(max(true, 1e-16)) if np.isfinite(true) else 0.0
        if stalled and rank > 1 and not spoilt:
            self.account.fallbacks.append(f"{ksp.getType()} stalled at rank {rank}")
        sound = not (spoilt or stalled)
        if not sound and self._patience.served:  # a train of an earlier matrix: one made for the next may do
            self._patience.lose()
            sound = True
        self.policy.report(rank, self._setup_seconds + seconds, max(digits, 0.0), sound)
        self._setup_seconds = 0.0  # a second solve with the same matrix has no set-up

    def _slowest(self, seconds: float) -> float:
        return self.comm.allreduce(seconds, op=MPI.MAX)

    # -- words ----------------------------------------------------------------------------------------------

    def report(self) -> list[str]:
        a = self.account
        lines = [
            f"tensor train: {self._line()}",
            f"set-ups {a.setups} ({a.setup_s:.3g} s), warm starts {a.reused}, kept {a.kept} times, "
            f"trees made anew {a.resets}",
            f"scaling {self.options.scaling}, precision {'double' if self._double else self.options.precision}",
        ]
        lines += [] if self.symmetric else [NOT_SYMMETRIC]
        lines += [f"fell back: {why} ({a.fallbacks.count(why)} times)" for why in dict.fromkeys(a.fallbacks)]
        if self.policy is not None:
            figures = self.policy.figures.items()
            costs = ", ".join(f"rank {r}: {f.cost:.2e} s ({f.uses} uses)" for r, f in figures if f.uses)
            lines.append(f"seconds per digit: {costs or 'none measured yet'}")
        return lines

    def _line(self) -> str:
        if self.rank == 1 or self.inverse is None:
            return f"rank 1 (block Jacobi), set up in {self._setup_seconds:.2e} s"
        compression, X = self.inverse.of, self.inverse.train
        T = compression.train
        form = "I + Z" if self.inverse.identity else "X"
        return (
            f"modes {'x'.join(map(str, T.rows))}, matrix ranks {T.ranks} error {compression.error:.2g}, inverse "
            f"{form} ranks {X.ranks} residual {self.inverse.residual:.2g}, {X.storage} numbers, "
            f"{self._setup_seconds:.2e} s"
        )

    def release(self) -> None:
        for thing in (self._jacobi, self._diagonal):
            if thing is not None:
                thing.destroy()
        self._jacobi = self._diagonal = None
