"""Classes of stiffness, their figures, and active sets, by dense matrices."""

from types import SimpleNamespace

import numpy as np
import pytest
from mpi4py import MPI
from petsc4py import PETSc

from signorini_cr.multigrid.constrained import ConstrainedMatrix
from signorini_cr.vi.active import ActiveSet
from signorini_cr.vi.stopping import BANDS, Stiffness

pytestmark = pytest.mark.serial
FIXED, BOUNDED = np.array([3, 7], np.int32), np.array([1, 4, 12, 20, 27], np.int32)


def petsc(matrix):
    n = len(matrix)
    indices = np.tile(np.arange(n, dtype=PETSc.IntType), n)
    start = np.arange(0, n * n + 1, n, dtype=PETSc.IntType)
    made = PETSc.Mat().createAIJ((n, n), csr=(start, indices, matrix.ravel()), comm=MPI.COMM_SELF)
    made.assemble()
    return made


def vector(values):
    return PETSc.Vec().createWithArray(values.copy(), comm=MPI.COMM_SELF)


def flows_of(contrast):
    """Conductances between 30 dofs, of the second half `contrast` times as large; two are fixed."""
    rng, n = np.random.default_rng(1), 30
    joined = rng.uniform(size=(n, n)) * (rng.uniform(size=(n, n)) < 0.3)
    joined = np.triu(joined, 1) + np.diag(np.full(n - 1, 0.5), 1)
    joined[n // 2 :] *= contrast
    joined += joined.T
    A = np.diag(joined.sum(axis=1)) - joined
    A[FIXED], A[:, FIXED] = 0.0, 0.0
    A[FIXED, FIXED] = 1e-30
    matrix = petsc(A)
    grid = SimpleNamespace(
        matrix=matrix, dirichlet=FIXED, operator=ConstrainedMatrix(matrix, BOUNDED)
    )
    sums = A.sum(axis=1)
    return rng, A, sums, Stiffness(grid, lambda: sums)


@pytest.mark.parametrize("contrast, number", [(1.0, 1), (1e7, 4), (1e11, 6)])
def test_classes(contrast, number):
    """Two decades each, from the smallest diagonal entry that is free."""
    _, A, _, stiffness = flows_of(contrast)
    free = np.setdiff1d(np.arange(len(A)), FIXED)
    entries = np.diag(A)
    low, high = entries[free].min(), entries[free].max()
    assert stiffness.contrast == pytest.approx(high / low)
    classes = np.floor(np.log(entries / low + 1e-300) / np.log(100.0)).clip(0)
    kinds = stiffness.number // BANDS
    assert kinds == 1 + classes[free].max() and abs(kinds - number) <= 1
    assert np.array_equal(stiffness.bounded, BANDS * classes[BOUNDED])
    values = np.arange(1.0, 1 + len(BOUNDED))
    sums = stiffness.sums(values)
    assert len(sums) == stiffness.number
    for i, found in enumerate(sums):
        assert found == values[BANDS * classes[BOUNDED] == i].sum()
    x = np.random.default_rng(2).normal(size=len(A))
    sizes = (np.abs(A) @ np.abs(x))[BOUNDED]
    which = np.array([True, False, True, True, False])
    for chosen in (None, which):
        kept = sizes if chosen is None else sizes * chosen
        assert np.allclose(stiffness.magnitude(vector(x), chosen), stiffness.sums(kept))


@pytest.mark.parametrize("contrast", [1.0, 1e9])
def test_residual_by_differences(contrast):
    """A x − b, and where there is contrast nothing is lost of what a stiff part gets in all."""
    rng, A, _, stiffness = flows_of(contrast)
    x, b = rng.normal(size=(2, len(A)))
    r = vector(0 * x)
    stiffness.residual(vector(x), vector(b), r)
    assert np.allclose(r.array, A @ x - b, rtol=1e-12, atol=1e-12 * contrast)
    stiffness.residual(vector(np.ones(len(A)) / 3), vector(0 * b), r)
    if contrast > 1.0:
        assert np.abs(r.array[20:]).max() <= np.abs(A[20:].sum(axis=1)).max()


def test_imbalance():
    """The worst class's residual in parts of its flows; that of active and fixed dofs is none."""
    rng, A, sums, stiffness = flows_of(1e9)
    x, b, r = rng.normal(size=(3, len(A)))
    r *= 1e3
    active = np.array([5, 20], np.int32)
    counted = np.setdiff1d(np.arange(len(A)), np.concatenate([FIXED, active]))
    low = np.delete(np.diag(A), FIXED).min()
    classes = np.floor(np.log(np.diag(A) / low + 1e-300) / np.log(100.0)).clip(0)
    flows = (np.abs(A) * np.abs(x[:, None] - x[None])).sum(axis=1) + np.abs(sums * x - b)

    def expected(r):
        found = 0.0
        for i in range(stiffness.number // BANDS):
            own = counted[classes[counted] == i]
            noise = 4 * 2.0**-53 * np.linalg.norm(np.diag(A)[own] * x[own])
            if np.linalg.norm(r[own]) > noise:
                found = max(found, np.linalg.norm(r[own]) / np.linalg.norm(flows[own]))
        return found

    def imbalance(r):
        return stiffness.imbalance(vector(x), vector(b), vector(r), active)

    assert imbalance(r) == pytest.approx(expected(r)) and expected(r) > 1.0
    stiff = np.where(classes > 0, r, 0.0)
    assert imbalance(stiff) == pytest.approx(expected(stiff)) and 0 < expected(stiff) < 1e-3
    left_out = np.zeros(len(A))
    left_out[[*FIXED, *active]] = 1e12
    assert imbalance(left_out) == 0.0
    # below what rounding leaves
    quiet = 1e-17 * np.diag(A) * x
    assert imbalance(quiet) == expected(quiet) == 0.0
    assert flows_of(1.0)[3].imbalance(vector(x), vector(b), vector(r), active) == 0.0


def test_active_sets():
    """On the bound or below it, and held there by a force; what PETSc leaves out is the same."""
    bounded = np.array([2, 5, 6, 9], np.int32)
    gap, force = np.array([0.0, 0.0, 1e-300, -1.0]), np.array([1e-300, 0.0, 1.0, 2.0])
    found = ActiveSet.of(bounded, gap, force)
    assert found.mask.tolist() == [True, False, False, True] and found.dofs.tolist() == [2, 9]
    with pytest.raises(ValueError, match="read-only"):
        found.mask[0] = False
    assert ActiveSet.of(bounded, 0.0, force).dofs.tolist() == [2, 6, 9]
    inactive = np.setdiff1d(np.arange(11), [2, 9]).astype(np.int32)
    same = ActiveSet.without(bounded, inactive + 100, 100)
    assert np.array_equal(same.mask, found.mask) and np.array_equal(same.bounded, bounded)


@pytest.mark.parametrize("active", [[], [0], [10], [2, 3, 9], range(11)])
def test_what_is_not_active(active):
    active = np.array(active, np.int32)
    inactive = np.setdiff1d(np.arange(11), active).astype(np.int32)
    found = ActiveSet.without(np.arange(11, dtype=np.int32), inactive, 0)
    assert np.array_equal(found.dofs, active)
