"""Cubic functions of facets for v on thin cells.

What u_D and α have beyond quadratics has to fall off within a cell's height, which is dear where
cells are thin. There v gets a function c_F = λ_j λ_k (λ_j − λ_k) for each facet. On Γ0 and Γ1 their
heights are those of the data's best cubics, on Γg they are 0; the others are what brings ∇v nearest
to ∇u_h, by conjugate gradients.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt
from dolfinx import fem

from ..data.moments import Trace
from ..fem.cells import Cells, Side, blocks, dot_rows, pick
from ..mesh.domain import CONTACT, DIRICHLET
from .companion import Companion
from .flux import Flux
from .lifting import Cubic
from .shapes import local_thirds, quadrature, third_slopes

FloatArray = npt.NDArray[np.float64]

STEPS = 200
"""Of conjugate gradients, at most."""
SHARE = 1e-12
"""Square of the part of the way that is left when they stop: the same on any number of ranks."""


def cubed(cells: Cells, kappa: FloatArray, flux: Flux, v: Companion) -> Companion:
    """Give v cubic functions; collective.

    Args:
        cells: The mesh, d = 2.
        kappa: κ, constant on each cell, shape (cells,) or ().
        flux: y.
        v: Without cusps.
    """
    boundary, thirds = v.boundary, np.zeros(len(cells.exterior))
    for part, trace, values in (
        (DIRICHLET, boundary.u_D, boundary.on_fixed),
        (CONTACT, boundary.alpha, boundary.on_contact),
    ):
        side = cells.sides[part]
        found = _of_data(trace, values, side)
        thirds[side.dofs] = cells.ways[side.local, side.cells] * found
    cells.share(thirds)
    _fit(cells, kappa, replace(v, thirds=thirds), np.where(cells.exterior, 0.0, 1.0))
    contact, lift, reasons = boundary.lifted(cells, flux, v.vertices, v.bumps, thirds)
    words = [word for rank in cells.comm.allgather(reasons) for word in rank if word]
    reason = v.reason or (words[0] if words else None)
    return replace(v, thirds=thirds, contact=contact, lift=lift, reason=reason)


def with_thirds(cells: Cells, v: fem.Function, thirds: FloatArray) -> fem.Function:
    """A function of degree 2 plus the cubic functions with some heights; collective."""
    mesh = cells.domain.mesh
    pieces = fem.Function(fem.functionspace(mesh, ("DG", 3)))
    pieces.interpolate(v)
    points = pieces.function_space.element.interpolation_points
    points = points() if callable(points) else points
    hats = np.column_stack([1.0 - points.sum(axis=1), points])
    values = np.stack(
        [hats[:, j] * hats[:, k] * (hats[:, j] - hats[:, k]) for j, k in cells.others]
    )
    dofs = pieces.function_space.dofmap.list[: cells.number]
    pieces.x.array[dofs] += local_thirds(cells, thirds, slice(0, cells.number)).T @ values
    pieces.x.scatter_forward()
    cubic = fem.Function(fem.functionspace(mesh, ("Lagrange", 3)))
    cubic.interpolate(pieces)
    return cubic


def _of_data(
    trace: Trace, values: tuple[FloatArray, FloatArray, FloatArray], side: Side
) -> FloatArray:
    """Heights of c_F in the data, as seen from the facets' cells, shape (n,)."""
    ends, middle, inside = values
    n = len(side.cells)
    quadratic = Cubic(ends, middle - ends.mean(axis=0), np.zeros(n))
    first, second = trace.hats.T
    cubic = first * second * (first - second)
    size = trace.weights @ cubic**2
    if not size > 0.0:
        return np.zeros(n)
    rest = inside - np.stack([quadratic.at(np.arange(n), np.full(n, s)) for s in second])
    return np.asarray((trace.weights * cubic) @ rest / size)


def _fit(cells: Cells, kappa: FloatArray, v: Companion, free: FloatArray) -> None:
    """Conjugate gradients for ‖κ^{1/2}(∇v − ∇u_h)‖² in the free heights; collective."""
    assert v.thirds is not None
    hats, weights = quadrature()
    matrix, pull = np.zeros((3, 3, cells.number)), np.zeros((3, cells.number))
    for part in blocks(cells.number):
        slopes, signs = v.slopes(cells, part), cells.ways[:, part]
        ones = np.ones_like(signs)
        for hat, weight in zip(hats[:, :, None], weights, strict=True):
            scale, off = weight * pick(kappa, part), slopes(hat)
            each = [
                third_slopes(cells, np.where(np.arange(3)[:, None] == i, ones, 0.0), hat)
                for i in range(3)
            ]
            for i, own in enumerate(each):
                flow = scale * signs[i] * cells.apply(own, part)
                pull[i, part] -= dot_rows(flow, off)
                for j, other in enumerate(each):
                    matrix[i, j, part] += signs[j] * dot_rows(flow, other)
    down = cells.over_facets(pull) * free
    weight = cells.over_facets(np.stack([matrix[i, i] for i in range(3)]))
    weight[weight == 0.0] = 1.0  # no cell of this rank has the facet
    owned = slice(cells.owned_facets())
    way = down / weight
    first = square = cells.total(down[owned] @ way[owned])[0]
    for _ in range(STEPS):
        if not square > SHARE * first:
            break
        image = cells.over_facets(np.einsum("ijn,jn->in", matrix, way[cells.facets])) * free
        length = square / cells.total(way[owned] @ image[owned])[0]
        v.thirds[:] += length * way
        down -= length * image
        straight = down / weight
        before, square = square, cells.total(down[owned] @ straight[owned])[0]
        way = straight + square / before * way
