"""Room for the matrix of a_h in CR, whose pattern needs no search.

Two facets have no more than one cell in common, so a row has its diagonal entry and d for each cell
of its facet. In general, entries that several cells have a share in must be found first, which
takes DOLFINx as long as computing them all.
"""

from __future__ import annotations

import numpy as np
from petsc4py import PETSc

from .parents import Layout


def empty_matrix(cr: Layout) -> PETSc.Mat:
    """A matrix that takes the entries of all owned cells without allocating anything.

    Args:
        cr: The dofs of CR.
    """
    owned, comm = cr.size[0], cr.mesh.comm
    local, d = owned + cr.index_map.num_ghosts, cr.cells.shape[1] - 1
    cells = cr.cells[: cr.mesh.topology.index_map(d).size_local]
    inside = d * np.bincount(cells.ravel(), minlength=local).astype(np.float64)
    outside = np.zeros(local)  # in columns that the row's rank does not own
    if comm.size > 1:
        owner = np.full(local, comm.rank)
        owner[owned:] = cr.index_map.owners
        there = cells[np.unique(np.flatnonzero(cells.ravel() >= owned) // (d + 1))]
        elsewhere = owner[there][:, :, None] != owner[there][:, None, :]
        np.add.at(outside, there, elsewhere.sum(axis=2))
        inside = cr.shared_sum(inside - outside)
        cr.shared_sum(outside)
    lengths = [n[:owned].astype(PETSc.IntType) for n in (1.0 + inside, outside)]
    nnz = lengths if comm.size > 1 else lengths[0]
    matrix = PETSc.Mat().createAIJ((cr.size, cr.size), nnz=nnz, comm=comm)
    # PETSc does not set it on ranks without rows, and these alone would then wait for an answer
    # when the matrix is assembled
    matrix.setOption(PETSc.Mat.Option.NEW_NONZERO_ALLOCATION_ERR, True)
    numbers = cr.numbers(np.arange(local, dtype=np.int32))
    local_to_global = PETSc.LGMap().create(numbers.astype(PETSc.IntType, copy=False), comm=comm)
    matrix.setLGMap(local_to_global, local_to_global)
    local_to_global.destroy()
    return matrix
