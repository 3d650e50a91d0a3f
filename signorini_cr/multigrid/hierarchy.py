"""Nested meshes and the multigrid on them: what is made when, and what goes when.

A sequence of meshes grows at its fine end, by `Hierarchy.add`, and on each mesh in turn
`Hierarchy.multigrid` lends the cycle that starts with the discrete space there:

- When a mesh is added, its relation to the one below is noted. Nothing is computed.
- When its cycle is asked for, P1 on the mesh below is assembled, with the transfer to the next
  coarser one, and joins the chain of P1 spaces; so does P1 on the first mesh itself, for CR. The
  chain is made anew of Galerkin products where it does not fit the finest matrix.
- When the cycle is given back, the discrete space leaves it, with its transfer and its sweeps; but
  P1, where that is the discrete space, stays as the chain's new finest.
- When a cycle was given up, the chain goes, and no other is made on finer meshes.
- `Hierarchy.free` lets the rest go. Meshes and spaces live as long as anyone holds one.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from dolfinx import fem
from dolfinx.fem.petsc import assemble_matrix
from petsc4py import PETSc

from ..arrays import FloatArray, IndexArray, Int32Array
from ..fem.layout import Layout
from ..fem.physics import OnMesh, Physics
from ..garbage import hold, release, sweep
from ..mesh.domain import Domain
from ..mesh.exchange import Exchange
from ..options import MATRICES, defaults
from .constrained import ConstrainedMatrix, numbers_of
from .cycle import (
    LONG_SWEEPS,
    SWEEPS,
    Grid,
    Multigrid,
    galerkin_products,
    is_galerkin_product,
)
from .parents import Parents
from .pattern import empty_matrix
from .transfer import Transfer, inclusion, prolongation
from .whole import Whole, suits_whole


@dataclass(frozen=True, eq=False)
class NestedMesh:
    """One mesh of a sequence.

    Attributes:
        physics: What is solved, shared by all meshes.
        domain: Mesh and boundary parts.
        parents: The cells of the mesh below that hold this one's, None on the coarsest.
        given: The physics on it, if somebody has that.
    """

    physics: Physics
    domain: Domain
    parents: Parents | None = None
    given: OnMesh | None = None

    def __post_init__(self) -> None:
        """Free what meshes before have left, and hold this one while there are objects on it."""
        sweep(self.domain.mesh.comm)
        hold(self, self.domain.mesh)

    @cached_property
    def data(self) -> OnMesh:
        """The physics on this mesh."""
        return self.physics.on(self.domain) if self.given is None else self.given

    def tidy(self) -> None:
        """Drop what only assembly and certificate need; who asks for that again makes it anew.

        Solutions do so after their certificate and after each quantity of interest.
        """
        if "data" in vars(self):  # else nobody has asked for it yet
            self.data.tidy()

    @property
    def V(self) -> fem.FunctionSpace:
        """The discrete space."""
        return self.data.V

    @cached_property
    def diameters(self) -> FloatArray:
        """Of this rank's cells, shape (cells,)."""
        mesh = self.domain.mesh
        number = mesh.topology.index_map(mesh.topology.dim).size_local
        return np.asarray(mesh.h(mesh.topology.dim, np.arange(number, dtype=np.int32)))


class Hierarchy:
    """Nested meshes, coarsest first, and the chain of P1 spaces on them.

    Attributes:
        meshes: The meshes so far.
    """

    def __init__(self, physics: Physics, domain: Domain):
        """Begin with the coarsest mesh."""
        self.meshes: tuple[NestedMesh, ...] = (NestedMesh(physics, domain),)
        self._chain: list[Grid] = []  # P1, coarsest first
        self._operators: list[ConstrainedMatrix] = []  # that belong to the chain alone
        self._given_up = False

    def add(
        self,
        domain: Domain,
        parent_cell: Int32Array | IndexArray,
        exchange: Exchange | None = None,
    ) -> None:
        """Add a mesh; the finest so far makes room.

        Args:
            domain: The mesh, whose cells lie in those of the finest so far, and boundary parts;
                the last step of its descent knows whether the same pattern is in all of them.
            parent_cell: For each local cell the coarse cell that holds it, as for `Parents`.
            exchange: The same.
        """
        finest = self.meshes[-1]
        finest.tidy()
        coarse, pattern = finest.domain.mesh, None
        if domain.descent and domain.descent[-1].mesh() is coarse:
            pattern = domain.descent[-1].pattern
        parents = Parents(coarse, domain.mesh, parent_cell, exchange, pattern)
        self.meshes = (*self.meshes, NestedMesh(finest.physics, domain, parents))

    @contextmanager
    def multigrid(
        self, operator: ConstrainedMatrix, dirichlet: Int32Array, again: bool = False
    ) -> Iterator[Multigrid]:
        """Lend the cycle that starts with the discrete space on the finest mesh; collective.

        Args:
            operator: The space's matrix, the identity in the rows and columns of the dofs on Γ0.
            dirichlet: Its owned dofs on Γ0, local numbers.
            again: Whether the matrix as it is, definite, will be solved with again and again.
        """
        grid = self._discrete_space(operator, dirichlet, again)
        below = [] if grid.transfer is None else self._chain
        cycle = Multigrid(
            [grid, *reversed(below)],
            on_one_mesh=len(below) == len(self.meshes),
            given_up=self._given_up,
        )
        try:
            yield cycle
        finally:
            cycle.free()
            if cycle.given_up:
                self._given_up = True
                self.free()
            if grid.dofs.cr or self._given_up:
                _free(grid)
            else:
                self._chain.append(grid)

    def free(self) -> None:
        """Free the chain; for a place that all ranks come through together."""
        for grid in self._chain:
            _free(grid)
        self._free_operators()
        self._chain = []

    def _discrete_space(
        self, operator: ConstrainedMatrix, dirichlet: Int32Array, again: bool
    ) -> Grid:
        """Prepare the discrete space, and the chain below it if there is to be one."""
        mesh = self.meshes[-1]
        dofs = Layout.of_space(mesh.V)
        if again and suits_whole(
            operator.matrix, mesh.domain.mesh.topology.dim, len(operator.dofs)
        ):
            whole = Whole(operator.matrix, operator.dofs)
            if whole.is_accurate():
                return Grid(operator, dofs, dirichlet, whole)
            whole.free()
        if self._given_up or not (dofs.cr or mesh.parents):
            return Grid.at_bottom(operator, dofs, dirichlet, self._given_up)
        while len(self._chain) < max(len(self.meshes) - 1, 1):
            self._add_conforming(self.meshes[len(self._chain)])
        below = self._chain[-1]
        if mesh.parents is None:
            return Grid.above(operator, dofs, dirichlet, inclusion(below.dofs, dofs))
        transfer = prolongation(below.dofs, dofs, mesh.parents)
        if not (mesh.physics.galerkin or is_galerkin_product(below, operator.matrix, transfer)):
            self._remake_chain(operator.matrix, transfer)
        sweeps = LONG_SWEEPS if dofs.cr else SWEEPS
        return Grid.above(operator, dofs, dirichlet, transfer, sweeps)

    def _add_conforming(self, mesh: NestedMesh) -> None:
        """Add P1 on the mesh that is the next finer one to the chain."""
        operator, dofs, dirichlet = conforming(mesh)
        self._operators.append(operator)
        if mesh.parents is None:
            self._chain.append(Grid.at_bottom(operator, dofs, dirichlet))
        else:
            transfer = prolongation(self._chain[-1].dofs, dofs, mesh.parents)
            self._chain.append(Grid.above(operator, dofs, dirichlet, transfer))

    @defaults(MATRICES, prefix="")
    def _remake_chain(self, finer: PETSc.Mat, transfer: Transfer) -> None:
        """Replace the chain's matrices by Galerkin products of a finer one's."""
        former = self._chain
        self._chain = galerkin_products(former[::-1], finer, transfer)[::-1]
        for grid in former:
            grid.solver.free()
        self._free_operators()
        self._operators = [grid.operator for grid in self._chain]

    def _free_operators(self) -> None:
        for operator in self._operators:
            operator.free()
            release(operator.matrix)
        self._operators = []


def _free(grid: Grid) -> None:
    """Free a grid with the way from it to the next coarser one."""
    grid.solver.free()
    if grid.transfer is not None:
        grid.transfer.free()


@defaults(MATRICES, prefix="")
def conforming(mesh: NestedMesh) -> tuple[ConstrainedMatrix, Layout, Int32Array]:
    """Assemble P1 beside CR on a mesh: its matrix, its dofs, those of them on Γ0; collective."""
    data = mesh.data
    p1 = Layout.of_p1(mesh.domain.mesh, data.V.dofmap.index_map_bs)
    form, scale = data.conforming(p1.cells, p1.index_map)
    matrix = assemble_matrix(empty_matrix(p1), form)
    matrix.assemble()
    matrix.scale(scale)
    dirichlet, bounded = p1.owned_at(data.fixed), p1.owned_at(data.bounds)
    matrix.zeroRowsColumns(numbers_of(matrix, dirichlet), 1.0)
    matrix.setOption(PETSc.Mat.Option.SPD, True)
    return ConstrainedMatrix(matrix, bounded), p1, dirichlet
