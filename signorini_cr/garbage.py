"""Release of objects that must be freed on several ranks, or in time.

What Python drops at a moment of its own choosing PETSc can't free on several ranks, and keeps until
all of them call `PETSc.garbage_cleanup` for the object's communicator. Each mesh has its own, which
ends with it, and what is still kept for it then is lost, with a communicator that PETSc has made
of it. So meshes, as C++ has them, are held here until they can be cleaned up: whenever a
`NestedMesh` is gone, which may happen often on one mesh, and when the mesh itself is.

A mesh has half a dozen communicators, of which MPICH has 2048 in a process, on one rank as well.
UFL and DOLFINx leave cycles behind, by which a mesh stays until Python looks for some: when there
are many new objects, whatever hangs on them, and hardly ever where there are many old ones. So it
is told to look when there are many meshes.
"""

from __future__ import annotations

import gc
from typing import Any
from weakref import WeakSet, ref

import numpy as np
from dolfinx.mesh import Mesh
from mpi4py import MPI
from petsc4py import PETSc

MANY = 50
"""So many meshes more than there were after the last look for cycles are a reason for another."""

_held: list[tuple[ref, Any]] = []
_meshes: WeakSet[Mesh] = WeakSet()
_allowed = MANY


def release(*things: PETSc.Object | None) -> None:
    """Free objects now; for places that all ranks come through together."""
    for thing in things:
        if thing is not None:
            thing.destroy()


def watch(mesh: Mesh) -> None:
    """Note a new mesh, and free what meshes before have left; collective."""
    global _allowed
    if mesh in _meshes:
        return
    states = mesh.comm.allgather((len(_meshes) >= _allowed, gc.isenabled()))
    # where it is switched off it would do harm, see `options.explained`
    if any(full for full, _ in states) and all(on for _, on in states):
        for _ in range(2):  # what is kept by PETSc's objects that are freed only now
            gc.collect()
            sweep(mesh.comm, everything=True)
        _allowed = len(_meshes) + MANY
    sweep(mesh.comm)
    _meshes.add(mesh)
    hold(mesh, mesh)


def hold(owner: object, mesh: Mesh) -> None:
    """Note that there are objects on a mesh's communicator that end with their owner."""
    if mesh.comm.size > 1:
        _held.append((ref(owner), mesh._cpp_object))


def sweep(comm: MPI.Comm, everything: bool = False) -> None:
    """Free what owners have left that are gone on all ranks; collective.

    Args:
        comm: The ranks.
        everything: Free what all ranks have dropped, whoever it belonged to. After an error in a
            solver PETSc may keep what has the owner along, who then is never gone.
    """
    if comm.size == 1:
        return
    same = MPI.IDENT, MPI.CONGRUENT
    mine = [entry for entry in _held if MPI.Comm.Compare(entry[1].comm, comm) in same]
    gone = np.array([owner() is None for owner, _ in mine], dtype=np.int32)
    comm.Allreduce(MPI.IN_PLACE, gone, op=MPI.MIN)
    done = [entry for entry, is_gone in zip(mine, gone, strict=True) if is_gone]
    for mesh in {id(mesh): mesh for _, mesh in (mine if everything else done)}.values():
        PETSc.garbage_cleanup(mesh.comm)
    _held[:] = [entry for entry in _held if not any(entry is other for other in done)]
