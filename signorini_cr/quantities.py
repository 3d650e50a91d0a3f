"""What is wanted of a solution in an interval."""

from __future__ import annotations

from typing import NamedTuple

from .estimate.force import Interval
from .fem.conditions import Data
from .solution import Solution


class Quantity(NamedTuple):
    """A number that u has.

    Attributes:
        kind: "force" or "flux" for what flows through a part, "mean" or "integral" for that of u.
        place: A part of the boundary or a material; None or "domain" for all of the domain.
        weight: What is integrated with it, and in means divided by; None for 1.
    """

    kind: str
    place: str | None = None
    weight: Data | None = None

    def of(self, solution: Solution) -> Interval:
        """Bound it; collective.

        Raises:
            InputError: There is no bound; the message says why.
        """
        if self.kind in ("force", "flux"):
            return solution.flux(str(self.place), weight=self.weight)
        ask = solution.mean if self.kind == "mean" else solution.integral
        return ask(self.place, self.weight)
