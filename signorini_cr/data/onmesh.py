"""The problem on one mesh: its data, each sampled once, for the system and for the certificate."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property

import numpy as np
import numpy.typing as npt

from ..fem.cells import Cells
from ..fem.conditions import Condition
from ..fem.space import function_space
from ..mesh.domain import Domain
from .loads import Edge, Load, chi
from .moments import Compiled, OnFacets

FloatArray = npt.NDArray[np.float64]


class OnMesh:
    """A problem's data on one mesh, each sampled when first asked for, and kept.

    Attributes:
        compiled: The data, whatever the mesh.
        forms: Their forms.
        domain: Mesh and boundary parts.
        V: The discrete space.
    """

    def __init__(self, compiled: Compiled, domain: Domain):
        """Make the space; collective."""
        self.compiled, self.forms, self.domain = compiled, compiled.forms, domain
        self.forms.insist_on_mesh(domain.mesh)
        self.V = function_space(domain.mesh, self.forms.element)

    @cached_property
    def cells(self) -> Cells:
        """The mesh as arrays, for the Crouzeix-Raviart element."""
        return Cells(self.domain, self.V, [condition.number for condition in self.forms.fixed])

    @cached_property
    def load(self) -> Load:
        """Moments of f."""
        return Load.of(self.compiled.f, self.cells)

    @cached_property
    def edges(self) -> tuple[Edge, ...]:
        """Moments of the fluxes that are known, one for each condition."""
        sampled = self._sampled(self.forms.natural, lambda condition: condition.flux)
        return tuple(Edge(on_facets, self.cells) for on_facets in sampled)

    @cached_property
    def fixed(self) -> tuple[OnFacets, ...]:
        """What u is set to on Γ0, one for each condition."""
        return self._sampled(self.forms.fixed, lambda condition: condition.fixed)

    @cached_property
    def bounded(self) -> tuple[OnFacets, ...]:
        """What u must not be below on Γ1, one for each condition."""
        return self._sampled(self.forms.bounded, lambda condition: condition.lower)

    def chi(self) -> FloatArray:
        """χ (1.10) by facet dof for the Crouzeix-Raviart element, this rank's cells' share."""
        return chi(self.load, self.edges, self.cells)

    def tidy(self) -> None:
        """Drop what only solution and certificate needed; it is made again if asked for."""
        for name in ("cells", "load", "edges"):
            self.__dict__.pop(name, None)

    def _sampled(
        self, conditions: tuple[Condition, ...], datum: Callable[[Condition], object]
    ) -> tuple[OnFacets, ...]:
        return tuple(
            OnFacets.of(condition, self.compiled.trace(datum(condition)), self.domain)
            for condition in conditions
        )
