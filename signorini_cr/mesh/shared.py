"""Data shared by ranks: vectors with room for ghosts, and sums over what each has for an entity."""

from __future__ import annotations

from collections import OrderedDict
from typing import Any, NamedTuple
from weakref import WeakKeyDictionary

import numpy as np
from dolfinx.mesh import Mesh
from mpi4py import MPI
from petsc4py import PETSc

from ..arrays import FloatArray
from ..garbage import release

KEPT = 8
"""For so many index maps of a mesh it is kept how its ranks share them, see `shared_sum`."""

_exchanges: WeakKeyDictionary[Mesh, OrderedDict[tuple[Any, int], _Exchange]] = WeakKeyDictionary()


def bounding_box(mesh: Mesh) -> tuple[FloatArray, FloatArray]:
    """Find the least and the largest coordinates of a mesh, shapes (3,); collective."""
    x = mesh.geometry.x
    ends = x.min(axis=0, initial=np.inf), x.max(axis=0, initial=-np.inf)
    lows, highs = zip(*mesh.comm.allgather(ends), strict=True)
    return np.min(lows, axis=0), np.max(highs, axis=0)


def ghosted(
    comm: MPI.Comm, index_map: Any, array: FloatArray | None = None, block: int = 1
) -> PETSc.Vec:
    """Make a PETSc vector with room for ghosts.

    On one process it is a plain one, which takes a third of the time to make.

    Args:
        comm: The ranks.
        index_map: How they share nodes.
        array: Memory for it, the numbers of each local node, ghosts included (no copy).
        block: How many numbers a node has.
    """
    size = (block * index_map.size_local, block * index_map.size_global)
    if comm.size == 1:
        array = np.zeros(size[0]) if array is None else array
        return PETSc.Vec().createWithArray(array, size, block, comm=comm)
    ghosts = index_map.ghosts.astype(PETSc.IntType)
    if array is None:
        return PETSc.Vec().createGhost(ghosts, size, block, comm=comm)
    return PETSc.Vec().createGhostWithArray(ghosts, array, size, block, comm=comm)


def shared_sum(mesh: Mesh, index_map: Any, array: FloatArray, block: int = 1) -> FloatArray:
    """Sum up, in place, what the ranks have for each shared entity; collective.

    Args:
        mesh: The mesh.
        index_map: How its ranks share the entities.
        array: The numbers of each local entity, ghosts included.
        block: How many numbers an entity has.
    """
    _gather(mesh, index_map, array, block, PETSc.InsertMode.ADD_VALUES)
    return array


def shared_maximum(mesh: Mesh, index_map: Any, array: FloatArray, block: int = 1) -> FloatArray:
    """Find, in place, the largest of what ranks have for each shared entity; see `shared_sum`."""
    _gather(mesh, index_map, array, block, PETSc.InsertMode.MAX_VALUES)
    return array


def _gather(mesh: Mesh, index_map: Any, array: FloatArray, block: int, mode: Any) -> None:
    """Gather what ranks have for each shared entity at its owner's, and hand out what comes of it.

    To find out who has what of whom takes a dozen collective calls, in each of which all ranks wait
    for the last one; so it is kept for the index maps that a mesh was asked for last.
    """
    if mesh.comm.size == 1:
        return
    kept, key = _exchanges.setdefault(mesh, OrderedDict()), (index_map, block)
    if key not in kept:
        if len(kept) == KEPT:
            release(kept.popitem(last=False)[1].vector)
        memory = np.empty(len(array))
        kept[key] = _Exchange(ghosted(mesh.comm, index_map, memory, block), memory)
    kept.move_to_end(key)
    kept[key].run(array, mode)


class _Exchange(NamedTuple):
    """A vector with room for ghosts, and its memory, for entities that ranks share."""

    vector: PETSc.Vec
    memory: FloatArray

    def run(self, array: FloatArray, mode: Any) -> None:
        """Gather and hand out what there is in an array, in place; collective."""
        # with an array in its memory's place, which takes no time, it does not work with copies;
        # petsc4py asks for the owned part of that, and has no memory where a rank owns nothing
        owned = self.vector.getLocalSize()
        if owned:
            self.vector.placeArray(array[:owned])
        else:
            self.memory[:] = array
        try:
            self.vector.ghostUpdate(mode, PETSc.ScatterMode.REVERSE)
            self.vector.ghostUpdate(PETSc.InsertMode.INSERT_VALUES, PETSc.ScatterMode.FORWARD)
        finally:
            if owned:
                self.vector.resetArray()
            else:
                array[:] = self.memory
