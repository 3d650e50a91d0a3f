"""Fine cells in their parents: the parents' shape functions at the fine dofs.

All that need be known of two nested meshes is the coarse cell that each fine cell lies in. On
regular refinements the same pattern repeats in every parent, and one copy of it does for all; of
those that we make it is known beforehand.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property, reduce

import numpy as np
import numpy.typing as npt
from dolfinx.mesh import Mesh

from .. import compat
from ..arrays import FloatArray, IndexArray, Int32Array
from ..fem.cells import barycentric_coordinates
from ..fem.layout import Layout
from ..mesh.exchange import Exchange

_DIRECTION = np.sqrt([2.0, 3.0, 5.0])
"""No edge or median of a cell is at right angles to it, unless on purpose."""

COORDINATE_ROUNDING = 1e-6
"""Barycentric coordinates below this are 0: far from the origin few digits of a cell are left."""


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
