"""Fine cells in their parents: the parents' shape functions at the fine dofs.

All that need be known of two nested meshes is the coarse cell that each fine cell lies in. On
regular refinements the same pattern repeats in every parent, and one copy of it does for all; of
those that we make it is known beforehand.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, reduce
from typing import Any

import basix
import numpy as np
import numpy.typing as npt
from dolfinx import fem
from dolfinx.mesh import Mesh
from petsc4py import PETSc

from .. import compat
from ..arrays import FloatArray, IndexArray, Int32Array
from ..fem.cells import barycentric_coordinates
from ..fem.physics import Imposed
from ..fem.space import facet_corners, function_space
from ..mesh.domain import facet_entities
from ..mesh.exchange import Exchange
from ..mesh.shared import shared_maximum, shared_sum

_DIRECTION = np.sqrt([2.0, 3.0, 5.0])
"""No edge or median of a cell is at right angles to it, unless on purpose."""

COORDINATE_ROUNDING = 1e-6
"""Barycentric coordinates below this are 0: far from the origin few digits of a cell are left."""


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

    def owned_among(self, dofs: Int32Array) -> Int32Array:
        """Find the owned dofs among those that any rank names, local numbers, ascending."""
        named = np.zeros(self.local)
        named[dofs] = 1.0
        # numpy is ten times as fast over truth values as over numbers
        return np.flatnonzero(self.shared_sum(named)[: self.size[0]] > 0.0).astype(np.int32)

    def shared_sum(self, array: FloatArray) -> FloatArray:
        """Sum up, in place, what the ranks have for each shared dof."""
        return shared_sum(self.mesh, self.index_map, array, self.block)

    def shared_maximum(self, array: FloatArray) -> FloatArray:
        """Find, in place, the largest of what the ranks have for each shared dof."""
        return shared_maximum(self.mesh, self.index_map, array, self.block)


class Parents:
    """The coarse cell that each fine cell lies in, and its place there.

    Attributes:
        cell: For each local fine cell the coarse cell that holds it: its local index, or, where
            fine cells have moved, its row among those fetched from other ranks.
    """

    def __init__(
        self,
        coarse: Mesh,
        fine: Mesh,
        cell: Int32Array | IndexArray,
        exchange: Exchange | None = None,
        pattern: FloatArray | None = None,
    ):
        """Relate two nested meshes.

        Args:
            coarse: The one.
            fine: The other.
            cell: For each local fine cell the local coarse cell that holds it; or its row among
                those that the exchange fetches.
            exchange: What fetches them from other ranks, if fine cells have moved.
            pattern: The same in every parent, if that is known, see `Refinement`.
        """
        self.cell = cell
        self._coarse, self._fine, self._exchange = coarse, fine, exchange
        self._pattern = pattern

    def take(
        self, values: npt.NDArray, nodes: Int32Array, cells: Int32Array | slice = slice(None)
    ) -> npt.NDArray:
        """Take the values at the nodes of fine cells' parents; collective.

        Args:
            values: For each local node of the coarse mesh, shape (nodes, …).
            nodes: Those of the local coarse cells, shape (coarse cells, …).
            cells: Local fine cells; all, if left out.

        Returns:
            For each of these what `values[nodes]` has for its parent.
        """
        parents = self.cell[cells]
        if self._exchange is None:
            return values[nodes[parents]]
        return self._exchange.fetch(values[nodes])[parents]

    def collected(self, values: FloatArray, ufunc: np.ufunc = np.add) -> FloatArray:
        """Put together what the children of each coarse cell of this rank have; collective.

        Args:
            values: For each fine cell of this rank.
            ufunc: What puts two values together: `np.add` or `np.minimum`.

        Returns:
            For each coarse cell of this rank.
        """
        if self.regular:
            children = values.reshape(-1, 2**self._coarse.topology.dim).T
            return reduce(ufunc, children[1:], children[0])
        first = 0.0 if ufunc is np.add else np.inf
        topology = self._coarse.topology
        result = np.full(topology.index_map(topology.dim).size_local, first)
        if self._exchange is None:
            ufunc.at(result, self.cell[: len(values)], values)
            return result
        rows = np.full(self._exchange.count, first)
        ufunc.at(rows, self.cell[: len(values)], values)
        ufunc.at(result, self._exchange.rows, self._exchange.give_back(rows))
        return result

    def layout(self, coarse: Layout) -> Layout:
        """Describe the coarse dofs, with the cells that `cell` numbers; collective."""
        if self._exchange is None:
            return coarse
        index_map = coarse.index_map
        first, end = index_map.local_range
        owner = np.full(index_map.size_local + index_map.num_ghosts, coarse.mesh.comm.rank)
        owner[index_map.size_local :] = index_map.owners
        nodes = coarse.cells.ravel()
        of_cells = np.column_stack([index_map.local_to_global(nodes), owner[nodes]])
        told = self._exchange.fetch(of_cells.reshape(-1, 2 * coarse.cells.shape[1])).reshape(-1, 2)
        number, owner = told.T
        others = (number < first) | (number >= end)
        ghosts, at, place = np.unique(number[others], return_index=True, return_inverse=True)
        cells = (number - first).astype(np.int32)
        cells[others] = index_map.size_local + place
        owners = owner[others][at].astype(np.int32)
        seen = compat.index_map(coarse.mesh.comm, index_map.size_local, ghosts, owners)
        return replace(coarse, cells=cells.reshape(-1, coarse.cells.shape[1]), index_map=seen)

    @cached_property
    def regular(self) -> bool:
        """True if every coarse cell has its 2^d children in a row, on this rank."""
        if self._exchange is not None:
            return False
        if self._pattern is not None:
            return True
        topology = self._coarse.topology
        cells = topology.index_map(topology.dim).size_local
        children = 2**topology.dim
        return len(self.cell) == children * cells and np.array_equal(
            self.cell, np.arange(len(self.cell)) // children
        )

    @cached_property
    def barycentric(self) -> FloatArray:
        """The parent's barycentric coordinates of the vertices of each fine cell.

        Shape (cells, d + 1, d + 1): vertex, coordinate. Shorter where the pattern repeats: with m
        rows, those of fine cell c are in row c % m.
        """
        coarse, fine, d = self._coarse, self._fine, self._fine.topology.dim
        children = 2**d
        x, x_coarse = (mesh.geometry.x[:, : mesh.geometry.dim] for mesh in (fine, coarse))
        nodes = compat.cell_nodes(fine)[: len(self.cell)]
        parents = compat.cell_nodes(coarse)
        if len(self.cell) > 0 and self.regular:
            if self._pattern is not None:
                return self._pattern
            # Does the pattern of the first cell repeat? One coordinate of each vertex tells, in a
            # direction where no two points of a cell are at the same place
            first = x_coarse[parents[:1].repeat(children, axis=0)]
            pattern = barycentric_coordinates(first, x[nodes[:children]])
            theirs, own = (points @ _DIRECTION[: points.shape[1]] for points in (x_coarse, x))
            inner = theirs[parents[: len(nodes) // children]]
            deviation = max(
                np.abs(inner @ pattern[:, k].T - own[nodes[:, k].reshape(-1, children)]).max()
                for k in range(d + 1)
            )
            if deviation <= 1e-10 * np.abs(x_coarse).max():
                return pattern
        return barycentric_coordinates(self.take(x_coarse, parents), x[nodes])

    def weights(self, coarse: Layout, fine: Layout) -> FloatArray:
        """Evaluate the parent's shape functions at the dofs of each fine cell.

        Returns:
            Shape (cells, d + 1, d + 1): dof of the fine cell, dof of its parent; as many rows as
            `barycentric`.
        """
        at = self.barycentric
        d = at.shape[-1] - 1
        if fine.cr:  # facet midpoints
            at = (at.sum(axis=1, keepdims=True) - at) / d
        weights = 1.0 - d * at if coarse.cr else at.copy()
        weights[np.abs(weights) < COORDINATE_ROUNDING] = 0.0
        return weights
