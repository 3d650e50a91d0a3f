"""A polygon's edges: arcs cut into facets, closed loops that neither cross nor touch."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.spatial import ConvexHull, QhullError

from ..arrays import BoolArray, FloatArray, IndexArray
from ..errors import InputError, naming, to_float
from .plane import cross, crossing, distance, in_words

FARTHEST = 1e100
"""Largest coordinate: areas, and products of them, stay finite."""
TURN = math.pi / 12
"""Most that the boundary turns from one facet of an arc to the next: 24 are a circle.

A facet of length l that turns by t is l tan(t/4)/2 away from its arc: here less than l/30, and than
1 % of the radius.
"""
MOST_FACETS = 2000
"""Of one arc."""
MOST_EDGES = 100_000
"""Of a polygon and its holes: the coarsest mesh has no more facets on its boundary."""


def coordinates(vertices: npt.ArrayLike, least: int = 3) -> FloatArray:
    """Return vertices as a read-only array, shape (n, 2), if they are that, finite and enough."""
    try:
        points = np.array(vertices, dtype=np.float64)
    except (TypeError, ValueError):
        points = np.empty(0)
    if points.ndim != 2 or points.shape[1] != 2:
        raise InputError("vertices are not a list of [x, y] pairs of numbers")
    if len(points) < least:
        raise InputError(f"{len(points)} vertices: a polygon has at least {least}")
    bad = np.flatnonzero(~np.isfinite(points).all(axis=1))
    if len(bad):
        raise InputError(f"vertex {bad[0]} is {in_words(points[bad[0]])}: not a finite point")
    far = np.flatnonzero(np.abs(points).max(axis=1) > FARTHEST)
    if len(far):
        raise InputError(
            f"vertex {far[0]} is {in_words(points[far[0]])}: "
            f"coordinates up to {FARTHEST:g} are allowed"
        )
    points.flags.writeable = False
    return points


def cut(
    vertices: npt.ArrayLike,
    boundary: Sequence[str],
    arcs: Mapping[int, Sequence[float]],
    size: float,
) -> tuple[FloatArray, tuple[str, ...], tuple[int, ...]]:
    """Cut the edges that are circular arcs into straight facets with their ends on the arc.

    The facets of an arc are equal, no longer than `size`, and turn by `TURN` at most.

    Args:
        vertices: Shape (n, 2), two at least.
        boundary: A label for every edge.
        arcs: A point between the ends that the arc of an edge passes through, by edge.
        size: Facet length wanted.

    Returns:
        The vertices, labels of the edges, and the edge that each was cut from.

    Raises:
        InputError: There is no such edge, or no such arc, or it would have too many facets.
    """
    corners = coordinates(vertices, 2 if arcs else 3)
    check_labels(boundary, len(corners), boundary)
    for edge in arcs:
        if edge not in range(len(corners)):
            raise InputError(f"there is no edge {edge}: they are 0 to {len(corners) - 1}")
    pieces = []
    for edge, (start, end) in enumerate(zip(corners, np.roll(corners, -1, axis=0), strict=True)):
        piece = start[None]
        if edge in arcs:
            with naming(f"the arc of edge {edge}"):
                piece = _arc(start, _one(arcs[edge]), end, size)
        pieces.append(piece)
    edges = [edge for edge, piece in enumerate(pieces) for _ in piece]
    return np.concatenate(pieces), tuple(boundary[edge] for edge in edges), tuple(edges)


def circle(center: Sequence[float], radius: float, size: float) -> FloatArray:
    """Cut a circle into facets like those of `cut`; their ends, shape (n, 2)."""
    radius = to_float("the radius", radius)
    if not 0.0 < radius < math.inf:
        raise InputError(f"the radius is {radius}: a positive number is needed")
    return _turned(_one(center), radius, 0.0, 2 * math.pi, size)


def _one(point: Sequence[float]) -> FloatArray:
    """Return a point as an array, shape (2,)."""
    try:
        x = np.array(point, dtype=np.float64)
    except (TypeError, ValueError):
        x = np.empty(0)
    if x.shape != (2,) or not np.abs(x).max() <= FARTHEST:
        raise InputError(f"a point [x, y] of numbers up to {FARTHEST:g} is needed, found {point}")
    return x


def _arc(start: FloatArray, through: FloatArray, end: FloatArray, size: float) -> FloatArray:
    """Compute the ends of an arc's facets, its own end left out."""
    d, e = through - start, end - start
    d2, e2, area = d @ d, e @ e, cross(d, e)
    if abs(area) <= 1e-9 * max(d2, e2):
        raise InputError(
            f"no circle passes through {in_words(start)}, {in_words(through)} and"
            f" {in_words(end)}; a point between its ends and beside the straight line is needed"
        )
    offset = np.array([e[1] * d2 - d[1] * e2, d[0] * e2 - e[0] * d2]) / (2 * area)
    first, last = (math.atan2(x[1], x[0]) for x in (-offset, e - offset))
    turn = (last - first) % (2 * math.pi)
    if area < 0:  # clockwise
        turn -= 2 * math.pi
    points = _turned(start + offset, float(np.hypot(*offset)), first, turn, size)
    points[0] = start
    return points


def _turned(
    center: FloatArray, radius: float, first: float, turn: float, size: float
) -> FloatArray:
    """Compute points at equal angles from `first` on, as many as there are to be facets."""
    size = to_float("size", size)
    if not size > 0.0:
        raise InputError(f"size is {size}: a positive number is needed")
    number = abs(turn) * max(radius / size, 1 / TURN)
    if number > MOST_FACETS:
        raise InputError(f"at the size {size:g} it has more than {MOST_FACETS} facets")
    number = max(math.ceil(number - 1e-9), 1)
    angles = first + turn * np.arange(number) / number
    return center + radius * np.stack([np.cos(angles), np.sin(angles)], axis=1)


def diameter(points: FloatArray) -> float:
    """Compute the largest distance between two points; they are opposite corners of their hull.

    Corners are opposite where parallels touch the hull, one at each. Sides are turned through, and
    what lies across the middle of a parallel side is found with its neighbours.

    Args:
        points: Shape (n, 2), not all the same.
    """
    away = points - points[0]
    try:
        hull = points[ConvexHull(away / np.abs(away).max()).vertices]  # counterclockwise
    except QhullError:  # they lie on a line
        longest = away[:, np.ptp(away, axis=0).argmax()]
        hull = points[[longest.argmin(), longest.argmax()]]
    sides = np.roll(hull, -1, axis=0) - hull
    angle = np.unwrap(np.arctan2(sides[:, 1], sides[:, 0]))
    turned = np.maximum.accumulate(np.concatenate([angle, angle + 2 * math.pi]))
    opposite = np.searchsorted(turned, angle + math.pi)
    corner = np.arange(len(hull))
    return max(
        float(
            np.hypot(*(hull[(corner + a) % len(hull)] - hull[(opposite + b) % len(hull)]).T).max()
        )
        for a in (0, 1)
        for b in (-1, 0, 1)
    )


def check_labels(labels: Sequence[str], edges: int, allowed: Sequence[str]) -> None:
    """Insist on one of the allowed labels for each edge."""
    if len(labels) != edges:
        raise InputError(
            f"{len(labels)} boundary labels for {edges} edges: one for each edge is needed"
        )
    for i, label in enumerate(labels):
        if label not in allowed:
            raise InputError(f"edge {i} is labelled {label!r}: allowed are {', '.join(allowed)}")


def check_loops(loops: Sequence[FloatArray], edges: Sequence[Sequence[int]] | None = None) -> None:
    """Insist on simple loops, apart from each other, the first around all the others.

    Edges touch if they come closer than 1e-12 of the polygon's extent.

    Args:
        loops: Vertices of the polygon and of each hole, shapes (n, 2).
        edges: What edges are called in messages, where it is not by their places in the loops.
    """
    number = sum(map(len, loops))
    if number > MOST_EDGES:
        raise InputError(f"there are {number} edges; {MOST_EDGES} are allowed")
    near = 1e-12 * np.ptp(loops[0], axis=0).max()
    of_all = _Edges.of(loops, edges)
    _check_corners(of_all, near)
    _check_meetings(of_all, near)
    _check_holes(loops)


@dataclass(frozen=True, eq=False)
class _Edges:
    """The edges of loops, one loop after the other; edge i begins in vertex i.

    Attributes:
        start: Where they begin, shape (n, 2).
        end: Where they end, shape (n, 2).
        after: The edge that begins there, shape (n,).
        loop: The loop that each is of, shape (n,).
        called: What each is called, shape (n,).
    """

    start: FloatArray
    end: FloatArray
    after: IndexArray
    loop: IndexArray
    called: IndexArray

    @classmethod
    def of(cls, loops: Sequence[FloatArray], called: Sequence[Sequence[int]] | None) -> _Edges:
        """Take the edges of all loops together; see `check_loops`."""
        places = [np.arange(len(loop)) for loop in loops]
        first = np.cumsum([0, *map(len, loops[:-1])])
        after = np.concatenate([k + np.roll(at, -1) for k, at in zip(first, places, strict=True)])
        start = np.concatenate(loops)
        loop = np.repeat(np.arange(len(loops)), [len(at) for at in places])
        names = np.concatenate([np.asarray(each) for each in called or places])
        return cls(start, start[after], after, loop, names)

    def vertex(self, i: int) -> str:
        """Name a vertex; that between two facets of an arc is one of the arc's points."""
        (before,) = np.flatnonzero(self.after == i)
        on_arc = self.called[before] == self.called[i]
        kind = "the point of edge" if on_arc else "vertex"
        return f"{kind} {self.called[i]}{self._where(i)} at {in_words(self.start[i])}"

    def edge(self, i: int) -> str:
        """Name an edge."""
        return f"edge {self.called[i]}{self._where(i)}"

    def _where(self, i: int) -> str:
        return f" of hole {self.loop[i] - 1}" if self.loop[i] else ""


def _check_corners(edges: _Edges, near: float) -> None:
    """Refuse two vertices at the same point."""
    x, y = np.ascontiguousarray(edges.start.T)
    for i in range(len(x)):
        same = i + 1 + np.flatnonzero(np.abs(x[i + 1 :] - x[i]) <= near)
        same = same[np.abs(y[same] - y[i]) <= near]
        if len(same):
            raise InputError(f"{edges.vertex(i)} is the same point as {edges.vertex(same[0])}")


def _check_meetings(edges: _Edges, near: float) -> None:
    """Refuse vertices that lie on edges of others, and edges that cross."""
    start, end = edges.start, edges.end
    left, bottom = np.ascontiguousarray(np.minimum(start, end).T) - near
    right, top = np.ascontiguousarray(np.maximum(start, end).T) + near
    for i, (a, b) in enumerate(zip(start, end, strict=True)):
        # a look at those alone whose boxes meet, which are few where there are many
        at = np.flatnonzero((left <= right[i]) & (right >= left[i]))
        at = at[(bottom[at] <= top[i]) & (top[at] >= bottom[i])]
        c, d = start[at], end[at]
        away = distance(a, c, d)
        away[(at == i) | (edges.after[at] == i)] = np.inf
        if away.min() <= near:
            raise InputError(f"{edges.vertex(i)} lies on {edges.edge(at[away.argmin()])}")
        crossed = crossing(a, b, c, d)
        if crossed.any():
            raise InputError(f"{edges.edge(i)} crosses {edges.edge(at[crossed.argmax()])}")


def _check_holes(loops: Sequence[FloatArray]) -> None:
    """Refuse holes outside of the polygon, and inside of others, where none cross."""
    first = np.stack([loop[0] for loop in loops])
    outside = ~inside(first[1:], loops[0])
    if outside.any():
        raise InputError(f"hole {outside.argmax()} lies outside the polygon")
    for j, loop in enumerate(loops[1:], start=1):
        at = np.flatnonzero(((first >= loop.min(axis=0)) & (first <= loop.max(axis=0))).all(axis=1))
        at = at[(at > 0) & (at != j)]
        within = at[inside(first[at], loop)]
        if len(within):
            raise InputError(f"hole {within[0] - 1} lies inside hole {j - 1}")


def inside(points: FloatArray, loop: FloatArray) -> BoolArray:
    """Tell which points, not on the loop, lie inside: a ray to the right crosses it oddly often.

    Args:
        points: Shape (n, 2).
        loop: Vertices of a polygon, shape (m, 2).
    """
    found = np.zeros(len(points), dtype=bool)
    for a, b in zip(loop, np.roll(loop, -1, axis=0), strict=True):
        spans = (a[1] > points[:, 1]) != (b[1] > points[:, 1])
        if spans.any():
            hit = a[0] + (points[spans, 1] - a[1]) / (b[1] - a[1]) * (b[0] - a[0])
            found[spans] ^= hit > points[spans, 0]
    return found
