"""Gauss-Seidel sweeps, against PETSc's own, and what goes on between the ranks; Jacobi's."""

import numpy as np
import pytest
from mpi4py import MPI
from petsc4py import PETSc

from signorini_cr import InputError, Polygon, Problem, exact, solve_levels
from signorini_cr.diffusion import Diffusion
from signorini_cr.fem.layout import Layout
from signorini_cr.multigrid.constrained import rows_of
from signorini_cr.multigrid.hierarchy import NestedMesh, conforming
from signorini_cr.multigrid.smoothing import OVER_RELAXATION, GaussSeidel, Jacobi
from signorini_cr.multigrid.transfer import inclusion
from signorini_cr.options import PREFIX
from signorini_cr.vi.level import Level

pytestmark = pytest.mark.ranks

# Corners of five degrees: large entries, many of them positive
FLAT = Polygon([[0, 0], [5, 0], [5, 0.4]], ["contact", "dirichlet", "neumann"])


def system(domain, element):
    level = Level((NestedMesh(Diffusion(Problem(), domain.mesh, element), domain),))
    return level.system, Layout.of_space(level.V)


def random(matrix, seed):
    vector = matrix.createVecRight()
    rng = np.random.default_rng(seed + 10 * MPI.COMM_WORLD.rank)
    vector.array[:] = rng.standard_normal(vector.local_size)
    return vector


def dense(matrix):
    """The whole matrix on every rank, and the rank that owns each row."""
    rows = matrix.getSize()[0]
    first, end = matrix.getOwnershipRange()
    start, columns, values = matrix.getValuesCSR()
    mine = np.zeros((rows, rows))
    mine[np.repeat(np.arange(first, end), np.diff(start)), columns] = values
    owner = np.zeros(rows, dtype=np.int64)
    owner[first:end] = MPI.COMM_WORLD.rank
    comm = MPI.COMM_WORLD
    return comm.allreduce(mine), comm.allreduce(owner)


def test_rows_of_any_rank_in_any_order():
    own, _ = system(exact.S1.mesh(0.2), "CR")
    A, _ = dense(own.A)
    rng = np.random.default_rng(MPI.COMM_WORLD.rank)
    for number in (7, 7 * (MPI.COMM_WORLD.rank % 2)):  # none on some ranks
        numbers = rng.permutation(len(A))[:number]
        start, column, value = rows_of(own.A, numbers)
        rows = np.zeros((number, len(A)))
        rows[np.repeat(np.arange(number), np.diff(start)), column] = value
        assert np.array_equal(rows, A[numbers])


@pytest.mark.parametrize("element", ["CR", "P1", "P1 beside CR", "product"])
@pytest.mark.parametrize("sweeps", [1, 3])
def test_sweeps_are_petscs(element, sweeps):
    domain = exact.S1.mesh(0.1)
    mesh = NestedMesh(Diffusion(Problem(), domain.mesh, "P1" if element == "P1" else "CR"), domain)
    A, dofs = Level((mesh,)).system.A, Layout.of_space(mesh.V)
    if element == "P1 beside CR":
        operator, dofs, _ = conforming(mesh)
        A = operator.matrix
    if element == "product":
        p1 = Layout.of_p1(dofs.mesh)
        A, dofs = A.ptap(inclusion(p1, dofs).matrix()), p1
    smoother = GaussSeidel(A, dofs, sweeps)
    b, start = random(A, 1), random(A, 2)
    for name, way in (
        ("forward", PETSc.Mat.SORType.LOCAL_FORWARD_SWEEP | PETSc.Mat.SORType.ZERO_INITIAL_GUESS),
        ("backward", PETSc.Mat.SORType.LOCAL_BACKWARD_SWEEP),
    ):
        x, theirs = start.copy(), start.copy()
        getattr(smoother, name)(b, x)
        A.SOR(b, theirs, smoother.relaxation, way, its=sweeps)
        scale = theirs.norm()
        theirs.axpy(-1.0, x)
        assert theirs.norm() < 1e-13 * scale


@pytest.mark.parametrize("element", ["CR", "P1"])
@pytest.mark.parametrize("polygon", [exact.S1, FLAT], ids=["square", "flat"])
def test_the_relaxation_leaves_a_cycle_positive_definite(element, polygon):
    """(2/ω − 1) D − O has positive eigenvalues, and ω is not much smaller than need be."""
    own, dofs = system(polygon.mesh(0.1), element)
    relaxation = GaussSeidel(own.A, dofs, 2).relaxation
    A, owner = dense(own.A)
    scale = np.sqrt(A.diagonal())
    between = np.where(owner[:, None] == owner, 0.0, A) / scale / scale[:, None]
    eigenvalues = np.linalg.eigvalsh(between)
    assert 2.0 / relaxation - 1.0 > eigenvalues[-1]
    assert relaxation >= min(OVER_RELAXATION, 0.85 * 2.0 / (1.0 + np.abs(eigenvalues).max()))
    if MPI.COMM_WORLD.size == 1:
        assert relaxation == OVER_RELAXATION


@pytest.mark.parametrize("element", ["CR", "P1"])
@pytest.mark.parametrize("polygon", [exact.S1, FLAT], ids=["square", "flat"])
def test_jacobi_against_dense_matrices(element, polygon):
    """x + D⁻¹ (b − A x) with D ≥ A, row by row of the matrix as NumPy has it."""
    own, dofs = system(polygon.mesh(0.1), element)
    A, owner = dense(own.A)
    D = np.abs(A).sum(axis=1)
    scale = 1.0 / np.sqrt(D)
    assert np.linalg.eigvalsh(scale[:, None] * A * scale)[-1] < 1.0 + 1e-12
    whole, mine = np.random.default_rng(4).standard_normal(len(A)), owner == MPI.COMM_WORLD.rank
    b, x = own.A.createVecs()
    b.array[:], x.array[:] = whole[mine], 7.0
    smoother = Jacobi(own.A, dofs, 2)
    expected = np.zeros(len(A))
    for name in ("forward", "backward"):
        getattr(smoother, name)(b, x)
        for _ in range(2):
            expected += (whole - A @ expected) / D
        assert np.allclose(x.array_r, expected[mine], rtol=0, atol=1e-13)
    smoother.free()


def test_another_smoother_is_an_option_and_the_forces_are_the_same():
    """Jacobi takes about twice the CG steps on each mesh, and ends with the same forces."""
    problem, database = Problem(f=-3.0, obstacle=-0.2), PETSc.Options(PREFIX)
    forces, steps = {}, {}
    for name in ("gauss-seidel", "jacobi", "sor"):
        database["smoother"] = name
        try:
            if name == "sor":
                with pytest.raises(InputError, match="'sor'; allowed are gauss-seidel, jacobi"):
                    next(solve_levels(problem, exact.S1.mesh(0.25), 1))
                break
            run = list(solve_levels(problem, exact.S1.mesh(0.5), 3))
        finally:
            del database["smoother"]
        forces[name] = run[-1].contact.force
        steps[name] = [solution.iterations.linear for solution in run]
        assert "multigrid on 3 meshes" in run[-1].iterations.preconditioner
    assert forces["jacobi"] == pytest.approx(forces["gauss-seidel"], rel=1e-7)
    ratios = np.array(steps["jacobi"]) / steps["gauss-seidel"]
    assert 1.0 < ratios.min() and ratios.max() < 3.0
