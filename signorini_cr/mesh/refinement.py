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
from mpi4py import MPI

from .. import compat
from ..arrays import FloatArray, Int32Array, Int64Array
from ..errors import InputError, together
from .domain import Domain, Refinement, facet_entities
from .shared import shared_sum

SIMILAR: FloatArray = np.array(
    [
        [[1.0, 0.0, 0.0], [0.5, 0.5, 0.0], [0.5, 0.0, 0.5]],
        [[0.5, 0.5, 0.0], [0.0, 1.0, 0.0], [0.0, 0.5, 0.5]],
        [[0.5, 0.0, 0.5], [0.0, 0.5, 0.5], [0.0, 0.0, 1.0]],
        [[0.0, 0.5, 0.5], [0.5, 0.0, 0.5], [0.5, 0.5, 0.0]],
    ]
)
"""The corners of the four children that `refine` makes, see there; as `Refinement.pattern`."""


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

    ghosts = coarse.comm.allreduce(coarse.topology.index_map(2).num_ghosts)
    given = compat.can_take_facets() and ghosts == 0
    topology = number = None
    if given and coarse.comm.size > 1:
        topology, number = _between_ranks(coarse, facets, vertices, children)
        given = topology is not None
    cell_map = cpp.common.IndexMap(coarse.comm, 4 * cells)
    topology = compat.create_topology(
        coarse.comm, CellType.triangle, vertices.index_map, cell_map, children, topology
    )
    if given:
        _give_facets(topology, coarse, corners, facets, vertices, m, number)
    else:
        topology.create_entities(1)
        topology.create_connectivity(1, 2)
    fine = _wrap(coarse, topology, vertices, children)
    parent = np.repeat(np.arange(cells, dtype=np.int32), 4)
    tags = _child_tags(domain, fine)
    return _child(domain, fine, tags, parent, SIMILAR), parent


def refine_marked(domain: Domain, marked_cells: npt.ArrayLike) -> tuple[Domain, Int32Array]:
    """Halve the sides of the marked triangles, and what else conformity takes; collective.

    Sides are halved by bisecting longest edges first, which keeps the angles bounded from below
    however often it is repeated. A rank keeps the children of its cells; `balance.balance`
    shares them out anew.

    Args:
        domain: Straight-sided triangles; ghost cells are left behind.
        marked_cells: Local indices of this rank's cells, or a truth value for each of them. What
            is said of ghost cells does not count.

    Returns:
        The fine domain, without ghost cells, and the parent of every fine cell, both local
        indices.

    Raises:
        InputError: The mesh does not consist of straight-sided triangles, or has no such cells.
    """
    mesh = _prepared(domain.mesh)
    marked = together(mesh.comm, _marked, mesh, marked_cells)
    edges = np.unique(_table(mesh.topology.connectivity(2, 1))[marked]).astype(np.int32)
    return refine_edges(domain, edges)


def _marked(mesh: Mesh, marked_cells: npt.ArrayLike) -> Int64Array:
    """Find the marked cells that this rank owns, ascending."""
    cells, marked = mesh.topology.index_map(2), np.asarray(marked_cells)
    owned, there = cells.size_local, _count(cells)
    if marked.dtype == bool:
        if marked.shape not in ((owned,), (there,)):
            raise InputError(
                f"marked_cells has truth values of the shape {marked.shape}; rank"
                f" {mesh.comm.rank} has {owned} cells"
            )
        return np.flatnonzero(marked[:owned])
    if marked.size and marked.dtype.kind not in "iu":
        raise InputError(
            f"marked_cells has values of the type {marked.dtype}; indices of cells are needed, or"
            " truth values"
        )
    if len(wrong := marked[(marked < 0) | (marked >= there)]):
        raise InputError(
            f"marked_cells: there is no cell {wrong[0]} on rank {mesh.comm.rank}, which has"
            f" {owned} cells"
        )
    return np.unique(marked[marked < owned]).astype(np.int64)


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
    """Find the value in the tags of each facet of each cell of this rank, 0 without one.

    Shape (cells, 3), for a mesh of triangles that knows the facets of its cells.
    """
    topology = domain.mesh.topology
    label = np.zeros(_count(topology.index_map(1)), dtype=np.int32)
    label[domain.tags.indices] = domain.tags.values
    of_cells = _table(topology.connectivity(2, 1))
    return label[of_cells[: topology.index_map(2).size_local]]


def tagged(mesh: Mesh, label: Int32Array) -> MeshTags:
    """Make the tags of exterior facets with values from `labels`, 0 for none; collective."""
    mesh.topology.create_connectivity(2, 1)
    mesh.topology.create_connectivity(1, 2)
    facet = _table(mesh.topology.connectivity(2, 1))[label > 0]
    order = np.argsort(facet)
    return meshtags(mesh, 1, facet[order], label[label > 0][order])


def _child(
    domain: Domain,
    fine: Mesh,
    tags: MeshTags,
    parent: Int32Array,
    pattern: FloatArray | None = None,
) -> Domain:
    """Make the fine domain: its cells consist of what their parents do."""
    materials = domain.materials.of_children(parent)
    step = Refinement(weakref.ref(domain.mesh), parent, pattern=pattern)
    descent = (*domain.descent, step)
    return Domain(fine, tags, parts=domain.parts, materials=materials, descent=descent)


def _count(index_map: Any) -> int:
    return int(index_map.size_local + index_map.num_ghosts)


def _third(k: int, j: int) -> int:
    """Return the local number that is neither k nor j."""
    return 3 - k - j if k != j else k


def _table(links: Any) -> Int32Array:
    """Return a connectivity with equally many links for each entity as a table."""
    array: Int32Array = links.array
    return array.reshape(links.num_nodes, -1) if links.num_nodes else array.reshape(0, 3)


def _prepared(mesh: Mesh) -> Mesh:
    """Check that the mesh can be refined, and make the connectivities that takes."""
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


def _shared(mesh: Mesh) -> Int32Array:
    """Find the facets of this rank that another one sees, too; collective."""
    facet_map = mesh.topology.index_map(1)
    seen = np.zeros(facet_map.size_local + facet_map.num_ghosts)
    seen[facet_map.size_local :] = 1.0
    shared_sum(mesh, facet_map, seen)
    return np.flatnonzero(seen[: facet_map.size_local]).astype(np.int32)


def _between_ranks(
    coarse: Mesh, facets: Int32Array, vertices: _Vertices, children: Int32Array
) -> tuple[Any, Int32Array | None]:
    """Make a topology that knows what lies between ranks, and numbers to fit; collective.

    DOLFINx notes that where it looks for facets, and nowhere else. Here it looks for those of the
    few cells beside other ranks. What it will take to lie there are then the facets with the
    numbers that it has found, so that these numbers are given to those that do. What is left of
    the numbers is for facets inside coarse cells, of which it makes no difference.

    Args:
        coarse: The coarse mesh, without ghost cells.
        facets: Coarse facets of the coarse cells, shape (cells, 3).
        vertices: The fine vertices.
        children: Fine vertices of the fine cells, shape (4 cells, 3).

    Returns:
        The topology, and new numbers of this rank's fine facets, in the order of `_give_facets`; or
        nothing where a rank has too few cells.
    """
    facet_map = coarse.topology.index_map(1)
    owned, inner = facet_map.size_local, 3 * len(facets)
    shared = _shared(coarse)
    border = np.concatenate([shared, np.arange(owned, _count(facet_map), dtype=np.int32)])
    cell, j = facet_entities(coarse, border).T
    beside = np.unique(np.concatenate([4 * cell + (j + 1) % 3, 4 * cell + (j + 2) % 3]))
    cell_map = cpp.common.IndexMap(coarse.comm, len(beside))
    topology = compat.create_topology(
        coarse.comm, CellType.triangle, vertices.index_map, cell_map, children[beside]
    )
    topology.create_entities(1)

    count = 2 * owned + inner
    taken = np.asarray(topology.interprocess_facets())
    taken = taken[taken < count]  # those of other ranks come last, here and there
    between = np.concatenate([2 * shared, 2 * shared + 1])
    spare = len(taken) - len(between)
    if not coarse.comm.allreduce(0 <= spare <= inner, op=MPI.LAND):
        return None, None
    number = np.full(count, -1, dtype=np.int32)
    number[between] = taken[: len(between)]
    number[2 * owned : 2 * owned + spare] = taken[len(between) :]
    free = np.ones(count, dtype=bool)
    free[taken] = False
    number[number < 0] = np.flatnonzero(free)
    return topology, number


def _give_facets(
    topology: Any,
    coarse: Mesh,
    corners: Int32Array,
    facets: Int32Array,
    vertices: _Vertices,
    m: Int32Array,
    number: Int32Array | None,
) -> None:
    """Hand over the fine facets; collective.

    First come the halves 2 f and 2 f + 1 of facet f of this rank, then three in each cell, then the
    halves of other ranks' facets; on several ranks this rank's are numbered anew after that. Half 1
    is the one at the end with the larger coarse global number; the facet opposite vertex k of child
    k is 2 F + 3 c + k and also belongs to the child in the middle.

    Args:
        topology: The fine topology.
        coarse: The coarse mesh, without ghost cells.
        corners: Coarse vertices of the coarse cells, shape (cells, 3).
        facets: Coarse facets of the coarse cells, shape (cells, 3).
        vertices: The fine vertices.
        m: Those in the middle of the coarse cells' facets, shape (cells, 3).
        number: New numbers of this rank's facets, from `_between_ranks`; None on one rank.
    """
    together = number is not None
    ends = _ends(coarse, vertices, m, together)
    of_cells, around, size = _neighbours(coarse, corners, facets, together)
    count = 2 * coarse.topology.index_map(1).size_local + m.size
    global_map = cpp.common.IndexMap(coarse.comm, count)
    if number is not None:
        global_map = _numbered_anew(coarse, global_map, number)
        number = np.concatenate([number, np.arange(count, len(size), dtype=np.int32)])
        old = np.empty_like(number)
        old[number] = np.arange(len(number), dtype=np.int32)
        begin = _starts(size)[:-1][old]
        of_cells, ends, size = number[of_cells], ends[old], size[old]
        moved = np.repeat(begin - _starts(size)[:-1], size)
        around = around[moved + np.arange(len(around), dtype=np.int32)]
    compat.set_facets(topology, global_map, of_cells, ends, around, _starts(size))


def _ends(coarse: Mesh, vertices: _Vertices, m: Int32Array, together: bool) -> Int32Array:
    """Find the vertices of fine facets, the one first that comes first, shape (fine facets, 2).

    Args:
        coarse: The coarse mesh.
        vertices: The fine vertices.
        m: As for `_give_facets`.
        together: Whether global numbers say which comes first, as all ranks see it.
    """
    facet_map = coarse.topology.index_map(1)
    owned, count = facet_map.size_local, 2 * facet_map.size_local + m.size
    coarse_map, fine_map = coarse.topology.index_map(0), vertices.index_map
    of_coarse, of_fine = (_everyones(each) if together else None for each in (coarse_map, fine_map))
    mine = fine_map.size_local
    ends: Int32Array = np.empty((2 * _count(facet_map) + m.size, 2), dtype=np.int32)
    old = coarse.topology.connectivity(1, 0).array.reshape(-1, 2)
    for i, at in enumerate(_ascending(old[:, 0], old[:, 1], of_coarse, coarse_map.size_local)):
        halves = _ascending(vertices.corner[at], vertices.middle, of_fine, mine)
        for n, column in enumerate(halves):
            ends[i : 2 * owned : 2, n] = column[:owned]
            ends[count + i :: 2, n] = column[owned:]
    inside = ends[2 * owned : count].reshape(-1, 3, 2)
    for k in range(3):
        pair = _ascending(m[:, (k + 1) % 3], m[:, (k + 2) % 3], of_fine, mine)
        inside[:, k, 0], inside[:, k, 1] = pair
    return ends


def _neighbours(
    coarse: Mesh, corners: Int32Array, facets: Int32Array, together: bool
) -> tuple[Int32Array, Int32Array, Int32Array]:
    """Find the children's fine facets, shape (4 cells, 3), and the children at each fine facet.

    Args:
        coarse: The coarse mesh.
        corners: As for `_give_facets`.
        facets: As for `_give_facets`.
        together: As for `_ends`.

    Returns:
        The former; the latter one facet after the other, and how many there are at each.
    """
    cells, facet_map = len(corners), coarse.topology.index_map(1)
    owned, inner = facet_map.size_local, 3 * cells
    c = np.arange(cells, dtype=np.int32)
    around = coarse.topology.connectivity(1, 2)
    start, first = around.offsets, around.array[around.offsets[:-1]]
    links = np.diff(start)
    place = _everyones(coarse.topology.index_map(0))[corners] if together else corners

    of_cells: Int32Array = np.empty((cells, 4, 3), dtype=np.int32)
    of_cells[:, 3] = 2 * owned + 3 * c[:, None] + np.arange(3, dtype=np.int32)
    halves = np.empty(2 * len(around.array), dtype=np.int32)
    for j in range(3):
        f, one, other = facets[:, j], (j + 1) % 3, (j + 2) % 3
        half_0 = 2 * f + np.int32(inner) * (f >= owned)
        at = 2 * start[f] + (first[f] != c)  # where the first half lists this cell's child
        beside = links[f]
        half = (place[:, one] > place[:, other]).astype(np.int32)
        for k, here in (one, half), (other, 1 - half):
            of_cells[:, k, j] = half_0 + here
            halves[at + here * beside] = 4 * c + k
        of_cells[:, j, j] = of_cells[:, 3, j]

    pairs = np.empty((cells, 3, 2), dtype=np.int32)
    pairs[:, :, 0] = 4 * c[:, None] + np.arange(3, dtype=np.int32)
    pairs[:, :, 1] = 4 * c[:, None] + 3
    last, twice = 2 * start[owned], np.repeat(links, 2)
    of_facets = np.concatenate([halves[:last], pairs.ravel(), halves[last:]])
    size = np.concatenate([twice[: 2 * owned], np.full(inner, 2, np.int32), twice[2 * owned :]])
    return of_cells.reshape(-1, 3), of_facets, size


def _numbered_anew(coarse: Mesh, index_map: Any, number: Int32Array) -> Any:
    """Make the index map of the fine facets, other ranks' halves as ghosts; collective.

    Args:
        coarse: The coarse mesh.
        index_map: That of this rank's fine facets.
        number: New numbers of these.
    """
    facet_map = coarse.topology.index_map(1)
    owned = 2 * facet_map.size_local
    everywhere = la.vector(facet_map, bs=2, dtype=np.int64)
    everywhere.array[:owned] = index_map.local_range[0] + number[:owned]
    everywhere.scatter_forward()
    ghosts, owners = everywhere.array[owned:], np.repeat(facet_map.owners, 2)
    return compat.index_map(coarse.comm, len(number), ghosts, owners)


def _everyones(index_map: Any) -> Int64Array:
    """Return the global numbers of local indices, ghosts included."""
    return np.concatenate([np.arange(*index_map.local_range), index_map.ghosts])


def _starts(size: Int32Array) -> Int32Array:
    """Compute where each of so many groups of these sizes begins, and where the last ends."""
    starts: Int32Array = np.zeros(len(size) + 1, dtype=np.int32)
    np.cumsum(size, out=starts[1:])
    return starts


def _ascending(
    a: Int32Array, b: Int32Array, order: npt.NDArray | None, owned: int = 0
) -> tuple[Int32Array, Int32Array]:
    """Sort pairs of vertices by global numbers.

    Args:
        a: One of each pair.
        b: The other.
        order: The global numbers; None where local ones are in the same order.
        owned: How many vertices are this rank's, whose local numbers are in that order.
    """
    first, second = np.minimum(a, b), np.maximum(a, b)
    if order is not None:
        ghosts = np.flatnonzero(second >= owned)  # few
        turned = ghosts[order[first[ghosts]] > order[second[ghosts]]]
        first[turned], second[turned] = second[turned], first[turned]
    return first, second


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


def _child_tags(domain: Domain, fine: Mesh) -> Any:
    """Tag the parts of the fine boundary: facet j of a cell goes to two of its children."""
    topology, tags = domain.mesh.topology, domain.tags
    owned = tags.indices < topology.index_map(1).size_local
    tagged, values = tags.indices[owned], tags.values[owned]
    cell, j = facet_entities(domain.mesh, tagged).T
    of_cells = _table(fine.topology.connectivity(2, 1))
    found = np.concatenate([of_cells[4 * cell + (j + i) % 3, j] for i in (1, 2)])
    order = np.argsort(found)
    return meshtags(fine, 1, found[order], np.tile(values, 2)[order])
