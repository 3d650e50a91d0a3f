"""Facts about Γ1: active facets, pressure, transition points, and the KKT conditions.

All figures come from the solution: the residual r = A u_h − b gives on a contact facet F the
pressure λ_F = r_F / |F|, the piecewise constant ∂ₙu_h that the scheme knows.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from dolfinx import fem
from mpi4py import MPI
from petsc4py import PETSc

from ..arrays import BoolArray, FloatArray, Int32Array, summed
from ..fem.layout import Layout
from ..fem.physics import OnMesh
from ..fem.space import ghosted_vector
from ..garbage import release
from ..rounding import counted, digits_of
from .active import ActiveSet
from .solver import Iterations
from .stopping import NOISE
from .system import System


@dataclass(frozen=True)
class Kkt:
    """Measures of how well u_h satisfies the discrete conditions on Γ1.

    Attributes:
        min_gap: Smallest u_h − α, or β − u_h, at a contact dof; 0 or above when feasible.
        min_pressure: Smallest λ_h at a contact dof on α, or −λ_h on β; 0 or above, up to the
            solver's tolerance.
        complementarity: Σ |λ_h| times the distance from the nearer bound, over
            the contact dofs, weighted by their facets' measure.
        residual: Norm of what is left of the equations, relative to `System.residual_scale`; or to
            what the rows are made of, in the class of stiffness where that is larger (`stopping`).
            Rounding of A u_h does not count.
        force_error: What the solver left wrong with the contact forces, summed up without regard
            to sign, relative to their sum, as measured by the solver; infinite where a tolerance
            looser than ours left it no step to measure that by.
    """

    min_gap: float
    min_pressure: float
    complementarity: float
    residual: float
    force_error: float


@dataclass(frozen=True, eq=False)
class ContactFacts:
    """Contact facets of this rank, and figures over all ranks.

    Attributes:
        facets: Local indices of the contact facets this rank owns, shape (n,).
        vertices: Their vertices' coordinates, shape (n, d, 3).
        measure: Their length, shape (n,).
        names: Names of their parts of the boundary, shape (n,).
        obstacle: Lower bound on the facet, the mean of α for CR; −∞ for none, shape (n,).
        upper: Upper bound on the facet, the mean of β for CR; ∞ for none, shape (n,).
        u: u_h at the facet's midpoint, shape (n,).
        pressure: λ_h, shape (n,), below 0 where u_h is on β, 0 off the bounds, where r is
            what the solver left of an equation, and where r is rounding alone; for P1 the mean of
            the pressures at the vertices.
        active: Whether the facet is in contact, shape (n,).
        gap_at_vertices: The smaller of u_h − α and β − u_h at the facet's vertices, shape (n, d);
            negative in places even for a feasible CR function, which respects the bounds at
            midpoints only.
        active_set: The dofs in contact.
        force: Σ r over the dofs in contact, the total contact force (per unit depth); what β
            contributes is negative.
        length: Total length of the active facets.
        number: Number of contact facets.
        number_active: Number of active ones.
        transitions: Points where contact begins or ends, shape (m, 3), on all ranks.
        kkt: The KKT figures.
    """

    comm: MPI.Comm
    facets: Int32Array
    vertices: FloatArray
    measure: FloatArray
    names: npt.NDArray[Any]
    obstacle: FloatArray
    upper: FloatArray
    u: FloatArray
    pressure: FloatArray
    active: BoolArray
    gap_at_vertices: FloatArray
    active_set: ActiveSet
    force: float
    length: float
    number: int
    number_active: int
    transitions: FloatArray
    kkt: Kkt
    _table: dict[str, npt.NDArray] | None

    def __repr__(self) -> str:
        """Describe the contact in a line."""
        facet = self.length / max(self.number_active, 1)  # the length is known to within one
        return (
            f"<ContactFacts: {self.number_active} of {counted(self.number, 'facet')}, "
            f"length {digits_of(self.length, facet)}, force {digits_of(self.force, None, 4)}>"
        )

    @property
    def bounds(self) -> dict[str, FloatArray]:
        """α as `obstacle`, and β as `upper` where any facet has one, NaN for none; collective."""
        found = {"obstacle": self.obstacle}
        if self.comm.allreduce(bool(np.isfinite(self.upper).any()), op=MPI.LOR):
            found["upper"] = self.upper
        return {name: np.where(np.isfinite(row), row, np.nan) for name, row in found.items()}

    @property
    def midpoints(self) -> FloatArray:
        """Midpoints of the facets, shape (n, 3)."""
        return self.vertices.mean(axis=1)

    def table(self) -> dict[str, npt.NDArray] | None:
        """Return all contact facets in order along the boundary, on rank 0; None on the others.

        Columns: part (connected piece of Γ1, from 0), arc_length (of the facet's midpoint, from
        the part's beginning, Ω to the left), x, y, length, obstacle, upper (where any facet has
        an upper bound), u, pressure, active, name (of the part of the boundary, where there are
        several).
        """
        return self._table


def contact_facts(
    data: OnMesh, system: System, u: fem.Function, residual: fem.Function, iterations: Iterations
) -> ContactFacts:
    """Read the state of Γ1 off a solution; collective.

    Args:
        data: The physics on the mesh.
        system: The variational inequality.
        u: u_h less the system's offset, ghosts up to date.
        residual: r = A u_h − b, ghosts up to date.
        iterations: What the solver says about its errors.
    """
    there = system.contact_facets
    at_dofs = _AtDofs.of(system, u, residual, 0.0 if iterations.extended else NOISE)
    pressure = at_dofs.force / there.share
    fields = _at_facets(data, system, u, at_dofs, pressure)
    measure, is_active = there.measure, fields["active"]
    table, transitions = there.walk.along(fields)
    sums = [
        np.sum(at_dofs.force),
        np.sum(measure[is_active]),
        len(measure),
        np.sum(is_active),
        np.sum(np.abs(at_dofs.force * at_dofs.gap)),
        at_dofs.left @ at_dofs.left,
    ]
    ends = at_dofs.gap, at_dofs.sign * pressure
    least = np.array([np.min(each, initial=np.inf) for each in ends])
    comm = data.domain.mesh.comm
    force, length, number, number_active, complementarity, squares = summed(comm, np.array(sums))
    comm.Allreduce(MPI.IN_PLACE, least, op=MPI.MIN)
    min_gap, min_pressure = least
    of_load = float(np.sqrt(squares)) / (system.residual_scale or 1.0)
    return ContactFacts(
        comm=comm,
        facets=system.bounded_facets,
        vertices=there.vertices,
        measure=measure,
        **fields,
        active_set=at_dofs.active,
        force=float(force),
        length=float(length),
        number=int(number),
        number_active=int(number_active),
        transitions=transitions,
        kkt=Kkt(
            min_gap=float(min_gap),
            min_pressure=float(min_pressure) + 0.0,  # no -0
            complementarity=float(complementarity),
            residual=float(max(of_load, iterations.imbalance)),
            force_error=iterations.force_error,
        ),
        _table=table,
    )


def _at_facets(
    data: OnMesh, system: System, u: fem.Function, at_dofs: _AtDofs, pressure: FloatArray
) -> dict[str, npt.NDArray]:
    """Compute what `ContactFacts` has of each facet, by name; collective.

    Args:
        data: The physics on the mesh.
        system: The variational inequality.
        u: u_h less the system's offset, ghosts up to date.
        at_dofs: What it does at the dofs.
        pressure: At the bounded dofs, shape (n,).
    """
    facets, dofs, offset = system.bounded_facets, system.contact_dofs, system.offset
    layout = Layout.of_space(u.function_space)

    def seen(values: FloatArray) -> FloatArray:
        """Return values at bounded dofs, 0 at others, as the facets see them."""
        everywhere = np.zeros(len(u.x.array))
        everywhere[system.bounded] = values
        return layout.shared_sum(everywhere)[dofs]

    state = seen(np.where(at_dofs.active.mask, 1.0, -1.0))
    below, above = system.obstacles_at_vertices
    local = data.at_vertices(u, facets)
    of_ends = not layout.cr
    return {
        "names": data.domain.names_of(facets),
        "obstacle": below.mean(axis=1) if of_ends else _bound(system.lower[dofs[:, 0]]) + offset,
        "upper": above.mean(axis=1) if of_ends else _bound(system.upper[dofs[:, 0]]) + offset,
        "u": local.mean(axis=1) + offset,
        "pressure": seen(pressure).mean(axis=1),
        "active": (state.min(axis=1) >= 0.0) & (state.max(axis=1) > 0.0),
        "gap_at_vertices": np.minimum(local - (below - offset), above - offset - local),
    }


@dataclass(frozen=True, eq=False)
class _AtDofs:
    """Gaps, forces and residuals of a solution at the dofs.

    Attributes:
        gap: Distance of the bounded dofs from the nearer bound, shape (n,).
        sign: Which that is, see `Bounds`, shape (n,).
        force: Contact forces there, 0 where they are rounding alone, shape (n,).
        active: The active set.
        left: What is left of the equations at owned dofs: all of r off Γ1, on it the smaller of
            the force off the bound and a_ii gap, and 0 where that is rounding alone.
    """

    gap: FloatArray
    sign: FloatArray
    force: FloatArray
    active: ActiveSet
    left: FloatArray

    @classmethod
    def of(
        cls, system: System, u: fem.Function, residual: fem.Function, rounding: float
    ) -> _AtDofs:
        """Compare what is there with what rounding makes of it, in parts; collective."""
        bounded = system.bounded
        vector = ghosted_vector(u.function_space, u.x.array)
        terms = system.operator.magnitude(vector) + np.abs(system.b[bounded])
        release(vector)
        diagonal = system.operator.whole_diagonal
        x, raw = u.x.array[bounded], residual.x.array[bounded]
        gap, sign = system.bounds.gap(x), system.bounds.sign(x)
        force = np.where(np.abs(raw) > rounding * terms, raw, 0.0)
        left = residual.x.array[: len(diagonal)].copy()
        left[bounded] = np.minimum(sign * raw, diagonal[bounded] * gap)
        left[np.abs(left) <= NOISE * diagonal * np.abs(u.x.array[: len(diagonal)])] = 0.0
        active = ActiveSet.of(bounded, gap, sign * force)
        # Off the bound r is what is left of an equation; on it, a pull is a pressure of wrong sign
        return cls(gap, sign, np.where(gap <= 0.0, force, 0.0), active, left)


def _bound(values: FloatArray) -> FloatArray:
    """Return bounds as they are told: infinite where PETSc's number says that there is none."""
    return np.where(np.abs(values) < PETSc.INFINITY, values, np.copysign(np.inf, values))
