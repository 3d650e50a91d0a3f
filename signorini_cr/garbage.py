"""PETSc's objects on several ranks, freed by all of them together.

What Python drops at a moment of its own choosing PETSc can't free on several ranks, and keeps until
all of them call `PETSc.garbage_cleanup` for the object's communicator. Each mesh has its own, which
ends with it, and whatever is still kept for it then is lost. So meshes are held here until they can
be cleaned up.
"""

from __future__ import annotations

import weakref

import numpy as np
from dolfinx.mesh import Mesh
from mpi4py import MPI
from petsc4py import PETSc

_held: list[tuple[weakref.ref, Mesh]] = []


def release(*things: PETSc.Object | None) -> None:
    """Free objects now; for places that all ranks come through together."""
    for thing in things:
        if thing is not None:
            thing.destroy()


def hold(owner: object, mesh: Mesh) -> None:
    """Note that there are objects on a mesh's communicator that end with their owner."""
    if mesh.comm.size > 1:
        _held.append((weakref.ref(owner), mesh))


def sweep(comm: MPI.Comm) -> None:
    """Free what owners have left that are gone on all ranks; collective."""
    if comm.size == 1:
        return
    same = MPI.IDENT, MPI.CONGRUENT
    mine = [entry for entry in _held if MPI.Comm.Compare(entry[1].comm, comm) in same]
    gone = np.array([owner() is None for owner, _ in mine], dtype=np.int32)
    comm.Allreduce(MPI.IN_PLACE, gone, op=MPI.MIN)
    done = [entry for entry, is_gone in zip(mine, gone, strict=True) if is_gone]
    for _, mesh in done:
        PETSc.garbage_cleanup(mesh.comm)
    _held[:] = [entry for entry in _held if not any(entry is other for other in done)]
