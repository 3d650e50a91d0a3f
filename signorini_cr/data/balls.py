"""Taylor polynomials in several variables whose coefficients are known to lie in balls.

A coefficient is a middle and a radius, for many polynomials at once; coefficients that are 0
everywhere are left out. Results are rounded outwards.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache, cached_property
from itertools import pairwise, product
from typing import TypeAlias

import numpy as np

from ..arrays import FloatArray

Rows = tuple[int, ...]
"""Places of coefficients in `indices`, in ascending order."""
_Term: TypeAlias = tuple[slice, slice, slice, bool]
"""Rows of two factors, the row of their product, and whether it is the first one there."""

ORDER = 3
"""The highest order."""
EPS = 4e-16
"""Relative error of +, −, ·, / and √, with room."""
LOOSE = 4e-15
"""The same of other functions, and of sums of a few products."""
TINY = 1e-300
"""Absolute error of numbers that are not 0 but below the normal ones, or on the way there."""


@cache
def indices(variables: int, order: int = ORDER) -> tuple[tuple[int, ...], ...]:
    """List the multi-indices of Taylor coefficients, by order, the value's first."""
    found = [k for k in product(range(order + 1), repeat=variables) if sum(k) <= order]
    return tuple(sorted(found, key=lambda k: (sum(k), [-i for i in k])))


@dataclass(frozen=True, eq=False)
class Balls:
    """Coefficients of polynomials.

    Attributes:
        rows: Which are not 0 everywhere.
        mid: Their middles, shape (len(rows), n) or (len(rows), 1).
        rad: Their radii, same shape; infinite, or NaN, where a coefficient has no bound.
    """

    rows: Rows
    mid: FloatArray
    rad: FloatArray

    def on(self, rows: Rows) -> tuple[FloatArray, FloatArray]:
        """Return middles and radii of these coefficients and of others, which are 0."""
        if rows == self.rows:
            return self.mid, self.rad
        mid, rad = np.zeros((2, len(rows), self.mid.shape[1]))
        there = np.searchsorted(rows, self.rows)
        mid[there], rad[there] = self.mid, self.rad
        return mid, rad

    def __neg__(self) -> Balls:
        """Negate the polynomials."""
        return Balls(self.rows, -self.mid, self.rad)

    def __add__(self, other: Balls) -> Balls:
        """Add polynomials."""
        if not self.rows or not other.rows:
            return self if self.rows else other
        rows = union(self.rows, other.rows)
        (a, of_a), (b, of_b) = self.on(rows), other.on(rows)
        mid = a + b
        return Balls(rows, mid, (of_a + of_b + EPS * np.abs(mid)) * (1 + 1e-15))

    def scaled(self, factor: float) -> Balls:
        """Multiply by a number."""
        lost = 0.0
        try:
            with np.errstate(under="raise"):
                mid, rad = factor * self.mid, abs(factor) * self.rad
        except FloatingPointError:
            mid, rad, lost = factor * self.mid, abs(factor) * self.rad, TINY
        return Balls(self.rows, mid, (rad + EPS * np.abs(mid)) * (1 + 1e-15) + lost)


NONE = Balls((), np.zeros((0, 1)), np.zeros((0, 1)))
"""The coefficients of 0."""


@dataclass(frozen=True, eq=False)
class Factor:
    """Coefficients that are to be multiplied.

    Attributes:
        rows: Which are not 0 everywhere.
        planes: Middles, their absolute values, and these plus radii, shape (3, len(rows), n); 0, 0
            and ∞ where there is no bound.
        bounded: Whether all coefficients have bounds.
    """

    rows: Rows
    planes: FloatArray
    bounded: bool

    @classmethod
    def of(cls, low: FloatArray, high: FloatArray, others: Balls) -> Factor:
        """Take a value between some bounds, shape (n,) or (), and coefficients of higher order."""
        mid = 0.5 * low + 0.5 * high
        shape = np.broadcast_shapes(mid.shape, others.mid.shape[1:])
        planes = np.empty((3, 1 + len(others.rows), *shape))
        planes[0, 0], planes[0, 1:] = mid, others.mid
        np.abs(planes[0], out=planes[1])
        planes[2, 0] = np.maximum(high - mid, mid - low) * (1 + 1e-15)
        planes[2, 1:] = others.rad
        planes[2] += planes[1]
        bounded = bool(np.isfinite(np.add.reduce(planes[2], axis=None)))
        if not bounded:
            bad = ~(planes[2] < np.inf)
            planes[:2, bad], planes[2, bad] = 0.0, np.inf
        return cls((0, *others.rows), planes, bounded)

    @cached_property
    def without_value(self) -> Factor:
        """The coefficients of higher order."""
        return Factor(self.rows[1:], self.planes[:, 1:], self.bounded)

    def times(self, other: Factor, variables: int, order: int) -> Balls:
        """Compute the coefficients of a product from the first order on, up to some order.

        With A = |a| + r a product's radius is A B − |a b|, and both of these are added up. 0 times
        what has no bound is 0.
        """
        terms, rows = _terms(variables, order, self.rows, other.rows)
        if not rows:
            return NONE
        try:
            with np.errstate(under="raise"):
                return Balls(rows, *self._times(other, terms, len(rows)))
        except FloatingPointError:
            mid, rad = self._times(other, terms, len(rows))
            return Balls(rows, mid, rad + TINY)

    def _times(
        self, other: Factor, terms: tuple[_Term, ...], rows: int
    ) -> tuple[FloatArray, FloatArray]:
        """Compute middles and radii of a product's coefficients, but for numbers below all."""
        shape = np.broadcast_shapes(self.planes.shape[2:], other.planes.shape[2:])
        total = np.empty((3, rows, *shape))
        bounded = self.bounded and other.bounded
        for i, j, k, first in terms:
            sums = total[:, k]
            some = np.multiply(self.planes[:, i], other.planes[:, j], out=sums if first else None)
            if not bounded:
                np.fmax(some[2], 0.0, out=some[2])
            if not first:
                sums += some
        mid, least, rad = total
        least -= LOOSE * rad
        rad -= least
        return mid, rad


@cache
def _terms(variables: int, order: int, left: Rows, right: Rows) -> tuple[tuple[_Term, ...], Rows]:
    """List the products in the coefficients of a product, from the first order on.

    Returns:
        Slices of rows: two to multiply, one of which at least is a single row, and those to add the
        products to, with whether they are the first that these get; and what these are.
    """
    every = indices(variables)
    sums = {}
    for i, j in product(left, right):
        index = tuple(p + q for p, q in zip(every[i], every[j], strict=True))
        if 0 < sum(index) <= order:
            sums[i, j] = every.index(index)
    rows = tuple(sorted(set(sums.values())))
    runs: list[list[tuple[int, int, int]]] = []
    firsts: list[bool] = []
    begun: set[int] = set()
    for i, j in sorted(sums, key=lambda pair: (pair[0] > 0, pair[1] > 0, *pair)):
        term = left.index(i), right.index(j), rows.index(sums[i, j])
        last = runs[-1][-2:] if runs else []
        steps = [
            tuple(q - p for p, q in zip(a, b, strict=True)) for a, b in pairwise([*last, term])
        ]
        is_first = term[2] not in begun
        begun.add(term[2])
        if steps and steps[0] == steps[-1] in ((0, 1, 1), (1, 0, 1)) and is_first == firsts[-1]:
            runs[-1].append(term)
        else:
            runs.append([term])
            firsts.append(is_first)
    terms = []
    for run, first in zip(runs, firsts, strict=True):
        a, b, target = (slice(p, q + 1) for p, q in zip(run[0], run[-1], strict=True))
        terms.append((a, b, target, first))
    return tuple(terms), rows


@cache
def union(a: Rows, b: Rows) -> Rows:
    """Join the rows of both."""
    return tuple(sorted({*a, *b}))


def middle(low: FloatArray, high: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Write a range as middle and radius."""
    mid = 0.5 * low + 0.5 * high
    return mid, np.maximum(high - mid, mid - low) * (1 + 1e-15)
