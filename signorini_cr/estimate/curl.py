"""What y gains on thin cells, where fluxes that are constant on facets cannot follow κ∇u.

y gets the curl of a continuous function ω of degree 2, which changes no divergence, and on each
cell a field τ without normal components that carries the affine part of f − f_T. ω is what brings
y + τ + curl ω nearest to κ∇v, by algebraic multigrid; it is 0 on Γ1 and Γg, so that y·n stays what
it is there. ω's values at the vertices change the fluxes through facets; what its bumps and τ
add to y is in `Beyond`. `docs/certificate.md` has the mathematics.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from ..data.loads import Load
from ..fem.cells import Cells, blocks, pick
from ..mesh.domain import CONTACT, NEUMANN
from .beyond import Beyond, turn
from .companion import Companion
from .flux import Flux, field_squares
from .nearest import Slopes, nearest
from .shapes import quadrature
from .sums import Sums

FloatArray = npt.NDArray[np.float64]

THIN = 25.0
"""h_T²/|T| of cells from which on they are thin: 2.3 if all sides are equal, 4 for half a square,
20 for half a rectangle 1 : 10."""

HELD = 0.1
"""Part of ‖p‖² + ‖b‖² + ‖κ^{-1/2}σ‖² that ‖p‖² on thin cells must make up."""


def promising(cells: Cells, kappa: FloatArray, flux: Flux, sums: Sums) -> bool:
    """Whether y on thin cells makes up much of the bound; collective.

    Args:
        cells: The mesh.
        kappa: Mean of κ, shape (cells,) or ().
        flux: y.
        sums: The parts of the bound with y as it is.
    """
    if cells.tdim != 2:
        return False
    assert sums.indicators is not None
    thin = np.flatnonzero(cells.diameter2 > THIN * cells.volume)
    squares = field_squares(cells, flux.excess[:, thin], thin) / pick(kappa, thin)
    there, whole = cells.total(np.sum(squares), np.sum(sums.indicators))
    return bool(there > HELD * whole)


def improve(cells: Cells, kappa: FloatArray, load: Load, flux: Flux, v: Companion) -> None:
    """Give y the curl and τ; collective.

    Args:
        cells: The mesh, d = 2.
        kappa: Mean of κ, shape (cells,) or ().
        load: Moments of f.
        flux: y, changed in place.
        v: v; its cusps do not count.
    """
    rise = None if load.hats is None else 12.0 * load.hats
    nothing = np.zeros(len(cells.exterior))
    flux.beyond = Beyond(nothing, nothing, rise)
    loose, free = _loosened(cells, len(v.vertices))
    slopes = _slopes(cells, kappa, flux, flux.beyond, v)
    vertices, heights = nearest(cells, np.asarray(1.0 / kappa), slopes, loose, free)
    vertices[~loose] = 0.0
    heights[~free] = 0.0
    flux.excess -= cells.turns * turn(vertices[cells.vertices])
    flux.beyond = Beyond(heights, vertices, rise)


def _loosened(cells: Cells, vertices: int) -> tuple[npt.NDArray[np.bool_], npt.NDArray[np.bool_]]:
    """Which of ω's values at vertices, and which heights, need not be 0; collective."""
    at_vertices, at_facets = np.zeros(vertices), np.zeros(len(cells.exterior))
    for part in (CONTACT, NEUMANN):
        at_vertices[cells.sides[part].ends] = 1.0
        at_facets[cells.sides[part].dofs] = 1.0
    if not cells.total(np.sum(at_facets))[0] and cells.comm.rank == 0:
        at_vertices[:1] = 1.0  # ω counts up to a constant
    return cells.share(at_vertices, 0) == 0.0, cells.share(at_facets) == 0.0


def _slopes(cells: Cells, kappa: FloatArray, flux: Flux, beyond: Beyond, v: Companion) -> Slopes:
    """−½ of how ‖κ^{-1/2}(y + τ + curl ω − κ∇v)‖² changes with ω.

    With V = Σ Q_i X_i/(2|T|), Σ Q_i = 0, and k, a, b the vertices in their order,
    V·curl λ_k = ((Q_a − Q_b) |X_a − X_b|² + Q_k (|X_b − X_k|² − |X_a − X_k|²)) / (8|T|²) with the
    order's sign.
    """
    hats, weights = quadrature()
    vertices, facets = np.zeros((2, 3, cells.number))
    for part in blocks(cells.number):
        k, P, volume = pick(kappa, part), flux.excess[:, part], cells.volume[part]
        slopes = v.slopes(cells, part)
        opposite = dict(zip(cells.pairs, cells.lengths[:, part], strict=True))
        l0, l1, l2 = opposite[1, 2], opposite[0, 2], opposite[0, 1]
        for hat, weight in zip(hats[:, :, None], weights, strict=True):
            Q = hat * P.sum(axis=0) - P + beyond.through(cells, part, hat)
            Q -= 2.0 * k * cells.apply(slopes(hat), part)
            pull = np.stack(
                [
                    (Q[2] - Q[1]) * l0 + Q[0] * (l2 - l1),
                    (Q[0] - Q[2]) * l1 + Q[1] * (l0 - l2),
                    (Q[1] - Q[0]) * l2 + Q[2] * (l1 - l0),
                ]
            )
            pull *= -weight * cells.turns[part] / (8.0 * k * volume)
            vertices[:, part] += pull
            facets[0, part] += 4.0 * (hat[1] * pull[2] + hat[2] * pull[1])
            facets[1, part] += 4.0 * (hat[0] * pull[2] + hat[2] * pull[0])
            facets[2, part] += 4.0 * (hat[0] * pull[1] + hat[1] * pull[0])
    return Slopes(vertices, facets, np.zeros(cells.number))
