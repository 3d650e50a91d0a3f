"""Smoothers: Gauss-Seidel sweeps, local to each rank, or Jacobi's.

In Gauss-Seidel a rank sweeps over its own rows, with its neighbours' values of the sweep before, as
in every parallel algebraic multigrid. PETSc's matrices offer that, too, but copy the right-hand
side for each sweep; only few rows have entries of other ranks, and they alone are corrected here.
Jacobi's method takes twice the steps, and the same ones on any number of ranks.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from ..arrays import IndexArray, Int32Array
from ..fem.layout import Layout
from ..garbage import release
from ..options import read_word
from .constrained import numbers_of, rows_of

OVER_RELAXATION = 1.3
"""ω where nothing is against it."""

POWER_STEPS = 4
"""Steps of the power method towards a bound for the entries between ranks."""

_FORWARD = PETSc.Mat.SORType.LOCAL_FORWARD_SWEEP
_BACKWARD = PETSc.Mat.SORType.LOCAL_BACKWARD_SWEEP
_FROM_ZERO = PETSc.Mat.SORType.ZERO_INITIAL_GUESS


class Smoother(Protocol):
    """Sweeps for A x = b before and, transposed, after the coarse correction."""

    def __init__(self, matrix: PETSc.Mat, dofs: Layout, sweeps: int):
        """Prepare the sweeps; rows and columns of the matrix may be constrained later; collective.

        Args:
            matrix: A, symmetric positive definite.
            dofs: Its rows.
            sweeps: Number of sweeps of each call.
        """

    def constrain(self, dofs: Int32Array) -> None:
        """Note the owned dofs whose rows and columns are the identity's now, and x = 0 there."""

    def forward(self, b: PETSc.Vec, x: PETSc.Vec) -> None:
        """Sweep before the correction, from x = 0."""

    def backward(self, b: PETSc.Vec, x: PETSc.Vec) -> None:
        """Sweep after the correction, from x, for the same b as before."""

    def free(self) -> None:
        """Free everything but the matrix."""


class GaussSeidel:
    """Forward sweeps for A x = b and backward sweeps, which are their transpose.

    With D the diagonal of A and O its entries between ranks, a cycle with such sweeps before and
    after the coarse correction is positive definite where (2/ω − 1) D − O is. On one rank O = 0,
    and any ω < 2 will do; on several the spectral radius of D⁻¹O tells how large ω may be.

    Attributes:
        relaxation: ω.
    """

    def __init__(self, matrix: PETSc.Mat, dofs: Layout, sweeps: int):
        """Prepare the sweeps, as any `Smoother`; collective."""
        self._matrix, self._sweeps = matrix, sweeps
        self.relaxation = OVER_RELAXATION
        self._alone = matrix.getComm().getSize() == 1
        if self._alone:
            return
        self._rows, self._between, radius = _entries_between_ranks(matrix, dofs)
        self.relaxation = min(OVER_RELAXATION, 0.99 * 2.0 / (1.0 + radius))
        self._constrained: IndexArray = np.empty(0, dtype=np.intp)
        self._share = self._between.createVecLeft()
        self._local = matrix.getDiagonalBlock()
        whole = matrix.createVecRight()
        self._b, self._x = self._local.createVecLeft(), whole.createLocalVector()
        release(whole)

    def constrain(self, dofs: Int32Array) -> None:
        """Note the owned dofs whose rows and columns are the identity's now, and x = 0 there."""
        if not self._alone:
            self._constrained = np.flatnonzero(np.isin(self._rows, dofs))

    def forward(self, b: PETSc.Vec, x: PETSc.Vec) -> None:
        """Sweep from the first row to the last, starting from x = 0."""
        self._sweep(b, x, _FORWARD, from_zero=True)

    def backward(self, b: PETSc.Vec, x: PETSc.Vec) -> None:
        """Sweep from the last row to the first, starting from x, for the same b as before."""
        self._sweep(b, x, _BACKWARD, from_zero=False)

    def free(self) -> None:
        """Free everything but the matrix."""
        if not self._alone:
            release(self._between, self._share, self._b, self._x)

    def _sweep(self, b: PETSc.Vec, x: PETSc.Vec, way: int, from_zero: bool) -> None:
        first = way | _FROM_ZERO if from_zero else way
        if self._alone:
            self._matrix.SOR(b, x, self.relaxation, first, its=self._sweeps)
            return
        if from_zero:
            self._b.array[:] = b.array_r
        for sweep in range(self._sweeps):
            if sweep > 0 or not from_zero:
                self._between.mult(x, self._share)
                self._share.array[self._constrained] = 0.0
                self._b.array[self._rows] = b.array_r[self._rows] - self._share.array_r
            x.getLocalVector(self._x)
            self._local.SOR(self._b, self._x, self.relaxation, first if sweep == 0 else way)
            x.restoreLocalVector(self._x)


class Jacobi:
    """Steps x ← x + D⁻¹ (b − A x) with D_ii = Σ_j |a_ij|, which is at least A.

    So each step reduces the error's energy norm, and still does when rows and columns are
    constrained: that only makes sums smaller.
    """

    def __init__(self, matrix: PETSc.Mat, dofs: Layout, sweeps: int):
        """Prepare the sweeps, as any `Smoother`; collective."""
        self._matrix, self._sweeps = matrix, sweeps
        start, _, values = matrix.getValuesCSR()
        self._inverse, self._residual = matrix.createVecRight(), matrix.createVecRight()
        self._inverse.array[:] = 1.0 / np.add.reduceat(np.abs(values), start[:-1])

    def constrain(self, dofs: Int32Array) -> None:
        """Do nothing: residuals of rows of the identity are 0 where b and x are."""

    def forward(self, b: PETSc.Vec, x: PETSc.Vec) -> None:
        """Sweep from x = 0."""
        x.pointwiseMult(self._inverse, b)
        self._sweep(b, x, self._sweeps - 1)

    def backward(self, b: PETSc.Vec, x: PETSc.Vec) -> None:
        """Sweep from x; the transpose of a sweep is itself."""
        self._sweep(b, x, self._sweeps)

    def free(self) -> None:
        """Free everything but the matrix."""
        release(self._inverse, self._residual)

    def _sweep(self, b: PETSc.Vec, x: PETSc.Vec, times: int) -> None:
        for _ in range(times):
            self._matrix.mult(x, self._residual)
            self._residual.aypx(-1.0, b)
            self._residual.pointwiseMult(self._inverse, self._residual)
            x.axpy(1.0, self._residual)


SMOOTHERS: dict[str, type[Smoother]] = {"gauss-seidel": GaussSeidel, "jacobi": Jacobi}
"""Smoothers by what ``-signorini_smoother`` calls them; the first is the default."""


def smoother(matrix: PETSc.Mat, dofs: Layout, sweeps: int) -> Smoother:
    """Make the smoother that is asked for, as described there; collective.

    Raises:
        InputError: There is none of that name.
    """
    return SMOOTHERS[read_word("smoother", tuple(SMOOTHERS))](matrix, dofs, sweeps)


def _entries_between_ranks(matrix: PETSc.Mat, dofs: Layout) -> tuple[Int32Array, PETSc.Mat, float]:
    """Find the entries of owned rows in columns of other ranks.

    Returns:
        The rows that may have such entries, ascending local numbers; the entries as a matrix with
        these rows; and a bound on the spectral radius of all of them, the matrix scaled to a
        diagonal of ones.
    """
    comm = matrix.getComm()
    first, end = matrix.getOwnershipRange()
    # An entry stems from a cell. If this rank does not own the cell, its dof is a ghost there and
    # thereby shared; if it does, the other dof is a ghost here, whose row has this one for a column
    ghost = np.arange(dofs.size[0], dofs.local, dtype=np.int32)
    shared = numbers_of(matrix, dofs.owned_among(ghost))
    # PETSc looks for their owners in order
    _, column, _ = rows_of(matrix, np.sort(dofs.numbers(ghost)))
    numbers = np.union1d(shared, column[(column >= first) & (column < end)])
    start, column, value = rows_of(matrix, numbers)
    rows = (numbers - first).astype(np.int32)
    row = np.repeat(np.arange(len(rows)), np.diff(start))
    diagonal = value[column == numbers[row]]
    others = (column < first) | (column >= end)
    start = np.zeros(len(rows) + 1, dtype=PETSc.IntType)
    np.cumsum(np.bincount(row[others], minlength=len(rows)), out=start[1:])
    column, value = column[others], value[others]
    sizes = (len(rows), PETSc.DECIDE), matrix.getSizes()[1]
    between = PETSc.Mat().createAIJ(sizes, csr=(start, column, value), comm=comm)
    magnitudes = PETSc.Mat().createAIJ(sizes, csr=(start, column, np.abs(value)), comm=comm)

    # Collatz and Wielandt: for v > 0 and M ≥ 0 no eigenvalue is larger than all (M v)_i / v_i
    v, product, radius = matrix.createVecRight(), magnitudes.createVecLeft(), np.inf
    v.set(1.0)
    for _ in range(POWER_STEPS):
        magnitudes.mult(v, product)
        image = product.array_r / diagonal
        ratios = image / v.array_r[rows]
        radius = min(radius, comm.tompi4py().allreduce(ratios.max(initial=0.0), op=MPI.MAX))
        v.array[rows] += image
    release(magnitudes, v, product)
    return rows, between, float(radius)
