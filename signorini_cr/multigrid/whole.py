"""Small systems that are solved again and again: factors of the whole matrix serve any active set.

With the identity in the rows and columns of some dofs S the inverse of A is, where b vanishes in S,
A⁻¹ b less the columns of A⁻¹ in S times what takes A⁻¹ b to 0 there: the Schur complement. So a new
active set costs no factorisation but a solve for each of its dofs that has never been active.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from petsc4py import PETSc

from ..arrays import FloatArray, Int32Array
from ..garbage import release
from ..options import ALONE_PREFIX, WHOLE_FACTORS, defaults, read

LARGEST = 50_000
"""Largest matrices, on one process and in the plane: a solve takes less than a cycle up to there,
and the factors as long as ten."""

COLUMNS = 4_000_000
"""Numbers that all columns of the inverse may have together: 32 MB."""


ACCURACY = 1e-6
"""Largest error that the factors may have for constants."""


def suits_whole(matrix: PETSc.Mat, dimension: int, bounded: int) -> bool:
    """Tell whether a matrix is small enough.

    Args:
        matrix: The matrix.
        dimension: The mesh's.
        bounded: How many dofs can be constrained.
    """
    size = matrix.getSize()[0]
    alone = matrix.getComm().getSize() == 1
    return alone and dimension == 2 and size <= LARGEST and size * bounded <= COLUMNS


class Whole:
    """A solver for one matrix that is constrained again and again, on one process."""

    def __init__(self, matrix: PETSc.Mat, dofs: Int32Array):
        """Factorise the matrix.

        Args:
            matrix: A, whole at present.
            dofs: Those that can be constrained, ascending, shape (n,).
        """
        self._dofs, self._known = dofs, np.zeros(len(dofs), dtype=bool)
        self._columns = np.empty((len(dofs), matrix.getSize()[0]))
        self._pc = PETSc.PC().create(matrix.getComm())
        self._pc.setOptionsPrefix(ALONE_PREFIX)
        self._pc.setOperators(matrix)
        with defaults(WHOLE_FACTORS, ALONE_PREFIX):
            read(self._pc)
            self._pc.setUp()
        # what is constrained afterwards is no reason to PETSc to set up anew
        self._pc.setReusePreconditioner(True)
        self._unit, self._image = matrix.createVecs()
        self._constrained = self._made_for = dofs[:0]

    def constrain(self, dofs: Int32Array) -> None:
        """Note which dofs are constrained from now on."""
        self._constrained = dofs

    def solve(self, b: PETSc.Vec, x: PETSc.Vec, below: Sequence[object] = ()) -> None:
        """Solve with the matrix as it is constrained now, b being 0 there; nothing is below."""
        dofs = self._constrained
        if len(dofs) and not np.array_equal(dofs, self._made_for):
            self._follow(dofs)
        self._pc.apply(b, x)
        if len(dofs):
            values = x.array
            values -= (self._schur @ values[dofs]) @ self._theirs
            values[dofs] = 0.0

    def _follow(self, dofs: Int32Array) -> None:
        """Find the columns of the inverse that are not known yet, and the Schur complement."""
        rows = np.searchsorted(self._dofs, dofs)
        for row in rows[~self._known[rows]]:
            self._unit.array[:] = 0.0
            self._unit.array[self._dofs[row]] = 1.0
            self._pc.apply(self._unit, self._image)
            self._columns[row], self._known[row] = self._image.array_r, True
        self._theirs: FloatArray = self._columns[rows]
        self._schur, self._made_for = np.linalg.inv(self._theirs[:, dofs]), dofs

    def is_accurate(self) -> bool:
        """Tell whether constants are found: a matrix that hardly anything holds may seem singular.

        With dofs on the obstacle it need not be; so other solvers are to be taken.
        """
        matrix, _ = self._pc.getOperators()
        self._unit.set(1.0)
        matrix.mult(self._unit, self._image)
        self._pc.apply(self._image, self._unit)
        return bool(np.abs(self._unit.array_r - 1.0).max(initial=0.0) <= ACCURACY)

    def describe(self, why: str = "") -> str:
        """Say in words what it is."""
        kind = self._pc.getType()
        if kind != WHOLE_FACTORS["pc_type"]:
            return f"{kind} (option -{ALONE_PREFIX}pc_type)"
        return "a direct solver" + why

    def free(self) -> None:  # "destroy" is what PETSc calls a context with
        """Free the factors, not the matrix."""
        release(self._pc, self._unit, self._image)
