"""An elastic block is pressed on a rough floor and sheared: finite elements of scikit-fem, friction by pctt::

    python docs/examples/block.py 15 block.png

The number is that of elements along the height. It needs scikit-fem: pip install 'pctt[examples]'.
"""

from __future__ import annotations

import sys
from typing import NamedTuple

import numpy as np
import scipy.sparse as sp
from mpi4py import MPI
from scipy.sparse.linalg import splu

from pctt import ccp

try:
    from skfem import Basis, ElementHex1, ElementVector, FacetBasis, LinearForm, MeshHex, asm
    from skfem.models.elasticity import lame_parameters, linear_elasticity
except ModuleNotFoundError as error:
    raise SystemExit("block.py needs scikit-fem: pip install 'pctt[examples]', or scikit-fem itself") from error

SIZE = np.array([40.0, 20.0, 30.0])  # of the block along x, y, z [mm]
YOUNG, NU, FRICTION = 10.0, 0.45, 0.4  # modulus [MPa], Poisson's ratio
PRESSED, SHIFTED, STEPS = 0.6, 1.5, 10  # ways of the top, down and then along x [mm], and steps of the second


class State(NamedTuple):
    """After a step.

    way : (3,) of the held nodes [mm]
    u : (3, nodes) displacements [mm]
    force : (nc, 3) of the floor on the contact nodes, along z, x, y [N]
    held : (3,) the force on the held nodes, along x, y, z [N], from the stiffness of all nodes
    result : of the cone problem
    """

    way: np.ndarray
    u: np.ndarray
    force: np.ndarray
    held: np.ndarray
    result: ccp.Result


class Block:
    """Trilinear elements, so many along the height. The nodes of the bottom may touch the floor z = 0.

    held : (3, nodes) which displacements are given: by default those of the top
    area : (nc,) of the floor at each contact [mm^2]
    """

    def __init__(self, high: int, friction: float = FRICTION) -> None:
        counts = np.rint(SIZE / SIZE[2] * high).astype(int)
        self.mesh = MeshHex.init_tensor(*(np.linspace(0, side, n + 1) for side, n in zip(SIZE, counts)))
        self.basis = Basis(self.mesh, ElementVector(ElementHex1()), intorder=2)
        self.K = asm(linear_elasticity(*lame_parameters(YOUNG, NU)), self.basis).tocsr()
        self.floor = np.flatnonzero(self.mesh.p[2] == 0.0)
        self.floor = self.floor[np.lexsort(self.mesh.p[:2, self.floor])]  # along x, then y
        self.held = np.tile(self.mesh.p[2] == SIZE[2], (3, 1))
        bottom = FacetBasis(self.mesh, ElementHex1(), facets=self.mesh.facets_satisfying(lambda x: x[2] == 0.0))
        self.area = asm(LinearForm(lambda v, w: v), bottom)[self.floor]
        self.mu = np.full(len(self.floor), friction)

    def move(self, ways: np.ndarray, tol: float = 1e-8) -> list[State]:
        """The states where the held nodes have moved by each of the ``ways`` (steps, 3) [mm]: K u = forces, with
        Coulomb's law between those of the floor and the displacements in a step."""
        number = self.basis.nodal_dofs  # (3, nodes)
        held, free = number[self.held], number[~self.held]
        rows = number[[2, 0, 1]][:, self.floor].T.ravel()  # normal and tangents of each contact
        G = sp.identity(self.K.shape[0], format="csr")[rows][:, free]
        stiffness = self.K[free][:, free]
        factor, before, guess, states = splu(stiffness.tocsc()), np.zeros((len(self.floor), 3)), None, []
        problem = ccp.ConeProblem(MPI.COMM_SELF, before, self.mu, G=G, masses=stiffness)
        for way in ways:
            u = np.zeros(self.K.shape[0])
            u[held] = np.broadcast_to(way[:, None], number.shape)[self.held]
            u[free] = -factor.solve(self.K[free] @ u)  # without contact
            problem = problem.with_velocities(u[rows].reshape(-1, 3) - before)
            result = ccp.solve(problem, guess, limits=ccp.Limits(tol))
            if not result.converged:
                raise RuntimeError(f"top at {way} mm: {result.reason}")
            guess = result.impulse
            u[free] += factor.solve(G.T @ guess.ravel())
            before = u[rows].reshape(-1, 3) * [0, 1, 1]  # the gap is the whole displacement, slip what is new of it
            reactions = (self.K @ u)[number] * self.held
            states.append(State(way, u[number], guess, reactions.sum(axis=1), result))
        return states

    def stress(self, u: np.ndarray) -> np.ndarray:
        """Von Mises's stress (nodes,) [MPa]: means of the elements around."""
        flat = np.zeros(self.K.shape[0])
        flat[self.basis.nodal_dofs] = u
        slopes = np.asarray(self.basis.interpolate(flat).grad).mean(axis=3)  # (3, 3, elements)
        strain = (slopes + slopes.transpose(1, 0, 2)) / 2
        deviator = strain - np.eye(3)[:, :, None] * np.trace(strain) / 3
        stress = YOUNG / (1 + NU) * np.sqrt(1.5 * (deviator**2).sum(axis=(0, 1)))
        corners = self.mesh.t  # (8, elements)
        return np.bincount(corners.ravel(), np.tile(stress, 8)) / np.bincount(corners.ravel())


def main(high: int, picture: str = "") -> list[State]:
    """Press, shear, print what the floor feels, and draw it."""
    block = Block(high)
    ways = np.zeros((STEPS + 1, 3))
    ways[:, 0], ways[:, 2] = np.linspace(0, SHIFTED, STEPS + 1), -PRESSED
    states = block.move(ways)
    print(f"{len(block.floor)} contacts of {block.mesh.nvertices} nodes, friction {FRICTION}")
    print("shift mm  iterations  normal N  shear N  shear / normal  open  slides  sticks  balance N")
    for state in states:
        force, (opened, slides, sticks) = state.force.sum(axis=0), state.result.counts
        balance = np.abs(state.held + force[[1, 2, 0]]).max()
        print(f"{state.way[0]:8.2f} {state.result.iterations:11} {force[0]:9.3f} {-force[1]:8.3f} "
              f"{-force[1] / force[0]:15.4f} {opened:5} {slides:7} {sticks:7} {balance:10.1e}")  # fmt: skip
    if picture:
        draw(block, states, picture)
    return states


def draw(block: Block, states: list[State], picture: str) -> None:
    """The face y = 0 and the floor, at the beginning, in between and at the end; pressures, and force over shift."""
    import matplotlib.pyplot as plt
    from matplotlib.colors import ListedColormap

    figure, axes = plt.subplots(2, 4, figsize=(12, 5.2), layout="constrained", width_ratios=[1, 1, 1, 1.1])
    chosen = [states[0], states[round(0.6 * STEPS)], states[-1]]
    x, colours = block.mesh.p, ListedColormap(["white", "sandybrown", "skyblue"])
    along, across = np.unique(x[0]), np.unique(x[1])
    grid, face = (len(across), len(along)), np.flatnonzero(x[1] == 0)
    face = face[np.lexsort(x[[0, 2]][:, face])].reshape(-1, len(along))
    top = max(np.quantile(block.stress(state.u)[face], 0.98) for state in chosen)
    for (side, floor), state in zip(axes.T, chosen):
        moved, name = x + state.u, f"shift {state.way[0]:.1f} mm"
        levels = np.linspace(0, top, 13)
        stress = side.contourf(*moved[[0, 2]][:, face], block.stress(state.u)[face], levels, extend="max")
        side.axhline(0, color="black")
        side.set(xlim=(-3, 45), ylim=(-3, 32), aspect="equal", xlabel="x [mm]", ylabel="z [mm]", title=name)
        zones = floor.pcolormesh(along, across, state.result.states.reshape(grid), cmap=colours, vmin=-0.5, vmax=2.5)
        floor.quiver(*x[:2, block.floor], *(state.force[:, 1:].T / block.area), width=0.004)
        floor.set(xlim=(-3, 45), aspect="equal", xlabel="x [mm]", ylabel="y [mm]", title="friction on the block")
        pressure, area = (each.reshape(grid).sum(axis=0) for each in (state.force[:, 0], block.area))
        axes[0, 3].plot(along, pressure / area, ".-", label=name)
    figure.colorbar(stress, ax=axes[0, :3], label="von Mises stress [MPa]", format="%.2f", ticks=levels[::3])
    figure.colorbar(zones, ax=axes[1, :3], ticks=[0, 1, 2]).ax.set_yticklabels(["open", "slides", "sticks"])
    axes[0, 3].set(xlabel="x [mm]", ylabel="pressure [MPa]", title="on the floor, means over y")
    forces = np.array([state.force.sum(axis=0) for state in states])
    shifts = [state.way[0] for state in states]
    axes[1, 3].plot(shifts, -forces[:, 1] / forces[:, 0], "o-", label="shear / normal force")
    axes[1, 3].axhline(FRICTION, color="black", linestyle="--", label="friction coefficient")
    axes[1, 3].set(xlabel="shift of the top [mm]", title="force on the top")
    for axis in axes[:, 3]:
        axis.legend(fontsize=9)
    figure.savefig(picture, dpi=90)


if __name__ == "__main__":
    main(int(sys.argv[1]), *sys.argv[2:])
