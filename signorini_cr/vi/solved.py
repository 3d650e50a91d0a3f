"""The interface of a solve to the streets above, whoever keeps its results."""

from __future__ import annotations

from typing import Protocol

from dolfinx import fem

from ..mesh.domain import Domain
from .contact import ContactFacts
from .level import Level


class Found(Protocol):
    """A discrete function and what it is to solve, which is all that a certificate asks for."""

    level: Level
    u: fem.Function

    @property
    def domain(self) -> Domain:
        """Mesh and boundary parts."""

    @property
    def element(self) -> str:
        """The element's name."""


class Solved(Found, Protocol):
    """u_h on one mesh; the attributes are those of :class:`~signorini_cr.solution.Solution`."""

    residual: fem.Function
    contact: ContactFacts
