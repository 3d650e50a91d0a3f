"""Choice for the bottom of the cycle, and figures of its grids, by dense matrices."""

from types import SimpleNamespace

import numpy as np
import pytest
from mpi4py import MPI
from petsc4py import PETSc

from signorini_cr.multigrid import bottom
from signorini_cr.multigrid.bottom import Bottom
from signorini_cr.multigrid.constrained import ConstrainedMatrix
from signorini_cr.multigrid.cycle import Grid, Multigrid
from signorini_cr.options import AMG

pytestmark = pytest.mark.serial
HAS_HYPRE = PETSc.PC.Type.HYPRE == AMG


def banded(n, above, positive=0.0):
    """Ones on the diagonal, `above` beside it; in one row there is another entry."""
    matrix = PETSc.Mat().createAIJ((n, n), nnz=6, comm=MPI.COMM_SELF)
    for i in range(n):
        matrix.setValue(i, i, 1.0)
        for j in (i - 1, i + 1):
            if 0 <= j < n:
                matrix.setValue(i, j, above)
    matrix.setValue(5, 9, positive)
    matrix.setValue(5, 12, positive)
    matrix.assemble()
    return matrix


@pytest.mark.skipif(not HAS_HYPRE, reason="GAMG is for all matrices or none")
@pytest.mark.parametrize("positive, suits", [(0.0, True), (0.124, True), (0.126, False)])
def test_positive_entries_do_harm(positive, suits):
    """Up to a quarter of the diagonal in a row; what is negative does not make up for it."""
    matrix = banded(20, -0.4, positive)
    assert bottom._suits_amg(matrix) == suits
    matrix.scale(7.0)
    assert bottom._suits_amg(matrix) == suits


@pytest.mark.skipif(not HAS_HYPRE or not bottom.HAS_MUMPS, reason="both are to choose from")
def test_what_solves(monkeypatch):
    """Small ones are factorised; large ones only alone, where AMG has no use, and if they fit."""
    good, bad = banded(20, -0.4), banded(20, -0.4, 0.3)
    amg, direct = PETSc.PC.Type.HYPRE, PETSc.PC.Type.CHOLESKY

    def choice(matrix, alone):
        return bottom._choice(matrix, 2, alone)["pc_type"]

    monkeypatch.setattr(bottom, "DIRECT", 20)
    assert choice(good, False) == choice(bad, True) == direct
    monkeypatch.setattr(bottom, "DIRECT", 19)
    assert [choice(good, False), choice(bad, False)] == [amg, amg]
    assert [choice(good, True), choice(bad, True)] == [amg, direct]
    assert bottom._choice(bad, 2, True) is bottom.LARGE_FACTORS
    monkeypatch.setitem(bottom.FACTORISED, 2, 20)
    assert choice(bad, True) == direct
    monkeypatch.setitem(bottom.FACTORISED, 2, 19)
    assert choice(bad, True) == amg


def test_a_bottom_follows_its_matrix():
    """Set up anew where other dofs are constrained, and only there."""
    matrix = banded(20, -0.4)
    solver, b, x = Bottom(matrix, 2), *matrix.createVecs()
    b.array[:] = np.arange(20.0)
    solver.constrain(np.array([3], np.int32))
    solver.solve(b, x)
    first = np.linalg.solve(matrix[:, :], b.array)
    assert np.allclose(x.array, first)
    matrix.scale(2.0)
    solver.constrain(np.array([3], np.int32))
    solver.solve(b, x)
    assert np.allclose(x.array, first)
    solver.constrain(np.array([4], np.int32))
    solver.solve(b, x)
    assert np.allclose(x.array, first / 2)
    assert solver.describe(", so") == "a direct solver, so"
    solver.free()


def grid(dirichlet=(0, 19), scale=1.0):
    """A space that stands alone."""
    matrix = banded(20, -0.4)
    matrix.scale(scale)
    operator = ConstrainedMatrix(matrix, np.array([4, 8, 11], np.int32))
    dofs = SimpleNamespace(cells=np.zeros((0, 3), np.int32))
    return Grid.at_bottom(operator, dofs, np.array(dirichlet, np.int32))


def test_rounding_of_a_grid():
    """‖diag(A) x‖ but for what is held."""
    space = grid(scale=3.0)
    x = space.matrix.createVecRight()
    x.array[:] = np.random.default_rng(3).normal(size=x.local_size)
    constrained = np.array([4, 11], np.int32)
    terms = np.delete(3.0 * x.array, [0, 19, 4, 11])
    assert space.rounding(x, constrained) == pytest.approx(np.linalg.norm(terms))


def test_what_a_grid_holds():
    """Dofs on Γ0 always, those that have a bound within a block."""
    space = grid()
    whole = space.matrix[:, :]
    with space.constrained(np.array([8, 9, 4], np.int32)) as constrained:
        assert constrained.tolist() == [4, 8] and sorted(space.left_out) == [0, 4, 8, 19]
        expected = whole.copy()
        expected[[4, 8]] = expected[:, [4, 8]] = 0.0
        expected[[4, 8], [4, 8]] = 1.0
        assert np.array_equal(space.matrix[:, :], expected)
    assert np.array_equal(space.matrix[:, :], whole) and space.left_out.tolist() == [0, 19]


def test_blocks_are_not_nested():
    """The inner one would put back what the outer one leaves out."""
    space = grid()
    whole = space.matrix[:, :]
    with space.constrained(np.array([4, 8], np.int32)):
        within = space.matrix[:, :]
        with pytest.raises(AssertionError, match="inside another"):
            with space.constrained(np.array([8, 11], np.int32)):
                pass
        assert np.array_equal(space.matrix[:, :], within)
    assert np.array_equal(space.matrix[:, :], whole)


def test_when_a_chain_is_given_up(monkeypatch):
    """Where there is something else to try, and once."""
    cycle = Multigrid([grid()])
    assert not cycle.may_give_up and cycle.describe() == "a direct solver"
    monkeypatch.setattr(bottom, "DIRECT", 19)
    cycle = Multigrid([grid()])
    assert cycle.may_give_up
    before = cycle.finest
    cycle.give_up()
    b, x = cycle.matrix.createVecs()
    b.array[:] = np.arange(20.0)
    b.array[8] = 0.0
    with cycle.constrained(np.array([8], np.int32)):
        cycle.apply(None, b, x)
        if HAS_HYPRE:
            assert "multigrid took too many CG steps" in cycle.describe()
    assert cycle.given_up and not cycle.may_give_up and cycle.finest is not before
    assert cycle.operator is before.operator
    inherited = Multigrid([grid()], given_up=True)
    assert not inherited.may_give_up and inherited.describe().endswith("on a coarser mesh")
    cycle.free()
