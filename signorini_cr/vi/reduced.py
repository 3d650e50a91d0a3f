"""The reduced systems of the active set method, solved without extracting them.

Extracting the reduced matrix costs as much as seven products with A (`benchmarks/submatrix.py`),
and a new size each time throws the linear solver away. Neither is needed: SNES is given a Jacobian
whose submatrices have a size and nothing else, and a linear solver that works in the full space,
with the identity in the rows and columns of the active dofs. That is the reduced system exactly.
What is behind the prefix `signorini_ksp_` and `signorini_pc_` is this inner solver.

It stops when its residual is a small part of what the active set's errors will leave anyway, so a
Newton step with a wrong set ends early and one with the right set is the last; but not before it is
certain of each contact dof's sign, or what it left undone would decide on the next active set, and
of the contact forces, which the residual says little about.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from ..arrays import FloatArray, summed
from ..garbage import release
from ..multigrid.cycle import SLOW, Grid, Multigrid
from ..options import PREFIX, REDUCED, defaults, read, read_word
from .active import ActiveSet
from .bounds import Bounds
from .stopping import FORCES, LOST, NOISE, Stiffness
from .system import Vectors

LINEAR_SHARE = 0.9
"""Part of what the residual may be that the linear solver leaves at the end."""

SET_SHARE = 0.3
"""Part that the linear solver leaves of what a wrong active set adds to the residual."""

SETTLED = 1.0
"""Part of its last change by which a contact dof's sign must be certain before the end."""

SETTLING_LIMIT = 1e-3
"""Part of what it may leave that the linear solver goes on to where signs stay open."""

FLOOR = 1e-10
"""Residuals below so many times the rounding of A x are not reduced further, whatever is open."""

DIGITS = 1e-6
"""Part of the residual that a correction may leave."""

CG_STEPS = 100
"""CG steps of one correction; the next one goes on."""

CAREFUL = 15
"""Newton steps after which a step must lower the energy: sets of active dofs may come back else."""

ARMIJO, HALVES = 0.1, 40
"""Part of what the slope promises by which it must, and how often a step is halved for that."""

Reason = PETSc.KSP.ConvergedReason


class FullJacobian:
    """The Jacobian as SNES sees it, a matrix of type python: A itself.

    SNES takes a submatrix from it for the inactive dofs and hands that to its linear solver, which
    is a `ReducedSolver` and needs none. A virtual submatrix, which PETSc makes where there is no
    other, takes no less to set up than a real one.
    """

    def __init__(self, A: PETSc.Mat):
        """Note A."""
        self._A = A

    def mult(self, _: PETSc.Mat, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """Compute y = A x."""
        self._A.mult(x, y)

    def createSubMatrix(
        self, matrix: PETSc.Mat, rows: PETSc.IS, columns: PETSc.IS, _: PETSc.Mat | None
    ) -> PETSc.Mat:
        """Make a matrix that has a size and nothing else."""
        sizes = [(index.getLocalSize(), PETSc.DECIDE) for index in (rows, columns)]
        sized = PETSc.Mat().createPython(sizes, comm=matrix.getComm())
        sized.setPythonContext(_Size())
        sized.setUp()
        sized.setOption(PETSc.Mat.Option.SPD, True)  # PETSc need not find that out
        return sized


class _Size:
    """The context of a matrix that nobody multiplies with."""


class ReducedSolver:
    """The linear solver of SNES, a KSP of type python that works in the full space.

    Attributes:
        bounds: Of the bounded dofs.
        ksp: The inner solver, CG with the V-cycle unless options say otherwise.
        iterations: Its steps so far.
        active: The active set of the last reduced system.
        reached: Norm of the residual that it left last, that of rounding where it left less
            and rounding is next to nothing.
        force_errors: What it left wrong with the forces on active dofs, summed over each class of
            stiffness, by the last change of the forces and the rate at which it converged;
            infinite where that is not known.
        reduction: What part of its residual it may leave where that is small enough from the start.
    """

    def __init__(
        self,
        cycle: Multigrid,
        bounds: Bounds,
        snes: PETSc.SNES,
        vectors: Vectors,
        atol: float,
        stiffness: Stiffness,
        slack: float = 1.0,
    ):
        """Set the inner solver up.

        Args:
            cycle: The preconditioner, with the matrix on its finest grid.
            bounds: Of that grid's bounded dofs.
            snes: The solver that it works for, which knows the active set.
            vectors: Right-hand side, and where SNES keeps the iterate and the residual.
            atol: What the linear solver may leave at the end.
            stiffness: Classes of these dofs.
            slack: How many times more than usual may be wrong with the forces.
        """
        self._cycle, self.bounds, self._snes = cycle, bounds, snes
        self._x, self._residual, self._b = vectors.x, vectors.residual, vectors.b
        self._stiffness, self._share = stiffness, slack * FORCES
        self.active = ActiveSet.none(cycle.operator.dofs)
        self.reached, self.reduction, self.iterations = np.inf, SET_SHARE, 0
        self._cut, self._comm = True, snes.getComm().tompi4py()
        self.force_errors: FloatArray = np.full(stiffness.number, np.inf)
        self._step, self._stays = self._x.duplicate(), False
        self.ksp = ksp = PETSc.KSP().create(self.matrix.getComm())
        ksp.setOptionsPrefix(PREFIX)
        ksp.setOperators(self.matrix)
        ksp.setTolerances(atol=atol)
        with defaults(REDUCED):
            read(ksp)
        self._is_cg = ksp.getType() == PETSc.KSP.Type.CG
        if self._is_cg:
            read_word("ksp_norm_type", ("unpreconditioned",))  # `LinearTest` decides by no other
            ksp.setNormType(PETSc.KSP.NormType.UNPRECONDITIONED)
        elif ksp.getTolerances()[1] == atol:  # preconditioned norms may be much smaller
            ksp.setTolerances(atol=SETTLING_LIMIT * atol)
        self._uses_cycle = ksp.getPC().getType() == PETSc.PC.Type.PYTHON
        if self._uses_cycle:
            ksp.getPC().setPythonContext(cycle)

    @property
    def matrix(self) -> PETSc.Mat:
        """A."""
        return self._cycle.matrix

    def set_jacobian(self) -> PETSc.Mat:
        """Give SNES the matrix that its method works with; return that, which is to be freed."""
        sizes = self._b.getSizes(), self._b.getSizes()
        context, comm = FullJacobian(self.matrix), self._snes.getComm()
        jacobian = PETSc.Mat().createPython(sizes, context, comm=comm)
        jacobian.setUp()
        self._snes.setJacobian(lambda *_: None, jacobian)
        return jacobian

    def describe(self) -> str:
        """Say which preconditioner was taken, and why."""
        if self._uses_cycle:
            return self._cycle.describe()
        return f"{self.ksp.getPC().getType()} (option -{PREFIX}pc_type)"

    def free(self) -> None:  # "destroy" is what PETSc calls a context with
        """Free everything but the cycle."""
        if self._stays:  # but nothing that would keep all the meshes
            self.ksp.setConvergenceTest(None)
            if self._uses_cycle:
                self.ksp.getPC().setPythonContext(None)
        release(self.ksp, self._step)

    def solve(self, outer: PETSc.KSP, _: PETSc.Vec, reduced: PETSc.Vec) -> None:
        """Solve the reduced system; its right-hand side is the residual that SNES keeps."""
        self._stiffness.sort(self._x, self._b)
        inactive, first = self._snes.getVIInactiveSet().array, self.matrix.getOwnershipRange()[0]
        self.active = ActiveSet.without(self._cycle.operator.dofs, inactive, first)
        without = self.active.dofs  # for SNES, whatever is held from here on
        careful = self._snes.getIterationNumber() >= CAREFUL
        if careful:
            self._hold()
        test = self._without_active()
        if test.slow:  # from the start, which one step of a factorisation makes up for
            self._cycle.give_up()
            test = self._without_active()
        self.reached, self.force_errors = test.reached, test.force_errors
        next_to_nothing = SETTLING_LIMIT * self.ksp.getTolerances()[1]
        # with several classes what is rounding in one may be much in another
        if test.reached < next_to_nothing and not self._stiffness.varied:
            rounding = NOISE * self._cycle.finest.rounding(self._x, self.active.dofs)
            if rounding <= next_to_nothing:
                self.reached = max(test.reached, rounding)
        if careful:
            self._shorten()
        # piece by piece, as a mask would take memory of the size of x, whose first touch takes long
        head, *others = np.split(self._step.array_r, without)
        np.concatenate([head, *(piece[1:] for piece in others)], out=reduced.array)
        outer.setIterationNumber(self.ksp.getIterationNumber())
        outer.setConvergedReason(self.ksp.getConvergedReason())

    def _hold(self) -> None:
        """Keep all dofs on their bounds there, but for one where the last step was not cut short.

        The primal-dual method, which frees all that pull, may go round in circles where A is no
        M-matrix, as on thin cells. This is the primal one, in which no energy comes back.
        """
        bounded = self.active.bounded
        forces, gap = self.forces(), self.bounds.gap(self._x.array_r[bounded])
        pull = np.where(gap <= 0.0, -forces, 0.0)
        most = float(pull.max(initial=0.0))
        pulls_most = most == max(self._comm.allgather(most)) > 0.0
        freed = int(pull.argmax()) if pulls_most and not self._cut else None
        self.active = ActiveSet.on_bounds(bounded, gap, freed)

    def _shorten(self) -> None:
        """Halve the step until ½ x·A x − b·x falls along the way that the bounds leave of it."""
        x, at, share = self._x.array_r, self._cycle.operator.dofs, 1.0
        way, image = self._x.duplicate(), self._x.duplicate()
        for _ in range(HALVES):
            way.array[:] = -share * self._step.array_r
            moved = np.clip(x[at] + way.array_r[at], self.bounds.lower, self.bounds.upper)
            way.array[at] = moved - x[at]
            self.matrix.mult(way, image)
            slope = self._residual.dot(way)
            if slope + 0.5 * way.dot(image) <= ARMIJO * slope:
                break
            share *= 0.5
        clipped = bool((moved != x[at] - share * self._step.array_r[at]).any())
        self._cut = self._comm.allreduce(clipped, op=MPI.LOR) or share < 1.0
        self._step.scale(share)
        release(way, image)

    def _without_active(self) -> LinearTest:
        """Solve with active dofs left out of matrices and residual.

        The matrices are whole afterwards whatever happens. After an error the residual is not, as
        PETSc keeps it locked; it is of no use then.
        """
        forces = self._residual.array_r[self.active.bounded].copy()
        self._residual.array[self.active.dofs] = 0.0
        with self._cycle.constrained(self.active.dofs, deep=self._uses_cycle):
            test = self._run(forces)
        self._residual.array[self.active.bounded] = forces
        return test

    def _run(self, forces: FloatArray) -> LinearTest:
        """Run the inner solver, and return what its test has found out."""
        system = ReducedSystem(
            self._cycle.finest, self._stiffness, self.active, self._x, self.bounds, forces
        )
        test = LinearTest(system, self._is_cg, self._share, self.reduction)
        if self._uses_cycle and self._cycle.may_give_up:
            test.patience = max(SLOW, self._cycle.patience - self.iterations)
        self.ksp.setConvergenceTest(test)
        try:
            self.ksp.solve(self._residual, self._step)
        except PETSc.Error:
            # PETSc crashes when it frees a KSP for whose vectors there was not memory enough
            self.ksp.incRef()
            self._stays = True
            raise
        self.iterations += self.ksp.getIterationNumber()
        return test

    def correction(self, active: ActiveSet, residual: PETSc.Vec) -> PETSc.Vec:
        """Solve a reduced system to `DIGITS`; collective.

        Args:
            active: The active set.
            residual: Right-hand side; what it has in active dofs does not count, and is lost.

        Returns:
            A vector that is 0 in active dofs, and holds until another system is solved.
        """
        residual.array[active.dofs] = 0.0
        start = 0.0

        def test(_: PETSc.KSP, iteration: int, norm: float) -> int:
            nonlocal start
            start = norm if iteration == 0 else start
            if not np.isfinite(norm):
                return Reason.DIVERGED_NANORINF
            if norm <= DIGITS * start:
                return Reason.CONVERGED_RTOL
            return Reason.ITERATING if iteration < CG_STEPS else Reason.CONVERGED_ITS

        with self._cycle.constrained(active.dofs, deep=self._uses_cycle):
            self.ksp.setConvergenceTest(test)
            self.ksp.solve(residual, self._step)
        self.iterations += self.ksp.getIterationNumber()
        return self._step

    def moved(self) -> FloatArray:
        """Return how far the last step took the bounded dofs, shape (n,)."""
        moved: FloatArray = np.abs(self._step.array_r[self.active.bounded])
        return moved

    def active_now(self) -> ActiveSet:
        """Return the active set of the iterate as it is now, which SNES will go on with."""
        bounded = self.active.bounded
        return ActiveSet.of(bounded, self.bounds.gap(self._x.array_r[bounded]), self.forces())

    def forces(self) -> FloatArray:
        """Return the residual in the bounded dofs, above 0 where it pushes them off, shape (n,)."""
        bounded = self.active.bounded
        return self.bounds.sign(self._x.array_r[bounded]) * self._residual.array_r[bounded]


@dataclass(frozen=True, eq=False)
class Outlook:
    """Effect that a step would have on the contact boundary, over all ranks.

    Attributes:
        wrong: Norm of the part of the next residual that pulling forces and penetration will make.
        unsettled: Whether any dof could still change sides: its indicator is less than what it
            changed by last.
        moved: Change of the forces on active dofs, summed over each class of stiffness.
        forces: What these are measured against: their sums, and not less than `Stiffness.least`.
    """

    wrong: float
    unsettled: bool
    moved: FloatArray
    forces: FloatArray


@dataclass(frozen=True, eq=False)
class ReducedSystem:
    """A reduced system, and the contact boundary before it is solved.

    Attributes:
        grid: The finest grid, with the active dofs constrained.
        stiffness: Classes of the bounded dofs.
        active: The active set.
        x: The iterate.
        bounds: Bounds of the bounded dofs.
        forces: A u − b there, shape (n,).
    """

    grid: Grid
    stiffness: Stiffness
    active: ActiveSet
    x: PETSc.Vec
    bounds: Bounds
    forces: FloatArray

    def indicator(self, step: PETSc.Vec | None = None) -> FloatArray:
        """Compute what will be active, as `ActiveSet.indicator` has it, in forces, shape (n,).

        Args:
            step: What is subtracted from the iterate; None for nothing.
        """
        operator, forces = self.grid.operator, self.forces
        x = self.x.array_r[operator.dofs]
        if step is not None:
            x, forces = x - step.array_r[operator.dofs], forces - operator.times(step)
        bounds = self.bounds
        return self.active.indicator(bounds.sign(x) * forces, operator.diagonal * bounds.gap(x))

    def outlook(self, now: FloatArray, before: FloatArray) -> Outlook:
        """Judge a step by its indicator and by that of the step before; collective."""
        active, sums = self.active.mask, self.stiffness.sums
        wrong = np.where(active == self.active.changed(now).mask, 0.0, now)
        change = np.abs(now - before)
        facts = np.concatenate(
            [
                [wrong @ wrong, (np.abs(now) < SETTLED * change).any()],
                sums(np.where(active, change, 0.0)),
                sums(np.where(active, np.maximum(now, 0.0), 0.0)),
            ]
        )
        facts = summed(self.stiffness.comm, facts)
        moved, forces = facts[2:].reshape(2, -1)
        forces = np.maximum(forces, self.stiffness.least)
        return Outlook(float(np.sqrt(facts[0])), bool(facts[1]), moved, forces)

    def rounding(self) -> float:
        """Return the norm of A x's rounding over the dofs that are solved for; collective."""
        return NOISE * self.grid.rounding(self.x, self.active.dofs)

    def lost_forces(self) -> FloatArray:
        """Sum the forces that are lost in rounding over each class of stiffness; collective."""
        return LOST * NOISE * self.stiffness.magnitude(self.x)


class LinearTest:
    """The convergence test of the inner solver, in one reduced system.

    Attributes:
        reached: Norm of the residual, CG's being that of the reduced system.
        force_errors: As for `ReducedSolver`.
        patience: Number of steps after which the solver is too slow; None for any number.
        slow: Whether it has been.
    """

    def __init__(self, system: ReducedSystem, is_cg: bool, share: float, reduction: float):
        """Begin.

        Args:
            system: What is solved.
            is_cg: Whether the solver is CG; others may not have an iterate to look at.
            share: What may be wrong with the forces, in parts of their sum.
            reduction: `ReducedSolver.reduction`.
        """
        self._system, self._is_cg, self._share = system, is_cg, share
        self._reduction = reduction
        self._before = system.indicator()
        self.reached = np.inf
        self.force_errors: FloatArray = np.full(system.stiffness.number, np.inf)
        self._moved: FloatArray = self.force_errors
        self.patience: int | None = None
        self.slow = False
        self._floors: tuple[float, FloatArray] | None = None

    def __call__(self, ksp: PETSc.KSP, iteration: int, norm: float) -> int:
        """Decide whether the solver may stop; the same on all ranks."""
        if not np.isfinite(norm):
            return Reason.DIVERGED_NANORINF
        rtol, atol, _, _ = ksp.getTolerances()
        before, self.reached = self.reached, norm
        if iteration == 0:
            self._start = norm
            # where only the set or the forces are left the residual is below atol from the start
            self._atol = min(atol, self._reduction * norm)
            return Reason.ITERATING if norm > 0.0 else Reason.CONVERGED_ATOL
        if not self._is_cg:
            done = norm <= max(self._atol, rtol * self._start)
            return Reason.CONVERGED_ATOL if done else Reason.ITERATING
        now = self._system.indicator(ksp.getSolution())
        outlook = self._system.outlook(now, self._before)
        self._before = now
        fall = max(norm / before if before else 0.0, (norm / self._start) ** (1 / iteration))
        self._estimate_force_errors(outlook.moved, fall, iteration)
        share = SETTLING_LIMIT if outlook.unsettled else 1.0
        if norm <= rtol * self._start:
            return Reason.CONVERGED_RTOL
        if iteration > 1 and norm <= share * SET_SHARE * outlook.wrong:
            return Reason.CONVERGED_RTOL
        if norm <= share * self._atol and self._forces_are_known(norm, outlook.forces):
            return Reason.CONVERGED_ATOL
        if self.patience is not None and iteration >= self.patience:
            self.slow = True
            return Reason.DIVERGED_MAX_IT
        return Reason.ITERATING

    def _estimate_force_errors(self, moved: FloatArray, fall: float, iteration: int) -> None:
        """Take the changes for a geometric series, at the slowest rate there is a sign of."""
        rate = np.full(len(moved), fall)
        if iteration > 2:  # the first step moves what is near, not what moves forces most
            rate = np.maximum(rate, moved / np.maximum(self._moved, 1e-300))
        self.force_errors = np.full(len(moved), np.inf)
        np.divide(moved * rate, 1.0 - rate, out=self.force_errors, where=rate < 1.0)
        self.force_errors[moved == 0.0] = 0.0
        self._moved = moved

    def _forces_are_known(self, norm: float, forces: FloatArray) -> bool:
        """Tell whether they are, or rounding makes it useless to go on for them; collective."""
        if (self.force_errors <= self._share * forces).all():
            return True
        if self._floors is None:
            self._floors = FLOOR * self._system.rounding(), self._system.lost_forces()
        floor, lost = self._floors
        allowed = np.where(forces <= lost, lost, self._share * forces)
        return norm <= floor or bool((self.force_errors <= allowed).all())
