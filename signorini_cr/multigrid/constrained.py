"""A matrix that dofs can be taken out of for a while, in place.

The reduced systems of the active set method leave dofs out. Extracting them costs as much as seven
products with the matrix (`benchmarks/submatrix.py`), a copy that has the identity in their rows and
columns its memory. Only dofs with a bound can ever be constrained, and they are few: their rows and
columns are kept here, and the matrix itself is changed for the length of a `with` block. Each rank
writes its own rows and says nothing to the others when it puts them back, so that the matrix is
whole after the block whatever fails in it, and on whichever rank.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

import numpy as np
import numpy.typing as npt
from petsc4py import PETSc

from ..arrays import BoolArray, FloatArray, IndexArray, Int32Array
from ..garbage import release


def rows_of(
    A: PETSc.Mat, numbers: npt.NDArray[np.integer]
) -> tuple[Int32Array, Int32Array, FloatArray]:
    """Take some rows of A, which may be those of other ranks; collective.

    PETSc has submatrices on several ranks, too, but they take a time that grows with A.

    Args:
        A: The matrix.
        numbers: Global numbers of the rows.

    Returns:
        The rows in CSR format: where each begins, global columns, values.
    """
    rows = PETSc.IS().createGeneral(numbers.astype(PETSc.IntType), comm=PETSc.COMM_SELF)
    columns = PETSc.IS().createStride(A.getSize()[1], 0, 1, PETSc.COMM_SELF)
    (matrix,) = A.createSubMatrices(rows, columns)
    csr: tuple[Int32Array, Int32Array, FloatArray] = matrix.getValuesCSR()
    release(rows, columns, matrix)
    return csr


def with_entries(A: PETSc.Mat, made: Callable[[FloatArray], FloatArray]) -> PETSc.Mat:
    """Make a matrix with A's pattern and entries of its own; collective.

    Args:
        A: The matrix.
        made: Of this rank's entries of A, shape (n,), makes those of the copy.
    """
    copy = A.duplicate(copy=True)
    start, column, value = A.getValuesCSR()
    copy.setValuesCSR(start, column, made(value))
    copy.assemble()
    return copy


def numbers_of(A: PETSc.Mat, dofs: npt.NDArray[np.integer]) -> npt.NDArray[np.integer]:
    """Return the global numbers of owned rows of A, in integers that hold them."""
    numbers: npt.NDArray[np.integer] = dofs.astype(PETSc.IntType) + A.getOwnershipRange()[0]
    return numbers


class ConstrainedMatrix:
    """A symmetric matrix A that can have the identity in the rows and columns of some dofs.

    Attributes:
        matrix: A, whole outside the blocks of `constrained`.
        dofs: Owned dofs that can be constrained, local numbers, ascending, shape (n,).
        diagonal: Their diagonal entries of A, shape (n,).
        whole_diagonal: Those of all owned dofs, shape (owned dofs,).
    """

    def __init__(self, A: PETSc.Mat, dofs: Int32Array):
        """Note the rows and columns of all dofs that may ever be constrained; collective."""
        self.matrix, self.dofs, self._open = A, dofs, False
        entries = A.getDiagonal()
        self.whole_diagonal: FloatArray = entries.array_r.copy()
        release(entries)
        self.diagonal = self.whole_diagonal[dofs]
        numbers = numbers_of(A, dofs)
        csr = _, column, _ = rows_of(A, numbers)
        sizes = (len(dofs), PETSc.DECIDE), A.getSizes()[1]
        self._rows = PETSc.Mat().createAIJ(sizes, csr=csr, comm=A.comm)
        self._product = self._rows.createVecLeft()
        # All own rows with an entry in such a column, as the pattern is symmetric
        near = self._named(column)
        near_numbers = numbers_of(A, np.flatnonzero(near))
        start, column, value = rows_of(A, near_numbers)
        row = np.repeat(near_numbers, np.diff(start))
        columns, place = np.unique(column, return_inverse=True)
        theirs = PETSc.IS().createGeneral(columns.astype(PETSc.IntType), comm=PETSc.COMM_SELF)
        self._marks, self._at_columns = A.createVecRight(), PETSc.Vec().createSeq(len(columns))
        self._to_columns = PETSc.Scatter().create(self._marks, theirs, self._at_columns, None)
        own = np.isin(row, numbers)
        self._of_own = np.searchsorted(numbers, row[own]), place[own], value[own]
        kept = own | self._seen(dofs)[place]
        release(theirs)
        self._row, self._column, self._value = row[kept], column[kept], value[kept]
        self._place, self._own_row = place[kept], self._row - A.getOwnershipRange()[0]
        self._unit: FloatArray = (self._row == self._column).astype(np.float64)
        # The pattern is not to change, or ranks would have to talk whenever values do
        A.setOption(PETSc.Mat.Option.NEW_NONZERO_LOCATION_ERR, True)

    @contextmanager
    def constrained(self, dofs: Int32Array) -> Iterator[Int32Array]:
        """Have the identity in the rows and columns of some dofs for a block; collective at entry.

        Blocks of one matrix are not nested.

        Args:
            dofs: Owned dofs, local numbers. Others than `dofs` are left alone: a space may meet Γ0
                where the finer one's bounds end, and far from the origin rounding reaches more.

        Yields:
            Those that are constrained, ascending.
        """
        assert not self._open, "a block inside another would put back what that one left out"
        named = np.zeros(self.matrix.getLocalSize()[0], dtype=bool)
        named[dofs] = True
        chosen = self.dofs[named[self.dofs]]
        named[:] = False
        named[chosen] = True
        which = np.flatnonzero(named[self._own_row] | self._seen(chosen)[self._place])
        anyone = self.matrix.getComm().tompi4py().allreduce(len(chosen)) > 0
        self._open = True
        try:
            if anyone:
                self._write(which, self._unit[which])
            yield chosen
        finally:
            if anyone:
                self._write(which, self._value[which])
            self._open = False

    def times(self, x: PETSc.Vec) -> FloatArray:
        """Compute A x in the dofs that can be constrained, shape (n,), whether or not they are."""
        self._rows.mult(x, self._product)
        return self._product.array_r.copy()

    def magnitude(self, x: PETSc.Vec) -> FloatArray:
        """Compute |A| |x|, of which rows of A x are made, in the constrainable dofs, shape (n,)."""
        self._to_columns.scatter(x, self._at_columns)
        row, place, value = self._of_own
        sizes = np.abs(value * self._at_columns.array_r[place])
        return np.bincount(row, sizes, minlength=len(self.dofs)).astype(np.float64, copy=False)

    def flows(self, x: PETSc.Vec, b: PETSc.Vec) -> FloatArray:
        """Sum what a row of A x − b is made of but for constants in x, in these dofs, shape (n,).

        That is Σ_j |a_ij| |x_j − x_i| + |Σ_j a_ij x_i − b_i|; collective.
        """
        self._to_columns.scatter(x, self._at_columns)
        row, place, value = self._of_own
        own = x.array_r[self.dofs]
        flows = np.abs(value * (self._at_columns.array_r[place] - own[row]))
        sums, rows = (np.bincount(row, each, minlength=len(own)) for each in (flows, value))
        found: FloatArray = sums + np.abs(rows * own - b.array_r[self.dofs])
        return found

    def free(self) -> None:  # "destroy" is what PETSc calls a context with
        """Free everything but the matrix."""
        release(self._rows, self._product)
        release(self._marks, self._at_columns, self._to_columns)

    def _named(self, numbers: Int32Array) -> BoolArray:
        """Find which owned dofs any rank names by their global numbers; collective."""
        marks = self.matrix.createVecRight()
        add = PETSc.InsertMode.ADD_VALUES
        marks.setValues(numbers.astype(PETSc.IntType, copy=False), np.ones(len(numbers)), add)
        marks.assemble()
        found: BoolArray = marks.array_r > 0.0
        release(marks)
        return found

    def _seen(self, dofs: Int32Array) -> BoolArray:
        """Find which dofs whose columns this rank has entries in are among some; collective.

        Args:
            dofs: Each rank's owned ones, local numbers.
        """
        # a vector that is 0 again afterwards, as a new one takes longer than all the rest
        self._marks.array[dofs] = 1.0
        self._to_columns.scatter(self._marks, self._at_columns)
        self._marks.array[dofs] = 0.0
        seen: BoolArray = self._at_columns.array_r > 0.0
        return seen

    def _write(self, which: IndexArray, values: FloatArray) -> None:
        """Write entries of own rows, which concerns no other rank as the pattern stays."""
        start = np.arange(len(which) + 1, dtype=PETSc.IntType)
        local = PETSc.Mat.Option.NO_OFF_PROC_ENTRIES
        self.matrix.setOption(local, True)
        try:
            self.matrix.setValuesIJV(start, self._column[which], values, rowmap=self._row[which])
            self.matrix.assemble()
        finally:
            self.matrix.setOption(local, False)
