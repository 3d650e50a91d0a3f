"""The result of a solve."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from dolfinx import fem
from mpi4py import MPI

from . import force, means
from .estimate.certificate import Certificate
from .estimate.force import Interval
from .fem import fields
from .fem.cells import on_cells
from .fem.conditions import Data
from .fem.problem import Problem
from .mesh.domain import Domain
from .rounding import at_most, counted, digits_of
from .shown import HTML
from .vi.contact import ContactFacts
from .vi.level import Level
from .vi.solver import Iterations


@dataclass(eq=False)
class Solution:
    """u_h on one mesh, and what is known about it.

    Attributes:
        level: Mesh, space and assembled system.
        u: u_h.
        residual: r = A u_h − b; on Γ1 the contact forces, elsewhere what the solver left.
        contact: The state of Γ1.
        energy: J(u_h) = ½ a_h(u_h, u_h) − χ(u_h).
        iterations: Newton steps and linear iterations.
        seconds: Wall time of the phases mesh, assemble, solve, estimate; whoever does a part of the
            work books it here, errors and certificate when they are made.
    """

    level: Level
    u: fem.Function
    residual: fem.Function
    contact: ContactFacts
    energy: float
    iterations: Iterations
    seconds: dict[str, float] = field(default_factory=dict)

    def __repr__(self) -> str:
        """Describe it in a line; the certificate only if it is made, as making it is collective."""
        contact, certificate = self.contact, self.certificate_if_made
        force = digits_of(contact.force, None, 4)
        line = (
            f"<Solution: {self.element}, {self.dofs} dofs, {contact.number_active} of "
            f"{counted(contact.number, 'facet')} in contact, force {force}"
        )
        bound = None if certificate is None else certificate.bound_h1
        return line + (">" if bound is None else f", error at most {at_most(bound)}>")

    def _repr_html_(self) -> str:
        """Write a table and a picture, for notebooks; of the certificate what has been made."""
        return HTML["Solution"](self)

    @property
    def domain(self) -> Domain:
        """Mesh and boundary parts."""
        return self.level.domain

    @property
    def problem(self) -> Problem:
        """The data."""
        return self.level.physics.problem

    @property
    def element(self) -> str:
        """The element's name: "CR" or "P1"."""
        return self.level.physics.element

    @property
    def cells(self) -> int:
        """Number of cells, over all ranks."""
        topology = self.domain.mesh.topology
        return topology.index_map(topology.dim).size_global

    @property
    def dofs(self) -> int:
        """Number of degrees of freedom, over all ranks."""
        dofmap = self.u.function_space.dofmap
        return dofmap.index_map.size_global * dofmap.index_map_bs

    @cached_property
    def h(self) -> float:
        """Largest cell diameter, over all ranks; found when first asked for, collectively."""
        largest = float(self.level.meshes[-1].diameters.max(initial=0.0))
        return float(self.domain.mesh.comm.allreduce(largest, op=MPI.MAX))

    @cached_property
    def errors(self) -> tuple[float, float] | None:
        """‖u − u_h‖_h (1.6) and ‖u − u_h‖ in L2; None where u is not known.

        Computed when first asked for, collectively.
        """
        physics = self.level.physics
        if physics.exact is None:
            return None
        with self.level.as_made(), self._estimating():
            return physics.errors(self.domain, self.u)

    @cached_property
    def certificate(self) -> Certificate:
        """The certificate of u_h's error; made when first asked for, collectively."""
        try:
            with self._estimating():
                certificate: Certificate = self.level.physics.certify(self)
                return certificate
        finally:
            self.level.meshes[-1].tidy()

    @property
    def certificate_if_made(self) -> Certificate | None:
        """The certificate if somebody has asked for it; not collective."""
        return vars(self).get("certificate")

    def force_bounds(self) -> tuple[float, float]:
        """Bound the contact force of u itself by two numbers; collective.

        See :func:`signorini_cr.force.force_bounds`.
        """
        with self._quantity():
            return force.force_bounds(self)

    def flux(self, *parts: str | int, weight: Data | None = None) -> Interval:
        """Bound what flows into Ω through Dirichlet or contact parts, as an interval; collective.

        See :func:`signorini_cr.force.flux`.
        """
        with self._quantity():
            return force.flux(self, *parts, weight=weight)

    def mean(self, where: str | int | None = None, weight: Data | None = None) -> Interval:
        """Bound the mean of u over a part, a material or all of Ω, as an interval; collective.

        See :func:`signorini_cr.means.mean`.
        """
        with self._quantity():
            return means.mean(self, where, weight)

    def integral(self, where: str | int | None = None, weight: Data | None = None) -> Interval:
        """Bound ∫ ψ u over a part, a material or all of Ω, as an interval; collective.

        See :func:`signorini_cr.means.integral`.
        """
        with self._quantity():
            return means.integral(self, where, weight)

    @contextmanager
    def _quantity(self) -> Iterator[None]:
        """Have the certificate that a quantity needs, and make room after it."""
        _ = self.certificate
        try:
            with self._estimating():
                yield
        finally:
            self.level.meshes[-1].tidy()

    @contextmanager
    def _estimating(self) -> Iterator[None]:
        """Book the time a block takes."""
        began = time.perf_counter()
        yield
        self.seconds["estimate"] = self.seconds.get("estimate", 0.0) + time.perf_counter() - began

    def u_dg(self) -> fem.Function:
        """Make u_h a discontinuous P1 function, which DOLFINx's writers draw right; collective."""
        return fields.discontinuous(self.u)

    def functions(self) -> dict[str, fem.Function]:
        """Return all there is to draw, in spaces that DOLFINx's writers draw right; collective.

        The certificate is made if it has not been asked for before.

        Returns:
            By name: `u`, from `u_dg`; `indicator`, constant on each cell, the square root of its
            share in `Certificate.indicators`; `companion`, continuous and of degree 1 to 3, from
            `Certificate.companion`; on a mesh of Γ1's facets, and constant on each, `pressure`
            λ_h, `contact`, 1 where there is contact and 0 elsewhere, and `obstacle` and
            `upper`, the bounds of u_h there, NaN for none. What a certificate without a bound
            lacks is left out.
        """
        mesh, contact, certificate = self.domain.mesh, self.contact, self.certificate
        found = {"u": self.u_dg()}
        if certificate.indicators is not None:
            shares = np.sqrt(certificate.indicators)
            found["indicator"] = on_cells(mesh, shares, "indicator")
        if certificate.companion is not None:
            found["companion"] = certificate.companion
            found["companion"].name = "companion"
        columns = {
            "pressure": contact.pressure,
            "contact": contact.active,
            **contact.bounds,
        }
        return found | fields.on_facets(mesh, contact.facets, columns)
