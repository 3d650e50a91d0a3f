"""Triangles, seen from a boundary facet each: what traces and fluxes there cost inside of them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..arrays import FloatArray
from ..fem.cells import BoundaryFacets, Cells, corner_points, measures, poincare
from .pieces import Pieces


@dataclass(frozen=True, eq=False)
class Triangles:
    """Triangles with a facet F for a side, P opposite; of shape (n,).

    Attributes:
        length: F's.
        height: H, P's distance from the facet's line.
        foot: How far from P's foot on that line the facet begins.
    """

    length: FloatArray
    height: FloatArray
    foot: FloatArray

    @classmethod
    def of(cls, cells: Cells, side: BoundaryFacets, stretched: bool = False) -> Triangles:
        """Measure the facets' cells, d = 2, as they are or as the cells measure lengths."""
        apex, (a, b) = corner_points(cells, side, stretched)
        length = np.linalg.norm(b - a, axis=1)
        foot = np.einsum("nk,nk->n", a - apex, b - a) / length
        return cls(length, 2.0 * cells.volume[side.cells] / length, foot)

    @property
    def area(self) -> FloatArray:
        """Shape (n,)."""
        return 0.5 * self.length * self.height

    def nearer(self) -> Triangles:
        """Take triangles in them about as high as wide, aslant or not, or themselves.

        P comes nearer to the point of F that is nearest to it, until it is as far as F is long.
        """
        nearest = np.clip(0.0, self.foot, self.foot + self.length)
        part = np.minimum(1.0, self.length / np.hypot(nearest, self.height))
        return Triangles(self.length, part * self.height, self.foot - nearest + part * nearest)

    def parts(self, pieces: Pieces, size: FloatArray, steep: FloatArray) -> FloatArray:
        """Bound |δ'|² + (kδ − sδ')²/H² on pieces of the facets: what goes with 1, k and k².

        Args:
            pieces: The pieces.
            size: Bounds of |δ|.
            steep: Bounds of |δ'|.
        """
        at = pieces.parent
        ends = self.foot[at] + pieces.hats[:, 1] * self.length[at]
        reach, size = np.maximum(*np.abs(ends)) / self.height[at], size / self.height[at]
        return np.stack([(1.0 + reach**2) * steep**2, 2.0 * reach * size * steep, size**2])

    def constant(self, measure: FloatArray) -> FloatArray:
        """Find C with ‖e − e_T‖_F ≤ C ‖∇e‖_T, see `trace_constant`; measure is |F|, unstretched."""
        longest = np.maximum(np.abs(self.foot), np.abs(self.foot + self.length))
        h = np.maximum(self.length, np.hypot(longest, self.height))
        c = poincare(2) * h
        return np.asarray(np.sqrt(measure / self.area * c * (c + h)))

    def quadratic(self, measure: FloatArray, a: FloatArray, c: FloatArray) -> FloatArray:
        """Bound ‖σ‖ of the gradient σ with σ·n = a (λ_j − λ_k) + c (6 λ_j λ_k − 1), shape (n,).

        j and k are F's ends, and σ·n = 0 on the other sides. No field without divergence and with
        these fluxes is smaller, and curl ψ is one, for ψ = |F| λ_j λ_k (a (1 + β λ_i) +
        c (λ_k − λ_j)), with the best β for c = 0. measure is |F|, unstretched.
        """
        base, up = self.length**2, self.height**2
        first, second = self.foot**2 + up, (self.foot + self.length) ** 2 + up
        products = second, first, 0.5 * (base - first - second), base + first + second
        jj, kk, jk, trace = (each / (4.0 * self.area) for each in products)
        square = a**2 * (trace / 12.0 - jk**2 / (5.0 * trace))
        square += a * c * (jj - kk) * (1.0 / 15.0 + 2.0 * jk / (15.0 * trace))
        square += c**2 * (2.0 * (jj + kk) + jk) / 45.0
        return np.asarray(measure * np.sqrt(np.maximum(square, 0.0)))


def trace_constant(cells: Cells, side: BoundaryFacets) -> FloatArray:
    """Compute c_F with ‖e − e_T‖_F ≤ c_F ‖∇e‖_T, shape (n,).

    |F|⁻¹ ∫_F w² = |T|⁻¹ (∫_T w² + (2/d) ∫_T w (x − P)·∇w), P opposite F.
    """
    d, h = cells.tdim, np.sqrt(cells.diameter2[side.cells])
    c = poincare(d) * h
    return np.sqrt(measures(cells, side) / cells.volume[side.cells] * c * (c + 2.0 * h / d))
