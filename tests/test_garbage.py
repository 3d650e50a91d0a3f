"""Meshes that nobody needs any more go, with their communicators, and PETSc's of these.

Open MPI has as many communicators as one likes, MPICH 2048 in a process. An attribute of one says
when it is freed.
"""

import gc

import pytest
import ufl
from helpers import HELD_ABOVE
from mpi4py import MPI

from signorini_cr import Problem, garbage, solve


class Watch:
    """Which of some communicators are there, by their names."""

    def __init__(self) -> None:
        self.there: list[object] = []
        self._key = MPI.Comm.Create_keyval(delete_fn=lambda _, key, name: self.there.remove(name))

    def add(self, comm: MPI.Comm, name: object) -> None:
        self.there.append(name)
        comm.Set_attr(self._key, name)


@pytest.fixture
def watch() -> Watch:
    return Watch()


def look_for_cycles_and_sweep() -> None:
    for _ in range(2):  # what PETSc's objects refer to waits for the second time
        gc.collect()
        garbage.sweep(MPI.COMM_WORLD)


def bent(x: ufl.core.expr.Expr) -> ufl.core.expr.Expr:
    """With two branches that agree where the condition changes, which costs a look."""
    return ufl.conditional(x[0] < 0.4, x[0] - 0.4, 2.0 * (x[0] - 0.4))


def test_a_mesh_goes_with_its_certified_solution(watch: Watch) -> None:
    """No cache holds the data's expressions, which know their mesh."""
    problem = Problem(f=bent, obstacle=bent, dirichlet=1.0, coefficient=lambda x: 2.0 + bent(x))
    domain = HELD_ABOVE.mesh(0.5)
    watch.add(domain.mesh.comm, "mesh")
    assert solve(problem, domain).certificate.bound_h1 is not None
    del domain
    look_for_cycles_and_sweep()
    assert watch.there == []
