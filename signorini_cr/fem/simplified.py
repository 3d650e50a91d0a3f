"""Formulas in a normal form, in which what cancels has gone.

Differentiation finds −Δ(r^{3/2} cos(3θ/2)) as a sum of terms like r^{-5/2} x² cos(3θ/2), and says
nothing of its being 0. Here a formula becomes a sum of products of powers of atoms: of the
coordinates, of sums that are divided by or of which a root is taken, and of all that is not
arithmetic. Numbers are fractions and exact. A sum P = … + c y² that is an atom lets y² be replaced
by (P − …)/c everywhere, so that x² + y² is the one power r². The same formula comes out whatever
the order of terms, and 0 where those relations make it 0. Where it is about a point other than 0,
as r² = (x − 2)² + y², coordinates are counted from there.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from fractions import Fraction
from functools import cache, lru_cache
from typing import Any, TypeAlias

import numpy as np
import ufl
from ufl import classes
from ufl.corealg.traversal import unique_pre_traversal

from ..arrays import FloatArray
from .lowering import by_components
from .pointwise import evaluate

Monomial: TypeAlias = tuple[tuple[int, Fraction], ...]
"""Atoms by number, in order, with their exponents."""
Polynomial: TypeAlias = dict[Monomial, Fraction]

MOST_TERMS = 200
"""Terms; with more of them a formula is left as it is."""
MOST_PRODUCTS = 100_000
"""Products of two terms, a second's work; with more of them a formula is left as it is."""
MOST_BITS = 5_000
"""Bits of a factor; with more of them a formula is left as it is."""
FAR = 2.0**300
"""Factors that are larger, or smaller than its inverse, are left where they stand: multiplied out,
as in (x/3)^{800}, they and what they belong to would be beyond the range of numbers."""
LOST, WELL = 16.0, 1e-13
"""Rounding may be so many times what it is in the formula as it was, or that part of the largest
value, before another is taken in its place."""
LARGEST_WHOLE = 64
"""Exponents up to this are integers; in C large ones are none."""
WHOLE = 8
"""Up to this power sums are multiplied out."""
SIMPLE = 64
"""Numbers that are a fraction with such a denominator, but for rounding, are taken for it."""


class _TooLong(Exception):
    """A sum of too many terms, or factors with too many digits."""


def simplified(expression: Any, points: FloatArray | None = None) -> Any:
    """Carry out derivatives, and let terms cancel where this makes the formula shorter.

    A formula of coordinates and numbers alone is worked on once, on whatever meshes it comes.

    Args:
        expression: A scalar.
        points: Where it is to be evaluated, or about there, shape (n, 3). What is multiplied out
            far from there, so that rounding would be more of it, is left as it is.
    """
    others = [
        e
        for e in unique_pre_traversal(expression)
        if isinstance(e, classes.Coefficient | classes.Constant | classes.GeometricQuantity)
    ]
    if len(others) != 1 or not isinstance(x := others[0], classes.SpatialCoordinate):
        return _best(expression, _shorter(expression), points)
    general = _coordinates(ufl.domain.extract_unique_domain(x).ufl_coordinate_element())
    shorter = [ufl.replace(e, {general: x}) for e in _known(ufl.replace(expression, {x: general}))]
    return _best(expression, shorter, points)


def _best(expression: Any, shorter: Sequence[Any], points: FloatArray | None) -> Any:
    """Choose the first of shorter formulas in which rounding is not much more than it has to be."""
    if points is None or not shorter:
        return shorter[0] if shorter else expression
    known = evaluate(expression, points)
    if known is None:
        return shorter[0]
    values, least = known
    there = np.isfinite(values) & np.isfinite(least)
    least = LOST * least + WELL * np.abs(values[there]).max(initial=0.0)
    for each in shorter:
        found = evaluate(each, points)
        if found is None or np.all((found[1] <= least)[there & np.isfinite(found[0])]):
            return each
    return expression


@cache
def _coordinates(element: Any) -> Any:
    """Return the coordinates of a mesh that no program works on."""
    return ufl.SpatialCoordinate(ufl.Mesh(element))


def _shorter(expression: Any) -> list[Any]:
    """List what `simplified` chooses from, the shortest first; only what is shorter."""
    plain = by_components(expression)
    found = []
    try:
        elsewhere = _origin(plain)
    except (ArithmeticError, ValueError):  # what is not finite is no fraction
        return []
    for origin in ({}, elsewhere) if elsewhere else ({},):
        reader = _Reader(origin)
        try:
            reader.read(plain)  # finds the sums that are atoms
            reader.known.clear()
            other = reader.formula(reader.read(plain))
        except (_TooLong, ArithmeticError, ValueError, RecursionError):
            continue
        if _size(other) < _size(plain):
            found.append(other)
    return sorted(found, key=_size)


_known = lru_cache(maxsize=64)(_shorter)


def _origin(expression: Any) -> dict[Any, Fraction]:
    """Find the number that each coordinate is most often compared with, if with any."""
    found: dict[Any, Counter[float]] = {}
    for e in unique_pre_traversal(expression):
        if isinstance(e, classes.Sum):
            a, b = e.ufl_operands
            a, b = (b, a) if isinstance(a, classes.RealValue) else (a, b)
            if _is_coordinate(a) and isinstance(b, classes.RealValue):
                found.setdefault(a, Counter())[-float(b)] += 1
    return {a: _fraction(counts.most_common(1)[0][0]) for a, counts in found.items()}


def _is_coordinate(e: Any) -> bool:
    return isinstance(e, classes.Indexed) and isinstance(
        e.ufl_operands[0], classes.SpatialCoordinate
    )


def bits(number: Fraction) -> int:
    """Count what it takes to write a number down exactly; 0 for 1."""
    return number.numerator.bit_length() + number.denominator.bit_length() - 2


def _handy(factor: Fraction) -> bool:
    """Tell whether a factor has few digits and is no very large or small number."""
    return bits(factor) <= MOST_BITS and 1 / FAR <= abs(factor) <= FAR


def _size(expression: Any) -> int:
    return sum(1 for _ in unique_pre_traversal(expression))


def _fraction(value: float) -> Fraction:
    """Return the number, or the simple fraction of which it is the rounded value."""
    exact = Fraction(value)
    simple = exact.limit_denominator(SIMPLE)
    return simple if abs(simple - exact) <= 3e-16 * abs(exact) else exact


class _Reader:
    """Formulas as polynomials in atoms, which are numbered as they come.

    Args:
        origin: Where coordinates are counted from, if not from 0.

    Attributes:
        known: What has been read.
    """

    def __init__(self, origin: dict[Any, Fraction]) -> None:
        self._origin = origin
        self.known: dict[Any, Polynomial] = {}
        self._atoms: list[Any] = []
        self._places: dict[Any, int] = {}
        self._squares: dict[int, Polynomial] = {}  # by atom
        self._positive: set[int] = set()
        self._coordinates: set[int] = set()
        self._products = 0

    def read(self, e: Any) -> Polynomial:
        """Return the normal form."""
        if e not in self.known:
            self.known[e] = self._read(e)
            if len(self.known[e]) > MOST_TERMS or not all(map(_handy, self.known[e].values())):
                raise _TooLong
        return self.known[e]

    def _read(self, e: Any) -> Polynomial:
        if isinstance(e, classes.Zero):
            return {}
        if isinstance(e, classes.RealValue):
            return {(): _fraction(float(e))}
        if _is_coordinate(e):
            return self._coordinate(e)
        operands: Any = getattr(e, "ufl_operands", ())
        if isinstance(e, classes.Sum):
            return _sum(*(self.read(operand) for operand in operands))
        if isinstance(e, classes.Product):
            return self._product(*(self.read(operand) for operand in operands))
        if isinstance(e, classes.Division):
            return self._product(self.read(operands[0]), self._power(operands[1], Fraction(-1)))
        if isinstance(e, classes.Sqrt):
            return self._power(operands[0], Fraction(1, 2))
        if isinstance(e, classes.Power) and isinstance(operands[1], classes.RealValue):
            return self._power(operands[0], _fraction(float(operands[1])))
        return self._atom(self._key(e, operands), e)

    def _coordinate(self, e: Any) -> Polynomial:
        """Write it as the distance from the origin, and where that is."""
        at = self._origin.get(e, Fraction(0))
        found = self._atom(e, e - float(at) if at else e)
        self._coordinates.add(self._places[e])
        return _sum(found, {(): at}) if at else found

    def _key(self, e: Any, operands: Any) -> Any:
        """Make a key that is the same for the same functions of normal forms."""
        if not operands or any(
            operand.ufl_shape != () or isinstance(operand, classes.Condition)
            for operand in operands
        ):
            return e
        return type(e), tuple(frozenset(self.read(operand).items()) for operand in operands)

    def _atom(self, key: Any, e: Any, power: Fraction = Fraction(1)) -> Polynomial:
        if key not in self._places:
            self._places[key] = len(self._atoms)
            self._atoms.append(e)
        return {((self._places[key], power),): Fraction(1)}

    def _power(self, base: Any, p: Fraction) -> Polynomial:
        terms = self.read(base)
        if p.denominator == 1 and 0 <= p <= WHOLE:
            found: Polynomial = {(): Fraction(1)}
            for _ in range(int(p)):
                found = self._product(found, terms)
            return found
        if len(terms) == 1:
            ((monomial, factor),) = terms.items()
            if p.denominator == 1:
                if abs(p) * bits(factor) > MOST_BITS:
                    raise _TooLong
                return {tuple((i, k * p) for i, k in monomial): factor ** int(p)}
            # a root of P is there only where P ≥ 0, and so is a root of it
            roots = all(i in self._positive or k.denominator > 1 for i, k in monomial)
            if factor == 1 and (roots or (len(monomial) == 1 and monomial[0][1] == 1)):
                return {tuple((i, k * p) for i, k in monomial): Fraction(1)}
        key = frozenset(terms.items())
        found = self._atom(key, base, p)
        self._note(self._places[key], terms)
        return found

    def _note(self, place: int, terms: Polynomial) -> None:
        """Learn from a sum that is an atom: its sign, and a square that it may replace."""
        even = all(k.denominator == 1 and k % 2 == 0 for monomial in terms for _, k in monomial)
        if even and all(factor > 0 for factor in terms.values()):
            self._positive.add(place)
        squares = [
            monomial[0][0]
            for monomial in terms
            if len(monomial) == 1
            and monomial[0][1] == 2
            and monomial[0][0] in self._coordinates
            and not any(
                monomial[0][0] == i for other in terms if other != monomial for i, _ in other
            )
        ]
        if squares and max(squares) not in self._squares:
            square = max(squares)
            factor = terms[((square, Fraction(2)),)]
            rest = {m: -c / factor for m, c in terms.items() if m != ((square, Fraction(2)),)}
            self._squares[square] = rest | {((place, Fraction(1)),): 1 / factor}

    def _product(self, a: Polynomial, b: Polynomial) -> Polynomial:
        found: Polynomial = {}
        self._products += len(a) * len(b)
        if self._products > MOST_PRODUCTS:
            raise _TooLong
        for (m, x), (n, y) in ((s, t) for s in a.items() for t in b.items()):
            exponents = dict(m)
            for i, k in n:
                exponents[i] = exponents.get(i, Fraction(0)) + k
            monomial = tuple(sorted((i, k) for i, k in exponents.items() if k))
            found[monomial] = found.get(monomial, Fraction(0)) + x * y
        found = {m: c for m, c in found.items() if c}
        if not all(map(_handy, found.values())):
            raise _TooLong
        return self._reduced(found)

    def _reduced(self, terms: Polynomial) -> Polynomial:
        """Take out the squares that a sum replaces."""
        found: Polynomial = {}
        for monomial, factor in terms.items():
            for i, k in monomial:
                if i in self._squares and k >= 2 and k.denominator == 1:
                    left = tuple((j, e - 2 * (j == i)) for j, e in monomial)
                    left = tuple((j, e) for j, e in left if e)
                    _add(found, self._product({left: factor}, self._squares[i]))
                    break
            else:
                _add(found, {monomial: factor})
        return found

    def formula(self, terms: Polynomial) -> Any:
        """Write a normal form as an expression."""
        total = ufl.as_ufl(0.0)
        for monomial in sorted(terms):
            term = ufl.as_ufl(float(terms[monomial]))
            for i, k in monomial:
                atom = self._atoms[i]
                if k == Fraction(1, 2):
                    atom = ufl.sqrt(atom)
                elif k != 1:
                    whole = k.denominator == 1 and abs(k) <= LARGEST_WHOLE
                    atom = atom ** (int(k) if whole else float(k))
                term = term * atom
            total = total + term
        return total


def _sum(a: Polynomial, b: Polynomial) -> Polynomial:
    found = dict(a)
    _add(found, b)
    return found


def _add(total: Polynomial, more: Polynomial) -> None:
    """Add to a sum, in place."""
    for monomial, factor in more.items():
        total[monomial] = total.get(monomial, Fraction(0)) + factor
        if not total[monomial]:
            del total[monomial]
