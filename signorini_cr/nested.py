"""Nested iteration: a start from the coarser mesh that brings its active set along.

Prolonging u alone loses the active set. What the reduced-space method takes for active are the dofs
on their bound with a positive residual, so both are put in place: a contact facet is active exactly
if its parent was, and the prolonged contact force is made the residual there. The residual of such
a facet is changed through the other facets of its cell: in a cell the entries of a row sum to zero,
so that adding δ to all of them takes a_ii δ away.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from dolfinx import fem
from mpi4py import MPI

from . import compat
from .assembly import System
from .domain import CONTACT, Domain
from .masking import MaskedMatrix
from .parents import Layout, barycentric_coordinates
from .space import closure_dofs, facet_entities, facet_measures, ghosted_vector
from .transfer import prolongate, shared_sum


@dataclass(frozen=True)
class Coarse:
    """What nested iteration takes from the coarser mesh.

    Attributes:
        domain: The mesh and its boundary parts.
        u: The solution there, CR or P1, ghosts up to date.
        residual: A u − b there, ghosts up to date.
        lower: Bounds, `PETSc.NINFINITY` where there are none, ghosts included.
        below: u on the mesh below this one and the parents there of this mesh's cells, if any.
    """

    domain: Domain
    u: fem.Function
    residual: fem.Function
    lower: npt.NDArray[np.float64]
    below: tuple[fem.Function, npt.NDArray[np.int32]] | None = None


ROUNDS = 3
"""Neighbours share facets, so that corrections disturb one another a little."""


def nested_start(
    coarse: Coarse,
    fine: Domain,
    parent_cell: npt.NDArray[np.int32],
    start: fem.Function,
    operator: MaskedMatrix,
    system: System,
) -> None:
    """Fill in the start on the fine mesh.

    Args:
        coarse: What is known on the coarse mesh.
        fine: The fine mesh and its boundary parts.
        parent_cell: For each local fine cell the local coarse cell that holds it.
        start: On entry with the Dirichlet values; on exit the start.
        operator: The fine matrix and its rows at the contact dofs.
        system: What it belongs to.
    """
    V = start.function_space
    x = start.x.array
    values = x[system.dirichlet].copy()
    x[:] = prolongate(coarse.u, V, parent_cell, coarse.below)
    x[system.dirichlet] = values
    facets = fine.facets(CONTACT)
    dofs = closure_dofs(V, facets)
    if dofs.shape[1] > 1:  # a P1 dof has many cells, and no one to change its residual through
        return
    order = np.argsort(dofs[:, 0])  # that of the operator's bounded dofs
    facets = facets[order]
    active, force = _from_parents(coarse, fine, parent_cell, facets)
    comm = V.mesh.comm
    scale = comm.allreduce(float(np.abs(x).max(initial=0.0)), op=MPI.MAX)
    bounded = operator.dofs
    lower = system.lower[bounded]
    above = lower + 4.0 * np.spacing(np.maximum(np.abs(lower), scale))
    x[bounded] = np.where(active, lower, np.maximum(x[bounded], above))

    cells, _ = facet_entities(fine.mesh, facets).T
    others = V.dofmap.list[cells]
    free = np.ones(len(x), dtype=bool)
    free[system.dirichlet] = free[bounded] = False
    movable = free[others] & active[:, None]
    number = np.maximum(movable.sum(axis=1), 1)
    vector, layout = ghosted_vector(V, x), Layout.of_space(V)
    for _ in range(ROUNDS):
        surplus = operator.times(vector) - system.b.x.array[bounded] - force
        shift = surplus / operator.diagonal * (others.shape[1] - 1) / number
        moves = np.zeros(len(x))
        np.add.at(moves, others[movable], np.broadcast_to(shift[:, None], others.shape)[movable])
        x += shared_sum(layout, moves)
    vector.destroy()


def _from_parents(
    coarse: Coarse,
    fine: Domain,
    parent_cell: npt.NDArray[np.int32],
    facets: npt.NDArray[np.int32],
) -> tuple[npt.NDArray[np.bool_], npt.NDArray[np.float64]]:
    """Whether each fine contact facet's parent is active, and its share of the contact force."""
    mesh, V = coarse.domain.mesh, coarse.u.function_space
    x, measure = facet_measures(fine.mesh, facets)
    parents = parent_cell[facet_entities(fine.mesh, facets)[:, 0]]
    # The parent facet lies opposite the vertex whose barycentric coordinate vanishes on the facet
    simplices = mesh.geometry.x[compat.cell_nodes(mesh)[parents]]
    points = x.mean(axis=1, keepdims=True)
    local = np.argmin(np.abs(barycentric_coordinates(simplices, points)[:, 0]), axis=1)
    tdim = mesh.topology.dim
    mesh.topology.create_connectivity(tdim, tdim - 1)
    c2f = mesh.topology.connectivity(tdim, tdim - 1).array.reshape(-1, tdim + 1)
    _, parent_measure = facet_measures(mesh, c2f[parents, local])
    dof = V.dofmap.list[parents, local]
    force = coarse.residual.x.array[dof]
    active = (coarse.u.x.array[dof] <= coarse.lower[dof]) & (force > 0.0)
    return active, force * measure / parent_measure
