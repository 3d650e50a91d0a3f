"""Contact forces where rounding hides them: u_h to twice the digits, and what data leave open.

A stiff part that rests on the obstacle is held by flows far below what rounding u_h to double
precision makes of its equations. So u_h is kept as the sum of two numbers a dof, x and a remainder,
and refined with residuals that are summed up from differences of either; the active set is that of
the sum. What is left unknown then are the data: means of α and u_D, loads and the matrix's entries
have 53 digits, too. How much forces depend on the last of these is measured, by changing all data
by a rounding of random sign and solving once more.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from petsc4py import PETSc

from ..arrays import BoolArray, FloatArray
from ..errors import NotConverged
from ..garbage import release
from ..multigrid.constrained import ConstrainedMatrix
from .active import ActiveSet
from .bounds import Bounds
from .reduced import ReducedSolver
from .stopping import BOTTOM, FORCES, GAIN, LOST, TOUCHING, Stiffness
from .system import DATUM, Vectors

SETS = 40
"""Active sets that are tried."""

REFINEMENTS = 20
"""Refinements in each."""

KNOWN = 1e-2
"""Change that a refinement may make, in parts of what may be wrong with the forces."""

REMAINDER = 1e-9
"""Forces below this part of the loads on their rows, with which others nearly cancel, are measured
against it."""

SAMPLES = 3
"""Times that data are changed; the largest answer counts."""

DataRounding = Callable[[int], tuple[FloatArray, FloatArray]]
"""`System.data_rounding`."""


@dataclass(frozen=True, eq=False)
class Outcome:
    """Accuracy of the forces in the end.

    Attributes:
        error: What may be wrong with them, in parts of their sum; where they are none, in parts of
            what their rows are made of.
        from_data: Whether most of it is from rounding of the data.
    """

    error: float
    from_data: bool


class Extended:
    """An iterate with a remainder, and its active set.

    Attributes:
        active: The active set.
        residual: A (x + remainder) − b.
    """

    def __init__(
        self,
        linear: ReducedSolver,
        operator: ConstrainedMatrix,
        bounds: Bounds,
        stiffness: Stiffness,
        vectors: Vectors,
        masses: FloatArray | None,
        offset: float,
    ):
        """Begin with the iterate and the active set that the linear solver had last.

        Args:
            linear: Solves reduced systems.
            operator: The matrix.
            bounds: The bounds.
            stiffness: Classes of dofs.
            vectors: Iterate, right-hand side and residual.
            masses: As `System.masses` has them.
            offset: `System.offset`.
        """
        self._masses, self._offset = masses, offset
        self._linear, self._operator, self._bounds = linear, operator, bounds
        self._stiffness, self._vectors = stiffness, vectors
        self.active, self.residual = linear.active, vectors.residual
        self._remainder, self._work, self._nothing = (vectors.x.duplicate() for _ in range(3))
        for each in (self._remainder, self._nothing):
            each.set(0.0)
        stiffness.sum_from_differences()
        stiffness.sort(vectors.x, vectors.b)

    def settle(self, rounding: DataRounding, loads: FloatArray, slack: float) -> Outcome:
        """Find active set and forces, and how well they are known; collective.

        On return x and the residual are those that contact is read from.

        Args:
            rounding: Draws what rounding may have done to the data.
            loads: χ in the bounded dofs, shape (n,).
            slack: How many times more than usual may be wrong with the forces.

        Raises:
            NotConverged: No active set is that of its own solution.
        """
        left = self._find_set(slack * FORCES)
        open_by_data = np.max([self._answer(*rounding(n), n) for n in range(SAMPLES)], axis=0)
        errors = 2.0 * left + open_by_data
        forces, made_of = self._stiffness.totals(self._forces()), self._stiffness.made_of
        of_loads = self._stiffness.totals(np.where(self.active.mask, np.abs(loads), 0.0)).sum()
        total = max(float(forces.sum()), REMAINDER * float(of_loads))
        flow = self._flow()
        # what drowns in its errors is no force where these are nothing against what it is made of,
        # against all forces, or against what flows where the domain is softest: where u touches
        # without pressing, its own rows may be made of rounding alone
        none = (forces <= LOST * errors) & (
            (errors <= slack * TOUCHING * made_of)
            | (errors * len(errors) <= slack * FORCES * total)
            | (errors <= slack * TOUCHING * flow)
        )
        sizes = self._sizes(forces)
        sizes[none] = np.maximum(made_of, max(total, flow))[none]
        # each class is solved for itself; what data leave open is measured against all forces
        solved = 2.0 * left / np.maximum(sizes, 1e-300)
        given = open_by_data / np.maximum(np.maximum(sizes, total), 1e-300)
        self._write(none)
        by_data = float(given.sum())
        return Outcome(float(solved.max()) + by_data, by_data > float(solved.max()))

    def free(self) -> None:  # "destroy" is what PETSc calls a context with
        """Free what is here alone."""
        release(self._remainder, self._work, self._nothing)

    def _find_set(self, share: float) -> FloatArray:
        """Go from active set to active set; return what is left wrong with the last's forces.

        That is an active set of its own solution, but for dofs whose forces are nothing.
        """
        wanted = self.active
        for _ in range(SETS):
            self.active = wanted
            left = self._refine(share)
            wanted = self.active.exchanged(self._pushes(), self._gap())
            wrong = self._misclassified(wanted)
            if wrong.sum() <= share * self._bottom:
                return left + wrong
        if wrong.sum() <= TOUCHING * self._flow():
            return left + wrong
        raise NotConverged(f"no active set is that of its own solution, of {SETS} tried")

    def _refine(self, share: float) -> FloatArray:
        """Solve with the active set; return what the last refinement changed, by class."""
        x, dofs = self._vectors.x, self.active.dofs
        on_bound = self._bounds.on(self._bounds.sign(x.array_r[self.active.bounded]))
        x.array[dofs] = on_bound[self.active.mask]
        self._remainder.array[dofs] = 0.0
        self._compute_residual()
        changed: FloatArray = np.full(self._stiffness.number, np.inf)
        for _ in range(REFINEMENTS):
            before, last = self.residual.array_r[self.active.bounded].copy(), changed
            step = self._linear.correction(self.active, self.residual)
            moved = np.abs(step.array_r[self.active.bounded])
            self._subtract(step)
            self._compute_residual()
            forces = np.abs(self.residual.array_r[self.active.bounded] - before)
            changed = self._stiffness.totals(
                np.where(self.active.mask, forces, self._could_touch(moved))
            )
            sizes = self._sizes(self._stiffness.totals(self._forces()))
            if (changed <= KNOWN * share * sizes).all() or changed.sum() > GAIN * last.sum():
                break
        return changed

    def _subtract(self, step: PETSc.Vec) -> None:
        """Take a step off x, and keep in the remainder what rounding would take."""
        low, x = self._remainder.array_r - step.array_r, self._vectors.x.array_r
        total = x + low
        self._remainder.array[:] = (x - total) + low
        self._vectors.x.array[:] = total

    def _compute_residual(self) -> None:
        self._stiffness.residual(self._vectors.x, self._vectors.b, self.residual)
        self._stiffness.residual(self._remainder, self._nothing, self._work)
        self.residual.axpy(1.0, self._work)

    def _gap(self) -> FloatArray:
        """Compute how far bounded dofs are from the nearer bound, shape (n,)."""
        bounded = self.active.bounded
        x, low = (each.array_r[bounded] for each in (self._vectors.x, self._remainder))
        return self._bounds.gap(x) + self._bounds.sign(x) * low

    def _pushes(self) -> FloatArray:
        """Return the residual in bounded dofs, above 0 where it pushes them off, shape (n,)."""
        bounded = self.active.bounded
        sign = self._bounds.sign(self._vectors.x.array_r[bounded])
        return sign * self.residual.array_r[bounded]

    def _forces(self) -> FloatArray:
        """Return the forces on active dofs, 0 on others, shape (n,)."""
        return np.where(self.active.mask, self._pushes(), 0.0)

    def _misclassified(self, wanted: ActiveSet) -> FloatArray:
        """Sum the forces that are to go, or come, with another active set, by class; collective."""
        pulls = np.maximum(-self._pushes(), 0.0)
        missing = self._operator.diagonal * np.maximum(-self._gap(), 0.0)
        wrong = np.where(self.active.mask, pulls, missing)
        return self._stiffness.totals(np.where(wanted.mask != self.active.mask, wrong, 0.0))

    def _flow(self) -> float:
        """Sum what the rows are made of where the domain is softest; collective."""
        x = self._vectors.x
        found = self._stiffness.flows(x)
        if self._masses is not None:
            found += self._masses * (np.abs(x.array_r) + abs(self._offset))
        return self._stiffness.least_of(found)

    @property
    def _bottom(self) -> float:
        """The least that forces are measured against."""
        return float(BOTTOM * self._stiffness.made_of.max())

    def _sizes(self, forces: FloatArray) -> FloatArray:
        """Compute what errors of the forces are measured against, by class, from their sums."""
        sizes: FloatArray = np.maximum(np.maximum(forces, self._stiffness.least), self._bottom)
        return sizes

    def _could_touch(self, moved: FloatArray) -> FloatArray:
        """Compute the forces of dofs off the obstacle, should they move once more, shape (n,)."""
        return self._operator.diagonal * np.maximum(2.0 * moved - np.abs(self._gap()), 0.0)

    def _answer(self, load: FloatArray, bounds: FloatArray, seed: int) -> FloatArray:
        """Compute what changes of the data change in the forces, by class; collective."""
        bounded, mask = self.active.bounded, self.active.mask
        change, answer = self._vectors.x.duplicate(), self._vectors.x.duplicate()
        change.set(0.0)
        change.array[self.active.dofs] = bounds[mask]
        self._stiffness.residual(change, self._nothing, answer)
        rng = np.random.default_rng((seed, self._stiffness.comm.rank, 1))
        flows = self._stiffness.flows(self._vectors.x)
        answer.array[:] += DATUM * flows * rng.choice([-1.0, 1.0], len(flows)) - load
        if self._masses is not None:
            size = DATUM * self._masses * (np.abs(self._vectors.x.array_r) + abs(self._offset))
            answer.array[:] += size * rng.choice([-1.0, 1.0], len(size))
        forces = answer.array_r[bounded].copy()
        step = self._linear.correction(self.active, answer)
        self._stiffness.residual(step, self._nothing, self._work)
        forces -= self._work.array_r[bounded]
        moved = np.abs(step.array_r[bounded] + bounds)
        release(change, answer)
        return self._stiffness.totals(np.where(mask, np.abs(forces), self._could_touch(moved)))

    def _write(self, none: BoolArray) -> None:
        """Leave forces that are none out, and dofs without force off the obstacle."""
        bounded, mask = self.active.bounded, self.active.mask
        x, residual = self._vectors.x, self.residual
        nothing = none[self._stiffness.bounded] | (self._pushes() <= FORCES * self._bottom)
        residual.array[bounded[mask & nothing]] = 0.0
        at = x.array_r[bounded]
        sign = self._bounds.sign(at)
        off = np.nextafter(self._bounds.on(sign), sign * np.inf)
        x.array[bounded] = np.where(~mask & (self._bounds.gap(at) <= 0.0), off, at)
