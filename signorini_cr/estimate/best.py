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
"""Layers of cells around these that are solved for."""

ROUNDS = 3
"""Times that v is solved for; after each but the last what is below α is held there, and what
promises most then may be elsewhere."""

LITTLE = 0.01
"""Part of E that a round around some points has to take off for another one to be worth it."""

MUCH = 0.1
"""Part of E that the last round takes off where v needs to be solved for on all of the mesh: 0.01
on ordinary meshes with singular points, 0.2 to 0.5 on thin cells."""

LEFT = 0.04
"""Part of E that single values may promise in the end. That is 0.005 and less on ordinary meshes,
0.2 on thin cells where v needs to be solved for on all of the mesh."""


Near = tuple[BoolArray, BoolArray, IndexArray]
"""Masks of the values at vertices and heights to solve for, and the cells that know of these."""


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
    cells, search = functional.cells, _Search.of(functional, draft, floors)
    near = promise.near(search.slopes, search.v, layers)
    if near is not None:
        # v is good enough but for some places; elsewhere cusps would be for what v is to become
        search.choose_cusps()
    best, least = search.found, cells.total(np.sum(search.slopes.energies))[0]
    local = falling = False
    for turn in range(ROUNDS):
        if turn > 0:
            near = promise.near(search.slopes, search.v, layers)
        held = search.solve(near)
        if turn == 0:  # where v is good otherwise
            search.choose_cusps()
        else:
            search.fit_cusps()
        energy, changes = cells.total(np.sum(search.slopes.energies), held)
        local |= near is not None
        settled = near is None or energy > (1.0 - LITTLE) * least
        falling = near is not None and energy < (1.0 - MUCH) * least
        if energy < least:
            best, least = search.found, energy
        if settled and changes == 0.0 and search.cusps is None:
            break
    if not local:
        return best, least, True
    left = promise.total(search.slopes, search.v)
    return best, least, not falling and left <= LEFT * least


@dataclass(eq=False)
class _Search:
    """v on the way from round to round.

    Attributes:
        functional: E.
        floors: What the bounds ask of v.
        v: v without cusps, and what of it may be changed.
        excess: v − u_h at the cells' vertices without bumps and cusps, shape (3, cells).
        slopes: Those of v with its cusps.
        cusps: These, if there are any.
    """

    functional: Functional
    floors: Floors
    v: Draft
    excess: FloatArray
    slopes: Slopes
    cusps: Cusps | None = None

    @classmethod
    def of(cls, functional: Functional, draft: Draft, floors: Floors) -> _Search:
        """Begin with a draft, which is left as it is."""
        excess = functional.excess(draft.vertices)
        return cls(functional, floors, draft, excess, Slopes.of(functional, excess, draft.bumps))

    @property
    def found(self) -> tuple[FloatArray, FloatArray, Cusps | None]:
        """Values at vertices, heights, and cusps."""
        return self.v.vertices, self.v.bumps, self.cusps

    def solve(self, near: Near | None) -> float:
        """Solve for some of v, within its bounds; slopes are without cusps then; collective.

        Returns:
            How many values this rank holds at their bounds from now on.
        """
        functional, v = self.functional, self.v
        cells = functional.cells
        some, heights, at = near or (v.free_vertices, v.free_facets, slice(None))
        step = nearest(cells, functional.kappa, self.slopes, some, heights, functional.masses)
        held = self._move(step, some, heights)
        if self.cusps is not None and not isinstance(at, slice):
            at = np.union1d(at, self.cusps.at)
        self.excess[:, at] = self.v.vertices[cells.vertices[:, at]] - functional.w[:, at]
        self.slopes.renew(functional, self.excess, self.v.bumps, at)
        return held

    def _move(
        self, step: tuple[FloatArray, FloatArray], some: BoolArray, heights: BoolArray
    ) -> float:
        """Move v by a step as far as the bounds allow, and hold what reaches them, see `solve`."""
        floors, bounded = self.floors, self.floors.side.dofs
        v, bumps = self.v.vertices + step[0], self.v.bumps + step[1]
        down = np.zeros_like(some)
        for sign, limit in floors.at_vertices:
            down |= some & (sign * v <= limit)
            v = np.where(some, sign * np.maximum(sign * v, limit), v)
        low, high = floors.heights(v)
        out = np.unique(bounded[heights[bounded] & ((bumps <= low) | (bumps >= high))[bounded]])
        # also where they are held since an earlier round: the facet's ends may have come down
        bumps[bounded] = np.clip(bumps, low, high)[bounded]
        free_facets = self.v.free_facets.copy()
        free_facets[out] = False
        self.v = Draft(v, bumps, self.v.free_vertices & ~down, free_facets)
        return float(len(out) + down.sum())

    def choose_cusps(self) -> None:
        """Choose where v gets cusps, slopes being those without; collective."""
        functional = self.functional
        self.cusps = Cusps.of(
            functional.cells, functional.kappa, functional.steady, self.slopes.energies
        )
        self.fit_cusps()

    def fit_cusps(self) -> None:
        """Find the cusps' best heights, and add what they do to E and its slopes; collective."""
        if self.cusps is None:
            return
        cells, slopes, v = self.functional.cells, self.slopes, (self.excess, self.v.bumps)
        self.cusps = self.cusps.fitted(cells, *v)
        at = self.cusps.at
        slopes.energies[at] += self.cusps.gains(cells, *v)
        for rows, pull in zip(
            (slopes.vertices, slopes.facets), self.cusps.pulls(cells), strict=True
        ):
            rows[:, at] -= pull


@dataclass(frozen=True, eq=False)
class Promise:
    """Curvatures of E: one value put right as if alone takes off its slope's square over this.

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

    def of_values(self, slopes: Slopes, v: Draft) -> tuple[FloatArray, FloatArray]:
        """Compute what each value of v promises, by vertex and by facet dof; collective."""
        cells = self.cells
        promises = cells.over_vertices(slopes.vertices), cells.over_facets(slopes.facets)
        for promise, weight, may in zip(
            promises, (self.vertices, self.facets), (v.free_vertices, v.free_facets), strict=True
        ):
            promise *= promise
            promise /= weight
            promise *= may
        return promises

    def total(self, slopes: Slopes, v: Draft) -> float:
        """Sum what all of them promise; collective."""
        vertices, facets = self.of_values(slopes, v)
        own = (
            vertices[: self.cells.owned_vertices()].sum()
            + facets[: self.cells.owned_facets()].sum()
        )
        return float(self.cells.total(float(own))[0])

    def near(self, slopes: Slopes, v: Draft, layers: int | None) -> Near | None:
        """Choose values that are worth being solved for; collective.

        They are those that hold `FOREMOST` of all promise, and all within some layers around them.

        Args:
            slopes: Those of v.
            v: v.
            layers: How many layers of cells around them; None for all.

        Returns:
            None if that is most of the mesh, or nothing is promised.
        """
        if layers is None:
            return None
        cells = self.cells
        owned = cells.owned_vertices(), cells.owned_facets()
        promises = self.of_values(slopes, v)
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
        there = np.zeros_like(v.free_facets)
        for facet, (j, k) in zip(facets, cells.others, strict=True):
            there[facet[inside[j] | inside[k]]] = True
        return v.free_vertices & chosen, v.free_facets & there, at


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
