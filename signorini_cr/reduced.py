"""The reduced systems of the active set method, solved without extracting them.

Extracting the reduced matrix costs as much as a dozen products with A, and a new size each time
throws the linear solver away. Neither is needed: SNES is given a Jacobian whose submatrices exist
in name only and a linear solver that works in the full space, with the identity in the rows and
columns of the active dofs. That is the reduced system exactly. What is behind the prefix
`signorini_ksp_` and `signorini_pc_` is this inner solver.

It stops when its residual is a small part of what the active set's errors will leave anyway, so a
Newton step with a wrong set ends early and one with the right set is the last.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from petsc4py import PETSc

from .multigrid import Grid
from .options import PREFIX, read

LINEAR_SHARE = 0.9
"""What the linear solver leaves at the end, in parts of what the residual may be."""

SET_SHARE = 0.1
"""What it leaves while the active set is wrong, in parts of what that adds to the residual."""


class MaskedSolver:
    """What SNES takes for the reduced Jacobian and for the linear solver, in the full space.

    Attributes:
        ksp: The inner solver, CG with the grid's V-cycle unless options say otherwise.
    """

    def __init__(
        self,
        grid: Grid,
        lower: npt.NDArray[np.float64],
        x: PETSc.Vec,
        residual: PETSc.Vec,
        atol: float,
    ):
        """Set the inner solver up.

        Args:
            grid: The matrix and its multigrid.
            lower: Bounds of the grid's bounded dofs, shape (n,).
            x: Where SNES keeps the iterate.
            residual: Where it keeps the residual.
            atol: What the linear solver may leave at the end.
        """
        self._grid, self._lower, self._x, self._residual = grid, lower, x, residual
        self._first = grid.matrix.getOwnershipRange()[0]
        self._is_active = np.zeros(len(lower), dtype=bool)
        self._step = x.duplicate()
        self.ksp = ksp = PETSc.KSP().create(grid.matrix.getComm())
        ksp.setOptionsPrefix(PREFIX)
        ksp.setOperators(grid.matrix)
        ksp.setType(PETSc.KSP.Type.CG)
        ksp.setTolerances(rtol=0.0, atol=atol, max_it=1000)
        ksp.getPC().setType(PETSc.PC.Type.PYTHON)
        ksp.getPC().setPythonContext(grid)
        read(ksp)
        if ksp.getType() == PETSc.KSP.Type.CG:
            ksp.setNormType(PETSc.KSP.NormType.UNPRECONDITIONED)
            ksp.setConvergenceTest(self._test)
        elif ksp.getTolerances()[0] == 0.0:  # their norms are not ours, so atol alone won't do
            ksp.setTolerances(rtol=1e-10)
        self._uses_grid = ksp.getPC().getType() == PETSc.PC.Type.PYTHON

    def describe(self) -> str:
        """The preconditioner taken, and why."""
        if self._uses_grid:
            return self._grid.describe()
        return f"{self.ksp.getPC().getType()} (option -{PREFIX}pc_type)"

    def free(self) -> None:  # "destroy" is what PETSc calls a context with
        """Free everything but the grid."""
        for thing in (self.ksp, self._step):
            thing.destroy()

    # as the context of the Jacobian

    def mult(self, _: PETSc.Mat, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """The Jacobian is A."""
        self._grid.operator.mult(x, y)

    def createSubMatrix(
        self, matrix: PETSc.Mat, rows: PETSc.IS, columns: PETSc.IS, _: PETSc.Mat | None
    ) -> PETSc.Mat:
        """Note which dofs are inactive, and return a matrix of the right size."""
        inactive = rows.array
        numbers = self._grid.operator.dofs + self._first
        place = np.searchsorted(inactive, numbers)
        if len(inactive):
            self._is_active = inactive.take(place, mode="clip") != numbers
        else:
            self._is_active = np.ones(len(numbers), dtype=bool)
        size = (len(inactive), PETSc.DECIDE)
        nominal = PETSc.Mat().createPython((size, size), comm=matrix.getComm())
        nominal.setPythonContext(_Nominal())
        nominal.setUp()
        nominal.setOption(PETSc.Mat.Option.SPD, True)  # PETSc need not find that out
        return nominal

    # as the context of the outer linear solver

    def solve(self, outer: PETSc.KSP, b: PETSc.Vec, x: PETSc.Vec) -> None:
        """Solve the reduced system, given what SNES knows: its right-hand side is the residual."""
        dofs = self._grid.operator.dofs
        active = dofs[self._is_active]
        self._grid.fix(active, deep=self._uses_grid)
        self._at_start = self._x.array_r[dofs], self._residual.array_r[dofs]
        self._residual.array[active] = 0.0
        self.ksp.setOperators(self._grid.matrix)
        self.ksp.solve(self._residual, self._step)
        self._residual.array[dofs] = self._at_start[1]
        x.array[:] = np.delete(self._step.array_r, active)
        outer.setIterationNumber(self.ksp.getIterationNumber())
        outer.setConvergedReason(self.ksp.getConvergedReason())

    def _test(self, ksp: PETSc.KSP, iteration: int, norm: float) -> int:
        """Whether CG may stop; its norm is that of the residual of the reduced system."""
        Reason = PETSc.KSP.ConvergedReason
        if not np.isfinite(norm):
            return Reason.DIVERGED_NANORINF
        rtol, atol, _, _ = ksp.getTolerances()
        if iteration == 0:
            self._norm = norm
        if norm <= atol:
            return Reason.CONVERGED_ATOL
        if norm <= rtol * self._norm:
            return Reason.CONVERGED_RTOL
        if iteration > 1 and norm <= SET_SHARE * self._set_residual(ksp.getSolution()):
            return Reason.CONVERGED_RTOL
        return Reason.ITERATING

    def _set_residual(self, step: PETSc.Vec) -> float:
        """What the next residual owes to the active set: forces that pull, and penetration."""
        operator, (x, force) = self._grid.operator, self._at_start
        gap = x - step.array_r[operator.dofs] - self._lower
        force = force - operator.times(step)
        wrong = np.where(self._is_active, force, operator.diagonal * gap)
        local = float(np.sum(np.minimum(wrong, 0.0) ** 2))
        return float(np.sqrt(step.getComm().tompi4py().allreduce(local)))


class _Nominal:
    """A matrix that is there for its size; nobody multiplies with it."""
