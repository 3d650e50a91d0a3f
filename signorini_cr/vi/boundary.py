"""Values on Γ0 and bounds on Γ1, by dofs, less a constant where all are far from 0."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from dolfinx import fem
from mpi4py import MPI
from petsc4py import PETSc

from ..arrays import BoolArray, FloatArray, Int32Array
from ..errors import raise_together
from ..fem.layout import Layout
from ..fem.physics import Imposed, OnMesh
from ..fem.space import unknowns
from .bounds import Bounds

FAR = 16.0
"""Values so many times as far from 0 as from one another are told from their middle."""

APART = 1e-15
"""Distance of two bounds that are the same, in parts of the largest."""


@dataclass(frozen=True, eq=False)
class Boundary:
    """Values and bounds of u less the offset.

    Attributes:
        u_D: Function with the Dirichlet values, 0 elsewhere.
        dirichlet: Local dofs on Γ0, ghosts included.
        lower: α on Γ1, `PETSc.NINFINITY` where there is none, ghosts up to date, shape (dofs,).
        upper: β on Γ1, `PETSc.INFINITY` where there is none, likewise.
        bounded: Owned local dofs with a bound, ascending, shape (n,).
        offset: The constant.
        facets: Owned facets of Γ1, ascending, shape (n,).
        dofs: The dofs with a bound that each of them has, shape (n, 1) or (n, d).
        obstacles: α and β themselves at the vertices of these facets, shape (2, n, d).
    """

    u_D: fem.Function
    dirichlet: Int32Array
    lower: FloatArray
    upper: FloatArray
    bounded: Int32Array
    offset: float
    facets: Int32Array
    dofs: Int32Array
    obstacles: FloatArray

    @classmethod
    def of(cls, data: OnMesh) -> Boundary:
        """Take values and bounds from the data; collective.

        Where all values of u_D, or of the bounds where there is no Γ0, lie far from 0 and close
        together, the offset is their middle.

        Raises:
            InputError: One is not finite.
        """
        V = data.V
        on_dirichlet, u_D = _imposed(data.fixed, V)
        dirichlet = np.flatnonzero(on_dirichlet).astype(np.int32)
        size, has_one = len(on_dirichlet), np.zeros_like(on_dirichlet)
        lower: FloatArray = np.full(size, PETSc.NINFINITY)
        upper: FloatArray = np.full(size, PETSc.INFINITY)
        for bound, sign in (lower, 1.0), (upper, -1.0):
            imposed = [each for each in data.bounds if each.sign == sign]
            if not imposed:
                continue
            there, values = _imposed(imposed, V)
            # Where the two parts meet in a P1 vertex the Dirichlet value holds
            at = np.flatnonzero(there & ~on_dirichlet)
            bound[at] = sign * values.x.array[at]
            has_one[at] = True
        offset = _middle_far_away(V.mesh.comm, u_D.x.array[dirichlet], lower, upper)
        if offset:
            u_D.x.array[dirichlet] -= offset
            lower, upper = _less(lower, offset), _less(upper, offset)
        _keep_apart(V.mesh.comm, lower, upper, has_one)
        bounded = np.flatnonzero(has_one[: Layout.of_space(V).size[0]]).astype(np.int32)
        return cls(u_D, dirichlet, lower, upper, bounded, offset, *_contact(data.bounds, V))

    @cached_property
    def bounds(self) -> Bounds:
        """The bounds of the dofs that have some."""
        return Bounds(self.lower[self.bounded], self.upper[self.bounded])

    def with_offset(self, offset: float) -> Boundary:
        """Take another constant off; without Γ0, as u_D stays."""
        further = offset - self.offset
        lower, upper = _less(self.lower, further), _less(self.upper, further)
        return replace(self, lower=lower, upper=upper, offset=offset)


def _less(bound: FloatArray, offset: float) -> FloatArray:
    """Take a constant off what is finite of a bound."""
    return np.where(np.abs(bound) < PETSc.INFINITY, bound - offset, bound)


def _middle_far_away(
    comm: MPI.Comm, fixed: FloatArray, lower: FloatArray, upper: FloatArray
) -> float:
    """Find the middle of values if they are far from 0 and close together, else 0; collective."""
    bottom, top = extent(comm, fixed)
    if bottom > top:
        each = np.concatenate([lower, upper])
        bottom, top = extent(comm, each[np.abs(each) < PETSc.INFINITY])
    middle = 0.5 * (bottom + top)
    return middle if abs(middle) > FAR * 0.5 * (top - bottom) else 0.0


def _keep_apart(comm: MPI.Comm, lower: FloatArray, upper: FloatArray, there: BoolArray) -> None:
    """Lift β by a little where it is α: the one that is nearer to u holds it; collective."""
    low, high = lower[there], upper[there]
    both = np.abs(np.concatenate([low, high]))
    size = float(both[both < PETSc.INFINITY].max(initial=0.0))
    least = max(APART * comm.allreduce(size, op=MPI.MAX), 1e-290)
    upper[there] = np.where(high > low, high, low + least)


def _contact(
    bounds: Sequence[Imposed], V: fem.FunctionSpace
) -> tuple[Int32Array, Int32Array, FloatArray]:
    """Find `facets`, `dofs` and `obstacles` of a `Boundary`."""
    topology = V.mesh.topology
    owned = topology.index_map(topology.dim - 1).size_local
    none, only = np.empty(0, dtype=np.int32), np.zeros(1, dtype=np.int32)
    rows = [(none, only), *((each.facets, each.components) for each in bounds)]
    every = np.concatenate([each for each, _ in rows])
    dofs = np.concatenate([unknowns(V, *row)[:, :, 0] for row in rows])
    # with bounds on both sides a facet is there twice
    facets, first = np.unique(every[every < owned], return_index=True)
    size = len(facets), topology.dim
    obstacles = np.stack([np.full(size, -np.inf), np.full(size, np.inf)])
    for each in bounds:
        own = each.facets < owned
        at = np.searchsorted(facets, each.facets[own])
        obstacles[0 if each.sign > 0 else 1][at] = each.sign * each.ends[own, :, 0]
    return facets, dofs[every < owned][first], obstacles


def _imposed(imposed: Sequence[Imposed], V: fem.FunctionSpace) -> tuple[BoolArray, fem.Function]:
    """Take data on the boundary as the element does: CR facet means, P1 values at vertices.

    Returns:
        Which dofs have some, and a Function with the values there.
    """
    values, layout = fem.Function(V), Layout.of_space(V)
    on_part = np.zeros_like(values.x.array)
    values.x.array[:] = PETSc.NINFINITY
    for data in imposed:
        dofs = unknowns(V, data.facets, data.components)
        # Π_h K ⊂ K_h holds with facet means for any α and u_D
        of_dofs = data.means[:, None] if layout.cr else data.ends
        # before the maximum over the ranks, which a NaN may lose
        require_finite(V.mesh.comm, data.key, of_dofs)
        np.maximum.at(values.x.array, dofs, of_dofs)
        on_part[dofs] = 1.0
    # A rank may own a dof of the part without owning any of its facets
    for array in (values.x.array, on_part):
        layout.shared_maximum(array)
    values.x.array[on_part == 0.0] = 0.0
    return on_part > 0.0, values


def extent(comm: MPI.Comm, values: FloatArray) -> tuple[float, float]:
    """Find the least and the largest of all ranks' values; ∞ and −∞ where there are none."""
    bottom = comm.allreduce(float(values.min(initial=np.inf)), op=MPI.MIN)
    return bottom, comm.allreduce(float(values.max(initial=-np.inf)), op=MPI.MAX)


def require_finite(comm: MPI.Comm, key: str, values: FloatArray) -> None:
    """Insist on numbers that PETSc takes for finite; collective.

    Raises:
        InputError: One is not; what they are called is `key`.
    """
    raise_together(
        comm,
        None
        if (np.abs(values) < PETSc.INFINITY).all()
        else f"data: {key} is not finite, or too large, at some point of the mesh; "
        "where(condition, a, b), or ufl.conditional, can set a value apart",
    )
