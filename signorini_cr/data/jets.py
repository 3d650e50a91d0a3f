"""Enclosures of an expression and of its derivatives on many boxes at once.

A jet holds, for each box, numbers between which the value and the Taylor coefficients ∂^k/k! up to
the third order lie at every point of the box (or at almost every point, where that says so). They
are found by interval arithmetic: an operator's range follows from its arguments' ranges. Results
are rounded outwards. A coefficient that has no bound, at a root of 0 or at a kink, is infinite,
and the coefficients of lower order still hold.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property
from typing import Any, TypeAlias
from weakref import WeakKeyDictionary

import numpy as np
import ufl
from dolfinx import fem
from ufl import classes

from .. import compat
from ..arrays import BoolArray, FloatArray, IndexArray
from ..fem.lowering import by_components
from ..fem.pointwise import Unknown, by_operators, is_affine
from ..mesh.domain import Domain
from .balls import EPS, LOOSE, NONE, ORDER, TINY, Balls, Factor, Rows, indices, middle, union

Range = tuple[FloatArray, FloatArray]
"""Lower and upper bounds."""
Truth = tuple[BoolArray, BoolArray]
"""Masks of the boxes in which a condition can hold, and of those in which it can fail."""


STRIP = 1e-13
"""Rounding of a coordinate, in parts of it."""


@dataclass(frozen=True, eq=False)
class Boxes:
    """Boxes to enclose data in: points low ≤ x ≤ high, as they depend on some variables.

    Attributes:
        low: Least coordinates, shape (gdim, n).
        high: Largest coordinates, shape (gdim, n).
        along: ∂x/∂(variables), shape (variables, gdim, n); None where x itself are the variables.
        corners: Vertices of the simplices that are meant, shape (d + 1, gdim, n); conditions on
            affine functions are then decided up to a strip along the simplex's boundary.
        cells: A cell that holds each box, shape (n,), for data that are given by cells.
        normal: Outward normals, shape (gdim, n).
        domain: Of the cells.
        slanted: Boxes that are much larger than their simplices, shape (k,).
        edges: Two edges of each of these, from one vertex, shape (variables, gdim, k).
        rounding: Width of the strips, in parts of the coordinates.
    """

    low: FloatArray
    high: FloatArray
    along: FloatArray | None = None
    corners: FloatArray | None = None
    cells: IndexArray | None = None
    normal: FloatArray | None = None
    domain: Domain | None = None
    slanted: IndexArray | None = None
    edges: FloatArray | None = None
    rounding: float = STRIP

    @property
    def own(self) -> Boxes:
        """The slanted ones with coordinates along the edges, in which simplices lie in [0, 1]^d."""
        assert self.slanted is not None
        low, high = self.low[:, self.slanted], self.high[:, self.slanted]
        cells = None if self.cells is None else self.cells[self.slanted]
        return Boxes(low, high, self.edges, cells=cells, domain=self.domain)

    def whole(self, which: IndexArray) -> Boxes:
        """Take some of them, of which all points are meant."""

        def some(array: Any) -> Any:
            return None if array is None else array[..., which]

        along, cells, normal = some(self.along), some(self.cells), some(self.normal)
        return Boxes(some(self.low), some(self.high), along, None, cells, normal, self.domain)

    @property
    def variables(self) -> int:
        """Of the Taylor polynomials."""
        return len(self.low if self.along is None else self.along)

    @cached_property
    def strip(self) -> FloatArray:
        """Width of what may be left out along the boundary, shape (n,): coordinates' rounding."""
        return self.rounding * np.maximum(np.abs(self.low), np.abs(self.high)).max(axis=0)

    @cached_property
    def strip_part(self) -> FloatArray:
        """Upper bound of a strip's part of its simplex, shape (n,).

        Of a simplex a slab of width δ holds at most d δ / (least height), and the least height is
        at least √det(edges' Gram matrix) / h^(d−1).
        """
        assert self.corners is not None
        edges = (self.corners[1:] - self.corners[:1]).transpose(2, 0, 1)
        d = edges.shape[1]
        gram = edges @ edges.transpose(0, 2, 1)
        volume = np.sqrt(np.maximum(np.linalg.det(gram), 0.0))
        # no edge is longer than two from the first corner
        reach = 2.0 * np.sqrt(gram.diagonal(axis1=1, axis2=2).max(axis=1))
        width = d * self.strip * reach ** (d - 1)
        return np.divide(width, volume, out=np.ones_like(width), where=width < volume)


CHOICES = 5
"""Most conditions in an expression that is written as choices first: 2⁵ expressions."""

STEPS = 6
"""Steps to where a condition changes, by a fixed slope: on small pieces a step leaves little."""

ALWAYS = np.array(True)
"""Branches that are joined continuously wherever they meet."""


@dataclass(frozen=True, eq=False)
class Jet:
    """Enclosures of a value and of its Taylor coefficients.

    Attributes:
        low: Lower bounds of the value, shape (n,) or ().
        high: Upper bounds of it.
        rest: Taylor coefficients from the first order on.
    """

    low: FloatArray
    high: FloatArray
    rest: Balls = NONE

    @cached_property
    def factor(self) -> Factor:
        """All coefficients, prepared for products."""
        return Factor.of(self.low, self.high, self.rest)

    @property
    def number(self) -> float | None:
        """The number that it is, or None."""
        known = self.low.ndim == 0 and self.low == self.high and not self.rest.rows
        return float(self.low) if known else None


def lowered(expression: Any) -> Any:
    """Rewrite the expression in scalar operators, with derivatives carried out."""
    nodes = ufl.corealg.traversal.unique_pre_traversal(expression)
    if all(isinstance(e, _KNOWN) for e in nodes):
        return expression
    return by_components(expression)


def is_local(expression: Any) -> bool:
    """Tell whether the expression depends on more than x: it differs from cell to cell."""
    kinds = (fem.Function, classes.GeometricQuantity)
    return any(
        isinstance(e, kinds) and not isinstance(e, classes.SpatialCoordinate)
        for e in ufl.corealg.traversal.unique_pre_traversal(expression)
    )


def has_conditions(expression: Any) -> bool:
    """Tell whether the expression may jump: by a choice between two others, or as an angle."""
    return any(
        isinstance(e, classes.Conditional | classes.Atan2)
        for e in ufl.corealg.traversal.unique_pre_traversal(expression)
    )


def differences(expression: Any, ordered: bool = True) -> list[Any]:
    """Find what changes its sign where conditions of a lowered expression change; local.

    Args:
        expression: The expression.
        ordered: Whether to leave out what is only asked whether it is 0; else what conditions take
            the size of is among it, as s in |s| < w.
    """

    def within(e: Any, kinds: Any) -> list[Any]:
        nodes = ufl.corealg.traversal.unique_pre_traversal(e)
        return [each for each in nodes if isinstance(each, kinds)]

    conditions = within(expression, _ORDERED if ordered else _COMPARISONS)
    found = [e.ufl_operands[0] - e.ufl_operands[1] for e in conditions]
    if ordered:
        found += [size.ufl_operands[0] for e in conditions for size in within(e, classes.Abs)]
    return list(dict.fromkeys(found))


def choices_first(expression: Any) -> Any:
    """Rewrite a lowered expression as a choice between expressions without any, if these are few.

    What jumps by itself may not do so as a part of a whole: where(x > 0, 1, 0) x is continuous.
    """
    nodes = ufl.corealg.traversal.unique_pre_traversal(expression)
    conditions = dict.fromkeys(
        e.ufl_operands[0] for e in nodes if isinstance(e, classes.Conditional)
    )
    return _chosen(expression, list(conditions)) if len(conditions) <= CHOICES else expression


def _chosen(e: Any, conditions: Sequence[Any]) -> Any:
    """Rewrite the expression with one choice after the other."""
    if not conditions:
        return e
    first, *more = conditions
    nodes = ufl.corealg.traversal.unique_pre_traversal(e)
    choices = [
        n for n in nodes if isinstance(n, classes.Conditional) and n.ufl_operands[0] == first
    ]
    holds, fails = (
        _chosen(ufl.replace(e, {each: each.ufl_operands[i] for each in choices}), more)
        for i in (1, 2)
    )
    return holds if holds == fails else ufl.conditional(first, holds, fails)


def values(expression: Any, points: Boxes) -> FloatArray:
    """Evaluate a lowered expression, not enclosed, at points that are given as boxes, shape (n,).

    Where the formula has no value, as the root of what rounding made negative, the middle of the
    enclosure; NaN where that has no end.

    Raises:
        Unknown: The expression holds an operator that is not known here.
    """
    at = Enclosure(points, order=0)

    def centre(e: Any) -> FloatArray:
        jet = at(e)
        with np.errstate(all="ignore"):
            return 0.5 * (jet.low + jet.high)

    found = np.asarray(by_operators(expression, centre))
    if not np.isfinite(found).all():
        found = np.where(np.isfinite(found), found, centre(expression))
    return np.broadcast_to(found, points.low.shape[1:])


class Enclosure:
    """Jets of lowered expressions on given boxes; what they have in common is found once.

    Args:
        boxes: Where.
        order: Up to which order.
        inner: A lower bound of the barycentric coordinates of all points that matter: conditions
            may then be decided up to slices of triangles that are too thin to hold one.
        rounding: What a conditional may jump by on a facet and still count as continuous.
    """

    def __init__(self, boxes: Boxes, order: int = ORDER, inner: float = 0.0, rounding: float = 0.0):
        """Begin with nothing known."""
        self.boxes, self.order, self.inner, self.rounding = boxes, order, inner, rounding
        self._strips, self._slices = np.zeros((2, *boxes.low.shape[1:]))
        self._known: dict[Any, Jet] = {}

    @property
    def left_out(self) -> FloatArray:
        """Upper bound of the part of each simplex on which conditions may be otherwise, shape (n,).

        For each condition that is decided up to a strip, or a slice, one of these.
        """
        if not self._strips.any():
            return self._slices
        return np.minimum(self._strips * self.boxes.strip_part + self._slices, 1.0)

    def __call__(self, e: Any) -> Jet:
        """Compute the jet of an expression.

        Raises:
            Unknown: It holds an operator that is not known here.
        """
        jet = self._known.get(e)
        if jet is None:
            with np.errstate(all="ignore"):
                jet = self._known[e] = self._jet(e)
        return jet

    def inverse(self, e: Any) -> Jet:
        """Compute the jet of 1/e."""
        with np.errstate(all="ignore"):
            return self._compose(self(e), power_series(-1.0))

    def _jet(self, e: Any) -> Jet:
        kind: type = type(e)
        rule = _rule_for(kind)
        if rule is None:
            raise Unknown(kind.__name__)
        return rule(self, e)

    # ---- what expressions begin with

    def _of_constant(self, e: Any) -> Jet:
        if e.ufl_shape != ():
            raise Unknown(type(e).__name__)
        return self._constant(float(e.value))

    def _constant(self, value: float) -> Jet:
        return Jet(np.array(value), np.array(value))

    def _linear(self, low: FloatArray, high: FloatArray, slopes: FloatArray) -> Jet:
        """Make a value with constant first derivatives, shape (variables, n) or (variables, 1)."""
        if not self.order:
            return Jet(low, high)
        there = np.flatnonzero(slopes.any(axis=1))
        mid = slopes[there]
        return Jet(low, high, Balls(tuple(int(k) + 1 for k in there), mid, LOOSE * np.abs(mid)))

    def _component(self, vector: Any, index: Any) -> Jet:
        if not all(isinstance(i, classes.FixedIndex) for i in index):
            raise Unknown("index")
        place = tuple(map(int, index))
        if isinstance(vector, fem.Constant):
            return self._constant(float(np.asarray(vector.value)[place]))
        if isinstance(vector, fem.Function):
            return self._entry(vector, place)
        (i,) = place
        if isinstance(vector, classes.SpatialCoordinate):
            box = self.boxes
            if box.along is not None:
                return self._linear(box.low[i], box.high[i], box.along[:, i])
            return self._linear(box.low[i], box.high[i], np.eye(len(box.low))[:, [i]])
        if isinstance(vector, classes.FacetNormal) and self.boxes.normal is not None:
            n = self.boxes.normal[i]
            return Jet(*out((n, n), LOOSE))
        raise Unknown(type(vector).__name__)

    def _entry(self, function: fem.Function, place: tuple[int, ...]) -> Jet:
        """Look up an entry of a tensor that is constant on each cell."""
        box, V = self.boxes, function.function_space
        size, steady = int(np.prod(function.ufl_shape)), V.ufl_element().embedded_superdegree == 0
        if box.cells is None or box.domain is None or not steady or V.dofmap.bs != size:
            raise Unknown(function.name)
        function = box.domain.own(function)
        dofs = function.function_space.dofmap.list[box.cells, 0]
        values = function.x.array[
            size * dofs + int(np.ravel_multi_index(place, function.ufl_shape))
        ]
        return Jet(values, values)

    def _function(self, function: fem.Function) -> Jet:
        """Enclose Functions that are affine on each cell, or constant."""
        box, domain = self.boxes, self.boxes.domain
        if box.cells is None or domain is None or not is_affine(function):
            raise Unknown(function.name)
        function = domain.own(function)
        values = function.x.array[function.function_space.dofmap.list[box.cells]]
        ends = values.min(axis=1), values.max(axis=1)
        if values.shape[1] == 1:
            return Jet(*ends)
        mesh = domain.mesh
        X = mesh.geometry.x[compat.cell_nodes(mesh)[box.cells]][:, :, : len(box.low)]
        rise = (values[:, 1:] - values[:, :1])[:, :, None]
        slope = np.linalg.solve(X[:, 1:] - X[:, :1], rise)[:, :, 0].T
        reach = [
            mul((s, s), (a - p, b - p))
            for s, a, b, p in zip(slope, box.low, box.high, X[:, 0].T, strict=True)
        ]
        low, high = (values[:, 0] + sum(r[k] for r in reach) for k in (0, 1))
        room = 10 * LOOSE * (np.abs(values).max(axis=1) + np.ptp(values, axis=1))
        low, high = np.maximum(low - room, ends[0]), np.minimum(high + room, ends[1])
        if box.along is not None:
            slope = np.einsum("vgn,gn->vn", box.along, slope)
        jet = self._linear(low, high, slope)
        # the middle of the range is not the value in the middle: not affine for `_difference`
        return replace(jet, rest=Balls(self._every, *jet.rest.on(self._every)))

    # ---- arithmetic

    def _sum(self, a: Jet, b: Jet) -> Jet:
        return Jet(*out((a.low + b.low, a.high + b.high)), a.rest + b.rest)

    def _product(self, a: Jet, b: Jet) -> Jet:
        if a.number is not None or b.number is not None:
            a, b = (a, b) if a.number is not None else (b, a)
            factor = float(a.low)
            if factor == 0.0:
                return a
            return Jet(*_scaled(factor, (b.low, b.high)), b.rest.scaled(factor))
        range_ = square_of(a.low, a.high) if a is b else mul((a.low, a.high), (b.low, b.high))
        if not self.order:
            return Jet(*range_)
        return Jet(*range_, a.factor.times(b.factor, self.boxes.variables, self.order))

    def _quotient(self, a: Jet, b: Jet) -> Jet:
        return self._product(a, self._compose(b, power_series(-1.0)))

    def _compose(self, a: Jet, series: Callable[[Range], Sequence[Range]]) -> Jet:
        """Compose φ(a), given the ranges of the Taylor coefficients φ_k over a's range.

        With δ for a less its value that is φ_0 + δ (φ_1 + δ (φ_2 + δ φ_3)).
        """
        terms = series((a.low, a.high))
        if not self.order or not a.rest.rows:
            return Jet(*terms[0])
        step, found = a.factor.without_value, Jet(*terms[self.order])
        for k in range(self.order - 1, -1, -1):
            rest = NONE
            if found.number != 0.0:
                rest = step.times(found.factor, self.boxes.variables, self.order - k)
            found = Jet(*terms[k], rest)
        return found

    def _number_power(self, base: Any, p: float) -> Jet:
        """Raise to a power; one of roots, or of roots of these, is one of what is under them."""
        while isinstance(base, classes.Sqrt):
            base, p = base.ufl_operands[0], 0.5 * p
        return self._compose(self(base), power_series(p))

    def _power(self, base: Any, exponent: Any) -> Jet:
        p = self(exponent)
        if p.number is not None:
            return self._number_power(base, p.number)
        u = self(base)
        whole = self._compose(self._product(p, self._compose(u, _ln)), _exp)
        # At a base of 0, where the logarithm has no range
        a, b = np.maximum(u.low, 0.0), np.maximum(u.high, 0.0)
        ends = np.broadcast_arrays(*(x**q for x in (a, b) for q in (p.low, p.high)))
        low, high = out((np.minimum.reduce(ends), np.maximum.reduce(ends)), LOOSE)
        one = (a <= 1) & (b >= 1)
        low, high = (
            np.where(one, np.minimum(low, 1.0), low),
            np.where(one, np.maximum(high, 1.0), high),
        )
        crosses = (p.low < 0) & (p.high > 0) & (a == 0)
        bad = crosses | (u.low < 0)
        return replace(
            whole,
            low=np.where(bad, -np.inf, np.maximum(whole.low, low)),
            high=np.where(bad, np.inf, np.minimum(whole.high, high)),
        )

    def _atan2(self, a: Jet, b: Jet) -> Jet:
        """Enclose the angle of (b, a), which jumps where b < 0 and a changes sign; 0 has none."""
        low = high = np.array(np.nan)
        for y in (a.low + 0.0, a.high + 0.0):
            for x in (b.low + 0.0, b.high + 0.0):
                angle = np.where((x == 0) & (y == 0), np.nan, np.arctan2(y, x))
                low, high = np.fmin(low, angle), np.fmax(high, angle)
        low, high = out((low, high), LOOSE)
        full = ((a.low < 0) & (a.high >= 0) & (b.low < 0)) | ~np.isfinite(low + high)
        if self.boxes.corners is not None and full.any():
            low, high, full = self._beside_cut(a, b, (low, high), full)
        rest = self._of_logarithm(a, b, (low, high))
        rows = self._every if full.any() else rest.rows
        mid, rad = rest.on(rows)
        mid, rad = np.where(full, 0.0, mid), np.where(full, np.inf, rad)
        return Jet(np.where(full, -4.0, low), np.where(full, 4.0, high), Balls(rows, mid, rad))

    def _of_logarithm(self, a: Jet, b: Jet, angle: Range) -> Balls:
        """Compute Taylor coefficients of the angle of z = b + ia, the logarithm's imaginary part.

        With δ for z less its value that is δ (1/z − δ (1/(2z²) − δ/(3z³))).
        """
        x, y = b.factor.without_value, a.factor.without_value
        of_a, of_b = square_of(a.low, a.high), square_of(b.low, b.high)
        square = out((of_a[0] + of_b[0], of_a[1] + of_b[1]))
        real = imaginary = NONE
        for k in range(self.order, 0, -1):
            size = _scaled((-1.0) ** (k - 1) / k, _raised(square, -0.5 * k))
            turn = _scaled(float(-k), angle)
            c, s = _wave(turn, np.cos, 0.0), _wave(turn, np.sin, 0.5 * np.pi)
            u, v = Jet(*mul(size, c), real).factor, Jet(*mul(size, s), imaginary).factor
            xu, yv, xv, yu = (
                p.times(q, self.boxes.variables, self.order - k + 1)
                for p, q in ((x, u), (y, v), (x, v), (y, u))
            )
            real, imaginary = xu + -yv, xv + yu
        return imaginary

    def _beside_cut(
        self, a: Jet, b: Jet, found: Range, full: BoolArray
    ) -> tuple[FloatArray, FloatArray, BoolArray]:
        """Go on with the angle across its jump where that does not enter the simplex.

        Where a ≥ 0 the angle is π/2 − atan2(b, a), and where a ≤ 0 it is atan2(b, −a) − π/2. They
        jump where a has the other sign and b is 0, and nowhere else.
        """
        low, high = found
        bottom, top, _ = self._difference(a, self._constant(0.0))
        for sign, beside in ((1.0, bottom >= 0), (-1.0, top <= 0)):
            ends = (a.low, a.high) if sign > 0 else (-a.high, -a.low)
            here = full & beside & ~((ends[0] <= 0) & (b.low <= 0) & (b.high >= 0))
            angles = [np.arctan2(x, y) for x in (b.low, b.high) for y in ends]
            turned = out((np.minimum.reduce(angles), np.maximum.reduce(angles)), LOOSE)
            first, last = (sign * (0.5 * np.pi - angle) for angle in turned)
            rows = out((np.minimum(first, last), np.maximum(first, last)), LOOSE)
            low, high = np.where(here, rows[0], low), np.where(here, rows[1], high)
            full = full & ~here
        return low, high, full

    # ---- choices

    def _choose(
        self, take: BoolArray, either: BoolArray, a: Jet, b: Jet, joined: BoolArray = ALWAYS
    ) -> Jet:
        """Choose `a` where take, else b; the hull of both where either may be.

        There coefficients are infinite from the second order on, and where they are not joined
        continuously, from the first.
        """
        low, high = np.where(take, a.low, b.low), np.where(take, a.high, b.high)
        rows, undecided = union(a.rest.rows, b.rest.rows), np.any(either)
        first = len(indices(self.boxes.variables, min(1, self.order)))
        if undecided:
            low = np.where(either, np.minimum(a.low, b.low), low)
            high = np.where(either, np.maximum(a.high, b.high), high)
            continuous = bool(np.all(joined | ~either))
            rows = union(rows, self._every[first - 1 :] if continuous else self._every)
        (m, r), (n, s) = a.rest.on(rows), b.rest.on(rows)
        mid, rad = np.where(take, m, n), np.where(take, r, s)
        if undecided:
            hull = middle(np.minimum(m - r, n - s), np.maximum(m + r, n + s))
            above = sum(row < first for row in rows)
            found = []
            for array, unknown, x in zip(hull, (0.0, np.inf), (mid, rad), strict=True):
                array[above:] = unknown
                found.append(np.where(either, np.where(joined, array, unknown), x))
            mid, rad = found
        return Jet(low, high, Balls(rows, mid, rad))

    @property
    def _every(self) -> Rows:
        """All coefficients from the first order on."""
        return tuple(range(1, len(indices(self.boxes.variables, self.order))))

    def _absolute(self, e: Any) -> Jet:
        """Enclose an absolute value; on simplices there may be one sign where a box has both."""
        (operand,) = e.ufl_operands
        a = self(operand)
        if self.boxes.corners is None:
            return self._compose(a, _abs)
        low, high, _ = self._difference(a, self._constant(0.0))
        if self.boxes.along is None and self.order >= 2:
            low, high = self._by_slopes(low, high, operand, classes.Zero())
        above, below = low >= 0, high <= 0
        jet = self._choose(above, ~(above | below), a, Jet(-a.high, -a.low, -a.rest))
        return replace(jet, low=np.maximum(jet.low, 0.0))

    def _order(self, a: Jet, b: Jet) -> tuple[BoolArray, BoolArray]:
        """Tell where a is not below b, and where b is not below a; on simplices, if meant."""
        low, high, _ = self._difference(a, b)
        return low >= 0, high <= 0

    def _maximum(self, a: Jet, b: Jet) -> Jet:
        above, below = self._order(a, b)
        jet = self._choose(above, ~(above | below), a, b)
        return replace(jet, low=np.maximum(a.low, b.low), high=np.maximum(a.high, b.high))

    def _minimum(self, a: Jet, b: Jet) -> Jet:
        above, below = self._order(a, b)
        jet = self._choose(below, ~(above | below), a, b)
        return replace(jet, low=np.minimum(a.low, b.low), high=np.minimum(a.high, b.high))

    def _conditional(self, e: Any) -> Jet:
        condition, first, second = e.ufl_operands
        can_hold, can_fail = self.truth(condition)
        a, b = self(first), self(second)
        either = can_hold & can_fail
        agree = bool(np.any(either)) and _known_to_agree(e)
        joined = ALWAYS if agree else self._joined(condition, first, second, either)
        jet = self._choose(can_hold, either, a, b, joined)
        if agree and _is_extreme(condition, first, second):
            rule = self._maximum if _is_maximum(condition, first) else self._minimum
            extreme = rule(a, b)
            return replace(jet, low=extreme.low, high=extreme.high)
        return jet

    def _joined(self, condition: Any, first: Any, second: Any, either: BoolArray) -> BoolArray:
        """Tell on which pieces of facets branches differ by rounding where a condition changes.

        A condition that compares changes at the roots of a difference. Where the latter's slope
        has one sign, there is one at most: within |C|/|C'| of any point, where the branches differ
        by no more than at that point, and by their difference's slope times this.
        """
        box, corners = self.boxes, self.boxes.corners
        joined = ~np.broadcast_to(either, box.low.shape[1:])
        on_facets = corners is not None and box.along is not None and len(corners) == 2
        if self.rounding == 0.0 or self.order == 0 or not on_facets or joined.all():
            return joined
        nodes = ufl.corealg.traversal.unique_pre_traversal(condition)
        comparisons = [e for e in nodes if isinstance(e, _COMPARISONS)]
        if not all(isinstance(e, _ORDERED) for e in comparisons):
            return joined
        which = np.flatnonzero(~joined)
        apart = first - second
        off = np.zeros(len(which))
        for each in comparisons:
            can_hold, can_fail = self.truth(each)
            here = np.broadcast_to(can_hold & can_fail, joined.shape)[which]
            off = np.maximum(off, np.where(here, self._at_root(each, apart, which), 0.0))
        joined[which] = off <= self.rounding
        return joined

    def _at_root(self, comparison: Any, e: Any, which: IndexArray) -> FloatArray:
        """Bound |e| on some pieces of facets where both sides of a comparison are equal."""
        box, n = self.boxes, len(self._strips)
        assert box.corners is not None and box.along is not None
        left, right = comparison.ufl_operands
        way, ends = box.along[0][:, which], box.corners[..., which]
        center = ends.mean(axis=0)
        reach = np.abs(np.sum(way * (ends[1] - center), axis=0)) / np.sum(way**2, axis=0)

        def slopes(jet: Jet) -> tuple[FloatArray, FloatArray]:
            mid, rad = (np.broadcast_to(x[0], n)[which] for x in jet.rest.on(self._every))
            return mid, rad

        def size(jet: Jet) -> FloatArray:
            return np.maximum(np.abs(jet.low), np.abs(jet.high))

        def at(along: FloatArray) -> Enclosure:
            point = center + along * way
            return Enclosure(replace(box.whole(which), low=point, high=point), order=0)

        (mid, rad), (other, more) = slopes(self(left - right)), slopes(self(e))
        along: FloatArray = np.zeros(len(which))
        for _ in range(STEPS):
            jet = at(along)(left - right)
            along = np.clip(along - 0.5 * (jet.low + jet.high) / mid, -reach, reach)
        there, least = at(along), np.maximum(np.abs(mid) - rad, 0.0)
        found = size(there(e)) + size(there(left - right)) * (np.abs(other) + more) / least
        return np.fmin(found, np.broadcast_to(size(self(e)), n)[which])  # fmin: not NaN

    def truth(self, e: Any) -> Truth:
        """Tell where in the boxes a condition can hold and can fail, but for null sets."""
        return decided(e, self._compared)

    def _compared(self, e: Any, left: Any, right: Any) -> Truth:
        low, high, thin = self._difference(self(left), self(right))
        if self.boxes.corners is not None and self.boxes.along is None and self.order >= 2:
            low, high = self._by_slopes(low, high, left, right)
        above, below = high > 0, low < 0  # where the difference can be so
        # It can be 0 on more than a null set only where all derivatives may vanish
        zero = (low <= 0) & (high >= 0) & ~thin
        if isinstance(e, classes.EQ):
            return zero, above | below
        if isinstance(e, classes.NE):
            return above | below, zero
        if isinstance(e, classes.GT | classes.LT):
            return above, below | zero
        return above | zero, below

    def _difference(self, a: Jet, b: Jet) -> tuple[FloatArray, FloatArray, BoolArray]:
        """Bound a − b, and tell whether it takes each value on a null set only."""
        low, high = a.low - b.high, a.high - b.low  # the sign is right whatever the rounding
        unclear = np.asarray((low <= 0) & (high >= 0))
        if not np.any(unclear):
            return low, high, unclear
        n, rest = self.boxes.variables, a.rest + -b.rest
        # where a function is 0 its derivatives, and theirs, are 0 almost everywhere
        thin = np.asarray((np.abs(rest.mid) > rest.rad).any(axis=0))
        corners = self.boxes.corners
        if corners is None or self.order < 2 or max(rest.rows, default=0) > n:
            return low, high, thin
        self._strips += (low < 0) & (high > 0)
        return *self._at_corners(low, high, rest.on(tuple(range(1, n + 1)))[0], corners), thin

    def _by_slopes(self, low: FloatArray, high: FloatArray, left: Any, right: Any) -> Range:
        """Bound left − right on simplices more narrowly, by its value at their centroids.

        On the way from there to a corner it changes by slopes that are enclosed: it lies between
        affine functions. Where one of these has the other sign on a thin slice only, that is left
        out.
        """
        box, rest = self.boxes, self(left).rest + -self(right).rest
        low, high = (np.array(np.broadcast_to(x, box.low.shape[1:])) for x in (low, high))
        which = np.flatnonzero((low <= 0) & (high >= 0))
        if max(rest.rows, default=0) <= box.variables or not len(which):
            return low, high
        assert box.corners is not None
        corners = box.corners[..., which]
        point = corners.mean(axis=0)
        cells = None if box.cells is None else box.cells[which]
        at = Enclosure(Boxes(point, point, cells=cells, domain=box.domain), order=0)
        a, b = at(left), at(right)
        mid, rad = (
            np.broadcast_to(x[: box.variables], (box.variables, len(low)))[:, which]
            for x in rest.on(self._every)
        )
        offset = corners - point
        rise = np.einsum("vn,cvn->cn", mid, offset)
        size = np.abs(a.low) + np.abs(b.low) + np.sum(np.abs(mid * offset), axis=1).max(axis=0)
        room = np.sum(rad * np.abs(offset).max(axis=0), axis=0) + LOOSE * size
        for sign, row, ends in (
            (1.0, low, a.low - b.high + rise - room),
            (-1.0, high, b.low - a.high - rise - room),
        ):
            bottom, part = ends.min(axis=0), _part_below(ends)
            thin = (bottom < 0) & (-bottom < self.inner * np.ptp(ends, axis=0)) & (part < 1.0)
            self._slices[which] += np.where(thin, part, 0.0)
            bottom = np.where(thin, 0.0, bottom)
            row[which] = sign * np.fmax(sign * row[which], bottom)
        return low, high

    def _at_corners(
        self, low: FloatArray, high: FloatArray, slopes: FloatArray, corners: FloatArray
    ) -> Range:
        """Bound an affine function on simplices, but for strips along their boundary.

        The middle of its range on the box is its value in the middle of the box.
        """
        box = self.boxes
        middle = 0.5 * (low + high)
        offset = corners - 0.5 * (box.low + box.high)
        if box.along is not None:  # along a unit vector
            offset = np.einsum("vgn,cgn->cvn", box.along, offset)
        half = 0.5 * (box.high - box.low)
        if box.along is not None:
            half = np.einsum("vgn,gn->vn", np.abs(box.along), half)
        rise = np.zeros(offset.shape[::2])
        steep, reach = np.zeros((2, rise.shape[1]))
        for axis, slope in enumerate(slopes):
            rise = rise + slope * offset[:, axis]
            steep = np.hypot(steep, slope)
            reach = reach + np.abs(slope) * half[axis]
        # what the range is wider than an affine function's is rounding
        rounding = np.maximum(0.5 * (high - low) - reach, 0.0) + EPS * (np.abs(low) + np.abs(high))
        room = steep * box.strip - rounding
        bottom, top = middle + rise.min(axis=0) + room, middle + rise.max(axis=0) - room
        bad = ~(bottom <= top)
        return np.where(bad, low, np.maximum(low, bottom)), np.where(
            bad, high, np.minimum(high, top)
        )


def _part_below(ends: FloatArray) -> FloatArray:
    """Compute the part of a triangle where an affine function is below 0; 1 of other simplices.

    Args:
        ends: Its values at the vertices, shape (d + 1, n).
    """
    if len(ends) != 3:
        return np.ones(ends.shape[1])
    low, middle, high = np.sort(ends, axis=0)
    one_below = low**2 / ((middle - low) * (high - low))
    one_above = 1.0 - high**2 / ((high - low) * (high - middle))
    found = np.where(middle > 0, one_below, np.where(high > 0, one_above, 1.0))
    return np.where(low >= 0, 0.0, np.clip(found * (1 + 1e-12) + 1e-15, 0.0, 1.0))


# ---- ranges


def out(x: Range, room: float = EPS) -> Range:
    """Make room for rounding; what is 0 stays so, and other numbers keep their signs."""
    try:
        with np.errstate(under="raise"):
            return _wider(*x, room)
    except FloatingPointError:
        less, more = (np.where(end == 0, 0.0, room * np.abs(end) + TINY) for end in x)
        low, high = x[0] - less, x[1] + more
        low, high = (
            np.where(x[0] > 0, np.maximum(low, 0.0), low),
            np.where(x[1] < 0, np.minimum(high, 0.0), high),
        )
        return np.fmax(low, -np.inf), np.fmin(high, np.inf)


def _wider(low: FloatArray, high: FloatArray, room: float = EPS) -> Range:
    """Make the same room, but for numbers below all."""
    low, high = low - room * np.abs(low), high + room * np.abs(high)
    return np.fmax(low, -np.inf), np.fmin(high, np.inf)  # of a number and NaN it is the number


def mul(x: Range, y: Range) -> Range:
    """Enclose a product."""
    try:
        with np.errstate(under="raise"):
            return _mul(x, y)
    except FloatingPointError:
        low, high = _mul(x, y)
    above = ((x[0] >= 0) & (y[0] >= 0)) | ((x[1] <= 0) & (y[1] <= 0))
    below = ((x[0] >= 0) & (y[1] <= 0)) | ((x[1] <= 0) & (y[0] >= 0))
    return (
        np.where(above, np.maximum(low - TINY, 0.0), low - TINY),
        np.where(below, np.minimum(high + TINY, 0.0), high + TINY),
    )


def _mul(x: Range, y: Range) -> Range:
    """Enclose a product, but for numbers below all."""
    a, b, c, d = x[0] * y[0], x[0] * y[1], x[1] * y[0], x[1] * y[1]
    low, high = np.fmin(np.fmin(a, b), np.fmin(c, d)), np.fmax(np.fmax(a, b), np.fmax(c, d))
    zero = np.isnan(low)  # 0 times what has no bound
    return _wider(np.where(zero, 0.0, low), np.where(zero, 0.0, high))


def square_of(low: FloatArray, high: FloatArray) -> Range:
    """Enclose a square."""
    around = (low < 0) & (high > 0)
    try:
        with np.errstate(under="raise"):
            a, b = low * low, high * high
            return _wider(np.where(around, 0.0, np.minimum(a, b)), np.maximum(a, b))
    except FloatingPointError:
        a, b = np.abs(low), np.abs(high)
        size = np.minimum(a, b), np.maximum(a, b)
        least, most = mul(size, size)
        return np.where(around, 0.0, least), most


def _scaled(factor: float, x: Range) -> Range:
    low, high = x if factor >= 0 else (x[1], x[0])
    try:
        with np.errstate(under="raise"):
            return _wider(factor * low, factor * high)
    except FloatingPointError:
        number = np.array(factor)
        return mul((number, number), x)


def _plus(x: Range, shift: float) -> Range:
    return out((x[0] + shift, x[1] + shift))


def _inverse(x: Range) -> Range:
    around = (x[0] < 0) & (x[1] > 0)
    low = np.where(around | (x[1] == 0), -np.inf, 1.0 / x[1])
    return out((low, np.where(around | (x[0] == 0), np.inf, 1.0 / x[0])))


def _raised(x: Range, p: float) -> Range:
    """Enclose x^p; where p is not whole, for what of x is not negative."""
    if p == 0:
        return np.array(1.0), np.array(1.0)
    if p == 1:
        return x
    if p == 2:
        return square_of(*x)
    whole = p == round(p)
    low, high = x if whole else (np.maximum(x[0], 0.0), np.maximum(x[1], 0.0))
    a, b = (np.sqrt(low), np.sqrt(high)) if p == 0.5 else (low**p, high**p)
    least, most = np.minimum(a, b), np.maximum(a, b)
    odd = whole and p % 2 != 0
    if whole and not odd:
        least = np.where((low < 0) & (high > 0), 0.0, least)
    bottom, top = out((least, most), LOOSE)
    # not by the flag for underflow, which vectorized powers may leave alone
    lost = ((np.abs(a) < TINY) & (low != 0)) | ((np.abs(b) < TINY) & (high != 0))
    if lost.any():
        room = np.where(lost, TINY, 0.0)
        bottom, top = (
            np.where((low >= 0) | (not odd), np.maximum(bottom - room, 0.0), bottom - room),
            np.where((high <= 0) & odd, np.minimum(top + room, 0.0), top + room),
        )
    return bottom, top


def _rising(function: Callable[[FloatArray], FloatArray], x: Range) -> Range:
    return out((function(x[0]), function(x[1])), LOOSE)


def _wave(x: Range, function: Callable[[FloatArray], FloatArray], top: float) -> Range:
    """Enclose a sine or cosine that has a crest at `top`."""
    turn, room = 2 * np.pi, LOOSE * (4.0 + np.maximum(np.abs(x[0]), np.abs(x[1])))

    def meets(crest: float) -> BoolArray:
        last = np.floor((x[1] + room - crest) / turn)
        return ~(last < np.ceil((x[0] - room - crest) / turn))  # NaN meets all

    a, b = function(x[0]), function(x[1])
    low, high = out((np.minimum(a, b), np.maximum(a, b)), LOOSE)
    low = np.where(meets(top + np.pi), -1.0, np.maximum(low, -1.0))
    return low, np.where(meets(top), 1.0, np.minimum(high, 1.0))


# ---- functions of one variable: the ranges of φ and of its first Taylor coefficients


def power_series(p: float) -> Callable[[Range], Sequence[Range]]:
    """Make the series of x^p."""
    factors = (1.0, p, p * (p - 1) / 2, p * (p - 1) * (p - 2) / 6)
    zero = np.array(0.0), np.array(0.0)

    def series(x: Range) -> Sequence[Range]:
        sign = -1.0 if p < 0 and p == round(p) else 1.0
        base = _inverse(x) if sign < 0 else x
        powers = enumerate(factors)
        return [_scaled(c, _raised(base, sign * (p - k))) if c else zero for k, c in powers]

    return series


def _exp(x: Range) -> Sequence[Range]:
    low, high = _rising(np.exp, x)
    e = np.where(low < TINY, 0.0, low), np.maximum(high, TINY)
    return e, e, _scaled(0.5, e), _scaled(1 / 6, e)


def _ln(x: Range) -> Sequence[Range]:
    inside = np.maximum(x[0], 0.0), np.maximum(x[1], 0.0)
    first = _inverse(inside)
    second, third = _scaled(-1 / 2, square_of(*first)), _scaled(1 / 3, _raised(first, 3.0))
    return _rising(np.log, inside), first, second, third


def _sin(x: Range) -> Sequence[Range]:
    s, c = _wave(x, np.sin, np.pi / 2), _wave(x, np.cos, 0.0)
    return s, c, _scaled(-1 / 2, s), _scaled(-1 / 6, c)


def _cos(x: Range) -> Sequence[Range]:
    s, c = _wave(x, np.sin, np.pi / 2), _wave(x, np.cos, 0.0)
    return c, _scaled(-1.0, s), _scaled(-1 / 2, c), _scaled(1 / 6, s)


def _tan(x: Range) -> Sequence[Range]:
    room = LOOSE * (4.0 + np.maximum(np.abs(x[0]), np.abs(x[1])))
    pole = np.floor((x[1] + room) / np.pi - 0.5) >= np.ceil((x[0] - room) / np.pi - 0.5)
    low, high = _rising(np.tan, x)
    t = np.where(pole, -np.inf, low), np.where(pole, np.inf, high)
    square = square_of(*t)
    first = _plus(square, 1.0)
    third = _scaled(1 / 3, mul(first, _plus(_scaled(3.0, square), 1.0)))
    return t, first, mul(t, first), third


def _asin(x: Range) -> Sequence[Range]:
    x = np.clip(x[0], -1.0, 1.0), np.clip(x[1], -1.0, 1.0)
    square = square_of(*x)
    inside = _plus(_scaled(-1.0, square), 1.0)
    second = _scaled(0.5, mul(x, _raised(inside, -1.5)))
    third = _scaled(1 / 6, mul(_plus(_scaled(2.0, square), 1.0), _raised(inside, -2.5)))
    return _rising(np.arcsin, x), _raised(inside, -0.5), second, third


def _acos(x: Range) -> Sequence[Range]:
    low, high = np.clip(x[1], -1.0, 1.0), np.clip(x[0], -1.0, 1.0)
    return (_rising(np.arccos, (low, high)), *(_scaled(-1.0, term) for term in _asin(x)[1:]))


def _atan(x: Range) -> Sequence[Range]:
    square = square_of(*x)
    first = _inverse(_plus(square, 1.0))
    second = _scaled(-1.0, mul(x, square_of(*first)))
    third = _scaled(1 / 3, mul(_plus(_scaled(3.0, square), -1.0), _raised(first, 3.0)))
    return _rising(np.arctan, x), first, second, third


def _sinh(x: Range) -> Sequence[Range]:
    s, c = _rising(np.sinh, x), _hyperbolic_cosine(x)
    return s, c, _scaled(0.5, s), _scaled(1 / 6, c)


def _cosh(x: Range) -> Sequence[Range]:
    s, c = _rising(np.sinh, x), _hyperbolic_cosine(x)
    return c, s, _scaled(0.5, c), _scaled(1 / 6, s)


def _hyperbolic_cosine(x: Range) -> Range:
    least = np.where((x[0] < 0) & (x[1] > 0), 0.0, np.minimum(np.abs(x[0]), np.abs(x[1])))
    return _rising(np.cosh, (least, np.maximum(np.abs(x[0]), np.abs(x[1]))))


def _tanh(x: Range) -> Sequence[Range]:
    t = _rising(np.tanh, x)
    square = square_of(*t)
    first = _plus(_scaled(-1.0, square), 1.0)
    third = _scaled(1 / 3, mul(first, _plus(_scaled(3.0, square), -1.0)))
    return t, first, _scaled(-1.0, mul(t, first)), third


def _abs(x: Range) -> Sequence[Range]:
    a, b = np.abs(x[0]), np.abs(x[1])
    either = (x[0] < 0) & (x[1] > 0)
    slope, kink = np.where(x[0] >= 0, 1.0, -1.0), np.where(either, np.inf, 0.0)
    return (
        (np.where(either, 0.0, np.minimum(a, b)), np.maximum(a, b)),
        (np.where(either, -1.0, slope), np.where(either, 1.0, slope)),
        (-kink, kink),
        (-kink, kink),
    )


SERIES: dict[type, Callable[[Range], Sequence[Range]]] = {
    classes.Abs: _abs,
    classes.Sqrt: power_series(0.5),
    classes.Exp: _exp,
    classes.Ln: _ln,
    classes.Sin: _sin,
    classes.Cos: _cos,
    classes.Tan: _tan,
    classes.Asin: _asin,
    classes.Acos: _acos,
    classes.Atan: _atan,
    classes.Sinh: _sinh,
    classes.Cosh: _cosh,
    classes.Tanh: _tanh,
}

_RULES: dict[type, Callable[..., Jet]] = {
    classes.Sum: Enclosure._sum,
    classes.Product: Enclosure._product,
    classes.Division: Enclosure._quotient,
    classes.MaxValue: Enclosure._maximum,
    classes.MinValue: Enclosure._minimum,
    classes.Atan2: Enclosure._atan2,
    classes.Conj: lambda _, a: a,
    classes.Real: lambda _, a: a,
}
"""Jets of an operator's arguments are all that these take."""

_Rule: TypeAlias = Callable[[Enclosure, Any], Jet]


def _of_series(series: Callable[[Range], Sequence[Range]]) -> _Rule:
    """Make the rule of a function of one argument from the ranges of its Taylor coefficients."""
    return lambda at, e: at._compose(at(e.ufl_operands[0]), series)


def _of_jets(rule: Callable[..., Jet]) -> _Rule:
    """Make the rule of an operator from what takes the jets of its arguments."""
    return lambda at, e: rule(at, *(at(operand) for operand in e.ufl_operands))


_KINDS: dict[type, _Rule] = {
    **{kind: _of_series(series) for kind, series in SERIES.items()},
    **{kind: _of_jets(rule) for kind, rule in _RULES.items()},
    classes.ScalarValue: lambda at, e: at._constant(float(e)),
    classes.Zero: lambda at, e: at._constant(float(e)),
    classes.Indexed: lambda at, e: at._component(*e.ufl_operands),
    classes.Power: lambda at, e: at._power(*e.ufl_operands),
    classes.Sqrt: lambda at, e: at._number_power(e, 1.0),
    classes.Abs: Enclosure._absolute,
    classes.Conditional: Enclosure._conditional,
    fem.Constant: Enclosure._of_constant,
    fem.Function: Enclosure._function,
}
"""Rules that enclose expressions, by kind. Roots and absolute values are more than their series;
no other kinds are the same or include one another."""


@cache
def _rule_for(kind: type) -> _Rule | None:
    """Find what encloses expressions of a kind; None for those that are not known here."""
    return next((rule for known, rule in _KINDS.items() if issubclass(kind, known)), None)


_KNOWN = (
    *_KINDS,
    classes.ConstantValue,
    classes.Condition,
    classes.MultiIndex,
    classes.SpatialCoordinate,
)
"""Kinds of expressions that need no lowering."""
_ORDERED = (classes.GT, classes.GE, classes.LT, classes.LE)
_COMPARISONS = (*_ORDERED, classes.EQ, classes.NE)


def decided(e: Any, compare: Callable[[Any, Any, Any], Truth]) -> Truth:
    """Tell where a condition can hold, and where it can fail, by what is known of comparisons.

    Args:
        e: The condition.
        compare: Tells it of a comparison, with its two sides, what is to be larger first.

    Raises:
        Unknown: It is made of something else.
    """
    if isinstance(e, classes.NotCondition):
        return decided(e.ufl_operands[0], compare)[::-1]
    if isinstance(e, classes.AndCondition | classes.OrCondition):
        (holds, fails), (also, nor) = (decided(operand, compare) for operand in e.ufl_operands)
        if isinstance(e, classes.AndCondition):
            return holds & also, fails | nor
        return holds | also, fails & nor
    if not isinstance(e, _COMPARISONS):
        raise Unknown(type(e).__name__)
    left, right = e.ufl_operands
    if isinstance(e, classes.LT | classes.LE):
        left, right = right, left
    return compare(e, left, right)


# ---- conditionals that are continuous


_agreeing: WeakKeyDictionary[Any, bool] = WeakKeyDictionary()
"""Answers on conditionals that are still there: one with x in it has its mesh along."""


def _known_to_agree(e: Any) -> bool:
    """Tell whether the branches of a conditional agree, once for each."""
    if e not in _agreeing:
        _agreeing[e] = _agree(*e.ufl_operands)
    return _agreeing[e]


def _agree(condition: Any, first: Any, second: Any) -> bool:
    """Tell whether the branches are seen to be equal where the condition changes."""
    if not isinstance(condition, _ORDERED):
        return False
    if _is_extreme(condition, first, second):
        return True
    a, b = condition.ufl_operands
    if isinstance(a, classes.ConstantValue):
        a, b = b, a
    try:
        one, other = (ufl.replace(branch, {a: b}) for branch in (first, second))
    except (ValueError, ArithmeticError):
        return False
    if all(isinstance(each, classes.RealValue | classes.Zero) for each in (one, other)):
        return float(one) == float(other)
    return bool(one == other)


def _is_extreme(condition: Any, first: Any, second: Any) -> bool:
    """Tell whether the conditional is the larger or the smaller of two numbers."""
    if not isinstance(condition, _ORDERED):
        return False
    a, b = condition.ufl_operands
    return bool((first == a and second == b) or (first == b and second == a))


def _is_maximum(condition: Any, first: Any) -> bool:
    """Tell whether it is the larger, if it is one of them."""
    return bool(
        (first == condition.ufl_operands[0]) == isinstance(condition, classes.GT | classes.GE)
    )
