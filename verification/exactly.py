"""Distances from a known solution, integrated by rules of our own.

Triangles are split along the lines where the solution's gradient is not smooth, and cut smaller
towards points where it has no bound or bends sharply; the rules are products of Gauss's, exact for
polynomials of the degrees that occur. Of the program the coordinates of the cells and the values
of u_h at the facets are taken.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import Any

import numpy as np
import numpy.typing as npt

from signorini_cr import Solution

FloatArray = npt.NDArray[Any]
IntArray = npt.NDArray[Any]
Line = tuple[float, float, float]
"""n_x, n_y and c: where n·x = c."""
Corner = tuple[float, float, float]
"""x, y and the size down to which cells that are nearer than their size are cut."""

GAUSS = 8
"""Points in each direction: exact to degree 14."""
DEEPEST = 40
"""Times that a triangle is cut in four at most."""


def split(triangles: FloatArray, owner: IntArray, line: Line) -> tuple[FloatArray, IntArray]:
    """Cut the triangles that a line crosses.

    Args:
        triangles: Vertices, shape (n, 3, 2).
        owner: The cell each is a part of, shape (n,).
        line: The line.
    """
    side = triangles @ np.array(line[:2]) - line[2]
    side[abs(side) < 1e-13] = 0.0
    crossed = (side.min(axis=1) < 0) & (side.max(axis=1) > 0)
    cut, d, mine = triangles[crossed], side[crossed], owner[crossed]
    positive = d > 0
    alone = np.where(positive.sum(axis=1) == 1, positive.T, ~positive.T).T
    first = np.argmax(alone, axis=1)
    order = (first[:, None] + np.arange(3)) % 3
    v = np.take_along_axis(cut, order[..., None], axis=1)
    d = np.take_along_axis(d, order, axis=1)
    ends = [
        v[:, 0] + (d[:, 0] / (d[:, 0] - d[:, k]))[:, None] * (v[:, k] - v[:, 0]) for k in (1, 2)
    ]
    pieces = [
        np.stack([v[:, 0], ends[0], ends[1]], axis=1),
        np.stack([ends[0], v[:, 1], v[:, 2]], axis=1),
        np.stack([ends[0], v[:, 2], ends[1]], axis=1),
    ]
    return (
        np.concatenate([triangles[~crossed], *pieces]),
        np.concatenate([owner[~crossed], mine, mine, mine]),
    )


def refine_towards(
    triangles: FloatArray, owner: IntArray, corner: Corner
) -> tuple[FloatArray, IntArray]:
    """Cut triangles in four as long as they are larger than their distance from a point."""
    done, owners = [], []
    point = np.array(corner[:2])
    for _ in range(DEEPEST):
        middle = triangles.mean(axis=1)
        size = np.linalg.norm(triangles - middle[:, None], axis=2).max(axis=1)
        near = np.linalg.norm(middle - point, axis=1) < 3 * size
        near &= size > corner[2]
        done.append(triangles[~near])
        owners.append(owner[~near])
        a, b, c = triangles[near].transpose(1, 0, 2)
        ab, bc, ca = (a + b) / 2, (b + c) / 2, (c + a) / 2
        triangles = np.concatenate(
            [np.stack(t, axis=1) for t in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))]
        )
        owner = np.tile(owner[near], 4)
        if not len(owner):
            break
    return np.concatenate([*done, triangles]), np.concatenate([*owners, owner])


def rule(points: int = GAUSS) -> tuple[FloatArray, FloatArray]:
    """Barycentric points and weights that add up to 1: Gauss's rules on a square, collapsed."""
    t, w = np.polynomial.legendre.leggauss(points)
    s: FloatArray = (t + 1) / 2
    a, b = (x.ravel() for x in np.meshgrid(s, s, indexing="ij"))
    weights = 2 * np.outer(w / 2 * s, w / 2).ravel()
    return np.column_stack([1 - a, a * (1 - b), a * b]), weights


class Pieces:
    """The cells of this rank in pieces on which a known function is smooth."""

    def __init__(self, points: FloatArray, lines: Sequence[Line], corners: Sequence[Corner]):
        """Cut cells of the given vertices, shape (n, 3, 2)."""
        triangles: FloatArray = points
        owner: IntArray = np.arange(len(points))
        for line in lines:
            triangles, owner = split(triangles, owner, line)
        for corner in corners:
            triangles, owner = refine_towards(triangles, owner, corner)
        e, d = triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
        area = abs(e[:, 0] * d[:, 1] - e[:, 1] * d[:, 0]) / 2
        hats, self.weights = rule()
        at = np.einsum("qi,nik->nqk", hats, triangles)
        self.x, self.y, self.area, self.owner = at[..., 0], at[..., 1], area, owner

    def integral(self, values: FloatArray) -> float:
        """The integral over all pieces of values at their points, shape (pieces, q)."""
        return float(self.area @ (values @ self.weights))


def slopes(solution: Solution) -> tuple[FloatArray, FloatArray]:
    """Vertices of this rank's cells, shape (n, 3, 2), and ∇u_h on them, shape (n, 2)."""
    mesh, V = solution.domain.mesh, solution.u.function_space
    owned = mesh.topology.index_map(2).size_local
    geometry = mesh.geometry
    nodes = geometry.dofmaps[0] if hasattr(geometry, "dofmaps") else geometry.dofmap
    p = geometry.x[nodes[:owned], :2]
    values = solution.u.x.array[V.dofmap.list[:owned]]
    edge = np.roll(p, -2, axis=1) - np.roll(p, -1, axis=1)
    twice = edge[:, 0, 0] * edge[:, 1, 1] - edge[:, 0, 1] * edge[:, 1, 0]
    hats = np.stack([-edge[..., 1], edge[..., 0]], axis=2) / twice[:, None, None]
    return p, np.einsum("ni,nik->nk", values, -2 * hats)


Gradient = Callable[[Any, Any], tuple[Any, Any]]


def graded(
    start: FloatArray, end: FloatArray, breaks: Sequence[float]
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Points and weights on an edge, graded towards some of its points.

    Args:
        start: Where the edge begins, shape (2,).
        end: Where it ends.
        breaks: Parameters in (0, 1) where the integrand is not smooth.
    """
    t, w = np.polynomial.legendre.leggauss(12)
    knots = np.unique(np.concatenate([[0.0, 1.0], [b for b in breaks if 0 < b < 1]]))
    share = 0.5 ** np.arange(1, 45)
    share = np.concatenate([[0.0], share[::-1], 1 - share[1:], [1.0]])
    marks = [a + (b - a) * share for a, b in pairwise(knots)]
    ends = np.unique(np.concatenate(marks))
    length = np.diff(ends)
    at = (ends[:-1, None] + length[:, None] * (t + 1) / 2).ravel()
    weights = (length[:, None] * w / 2).ravel() * np.linalg.norm(end - start)
    x, y = (start[k] + at * (end[k] - start[k]) for k in (0, 1))
    return x, y, weights
