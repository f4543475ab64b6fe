"""Ranks of Newton matrices, and what any train can do for them:

    run/study ranks unfoldings [N] [-form program,paper]    exact ranks at three bonds, by singular values
    run/study ranks bounds [N] [-form FORM]                 BiCGStab with the best matrix of rank r at one bond,
                                                            inverted exactly, and with the best inverse of rank r
    run/study ranks functions                               error against rank of four functions on a grid, and the
                                                            cores of sin(x + y + z): docs/functions.png

The matrices are those of a settled mixer: N, and S = N + B of an early, a middle and a late Newton step of `pdip` with
block Jacobi, from a cold start and of rigid contacts. The contacts are in Morton order. A bond of a train with boxes of
c contacts separates which pair of boxes an entry belongs to from its place in the pair. The rank of this unfolding is
the least rank of any train at the bond; nothing here depends on how trains are found. Writes results/ranks_WHAT.json.
"""

from __future__ import annotations

import sys
from argparse import Namespace
from collections.abc import Iterator

import petsc4py

petsc4py.init([sys.argv[0]])

import numpy as np
import scipy.sparse as sp
from newton_systems import COMM, FORMS, Replay, System, replays
from petsc4py import PETSc
from shared import ROOT, Row, Table, figure, listed, parser, record, reduce_colours, say_machine

from dem.geometry.morton import morton_codes
from pctt.tt.train import decompose

BONDS = (8, 64, 512)  # contacts in a box
LARGEST = 6000  # pairs of boxes, or places in a pair, of an unfolding whose singular values are found: a minute
EPS = (1e-1, 1e-2)
FEW, BOX, CAP = 1024, 64, 300  # contacts of `bounds`, in a box; iterations, of which block Jacobi takes 50 to 150
OF_MATRIX, OF_INVERSE = (10, 40, 80, 120), (10, 40, 100, 200)  # ranks
POINTS = 32  # of the grid of `functions`, per axis

# -- matrices -------------------------------------------------------------------------------------------------


class Matrices:
    """N and S of one cone problem as sparse arrays (3 nc, 3 nc), contacts in Morton order."""

    def __init__(self, replay: Replay):
        self.systems, problem = replay.systems, replay.problem
        self.order = np.argsort(morton_codes(problem.point), kind="stable")
        self._diagonal = problem.diagonal_blocks[self.order]
        rows = (3 * self.order[:, None] + np.arange(3)).ravel()
        indptr, indices, values = problem.N.convert("aij", PETSc.Mat()).getValuesCSR()
        N = sp.csr_matrix((values, indices, indptr), shape=problem.N.getSize())[rows][:, rows]
        self.coupling = N - block_diagonal(self._diagonal)  # N without its diagonal blocks
        self.coupling.data[np.abs(self.coupling.data) < 1e-12 * np.abs(N.data).max()] = 0.0
        self.coupling.eliminate_zeros()
        self.N = N

    def blocks(self, system: System) -> np.ndarray:
        """The diagonal blocks of S (nc, 3, 3)."""
        return self._diagonal + system.barrier[self.order]

    def S(self, system: System) -> sp.csr_matrix:
        return (self.coupling + block_diagonal(self.blocks(system))).tocsr()

    def scaled(self, system: System) -> sp.csr_matrix:
        """T = L^-1 S L^-T - I, where L L' are the diagonal blocks of S."""
        root = block_diagonal(np.linalg.inv(np.linalg.cholesky(self.blocks(system))))
        return (root @ self.coupling @ root.T).tocsr()

    def change(self, system: System, following: System) -> sp.csr_matrix:
        """S of the next step less S of this one."""
        return block_diagonal(following.barrier[self.order] - system.barrier[self.order])

    def right_side(self, system: System) -> np.ndarray:
        """b, scaled as T is (3 nc,)."""
        root = np.linalg.inv(np.linalg.cholesky(self.blocks(system)))
        return np.einsum("cij,cj->ci", root, system.b.reshape(-1, 3)[self.order]).ravel()


def block_diagonal(blocks: np.ndarray) -> sp.csr_matrix:
    """Of blocks (n, b, b)."""
    count = np.arange(len(blocks) + 1)
    return sp.bsr_matrix((np.ascontiguousarray(blocks), count[:-1], count)).tocsr()


def stages(systems: list[System]) -> dict[str, int]:
    """Indices of an early, a middle and a late system that has a next one."""
    return {"early": 0, "middle": len(systems) // 2, "late": len(systems) - 2}


# -- unfoldings -----------------------------------------------------------------------------------------------


def singular_values(A: sp.spmatrix, box: int) -> np.ndarray:
    """Of the unfolding of A (n, n) at the bond of boxes of ``box`` rows, descending; empty if it is over LARGEST."""
    A = A.tocoo()
    i, j = A.row.astype(np.int64), A.col.astype(np.int64)
    boxes = -(-A.shape[0] // box)
    pairs, row = np.unique(i // box * boxes + j // box, return_inverse=True)
    places, column = np.unique(i % box * box + j % box, return_inverse=True)
    if min(len(pairs), len(places)) > LARGEST:
        return np.empty(0)
    unfolding = sp.csr_matrix((A.data, (row, column)), shape=(len(pairs), len(places)))
    if len(pairs) > len(places):
        unfolding = unfolding.T
    squares = np.linalg.eigvalsh((unfolding @ unfolding.T).toarray())[::-1]  # to 1e-8 of the largest value
    return np.sqrt(np.maximum(squares, 0.0))


def rank_at(values: np.ndarray, eps: float) -> int:
    """The least rank with a relative error of ``eps`` in Frobenius' norm."""
    tails = np.sqrt(np.cumsum(values[::-1] ** 2))[::-1]
    return int((tails > eps * tails[0]).sum())


def captured(values: np.ndarray, rank: int) -> float:
    """The part of the squared norm that the best approximation of this rank has."""
    return float((values[:rank] ** 2).sum() / (values**2).sum())


def matrices(of: Matrices) -> Iterator[tuple[str, str, sp.csr_matrix]]:
    """Names of matrices and of the Newton steps they belong to."""
    yield "N", "", of.N
    yield "N without diagonal blocks", "", of.coupling
    for what in ("scaled S - I", "S", "S_k+1 - S_k"):
        for stage, k in stages(of.systems).items():
            system, following = of.systems[k : k + 2]
            made = {"S": of.S, "scaled S - I": of.scaled}.get(what)
            yield what, f"{stage} {k}", made(system) if made else of.change(system, following)


def unfoldings(given: Namespace) -> list[Row]:
    """A row per matrix: its ranks at each bond, and how much of its squared norm couples contacts."""
    rows: list[Row] = []
    for form in given.form:
        steps = replays(given.n, form=form)
        of = Matrices(next(steps))
        print(f"mixer n = {given.n}, pdip of the {form}: {len(of.order)} contacts, {len(of.systems)} Newton steps")
        print(f"bonds at {', '.join(map(str, BONDS))} contacts: singular values, ranks at {EPS[0]:g} and {EPS[1]:g},")
        print("part of the squared norm that rank 10 has; norm of what couples contacts over that of the matrix")
        table = Table(matrix=("matrix", "<25"), step=("step", "<10"), full=(cell("full"), "16"),
                      at_1e_1=(cell("at 0.1"), "16"), at_1e_2=(cell("at 0.01"), "16"),
                      rank_10=(cell("rank 10", ".2f"), "18"), coupling=("coupling", "9.2g"))  # fmt: skip
        for name, step, A in matrices(of):
            row: Row = {"form": form, "n": given.n, "contacts": len(of.order), "matrix": name, "step": step}
            found = [singular_values(A, 3 * bond) for bond in BONDS]
            row["full"] = [len(values) or None for values in found]
            for eps in EPS:
                row[f"at {eps:g}"] = [rank_at(values, eps) if len(values) else None for values in found]
            row["rank 10"] = [captured(values, 10) if len(values) else None for values in found]
            entries = A.tocoo()
            couples = entries.row // 3 != entries.col // 3
            row["coupling"] = float(np.linalg.norm(entries.data[couples]) / np.linalg.norm(entries.data))
            rows.append(row)
            table.add(row)
        steps.close()
    return rows


def cell(name: str, form: str = "d"):
    """The figures of all bonds in one cell."""
    return lambda row: " / ".join("-" if value is None else f"{value:{form}}" for value in row[name])


# -- bounds ---------------------------------------------------------------------------------------------------


def bounds(given: Namespace) -> list[Row]:
    """A row per Newton step and preconditioner of the first contacts of the curve, scaled by blocks."""
    (form,) = given.form
    steps = replays(given.n, form=form)
    of = Matrices(next(steps))
    n = 3 * FEW
    if len(of.order) < FEW:
        raise SystemExit(f"run/study ranks bounds: N {given.n} has {len(of.order)} contacts, needed are {FEW}")
    print(f"mixer n = {given.n}, {len(of.systems)} Newton steps; {FEW} of {len(of.order)} contacts, bond at {BOX}")
    print(f"BiCGStab to 1e-4 and a true residual of 2e-4, at most {CAP} iterations; '>': not solved")
    table = Table(step=("step", "<10"), preconditioner=("preconditioner", "<24"), rank=("rank", "5"),
                  captured=("captured", "9.4f"), iterations=("said", "10"))  # fmt: skip
    rows: list[Row] = []
    for part, k in zip(("early", "middle", "late"), (np.array([1, 2, 3]) * len(of.systems)) // 4):
        system = of.systems[k]
        T = of.scaled(system)[:n, :n]
        S, b = (sp.identity(n) + (T + T.T) / 2).tocsr(), of.right_side(system)[:n]
        A = S.toarray()
        inverse = np.linalg.inv(A)
        tried = [("block Jacobi", None, 0.0, None)]
        tried += [("inverse of rank r of S", r, share, M) for r, share, M in truncated(A, OF_MATRIX)]
        tried += [("rank r of the inverse", r, share, M) for r, share, M in truncated(inverse, OF_INVERSE)]
        for name, rank, share, M in tried:
            row: Row = {"step": f"{part} {k}", "preconditioner": name, "rank": rank or "", "captured": share}
            if M is not None and name.startswith("inverse"):
                M = np.linalg.inv(M)
            row["iterations"], row["residual"] = bicgstab(S, b, M)
            row["solved"] = row["residual"] < 2e-4
            row["said"] = f"{'' if row['solved'] else '> '}{row['iterations']}"
            rows.append(row)
            table.add(row)
    steps.close()
    return rows


def truncated(A: np.ndarray, ranks: tuple[int, ...]) -> Iterator[tuple[int, float, np.ndarray]]:
    """I and the best approximation of A - I of each rank at the bond, and its part of the squared norm of A - I."""
    n, box = len(A), 3 * BOX
    boxes = n // box
    unfolding = (A - np.eye(n)).reshape(boxes, box, boxes, box).transpose(0, 2, 1, 3).reshape(boxes**2, box**2)
    squares, vectors = np.linalg.eigh(unfolding @ unfolding.T)
    squares, vectors = squares[::-1], vectors[:, ::-1]
    for rank in ranks:
        best = vectors[:, :rank] @ (vectors[:, :rank].T @ unfolding)
        M = best.reshape(boxes, boxes, box, box).transpose(0, 2, 1, 3).reshape(n, n)
        yield rank, float(squares[:rank].sum() / squares.sum()), np.eye(n) + (M + M.T) / 2


def bicgstab(A: sp.csr_matrix, b: np.ndarray, inverse: np.ndarray | None) -> tuple[int, float]:
    """Iterations, from the right, and the relative true residual, with this approximate inverse or without."""
    mats = [PETSc.Mat().createAIJ(A.shape, csr=(A.indptr, A.indices, A.data), comm=COMM)]
    if inverse is not None:
        mats.append(PETSc.Mat().createDense(A.shape, array=np.asfortranarray(inverse), comm=COMM))
    ksp = PETSc.KSP().create(COMM)
    ksp.setOperators(mats[0], mats[-1])
    ksp.setType("bcgs")
    ksp.setPCSide(PETSc.PC.Side.RIGHT)
    ksp.getPC().setType("none" if inverse is None else "mat")
    ksp.setTolerances(rtol=1e-4, max_it=CAP)
    x, right = mats[0].createVecs()
    right.array[:] = b
    ksp.solve(right, x)
    residual = float(np.linalg.norm(b - A @ x.array_r) / np.linalg.norm(b))
    its = int(ksp.getIterationNumber())
    for thing in (ksp, x, right, *mats):
        thing.destroy()
    return its, residual


# -- functions ------------------------------------------------------------------------------------------------


def functions(given: Namespace) -> list[Row]:
    """A row per function: relative errors of the trains of ranks 1 to POINTS of its values on a grid in a cube."""
    x, y, z = np.meshgrid(*[np.linspace(0, 1, POINTS)] * 3, indexing="ij")
    rng = np.random.default_rng(0)
    values = {
        "sin(x + y + z)": np.sin(x + y + z),
        "1 / (0.01 + distance from the corner)": 1 / (0.01 + np.sqrt(x**2 + y**2 + z**2)),
        "1 in a ball, 0 outside": 1.0 * ((x - 0.5) ** 2 + (y - 0.5) ** 2 + (z - 0.5) ** 2 < 0.16),
        "random numbers": rng.standard_normal(x.shape),
    }
    ranks = [1, 2, 3, 4, 6, 8, 12, 16, 24, POINTS]
    table = Table(function=("function", "<38"), **{f"rank_{rank}": (str(rank), "8.0e") for rank in ranks})
    rows: list[Row] = []
    for name, T in values.items():
        row: Row = {"function": name}
        for rank in ranks:
            row[str(rank)] = float(np.linalg.norm(decompose(T, 1e-15, rank).full() - T) / np.linalg.norm(T))
        rows.append(row)
        table.add(row)
    train = decompose(values["sin(x + y + z)"], 1e-12)
    print(f"sin(x + y + z): {train}, of {x.size} numbers")
    picture = ROOT / "docs" / "functions.png"
    with figure(picture, 2) as panels:
        if len(panels):
            errors, cores = panels
            for row in rows:
                errors.loglog(ranks, [max(row[str(rank)], 1e-16) for rank in ranks], "o-", label=row["function"])
            errors.set(xlabel="rank", ylabel="relative error of the train", title=f"functions on {POINTS}^3 points")
            errors.set_xticks(ranks, [str(rank) for rank in ranks], minor=False)
            errors.set_ylim(1e-19, 10)
            errors.legend(fontsize="small", loc="lower left", ncols=2)
            errors.grid(alpha=0.3)
            for k, (core, axis) in enumerate(zip(train.cores, "xyz")):
                curves = core.transpose(1, 0, 2).reshape(POINTS, -1) * np.sqrt(POINTS) ** (k < 2)
                scale = np.abs(curves).max()
                for curve in curves.T:
                    cores.plot(np.linspace(0, 1, POINTS) + 1.15 * k, curve / scale, color=f"C{k}")
                cores.text(1.15 * k + 0.5, 1.12, f"{' x '.join(map(str, core.shape))}", ha="center")
                cores.text(1.15 * k + 0.5, -1.45, f"{axis} from 0 to 1", ha="center")
            cores.set(ylim=(-1.3, 1.3), xticks=[], yticks=[], title="the cores of sin(x + y + z)")
    if len(panels):
        reduce_colours(picture)
    return rows


if __name__ == "__main__":
    words = parser("ranks", __doc__)
    kinds = words.add_subparsers(dest="what", required=True)
    for name, forms in (("unfoldings", [*FORMS]), ("bounds", ["program"])):
        of_kind = kinds.add_parser(name, allow_abbrev=False)
        of_kind.add_argument("n", type=int, nargs="?", default=4, help="size of the mixer (4)")
        of_kind.add_argument("-form", type=listed(known=[*FORMS]), default=forms, help=f"of pdip ({','.join(forms)})")
    kinds.add_parser("functions", allow_abbrev=False)
    given = words.parse_args()
    if given.what == "bounds" and len(given.form) != 1:
        words.error("bounds: -form takes one form")
    about = say_machine()
    do = {"unfoldings": unfoldings, "bounds": bounds, "functions": functions}[given.what]
    record(f"ranks_{given.what}", about, do(given))
