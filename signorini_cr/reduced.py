"""The reduced systems of the active set method, solved without extracting them.

Extracting the reduced matrix costs as much as a dozen products with A, and a new size each time
throws the linear solver away. Neither is needed: SNES is given a Jacobian whose submatrices exist
in name only and a linear solver that works in the full space, with the identity in the rows and
columns of the active dofs. That is the reduced system exactly. What is behind the prefix
`signorini_ksp_` and `signorini_pc_` is this inner solver.

It stops when its residual is a small part of what the active set's errors will leave anyway, so a
Newton step with a wrong set ends early and one with the right set is the last; but not before it is
certain of each contact dof's sign, or what it left undone would decide on the next active set.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from petsc4py import PETSc

from .garbage import release
from .masking import numbers_of
from .multigrid import Grid
from .options import PREFIX, read

LINEAR_SHARE = 0.9
"""What the linear solver leaves at the end, in parts of what the residual may be."""

SET_SHARE = 0.3
"""What it leaves while the active set is wrong, in parts of what that adds to the residual."""

SETTLED = 1.0
"""Part of its last change by which a contact dof's sign must be certain before the end."""

SETTLING_LIMIT = 1e-3
"""Where signs stay open the linear solver goes on to this part of what it may leave."""


class MaskedSolver:
    """What SNES takes for the reduced Jacobian and for the linear solver, in the full space.

    Attributes:
        ksp: The inner solver, CG with the grid's V-cycle unless options say otherwise.
        iterations: Its steps so far.
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
        self._is_active = np.zeros(len(lower), dtype=bool)
        self._step = x.duplicate()
        self.iterations = 0
        self.ksp = ksp = PETSc.KSP().create(grid.matrix.getComm())
        ksp.setOptionsPrefix(PREFIX)
        ksp.setOperators(grid.matrix)
        ksp.setType(PETSc.KSP.Type.CG)
        ksp.setTolerances(rtol=0.0, atol=atol, max_it=1000)
        ksp.getPC().setType(PETSc.PC.Type.PYTHON)
        ksp.getPC().setPythonContext(grid)
        read(ksp)
        ksp.setConvergenceTest(self._test)
        self._is_cg = ksp.getType() == PETSc.KSP.Type.CG
        if self._is_cg:
            ksp.setNormType(PETSc.KSP.NormType.UNPRECONDITIONED)
        elif ksp.getTolerances()[1] == atol:  # preconditioned norms may be much smaller
            ksp.setTolerances(atol=SETTLING_LIMIT * atol)
        self._uses_grid = ksp.getPC().getType() == PETSc.PC.Type.PYTHON

    def describe(self) -> str:
        """The preconditioner taken, and why."""
        if self._uses_grid:
            return self._grid.describe()
        return f"{self.ksp.getPC().getType()} (option -{PREFIX}pc_type)"

    def free(self) -> None:  # "destroy" is what PETSc calls a context with
        """Free everything but the grid."""
        release(self.ksp, self._step)

    # as the context of the Jacobian

    def mult(self, _: PETSc.Mat, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """The Jacobian is A."""
        self._grid.operator.mult(x, y)

    def createSubMatrix(
        self, matrix: PETSc.Mat, rows: PETSc.IS, columns: PETSc.IS, _: PETSc.Mat | None
    ) -> PETSc.Mat:
        """Note which dofs are inactive, and return a matrix of the right size."""
        inactive = rows.array
        numbers = numbers_of(matrix, self._grid.operator.dofs)
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
        # by hand: numpy.delete takes memory of the size of x
        step, reduced = self._step.array_r, x.array
        starts, ends = np.concatenate([[0], active + 1]), np.append(active, len(step))
        for gone, (start, end) in enumerate(zip(starts, ends, strict=True)):
            reduced[start - gone : end - gone] = step[start:end]
        self.iterations += self.ksp.getIterationNumber()
        outer.setIterationNumber(self.ksp.getIterationNumber())
        outer.setConvergedReason(self.ksp.getConvergedReason())

    def active(self) -> npt.NDArray[np.bool_]:
        """Which bounded dofs are on their bound with a residual pushing them there, shape (n,)."""
        dofs = self._grid.operator.dofs
        return (self._x.array_r[dofs] <= self._lower) & (self._residual.array_r[dofs] > 0.0)

    def disputed(self) -> float:
        """Norm of the residual in the dofs that the last system had in the wrong set."""
        force = self._residual.array_r[self._grid.operator.dofs]
        local = float(np.sum(force[self.active() != self._is_active] ** 2))
        return float(np.sqrt(self._x.getComm().tompi4py().allreduce(local)))

    def _test(self, ksp: PETSc.KSP, iteration: int, norm: float) -> int:
        """Whether the linear solver may stop; CG's norm is that of the reduced residual."""
        Reason = PETSc.KSP.ConvergedReason
        if not np.isfinite(norm):
            return Reason.DIVERGED_NANORINF
        rtol, atol, _, _ = ksp.getTolerances()
        if iteration == 0:
            self._norm, self._before = norm, self._indicator(None)
            # where the set alone is left to be found the residual is below atol from the start
            self._atol = atol if norm > atol else SET_SHARE * norm
            return Reason.ITERATING if norm > 0.0 else Reason.CONVERGED_ATOL
        # other methods than CG may not have an iterate to look at
        wrong, unsettled = self._set_facts(ksp.getSolution()) if self._is_cg else (0.0, False)
        share = SETTLING_LIMIT if unsettled else 1.0
        if norm <= share * self._atol:
            return Reason.CONVERGED_ATOL
        if norm <= rtol * self._norm or (iteration > 1 and norm <= share * SET_SHARE * wrong):
            return Reason.CONVERGED_RTOL
        return Reason.ITERATING

    def _indicator(self, step: PETSc.Vec | None) -> npt.NDArray[np.float64]:
        """Forces on active dofs, minus gaps times the diagonal on the others; positive is active.

        Args:
            step: What is subtracted from the iterate; None for nothing.
        """
        operator, (x, force) = self._grid.operator, self._at_start
        if step is not None:
            x = x - step.array_r[operator.dofs]
            force = force - operator.times(step)
        return np.where(self._is_active, force, operator.diagonal * (self._lower - x))

    def _set_facts(self, step: PETSc.Vec) -> tuple[float, bool]:
        """What the active set will have to do with the next residual, and with the next set.

        Returns:
            The part of the residual that forces that pull and penetration will make, and whether
            any dof could still change sides: its indicator is less than what it changed by last.
        """
        now = self._indicator(step)
        wrong = np.where(self._is_active == (now > 0.0), 0.0, now)
        unsettled = np.abs(now) < SETTLED * np.abs(now - self._before)
        self._before = now
        facts = np.array([wrong @ wrong, unsettled.any()])
        squared, unsettled = step.getComm().tompi4py().allreduce(facts)
        return float(np.sqrt(squared)), bool(unsettled)


class _Nominal:
    """A matrix that is there for its size; nobody multiplies with it."""
