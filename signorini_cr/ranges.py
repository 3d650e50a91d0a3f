"""Upper and lower bounds of an expression on each cell, by interval arithmetic.

The cell is taken for its bounding box, an operator's range follows from its arguments' ranges. The
bounds hold for every point, not only for those where somebody looked; they may be too wide by
O(h), and by rounding they may be too narrow.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt
import ufl
from dolfinx import fem
from ufl import classes

from .cells import Cells
from .compat import cell_nodes

FloatArray = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]
Range = tuple[FloatArray, FloatArray]


class _Unknown(Exception):
    """An operator whose range is not known here."""


def range_of(expression: ufl.core.expr.Expr, cells: Cells) -> Range | None:
    """Lower and upper bounds on each owned cell, shapes (cells,) or ().

    Args:
        expression: A scalar.
        cells: The mesh.

    Returns:
        None if the expression holds an operator whose range is not known here.
    """
    with np.errstate(all="ignore"):
        try:
            low, high = _range(expression, cells)
        except _Unknown:
            return None
    known = np.isfinite(low).all() and np.isfinite(high).all()
    return (low, high) if known else None


def _range(e: Any, cells: Cells) -> Range:
    if isinstance(e, classes.ScalarValue | classes.Zero):
        return np.array(float(e)), np.array(float(e))
    if isinstance(e, fem.Constant) and e.ufl_shape == ():
        return np.array(float(e.value)), np.array(float(e.value))
    if isinstance(e, fem.Function):
        return _function(e, cells)
    if isinstance(e, classes.Indexed):
        vector, index = e.ufl_operands
        if isinstance(vector, classes.SpatialCoordinate) and isinstance(
            index[0], classes.FixedIndex
        ):
            return _coordinate(int(index[0]), cells)
    if isinstance(e, classes.Conditional):
        condition, first, second = e.ufl_operands
        true, false = _truth(condition, cells)
        (a, b), (c, d) = _range(first, cells), _range(second, cells)
        return (
            np.where(false, np.where(true, np.minimum(a, c), c), a),
            np.where(false, np.where(true, np.maximum(b, d), d), b),
        )
    rule = next((rule for kind, rule in _RULES.items() if isinstance(e, kind)), None)
    if rule is not None:
        return rule(*(_range(operand, cells) for operand in e.ufl_operands))
    raise _Unknown(type(e).__name__)


def _coordinate(i: int, cells: Cells) -> Range:
    mesh = cells.domain.mesh
    x = mesh.geometry.x[cell_nodes(mesh)[: cells.number], i]
    return x.min(axis=1), x.max(axis=1)


def _function(function: fem.Function, cells: Cells) -> Range:
    """Ranges of functions whose values are between their degrees of freedom."""
    V = function.function_space
    element = V.ufl_element()
    within = (
        V.mesh is cells.domain.mesh
        and element.reference_value_shape == ()
        and element.family_name in ("P", "Lagrange", "Discontinuous Lagrange")
        and element.degree <= 1
    )
    if not within:
        raise _Unknown(function.name)
    values = function.x.array[V.dofmap.list[: cells.number]]
    return values.min(axis=1), values.max(axis=1)


def _truth(e: Any, cells: Cells) -> tuple[BoolArray, BoolArray]:
    """Where in the cell a condition can hold, and where it can fail, but for null sets."""
    if isinstance(e, classes.NotCondition):
        return _truth(e.ufl_operands[0], cells)[::-1]
    if isinstance(e, classes.AndCondition | classes.OrCondition):
        (true, false), (also, nor) = (_truth(operand, cells) for operand in e.ufl_operands)
        if isinstance(e, classes.AndCondition):
            return true & also, false | nor
        return true | also, false & nor
    if isinstance(e, classes.GT | classes.GE | classes.LT | classes.LE):
        larger, smaller = e.ufl_operands
        if isinstance(e, classes.LT | classes.LE):
            larger, smaller = smaller, larger
        (a, b), (c, d) = _range(larger, cells), _range(smaller, cells)
        either = (a == d) & (b == c)  # the same number on both sides
        return (b > c) | either, (a < d) | either
    raise _Unknown(type(e).__name__)


def _product(x: Range, y: Range) -> Range:
    ends = np.broadcast_arrays(*(a * b for a in x for b in y))
    return np.minimum.reduce(ends), np.maximum.reduce(ends)


def _quotient(x: Range, y: Range) -> Range:
    if np.any((y[0] <= 0) & (y[1] >= 0)):
        raise _Unknown("division by a range around 0")
    return _product(x, (1 / y[1], 1 / y[0]))


def _power(x: Range, p: Range) -> Range:
    if p[0].ndim or p[0] != p[1]:
        raise _Unknown("power")
    exponent = float(p[0])
    whole = exponent == round(exponent)
    if not whole and np.any(x[0] < 0):
        raise _Unknown("root of a range around 0")
    if exponent < 0:
        return _quotient((np.array(1.0), np.array(1.0)), _power(x, (-p[0], -p[0])))
    a, b = x[0] ** exponent, x[1] ** exponent
    low, high = np.minimum(a, b), np.maximum(a, b)
    if whole and exponent % 2 == 0:
        low = np.where((x[0] < 0) & (x[1] > 0), 0.0, low)
    return low, high


def _abs(x: Range) -> Range:
    a, b = np.abs(x[0]), np.abs(x[1])
    return np.where((x[0] < 0) & (x[1] > 0), 0.0, np.minimum(a, b)), np.maximum(a, b)


def _sin(x: Range) -> Range:
    """A wave reaches ±1 where π/2 + 2πk, or −π/2 + 2πk, is in the range."""
    turn = 2 * np.pi
    a, b = np.sin(x[0]), np.sin(x[1])
    top = np.floor((x[1] - np.pi / 2) / turn) >= np.ceil((x[0] - np.pi / 2) / turn)
    bottom = np.floor((x[1] + np.pi / 2) / turn) >= np.ceil((x[0] + np.pi / 2) / turn)
    return np.where(bottom, -1.0, np.minimum(a, b)), np.where(top, 1.0, np.maximum(a, b))


def _cos(x: Range) -> Range:
    return _sin((x[0] + np.pi / 2, x[1] + np.pi / 2))


def _rising(function: Callable[[FloatArray], FloatArray]) -> Callable[[Range], Range]:
    return lambda x: (function(x[0]), function(x[1]))


_RULES: dict[type, Callable[..., Range]] = {
    classes.Sum: lambda x, y: (x[0] + y[0], x[1] + y[1]),
    classes.Product: _product,
    classes.Division: _quotient,
    classes.Power: _power,
    classes.Abs: _abs,
    classes.Sin: _sin,
    classes.Cos: _cos,
    classes.Sqrt: _rising(np.sqrt),
    classes.Exp: _rising(np.exp),
    classes.Ln: _rising(np.log),
    classes.Atan: _rising(np.arctan),
    classes.Tanh: _rising(np.tanh),
    classes.Sinh: _rising(np.sinh),
    classes.MinValue: lambda x, y: (np.minimum(x[0], y[0]), np.minimum(x[1], y[1])),
    classes.MaxValue: lambda x, y: (np.maximum(x[0], y[0]), np.maximum(x[1], y[1])),
}
