"""∫ ψ v for a weight ψ in cells or on a part of the boundary, and what is not known of it."""

from __future__ import annotations

from dataclasses import astuple, dataclass

import numpy as np

from ..arrays import FloatArray
from ..data.loads import THIRD, Certain, Segments, trace_of
from ..fem.cells import Cells, dot_rows, measures, sum_rows
from .certificate import Made
from .companion import on_facet
from .sums import INTEGRAL_ROUNDING

CUSP = 0.5
"""No cusp of the height 1 is larger: t^s − t for s = ½ and ¼."""


@dataclass(frozen=True)
class Pairing:
    """ψ against functions, on a rank or on all of them.

    Attributes:
        total: ∫ ψ.
        missed: How far that may be from the truth, rounding included.
        of_u: ∫ ψ u_h.
        of_v: ∫ ψ v.
        unsure: How far that may be from ∫ ψ (v + ℓ).
        scale: Bound of ∫ |ψ v|, or thereabouts, for rounding.
    """

    total: float
    missed: float
    of_u: float
    of_v: float
    unsure: float
    scale: float

    def over_ranks(self, cells: Cells) -> Pairing:
        """Add up what the ranks have; collective."""
        return Pairing(*map(float, cells.total(*astuple(self))))


def in_cells(made: Made, cells: Cells, psi: Certain, there: FloatArray) -> Pairing:
    """Integrate over cells; this rank's share.

    Bumps have the means ⅓, facets' cubics 0, cells' 1/60, and cusps known ones. What ψ has beyond
    its mean meets cubics and cusps by its norm only.

    Args:
        made: v and u_h.
        cells: The mesh.
        psi: ψ, 0 outside of the place.
        there: Which cells make the place, shape (cells,).
    """
    load, volume, n = psi.load, cells.volume, cells.number
    root = np.sqrt(volume)
    missed, rough = (np.zeros(n) if row is None else row for row in (psi.missed, psi.rough))
    at_ends = made.vertices[cells.vertices]
    means, swing = at_ends.mean(axis=0), np.ptp(at_ends, axis=0)
    size = np.abs(at_ends).max(axis=0)
    odd = np.zeros(n)  # bounds of what has no known product with ψ − ψ_T, in the mean
    against = load.mean * made.w.mean(axis=0)
    if load.hats is not None:
        against = against + dot_rows(load.hats, made.w)
    if cells.tdim == 2:
        height = made.bumps[cells.facets]
        means, swing = means + sum_rows(height) / 3.0, swing + sum_rows(np.abs(height))
        size = size + np.abs(height).max(axis=0)
    if made.thirds is not None:
        heights = sum_rows(np.abs(made.thirds[cells.facets]))
        odd, swing = odd + heights / np.sqrt(840.0), swing + THIRD * heights
    if made.bubbles is not None:
        means, heights = means + made.bubbles / 60.0, np.abs(made.bubbles)
        odd, swing = odd + heights / np.sqrt(2520.0), swing + heights / 27.0
    if made.cusps is not None:
        means[made.cusps.at] += made.cusps.means
        heights = np.abs(made.cusps.heights).sum(axis=0)
        odd[made.cusps.at] += CUSP * heights
        swing[made.cusps.at] += CUSP * heights
    found = load.mean * means
    if load.hats is not None:
        found = found + dot_rows(load.hats, at_ends)
        if load.bumps is not None and cells.tdim == 2:
            found = found + dot_rows(load.bumps, height)
    spread = np.zeros(n) if load.variance is None else np.sqrt(load.variance)
    norm = root * (np.abs(load.mean) + spread) + rough
    lifted, _, areas, _ = made.lift
    unsure = np.abs(means) * missed + swing * root * rough + volume * spread * odd
    return Pairing(
        float(volume @ load.mean),
        float(np.sum(missed) + INTEGRAL_ROUNDING * (root @ norm)),
        float(volume @ against),
        float(volume @ found),
        float(np.sum(unsure) + norm[lifted] @ areas),
        float(root * norm @ size),
    )


def on_side(made: Made, cells: Cells, psi: Segments) -> Pairing:
    """Integrate over a part of the boundary; this rank's share.

    Cusps vanish there, and ℓ on other parts than Γ0 and Γ1.

    Args:
        made: v and u_h.
        cells: The mesh.
        psi: ψ on the part.
    """
    facets, length = psi.facets, measures(cells, psi.facets)

    def over(values: FloatArray) -> FloatArray:
        sums = np.bincount(psi.place, psi.measure * (psi.weights @ values), minlength=len(length))
        return sums.astype(np.float64)

    own_v = made.vertices, made.bumps, made.thirds
    v = on_facet(cells, psi.side, psi.hats, *own_v)
    u = np.einsum("qdn,dn->qn", psi.hats, trace_of(cells, facets, made.w)[:, psi.place])
    own = np.zeros(len(cells.exterior))
    np.add.at(own, made.bounded, made.lift[3])
    norm = np.sqrt(over(psi.values**2)) + psi.rough
    unsure = psi.change(*own_v) + norm @ own[facets.dofs]
    return Pairing(
        float(np.sum(psi.through)),
        float(np.sum(psi.missed) + INTEGRAL_ROUNDING * np.sum(over(np.abs(psi.values)))),
        float(np.sum(over(psi.values * u))),
        float(np.sum(over(psi.values * v))),
        float(unsure),
        float(np.sum(over(np.abs(psi.values * v)))),
    )
