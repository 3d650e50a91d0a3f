"""Stopping criteria for the solution of the variational inequality.

The residual as a whole says little where the coefficient varies by orders of magnitude: what is
small against the stiff part's flows may be all there is in the soft part. So three things are
asked for:

1. ‖r‖₂ is at most τ times the residual scale for the equations as a whole, τ = 1e-8 unless set
   otherwise.
2. The contact forces are known: the sum of the errors that the solver left in them is at most
   1e-7 of their sum.
3. Each part is converged for itself. Dofs whose diagonal entries are of the same magnitude, up to a
   factor of 100, make a class. In each, 2. holds for its own forces; and where there is more than
   one, ‖r‖₂ over the class is at most τ times the norm of what its rows are made of,
   Σ_j |a_ij| |u_j − u_i| + |χ_i|.

How well forces are known is measured, not concluded from a norm: a step of the linear solver, or
one more Newton step in the same active set, which refines u_h with its true residual, changes the
forces by what was wrong with them before. Where rounding does not allow for 2., or u_h is so near
the obstacle that rounding decides whether it touches, the solver goes on to twice the digits (see
`extended`); 1e-6 is enough then, and what is known less well is an error, but for what is nothing
beside all else: forces are measured against 1e-15 of what the rows on Γ1 are made of, at least.
What the rounding of data leaves open counts as well: of loads, u_D and bounds, and of the matrix's
entries, of which those that c and b have a part in are off by a rounding of the largest in their
cell.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from ..arrays import BoolArray, FloatArray, IndexArray, Int32Array, summed
from ..garbage import release
from ..multigrid.constrained import with_entries
from ..multigrid.cycle import Grid

DECADES = 2.0
"""Dofs whose diagonal entries are within so many powers of ten make a class."""

BANDS = 4
"""So many classes of dofs on Γ1 that are made of much or of little; the last has all the rest."""

BAND = 5.0
"""So many powers of ten make one. Where u touches without pressing, what rows are made of is what
the mesh does not resolve, 10⁻³ to 10⁻⁵ of what it is elsewhere: that is not worth more steps."""

WINDOWS = 8
"""Squares along the longest extent of Γ1. What a dof's neighbourhood is made of is the most of its
square and the ones around it: the end of a contact zone, or a corner, where forces fall to 0 is no
part of its own, on whichever side of a square's edge it lies."""

BOTTOM = 10.0 ** -(BAND * (BANDS - 1))
"""Least size that forces and residuals are measured against, in parts of the most that rows are
made of: where the last of the bands begins. Where u falls off by many orders of magnitude, or
flows are what rounding makes of none, there is no end below."""

LEAST_MEASURE = 1e-2
"""Least size that forces are measured against, in parts of what their class's rows are made of;
but in the first, which are made of most."""

FORCES = 1e-7
"""Error that the contact forces may have, in parts of their sum."""

FLOWS = 1e-8
"""Residual that a class of stiffness may have, in parts of its flows."""

ROUNDED = 1e-6
"""Size that both may have where rounding allows for no better."""

NOISE = 4.0 * 2.0**-53
"""Rounding of a row of A x, in parts of |A| |x|; measured are 1 to 2 of these 4."""

STORED = NOISE / 32.0
"""Error of a row of A x, in parts of |A| |x|, as x is stored with 53 digits: as measured."""

GAIN = 0.5
"""Part of what is wrong that a refinement must take away to be worth another one; else rounding is
at work."""

LOST = 10.0
"""Forces whose sum is below so many times their rounding are lost in it."""

TOUCHING = 1e-10
"""Forces that are lost are none where rounding is below this part of what their rows are made of,
or of what flows in the softest part: u touches without pressing. Elsewhere there may be contact
that rounding hides."""


class Stiffness:
    """Classes of dofs of like diagonal entries, and whether the equations of each are solved.

    Where there are several, A x is summed up from differences: a stiff part that only a soft one
    holds moves by what rounding leaves of its rows' sum, and Σ_j a_ij (x_j − x_i) leaves nothing,
    as what dof j gets from dof i is what i gives to j.

    Attributes:
        comm: The ranks.
        number: How many classes of dofs with a bound there are, over all ranks; some may be empty.
        contrast: Largest diagonal entry over the smallest.
        stiffest: The largest of them.
        bounded: Class of each dof with a bound, shape (n,).
        made_of: What the rows of these are made of, summed over each class, shape (classes,).
        least: What forces are measured against at least, shape (classes,).
    """

    def __init__(
        self,
        grid: Grid,
        row_sums: Callable[[], FloatArray] | None = None,
        window: IndexArray | None = None,
    ):
        """Sort the dofs; collective, the matrix must be whole.

        Args:
            grid: Matrix and dofs.
            row_sums: Returns the sums of the owned rows of A, which are 0 but where a dof on Γ0 has
                been taken out, shape (dofs,); it is asked if there are several classes.
            window: As `windows` has it; None for one that all are in.
        """
        self._grid, self.comm = grid, grid.matrix.getComm().tompi4py()
        entries = grid.operator.whole_diagonal.copy()
        entries[grid.dirichlet] = np.inf
        low = self.comm.allreduce(float(entries.min(initial=np.inf)), op=MPI.MIN)
        entries[grid.dirichlet] = 0.0
        high = self.comm.allreduce(float(entries.max(initial=0.0)), op=MPI.MAX)
        entries[grid.dirichlet] = 1.0
        self._smallest, self.stiffest, self.contrast = low, high, max(high / low, 1.0)
        self._kinds = 1 + int(self._classes(np.array([high]))[0]) if high > 0.0 else 1
        self._kind = self._classes(grid.operator.diagonal)
        self.number = self._kinds * BANDS
        self.bounded = BANDS * self._kind
        self.made_of: FloatArray = np.zeros(self.number)
        self.least: FloatArray = np.zeros(self.number)
        self._window = np.zeros(len(grid.operator.dofs), np.intp) if window is None else window
        self._differences: PETSc.Mat | None = None
        self._always = False
        self._find_row_sums = row_sums
        if row_sums is not None and self._kinds > 1:
            self._free, self._class = np.ones(len(entries), dtype=bool), self._classes(entries)
            self._free[grid.dirichlet] = False
            self._diagonal = entries
            self._take_differences(row_sums)

    @property
    def varied(self) -> bool:
        """True if there are dofs of several magnitudes of stiffness; the same on all ranks."""
        return self._kinds > 1

    def _take_differences(self, row_sums: Callable[[], FloatArray]) -> None:
        self._row_sums = row_sums()
        self._differences, self._weights = _differences(self._grid.matrix)

    def _classes(self, diagonal: FloatArray) -> IndexArray:
        with np.errstate(over="ignore"):
            ratio = np.minimum(diagonal / self._smallest, np.finfo(float).max)
        decades = np.log10(ratio) / DECADES
        return np.maximum(decades, 0.0).astype(np.intp)

    def sort(self, x: PETSc.Vec, b: PETSc.Vec) -> None:
        """Sort the bounded dofs by what their rows are made of now; collective.

        Args:
            x: The iterate.
            b: Right-hand side.
        """
        made_of = self._grid.operator.flows(x, b)
        around: FloatArray = np.zeros(WINDOWS**3)
        np.maximum.at(around, self._window, made_of)
        self.comm.Allreduce(MPI.IN_PLACE, around, op=MPI.MAX)
        top = float(around.max())
        around = _spread(around)[self._window]
        decades = np.log10(max(top, 1e-300) / np.maximum(around, 1e-300))
        band = np.clip(decades / BAND, 0, BANDS - 1).astype(np.intp)
        self.bounded = BANDS * self._kind + band
        self.made_of = self.totals(made_of)
        self.least = LEAST_MEASURE * self.made_of
        self.least[::BANDS] = 0.0

    def sums(self, values: FloatArray) -> FloatArray:
        """Sum values of the bounded dofs over this rank's part of each class, shape (classes,)."""
        sums = np.bincount(self.bounded, values, minlength=self.number)
        return sums.astype(np.float64, copy=False)

    def totals(self, values: FloatArray) -> FloatArray:
        """Sum values of the bounded dofs over all of each class, shape (classes,); collective."""
        return summed(self.comm, self.sums(values))

    def magnitude(self, x: PETSc.Vec, which: BoolArray | None = None) -> FloatArray:
        """Sum up |A| |x| over the bounded dofs of each class, shape (classes,); collective.

        Args:
            x: A vector.
            which: The bounded dofs that count, shape (n,); None for all.
        """
        values = self._grid.operator.magnitude(x)
        return self.totals(values if which is None else np.where(which, values, 0.0))

    def sum_from_differences(self) -> None:
        """Sum up A x from differences from now on, where there is one class only, too."""
        self._always = True

    def residual(self, x: PETSc.Vec, b: PETSc.Vec, r: PETSc.Vec) -> None:
        """Compute r = A x − b; collective, where the matrix must be whole for the first time."""
        if self._always and self._differences is None and self._find_row_sums is not None:
            self._take_differences(self._find_row_sums)
        if self._differences is None:
            self._grid.matrix.mult(x, r)
            r.axpy(-1.0, b)
            return
        flows = self._differences.createVecLeft()
        self._differences.mult(x, flows)
        flows.array[:] *= self._weights
        self._differences.multTranspose(flows, r)
        r.array[:] += self._row_sums * x.array_r - b.array_r
        release(flows)

    def imbalance(self, x: PETSc.Vec, b: PETSc.Vec, r: PETSc.Vec, active: Int32Array) -> float:
        """Compute the largest ‖r‖ / ‖flows‖ of all classes, 0 for what is lost in rounding.

        Args:
            x: The iterate.
            b: Right-hand side.
            r: A x − b.
            active: Owned dofs whose equations do not count, local numbers.
        """
        if self._differences is None or not self.varied:
            return 0.0
        counted = self._free.copy()
        counted[active] = False
        made_of = self.flows(x) + np.abs(self._row_sums * x.array_r - b.array_r)
        facts = [
            np.bincount(self._class[which], values[which] ** 2, minlength=self._kinds)
            for values, which in (
                (r.array_r, counted),
                (made_of, counted),
                (NOISE * self._diagonal * x.array_r, counted),
                (made_of, self._free),
            )
        ]
        left, flow, noise, whole = np.sqrt(summed(self.comm, np.array(facts)))
        flow = np.maximum(flow, max(BOTTOM * whole.max(), 1e-300))
        return float(np.max(left / flow, initial=0.0, where=left > noise))

    def least_of(self, sizes: FloatArray) -> float:
        """Sum up over the dofs of each class of stiffness; the least that is not 0; collective.

        Args:
            sizes: Of the rows of owned dofs, shape (dofs,).
        """
        kinds = self._class if self.varied else np.zeros(len(sizes), np.intp)
        found = np.bincount(kinds, sizes, minlength=self._kinds).astype(np.float64, copy=False)
        found = summed(self.comm, found)
        return float(found[found > 0.0].min()) if found.any() else 0.0

    def flows(self, x: PETSc.Vec) -> FloatArray:
        """Sum up |a_ij| |x_j − x_i| over j ≠ i for owned dofs i, from differences; collective."""
        assert self._differences is not None
        sizes, flows = self._differences.createVecs()
        self._differences.mult(x, flows)
        flows.array[:] = np.abs(self._weights * flows.array_r)
        made_of = with_entries(self._differences, np.abs)
        made_of.multTranspose(flows, sizes)
        found: FloatArray = sizes.array_r.copy()
        release(sizes, flows, made_of)
        return found

    def free(self) -> None:  # "destroy" is what PETSc calls a context with
        """Free the differences."""
        release(self._differences)


def windows(comm: MPI.Comm, places: FloatArray) -> IndexArray:
    """Number the square, or cube, around each dof with a bound, shape (n,); collective.

    Args:
        comm: The ranks that have such dofs.
        places: A point by each of this rank's, shape (n, 3).
    """
    ends = np.stack([places.min(axis=0, initial=np.inf), -places.max(axis=0, initial=-np.inf)])
    comm.Allreduce(MPI.IN_PLACE, ends, op=MPI.MIN)
    low, size = ends[0], -(ends[0] + ends[1]).min()
    place = np.clip((places - low) * (WINDOWS / max(size, 1e-300)), 0, WINDOWS - 1)
    window: IndexArray = place.astype(np.intp) @ WINDOWS ** np.arange(3)
    return window


def _spread(values: FloatArray) -> FloatArray:
    """Find the largest value of each square, or cube, and those around it, see `windows`."""
    for stride in WINDOWS ** np.arange(3):
        rows = values.reshape(-1, WINDOWS, stride)
        values = rows.copy()
        np.maximum(values[:, 1:], rows[:, :-1], out=values[:, 1:])
        np.maximum(values[:, :-1], rows[:, 1:], out=values[:, :-1])
    return values.ravel()


def _differences(A: PETSc.Mat) -> tuple[PETSc.Mat, FloatArray]:
    """Make the matrix whose rows take differences x_j − x_i, j > i with a_ij ≠ 0, and the a_ij.

    D the first and w the second, A = −Dᵀ diag(w) D but for row sums.
    """
    start, column, value = A.getValuesCSR()
    first, end = A.getOwnershipRange()
    row = np.repeat(np.arange(first, end, dtype=column.dtype), np.diff(start))
    chosen = (column > row) & (value != 0.0)
    row, column, value = row[chosen], column[chosen], -value[chosen]
    number = len(row)
    signs = np.empty((number, 2))
    signs[:, 0], signs[:, 1] = -1.0, 1.0
    csr = (
        np.arange(0, 2 * number + 1, 2, dtype=PETSc.IntType),
        np.stack([row, column], axis=1).ravel().astype(PETSc.IntType),
        signs.ravel(),
    )
    sizes = (number, PETSc.DECIDE), A.getSizes()[1]
    return PETSc.Mat().createAIJ(sizes, csr=csr, comm=A.comm), value
