"""Boundary conditions: what holds on a part of the boundary, and what that adds to the problem.

A kind of condition is a class that overrides what it adds. Whoever assembles, solves or certifies
asks each condition for that, and none for its kind; so one more kind is one more class in `KINDS`,
and one more name in `PARTS` where it lies on a part of its own.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt
from ufl.core.expr import Expr

from ..mesh.domain import PARTS, Domain


@dataclass(frozen=True)
class Given:
    """What conditions are made from.

    Attributes:
        problem: The user's data, a `Problem`.
        expression: Turns data into an expression in the coordinates.
        exact: The exact solution u, if it is known.
        flux: κ∂ₙu, if u is known and not constant.
    """

    problem: Any
    expression: Callable[[Any], Expr]
    exact: Expr | None = None
    flux: Expr | None = None

    def or_derived(self, key: str, derived: Expr | None) -> tuple[Expr, str]:
        """Take the user's data, else what follows from u, else 0; and tell where it is from."""
        given = getattr(self.problem, key)
        if given is None and derived is not None:
            return derived, "exact.u"
        return self.expression(0.0 if given is None else given), f"data.{key}"


@dataclass(frozen=True, eq=False)
class Condition:
    """What holds on one part of the boundary; each kind adds what it overrides.

    Attributes:
        value: Its data, a scalar.
        source: What the data are from, for messages: a key of a problem file.
        part: The part's name, a key of `PARTS`.
        key: The data's name in `Problem`.
        uncertified: Why no certificate covers it; None where one does.
    """

    value: Expr
    source: str = ""
    part: ClassVar[str]
    key: ClassVar[str]
    uncertified: ClassVar[str | None] = None

    @classmethod
    def of(cls, given: Given) -> Condition | None:
        """Make it from what the user gives, and what follows from an exact solution.

        Returns:
            None where the user asks for no condition of this kind.
        """
        raise NotImplementedError

    @property
    def number(self) -> int:
        """The part's value in the facet tags."""
        return PARTS[self.part]

    @property
    def data(self) -> dict[str, Expr]:
        """All its data, by their names in `Problem`."""
        return {self.key: self.value}

    @property
    def fixed(self) -> Expr | None:
        """What u is set to."""
        return None

    @property
    def lower(self) -> Expr | None:
        """What u must not be below."""
        return None

    @property
    def flux(self) -> Expr | None:
        """What is known of κ∂ₙu: χ(v) gains its integral times v."""
        return None

    def a(self, u: Any, v: Any) -> Expr | None:
        """Return the integrand that a_h gains on the part; it must not involve derivatives."""
        return None


class Neumann(Condition):
    """κ∂ₙu = g."""

    part, key = "neumann", "g"

    @classmethod
    def of(cls, given: Given) -> Neumann:
        """Take g, or the exact solution's flux."""
        return cls(*given.or_derived(cls.key, given.flux))

    @property
    def flux(self) -> Expr:
        """All of g."""
        return self.value


class Dirichlet(Condition):
    """u = u_D."""

    part, key = "dirichlet", "dirichlet"

    @classmethod
    def of(cls, given: Given) -> Dirichlet:
        """Take u_D, or the exact solution."""
        return cls(*given.or_derived(cls.key, given.exact))

    @property
    def fixed(self) -> Expr:
        """All of u_D."""
        return self.value


class Contact(Condition):
    """u ≥ α, κ∂ₙu ≥ 0, and one of them with equality."""

    part, key = "contact", "obstacle"

    @classmethod
    def of(cls, given: Given) -> Contact:
        """Take α."""
        return cls(given.expression(given.problem.obstacle), "data.obstacle")

    @property
    def lower(self) -> Expr:
        """All of α."""
        return self.value


def facets_of(domain: Domain, conditions: Sequence[Condition]) -> npt.NDArray[np.int32]:
    """Local indices of the owned facets under some conditions, ascending, shape (n,)."""
    facets = [domain.facets(condition.number) for condition in conditions]
    return np.sort(np.concatenate([np.empty(0, dtype=np.int32), *facets]))


KINDS: tuple[type[Condition], ...] = (Dirichlet, Neumann, Contact)
"""The kinds there are; a problem has at most one condition of each."""
