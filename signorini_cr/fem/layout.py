"""Places of a space's dofs on the mesh, and sums of what ranks have for them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import basix
import numpy as np
from dolfinx import fem
from dolfinx.mesh import Mesh
from petsc4py import PETSc

from .. import compat
from ..arrays import BoolArray, FloatArray, Int32Array
from ..mesh.domain import facet_entities
from ..mesh.shared import shared_maximum, shared_sum
from .physics import Imposed
from .space import facet_corners, function_space


@dataclass(frozen=True, eq=False)
class Layout:
    """Places of the nodes of CR or P1, and the number of unknowns of each.

    Attributes:
        mesh: The mesh.
        cells: Local nodes of the local cells, shape (cells, d + 1); node i of a cell belongs to
            its vertex i (P1) or to the facet opposite (CR).
        index_map: Their distribution over the ranks.
        cr: Whether it is CR.
        block: Unknowns, or dofs, of a node: those of node i have the numbers from block * i on.
    """

    mesh: Mesh
    cells: Int32Array
    index_map: Any
    cr: bool
    block: int = 1

    @classmethod
    def of_space(cls, V: fem.FunctionSpace) -> Layout:
        """Describe the dofs of a CR or P1 space."""
        cr = V.element.basix_element.family is basix.ElementFamily.CR
        return cls(V.mesh, V.dofmap.list, V.dofmap.index_map, cr, V.dofmap.index_map_bs)

    @classmethod
    def of_p1(cls, mesh: Mesh, block: int = 1) -> Layout:
        """Describe P1 without new numbers: the nodes of a straight-sided mesh are its vertices."""
        if compat.coordinate_map(mesh).degree == 1:
            return cls(mesh, compat.cell_nodes(mesh), mesh.geometry.index_map(), False, block)
        return replace(cls.of_space(function_space(mesh, "P1")), block=block)

    @property
    def size(self) -> tuple[int, int]:
        """Number of owned dofs, and of all on all ranks, as PETSc takes them."""
        return self.block * self.index_map.size_local, self.block * self.index_map.size_global

    @property
    def local(self) -> int:
        """Number of local dofs, ghosts included."""
        nodes: int = self.index_map.size_local + self.index_map.num_ghosts
        return self.block * nodes

    def numbers(self, dofs: Int32Array) -> Int32Array:
        """Return the global numbers of local dofs."""
        if self.mesh.comm.size == 1:
            return dofs
        nodes, component = np.divmod(dofs.ravel(), self.block)
        numbers = self.index_map.local_to_global(nodes).astype(PETSc.IntType) * self.block
        return (numbers + component).reshape(dofs.shape)

    def ends(self, facets: Int32Array) -> Int32Array:
        """Find the nodes of P1 at the vertices of exterior facets, shape (n, d)."""
        cells, local = facet_entities(self.mesh, facets).T
        ends: Int32Array = self.cells[cells[:, None], facet_corners(self.mesh)[local]]
        return ends

    def owned_at(self, imposed: Sequence[Imposed]) -> Int32Array:
        """Find the owned dofs of P1 at whose vertices any rank has something imposed, ascending."""
        dofs = [self.block * self.ends(i.facets)[:, :, None] + i.components for i in imposed]
        none = np.empty(0, dtype=np.int32)
        return self.owned_among(np.concatenate([none, *(each.ravel() for each in dofs)]))

    def nodes_at(self, facets: Int32Array) -> Int32Array:
        """Find the local nodes of P1 at whose vertices any rank has one of its facets, ascending.

        Args:
            facets: Exterior ones.

        Returns:
            Ghosts included, as `dolfinx.fem.dirichletbc` takes them.
        """
        nodes = replace(self, block=1)
        return np.flatnonzero(nodes.named(self.ends(facets))).astype(np.int32)

    def owned_among(self, dofs: Int32Array) -> Int32Array:
        """Find the owned dofs among those that any rank names, local numbers, ascending."""
        return np.flatnonzero(self.named(dofs)[: self.size[0]]).astype(np.int32)

    def named(self, dofs: Int32Array) -> BoolArray:
        """Tell which local dofs any rank names: truth values, over which numpy is the fastest."""
        named = np.zeros(self.local)
        named[dofs] = 1.0
        return np.asarray(self.shared_sum(named) > 0.0)

    def shared_sum(self, array: FloatArray) -> FloatArray:
        """Sum up, in place, what the ranks have for each shared dof."""
        return shared_sum(self.mesh, self.index_map, array, self.block)

    def shared_maximum(self, array: FloatArray) -> FloatArray:
        """Find, in place, the largest of what the ranks have for each shared dof."""
        return shared_maximum(self.mesh, self.index_map, array, self.block)
