"""Meshes that nobody needs any more go, with their communicators, and PETSc's of these.

Open MPI has as many communicators as one likes, MPICH 2048 in a process. An attribute of one says
when it is freed.
"""

import gc
from collections.abc import Iterator

import numpy as np
import pytest
import ufl
from dolfinx import fem
from helpers import HELD_ABOVE, SQUARE
from mpi4py import MPI
from petsc4py import PETSc

from signorini_cr import Problem, exact, garbage, solve, solve_levels
from signorini_cr.fem.space import function_space, ghosted_vector
from signorini_cr.mesh.domain import Domain
from signorini_cr.multigrid.smoothing import GaussSeidel


class Watch:
    """The communicators of some that are still there, by their names."""

    def __init__(self) -> None:
        self.there: list[object] = []
        self._key = MPI.Comm.Create_keyval(delete_fn=lambda _, key, name: self.there.remove(name))

    def add(self, comm: MPI.Comm, name: object) -> None:
        self.there.append(name)
        comm.Set_attr(self._key, name)


@pytest.fixture
def watch() -> Watch:
    return Watch()


@pytest.fixture
def seldom() -> Iterator[None]:
    """Have Python look for cycles only when it is told to, as if there were many old objects."""
    thresholds = gc.get_threshold()
    gc.collect()
    gc.set_threshold(0)
    yield
    gc.set_threshold(*thresholds)


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


def test_what_petsc_keeps_for_a_mesh_goes_with_it(watch: Watch) -> None:
    """It keeps what several ranks drop, also where no sequence of meshes is solved on."""
    domain = SQUARE.mesh(0.5)
    V = function_space(domain.mesh)
    vector = ghosted_vector(V, fem.Function(V).x.array)
    watch.add(domain.mesh.comm, "mesh")
    watch.add(vector.comm.tompi4py(), "PETSc's")
    del vector, V, domain
    look_for_cycles_and_sweep()
    assert watch.there == []


def test_a_mesh_frees_what_the_one_before_has_left(watch: Watch, seldom: None) -> None:
    def leave_a_matrix() -> Domain:
        domain = SQUARE.mesh(0.5)
        matrix = PETSc.Mat().createAIJ((2, 2), comm=domain.mesh.comm)
        watch.add(matrix.comm.tompi4py(), "PETSc's")
        return domain

    domain = leave_a_matrix()
    assert watch.there == ([] if MPI.COMM_WORLD.size == 1 else ["PETSc's"])
    del domain
    SQUARE.mesh(0.5)
    assert watch.there == []


def test_meshes_do_not_pile_up(watch: Watch, seldom: None, monkeypatch: pytest.MonkeyPatch) -> None:
    """Though each is in a cycle, by which it would wait for Python to look for some."""
    monkeypatch.setattr(garbage, "MANY", 6)
    monkeypatch.setattr(garbage, "_allowed", len(garbage._meshes) + 6)
    most = 0
    for number in range(20):
        domain = SQUARE.mesh(0.5)
        watch.add(domain.mesh.comm, number)
        fem.Function(function_space(domain.mesh)).interpolate(lambda x: x[0])
        most = max(most, len(watch.there))
    assert 6 <= most <= 8
    before = list(watch.there)
    gc.disable()
    try:  # as in a call of PETSc, where it would do harm
        kept = [SQUARE.mesh(0.5) for _ in range(8)]
    finally:
        gc.enable()
    assert len(kept) == 8 and watch.there == before


def test_what_is_needed_stays() -> None:
    """With a second mesh beside it that is gone."""
    solution, _ = (solve(exact.A.problem, exact.A.structured(4)) for _ in range(2))
    del _
    look_for_cycles_and_sweep()
    again = fem.Function(solution.level.V)
    solution.level.system.residual(solution.u, again)
    assert np.allclose(again.x.array, solution.residual.x.array, rtol=0.0, atol=1e-12)


def test_meshes_go_after_an_error_inside_the_cycle(
    watch: Watch, monkeypatch: pytest.MonkeyPatch
) -> None:
    """PETSc's solver, which can't be freed then, holds none of them."""

    def fail(*_: object) -> None:
        raise ArithmeticError("in the cycle")

    def end() -> None:
        for solution in solve_levels(exact.A.problem, exact.A.structured(3), 3):
            watch.add(solution.domain.mesh.comm, solution.level.number)
            if solution.level.number == 1:
                monkeypatch.setattr(GaussSeidel, "backward", fail)

    with pytest.raises(ArithmeticError, match="in the cycle"):
        end()
    look_for_cycles_and_sweep()
    assert watch.there == []


def test_meshes_do_not_pile_up_when_monitors_raise(
    watch: Watch, seldom: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """On several ranks PETSc keeps what holds them then, until it is told to free all."""
    monkeypatch.setattr(garbage, "MANY", 4)
    monkeypatch.setattr(garbage, "_allowed", len(garbage._meshes) + 4)

    def fail(*_: object) -> None:
        raise KeyError("ours")

    for number in range(12):
        domain = exact.A.structured(4)
        watch.add(domain.mesh.comm, number)
        with pytest.raises(KeyError, match="ours"):
            solve(exact.A.problem, domain, monitor=fail)
    assert len(watch.there) <= 6
