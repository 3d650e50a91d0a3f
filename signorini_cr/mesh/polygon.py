"""Checks of a polygon's edges: closed loops that neither cross nor touch."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from ..arrays import FloatArray
from ..errors import InputError

FARTHEST = 1e100
"""Largest coordinate: areas, and products of them, stay finite."""


def coordinates(vertices: npt.ArrayLike) -> FloatArray:
    """Vertices as a read-only array, shape (n, 2), if they are that and finite."""
    try:
        points = np.array(vertices, dtype=np.float64)
    except (TypeError, ValueError):
        points = np.empty(0)
    if points.ndim != 2 or points.shape[1] != 2:
        raise InputError("vertices are not a list of [x, y] pairs of numbers")
    if len(points) < 3:
        raise InputError(f"{len(points)} vertices: a polygon has at least 3")
    bad = np.flatnonzero(~np.isfinite(points).all(axis=1))
    if len(bad):
        raise InputError(f"vertex {bad[0]} is {_point(points[bad[0]])}: not a finite point")
    far = np.flatnonzero(np.abs(points).max(axis=1) > FARTHEST)
    if len(far):
        raise InputError(
            f"vertex {far[0]} is {_point(points[far[0]])}: "
            f"coordinates up to {FARTHEST:g} are allowed"
        )
    points.flags.writeable = False
    return points


def _point(x: FloatArray) -> str:
    return f"({x[0]:g}, {x[1]:g})"


def check_labels(labels: Sequence[str], edges: int, allowed: Sequence[str]) -> None:
    """Insist on one of the allowed labels for each edge."""
    if len(labels) != edges:
        raise InputError(
            f"{len(labels)} boundary labels for {edges} edges: one for each edge is needed"
        )
    for i, label in enumerate(labels):
        if label not in allowed:
            raise InputError(f"edge {i} is labelled {label!r}: allowed are {', '.join(allowed)}")


def check_loops(loops: Sequence[FloatArray]) -> None:
    """Insist on simple loops, apart from each other, the first around all the others.

    Edges touch if they come closer than 1e-12 of the polygon's extent.

    Args:
        loops: Vertices of the polygon and of each hole, shapes (n, 2).
    """
    a = np.concatenate(loops)
    sizes = np.array([len(loop) for loop in loops])
    starts = np.repeat(np.cumsum(sizes) - sizes, sizes)
    local = np.arange(len(a)) - starts
    ring = np.repeat(np.arange(len(loops)), sizes)
    after = starts + (local + 1) % np.repeat(sizes, sizes)
    b = a[after]
    near = 1e-12 * np.ptp(loops[0], axis=0).max()

    def vertex(i: int) -> str:
        return f"vertex {local[i]}{_where(ring[i])} at {_point(a[i])}"

    def edge(i: int) -> str:
        return f"edge {local[i]}{_where(ring[i])}"

    for i in range(len(a)):  # the polygon's own vertices: few
        same = np.flatnonzero(np.abs(a[i + 1 :] - a[i]).max(axis=1) <= near)
        if len(same):
            raise InputError(f"{vertex(i)} is the same point as {vertex(i + 1 + same[0])}")
    direction = b - a
    length2 = (direction**2).sum(axis=1)
    for i in range(len(a)):
        t = np.clip(((a[i] - a) * direction).sum(axis=1) / length2, 0, 1)
        gap = np.linalg.norm(a + t[:, None] * direction - a[i], axis=1)
        gap[(np.arange(len(a)) == i) | (after == i)] = np.inf
        if gap.min() <= near:
            raise InputError(f"{vertex(i)} lies on {edge(int(gap.argmin()))}")
        crossing = (_side(a[i], b[i], a) * _side(a[i], b[i], b) < 0) & (
            _side(a, b, a[i]) * _side(a, b, b[i]) < 0
        )
        if crossing.any():
            raise InputError(f"{edge(i)} crosses {edge(int(crossing.argmax()))}")
    for k in range(1, len(loops)):
        if not _inside(loops[k][0], loops[0]):
            raise InputError(f"hole {k - 1} lies outside the polygon")
        for j in range(1, len(loops)):
            if j != k and _inside(loops[k][0], loops[j]):
                raise InputError(f"hole {k - 1} lies inside hole {j - 1}")


def _where(ring: int) -> str:
    return f" of hole {ring - 1}" if ring else ""


def _side(a: FloatArray, b: FloatArray, x: FloatArray) -> FloatArray:
    """Sign of the area of the triangles a, b, x."""
    u, v = b - a, x - a
    return np.sign(u[..., 0] * v[..., 1] - u[..., 1] * v[..., 0])


def _inside(x: FloatArray, loop: FloatArray) -> bool:
    """Whether a point, not on the loop, lies inside: a ray to the right crosses it oddly often."""
    a, b = loop, np.roll(loop, -1, axis=0)
    spans = (a[:, 1] > x[1]) != (b[:, 1] > x[1])
    a, b = a[spans], b[spans]
    hit = a[:, 0] + (x[1] - a[:, 1]) / (b[:, 1] - a[:, 1]) * (b[:, 0] - a[:, 0])
    return bool(np.count_nonzero(hit > x[0]) % 2)
