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
from functools import cached_property

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from ..arrays import FloatArray, summed
from ..errors import InputError, NotConverged, fail_together
from ..garbage import release
from ..multigrid.cycle import Multigrid
from ..options import NEWTON, PREFIX, REDUCED_PREFIX, defaults, explained, read, read_number
from .active import ActiveSet
from .bounds import Bounds
from .extended import Extended
from .reduced import LINEAR_SHARE, SET_SHARE, ReducedSolver
from .stopping import FLOWS, FORCES, GAIN, LOST, NOISE, ROUNDED, STORED, TOUCHING, Stiffness
from .system import DATUM, System, Vectors

TOLERANCE = 1e-8
"""Norm that the residual may have, in parts of that at the most trivial start."""

SET_TOLERANCE = 0.01
"""Residual that dofs in the wrong set may have, in parts of what all may have together."""

SET_STEPS = 2
"""Newton steps that are made for that alone, when the residual as a whole is small already.

Only one where that is so after more steps than these: what takes long has been looked at often.
"""

LARGE = 1e10
"""Contrast of stiffness from which on it is told of when a solver gives up."""

ENTRIES = 3.0
"""So many times the largest entry is what c and b have in a row and in those of its neighbours."""

SLIGHT = 0.1
"""Part of what may be wrong with the forces that need not be worked out."""

PASSES = 6
"""Newton steps in an active set that does not change any more; they refine the solution."""

SWAPS = 10
"""Times that dofs may turn out to be in the wrong set when all else is well."""

INDEFINITE = (
    PETSc.KSP.ConvergedReason.DIVERGED_INDEFINITE_MAT,
    PETSc.KSP.ConvergedReason.DIVERGED_INDEFINITE_PC,
)
"""PETSc's words for a product with A, or with the preconditioner, that is not above 0."""

DIVERGED_NAN, DIVERGED_ROUNDING = -4, -5
"""PETSc's number for what is not finite, whose name depends on the version, and for "no gain"."""


Monitor = Callable[[int, float, int, int], None]
"""Called after each step, on the ranks that have one: step, residual norm, active dofs, linear
iterations so far; the same on all ranks."""


class Indefinite(NotConverged):
    """Error where the linear solver finds that it is not solving with a positive definite A."""


@dataclass(frozen=True)
class Iterations:
    """Steps that the solver took, and the accuracy that it reached.

    Attributes:
        newton: Newton steps.
        linear: Linear (CG) iterations.
        preconditioner: The one taken, in words.
        force_error: What may be wrong with the contact forces, in parts of their sum: the largest
            of all classes, see `stopping`; infinite where a looser tolerance leaves no step to
            measure it by.
        imbalance: Largest residual of a class of stiffness in parts of its flows; 0 where there is
            one class only.
        extended: Whether forces are those of u_h to twice the digits, see `extended`.
    """

    newton: int
    linear: int
    preconditioner: str
    force_error: float
    imbalance: float
    extended: bool


def solve_vi(
    cycle: Multigrid,
    vectors: Vectors,
    scale: float,
    *,
    monitor: Monitor | None = None,
    system: System | None = None,
) -> Iterations:
    """Solve the variational inequality in place; collective.

    The solve ends when the residual's norm is below `TOLERANCE` times `scale`, or lost in rounding,
    and what is due to the choice of the active set far below; and the contact forces and each class
    of stiffness are converged for themselves, see `stopping`.

    Args:
        cycle: The preconditioner, with the matrix A on its finest grid: symmetric positive
            definite, Dirichlet rows and columns those of the identity. A is whole on return, and
            after errors, too.
        vectors: Right-hand side and bounds, start and solution.
        scale: Norm that the residual is measured against, `System.residual_scale`; the same for
            all starts.
        monitor: Called after each step.
        system: What is solved, if its data may be asked; else all equations are of one class of
            stiffness, all contact is one neighbourhood, and what is lost in rounding stays so.

    Raises:
        NotConverged: With the name PETSc gives to the reason, or what is lost in rounding; an
            `Indefinite` where CG has seen that A is not positive definite.
        InputError: PETSc can't solve with the options that are set.
    """
    target = TOLERANCE * scale or 1e-300
    # looked up here, as the linear solver has to know; what is below rounding is all the same to it
    wanted = max(read_number("snes_atol", target), 1e-30 * target)
    snes = PETSc.SNES().create(cycle.matrix.getComm())
    comm = snes.getComm().tompi4py()
    known = (None, None) if system is None else (system.row_sums, system.windows)
    stiffness = Stiffness(cycle.finest, *known)
    bounds = Bounds(*(each.array_r[cycle.operator.dofs] for each in (vectors.lower, vectors.upper)))
    linear = ReducedSolver(
        cycle,
        bounds,
        snes,
        vectors,
        LINEAR_SHARE * wanted,
        stiffness,
        max(1.0, wanted / target),
    )
    test = NewtonTest(cycle, vectors.b, linear, stiffness, target, system)
    things: tuple[PETSc.Object, ...] = ()
    try:
        things = _prepare(snes, linear, stiffness, vectors, target)
        with explained() as keep:
            snes.setConvergenceTest(keep(lambda snes, step, norms: test(snes, step, norms[2])))
            # all ranks report, though there may be a monitor on one of them only
            if comm.allreduce(monitor is not None, op=MPI.LOR):
                snes.setMonitor(keep(_reporting(comm, linear, monitor)))
            snes.solve(None, vectors.x)
            reason, inner = snes.getConvergedReason(), linear.ksp.getConvergedReason()
            extended = test.doubtful and reason > 0
            if extended:
                test.settle(vectors, bounds)
        if test.forceless and not extended:
            vectors.residual.array[linear.active_now().dofs] = 0.0
        iterations = Iterations(
            snes.getIterationNumber(),
            linear.iterations,
            linear.describe(),
            float(test.force_error),
            float(test.imbalance),
            extended,
        )
    finally:
        release(snes, *things)
        linear.free()
        stiffness.free()
    if reason < 0 or test.failure:
        why = test.failure or _stopped(reason, inner, stiffness.contrast)
        kind = Indefinite if inner in INDEFINITE and not test.failure else NotConverged
        raise kind(
            f"{why} after {iterations.newton} Newton steps "
            f"and {iterations.linear} linear iterations"
        )
    return iterations


def _prepare(
    snes: PETSc.SNES, linear: ReducedSolver, stiffness: Stiffness, vectors: Vectors, target: float
) -> tuple[PETSc.Object, ...]:
    """Tell SNES what to solve, and what solves its reduced systems; return what is to be freed."""
    snes.setOptionsPrefix(PREFIX)
    outer = snes.getKSP()
    outer.setOptionsPrefix(REDUCED_PREFIX)
    outer.setType(PETSc.KSP.Type.PYTHON)
    outer.setPythonContext(linear)
    outer.getPC().setType(PETSc.PC.Type.NONE)
    snes.setTolerances(atol=target)
    with defaults(NEWTON):
        read(snes)
    if outer.getType() != PETSc.KSP.Type.PYTHON:
        raise InputError(
            f"PETSc can't solve with -{REDUCED_PREFIX}ksp_type {outer.getType()}: it needs the "
            f"method mult of a matrix that is never made; see -{PREFIX}ksp_type"
        )
    if snes.getType() == PETSc.SNES.Type.VINEWTONSSLS:
        raise InputError(
            f"PETSc can't solve with -{PREFIX}snes_type {snes.getType()}: it needs the method"
            " diagonalScale of a matrix that is never made"
        )
    # after the type, which brings functions of its own
    snes.setFunction(lambda _, x, r: stiffness.residual(x, vectors.b, r), vectors.residual)
    snes.setVariableBounds(vectors.lower, vectors.upper)
    return outer, linear.set_jacobian()


def _reporting(
    comm: MPI.Comm, linear: ReducedSolver, monitor: Monitor | None
) -> Callable[[PETSc.SNES, int, float], None]:
    """Make what calls the monitor, which only some of the ranks may have."""

    def report(_: PETSc.SNES, step: int, norm: float) -> None:
        number = comm.allreduce(int(linear.active_now().mask.sum()))
        error = None
        try:
            if monitor is not None:
                monitor(step, norm, number, linear.iterations)
        except MemoryError:
            raise  # at once, there may be none left to talk about it
        except Exception as caught:
            error = caught
        fail_together(comm, error)

    return report


def _stopped(reason: int, inner: int, contrast: float) -> str:
    """Say why SNES gave up, and perhaps the linear solver before it."""
    words = f"SNES stopped with {_name(PETSc.SNES.ConvergedReason, reason)}"
    if inner < 0:
        words += f" (KSP {_name(PETSc.KSP.ConvergedReason, inner)})"
    if contrast > LARGE:
        words += f", as the stiffness varies by a factor of {contrast:.1e}"
    return words


class NewtonTest:
    """Test that decides when SNES may stop; see `stopping`.

    Attributes:
        force_error: What may be wrong with the contact forces, in parts of their sum.
        imbalance: Largest residual of a class of stiffness in parts of its flows.
        forceless: Whether all forces are rounding, and there are none.
        doubtful: Whether SNES has come as far as it can in double precision, which is not enough.
        failure: Why it can't be done, if it can't.
    """

    def __init__(
        self,
        cycle: Multigrid,
        b: PETSc.Vec,
        linear: ReducedSolver,
        stiffness: Stiffness,
        target: float,
        system: System | None,
    ):
        """Start the tests; target is what the residual may be unless options say otherwise."""
        self._cycle, self._b, self._target = cycle, b, target
        self._linear, self._stiffness, self._system = linear, stiffness, system
        # now, as a monitor may change the data
        self._rounded = 0.0 if system is None else system.data_rounded()
        self._start, self._slack = np.inf, 1.0
        self._for_the_set = self._passes = self._swaps = 0
        self._forces = linear.forces()
        self.force_error = self.imbalance = np.inf
        self.doubtful = self.forceless = False
        self.failure = ""

    def __call__(self, snes: PETSc.SNES, step: int, norm: float) -> int:
        """Decide; the same on all ranks."""
        Reason = PETSc.SNES.ConvergedReason
        if not np.isfinite(norm):
            return DIVERGED_NAN
        small = self._small(snes, step, norm)
        before, self._forces = self._forces, self._linear.forces()
        if step == 0:
            done = self._accept_start(norm, small)
            return Reason.CONVERGED_FNORM_ABS if done else Reason.ITERATING
        force_error, imbalance = self.force_error, self.imbalance
        self._forget()
        facts = self._step_forces(before)
        if self._is_large(snes, step, norm, small) or self._go_on_for_the_set(step, small, facts):
            return Reason.ITERATING
        noise = self._measure(snes, norm, facts)
        if self.force_error <= self._slack * FORCES and self.imbalance <= self._slack * FLOWS:
            return Reason.CONVERGED_FNORM_ABS
        if self._try_another_set(facts, noise) or self._refine(force_error, imbalance):
            return Reason.ITERATING
        return self._as_far_as_it_goes(snes.getSolution())

    def _small(self, snes: PETSc.SNES, step: int, norm: float) -> float:
        """Compute what the residual's norm may be; a tolerance looser than ours loosens all."""
        if step == 0:
            self._start = norm
        rtol, atol, _, _ = snes.getTolerances()
        small = max(atol, rtol * self._start)
        self._slack = max(1.0, small / self._target)
        return float(small)

    def _accept_start(self, norm: float, small: float) -> bool:
        """Note that nothing is wrong if no step is needed; return whether that is so.

        By our own tolerance one is made, to look at the set.
        """
        enough = norm == 0.0 or (self._slack > 1.0 and norm <= small)
        if enough:
            self.imbalance = 0.0
            self.force_error = 0.0 if norm == 0.0 else np.inf
        return enough

    def _forget(self) -> None:
        """Forget what was measured in another set, as it says nothing."""
        self.force_error = self.imbalance = np.inf
        self.forceless = False

    def _is_large(self, snes: PETSc.SNES, step: int, norm: float, small: float) -> bool:
        """Tell whether the residual is too large, and no rounding; collective."""
        if norm <= small:
            return False
        active = self._linear.active.dofs
        finest = self._cycle.finest
        return step == 1 or norm > NOISE * finest.rounding(snes.getSolution(), active)

    def _go_on_for_the_set(self, step: int, small: float, facts: _StepForces) -> bool:
        """Count a step that is made only as dofs are in the wrong set; return whether it is."""
        allowed = SET_STEPS if step <= SET_STEPS else 1
        wrong = facts.misclassified_norm > SET_TOLERANCE * small
        if self._for_the_set >= allowed or not wrong:
            return False
        self._for_the_set += 1
        return True

    def _measure(self, snes: PETSc.SNES, norm: float, facts: _StepForces) -> FloatArray:
        """Work out what may be wrong; return what of the forces is rounding; collective."""
        x, residual = snes.getSolution(), snes.getFunction()[0]
        errors, noise = self._force_errors(x, norm, facts)
        self.force_error = float(errors.max(initial=0.0))
        active = self._linear.active.dofs
        self.imbalance = self._stiffness.imbalance(x, self._b, residual, active)
        return noise

    def _try_another_set(self, facts: _StepForces, noise: FloatArray) -> bool:
        """Count a step that is made for another set; return whether it is.

        That is so where dofs in the wrong set are what is wrong, and were so not too often. What
        was measured in this set says nothing of that one.
        """
        allowed = np.maximum(self._slack * FORCES * facts.sizes, noise)
        if not (facts.misclassified > allowed).any():
            return False
        self._swaps += 1
        if self._swaps >= SWAPS:
            return False
        self._forget()
        return True

    def _refine(self, force_error: float, imbalance: float) -> bool:
        """Have the linear solver leave less in the same set, if that has helped; return whether.

        Args:
            force_error: As it was a step before.
            imbalance: The same.
        """
        self._passes += 1
        figures = (self.force_error, force_error, FORCES), (self.imbalance, imbalance, FLOWS)
        gains = any(self._slack * most < now <= GAIN * last for now, last, most in figures)
        if not gains or self._passes >= PASSES:
            return False
        reduction = min(1.0, self._slack * FLOWS / max(self.imbalance, 1e-300))
        self._linear.reduction = SET_SHARE * reduction
        return True

    def _as_far_as_it_goes(self, x: PETSc.Vec) -> int:
        """End where rounding has the last word: go to twice the digits, put up with it, or fail."""
        if self._system is not None:
            self.doubtful = True
            return int(PETSc.SNES.ConvergedReason.CONVERGED_FNORM_ABS)
        if max(self.force_error, self.imbalance) <= self._slack * ROUNDED:
            return int(PETSc.SNES.ConvergedReason.CONVERGED_FNORM_ABS)
        self.failure = self._lost_in_rounding(x)
        return DIVERGED_ROUNDING

    def settle(self, vectors: Vectors, bounds: Bounds) -> None:
        """Go on to twice the digits where double precision is not enough; collective."""
        system = self._system
        assert system is not None
        extended = Extended(
            self._linear,
            self._cycle.operator,
            bounds,
            self._stiffness,
            vectors,
            self._masses,
            system.offset,
        )
        try:
            loads = system.chi[system.bounded]
            settled = extended.settle(system.data_rounding, loads, self._slack)
            active = extended.active.dofs
        except NotConverged as failure:
            self.failure = failure.reason
            return
        finally:
            extended.free()
        self.force_error = settled.error
        x, b, residual = vectors.x, vectors.b, vectors.residual
        self.imbalance = self._stiffness.imbalance(x, b, residual, active)
        if not max(self.force_error, self.imbalance) <= self._slack * ROUNDED:  # NaN is neither
            self.failure = self._lost_in_rounding(x, settled.from_data)

    def _force_errors(
        self, x: PETSc.Vec, norm: float, facts: _StepForces
    ) -> tuple[FloatArray, FloatArray]:
        """Estimate the errors of the forces of each class, in parts, and their rounding."""
        stiffness, slack = self._stiffness, self._slack
        # the linear solver knows what it left, unless rounding has added to the residual; a
        # misclassified dof has its force there, its neighbours as much, and so may other forces
        left, reached = self._linear.force_errors, self._linear.reached
        sure = norm <= 2.0 * (reached + facts.misclassified_norm) and np.isfinite(left).all()
        errors = (left if sure else facts.moved) + 2.0 * facts.misclassified
        errors += STORED * stiffness.magnitude(x, facts.active.mask)
        errors += self._close(x, facts.active, moving=not sure)
        total = facts.forces.sum()
        of_data = np.where(facts.forces > 0.0, self._of_data(x, facts.active, total), 0.0)
        with np.errstate(over="ignore"):  # no forces at all: everything is too much beside them
            relative = np.maximum(
                errors / np.maximum(facts.sizes, 1e-300), of_data / max(total, 1e-300)
            )
        noise = np.zeros_like(errors)
        if (relative > slack * FORCES).any():
            noise = LOST * NOISE * stiffness.magnitude(x)
            # what is lost in rounding is nothing beside all forces, or where there are none
            lost = (errors <= noise) & (facts.forces <= noise)
            beside = np.where(lost, noise.sum(), np.inf) / max(total, 1e-300)
            relative = np.where(beside <= slack * FORCES, beside, relative)
            if sure and not stiffness.varied and lost.all():
                made_of = np.maximum(stiffness.made_of, 1e-300)
                lost_part = noise / made_of
                if (lost_part <= slack * TOUCHING).all():
                    relative, self.forceless = lost_part, True
        return relative, noise

    def _close(self, x: PETSc.Vec, active: ActiveSet, moving: bool) -> FloatArray:
        """Sum the forces of dofs off the obstacle, but not certainly so, by class; collective."""
        operator, at = self._cycle.operator, x.array_r[active.bounded]
        reach = DATUM * (x.norm(PETSc.NormType.INFINITY) + self._offset)
        moved = 2.0 * self._linear.moved() if moving else 0.0
        gap = self._linear.bounds.gap(at)
        with np.errstate(over="ignore"):  # what is beyond all numbers is not known
            force = operator.diagonal * np.maximum(reach + moved - gap, 0.0)
        return self._stiffness.totals(np.where(active.mask, 0.0, force))

    def _of_data(self, x: PETSc.Vec, active: ActiveSet, total: float) -> float:
        """Estimate what rounding of the data may add to the forces, all together; collective.

        An entry of the matrix that c or b has a part in is off by a rounding of the largest in its
        cell, even where it is 0.

        Args:
            x: The iterate.
            active: Its active set.
            total: The sum of the forces.
        """
        if self._system is None:
            return 0.0
        sizes = np.abs(x.array_r[active.bounded]) + self._offset
        own = float((self._cycle.operator.diagonal * sizes)[active.mask].sum())
        rounded = self._rounded + 2.0 * DATUM * float(self._stiffness.comm.allreduce(own))
        # where it may count: no entry is larger than the largest on the diagonal
        sizes = x.norm(PETSc.NormType.NORM_1) + x.getSize() * self._offset
        most = ENTRIES * DATUM * self._stiffness.stiffest * sizes
        if total == 0.0 or most <= SLIGHT * FORCES * total or self._masses is None:
            return rounded
        own = float(self._masses @ (np.abs(x.array_r) + self._offset))
        return rounded + DATUM * float(self._stiffness.comm.allreduce(own))

    @cached_property
    def _masses(self) -> FloatArray | None:
        """`System.masses`; collective."""
        return None if self._system is None else self._system.masses()

    @property
    def _offset(self) -> float:
        return 0.0 if self._system is None else abs(self._system.offset)

    def _lost_in_rounding(self, x: PETSc.Vec, from_data: bool = False) -> str:
        """Say to users what is lost in rounding."""
        if self.force_error >= self.imbalance:
            known = f"the contact forces are known to {self.force_error:.1e} of their sum only"
        else:
            known = f"equations hold to {self.imbalance:.1e} of what they are made of only"
        largest = float(x.norm(PETSc.NormType.INFINITY)) + self._offset
        lost = "hangs on the last digit of the data" if from_data else "is lost in rounding"
        return (
            f"{known}, {ROUNDED:.0e} is wanted. The rest {lost}, as the stiffness varies by a "
            f"factor of {self._stiffness.contrast:.1e} and u_h is as large as {largest:.1e}; "
            "stopped"
        )

    def _step_forces(self, before: FloatArray) -> _StepForces:
        """Sum up contact forces; collective."""
        forces, active = self._forces, self._linear.active_now()
        misclassified = active.mask != self._linear.active.mask
        facts = [
            self._stiffness.sums(np.where(which, values, 0.0))
            for which, values in (
                (misclassified, forces**2),
                (active.mask, forces),
                (active.mask, np.abs(forces - before)),
                (misclassified, np.abs(forces)),
            )
        ]
        squares, sums, moved, wrong = summed(self._stiffness.comm, np.array(facts))
        sizes = np.maximum(sums, self._stiffness.least)
        return _StepForces(active, float(np.sqrt(squares.sum())), sums, sizes, moved, wrong)


@dataclass(frozen=True, eq=False)
class _StepForces:
    """Forces after a Newton step, over all ranks; sums have one figure a class of stiffness.

    Attributes:
        active: The active set of the iterate.
        misclassified_norm: Norm of the residual in the dofs that the last system had in the other
            set.
        forces: Sum of the forces on active dofs.
        sizes: What errors are measured against: that, and not less than `Stiffness.least`.
        moved: Sum of what they have changed by since the step before.
        misclassified: Sum of the forces on misclassified dofs.
    """

    active: ActiveSet
    misclassified_norm: float
    forces: FloatArray
    sizes: FloatArray
    moved: FloatArray
    misclassified: FloatArray


def _name(reasons: type, value: int) -> str:
    """Name of a converged reason; several may share a value, the longest says most."""
    names = [n for n, v in vars(reasons).items() if v == value and n.isupper()]
    return max(names, key=len, default=str(value))
