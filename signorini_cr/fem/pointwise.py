"""Values of UFL expressions at points, alone or with a bound of what rounding may have done.

The bound follows the operations (running error analysis): every one of them adds its own rounding
to what its operands bring along, and the coordinates bring along what they are not known by. Where
a value is the difference of large numbers, or belongs to a steep function, the bound says so.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any, TypeAlias

import numpy as np
import ufl
from dolfinx import fem
from ufl import classes
from ufl.corealg.traversal import unique_post_traversal

from ..arrays import FloatArray, IndexArray, Int32Array
from ..compat import cell_nodes
from ..mesh.domain import Domain
from .lowering import by_components
from .space import facet_corners, facet_normals

Value: TypeAlias = tuple[Any, Any]
"""A number and the bound of its error; of a condition, the truth and 0."""

EPS = float(np.finfo(np.float64).eps)


class Unknown(Exception):
    """An operator that is not known here."""


@dataclass(frozen=True, eq=False)
class Samples:
    """Points of cells or facets, at which formulas are evaluated without compiling them.

    Attributes:
        domain: The mesh.
        cells: The cell of each row of points, shape (n,).
        hats: Barycentric coordinates in the cell, shape (q, d + 1) or (n, q, d + 1).
        facets: Pairs (cell, facet's number in the cell), shape (n, 2), if that is where they are.
    """

    domain: Domain
    cells: Int32Array | IndexArray
    hats: FloatArray
    facets: Int32Array | None = None

    @classmethod
    def on_facets(cls, domain: Domain, facets: Int32Array, hats: FloatArray) -> Samples:
        """Take the same points on each of some boundary facets.

        Args:
            domain: The mesh.
            facets: Pairs (cell, facet's number in the cell), shape (n, 2).
            hats: Barycentric coordinates in a facet, whose vertices are in the order of the cell's
                closure, shape (q, d).
        """
        cells, local = facets.T
        ends = facet_corners(domain.mesh)
        in_cells = np.zeros((len(ends), len(hats), len(ends)))
        np.put_along_axis(in_cells, ends[:, None], hats[None], axis=2)
        return cls(domain, cells, in_cells[local], facets)

    @cached_property
    def x(self) -> FloatArray:
        """Coordinates, shape (n, q, 3); exact where all corners have them, as in `points_of`."""
        mesh = self.domain.mesh
        corners = mesh.geometry.x[cell_nodes(mesh)[self.cells]]
        counted = np.expand_dims((self.hats != 0.0).any(axis=-2), -1)  # a facet's are not all
        low = np.where(counted, corners, np.inf).min(axis=1, keepdims=True)
        high = np.where(counted, corners, -np.inf).max(axis=1, keepdims=True)
        return np.clip(self.hats @ corners, low, high)

    @cached_property
    def normals(self) -> FloatArray:
        """Outward unit normals of the facets, shape (n, 3).

        Raises:
            Unknown: They are points of cells.
        """
        if self.facets is None:
            raise Unknown("normal")
        return facet_normals(self.domain.mesh, self.facets)

    def of(self, expression: Any) -> FloatArray:
        """Evaluate a lowered scalar as compiled code would, shape (n, q).

        Raises:
            Unknown: It holds an operator, or a kind of Function, that is not known here.
        """
        found = by_operators(expression, self._leaf)
        return np.array(np.broadcast_to(found, self.x.shape[:2]), dtype=np.float64)

    def _leaf(self, e: Any) -> Any:
        if isinstance(e, classes.ScalarValue | classes.Zero):
            return float(e)
        if isinstance(e, fem.Constant) and e.ufl_shape == ():
            return float(e.value)
        if isinstance(e, fem.Function) and is_affine(e):
            function = self.domain.own(e)
            values = function.x.array[function.function_space.dofmap.list[self.cells]]
            if values.shape[1] == 1:
                return values
            return (self.hats @ values[:, :, None])[..., 0]
        if isinstance(e, classes.Indexed):
            vector, index = e.ufl_operands
            if all(isinstance(i, classes.FixedIndex) for i in index):
                place = tuple(map(int, index))
                if isinstance(vector, fem.Constant):
                    return float(np.asarray(vector.value)[place])
                if isinstance(vector, classes.SpatialCoordinate):
                    return self.x[..., place[0]]
                if isinstance(vector, classes.FacetNormal):
                    return self.normals[:, None, place[0]]
        raise Unknown(type(e).__name__)


def is_affine(function: fem.Function) -> bool:
    """Tell whether a Function is one of scalars, and affine or constant on each cell."""
    element = function.function_space.ufl_element()
    return (
        element.reference_value_shape == ()
        and element.family_name in ("P", "Lagrange", "Discontinuous Lagrange")
        and element.degree <= 1
    )


def by_operators(expression: Any, leaf: Callable[[Any], Any]) -> Any:
    """Evaluate an expression with NumPy's functions for its operators.

    Args:
        expression: A lowered scalar.
        leaf: Gives the values of all else that is in it; it may raise Unknown.

    Returns:
        Values of the shape that NumPy makes of those of the leaves.
    """
    known: dict[Any, Any] = {}
    stack = [expression]  # rather than calls within one another: it may be deep
    with np.errstate(all="ignore"):
        while expression not in known:
            e = stack[-1]
            function = OPERATORS.get(type(e))
            operands = () if function is None else e.ufl_operands
            if unknown := [operand for operand in operands if operand not in known]:
                stack += unknown
                continue
            known[e] = leaf(e) if function is None else function(*(known[o] for o in operands))
            stack.pop()
    return known[expression]


def evaluate(
    expression: ufl.core.expr.Expr,
    points: FloatArray,
    uncertainty: float = 0.0,
    cells: Int32Array | None = None,
) -> tuple[FloatArray, FloatArray] | None:
    """Evaluate an expression and bound the error of its values.

    Args:
        expression: A scalar, a vector or a matrix.
        points: Coordinates, shape (n, 3).
        uncertainty: By how much each coordinate may be wrong.
        cells: Local cells that hold the points, for Functions, shape (n,).

    Returns:
        Values and bounds, shapes (n, *shape of the expression); None if there is an operator in the
        expression that is not known here.
    """
    reader = _Reader(points, uncertainty, cells)
    shape = (len(points), *expression.ufl_shape)
    values, bounds = np.empty(shape), np.empty(shape)
    with np.errstate(all="ignore"):
        for index in np.ndindex(*expression.ufl_shape):
            at: tuple[Any, ...] = (slice(None), *index)
            component = expression[index] if index else expression
            try:
                try:
                    found = reader.read(component)
                except Unknown:
                    found = reader.read(by_components(component))
            except Unknown:
                return None
            values[at], bounds[at] = found
    return values, bounds


class _Reader:
    """The points and what is known of them."""

    def __init__(self, points: FloatArray, uncertainty: float, cells: Int32Array | None) -> None:
        self.points, self.uncertainty, self.cells = points, uncertainty, cells

    def read(self, expression: Any) -> Any:
        values: dict[Any, Any] = {}
        for node in unique_post_traversal(expression):
            values[node] = self._node(node, [values[operand] for operand in node.ufl_operands])
        return values[expression]

    def _node(self, node: Any, operands: list[Any]) -> Any:
        """Evaluate a node: a pair, a tuple of them for a vector, or of such tuples for a matrix."""
        if isinstance(node, classes.MultiIndex):
            return None
        if isinstance(node, classes.Zero):
            return _filled(node.ufl_shape, lambda _: (0.0, 0.0))
        if isinstance(node, classes.ScalarValue):
            value = float(node)
            return value, 0.0 if value.is_integer() else EPS * abs(value)
        if isinstance(node, classes.Identity):
            return _filled(node.ufl_shape, lambda index: (float(index[0] == index[1]), 0.0))
        if isinstance(node, classes.SpatialCoordinate):
            return tuple((self.points[:, i], self.uncertainty) for i in range(node.ufl_shape[0]))
        if isinstance(node, fem.Constant):
            found = np.asarray(node.value, dtype=np.float64)
            return _filled(node.ufl_shape, lambda index: (found[index], EPS * abs(found[index])))
        if isinstance(node, fem.Function):
            return self._function(node)
        if isinstance(node, classes.ListTensor):
            return tuple(operands)
        if isinstance(node, classes.Indexed):
            part = operands[0]
            for index in node.ufl_operands[1]:
                if not isinstance(index, classes.FixedIndex):
                    raise Unknown("free index")
                part = part[int(index)]
            return part
        if isinstance(node, classes.Variable):
            return operands[0]
        rule = _RULES.get(type(node))
        if node.ufl_shape == () and rule is not None:
            return rule(*operands)
        raise Unknown(type(node).__name__)

    def _function(self, function: fem.Function) -> Any:
        if self.cells is None or len(function.ufl_shape) > 1:
            raise Unknown(function.name)
        values = np.zeros((len(self.points), max((1, *function.ufl_shape))))
        if len(values):
            values[:] = np.reshape(function.eval(self.points, self.cells), values.shape)
        error = 16 * EPS * float(np.abs(function.x.array).max(initial=0.0))
        return _filled(function.ufl_shape, lambda i: (values[:, i[0] if i else 0], error))


def _filled(shape: tuple[int, ...], value: Callable[[tuple[int, ...]], Value]) -> Any:
    """Make nested tuples of a shape."""

    def fill(index: tuple[int, ...]) -> Any:
        if len(index) == len(shape):
            return value(index)
        return tuple(fill((*index, i)) for i in range(shape[len(index)]))

    return fill(())


def _sum(a: Value, b: Value) -> Value:
    value = a[0] + b[0]
    return value, a[1] + b[1] + EPS * np.abs(value)


def _product(a: Value, b: Value) -> Value:
    value = a[0] * b[0]
    error = np.abs(a[0]) * b[1] + np.abs(b[0]) * a[1] + a[1] * b[1]
    return value, error + EPS * np.abs(value)


def _quotient(a: Value, b: Value) -> Value:
    value = np.divide(a[0], b[0])
    return value, (a[1] + np.abs(value) * b[1]) / np.abs(b[0]) + EPS * np.abs(value)


def _function_of(function: Callable[..., Any], period: float = np.inf) -> Callable[..., Value]:
    """Make the rule for a function of NumPy's: how far it moves when its arguments do.

    Args:
        function: Of one argument or more.
        period: A jump by so much is none.
    """

    def rule(*arguments: Value) -> Value:
        here = [argument[0] for argument in arguments]
        value = function(*here)
        total = 2 * EPS * np.abs(value)
        for i, (at, error) in enumerate(arguments):
            moves = [0.0 * value]
            for moved in (at - error, at + error):
                change = np.abs(function(*here[:i], moved, *here[i + 1 :]) - value)
                moves.append(np.fmin(change, np.abs(period - change)))
            total = total + np.fmax(moves[0], np.fmax(moves[1], moves[2]))
        return value, total

    return rule


def _choice(condition: Value, a: Value, b: Value) -> Value:
    return np.where(condition[0], a[0], b[0]), np.where(condition[0], a[1], b[1])


def _extreme(function: Callable[..., Any]) -> Callable[[Value, Value], Value]:
    return lambda a, b: (function(a[0], b[0]), np.maximum(a[1], b[1]))


def _truth(function: Callable[..., Any]) -> Callable[..., Value]:
    return lambda *operands: (function(*(operand[0] for operand in operands)), 0.0)


_SMOOTH: dict[type, Callable[..., Any]] = {
    classes.Power: lambda a, p: np.asarray(a, dtype=np.float64) ** p,
    classes.Sqrt: np.sqrt,
    classes.Exp: np.exp,
    classes.Ln: np.log,
    classes.Sin: np.sin,
    classes.Cos: np.cos,
    classes.Tan: np.tan,
    classes.Asin: np.arcsin,
    classes.Acos: np.arccos,
    classes.Atan: np.arctan,
    classes.Atan2: np.arctan2,
    classes.Sinh: np.sinh,
    classes.Cosh: np.cosh,
    classes.Tanh: np.tanh,
}
_EXTREMES: dict[type, Callable[..., Any]] = {
    classes.MinValue: np.fmin,  # as compiled code has it where one of them is no number
    classes.MaxValue: np.fmax,
}
_TRUTHS: dict[type, Callable[..., Any]] = {
    classes.LT: np.less,
    classes.LE: np.less_equal,
    classes.GT: np.greater,
    classes.GE: np.greater_equal,
    classes.EQ: np.equal,
    classes.NE: np.not_equal,
    classes.AndCondition: np.logical_and,
    classes.OrCondition: np.logical_or,
    classes.NotCondition: np.logical_not,
}
OPERATORS: dict[type, Callable[..., Any]] = {
    classes.Sum: np.add,
    classes.Product: np.multiply,
    classes.Division: np.divide,
    classes.Abs: np.abs,
    classes.Conditional: np.where,
    **_SMOOTH,
    **_EXTREMES,
    **_TRUTHS,
}
"""Function of numbers for each operator."""

_PERIODS = {classes.Atan2: 2 * np.pi}
_RULES: dict[type, Callable[..., Value]] = {
    classes.Sum: _sum,
    classes.Product: _product,
    classes.Division: _quotient,
    classes.Abs: lambda a: (np.abs(a[0]), a[1]),
    classes.Conditional: _choice,
    **{kind: _function_of(f, _PERIODS.get(kind, np.inf)) for kind, f in _SMOOTH.items()},
    **{kind: _extreme(f) for kind, f in _EXTREMES.items()},
    **{kind: _truth(f) for kind, f in _TRUTHS.items()},
}
