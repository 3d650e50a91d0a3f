"""Bounds of dofs from below and above; everything about contact is said of the nearer of the two.

A dof's gap is its distance from the nearer bound, its sign 1 where that is the lower and −1 where
it is the upper one. With s its sign, s (A u − b) is the force that pushes it off the bound, and so
a bound from above differs from one from below by a sign only.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..arrays import FloatArray


@dataclass(frozen=True, eq=False)
class Bounds:
    """The bounds of some dofs; of each dof one at least is finite.

    Attributes:
        lower: α, or −∞, shape (n,).
        upper: β, or ∞, shape (n,).
    """

    lower: FloatArray
    upper: FloatArray

    def sign(self, x: FloatArray) -> FloatArray:
        """Return 1 where the lower bound is nearer to x, else −1, shape (n,)."""
        return np.where(x - self.lower <= self.upper - x, 1.0, -1.0)

    def gap(self, x: FloatArray) -> FloatArray:
        """Compute how far x is from the nearer bound, below 0 beyond it, shape (n,)."""
        gap: FloatArray = np.minimum(x - self.lower, self.upper - x)
        return gap

    def on(self, sign: FloatArray) -> FloatArray:
        """Return the lower bound where a sign is 1, the upper where it is −1, shape (n,)."""
        return np.where(sign > 0.0, self.lower, self.upper)
