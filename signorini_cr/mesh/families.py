"""Families of meshes on a polygon: structured, mapped, and with vertices moved at random.

Unstructured ones come from gmsh, `Polygon.mesh`. All are made on one rank and then shared out,
so that they are the same whatever the number of ranks.
"""

from __future__ import annotations

import numpy as np
from mpi4py import MPI

from ..arrays import FloatArray, Int32Array, Int64Array
from ..errors import InputError, insist_on_kind, to_float
from .domain import Domain, Polygon, distribute
from .gmshmesh import Triangulation
from .plane import distance
from .polygon import inside


def structured(
    polygon: Polygon,
    n: int,
    comm: MPI.Comm = MPI.COMM_WORLD,
    *,
    shift: float = 0.0,
    jitter: float = 0.0,
    seed: int = 0,
) -> Domain:
    """Mesh a polygon by squares of side 1/n, each cut in two by its rising diagonal; collective.

    Refining such a mesh gives the one with 2 n. With ``shift`` it is mapped by

        x ↦ x + shift (1 − x²)

    (the middle of the polygon and half its width taken for 0 and 1), so that points which the
    squares have at a corner come to lie inside a facet. With ``jitter`` every vertex is moved at
    random by up to so many sides of a square in x and in y; one on the boundary along its edge
    only, and the polygon's own vertices stay.

    Args:
        polygon: Its edges must lie on the squares' sides.
        n: Squares per unit length.
        comm: The ranks that share the mesh.
        shift: Less than ½ in absolute value.
        jitter: Less than ¼.
        seed: Different seeds give different movements.

    Raises:
        InputError: The polygon doesn't consist of such squares, or a number is out of range.
    """
    insist_on_kind("polygon", polygon, Polygon, "a Polygon")
    number = to_float("n", n, "a number of squares")
    if not 1.0 <= number < np.inf:
        raise InputError(f"n is {n}: a mesh has 1 square or more per unit length")
    shift, jitter = to_float("shift", shift), to_float("jitter", jitter)
    if not abs(shift) < 0.5 or not 0.0 <= jitter < 0.25:
        raise InputError(
            f"shift is {shift} and jitter {jitter}: less than 0.5 and 0.25 keep triangles upright"
        )
    if polygon.materials:
        raise InputError("squares do not follow the edges of materials; Polygon.mesh does")
    return distribute(comm, polygon.parts, {}, _squares, polygon, number, shift, jitter, seed)


def _squares(polygon: Polygon, n: float, shift: float, jitter: float, seed: int) -> Triangulation:
    polygon.check_parts()
    starts, ends, labels = _edges(polygon)
    low, high = polygon.vertices.min(axis=0), polygon.vertices.max(axis=0)
    number = np.rint((high - low) * n).astype(np.int64)
    grid = (starts - low) * n
    flat = np.isclose(starts, ends, rtol=0, atol=1e-12).any(axis=1)
    if not (np.allclose(grid, np.rint(grid), atol=1e-9) and flat.all()):
        raise InputError(
            f"the polygon's edges don't lie on squares of side 1/{n:g}: give a polygon of upright "
            "and level edges, and an n that its vertices fit"
        )
    points, triangles = _grid(*number)
    points = low + points * ((high - low) / number)
    middles = points[triangles].mean(axis=1)
    within = inside(middles, polygon.vertices)
    for hole in polygon.holes:
        within &= ~inside(middles, hole.vertices)
    used, triangles = np.unique(triangles[within], return_inverse=True)
    points, triangles = points[used], triangles.reshape(-1, 3)
    facets = _boundary(triangles)
    # that each lies on, or is nearest to
    edge = distance(points[facets].mean(axis=1)[:, None], starts, ends).argmin(axis=1)
    if jitter:
        points = points + _moves(
            points, facets, ends[edge] - starts[edge], polygon, n, jitter, seed
        )
    if shift:
        middle, half = 0.5 * (low[0] + high[0]), 0.5 * (high[0] - low[0])
        points[:, 0] += shift * half * (1.0 - ((points[:, 0] - middle) / half) ** 2)
        _require_kept(polygon, middle, half)
    return Triangulation(points, triangles, facets, labels[edge])


def _grid(columns: int, rows: int) -> tuple[FloatArray, Int64Array]:
    """Make squares of side 1, in two triangles each: their corners, and those of each triangle."""
    i, j = (index.ravel() for index in np.meshgrid(np.arange(columns), np.arange(rows)))
    corner = i + (columns + 1) * j
    right, up, across = corner + 1, corner + columns + 1, corner + columns + 2
    triangles = np.stack([corner, right, across, corner, across, up], axis=1).reshape(-1, 3)
    x, y = np.meshgrid(np.arange(columns + 1.0), np.arange(rows + 1.0))
    return np.stack([x.ravel(), y.ravel()], axis=1), triangles


def _require_kept(polygon: Polygon, middle: float, half: float) -> None:
    """Insist that no vertex lies between the polygon's left and right end: it would move."""
    loops = [polygon.vertices, *(hole.vertices for hole in polygon.holes)]
    if not np.allclose(np.abs(np.concatenate(loops)[:, 0] - middle), half):
        raise InputError("shift would move a vertex of the polygon: give a rectangle")


def _edges(polygon: Polygon) -> tuple[FloatArray, FloatArray, Int32Array]:
    """Return starts and ends of all edges, shapes (n, 2), and the numbers of their parts."""
    loops = [polygon, *polygon.holes]
    starts = np.concatenate([loop.vertices for loop in loops])
    ends = np.concatenate([np.roll(loop.vertices, -1, axis=0) for loop in loops])
    names = [name for loop in loops for name in loop.boundary]
    return starts, ends, np.array([polygon.parts[name] for name in names], dtype=np.int32)


def _boundary(triangles: Int64Array) -> Int64Array:
    """Find the ends of the facets of one triangle only, shape (facets, 2)."""
    facets = np.sort(triangles[:, [[1, 2], [0, 2], [0, 1]]].reshape(-1, 2), axis=1)
    unique, count = np.unique(facets, axis=0, return_counts=True)
    single: Int64Array = unique[count == 1]
    return single


def _moves(
    points: FloatArray,
    facets: Int64Array,
    along: FloatArray,
    polygon: Polygon,
    n: float,
    jitter: float,
    seed: int,
) -> FloatArray:
    """Draw random movements of the vertices that keep the polygon's shape.

    Args:
        points: The vertices, shape (points, 2).
        facets: Ends of the boundary facets, shape (facets, 2).
        along: Direction of the edge under each, level or upright, shape (facets, 2).
        polygon: Whose vertices stay.
        n: Squares per unit length.
        jitter: Largest movement, in squares.
        seed: Of the random numbers.
    """
    moves = np.random.default_rng(seed).uniform(-jitter / n, jitter / n, points.shape)
    for end in facets.T:
        moves[end] *= along != 0.0
    loops = [polygon.vertices, *(hole.vertices for hole in polygon.holes)]
    for corner in np.concatenate(loops):  # few
        moves[np.linalg.norm(points - corner, axis=1) < 0.5 / n] = 0.0
    return moves
