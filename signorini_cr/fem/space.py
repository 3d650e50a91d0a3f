"""The discrete spaces: V_h of Crouzeix and Raviart (1.5), and conforming P1 to compare with.

A CR function is affine on each cell and has one degree of freedom per facet: its value at the
facet's midpoint, which is its mean over the facet.
"""

from __future__ import annotations

from typing import Any

import basix
import basix.ufl
import numpy as np
from dolfinx import fem
from dolfinx.mesh import Mesh
from petsc4py import PETSc

from ..arrays import FloatArray, IndexArray, Int32Array
from ..compat import cell_nodes, facet_vertices
from ..errors import InputError
from ..mesh.domain import facet_entities
from ..mesh.shared import ghosted

ELEMENTS = {"CR": "CR", "P1": "Lagrange"}


def ufl_element(mesh: Mesh, element: str) -> Any:
    """Make the Basix element called ``element`` ("CR" or "P1") on the mesh's cell.

    Raises:
        InputError: There is no element of that name.
    """
    if not isinstance(element, str) or element not in ELEMENTS:
        raise InputError(f"element {element!r} is unknown; allowed: {', '.join(ELEMENTS)}")
    return basix.ufl.element(ELEMENTS[element], mesh.basix_cell(), 1)


def function_space(mesh: Mesh, element: str = "CR") -> fem.FunctionSpace:
    """Make V_h on a mesh; boundary values are not built in."""
    return fem.functionspace(mesh, ufl_element(mesh, element))


def facet_corners(mesh: Mesh) -> IndexArray:
    """List the vertices of a cell's facets by local number, shape (d + 1, d)."""
    return np.array(basix.topology(mesh.basix_cell())[-2])


def closure_dofs(V: fem.FunctionSpace, facets: Int32Array) -> Int32Array:
    """Find the dofs that fix a function on boundary facets.

    One per facet, its midpoint's, for CR; the d of its vertices for P1, in the order in which
    `quadrature.Trace` gives values at vertices.

    Args:
        V: CR or P1.
        facets: Local indices of exterior facets, shape (n,).

    Returns:
        Local dofs, shape (n, 1) or (n, d).
    """
    closure = np.array(V.element.basix_element.entity_closure_dofs[-2])
    cells, local = facet_entities(V.mesh, facets).T
    return np.take_along_axis(V.dofmap.list[cells], closure[local], axis=1)


def unknowns(V: fem.FunctionSpace, facets: Int32Array, components: Int32Array) -> Int32Array:
    """Find the numbers of some unknowns that fix a function on boundary facets.

    Args:
        V: CR or P1, with a block of unknowns at each node.
        facets: Local indices of exterior facets, shape (n,).
        components: Which unknowns of each node, shape (c,).

    Returns:
        Local unknowns, shape (n, 1, c) or (n, d, c).
    """
    return closure_dofs(V, facets)[:, :, None] * V.dofmap.index_map_bs + components


def facet_to_dof(V: fem.FunctionSpace) -> Int32Array:
    """Find the CR dof of every facet, shape (facets,), ghosts included."""
    tdim = V.mesh.topology.dim
    c2f = V.mesh.topology.connectivity(tdim, tdim - 1)
    facets = V.mesh.topology.index_map(tdim - 1)
    dofs = np.empty(facets.size_local + facets.num_ghosts, dtype=np.int32)
    dofs[c2f.array.reshape(-1, tdim + 1)] = V.dofmap.list
    return dofs


def facet_measures(mesh: Mesh, facets: Int32Array) -> tuple[FloatArray, FloatArray]:
    """Find vertex coordinates and measures (lengths, for d = 2) of exterior facets.

    Returns:
        Coordinates of shape (n, d, 3), vertices in the order of the cell's closure, and measures
        of shape (n,).
    """
    x = facet_vertices(mesh, facet_entities(mesh, facets))
    return x, simplex_measures(x)


def facet_normals(mesh: Mesh, entities: Int32Array) -> FloatArray:
    """Find the outward unit normals of exterior facets.

    Args:
        mesh: The mesh.
        entities: As `facet_entities` has them, shape (n, 2).

    Returns:
        Shape (n, 3).
    """
    x = facet_vertices(mesh, entities)
    edges = x[:, 1:] - x[:, :1]
    up = np.broadcast_to([0.0, 0.0, 1.0], edges[:, 0].shape)
    normal = np.cross(edges[:, 0], edges[:, 1] if edges.shape[1] > 1 else up)
    outwards = x.mean(axis=1) - mesh.geometry.x[cell_nodes(mesh)[entities[:, 0]]].mean(axis=1)
    normal *= np.sign((normal * outwards).sum(axis=1))[:, None]
    return np.asarray(normal / np.linalg.norm(normal, axis=1)[:, None])


def simplex_measures(x: FloatArray) -> FloatArray:
    """Compute the measures of simplices with vertices x, shape (n, vertices, gdim)."""
    edges = x[:, 1:] - x[:, :1]
    gram = np.einsum("nid,njd->nij", edges, edges)
    return np.sqrt(np.linalg.det(gram)) / np.prod(np.arange(1, x.shape[1]))


def vertex_values(u: fem.Function, cells: Int32Array | slice = slice(None)) -> FloatArray:
    """Evaluate at the vertices of each cell, where a CR function is discontinuous.

    With c_i the value on the facet opposite vertex i, vertex i has Σ_j c_j − d c_i.

    Args:
        u: CR or P1.
        cells: Local cells; all, ghosts included, if left out.

    Returns:
        Shape (cells, d + 1).

    Raises:
        InputError: The function has several components.
    """
    if u.function_space.dofmap.index_map_bs > 1:
        raise InputError(
            f"{u.name} has {u.function_space.dofmap.index_map_bs} components, and only functions of"
            " one are drawn and written; u.sub(0).collapse() is the first of them"
        )
    values = u.x.array[u.function_space.dofmap.list[cells]]
    if u.function_space.element.basix_element.family is basix.ElementFamily.CR:
        return values.sum(axis=1, keepdims=True) - u.function_space.mesh.topology.dim * values
    return values


def ghosted_vector(V: fem.FunctionSpace, array: FloatArray) -> PETSc.Vec:
    """Make a PETSc vector with room for the ghosts of V, on an array (no copy)."""
    return ghosted(V.mesh.comm, V.dofmap.index_map, array, V.dofmap.index_map_bs)


def facet_quadrature(mesh: Mesh, degree: int) -> tuple[FloatArray, FloatArray]:
    """Return points on the reference facet, shape (q, d − 1), and weights that add up to 1."""
    facet = basix.cell.subentity_types(mesh.basix_cell())[-2][0]
    points, weights = basix.make_quadrature(facet, degree)
    return points, weights / weights.sum()
