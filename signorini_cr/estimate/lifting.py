"""The parts of u_D and α beyond v on boundary facets, enclosed and lifted into the cells.

δ is u_D − v on Γ0, and (α − α_I)⁺ on Γ1, where α_I ≤ v is the polynomial that α is interpolated by;
with bounds on both sides, so that v + ℓ passes neither, it is (α − v)⁺ − (v − β)⁺. It vanishes at
the facets' ends, and ℓ(P + t(z − P)) = t^k δ(z) brings it into the cell, P opposite the facet.
What is needed are bounds of |δ| and |δ'|, piece by piece; k is the best for them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from mpi4py import MPI

from ..arrays import BoolArray, FloatArray, IndexArray
from ..data.balls import indices, middle
from ..data.cutting import refine
from ..data.jets import STRIP, Boxes, Enclosure, Jet, choices_first, has_conditions
from ..data.pieces import Pieces
from ..data.quadrature import OnParts, Trace
from ..data.triangles import Triangles
from ..fem.cells import BoundaryFacets, Cells
from ..fem.pointwise import Unknown

ROUGH = "{} jumps on a boundary facet, or its derivative is not known to be bounded there"
NO_RANGE = "{} holds an operator that has no enclosure: {}"
CURVED = "u_D or α is not affine on the facets: their lifting is known for d = 2 only"

QUARTERS = 2
"""Halvings of facets to begin with."""
HALVINGS = 30
"""Most halvings of those on which data are not shown to be below others."""
POWERS = 0.5, 1e6
"""Least and largest k."""
END = 1e-9
"""Part of a facet where its data's limit at the end is looked for."""
DATA_ROUNDING = 1e-11
"""Part of the largest value that counts as rounding of data, and as 0."""
JUMP = 1e-9
"""Part of the largest value that counts as a jump."""


@dataclass(frozen=True, eq=False)
class Cubic:
    """Cubic polynomials on facets.

    For 0 ≤ s ≤ 1 they are (1 − s) a + s b + 4 s (1 − s) height + s (1 − s) (1 − 2s) third.

    Attributes:
        ends: a and b, shape (2, n).
        height: Shape (n,).
        third: Shape (n,).
    """

    ends: FloatArray
    height: FloatArray
    third: FloatArray

    def at(self, which: IndexArray, s: FloatArray) -> FloatArray:
        """Evaluate at s on some facets."""
        a, b = self.ends[:, which]
        bend = 4.0 * self.height[which] + (1.0 - 2.0 * s) * self.third[which]
        return a + s * (b - a) + s * (1.0 - s) * bend

    def slope(self, which: IndexArray, s: FloatArray) -> FloatArray:
        """Compute the derivative in s."""
        a, b = self.ends[:, which]
        bend = 4.0 * (1.0 - 2.0 * s) * self.height[which]
        return b - a + bend + (1.0 - 6.0 * s * (1.0 - s)) * self.third[which]

    def bend(self, which: IndexArray, s: FloatArray) -> FloatArray:
        """Compute half the second derivative in s."""
        return (6.0 * s - 3.0) * self.third[which] - 4.0 * self.height[which]


@dataclass(frozen=True, eq=False)
class Lift:
    """Bounds for each facet of a part of the boundary.

    Attributes:
        steep: ‖∇ℓ‖_T, shape (n,).
        area: ‖ℓ‖_T.
        beyond: |∫_F δ|.
        least: Lower bound of the data's mean.
        edge: ‖ℓ‖_F.
        reason: Why there are none, if there are none; this rank's.
    """

    steep: FloatArray
    area: FloatArray
    beyond: FloatArray
    least: FloatArray
    edge: FloatArray
    reason: str | None = None

    @classmethod
    def none(cls, least: FloatArray, reason: str | None = None) -> Lift:
        """Say that there is nothing to lift, or nothing that can be."""
        zero = np.zeros_like(least)
        return cls(zero, zero, zero, least, zero, reason)


def joined(lifts: Sequence[Lift]) -> Lift:
    """Put those of several parts one after the other; with one reason, if there is one."""
    rows = [(each.steep, each.area, each.beyond, each.least, each.edge) for each in lifts]
    columns = zip([np.empty(0)] * 5, *rows, strict=True)
    steep, area, beyond, least, edge = (np.concatenate(column) for column in columns)
    reason = next((each.reason for each in lifts if each.reason), None)
    return Lift(steep, area, beyond, least, edge, reason)


def cheaper(one: Lift, other: Lift) -> Lift:
    """Take of two ways to bring v above α the one that costs less, facet by facet.

    Args:
        one: The first; of infinite cost where it is none.
        other: The second.
    """
    if one.reason or (other.reason and not np.isfinite(one.steep).all()):
        return other
    if other.reason:
        return one
    better = other.steep < one.steep
    steep, area, beyond, least, edge = (
        np.where(better, theirs, own)
        for own, theirs in (
            (one.steep, other.steep),
            (one.area, other.area),
            (one.beyond, other.beyond),
            (one.least, other.least),
            (one.edge, other.edge),
        )
    )
    return Lift(steep, area, beyond, least, edge)


def lift(
    cells: Cells,
    side: BoundaryFacets,
    trace: Trace,
    base: Cubic | None,
    v: Cubic,
    scale: float,
    goal: float,
    obstacle: bool,
    ratio: float = 0.0,
) -> Lift:
    """Enclose data less a polynomial, and bound the lifting; collective.

    Args:
        cells: The mesh, of triangles.
        side: The facets.
        trace: The data.
        base: α_I, for an obstacle; None to measure δ from v.
        v: The companion; on facets where the obstacle is below it δ is 0.
        scale: Size of the values, by which rounding is told.
        goal: What ‖∇ℓ‖ need not be known better than.
        obstacle: Whether δ is the positive part of the difference.
        ratio: b over the largest κ, by which ‖ℓ‖²_F counts beside ‖∇ℓ‖²_T.
    """
    n, name = len(side.cells), "α" if obstacle else "u_D"
    if trace.constant is not None:
        return Lift.none(np.full(n, trace.constant))
    seen = Triangles.of(cells, side)

    def lifted(expression: Any) -> Lift:
        found = _enclosed(cells, side, expression, base, v, scale, goal, obstacle, ratio, seen)
        return _lifted(found, seen, n, ROUGH.format(name))

    expression = trace.deviation.expression
    try:
        found = lifted(expression)
        if cells.comm.allreduce(found.reason is not None, op=MPI.LOR):
            other = choices_first(expression)
            found = found if other is expression else lifted(other)
    except Unknown as error:
        return Lift.none(np.zeros(n), NO_RANGE.format(name, error))
    return found


def _lifted(found: _Enclosed, seen: Triangles, n: int, rough: str) -> Lift:
    """Bound the lifting; `rough` is the reason where that can't be."""
    pieces, length, height = found.pieces, seen.length, seen.height

    def mean(values: FloatArray) -> FloatArray:
        sums = np.bincount(pieces.parent, pieces.share * values, minlength=n)
        return np.asarray(sums, dtype=np.float64)

    with np.errstate(invalid="ignore", divide="ignore"):
        rows = (*seen.parts(pieces, found.size, found.steep), found.size, found.size**2)
        one, k, two, beyond, norm = (np.where(found.clear, 0.0, mean(row)) for row in rows)
        power = np.clip(np.nan_to_num(np.sqrt(one / two), nan=1.0), *POWERS)
        squares = one / power + k + power * two
    squares[found.jumps & ~found.clear] = np.inf
    fine = bool(np.isfinite(squares).all())
    return Lift(
        np.sqrt(0.5 * height * length * squares),
        np.sqrt(height * length * norm / (2.0 * power + 2.0)),
        beyond * length,
        mean(found.least),
        np.sqrt(length * norm),
        None if fine else rough,
    )


@dataclass(frozen=True, eq=False)
class _Enclosed:
    """Bounds of δ, and of the data.

    Attributes:
        pieces: Pieces of the facets.
        size: Bounds of |δ| on them, shape (pieces,).
        steep: Bounds of |δ'|.
        least: Lower bounds of the data's means.
        jumps: Facets at whose ends δ does not vanish, shape (n,).
        clear: Facets on which the companion is above the obstacle, shape (n,).
    """

    pieces: Pieces
    size: FloatArray
    steep: FloatArray
    least: FloatArray
    jumps: BoolArray
    clear: BoolArray


def _enclosed(
    cells: Cells,
    side: BoundaryFacets,
    expression: Any,
    base: Cubic | None,
    v: Cubic,
    scale: float,
    goal: float,
    obstacle: bool,
    ratio: float,
    seen: Triangles,
) -> _Enclosed:
    """Enclose δ piece by piece, as finely as `goal` asks for; collective.

    Args:
        cells: As for `lift`, and so are all but the next but one and the last.
        side: The facets.
        expression: The data.
        base: α_I.
        v: The companion.
        scale: Size of the values.
        goal: What ‖∇ℓ‖ need not be known better than.
        obstacle: Whether δ is the positive part of the difference.
        ratio: b over the largest κ.
        seen: The cells, as they are seen from the facets.

    Raises:
        Unknown: The data hold an operator that has no enclosure.
    """
    n, polynomial, whole = len(side.cells), base or v, Pieces.of_facets(cells, side)

    def steepness(pieces: Pieces) -> FloatArray:
        size, steep, least = _bounds(expression, pieces, polynomial, cells, seen.length, scale)
        if obstacle and base is None:
            # δ is a positive part, and 0 where the difference is shown to be negative
            signed = _bounds(expression, pieces, v, cells, seen.length, scale, signed=True)[0]
            size = np.fmin(size, np.maximum(signed, 0.0))
            steep = np.where(signed <= 0.0, 0.0, steep)
        square = seen.parts(pieces, size, steep).sum(axis=0)
        square = square + 2.0 * ratio / seen.height[pieces.parent] * size**2
        return np.stack([square, size, steep, least])

    weights = np.zeros((4, n))
    with np.errstate(divide="ignore", over="ignore"):  # without a goal none is too small to be cut
        weights[0] = 0.5 * seen.height * seen.length / np.float64(goal) ** 2
    pieces = whole
    for _ in range(QUARTERS):
        pieces = pieces.halves()
    room = 8 * cells.comm.allreduce(n) + 1000
    pieces, (_, size, steep, least) = refine(pieces, steepness, weights, room, cells)
    jumps = _jump_at_ends(expression, whole, polynomial, cells, JUMP * scale, obstacle)
    if has_conditions(expression):
        jumps |= _jump_between(expression, pieces, polynomial, cells, JUMP * scale, obstacle)
    clear = np.zeros(n, dtype=bool)
    if obstacle:
        below = size <= 0.0
        if base is not None:
            below = _bounds(expression, pieces, v, cells, seen.length, scale, signed=True)[0] <= 0
        clear = np.bincount(pieces.parent, ~below, minlength=n) == 0
    return _Enclosed(pieces, size, steep, least, jumps, clear)


def gaps(
    cells: Cells, bounds: OnParts, v: FloatArray, bumps: FloatArray, thirds: FloatArray | None
) -> FloatArray:
    """Bound from below how far v is off its bounds on each facet, d = 2, shape (n,); collective.

    Args:
        cells: The mesh.
        bounds: α and −β on Γ1, seen from the cells.
        v: v at the vertices.
        bumps: Heights of its bumps.
        thirds: Those of its cubics; or None.
    """
    found: list[FloatArray] = [np.zeros(0)]
    for data in bounds.parts:
        side, trace = data.side(cells), data.trace
        third: FloatArray = np.zeros(len(side.cells))
        if thirds is not None:
            third = cells.ways_between(*side.ends) * thirds[side.dofs]
        own = Cubic(data.sign * v[side.ends], data.sign * bumps[side.dofs], data.sign * third)
        pieces = Pieces.of_facets(cells, side)
        for _ in range(QUARTERS):
            pieces = pieces.halves()
        above: FloatArray
        if trace.constant is not None:
            s = pieces.hats[:, 1]
            ends = np.stack([own.at(pieces.parent, t) for t in s])
            width = np.abs(s[1] - s[0])
            bend = 4.0 * np.abs(own.height) + 3.0 * np.abs(own.third)
            off = trace.constant - ends.min(axis=0) + bend[pieces.parent] * width**2 / 4.0
            above = np.asarray(off)
        else:
            length = Triangles.of(cells, side).length
            try:
                e = trace.deviation.expression
                above = _bounds(e, pieces, own, cells, length, 0.0, signed=True)[0]
            except Unknown:
                above = np.full(pieces.parent.shape, np.inf)
        found.append(np.full(len(side.cells), np.inf))
        np.minimum.at(found[-1], pieces.parent, -above)
    return np.concatenate(found)


def below(cells: Cells, side: BoundaryFacets, trace: Trace, scale: float) -> bool:
    """Tell whether data are shown to be 0 or less on all of a part of the boundary; collective.

    Args:
        cells: The mesh, of triangles.
        side: The facets.
        trace: The data.
        scale: Size of what they are the difference of, by which rounding is told.
    """
    none = np.zeros(len(side.cells))
    length, zero = Triangles.of(cells, side).length, Cubic(np.stack([none, none]), none, none)
    pieces, room = Pieces.of_facets(cells, side), 8 * len(none) + 1000
    expression = trace.deviation.expression
    shown = False
    try:
        for _ in range(HALVINGS):
            most = _bounds(expression, pieces, zero, cells, length, scale, signed=True)[0]
            open_ = ~(most <= JUMP * scale)
            shown = not open_.any()
            if shown or np.count_nonzero(open_) > room:
                break
            pieces = pieces[open_].halves()
    except Unknown:
        shown = False
    return bool(cells.comm.allreduce(shown, op=MPI.LAND))


def _bounds(
    expression: Any,
    pieces: Pieces,
    base: Cubic,
    cells: Cells,
    length: FloatArray,
    scale: float,
    signed: bool = False,
) -> FloatArray:
    """Bound |δ|, |δ'|, and the data's mean from below, on pieces of facets, shape (3, n).

    Where conditions are decided but for strips at the ends, whose part of a piece is π, let D bound
    |δ'| on all of the piece. Then |δ| is no more than π D times its length above what it is
    elsewhere, and |δ'|² is in the mean not more than π D² above. If there is no D, data jump in the
    strip, and are taken to do so at the end. With `signed` the first is an upper bound of δ itself.
    """

    def bounds(which: slice | IndexArray, rounding: float) -> tuple[FloatArray, FloatArray]:
        boxes = replace(pieces[which].boxes(cells, decide=True), rounding=rounding)
        return _by_taylor(expression, pieces[which], boxes, base, cells, length, scale, signed)

    found, part = bounds(slice(None), STRIP)
    which = np.flatnonzero(part)
    if len(which):
        size, steep, least = found[:, which]
        (whole, steepest, lowest), _ = bounds(which, 0.0)
        # a jump so near to a vertex, as rounding makes of one at it, is none
        part = np.where(np.isfinite(steepest), part[which], 0.0)
        steepest = np.where(part > 0.0, steepest, 0.0)
        width = part * length[pieces.parent[which]] * pieces.share[which]
        found[:, which] = (
            np.where(part > 0.0, np.fmin(whole, size + width * steepest), size),
            np.hypot(steep, np.sqrt(part) * steepest),
            np.where(part > 0.0, np.fmax(lowest, least - part * width * steepest), least),
        )
    return found


def _by_taylor(
    expression: Any,
    pieces: Pieces,
    boxes: Boxes,
    base: Cubic,
    cells: Cells,
    length: FloatArray,
    scale: float,
    signed: bool,
) -> tuple[FloatArray, FloatArray]:
    """Bound the same on boxes, but for a part of each piece which is bounded as well, shape (n,).

    Taylor's formula about the middle m for δ', with what the orders 1, 2 and 3 say; whichever is
    the best.
    """
    enclosure = Enclosure(boxes, rounding=DATA_ROUNDING * scale)
    over = enclosure(expression)
    at, s = pieces.parent, pieces.hats[:, 1].mean(axis=0)
    e = 0.5 * length[at] * pieces.share
    there = Enclosure(pieces.points(cells, np.full((2, 1), 0.5)))(expression)
    c, m = _balls(over, len(at)), _balls(there, len(at))
    slope = base.slope(at, s) / length[at]
    bend = base.bend(at, s) / length[at] ** 2
    cube = 2.0 * base.third[at] / length[at] ** 3
    with np.errstate(invalid="ignore"):
        first = np.abs(m[1][0] - slope) + m[1][1]
        by_order = (
            np.abs(c[1][0] - slope) + c[1][1] + e * (2.0 * np.abs(bend) + 3.0 * e * np.abs(cube)),
            first + 2.0 * e * (np.abs(c[2][0] - bend) + c[2][1] + 3.0 * e * np.abs(cube)),
            first
            + 2.0 * e * (np.abs(m[2][0] - bend) + m[2][1])
            + 3.0 * e**2 * (np.abs(c[3][0] - cube) + c[3][1]),
        )
        steep = np.where(np.isnan(d := np.fmin.reduce(by_order)), np.inf, d)
        ends = np.stack([base.at(at, t) for t in (*pieces.hats[:, 1], s)])
        swing = np.abs(bend) * e**2 + np.abs(cube) * e**3
        above = over.high - ends.min(axis=0) + swing
        below = ends.max(axis=0) - over.low + swing
        middle = m[0][0] - ends[2]
        if signed:
            size = np.fmin(above, middle + m[0][1] + e * steep)
        else:
            size = np.fmin(np.maximum(above, below), np.abs(middle) + m[0][1] + e * steep)
            rounding = np.isinf(steep) & (size <= DATA_ROUNDING * scale)
            steep, size = np.where(rounding, 0.0, steep), np.where(rounding, 0.0, size)
        low = m[0][0] - m[0][1]
        least = np.fmax.reduce(
            (
                over.low + np.zeros_like(e),
                low - 0.5 * e * c[1][1],
                low + e**2 / 3.0 * (c[2][0] - c[2][1]),
                low + e**2 / 3.0 * (m[2][0] - m[2][1]) - 0.25 * e**3 * (np.abs(c[3][0]) + c[3][1]),
            )
        )
    return np.stack([size, steep, least]), enclosure.left_out


def _balls(jet: Jet, n: int) -> list[tuple[FloatArray, FloatArray]]:
    """Return the value and the coefficients up to the third order in one variable."""
    mid, rad = jet.rest.on((1, 2, 3))
    pairs = [middle(jet.low, jet.high), *zip(mid, rad, strict=True)]
    return [(np.broadcast_to(a, n), np.broadcast_to(b, n)) for a, b in pairs]


def _jump_at_ends(
    expression: Any, whole: Pieces, base: Cubic, cells: Cells, jump: float, obstacle: bool
) -> BoolArray:
    """Tell where δ does not vanish at a facet's end: the data's limit is not the value there."""
    found = np.zeros(len(whole.parent), dtype=bool)
    for end in (0, 1):
        low, high = _near(expression, whole, end, cells)
        found |= low > base.ends[end] + jump
        if not obstacle:
            found |= high < base.ends[end] - jump
    return found


def _jump_between(
    expression: Any, pieces: Pieces, base: Cubic, cells: Cells, jump: float, obstacle: bool
) -> BoolArray:
    """Tell on which facets δ jumps from one piece to the next, of which each may be smooth."""
    s = pieces.hats[:, 1]
    order = np.lexsort((s.mean(axis=0), pieces.parent))
    s, parent = s[:, order], pieces.parent[order]
    near = [[x[order] for x in _near(expression, pieces, end, cells)] for end in (0, 1)]
    forward = s[1] > s[0]
    begin = [np.where(forward, a, b) for a, b in zip(*near, strict=True)]
    stop = [np.where(forward, b, a) for a, b in zip(*near, strict=True)]
    if obstacle:
        begin = [np.maximum(x, base.at(parent, s.min(axis=0))) for x in begin]
        stop = [np.maximum(x, base.at(parent, s.max(axis=0))) for x in stop]
    low, high = (np.array(x) for x in zip(begin, stop, strict=True))  # rows: begin, stop
    apart = (low[0, 1:] > high[1, :-1] + jump) | (high[0, 1:] < low[1, :-1] - jump)
    found = np.zeros(len(base.height), dtype=bool)
    found[parent[1:][(parent[1:] == parent[:-1]) & apart]] = True
    return found


def _near(expression: Any, pieces: Pieces, end: int, cells: Cells) -> tuple[FloatArray, FloatArray]:
    """Enclose data next to one end of each piece, shapes (n,)."""
    corners = pieces.corners.copy()
    corners[1 - end] = corners[end] + END * (pieces.corners[1 - end] - corners[end])
    # at a point conditions that change there would be those of the next piece
    same = (corners[0] == corners[1]).all(axis=0)
    corners[..., same] = pieces.corners[..., same]
    near = Pieces(pieces.parent, corners, pieces.hats, pieces.share, pieces.frame)
    jet = Enclosure(near.boxes(cells, decide=True))(expression)
    n = len(pieces.parent)
    return np.broadcast_to(jet.low, n), np.broadcast_to(jet.high, n)


def affine(
    cells: Cells,
    side: BoundaryFacets,
    trace: Trace,
    v: FloatArray,
    values: FloatArray,
    scale: float,
) -> Lift:
    """Insist on data that are affine on the facets of tetrahedra; v or more at their vertices.

    Args:
        cells: The mesh.
        side: The facets.
        trace: The data.
        v: v at the facets' vertices, shape (d, n).
        values: The data there.
        scale: Size of the values, by which rounding is told.
    """
    zero = np.zeros(len(side.cells))
    if trace.constant is not None:
        return Lift.none(zero + trace.constant)
    whole = Pieces.of_facets(cells, side)
    boxes = whole.boxes(cells, decide=True)
    enclosure = Enclosure(boxes)
    try:
        jet = enclosure(trace.deviation.expression)
        every = Enclosure(replace(boxes, rounding=0.0))(trace.deviation.expression)
    except Unknown as error:
        return Lift.none(zero, NO_RANGE.format("u_D or α", error))
    off = zero.copy()
    half = whole.half(boxes)
    # on strips, where slopes may be others
    for row, rad in zip(every.rest.rows, every.rest.rad, strict=True):
        index = indices(boxes.variables)[row]
        if sum(index) == 1:
            size = np.prod([h**k for h, k in zip(half, index, strict=True)], axis=0)
            off = off + np.where(enclosure.left_out > 0.0, 4.0 * rad * size * enclosure.left_out, 0)
    for row, mid, rad in zip(jet.rest.rows, jet.rest.mid, jet.rest.rad, strict=True):
        index = indices(boxes.variables)[row]
        if sum(index) == 2:
            size = np.prod([h**k for h, k in zip(half, index, strict=True)], axis=0)
            off = off + 2.0 * (np.abs(mid) + rad) * size
    curved = not (off <= JUMP * scale).all() or (values - v > JUMP * scale).any()
    reason = CURVED if curved else None
    return Lift.none(values.mean(axis=0) - off, reason)
