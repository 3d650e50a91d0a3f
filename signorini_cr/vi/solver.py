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
import numpy.typing as npt
from mpi4py import MPI
from petsc4py import PETSc

from ..errors import NotConverged
from ..garbage import release
from ..multigrid.cycle import Grid
from ..options import PREFIX, defaults, explained, read, read_number
from .reduced import LINEAR_SHARE, SET_SHARE, MaskedSolver
from .stopping import FLOWS, FORCES, LOST, NOISE, ROUNDED, STORED, Stiffness

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

PASSES = 6
"""Newton steps in an active set that does not change any more; they refine the solution."""

GAIN = 0.5
"""What a refinement must take away of what is wrong, or rounding is at work."""

DIVERGED_NAN, DIVERGED_ROUNDING = -4, -5
"""PETSc's number for what is not finite, whose name depends on the version, and for "no gain"."""

FloatArray = npt.NDArray[np.float64]

Monitor = Callable[[int, float, int, int], None]
"""Called after each step, on the ranks that have one: step, residual norm, active dofs, linear
iterations so far; the same on all ranks."""


@dataclass(frozen=True)
class Iterations:
    """What the solver did.

    Attributes:
        newton: Newton steps.
        linear: Linear (CG) iterations.
        preconditioner: The one taken, in words.
        force_error: What may be wrong with the contact forces, in parts of their sum: the largest
            of all classes of stiffness.
        imbalance: Largest residual of a class of stiffness in parts of its flows; 0 where there is
            one class only.
    """

    newton: int
    linear: int
    preconditioner: str
    force_error: float = 0.0
    imbalance: float = 0.0


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
    row_sums: Callable[[], FloatArray] | None = None,
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
        tolerance: The solve ends when the residual's norm is below ``tolerance * load``, or lost
            in rounding, and what is due to the choice of the active set far below; and the contact
            forces and each class of stiffness are converged for themselves, see `stopping`.
        monitor: Called after each step.
        level: Named in the error.
        row_sums: `System.row_sums`; without them all equations are of one class of stiffness.

    Raises:
        NotConverged: With the name PETSc gives to the reason, or what is lost in rounding.
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

    stiffness = Stiffness(grid, row_sums)

    def function(_: PETSc.SNES, x: PETSc.Vec, f: PETSc.Vec) -> None:
        stiffness.residual(x, b, f)

    snes.setFunction(function, residual)
    linear = MaskedSolver(
        grid, bounds, x, residual, LINEAR_SHARE * wanted, stiffness, max(1.0, wanted / target)
    )
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

    test = _Test(grid, b, linear, stiffness, target)

    def converged(snes: PETSc.SNES, step: int, norms: tuple[float, float, float]) -> int:
        return test(snes, step, norms[2])

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
        iterations = Iterations(
            snes.getIterationNumber(),
            linear.iterations,
            linear.describe(),
            test.force_error,
            test.imbalance,
        )
    finally:
        if together:  # a monitor may raise on one rank alone, which must not wait for the others
            grid.restore()
        release(outer, snes, jacobian, upper)
        linear.free()
        stiffness.free()
    if reason < 0:
        words = _name(PETSc.SNES.ConvergedReason, reason)
        if linear_reason < 0:
            words += f" (KSP {_name(PETSc.KSP.ConvergedReason, linear_reason)})"
        words = f"SNES stopped with {words}" if test.failure is None else f"{test.failure}; stopped"
        raise NotConverged(
            f"{words} after {iterations.newton} Newton steps "
            f"and {iterations.linear} linear iterations",
            level,
        )
    return iterations


class _Test:
    """Whether SNES may stop; see `stopping`.

    Attributes:
        force_error: What may be wrong with the contact forces, in parts of their sum.
        imbalance: Largest residual of a class of stiffness in parts of its flows.
        failure: Why it can't be done, if it can't.
    """

    def __init__(
        self, grid: Grid, b: PETSc.Vec, linear: MaskedSolver, stiffness: Stiffness, target: float
    ):
        """Start the tests; target is what the residual may be unless options say otherwise."""
        self._grid, self._b, self._target = grid, b, target
        self._linear, self._stiffness = linear, stiffness
        self._start = np.inf
        self._for_the_set = self._passes = 0
        self._forces = linear.forces()
        self.force_error = self.imbalance = np.inf
        self.failure: str | None = None

    def __call__(self, snes: PETSc.SNES, step: int, norm: float) -> int:
        """Decide; the same on all ranks."""
        Reason, linear, x = PETSc.SNES.ConvergedReason, self._linear, snes.getSolution()
        if not np.isfinite(norm):
            return DIVERGED_NAN
        if step == 0:
            self._start = norm
        rtol, atol, _, _ = snes.getTolerances()
        small = max(atol, rtol * self._start)
        before, self._forces = self._forces, linear.forces()
        loose = max(1.0, small / self._target)  # who sets a tolerance sets them all
        if step == 0:
            enough = norm == 0.0 or (loose > 1.0 and norm <= small)
            if enough:
                self.force_error = self.imbalance = 0.0
            return Reason.CONVERGED_FNORM_ABS if enough else Reason.ITERATING
        disputed, total, moved, in_dispute = self._sums(before)
        known, solved = self.force_error, self.imbalance
        self.force_error = self.imbalance = np.inf  # what was known of another set says nothing
        if norm > small and (step == 1 or norm > NOISE * self._grid.rounding(x)):
            return Reason.ITERATING
        allowed = SET_STEPS if step <= SET_STEPS else 1
        if self._for_the_set < allowed and disputed > SET_TOLERANCE * small:
            self._for_the_set += 1
            return Reason.ITERATING
        # the linear solver knows what it left, unless rounding has added to the residual; a dof
        # in the wrong set has its force there, its neighbours as much, and so may other forces
        sure = norm <= 2.0 * (linear.reached + disputed) and np.isfinite(linear.force_errors).all()
        errors = (linear.force_errors if sure else moved) + 2.0 * in_dispute
        errors += STORED * self._stiffness.magnitude(x, linear.active())
        noise = np.zeros_like(total)
        if (errors > loose * FORCES * total).any():
            noise = LOST * NOISE * self._stiffness.magnitude(x)
            errors = np.where((errors <= noise) & (total <= noise), 0.0, errors)
        self.force_error = float(np.max(errors / np.maximum(total, 1e-300), initial=0.0))
        self.imbalance = self._stiffness.imbalance(x, self._b, snes.getFunction()[0])
        if self.force_error <= loose * FORCES and self.imbalance <= loose * FLOWS:
            return Reason.CONVERGED_FNORM_ABS
        if (in_dispute > np.maximum(loose * FORCES * total, noise)).any():
            self.force_error = self.imbalance = np.inf  # of another set
            return Reason.ITERATING
        self._passes += 1
        figures = (self.force_error, known, FORCES), (self.imbalance, solved, FLOWS)
        gains = any(loose * limit < now <= GAIN * last for now, last, limit in figures)
        if gains and self._passes < PASSES:
            linear.reduction = SET_SHARE * min(1.0, loose * FLOWS / max(self.imbalance, 1e-300))
            return Reason.ITERATING
        if max(self.force_error, self.imbalance) <= loose * ROUNDED:
            return Reason.CONVERGED_FNORM_ABS
        self.failure = self._lost_in_rounding(float(x.norm(PETSc.NormType.INFINITY)))
        return DIVERGED_ROUNDING

    def _lost_in_rounding(self, largest: float) -> str:
        """What to say to users; u_h is as large as given."""
        if self.force_error >= self.imbalance:
            known = f"the contact forces are known to {self.force_error:.1e} of their sum only"
        else:
            known = f"equations hold to {self.imbalance:.1e} of what they are made of only"
        return (
            f"{known}, {ROUNDED:.0e} is wanted. The rest is lost in rounding, as the stiffness "
            f"varies by a factor of {self._stiffness.contrast:.1e} and u_h is as large as "
            f"{largest:.1e}"
        )

    def _sums(self, before: FloatArray) -> tuple[float, FloatArray, FloatArray, FloatArray]:
        """Sum up contact forces.

        Returns:
            The norm of the residual in the dofs in dispute; and for each class of stiffness the
            forces, what they have changed by since ``before``, and those in dispute.
        """
        forces, linear = self._forces, self._linear
        active, disputed = linear.active(), linear.disputed()
        facts = [
            self._stiffness.sums(np.where(which, values, 0.0))
            for which, values in (
                (disputed, forces**2),
                (active, forces),
                (active, np.abs(forces - before)),
                (disputed, np.abs(forces)),
            )
        ]
        sums = self._grid.matrix.getComm().tompi4py().allreduce(np.array(facts))
        return float(np.sqrt(sums[0].sum())), sums[1], sums[2], sums[3]


def _name(reasons: type, value: int) -> str:
    """Name of a converged reason; several may share a value, the longest says most."""
    names = [n for n, v in vars(reasons).items() if v == value and n.isupper()]
    return max(names, key=len, default=str(value))
