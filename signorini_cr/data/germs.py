"""Integrable singularities: bounds of an expression near a point at which it has none.

Around a point z data like r^{3/2} cos(3θ/2), or what differentiation makes of them, are powers of
the distance ρ from z times bounded functions of the direction. So a value is written as c + ρ^a I
with an exact number c, an exponent a, and an interval I for each sector of directions, which holds
for all 0 < ρ ≤ ϱ. Arithmetic on such germs is interval arithmetic that keeps powers of ρ apart:
ρ² cos² + ρ² sin² does not reach 0, and ρ^{-1/2} has no bound but an integral.
"""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction
from itertools import product
from typing import Any

import numpy as np
from dolfinx import fem
from ufl import classes
from ufl.corealg import traversal

from ..arrays import BoolArray, FloatArray, IndexArray
from ..fem.cells import at_points
from ..fem.pointwise import Unknown
from ..fem.simplified import bits
from ..mesh.plane import angle, cross
from .jets import (
    SERIES,
    Boxes,
    Enclosure,
    Range,
    Truth,
    decided,
    mul,
    out,
    power_series,
    square_of,
)

SECTORS = 16
"""Sectors that the directions from a point into a triangle are divided into."""
NARROW = 1e-12
"""Directions are known up to this angle, and vertices up to it in parts of their distance."""
MOST_BITS = 100_000
"""Bits of constants, which are exact; of those with more nothing is known."""
MOST_LOOKS = 5_000_000
"""Points times operators at which something singular is looked for."""
AT_ONCE = 4096
"""Points that are looked at together."""
CLOSE = 1e-3
"""Distance from a vertex at which singular points matter, in parts of the simplex's size."""


@dataclass(frozen=True, eq=False)
class Germ:
    """Values c + ρ^a I for 0 < ρ ≤ ϱ; c = 0 unless a > 0.

    Attributes:
        constant: c.
        power: a; infinite where the value is c.
        low: Lower ends of I, shape (n, sectors).
        high: Upper ends of I.
    """

    constant: Fraction
    power: float
    low: FloatArray
    high: FloatArray


def bound(
    expression: Any, point: FloatArray, directions: FloatArray, reach: FloatArray
) -> tuple[float, FloatArray] | None:
    """Find a and A with |expression| ≤ A ρ^a at the distances 0 < ρ ≤ ϱ from a point.

    Args:
        expression: Lowered, a function of x alone.
        point: z, shape (gdim,).
        directions: Bounds of the components of unit vectors, shape (2, gdim, n, sectors).
        reach: ϱ, shape (n,).

    Returns:
        a and A, shape (n,); None where that is not known.
    """
    with np.errstate(all="ignore"):
        try:
            germ = _Germs(point, directions, reach)(expression)
        except (Unknown, OverflowError, ValueError):  # nan is no fraction
            return None
    if germ.power == np.inf:
        return 0.0, np.full(len(reach), abs(float(germ.constant)))
    largest = np.maximum(np.abs(germ.low), np.abs(germ.high)).max(axis=1)
    largest = np.broadcast_to(largest, reach.shape)
    if germ.constant:
        return 0.0, abs(float(germ.constant)) * (1 + 1e-15) + largest * reach**germ.power
    return germ.power, largest


class _Germs:
    """Germs of lowered expressions; what they have in common is found once."""

    def __init__(self, point: FloatArray, directions: FloatArray, reach: FloatArray):
        self.point, self.directions = point, directions
        self.reach = reach[:, None] * (1 + 1e-15)
        self._known: dict[Any, Germ] = {}

    def __call__(self, e: Any) -> Germ:
        if e not in self._known:
            self._known[e] = self._germ(e)
        return self._known[e]

    def _germ(self, e: Any) -> Germ:
        if isinstance(e, classes.ScalarValue | classes.Zero):
            return self._number(float(e))
        if isinstance(e, fem.Constant) and e.ufl_shape == ():
            return self._number(float(e.value))
        operands: Any = getattr(e, "ufl_operands", ())
        if isinstance(e, classes.Indexed):
            return self._component(*operands)
        if isinstance(e, classes.Conditional):
            holds, fails = decided(operands[0], self._compared)
            return self._choice(holds, fails, self(operands[1]), self(operands[2]))
        if isinstance(e, classes.Power):
            exponent = self(operands[1])
            if exponent.power != np.inf:
                raise Unknown("power")
            return self._to_the(self(operands[0]), float(exponent.constant))
        if isinstance(e, classes.Sqrt):
            return self._to_the(self(operands[0]), 0.5)
        if isinstance(e, classes.Abs):
            return self._abs(self(operands[0]))
        for kind, series in SERIES.items():
            if isinstance(e, kind):
                return self._ranged(series(self.plain(self(operands[0])))[0])
        rules = {
            classes.Sum: self._sum,
            classes.Product: self._product,
            classes.Division: lambda a, b: self._product(a, self._to_the(b, -1.0)),
            classes.Atan2: self._atan2,
            classes.MaxValue: lambda a, b: self._choice(*self._above(a, b), a, b),
            classes.MinValue: lambda a, b: self._choice(*self._above(b, a), a, b),
        }
        for kind, rule in rules.items():
            if isinstance(e, kind):
                return rule(*(self(operand) for operand in operands))
        raise Unknown(type(e).__name__)

    def _number(self, value: float | Fraction) -> Germ:
        nothing, exact = np.zeros((1, 1)), Fraction(value)
        if bits(exact) > MOST_BITS:
            raise Unknown("a number with so many digits")
        return Germ(exact, np.inf, nothing, nothing)

    def _ranged(self, x: Range) -> Germ:
        return Germ(Fraction(0), 0.0, *x)

    def _component(self, vector: Any, index: Any) -> Germ:
        if not isinstance(vector, classes.SpatialCoordinate) or len(index) > 1:
            raise Unknown(type(vector).__name__)
        i = int(index[0])
        return Germ(Fraction(float(self.point[i])), 1.0, *self.directions[:, i])

    def _with(self, g: Germ, power: float) -> Range:
        """Enclose I for a smaller exponent: ρ^a I lies in ρ^b [0, ϱ^{a−b}] I."""
        if g.power == power:
            return g.low, g.high
        if g.power == np.inf:
            return np.zeros((1, 1)), np.zeros((1, 1))
        scale = self.reach ** (g.power - power)
        return out((np.minimum(g.low * scale, 0.0), np.maximum(g.high * scale, 0.0)))

    def _folded(self, g: Germ, power: float) -> Range:
        """Enclose the same with the constant in I, for an exponent that is not above 0."""
        low, high = self._with(g, power)
        c = float(g.constant)
        if c:
            one = out((np.array(c), np.array(c)))
            if power < 0:
                scale = self.reach**-power
                one = out((np.minimum(one[0] * scale, 0.0), np.maximum(one[1] * scale, 0.0)))
            low, high = out((low + one[0], high + one[1]))
        return low, high

    def plain(self, g: Germ) -> Range:
        """Enclose the range over all ρ."""
        if g.power < 0:
            raise Unknown("what has no bound")
        return self._folded(g, 0.0)

    def _sum(self, a: Germ, b: Germ) -> Germ:
        constant, power = a.constant + b.constant, min(a.power, b.power)
        if power > 0:
            x, y = self._with(a, power), self._with(b, power)
        else:
            constant = Fraction(0)
            x, y = self._folded(a, power), self._folded(b, power)
        return Germ(constant, power, *out((x[0] + y[0], x[1] + y[1])))

    def _product(self, a: Germ, b: Germ) -> Germ:
        total = self._number(a.constant * b.constant)
        terms = [(b, a.constant), (a, b.constant)]
        for g, c in terms:
            if c and g.power != np.inf:
                one = np.array(float(c))
                more = mul(out((one, one)), (g.low, g.high))
                total = self._sum(total, Germ(Fraction(0), g.power, *more))
        if a.power != np.inf and b.power != np.inf:
            more = mul((a.low, a.high), (b.low, b.high))
            total = self._sum(total, Germ(Fraction(0), a.power + b.power, *more))
        return total

    def _to_the(self, g: Germ, p: float) -> Germ:
        whole = p == int(p)
        if g.power == np.inf and whole and (g.constant or p > 0):
            if abs(p) * bits(g.constant) > MOST_BITS:
                raise Unknown("a number with so many digits")
            return self._number(g.constant ** int(p))
        if whole and 0 < p <= 4:  # keeps constants exact
            total = g
            for _ in range(int(p) - 1):
                total = self._product(total, g) if p != 2 else self._squared(g)
            return total
        if g.constant:
            return self._ranged(power_series(p)(self.plain(g))[0])
        if g.power == np.inf:
            raise Unknown("a power of 0")
        return Germ(Fraction(0), g.power * p, *power_series(p)((g.low, g.high))[0])

    def _squared(self, g: Germ) -> Germ:
        if g.constant or g.power == np.inf:
            return self._product(g, g)
        return Germ(Fraction(0), 2 * g.power, *square_of(g.low, g.high))

    def _abs(self, g: Germ) -> Germ:
        if g.power == np.inf:
            return self._number(abs(g.constant))
        x = self.plain(g) if g.constant else (g.low, g.high)
        return Germ(Fraction(0), 0.0 if g.constant else g.power, *SERIES[classes.Abs](x)[0])

    def _atan2(self, y: Germ, x: Germ) -> Germ:
        if y.constant or x.constant or not y.power == x.power < np.inf:
            (a, b), (c, d) = self.plain(y), self.plain(x)
        else:
            a, b, c, d = y.low, y.high, x.low, x.high
        angles = [np.arctan2(s + 0.0, t + 0.0) for s in (a, b) for t in (c, d)]
        low, high = out((np.minimum.reduce(angles), np.maximum.reduce(angles)), 4e-15)
        full = (a <= 0) & (b >= 0) & (c <= 0)
        return Germ(Fraction(0), 0.0, np.where(full, -4.0, low), np.where(full, 4.0, high))

    def _sign(self, a: Germ, b: Germ) -> Range:
        """Find a range with the signs of a − b."""
        g = self._sum(a, self._product(self._number(-1.0), b))
        if g.power == np.inf:
            return np.full((1, 1), float(g.constant)), np.full((1, 1), float(g.constant))
        return self.plain(g) if g.constant else (g.low, g.high)

    def _above(self, a: Germ, b: Germ) -> tuple[BoolArray, BoolArray]:
        low, high = self._sign(a, b)
        return high > 0, low < 0

    def _compared(self, e: Any, left: Any, right: Any) -> Truth:
        """Tell where a comparison can hold, and where it can fail, but for null sets."""
        if isinstance(e, classes.EQ | classes.NE):
            raise Unknown(type(e).__name__)
        low, high = self._sign(self(left), self(right))
        strict = isinstance(e, classes.GT | classes.LT)
        zero = (low == 0) & (high == 0)
        return (high > 0) | (zero & (not strict)), (low < 0) | (zero & strict)

    def _choice(self, first: BoolArray, second: BoolArray, a: Germ, b: Germ) -> Germ:
        """Choose a where only the first can be, b where only the second, else the hull of both."""
        if not second.any():
            return a
        if not first.any():
            return b
        power = min(a.power, b.power)
        constant = a.constant
        if a.constant == b.constant and power > 0:
            if power == np.inf:
                return a
            x, y = self._with(a, power), self._with(b, power)
        else:
            power, constant = min(power, 0.0), Fraction(0)
            x, y = self._folded(a, power), self._folded(b, power)
        low = np.where(first, np.where(second, np.minimum(x[0], y[0]), x[0]), y[0])
        high = np.where(first, np.where(second, np.maximum(x[1], y[1]), x[1]), y[1])
        return Germ(constant, power, low, high)


def allowance(
    expression: Any, corners: FloatArray, hats: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Find R and W of `ranges` for data that have no bound at a vertex of a simplex, or near one.

    With |f| ≤ A ρ^a on T, and q the polynomial that a quadrature rule sees, ‖f − q‖ is at most
    ‖f‖ + ‖q‖ ≤ A (∫_T ρ^{2a})^{1/2} + A ρ₀^a |T|^{1/2}, ρ₀ the least distance of the rule's points.

    Args:
        expression: Lowered, a function of x alone.
        corners: Vertices of triangles or segments, shape (d + 1, gdim, n), d ≤ 2.
        hats: Barycentric coordinates of the rule's points, shape (d + 1, q).

    Returns:
        R and W, infinite where nothing is known, shapes (n,).
    """
    d, n = len(corners) - 1, corners.shape[-1]
    found = np.full((2, n), np.inf)
    if d > 2 or not n:
        return found[0], found[1]
    size = np.linalg.norm(corners[1:] - corners[:1], axis=1).max(axis=0)
    for point in singular_points(expression, corners):
        away = np.linalg.norm(corners - point[:, None], axis=1)
        which = np.flatnonzero(away.min(axis=0) <= CLOSE * size)
        if not len(which):
            continue
        offset = corners[..., which] - point[:, None]
        reach = away[:, which].max(axis=0) * (1 + NARROW)
        tip = away[:, which].argmin(axis=0)
        distance = away[tip, which]
        exact = distance <= NARROW * (size[which] + np.linalg.norm(point))
        measure = _measures(corners[..., which])
        directions, angle = _sectors(offset, tip, exact)
        germ = bound(expression, point, directions, reach)
        if germ is None or 2 * germ[0] <= -d:
            continue
        power, largest = germ
        points = at_points(offset, hats)
        nearest = np.linalg.norm(points, axis=0).min(axis=0) * (1 - NARROW)
        with np.errstate(divide="ignore"):
            most = largest * np.maximum(nearest**power, reach**power)
        square, mean = (
            angle * reach ** (k * power + d) / ((k * power + d) * measure) for k in (2, 1)
        )
        rough = 0.5 * (largest * np.sqrt(square) + most) * (1 + NARROW)
        missed = 0.5 * (largest * mean + most) * (1 + NARROW)
        # seen from outside, the simplex has to lie on one side
        rough[angle > np.pi] = np.inf
        found[0, which] = np.fmin(found[0, which], rough)
        found[1, which] = np.fmin(found[1, which], np.fmin(missed, rough))
    return found[0], found[1]


def may_be_singular(expression: Any) -> bool:
    """Tell whether an operator in the expression can take something finite to infinity."""
    return bool(_inverted(expression))


def _inverted(expression: Any) -> list[Any]:
    """List what operators of an expression take to infinity where it is 0."""
    found = []
    for e in traversal.unique_pre_traversal(expression):
        if isinstance(e, classes.Division):
            found.append(e.ufl_operands[1])
        elif isinstance(e, classes.Ln) or (
            isinstance(e, classes.Power) and not _is_positive(e.ufl_operands[1])
        ):
            found.append(e.ufl_operands[0])
    return found


def _is_positive(e: Any) -> bool:
    """Tell whether it is a positive number, whatever values constants may get."""
    return isinstance(e, classes.ScalarValue) and float(e) > 0


def holders(point: FloatArray, corners: FloatArray) -> tuple[IndexArray, FloatArray]:
    """Find the simplices in which a point is, but for those it is a vertex of.

    Args:
        point: Where, shape (gdim,).
        corners: Vertices of triangles or segments, shape (d + 1, gdim, n).

    Returns:
        The simplices, and the point's barycentric coordinates there, shape (d + 1, simplices).
    """
    size = np.linalg.norm(corners[1:] - corners[:1], axis=1).max(axis=0)
    hats = _barycentric(corners, point)
    x = np.einsum("cn,cgn->gn", hats, corners)
    room = NARROW * (size + np.linalg.norm(point))
    near = np.linalg.norm(x - point[:, None], axis=0) <= room
    corner = np.linalg.norm(corners - point[:, None], axis=1).min(axis=0) <= room
    # on a side of it, whichever way that was rounded
    which = np.flatnonzero(near & ~corner & (hats.min(axis=0) >= -NARROW))
    inside = np.maximum(hats[:, which], 0.0)
    return which, inside / inside.sum(axis=0)


def _measures(corners: FloatArray) -> FloatArray:
    """Measure segments or triangles, shape (n,)."""
    edges = corners[1:] - corners[:1]
    if len(corners) == 2:
        return np.asarray(np.linalg.norm(edges[0], axis=0))
    return np.asarray(0.5 * np.abs(cross(edges[0].T, edges[1].T)))


def _barycentric(corners: FloatArray, point: FloatArray) -> FloatArray:
    """Find barycentric coordinates of the nearest point in a simplex's plane, shape (d + 1, n)."""
    edges = (corners[1:] - corners[:1]).transpose(2, 0, 1)
    gram = edges @ edges.transpose(0, 2, 1)
    right = np.einsum("ndg,ng->nd", edges, (point[:, None] - corners[0]).T)
    others = np.linalg.solve(gram, right[:, :, None])[:, :, 0].T
    return np.vstack([1.0 - others.sum(axis=0), others])


def singular_points(expression: Any, corners: FloatArray) -> list[FloatArray]:
    """Find points near simplices at which an expression has no value: of 0 and numbers in it.

    Args:
        expression: Lowered.
        corners: Vertices of triangles or segments, shape (d + 1, gdim, n).

    Returns:
        The points, each of shape (gdim,), in an order of their own.
    """
    found: dict[tuple[float, ...], None] = {}
    for e in _divisors(expression):
        points = _of_numbers(e, corners)
        if len(points) * len(list(traversal.unique_pre_traversal(e))) <= MOST_LOOKS:
            found |= dict.fromkeys(map(tuple, points[_unbounded(1.0 / e, points, corners)]))
    every = np.array(sorted(found)).reshape(-1, corners.shape[1])
    return list(every[_unbounded(expression, every, corners)])


def _divisors(expression: Any) -> list[Any]:
    """List what an expression is singular at the roots of: no products, and no powers."""
    left = _inverted(expression)
    found: dict[Any, bool] = {}  # and whether it has roots of its own
    while left:
        e = left.pop()
        if e in found:
            continue
        roots: tuple[Any, ...] = ()
        if isinstance(e, classes.Product):
            roots = e.ufl_operands
        elif isinstance(e, classes.Division | classes.Sqrt | classes.Abs) or (
            isinstance(e, classes.Power) and _is_positive(e.ufl_operands[1])
        ):
            roots = e.ufl_operands[:1]
        found[e] = not roots and not isinstance(e, classes.ScalarValue)
        left += roots
    return [e for e, own in found.items() if own]


def _of_numbers(expression: Any, corners: FloatArray) -> FloatArray:
    """Find the points of 0 and numbers in an expression that are near simplices, (k, gdim)."""
    numbers = {0.0}
    for e in traversal.unique_pre_traversal(expression):
        if isinstance(e, classes.ScalarValue) or (isinstance(e, fem.Constant) and not e.ufl_shape):
            value = float(e) if isinstance(e, classes.ScalarValue) else float(e.value)
            numbers |= {value, -value}
    low, high = corners.min(axis=0), corners.max(axis=0)
    room = CLOSE * np.linalg.norm(high - low, axis=0)
    axes, levels = [], []
    for a, b in zip(low, high, strict=True):
        axes.append([x for x in sorted(numbers) if np.any((a - room <= x) & (x <= b + room))])
        levels.append(sorted(set(np.unique(a[a == b]).tolist()) - numbers))
    points = [*product(*axes)]
    for i, flat in enumerate(levels):  # facets that are aligned with an axis
        points += product(*axes[:i], flat, *axes[i + 1 :])
    return np.array(points).reshape(-1, len(axes))


def _unbounded(expression: Any, points: FloatArray, corners: FloatArray) -> BoolArray:
    """Tell at which points an expression is not seen to have a value, shape (k,)."""
    found = np.zeros(len(points), dtype=bool)
    # 0 times what has no bound would be 0
    room = 1e-9 * np.ptp(corners, axis=(0, 2)).max() + 1e-15 * np.abs(points)
    for at in range(0, len(points), AT_ONCE):
        some = slice(at, at + AT_ONCE)
        low, high = (points[some] - room[some]).T, (points[some] + room[some]).T
        try:
            jet = Enclosure(Boxes(low, high), order=0)(expression)
        except Unknown:
            break
        found[some] = ~(np.isfinite(jet.low) & np.isfinite(jet.high))
    return found


def _sectors(
    offset: FloatArray, tip: IndexArray, exact: BoolArray
) -> tuple[FloatArray, FloatArray]:
    """Bound the unit vectors that point from a point into simplices.

    Args:
        offset: From the point to the vertices, shape (d + 1, gdim, n), d ≤ 2.
        tip: The vertex that is next to the point, shape (n,).
        exact: Whether it is the point.

    Returns:
        The bounds, shape (2, gdim, n, sectors), and the angles between all of them, shape (n,).
    """
    length = np.linalg.norm(offset, axis=1, keepdims=True)
    unit = offset / np.where(length > 0, length, 1.0)
    at = np.arange(len(tip))
    if len(unit) == 2:
        far, near = unit[1 - tip, :, at].T, unit[tip, :, at].T
        near = np.where(exact, far, near)
        low, high = np.minimum(far, near), np.maximum(far, near)
        sides = 1.0 + (np.einsum("gn,gn->n", far, near) < 0)
        rows = low - NARROW * np.abs(low), high + NARROW * np.abs(high)
        return np.stack(rows)[..., None], sides
    start: FloatArray = np.zeros(len(tip))
    turn: FloatArray = np.zeros(len(tip))
    for i, j in ((1, 2), (0, 1), (0, 2)):  # the widest of the angles between two vertices
        one, other = ((tip + k) % 3 for k in (i, j))
        a, b = unit[one, :, at], unit[other, :, at]
        between = angle(a, b)
        wider = (np.abs(between) > np.abs(turn)) & ~(exact & (i == 0))
        start = np.where(wider, np.arctan2(a[:, 1], a[:, 0]), start)
        turn = np.where(wider, between, turn)
    ends = start[:, None] + turn[:, None] * np.linspace(0.0, 1.0, SECTORS + 1)
    low = np.minimum(ends[:, :-1], ends[:, 1:])
    high = np.maximum(ends[:, :-1], ends[:, 1:])
    bounds: list[Range] = []
    for shift in (0.5 * np.pi, 0.0):  # cosine and sine
        first, last = (np.sin(end + shift) for end in (low, high))
        top = np.floor((high + shift) / np.pi - 0.5) > np.floor((low + shift) / np.pi - 0.5)
        least = np.where(top & (first + last < 0), -1.0, np.minimum(first, last))
        most = np.where(top & (first + last > 0), 1.0, np.maximum(first, last))
        # directions along an axis are that
        least = np.where(np.abs(least) < NARROW, 0.0, least - NARROW * np.abs(least))
        most = np.where(np.abs(most) < NARROW, 0.0, most + NARROW * np.abs(most))
        bounds.append((least, most))
    return np.array(bounds).transpose(1, 0, 2, 3), np.abs(turn) * (1 + NARROW)
