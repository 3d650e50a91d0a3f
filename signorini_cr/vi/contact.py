"""What happens on Γ1: active facets, pressure, transition points, and the KKT conditions.

All figures come from the solution: the residual r = A u_h − b gives on a contact facet F the
pressure λ_F = r_F / |F|, the piecewise constant ∂ₙu_h that the scheme knows.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from dolfinx import fem
from dolfinx.la import InsertMode
from mpi4py import MPI

from ..fem.physics import OnMesh
from ..fem.space import facet_measures
from ..fem.walk import along_boundary
from .solver import Iterations
from .stopping import NOISE
from .system import System

FloatArray = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Kkt:
    """How well u_h satisfies the discrete conditions on Γ1.

    Attributes:
        min_gap: Smallest u_h − α at a contact dof; 0 or above when feasible.
        min_pressure: Smallest λ_h at a contact dof on its bound; 0 or above, up to the solver's
            tolerance.
        complementarity: Σ |λ_h (u_h − α)| over the contact dofs, weighted by their facets' measure.
        residual: Norm of what is left of the equations, relative to the load; or to what the rows
            are made of, in the class of stiffness where that is larger (`stopping`). Rounding of
            A u_h does not count.
        force_error: What the solver left wrong with the contact forces, summed up without regard
            to sign, relative to their sum, as measured by the solver.
    """

    min_gap: float
    min_pressure: float
    complementarity: float
    residual: float
    force_error: float


@dataclass(frozen=True, eq=False)
class Contact:
    """Contact facets of this rank, and figures over all ranks.

    Attributes:
        facets: Local indices of the contact facets this rank owns, shape (n,).
        vertices: Their vertices' coordinates, shape (n, d, 3).
        measure: Their length, shape (n,).
        obstacle: Bound on the facet, the mean of α for CR, shape (n,).
        u: u_h at the facet's midpoint, shape (n,).
        pressure: λ_h, shape (n,), 0 off the bound, where r is what the solver left of an equation,
            and where r is rounding alone; for P1 the mean of the pressures at the vertices.
        active: Whether the facet is in contact, shape (n,).
        gap_at_vertices: u_h − α at the facet's vertices, shape (n, d); negative in places even for
            a feasible CR function, which respects the bound at midpoints only.
        force: Σ r over the dofs in contact, the total contact force (per unit depth).
        length: Total length of the active facets.
        number: Number of contact facets.
        number_active: Number of active ones.
        transitions: Points where contact begins or ends, shape (m, 3), on all ranks.
        kkt: The KKT figures.
    """

    comm: MPI.Comm
    facets: npt.NDArray[np.int32]
    vertices: FloatArray
    measure: FloatArray
    obstacle: FloatArray
    u: FloatArray
    pressure: FloatArray
    active: npt.NDArray[np.bool_]
    gap_at_vertices: FloatArray
    force: float
    length: float
    number: int
    number_active: int
    transitions: FloatArray
    kkt: Kkt
    _table: dict[str, npt.NDArray] | None

    @property
    def midpoints(self) -> FloatArray:
        """Midpoints of the facets, shape (n, 3)."""
        return self.vertices.mean(axis=1)

    def table(self) -> dict[str, npt.NDArray] | None:
        """All contact facets in order along the boundary, on rank 0; None on the others.

        Columns: part (connected piece of Γ1, from 0), arc_length (of the facet's midpoint, from
        the part's beginning, Ω to the left), x, y, length, obstacle, u, pressure, active.
        """
        return self._table


def contact_facts(
    data: OnMesh,
    system: System,
    u: fem.Function,
    residual: fem.Function,
    diagonal: FloatArray,
    rounding: FloatArray,
    iterations: Iterations,
) -> Contact:
    """Read the state of Γ1 off a solution.

    Args:
        data: The physics on the mesh.
        system: The variational inequality.
        u: u_h, ghosts up to date.
        residual: r = A u_h − b, ghosts up to date.
        diagonal: Diagonal of A, owned dofs.
        rounding: What rounding makes of r, owned dofs with a bound only.
        iterations: What the solver says about its errors.
    """
    V = u.function_space
    mesh, facets = data.domain.mesh, system.bounded_facets
    comm, owned = mesh.comm, len(diagonal)
    vertices, measure = facet_measures(mesh, facets)
    dofs, bounded, lower = system.contact_dofs, system.bounded, system.lower
    obstacle_at_vertices = system.obstacle_at_vertices

    work = fem.Function(V)
    np.add.at(work.x.array, dofs, (measure / dofs.shape[1])[:, None])
    work.x.scatter_reverse(InsertMode.add)
    weight = work.x.array[bounded]
    work.x.array[:] = 0.0

    def on_facets(values: FloatArray) -> FloatArray:
        """Values at bounded dofs, 0 at others, as the facets see them."""
        work.x.array[bounded] = values
        work.x.scatter_forward()
        return work.x.array[dofs]

    gap = u.x.array[bounded] - lower[bounded]
    raw = residual.x.array[bounded]
    force, stiff_gap = np.where(np.abs(raw) > rounding, raw, 0.0), diagonal[bounded] * gap
    # The primal-dual criterion: it tells gap from pressure also where both are nearly zero
    in_contact = force > stiff_gap
    state = on_facets(np.where(in_contact, 1.0, -1.0))
    # Off the bound r is what is left of an equation; on it, a pull is a pressure of wrong sign
    force = np.where(in_contact | (gap <= 0.0), force, 0.0)
    pressure = force / weight
    is_active: npt.NDArray[np.bool_] = (state.min(axis=1) >= 0.0) & (state.max(axis=1) > 0.0)
    # What is left of the equations: all of r off Γ1, min(r, a_ii gap) on it
    left = residual.x.array[:owned].copy()
    left[bounded] = np.minimum(raw, stiff_gap)
    left[np.abs(left) <= NOISE * diagonal * np.abs(u.x.array[:owned])] = 0.0

    local = data.at_vertices(u, facets)
    total = _Totals(comm)
    of_load = float(np.sqrt(total.sum(left @ left))) / (system.load or 1.0)
    kkt = Kkt(
        min_gap=total.min(gap),
        min_pressure=total.min(pressure),
        complementarity=total.sum(np.abs(force * gap)),
        residual=max(of_load, iterations.imbalance),
        force_error=iterations.force_error,
    )
    fields: dict[str, npt.NDArray] = {
        "vertices": vertices,
        "measure": measure,
        "obstacle": obstacle_at_vertices.mean(axis=1) if dofs.shape[1] > 1 else lower[dofs[:, 0]],
        "u": local.mean(axis=1),
        "pressure": on_facets(pressure).mean(axis=1),
        "active": is_active,
        "gap_at_vertices": local - obstacle_at_vertices,
    }
    table, transitions = along_boundary(mesh, facets, fields)
    return Contact(
        comm=comm,
        facets=facets,
        **fields,
        force=total.sum(force),
        length=total.sum(measure[is_active]),
        number=int(total.sum(np.ones(len(facets)))),
        number_active=int(total.sum(is_active)),
        transitions=transitions,
        kkt=kkt,
        _table=table,
    )


class _Totals:
    """Reductions over all ranks of arrays that may be empty on some."""

    def __init__(self, comm: MPI.Comm):
        self.comm = comm

    def sum(self, values: npt.ArrayLike) -> float:
        return float(self.comm.allreduce(float(np.sum(values))))

    def min(self, values: npt.NDArray) -> float:
        return float(self.comm.allreduce(float(np.min(values, initial=np.inf)), op=MPI.MIN))
