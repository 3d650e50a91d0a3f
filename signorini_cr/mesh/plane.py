"""Points, vectors and segments of the plane: which way they turn, cross and lie, and in words.

Arrays of points and vectors have shape (…, 2), in any unit of length, and are broadcast; what is
computed of each has shape (…).
"""

from __future__ import annotations

import numpy as np

from ..arrays import BoolArray, FloatArray


def cross(u: FloatArray, v: FloatArray) -> FloatArray:
    """Compute u₁v₂ − u₂v₁, the signed area that two vectors span: above 0 where v is to the left.

    More components than two do not count.
    """
    product: FloatArray = u[..., 0] * v[..., 1] - u[..., 1] * v[..., 0]
    return product


def angle(u: FloatArray, v: FloatArray) -> FloatArray:
    """Compute the angle from u to v, counterclockwise, in radians from −π to π."""
    return np.arctan2(cross(u, v), (u * v).sum(axis=-1))


def side(a: FloatArray, b: FloatArray, x: FloatArray, near: float = 0.0) -> FloatArray:
    """Tell on which side of the line from a to b a point lies: 1 left, −1 right, 0 on it.

    Args:
        a: Where the line begins.
        b: Where it ends.
        x: The point.
        near: Distance from the line, in parts of the lengths at hand, that counts as none.
    """
    u, v = b - a, x - a
    turn = cross(u, v)
    if near:
        scale = np.abs(u[..., 0] * v[..., 1]) + np.abs(u[..., 1] * v[..., 0])
        scale += np.hypot(u[..., 0], u[..., 1]) * np.hypot(v[..., 0], v[..., 1])
        turn = np.where(np.abs(turn) > near * scale, turn, 0.0)
    return np.sign(turn)


def crossing(
    a: FloatArray, b: FloatArray, c: FloatArray, d: FloatArray, near: float = 0.0
) -> BoolArray:
    """Tell whether segments ab and cd have one point inside both in common; near as in `side`."""
    parted = side(a, b, c, near) * side(a, b, d, near) < 0
    return parted & (side(c, d, a, near) * side(c, d, b, near) < 0)


def share(a: FloatArray, b: FloatArray, x: FloatArray) -> FloatArray:
    """Compute how far along from a, 0, to b, 1, the feet of points on lines are; a is not b."""
    along = b - a
    return ((x - a) * along).sum(axis=-1) / (along**2).sum(axis=-1)


def distance(x: FloatArray, a: FloatArray, b: FloatArray) -> FloatArray:
    """Compute how far points are from segments from a to b, which is not a."""
    t = np.clip(share(a, b, x), 0, 1)[..., None]
    return np.linalg.norm(a + t * (b - a) - x, axis=-1)


def in_words(x: FloatArray) -> str:
    """Write a point, of space as well, for a message."""
    return "(" + ", ".join(f"{value:g}" for value in x) + ")"


def ends_in_words(ends: FloatArray) -> str:
    """Write the ends of a segment, shape (2, 2), for a message."""
    return f"from {in_words(ends[0])} to {in_words(ends[1])}"
