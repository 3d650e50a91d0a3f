"""Nested iteration: a start from the coarser mesh that brings its active set along.

Prolonging u alone loses the active set. What the reduced-space method takes for active are the dofs
on their bound with a positive residual, so both are put in place: a contact facet is active exactly
if its parent was, and where the residual of the prolonged u is not near the parent's contact force,
that force is made the residual. The residual of such a facet is changed through the other facets of
its cell: in a cell the entries of a row sum to zero, so that adding δ to all of them takes a_ii δ
away. Where the prolongation is good it knows the force better than the parent, and is left alone.

Where contact begins or ends the parents know too little to tell whether a facet is active. There
the prolonged u does, by the sign of the residual with the facet on its bound.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from dolfinx import fem
from dolfinx.mesh import Mesh
from mpi4py import MPI

from .. import compat
from ..fem.space import (
    facet_corners,
    facet_entities,
    facet_measures,
    ghosted_vector,
)
from ..multigrid.parents import Layout, barycentric_coordinates
from ..multigrid.transfer import prolongate
from .assembly import Level
from .solved import Solved

ENOUGH = 0.5
"""Part of the parent's force from which on the residual is left as the prolongation has it."""

ROUNDS = 3
"""Neighbours share facets, so that corrections disturb one another a little."""


def nested_start(coarse: Solved, level: Level, start: fem.Function) -> None:
    """Fill in the start on a level.

    Args:
        coarse: The solution on the mesh below, CR or P1, ghosts up to date.
        level: The fine mesh and what is assembled on it.
        start: On entry with the Dirichlet values; on exit the start.
    """
    parents, below = level.parents, coarse.level.parents
    if parents is None:
        return
    system, operator = level.system, level.grid.operator
    before = None if coarse.before is None or below is None else (coarse.before, below)
    V = start.function_space
    x = start.x.array
    values = x[system.dirichlet].copy()
    x[:] = prolongate(coarse.u, V, parents, before)
    x[system.dirichlet] = values
    facets, dofs = system.bounded_facets, system.contact_dofs
    if dofs.shape[1] > 1:  # a P1 dof has many cells, and no one to change its residual through
        return
    order = np.argsort(dofs[:, 0])  # the order of the operator's bounded dofs
    facets, block = facets[order], V.dofmap.index_map_bs
    component = dofs[order, 0] % block
    bounded, b = operator.dofs, system.b.x.array[operator.dofs]
    lower = system.lower[bounded]
    vector, layout = ghosted_vector(V, x), Layout.of_space(V)
    active, force, at_front = _from_parents(
        coarse, level.domain.mesh, parents.cell, facets, component
    )
    on_bound = operator.times(vector) - b - operator.diagonal * (x[bounded] - lower)
    active = np.where(at_front, on_bound > 0.0, active)
    force = np.where(at_front, on_bound, force)
    scale = V.mesh.comm.allreduce(float(np.abs(x).max(initial=0.0)), op=MPI.MAX)
    above = lower + 4.0 * np.spacing(np.maximum(np.abs(lower), scale))
    x[bounded] = np.where(active, lower, np.maximum(x[bounded], above))

    others = V.dofmap.list[facet_entities(level.domain.mesh, facets)[:, 0]]
    others = block * others + component[:, None]
    free = np.ones(len(x), dtype=bool)
    free[system.dirichlet] = free[bounded] = False
    surplus = operator.times(vector) - b - force
    weak = active & (surplus < (ENOUGH - 1.0) * force)
    movable = free[others] & weak[:, None]
    number = np.maximum(movable.sum(axis=1), 1)
    moves = np.zeros(len(x))
    for _ in range(ROUNDS):
        shift = surplus / operator.diagonal * (others.shape[1] - 1) / number
        np.add.at(moves, others[movable], np.broadcast_to(shift[:, None], others.shape)[movable])
        x += layout.shared_sum(moves)
        moves[:] = 0.0
        surplus = operator.times(vector) - b - force
    vector.destroy()


def _from_parents(
    coarse: Solved,
    fine: Mesh,
    parent_cell: npt.NDArray[np.int32],
    facets: npt.NDArray[np.int32],
    component: npt.NDArray[np.int32],
) -> tuple[npt.NDArray[np.bool_], npt.NDArray[np.float64], npt.NDArray[np.bool_]]:
    """What the fine contact facets' parents say.

    Returns:
        Whether the parent is active, the facet's share of its contact force, and whether contact
        begins or ends at one of the parent's vertices.
    """
    mesh, V = coarse.domain.mesh, coarse.u.function_space
    x, measure = facet_measures(fine, facets)
    parents = parent_cell[facet_entities(fine, facets)[:, 0]]
    # The parent facet lies opposite the vertex whose barycentric coordinate vanishes on the facet
    simplices = mesh.geometry.x[compat.cell_nodes(mesh)[parents]]
    points = x.mean(axis=1, keepdims=True)
    local = np.argmin(np.abs(barycentric_coordinates(simplices, points)[:, 0]), axis=1)
    tdim = mesh.topology.dim
    mesh.topology.create_connectivity(tdim, tdim - 1)
    c2f = mesh.topology.connectivity(tdim, tdim - 1).array.reshape(-1, tdim + 1)
    _, parent_measure = facet_measures(mesh, c2f[parents, local])
    dof = V.dofmap.index_map_bs * V.dofmap.list[parents, local] + component
    force = coarse.residual.x.array[dof]
    active = (coarse.u.x.array[dof] <= coarse.level.system.lower[dof]) & (force > 0.0)
    ends = Layout.of_p1(mesh).cells[parents[:, None], facet_corners(mesh)[local]]
    at_front = _front(coarse)[ends].any(axis=1)
    return active, force * measure / parent_measure, at_front


def _front(solution: Solved) -> npt.NDArray[np.bool_]:
    """Whether contact begins or ends at a vertex, for all local ones."""
    mesh, contact = solution.domain.mesh, solution.contact
    p1 = Layout.of_p1(mesh)
    ends = p1.ends(contact.facets)
    there = np.ones(p1.size[0] + p1.index_map.num_ghosts, dtype=bool)
    for which in (contact.active, ~contact.active):
        count = np.zeros(len(there))
        np.add.at(count, ends[which], 1.0)
        there &= p1.shared_sum(count) > 0.0
    return there
