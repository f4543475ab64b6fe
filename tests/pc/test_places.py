"""What is known of the places of rows: grids, DMs, coordinates, near null spaces."""

from __future__ import annotations

import numpy as np
import pytest
from mpi4py import MPI
from petsc4py import PETSc
from scipy.spatial import Delaunay
from train_solver import context, report, solve, solver

from pctt.mat.order import places_of
from pctt.pc.sparse_train import SparseTrain
from pctt.petsc import own_errors

N = 24


def laplacian(da: PETSc.DMDA) -> PETSc.Mat:
    """The five-point stencil on the grid of a DMDA, with the DM."""
    mat = da.createMat()
    nx, ny = da.getSizes()
    (x0, x1), (y0, y1) = da.getRanges()
    row, column = PETSc.Mat.Stencil(), PETSc.Mat.Stencil()
    for y in range(y0, y1):
        for x in range(x0, x1):
            row.index = (x, y)
            for i, j, value in ((x, y, 4.0), (x - 1, y, -1.0), (x + 1, y, -1.0), (x, y - 1, -1.0), (x, y + 1, -1.0)):
                if 0 <= i < nx and 0 <= j < ny:
                    column.index = (i, j)
                    mat.setValueStencil(row, column, value)
    mat.assemble()
    return mat


def without_dm(mat: PETSc.Mat) -> PETSc.Mat:
    """A copy as ``MatCopy`` and the submatrices of PETSc's preconditioners leave it."""
    copy = PETSc.Mat().createAIJ(mat.getSizes(), csr=mat.getValuesCSR(), comm=mat.comm)
    assert not copy.getDM().handle
    return copy


def plane() -> PETSc.DMDA:
    return PETSc.DMDA().create((N, N), stencil_width=1, comm=PETSc.COMM_WORLD, setup=True)


def coordinates(da: PETSc.DMDA) -> np.ndarray:
    da.setUniformCoordinates(0, 1, 0, 1)
    return da.getCoordinates().array_r.reshape(-1, 2).copy()


@pytest.mark.parallel(1, 2, 3)
@pytest.mark.parametrize("known", ["Mat", "other Mat", "KSP", "attribute", "PCSetCoordinates", "the order of the rows"])
def test_a_grid_is_found_wherever_it_is_known(known):
    """The train of rank 20 is nearly exact in the order of the grid alone."""
    da = plane()
    mat = laplacian(da)
    ksp = solver(mat, rank=20)
    if known != "Mat":
        copy = without_dm(mat)
        ksp.setOperators(mat if known == "other Mat" else copy, copy)
        if known == "KSP":
            ksp.pc.setDM(da)  # as KSPSetDM does
        elif known == "attribute":
            copy.setAttr("coordinates", coordinates(da))
        elif known == "PCSetCoordinates":
            ksp.pc.setCoordinates(coordinates(da))
        elif known == "the order of the rows":
            if MPI.COMM_WORLD.size > 1:
                return  # a DMDA has its own order there
            copy.setAttr("grid", (N, N))
    assert solve(ksp)[0] <= 4
    assert context(ksp).rank == 20


@pytest.mark.parallel(1, 2)
def test_where_nothing_is_known_a_warning_says_so(recwarn, monkeypatch):
    monkeypatch.setattr(SparseTrain, "make", lambda self, A, P: self._refuse("it was refused"))
    ksp = solver(without_dm(laplacian(plane())), rank=2)
    places = places_of(ksp.getOperators()[1])
    assert (places.grid, places.points, places.source) == (None, None, "nothing")
    for _ in range(3):  # it warns once
        ksp.getOperators()[1].scale(2.0)
        ksp.setUp()
    words = [str(one.message) for one in recwarn if "it was refused" in str(one.message)]
    assert len(words) == (MPI.COMM_WORLD.rank == 0)
    assert all("nothing is known of the places of its rows" in line for line in words)


@pytest.mark.parametrize(
    ("order", "words"),
    [
        ("natural", "ordered by their numbers"),
        ("grid", "-a_pc_tt_order grid: .*allowed without are auto, rcm, natural"),
    ],
)
def test_the_order_is_told_or_refused_by_its_name(order, words):
    ksp = solver(without_dm(laplacian(plane())), prefix="a_", rank=20, order=order)
    if order == "grid":
        with pytest.raises(ValueError, match=words), own_errors():
            ksp.setUp()
    else:
        ksp.setUp()
        assert words in report(ksp)


@pytest.mark.parallel(1, 3)
def test_points_from_the_rigid_motions_of_a_body():
    """Up to an affine map they are the points."""
    comm = MPI.COMM_WORLD
    points = np.random.default_rng(comm.rank).random((20, 3)) * [3.0, 2.0, 1.0]
    coordinates = PETSc.Vec().createMPI((60, None), bsize=3, comm=comm)
    coordinates.array[:] = points.ravel()
    mat = PETSc.Mat().createAIJ(((60, None), (60, None)), bsize=3, nnz=3, comm=comm)
    for row in range(*mat.getOwnershipRange()):
        mat[row, row] = 1.0
    mat.assemble()
    mat.setNearNullSpace(PETSc.NullSpace().createRigidBody(coordinates))
    places = places_of(mat)
    assert places.source == "a near null space"
    found, given = (np.concatenate(comm.allgather(x)) for x in (places.points, points))
    affine = np.hstack((found, np.ones((len(found), 1))))
    image = affine @ np.linalg.lstsq(affine, given, rcond=None)[0]
    np.testing.assert_allclose(image, given, atol=1e-9)


def test_a_constant_near_null_space_says_nothing():
    mat = without_dm(laplacian(plane()))
    mat.setNearNullSpace(PETSc.NullSpace().create(constant=False, vectors=[mat.createVecRight()]))
    assert places_of(mat).points is None


@pytest.mark.parallel(1, 2)
def test_the_coordinates_of_an_unstructured_mesh():
    """A vector of a DMPlex with a number at each vertex has the vertices' coordinates."""
    first_rank = MPI.COMM_WORLD.rank == 0
    points = np.random.default_rng(0).random((30, 2)) if first_rank else np.zeros((0, 2))
    cells = Delaunay(points).simplices if first_rank else np.zeros((0, 3))
    mesh = PETSc.DMPlex().createFromCellList(2, cells.astype(PETSc.IntType), points, comm=PETSc.COMM_WORLD)
    mesh.distribute()
    start, end = mesh.getChart()
    first, last = mesh.getDepthStratum(0)
    section = PETSc.Section().create(comm=PETSc.COMM_WORLD)
    section.setChart(start, end)
    for vertex in range(first, last):
        section.setDof(vertex, 1)
    section.setUp()
    take = "setLocalSection" if hasattr(mesh, "setLocalSection") else "setSection"  # the name in petsc4py of 3.18
    getattr(mesh, take)(section)
    mat = mesh.createMat()
    mat.assemble()
    places = places_of(mat)
    assert "the coordinates of a DM" in places.source
    assert places.points.shape == (mat.getLocalSize()[0], 2)


def test_scattered_points_fill_no_grid_and_two_rows_at_one_point_neither():
    mat = without_dm(laplacian(plane()))
    points = np.random.default_rng(0).random((N * N, 2))
    twice = np.stack(np.divmod(np.arange(N * N), N), axis=1).astype(float)
    twice[1] = twice[0]
    for where in (points, twice):
        mat.setAttr("coordinates", where)
        assert places_of(mat).grid is None


@pytest.mark.parallel(1, 2)
def test_points_that_fill_a_grid_in_any_order():
    comm = MPI.COMM_WORLD
    shape = (4, 3, 5)
    rows = np.random.default_rng(0).permutation(60)  # the point of each row
    points = np.array(np.unravel_index(rows, shape)).T * [0.1, 1.0, 7.0] / 3 + 1e5
    mat = PETSc.Mat().createAIJ((60, 60), nnz=1, comm=comm)
    mat.assemble()
    mat.setAttr("coordinates", points[slice(*mat.getOwnershipRange())])
    places = places_of(mat)
    assert places.grid == shape
    assert np.array_equal(rows[places.row_at], np.arange(60))


@pytest.mark.parallel(1, 2)
def test_points_of_a_disc_lie_on_a_grid():
    comm = MPI.COMM_WORLD
    points = np.stack(np.unravel_index(np.arange(400), (20, 20)), axis=1) / 7.0
    disc = points[np.hypot(*(points - points.mean(axis=0)).T) < 1.4]
    line = np.stack((points[:100, 0] ** 2 + points[:100, 1], np.zeros(100)), axis=1)
    for where, known in ((disc, (20, 20)), (disc[::5], None), (line, None)):
        mat = PETSc.Mat().createAIJ((len(where), len(where)), nnz=1, comm=comm)
        mat.assemble()
        mat.setAttr("coordinates", where[slice(*mat.getOwnershipRange())])
        places = places_of(mat)
        assert places.lattice(len(where)) == known
        assert places.grid is None or places.grid == (100, 1)


@pytest.mark.parallel(2)
def test_points_of_another_width_on_one_rank_are_refused():
    """Else the ranks would compare different numbers of axes, and wait for each other."""
    mat = without_dm(laplacian(plane()))
    mat.setAttr("coordinates", np.zeros((mat.getLocalSize()[0], 2 + MPI.COMM_WORLD.rank)))
    with pytest.raises(ValueError, match="have 3 columns, on rank 0 2, on rank 1"):
        places_of(mat)
