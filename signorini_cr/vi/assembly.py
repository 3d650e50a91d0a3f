"""One mesh and the variational inequality (1.8) that is assembled on it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt
from dolfinx import fem
from dolfinx.fem.petsc import assemble_matrix
from petsc4py import PETSc

from ..errors import InputError
from ..fem.physics import OnMesh, Physics
from ..garbage import hold, sweep
from ..mesh.domain import Domain
from ..multigrid.cycle import LONG_SWEEPS, SWEEPS, Grid, Patience
from ..multigrid.masking import numbers_of
from ..multigrid.parents import Layout, Parents
from ..multigrid.pattern import empty_matrix
from ..multigrid.transfer import inclusion, prolongation
from ..options import NO_INODES, defaults
from .pieces import Loose
from .system import System

FloatArray = npt.NDArray[np.float64]


@dataclass(eq=False)
class Level:
    """One mesh with everything that is assembled on it.

    Attributes:
        physics: What is solved, shared by all levels.
        domain: Mesh and boundary parts.
        number: Position in the sequence, from 0.
        coarser: The level below, if there is one.
        parent_cell: For each local cell the cell of the coarser mesh that holds it.
    """

    physics: Physics
    domain: Domain
    number: int = 0
    coarser: Level | None = None
    parent_cell: npt.NDArray[np.int32] | None = None

    def __post_init__(self) -> None:
        """Free what levels before have left, and hold the mesh while there are objects on it."""
        if PETSc.ScalarType is not np.float64:
            raise InputError(f"PETSc's numbers are {PETSc.ScalarType.__name__}; float64 is needed")
        sweep(self.domain.mesh.comm)
        hold(self, self.domain.mesh)

    @cached_property
    def parents(self) -> Parents | None:
        """The coarser mesh's cells that hold this one's."""
        if self.coarser is None or self.parent_cell is None:
            return None
        return Parents(self.coarser.domain.mesh, self.domain.mesh, self.parent_cell)

    @cached_property
    def data(self) -> OnMesh:
        """The physics on this mesh."""
        return self.physics.on(self.domain)

    @property
    def V(self) -> fem.FunctionSpace:
        """The discrete space."""
        return self.data.V

    @cached_property
    def system(self) -> System:
        """The assembled variational inequality."""
        return System(self.data)

    @cached_property
    def loose(self) -> Loose | None:
        """Pieces without a Dirichlet facet; None if there are none, which refinement keeps."""
        if self.coarser is not None and self.coarser.loose is None:
            return None
        found = Loose.of(self.V, self.system.held)
        return found if found.count else None

    @cached_property
    def patience(self) -> Patience:
        """Whether multigrid is given up, as it is above a mesh where it was."""
        lost = self.coarser is not None and self.coarser.patience.lost
        return Patience(lost, inherited=lost)

    @cached_property
    @defaults(NO_INODES, prefix="")
    def grid(self) -> Grid:
        """The multigrid that starts with the discrete space."""
        system, dofs = self.system, Layout.of_space(self.V)
        own = system.A, dofs, self._owned_dirichlet, system.bounded
        if self.patience.lost:
            return Grid(*own, patience=self.patience)
        if self._below is not None:
            coarse, coarse_dofs, parents = self._below
            transfer = prolongation(coarse_dofs, dofs, parents)
            if not (self.physics.galerkin or coarse.is_product(system.A, transfer)):
                coarse = coarse.projected(system.A, transfer)
                self._below = coarse, coarse_dofs, parents  # P1 on this mesh shall have them, too
            sweeps = LONG_SWEEPS if dofs.cr else SWEEPS
            return Grid(*own, transfer, coarse, sweeps, patience=self.patience)
        if dofs.cr:
            coarse, p1 = self.conforming
            return Grid(
                *own, inclusion(p1, dofs), coarse, on_same_mesh=True, patience=self.patience
            )
        return Grid(*own, patience=self.patience)

    @cached_property
    @defaults(NO_INODES, prefix="")
    def conforming(self) -> tuple[Grid, Layout]:
        """P1 on this mesh and its dofs: for the next mesh, or for CR on this one."""
        if self.physics.element == "P1":
            return self.grid, Layout.of_space(self.V)
        p1 = Layout.of_p1(self.domain.mesh, self.V.dofmap.index_map_bs)
        form, scale = self.data.conforming(p1.cells, p1.index_map)
        matrix = assemble_matrix(empty_matrix(p1), form)
        matrix.assemble()
        matrix.scale(scale)
        dirichlet, bounded = p1.owned_at(self.data.fixed), p1.owned_at(self.data.lower)
        matrix.zeroRowsColumns(numbers_of(matrix, dirichlet), 1.0)
        matrix.setOption(PETSc.Mat.Option.SPD, True)
        space = matrix, p1, dirichlet, bounded
        if self._below is None:
            return Grid(*space), p1
        coarse, dofs, parents = self._below
        return Grid(*space, prolongation(dofs, p1, parents), coarse), p1

    @cached_property
    def _below(self) -> tuple[Grid, Layout, Parents] | None:
        """P1 on the coarser mesh, its dofs, and the cells there that hold this mesh's."""
        if self.coarser is None or self.parents is None:
            return None
        return (*self.coarser.conforming, self.parents)

    @property
    def _owned_dirichlet(self) -> npt.NDArray[np.int32]:
        dofs = self.system.dirichlet
        return dofs[dofs < self.system.A.getLocalSize()[0]]
