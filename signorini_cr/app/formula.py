"""Formulas in x and y: a graph of operations on numbers and conditions, with two readings.

- :meth:`Expression.ufl` on a spatial coordinate, for forms and for differentiation,
- :meth:`Expression.numpy` on an array of points, for checks and tables.

Every number is a float (``1/2`` is 0.5), and constants are folded when the graph is built, so that
huge powers cost nothing and a constant that is not finite can be rejected at once.
"""

import math
import operator
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt
import ufl

VARIABLES = ("x", "y")
CONSTANTS = {"pi": math.pi}


@dataclass(frozen=True, eq=False, slots=True)
class Node:
    """One operation; ``args`` holds nodes, or the value of a ``const`` or the index of an ``x``.

    ``lost`` tells of a constant that is 0 as it is below all numbers, and not because it is 0.
    """

    op: str
    args: tuple[Any, ...]
    condition: bool = False
    lost: bool = False


class Clock:
    """The time t, one number for all the expressions of a file."""

    def __init__(self) -> None:
        """Begin at 0."""
        self._value = 0.0
        self._constants: dict[Any, Any] = {}

    @property
    def value(self) -> float:
        """The time, which can be set; forms that hold `on` follow."""
        return self._value

    @value.setter
    def value(self, value: float) -> None:
        self._value = value
        for constant in self._constants.values():
            constant.value = value

    def on(self, x: Any) -> Any:
        """Return a number if x is an array of points, a Constant if it is a coordinate in UFL."""
        if isinstance(x, np.ndarray):
            return self._value
        from dolfinx import fem  # problem files are read without it

        domain = ufl.domain.extract_unique_domain(x)
        if domain not in self._constants:
            self._constants[domain] = fem.Constant(domain, self._value)
        return self._constants[domain]


def _power(base: Any, exponent: Any) -> Any:
    """Raise to a power in UFL, ``base**exponent``, with small whole exponents as integers."""
    if isinstance(exponent, float) and exponent.is_integer() and abs(exponent) <= 64:
        exponent = int(exponent)
    return _inside(lambda b: b**exponent, base)


def _inside(function: Callable[[Any], Any], value: Any) -> Any:
    """Take ``function(value)`` into the branches of a conditional.

    Differentiation then stays within a branch: the derivative of ``max(0, x)**1.5`` for x < 0 is 0
    rather than the 0 times infinity of the chain rule. Where a branch is a number of which there is
    no function, as in ``sqrt(where(x > 0, x, -1))``, the conditional stays within: that branch may
    be taken nowhere.
    """
    if not isinstance(value, ufl.classes.Conditional):
        return function(value)
    condition, *branches = value.ufl_operands
    try:
        found = [_inside(function, branch) for branch in branches]
    except (ArithmeticError, ValueError):  # UFL works it out as Python does
        return function(value)
    if any(isinstance(ufl.as_ufl(each), ufl.constantvalue.ComplexValue) for each in found):
        return function(value)
    return ufl.conditional(condition, *found)


# name: (arguments as the user counts them, NumPy, UFL); None means two or more.
FUNCTIONS: dict[str, tuple[int | None, Callable[..., Any], Callable[..., Any]]] = {
    "sqrt": (1, np.sqrt, lambda a: _inside(ufl.sqrt, a)),
    "exp": (1, np.exp, ufl.exp),
    "log": (1, np.log, ufl.ln),
    "sin": (1, np.sin, ufl.sin),
    "cos": (1, np.cos, ufl.cos),
    "tan": (1, np.tan, ufl.tan),
    "asin": (1, np.arcsin, ufl.asin),
    "acos": (1, np.arccos, ufl.acos),
    "atan": (1, np.arctan, ufl.atan),
    "atan2": (2, np.arctan2, ufl.atan2),
    "sinh": (1, np.sinh, ufl.sinh),
    "cosh": (1, np.cosh, ufl.cosh),
    "tanh": (1, np.tanh, ufl.tanh),
    "abs": (1, np.abs, abs),
    "sign": (1, np.sign, ufl.sign),
    "min": (None, np.minimum, lambda a, b: ufl.conditional(ufl.lt(a, b), a, b)),
    "max": (None, np.maximum, lambda a, b: ufl.conditional(ufl.gt(a, b), a, b)),
    "where": (3, np.where, ufl.conditional),
}
_OPERATORS: dict[str, tuple[Callable[..., Any], Callable[..., Any]]] = {
    "+": (np.add, operator.add),
    "-": (np.subtract, operator.sub),
    "*": (np.multiply, operator.mul),
    "/": (np.divide, operator.truediv),
    "**": (np.power, _power),
    "neg": (np.negative, operator.neg),
    "<": (np.less, ufl.lt),
    "<=": (np.less_equal, ufl.le),
    ">": (np.greater, ufl.gt),
    ">=": (np.greater_equal, ufl.ge),
    "==": (np.equal, ufl.eq),
    "!=": (np.not_equal, ufl.ne),
    "and": (np.logical_and, ufl.And),
    "or": (np.logical_or, ufl.Or),
    "not": (np.logical_not, ufl.Not),
}
_NEVER_ZERO = ("*", "/", "**", "exp")
"""Of numbers other than 0; 0 times a number is folded before."""
_NUMPY = {name: row[0] for name, row in _OPERATORS.items()}
_NUMPY |= {name: row[1] for name, row in FUNCTIONS.items()}
_UFL = {name: row[1] for name, row in _OPERATORS.items()}
_UFL |= {name: row[2] for name, row in FUNCTIONS.items()}


@dataclass(frozen=True)
class Expression:
    """A number or a condition that depends on the point (x, y).

    Attributes:
        text: What was written.
        root: The operation that gives the value.
    """

    text: str
    root: Node = field(repr=False)

    @property
    def is_condition(self) -> bool:
        """True if the value is true or false rather than a number."""
        return self.root.condition

    @property
    def constant(self) -> float | bool | None:
        """The value where it is the same at every point, else None."""
        return self.root.args[0] if self.root.op == "const" else None

    @property
    def depends_on_time(self) -> bool:
        """True if the time is in it."""
        return any(node.op == "clock" for node in self._order)

    @cached_property
    def _order(self) -> tuple[Node, ...]:
        """All operations, each after those it needs."""
        return tuple(operands_first(self.root))

    def ufl(self, x: Any) -> Any:
        """Build the expression in UFL.

        Args:
            x: The spatial coordinate, with at least two components.

        Returns:
            A scalar UFL expression (a UFL condition for a condition); a constant stays as it is.
        """
        return self._value(_UFL, x)

    def numpy(self, points: npt.ArrayLike) -> npt.NDArray[Any]:
        """Evaluate it at points; what is not finite there comes out as inf or nan.

        Args:
            points: Coordinates, shape (n, 2) or wider.

        Returns:
            Floats, or booleans for a condition, shape (n,).
        """
        points = np.asarray(points, dtype=np.float64)
        with np.errstate(all="ignore"):
            value = self._value(_NUMPY, points.T)
        return np.array(np.broadcast_to(value, points.shape[:1]))

    def _value(self, table: Mapping[str, Callable[..., Any]], x: Any) -> Any:
        values: dict[int, Any] = {}
        for node in self._order:
            if node.op == "const":
                values[id(node)] = node.args[0]
            elif node.op == "clock":
                values[id(node)] = node.args[0].on(x)
            elif node.op == "variable":
                values[id(node)] = x[node.args[0]]
            else:
                values[id(node)] = table[node.op](*(values[id(arg)] for arg in node.args))
        return values[id(self.root)]


def operands_first(root: Node) -> Iterator[Node]:
    """Walk the graph below ``root``, each operation once and after its operands."""
    seen: set[int] = set()
    stack = [(root, False)]
    while stack:
        node, ready = stack.pop()
        if ready:
            yield node
        elif id(node) not in seen:
            seen.add(id(node))
            stack.append((node, True))
            stack.extend((arg, False) for arg in node.args if isinstance(arg, Node))


def constant(value: float | bool, lost: bool = False) -> Node:
    """Make the node of a number, or of true or false."""
    return Node("const", (value,), isinstance(value, bool), lost)


def is_constant(node: Node, value: float | bool) -> bool:
    """Tell whether a node is known to have this value."""
    return node.op == "const" and node.args[0] == value


def operation(op: str, *args: Node) -> Node:
    """Make the node of an operation, folded where its value is known."""
    condition = op in ("<", "<=", ">", ">=", "==", "!=", "and", "or", "not")
    if op == "where" and args[0].op == "const":
        return args[1] if args[0].args[0] else args[2]
    if op in ("and", "or"):
        stop = op == "or"
        if any(is_constant(arg, stop) for arg in args):
            return constant(stop)
        if any(is_constant(arg, not stop) for arg in args):
            return args[1] if is_constant(args[0], not stop) else args[0]
    if (op == "*" and (is_constant(args[0], 0.0) or is_constant(args[1], 0.0))) or (
        op == "/" and is_constant(args[0], 0)
    ):
        return constant(0.0)
    if op == "**" and is_constant(args[1], 0.0):
        return constant(1.0)
    if all(arg.op == "const" for arg in args):
        with np.errstate(all="ignore"):
            value = _NUMPY[op](*(arg.args[0] for arg in args))
        lost = value == 0.0 and op in _NEVER_ZERO and args[0].args[0] != 0.0
        return constant(bool(value) if condition else float(value), bool(lost))
    return Node(op, args, condition)
