"""Figures as people read them: what is certain stays certain, the rest has no digits to spare.

A number is what its shortest decimals say, as those that print floats take it.
"""

from __future__ import annotations

import math
from decimal import ROUND_CEILING, ROUND_FLOOR, ROUND_HALF_EVEN, Decimal


def rounded_up(value: float, digits: int = 3) -> float:
    """Find the least number of so many digits not below a value; leave what is not finite."""
    if not math.isfinite(value) or value == 0.0:
        return value
    exact = _exact(value)
    return float(_rounded(exact, exact.adjusted() - digits + 1, ROUND_CEILING))


def at_most(value: float, digits: int = 3) -> str:
    """Format a bound from above in so many digits; what is printed is not below it."""
    return told(rounded_up(value, digits))


def interval(lower: float, upper: float) -> str:
    """Format an interval that holds [lower, upper], with two digits of its width, at both ends."""
    width = upper - lower
    if not (0.0 < width < math.inf):
        return f"[{lower!r}, {upper!r}]"
    last = _last(max(width, 1e-15 * max(abs(lower), abs(upper))))
    low = _rounded(_exact(lower), last, ROUND_FLOOR)
    return f"[{_placed(low)}, {_placed(_rounded(_exact(upper), last, ROUND_CEILING))}]"


def digits_of(value: float, within: float | None, digits: int = 6, least: int = 2) -> str:
    """Format a figure with the digits that mean something.

    Args:
        value: It.
        within: How wide the interval is that it is known to lie in; two digits of that are told.
            None if nothing is known about it.
        digits: The most there are.
        least: And the least.
    """
    if not math.isfinite(value) or value == 0.0:
        return told(value)
    exact = _exact(value)
    first = exact.adjusted()
    last = first - digits + 1
    if within is not None and 0.0 < within < math.inf:
        last = max(last, min(_last(within), first - least + 1))
    return _told(_rounded(exact, last, ROUND_HALF_EVEN))


def told(value: float) -> str:
    """Format a number of few digits in full; 100 as 100, not as 1e+02."""
    return _told(_exact(value)) if math.isfinite(value) else str(value)


def counted(number: int, thing: str) -> str:
    """Format a number of things, called by the word for one of them and an s."""
    return f"{number} {thing}{'' if number == 1 else 's'}"


def _exact(value: float) -> Decimal:
    return Decimal(repr(float(value)))


def _last(width: float) -> int:
    """Find the power of ten of the second digit."""
    return math.floor(math.log10(width)) - 1


def _rounded(value: Decimal, last: int, way: str) -> Decimal:
    return value.quantize(Decimal((0, (1,), last)), rounding=way)


def _placed(number: Decimal) -> str:
    """Format a rounded number with the zeros at the end of its decimals."""
    plain = number != 0 and -5 <= number.adjusted() < 10
    return f"{number:f}" if plain else _told(number)


def _told(number: Decimal) -> str:
    if number == 0:
        return "0"
    number = number.normalize()
    if -5 <= number.adjusted() < 10:
        return f"{number:f}"
    return f"{number:e}"
