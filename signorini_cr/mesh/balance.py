"""Refined meshes shared out anew, where some ranks have many more cells than others."""

from __future__ import annotations

from typing import Any, TypeAlias

import numpy as np
from dolfinx import cpp
from dolfinx.mesh import Mesh, create_mesh
from mpi4py import MPI

from .. import compat
from ..arrays import IndexArray, Int32Array
from .domain import Domain
from .exchange import Exchange
from .materials import Materials
from .partition import bisect
from .refinement import labels, tagged

LIMIT = 1.3
"""Cells of the rank that has most, over the mean, from which on a mesh is shared out anew."""


Refined: TypeAlias = tuple[Domain, Int32Array | IndexArray, Exchange | None]
"""The next domain of a sequence, and where the parents of its cells are."""


def balance(domain: Domain, parent: Int32Array) -> Refined:
    """Share a refined mesh out anew if one rank has many more cells than the mean; collective.

    Args:
        domain: As `refine_marked` makes it.
        parent: The parent of every cell, local indices.

    Returns:
        The domain, the parent of every cell, and None, if all stays where it is. Otherwise a
        domain of the same cells on other ranks; for every cell the row of its parent, among those
        that an exchange fetches from the ranks of the coarse cells; and this exchange.
    """
    topology = domain.mesh.topology
    comm, cells = domain.mesh.comm, topology.index_map(topology.dim)
    most = comm.allreduce(cells.size_local, op=MPI.MAX)
    if most * comm.size <= LIMIT * cells.size_global:
        return domain, parent, None
    mesh = _moved(domain.mesh)
    starts = np.array(comm.allgather(cells.local_range[0]))
    number = mesh.topology.original_cell_index
    rank = np.searchsorted(starts, number, side="right") - 1
    before = Exchange(comm, rank, number - starts[rank])
    known = before.fetch(np.column_stack([parent, labels(domain)]))[before.place]
    materials = domain.materials
    if materials.numbers:
        of_cells = before.fetch(materials.of_cells)[before.place]
        materials = Materials(materials.numbers, of_cells)
    parents = Exchange(comm, rank, known[:, 0])
    tags = tagged(mesh, known[:, 1:])
    *before_it, last = domain.descent
    descent = (*before_it, last._replace(parent=parents.place, exchange=parents))
    moved = Domain(mesh, tags, parts=domain.parts, materials=materials, descent=descent)
    return moved, parents.place, parents


def _moved(mesh: Mesh) -> Mesh:
    """Share out the same cells, as many to each rank; collective."""
    nodes, x = compat.cell_nodes(mesh), mesh.geometry.x[:, : mesh.geometry.dim]
    ranks = _ranks(mesh)

    def partitioner(comm: Any, parts: int, kinds: Any, corners: Any) -> Any:
        return cpp.graph.AdjacencyList_int32(ranks.reshape(-1, 1))

    numbers = mesh.geometry.index_map()
    return create_mesh(
        mesh.comm,
        cells=numbers.local_to_global(nodes.ravel()).reshape(nodes.shape),
        x=x[: numbers.size_local],
        e=mesh.ufl_domain().ufl_coordinate_element(),
        partitioner=partitioner,
    )


def _ranks(mesh: Mesh) -> Int32Array:
    """Find where the cells of this rank are to go; collective."""
    comm, nodes = mesh.comm, compat.cell_nodes(mesh)
    parts = comm.gather(mesh.geometry.x[nodes, : mesh.geometry.dim].mean(axis=1))
    shares = None
    if parts is not None:
        ends = np.cumsum([len(part) for part in parts])[:-1]
        shares = np.split(bisect(np.concatenate(parts), comm.size), ends)
    ranks: Int32Array = comm.scatter(shares)
    return ranks
