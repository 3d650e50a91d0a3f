"""The continuous function of degree 2 that is nearest to u_h, by algebraic multigrid.

Where few of its values are free, the cells that know of these are made a mesh of their own, and the
system is as small as that.
"""

from __future__ import annotations

import numpy as np
import ufl
from dolfinx import fem
from dolfinx.fem.petsc import assemble_matrix
from dolfinx.la import InsertMode
from petsc4py import PETSc

from .. import compat
from ..arrays import BoolArray, FloatArray, IndexArray, Int32Array
from ..fem.cells import Cells, on_cells, sum_rows
from ..fem.space import ghosted_vector, shared_maximum
from ..garbage import release
from ..jit import compiled
from ..options import COMPANION, ESTIMATE_PREFIX, solve_once
from .functional import Masses, Slopes

SHARE = 1e-10
"""Part of the way, in the energy norm, that is left when the linear solver stops: equal bounds on
any number of ranks."""

OF_FACET = np.array([[4.0, -1.0, 2.0], [-1.0, 4.0, 2.0], [2.0, 2.0, 16.0]]) / 30.0
"""Mass matrix of a facet of length 1, of its ends and its middle."""

LARGEST = 0.5
"""Part of all cells up to which those that free values touch are made a mesh of their own."""


def nearest(
    cells: Cells,
    kappa: FloatArray,
    slopes: Slopes,
    free_vertices: BoolArray,
    free_facets: BoolArray,
    masses: Masses | None = None,
) -> tuple[FloatArray, FloatArray]:
    """Find the way from v to the function of degree 2 that is nearest to u_h; collective.

    Args:
        cells: The mesh, d = 2.
        kappa: Mean of κ, shape (cells,) or ().
        slopes: Those of v.
        free_vertices: Which values at vertices are free.
        free_facets: Which heights are free.
        masses: What E has beside gradients, if anything.

    Returns:
        What is to be added to v's values at the vertices and to the heights of its bumps.
    """
    mesh, d = cells.domain.mesh, cells.tdim
    patch: slice | IndexArray = slice(None)
    some = np.flatnonzero(
        free_vertices[cells.vertices].any(axis=0) | free_facets[cells.facets].any(axis=0)
    )
    few, all_ = cells.total(float(len(some)), float(cells.number))
    if 0.0 < few <= LARGEST * all_:
        mesh, parents = compat.submesh(mesh, d, some.astype(np.int32))
        patch = parents.astype(np.intp)
    vertices, facets = cells.vertices[:, patch], cells.facets[:, patch]
    V = fem.functionspace(mesh, ("Lagrange", 2))
    dofs = V.dofmap.list[: vertices.shape[1]].T
    b, x = fem.Function(V), fem.Function(V)
    held = np.zeros_like(b.x.array)
    held[dofs[: d + 1][~free_vertices[vertices]]] = 1.0
    held[dofs[d + 1 :][~free_facets[facets]]] = 1.0
    shared_maximum(mesh, V.dofmap.index_map, held)
    fixed = np.flatnonzero(held > 0.0).astype(np.int32)
    # A nodal function of a vertex is λ_i less half the bumps of the two facets it belongs to
    pull = slopes.facets[:, patch]
    rows = np.concatenate([slopes.vertices[:, patch] - 0.5 * (sum_rows(pull) - pull), pull])
    b.x.array[:] = np.bincount(dofs.ravel(), rows.ravel(), minlength=len(held))
    b.x.scatter_reverse(InsertMode.add)
    b.x.array[fixed] = 0.0
    k = cells.coefficient(kappa, mesh, patch)
    u, w = ufl.TrialFunction(V), ufl.TestFunction(V)
    energy = ufl.inner(k * ufl.grad(u), ufl.grad(w))
    if masses is not None and masses.reacts:
        energy += on_cells(mesh, np.broadcast_to(masses.reaction, cells.number)[patch]) * u * w
    form = compiled(mesh.comm, fem.form, energy * ufl.dx)
    A = assemble_matrix(form, [fem.dirichletbc(fem.Function(V), fixed)])
    A.assemble()
    if masses is not None and masses.some:
        _add_losses(A, cells, masses, patch, dofs, held > 0.0)
    load, found = (ghosted_vector(V, function.x.array) for function in (b, x))
    solve_once(A, load, found, COMPANION | {"ksp_rtol": SHARE}, ESTIMATE_PREFIX)
    release(A, load, found)
    # aggregates of fixed and free values mix what an iteration leaves of both
    x.x.array[fixed] = 0.0
    x.x.scatter_forward()
    nodal = x.x.array[dofs]
    corners, middles = nodal[: d + 1], nodal[d + 1 :]
    at_vertices, heights = np.zeros(len(free_vertices)), np.zeros(len(free_facets))
    at_vertices[vertices] = corners
    heights[facets] = middles - 0.5 * (sum_rows(corners) - corners)
    return at_vertices, heights


def _add_losses(
    A: PETSc.Mat,
    cells: Cells,
    masses: Masses,
    patch: slice | IndexArray,
    dofs: Int32Array,
    held: BoolArray,
) -> None:
    """Add ∫ b u w over facets; collective.

    Args:
        A: The matrix, in whose pattern this is.
        cells: The mesh.
        masses: b.
        patch: Which cells the matrix is of.
        dofs: Their dofs, shape (6, n).
        held: Which dofs have rows and columns of the identity.
    """
    row = np.full(cells.number, -1)
    row[patch] = np.arange(dofs.shape[1])
    side, at = masses.side, row[masses.side.cells]
    near = at >= 0
    local, at, loss = side.local[near], at[near], masses.loss[near]
    of_facet = np.vstack([dofs[cells.others[local].T, at], dofs[3 + local, at]]).T
    of_facet = np.where(held[of_facet], -1, of_facet).astype(PETSc.IntType)  # which are passed over
    start = np.arange(0, 3 * of_facet.size + 1, 3, dtype=PETSc.IntType)
    columns = np.repeat(of_facet, 3, axis=0).ravel()
    values = (loss[:, None, None] * OF_FACET).ravel()
    A.setValuesLocalIJV(start, columns, values, addv=True, rowmap=of_facet.ravel())
    A.assemble()
