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

from ..arrays import BoolArray, FloatArray, IndexArray
from ..data.diffusion import diffusion
from ..data.loads import Edge, Load
from ..fem.cells import Cells, Side, blocks, dot_rows, pick, poincare, sum_rows
from .beyond import Beyond

if TYPE_CHECKING:
    from ..vi.level import Level


@dataclass(eq=False)
class Flux:
    """y ∈ H(div), a Raviart-Thomas field of lowest order, and what it has beyond on thin cells.

    Attributes:
        excess: Fluxes out of each cell of y − κ_T ∇u_h, shape (d + 1, cells), κ_T the mean of κ.
        contact: Fluxes through the facets of Γ1, not negative, shape (n,).
        touching: Whether the facet of Γ1 is in contact, shape (n,).
        left: ∫_T (f + div y), shape (cells,).
        steepness: ‖∇u_h‖²_T, shape (cells,).
        beyond: What y has beyond the Raviart-Thomas field; None where that is all.
    """

    excess: FloatArray
    contact: FloatArray
    touching: BoolArray
    left: FloatArray
    steepness: FloatArray
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
    fluxes, steepness = np.empty_like(excess), np.empty(cells.number)
    for part in blocks(cells.number):
        shares = load.shares(cells, part)
        np.negative(shares, out=excess[:, part])
        slopes = cells.apply(w[:, part], part)
        steepness[part] = dot_rows(w[:, part], slopes)
        slopes *= -d * pick(kappa, part)
        np.subtract(slopes, shares, out=fluxes[:, part])
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
    return Flux(excess, contact, touching, left, steepness)


def unbalanced(
    level: Level, cells: Cells, left: FloatArray, kappa_min: FloatArray, size: float = 0.0
) -> float:
    """Bound W with |Σ_T left_T e_T| ≤ W ‖κ^{1/2} ∇e‖ for e ∈ H¹ that vanishes on Γ0.

    e_T is the mean over T. Level by level, what a cell's children have too much or too little is
    spread over the cell: Poincaré's inequality on the cell bounds the difference. On the coarsest
    mesh the rest is carried to Γ0 from cell to cell, as a flux in H(div).

    Args:
        level: The mesh and the coarser ones below it.
        cells: The same mesh.
        left: Integrals over the cells, shape (cells,).
        kappa_min: Lower bound of κ on each cell, shape (cells,) or ().
        size: Of the bound, to which what is carried may be small.
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
        square = np.maximum(square - left**2 / volume, 0.0)
        part = float(np.sum(h**2 * square / kappa_min))
        bound += poincare(d) * np.sqrt(cells.comm.allreduce(part))
    if len(meshes) > 1:
        cells = diffusion(meshes[0].data).cells  # kept: all finer meshes ask for the same walk
    return float(bound + _carried(cells, left, kappa_min, size))


def balance(cells: Cells, flux: Flux, kappa_min: FloatArray, size: float, bound: float) -> float:
    """Add to y what the cells lack, carried to Γ0 cell by cell, where that is worth it; collective.

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
    fluxes, all_reached = _carry(cells, flux.left)
    if not all_reached:
        return 0.0
    squares = field_squares(cells, fluxes) / kappa_min
    square = cells.total(np.sum(squares))[0]
    if not np.sqrt(size**2 + square) - size < bound:
        return 0.0
    flux.excess += fluxes
    flux.left += sum_rows(fluxes)
    return float(np.sqrt(square))


STEPS = 30
"""Of conjugate gradients, for a small field of given divergence."""
WORTH = 1e-3
"""Part of the bound from which on what is left of the equation is carried away by y itself."""


def _carry(cells: Cells, left: FloatArray) -> tuple[FloatArray, bool]:
    """Fluxes of a field q in the Raviart-Thomas space with ∫_T div q = −left_T; collective.

    q·n vanishes on the boundary but Γ0. Cell after cell, the farthest from Γ0 first, sends what it
    holds through the facets by which a walk from Γ0 first came to it, the same through each: so q
    does not depend on how cells and facets are numbered.

    Returns:
        Fluxes out of each cell, shape (d + 1, cells), and whether all cells have a way.
    """
    comm = cells.comm
    fluxes = np.zeros((cells.tdim + 1, cells.number))
    arrived = np.zeros(len(cells.exterior))
    for layer, ways in reversed(cells.layers):
        facets = cells.facets[:, layer]
        inflow = arrived[facets]
        outflow = np.broadcast_to(
            -(left[layer] + inflow.sum(axis=0)) / ways.sum(axis=0), ways.shape
        )
        fluxes[:, layer] = np.where(ways, outflow, inflow)
        arrived[facets[ways]] = -outflow[ways]
        if comm.size > 1:
            arrived[cells.between] += cells.from_others(facets[ways], -outflow[ways])
    reached = cells.total(sum(len(layer) for layer, _ in cells.layers), cells.number)
    return fluxes, bool(reached[0] == reached[1])


def _carried(cells: Cells, left: FloatArray, kappa_min: FloatArray, size: float) -> float:
    """‖κ^{-1/2} q‖ of a field q in the Raviart-Thomas space with ∫_T div q = −left_T; collective.

    Where a walk's q is not small against `size`, one that is nearly the smallest takes its place.
    """

    def norm(fluxes: FloatArray) -> float:
        squares = field_squares(cells, fluxes)
        return float(np.sqrt(cells.total(np.sum(squares / kappa_min))[0]))

    fluxes, all_reached = _carry(cells, left)
    if not all_reached:
        return np.inf
    found = norm(fluxes)
    if found > WORTH * size:
        fluxes = _diffused(cells, left, kappa_min)
        rest, _ = _carry(cells, left + sum_rows(fluxes))
        found = min(found, norm(fluxes + rest))
    return found


def _diffused(cells: Cells, left: FloatArray, kappa: FloatArray) -> FloatArray:
    """Fluxes of nearly the smallest q with nearly ∫_T div q = −left_T; collective.

    They are those of `equilibrate` for the load left_T/|T| and no contact. A few steps of conjugate
    gradients are enough where there are few cells, and of use on any mesh.
    """
    d, owned = cells.tdim, cells.owned_facets()
    fixed = np.zeros(len(cells.exterior))
    for part in cells.fixed:
        fixed[cells.sides[part].dofs] = 1.0
    free = cells.share(fixed) == 0

    def residuals(z: FloatArray) -> FloatArray:
        return d**2 * kappa * cells.apply(z[cells.facets], slice(0, cells.number))

    def assembled(local: FloatArray) -> FloatArray:
        return np.where(free, cells.over_facets(local), 0.0)

    def product(a: FloatArray, b: FloatArray) -> float:
        return float(cells.total(a[:owned] @ b[:owned])[0])

    load = np.tile(left / (d + 1), (d + 1, 1))
    diagonal = cells.over_facets(d**2 * kappa * cells.squares(slice(0, cells.number)))
    r, before = assembled(load), np.inf
    z, p = np.zeros_like(r), np.zeros_like(r)
    for _ in range(STEPS):
        s = r / diagonal
        now = product(r, s)
        if now == 0.0:
            break
        p = s + now / before * p
        Ap = assembled(residuals(p))
        step = now / product(p, Ap)
        z, r, before = z + step * p, r - step * Ap, now
    fluxes = residuals(z) - load
    half = 0.5 * cells.over_facets(fluxes)
    half[cells.exterior] = 0.0
    fluxes -= half[cells.facets]
    fluxes[(cells.exterior & free)[cells.facets]] = 0.0
    return fluxes


def field_squares(
    cells: Cells, fluxes: FloatArray, part: slice | IndexArray | None = None
) -> FloatArray:
    """‖p‖²_T of the field with the given fluxes out of the cell, shape (cells in the part,).

    p = (s (x − x_T) − Σ a_i X_i) / (d |T|) with s the sum of the fluxes and a_i = flux_i − s/(d+1).
    """
    if part is None:
        out = np.empty(cells.number)
        for part in blocks(cells.number):
            out[part] = field_squares(cells, fluxes[:, part], part)
        return out
    d = cells.tdim
    s = sum_rows(fluxes)
    a = fluxes - s / (d + 1)
    lengths = cells.lengths[:, part]
    squares = s**2 * sum_rows(lengths) / ((d + 1) ** 2 * (d + 2))
    for (i, j), length in zip(cells.pairs, lengths, strict=True):
        squares -= a[i] * a[j] * length
    return squares / (d**2 * cells.volume[part])
