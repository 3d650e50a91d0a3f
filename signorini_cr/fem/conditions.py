"""Boundary conditions: what holds on a part of the boundary, and what that adds to the problem.

A kind of condition is a class that overrides what it adds. The user makes one from data; `Forms`
makes the same from expressions, for a part. Whoever assembles, solves or certifies asks each
condition for what it adds, and none for its kind; so one more kind is one more class.
"""

from __future__ import annotations

import copy
import re
import reprlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from numbers import Number
from typing import Any, ClassVar, Self, TypeAlias, TypeVar, cast

import numpy as np
import ufl
from ufl.algorithms.analysis import extract_coefficients, extract_constants
from ufl.core.expr import Expr

from ..arrays import Int32Array
from ..mesh import domain
from ..mesh.domain import Domain

T = TypeVar("T")

Data: TypeAlias = float | Expr | Callable[[Expr], Any]
"""A number, a UFL expression, or a function of x = ufl.SpatialCoordinate that returns one."""


MESHES = 4
"""For so many meshes, or arguments, a function is called once, if it is used on many in turn."""


class Once:
    """A function in the data that is called once for a mesh.

    What it returns may hang on variables that have other values later, when a bound is asked for,
    say, or another solver is made for steps in time. A solution is that of the data as they were.
    """

    def __init__(self, function: Callable[..., Any]):
        """Take it."""
        self._function = function
        self._known: dict[tuple[Expr, ...], Any] = {}

    def __repr__(self) -> str:
        """Write the function."""
        return repr(self._function)

    def __getattr__(self, name: str) -> Any:
        """Have all else that the function has, its name for one."""
        if name == "_function":  # before there is one, as in a copy
            raise AttributeError(name)
        return getattr(self._function, name)

    def __call__(self, *arguments: Any) -> Any:
        """Return what the function has returned for these coordinates, or arguments of a form."""
        given = tuple(each for each in arguments if isinstance(each, Expr))
        if not given:
            return self._function(*arguments)
        if given not in self._known:
            if len(self._known) == MESHES:  # each of which lives as long as what is known of it
                self._known.clear()
            self._known[given] = self._function(*arguments)
        return self._known[given]


def changed(data: T, **others: Any) -> T:
    """Copy a dataclass of data with other values of some fields, however its class is made."""
    made = copy.copy(data)
    for name, value in others.items():
        object.__setattr__(made, name, value)
    return made


def once(data: T) -> T:
    """Copy a dataclass of data, whose functions are called once for a mesh."""
    given = {each.name: getattr(data, each.name) for each in fields(cast(Any, data))}
    own = {
        name: Once(value)
        for name, value in given.items()
        if callable(value) and not isinstance(value, Expr | Once)
    }
    return changed(data, **own)


def in_short(data: Any) -> str:
    """Write a dataclass with what differs from its defaults, functions by their names.

    Of what it has by name there are the names.
    """
    given = []
    for each in fields(data):
        value = getattr(data, each.name)
        if isinstance(value, Mapping):
            value = list(value) or each.default
        plain = isinstance(value, str | Number)  # others may not be compared, or not to one answer
        if each.repr and value is not each.default and not (plain and value == each.default):
            told = getattr(value, "__name__", None) or reprlib.repr(value)
            given.append(f"{each.name}={told}")
    return f"{type(data).__name__}({', '.join(given)})"


def as_number(expression: Expr) -> float | None:
    """Return the number that an expression is, or None."""
    if isinstance(expression, ufl.constantvalue.ScalarValue | ufl.constantvalue.Zero):
        return float(expression)
    return None


def is_by_cells(expression: Expr) -> bool:
    """Tell whether it is a scalar of numbers, Constants and Functions of degree 0."""
    known = ufl.constantvalue.ConstantValue, ufl.Constant, ufl.core.multiindex.MultiIndex
    terminals = ufl.corealg.traversal.traverse_unique_terminals(expression)
    return not expression.ufl_shape and all(
        isinstance(each, known) or domain.is_by_cells(each) for each in terminals
    )


def may_change(expression: Expr) -> bool:
    """Tell whether an expression holds a Constant or a Function, which may get other values."""
    found = extract_constants(expression) or extract_coefficients(expression)
    return bool(found)


def negative(expression: Expr) -> Expr:
    """Return the same with the other sign; a number remains one."""
    value = as_number(expression)
    return -expression if value is None else ufl.as_ufl(-value)


@dataclass(frozen=True)
class Given:
    """Inputs that conditions are made from.

    Attributes:
        expression: Turns data into an expression in the coordinates; `called` is what messages
            call them.
        exact: The exact solution u, if it is known.
        flux: κ∂ₙu, if u is known and not constant.
    """

    expression: Callable[..., Expr]
    exact: Expr | None = None
    flux: Expr | None = None


@dataclass(frozen=True, eq=False, kw_only=True)
class Condition:
    """A condition on one part of the boundary; each kind adds what it overrides.

    Attributes:
        part: The part's name, once it is known.
        number: The part's value in the facet tags.
        label: What its main datum is called, for messages: a key of a problem file.
        source: What that is from: the same, or "exact.u".
        uncertified: Why no certificate covers it; None where one does.
    """

    part: str = field(default="", repr=False)
    number: int = field(default=0, repr=False)
    label: str = field(default="", repr=False)
    source: str = field(default="", repr=False)
    uncertified: ClassVar[str | None] = None

    def __repr__(self) -> str:
        """Tell its data, as far as they are given."""
        return in_short(self)

    def made(self, given: Given, part: str, number: int, label: str) -> Self:
        """Make it from expressions, for a part of the boundary.

        Args:
            given: What goes with the user's data.
            part: The part's name.
            number: Its value in the facet tags.
            label: What the main datum is called.
        """
        source, main = label, self.names()[0]
        left_out = self.main is None and self.optional
        own = {name: getattr(self, name) for name in self.names()} | (
            {main: 0.0} if left_out else {}
        )
        may_lack = {each.name for each in fields(self) if each.default is None}
        expressions = {
            name: None
            if value is None and name in may_lack
            else given.expression(value, called=_in_python(label, part, name))
            for name, value in own.items()
        }
        if left_out and (derived := self._derived(given, expressions)) is not None:
            expressions[main], source = derived, "exact.u"
        own = {"part": part, "number": number, "label": label, "source": source, **expressions}
        return changed(self, **own)

    @classmethod
    def names(cls) -> tuple[str, ...]:
        """Return the names of its data, the main one first."""
        common = {each.name for each in fields(Condition)}
        return tuple(each.name for each in fields(cls) if each.name not in common)

    def _derived(self, given: Given, expressions: dict[str, Expr]) -> Expr | None:
        """Derive the main datum from an exact solution, where the user does not give it."""
        return None

    @classmethod
    def in_words(cls, said: Mapping[str, str], exact: bool, kappa: str) -> str:
        """Say what holds on the part, with data as they were written.

        Args:
            said: What was written for each datum that is given, by name.
            exact: Whether an exact solution is known, which what is not given may follow from.
            kappa: What stands before ∂ₙu.
        """
        first = cls.names()[0]
        given = {first: _derived_in_words(first, exact), **said}
        return f"{cls.__name__}: " + ", ".join(f"{name} = {text}" for name, text in given.items())

    @property
    def kind(self) -> str:
        """Its kind, as legends of pictures call it."""
        return type(self).__name__

    @property
    def main(self) -> Any:
        """Its main datum."""
        return getattr(self, self.names()[0])

    @property
    def optional(self) -> bool:
        """True if the main datum, where it is None, follows from an exact solution, or is 0."""
        return True

    @property
    def data(self) -> dict[str, Any]:
        """All its data by what they are called in messages."""
        values = {self.called(name): getattr(self, name) for name in self.names()}
        return {name: value for name, value in values.items() if value is not None}

    def called(self, name: str) -> str:
        """Say what one of its data is called in messages."""
        return self.label if name == self.names()[0] else f"boundary.{self.part}.{name}"

    @property
    def fixed(self) -> Any:
        """The value that u is set to."""
        return None

    @property
    def bounds(self) -> tuple[tuple[int, Any], ...]:
        """The bounds of u: s u must not be below a, for each pair (s, a), where s is 1 or −1."""
        return ()

    @property
    def flux(self) -> Any:
        """The known part of κ∂ₙu + b u: χ(v) gains its integral times v."""
        return None

    @property
    def loss(self) -> Any:
        """The coefficient b ≥ 0: a_h(u, v) gains the integral of b u v."""
        return None


@dataclass(frozen=True, eq=False, repr=False)
class Dirichlet(Condition):
    """u = u_D.

    Attributes:
        value: u_D; None for the exact solution where there is one, else 0.
    """

    value: Data | None = None

    @classmethod
    def in_words(cls, said: Mapping[str, str], exact: bool, kappa: str) -> str:
        """Say it as an equation."""
        return f"u = {said.get('value', 'exact.u' if exact else '0')}"

    def _derived(self, given: Given, expressions: dict[str, Expr]) -> Expr | None:
        return given.exact

    @property
    def fixed(self) -> Any:
        """All of u_D."""
        return self.value


@dataclass(frozen=True, eq=False, repr=False)
class Neumann(Condition):
    """κ∂ₙu = g.

    Attributes:
        g: The flux; None for the exact solution's where there is one, else 0.
    """

    g: Data | None = None

    @classmethod
    def in_words(cls, said: Mapping[str, str], exact: bool, kappa: str) -> str:
        """Say it as an equation."""
        return f"{kappa}∂ₙu = {said.get('g', _derived_in_words('g', exact))}"

    def _derived(self, given: Given, expressions: dict[str, Expr]) -> Expr | None:
        return given.flux

    @property
    def flux(self) -> Any:
        """All of g."""
        return self.g


@dataclass(frozen=True, eq=False, repr=False)
class Robin(Condition):
    """κ∂ₙu + b (u − u_ext) = g.

    Attributes:
        g: The flux into the domain; None for what an exact solution has on the left, else 0.
        coefficient: b ≥ 0.
        external: u_ext.
    """

    g: Data | None = None
    coefficient: Data = field(default=0.0, kw_only=True)
    external: Data = field(default=0.0, kw_only=True)

    @classmethod
    def in_words(cls, said: Mapping[str, str], exact: bool, kappa: str) -> str:
        """Say it as an equation."""
        return f"{_left_in_words(said, kappa)} = {said.get('g', _derived_in_words('g', exact))}"

    def _derived(self, given: Given, expressions: dict[str, Expr]) -> Expr | None:
        if given.exact is None:
            return None
        gain = expressions["coefficient"] * (given.exact - expressions["external"])
        return gain if given.flux is None else gain + given.flux

    @property
    def flux(self) -> Any:
        """The part of the flux that does not depend on u."""
        return _known(self)

    @property
    def loss(self) -> Any:
        """All of b."""
        return self.coefficient


@dataclass(frozen=True, eq=False, repr=False)
class Contact(Condition):
    """α ≤ u ≤ β: λ = κ∂ₙu + b (u − u_ext) − g is not below 0 where u < β, nor above 0 where u > α.

    So λ = 0 between the bounds; with α alone it is the condition u ≥ α, λ ≥ 0, λ (u − α) = 0.

    Attributes:
        obstacle: α; None for none if there is a β, else 0.
        upper: β; None for none.
        coefficient: b ≥ 0.
        external: u_ext.
        g: A flux into the domain that does not come from an obstacle.
    """

    obstacle: Data | None = None
    upper: Data | None = field(default=None, kw_only=True)
    coefficient: Data = field(default=0.0, kw_only=True)
    external: Data = field(default=0.0, kw_only=True)
    g: Data = field(default=0.0, kw_only=True)

    @classmethod
    def in_words(cls, said: Mapping[str, str], exact: bool, kappa: str) -> str:
        """Say it as inequalities; nothing of it is derived."""
        left = _left_in_words(said, kappa)
        if _matters(said, "g"):
            left = _difference(left, said["g"])
        if "upper" not in said:
            return f"u ≥ {said.get('obstacle', '0')}, {left} ≥ 0, one of them an equality"
        if "obstacle" not in said:
            return f"u ≤ {said['upper']}, {left} ≤ 0, one of them an equality"
        return (
            f"{said['obstacle']} ≤ u ≤ {said['upper']}, {left} ≥ 0 on the lower bound, ≤ 0 on the"
            " upper, 0 between them"
        )

    @property
    def kind(self) -> str:
        """One word for all of them."""
        return "contact"

    @property
    def optional(self) -> bool:
        """Not if there is no α."""
        return self.upper is None

    @property
    def bounds(self) -> tuple[tuple[int, Any], ...]:
        """That is u ≥ α and −u ≥ −β."""
        below = () if self.obstacle is None else ((1, self.obstacle),)
        return below if self.upper is None else (*below, (-1, negative(self.upper)))

    @property
    def flux(self) -> Any:
        """The part of the flux free of u; None where there is neither that nor a b."""
        known = _known(self)
        return known if self.loss is not None or as_number(known) != 0.0 else None

    @property
    def loss(self) -> Any:
        """All of b; None where it is 0."""
        return None if as_number(self.coefficient) == 0.0 else self.coefficient


def _in_python(label: str, part: str, name: str) -> str:
    """Say what a datum of a condition is called by those who do not write a file."""
    usual = label.startswith("data.")
    return label.removeprefix("data.") if usual else f"conditions[{part!r}].{name}"


def _known(condition: Any) -> Any:
    """Return g + b u_ext."""
    if as_number(condition.coefficient) == 0.0:
        return condition.g
    return condition.g + condition.coefficient * condition.external


def _left_in_words(said: Mapping[str, str], kappa: str) -> str:
    """Write κ∂ₙu + b (u − u_ext)."""
    flux = f"{kappa}∂ₙu"
    if not _matters(said, "coefficient"):
        return flux
    difference = _difference("u", said.get("external", "0"))
    difference = f"({difference})" if difference != "u" else difference
    return f"{flux} + {as_factor(said['coefficient'], difference)}"


def _matters(said: Mapping[str, str], name: str) -> bool:
    """Tell whether a datum is given and not written as the number 0."""
    return said.get(name, "0") not in ("0", "0.0")


def _derived_in_words(name: str, exact: bool) -> str:
    """Say what a datum is that is not given."""
    return f"{name} from exact.u" if exact else "0"


def as_factor(text: str, of: str = "") -> str:
    """Write what can be multiplied as it is, anything else in parentheses, and nothing for 1."""
    if of and text in ("1", "1.0"):
        return of
    factor = text if re.fullmatch(r"[\w.]+", text) else f"({text})"
    return f"{factor} {of}" if of else factor


def _difference(left: str, right: str) -> str:
    """Write a difference as people do: u − cold, u + 5 for u − (−5), u for u − 0."""
    try:
        number = float(right)
    except ValueError:
        return f"{left} − {as_factor(right)}"
    if number == 0.0:
        return left
    return f"{left} + {right.lstrip('- ')}" if number < 0.0 else f"{left} − {right}"


def facets_of(where: Domain, conditions: Sequence[Condition]) -> Int32Array:
    """Find the owned facets under some conditions: local indices, ascending, shape (n,)."""
    facets = [where.facets(condition.number) for condition in conditions]
    return np.sort(np.concatenate([np.empty(0, dtype=np.int32), *facets]))
