"""Test that triangles and tetrahedra can be cells: not too thin, and beside one another."""

from __future__ import annotations

import numpy as np
from dolfinx.mesh import Mesh, compute_midpoints

from ..arrays import FloatArray
from ..compat import cell_nodes
from .plane import cross, in_words
from .shared import shared_sum

THINNEST = 1e6
"""Lengths by heights that are possible.

A gradient on such a cell is the difference of two that are as many times larger; an entry of a_h's
matrix has the square of that, of which rounding leaves four digits here, and none from 10⁸ on.
"""

SMALLEST = 1e-30
"""Lengths that are possible: of shorter ones, and of the finer meshes' made of them, products as
the certificate's would be lost."""


def thinness(corners: FloatArray) -> FloatArray:
    """Compute how many times as long as their least height cells are, inf without any.

    Args:
        corners: Of triangles or tetrahedra, shape (n, d + 1, d).

    Returns:
        Shape (n,).
    """
    one, other = np.triu_indices(corners.shape[1], 1)
    longest = np.linalg.norm(corners[:, one] - corners[:, other], axis=2).max(axis=1)
    spans, widest = corners[:, 1:] - corners[:, :1], longest
    if corners.shape[2] == 3:
        normals = np.cross(spans, np.roll(spans, 1, axis=1))
        facing = normals.sum(axis=1, keepdims=True)
        widest = np.linalg.norm(np.append(normals, facing, axis=1), axis=2).max(axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        found = longest * widest / np.abs(_determinants(spans))
    return np.where(np.isnan(found), np.inf, found)


def too_thin(corners: FloatArray, origin: FloatArray | None = None) -> str | None:
    """Say which cell is thinner than `THINNEST`, or shorter than `SMALLEST`, if any is.

    Args:
        corners: Of triangles or tetrahedra, shape (n, d + 1, d).
        origin: From where they are given, shape (d,); else from 0.
    """
    origin = np.zeros(corners.shape[2]) if origin is None else origin
    found = thinness(corners)
    length = np.abs(corners[:, 1:] - corners[:, :1]).max(axis=(1, 2))
    if len(small := np.flatnonzero(length < SMALLEST)) and length[small[0]] > 0.0:
        place = in_words(origin + corners[small[0], 0])
        return (
            f"the cell at {place} is {length[small[0]]:.2g} long: lengths"
            f" from {SMALLEST:g} on are possible, in other units perhaps"
        )
    bad = np.flatnonzero(~(found <= THINNEST))
    if not len(bad):
        return None
    ratio, place = found[bad[0]], in_words(origin + corners[bad[0], 0])
    kind = "triangle" if corners.shape[2] == 2 else "tetrahedron"
    # rounding may leave a little where there is nothing
    if ratio > 1e13:
        return f"the {kind} at {place} has no {'area' if kind == 'triangle' else 'volume'}"
    return (
        f"the {kind} at {place} is {ratio:.2g} times as long as it is high: up to"
        f" {THINNEST:.0e} times is possible"
    )


def folded(mesh: Mesh) -> str | None:
    """Say where two cells lie on the same side of their facet, if any do; collective.

    Args:
        mesh: It knows the facets of its cells.

    Returns:
        What the rank that owns such a facet has to say.
    """
    d, topology = mesh.topology.dim, mesh.topology
    of_facets, owned = topology.index_map(d - 1), topology.index_map(d).size_local
    corners = mesh.geometry.x[cell_nodes(mesh)[:owned], :d]
    turns = np.sign(_determinants(corners[:, 1:] - corners[:, :1]))
    facets, vertices = (
        topology.connectivity(d, k).array.reshape(-1, d + 1)[:owned] for k in (d - 1, 0)
    )
    numbers = topology.index_map(0).local_to_global(vertices.ravel()).reshape(vertices.shape)
    sides = np.zeros(of_facets.size_local + of_facets.num_ghosts)
    for i in range(d + 1):
        # the way around a facet that a cell gives it, against that of its vertices' numbers
        ends = np.delete(numbers, i, axis=1)
        way = np.prod(
            [np.sign(ends[:, k] - ends[:, j]) for j in range(d) for k in range(j)], axis=0
        )
        np.add.at(sides, facets[:, i], (-1) ** i * way * turns)
    shared_sum(mesh, of_facets, sides)
    bad = np.flatnonzero(np.abs(sides[: of_facets.size_local]) > 1.5).astype(np.int32)
    if not len(bad):
        return None
    place = in_words(compute_midpoints(mesh, d - 1, bad[:1])[0, :d])
    return f"cells overlap at the facet around {place}: both lie on the same side of it"


def _determinants(spans: FloatArray) -> FloatArray:
    """Compute determinants of small matrices, shape (n,), much faster than LAPACK does."""
    if spans.shape[1] == 2:
        return cross(spans[:, 0], spans[:, 1])
    volume: FloatArray = (spans[:, 0] * np.cross(spans[:, 1], spans[:, 2])).sum(axis=1)
    return volume
