"""v on the way to the companion, and what its bounds ask of it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..arrays import BoolArray, FloatArray
from ..data.quadrature import OnFacets, OnParts
from ..fem.cells import BoundaryFacets, Cells
from .functional import Masses

KINK = 0.05
"""Deviation of α from its interpolant, in parts of this one's bump: 1/8 at a kink, else O(h)."""
SLIGHT = 1e-3
"""Deviation at a kink that counts, in parts of what α differs by on the facet. Where α is a
wave and its second derivative 0, it is a 78th of (ωh)² for the frequency ω."""
NOISE = 1e-9
"""Part of α below which it is rounding."""


@dataclass(eq=False)
class Draft:
    """v on the way.

    Attributes:
        vertices: v at the vertices, ghosts included.
        bumps: Heights of v's bumps by facet dof, ghosts included.
        free_vertices: Which values at vertices may be changed.
        free_facets: Which heights may be changed.
    """

    vertices: FloatArray
    bumps: FloatArray
    free_vertices: BoolArray
    free_facets: BoolArray


@dataclass(frozen=True, eq=False)
class Floors:
    """Bounds of v: s v is not below the quadratic through three values on each facet.

    Attributes:
        side: The facets of Γ1, once for each bound.
        signs: s, shape (n,).
        ends: The bounds at their ends, shape (d, n).
        middle: At their midpoints, shape (n,).
        at_vertices: The values of s, and for each the largest bound at each vertex, −∞ for none:
            where parts with obstacles of their own meet, the higher one counts.
        facets: Number of facets.
        kinked: Where α has a kink, see `kinked`, shape (n,).
        at_middle: Where s v is not to be below α at the middle either, and no more is asked for:
            at kinks, and where v is drawn to t/b, as near to u as α is, shape (n,).
    """

    side: BoundaryFacets
    signs: FloatArray
    ends: FloatArray
    middle: FloatArray
    at_vertices: tuple[tuple[int, FloatArray], ...]
    facets: int
    kinked: BoolArray
    at_middle: BoolArray

    @classmethod
    def of(cls, cells: Cells, bounds: OnParts, masses: Masses) -> Floors:
        """Collect them; collective."""
        side, signs, ends = bounds.side, bounds.signs, bounds.ends
        limits = []
        for sign in sorted({each.sign for each in bounds.parts}, reverse=True):
            here = signs == sign
            limits.append((sign, cells.largest_at_vertices(side.ends[:, here], ends[:, here])))
        n, none = len(cells.exterior), np.empty(0, dtype=bool)
        bent = np.concatenate([none, *map(kinked, bounds.parts)])
        strong = np.zeros(n, dtype=bool)
        strong[masses.side.dofs] = masses.strong
        # to a bound that is a number no lifting brings v
        curved = [np.full(len(p.middle), p.trace.constant is None) for p in bounds.parts]
        at_middle = bent | strong[side.dofs] & np.concatenate([none, *curved])
        return cls(side, signs, ends, bounds.middle, tuple(limits), n, bent, at_middle)

    def heights(self, v: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the least and the largest heights of bumps that they allow for, by facet dof.

        Args:
            v: v at the vertices, within the bounds.
        """
        above = self.signs * v[self.side.ends]
        least = np.where(
            self.at_middle,
            self.middle - above.mean(axis=0),
            _lowest(above, self.ends, self.middle),
        )
        low, high = np.full(self.facets, -np.inf), np.full(self.facets, np.inf)
        up = self.signs > 0.0
        low[self.side.dofs[up]] = least[up]
        high[self.side.dofs[~up]] = -least[~up]
        return low, high


def _lowest(v: FloatArray, obstacle: FloatArray, middle: FloatArray) -> FloatArray:
    """Find the bumps' least heights for v to stay above the quadratic through α's three values.

    Args:
        v: At the facets' ends, not below α, shape (2, n).
        obstacle: α there.
        middle: α at the midpoints, shape (n,).
    """
    room: FloatArray = np.sqrt(np.maximum(v - obstacle, 0.0)).sum(axis=0) ** 2 / 4
    return middle - obstacle.mean(axis=0) - room


def kinked(data: OnFacets) -> BoolArray:
    """Tell where α has a kink, so that its quadratic interpolant is far above it; shape (n,)."""
    if data.trace.constant is not None or len(data.ends) != 2:
        return np.zeros(len(data.middle), dtype=bool)
    bump = np.abs(data.middle - data.ends.mean(axis=0))
    values = np.concatenate([data.ends, data.middle[None], data.inside])
    least = np.maximum(SLIGHT * np.ptp(values, axis=0), NOISE * np.abs(values).max(axis=0))
    return np.asarray(np.abs(data.rest).max(axis=0, initial=0.0) > np.maximum(KINK * bump, least))
