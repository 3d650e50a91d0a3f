"""State that a run goes on from: u_h on the last meshes or last times, and how meshes were made.

Cells, facets and vertices are told by where they are. Places are the same to the last bit however a
mesh is shared out: those of vertices are read, or are midpoints of two others, and so are those of
facets. On the two faces of a slit they would be the same, so facets of the boundary are beside it.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
import numpy.typing as npt
from dolfinx import fem
from dolfinx.mesh import Mesh
from mpi4py import MPI

from . import compat
from .arrays import BoolArray, FloatArray, Int32Array, found_in
from .errors import InputError
from .fem.layout import Layout
from .mesh.balance import Refined, balance
from .mesh.domain import Domain, exterior_facets
from .mesh.refinement import refine, refine_edges
from .mesh.shared import shared_maximum
from .multigrid.hierarchy import NestedMesh
from .solution import Solution

Places = npt.NDArray[np.complex128]
"""Points of the plane; they sort by x, then by y."""


BESIDE = 0.2371
"""Distance of a facet's place beside it, in lengths of the facet; it is no other facet's place."""


class AnotherMesh(InputError):
    """Error where what is to go on was solved on another mesh."""


@dataclass(frozen=True, eq=False)
class Restart:
    """A sequence of meshes, and u_h on the last two or at the last times, for any number of ranks.

    Attributes:
        added: For each mesh but the coarsest the places of the edges below it that were cut in
            two; None where every triangle was cut into four.
        u: Places of the nodes of u_h and its values there, shape (nodes, block), on the last mesh
            and on the one below it; or, in time, all on the last mesh, after the last step and
            after those before it.
        space: What the nodes of u_h are those of, in its order; None of what was read from a file,
            whose order is that of other ranks.
    """

    added: tuple[Places | None, ...]
    u: tuple[tuple[Places, FloatArray], ...]
    space: fem.FunctionSpace | None = field(default=None, repr=False)

    @classmethod
    def of(cls, solution: Solution, below: Restart | None, adaptive: bool) -> Restart:
        """Take what there is on all ranks to rank 0; collective.

        Args:
            solution: On the last mesh.
            below: The same for the mesh below, None on the coarsest.
            adaptive: Whether meshes were refined in parts.

        Returns:
            Nothing but empty arrays on the other ranks.
        """
        comm, V = solution.domain.mesh.comm, solution.u.function_space
        size = V.dofmap.index_map.size_local
        here = _gathered(_places(V)[:size], comm), _gathered(_by_nodes(solution.u), comm)
        if below is None:
            return cls((), (here,))
        added = None
        if adaptive:
            (added,) = _added(solution.level.meshes[-2:], comm)
        return cls((*below.added, added), (here, below.u[0]))

    @classmethod
    def of_meshes(cls, solution: Solution) -> Restart:
        """Take how the meshes of a solution were made, refined in parts, to rank 0; collective.

        Returns:
            Nothing but empty arrays on the other ranks; no function.
        """
        return cls(_added(solution.level.meshes, solution.domain.mesh.comm), ())

    @classmethod
    def of_steps(
        cls,
        last: Sequence[Solution],
        below: Restart | None = None,
        earlier: Sequence[tuple[Places, FloatArray]] = (),
    ) -> Restart:
        """Take what there is after a step in time to rank 0; collective.

        Args:
            last: Of this step and of those before it that the next ones need; on the same mesh.
            below: The same for the step before, or `of_meshes`; None at the first, where every
                triangle was cut into four.
            earlier: What follows in `u`, of steps before those.

        Returns:
            Nothing but empty arrays on the other ranks.
        """
        V, comm = last[0].u.function_space, last[0].domain.mesh.comm
        size = V.dofmap.index_map.size_local
        same = below is not None and below.space is V
        at = below.u[0][0] if below and same else _gathered(_places(V)[:size], comm)
        u = tuple((at, _gathered(_by_nodes(each.u), comm)) for each in last)
        uniform = (None,) * last[0].level.number
        return cls(uniform if below is None else below.added, (*u, *earlier), V)

    def meshes(self, domain: Domain) -> Iterator[Refined]:
        """Refine as it was done before; collective.

        Args:
            domain: The coarsest mesh.

        Yields:
            What `Hierarchy.add` takes.
        """
        for places in self.added:
            if places is None:
                refined: Refined = (*refine(domain), None)
            else:
                places = _of_all(places, domain.mesh.comm)
                refined = balance(*refine_edges(domain, _edges_at(domain.mesh, places)))
            yield refined
            domain = refined[0]

    def function(self, V: fem.FunctionSpace, number: int) -> fem.Function:
        """Read u_h on the last mesh (0) or on the one below (1), or so many steps back; collective.

        Raises:
            AnotherMesh: The mesh is another one.
        """
        at, values = (_of_all(each, V.mesh.comm) for each in self.u[number])
        if V.dofmap.index_map.size_global == len(at) > len(np.unique(at)):
            raise AnotherMesh(
                "nodes of P1 at the same place, as on the two faces of a slit, can't be told apart"
            )
        order, mine = np.argsort(at), _places(V)
        place, there = found_in(at[order], mine)
        other = len(at) != V.dofmap.index_map.size_global or not there.all()
        if V.mesh.comm.allreduce(other, op=MPI.LOR):
            raise AnotherMesh(
                "the mesh is not the one that the levels before were solved on: other versions of"
                " gmsh and DOLFINx may make another one of the same polygon"
            )
        u = fem.Function(V)
        u.x.array[:] = values[order[place]].ravel()
        return u


def _added(meshes: Sequence[NestedMesh], comm: MPI.Comm) -> tuple[Places, ...]:
    """Find the places of edges that each mesh but the first has cut in two; collective."""
    vertices = [_gathered(_nodes(each.domain.mesh), comm) for each in meshes]
    edges = [_gathered(_boundary(each.domain.mesh), comm) for each in meshes]
    found = []
    for (coarse, fine), (before, after) in zip(pairwise(vertices), pairwise(edges), strict=True):
        cut = before[~np.isin(before[:, 0], after[:, 0])]
        inside = np.setdiff1d(np.setdiff1d(fine, coarse), cut[:, 1])
        found.append(np.concatenate([inside, np.unique(cut[:, 0])]))
    return tuple(found)


def _corners(mesh: Mesh) -> Places:
    """Return the corners of this rank's cells, shape (cells, 3)."""
    return _nodes(mesh)[compat.cell_nodes(mesh)]


def _nodes(mesh: Mesh) -> Places:
    """Return the vertices of this rank's cells."""
    x = mesh.geometry.x
    return x[:, 0] + 1j * x[:, 1]


def _by_nodes(u: fem.Function) -> FloatArray:
    """Return the values at the nodes that this rank owns, shape (nodes, block)."""
    dofmap = u.function_space.dofmap
    values: FloatArray = u.x.array.reshape(-1, dofmap.index_map_bs)[: dofmap.index_map.size_local]
    return values


def _places(V: fem.FunctionSpace) -> Places:
    """Find where the nodes of CR or P1 are, ghosts included."""
    layout, at = Layout.of_space(V), _corners(V.mesh)
    places = np.empty(layout.index_map.size_local + layout.index_map.num_ghosts, dtype=at.dtype)
    places[layout.cells] = _sides(V.mesh)[-1] if layout.cr else at
    return places


def _sides(mesh: Mesh) -> tuple[Int32Array, BoolArray, Places, Places]:
    """Find the sides opposite corners of this rank's cells; collective.

    Returns:
        Edges, whether they are of the boundary, their midpoints, and where they are told to be, all
        of shape (cells, 3).
    """
    exterior = exterior_facets(mesh)
    edges = mesh.topology.connectivity(2, 1).array.reshape(-1, 3)
    index_map = mesh.topology.index_map(1)
    outer = np.zeros(index_map.size_local + index_map.num_ghosts)
    outer[exterior] = 1.0
    of_boundary = shared_maximum(mesh, index_map, outer)[edges] > 0.0
    corners = _corners(mesh)
    first, second = corners[:, [1, 2, 0]], corners[:, [2, 0, 1]]
    middle, along = 0.5 * (first + second), second - first  # a + b is b + a exactly
    left = (along.conj() * (corners - middle)).imag > 0.0
    inwards = 1j * np.where(left, along, -along)
    return edges, of_boundary, middle, np.where(of_boundary, middle + BESIDE * inwards, middle)


def _boundary(mesh: Mesh) -> Places:
    """Return where the edges of the boundary and their midpoints are; collective.

    Returns:
        Shape (edges, 2); of those that cells of this rank have.
    """
    _, of_boundary, middle, places = _sides(mesh)
    return np.stack([places[of_boundary], middle[of_boundary]], axis=1)


def _edges_at(mesh: Mesh, places: Places) -> Int32Array:
    """Find the edges of this rank's cells whose places are among some; collective."""
    edges, _, _, mine = _sides(mesh)
    return np.unique(edges[np.isin(mine, places)]).astype(np.int32)


def _of_all(values: npt.NDArray, comm: MPI.Comm) -> npt.NDArray:
    """Give all ranks what `_gathered` has left on rank 0, unless they have read it; collective."""
    found: npt.NDArray = comm.bcast(values) if comm.allreduce(not len(values), MPI.LOR) else values
    return found


def _gathered(values: npt.NDArray, comm: MPI.Comm) -> npt.NDArray:
    """Gather all ranks' values on rank 0, nothing elsewhere; collective."""
    if comm.size == 1:
        return values
    parts = comm.gather(values)
    return values[:0] if parts is None else np.concatenate(parts)
