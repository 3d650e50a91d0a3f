"""The continuous function of degree 2 that is nearest to u_h, by algebraic multigrid.

Where few of its values are free, the cells that know of these are made a mesh of their own, and the
system is as small as that.

A function of degree 2 is given by its values at the vertices and the heights of its bumps
b_F = 4 λ_j λ_k over the straight line through them, on each cell relative to u_h.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import ufl
from dolfinx import fem
from dolfinx.fem.petsc import assemble_matrix
from dolfinx.la import InsertMode

from .. import compat
from ..arrays import BoolArray, FloatArray, IndexArray
from ..fem.cells import Cells, blocks, dot_rows, pick, sum_rows
from ..fem.space import ghosted_vector, shared_maximum
from ..garbage import release
from ..jit import compiled
from ..options import COMPANION, ESTIMATE_PREFIX, solve_once

SHARE = 1e-10
"""Part of the way, in the energy norm, that is left when the linear solver stops: equal bounds on
any number of ranks."""

LARGEST = 0.5
"""Part of all cells up to which those that free values touch are made a mesh of their own."""


@dataclass(frozen=True, eq=False)
class Slopes:
    """How fast E = ‖κ^{1/2}(∇v − ∇_h u_h)‖² falls, cell by cell.

    Attributes:
        vertices: −½ ∂E by v's values at the vertices with the bumps kept, shape (d + 1, cells).
        facets: −½ ∂E by the heights of the bumps, shape (d + 1, cells).
        energies: The cells' shares of E, shape (cells,).
    """

    vertices: FloatArray
    facets: FloatArray
    energies: FloatArray

    @classmethod
    def of(cls, cells: Cells, kappa: FloatArray, excess: FloatArray, bumps: FloatArray) -> Slopes:
        """Compute them; collective.

        Args:
            cells: The mesh, d = 2.
            kappa: Mean of κ, shape (cells,) or ().
            excess: v − u_h at the cells' vertices without the bumps, shape (d + 1, cells).
            bumps: Heights by facet dof.
        """
        rows = np.empty_like(excess), np.empty_like(excess)
        slopes = cls(*rows, np.empty(cells.number))
        slopes.renew(cells, kappa, excess, bumps, slice(None))
        return slopes

    def renew(
        self,
        cells: Cells,
        kappa: FloatArray,
        excess: FloatArray,
        bumps: FloatArray,
        where: slice | IndexArray,
    ) -> None:
        """Compute them anew on some cells, or on all with ``slice(None)``; see `of`."""
        for part in blocks(cells.number) if isinstance(where, slice) else (where,):
            k, c, height = pick(kappa, part), excess[:, part], bumps[cells.facets[:, part]]
            rest = cells.trace(part) - 2.0 * cells.squares(part)
            at_vertices = -k * cells.apply(c - 4 / 3 * height, part)
            at_facets = 4 / 3 * k * (cells.apply(c - 2.0 * height, part) - rest * height)
            self.vertices[:, part], self.facets[:, part] = at_vertices, at_facets
            self.energies[part] = -dot_rows(c, at_vertices) - dot_rows(height, at_facets)


def nearest(
    cells: Cells, kappa: FloatArray, slopes: Slopes, loose: BoolArray, free: BoolArray
) -> tuple[FloatArray, FloatArray]:
    """The way from v to the function of degree 2 that is nearest to u_h; collective.

    Args:
        cells: The mesh, d = 2.
        kappa: Mean of κ, shape (cells,) or ().
        slopes: Those of v.
        loose: Which values at vertices are free.
        free: Which heights are free.

    Returns:
        What is to be added to v's values at the vertices and to the heights of its bumps.
    """
    mesh, d = cells.domain.mesh, cells.tdim
    patch: slice | IndexArray = slice(None)
    some = np.flatnonzero(loose[cells.vertices].any(axis=0) | free[cells.facets].any(axis=0))
    few, all_ = cells.total(float(len(some)), float(cells.number))
    if 0.0 < few <= LARGEST * all_:
        mesh, parents = compat.submesh(mesh, d, some.astype(np.int32))
        patch = parents.astype(np.intp)
    vertices, facets = cells.vertices[:, patch], cells.facets[:, patch]
    V = fem.functionspace(mesh, ("Lagrange", 2))
    dofs = V.dofmap.list[: vertices.shape[1]].T
    b, x = fem.Function(V), fem.Function(V)
    held = np.zeros_like(b.x.array)
    held[dofs[: d + 1][~loose[vertices]]] = 1.0
    held[dofs[d + 1 :][~free[facets]]] = 1.0
    shared_maximum(V, held)
    fixed = np.flatnonzero(held > 0.0).astype(np.int32)
    # A nodal function of a vertex is λ_i less half the bumps of the two facets it belongs to
    pull = slopes.facets[:, patch]
    rows = np.concatenate([slopes.vertices[:, patch] - 0.5 * (sum_rows(pull) - pull), pull])
    b.x.array[:] = np.bincount(dofs.ravel(), rows.ravel(), minlength=len(held))
    b.x.scatter_reverse(InsertMode.add)
    b.x.array[fixed] = 0.0
    k = cells.coefficient(kappa, mesh, patch)
    u, w = ufl.TrialFunction(V), ufl.TestFunction(V)
    form = compiled(mesh.comm, fem.form, ufl.inner(k * ufl.grad(u), ufl.grad(w)) * ufl.dx)
    A = assemble_matrix(form, [fem.dirichletbc(fem.Function(V), fixed)])
    A.assemble()
    load, found = (ghosted_vector(V, function.x.array) for function in (b, x))
    solve_once(A, load, found, COMPANION | {"ksp_rtol": SHARE}, ESTIMATE_PREFIX)
    release(A, load, found)
    # aggregates of fixed and free values mix what an iteration leaves of both
    x.x.array[fixed] = 0.0
    x.x.scatter_forward()
    nodal = x.x.array[dofs]
    corners, middles = nodal[: d + 1], nodal[d + 1 :]
    at_vertices, heights = np.zeros(len(loose)), np.zeros(len(free))
    at_vertices[vertices] = corners
    heights[facets] = middles - 0.5 * (sum_rows(corners) - corners)
    return at_vertices, heights
