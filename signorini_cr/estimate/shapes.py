"""Functions on triangles: bumps b_F = 4 λ_j λ_k, c_F = λ_j λ_k (λ_j − λ_k), and λ_1 λ_2 λ_3."""

from __future__ import annotations

import basix
import numpy as np

from ..arrays import BoolArray, FloatArray, IndexArray
from ..fem.cells import Cells
from .descent import descend, nonzero

CG_STEPS = 200
"""Of conjugate gradients, at most."""
SQUARED_TOLERANCE = 1e-20
"""Square of the part of the way that is left when they stop: the same on any number of ranks."""


def bump_slopes(cells: Cells, height: FloatArray, hat: FloatArray) -> FloatArray:
    """Compute γ_k with ∇ Σ height_i b_i = Σ γ_k ∇λ_k at a point, shape (3, n)."""
    gamma = np.zeros_like(height)
    for (i, j), m in ((pair, 3 - sum(pair)) for pair in cells.pairs):
        gamma[i] += 4.0 * hat[m] * height[j]
        gamma[j] += 4.0 * hat[m] * height[i]
    return gamma


def third_slopes(cells: Cells, height: FloatArray, hat: FloatArray) -> FloatArray:
    """Compute γ_k with ∇ Σ height_i c_i = Σ γ_k ∇λ_k at a point, shape (3, n)."""
    gamma = np.zeros_like(height)
    for i, (j, k) in enumerate(cells.others):
        both = 2.0 * hat[j] * hat[k]
        gamma[j] += (both - hat[k] ** 2) * height[i]
        gamma[k] += (hat[j] ** 2 - both) * height[i]
    return gamma


def bubble_slopes(hat: FloatArray) -> FloatArray:
    """Compute γ_k with ∇ λ_1 λ_2 λ_3 = Σ γ_k ∇λ_k at a point, shape (3, n)."""
    return np.stack([hat[1] * hat[2], hat[2] * hat[0], hat[0] * hat[1]])


def local_thirds(cells: Cells, thirds: FloatArray, where: slice | IndexArray) -> FloatArray:
    """Take the heights of the c_i of each cell from those of the facets, shape (3, n)."""
    return np.asarray(cells.ways[:, where] * thirds[cells.facets[:, where]])


def quadrature() -> tuple[FloatArray, FloatArray]:
    """Return points and weights of a rule that is exact for |y|², shapes (q, 3) and (q,)."""
    points, weights = basix.make_quadrature(basix.CellType.triangle, 4)
    return np.column_stack([1.0 - points.sum(axis=1), points]), weights / weights.sum()


def best_heights(cells: Cells, matrix: FloatArray, pull: FloatArray, free: BoolArray) -> FloatArray:
    """Find heights that minimise a quadratic functional, by conjugate gradients; collective.

    Args:
        cells: The mesh.
        matrix: The cells' shares of the matrix, shape (3, 3, cells).
        pull: Those of the right side, shape (3, cells).
        free: Which heights need not be 0, by facet dof.
    """
    diagonal = nonzero(cells.over_facets(np.stack([matrix[i, i] for i in range(3)])))
    down = cells.over_facets(pull) * free
    heights = np.zeros_like(down)

    def image(way: FloatArray) -> FloatArray:
        return cells.over_facets(np.einsum("ijn,jn->in", matrix, way[cells.facets])) * free

    descend(cells, image, heights, down, diagonal, CG_STEPS, SQUARED_TOLERANCE)
    return heights
