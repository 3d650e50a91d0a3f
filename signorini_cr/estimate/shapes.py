"""Functions of facets on triangles: bumps b_F = 4 λ_j λ_k, and c_F = λ_j λ_k (λ_j − λ_k)."""

from __future__ import annotations

import basix
import numpy as np
import numpy.typing as npt

from ..fem.cells import Cells

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.intp]


def bump_slopes(cells: Cells, height: FloatArray, hat: FloatArray) -> FloatArray:
    """Numbers γ_k with ∇ Σ height_i b_i = Σ γ_k ∇λ_k at a point, shape (3, n)."""
    gamma = np.zeros_like(height)
    for (i, j), m in ((pair, 3 - sum(pair)) for pair in cells.pairs):
        gamma[i] += 4.0 * hat[m] * height[j]
        gamma[j] += 4.0 * hat[m] * height[i]
    return gamma


def third_slopes(cells: Cells, height: FloatArray, hat: FloatArray) -> FloatArray:
    """Numbers γ_k with ∇ Σ height_i c_i = Σ γ_k ∇λ_k at a point, shape (3, n)."""
    gamma = np.zeros_like(height)
    for i, (j, k) in enumerate(cells.others):
        both = 2.0 * hat[j] * hat[k]
        gamma[j] += (both - hat[k] ** 2) * height[i]
        gamma[k] += (hat[j] ** 2 - both) * height[i]
    return gamma


def local_thirds(cells: Cells, thirds: FloatArray, where: slice | IntArray) -> FloatArray:
    """Heights of the c_i of each cell from those of the facets, shape (3, n)."""
    return np.asarray(cells.ways[:, where] * thirds[cells.facets[:, where]])


def quadrature() -> tuple[FloatArray, FloatArray]:
    """Points and weights of a rule that is exact for |y|², shapes (q, 3) and (q,)."""
    points, weights = basix.make_quadrature(basix.CellType.triangle, 4)
    return np.column_stack([1.0 - points.sum(axis=1), points]), weights / weights.sum()
