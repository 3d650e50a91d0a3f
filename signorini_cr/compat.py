"""The places where DOLFINx versions differ; found by looking, not by version numbers."""

from __future__ import annotations

from collections.abc import Callable
from copy import copy
from typing import Any
from weakref import WeakKeyDictionary

import basix
import cffi
import numpy as np
import ufl
from dolfinx import cpp, fem
from dolfinx.mesh import CellType, Mesh, create_submesh
from mpi4py import MPI
from ufl import exprequals
from ufl.algebra import Abs
from ufl.core.expr import Expr
from ufl.core.operator import Operator

from .arrays import FloatArray, Int32Array, Int64Array
from .garbage import watch
from .jit import compiled

_TAG = 1998


def _are_equal(one: Expr, other: Expr) -> bool:
    """Tell whether two expressions are written in the same way, each pair looked at once.

    UFL's own, before 2025, goes through the operands again wherever they are used: for n maxima
    within one another 2ⁿ pairs. Sets and dicts of expressions ask this of each other's members.
    """
    if type(one) is not type(other) or hash(one) != hash(other):
        return False
    pairs, seen = [(one, other)], set()
    while pairs:
        a, b = pairs.pop()
        if a is b or (id(a), id(b)) in seen:
            continue
        seen.add((id(a), id(b)))
        if a._ufl_typecode_ != b._ufl_typecode_:
            return False
        if a._ufl_is_terminal_:
            if not a == b:  # UFL has no !=
                return False
        elif len(a.ufl_operands) != len(b.ufl_operands):
            return False
        else:
            pairs.extend(zip(a.ufl_operands, b.ufl_operands, strict=True))
    one.ufl_operands = other.ufl_operands  # so that the next comparison ends at once
    return True


if hasattr(exprequals, "hash_total"):  # what it counted went with the old way
    Expr.__eq__ = _are_equal


def _take_operand(absolute: Abs, operand: Any) -> None:
    """Initialize an absolute value, unless it is that which it was asked of.

    UFL's takes |x| for ||x||, and then makes it its own operand: what goes through it has no end.
    """
    if absolute is not operand:
        Operator.__init__(absolute, (operand,))


Abs.__init__ = _take_operand


def cell_nodes(mesh: Mesh) -> Int32Array:
    """Return the rows of `mesh.geometry.x` for every local cell, shape (cells, nodes)."""
    geometry = mesh.geometry
    return geometry.dofmaps[0] if hasattr(geometry, "dofmaps") else geometry.dofmap


def submesh(mesh: Mesh, dim: int, entities: Int32Array) -> tuple[Mesh, Int32Array]:
    """Make the mesh that some entities of a mesh make up; collective.

    Args:
        mesh: The mesh.
        dim: Dimension of the entities.
        entities: Their local indices; owned ones, ascending.

    Returns:
        The mesh, and the entity that each cell owned by this rank was.
    """
    made, parents, *_ = create_submesh(mesh, dim, entities)
    watch(made)
    cells = np.arange(made.topology.index_map(dim).size_local, dtype=np.int32)
    if hasattr(parents, "sub_topology_to_topology"):  # since 0.10
        return made, parents.sub_topology_to_topology(cells, False)
    return made, parents[cells]


def coordinate_map(mesh: Mesh) -> Any:
    """Return the map from the reference cell, as the C++ object."""
    geometry = mesh.geometry
    cmap = geometry.cmaps[0] if hasattr(geometry, "cmaps") else geometry.cmap
    return cmap._cpp_object


def interpolation_points(V: fem.FunctionSpace) -> FloatArray:
    """Return the points on the reference cell whose values an interpolant is made of."""
    points = V.element.interpolation_points
    return np.asarray(points() if callable(points) else points)  # a property since 0.10


def index_map(
    comm: MPI.Comm, owned: int, ghosts: Int64Array, owners: Int32Array
) -> cpp.common.IndexMap:
    """Distribute entities over the ranks; collective.

    Args:
        comm: The ranks that share the entities.
        owned: How many this rank owns.
        ghosts: Global numbers of the others it sees, shape (n,).
        owners: The ranks these belong to, shape (n,).
    """
    try:
        return cpp.common.IndexMap(comm, owned, ghosts, owners)
    except TypeError:  # since 0.10 with a tag for the messages
        return cpp.common.IndexMap(comm, owned, ghosts, owners, _TAG)


def create_topology(
    comm: MPI.Comm,
    cell_type: CellType,
    vertices: Any,
    cells: Any,
    corners: Int32Array,
    topology: Any = None,
) -> Any:
    """Make a C++ topology that knows its vertices and cells only.

    Args:
        comm: The ranks that share the mesh.
        cell_type: The one type of cell.
        vertices: Index map of the vertices.
        cells: Index map of the cells.
        corners: Local vertices of every cell, shape (cells, d + 1).
        topology: One of the same vertices to take, where `can_take_facets` allows it.
    """
    links = cpp.graph.AdjacencyList_int32(corners)
    if not hasattr(cpp.mesh.Topology, "set_connectivity"):
        # since 0.10 the constructor takes it all
        number = np.arange(*cells.local_range, dtype=np.int64)
        return cpp.mesh.Topology(cell_type, vertices, cells, links, number)
    topology = topology or cpp.mesh.Topology(comm, cell_type)
    count = vertices.size_local + vertices.num_ghosts
    none = cpp.graph.AdjacencyList_int32(np.empty(0, np.int32), np.zeros(count + 1, np.int32))
    topology.set_index_map(0, vertices)
    topology.set_connectivity(none, 0, 0)
    topology.set_index_map(topology.dim, cells)
    topology.set_connectivity(links, topology.dim, 0)
    return topology


def can_take_facets() -> bool:
    """Tell whether a topology can be given facets of our own numbering; later versions can't.

    It can't be told which of them lie between ranks, but knows those that it found itself before.
    What that is worth is in benchmarks/results/refinement.md.
    """
    return hasattr(cpp.mesh.Topology, "set_connectivity")


def set_facets(
    topology: Any,
    facets: Any,
    of_cells: Int32Array,
    ends: Int32Array,
    cells: Int32Array,
    start: Int32Array,
) -> None:
    """Give a topology its facets, where `can_take_facets` allows it.

    Args:
        topology: From `create_topology`.
        facets: Index map of the facets.
        of_cells: Facets of every cell, shape (cells, d + 1); facet i is opposite vertex i.
        ends: Vertices of every facet, shape (facets, d), in the order of their indices.
        cells: Cells of every facet, one facet after the other.
        start: Where each facet's cells begin, shape (facets + 1,).
    """
    tdim = topology.dim
    topology.set_index_map(tdim - 1, facets)
    topology.set_connectivity(cpp.graph.AdjacencyList_int32(of_cells), tdim, tdim - 1)
    topology.set_connectivity(cpp.graph.AdjacencyList_int32(ends), tdim - 1, 0)
    topology.set_connectivity(cpp.graph.AdjacencyList_int32(cells, start), tdim - 1, tdim)


def with_dofs(V: fem.FunctionSpace, cells: Int32Array, index_map: Any) -> fem.FunctionSpace:
    """Put the element of one space to work on the dofs of another, to assemble over cells only.

    Which entities the dofs belong to is still what V says.

    Args:
        V: The space with the element.
        cells: Nodes of every local cell, as many as the element has, shape (cells, n).
        index_map: Their distribution over the ranks.
    """
    own, block = V._cpp_object, V.dofmap.index_map_bs
    links = cpp.graph.AdjacencyList_int32(np.ascontiguousarray(cells))
    parts = (
        V.mesh._cpp_object,
        own.element,
        cpp.fem.DofMap(own.dofmap.dof_layout, index_map, block, links, block),
    )
    try:
        space = cpp.fem.FunctionSpace_float64(*parts)
    except TypeError:  # 0.9 wants the shape of a value, too
        space = cpp.fem.FunctionSpace_float64(*parts, V.ufl_element().reference_value_shape)
    return fem.FunctionSpace(V.mesh, V.ufl_element(), space)


def compile_expression(expression: Any, points: FloatArray, mesh: Mesh) -> fem.Expression:
    """Compile an expression for meshes of the same kind as one mesh.

    Newer versions insist that it depends on x, even if all that is left of it is a number.

    Args:
        expression: Scalar or vector.
        points: On the reference cell or facet.
        mesh: The mesh that the expression was written for.
    """
    x = ufl.SpatialCoordinate(mesh)
    nothing = x[0] - x[0]
    if shape := expression.ufl_shape:
        nothing = ufl.as_vector([nothing] * shape[0])
    return compiled(mesh.comm, fem.Expression, expression + nothing, points, mesh.comm)


_functions: WeakKeyDictionary[fem.Expression, list[Any]] = WeakKeyDictionary()
"""Those in each expression: UFL takes long to find them."""


def bound(expression: fem.Expression, own: Callable[[Any], Any]) -> fem.Expression:
    """Bind a compiled expression to other functions, of the same element.

    Args:
        expression: From `compile_expression`.
        own: The function to take in the place of one in the expression.
    """
    data = expression.ufl_expression
    if expression not in _functions:
        _functions[expression] = ufl.algorithms.extract_coefficients(data)
    functions = _functions[expression]
    if all(own(function) is function for function in functions):
        return expression
    code = expression.ufcx_expression
    where = code.original_coefficient_positions
    values = [own(functions[where[i]])._cpp_object for i in range(code.num_coefficients)]
    constants = [c._cpp_object for c in ufl.algorithms.analysis.extract_constants(data)]
    ffi = cffi.FFI()
    address = int(ffi.cast("uintptr_t", ffi.addressof(code)))
    made = copy(expression)
    try:
        made._cpp_object = cpp.fem.create_expression_float64(address, values, constants, None)
    except TypeError:  # since 0.10 there are maps between meshes, too
        made._cpp_object = cpp.fem.create_expression_float64(address, values, constants, [], None)
    return made


def facet_vertices(mesh: Mesh, entities: Int32Array) -> FloatArray:
    """Find the coordinates of facets' vertices, in the order of the cell's closure.

    Args:
        mesh: The mesh.
        entities: Pairs (cell, facet's number in the cell), shape (n, 2).

    Returns:
        Shape (n, d, 3).
    """
    return np.asarray(mesh.geometry.x[facet_nodes(mesh, entities)])


def facet_nodes(mesh: Mesh, entities: Int32Array) -> Int32Array:
    """Find the rows of `mesh.geometry.x` that `facet_vertices` takes, shape (n, d)."""
    cells, local = entities.T
    corners = np.array(basix.topology(mesh.basix_cell())[-2])
    return np.take_along_axis(cell_nodes(mesh)[cells], corners[local], axis=1)


class FacetExpression:
    """A UFL expression at points of the reference facet.

    Newer versions may turn a facet before they lay the points on it, and do not say so. Where the
    points came to lie is evaluated along with the expression, and the values are put in order.

    Args:
        expression: Scalar or vector.
        points: On the reference facet, shape (q, d − 1).
        mesh: The mesh that the expression was written for.
    """

    def __init__(self, expression: Any, points: FloatArray, mesh: Mesh):
        """Compile the expression."""
        self._values = compile_expression(expression, points, mesh)
        x = ufl.SpatialCoordinate(mesh)
        self._where = compiled(mesh.comm, fem.Expression, x, points, mesh.comm)
        self._shape = (len(points), -1)
        self._hats = np.column_stack([1.0 - points.sum(axis=1), points])

    def at(
        self, mesh: Mesh, entities: Int32Array, own: Callable[[Any], Any] = lambda given: given
    ) -> FloatArray:
        """Evaluate on boundary facets of a mesh of the same kind.

        Args:
            mesh: Where.
            entities: Pairs (cell, facet's number in the cell), shape (n, 2).
            own: The mesh's function in the place of one in the expression.

        Returns:
            Shape (n, q, components).
        """
        if not len(entities):
            return np.zeros((0, len(self._hats), self._values.value_size))
        shape, expression = (len(entities), *self._shape), bound(self._values, own)
        try:
            values = expression.eval(mesh, entities).reshape(shape)
        except (AssertionError, TypeError):  # 0.9 wants them flattened, and turns nothing
            return expression.eval(mesh, entities.ravel()).reshape(shape)
        wanted = (self._hats @ facet_vertices(mesh, entities))[..., : mesh.geometry.dim]
        found = self._where.eval(mesh, entities).reshape(shape)
        distance = np.linalg.norm(wanted[:, :, None] - found[:, None, :], axis=-1)
        return np.take_along_axis(values, distance.argmin(axis=2)[:, :, None], axis=1)
