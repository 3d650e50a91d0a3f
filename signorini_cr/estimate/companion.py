"""A conforming function near u_h: the primal half of the certificate.

v is continuous, v = u_D on Γ0 and v ≥ α on Γ1. It is P1 with the means of u_h's vertex values,
weighted by κ, plus (for d = 2) a quadratic bump b_F = 4 λ_j λ_k on each facet, whose heights are
found by sweeps that bring ∇v nearer to ∇u_h. Where that leaves much to be gained, v is found by
solving for it, see `nearest`, around the points where it is, or on all of the mesh if that is
everywhere; single vertices that hold much of what is left get `cusps`.
What u_D and α have beyond quadratic polynomials goes into a lifting ℓ in the boundary cells, of
which the norm is known. `docs/certificate.md` has the mathematics.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..arrays import BoolArray, FloatArray, IndexArray
from ..data.admissible import differs
from ..data.moments import OnFacets, OnParts
from ..fem.cells import BoundaryFacets, Cells, blocks, dot_rows, measures, pick, sum_rows
from ..fem.conditions import number
from .cusps import Cusps
from .descent import descend, nonzero
from .flux import Flux
from .functional import Functional, Masses, Slopes
from .lifting import Cubic, Lift, affine, joined, lift
from .nearest import LARGEST, nearest
from .shapes import bump_slopes, local_thirds, third_slopes

Lifted = tuple[IndexArray, FloatArray, FloatArray, FloatArray]

JUMP = "u_D jumps where boundary facets meet: no function of finite energy has such values"
BELOW = "u_D is below α where Γ0 meets Γ1: no function satisfies both"

PROMISE = 0.04
"""Part of ‖κ^{1/2}(∇v − ∇u_h)‖² that a step must promise to take off for v to be solved for.

A sweep leaves 0.005 to 0.03 on ordinary meshes with a smooth coefficient, also around a singular
point; 0.05 on fine meshes where there are several, 0.07 where the coefficient is a checkerboard,
and 0.2 and more on thin cells.
"""

FOREMOST = 0.9
"""Part of all promise that the values have around which v is solved for.

On a mesh of a polygon with re-entrant corners 20 of 270,000 vertices have 0.95. More than this, or
more layers, take longer, and bring the bound down by 0.2 to 0.4 %.
"""

LAYERS = 12
"""How many layers of cells around these are solved for."""

ROUNDS = 3
"""How often v is solved for; after each time but the last what is below α is held there, and what
promises most then may be elsewhere."""

LITTLE = 0.01
"""Part of E that a round around some points has to take off for another one to be worth it."""


MUCH = 0.1
"""Part of E that the last round takes off where v needs to be solved for on all of the mesh: 0.01
on ordinary meshes with singular points, 0.2 to 0.5 on thin cells."""

LEFT = 0.04
"""Part of E that single values may promise in the end. That is 0.005 and less on ordinary meshes,
0.2 on thin cells where v needs to be solved for on all of the mesh."""


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
    """

    vertices: FloatArray
    bumps: FloatArray
    excess: FloatArray
    contact: FloatArray
    lift: Lifted
    reason: str | None
    boundary: Boundary
    cusps: Cusps | None = None
    thirds: FloatArray | None = None

    def slopes(self, cells: Cells, where: slice | IndexArray) -> Callable[[FloatArray], FloatArray]:
        """∇(v − u_h) without cusps, as γ_i with ∇(v − u_h) = Σ γ_i ∇λ_i, as a function.

        Args:
            cells: The mesh.
            where: Which cells.

        Returns:
            A function of a point's barycentric coordinates, shape (d + 1, 1) or (d + 1, n); its
            values are of shape (d + 1, n).
        """
        excess, height, third = self.excess[:, where], None, None
        if cells.tdim == 2:
            height = self.bumps[cells.facets[:, where]]
        if self.thirds is not None:
            third = local_thirds(cells, self.thirds, where)

        def at(hat: FloatArray) -> FloatArray:
            gamma = excess if height is None else excess + bump_slopes(cells, height, hat)
            return gamma if third is None else gamma + third_slopes(cells, third, hat)

        return at


@dataclass(frozen=True, eq=False)
class Floors:
    """What the bounds ask of v: s v is not below the quadratic through three values on each facet.

    Attributes:
        side: The facets of Γ1, once for each bound.
        signs: s, shape (n,).
        ends: The bounds at their ends, shape (d, n).
        middle: At their midpoints, shape (n,).
        at_vertices: The values of s, and for each the largest bound at each vertex, −∞ for none:
            where parts with obstacles of their own meet, the higher one counts.
        strong: Where v is drawn to t/b, as near to u as α is: there s v is not below α at the
            middle, either, and no more is asked for, shape (n,).
        facets: Number of facets.
    """

    side: BoundaryFacets
    signs: FloatArray
    ends: FloatArray
    middle: FloatArray
    at_vertices: tuple[tuple[int, FloatArray], ...]
    strong: BoolArray
    facets: int

    @classmethod
    def of(cls, cells: Cells, bounds: OnParts, masses: Masses) -> Floors:
        """Collect them; collective."""
        side, signs, ends = bounds.side, bounds.signs, bounds.ends
        limits = []
        for sign in sorted({each.sign for each in bounds.parts}, reverse=True):
            here = signs == sign
            limits.append((sign, cells.largest_at_vertices(side.ends[:, here], ends[:, here])))
        strong = np.zeros(len(cells.exterior), dtype=bool)
        strong[masses.side.dofs] = masses.strong
        # to a bound that is a number no lifting brings v
        curved = [np.full(len(p.middle), p.trace.constant is None) for p in bounds.parts]
        strong = strong[side.dofs] & np.concatenate([np.empty(0, dtype=bool), *curved])
        return cls(side, signs, ends, bounds.middle, tuple(limits), strong, len(cells.exterior))

    def heights(self, v: FloatArray) -> tuple[FloatArray, FloatArray]:
        """The least and the largest heights of bumps that they allow for, by facet dof.

        Args:
            v: v at the vertices, within the bounds.
        """
        above = self.signs * v[self.side.ends]
        least = np.where(
            self.strong,
            self.middle - above.mean(axis=0),
            _lowest(above, self.ends, self.middle),
        )
        low, high = np.full(self.facets, -np.inf), np.full(self.facets, np.inf)
        up = self.signs > 0.0
        low[self.side.dofs[up]] = least[up]
        high[self.side.dofs[~up]] = -least[~up]
        return low, high


def _lowest(v: FloatArray, obstacle: FloatArray, middle: FloatArray) -> FloatArray:
    """Least heights of the bumps with which v stays above the quadratic through α's three values.

    Args:
        v: At the facets' ends, not below α, shape (2, n).
        obstacle: α there.
        middle: α at the midpoints, shape (n,).
    """
    room: FloatArray = np.sqrt(np.maximum(v - obstacle, 0.0)).sum(axis=0) ** 2 / 4
    return middle - obstacle.mean(axis=0) - room


def companion(
    functional: Functional,
    flux: Flux,
    u_D: OnParts,
    alpha: OnParts,
    sweeps: int,
    goal: float,
    highest: float,
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
    """
    cells, floors = functional.cells, Floors.of(functional.cells, alpha, functional.masses)
    draft = _started(functional, u_D, floors, flux)
    largest = max(1e-300, float(np.abs(draft.vertices).max(initial=0.0)))
    scale = max(cells.comm.allgather(largest))
    boundary = Boundary(u_D, alpha, scale, goal, highest, functional.masses)
    wrong = boundary.contradictions(cells, draft.vertices)
    excess, cusps = functional.excess(draft.vertices), None
    if cells.tdim == 2 and sweeps > 0:
        poor = _improved(functional, draft, excess, u_D.side, floors, sweeps)
        if poor:
            draft.vertices, draft.bumps, cusps = _solved(functional, draft, floors)
            excess = functional.excess(draft.vertices)
    above, lifts, reasons = boundary.lifted(
        cells, flux, draft.vertices, draft.bumps, np.zeros(len(draft.bumps))
    )
    words = [word for rank in cells.comm.allgather(wrong + reasons) for word in rank if word]
    reason = words[0] if words else None
    return Companion(draft.vertices, draft.bumps, excess, above, lifts, reason, boundary, cusps)


@dataclass(eq=False)
class Draft:
    """v on the way.

    Attributes:
        vertices: v at the vertices, ghosts included.
        bumps: Heights of v's bumps by facet dof, ghosts included.
        loose: Which values at vertices may be changed.
        free: Which heights may be changed.
    """

    vertices: FloatArray
    bumps: FloatArray
    loose: BoolArray
    free: BoolArray


def _started(functional: Functional, u_D: OnParts, floors: Floors, flux: Flux) -> Draft:
    """Make a v that is admissible, with bumps where data ask for them; collective.

    Args:
        functional: What v is to make small.
        u_D: Values on Γ0, seen from the cells.
        floors: What the bounds ask of v.
        flux: y, which knows where there is contact.
    """
    cells, fixed, contact = functional.cells, u_D.side, floors.side
    v, touching = _at_vertices(functional, u_D, floors, flux)
    held = np.zeros(len(v))
    held[fixed.ends] = held[contact.ends[:, touching]] = 1.0
    bumps, taken = np.zeros((2, floors.facets))
    if cells.tdim == 2:
        low, high = (limit[contact.dofs] for limit in floors.heights(v))
        bumps[contact.dofs] = np.clip(0.0, low, high)
        bumps[fixed.dofs] = u_D.middle - v[fixed.ends].mean(axis=0)
        ends = np.where(floors.signs > 0.0, low, high)
        bumps[contact.dofs[touching]] = ends[touching]
        taken[fixed.dofs] = taken[contact.dofs[touching]] = 1.0
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
    energy, promise = _sweep(functional, excess, bumps, draft.free, (fixed, contact), sweeps)
    low, high = (limit[contact.dofs] for limit in floors.heights(draft.vertices))
    bumps[contact.dofs] = np.clip(bumps[contact.dofs], low, high)
    promise += _promise(functional, excess, bumps, draft.loose)
    return promise > PROMISE * energy


@dataclass(frozen=True, eq=False)
class Boundary:
    """What v has to be on Γ0 and above on Γ1.

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
    functional: Functional, u_D: OnParts, floors: Floors, flux: Flux
) -> tuple[FloatArray, BoolArray]:
    """Means of u_h's values at the vertices, weighted by what it costs to leave them; α, β, u_D.

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
    for sign, limit in floors.at_vertices:
        here = flux.touching & (floors.signs == sign)
        there = floors.side.ends[:, here]
        held = collect(there.ravel(), None) > 0
        if masses.some:
            # what leaving t/b for α costs in ‖p − b‖², and what not doing so costs in 4C
            of_b, of_force = (
                collect(there.ravel(), np.tile(each[here], len(there)))
                for each in (loss[floors.side.dofs], 2.0 * (cells.tdim + 1) * flux.contact)
            )
            held &= of_b * np.where(held, sign * v - limit, 0.0) <= of_force
        at_bound[here] = held[there].all(axis=0)
        moved = np.where(held, limit, np.maximum(sign * v, limit))
        np.copyto(v, sign * moved, where=limit > -np.inf)
    ends = u_D.side.ends.ravel()
    count = collect(ends, None)
    np.copyto(v, collect(ends, u_D.ends.ravel()) / np.maximum(count, 1.0), where=count > 0)
    return v, at_bound


def _solved(
    functional: Functional, draft: Draft, floors: Floors
) -> tuple[FloatArray, FloatArray, Cusps | None]:
    """Solve for the best v of degree 2, with cusps where they are called for; collective.

    First around the values that promise most. Where v is still far from the best then, on the whole
    mesh: in thin cells one value may hang on many, and cusps that were found with a v that is not
    what it is to become may be in the way.

    Args:
        functional: What v is to make small.
        draft: v to begin with, and what of it may be changed.
        floors: What the bounds ask of v.

    Returns:
        v at the vertices, the heights, and the cusps.
    """
    promise = Promise.of(functional)
    best, least, settled = _best(functional, draft, floors, promise, LAYERS)
    if not settled:
        other, energy, _ = _best(functional, draft, floors, promise, None)
        if energy < least:
            best = other
    return best


def _best(
    functional: Functional, draft: Draft, floors: Floors, promise: Promise, layers: int | None
) -> tuple[tuple[FloatArray, FloatArray, Cusps | None], float, float]:
    """Solve for v in rounds, each for the values that promise most, and those around; collective.

    Args:
        functional: What v is to make small.
        draft: v to begin with, and what of it may be changed.
        floors: What the bounds ask of v.
        promise: What values promise.
        layers: How many layers of cells around them; None for all of the mesh.

    Returns:
        As `_solved`, E, and whether v is settled.
    """
    cells, kappa, bounded = functional.cells, functional.kappa, floors.side.dofs
    v, bumps, loose, free = draft.vertices, draft.bumps, draft.loose, draft.free
    excess = functional.excess(v)
    slopes = Slopes.of(functional, excess, bumps)
    cusps: Cusps | None = None
    near = promise.near(slopes, loose, free, layers)
    if near is not None:
        # v is good enough but for some places; elsewhere cusps would be for what v is to become
        cusps = Cusps.of(cells, kappa, functional.steady, slopes.energies)
        cusps = _fitted(functional, cusps, excess, bumps, slopes)
    best, least = (v, bumps, cusps), cells.total(np.sum(slopes.energies))[0]
    for turn in range(ROUNDS):
        if turn > 0:
            near = promise.near(slopes, loose, free, layers)
        some, heights, at = near or (loose, free, slice(None))
        step = nearest(cells, kappa, slopes, some, heights, functional.masses)
        v, bumps, free = v + step[0], bumps + step[1], free.copy()
        down = np.zeros_like(loose)
        for sign, limit in floors.at_vertices:
            down |= some & (sign * v <= limit)
            v = np.where(some, sign * np.maximum(sign * v, limit), v)
        low, high = floors.heights(v)
        out = np.unique(bounded[heights[bounded] & ((bumps <= low) | (bumps >= high))[bounded]])
        # also where they are held since an earlier round: the facet's ends may have come down
        bumps[bounded] = np.clip(bumps, low, high)[bounded]
        free[out] = False
        loose = loose & ~down
        if cusps is not None and not isinstance(at, slice):
            at = np.union1d(at, cusps.at)
        excess[:, at] = v[cells.vertices[:, at]] - functional.w[:, at]
        slopes.renew(functional, excess, bumps, at)
        if turn == 0:  # where v is good otherwise
            cusps = Cusps.of(cells, kappa, functional.steady, slopes.energies)
        cusps = _fitted(functional, cusps, excess, bumps, slopes)
        energy, changes = cells.total(np.sum(slopes.energies), float(len(out) + down.sum()))
        settled = near is None or energy > (1.0 - LITTLE) * least
        falling = near is not None and energy < (1.0 - MUCH) * least
        if energy < least:
            best, least = (v, bumps, cusps), energy
        if settled and changes == 0.0 and cusps is None:
            break
    little = promise.total(slopes, loose, free) <= LEFT * least
    return best, least, little and not falling


def _fitted(
    functional: Functional,
    cusps: Cusps | None,
    excess: FloatArray,
    bumps: FloatArray,
    slopes: Slopes,
) -> Cusps | None:
    """Find the best heights of cusps, and add what these do to E and its slopes; collective.

    Args:
        functional: E.
        cusps: The cusps, if there are any.
        excess: v − u_h at the cells' vertices without bumps and cusps, shape (3, cells).
        bumps: Heights of v's bumps by facet dof.
        slopes: Those of v without cusps, changed in place.
    """
    if cusps is None:
        return None
    cells = functional.cells
    cusps = cusps.fitted(cells, excess, bumps)
    slopes.energies[cusps.at] += cusps.gains(cells, excess, bumps)
    for rows, pull in zip((slopes.vertices, slopes.facets), cusps.pulls(cells), strict=True):
        rows[:, cusps.at] -= pull
    return cusps


@dataclass(frozen=True, eq=False)
class Promise:
    """What E falls by if one value is put right as if it were alone: its slope's square over this.

    Attributes:
        cells: The mesh.
        vertices: ½ ∂²E by values at vertices, ghosts included.
        facets: The same by heights of bumps.
    """

    cells: Cells
    vertices: FloatArray
    facets: FloatArray

    @classmethod
    def of(cls, functional: Functional) -> Promise:
        """Make it; collective."""
        cells, masses = functional.cells, functional.masses
        squares = np.empty((3, cells.number))
        for part in blocks(cells.number):
            squares[:, part] = pick(functional.kappa, part) * cells.squares(part)
        traces = np.tile(4 / 3 * sum_rows(squares), (3, 1))
        if masses.reacts:
            mass = masses.on_cells(cells, slice(0, cells.number))
            squares += mass / 6.0
            traces += 8.0 / 45.0 * mass
        side = masses.side
        np.add.at(squares, (cells.others[side.local].T, side.cells), masses.loss / 3.0)
        np.add.at(traces, (side.local, side.cells), 8.0 / 15.0 * masses.loss)
        return cls(cells, nonzero(cells.over_vertices(squares)), nonzero(cells.over_facets(traces)))

    def of_values(
        self, slopes: Slopes, loose: BoolArray, free: BoolArray
    ) -> tuple[FloatArray, FloatArray]:
        """What each value promises, ghosts included; collective.

        Args:
            slopes: Those of v.
            loose: Which values at vertices may be changed.
            free: Which heights may be changed.

        Returns:
            By vertex and by facet dof.
        """
        cells = self.cells
        promises = cells.over_vertices(slopes.vertices), cells.over_facets(slopes.facets)
        for promise, weight, may in zip(
            promises, (self.vertices, self.facets), (loose, free), strict=True
        ):
            promise *= promise
            promise /= weight
            promise *= may
        return promises

    def total(self, slopes: Slopes, loose: BoolArray, free: BoolArray) -> float:
        """What all of them promise; collective."""
        vertices, facets = self.of_values(slopes, loose, free)
        own = (
            vertices[: self.cells.owned_vertices()].sum()
            + facets[: self.cells.owned_facets()].sum()
        )
        return float(self.cells.total(float(own))[0])

    def near(
        self, slopes: Slopes, loose: BoolArray, free: BoolArray, layers: int | None
    ) -> tuple[BoolArray, BoolArray, IndexArray] | None:
        """Choose values that are worth being solved for; collective.

        They are those that hold `FOREMOST` of all promise, and all within some layers around them.

        Args:
            slopes: Those of v.
            loose: Which values at vertices may be changed.
            free: Which heights may be changed.
            layers: How many layers of cells around them; None for all.

        Returns:
            Which of them are to be, and the cells of this rank that know of these; None if that is
            most of the mesh, or nothing is promised.
        """
        if layers is None:
            return None
        cells = self.cells
        owned = cells.owned_vertices(), cells.owned_facets()
        promises = self.of_values(slopes, loose, free)
        limit = _limit(cells, *(p[:n] for p, n in zip(promises, owned, strict=True)))
        chosen, much = (promise > limit for promise in promises)
        local, at = np.nonzero(much[cells.facets])
        chosen[cells.vertices[cells.others[local].T, at]] = True
        chosen = cells.around(chosen, layers)
        few, all_ = cells.total(float(np.count_nonzero(chosen[: owned[0]])), float(owned[0]))
        if not 0.0 < few <= LARGEST * all_:
            return None
        at = np.flatnonzero(chosen[cells.vertices].any(axis=0))
        facets, inside = cells.facets[:, at], chosen[cells.vertices[:, at]]
        there = np.zeros(len(free), dtype=bool)
        for facet, (j, k) in zip(facets, cells.others, strict=True):
            there[facet[inside[j] | inside[k]]] = True
        return loose & chosen, free & there, at


def _limit(cells: Cells, *promises: FloatArray) -> float:
    """Return what those are above that hold `FOREMOST` of the whole; collective.

    Args:
        cells: The mesh.
        *promises: Those of this rank, shapes (n,).
    """
    largest = max(cells.comm.allgather(max(float(p.max(initial=0.0)) for p in promises)))
    if largest == 0.0:
        return 0.0
    total, number = cells.total(sum(p.sum() for p in promises), float(sum(map(len, promises))))
    # All that are below this together are no more than the rest; mostly that leaves few
    least = (1.0 - FOREMOST) * total / number
    some = np.concatenate([p[p > least] for p in promises])
    # By classes, each 2^{1/4} below the one before. None ends at a value that equals the largest
    # one, or that divided by a power of 2, but for rounding
    classes = (4.0 * np.log2(largest / some) + 0.37).astype(np.intp)
    held = cells.total(*np.bincount(classes, some, minlength=256))
    last = int(np.searchsorted(np.cumsum(held), FOREMOST * total))
    return float(largest * 2.0 ** ((0.37 - last - 1) / 4.0))


def _sweep(
    functional: Functional,
    excess: FloatArray,
    bumps: FloatArray,
    free: BoolArray,
    bumped: tuple[BoundaryFacets, ...],
    steps: int,
) -> tuple[float, float]:
    """Make E smaller by conjugate gradients in the heights of the bumps; collective.

    Args:
        functional: E.
        excess: v − u_h at the cells' vertices without the bumps, shape (d + 1, cells).
        bumps: Heights, improved in place.
        free: Which of them may be.
        bumped: The facets on which there are some to begin with.
        steps: How many steps.

    Returns:
        E, and what it would fall by if each height were put right as if it were alone.
    """
    cells, held = functional.cells, np.flatnonzero(~free)
    matrix = _OfHeights(functional)
    energy, local = matrix.without_bumps(excess)
    energy += matrix.with_bumps(bumps, bumped, local)

    def assembled(local: FloatArray) -> FloatArray:
        out = cells.over_facets(local)
        out[held] = 0.0
        return out

    def image(way: FloatArray) -> FloatArray:
        matrix.multiply(way, local)
        return assembled(local)

    down = assembled(local)
    fall, square = descend(cells, image, bumps, down, matrix.diagonal(), steps)
    return float(cells.total(energy)[0] - 4 / 3 * fall), float(4 / 3 * square)


class _OfHeights:
    """E as a quadratic functional of the heights of bumps, in units of 4/3.

    On a cell its matrix is 2κ|T| ∇λ_i·∇λ_j outside the diagonal and κ|T| Σ|∇λ_k|² on it, and to
    each entry c|T|/15 is added, on the diagonal twice.

    Attributes:
        functional: E.
        own: κ|T| Σ|∇λ_k|² + c|T|/15, shape (cells,).
        lost: What b adds to the diagonal, by facet dof.
        at: Local numbers and cells of the facets with a b.
    """

    def __init__(self, functional: Functional):
        """Take what is on the diagonal."""
        cells, masses = functional.cells, functional.masses
        self.functional, self.own = functional, np.empty(cells.number)
        self.lost = np.zeros(len(cells.exterior))
        self.lost[masses.side.dofs] = 0.4 * masses.loss
        self.at = masses.side.local, masses.side.cells
        self._reacts = masses.reacts
        for part in blocks(cells.number):
            self.own[part] = pick(functional.kappa, part) * cells.trace(part)
            if self._reacts:
                self.own[part] += masses.on_cells(cells, part) / 15.0

    def without_bumps(self, excess: FloatArray) -> tuple[float, FloatArray]:
        """Return E for no bumps, this rank's share, and −½ its slope on each cell.

        Args:
            excess: v − u_h at the cells' vertices, shape (3, cells).
        """
        cells, kappa, masses = self.functional.cells, self.functional.kappa, self.functional.masses
        slope, energy = np.empty_like(excess), 0.0
        for part in blocks(cells.number):
            k = pick(kappa, part)
            np.multiply(k, cells.apply(excess[:, part], part), out=slope[:, part])
            energy += float(np.sum(dot_rows(excess[:, part], slope[:, part])))
            if self._reacts:
                mass = masses.on_cells(cells, part)
                energy += float(np.sum(mass * distance(excess[:, part], None)))
                slope[:, part] += masses.pull(cells, excess[:, part], part)
        first, last, height = masses.toward
        ends = excess[cells.others[masses.side.local].T, masses.side.cells] - (first, last)
        energy += float(np.sum(masses.loss * distance(ends, None)))
        energy += float(masses.loss @ (8 / 15 * height**2 - 2 / 3 * height * ends.sum(axis=0)))
        np.add.at(slope, self.at, masses.pull_on_facets(excess, cells.others))
        return energy, slope

    def with_bumps(
        self, bumps: FloatArray, bumped: tuple[BoundaryFacets, ...], slope: FloatArray
    ) -> float:
        """Return what E changes by with some bumps, this rank's share.

        Args:
            bumps: Heights by facet dof.
            bumped: The facets on which there are some.
            slope: −½ E's slope on each cell, shape (3, cells), changed in place.
        """
        cells, side = self.functional.cells, self.functional.masses.side
        near = np.unique(np.concatenate([each.cells for each in (*bumped, side)]))
        flow, height = slope[:, near], bumps[cells.facets[:, near]]
        change = self._times(height, near, np.empty_like(height))
        slope[:, near] = flow - change
        energy = -4 / 3 * float(np.sum(dot_rows(height, 2.0 * flow - change)))
        lost, height = self.lost[side.dofs], bumps[side.dofs]
        np.subtract.at(slope, self.at, lost * height)
        return energy + 4 / 3 * float(np.sum(lost * height**2))

    def multiply(self, heights: FloatArray, out: FloatArray) -> None:
        """Put the cells' matrices times heights by facet dof into an array, shape (3, cells)."""
        cells, side = self.functional.cells, self.functional.masses.side
        for part in blocks(cells.number):
            self._times(heights[cells.facets[:, part]], part, out[:, part])
        np.add.at(out, self.at, self.lost[side.dofs] * heights[side.dofs])

    def _times(self, height: FloatArray, part: slice | IndexArray, out: FloatArray) -> FloatArray:
        """Put the matrices, but for b, times heights of local bumps into an array."""
        cells, own = self.functional.cells, self.own[part]
        twice, stiffness = 2.0 * pick(self.functional.kappa, part), cells.stiffness[:, part]
        for i, (j, k) in enumerate(cells.others):
            row = np.multiply(stiffness[i + j - 1], height[j], out=out[i])
            row += stiffness[i + k - 1] * height[k]
            row *= twice
            row += own * height[i]
        if self._reacts:
            mass = self.functional.masses.on_cells(cells, part)
            out += mass / 15.0 * sum_rows(height)
        return out

    def diagonal(self) -> FloatArray:
        """The diagonal by facet dof; collective."""
        cells = self.functional.cells
        local = np.tile(self.own, (3, 1))
        if self._reacts:
            local += self.functional.masses.on_cells(cells, slice(0, cells.number)) / 15.0
        np.add.at(local, self.at, self.lost[self.functional.masses.side.dofs])
        return nonzero(cells.over_facets(local))


def distance(c: FloatArray, height: FloatArray | None) -> FloatArray:
    """Means of (v − u_h)² over simplices of one, two or three dimensions, shape (n,).

    Args:
        c: v − u_h at the vertices, shape (k, n).
        height: Heights of v's bumps on triangles, shape (3, n), if there are any.
    """
    k, total = len(c), sum_rows(c)
    out = (total**2 + dot_rows(c, c)) / (k * (k + 1))
    if height is not None:
        whole = sum_rows(height)
        out += (4.0 * total * whole - 2.0 * dot_rows(c, height)) / 15.0
        out += 4.0 * (whole**2 + dot_rows(height, height)) / 45.0
    return np.asarray(out)


def _promise(
    functional: Functional, excess: FloatArray, bumps: FloatArray, loose: BoolArray
) -> float:
    """Return what E would fall by if each vertex were put right alone.

    Args:
        functional: E.
        excess: v − u_h at the cells' vertices without the bumps, shape (d + 1, cells).
        bumps: Their heights.
        loose: Which values at vertices may be changed.
    """
    cells, kappa, masses = functional.cells, functional.kappa, functional.masses
    slope, diagonal = np.empty_like(excess), np.empty_like(excess)
    for part in blocks(cells.number):
        k, height = pick(kappa, part), bumps[cells.facets[:, part]]
        if masses.reacts:
            fall, _ = masses.fall(cells, excess[:, part], height, part)
        height *= -4 / 3
        height += excess[:, part]
        np.multiply(k, cells.apply(height, part), out=slope[:, part])
        np.multiply(k, cells.squares(part), out=diagonal[:, part])
        if masses.reacts:
            slope[:, part] -= fall
            diagonal[:, part] += masses.on_cells(cells, part) / 6.0
    ends = cells.others[masses.side.local].T, masses.side.cells
    np.subtract.at(slope, ends, masses.fall_on_facets(cells, excess, bumps, slice(None))[0])
    np.add.at(diagonal, ends, masses.loss / 3.0)
    owned = slice(cells.owned_vertices())
    down, weight = (cells.over_vertices(values)[owned] for values in (slope, diagonal))
    return float(cells.total(np.sum(down**2 * loose[owned] / weight))[0])


def bend_squares(cells: Cells, height: FloatArray, part: slice) -> FloatArray:
    """What ‖∇φ‖²_T of φ = Σ height_i b_i is more than that of its mean; d = 2, shape (n,).

    The mean of ∇b_i is −4/3 ∇λ_i.
    """
    out = np.zeros(height.shape[1])
    squares = 3.0 * height**2
    for (i, j), s in zip(cells.pairs, cells.stiffness[:, part], strict=True):
        apart = height[i] - height[j]
        apart *= apart
        apart += squares[3 - i - j]
        apart *= s
        out += apart
    out *= -8 / 9
    return out


def on_facet(
    cells: Cells, side: BoundaryFacets, hats: FloatArray, v: FloatArray, bumps: FloatArray
) -> FloatArray:
    """Values of v at points of facets, shape (q, n).

    Args:
        cells: The mesh.
        side: The facets.
        hats: Barycentric coordinates, shape (q, d) or (q, d, n).
        v: v at the vertices.
        bumps: Heights of v's bumps.
    """
    hats = hats if hats.ndim == 3 else hats[:, :, None]
    values = (hats * v[side.ends]).sum(axis=1)
    if cells.tdim == 2:
        values = values + 4.0 * hats.prod(axis=1) * bumps[side.dofs]
    return values


def _lift(
    cells: Cells,
    data: OnFacets,
    v: FloatArray,
    bumps: FloatArray,
    thirds: FloatArray,
    boundary: Boundary,
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
    loss = 0.0 if lossy is None else number(lossy)
    if loss is None:
        assert boundary.masses is not None
        loss = boundary.masses.largest(cells, side)
    if obstacle and len(data.condition.bounds) == 1 and loss == 0.0:
        base = Cubic(ends, middle - ends.mean(axis=0), third)
    ratio = loss / boundary.highest
    return lift(cells, side, trace, base, companion, boundary.scale, boundary.goal, obstacle, ratio)
