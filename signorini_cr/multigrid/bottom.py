"""Solver of the space at the bottom of the cycle, or in place of the cycle.

Small matrices are factorised on every rank, algebraic multigrid has the others. Where the cycle has
been given up, that is what takes few steps for thin cells only if they are aligned with the strong
direction, so that the matrix has no positive off-diagonal entries to speak of: then BoomerAMG needs
a handful of steps. On other cells it would need hundreds, and the matrix is factorised.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from ..arrays import Int32Array
from ..garbage import release
from ..options import (
    ALONE_PREFIX,
    BOOMERAMG,
    BOTTOM_PREFIX,
    HAS_MUMPS,
    LARGE_FACTORS,
    REDUNDANT_FACTORS,
    SMALL_FACTORS,
    defaults,
    read,
)

DIRECT = 2000
"""Bottom spaces of up to this many dofs are factorised, on every rank; AMG has the others."""

FACTORISED = {2: 4_000_000, 3: 20_000}
"""Largest matrices that are factorised instead, by the mesh's dimension; AMG has the others.

In the plane that takes about as long as four linear solves with BoomerAMG of plain cells at 1 M
dofs, and 0.6 kB a dof; in space it is far more.
"""

POSITIVE = 0.25
"""Part of the diagonal up to which positive off-diagonal entries of a row do no harm to AMG."""


NO_HYPRE = "GAMG (PETSc is without hypre)"


def is_small(matrix: PETSc.Mat) -> bool:
    """Tell whether a matrix at the bottom is to be factorised."""
    return matrix.getSize()[0] <= DIRECT


class Bottom:
    """A solver for one matrix that is constrained again and again."""

    def __init__(self, matrix: PETSc.Mat, dimension: int, alone: bool = False):
        """Choose what solves; collective.

        Args:
            matrix: The matrix.
            dimension: The mesh's.
            alone: Whether it takes the place of the cycle.
        """
        self._matrix, self._prefix = matrix, ALONE_PREFIX if alone else BOTTOM_PREFIX
        self._options = _choice(matrix, dimension, alone)
        self._pc: PETSc.PC | None = None
        self._constrained: Int32Array = np.empty(0, np.int32)
        self._made_for: Int32Array | None = None
        self._checked = False

    def constrain(self, dofs: Int32Array) -> None:
        """Note which owned dofs are constrained from now on; on all ranks, which need not talk."""
        self._constrained, self._checked = dofs, False

    def solve(self, b: PETSc.Vec, x: PETSc.Vec, below: Sequence[object] = ()) -> None:
        """Solve with the matrix as it is constrained now; nothing is below."""
        if self._pc is None:
            self._pc = PETSc.PC().create(self._matrix.getComm())
            self._pc.setOptionsPrefix(self._prefix)
            self._pc.setOperators(self._matrix)
            with defaults(self._options, self._prefix):
                read(self._pc)
        if not self._checked:
            self._follow(self._pc)
        self._pc.apply(b, x)

    def _follow(self, pc: PETSc.PC) -> None:
        """Set up anew if other dofs are constrained than those it was made for; collective."""
        made = self._made_for
        stale = made is None or not np.array_equal(self._constrained, made)
        if self._matrix.getComm().tompi4py().allreduce(stale, op=MPI.LOR):
            # The matrix is whole in between, which is no reason to PETSc to set up anew
            pc.setReusePreconditioner(False)
            with defaults(self._options, self._prefix):
                pc.setUp()
            pc.setReusePreconditioner(True)
            self._made_for = self._constrained
        self._checked = True

    def describe(self, why: str = "") -> str:
        """Say in words what it is, and why unless it is what users have asked for."""
        usual = self._options["pc_type"]
        kind = usual if self._pc is None else self._pc.getType()
        if kind != usual:
            return f"{kind} (option -{self._prefix}pc_type)"
        words = {PETSc.PC.Type.HYPRE: "BoomerAMG", PETSc.PC.Type.GAMG: NO_HYPRE}
        return words.get(kind, "a direct solver") + why

    def free(self) -> None:  # "destroy" is what PETSc calls a context with
        """Free the solver, not the matrix."""
        release(self._pc)


def _choice(matrix: PETSc.Mat, dimension: int, alone: bool) -> Mapping[str, object]:
    """Choose the settings of what solves with a matrix unless options say otherwise; collective.

    Some are read when it is made, some when it is set up.
    """
    if not is_small(matrix):
        if not alone or matrix.getSize()[0] > FACTORISED[dimension] or _suits_amg(matrix):
            return BOOMERAMG
        if HAS_MUMPS:
            return LARGE_FACTORS
    return SMALL_FACTORS if matrix.getComm().getSize() == 1 else REDUNDANT_FACTORS


def _suits_amg(matrix: PETSc.Mat) -> bool:
    """Tell whether the matrix is, nearly, an M-matrix: BoomerAMG was made for these; collective."""
    if BOOMERAMG["pc_type"] != PETSc.PC.Type.HYPRE:
        return False
    start, column, value = matrix.getValuesCSR()
    row = np.repeat(np.arange(len(start) - 1), np.diff(start))
    off = column != row + matrix.getOwnershipRange()[0]
    positive = np.bincount(row, np.where(off, value, 0.0).clip(0.0), len(start) - 1)
    largest = float((positive / value[~off]).max(initial=0.0))
    return matrix.getComm().tompi4py().allreduce(largest, op=MPI.MAX) <= POSITIVE
