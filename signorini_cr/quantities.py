"""Quantities of a solution that are wanted in an interval, and their kinds."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

from .errors import InputError
from .estimate.force import Interval
from .fem.conditions import Condition, Contact, Data, Dirichlet, Neumann, Robin
from .hints import meant
from .solution import Solution


class Kind(NamedTuple):
    """A kind of quantities.

    Attributes:
        bound: Puts one between two numbers, given a solution, the place and a weight; collective.
        parts: The conditions on parts of the boundary that it may be of.
        of_u: Whether it may be of materials, and of all of the domain, as well.
        unit: What it is measured in: "u", "force", or "" where that isn't told.
        weighted_unit: The same where it has a weight.
    """

    bound: Callable[[Solution, str | None, Data | None], Interval]
    parts: tuple[type[Condition], ...]
    of_u: bool
    unit: str
    weighted_unit: str


def _flux(solution: Solution, place: str | None, weight: Data | None) -> Interval:
    return solution.flux(str(place), weight=weight)


KINDS = {
    "force": Kind(_flux, (Contact,), False, "force", ""),
    "flux": Kind(_flux, (Dirichlet,), False, "force", ""),
    "mean": Kind(Solution.mean, (Contact, Neumann, Robin), True, "u", "u"),
    "integral": Kind(Solution.integral, (Contact, Neumann, Robin), True, "", ""),
}
"""All there are, by the key that asks for one."""


class Quantity(NamedTuple):
    """A number that u has.

    Attributes:
        kind: One of `KINDS`: "force" or "flux" for what flows through a part, "mean" or "integral"
            for that of u.
        place: A part of the boundary or a material; None or "domain" for all of the domain.
        weight: What is integrated with it, and in means divided by; None for 1.
    """

    kind: str
    place: str | None = None
    weight: Data | None = None

    def of(self, solution: Solution) -> Interval:
        """Bound it; collective.

        Raises:
            InputError: There is no such kind, or no bound; the message says why.
        """
        if self.kind not in KINDS:
            told = meant(self.kind, KINDS)
            raise InputError(f"no kind of quantity is called {self.kind!r}; {told}")
        return KINDS[self.kind].bound(solution, self.place, self.weight)
