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

from dataclasses import dataclass

import numpy as np
from dolfinx import fem
from mpi4py import MPI
from petsc4py import PETSc

from .. import compat
from ..arrays import BoolArray, FloatArray, Int32Array
from ..fem.cells import barycentric_coordinates
from ..fem.layout import Layout
from ..fem.space import facet_corners, ghosted_vector, simplex_measures
from ..garbage import release
from ..mesh.domain import facet_entities
from ..multigrid.transfer import Ancestor, prolongate
from .active import ActiveSet
from .level import Level
from .solved import Solved
from .system import System

TRUSTED = 0.5
"""Part of the parent's force from which on the residual is left as the prolongation has it."""

SWEEPS = 3
"""Neighbours share facets, so that corrections disturb one another a little."""


def nested_start(
    coarse: Solved, level: Level, start: fem.Function, before: fem.Function | None = None
) -> None:
    """Fill in the start on a level; collective.

    Args:
        coarse: The solution on the mesh below, CR or P1, ghosts up to date.
        level: The fine mesh and what is assembled on it.
        start: On entry with the Dirichlet values; on exit the start.
        before: The solution that the coarse one was started from, if it was.
    """
    if level.parents is None:
        return
    system, below = level.system, coarse.level.parents
    ancestor = None if before is None or below is None else Ancestor(before, below)
    values = start.x.array[system.dirichlet].copy()
    start.x.array[:] = prolongate(coarse.u, level.V, level.parents, ancestor)
    if system.offset:
        start.x.array[:] -= system.offset
    start.x.array[system.dirichlet] = values
    if coarse.element == "P1":  # a dof has many cells, and no one to change its residual through
        return
    vector = ghosted_vector(level.V, start.x.array)
    facets = system.bounded_facets[system.facets_by_dof()]
    expected = _Expected.of(_Inherited.of(coarse, level), system, vector)
    _put_on_bounds(start, system, expected)
    _make_forces(start, vector, system, facets, expected)
    release(vector)


def known_start(u: fem.Function, level: Level, start: fem.Function) -> None:
    """Start from what was found on the same mesh before; collective.

    Args:
        u: What was found, with its contact dofs on their bounds but for rounding.
        level: The mesh and what is assembled on it.
        start: On entry with the Dirichlet values; on exit the start.
    """
    system = level.system
    values = start.x.array[system.dirichlet].copy()
    start.x.array[:] = u.x.array - system.offset
    start.x.array[system.dirichlet] = values
    bounded, bounds = system.bounded, system.bounds
    x = start.x.array[bounded]
    sign = bounds.sign(x)
    bound = bounds.on(sign)
    near = sign * (x - bound) < _margin(_largest(start), bound)
    start.x.array[bounded] = np.where(near, bound, x)


@dataclass(frozen=True, eq=False)
class _Expected:
    """State that is expected of the bounded dofs.

    Attributes:
        active: The active set to begin with.
        sign: The sign of the bound that a dof is on or nearer to, shape (n,).
        force: Forces wanted on active dofs, off the bound; 0 on others, shape (n,).
    """

    active: ActiveSet
    sign: FloatArray
    force: FloatArray

    @classmethod
    def of(cls, inherited: _Inherited, system: System, vector: PETSc.Vec) -> _Expected:
        """Put together what parents and the prolonged u say."""
        operator, bounded, bounds = system.operator, system.bounded, system.bounds
        x = vector.array_r[bounded]
        of_parent = inherited.active & ~inherited.at_front
        sign = np.where(of_parent, np.sign(inherited.force), bounds.sign(x))
        gap = x - bounds.on(sign)
        on_bound = operator.times(vector) - system.b[bounded] - operator.diagonal * gap
        force = sign * np.where(inherited.at_front, on_bound, inherited.force)
        # with its parent off the bound a facet has no force, as the criterion sees it
        pushing = np.where(inherited.at_front | inherited.active, force, 0.0)
        active = ActiveSet.of(bounded, 0.0, pushing)
        return cls(active, sign, np.where(active.mask, force, 0.0))


def _put_on_bounds(start: fem.Function, system: System, expected: _Expected) -> None:
    """Put active dofs on their bounds and the others off them, if only by rounding; collective."""
    x, bounds = start.x.array[system.bounded], system.bounds
    scale = _largest(start)
    low, high = (
        bound - sign * _margin(scale, bound)
        for sign, bound in ((-1.0, bounds.lower), (1.0, bounds.upper))
    )
    free = np.where(low < high, np.clip(x, low, high), 0.5 * (bounds.lower + bounds.upper))
    start.x.array[system.bounded] = np.where(expected.active.mask, bounds.on(expected.sign), free)


def _largest(start: fem.Function) -> float:
    """Find the largest absolute value of a function; collective."""
    values = start.x.array
    largest = max(float(values.max(initial=0.0)), -float(values.min(initial=0.0)))
    return start.function_space.mesh.comm.allreduce(largest, op=MPI.MAX)


def _margin(scale: float, bound: FloatArray) -> FloatArray:
    """Compute a distance from bounds that rounding cannot hide where values are so large."""
    finite = np.where(np.isfinite(bound), np.abs(bound), 0.0)
    return 4.0 * np.spacing(np.maximum(finite, scale))


def _make_forces(
    start: fem.Function,
    vector: PETSc.Vec,
    system: System,
    facets: Int32Array,
    expected: _Expected,
) -> None:
    """Make forces the residual of active facets where it is far from them; collective.

    Args:
        start: The start.
        vector: The same numbers as PETSc has them.
        system: The variational inequality.
        facets: The contact facets, as the bounded dofs are.
        expected: The forces wanted.
    """
    V, operator, b = start.function_space, system.operator, system.b[system.bounded]
    block = V.dofmap.index_map_bs
    others = block * V.dofmap.list[facet_entities(V.mesh, facets)[:, 0]]
    others += (system.bounded % block)[:, None]
    free = np.ones(len(start.x.array), dtype=bool)
    free[system.dirichlet] = free[system.bounded] = False
    sign, force = expected.sign, expected.force
    surplus = sign * (operator.times(vector) - b) - force
    weak = (force > 0.0) & (surplus < (TRUSTED - 1.0) * force)
    movable = free[others] & weak[:, None]
    number = np.maximum(movable.sum(axis=1), 1)
    layout, moves = Layout.of_space(V), np.zeros(len(free))
    for _ in range(SWEEPS):
        shift = sign * surplus / operator.diagonal * (others.shape[1] - 1) / number
        np.add.at(moves, others[movable], np.broadcast_to(shift[:, None], others.shape)[movable])
        start.x.array[:] += layout.shared_sum(moves)
        moves[:] = 0.0
        surplus = sign * (operator.times(vector) - b) - force


@dataclass(frozen=True, eq=False)
class _Inherited:
    """State of the contact facets, as their parents have it.

    Attributes:
        active: Whether the parent is active, shape (n,).
        force: The facet's share of its contact force, shape (n,).
        at_front: Whether contact begins or ends at one of the parent's vertices, shape (n,).
    """

    active: BoolArray
    force: FloatArray
    at_front: BoolArray

    @classmethod
    def of(cls, coarse: Solved, level: Level) -> _Inherited:
        """Ask the parents of the fine contact facets, in the order of their dofs; collective."""
        mesh, V = coarse.domain.mesh, coarse.u.function_space
        parents, system = level.parents, level.system
        assert parents is not None
        order = system.facets_by_dof()
        x, measure = (each[order] for each in system.measured)
        facets = system.bounded_facets[order]
        cells = facet_entities(level.domain.mesh, facets)[:, 0]
        # The parent facet lies opposite the vertex whose barycentric coordinate vanishes on it
        simplices = parents.take(mesh.geometry.x, compat.cell_nodes(mesh), cells)
        points = x.mean(axis=1, keepdims=True)
        local = np.argmin(np.abs(barycentric_coordinates(simplices, points)[:, 0]), axis=1)
        each, corners = np.arange(len(facets)), facet_corners(mesh)[local]
        parent_measure = simplex_measures(simplices[each[:, None], corners])
        block = V.dofmap.index_map_bs
        marks = np.zeros(len(coarse.u.x.array))
        marks[coarse.contact.active_set.dofs] = 1.0
        active, force = (
            parents.take(values.reshape(-1, block), V.dofmap.list, cells)[
                each, local, level.system.bounded % block
            ]
            for values in (Layout.of_space(V).shared_sum(marks), coarse.residual.x.array)
        )
        front = parents.take(_front(coarse), Layout.of_p1(mesh).cells, cells)
        at_front = front[each[:, None], corners].any(axis=1)
        return cls(active > 0.0, force * measure / parent_measure, at_front)


def _front(solution: Solved) -> BoolArray:
    """Tell whether contact begins or ends at a vertex, for all local ones; collective."""
    contact, p1 = solution.contact, Layout.of_p1(solution.domain.mesh)
    ends = p1.ends(contact.facets)
    return p1.named(ends[contact.active]) & p1.named(ends[~contact.active])
