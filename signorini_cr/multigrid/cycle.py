"""Multigrid in the active set: a V-cycle from CR to P1, and down the P1 spaces of all meshes.

A chain of grids, finest first: CR, then P1 on the mesh below and on all coarser ones. P1 ⊂ CR and
coarse P1 ⊂ fine P1 and therefore coarse P1 ⊂ fine CR, so that the coarse matrices are Galerkin
products where the coefficient is constant on the coarse cells, and nearly so where it varies little
on them; each is computed once, on its own mesh, and the finest mesh needs none. Where it varies
much, as if it jumped inside coarse cells, they are computed anew from the finest matrix.

Dofs on the obstacle are constrained on every grid: the matrix has the identity there, and a coarse
function that does not vanish at a constrained dof of the finer grid is constrained too, which
leaves subspaces of the reduced space. Smoothing is by over-relaxed Gauss-Seidel sweeps, forward
before and backward after the coarse correction, or by what the user asks for (see `smoothing`).

Where there is no coarser mesh, CR stands on P1 of the same one, and that is left to BoomerAMG, or
to GAMG where PETSc is without hypre: the auxiliary space method. Small bottom grids are solved
directly.

Thin cells and strong anisotropy are too much for that cycle. Functions of CR that on no cell vary
in the strong direction cost next to nothing, there are as many of them as vertices, and P1 has
hardly any. No cheap figure of the mesh tells beforehand how many steps CG will take; CG does. Where
it has taken `PATIENCE` of them on one mesh, and takes many for one linear system, the chain is
given up, there and on all finer meshes, for the finest matrix alone (see `bottom`).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from ..arrays import Int32Array
from ..fem.layout import Layout
from ..garbage import release
from .bottom import Bottom, is_small
from .constrained import ConstrainedMatrix, numbers_of
from .smoothing import smoother
from .transfer import Transfer
from .whole import Whole

PATIENCE, LITTLE = 40, 20
"""CG steps on one mesh after which the chain is given up in a linear system that takes many.

A factorisation takes as long as 30 steps of the cycle at 0.02 to 0.3 M dofs and 55 at 1.2 M. That
of a small matrix takes next to no time, and the second number counts.
"""

SLOW = 10
"""CG steps that are many for one linear system where others have taken most of `PATIENCE`.

On cells of any but thin shapes and from cold starts nine are usual at most.
"""

NEARLY = 0.2
"""Part of the diagonal by which a coarse matrix may differ from the Galerkin product."""

SWEEPS = 2
"""Sweeps of the smoother before and after the coarse correction."""

LONG_SWEEPS = 3
"""The same between CR and P1 of the mesh below, where there is more to smooth."""


class Grid:
    """One space of the chain.

    Attributes:
        operator: Its matrix, with the identity in the rows and columns of the dofs on Γ0.
        dofs: Its dofs.
        dirichlet: Its owned dofs on Γ0, local numbers.
        solver: What solves on it, or nearly so.
        transfer: What writes functions of the next coarser space in this one, None at the bottom.
        left_out: Owned dofs that are left out at present: those on Γ0, and the constrained ones.
    """

    def __init__(
        self,
        operator: ConstrainedMatrix,
        dofs: Layout,
        dirichlet: Int32Array,
        solver: Bottom | TwoGrids | Whole,
        transfer: Transfer | None = None,
    ):
        """Take a space into the cycle, by what solves on it; see `at_bottom` and `above`."""
        self.operator, self.dofs, self.dirichlet = operator, dofs, dirichlet
        self.solver, self.transfer, self.left_out = solver, transfer, dirichlet

    @classmethod
    def at_bottom(
        cls,
        operator: ConstrainedMatrix,
        dofs: Layout,
        dirichlet: Int32Array,
        alone: bool = False,
    ) -> Grid:
        """Prepare a space that has no coarser one below it; collective.

        Args:
            operator: Its matrix, the identity in the rows and columns of the dofs on Γ0.
            dofs: Its dofs.
            dirichlet: Its owned dofs on Γ0, local numbers.
            alone: Whether this takes the place of a chain.
        """
        solver = Bottom(operator.matrix, dofs.cells.shape[1] - 1, alone)
        return cls(operator, dofs, dirichlet, solver)

    @classmethod
    def above(
        cls,
        operator: ConstrainedMatrix,
        dofs: Layout,
        dirichlet: Int32Array,
        transfer: Transfer,
        sweeps: int = SWEEPS,
    ) -> Grid:
        """Prepare a space above a coarser one; collective.

        Args:
            operator: As for `at_bottom`.
            dofs: Its dofs.
            dirichlet: Its owned dofs on Γ0, local numbers.
            transfer: What writes functions of the coarser space in this one.
            sweeps: Number of sweeps of the smoother before and after.
        """
        solver = TwoGrids(operator.matrix, dofs, transfer, sweeps)
        return cls(operator, dofs, dirichlet, solver, transfer)

    @property
    def matrix(self) -> PETSc.Mat:
        """The PETSc matrix, as it is constrained at present."""
        return self.operator.matrix

    @contextmanager
    def constrained(self, dofs: Int32Array) -> Iterator[Int32Array]:
        """Leave dofs out for a block; collective at entry.

        Args:
            dofs: Owned dofs, local numbers; only those with a bound count.

        Yields:
            Owned dofs of the next coarser space whose functions don't vanish at those left out.
        """
        with self.operator.constrained(dofs) as constrained:
            self.left_out = np.concatenate([self.dirichlet, constrained])
            self.solver.constrain(constrained)
            try:
                yield (
                    constrained
                    if self.transfer is None
                    else self.transfer.coarse_support(constrained)
                )
            finally:
                self.left_out = self.dirichlet
                self.solver.constrain(constrained[:0])

    def rounding(self, x: PETSc.Vec, constrained: Int32Array) -> float:
        """Take the norm of diagonal times x over free dofs: the residual's digits are lost in it.

        Args:
            x: A vector.
            constrained: Owned dofs that are not free, beside those on Γ0, whose diagonal is 1
                whatever the matrix's magnitude.
        """
        terms = x.duplicate()
        np.multiply(self.operator.whole_diagonal, x.array_r, out=terms.array)
        for dofs in (self.dirichlet, constrained):
            terms.array[dofs] = 0.0
        norm = terms.norm()
        release(terms)
        return float(norm)

    def remade(self, matrix: PETSc.Mat) -> Grid:
        """Make the same space with another matrix; the transfer is shared, nothing else is."""
        operator = ConstrainedMatrix(matrix, self.operator.dofs)
        if self.transfer is None:
            return Grid.at_bottom(operator, self.dofs, self.dirichlet)
        return Grid.above(operator, self.dofs, self.dirichlet, self.transfer)


class TwoGrids:
    """A cycle's part on a grid that has a coarser one below it."""

    def __init__(self, matrix: PETSc.Mat, dofs: Layout, transfer: Transfer, sweeps: int):
        """Prepare the sweeps, as for `Grid`; collective."""
        self._matrix, self._transfer = matrix, transfer
        self._smoother = smoother(matrix, dofs, sweeps)
        self._residual = matrix.createVecRight()
        self._b_coarse, self._x_coarse = transfer.coarse_vector(), transfer.coarse_vector()

    def constrain(self, dofs: Int32Array) -> None:
        """Note which owned dofs are constrained from now on."""
        self._smoother.constrain(dofs)

    def solve(self, b: PETSc.Vec, x: PETSc.Vec, below: Sequence[Grid]) -> None:
        """Do one V-cycle for A x = b, from x = 0: smooth, correct in the coarser spaces, smooth.

        Args:
            b: Right-hand side, 0 in the dofs that are held.
            x: The result.
            below: The coarser spaces, finest first.
        """
        self._smoother.forward(b, x)
        self._matrix.mult(x, self._residual)
        self._residual.aypx(-1.0, b)
        self._transfer.restrict(self._residual, self._b_coarse)
        self._b_coarse.array[below[0].left_out] = 0.0
        below[0].solver.solve(self._b_coarse, self._x_coarse, below[1:])
        self._transfer.add(self._x_coarse, x)
        self._smoother.backward(b, x)

    def free(self) -> None:  # "destroy" is what PETSc calls a context with
        """Free everything but the matrix and the transfer."""
        self._smoother.free()
        release(self._residual, self._b_coarse, self._x_coarse)


class Multigrid:
    """The V-cycle over a chain of grids, a preconditioner of PETSc's type python.

    Attributes:
        grids: The chain, finest first.
        given_up: Whether the chain has been given up, here or on a coarser mesh.
    """

    def __init__(self, grids: Sequence[Grid], *, on_one_mesh: bool = False, given_up: bool = False):
        """Take a chain of grids that others own.

        Args:
            grids: Finest first; all but the last have a coarser one below.
            on_one_mesh: Whether the chain has a space of one mesh on another of the same.
            given_up: Whether that was on a coarser mesh already, and this is what comes instead.
        """
        self.grids = list(grids)
        self.given_up = self._inherited = given_up
        self._on_one_mesh = on_one_mesh
        self._replacement: Grid | None = None

    @property
    def finest(self) -> Grid:
        """The space whose systems are solved."""
        return self.grids[0]

    @property
    def operator(self) -> ConstrainedMatrix:
        """Its matrix."""
        return self.finest.operator

    @property
    def matrix(self) -> PETSc.Mat:
        """The PETSc matrix of that."""
        return self.finest.matrix

    @property
    def may_give_up(self) -> bool:
        """True if there is something else to try than this chain; the same on all ranks."""
        return not self.given_up and (len(self.grids) > 1 or not is_small(self.matrix))

    @property
    def patience(self) -> int:
        """CG steps on this mesh after which to give up, see `PATIENCE`."""
        return LITTLE if is_small(self.matrix) else PATIENCE

    def give_up(self) -> None:
        """Leave the coarser spaces alone from now on, for BoomerAMG or a factorisation.

        Not in a block of `constrained`, which the replacement would know nothing of; collective.
        """
        fine = self.finest
        self._replacement = Grid.at_bottom(fine.operator, fine.dofs, fine.dirichlet, alone=True)
        self.grids, self.given_up = [self._replacement], True

    @contextmanager
    def constrained(self, dofs: Int32Array, deep: bool = True) -> Iterator[None]:
        """Leave dofs out of the finest space for a block, and what needs them out of the others.

        All matrices are whole again after the block, and the cycle is theirs, whatever happens in
        it; collective at entry.

        Args:
            dofs: Owned dofs of the finest space, local numbers; only those with a bound count.
            deep: Go on to the coarser spaces; without that the cycle may not be used.
        """
        with ExitStack() as stack:
            for grid in self.grids if deep else self.grids[:1]:
                dofs = stack.enter_context(grid.constrained(dofs))
            yield

    def apply(self, _: PETSc.PC | None, b: PETSc.Vec, x: PETSc.Vec) -> None:
        """Do one V-cycle, as PETSc's preconditioner of type python."""
        self.finest.solver.solve(b, x, self.grids[1:])

    def describe(self) -> str:
        """Say in words what the cycle is."""
        bottom = self.grids[-1].solver
        assert not isinstance(bottom, TwoGrids)
        if self.given_up:
            where = " on a coarser mesh" if self._inherited else ""
            return bottom.describe(f", as multigrid took too many CG steps{where}")
        solver = bottom.describe()
        if len(self.grids) == 1:
            return solver
        if self._on_one_mesh:
            return f"P1 auxiliary space with {solver}, as there is no coarser mesh"
        return f"multigrid on {len(self.grids)} meshes with {solver} on the coarsest"

    def free(self) -> None:  # "destroy" is what PETSc calls a context with
        """Free what has taken the chain's place, if anything has; the chain is its owner's."""
        if self._replacement is not None:
            self._replacement.solver.free()


def is_galerkin_product(grid: Grid, finer: PETSc.Mat, transfer: Transfer) -> bool:
    """Tell whether a space's matrix is, nearly, the Galerkin product of a finer one's; collective.

    It is not where a mesh does not see what the coefficient does between its quadrature points.

    Args:
        grid: The space.
        finer: The finer space's matrix.
        transfer: What writes functions of the one in the other.
    """
    v, product, own = (transfer.coarse_vector() for _ in range(3))
    u, image = finer.createVecs()
    v.array[:] = np.random.default_rng(0).standard_normal(v.local_size)
    v.array[grid.dirichlet] = 0.0
    transfer.add(v, u)
    finer.mult(u, image)
    transfer.restrict(image, product)
    grid.matrix.mult(v, own)
    difference = np.abs(product.array_r - own.array_r)
    difference[grid.dirichlet] = 0.0
    largest = float((difference / grid.operator.whole_diagonal).max(initial=0.0))
    release(v, product, own, u, image)
    return grid.matrix.getComm().tompi4py().allreduce(largest, op=MPI.MAX) <= NEARLY


def galerkin_products(chain: Sequence[Grid], finer: PETSc.Mat, transfer: Transfer) -> list[Grid]:
    """Make the same chain with Galerkin products of a finer space's matrix; collective.

    Args:
        chain: Grids, finest first; their transfers are shared.
        finer: The finer space's matrix.
        transfer: What writes functions of the chain's finest space there.
    """
    made: list[Grid] = []
    for grid in chain:
        whole = transfer.matrix()
        finer = finer.ptap(whole)
        release(whole)
        # on Γ0 it holds rubbish, as the finer matrix has the identity there
        finer.zeroRowsColumns(numbers_of(finer, grid.dirichlet), 1.0)
        made.append(grid.remade(finer))
        transfer = grid.transfer or transfer
    return made
