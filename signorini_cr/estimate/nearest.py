"""The continuous function of degree 2 that is nearest to u_h, by algebraic multigrid.

Where few of its values are free, the cells that know of these are made a mesh of their own, and the
system is as small as that.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import ufl
from dolfinx import fem
from dolfinx.fem.petsc import assemble_matrix
from petsc4py import PETSc

from .. import compat
from ..arrays import BoolArray, FloatArray, IndexArray, Int32Array
from ..fem.cells import Cells, on_cells, sum_rows
from ..fem.space import ghosted_vector
from ..garbage import release
from ..jit import compiled
from ..mesh.shared import shared_maximum, shared_sum
from ..options import COMPANION, ESTIMATE_PREFIX, solve_once
from .functional import Masses, Slopes

TOLERANCE = 1e-10
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
    patch = _Patch.of(cells, free_vertices, free_facets)
    A, x = patch.matrix(kappa, masses), fem.Function(patch.V)
    load, found = (ghosted_vector(patch.V, array) for array in (patch.fall(slopes), x.x.array))
    solve_once(A, load, found, COMPANION | {"ksp_rtol": TOLERANCE}, ESTIMATE_PREFIX)
    release(A, load, found)
    # aggregates of fixed and free values mix what an iteration leaves of both
    x.x.array[patch.held] = 0.0
    x.x.scatter_forward()
    corners, middles = np.split(x.x.array[patch.dofs], 2)
    at_vertices, heights = np.zeros(len(free_vertices)), np.zeros(len(free_facets))
    at_vertices[cells.vertices[:, patch.at]] = corners
    heights[cells.facets[:, patch.at]] = middles - 0.5 * (sum_rows(corners) - corners)
    return at_vertices, heights


@dataclass(frozen=True, eq=False)
class _Patch:
    """The functions of degree 2 on the cells that know of free values, or on all.

    Attributes:
        cells: All cells.
        at: Which of them these are.
        V: The functions.
        dofs: Dofs of the cells' vertices and facets, shape (6, n).
        held: Which dofs are not free, ghosts included.
    """

    cells: Cells
    at: slice | IndexArray
    V: fem.FunctionSpace
    dofs: Int32Array
    held: BoolArray

    @classmethod
    def of(cls, cells: Cells, free_vertices: BoolArray, free_facets: BoolArray) -> _Patch:
        """Make the cells that know of free values a mesh if they are few; collective."""
        mesh, number = cells.domain.mesh, cells.number
        at: slice | IndexArray = slice(None)
        some = np.flatnonzero(
            free_vertices[cells.vertices].any(axis=0) | free_facets[cells.facets].any(axis=0)
        )
        few, all_ = cells.total(float(len(some)), float(number))
        if 0.0 < few <= LARGEST * all_:
            mesh, parents = compat.submesh(mesh, cells.tdim, some.astype(np.int32))
            at, number = parents.astype(np.intp), len(parents)
        V = fem.functionspace(mesh, ("Lagrange", 2))
        dofs = V.dofmap.list[:number].T
        free = free_vertices[cells.vertices[:, at]], free_facets[cells.facets[:, at]]
        held = np.zeros_like(fem.Function(V).x.array)
        held[dofs[~np.concatenate(free)]] = 1.0
        shared_maximum(mesh, V.dofmap.index_map, held)
        return cls(cells, at, V, dofs, held > 0.0)

    def fall(self, slopes: Slopes) -> FloatArray:
        """Compute how fast E falls by values at dofs, 0 for those held; collective."""
        # A nodal function of a vertex is λ_i less half the bumps of the two facets it belongs to
        pull = slopes.facets[:, self.at]
        rows = [slopes.vertices[:, self.at] - 0.5 * (sum_rows(pull) - pull), pull]
        own = np.bincount(self.dofs.ravel(), np.concatenate(rows).ravel(), len(self.held))
        found = shared_sum(self.V.mesh, self.V.dofmap.index_map, own.astype(np.float64))
        return np.where(self.held, 0.0, found)

    def matrix(self, kappa: FloatArray, masses: Masses | None) -> PETSc.Mat:
        """Assemble E's matrix, where values are held that of the identity; collective."""
        V, mesh = self.V, self.V.mesh
        u, w = ufl.TrialFunction(V), ufl.TestFunction(V)
        k = self.cells.coefficient(kappa, mesh, self.at)
        energy = ufl.inner(k * ufl.grad(u), ufl.grad(w))
        if masses is not None and masses.reacts:
            reaction = np.broadcast_to(masses.reaction, self.cells.number)
            energy += on_cells(mesh, reaction[self.at]) * u * w
        form = compiled(mesh.comm, fem.form, energy * ufl.dx)
        fixed = np.flatnonzero(self.held).astype(np.int32)
        A = assemble_matrix(form, [fem.dirichletbc(fem.Function(V), fixed)])
        A.assemble()
        if masses is not None and masses.some:
            self._add_losses(A, masses)
        return A

    def _add_losses(self, A: PETSc.Mat, masses: Masses) -> None:
        """Add ∫ b u w over facets to a matrix, in whose pattern this is; collective."""
        row, side = np.full(self.cells.number, -1), masses.side
        row[self.at] = np.arange(self.dofs.shape[1])
        at = row[side.cells]
        near = at >= 0
        local, at, loss = side.local[near], at[near], masses.loss[near]
        ends, middle = self.dofs[self.cells.others[local].T, at], self.dofs[3 + local, at]
        of_facet = np.vstack([ends, middle]).T
        of_facet = np.where(self.held[of_facet], -1, of_facet).astype(PETSc.IntType)  # passed over
        start = np.arange(0, 3 * of_facet.size + 1, 3, dtype=PETSc.IntType)
        columns = np.repeat(of_facet, 3, axis=0).ravel()
        values = (loss[:, None, None] * OF_FACET).ravel()
        A.setValuesLocalIJV(start, columns, values, addv=True, rowmap=of_facet.ravel())
        A.assemble()
