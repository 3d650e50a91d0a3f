"""The reduced systems of the active set method, solved without extracting them.

Extracting the reduced matrix costs as much as a dozen products with A, and a new size each time
throws the linear solver away. Neither is needed: SNES is given a Jacobian whose submatrices exist
in name only and a linear solver that works in the full space, with the identity in the rows and
columns of the active dofs. That is the reduced system exactly. What is behind the prefix
`signorini_ksp_` and `signorini_pc_` is this inner solver.

It stops when its residual is a small part of what the active set's errors will leave anyway, so a
Newton step with a wrong set ends early and one with the right set is the last; but not before it is
certain of each contact dof's sign, or what it left undone would decide on the next active set, and
of the contact forces, which the residual says little about.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from petsc4py import PETSc

from ..garbage import release
from ..multigrid.cycle import PATIENCE, SLOW, Grid
from ..multigrid.masking import numbers_of
from ..options import PREFIX, read
from .stopping import FORCES, LOST, NOISE, Stiffness

LINEAR_SHARE = 0.9
"""What the linear solver leaves at the end, in parts of what the residual may be."""

SET_SHARE = 0.3
"""What it leaves while the active set is wrong, in parts of what that adds to the residual."""

SETTLED = 1.0
"""Part of its last change by which a contact dof's sign must be certain before the end."""

SETTLING_LIMIT = 1e-3
"""Where signs stay open the linear solver goes on to this part of what it may leave."""

FLOOR = 1e-10
"""Residuals below so many times the rounding of A x are not reduced further, whatever is open."""


class MaskedSolver:
    """What SNES takes for the reduced Jacobian and for the linear solver, in the full space.

    Attributes:
        ksp: The inner solver, CG with the grid's V-cycle unless options say otherwise.
        iterations: Its steps so far.
        reached: Norm of the residual that it left last.
        force_errors: What it left wrong with the forces on active dofs, summed over each class of
            stiffness, by the last change of the forces and the rate at which it converged;
            infinite where that is not known.
        reduction: What part of its residual it may leave where that is small enough from the start.
    """

    def __init__(
        self,
        grid: Grid,
        lower: npt.NDArray[np.float64],
        x: PETSc.Vec,
        residual: PETSc.Vec,
        atol: float,
        stiffness: Stiffness,
        loose: float = 1.0,
    ):
        """Set the inner solver up.

        Args:
            grid: The matrix and its multigrid.
            lower: Bounds of the grid's bounded dofs, shape (n,).
            x: Where SNES keeps the iterate.
            residual: Where it keeps the residual.
            atol: What the linear solver may leave at the end.
            stiffness: Classes of the grid's bounded dofs.
            loose: How many times more than usual may be wrong with the forces.
        """
        self._grid, self._lower, self._x, self._residual = grid, lower, x, residual
        self._stiffness, self._share = stiffness, loose * FORCES
        self._is_active = np.zeros(len(lower), dtype=bool)
        self.reached, self.reduction = np.inf, SET_SHARE
        self.force_errors: npt.NDArray[np.float64] = np.full(stiffness.number, np.inf)
        self._step = x.duplicate()
        self._slow = False  # whether the last solve was stopped for that
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
        self.force_errors = np.full(self._stiffness.number, np.inf)
        self.ksp.setOperators(self._grid.matrix)
        self.ksp.solve(self._residual, self._step)
        if self._slow:  # once more from the start, which one step of a factorisation makes up for
            self.iterations += self.ksp.getIterationNumber()
            self._grid.give_up()
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

    def disputed(self) -> npt.NDArray[np.bool_]:
        """Which bounded dofs the last system had in the wrong set, shape (n,)."""
        return self.active() != self._is_active

    def forces(self) -> npt.NDArray[np.float64]:
        """The residual in the bounded dofs, shape (n,)."""
        forces: npt.NDArray[np.float64] = self._residual.array_r[self._grid.operator.dofs]
        return forces

    def _test(self, ksp: PETSc.KSP, iteration: int, norm: float) -> int:
        """Whether the linear solver may stop; CG's norm is that of the reduced residual."""
        Reason = PETSc.KSP.ConvergedReason
        if not np.isfinite(norm):
            return Reason.DIVERGED_NANORINF
        rtol, atol, _, _ = ksp.getTolerances()
        before, self.reached = self.reached, norm
        if iteration == 0:
            self._slow = False
            self._norm, self._before = norm, self._indicator(None)
            self._moved = self.force_errors
            self._noise: npt.NDArray[np.float64] | None = None
            # where only the set or the forces are left the residual is below atol from the start
            self._atol = min(atol, self.reduction * norm)
            return Reason.ITERATING if norm > 0.0 else Reason.CONVERGED_ATOL
        if not self._is_cg:  # other methods may not have an iterate to look at
            done = norm <= max(self._atol, rtol * self._norm)
            return Reason.CONVERGED_ATOL if done else Reason.ITERATING
        wrong, unsettled, moved, forces = self._set_facts(ksp.getSolution())
        of_norm = max(norm / before if before else 0.0, (norm / self._norm) ** (1 / iteration))
        rate = np.full(len(moved), of_norm)
        if iteration > 2:  # the first step moves what is near, not what moves forces most
            rate = np.maximum(rate, moved / np.maximum(self._moved, 1e-300))
        self.force_errors = np.full(len(moved), np.inf)
        np.divide(moved * rate, 1.0 - rate, out=self.force_errors, where=rate < 1.0)
        self.force_errors[moved == 0.0] = 0.0
        self._moved = moved
        share = SETTLING_LIMIT if unsettled else 1.0
        if norm <= rtol * self._norm or (iteration > 1 and norm <= share * SET_SHARE * wrong):
            return Reason.CONVERGED_RTOL
        if norm <= share * self._atol:
            known = (self.force_errors <= self._share * forces).all()
            if known or self._lost(norm, forces):
                return Reason.CONVERGED_ATOL
        much = iteration >= SLOW and self.iterations + iteration >= PATIENCE
        if much and self._uses_grid and self._grid.may_give_up:
            self._slow = True
            return Reason.DIVERGED_MAX_IT
        return Reason.ITERATING

    def _lost(self, norm: float, forces: npt.NDArray[np.float64]) -> bool:
        """Whether rounding makes it useless to reduce the residual for the forces' sake."""
        if self._noise is None:
            self._floor = FLOOR * NOISE * self._grid.rounding(self._x)
            self._noise = LOST * NOISE * self._stiffness.magnitude(self._x)
        allowed = np.where(forces <= self._noise, self._noise, self._share * forces)
        return norm <= self._floor or bool((self.force_errors <= allowed).all())

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

    def _set_facts(
        self, step: PETSc.Vec
    ) -> tuple[float, bool, npt.NDArray[np.float64], npt.NDArray[np.float64]]:
        """What the active set will have to do with the next residual, and with the next set.

        Returns:
            The part of the residual that forces that pull and penetration will make; whether any
            dof could still change sides: its indicator is less than what it changed by last; and
            for each class of stiffness the change of the forces on active dofs, and their sum.
        """
        now = self._indicator(step)
        wrong = np.where(self._is_active == (now > 0.0), 0.0, now)
        change = np.abs(now - self._before)
        unsettled = np.abs(now) < SETTLED * change
        self._before = now
        sums, active = self._stiffness.sums, self._is_active
        moved, forces = (
            sums(np.where(active, change, 0.0)),
            sums(np.where(active, np.maximum(now, 0.0), 0.0)),
        )
        facts = np.concatenate([[wrong @ wrong, unsettled.any()], moved, forces])
        facts = step.getComm().tompi4py().allreduce(facts)
        moved, forces = np.split(facts[2:], 2)
        return float(np.sqrt(facts[0])), bool(facts[1]), moved, forces


class _Nominal:
    """A matrix that is there for its size; nobody multiplies with it."""
