"""A flux in H(div) that balances the load: the dual half of the certificate.

The local residuals of a Crouzeix-Raviart solution are the fluxes through the facets of a
Raviart-Thomas field y of lowest order; nothing is solved. Its divergence is the mean of −f on each
cell, save for what the solver left, which is kept as one number per cell and bounded for itself.
`docs/certificate.md` has the mathematics.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from ..data.diffusion import diffusion
from ..data.loads import Edge, Load
from ..fem.cells import Cells, Side, blocks, pick, poincare, sum_rows
from .beyond import Beyond

if TYPE_CHECKING:
    from ..vi.level import Level

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.intp]


@dataclass(eq=False)
class Flux:
    """y ∈ H(div), a Raviart-Thomas field of lowest order, and what it has beyond on thin cells.

    Attributes:
        excess: Fluxes out of each cell of y − κ_T ∇u_h, shape (d + 1, cells), κ_T the mean of κ.
        contact: Fluxes through the facets of Γ1, not negative, shape (n,).
        touching: Whether the facet of Γ1 is in contact, shape (n,).
        left: ∫_T (f + div y), shape (cells,).
        beyond: What y has beyond the Raviart-Thomas field; None where that is all.
    """

    excess: FloatArray
    contact: FloatArray
    touching: npt.NDArray[np.bool_]
    left: FloatArray
    beyond: Beyond | None = None


def equilibrate(
    cells: Cells,
    kappa: FloatArray,
    w: FloatArray,
    load: Load,
    edge: Edge,
    on_contact: Side,
    gap: FloatArray,
) -> Flux:
    """Find the facet fluxes of y from the local residuals of u_h.

    Seen from T the flux through F is ∫_T κ∇u_h·∇ψ_F − ∫_T f ψ_F − ∫_{∂T∩Γg} g ψ_F, so that the two
    sides of F differ by what the solver left of the equation of F; y takes the mean of the
    two. On Γ1 it is 0 where
    there is no contact, on Γg it is ∫_F g.

    Args:
        cells: The mesh.
        kappa: Mean of κ, shape (cells,) or ().
        w: u_h at the cells' vertices, shape (d + 1, cells).
        load: Moments of f.
        edge: Integrals of g.
        on_contact: The facets of Γ1.
        gap: u_h − α on them, by means, shape (n,).
    """
    d = cells.tdim
    excess = np.empty((d + 1, cells.number))
    fluxes = np.empty_like(excess)
    for part in blocks(cells.number):
        shares = load.shares(cells, part)
        np.negative(shares, out=excess[:, part])
        fluxes[:, part] = -d * pick(kappa, part) * cells.apply(w[:, part], part) - shares
    on_neumann, through = edge.side, edge.shares.sum(axis=0)
    for i, share in enumerate(edge.to_cells()):
        # the facet itself gets all of it further down
        share = np.where(on_neumann.local == i, 0.0, share)
        np.subtract.at(excess[i], on_neumann.cells, share)
        np.subtract.at(fluxes[i], on_neumann.cells, share)
    half = cells.over_facets(fluxes)
    half *= 0.5
    half[cells.exterior] = 0.0
    for part in blocks(cells.number):
        excess[:, part] -= half[cells.facets[:, part]]
    there = on_contact.local, on_contact.cells
    # In contact: the primal-dual criterion with the facet's diagonal entry of A
    diagonal = d**2 * pick(kappa, on_contact.cells) * cells.opposite(on_contact)
    touching = fluxes[there] > np.maximum(diagonal * gap, 0.0)
    contact = np.where(touching, fluxes[there], 0.0)
    excess[there] += contact - fluxes[there]
    there = on_neumann.local, on_neumann.cells
    excess[there] += through - fluxes[there]
    left = sum_rows(excess)
    left += cells.volume * load.mean
    return Flux(excess, contact, touching, left)


def unbalanced(
    level: Level, cells: Cells, left: FloatArray, kappa_min: FloatArray, signed: bool = True
) -> float:
    """Bound W with |Σ_T left_T e_T| ≤ W ‖κ^{1/2} ∇e‖ for e ∈ H¹ that vanishes on Γ0.

    e_T is the mean over T. Level by level, what a cell's children have too much or too little is
    spread over the cell: Poincaré's inequality on the cell bounds the difference. On the coarsest
    mesh the rest is carried to Γ0 along a tree of cells, as a flux in H(div).

    Args:
        level: The mesh and the coarser ones below it.
        cells: The same mesh.
        left: Integrals over the cells, shape (cells,).
        kappa_min: Lower bound of κ on each cell, shape (cells,) or ().
        signed: Whether left is known; else it is an upper bound of the absolute value.
    """
    volume, bound = cells.volume, 0.0
    meshes = level.meshes
    for mesh, coarser in zip(meshes[:0:-1], meshes[-2::-1], strict=True):
        assert mesh.parents is not None
        parent, domain = mesh.parents.cell[: len(left)].astype(np.intp), coarser.domain
        d = domain.mesh.topology.dim
        number = domain.mesh.topology.index_map(d).size_local
        square, left, volume = (
            np.bincount(parent, values, minlength=number).astype(np.float64, copy=False)
            for values in (left**2 / volume, left, volume)
        )
        if kappa_min.ndim:
            coarse = np.full(number, np.inf)
            np.minimum.at(coarse, parent, kappa_min)
            kappa_min = coarse
        h = domain.mesh.h(d, np.arange(number, dtype=np.int32))
        if signed:
            square = np.maximum(square - left**2 / volume, 0.0)
        part = float(np.sum(h**2 * square / kappa_min))
        bound += poincare(d) * np.sqrt(cells.comm.allreduce(part))
    if len(meshes) > 1:
        cells = diffusion(meshes[0].data).cells
    return float(bound + _carried(cells, left, kappa_min, signed))


def balance(cells: Cells, flux: Flux, kappa_min: FloatArray, size: float, bound: float) -> float:
    """Add to y what the cells lack, carried to Γ0 along a tree, where that is worth it; collective.

    Args:
        cells: The mesh.
        flux: y; what is left becomes 0 but for rounding.
        kappa_min: Lower bound of κ on each cell, shape (cells,) or ().
        size: About ‖κ^{-1/2}(y − κ∇u_h)‖.
        bound: What `unbalanced` gives.

    Returns:
        The norm ‖κ^{-1/2} q‖ of what was added; 0 if nothing was.
    """
    if bound <= WORTH * size:
        return 0.0
    fluxes, _, all_reached = _carry(cells, flux.left)
    if not all_reached:
        return 0.0
    squares = field_squares(cells, fluxes, slice(0, cells.number)) / kappa_min
    square = cells.total(np.sum(squares))[0]
    if not np.sqrt(size**2 + square) - size < bound:
        return 0.0
    flux.excess += fluxes
    flux.left += sum_rows(fluxes)
    return float(np.sqrt(square))


WORTH = 1e-3
"""Part of the bound from which on what is left of the equation is carried away by y itself."""


def _carry(cells: Cells, left: FloatArray) -> tuple[FloatArray, IntArray, bool]:
    """Fluxes of a field q in the Raviart-Thomas space with ∫_T div q = −left_T; collective.

    q·n vanishes on the boundary but Γ0. Cell after cell, the farthest from Γ0 first, sends what it
    holds through the facet by which a walk from Γ0 first came to it.

    Returns:
        Fluxes out of each cell, shape (d + 1, cells), the local facets that the cells send through,
        and whether all cells have a way.
    """
    comm = cells.comm
    fluxes = np.zeros((cells.tdim + 1, cells.number))
    ways = np.zeros(cells.number, dtype=np.intp)
    arrived = np.zeros(len(cells.exterior))
    for layer, way_out in reversed(cells.layers):
        inflow = arrived[cells.facets[:, layer]]
        outflow = -left[layer] - inflow.sum(axis=0)
        fluxes[:, layer] = inflow
        fluxes[way_out, layer] = outflow
        ways[layer] = way_out
        through = cells.facets[way_out, layer]
        arrived[through] = -outflow
        if comm.size > 1:
            arrived[cells.between] += cells.from_others(through, -outflow)
    reached = cells.total(sum(len(layer) for layer, _ in cells.layers), cells.number)
    return fluxes, ways, bool(reached[0] == reached[1])


def _carried(cells: Cells, left: FloatArray, kappa_min: FloatArray, signed: bool) -> float:
    """‖κ^{-1/2} q‖ of a field q in the Raviart-Thomas space with ∫_T div q = −left_T."""
    fluxes, ways, all_reached = _carry(cells, left)
    if not all_reached:
        return np.inf
    everywhere = slice(0, cells.number)
    if signed:
        squares = field_squares(cells, fluxes, everywhere)
    else:  # the triangle inequality for what comes in by each facet, and for the cell's own
        norms, at = np.zeros(cells.number), np.arange(cells.number)
        for i, amount in enumerate((*fluxes, left)):
            unit = np.zeros_like(fluxes)
            if i < len(fluxes):
                unit[i] = 1.0
            amount = np.where(ways == i, 0.0, np.abs(amount))
            unit[ways, at] = -1.0
            norms += amount * np.sqrt(np.maximum(field_squares(cells, unit, everywhere), 0.0))
        squares = norms**2
    return float(np.sqrt(cells.comm.allreduce(float(np.sum(squares / kappa_min)))))


def field_squares(
    cells: Cells, fluxes: FloatArray, part: slice | npt.NDArray[np.intp]
) -> FloatArray:
    """‖p‖²_T of the field with the given fluxes out of the cell, shape (cells in the part,).

    p = (s (x − x_T) − Σ a_i X_i) / (d |T|) with s the sum of the fluxes and a_i = flux_i − s/(d+1).
    """
    d = cells.tdim
    s = sum_rows(fluxes)
    a = fluxes - s / (d + 1)
    lengths = cells.lengths[:, part]
    squares = s**2 * sum_rows(lengths) / ((d + 1) ** 2 * (d + 2))
    for (i, j), length in zip(cells.pairs, lengths, strict=True):
        squares -= a[i] * a[j] * length
    return squares / (d**2 * cells.volume[part])
