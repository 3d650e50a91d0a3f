"""The discrete variational inequality (1.8), solved by PETSc's SNES `vinewtonrsls`.

Find u ∈ K_h with a_h(u, v − u) ≥ χ(v − u) for all v ∈ K_h. With A and b the matrix and the vector
of a_h and χ this is the complementarity problem

    (Au − b)_i ≥ 0,  u_i ≥ α_i,  (Au − b)_i (u_i − α_i) = 0   for the dofs i on Γ1,

and (Au − b)_i = 0 for all others. The reduced-space method drops the dofs that sit on their bound
with (Au − b)_i > 0, solves for the rest, and repeats: with full steps it is the primal-dual active
set method.

Extracting the reduced matrix costs as much as a dozen products with A, and a new size each time
throws the linear solver away. Neither is needed: SNES is given a Jacobian whose submatrices exist
in name only and a linear solver that works in the full space, with the identity in the rows and
columns of the active dofs. That is the reduced system exactly. What is behind the prefix
`signorini_ksp_` and `signorini_pc_` is this inner solver.

It stops when its residual is a small part of what the active set's errors will leave anyway, so a
Newton step with a wrong set ends early and one with the right set is the last.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from petsc4py import PETSc

from .errors import NotConverged
from .multigrid import Grid
from .options import PREFIX, defaults

# What can be set through options only. Full steps are the primal-dual active set method: PETSc's
# usual line search tests a norm that may rightly rise. A contact dof counts as active within the
# zero tolerance of its bound; PETSc's is absolute and would freeze data of small magnitude.
DEFAULTS = {"snes_linesearch_type": "basic", "snes_vi_zero_tolerance": 1e-30}

LINEAR_SHARE = 0.3
"""What the linear solver leaves at the end, in parts of what the residual may be."""

SET_SHARE = 0.1
"""What it leaves while the active set is wrong, in parts of what that adds to the residual."""

Monitor = Callable[[int, float, int, int], None]
"""Called on all ranks after each step: step, residual norm, active dofs, linear iterations."""


@dataclass(frozen=True)
class Iterations:
    """What the solver did: Newton steps, linear (CG) iterations, and the preconditioner taken."""

    newton: int
    linear: int
    preconditioner: str


class ContactRows:
    """The rows of A that belong to contact dofs, to be had without a product with all of A.

    Attributes:
        dofs: Owned dofs with a bound, local numbers, ascending, shape (n,).
        lower: Their bounds α, shape (n,).
        diagonal: Their diagonal entries of A, shape (n,).
    """

    def __init__(self, A: PETSc.Mat, lower: PETSc.Vec):
        """Copy the rows of the dofs with a finite bound."""
        self.dofs = np.flatnonzero(lower.array_r > PETSc.NINFINITY).astype(np.int32)
        self.lower = lower.array_r[self.dofs].copy()
        diagonal = A.getDiagonal()
        self.diagonal = diagonal.array_r[self.dofs].copy()
        diagonal.destroy()
        first = A.getOwnershipRange()[0]
        rows = PETSc.IS().createGeneral((self.dofs + first).astype(PETSc.IntType), comm=A.comm)
        columns = PETSc.IS().createStride(A.getLocalSize()[1], first, 1, comm=A.comm)
        self._rows = A.createSubMatrix(rows, columns)
        self._product = self._rows.createVecLeft()
        for thing in (rows, columns):
            thing.destroy()

    def times(self, x: PETSc.Vec) -> npt.NDArray[np.float64]:
        """A x in the contact dofs, shape (n,)."""
        self._rows.mult(x, self._product)
        return self._product.array_r.copy()

    def destroy(self) -> None:
        """Free the copy."""
        self._rows.destroy()
        self._product.destroy()


def solve_vi(
    grid: Grid,
    contact: ContactRows,
    b: PETSc.Vec,
    lower: PETSc.Vec,
    x: PETSc.Vec,
    residual: PETSc.Vec,
    *,
    load: float,
    tolerance: float = 1e-8,
    monitor: Monitor | None = None,
    level: int | None = None,
) -> Iterations:
    """Solve the variational inequality in place.

    Args:
        grid: The matrix A, symmetric positive definite, Dirichlet rows and columns those of the
            identity, and the multigrid that goes with it.
        contact: The rows of A of the dofs with a bound.
        b: Right-hand side, with the Dirichlet values in their rows.
        lower: Bound of each dof, `PETSc.NINFINITY` where there is none.
        x: On entry the start, with the Dirichlet values in place; on exit the solution.
        residual: On exit A x − b.
        load: Norm that the residual is measured against, `System.load`; the same for all starts.
        tolerance: The solve ends when the residual's norm is below ``tolerance * load``.
        monitor: Called after each step.
        level: Named in the error.

    Raises:
        NotConverged: With the name PETSc gives to the reason.
    """
    A, comm = grid.matrix, grid.matrix.getComm()
    target = tolerance * load or 1e-300
    snes = PETSc.SNES().create(comm)
    snes.setOptionsPrefix(PREFIX)
    snes.setType(PETSc.SNES.Type.VINEWTONRSLS)

    def function(_: PETSc.SNES, x: PETSc.Vec, f: PETSc.Vec) -> None:
        A.mult(x, f)
        f.axpy(-1.0, b)

    snes.setFunction(function, residual)
    linear = _MaskedSolver(grid, contact, x, residual, LINEAR_SHARE * target)
    jacobian = PETSc.Mat().createPython(A.getSizes(), linear, comm=comm)
    jacobian.setUp()
    snes.setJacobian(lambda *_: None, jacobian)
    upper = b.duplicate()
    upper.set(PETSc.INFINITY)
    snes.setVariableBounds(lower, upper)
    # rtol is relative to the start, so a warm start needs the absolute one
    snes.setTolerances(rtol=0.0, atol=target, max_it=100)
    outer = snes.getKSP()
    outer.setOptionsPrefix(PREFIX + "reduced_")
    outer.setType(PETSc.KSP.Type.PYTHON)
    outer.setPythonContext(linear)
    outer.getPC().setType(PETSc.PC.Type.NONE)

    def report(snes: PETSc.SNES, step: int, norm: float) -> None:
        if monitor is not None:
            number = _active_dofs(snes.getSolution(), residual, contact)
            monitor(step, norm, number, snes.getLinearSolveIterations())

    snes.setMonitor(report)
    with defaults(DEFAULTS):
        snes.setFromOptions()
    snes.solve(None, x)
    reason = snes.getConvergedReason()
    iterations = Iterations(
        snes.getIterationNumber(), snes.getLinearSolveIterations(), linear.describe()
    )
    linear_reason = linear.ksp.getConvergedReason()
    for thing in (snes, jacobian, upper):
        thing.destroy()
    linear.free()
    if reason < 0:
        words = _name(PETSc.SNES.ConvergedReason, reason)
        if linear_reason < 0:
            words += f" (KSP {_name(PETSc.KSP.ConvergedReason, linear_reason)})"
        raise NotConverged(
            f"SNES stopped with {words} after {iterations.newton} Newton steps "
            f"and {iterations.linear} linear iterations",
            level,
        )
    return iterations


class _MaskedSolver:
    """What SNES takes for the reduced Jacobian and for the linear solver, in the full space.

    Attributes:
        ksp: The inner solver, CG with the grid's V-cycle unless options say otherwise.
    """

    def __init__(
        self, grid: Grid, contact: ContactRows, x: PETSc.Vec, residual: PETSc.Vec, atol: float
    ):
        self._grid, self._contact, self._x, self._residual = grid, contact, x, residual
        self._first = grid.matrix.getOwnershipRange()[0]
        self._is_active = np.zeros(len(contact.dofs), dtype=bool)
        self._rhs, self._step = x.duplicate(), x.duplicate()
        self.ksp = ksp = PETSc.KSP().create(grid.matrix.getComm())
        ksp.setOptionsPrefix(PREFIX)
        ksp.setOperators(grid.masked)
        ksp.setType(PETSc.KSP.Type.CG)
        ksp.setTolerances(rtol=0.0, atol=atol, max_it=1000)
        ksp.getPC().setType(PETSc.PC.Type.PYTHON)
        ksp.getPC().setPythonContext(grid)
        ksp.setFromOptions()
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
        for thing in (self.ksp, self._rhs, self._step):
            thing.destroy()

    # as the context of the Jacobian

    def mult(self, _: PETSc.Mat, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """The Jacobian is A."""
        self._grid.matrix.mult(x, y)

    def createSubMatrix(
        self, matrix: PETSc.Mat, rows: PETSc.IS, columns: PETSc.IS, _: PETSc.Mat | None
    ) -> PETSc.Mat:
        """Note which dofs are inactive, and return a matrix of the right size."""
        contact, inactive = self._contact, rows.array
        numbers = contact.dofs + self._first
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
        contact = self._contact
        active = contact.dofs[self._is_active]
        self._grid.fix(active, deep=self._uses_grid)
        self._at_start = self._x.array_r[contact.dofs], self._residual.array_r[contact.dofs]
        self._residual.copy(self._rhs)
        self._rhs.array[active] = 0.0
        self._step.set(0.0)
        self.ksp.setOperators(self._grid.masked)
        self.ksp.solve(self._rhs, self._step)
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
        contact, active = self._contact, self._is_active
        x, force = self._at_start
        gap = x - step.array_r[contact.dofs] - contact.lower
        force = force - contact.times(step)
        wrong = np.where(active, force, contact.diagonal * gap)
        local = float(np.sum(np.minimum(wrong, 0.0) ** 2))
        return float(np.sqrt(step.getComm().tompi4py().allreduce(local)))


class _Nominal:
    """A matrix that is there for its size; nobody multiplies with it."""


def _active_dofs(x: PETSc.Vec, residual: PETSc.Vec, contact: ContactRows) -> int:
    """Number of dofs on their bound with a residual pushing them there, over all ranks."""
    on_bound = x.array_r[contact.dofs] <= contact.lower
    active = on_bound & (residual.array_r[contact.dofs] > 0)
    return int(x.getComm().tompi4py().allreduce(int(active.sum())))


def _name(reasons: type, value: int) -> str:
    """Name of a converged reason; several may share a value, the longest says most."""
    names = [n for n, v in vars(reasons).items() if v == value and n.isupper()]
    return max(names, key=len, default=str(value))
