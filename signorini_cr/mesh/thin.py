"""Cells that are too thin for the matrices of a finite element, or have no volume at all."""

from __future__ import annotations

import numpy as np

from ..arrays import FloatArray

THINNEST = 1e6
"""Lengths by heights that are possible.

A gradient on such a cell is the difference of two that are as many times larger; an entry of a_h's
matrix has the square of that, of which rounding leaves four digits here, and none from 10⁸ on.
"""


def thinness(corners: FloatArray) -> FloatArray:
    """Compute how many times as long as their least height cells are, inf without any.

    Args:
        corners: Of triangles or tetrahedra, shape (n, d + 1, d).

    Returns:
        Shape (n,).
    """
    one, other = np.triu_indices(corners.shape[1], 1)
    longest = np.linalg.norm(corners[:, one] - corners[:, other], axis=2).max(axis=1)
    spans = corners[:, 1:] - corners[:, :1]
    if corners.shape[2] == 2:
        widest = longest
        volume = spans[:, 0, 0] * spans[:, 1, 1] - spans[:, 0, 1] * spans[:, 1, 0]
    else:
        normals = np.cross(spans, np.roll(spans, 1, axis=1))
        facing = normals.sum(axis=1, keepdims=True)
        widest = np.linalg.norm(np.append(normals, facing, axis=1), axis=2).max(axis=1)
        volume = (spans[:, 2] * normals[:, 1]).sum(axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        found = longest * widest / np.abs(volume)
    return np.where(np.isnan(found), np.inf, found)


def too_thin(corners: FloatArray) -> str | None:
    """Say which cell is thinner than `THINNEST`, and where, if any is.

    Args:
        corners: Of triangles or tetrahedra, shape (n, d + 1, d).
    """
    found = thinness(corners)
    bad = np.flatnonzero(~(found <= THINNEST))
    if not len(bad):
        return None
    ratio, place = found[bad[0]], ", ".join(f"{x:g}" for x in corners[bad[0], 0])
    kind = "triangle" if corners.shape[2] == 2 else "tetrahedron"
    # rounding may leave a little where there is nothing
    if ratio > 1e13:
        return f"the {kind} at ({place}) has no {'area' if kind == 'triangle' else 'volume'}"
    return (
        f"the {kind} at ({place}) is {ratio:.2g} times as long as it is high: up to"
        f" {THINNEST:.0e} times is possible"
    )
