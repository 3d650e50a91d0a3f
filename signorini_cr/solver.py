"""The discrete variational inequality (1.8), solved by PETSc's SNES `vinewtonrsls`.

Find u ∈ K_h with a_h(u, v − u) ≥ χ(v − u) for all v ∈ K_h. With A and b the matrix and the vector
of a_h and χ this is the complementarity problem

    (Au − b)_i ≥ 0,  u_i ≥ α_i,  (Au − b)_i (u_i − α_i) = 0   for the dofs i on Γ1,

and (Au − b)_i = 0 for all others. The reduced-space method drops the dofs that sit on their bound
with (Au − b)_i > 0, solves for the rest, and repeats: with full steps it is the primal-dual active
set method.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from .errors import NotConverged
from .garbage import release
from .multigrid import Grid
from .options import PREFIX, defaults, explained, read, read_number
from .reduced import LINEAR_SHARE, MaskedSolver

# What can be set through options only. Full steps are the primal-dual active set method: PETSc's
# usual line search tests a norm that may rightly rise. A contact dof counts as active within the
# zero tolerance of its bound; PETSc's is absolute and would freeze data of small magnitude.
DEFAULTS = {"snes_linesearch_type": "basic", "snes_vi_zero_tolerance": 0.0}

SET_TOLERANCE = 0.01
"""What dofs in the wrong set may have for a residual, in parts of what all may have together."""

SET_STEPS = 2
"""Newton steps to that end alone, when the residual as a whole is small enough already.

One less after as many steps: what takes long has been looked at often.
"""

NOISE = 4.0 * 2.0**-53
"""A residual below this times the diagonal times x is rounding; measured are 1 to 2 of these 4."""

DIVERGED_NAN = -4
"""PETSc's number; its name depends on the version."""

Monitor = Callable[[int, float, int, int], None]
"""Called after each step, on the ranks that have one: step, residual norm, active dofs, linear
iterations so far; the same on all ranks."""


@dataclass(frozen=True)
class Iterations:
    """What the solver did: Newton steps, linear (CG) iterations, and the preconditioner taken."""

    newton: int
    linear: int
    preconditioner: str


def solve_vi(
    grid: Grid,
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
        b: Right-hand side, with the Dirichlet values in their rows.
        lower: Bound of each dof, `PETSc.NINFINITY` for all but the grid's bounded ones.
        x: On entry the start, with the Dirichlet values in place; on exit the solution.
        residual: On exit A x − b.
        load: Norm that the residual is measured against, `System.load`; the same for all starts.
        tolerance: The solve ends when the residual's norm is below ``tolerance * load``, and what
            is due to the choice of the active set far below; or when it is lost in rounding, as it
            can be where the coefficient varies by many orders of magnitude.
        monitor: Called after each step.
        level: Named in the error.

    Raises:
        NotConverged: With the name PETSc gives to the reason.
        InputError: PETSc can't solve with the options that are set. On several ranks the grid's
            matrices are then left as they are, without the dofs taken out last.
    """
    operator, comm = grid.operator, grid.matrix.getComm()
    bounds = lower.array_r[operator.dofs]
    target = tolerance * load or 1e-300
    # looked up here, as the linear solver has to know; what is below rounding is all the same to it
    wanted = max(read_number("snes_atol", target), 1e-30 * target)
    snes = PETSc.SNES().create(comm)
    snes.setOptionsPrefix(PREFIX)
    snes.setType(PETSc.SNES.Type.VINEWTONRSLS)

    def function(_: PETSc.SNES, x: PETSc.Vec, f: PETSc.Vec) -> None:
        operator.mult(x, f)
        f.axpy(-1.0, b)

    snes.setFunction(function, residual)
    linear = MaskedSolver(grid, bounds, x, residual, LINEAR_SHARE * wanted)
    jacobian = PETSc.Mat().createPython(grid.matrix.getSizes(), linear, comm=comm)
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
        number = comm.tompi4py().allreduce(int(linear.active().sum()))
        if monitor is not None:
            monitor(step, norm, number, linear.iterations)

    start, for_the_set = 0.0, 0

    def converged(snes: PETSc.SNES, step: int, norms: tuple[float, float, float]) -> int:
        nonlocal start, for_the_set
        rtol, atol, _, _ = snes.getTolerances()
        norm, Reason = norms[2], PETSc.SNES.ConvergedReason
        if step == 0:
            start = norm
        if not np.isfinite(norm):
            return DIVERGED_NAN
        small = max(atol, rtol * start)
        if norm > small:
            lost = step > 1 and norm <= NOISE * grid.rounding(snes.getSolution())
            return Reason.CONVERGED_FNORM_ABS if lost else Reason.ITERATING
        allowed = SET_STEPS if step <= SET_STEPS else 1
        if step > 0 and for_the_set < allowed and linear.disputed() > SET_TOLERANCE * small:
            for_the_set += 1
            return Reason.ITERATING
        return Reason.CONVERGED_FNORM_ABS

    snes.setConvergenceTest(converged)
    # all ranks report, though there may be a monitor on one of them only
    if comm.tompi4py().allreduce(monitor is not None, op=MPI.LOR):
        snes.setMonitor(report)
    with defaults(DEFAULTS):
        read(snes)
    together = comm.getSize() == 1
    try:
        with explained():
            snes.solve(None, x)
        together = True
        reason, linear_reason = snes.getConvergedReason(), linear.ksp.getConvergedReason()
        iterations = Iterations(snes.getIterationNumber(), linear.iterations, linear.describe())
    finally:
        if together:  # a monitor may raise on one rank alone, which must not wait for the others
            grid.restore()
        release(outer, snes, jacobian, upper)
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


def _name(reasons: type, value: int) -> str:
    """Name of a converged reason; several may share a value, the longest says most."""
    names = [n for n, v in vars(reasons).items() if v == value and n.isupper()]
    return max(names, key=len, default=str(value))
