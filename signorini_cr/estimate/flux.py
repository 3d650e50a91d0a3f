"""A flux in H(div) that balances the load: the dual half of the certificate.

The local residuals of a Crouzeix-Raviart solution are the fluxes through the facets of a
Raviart-Thomas field y of lowest order; nothing is solved. Its divergence is the mean of −f on each
cell, save for what the solver left, which is kept as one number per cell and bounded for itself.
`docs/certificate.md` has the mathematics.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from mpi4py import MPI

from ..arrays import BoolArray, FloatArray, IndexArray
from ..data.diffusion import diffusion
from ..data.loads import NOTHING, Known, VolumeMoments, reacts, to_cells
from ..fem.cells import (
    BoundaryFacets,
    Cells,
    Layers,
    blocks,
    dot_rows,
    measures,
    pick,
    poincare,
    sum_rows,
)
from ..vi.active import touching
from .beyond import Beyond
from .descent import descend, nonzero

if TYPE_CHECKING:
    from ..vi.level import Level


@dataclass(eq=False)
class Flux:
    """y ∈ H(div), a Raviart-Thomas field of lowest order, and what it has beyond on thin cells.

    Attributes:
        excess: Fluxes out of each cell of y − κ_T ∇u_h, shape (d + 1, cells), κ_T the mean of κ.
        contact: Contact forces off each bound of the facets of Γ1: y's flux less that which is
            known, not negative, shape (n,).
        touching: Whether the facet is in contact with it, shape (n,).
        left: ∫_T (f + div y), shape (cells,).
        steepness: ‖∇u_h‖²_T, shape (cells,).
        beyond: What y has beyond the Raviart-Thomas field; None where that is all.
        taken_up: Where c takes up what is left, shape (cells,); None for nowhere on any rank.
        shed: ∫_F (g − b u_h − y·n) for b to take up, in the order of `Known`; None for nothing.
        carried: What contact forces may have to be changed by for the sake of what is left, in the
            order of `contact`; None where that goes elsewhere.
    """

    excess: FloatArray
    contact: FloatArray
    touching: BoolArray
    left: FloatArray
    steepness: FloatArray
    beyond: Beyond | None = None
    taken_up: BoolArray | None = None
    shed: FloatArray | None = None
    carried: FloatArray | None = None

    @property
    def unbalanced(self) -> FloatArray:
        """∫_T (f + div y) where it is not taken up, shape (cells,)."""
        return self.left if self.taken_up is None else np.where(self.taken_up, 0.0, self.left)


def equilibrate(
    cells: Cells,
    kappa: FloatArray,
    w: FloatArray,
    load: VolumeMoments,
    edge: Known,
    on_contact: BoundaryFacets,
    signs: FloatArray,
    gap: FloatArray,
) -> Flux:
    """Find the facet fluxes of y from the local residuals of u_h.

    Seen from T the flux through F is ∫_T κ∇u_h·∇ψ_F − ∫_T f ψ_F − ∫_{∂T∩Γg} g ψ_F, so that the two
    sides of F differ by what the solver left of the equation of F; y takes the mean of the
    two. On Γg it is ∫_F g; on Γ1 it is that where there is no contact, and not less where there is.

    Args:
        cells: The mesh.
        kappa: Mean of κ, shape (cells,) or ().
        w: u_h at the cells' vertices, shape (d + 1, cells).
        load: Moments of f − c u_h.
        edge: Integrals of g − b u_h.
        on_contact: The facets of Γ1, once for each bound.
        signs: 1 for α, −1 for β, shape (n,).
        gap: u_h − α or β − u_h on them, by means, shape (n,).
    """
    d = cells.tdim
    excess = np.empty((d + 1, cells.number))
    fluxes, steepness = np.empty_like(excess), np.empty(cells.number)
    for block in blocks(cells.number):
        shares = load.shares(cells, block)
        np.negative(shares, out=excess[:, block])
        slopes = cells.apply(w[:, block], block)
        steepness[block] = dot_rows(w[:, block], slopes)
        slopes *= -d * pick(kappa, block)
        np.subtract(slopes, shares, out=fluxes[:, block])
    side, known = edge.side, np.zeros(len(cells.exterior))
    known[side.dofs] = edge.shares.sum(axis=0)
    for i, share in enumerate(to_cells(cells, side, edge.shares)):
        # the facet itself gets all of it further down
        share = np.where(side.local == i, 0.0, share)
        np.subtract.at(excess[i], side.cells, share)
        np.subtract.at(fluxes[i], side.cells, share)
    half = cells.over_facets(fluxes)
    half *= 0.5
    half[cells.exterior] = 0.0
    for block in blocks(cells.number):
        excess[:, block] -= half[cells.facets[:, block]]
    there = on_contact.local, on_contact.cells
    diagonal = d**2 * pick(kappa, on_contact.cells) * cells.opposite(on_contact)
    force, through = fluxes[there] - known[on_contact.dofs], known[on_contact.dofs]
    force *= signs
    in_contact = touching(gap, force, diagonal)
    contact = np.where(in_contact, force, 0.0)
    excess[there] += through - fluxes[there]
    np.add.at(excess, there, signs * contact)
    natural = ~edge.bounded
    there = side.local[natural], side.cells[natural]
    excess[there] += known[side.dofs[natural]] - fluxes[there]
    left = sum_rows(excess)
    left += cells.volume * load.mean
    return Flux(excess, contact, in_contact, left, steepness)


def relax(
    cells: Cells,
    kappa: FloatArray,
    flux: Flux,
    reaction: FloatArray,
    edge: Known,
    on_contact: BoundaryFacets,
    signs: FloatArray,
) -> BoolArray | None:
    """Bring y nearer to κ∇u_h where c can take up what it then lacks; collective.

    With f + div y = left_T/|T| on T instead of 0 the bound has ‖c^{-1/2} left_T/|T|‖_T more, and
    where c h_T² is larger than κ that is less than what ‖κ^{-1/2}(y − κ∇u_h)‖_T falls by. So it is
    with b, g − b u_h − y·n and ‖b^{-1/2} ·‖_F. The squares' sum is minimised by conjugate gradients
    in the fluxes through facets inside, on Γ0, with a b and in contact, but for those of cells
    without a c. Forces that come out below 0 are 0; then it is done once more without them.

    Args:
        cells: The mesh.
        kappa: Mean of κ, shape (cells,) or ().
        flux: y, changed in place.
        reaction: c, shape (cells,) or ().
        edge: Integrals of g − b u_h.
        on_contact: The facets of Γ1, once for each bound.
        signs: 1 for α, −1 for β, shape (n,).

    Returns:
        `Flux.taken_up`.
    """
    if cells.tdim != 2 or not reacts(reaction):
        return None
    ratio = float((reaction * cells.diameter2 / kappa).max(initial=0.0))
    if cells.comm.allreduce(ratio, op=MPI.MAX) < STRONG:
        return None
    takers = np.broadcast_to(reaction > 0.0, cells.number)
    pushing = flux.touching.copy()
    for last in (False, True):
        squares, free = _relaxed(cells, kappa, reaction, edge, on_contact, pushing)
        fluxes = squares.least(flux, free)
        there = on_contact.local[pushing], on_contact.cells[pushing]
        off, before = signs[pushing], flux.contact[pushing]
        force = before + off * fluxes[there]
        pulls = np.zeros_like(pushing)
        pulls[pushing] = force < 0.0
        if last or not cells.comm.allreduce(bool(pulls.any()), op=MPI.LOR):
            break
        # where the force would pull there is none, and what is best without it is found anew
        _let_go(flux, on_contact, signs, pulls)
        pushing &= ~pulls
    force = np.maximum(force, 0.0)
    fluxes[there] = off * (force - before)
    flux.contact[pushing] = force
    flux.shed = np.where(squares.of_edge > 0.0, -fluxes[squares.sides], 0.0)
    flux.excess += fluxes
    flux.left += sum_rows(fluxes)
    return takers


def _let_go(flux: Flux, on_contact: BoundaryFacets, signs: FloatArray, which: BoolArray) -> None:
    """Take contact forces out of y."""
    there, force = (on_contact.local[which], on_contact.cells[which]), signs * flux.contact
    np.subtract.at(flux.excess, there, force[which])
    np.subtract.at(flux.left, there[1], force[which])
    flux.contact[which] = 0.0


def _relaxed(
    cells: Cells,
    kappa: FloatArray,
    reaction: FloatArray,
    edge: Known,
    on_contact: BoundaryFacets,
    pushing: BoolArray,
) -> tuple[_Relaxed, BoolArray]:
    """Set up what is to become small, and which fluxes may change, by facet dof; collective.

    Args:
        cells: The mesh.
        kappa: Mean of κ, shape (cells,) or ().
        reaction: c, shape (cells,) or ().
        edge: Integrals of g − b u_h.
        on_contact: The facets of Γ1, once for each bound.
        pushing: Where the force takes up what changes, and b nothing, shape (n,).
    """
    loss, in_contact = np.zeros(len(cells.exterior)), on_contact.dofs[pushing]
    loss[edge.side.dofs] = edge.loss
    loss[in_contact] = 0.0
    held = np.zeros(len(cells.exterior))
    for part, side in cells.sides.items():  # of this rank's cells: others may see a facet as well
        held[side.dofs] = part not in cells.fixed
    held[on_contact.dofs] = loss[on_contact.dofs] == 0.0
    held[in_contact] = 0.0
    if reaction.ndim:
        held[cells.facets[:, reaction <= 0.0]] = 1.0
    return _Relaxed.of(cells, kappa, reaction, edge.side, loss), cells.share(held) == 0.0


@dataclass(frozen=True, eq=False)
class _Relaxed:
    """The sum of squares that `relax` makes small, as a functional of fluxes.

    Attributes:
        cells: The mesh.
        kappa: Mean of κ, shape (cells,) or ().
        of_cells: 1/(c|T|), 0 where there is no c, shape (cells,).
        sides: Local numbers and cells of facets with a g or a b.
        of_edge: 1/(b|F|) on them, 0 where b takes up nothing, shape (n,).
        sign: 1 where a flux that counts as positive leaves the cell, −1 where it enters, shape
            (3, cells): of a facet's two cells it leaves one, the same on all ranks.
    """

    cells: Cells
    kappa: FloatArray
    of_cells: FloatArray
    sides: tuple[IndexArray, IndexArray]
    of_edge: FloatArray
    sign: FloatArray

    @classmethod
    def of(
        cls,
        cells: Cells,
        kappa: FloatArray,
        reaction: FloatArray,
        side: BoundaryFacets,
        loss: FloatArray,
    ) -> _Relaxed:
        """Weigh what c and b take up.

        Args:
            cells: The mesh.
            kappa: Mean of κ, shape (cells,) or ().
            reaction: c, shape (cells,) or ().
            side: Facets with a g or a b.
            loss: b by facet dof, 0 where it takes up nothing.
        """
        return cls(
            cells,
            kappa,
            _inverse(reaction * cells.volume),
            (side.local, side.cells),
            _inverse(loss[side.dofs] * measures(cells, side)),
            cells.ways * cells.turns * np.array([[1.0], [-1.0], [1.0]]),
        )

    def least(self, flux: Flux, free: BoolArray) -> FloatArray:
        """Find how fluxes out of the cells are to change, shape (3, cells); collective.

        Args:
            flux: y.
            free: Which of them may, by facet dof.
        """

        def assembled(local: FloatArray) -> FloatArray:
            return np.where(free, self.cells.over_facets(local), 0.0)

        def image(way: FloatArray) -> FloatArray:
            fluxes = self.sign * way[self.cells.facets]
            return assembled(self.slopes(fluxes, sum_rows(fluxes), fluxes[self.sides]))

        down = -assembled(self.slopes(flux.excess, flux.left, np.zeros(len(self.of_edge))))
        change = np.zeros_like(down)
        descend(self.cells, image, change, down, self.diagonal(), CG_STEPS)
        return self.sign * change[self.cells.facets]

    def slopes(self, excess: FloatArray, left: FloatArray, shed: FloatArray) -> FloatArray:
        """Compute ½ ∂ by the flux through each cell's facets, shape (3, cells).

        Args:
            excess: Fluxes of y − κ∇u_h out of the cells, shape (3, cells).
            left: ∫_T (f + div y), shape (cells,).
            shed: What y·n has beyond g − b u_h on the facets of `sides`, shape (n,).
        """
        local = _field_slopes(self.cells, excess) / self.kappa + self.of_cells * left
        np.add.at(local, self.sides, self.of_edge * shed)
        return self.sign * local

    def diagonal(self) -> FloatArray:
        """Compute ½ ∂² by each flux, by facet dof; collective."""
        units = np.eye(3)[:, :, None] * np.ones(self.cells.number)
        local = np.stack([field_squares(self.cells, unit) for unit in units]) / self.kappa
        local += self.of_cells
        np.add.at(local, self.sides, self.of_edge)
        return nonzero(self.cells.over_facets(local))


def _inverse(masses: FloatArray) -> FloatArray:
    """Compute 1 over what is positive, 0 for the rest."""
    return np.divide(1.0, masses, out=np.zeros_like(masses), where=masses > 0.0)


def _field_slopes(cells: Cells, fluxes: FloatArray) -> FloatArray:
    """Compute ½ ∂`field_squares` by each flux, shape (d + 1, cells)."""
    d, s = cells.tdim, sum_rows(fluxes)
    a, q = fluxes - s / (d + 1), np.zeros_like(fluxes)
    for (i, j), length in zip(cells.pairs, cells.lengths, strict=True):
        q[i] += a[j] * length
        q[j] += a[i] * length
    bulk = s * sum_rows(cells.lengths) / ((d + 1) ** 2 * (d + 2))
    out: FloatArray = bulk + 0.5 * (sum_rows(q) / (d + 1) - q)
    return out / (d**2 * cells.volume)


def unbalanced(
    level: Level,
    cells: Cells,
    left: FloatArray,
    kappa_min: FloatArray,
    size: float = 0.0,
    reaction: FloatArray = NOTHING,
) -> float:
    """Bound W with |Σ_T left_T e_T| ≤ W times e's energy norm, for e ∈ H¹ that vanishes on Γ0.

    e_T is the mean over T. Level by level, what a cell's children have too much or too little is
    spread over the cell: Poincaré's inequality on the cell bounds the difference. On the coarsest
    mesh the rest is carried to Γ0 from cell to cell, as a flux in H(div).

    Args:
        level: The mesh and the coarser ones below it.
        cells: The same mesh.
        left: Integrals over the cells, shape (cells,).
        kappa_min: Lower bound of κ's eigenvalues on each cell, shape (cells,) or ().
        size: Of the bound, to which what is carried may be small.
        reaction: c, shape (cells,) or (): ‖c^{1/2} e‖ bounds it, too.
    """
    volume, bound = cells.volume, 0.0
    taken_up = np.inf
    if reacts(reaction):
        mass = reaction * volume
        share = np.where(left == 0.0, 0.0, np.inf)
        np.divide(left**2, mass, out=share, where=mass > 0.0)
        taken_up = float(np.sqrt(cells.total(np.sum(share))[0]))
        if taken_up <= WORTH * size:
            return taken_up
    meshes = level.meshes
    for mesh, coarser in zip(meshes[:0:-1], meshes[-2::-1], strict=True):
        parents = mesh.parents
        assert parents is not None
        square, left, volume = map(parents.collected, (left**2 / volume, left, volume))
        if kappa_min.ndim:
            kappa_min = parents.collected(kappa_min, np.minimum)
        square = np.maximum(square - left**2 / volume, 0.0)
        own = float(np.sum(coarser.diameters**2 * square / kappa_min))
        bound += poincare(cells.tdim) * np.sqrt(cells.comm.allreduce(own))
    if len(meshes) > 1:
        coarsest = diffusion(meshes[0].data)
        cells, reaction = coarsest.cells, coarsest.reaction[0]  # kept, with the walk on them
    plain = cells.unstretched()
    return min(taken_up, float(bound + _carried(plain, left, kappa_min, size, reaction)))


def rebalance(cells: Cells, flux: Flux, kappa_min: FloatArray, size: float, bound: float) -> float:
    """Add to y what the cells lack, carried to Γ0 cell by cell, where that is worth it; collective.

    Args:
        cells: The mesh.
        flux: y; what is left and not taken up becomes 0 but for rounding.
        kappa_min: Lower bound of κ on each cell, shape (cells,) or ().
        size: About ‖κ^{-1/2}(y − κ∇u_h)‖.
        bound: What `unbalanced` gives.

    Returns:
        The norm ‖κ^{-1/2} q‖ of what was added; 0 if nothing was.
    """
    if bound <= WORTH * size or cells.sinks:
        return 0.0
    fluxes, all_reached = _carry(cells, flux.unbalanced)
    if not all_reached:
        return 0.0
    squares = field_squares(cells, fluxes) / kappa_min
    square = cells.total(np.sum(squares))[0]
    if not np.sqrt(size**2 + square) - size < bound:
        return 0.0
    flux.excess += fluxes
    flux.left += sum_rows(fluxes)
    return float(np.sqrt(square))


STRONG = 3.0
"""c h_T²/κ from which on c takes up what y lacks."""
CG_STEPS = 30
"""Of conjugate gradients, for a small field of given divergence."""
WORTH = 1e-3
"""Part of the bound from which on what is left of the equation is carried away by y itself."""


def _carry(
    cells: Cells, left: FloatArray, layers: Layers | None = None, takers: int = 0
) -> tuple[FloatArray, bool]:
    """Find the fluxes of a Raviart-Thomas field q with ∫_T div q = −left_T; collective.

    q·n vanishes on the boundary but Γ0. Cell after cell, the farthest from Γ0 first, sends what it
    holds through the facets by which a walk from Γ0 first came to it, the same through each: so q
    does not depend on how cells and facets are numbered.

    Args:
        cells: The mesh.
        left: Shape (cells,).
        layers: The walk; None for that from Γ0.
        takers: How many cells of this rank are in no layer: they keep what they get.

    Returns:
        Fluxes out of each cell, shape (d + 1, cells), and whether all cells have a way.
    """
    comm = cells.comm
    layers = cells.layers if layers is None else layers
    fluxes = np.zeros((cells.tdim + 1, cells.number))
    arrived = np.zeros(len(cells.exterior))
    kept = np.ones(cells.number, dtype=bool)
    for layer, ways in reversed(layers):
        facets = cells.facets[:, layer]
        inflow = arrived[facets]
        outflow = np.broadcast_to(
            -(left[layer] + inflow.sum(axis=0)) / ways.sum(axis=0), ways.shape
        )
        fluxes[:, layer], kept[layer] = np.where(ways, outflow, inflow), False
        arrived[facets[ways]] = -outflow[ways]
        if comm.size > 1:
            arrived[cells.between] += cells.from_others(facets[ways], -outflow[ways])
    reached = cells.total(sum(len(layer) for layer, _ in layers) + takers, cells.number)
    if takers:
        fluxes[:, kept] = arrived[cells.facets[:, kept]]
    return fluxes, bool(reached[0] == reached[1])


def _carried(
    cells: Cells, left: FloatArray, kappa_min: FloatArray, size: float, reaction: FloatArray
) -> float:
    """Compute ‖κ^{-1/2} q‖ of a Raviart-Thomas field q with ∫_T div q = −left_T; collective.

    Where q leaves through facets with a b, that takes up ‖b^{-1/2} q·n‖ there. Where a walk's q is
    not small against `size`, one that is nearly the smallest takes its place. Where cells have no
    way to Γ0 or a b, all is carried to cells with a c as well, and that takes up what they get.
    """

    def norm(fluxes: FloatArray) -> float:
        square = float(np.sum(field_squares(cells, fluxes) / kappa_min))
        for part, loss in cells.sinks.items():
            side = cells.sides[part]
            out = fluxes[side.local, side.cells]
            square += float(np.sum(out**2 / (loss * measures(cells, side))))
        return float(np.sqrt(cells.total(square)[0]))

    fluxes, all_reached = _carry(cells, left)
    if not all_reached:
        if not reaction.ndim:
            return np.inf
        takers = reaction > 0.0
        layers = cells.layered([cells.sides[part].dofs for part in cells.fixed], takers)
        fluxes, all_reached = _carry(cells, left, layers, int(takers.sum()))
        kept = (left + sum_rows(fluxes))[takers]
        square = float(np.sum(kept**2 / (reaction * cells.volume)[takers]))
        total = float(cells.total(square)[0])
        return float(np.hypot(norm(fluxes), np.sqrt(total))) if all_reached else np.inf
    found, layers = norm(fluxes), cells.layers
    if found > WORTH * size and cells.sinks:  # a b that is small is a dear way out
        fluxes, all_reached = _carry(cells, left, cells.layers_from_fixed)
        other = norm(fluxes)
        if all_reached and other < found:
            found, layers = other, cells.layers_from_fixed
    if found > WORTH * size:
        fluxes = _diffused(cells, left, kappa_min)
        rest, _ = _carry(cells, left + sum_rows(fluxes), layers)
        found = min(found, norm(fluxes + rest))
    return found


def carried_to_contact(
    cells: Cells,
    flux: Flux,
    left: FloatArray,
    kappa_min: FloatArray,
    on_contact: BoundaryFacets,
    reaction: FloatArray,
    signed: bool,
) -> tuple[float, FloatArray]:
    """Carry to facets in contact, too, what has no other way or a dear one; collective.

    There are ways to parts with a b and cells with a c, and ways without: the smaller norm counts.

    Args:
        cells: The mesh.
        flux: y.
        left: Integrals over the cells, shape (cells,).
        kappa_min: Lower bound of κ's eigenvalues on each cell, shape (cells,) or ().
        on_contact: The facets of Γ1, once for each bound.
        reaction: c, shape (cells,) or ().
        signed: Whether these are the integrals; if not, they bound them.

    Returns:
        W as `unbalanced` has it for e less what e has on Γ1, ∞ where there is none; and by how much
        that changes each contact force at most, shape (n,).
    """
    plain = cells.unstretched()
    mean = cells.total(float(flux.contact.sum()), float(flux.touching.sum()))
    firm = flux.contact >= 0.5 * mean[0] / max(mean[1], 1.0)
    firm &= flux.touching

    def way(parts: Iterable[int], takers: BoolArray) -> tuple[float, FloatArray]:
        exits = [*(cells.sides[part].dofs for part in parts), on_contact.dofs[firm]]
        fluxes, all_reached = _carry(plain, left, plain.layered(exits, takers), int(takers.sum()))
        change = np.where(firm, np.abs(fluxes[on_contact.local, on_contact.cells]), 0.0)
        enough = not (change > flux.contact).any()
        if not (all_reached and cells.comm.allreduce(enough, op=MPI.LAND)):
            return np.inf, change
        if signed:
            squares = field_squares(plain, fluxes)
        else:  # of a sum of one field for each facet, whatever the signs
            units = np.eye(len(fluxes))[:, :, None] * np.ones(cells.number)
            sizes = [np.sqrt(np.maximum(field_squares(plain, unit), 0.0)) for unit in units]
            squares = dot_rows(np.abs(fluxes), np.stack(sizes)) ** 2
        square = float(np.sum(squares / kappa_min))
        for part in set(parts) & set(plain.sinks):
            side, loss = plain.sides[part], plain.sinks[part]
            square += float(
                np.sum(fluxes[side.local, side.cells] ** 2 / (loss * measures(plain, side)))
            )
        kept = (left + sum_rows(fluxes))[takers]
        square += float(np.sum(kept**2 / (reaction * cells.volume)[takers])) if kept.size else 0.0
        return float(np.sqrt(cells.total(square)[0])), change

    takers = np.broadcast_to(reaction > 0.0, cells.number)
    found = [way(cells.fixed, takers)]
    if cells.sinks or cells.comm.allreduce(bool(takers.any()), op=MPI.LOR):
        none = np.zeros(cells.number, dtype=bool)
        found.append(way([part for part in cells.fixed if part not in cells.sinks], none))
    return min(found, key=lambda each: each[0])


def _diffused(cells: Cells, left: FloatArray, kappa: FloatArray) -> FloatArray:
    """Find the fluxes of nearly the smallest q with nearly ∫_T div q = −left_T; collective.

    They are those of `equilibrate` for the load left_T/|T|, a b and no contact. A few steps of
    conjugate gradients are enough where there are few cells, and of use on any mesh.
    """
    d = cells.tdim
    fixed, losses = np.zeros((2, len(cells.exterior)))
    for part in cells.fixed:
        side = cells.sides[part]
        if part in cells.sinks:
            losses[side.dofs] = cells.sinks[part] * measures(cells, side)
        else:
            fixed[side.dofs] = 1.0
    free, losses = cells.share(fixed) == 0, cells.share(losses)

    def residuals(z: FloatArray) -> FloatArray:
        return d**2 * kappa * cells.apply(z[cells.facets], slice(0, cells.number))

    def assembled(local: FloatArray) -> FloatArray:
        return np.where(free, cells.over_facets(local), 0.0)

    load = np.tile(left / (d + 1), (d + 1, 1))
    squares = cells.over_facets(d**2 * kappa * cells.squares(slice(0, cells.number)))
    down, diagonal = assembled(load), nonzero(squares + losses)
    z = np.zeros_like(down)

    def image(way: FloatArray) -> FloatArray:
        return assembled(residuals(way)) + losses * way

    descend(cells, image, z, down, diagonal, CG_STEPS)
    fluxes = residuals(z) - load
    half = 0.5 * cells.over_facets(fluxes)
    half[cells.exterior] = 0.0
    fluxes -= half[cells.facets]
    outside = (cells.exterior & free)[cells.facets]
    fluxes[outside] = (-losses * z)[cells.facets][outside]
    return fluxes


def field_squares(
    cells: Cells, fluxes: FloatArray, block: slice | IndexArray | None = None
) -> FloatArray:
    """Compute ‖p‖²_T of the field with these fluxes out of the cell, shape (cells in the block,).

    p = (s (x − x_T) − Σ a_i X_i) / (d |T|) with s the sum of the fluxes and a_i = flux_i − s/(d+1).
    """
    if block is None:
        out = np.empty(cells.number)
        for block in blocks(cells.number):
            out[block] = field_squares(cells, fluxes[:, block], block)
        return out
    d = cells.tdim
    s = sum_rows(fluxes)
    a = fluxes - s / (d + 1)
    lengths = cells.lengths[:, block]
    squares = s**2 * sum_rows(lengths) / ((d + 1) ** 2 * (d + 2))
    for (i, j), length in zip(cells.pairs, lengths, strict=True):
        squares -= a[i] * a[j] * length
    return squares / (d**2 * cells.volume[block])
