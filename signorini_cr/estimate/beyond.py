"""The part of y beyond a Raviart-Thomas field of lowest order on thin cells, see `curl`."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import ufl
from dolfinx import fem

from .. import compat
from ..arrays import FloatArray, IndexArray
from ..fem.cells import Cells
from .shapes import bump_slopes


@dataclass(frozen=True, eq=False)
class Beyond:
    """curl of ω's bumps, and τ = ⅓ Σ_{i<j} (ℓ_j − ℓ_i) (X_j − X_i) λ_i λ_j on each cell.

    Attributes:
        heights: Heights of ω's bumps by facet dof.
        rise: ℓ_i, the values at the vertices of the affine part of f − f_T, shape (3, cells);
            None where f is constant on each cell.
    """

    heights: FloatArray
    rise: FloatArray | None

    def through(self, cells: Cells, where: slice | IndexArray, hat: FloatArray) -> FloatArray:
        """Compute Q_i = 2|T| (curl ω + τ)·∇λ_i at a point of each cell, shape (3, n).

        Args:
            cells: The mesh.
            where: Which cells.
            hat: The point's barycentric coordinates, shape (3, 1) or (3, n).
        """
        height = self.heights[cells.facets[:, where]]
        out = cells.turns[where] * turn(bump_slopes(cells, height, hat))
        if self.rise is not None:
            rise, scale = self.rise[:, where], 2 / 3 * cells.volume[where]
            for i, j in cells.pairs:
                amount = scale * hat[i] * hat[j] * (rise[j] - rise[i])
                out[i] -= amount
                out[j] += amount
        return out

    def largest(self, cells: Cells) -> FloatArray:
        """Find the largest |height| on each cell, shape (cells,)."""
        return np.asarray(np.abs(self.heights[cells.facets]).max(axis=0))

    def field(self, cells: Cells) -> ufl.core.expr.Expr:
        """Write the curl of the bumps and τ = ⅓ (Σ ℓ_i λ_i X_i − ℓ x) in UFL; collective."""
        mesh = cells.domain.mesh
        omega = fem.Function(fem.functionspace(mesh, ("Lagrange", 2)))
        dofs = omega.function_space.dofmap.list[: cells.number]
        omega.x.array[dofs[:, 3:]] = self.heights[cells.facets].T
        omega.x.scatter_forward()
        x, y = ufl.grad(omega)
        curl = ufl.as_vector([y, -x])
        if self.rise is None:
            return curl
        corners = mesh.geometry.x[compat.cell_nodes(mesh)[: cells.number], :2]
        rise = fem.Function(fem.functionspace(mesh, ("DG", 1)))
        moved = fem.Function(fem.functionspace(mesh, ("DG", 1, (2,))))
        dofs = rise.function_space.dofmap.list[: cells.number]
        rise.x.array[dofs] = self.rise.T
        for axis in range(2):
            moved.x.array[2 * dofs + axis] = self.rise.T * corners[..., axis]
        for function in (rise, moved):
            function.x.scatter_forward()
        return curl + (moved - rise * ufl.SpatialCoordinate(mesh)) / 3


def turn(gamma: FloatArray) -> FloatArray:
    """Compute 2|T| curl φ·∇λ_i for ∇φ = Σ γ_k ∇λ_k if the vertices turn left."""
    return np.stack([gamma[1] - gamma[2], gamma[2] - gamma[0], gamma[0] - gamma[1]])
