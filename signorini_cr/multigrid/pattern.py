"""Room for the matrix of a_h, whose pattern needs no search.

A row has its diagonal entry and d for each cell of its dof. That is exact for CR, as two facets
have no more than one cell in common; for P1 it is twice as much as is needed in the plane and five
times in space. To find out which entries several cells have a share in takes DOLFINx as long as
computing them all.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from petsc4py import PETSc

from ..arrays import FloatArray, IndexArray
from ..fem.layout import Layout
from ..mesh.shared import shared_sum


def empty_matrix(dofs: Layout) -> PETSc.Mat:
    """Make a matrix that takes the entries of all owned cells without allocating anything.

    Args:
        dofs: The dofs of CR or P1.
    """
    owned, comm, block = dofs.index_map.size_local, dofs.mesh.comm, dofs.block
    local, d = owned + dofs.index_map.num_ghosts, dofs.cells.shape[1] - 1
    cells = dofs.cells[: dofs.mesh.topology.index_map(d).size_local]
    inside = d * np.bincount(cells.ravel(), minlength=local).astype(np.float64)
    if comm.size > 1:
        outside = np.zeros(local)  # in columns that the row's rank does not own
        owner = np.full(local, comm.rank)
        owner[owned:] = dofs.index_map.owners
        there = cells[np.unique(np.flatnonzero(cells.ravel() >= owned) // (d + 1))]
        apart = owner[there][:, :, None] != owner[there][:, None, :]
        np.add.at(outside, there, apart.sum(axis=2))
        inside = shared_sum(dofs.mesh, dofs.index_map, inside - outside)
        shared_sum(dofs.mesh, dofs.index_map, outside)

    def lengths(entries: FloatArray, columns: int) -> IndexArray:
        """Count for each unknown; PETSc refuses more than there are columns."""
        of_nodes = block * np.minimum(entries[:owned], columns).astype(PETSc.IntType)
        return of_nodes if block == 1 else np.repeat(of_nodes, block)

    here = lengths(1.0 + inside, owned)
    nnz: Any = here
    if comm.size > 1:
        nnz = here, lengths(outside, dofs.index_map.size_global - owned)
    matrix = PETSc.Mat().createAIJ((dofs.size, dofs.size), block, nnz=nnz, comm=comm)
    # PETSc does not set it on ranks without rows, and these alone would then wait for an answer
    # when the matrix is assembled
    matrix.setOption(PETSc.Mat.Option.NEW_NONZERO_ALLOCATION_ERR, True)
    nodes = dofs.index_map.local_to_global(np.arange(local, dtype=np.int32))
    local_to_global = PETSc.LGMap().create(nodes.astype(PETSc.IntType), block, comm=comm)
    matrix.setLGMap(local_to_global, local_to_global)
    local_to_global.destroy()
    return matrix
