"""A matrix that dofs can be taken out of, in place.

The reduced systems of the active set method leave dofs out. Extracting them costs as much as a
dozen products with the matrix, a copy that wears the identity in their rows and columns costs its
memory. Only dofs with a bound can ever be taken out, and they are few: their rows are kept here,
and the matrix itself is changed and changed back.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from petsc4py import PETSc

from ..garbage import release

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int32]


def rows_of(
    A: PETSc.Mat, numbers: npt.NDArray[np.integer]
) -> tuple[IntArray, IntArray, FloatArray]:
    """Some rows of A, which may be those of other ranks; collective.

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
    csr: tuple[IntArray, IntArray, FloatArray] = matrix.getValuesCSR()
    release(rows, columns, matrix)
    return csr


def numbers_of(A: PETSc.Mat, dofs: npt.NDArray[np.integer]) -> npt.NDArray[np.integer]:
    """Global numbers of owned rows of A, in integers that hold them."""
    numbers: npt.NDArray[np.integer] = dofs.astype(PETSc.IntType) + A.getOwnershipRange()[0]
    return numbers


class MaskedMatrix:
    """A symmetric matrix A with the identity in the rows and columns of some dofs.

    Attributes:
        masked: The PETSc matrix; it is A itself while no dof is taken out.
        dofs: Owned dofs that can be taken out, local numbers, ascending, shape (n,).
        diagonal: Their diagonal entries of A, shape (n,).
        fixed: Which of them are out, shape (n,).
    """

    def __init__(self, A: PETSc.Mat, dofs: IntArray):
        """Note the rows of the dofs, all that may ever have to be taken out."""
        self.masked, self.dofs = A, dofs
        self.fixed: npt.NDArray[np.bool_] = np.zeros(len(dofs), dtype=bool)
        numbers = numbers_of(A, dofs)
        csr = start, self._column, self._value = rows_of(A, numbers)
        sizes = (len(dofs), PETSc.DECIDE), A.getSizes()[1]
        self._rows = PETSc.Mat().createAIJ(sizes, csr=csr, comm=A.comm)
        self._entry = np.repeat(np.arange(len(dofs)), np.diff(start))
        self._row = numbers[self._entry]
        self.diagonal: FloatArray = self._value[self._column == self._row]
        self._part = self._rows.createVecLeft()

    def fix(self, dofs: IntArray) -> bool:
        """Take dofs out, and put the others back.

        Args:
            dofs: Owned dofs, local numbers. Others than `dofs` are left alone: a space may meet Γ0
                where the finer one's bounds end, and far from the origin rounding touches more.

        Returns:
            Whether that changed anything, on any rank.
        """
        fixed = np.isin(self.dofs, dofs)
        comm = self.masked.getComm().tompi4py()
        differs = not np.array_equal(fixed, self.fixed)
        changed, some_out = comm.allreduce(np.array([differs, self.fixed.any()]))  # + is "or"
        if changed:
            if some_out:
                self._set(self.fixed, self._value)
            self._set(fixed, np.where(self._column == self._row, 1.0, 0.0))
            self.fixed = fixed
        return bool(changed)

    @property
    def out(self) -> IntArray:
        """The dofs that are out, local numbers, ascending."""
        return self.dofs[self.fixed]

    def times(self, x: PETSc.Vec) -> FloatArray:
        """A x in the dofs that can be taken out, shape (n,)."""
        self._rows.mult(x, self._part)
        return self._part.array_r.copy()

    def magnitude(self, x: PETSc.Vec) -> FloatArray:
        """|A| |x| in the dofs that can be taken out, shape (n,): what a row of A x is made of."""
        rows, sizes = self._rows.duplicate(copy=True), x.duplicate()
        start, column, value = rows.getValuesCSR()
        rows.setValuesCSR(start, column, np.abs(value))
        rows.assemble()
        sizes.array[:] = np.abs(x.array_r)
        rows.mult(sizes, self._part)
        release(rows, sizes)
        return self._part.array_r.copy()

    def mult(self, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """Compute y = A x, whatever is taken out."""
        self.masked.mult(x, y)
        self._part.array[:] = np.where(self.fixed, x.array_r[self.dofs], 0.0)
        self._rows.multTransposeAdd(self._part, y, y)
        y.array[self.out] = self.times(x)[self.fixed]

    def free(self) -> None:
        """Free the rows; the matrix should be whole by then."""
        release(self._rows, self._part)

    def _set(self, which: npt.NDArray[np.bool_], values: FloatArray) -> None:
        """Write the rows and the columns of some dofs."""
        chosen = which[self._entry]
        rows, columns = self._row[chosen], self._column[chosen]
        start = np.arange(len(rows) + 1, dtype=PETSc.IntType)
        for i, j in ((rows, columns), (columns, rows)):
            self.masked.setValuesIJV(start, j, values[chosen], rowmap=i)
        self.masked.assemble()
