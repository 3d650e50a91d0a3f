"""Cubic functions for v on thin cells.

What u_D and α have beyond quadratics has to fall off within a cell's height, which is dear where
cells are thin. There v gets a function c_F = λ_j λ_k (λ_j − λ_k) for each facet, and λ_1 λ_2 λ_3
for each cell: without the latter a cubic on the boundary would bend v in the cells next to it. On
Γ0 and Γ1 the facets' heights are those of the data's best cubics, on Γg they are 0; the others are
what brings ∇v nearest to ∇u_h, by conjugate gradients.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from dolfinx import fem

from .. import compat
from ..arrays import FloatArray
from ..data.quadrature import OnFacets
from ..fem.cells import Cells, blocks, dot_rows, pick
from .companion import Companion
from .flux import Flux
from .shapes import best_heights, bubble_slopes, local_thirds, quadrature, third_slopes

AT_OBSTACLE = 1e-12
"""Distance of v from α in the middle of a facet where it is meant to be α, in parts of the data."""


def cubed(cells: Cells, kappa: FloatArray, flux: Flux, v: Companion) -> Companion:
    """Give v cubic functions; collective.

    Args:
        cells: The mesh, d = 2.
        kappa: κ, constant on each cell, shape (cells,) or ().
        flux: y.
        v: Without cusps.
    """
    boundary, thirds = v.boundary, np.zeros(len(cells.exterior))
    for data in (*boundary.u_D.parts, *boundary.alpha.parts):
        if len(data.condition.bounds) > 1:  # following one bound v might pass the other
            continue
        side = data.side(cells)
        own = data.sign * cells.ways_between(*side.ends) * _of_data(data)
        if data.condition.fixed is None:  # v need not follow α where it is above it
            middle = v.vertices[side.ends].mean(axis=0) + v.bumps[side.dofs]
            apart = np.abs(data.sign * middle - data.middle)
            own = np.where(apart <= AT_OBSTACLE * boundary.scale, own, 0.0)
        thirds[side.dofs] = own
    cells.share(thirds)
    heights, bubbles = _fitted(cells, kappa, replace(v, thirds=thirds))
    thirds += heights
    contact, lift, reasons = boundary.lifted(cells, flux, v.vertices, v.bumps, thirds)
    words = [word for rank in cells.comm.allgather(reasons) for word in rank if word]
    reason = v.reason or (words[0] if words else None)
    lifted = replace(v, contact=contact, lift=lift, reason=reason)
    return replace(lifted, thirds=thirds, bubbles=bubbles)


def with_cubics(
    cells: Cells, v: fem.Function, thirds: FloatArray, bubbles: FloatArray
) -> fem.Function:
    """Make a function of degree 2 plus cubic functions with some heights; collective."""
    mesh = cells.domain.mesh
    pieces = fem.Function(fem.functionspace(mesh, ("DG", 3)))
    pieces.interpolate(v)
    points = compat.interpolation_points(pieces.function_space)
    hats = np.column_stack([1.0 - points.sum(axis=1), points])
    values = np.stack(
        [hats[:, j] * hats[:, k] * (hats[:, j] - hats[:, k]) for j, k in cells.others]
    )
    dofs = pieces.function_space.dofmap.list[: cells.number]
    pieces.x.array[dofs] += local_thirds(cells, thirds, slice(0, cells.number)).T @ values
    pieces.x.array[dofs] += np.outer(bubbles, hats.prod(axis=1))
    pieces.x.scatter_forward()
    cubic = fem.Function(fem.functionspace(mesh, ("Lagrange", 3)))
    cubic.interpolate(pieces)
    return cubic


def _of_data(data: OnFacets) -> FloatArray:
    """Find the heights of c_F in the data, as seen from the facets' cells, shape (n,)."""
    trace = data.trace
    first, second = trace.hats.T
    cubic = first * second * (first - second)
    size = trace.weights @ cubic**2
    if not size > 0.0:
        return np.zeros(len(data.middle))
    return np.asarray((trace.weights * cubic) @ data.rest / size)


def _fitted(cells: Cells, kappa: FloatArray, v: Companion) -> tuple[FloatArray, FloatArray]:
    """Find the cubics that bring ∇v nearest to ∇u_h; collective.

    Those of cells have no product with another cell's, and are eliminated.

    Returns:
        What is to be added to inner facets' heights, and the cells' heights.
    """
    hats, weights = quadrature()
    matrix, pull = np.zeros((4, 4, cells.number)), np.zeros((4, cells.number))
    for block in blocks(cells.number):
        slopes, signs = v.slopes(cells, block), cells.ways[:, block]
        for hat, weight in zip(hats[:, :, None], weights, strict=True):
            off = slopes(hat)
            each = [third_slopes(cells, signs * row[:, None], hat) for row in np.eye(3)]
            each.append(np.broadcast_to(bubble_slopes(hat), off.shape))
            for i, own in enumerate(each):
                flow = weight * pick(kappa, block) * cells.apply(own, block)
                pull[i, block] -= dot_rows(flow, off)
                for j, other in enumerate(each):
                    matrix[i, j, block] += dot_rows(flow, other)
    alone, joint = matrix[3, 3], matrix[:3, 3]
    reduced = matrix[:3, :3] - joint[:, None] * joint / alone
    heights = best_heights(cells, reduced, pull[:3] - joint * pull[3] / alone, ~cells.exterior)
    return heights, (pull[3] - dot_rows(joint, heights[cells.facets])) / alone
