"""Distances of data from polynomials, on every cell and facet: enclosed, not sampled.

On a simplex T, data are within R of some quadratic polynomial, and within W ≤ R of a cubic one.
Both follow from the jets on a box around T.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import ufl

from ..arrays import BoolArray, FloatArray
from ..fem.cells import Cells, blocks
from ..fem.pointwise import Unknown
from .balls import indices
from .germs import allowance, holders, may_be_singular, singular_points
from .jets import (
    STRIP,
    Boxes,
    Enclosure,
    Jet,
    Range,
    differences,
    has_conditions,
    is_local,
    lowered,
    values,
)
from .pieces import EDGES, Levels, Pieces

Errors = Callable[[Boxes, FloatArray], FloatArray]
"""Function for errors of data on boxes and simplices of given half extents; shape (rows, n)."""
CHUNK = 1 << 12
"""Boxes that are worked on at a time."""
BESIDE = 1e-7
"""Distance of a point of a piece from another one beside it, in parts of the piece."""
_CUBIC = {1: 1.0, 2: 0.5, 3: 0.25}
"""Distance on [−1, 1]^m of xyz, x²y and x³ from quadratics, by the largest exponent."""


def range_of(expression: ufl.core.expr.Expr, cells: Cells) -> Range | None:
    """Bound an expression below and above on each owned cell, shapes (cells,) or ().

    Args:
        expression: A scalar.
        cells: The mesh.

    Returns:
        None if the expression holds an operator whose range is not known, or has no bound.
    """
    return range_on(expression, Pieces.of_cells(cells), cells)


def range_on(expression: ufl.core.expr.Expr, whole: Pieces, cells: Cells) -> Range | None:
    """Bound an expression below and above on pieces, shapes (n,); see `range_of`."""
    found = ranges_on(expression, whole, cells)
    return None if found is None else found[0]


class Strips(NamedTuple):
    """Strips along pieces' sides that ranges leave out; see `Boxes.corners`.

    Attributes:
        part: Upper bound of the strips' part of a piece, 0 where there is none, shape (n,).
        low: Lower bound on all of the piece.
        high: Upper bound.
    """

    part: FloatArray
    low: FloatArray
    high: FloatArray


def ranges_on(
    expression: ufl.core.expr.Expr, whole: Pieces, cells: Cells
) -> tuple[Range, Strips] | None:
    """Bound an expression on pieces but for strips along their sides, and tell of these.

    A jump along a side, whose vertices are rounded, is one within such a strip.

    Returns:
        None as in `range_of`.
    """
    data, n = lowered(expression), len(whole.share)
    try:
        jet = Enclosure(whole.boxes(cells), order=0)(data)
        low, high = (np.array(np.broadcast_to(x, n)) for x in (jet.low, jet.high))
        part, every = np.zeros(n), (low, high)
        if has_conditions(data):
            wide = np.flatnonzero(high > low)
            boxes = whole[wide].boxes(cells, decide=True)
            at = Enclosure(boxes)
            jet = at(data)
            low[wide], high[wide], part[wide] = jet.low, jet.high, at.left_out
            every = low.copy(), high.copy()
            if part.any():
                jet = Enclosure(replace(boxes, rounding=0.0))(data)
                every[0][wide], every[1][wide] = jet.low, jet.high
        strips = Strips(part, *every)
    except Unknown:
        return None
    if not (np.isfinite(low).all() and np.isfinite(high).all()):
        return None
    return (low, high), strips


def remainders(
    jet: Jet, half: FloatArray, in_the_mean: bool = False
) -> tuple[FloatArray, FloatArray]:
    """Compute R and W for simplices within half extents of a point, shapes (n,).

    Taylor's polynomial of the point, with the middles of the coefficients of the highest order
    for these, is off by no more than their radii allow; a cubic is replaced by a quadratic.

    Args:
        jet: On boxes that hold the simplices.
        half: Shape (variables, n).
        in_the_mean: Whether R may be the root of a mean square and W a mean, also by a rule that
            is exact for degree 4; else they hold at every point.
    """
    variables, n = half.shape
    by_order, by_order_of_mean = np.zeros((2, 4, n))
    by_order[0] = by_order_of_mean[0] = 0.5 * (jet.high - jet.low)
    cubic = np.zeros(n)
    of_square, of_mean = means(variables) if in_the_mean else (_ONES, _ONES)
    for row, mid, rad in zip(jet.rest.rows, jet.rest.mid, jet.rest.rad, strict=True):
        index = indices(variables)[row]
        order = sum(index)
        size = np.prod([h**k for h, k in zip(half, index, strict=True) if k], axis=0)
        by_order[order] += of_square[order] * rad * size
        by_order_of_mean[order] += of_mean[order] * rad * size
        if order == 3:
            cubic += _CUBIC[max(index)] * np.abs(mid) * size
    by_order[3] += cubic
    found = np.fmin.reduce(by_order), np.fmin.reduce(by_order_of_mean)
    return tuple(np.where(np.isnan(x), np.inf, x * (1 + 1e-12)) for x in found)  # type: ignore[return-value]


_ONES = 1.0, 1.0, 1.0, 1.0


def means(variables: int) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Bound (mean t^2i)^½ and the mean of |t^i| for multi-indices i, by their order.

    t runs through a simplex in the cube [−1, 1]^d that touches all of its faces, or through a slab
    of a triangle; means may be a rule's. t₁² and t₁⁴ have the means given here or less, and the
    inequality of Cauchy and Schwarz gives the others; |t₁|³ t₁³ is at most t₁⁴.
    """
    second, fourth = (2 / 5, 9 / 35) if variables == 3 else (1 / 3, 1 / 5)
    return (
        (1.0, second**0.5, fourth**0.5, fourth**0.5),
        (1.0, second**0.5, second, (second * fourth) ** 0.5),
    )


class Deviation:
    """R and W of expressions; an expression's inverse may be among them."""

    def __init__(self, expression: ufl.core.expr.Expr):
        """Prepare the expression."""
        self.expression = lowered(expression)
        self.local = is_local(self.expression)
        self.singular = not self.local and may_be_singular(self.expression)
        self.decides = self.singular or has_conditions(self.expression)
        self.differences = differences(self.expression)
        self._compared = differences(self.expression, ordered=False)

    def __call__(
        self,
        at: Enclosure,
        half: FloatArray,
        inverse: bool = False,
        hats: FloatArray | None = None,
        largest: float = 1.0,
    ) -> tuple[FloatArray, FloatArray]:
        """Compute R and W, shapes (n,).

        Args:
            at: On the boxes that are asked about.
            half: Half extents of the simplices in them, shape (variables, n).
            inverse: Of the expression's inverse.
            hats: Points of a rule that is exact for degree 4, where R and W need only hold in the
                mean over a simplex, so that data without a bound may be of use.
            largest: How far above its mean the square of what R is multiplied by may be.

        Raises:
            Unknown: The expression holds an operator whose range is not known.
        """
        boxes = at.boxes
        quadratic, cubic = remainders(self._jet(at, inverse), half, in_the_mean=hats is not None)
        left_out = at.left_out
        if left_out.any():
            # What conditions left out along the boundary: there all values are possible
            which = np.flatnonzero(left_out)
            jet = self._jet(Enclosure(boxes.whole(which), order=0), inverse)
            part, width = left_out[which], jet.high - jet.low
            quadratic[which] += np.sqrt(largest * part) * width
            cubic[which] = np.minimum(cubic[which] + 2 * part * width, quadratic[which])
        if hats is not None and boxes.corners is not None and self.singular:
            rough, missed = allowance(self.expression, boxes.corners, hats)
            quadratic, cubic = np.fmin(quadratic, rough), np.fmin(cubic, missed)
        if boxes.slanted is not None and len(boxes.slanted):
            own = boxes.own
            there = remainders(self._jet(Enclosure(own), inverse), np.full_like(own.low, 0.5))
            for row, values in zip((quadratic, cubic), there, strict=True):
                row[boxes.slanted] = np.fmin(row[boxes.slanted], values)
        return quadratic, cubic

    def apart(self, pieces: Pieces) -> Pieces:
        """Cut pieces so that no point at which the data may be singular is inside of one."""
        if not self.singular:
            return pieces
        for point in singular_points(self.expression, pieces.corners):
            which, hats = holders(point, pieces.corners)
            if len(which):
                rest = np.setdiff1d(np.arange(len(pieces.share)), which)
                pieces = pieces[rest] + pieces[which].around(point, hats)
        return pieces

    def levels(self, cells: Cells) -> Levels | None:
        """Find what changes its sign where the data may jump; None where nothing does."""
        if not self.differences:
            return None
        hats = np.hstack([np.eye(3), EDGES])

        def at(pieces: Pieces) -> FloatArray:
            points, shape = pieces.points(cells, hats), (hats.shape[1], len(pieces.share))
            return np.stack([values(each, points).reshape(shape) for each in self.differences])

        return at

    def _jet(self, enclosure: Enclosure, inverse: bool) -> Jet:
        return enclosure.inverse(self.expression) if inverse else enclosure(self.expression)

    def values(self, pieces: Pieces, cells: Cells, hats: FloatArray) -> FloatArray:
        """Evaluate at points of pieces, shape (q, n).

        Args:
            pieces: The pieces.
            cells: The mesh.
            hats: Barycentric coordinates of the points in a piece, shape (d + 1, q).
        """
        found = np.empty((hats.shape[1], len(pieces.parent)))
        for part in chunks(len(pieces.parent)):
            here = found[:, part]
            here[:] = values(self.expression, pieces[part].points(cells, hats)).reshape(here.shape)
        self.off_null_sets(found, pieces, cells, hats)
        return found

    def off_null_sets(
        self, found: FloatArray, pieces: Pieces | None, cells: Cells, hats: FloatArray
    ) -> None:
        """Replace values at points where the two sides of a condition are equal, nearly.

        Enclosures hold almost everywhere, and there may be null sets on which data have other
        values: these are taken from a point beside.

        Args:
            found: Values at points of pieces, shape (q, n); changed.
            pieces: The pieces; None for the cells.
            cells: The mesh.
            hats: Barycentric coordinates of the points in a piece, shape (d + 1, q).
        """
        if not self._compared:
            return
        mixture = np.arange(1.0, 1.0 + len(hats))
        beside = (1.0 - BESIDE) * hats + BESIDE * (mixture / mixture.sum())[:, None]
        whole = Pieces.of_cells(cells) if pieces is None and self.local else pieces
        if whole is None:  # the cells, whose extents are all that the data depend on
            near = cells.search(lambda low, high: self._may_be_even(Boxes(low, high)))
        else:
            parts = blocks(found.shape[1])
            here = [self._may_be_even(whole[block].hulls(cells)) for block in parts]
            near = np.flatnonzero(np.concatenate([*here, np.empty(0, dtype=bool)]))
        for block in blocks(len(near)):
            which = near[block]
            some = Pieces.of_cells(cells, which) if whole is None else whole[which]
            even = self._may_be_even(some.points(cells, hats)).reshape(len(found), len(which))
            if even.any():
                others = values(self.expression, some.points(cells, beside)).reshape(even.shape)
                found[:, which] = np.where(even, others, found[:, which])

    def _may_be_even(self, boxes: Boxes) -> BoolArray:
        """Tell in which boxes the two sides of some condition may be equal, nearly, shape (n,)."""
        room = STRIP * np.maximum(np.abs(boxes.low), np.abs(boxes.high))
        at = Enclosure(replace(boxes, low=boxes.low - room, high=boxes.high + room), order=0)
        even = np.zeros(boxes.low.shape[1:], dtype=bool)
        for difference in self._compared:
            with suppress(Unknown):  # there is no enclosure then that null sets could contradict
                jet = at(difference)
                even |= ~((jet.low > 0) | (jet.high < 0))  # also where it may be anything
        return even


def chunks(n: int) -> list[slice]:
    """Cut into consecutive ranges whose jets fit into the processor's cache; one at least."""
    return [slice(a, min(a + CHUNK, n)) for a in range(0, max(n, 1), CHUNK)]


def errors_on(pieces: Pieces, errors: Errors, cells: Cells, decide: bool = True) -> FloatArray:
    """Work out what is to be known on boxes around pieces; for `decide` see `Boxes.corners`."""
    n = len(pieces.share)
    if n > CHUNK:
        parts_of = [errors_on(pieces[part], errors, cells, decide) for part in chunks(n)]
        return np.concatenate(parts_of, axis=1)
    whole = pieces.whole
    if whole.all() or not decide:
        boxes = pieces.boxes(cells, decide)
        return errors(boxes, pieces.half(boxes))
    parts = []
    for which in (np.flatnonzero(whole), np.flatnonzero(~whole)):
        some = pieces[which]
        boxes = some.boxes(cells, decide=bool(some.whole.all()))
        parts.append((which, errors(boxes, some.half(boxes))))
    found = np.empty((len(parts[0][1]), len(whole)))
    for which, there in parts:
        found[:, which] = there
    return found
