"""Multigrid in the active set: a V-cycle from CR to P1, and down the P1 spaces of all meshes.

A chain of grids, finest first: CR, then P1 on the mesh below and on all coarser ones. P1 ⊂ CR and
coarse P1 ⊂ fine P1 and therefore coarse P1 ⊂ fine CR, so that the coarse matrices are Galerkin
products where the coefficient is constant on the coarse cells, and nearly so where it varies little
on them; each is computed once, on its own mesh, and the finest mesh needs none. Where it varies
much, as if it jumped inside coarse cells, they are computed anew from the finest matrix.

Dofs on the obstacle are taken out on every grid: the matrix has the identity there, and a coarse
function that does not vanish at a fixed dof of the finer grid is fixed too, which leaves subspaces
of the reduced space. Smoothing is by over-relaxed Gauss-Seidel sweeps, forward before and backward
after the coarse correction.

Where there is no coarser mesh, CR stands on P1 of the same one, and that is left to BoomerAMG, or
to GAMG where PETSc is without hypre: the auxiliary space method. Small bottom grids are solved
directly.

Thin cells and strong anisotropy are too much for that cycle. Functions of CR that on no cell vary
in the strong direction cost next to nothing, there are as many of them as vertices, and P1 has
hardly any. No cheap figure of the mesh tells beforehand how many steps CG will take; CG does. Where
it has taken `PATIENCE` of them on one mesh, and takes many for one linear system, the chain is
given up, there and on all finer meshes, for the finest matrix alone. If that has no positive
off-diagonal entries to speak of, as where cells are aligned with the strong direction, BoomerAMG
needs a handful of steps. On other cells it would need hundreds: there the matrix is factorised.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt
from mpi4py import MPI
from petsc4py import PETSc

from ..garbage import release
from ..options import AMG, PREFIX, defaults, read
from .masking import MaskedMatrix, numbers_of
from .parents import Layout
from .smoothing import GaussSeidel
from .transfer import Transfer

DIRECT = 2000
"""Bottom grids of up to this many dofs are factorised, on every rank; AMG has the others."""

# Gauss-Seidel forward on the way down and backward on the way up: as symmetric as PETSc's default,
# which goes both ways each time, and a third cheaper. In one pass through all rows, not in one for
# those of coarse points and one for the others: as many CG steps, and a third cheaper once more
_BOOMERAMG = {
    "pc_hypre_boomeramg_relax_type_down": "SOR/Jacobi",
    "pc_hypre_boomeramg_relax_type_up": "backward-SOR/Jacobi",
    "pc_hypre_boomeramg_no_CF": True,
}

_BOTTOM = PREFIX + "bottom_"
_ALONE = PREFIX + "alone_"

PATIENCE = 40
"""CG steps on one mesh after which the chain is given up in a linear system that takes many.

A factorisation takes as long as 30 steps of the cycle at 0.02 to 0.3 M dofs and 55 at 1.2 M.
"""

SLOW = 14
"""CG steps that are many for one linear system; two thirds of that are usual at most."""

FACTORISED = {2: 4_000_000, 3: 20_000}
"""Largest matrices that are factorised instead, by the mesh's dimension; AMG has the others.

In the plane that takes about as long as four linear solves with BoomerAMG of plain cells at 1 M
dofs, and 0.6 kB a dof; in space it is far more.
"""

POSITIVE = 0.25
"""Part of the diagonal up to which positive off-diagonal entries of a row do no harm to AMG."""

# Minimum degree takes least time for matrices of plane meshes, on two ranks as well
_MUMPS = {"pc_factor_mat_solver_type": "mumps", "mat_mumps_icntl_7": 0}
HAS_MUMPS = PETSc.Sys.hasExternalPackage("mumps")

# PETSc's smallest pivot is absolute and would refuse coefficients of small magnitude
_PIVOTS = {"pc_factor_zeropivot": 1e-300, "redundant_pc_factor_zeropivot": 1e-300}

NEARLY = 0.2
"""Part of the diagonal by which a coarse matrix may differ from the Galerkin product."""

SWEEPS = 2
"""Gauss-Seidel sweeps before and after the coarse correction."""

LONG_SWEEPS = 3
"""The same between CR and P1 of the mesh below, where there is more to smooth."""


@dataclass
class Patience:
    """Whether the chain of a mesh has been given up; what finer meshes ask for.

    Attributes:
        lost: Whether it has.
        inherited: Whether that was on a coarser mesh.
    """

    lost: bool = False
    inherited: bool = False


class Grid:
    """One space of the chain, and everything below it.

    Attributes:
        operator: Its matrix, with the identity in the rows and columns of the dofs on Γ0 and of
            those that `fix` takes out.
        coarser: The next space, None at the bottom.
        meshes: Number of meshes in the chain.
    """

    def __init__(
        self,
        matrix: PETSc.Mat,
        dofs: Layout,
        dirichlet: npt.NDArray[np.int32],
        bounded: npt.NDArray[np.int32],
        transfer: Transfer | None = None,
        coarser: Grid | None = None,
        sweeps: int = SWEEPS,
        on_same_mesh: bool = False,
        patience: Patience | None = None,
    ):
        """Join a space to the chain.

        Args:
            matrix: Its matrix, the identity in the rows and columns of the dofs on Γ0.
            dofs: Its dofs.
            dirichlet: Its owned dofs on Γ0, local numbers.
            bounded: Its owned dofs that may be taken out, local numbers, ascending.
            transfer: What writes functions of the coarser space in this one.
            coarser: The next space.
            sweeps: Number of Gauss-Seidel sweeps before and after.
            on_same_mesh: Whether the next space lives on the same mesh, not on a coarser one.
            patience: Tells whether there is a chain, and is told when it is given up.
        """
        self.meshes: int = (coarser.meshes if coarser else 0) + (not on_same_mesh)
        self.operator, self.coarser = MaskedMatrix(matrix, bounded), coarser
        self._transfer, self._dofs, self._sweeps = transfer, dofs, sweeps
        self._dirichlet = dirichlet
        self._patience = patience or Patience()
        self._silent = dirichlet
        self._changed = True
        self._bottom: PETSc.PC | None = None
        self._vectors: list[PETSc.Vec] = []  # residual, and the coarser space's b and x
        self._smoother: GaussSeidel | None = None
        if transfer is not None:
            self._smoother = GaussSeidel(matrix, dofs, sweeps)
            coarse = transfer.coarse_vector(), transfer.coarse_vector()
            self._vectors = [matrix.createVecRight(), *coarse]

    @property
    def matrix(self) -> PETSc.Mat:
        """The matrix as it is now, without what `fix` has taken out."""
        return self.operator.masked

    @property
    def may_give_up(self) -> bool:
        """Whether there is something else to try than this chain; the same on all ranks."""
        if self._patience.lost:
            return False
        return self.coarser is not None or not self._is_small

    def give_up(self) -> None:
        """Leave the coarser spaces alone from now on, for BoomerAMG or a factorisation."""
        release(self._bottom, *self._vectors)
        for part in (self._transfer, self._smoother):
            if part is not None:
                part.free()
        if self.coarser is not None:
            self.coarser.restore()
        self._bottom, self._vectors = None, []
        self._transfer, self._smoother, self.coarser = None, None, None
        self._changed, self.meshes = True, 1
        self._patience.lost = True

    @property
    def dirichlet(self) -> npt.NDArray[np.int32]:
        """Owned dofs on Γ0, local numbers."""
        return self._dirichlet

    def is_product(self, finer: PETSc.Mat, transfer: Transfer) -> bool:
        """Whether the whole matrix is, nearly, the Galerkin product of a finer space's.

        It is not where a mesh does not see what the coefficient does between its quadrature points.

        Args:
            finer: The finer space's matrix.
            transfer: What writes functions of this space there.
        """
        self.fix(self.operator.dofs[:0], deep=False)
        v, product, own = (transfer.coarse_vector() for _ in range(3))
        u, image = finer.createVecs()
        v.array[:] = np.random.default_rng(0).standard_normal(v.local_size)
        v.array[self._dirichlet] = 0.0
        transfer.add(v, u)
        finer.mult(u, image)
        transfer.restrict(image, product)
        self.matrix.mult(v, own)
        difference = np.abs(product.array_r - own.array_r)
        difference[self._dirichlet] = 0.0
        diagonal = self.matrix.getDiagonal()
        largest = float((difference / diagonal.array_r).max(initial=0.0))
        release(v, product, own, u, image, diagonal)
        return self.matrix.getComm().tompi4py().allreduce(largest, op=MPI.MAX) <= NEARLY

    def projected(self, finer: PETSc.Mat, transfer: Transfer) -> Grid:
        """The same chain with Galerkin products of a finer space's matrix.

        Args:
            finer: The finer space's matrix.
            transfer: What writes functions of this space there.
        """
        whole = transfer.matrix()
        matrix = finer.ptap(whole)
        # on Γ0 it holds rubbish, as the finer matrix has the identity there
        matrix.zeroRowsColumns(numbers_of(matrix, self._dirichlet), 1.0)
        release(whole)
        coarser = self.coarser
        if coarser is not None and self._transfer is not None:
            coarser = coarser.projected(matrix, self._transfer)
        return Grid(
            matrix,
            self._dofs,
            self._dirichlet,
            self.operator.dofs,
            self._transfer,
            coarser,
            self._sweeps,
        )

    def rounding(self, x: PETSc.Vec) -> float:
        """Norm of the diagonal times x over the free dofs: what the residual's digits are lost in.

        Dofs on Γ0 and those taken out have a diagonal of 1, whatever the matrix's magnitude.
        """
        terms = self.matrix.getDiagonal()
        terms.pointwiseMult(terms, x)
        terms.array[self._silent] = 0.0
        norm = terms.norm()
        release(terms)
        return float(norm)

    def fix(self, dofs: npt.NDArray[np.int32], deep: bool = True) -> None:
        """Take dofs out of the space, and what does not vanish there out of the coarser ones.

        Args:
            dofs: Owned dofs, local numbers; replaces those of the call before. Only those with a
                bound count.
            deep: Go on to the coarser spaces; without that the cycle may not be used.
        """
        if self.operator.fix(dofs):
            self._silent = np.concatenate([self._dirichlet, self.operator.out])
            if self._smoother is not None:
                self._smoother.take_out(self.operator.out)
            self._changed = True
        # the coarser spaces may have served another fine one since
        if self.coarser is not None and self._transfer is not None and deep:
            self.coarser.fix(self._transfer.touched(self.operator.out))

    def restore(self) -> None:
        """Put all dofs back, and below P1 those of the coarser spaces, too.

        Their matrices are the coarser meshes' own; those below CR nobody else uses.
        """
        self.fix(self.operator.dofs[:0], deep=False)
        if self.coarser is not None and not self._dofs.cr:
            self.coarser.restore()

    def cycle(self, b: PETSc.Vec, x: PETSc.Vec) -> None:
        """One V-cycle for masked x = b, from x = 0; b is 0 in the fixed dofs."""
        if self.coarser is None or self._transfer is None or self._smoother is None:
            self._solve_bottom(b, x)
            return
        r, b_coarse, x_coarse = self._vectors
        self._smoother.forward(b, x)
        self.matrix.mult(x, r)
        r.aypx(-1.0, b)
        self._transfer.restrict(r, b_coarse)
        b_coarse.array[self.coarser._silent] = 0.0
        self.coarser.cycle(b_coarse, x_coarse)
        self._transfer.add(x_coarse, x)
        self._smoother.backward(b, x)

    def apply(self, _: PETSc.PC, b: PETSc.Vec, x: PETSc.Vec) -> None:
        """The V-cycle as PETSc's preconditioner of type python."""
        self.cycle(b, x)

    def describe(self) -> str:
        """What the cycle is, in words."""
        bottom = self._bottom_words()
        if self.coarser is None:
            return bottom
        if self.meshes == 1:
            return f"P1 auxiliary space with {bottom}, as there is no coarser mesh"
        return f"multigrid on {self.meshes} meshes with {bottom} on the coarsest"

    def free(self) -> None:  # "destroy" is what PETSc calls a context with
        """Free what belongs to this space alone, not the matrix it was made with."""
        release(self._bottom, *self._vectors)
        for part in (self._transfer, self._smoother):
            if part is not None:
                part.free()
        self.operator.free()

    def _solve_bottom(self, b: PETSc.Vec, x: PETSc.Vec) -> None:
        if self._bottom is None:
            self._bottom = self._bottom_solver()
        if self._changed:
            self._bottom.setOperators(self.matrix)
            with defaults(self._bottom_defaults, self._bottom_prefix):
                self._bottom.setUp()
            self._changed = False
        self._bottom.apply(b, x)

    def _bottom_words(self) -> str:
        """What solves the space at the bottom, and why where that is not its size."""
        if self.coarser is not None:
            return self.coarser._bottom_words()
        kind = self._bottom_type if self._bottom is None else self._bottom.getType()
        if kind != self._bottom_type:
            return f"{kind} (option -{self._bottom_prefix}pc_type)"
        if kind == PETSc.PC.Type.HYPRE:
            words = "BoomerAMG"
        elif kind == PETSc.PC.Type.GAMG:
            words = "GAMG (PETSc is without hypre)"
        else:
            words = "a direct solver"
        if self._patience.lost:
            where = " on a coarser mesh" if self._patience.inherited else ""
            words += f", as multigrid took {PATIENCE} CG steps{where}"
        return words

    @property
    def _is_small(self) -> bool:
        """Whether this space, at the bottom, is to be factorised."""
        return self.matrix.getSize()[0] <= DIRECT

    @cached_property
    def _suits_amg(self) -> bool:
        """Whether the matrix is, nearly, an M-matrix: what BoomerAMG was made for; collective."""
        if AMG != PETSc.PC.Type.HYPRE:
            return False
        start, column, value = self.matrix.getValuesCSR()
        row = np.repeat(np.arange(len(start) - 1), np.diff(start))
        off = column != row + self.matrix.getOwnershipRange()[0]
        positive = np.bincount(row, np.where(off, value, 0.0).clip(0.0), len(start) - 1)
        largest = float((positive / value[~off]).max(initial=0.0))
        return self.matrix.getComm().tompi4py().allreduce(largest, op=MPI.MAX) <= POSITIVE

    @property
    def _bottom_prefix(self) -> str:
        """What options of the solver at the bottom begin with."""
        return _ALONE if self._patience.lost else _BOTTOM

    @property
    def _bottom_type(self) -> str:
        """What solves this space at the bottom unless options say otherwise."""
        if not self._is_small:
            most = FACTORISED[self._dofs.cells.shape[1] - 1]
            if not self._patience.lost or self.matrix.getSize()[0] > most or self._suits_amg:
                return AMG
            if HAS_MUMPS:
                return PETSc.PC.Type.CHOLESKY
        alone = self.matrix.getComm().getSize() == 1
        return PETSc.PC.Type.CHOLESKY if alone else PETSc.PC.Type.REDUNDANT

    @property
    def _bottom_defaults(self) -> Mapping[str, object]:
        """Options of that solver; some are read when it is made, some when it is set up."""
        if self._bottom_type == AMG:
            return _BOOMERAMG
        return _PIVOTS if self._is_small or not HAS_MUMPS else _MUMPS

    def _bottom_solver(self) -> PETSc.PC:
        pc = PETSc.PC().create(self.matrix.getComm())
        pc.setOptionsPrefix(self._bottom_prefix)
        pc.setType(self._bottom_type)
        with defaults(self._bottom_defaults, self._bottom_prefix):
            read(pc)
        return pc
