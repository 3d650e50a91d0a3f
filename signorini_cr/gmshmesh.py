"""What needs gmsh: triangulating polygons and reading mesh files, on one rank, into arrays.

gmsh is loaded on first use, so a mesh of the user's own works without it.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from signorini_cr.errors import InputError

_MOST_TRIANGLES = 2e7
_LINE, _TRIANGLE = 1, 2  # gmsh's element types
_OPTIONS = {
    "General.Terminal": 0,
    "General.AbortOnError": 2,  # raise instead of going on
    "General.NumThreads": 1,  # the same mesh every time
    "Mesh.Algorithm": 6,  # Frontal-Delaunay: the best angles
    "Mesh.ElementOrder": 1,
    "Mesh.RandomSeed": 1,
    "Mesh.MeshSizeFromPoints": 0,
    "Mesh.MeshSizeFromCurvature": 0,
    "Mesh.MeshSizeExtendFromBoundary": 1,
    "Mesh.RecombineAll": 0,
}


class Triangulation(NamedTuple):
    """A triangle mesh as arrays, all on one rank.

    Attributes:
        points: Coordinates, shape (points, 2).
        triangles: Corners, shape (triangles, 3).
        facets: Ends of the labelled facets, shape (facets, 2).
        labels: Index of each facet's label, shape (facets,).
    """

    points: npt.NDArray[np.float64]
    triangles: npt.NDArray[np.int64]
    facets: npt.NDArray[np.int64]
    labels: npt.NDArray[np.int32]


@contextmanager
def _session() -> Iterator[Any]:
    """A silent gmsh with an empty model; a session of the user's own is left as it was."""
    import gmsh

    ours = not gmsh.isInitialized()
    if ours:
        gmsh.initialize(argv=[], readConfigFiles=False, interruptible=False)
        current = None
        before = {}
    else:
        current = gmsh.model.getCurrent()
        before = {name: gmsh.option.getNumber(name) for name in _OPTIONS}
    try:
        for name, value in _OPTIONS.items():
            gmsh.option.setNumber(name, value)
        gmsh.model.add("signorini_cr")
        yield gmsh
    finally:
        if ours:
            gmsh.finalize()
        else:
            gmsh.model.remove()
            gmsh.model.setCurrent(current)
            for name, value in before.items():
                gmsh.option.setNumber(name, value)


def triangulate(
    loops: Sequence[npt.NDArray[np.float64]], labels: npt.NDArray[np.int32], size: float
) -> Triangulation:
    """Triangulate a polygon with holes; its vertices become mesh vertices.

    Args:
        loops: Vertices of the polygon and of each hole, shapes (n, 2).
        labels: Label of every edge, one loop after the other.
        size: Facet length wanted; shorter edges get one facet.
    """
    ends = np.concatenate([np.roll(loop, -1, axis=0) for loop in loops])
    lengths = np.linalg.norm(ends - np.concatenate(loops), axis=1)
    counts = np.maximum(1, np.ceil(lengths / size - 1e-9))
    if counts.sum() > _MOST_TRIANGLES:
        raise _too_fine(size)
    with _session() as gmsh:
        geo = gmsh.model.geo
        curves: list[int] = []
        rings = []
        for loop in loops:
            points = [geo.addPoint(x, y, 0.0) for x, y in loop]
            lines = [geo.addLine(a, b) for a, b in zip(points, points[1:] + points[:1])]
            rings.append(geo.addCurveLoop(lines))
            curves += lines
        geo.addPlaneSurface(rings)
        for curve, count in zip(curves, counts):
            geo.mesh.setTransfiniteCurve(curve, int(count) + 1)
        geo.synchronize()
        before = gmsh.option.getNumber("Mesh.MeshSizeMax")
        gmsh.option.setNumber("Mesh.MeshSizeMax", size)
        try:
            gmsh.model.mesh.generate(2)
        except Exception as error:
            raise InputError(f"gmsh could not triangulate the polygon: {error}") from error
        finally:
            gmsh.option.setNumber("Mesh.MeshSizeMax", before)
        facets = [_elements(gmsh, 1, _LINE, curve) for curve in curves]
        return _compact(
            gmsh,
            _elements(gmsh, 2, _TRIANGLE),
            np.concatenate(facets),
            np.repeat(labels, [len(ends) for ends in facets]),
        )


def _elements(gmsh: Any, dim: int, kind: int, entity: int = -1) -> npt.NDArray[np.int64]:
    """Node tags of the elements of one type, shape (elements, dim + 1)."""
    tags = gmsh.model.mesh.getElementsByType(kind, entity)[1]
    return tags.astype(np.int64).reshape(-1, dim + 1)


def _compact(
    gmsh: Any,
    triangles: npt.NDArray[np.int64],
    facets: npt.NDArray[np.int64],
    labels: npt.NDArray[np.int32],
) -> Triangulation:
    """Renumber gmsh's node tags from 0, leaving out the nodes of no triangle."""
    tags, points, _ = gmsh.model.mesh.getNodes()
    used, corners = np.unique(triangles, return_inverse=True)
    order = np.argsort(tags)
    rows = order[np.searchsorted(tags, used, sorter=order)]
    position = np.searchsorted(used, facets)
    return Triangulation(
        points.reshape(-1, 3)[rows, :2].copy(),
        corners.reshape(triangles.shape),
        position,
        labels.astype(np.int32),
    )


def _too_fine(size: float) -> InputError:
    return InputError(f"size is {size}: that asks for more than {_MOST_TRIANGLES:.0e} triangles")
