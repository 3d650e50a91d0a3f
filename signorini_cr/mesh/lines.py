"""Polygons inside a polygon: the lines that the mesh is to follow, and which cells lie in each."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from ..arrays import FloatArray, IndexArray, Int32Array
from ..errors import InputError
from .polygon import inside

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
    """
    if not polygons:
        return Outline(loops, labels, np.empty((0, 2, 2)))
    near = NEAR * np.ptp(loops[0], axis=0).max()
    rings = [*loops, *polygons]
    points: list[FloatArray] = []

    def number(x: FloatArray) -> int:
        """Return the point's number; a new one, unless there is one already."""
        if points:
            distance = np.abs(np.array(points) - x).max(axis=1)
            if distance.min() <= near:
                return int(distance.argmin())
        points.append(x)
        return len(points) - 1

    of_rings = [np.array([number(x) for x in ring]) for ring in rings]
    edges = np.concatenate([np.column_stack([ring, np.roll(ring, -1)]) for ring in of_rings])
    of_outline = sum(map(len, loops))
    corners = np.array(points)
    for i in range(of_outline, len(edges)):
        for x in _crossings(corners[edges[i]], corners[edges[:i]]):
            number(x)
    x = np.array(points)
    pieces = [_through(edge, x, near) for edge in edges]

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


def _crossings(edge: FloatArray, others: FloatArray) -> FloatArray:
    """Find where an edge, shape (2, 2), crosses others, shape (n, 2, 2)."""
    u, v, w = edge[1] - edge[0], others[:, 1] - others[:, 0], others[:, 0] - edge[0]
    with np.errstate(all="ignore"):  # parallel ones have none
        det = u[0] * v[:, 1] - u[1] * v[:, 0]
        t = (w[:, 0] * v[:, 1] - w[:, 1] * v[:, 0]) / det
        s = (w[:, 0] * u[1] - w[:, 1] * u[0]) / det
        meet = (t > 0) & (t < 1) & (s > 0) & (s < 1)
    return np.asarray(edge[0] + t[meet, None] * u)


def _through(edge: IndexArray, x: FloatArray, near: float) -> IndexArray:
    """Find the points on an edge, from one end to the other."""
    start, u = x[edge[0]], x[edge[1]] - x[edge[0]]
    t = (x - start) @ u / (u @ u)
    on = np.linalg.norm(x - start - t[:, None] * u, axis=1) <= near
    found = np.flatnonzero(on & (t > 0) & (t < 1))
    found = found[(found != edge[0]) & (found != edge[1])]
    return np.concatenate([edge[:1], found[np.argsort(t[found])], edge[1:]])


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
