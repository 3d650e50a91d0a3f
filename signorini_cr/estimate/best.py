"""The best v of degree 2, solved for where it promises much; see `nearest`, and `cusps`."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..arrays import BoolArray, FloatArray, IndexArray
from ..fem.cells import Cells
from .cusps import Cusps
from .draft import Draft, Floors
from .functional import Functional, Slopes
from .heights import curvatures
from .nearest import LARGEST, nearest

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


def solved(
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
) -> tuple[tuple[FloatArray, FloatArray, Cusps | None], float, bool]:
    """Solve for v in rounds, each for the values that promise most, and those around; collective.

    Args:
        functional: What v is to make small.
        draft: v to begin with, and what of it may be changed.
        floors: What the bounds ask of v.
        promise: What values promise.
        layers: How many layers of cells around them; None for all of the mesh.

    Returns:
        As `solved`, E, and whether v is settled, as far as more of the mesh would make it so.
    """
    cells, kappa, bounded = functional.cells, functional.kappa, floors.side.dofs
    v, bumps, free_vertices, free_facets = (
        draft.vertices,
        draft.bumps,
        draft.free_vertices,
        draft.free_facets,
    )
    excess = functional.excess(v)
    slopes = Slopes.of(functional, excess, bumps)
    cusps: Cusps | None = None
    near = promise.near(slopes, free_vertices, free_facets, layers)
    if near is not None:
        # v is good enough but for some places; elsewhere cusps would be for what v is to become
        cusps = Cusps.of(cells, kappa, functional.steady, slopes.energies)
        cusps = _fitted(functional, cusps, excess, bumps, slopes)
    best, least = (v, bumps, cusps), cells.total(np.sum(slopes.energies))[0]
    local = falling = False
    for turn in range(ROUNDS):
        if turn > 0:
            near = promise.near(slopes, free_vertices, free_facets, layers)
        local |= near is not None
        some, heights, at = near or (free_vertices, free_facets, slice(None))
        step = nearest(cells, kappa, slopes, some, heights, functional.masses)
        v, bumps, free_facets = v + step[0], bumps + step[1], free_facets.copy()
        down = np.zeros_like(free_vertices)
        for sign, limit in floors.at_vertices:
            down |= some & (sign * v <= limit)
            v = np.where(some, sign * np.maximum(sign * v, limit), v)
        low, high = floors.heights(v)
        out = np.unique(bounded[heights[bounded] & ((bumps <= low) | (bumps >= high))[bounded]])
        # also where they are held since an earlier round: the facet's ends may have come down
        bumps[bounded] = np.clip(bumps, low, high)[bounded]
        free_facets[out] = False
        free_vertices = free_vertices & ~down
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
    if not local:
        return best, least, True
    return (
        best,
        least,
        not falling and promise.total(slopes, free_vertices, free_facets) <= LEFT * least,
    )


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
        return cls(functional.cells, *curvatures(functional))

    def of_values(
        self, slopes: Slopes, free_vertices: BoolArray, free_facets: BoolArray
    ) -> tuple[FloatArray, FloatArray]:
        """Compute what each value promises, ghosts included; collective.

        Args:
            slopes: Those of v.
            free_vertices: Which values at vertices may be changed.
            free_facets: Which heights may be changed.

        Returns:
            By vertex and by facet dof.
        """
        cells = self.cells
        promises = cells.over_vertices(slopes.vertices), cells.over_facets(slopes.facets)
        for promise, weight, may in zip(
            promises, (self.vertices, self.facets), (free_vertices, free_facets), strict=True
        ):
            promise *= promise
            promise /= weight
            promise *= may
        return promises

    def total(self, slopes: Slopes, free_vertices: BoolArray, free_facets: BoolArray) -> float:
        """Sum what all of them promise; collective."""
        vertices, facets = self.of_values(slopes, free_vertices, free_facets)
        own = (
            vertices[: self.cells.owned_vertices()].sum()
            + facets[: self.cells.owned_facets()].sum()
        )
        return float(self.cells.total(float(own))[0])

    def near(
        self, slopes: Slopes, free_vertices: BoolArray, free_facets: BoolArray, layers: int | None
    ) -> tuple[BoolArray, BoolArray, IndexArray] | None:
        """Choose values that are worth being solved for; collective.

        They are those that hold `FOREMOST` of all promise, and all within some layers around them.

        Args:
            slopes: Those of v.
            free_vertices: Which values at vertices may be changed.
            free_facets: Which heights may be changed.
            layers: How many layers of cells around them; None for all.

        Returns:
            Which of them are to be, and the cells of this rank that know of these; None if that is
            most of the mesh, or nothing is promised.
        """
        if layers is None:
            return None
        cells = self.cells
        owned = cells.owned_vertices(), cells.owned_facets()
        promises = self.of_values(slopes, free_vertices, free_facets)
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
        there = np.zeros(len(free_facets), dtype=bool)
        for facet, (j, k) in zip(facets, cells.others, strict=True):
            there[facet[inside[j] | inside[k]]] = True
        return free_vertices & chosen, free_facets & there, at


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
