"""A mesh as arrays: what the certificate needs to know of cells, facets and vertices.

Arrays over cells have the local number first: shape (d + 1, cells), owned cells only. Facet i is
opposite vertex i.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations
from types import MappingProxyType
from typing import Any

import numpy as np
from dolfinx import fem
from dolfinx.mesh import Mesh
from scipy.sparse import csc_array

from .. import compat
from ..arrays import BoolArray, FloatArray, IndexArray, Int32Array, summed
from ..mesh.domain import Domain, Refinement, facet_entities
from ..mesh.shared import shared_maximum, shared_sum
from .space import simplex_measures

BLOCK = 1 << 15
"""Cells that are worked on at a time: as many as the processor's cache holds."""

BESSEL = 3.8317059702
"""First positive zero of J₁, rounded down."""


def blocks(cells: int) -> Iterator[slice]:
    """Cut the cells into consecutive ranges."""
    return (slice(a, min(a + BLOCK, cells)) for a in range(0, cells, BLOCK))


def _extents(mesh: Mesh, nodes: Int32Array) -> tuple[FloatArray, FloatArray]:
    """Find least and largest coordinates of cells with some vertices, shapes (gdim, n)."""
    low = high = mesh.geometry.x.take(nodes[:, 0], axis=0)
    for node in nodes.T[1:]:
        corner = mesh.geometry.x.take(node, axis=0)
        low, high = np.minimum(low, corner), np.maximum(high, corner)
    low, high = (np.ascontiguousarray(x.T[: mesh.geometry.dim]) for x in (low, high))
    return low, high


def _search(
    mesh: Mesh, cells: IndexArray, may: Callable[[FloatArray, FloatArray], BoolArray]
) -> IndexArray:
    """Find those of some cells in whose extents there may be something; see `Cells.search`."""
    nodes, parts = compat.cell_nodes(mesh), (cells[block] for block in blocks(len(cells)))
    found = [which[may(*_extents(mesh, nodes[which]))] for which in parts]
    return np.concatenate([cells[:0], *found])


def pick(values: FloatArray, where: slice | IndexArray) -> FloatArray:
    """Take the values on some cells of an array over all, or the one value that holds on all."""
    return values if values.ndim == 0 else values[where]


def sum_rows(a: FloatArray) -> FloatArray:
    """Sum rows: Σ_i a_i, shape (n,); for few long rows much faster than ``a.sum(axis=0)``."""
    out = a[0] + a[1]
    for row in a[2:]:
        out += row
    return out


def dot_rows(a: FloatArray, b: FloatArray) -> FloatArray:
    """Compute Σ_i a_i b_i, shape (n,)."""
    out = a[0] * b[0]
    for x, y in zip(a[1:], b[1:], strict=True):
        out += x * y
    return out


def at_points(ends: FloatArray, hats: FloatArray) -> FloatArray:
    """Evaluate what is affine on each of some simplices at the same points of all.

    Args:
        ends: Values at the vertices, shape (d + 1, …, n).
        hats: Barycentric coordinates of the points, shape (d + 1, q).

    Returns:
        Shape (…, q, n).
    """
    return np.asarray(hats.T @ np.moveaxis(ends, 0, -2))


def barycentric_coordinates(simplices: FloatArray, points: FloatArray) -> FloatArray:
    """Compute barycentric coordinates of points in simplices.

    Args:
        simplices: Vertices, shape (n, d + 1, 3).
        points: Shape (n, m, 3).

    Returns:
        Shape (n, m, d + 1).
    """
    edges = simplices[:, 1:] - simplices[:, :1]
    inverse = np.linalg.pinv(edges)
    rest = np.einsum("nmx,nxd->nmd", points - simplices[:, :1], inverse)
    return np.concatenate([1.0 - rest.sum(axis=2, keepdims=True), rest], axis=2)


def points_of(corners: FloatArray, hats: FloatArray) -> FloatArray:
    """Find the same points of some simplices; what their corners have in common is exact.

    A condition on a coordinate may hold with equality on all of a facet: there rounding of the
    coordinate must not decide.

    Args:
        corners: Shape (d + 1, gdim, n).
        hats: Barycentric coordinates of the points, shape (d + 1, q).

    Returns:
        Shape (gdim, q, n).
    """
    low, high = (np.expand_dims(x, 1) for x in (corners.min(axis=0), corners.max(axis=0)))
    return np.clip(at_points(corners, hats), low, high)


def poincare(tdim: int) -> float:
    """Return C with ‖w − w_T‖_T ≤ C h_T ‖∇w‖_T for all w ∈ H¹(T).

    1/π for any convex cell (Payne and Weinberger); 1/j₁₁ for triangles (Laugesen and Siudeja).
    """
    return 1 / BESSEL if tdim == 2 else 1 / np.pi


@dataclass(frozen=True, eq=False)
class BoundaryFacets:
    """Boundary facets of one part, seen from their cells.

    Attributes:
        cells: The cell of each facet, shape (n,).
        local: Number of the facet in its cell, shape (n,).
        dofs: The facet's degree of freedom, shape (n,).
        ends: The facet's vertices, in the order of the cell's closure, shape (d, n).
    """

    cells: IndexArray
    local: IndexArray
    dofs: IndexArray
    ends: IndexArray

    @classmethod
    def joined(cls, sides: Sequence[BoundaryFacets], d: int) -> BoundaryFacets:
        """Put those of several parts one after the other, for cells of dimension d."""
        none = np.empty(0, dtype=np.intp)
        sides = [cls(none, none, none, none.reshape(d, 0)), *sides]
        return cls(
            np.concatenate([side.cells for side in sides]),
            np.concatenate([side.local for side in sides]),
            np.concatenate([side.dofs for side in sides]),
            np.concatenate([side.ends for side in sides], axis=1),
        )

    def picked(self, where: BoolArray | IndexArray) -> BoundaryFacets:
        """Take some of the facets."""
        ends = self.ends[:, where]
        return BoundaryFacets(self.cells[where], self.local[where], self.dofs[where], ends)

    @property
    def entities(self) -> Int32Array:
        """Pairs (cell, local facet), as Expressions want them."""
        return np.column_stack([self.cells, self.local]).astype(np.int32)


Layers = list[tuple[IndexArray, BoolArray]]

THIN = 25.0
"""h_T²/|T| of cells from which on they are thin: 2.3 if all sides are equal, 4 for half a square,
20 for half a rectangle 1 : 10."""


class Cells:
    """Facets, vertices and measures of a mesh's cells, for the certificate.

    Attributes:
        number: Owned cells.
        facets: Facet dofs of each cell, shape (d + 1, cells).
        vertices: Vertices of each cell, shape (d + 1, cells).
        others: The vertices of facet i but vertex i, shape (d + 1, d).
        pairs: The pairs i < j of local vertices, in the order of the next two arrays' rows.
        lengths: |X_i − X_j|², shape (pairs, cells).
        stiffness: |T| ∇λ_i·∇λ_j, shape (pairs, cells).
        volume: |T|, shape (cells,).
        sides: The boundary facets by part.
        sinks: The parts that take up a flux, and b on their facets, shape (n,) or ().
        fixed: The parts that make Γ0, and these.
        stretch: Symmetric matrices of determinant 1 by which lengths on each cell are measured,
            shape (cells, d, d); None where they are what they are. X stands for stretch X then, and
            ∇ for stretch⁻¹ ∇, in `lengths`, `stiffness` and all that is made of them. |T|, and what
            flows through facets, do not change.
    """

    def __init__(
        self,
        domain: Domain,
        V: fem.FunctionSpace,
        fixed: Sequence[int],
        sinks: Mapping[int, FloatArray] = MappingProxyType({}),
        stretch: FloatArray | None = None,
    ):
        """Read a domain's mesh; V is its Crouzeix-Raviart space."""
        mesh, self.fixed, self.sinks = domain.mesh, (*fixed, *sinks), sinks
        self.stretch = stretch
        self.domain, self.V, self.comm = domain, V, mesh.comm
        d = self.tdim = mesh.topology.dim
        n = self.number = mesh.topology.index_map(d).size_local
        self.facets = _rows(V.dofmap.list[:n])
        corners = mesh.topology.connectivity(d, 0).array.reshape(-1, d + 1)
        self.vertices = _rows(corners[:n])
        self.others = np.array([[j for j in range(d + 1) if j != i] for i in range(d + 1)])
        self.pairs = list(combinations(range(d + 1), 2))
        self.lengths = np.empty((len(self.pairs), n))
        self.stiffness = np.empty((len(self.pairs), n))
        self.volume = np.empty(n)
        x = np.ascontiguousarray(mesh.geometry.x[:, : mesh.geometry.dim].T)
        nodes = _rows(compat.cell_nodes(mesh)[:n])
        for block in blocks(n):
            corner = [[row.take(i) for row in x] for i in nodes[:, block]]
            if stretch is not None:
                corner = [list(np.einsum("nij,jn->in", stretch[block], c)) for c in corner]
            edges = [[p - q for p, q in zip(c, corner[0], strict=True)] for c in corner[1:]]
            for k, (i, j) in enumerate(self.pairs):
                self.lengths[k, block] = sum(
                    (p - q) ** 2 for p, q in zip(corner[i], corner[j], strict=True)
                )
            self.volume[block], self.stiffness[:, block] = _shape(edges, self.lengths[:, block])

    def drain(self, sinks: Mapping[int, FloatArray]) -> None:
        """Let parts take up a flux, which asks for data that ask for a mesh; before all else."""
        self.fixed, self.sinks = (*self.fixed, *sinks), sinks

    def unstretched(self) -> Cells:
        """Return the same cells with lengths as they are."""
        return self if self.stretch is None else Cells(self.domain, self.V, self.fixed, self.sinks)

    def extents(self, block: slice) -> tuple[FloatArray, FloatArray]:
        """Find least and largest coordinates in some cells, shapes (gdim, cells in the block)."""
        return _extents(self.domain.mesh, compat.cell_nodes(self.domain.mesh)[: self.number][block])

    def search(self, may: Callable[[FloatArray, FloatArray], BoolArray]) -> IndexArray:
        """Find owned cells in whose extents there may be something, ascending.

        Where there is none in a coarser cell's, there is none in those of what it was cut into.

        Args:
            may: Tells so of boxes by least and largest coordinates, shapes (gdim, n); shape (n,).
        """
        mesh, way = self.domain.mesh, list[tuple[Mesh, Refinement]]()
        for step in reversed(self.domain.descent):
            coarse = step.mesh()
            if coarse is None or step.exchange is not None:
                break
            way.append((mesh, step))
            mesh = coarse
        # ghost cells are left behind by the first step
        owned = mesh.topology.index_map(mesh.topology.dim).size_local
        found = _search(mesh, np.arange(owned), may)
        for fine, step in reversed(way):
            if step.pattern is None:
                inside = np.zeros(len(compat.cell_nodes(mesh)), dtype=bool)
                inside[found] = True
                children = np.flatnonzero(inside[step.parent])
            else:
                number = len(step.pattern)
                children = (number * found[:, None] + np.arange(number)).ravel()
            found, mesh = _search(fine, children, may), fine
        return found

    def corners(self, block: slice) -> tuple[FloatArray, FloatArray]:
        """Find stretched vertices and ∇λ_i of some cells, shapes (d + 1, cells in the block, d)."""
        mesh = self.domain.mesh
        nodes = compat.cell_nodes(mesh)[: self.number][block]
        x = mesh.geometry.x[nodes.T, : mesh.geometry.dim]
        if self.stretch is not None:
            x = np.einsum("nij,cnj->cni", self.stretch[block], x)
        inverse = np.linalg.inv((x[1:] - x[0]).transpose(1, 0, 2)).transpose(2, 0, 1)
        return x, np.concatenate([-inverse.sum(axis=0, keepdims=True), inverse])

    def coefficient(
        self, kappa: FloatArray, mesh: Mesh | None = None, where: slice | IndexArray = slice(None)
    ) -> fem.Function:
        """Make κ for forms: by cells, and with a stretch κ stretch⁻², a tensor; collective.

        Args:
            kappa: Shape (cells,) or ().
            mesh: One that some of the cells make up; this one if left out.
            where: Which cells those are, in its order.
        """
        mesh = mesh or self.domain.mesh
        values = np.broadcast_to(kappa, self.number)[where]
        if self.stretch is None:
            return on_cells(mesh, values)
        inverse = np.linalg.inv(self.stretch[where])
        return on_cells(mesh, values[:, None, None] * (inverse @ inverse))

    @cached_property
    def diameter2(self) -> FloatArray:
        """h_T², shape (cells,)."""
        return self.lengths.max(axis=0)

    @cached_property
    def turns(self) -> FloatArray:
        """1 for triangles whose vertices turn left, −1 for others, shape (cells,)."""
        x = self.domain.mesh.geometry.x[compat.cell_nodes(self.domain.mesh)[: self.number]]
        (a, b), (c, d) = (x[:, 1:, :2] - x[:, :1, :2]).transpose(1, 2, 0)
        return np.where(a * d > b * c, 1.0, -1.0)

    @cached_property
    def ways(self) -> FloatArray:
        """1 where a triangle goes along its facet as its neighbour does, shape (3, cells).

        That is from the end with the lower local number to the other; −1 on one of both sides where
        they do not agree.
        """
        return np.stack([self.ways_between(*self.vertices[pair]) for pair in self.others])

    def ways_between(self, first: IndexArray, second: IndexArray) -> FloatArray:
        """Return 1 where the first of two vertices precedes the second on all ranks, else −1."""
        name = self.domain.mesh.topology.index_map(0).local_to_global
        names = (name(ends.astype(np.int32)) for ends in (first, second))
        return np.where(np.less(*names), 1.0, -1.0)

    @cached_property
    def sides(self) -> dict[int, BoundaryFacets]:
        """Boundary facets of owned cells."""
        sides = {}
        for part, found in self.domain.all_facets.items():
            cells, local = facet_entities(self.domain.mesh, found).T.astype(np.intp)
            own = cells < self.number
            cells, local = cells[own], local[own]
            sides[part] = BoundaryFacets(
                cells,
                local,
                self.facets[local, cells],
                self.vertices[self.others[local].T, cells[None, :]],
            )
        return sides

    @cached_property
    def exterior(self) -> BoolArray:
        """True for each facet dof on the boundary, ghosts included."""
        mark = self._facet_zeros()
        for side in self.sides.values():
            mark[side.dofs] = 1.0
        return self.share(mark) > 0

    @cached_property
    def layers(self) -> Layers:
        """Cells by the number of facets between them and Γ0 or a part with a b, nearest first."""
        return self.layered([self.sides[part].dofs for part in self.fixed])

    @cached_property
    def layers_from_fixed(self) -> Layers:
        """The same with Γ0 alone; not all cells need have a way there."""
        return self.layered([self.sides[p].dofs for p in self.fixed if p not in self.sinks])

    def layered(self, exits: Sequence[IndexArray], takers: BoolArray | None = None) -> Layers:
        """Sort cells by the number of facets between them and others, nearest first; collective.

        Args:
            exits: Facet dofs that count as between a cell and the outside.
            takers: Cells that have no way to go, shape (cells,); None for none.

        Returns:
            For each layer its cells, shape (n,), and which of their local facets lead back, shape
            (d + 1, n): one or more. Takers are in none.
        """
        d = self.tdim
        owners = np.full((2, len(self.exterior)), -1)
        flat, cell = self.facets.ravel(), np.tile(np.arange(self.number), d + 1)
        owners[0, flat] = cell
        other = owners[0, flat] != cell
        owners[1, flat[other]] = cell[other]
        reached = np.zeros(self.number, dtype=bool) if takers is None else takers.copy()
        front = np.zeros(len(self.exterior))
        for dofs in (*exits, self.facets[:, reached].ravel()):
            front[dofs] = 1.0
        seen = self.share(front) > 0
        found, layers = np.flatnonzero(seen), []
        while self.comm.allreduce(len(found)) > 0:
            near = owners[:, found].ravel()
            layer = np.unique(near[near >= 0])
            layer = layer[~reached[layer]]
            facets = self.facets[:, layer]
            reached[layer] = True
            layers.append((layer, seen[facets]))
            new = np.unique(facets[~seen[facets]])
            if self.comm.size > 1:
                theirs = self.from_others(new, np.ones(len(new))) > 0
                new = np.union1d(new, self.between[theirs & ~seen[self.between]])
            seen[new] = True
            found = new
        return layers

    def around(self, chosen: BoolArray, layers: int) -> BoolArray:
        """Tell which vertices so many layers of cells around some have; collective.

        Args:
            chosen: These, ghosts included.
            layers: How many.
        """
        topology = self.domain.mesh.topology
        topology.create_connectivity(0, self.tdim)
        links = topology.connectivity(0, self.tdim)
        reached = self.share(chosen.astype(np.float64), 0) > 0.0
        found = np.flatnonzero(reached)
        for _ in range(layers):
            first = links.offsets[found]
            count = links.offsets[found + 1] - first
            shift = np.repeat(first - np.cumsum(count) + count, count)
            near = links.array[shift + np.arange(len(shift))]
            found = np.unique(self.vertices[:, near[near < self.number]])
            found = found[~reached[found]]
            if self.comm.size > 1:
                new = np.zeros(len(reached))
                new[found] = 1.0
                found = np.flatnonzero((self.share(new, 0) > 0.0) & ~reached)
            reached[found] = True
        return reached

    def over_facets(self, values: FloatArray, shared: bool = True) -> FloatArray:
        """Add up local values, shape (d + 1, cells), for each facet dof.

        Args:
            values: One for each cell and facet.
            shared: Whether to add the other ranks' shares, ghosts included.
        """
        total = _sums(self._of_facets, values)
        return self.share(total) if shared else total

    def masses(self, rate: FloatArray) -> FloatArray:
        """Compute ∫ rate ψ² for each facet dof's function ψ, this rank's share; for triangles.

        There the functions of Crouzeix-Raviart are orthogonal, and these all products there are.

        Args:
            rate: A number on each owned cell, shape (cells,) or ().
        """
        of_cells = rate * self.volume / 3.0
        return self.over_facets(np.broadcast_to(of_cells, self.facets.shape), shared=False)

    def over_vertices(self, values: FloatArray) -> FloatArray:
        """Add up local values, shape (d + 1, cells), for each vertex, ghosts included."""
        return self.share(_sums(self._of_vertices, values), 0)

    @cached_property
    def _of_facets(self) -> csc_array:
        return _column(self.facets, self.V.dofmap.index_map)

    @cached_property
    def _of_vertices(self) -> csc_array:
        return _column(self.vertices, self.domain.mesh.topology.index_map(0))

    def share(self, values: FloatArray, dim: int | None = None) -> FloatArray:
        """Sum the ranks' shares of facet dofs, or of vertices (``dim`` = 0), in place."""
        topology = self.domain.mesh.topology
        index_map = self.V.dofmap.index_map if dim is None else topology.index_map(dim)
        return shared_sum(self.domain.mesh, index_map, values)

    def largest_at_vertices(self, ends: IndexArray, values: FloatArray) -> FloatArray:
        """Find the largest value that any rank's facets give each vertex, with ghosts; collective.

        Args:
            ends: The facets' vertices, shape (d, n).
            values: One for each, shape (d, n).

        Returns:
            −∞ where there is no facet.
        """
        index_map = self.domain.mesh.topology.index_map(0)
        found: FloatArray = np.full(index_map.size_local + index_map.num_ghosts, -np.inf)
        np.maximum.at(found, ends, values)
        return shared_maximum(self.domain.mesh, index_map, found)

    @cached_property
    def between(self) -> IndexArray:
        """Facet dofs that other ranks see as well, shape (n,)."""
        mark = self._facet_zeros()
        mark[self.owned_facets() :] = 1.0
        return np.flatnonzero(self.share(mark) > 0)

    @cached_property
    def _mailbox(self) -> FloatArray:
        """One for all messages, 0 between them: a new one would take longer than all the rest."""
        return self._facet_zeros()

    def _facet_zeros(self) -> FloatArray:
        index_map = self.V.dofmap.index_map
        return np.zeros(index_map.size_local + index_map.num_ghosts)

    def from_others(self, where: IndexArray, values: FloatArray) -> FloatArray:
        """Sum what the other ranks have, in the order of ``between``; collective.

        Args:
            where: Dofs that this rank has something for, each once.
            values: What it has, shape (n,).
        """
        box = self._mailbox
        box[where] = values
        mine = box[self.between]
        theirs = self.share(box)[self.between] - mine
        box[where] = 0.0
        box[self.between] = 0.0
        return theirs

    def owned_facets(self) -> int:
        """Return the number of facet dofs this rank owns."""
        return self.V.dofmap.index_map.size_local

    def owned_vertices(self) -> int:
        """Return the number of vertices this rank owns."""
        return self.domain.mesh.topology.index_map(0).size_local

    def total(self, *values: float | np.floating | FloatArray) -> FloatArray:
        """Sum over all ranks."""
        return summed(self.comm, np.array(values, dtype=np.float64))

    def apply(self, c: FloatArray, block: slice | IndexArray) -> FloatArray:
        """Compute |T| ∇λ_i·∇w for w = Σ c_i λ_i, shape (d + 1, cells in the block)."""
        out = np.empty_like(c)
        if self.tdim == 2:
            # what flows to each vertex from the next one, all the way round
            first, third, second = self.stiffness
            first = (c[1] - c[0]) * first[block]
            second = (c[2] - c[1]) * second[block]
            third = (c[0] - c[2]) * third[block]
            np.subtract(first, third, out=out[0])
            np.subtract(second, first, out=out[1])
            np.subtract(third, second, out=out[2])
            return out
        out[:] = 0.0
        for (i, j), s in zip(self.pairs, self.stiffness, strict=True):
            flow = c[j] - c[i]
            flow *= s[block]
            out[i] += flow
            out[j] -= flow
        return out

    def slopes(self, c: FloatArray) -> FloatArray:
        """Compute |T| |∇w|² for w = Σ c_i λ_i, c of shape (d + 1, cells), shape (cells,)."""
        out = np.empty(self.number)
        for block in blocks(self.number):
            out[block] = dot_rows(c[:, block], self.apply(c[:, block], block))
        return out

    def opposite(self, side: BoundaryFacets) -> FloatArray:
        """Compute |T| |∇λ_i|² for the vertices opposite boundary facets, shape (n,)."""
        out = np.zeros(len(side.cells))
        for (i, j), s in zip(self.pairs, self.stiffness, strict=True):
            out -= np.where((side.local == i) | (side.local == j), s[side.cells], 0.0)
        return out

    def squares(self, block: slice | IndexArray) -> FloatArray:
        """Compute |T| |∇λ_i|², shape (d + 1, cells in the block)."""
        out = np.zeros((self.tdim + 1, len(self.volume[block])))
        for (i, j), s in zip(self.pairs, self.stiffness[:, block], strict=True):
            out[i] -= s
            out[j] -= s
        return out

    def trace(self, block: slice | IndexArray) -> FloatArray:
        """Compute |T| Σ |∇λ_i|²."""
        return -2.0 * sum_rows(self.stiffness[:, block])


def on_cells(mesh: Mesh, values: FloatArray, name: str | None = None) -> fem.Function:
    """Make a function that is constant on each cell; collective.

    Args:
        mesh: The mesh.
        values: Numbers or tensors on the cells of this rank, shape (cells, …).
        name: What writers are to call it.
    """
    function = fem.Function(fem.functionspace(mesh, ("DG", 0, values.shape[1:])), name=name)
    function.x.array[: values.size] = values.ravel()
    function.x.scatter_forward()
    return function


def corner_points(
    cells: Cells, side: BoundaryFacets, stretched: bool = False
) -> tuple[FloatArray, FloatArray]:
    """Find the opposite vertex, shape (n, gdim), and the ends, shape (d, n, gdim).

    They are the stretched ones where that is asked for and the cells have a stretch.
    """
    mesh = cells.domain.mesh
    nodes = compat.cell_nodes(mesh)[side.cells]
    x = mesh.geometry.x[:, : mesh.geometry.dim]
    apex = x[np.take_along_axis(nodes, side.local[:, None], axis=1)[:, 0]]
    ends = x[np.take_along_axis(nodes, cells.others[side.local], axis=1).T]
    if stretched and cells.stretch is not None:
        stretch = cells.stretch[side.cells]
        apex, ends = (np.einsum("nij,...nj->...ni", stretch, points) for points in (apex, ends))
    return apex, ends


def measures(cells: Cells, side: BoundaryFacets) -> FloatArray:
    """Compute |F|, shape (n,)."""
    _, ends = corner_points(cells, side)
    return simplex_measures(ends.transpose(1, 0, 2))


def _rows(table: Int32Array) -> IndexArray:
    """Transpose a table of indices, row by row in memory."""
    return np.ascontiguousarray(table.T, dtype=np.intp)


def _column(table: IndexArray, index_map: Any) -> csc_array:
    """Make a column with an entry, not set, for each place of a table of rows, which may repeat.

    Its product with 1 adds up what each row has, in the order of the table: as `np.bincount`, but
    that looks through the table first, which takes as long again.
    """
    column = csc_array((index_map.size_local + index_map.num_ghosts, 1))
    column.indices, column.indptr = table.ravel(), np.array([0, table.size])
    return column


def _sums(column: csc_array, values: FloatArray) -> FloatArray:
    """Put values into a column from `_column`, and add them up for each row."""
    rows = np.ascontiguousarray(values, dtype=np.float64)
    column.data = rows.reshape(column.indices.shape)  # which insists on as many
    total: FloatArray = column @ np.ones(1)
    column.data = np.empty(0)  # they are the caller's, to be freed
    return total


def _shape(edges: list[list[FloatArray]], lengths: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Compute volumes and |T| ∇λ_i·∇λ_j of cells from the edges at their first vertex."""
    if len(edges) == 2:
        (a, b), (c, d) = edges
        volume = 0.5 * np.abs(a * d - b * c)
        scale = 0.125 / volume
        half = sum_rows(lengths)
        return volume, (2.0 * lengths - half) * scale
    jacobian = np.stack([np.stack(e, axis=-1) for e in edges], axis=-2)
    size = len(edges)
    volume = np.abs(np.linalg.det(jacobian)) / np.prod(np.arange(1, size + 1))
    inverse = np.linalg.inv(jacobian)
    gradients = np.concatenate([-inverse.sum(axis=-1, keepdims=True), inverse], axis=-1)
    rows = [
        volume * (gradients[..., i] * gradients[..., j]).sum(axis=-1)
        for i, j in combinations(range(size + 1), 2)
    ]
    return volume, np.stack(rows)


def vertex_rows(u: FloatArray, cells: Cells) -> FloatArray:
    """Compute u_h at the cells' vertices from its facet dofs, shape (d + 1, cells)."""
    out = np.empty(cells.facets.shape)
    for block in blocks(cells.number):
        values = u[cells.facets[:, block]]
        np.subtract(sum_rows(values), cells.tdim * values, out=out[:, block])
    return out
