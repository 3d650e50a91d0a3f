"""A conforming function near u_h: the primal half of the certificate.

v is continuous, v = u_D on Γ0 and v ≥ α on Γ1. It is P1 with the means of u_h's vertex values,
weighted by κ, plus (for d = 2) a quadratic bump b_F = 4 λ_j λ_k on each facet, whose heights are
found by sweeps that bring ∇v nearer to ∇u_h. Where that leaves much to be gained, v is found by
solving for it, see `best`, around the points where it is, or on all of the mesh if that is
everywhere; single vertices that hold much of what is left get `cusps`.
What u_D and α have beyond quadratic polynomials goes into a lifting ℓ in the boundary cells, of
which the norm is known. `docs/certificate.md` has the mathematics.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from mpi4py import MPI

from ..arrays import BoolArray, FloatArray, IndexArray
from ..data.admissible import differs
from ..data.quadrature import OnFacets, OnParts
from ..fem.cells import THIN, BoundaryFacets, Cells, measures
from ..fem.conditions import as_number
from .best import solved
from .cusps import Cusps
from .draft import Draft, Floors, kinked
from .flux import Flux
from .functional import Functional, Masses
from .heights import promise_of_vertices, sweep
from .lifting import Cubic, Lift, affine, cheaper, joined, lift
from .shapes import bubble_slopes, bump_slopes, local_thirds, third_slopes

Lifted = tuple[IndexArray, FloatArray, FloatArray, FloatArray]

JUMP = "u_D jumps where boundary facets meet: no function of finite energy has such values"
BELOW = "u_D is below α where Γ0 meets Γ1: no function satisfies both"

PROMISE = 0.04
"""Part of ‖κ^{1/2}(∇v − ∇u_h)‖² that a step must promise to take off for v to be solved for.

A sweep leaves 0.005 to 0.03 on ordinary meshes with a smooth coefficient, also around a singular
point; 0.05 on fine meshes where there are several, 0.07 where the coefficient is a checkerboard,
and 0.2 and more on thin cells.
"""

SHARED = 0.03
"""Cost of a move of v at a vertex of thin cells, in parts of Σ κ|T||∇λ_i|², which it would cost
alone: others move along. From 0.01 to 0.1 bounds differ by 2 % at most."""

ALONE = 0.3
"""The same for other cells, on the one next to the facet."""


@dataclass(eq=False)
class Companion:
    """v, and what is needed of it.

    Attributes:
        vertices: v at the vertices, ghosts included.
        bumps: Heights of v's bumps by facet dof, ghosts included.
        excess: v − u_h at the cells' vertices, before the bumps, shape (d + 1, cells).
        contact: Σ over Γ1 of ∫_F of y·n times what v + ℓ is off the bound, by facet, once for each
            bound, shape (n,).
        lift: Cells, bounds of ‖∇ℓ‖_T and ‖ℓ‖_T on them, shapes (n,); and of ‖ℓ‖_F on Γ1's facets.
        reason: Why v is not admissible, if it isn't.
        boundary: What v has to be on Γ0 and above on Γ1.
        cusps: What v has beyond vertices and bumps; None if nothing, then on all ranks.
        thirds: Heights of the cubic functions of facets by facet dof, see `cubic`; or None.
        bubbles: Those of the cells' λ_1 λ_2 λ_3, shape (cells,); or None.
    """

    vertices: FloatArray
    bumps: FloatArray
    excess: FloatArray
    contact: FloatArray
    lift: Lifted
    reason: str | None
    boundary: Prescribed
    cusps: Cusps | None = None
    thirds: FloatArray | None = None
    bubbles: FloatArray | None = None

    def slopes(self, cells: Cells, where: slice | IndexArray) -> Callable[[FloatArray], FloatArray]:
        """Return a function for ∇(v − u_h) without cusps: γ_i with ∇(v − u_h) = Σ γ_i ∇λ_i.

        Args:
            cells: The mesh.
            where: Which cells.

        Returns:
            A function of a point's barycentric coordinates, shape (d + 1, 1) or (d + 1, n); its
            values are of shape (d + 1, n).
        """
        excess, height, third, bubble = self.excess[:, where], None, None, None
        if cells.tdim == 2:
            height = self.bumps[cells.facets[:, where]]
        if self.thirds is not None:
            third = local_thirds(cells, self.thirds, where)
        if self.bubbles is not None:
            bubble = self.bubbles[where]

        def at(hat: FloatArray) -> FloatArray:
            gamma = excess if height is None else excess + bump_slopes(cells, height, hat)
            if third is not None:
                gamma = gamma + third_slopes(cells, third, hat)
            return gamma if bubble is None else gamma + bubble * bubble_slopes(hat)

        return at


def companion(
    functional: Functional,
    flux: Flux,
    u_D: OnParts,
    alpha: OnParts,
    sweeps: int,
    goal: float,
    highest: float,
    on_obstacle: bool = False,
) -> Companion:
    """Make v; collective.

    Args:
        functional: What it is to make small.
        flux: y.
        u_D: Values on Γ0, seen from the cells.
        alpha: Obstacle on Γ1, seen from the cells.
        sweeps: How often the bumps are improved.
        goal: What ‖∇ℓ‖ need not be known better than.
        highest: The largest κ.
        on_obstacle: Whether v is α wherever y says that there is contact, whatever that costs.
    """
    cells, floors = functional.cells, Floors.of(functional.cells, alpha, functional.masses)
    draft = _started(functional, u_D, floors, flux, on_obstacle)
    largest = max(1e-300, float(np.abs(draft.vertices).max(initial=0.0)))
    scale = max(cells.comm.allgather(largest))
    boundary = Prescribed(u_D, alpha, scale, goal, highest, functional.masses)
    wrong = boundary.contradictions(cells, draft.vertices)
    excess, cusps = functional.excess(draft.vertices), None
    if cells.tdim == 2 and sweeps > 0:
        poor = _improved(functional, draft, excess, u_D.side, floors, sweeps)
        if poor:
            draft.vertices, draft.bumps, cusps = solved(functional, draft, floors)
            excess = functional.excess(draft.vertices)
    above, lifts, reasons = boundary.lifted(
        cells, flux, draft.vertices, draft.bumps, np.zeros(len(draft.bumps))
    )
    words = [word for rank in cells.comm.allgather(wrong + reasons) for word in rank if word]
    reason = words[0] if words else None
    return Companion(draft.vertices, draft.bumps, excess, above, lifts, reason, boundary, cusps)


def _started(
    functional: Functional, u_D: OnParts, floors: Floors, flux: Flux, on_obstacle: bool
) -> Draft:
    """Make a v that is admissible, with bumps where data ask for them; collective.

    Args:
        functional: What v is to make small.
        u_D: Values on Γ0, seen from the cells.
        floors: What the bounds ask of v.
        flux: y, which knows where there is contact.
        on_obstacle: As in `companion`.
    """
    cells, fixed, contact = functional.cells, u_D.side, floors.side
    v, at_bound = _at_vertices(functional, u_D, floors, flux, on_obstacle)
    held = np.zeros(len(v))
    held[fixed.ends] = held[contact.ends[:, at_bound]] = 1.0
    bumps, taken = np.zeros((2, floors.facets))
    if cells.tdim == 2:
        low, high = (limit[contact.dofs] for limit in floors.heights(v))
        bumps[contact.dofs] = np.clip(0.0, low, high)
        bumps[fixed.dofs] = u_D.middle - v[fixed.ends].mean(axis=0)
        ends = np.where(floors.signs > 0.0, low, high)
        bumps[contact.dofs[at_bound]] = ends[at_bound]
        taken[fixed.dofs] = taken[contact.dofs[at_bound]] = 1.0
        # a facet's values reach the ranks that share it
        cells.share(bumps)
    return Draft(v, bumps, cells.share(held, 0) == 0.0, cells.share(taken) == 0.0)


def _improved(
    functional: Functional,
    draft: Draft,
    excess: FloatArray,
    fixed: BoundaryFacets,
    floors: Floors,
    sweeps: int,
) -> bool:
    """Improve the bumps, d = 2; collective.

    Args:
        functional: What v is to make small.
        draft: v, of which the heights are changed.
        excess: v − u_h at the cells' vertices without the bumps, shape (3, cells).
        fixed: The facets of Γ0.
        floors: What the bounds ask of v.
        sweeps: How often.

    Returns:
        Whether much would be gained by solving for v.
    """
    contact, bumps = floors.side, draft.bumps
    energy, promise = sweep(functional, excess, bumps, draft.free_facets, (fixed, contact), sweeps)
    low, high = (limit[contact.dofs] for limit in floors.heights(draft.vertices))
    bumps[contact.dofs] = np.clip(bumps[contact.dofs], low, high)
    promise += promise_of_vertices(functional, excess, bumps, draft.free_vertices)
    return promise > PROMISE * energy


@dataclass(frozen=True, eq=False)
class Prescribed:
    """Values that v has to have on Γ0, and the obstacle that it has to be above on Γ1.

    Attributes:
        u_D: Values on Γ0, seen from the cells.
        alpha: Obstacle on Γ1, seen from the cells.
        scale: Size of the values.
        goal: What ‖∇ℓ‖ need not be known better than.
        highest: The largest κ.
        masses: What E has of terms without gradients.
    """

    u_D: OnParts
    alpha: OnParts
    scale: float
    goal: float
    highest: float
    masses: Masses | None = None

    def contradictions(self, cells: Cells, v: FloatArray) -> list[str | None]:
        """Tell which data no function can satisfy, from v at the vertices; this rank's facets."""
        fixed, contact, u_D, alpha = self.u_D.side, self.alpha.side, self.u_D, self.alpha
        jump = np.abs(v[fixed.ends] - u_D.ends)
        below = alpha.ends - alpha.signs * v[contact.ends]
        jumps = differs(cells, fixed, jump, self.scale, *u_D.traces)
        is_below = differs(cells, contact, below, self.scale, *u_D.traces, *alpha.traces)
        return [JUMP if jumps else None, BELOW if is_below else None]

    def lifted(
        self, cells: Cells, flux: Flux, v: FloatArray, bumps: FloatArray, thirds: FloatArray
    ) -> tuple[FloatArray, Lifted, list[str | None]]:
        """Bring what u_D and α have beyond v into the cells; collective.

        Returns:
            `Companion.contact`, `Companion.lift`, and why there are none.
        """
        fixed, contact = self.u_D.side, self.alpha.side
        lifts = [
            joined([_lift(cells, part, v, bumps, thirds, self, obstacle) for part in data.parts])
            for data, obstacle in ((self.u_D, False), (self.alpha, True))
        ]
        # y·n is constant on a facet: the mean of v + ℓ − α
        signs = self.alpha.signs
        above = signs * v[contact.ends].mean(axis=0) - lifts[1].least
        if cells.tdim == 2:
            above += signs * 2.0 / 3.0 * bumps[contact.dofs]
        above += lifts[1].beyond / measures(cells, contact)
        force = flux.contact if flux.carried is None else flux.contact + flux.carried
        return (
            np.where(force > 0, force * np.maximum(above, 0.0), 0.0),
            (
                np.concatenate([fixed.cells, contact.cells]),
                np.concatenate([lift.steep for lift in lifts]),
                np.concatenate([lift.area for lift in lifts]),
                lifts[1].edge,
            ),
            [lift.reason for lift in lifts],
        )


def _at_vertices(
    functional: Functional, u_D: OnParts, floors: Floors, flux: Flux, on_obstacle: bool
) -> tuple[FloatArray, BoolArray]:
    """Average u_h at vertices, weighted by what it costs to leave its values; or take α, β, u_D.

    Returns:
        They, and on which facets of Γ1 they are α or β at both ends, and the bump should be theirs.
    """
    cells, w, kappa, masses = functional.cells, functional.w, functional.kappa, functional.masses
    index_map = cells.domain.mesh.topology.index_map(0)
    size = index_map.size_local + index_map.num_ghosts
    flat = cells.vertices.ravel()

    def collect(where: Any, values: Any) -> FloatArray:
        return cells.share(np.bincount(where, values, minlength=size).astype(np.float64), 0)

    if kappa.ndim or masses.some:
        weights = np.tile(kappa + masses.reaction * cells.volume, (len(w), 1))
        moved = np.zeros_like(weights)
        for ends, toward in zip(cells.others[masses.side.local].T, masses.toward[:-1], strict=True):
            np.add.at(weights, (ends, masses.side.cells), masses.loss)
            np.add.at(moved, (ends, masses.side.cells), masses.loss * toward)
        v = cells.over_vertices(weights * w + moved)
        v /= np.maximum(cells.over_vertices(weights), np.finfo(float).tiny)
    else:
        v = cells.over_vertices(w)
        v /= np.maximum(collect(flat, None), 1.0)
    at_bound, loss = flux.touching.copy(), np.zeros(floors.facets)
    loss[masses.side.dofs] = masses.loss
    moving = None if on_obstacle else _moving(functional, floors)
    for sign, limit in floors.at_vertices:
        here = flux.touching & (floors.signs == sign)
        there = floors.side.ends[:, here]
        held = collect(there.ravel(), None) > 0
        if not on_obstacle and (masses.some or moving is not None):
            # what leaving t/b and u_h for α costs in ‖p − b‖², and what not doing so costs in 4C
            costs, of_force = (
                collect(there.ravel(), np.tile(each[here], len(there)))
                for each in (loss[floors.side.dofs], 2.0 * (cells.tdim + 1) * flux.contact)
            )
            if moving is not None:
                costs += moving
            held &= costs * np.where(held, sign * v - limit, 0.0) <= of_force
        at_bound[here] = held[there].all(axis=0)
        moved = np.where(held, limit, np.maximum(sign * v, limit))
        np.copyto(v, sign * moved, where=limit > -np.inf)
    ends = u_D.side.ends.ravel()
    count = collect(ends, None)
    np.copyto(v, collect(ends, u_D.ends.ravel()) / np.maximum(count, 1.0), where=count > 0)
    return v, at_bound


def _moving(functional: Functional, floors: Floors) -> FloatArray | None:
    """Estimate (d + 1) times what moving v by Δ costs, over Δ², by vertex; or None for nothing.

    On thin cells and next to kinks of α; elsewhere what u_h has at the vertices of facets in
    contact is near α.
    """
    cells = functional.cells
    if cells.tdim != 2:
        return None
    shares = np.zeros(cells.number)
    shares[floors.side.cells[floors.kinked]] = ALONE
    shares[cells.diameter2 > THIN * cells.volume] = SHARED
    if not cells.comm.allreduce(bool(shares.any()), op=MPI.LOR):
        return None
    squares = shares * functional.kappa * cells.squares(slice(0, cells.number))
    return (cells.tdim + 1) * cells.over_vertices(squares)


def bend_squares(cells: Cells, height: FloatArray, block: slice) -> FloatArray:
    """Compute what ‖∇φ‖²_T of φ = Σ height_i b_i has beyond that of its mean; d = 2, shape (n,).

    The mean of ∇b_i is −4/3 ∇λ_i.
    """
    out = np.zeros(height.shape[1])
    squares = 3.0 * height**2
    for (i, j), s in zip(cells.pairs, cells.stiffness[:, block], strict=True):
        apart = height[i] - height[j]
        apart *= apart
        apart += squares[3 - i - j]
        apart *= s
        out += apart
    out *= -8 / 9
    return out


def on_facet(
    cells: Cells,
    side: BoundaryFacets,
    hats: FloatArray,
    v: FloatArray,
    bumps: FloatArray,
    thirds: FloatArray | None = None,
) -> FloatArray:
    """Evaluate v at points of facets, shape (q, n).

    Args:
        cells: The mesh.
        side: The facets.
        hats: Barycentric coordinates, shape (q, d) or (q, d, n).
        v: v at the vertices.
        bumps: Heights of v's bumps.
        thirds: Those of its cubics; None where it has none.
    """
    hats = hats if hats.ndim == 3 else hats[:, :, None]
    values = (hats * v[side.ends]).sum(axis=1)
    if cells.tdim == 2:
        height, product = 4.0 * bumps[side.dofs], hats.prod(axis=1)
        if thirds is not None:
            third = cells.ways_between(*side.ends) * thirds[side.dofs]
            height = height + third * (hats[:, 0] - hats[:, 1])
        values = values + product * height
    return values


def _lift(
    cells: Cells,
    data: OnFacets,
    v: FloatArray,
    bumps: FloatArray,
    thirds: FloatArray,
    boundary: Prescribed,
    obstacle: bool,
) -> Lift:
    """Bring what u_D or α have beyond v into the cells."""
    side, trace, ends, middle = data.side(cells), data.trace, data.ends, data.middle
    v = data.sign * v[side.ends]
    if cells.tdim != 2:
        return affine(cells, side, trace, v, ends, boundary.scale)
    third = cells.ways_between(*side.ends) * (data.sign * thirds[side.dofs])
    companion = Cubic(v, data.sign * bumps[side.dofs], third)
    base, lossy = None, data.condition.loss
    loss = 0.0 if lossy is None else as_number(lossy)
    if loss is None:
        assert boundary.masses is not None
        loss = boundary.masses.largest(cells, side)
    if obstacle and len(data.condition.bounds) == 1 and loss == 0.0:
        base = Cubic(ends, middle - ends.mean(axis=0), third)
    more = boundary.scale, boundary.goal, obstacle, loss / boundary.highest
    found = lift(cells, side, trace, base, companion, *more)
    if base is not None:  # where α has a kink v need not be above α_I
        found.steep[kinked(data)] = np.inf
    if base is None or not cells.total(float(np.sum(found.steep**2)))[0] > boundary.goal**2:
        return found
    # α may be far above its interpolant, where it has a kink, and v above α
    return cheaper(found, lift(cells, side, trace, None, companion, *more))
