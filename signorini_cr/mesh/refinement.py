"""Nested meshes: every triangle into four, or marked triangles only.

Both keep the children of a cell on its rank and carry boundary parts and materials along.
"""

from __future__ import annotations

import weakref
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import ufl
from dolfinx import cpp, la
from dolfinx.mesh import CellType, Mesh, MeshTags, RefinementOption, meshtags
from dolfinx.mesh import refine as split

from .. import compat
from ..arrays import Int32Array
from ..errors import InputError
from .domain import Domain, Refinement


def refine(domain: Domain) -> tuple[Domain, Int32Array]:
    r"""Cut every triangle into four similar ones; collective.

    Child k < 3 of a cell keeps its vertex k, child 3 lies in the middle; m_i is the midpoint of
    the facet opposite vertex i:

                 v2
                / 2 \
              m1 --- m0
             / 0 \ 3 / 1 \
           v0 --- m2 --- v1

    Args:
        domain: Straight-sided triangles; ghost cells are left behind.

    Returns:
        The fine domain, without ghost cells, and the parent of every fine cell, both local
        indices: the children of cell c are 4 c, …, 4 c + 3.

    Raises:
        InputError: The mesh does not consist of straight-sided triangles.
    """
    coarse = _prepared(domain.mesh)
    cells = coarse.topology.index_map(2).size_local
    corners = _table(coarse.topology.connectivity(2, 0))[:cells]
    facets = _table(coarse.topology.connectivity(2, 1))[:cells]
    vertices = _number_vertices(coarse, corners, facets)

    v, m = vertices.corner[corners], vertices.middle[facets]
    children = np.empty((cells, 4, 3), dtype=np.int32)
    for k in range(3):
        children[:, k] = m[:, [_third(k, j) for j in range(3)]]
        children[:, k, k] = v[:, k]
    children[:, 3] = m
    children = children.reshape(-1, 3)

    cell_map = cpp.common.IndexMap(coarse.comm, 4 * cells)
    topology = compat.create_topology(
        coarse.comm, CellType.triangle, vertices.index_map, cell_map, children
    )
    if compat.can_take_facets(coarse.comm):
        _give_facets(topology, coarse, corners, facets, vertices, m)
    else:
        topology.create_entities(1)
        topology.create_connectivity(1, 2)
    fine = _wrap(coarse, topology, vertices, children)
    parent = np.repeat(np.arange(cells, dtype=np.int32), 4)
    return _child(domain, fine, _child_tags(domain, fine, facets), parent), parent


def refine_marked(domain: Domain, marked_cells: npt.ArrayLike) -> tuple[Domain, Int32Array]:
    """Halve the sides of the marked triangles, and what else conformity takes; collective.

    Sides are halved by bisecting longest edges first, which keeps the angles bounded from below
    however often it is repeated. A rank keeps the children of its cells; `balance.balance`
    shares them out anew.

    Args:
        domain: Straight-sided triangles; ghost cells are left behind.
        marked_cells: Local indices of this rank's cells, or a truth value for each of them.

    Returns:
        The fine domain, without ghost cells, and the parent of every fine cell, both local
        indices.

    Raises:
        InputError: The mesh does not consist of straight-sided triangles.
    """
    mesh = _prepared(domain.mesh)
    owned = mesh.topology.index_map(2).size_local
    marked = np.asarray(marked_cells)
    marked = np.flatnonzero(marked) if marked.dtype == bool else marked.astype(np.int32)
    marked = marked[(marked >= 0) & (marked < owned)]
    edges = np.unique(_table(mesh.topology.connectivity(2, 1))[marked]).astype(np.int32)
    return refine_edges(domain, edges)


def refine_edges(domain: Domain, edges: Int32Array) -> tuple[Domain, Int32Array]:
    """Halve some edges, and what else conformity takes; collective.

    Args:
        domain: Straight-sided triangles; ghost cells are left behind.
        edges: Local indices; those of the new vertices of a mesh that was made like this make the
            same mesh again.

    Returns:
        As for `refine_marked`.

    Raises:
        InputError: The mesh does not consist of straight-sided triangles.
    """
    coarse = _prepared(domain.mesh)
    fine, parent, parent_facet = split(
        coarse,
        edges,
        partitioner=None,
        option=RefinementOption.parent_cell_and_facet,
    )
    # what comes back is in the order the cells had before DOLFINx sorted them
    cells = fine.topology.index_map(2)
    before = fine.topology.original_cell_index - cells.local_range[0]
    parent = parent[before]
    parent_facet = parent_facet.reshape(-1, 3)[before]

    label = labels(domain)[parent[:, None], parent_facet]
    label[parent_facet < 0] = 0
    return _child(domain, fine, tagged(fine, label), parent), parent


def labels(domain: Domain) -> Int32Array:
    """The value in the tags of each facet of each cell of this rank, 0 without one.

    Shape (cells, 3), for a mesh of triangles that knows the facets of its cells.
    """
    topology = domain.mesh.topology
    label = np.zeros(_count(topology.index_map(1)), dtype=np.int32)
    label[domain.tags.indices] = domain.tags.values
    of_cells = _table(topology.connectivity(2, 1))
    return label[of_cells[: topology.index_map(2).size_local]]


def tagged(mesh: Mesh, label: Int32Array) -> MeshTags:
    """The tags of exterior facets with the values that `labels` tells, 0 for none; collective."""
    mesh.topology.create_connectivity(2, 1)
    mesh.topology.create_connectivity(1, 2)
    facet = _table(mesh.topology.connectivity(2, 1))[label > 0]
    order = np.argsort(facet)
    return meshtags(mesh, 1, facet[order], label[label > 0][order])


def _child(domain: Domain, fine: Mesh, tags: MeshTags, parent: Int32Array) -> Domain:
    """The fine domain: its cells consist of what their parents do."""
    materials = domain.materials.of_children(parent)
    descent = (*domain.descent, Refinement(weakref.ref(domain.mesh), parent))
    return Domain(fine, tags, parts=domain.parts, materials=materials, descent=descent)


def _count(index_map: Any) -> int:
    return int(index_map.size_local + index_map.num_ghosts)


def _third(k: int, j: int) -> int:
    """The local number that is neither k nor j."""
    return 3 - k - j if k != j else k


def _table(links: Any) -> Int32Array:
    """A connectivity with equally many links for each entity, as a table."""
    array: Int32Array = links.array
    return array.reshape(links.num_nodes, -1) if links.num_nodes else array.reshape(0, 3)


def _prepared(mesh: Mesh) -> Mesh:
    """The mesh, if it can be refined, with the connectivities that takes."""
    check_refinable(mesh)
    for dims in ((2, 1), (1, 2), (1, 0)):
        mesh.topology.create_connectivity(*dims)
    return mesh


def check_refinable(mesh: Mesh) -> None:
    """Raise InputError if a mesh can't be refined."""
    if mesh.topology.cell_type != CellType.triangle:
        raise InputError(
            f"the mesh consists of {mesh.topology.cell_type.name} cells: only triangles can be "
            "refined so far"
        )
    if compat.coordinate_map(mesh).degree != 1:
        raise InputError("the mesh has curved cells: only straight-sided ones can be refined")


class _Vertices(NamedTuple):
    """The fine vertices: owned ones, ghost corners, ghost midpoints.

    Attributes:
        index_map: Their distribution over the ranks.
        corner: Number of every coarse vertex, shape (coarse vertices,).
        middle: Number of every coarse facet's midpoint, shape (coarse facets,).
        x: Their coordinates, shape (fine vertices, gdim).
    """

    index_map: Any
    corner: Int32Array
    middle: Int32Array
    x: npt.NDArray[np.floating]


def _number_vertices(mesh: Mesh, corners: Int32Array, facets: Int32Array) -> _Vertices:
    """Number the fine vertices; each stays with the rank of its coarse vertex or facet.

    They are numbered as the cells meet them, so that neighbours have numbers that lie close
    together. Where DOLFINx has to find the facets it takes half as long again without that.

    Args:
        mesh: The coarse mesh.
        corners: Coarse vertices of the coarse cells, shape (cells, 3).
        facets: Coarse facets of the coarse cells, shape (cells, 3).
    """
    topology = mesh.topology
    maps = vertex_map, facet_map = topology.index_map(0), topology.index_map(1)
    split = _count(vertex_map)  # facets are counted on from the vertices
    first = _first_places(np.hstack([corners, split + facets]), split + _count(facet_map))
    owned = [m.size_local for m in maps]
    mine = np.concatenate([first[: owned[0]], first[split : split + owned[1]]])
    met = np.zeros(corners.size + facets.size + len(first), dtype=bool)
    met[mine] = True
    number = np.cumsum(met, dtype=np.int32)[mine] - 1

    start = sum(m.local_range[0] for m in maps)
    parts, ghosts, owners, count = [], [], [], sum(owned)
    for m, own, entities in zip(maps, np.split(number, [owned[0]]), (corners, facets), strict=True):
        kept = _ghosts_in(m, entities)
        everywhere = la.vector(m, dtype=np.int64)
        np.add(own, start, out=everywhere.array[: m.size_local], dtype=np.int64)
        everywhere.scatter_forward()
        part = np.full(_count(m), -1, dtype=np.int32)
        part[: m.size_local] = own
        part[m.size_local + kept] = count + np.arange(len(kept))
        count += len(kept)
        parts.append(part)
        ghosts.append(everywhere.array[m.size_local + kept])
        owners.append(m.owners[kept])
    index_map = compat.index_map(
        mesh.comm, sum(owned), np.concatenate(ghosts), np.concatenate(owners)
    )
    corner, middle = parts
    x = _coordinates(mesh, corners, corner, middle, count)
    return _Vertices(index_map, corner, middle, x)


def _coordinates(
    mesh: Mesh, corners: Int32Array, corner: Int32Array, middle: Int32Array, count: int
) -> npt.NDArray[np.floating]:
    """Compute where the fine vertices are.

    Args:
        mesh: The coarse mesh.
        corners: Coarse vertices of the coarse cells, shape (cells, 3).
        corner: Number of every coarse vertex, −1 for ghosts that are left behind.
        middle: Number of every coarse facet's midpoint, likewise.
        count: How many numbers there are.
    """
    node = np.zeros(len(corner), dtype=np.int32)
    node[corners] = compat.cell_nodes(mesh)[: len(corners)]
    x_coarse = mesh.geometry.x[:, : mesh.geometry.dim].take(node, axis=0)
    ends = mesh.topology.connectivity(1, 0).array.reshape(-1, 2)
    x = np.empty((count + 1, mesh.geometry.dim), dtype=x_coarse.dtype)  # the last one is for −1
    x[corner] = x_coarse
    x[middle] = 0.5 * (x_coarse.take(ends[:, 0], axis=0) + x_coarse.take(ends[:, 1], axis=0))
    return x[:-1]


def _first_places(table: Int32Array, count: int) -> Int32Array:
    """Find where each of the numbers below ``count`` first stands in a table.

    Those of entities that no cell of this rank meets follow behind the table, one by one.
    """
    first = np.arange(table.size, table.size + count, dtype=np.int32)
    # of equal numbers the last one wins; if another did, it would cost locality and nothing else
    first[table.ravel()[::-1]] = np.arange(table.size - 1, -1, -1, dtype=np.int32)
    return first


def _ghosts_in(index_map: Any, entities: Int32Array) -> Int32Array:
    """Find the ghost entities of cells of this rank: all, unless it has ghost cells."""
    seen = np.zeros(index_map.num_ghosts, dtype=bool)
    seen[entities[entities >= index_map.size_local] - index_map.size_local] = True
    return np.flatnonzero(seen).astype(np.int32)


def _give_facets(
    topology: Any,
    coarse: Mesh,
    corners: Int32Array,
    facets: Int32Array,
    vertices: _Vertices,
    m: Int32Array,
) -> None:
    """Hand over the fine facets: the halves 2 f and 2 f + 1 of facet f, then three in each cell.

    Half 1 is the one at the end with the larger coarse index; the facet opposite vertex k of child
    k is number 2 F + 3 c + k and also belongs to the child in the middle.

    Args:
        topology: The fine topology.
        coarse: The coarse mesh.
        corners: Coarse vertices of the coarse cells, shape (cells, 3).
        facets: Coarse facets of the coarse cells, shape (cells, 3).
        vertices: The fine vertices.
        m: Those in the middle of the coarse cells' facets, shape (cells, 3).
    """
    ends = _ends(coarse, vertices, m)
    of_cells, around, offsets = _neighbours(coarse, corners, facets)
    number = cpp.common.IndexMap(coarse.comm, len(ends))
    compat.set_facets(topology, number, of_cells, ends, around, offsets)


def _ends(coarse: Mesh, vertices: _Vertices, m: Int32Array) -> Int32Array:
    """The vertices of the fine facets, the smaller number first, shape (fine facets, 2).

    Args:
        coarse: The coarse mesh.
        vertices: The fine vertices.
        m: As for `_give_facets`.
    """
    halves = 2 * coarse.topology.index_map(1).size_local
    ends = np.empty((halves + m.size, 2), dtype=np.int32)
    old = coarse.topology.connectivity(1, 0).array.reshape(-1, 2)
    for i, choose in enumerate((np.minimum, np.maximum)):
        corner = vertices.corner[choose(old[:, 0], old[:, 1])]
        _ascending(corner, vertices.middle, ends[i:halves:2])
    inner = ends[halves:].reshape(-1, 3, 2)
    for k in range(3):
        _ascending(m[:, (k + 1) % 3], m[:, (k + 2) % 3], inner[:, k])
    return ends


def _neighbours(
    coarse: Mesh, corners: Int32Array, facets: Int32Array
) -> tuple[Int32Array, Int32Array, Int32Array]:
    """The fine facets of the children, shape (4 cells, 3), and the children at each fine facet.

    Args:
        coarse: The coarse mesh.
        corners: As for `_give_facets`.
        facets: As for `_give_facets`.

    Returns:
        The former; the latter one facet after the other, and where each facet's begin.
    """
    cells, count = len(corners), coarse.topology.index_map(1).size_local
    c = np.arange(cells, dtype=np.int32)
    around = coarse.topology.connectivity(1, 2)
    start, first = around.offsets, around.array[around.offsets[:-1]]
    number = np.diff(start)

    of_cells = np.empty((cells, 4, 3), dtype=np.int32)
    of_cells[:, 3] = 2 * count + 3 * c[:, None] + np.arange(3, dtype=np.int32)
    halves = np.empty(2 * len(around.array), dtype=np.int32)
    for j in range(3):
        f = facets[:, j]
        links = 2 * start[f] + (first[f] != c)  # where the first half lists this cell's child
        for k in (j + 1) % 3, (j + 2) % 3:
            half = (corners[:, k] > corners[:, _third(j, k)]).astype(np.int32)
            of_cells[:, k, j] = 2 * f + half
            halves[links + half * number[f]] = 4 * c + k
        of_cells[:, j, j] = of_cells[:, 3, j]

    pairs = np.empty((cells, 3, 2), dtype=np.int32)
    pairs[:, :, 0] = 4 * c[:, None] + np.arange(3, dtype=np.int32)
    pairs[:, :, 1] = 4 * c[:, None] + 3
    offsets = np.empty(2 * count + 3 * cells + 1, dtype=np.int32)
    offsets[0 : 2 * count + 1 : 2] = 2 * start
    offsets[1 : 2 * count : 2] = 2 * start[:-1] + number
    offsets[2 * count :] = len(halves) + 2 * np.arange(3 * cells + 1, dtype=np.int32)
    return of_cells.reshape(-1, 3), np.concatenate([halves, pairs.reshape(-1)]), offsets


def _ascending(a: Int32Array, b: Int32Array, pairs: Int32Array) -> None:
    """Write pairs of numbers, the smaller one first."""
    np.minimum(a, b, out=pairs[:, 0])
    np.maximum(a, b, out=pairs[:, 1])


def _wrap(coarse: Mesh, topology: Any, vertices: _Vertices, children: Int32Array) -> Mesh:
    """Put a mesh together whose nodes are numbered like its vertices."""
    index_map = vertices.index_map
    number = np.concatenate([np.arange(*index_map.local_range, dtype=np.int64), index_map.ghosts])
    geometry = cpp.mesh.Geometry_float64(
        index_map, children, compat.coordinate_map(coarse), vertices.x, number
    )
    mesh = cpp.mesh.Mesh_float64(coarse.comm, topology, geometry)
    # a new UFL domain, because it carries a reference to the C++ mesh
    return Mesh(mesh, ufl.Mesh(coarse.ufl_domain().ufl_coordinate_element()))


def _child_tags(domain: Domain, fine: Mesh, facets: Int32Array) -> Any:
    """The boundary parts on the fine mesh: facet j of a cell is shared out to two of its children.

    Args:
        domain: The coarse domain.
        fine: The fine mesh.
        facets: Coarse facets of the coarse cells, shape (cells, 3).
    """
    topology, tags = domain.mesh.topology, domain.tags
    owned = tags.indices < topology.index_map(1).size_local
    tagged, values = tags.indices[owned], tags.values[owned]
    around = topology.connectivity(1, 2)
    cell = around.array[around.offsets[tagged]]
    j = np.argmax(facets[cell] == tagged[:, None], axis=1)
    of_cells = _table(fine.topology.connectivity(2, 1))
    found = np.concatenate([of_cells[4 * cell + (j + i) % 3, j] for i in (1, 2)])
    order = np.argsort(found)
    return meshtags(fine, 1, found[order], np.tile(values, 2)[order])
