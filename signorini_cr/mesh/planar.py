"""Test that triangles lie side by side in the plane: none over another, no vertex inside a side.

Take all triangles counterclockwise. Where two share a side they must run through it in opposite
directions, and around a vertex they must not overlap. Then a point is covered as often as the
boundary winds around it. If no two sides of the boundary cross or run along each other, each of its
loops is simple, and winds once around what lies in it: to the left the outer one of each piece, and
to the right all others, as the angles along the boundary add up to 2π times the Euler
characteristic. So a piece covers no point twice, and pieces must not lie on one another.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import numpy.typing as npt
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components

from ..arrays import BoolArray, FloatArray, Int64Array
from .plane import angle, cross, crossing, ends_in_words, in_words, side

_NEAR = 1e-12
"""Distance from a line, in parts of the lengths at hand, that counts as none."""

_DIRECTION = np.array([0.8090, 0.5878])
"""Direction in which sides are ordered; few domains have many sides across it."""

_AT_A_TIME = 1_000_000
"""Pairs of sides looked at together."""


def overlap(
    points: FloatArray,
    triangles: Int64Array,
    sides: Int64Array,
    count: Int64Array,
    piece: Int64Array,
) -> str | None:
    """Say where triangles overlap or do not meet side to side, if they do.

    Args:
        points: Coordinates, shape (points, 2).
        triangles: Corners, each triangle with an area, shape (triangles, 3).
        sides: Number of the side opposite each corner, shape (triangles, 3).
        count: How many triangles, one or two, have the side, shape (sides,).
        piece: Which of the pieces that hang together by sides the triangle belongs to, shape
            (triangles,).
    """
    u, v = np.diff(points[triangles], axis=1).swapaxes(0, 1)
    turned = cross(u, v) < 0
    ends = triangles[:, [[1, 2], [2, 0], [0, 1]]]
    up = (ends[:, :, 0] < ends[:, :, 1]) != turned[:, None]
    ups = np.bincount(sides.ravel(), up.ravel(), len(count))
    alike = ((count == 2) & (ups != 1))[sides]
    if alike.any():
        return f"triangles overlap at the facet {ends_in_words(points[ends[alike][0]])}"
    angles = np.bincount(triangles.ravel(), _angles(points[triangles]).ravel(), len(points))
    if len(bad := np.flatnonzero(angles > 2 * np.pi + 1e-6)):
        return f"triangles overlap around {in_words(points[bad[0]])}"
    outer = count[sides] == 1
    rim = np.where(turned[:, None, None], ends[:, :, ::-1], ends)[outer]
    owner = np.broadcast_to(piece[:, None], sides.shape)[outer]
    ccw = np.where(turned[:, None], triangles[:, ::-1], triangles)
    for vertex in np.flatnonzero(np.bincount(rim[:, 0], minlength=len(points)) > 1):
        if _crowded(points, ccw, vertex):
            return f"triangles overlap around {in_words(points[vertex])}"
    return _crossing(points, rim) or _nested(points, triangles, piece, rim, owner)


def _angles(corners: FloatArray) -> FloatArray:
    """Compute the angle at each corner of triangles, shape (triangles, 3)."""
    u, v = np.roll(corners, -1, axis=1) - corners, np.roll(corners, 1, axis=1) - corners
    return np.abs(angle(u, v))


def _crowded(points: FloatArray, ccw: Int64Array, vertex: int) -> bool:
    """Tell whether two triangles that have a vertex in common overlap around it."""
    cell, corner = np.nonzero(ccw == vertex)
    first, last = points[ccw[cell, (corner + 1) % 3]], points[ccw[cell, (corner + 2) % 3]]
    apex = points[vertex]
    for i in range(len(cell) - 1):
        a, b, c, d = first[i], last[i], first[i + 1 :], last[i + 1 :]
        inside = (side(apex, a, c, _NEAR) >= 0) & (side(apex, c, b, _NEAR) > 0)
        around = (side(apex, c, a, _NEAR) >= 0) & (side(apex, a, d, _NEAR) > 0)
        if np.any(inside | around):
            return True
    return False


def _crossing(points: FloatArray, sides: Int64Array) -> str | None:
    """Say which two sides of the boundary cross, touch or run along each other, if any do."""
    for i, j in _close(points[sides] @ _DIRECTION):
        one, two = points[sides[i]], points[sides[j]]  # shape (pairs, 2 ends, 2)
        ends = one[:, 0], one[:, 1], two[:, 0], two[:, 1]
        faults = [
            (crossing(*ends, _NEAR), "crosses", one, two),
            (_run_along(one, two), "overlaps", one, two),
            (_touched(one, two), "ends in", two, one),
            (_touched(two, one), "ends in", one, two),
        ]
        for found, word, first, second in faults:
            if len(k := np.flatnonzero(found)):
                return (
                    f"the facet {ends_in_words(first[k[0]])} {word} that"
                    f" {ends_in_words(second[k[0]])}: facets may meet at their ends only"
                )
    return None


def _close(along: FloatArray) -> Iterator[tuple[Int64Array, Int64Array]]:
    """Find pairs of sides of which neither lies before the other.

    Args:
        along: Position of the ends of every side, shape (sides, 2).
    """
    low, high = along.min(axis=1), along.max(axis=1)
    order = np.argsort(low)
    last = np.searchsorted(low[order], high[order], side="right")
    count = last - np.arange(len(order)) - 1
    begin, total = 0, np.cumsum(count)
    while begin < len(order):
        done = total[begin - 1] if begin else 0
        end = max(begin + 1, int(np.searchsorted(total, done + _AT_A_TIME, side="right")))
        first = np.repeat(np.arange(begin, end), count[begin:end])
        offset = np.arange(len(first)) - np.repeat(
            total[begin:end] - count[begin:end] - done, count[begin:end]
        )
        yield order[first], order[first + 1 + offset]
        begin = end


def _touched(one: FloatArray, other: FloatArray) -> BoolArray:
    """Tell whether an end of the other lies inside the one."""
    u = one[:, 1] - one[:, 0]
    length = np.hypot(*u.T)
    found = np.zeros(len(one), dtype=bool)
    for end in (0, 1):
        t = ((other[:, end] - one[:, 0]) * u).sum(axis=1) / length**2
        x = one[:, 0] + t[:, None] * u
        on = np.hypot(*(x - other[:, end]).T) <= _NEAR * length
        found |= on & (t > 1e-6) & (t < 1 - 1e-6)
    return found


def _run_along(one: FloatArray, two: FloatArray) -> BoolArray:
    """Tell whether two sides are the same and have the mesh on the same hand."""
    length = np.hypot(*(one[:, 1] - one[:, 0]).T)
    return (np.hypot(*(one - two).transpose(2, 0, 1)) <= _NEAR * length[:, None]).all(axis=1)


def _nested(
    points: FloatArray,
    triangles: Int64Array,
    piece: Int64Array,
    sides: Int64Array,
    owner: Int64Array,
) -> str | None:
    """Say which piece of the mesh lies on another one, if any does."""
    pieces = np.unique(piece)
    a, b = points[sides[:, 0]], points[sides[:, 1]]
    for number in pieces if len(pieces) > 1 else ():
        x = points[triangles[number]].mean(axis=0)
        spans = ((a[:, 1] > x[1]) != (b[:, 1] > x[1])) & (owner != number)
        p, q = a[spans], b[spans]
        hit = p[:, 0] + (x[1] - p[:, 1]) / (q[:, 1] - p[:, 1]) * (q[:, 0] - p[:, 0])
        right = owner[spans][hit > x[0]]
        if np.any(np.bincount(right) % 2):
            return f"a piece of the mesh lies on another one at {in_words(x)}"
    return None


def pieces(sides: npt.NDArray[np.integer], edges: int) -> Int64Array:
    """Number the piece of every cell by the lowest cell it is connected with, shape (cells,).

    Args:
        sides: What connects cells, edges as a rule, of every cell, shape (cells, n).
        edges: How many of them there are.
    """
    cells, per_cell = sides.shape
    # rows are cells and, without entries of their own, what connects them
    starts = np.append(per_cell * np.arange(cells + 1), np.full(edges, sides.size))
    entries = np.ones(sides.size, dtype=np.int8), cells + sides.ravel(), starts
    joined = csr_array(entries, shape=(cells + edges, cells + edges))
    _, label = connected_components(joined, directed=False)
    _, lowest, which = np.unique(label[:cells], return_index=True, return_inverse=True)
    return lowest[which]
