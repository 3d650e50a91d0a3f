"""Correction of y on thin cells, where fluxes that are constant on facets cannot follow κ∇u.

y gets the curl of a continuous function ω, which changes no divergence, and on each cell a field τ
without normal components that carries the affine part of f − f_T. ω is made of the bumps of facets;
their heights are those that bring y + τ + curl ω nearest to κ∇(u_h + v)/2, the middle of what the
bound is made of. On Γ1 they are 0, so that y·n stays what it is there; on Γg they are such that y·n
is the affine function nearest to g. `docs/certificate.md`
has the mathematics.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..arrays import FloatArray
from ..data.loads import NOTHING, Segments, VolumeMoments
from ..data.quadrature import Coefficient
from ..fem.cells import THIN, Cells, blocks, measures, pick
from .beyond import Beyond
from .companion import Companion
from .duality import taken_up
from .flux import Flux, field_squares
from .functional import Slopes
from .nearest import nearest
from .shapes import quadrature
from .sums import Sums

WORTH = 0.05
"""Part of the bound's square that something on thin cells must make up to be worth a try."""


def promising(
    cells: Cells, kappa: FloatArray, flux: Flux, v: Companion, sums: Sums
) -> tuple[bool, bool]:
    """Tell what makes up much of the bound on thin cells; collective.

    Args:
        cells: The mesh.
        kappa: Mean of κ, shape (cells,) or ().
        flux: y.
        v: v.
        sums: The parts of the bound with both as they are, but for ℓ's.

    Returns:
        Whether y or ℓ does, and whether it does that v is above α where there is contact.
    """
    if cells.tdim != 2:
        return False, False
    thin = cells.diameter2 > THIN * cells.volume
    which = np.flatnonzero(thin)
    squares = field_squares(cells, flux.excess[:, which], which) / pick(kappa, which)
    at, slope, *_ = v.lift
    lifted = pick(kappa, at) * slope**2
    side = v.boundary.alpha.side
    *parts, whole = cells.total(
        np.sum(squares),
        np.sum(lifted[thin[at]]),
        np.sum(v.contact[thin[side.cells]]),
        np.sum(sums.indicators) + np.sum(lifted),
    )
    of_y, of_lift, of_alpha = (bool(part > WORTH * whole) for part in parts)
    return of_y or of_lift, of_alpha


def improve(
    cells: Cells,
    kappa: Coefficient,
    load: VolumeMoments,
    edge: Segments,
    flux: Flux,
    v: Companion,
    reaction: FloatArray = NOTHING,
) -> Flux:
    """Make y with the curl and τ; collective.

    Args:
        cells: The mesh, d = 2.
        kappa: The coefficient.
        load: Moments of f.
        edge: Values of g.
        flux: y.
        v: v; its cusps do not count.
        reaction: c, shape (cells,) or ().
    """
    rise = None if load.hats is None else 12.0 * load.hats
    taken = taken_up(cells, load, kappa.bounds.low, slice(None), reaction)
    if rise is not None and taken is not None:
        rise = np.where(taken, 0.0, rise)
    given, held = np.zeros((2, len(cells.exterior)))
    # ω = 4 height λ_j λ_k has the slope 4 height (λ_j − λ_k)/|F|; to the left of the facet's normal
    # it goes from j to k, but for the facet 1 of cells whose vertices turn left
    side = edge.facets
    left = np.where(side.local == 1, -1.0, 1.0) * cells.turns[side.cells]
    slope = np.where(edge.followed, edge.slope, 0.0)  # elsewhere b takes it up
    given[side.dofs] = left * slope * measures(cells, side) / 4.0
    for known in (v.boundary.alpha.side, side):
        held[known.dofs] = 1.0
    given, free = cells.share(given), cells.share(held) == 0.0
    flux = replace(flux, beyond=Beyond(given, rise))
    slopes = Slopes(np.zeros((3, cells.number)), _pull(cells, kappa.mean, flux, v), np.zeros(0))
    none = np.zeros(len(v.vertices), dtype=bool)
    _, heights = nearest(cells, np.asarray(1.0 / kappa.mean), slopes, none, free)
    return replace(flux, beyond=Beyond(np.where(free, heights, given), rise))


def _pull(cells: Cells, kappa: FloatArray, flux: Flux, v: Companion) -> FloatArray:
    """Compute −∫ κ⁻¹ (y − κ∇(u_h + v)/2)·curl b_i on each cell, shape (3, cells).

    With V = Σ Q_i X_i/(2|T|), Σ Q_i = 0, and a, b the vertices before and after k,
    V·curl λ_k = ((Q_a − Q_b) |X_a − X_b|² + Q_k (|X_b − X_k|² − |X_a − X_k|²)) / (8|T|²) if the
    vertices turn left, else the negative of that.
    """
    hats, weights = quadrature()
    pull = np.zeros((3, cells.number))
    for block in blocks(cells.number):
        k, P, volume = pick(kappa, block), flux.excess[:, block], cells.volume[block]
        slopes = v.slopes(cells, block)
        opposite = dict(zip(cells.pairs, cells.lengths[:, block], strict=True))
        lengths = [opposite[1, 2], opposite[0, 2], opposite[0, 1]]
        for hat, weight in zip(hats[:, :, None], weights, strict=True):
            Q = hat * P.sum(axis=0) - P - k * cells.apply(slopes(hat), block)
            if flux.beyond is not None:
                Q += flux.beyond.through(cells, block, hat)
            along = [
                (Q[a] - Q[b]) * lengths[m] + Q[m] * (lengths[a] - lengths[b])
                for m, a, b in ((0, 2, 1), (1, 0, 2), (2, 1, 0))
            ]
            scale = -0.5 * weight * cells.turns[block] / (k * volume)
            for i, (a, b) in enumerate(cells.others):
                pull[i, block] += scale * (hat[a] * along[b] + hat[b] * along[a])
    return pull
