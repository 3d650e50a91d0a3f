"""Polygons inside a polygon: the lines that the mesh is to follow, and which cells lie in each."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import product
from typing import NamedTuple

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from ..arrays import FloatArray, IndexArray, Int32Array
from ..errors import InputError
from .plane import cross, share
from .polygon import MOST_EDGES, inside

NEAR = 1e-12
"""Distance at which points are the same, or on a line, in parts of the extent."""


class Outline(NamedTuple):
    """An outline, and lines inside it that meet it and one another in their ends only.

    Attributes:
        loops: Vertices of the polygon and of each hole, those on which lines end among them,
            shapes (n, 2).
        labels: Label of every edge, one loop after the other.
        lines: Ends of the lines, shape (m, 2, 2).
    """

    loops: Sequence[FloatArray]
    labels: Int32Array
    lines: FloatArray


def arranged(
    loops: Sequence[FloatArray], labels: Int32Array, polygons: Sequence[FloatArray]
) -> Outline:
    """Cut an outline and the edges of polygons where they meet.

    Args:
        loops: Vertices of the polygon and of each hole, shapes (n, 2).
        labels: Label of every edge, one loop after the other.
        polygons: May reach beyond the outline, and share edges, or parts of edges.

    Raises:
        InputError: There are too many edges, or too many points in which they cross.
    """
    if not polygons:
        return Outline(loops, labels, np.empty((0, 2, 2)))
    extent = np.ptp(loops[0], axis=0).max()
    near = NEAR * extent
    low, high = loops[0].min(axis=0) - extent, loops[0].max(axis=0) + extent
    rings = [*loops, *(_clipped(polygon, low, high) for polygon in polygons)]
    sizes = np.array([len(ring) for ring in rings])
    if sizes.sum() > MOST_EDGES:
        raise InputError(
            f"the outline and the materials' polygons have {sizes.sum()} edges; {MOST_EDGES} are"
            " allowed"
        )
    corners = np.concatenate(rings)
    after = np.arange(len(corners)) + 1
    after[np.cumsum(sizes) - 1] = np.cumsum(sizes) - sizes
    of_outline = sum(map(len, loops))
    points = np.concatenate([corners, _crossings(corners, corners[after], of_outline, near)])
    number, x = _each_once(points, near)
    edges = np.column_stack([number[: len(corners)], number[after]])
    pieces = _pieces(edges, x, near)

    new_loops, new_labels, at = [], [], 0
    for loop in loops:
        cut = pieces[at : at + len(loop)]
        new_loops.append(np.concatenate([x[way[:-1]] for way in cut]))
        new_labels.append(np.repeat(labels[at : at + len(loop)], [len(way) - 1 for way in cut]))
        at += len(loop)

    def pairs(ways: Sequence[IndexArray]) -> set[tuple[int, ...]]:
        both = np.concatenate([np.column_stack([way[:-1], way[1:]]) for way in ways])
        return set(map(tuple, np.sort(both, axis=1).tolist()))

    lines = np.array(sorted(pairs(pieces[of_outline:]) - pairs(pieces[:of_outline])), dtype=int)
    ends = x[lines.reshape(-1, 2)]
    middle = ends.mean(axis=1)
    within = inside(middle, loops[0])
    for hole in loops[1:]:
        within &= ~inside(middle, hole)
    return Outline(new_loops, np.concatenate(new_labels), ends[within])


def _clipped(polygon: FloatArray, low: FloatArray, high: FloatArray) -> FloatArray:
    """Clip a polygon to a box (Sutherland and Hodgman); what runs outside follows the box.

    Where an edge ends far away its crossings would be off all lines by the rounding of its end.
    """
    for axis, (sign, bound) in product((0, 1), ((-1.0, low), (1.0, high))):
        beyond = sign * (polygon[:, axis] - bound[axis])
        after, beyond_after = np.roll(polygon, -1, axis=0), np.roll(beyond, -1)
        begins, ends = beyond <= 0, beyond_after <= 0  # within
        first, last = np.minimum(beyond, beyond_after), np.maximum(beyond, beyond_after)
        # from the end that is within, so that little is lost
        start, end = (np.where(begins[:, None], *x) for x in ((polygon, after), (after, polygon)))
        with np.errstate(all="ignore"):
            between = start + (first / (first - last))[:, None] * (end - start)
        between[:, axis] = bound[axis]
        kept = np.stack([begins, begins != ends], axis=1)
        polygon = np.stack([polygon, between], axis=1)[kept]
    return polygon


def _crossings(a: FloatArray, b: FloatArray, of_outline: int, near: float) -> FloatArray:
    """Find where edges of polygons cross others, shape (n, 2).

    Args:
        a: Where edges begin, the outline's first, shape (edges, 2).
        b: Where they end.
        of_outline: How many are the outline's, which do not cross one another.
        near: Edges farther apart than that do not meet.

    Raises:
        InputError: There are too many.
    """
    low, high = np.minimum(a, b) - near, np.maximum(a, b) + near
    found, total = [np.empty((0, 2))], 0
    for i in range(of_outline, len(a)):
        at = np.flatnonzero((low[:i] <= high[i]).all(axis=1) & (high[:i] >= low[i]).all(axis=1))
        u, v, w = b[i] - a[i], b[at] - a[at], a[at] - a[i]
        with np.errstate(all="ignore"):  # parallel ones have none
            det = cross(u, v)
            t, s = cross(w, v) / det, cross(w, u) / det
            meet = (t > 0) & (t < 1) & (s > 0) & (s < 1)
        found.append(a[i] + t[meet, None] * u)
        total += len(found[-1])
        if total > MOST_EDGES:
            raise InputError(
                "the materials' polygons cross the outline and one another more than"
                f" {MOST_EDGES} times"
            )
    return np.concatenate(found)


def _each_once(points: FloatArray, near: float) -> tuple[IndexArray, FloatArray]:
    """Take points that are no farther apart than that for one; number of each, and those left."""
    # Of those in one square of a fine grid only the first is compared with its neighbours
    squares = np.floor(points / (0.5 * near))
    _, begins, square = np.unique(squares, axis=0, return_index=True, return_inverse=True)
    pairs = cKDTree(points[begins]).query_pairs(near, p=np.inf, output_type="ndarray")
    graph = csr_array((np.ones(len(pairs)), pairs.T), shape=(len(begins), len(begins)))
    groups, group = connected_components(graph, directed=False)
    first = np.full(groups, len(points))
    np.minimum.at(first, group, begins)
    kept, number = np.unique(first[group[square.reshape(-1)]], return_inverse=True)
    return number, points[kept]


def _pieces(edges: IndexArray, x: FloatArray, near: float) -> list[IndexArray]:
    """Find the points on each edge, shape (edges, 2), from one end to the other."""
    found = []
    for first, last in edges:
        start, u = x[first], x[last] - x[first]
        low, high = np.minimum(start, x[last]) - near, np.maximum(start, x[last]) + near
        at = np.flatnonzero((x >= low).all(axis=1) & (x <= high).all(axis=1))
        at = at[(at != first) & (at != last)]
        t = share(start, x[last], x[at])
        on = np.linalg.norm(x[at] - start - t[:, None] * u, axis=1) <= near
        on &= (t > 0) & (t < 1)
        found.append(np.array([first, *at[on][np.argsort(t[on])], last]))
    return found


def sorted_out(
    middles: FloatArray, polygons: Mapping[str, FloatArray], numbers: Mapping[str, int]
) -> Int32Array:
    """Find the number of the polygon that each cell lies in, or 0, shape (cells,).

    Args:
        middles: The cells' midpoints, shape (cells, 2); no cell is cut by a polygon.
        polygons: Their vertices, by name.
        numbers: Their numbers, by name.

    Raises:
        InputError: Two polygons have a cell in common, or a polygon has none.
    """
    found: Int32Array = np.zeros(len(middles), dtype=np.int32)
    names = {number: name for name, number in numbers.items()}
    for name, polygon in polygons.items():
        here = inside(middles, polygon)
        if not here.any():
            raise InputError(f"the material {name} lies outside the domain")
        both = np.flatnonzero(here & (found > 0))
        if len(both):
            x, y = middles[both[0]]
            other = names[int(found[both[0]])]
            raise InputError(
                f"the materials {other} and {name} overlap around ({x:.6g}, {y:.6g}): their"
                " polygons must lie apart, or side by side"
            )
        found[here] = numbers[name]
    return found
