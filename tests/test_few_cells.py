"""Fewer cells than ranks: whoever has none takes part in everything, and nothing else changes."""

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
import ufl
from dolfinx import cpp
from dolfinx.mesh import create_unit_square
from helpers import tagged
from mpi4py import MPI

from signorini_cr import (
    Contact,
    Dirichlet,
    Domain,
    InputError,
    Material,
    Polygon,
    Problem,
    Robin,
    Solution,
    solve,
    solve_adaptive,
    solve_in_time,
    solve_levels,
)
from signorini_cr.arrays import summed
from signorini_cr.restart import Restart

pytestmark = [pytest.mark.slow, pytest.mark.ranks]

COMM = MPI.COMM_WORLD
PLAIN = Problem(f=-3.0, obstacle=-0.2)
VERTICES, LABELS = [[0, 0], [1, 0], [0, 1]], ["contact", "dirichlet", "neumann"]
TRIANGLE = Polygon(VERTICES, LABELS)


def tensor(x: ufl.core.expr.Expr) -> ufl.core.expr.Expr:
    return ufl.as_matrix([[2 + x[0], 0.5 * x[1]], [0.5 * x[1], 1 + 0 * x[0]]])


PROBLEMS = {
    "plain": PLAIN,
    "tensor": Problem(f=-3.0, obstacle=-0.2, coefficient=tensor),
    "varying": Problem(
        f=lambda x: -3.0 - ufl.sin(5.0 * x[0]),
        g=lambda x: x[1] ** 2,
        obstacle=lambda x: -0.2 + 0.1 * ufl.sin(4.0 * x[0]),
        dirichlet=lambda x: 0.1 * x[0],
        coefficient=lambda x: ufl.exp(x[0] * x[1]),
        reaction=2.0,
    ),
    "parts": Problem(
        f=lambda x: -3.0 * ufl.exp(x[0]),
        conditions={
            "contact": Contact(obstacle=-0.2, upper=0.1, coefficient=0.5, external=-1.0),
            "dirichlet": Dirichlet(0.0),
            "neumann": Robin(coefficient=1.5, external=0.3),
        },
        materials={"soft": Material(coefficient=0.1, f=lambda x: -1.0 - x[0], reaction=2.0)},
    ),
    "strong": Problem(
        f=lambda x: -1e4 * (1.0 + x[0]),
        reaction=1e4,
        conditions={
            "contact": Contact(lambda x: -0.8 - 0.3 * x[0], coefficient=1e4, external=-1.0),
            "dirichlet": Dirichlet(-1.0),
            "neumann": Robin(coefficient=1e6, external=lambda x: -1.0 - x[1]),
        },
    ),
    "exact": Problem(exact=lambda x: x[0] ** 3 - 3.0 * x[0] * x[1] ** 2, obstacle=-9.0),
}


COMPILED = Problem(
    f=lambda x: -3.0 - ufl.bessel_J(0, 5.0 * x[0]),
    g=lambda x: ufl.bessel_J(1, x[1]),
    obstacle=lambda x: -0.2 + 0.1 * ufl.bessel_J(0, 4.0 * x[0]),
    dirichlet=lambda x: 0.1 * ufl.bessel_J(1, x[0]),
    coefficient=lambda x: 2.0 + ufl.bessel_J(0, x[0] * x[1]),
    reaction=lambda x: 2.0 + ufl.bessel_J(0, x[1]),
)
"""Data that NumPy has no functions for; there is no certificate that meshes could be adapted by."""


def solved(
    kind: str, problem: Problem, comm: MPI.Comm, restart: Restart | None = None
) -> Iterator[Solution]:
    """On a triangle, which gmsh cuts into two."""
    materials = {"soft": np.array([[0.0, 0.0], [0.5, 0.0], [0.5, 0.5], [0.0, 0.5]])}
    polygon = Polygon(VERTICES, LABELS, materials=materials) if problem.materials else TRIANGLE
    domain = polygon.mesh(1.0, comm)
    if kind == "adaptive":
        return solve_adaptive(problem, domain, levels=5, restart=restart)
    return solve_levels(problem, domain, 3, "P1" if kind == "p1" else "CR", restart=restart)


def test_sums_where_a_rank_has_nothing_to_add_up():
    own = [0, 1, 1] if COMM.rank == COMM.size - 1 else []
    counted = np.bincount(np.array(own, np.intp), np.full(len(own), 0.5), minlength=2)
    assert np.array_equal(summed(COMM, counted), [0.5, 1.0])
    nothing = np.bincount(np.empty(0, np.intp), np.empty(0), minlength=2)
    assert summed(COMM, nothing).dtype == np.float64


@pytest.mark.parametrize("name", PROBLEMS)
@pytest.mark.parametrize("kind", ["uniform", "adaptive", "p1"])
def test_the_figures_are_those_of_one_rank(kind: str, name: str) -> None:
    restart = None
    for one, all_ranks in zip(
        solved(kind, PROBLEMS[name], MPI.COMM_SELF),
        solved(kind, PROBLEMS[name], COMM),
        strict=True,
    ):
        assert one.cells == all_ranks.cells
        assert one.energy == pytest.approx(all_ranks.energy, rel=1e-8)
        bounds = [each.certificate.bound_h1 for each in (one, all_ranks)]
        assert bounds[0] == (bounds[1] and pytest.approx(bounds[1], rel=1e-6))
        assert one.errors == (one.errors and pytest.approx(all_ranks.errors, rel=1e-6))
        restart = Restart.of(all_ranks, restart, kind == "adaptive")
    (again,) = solved(kind, PROBLEMS[name], COMM, COMM.bcast(restart))
    assert again.energy == pytest.approx(one.energy, rel=1e-8)


@pytest.mark.parametrize("element", ["CR", "P1"])
def test_so_are_those_of_data_that_are_compiled(element: str) -> None:
    """On a single cell, which all ranks but one are without."""
    one, all_ranks = (
        solve(COMPILED, TRIANGLE.mesh(2**0.5, comm), element) for comm in (MPI.COMM_SELF, COMM)
    )
    assert one.cells == all_ranks.cells == 1
    assert one.energy == pytest.approx(all_ranks.energy, rel=1e-8)
    assert all_ranks.certificate.reason == one.certificate.reason is not None


def in_time(comm: MPI.Comm, scheme: str) -> list[float]:
    steps = solve_in_time(
        PLAIN, TRIANGLE.mesh(1.0, comm), end=1.0, steps=3, scheme=scheme, levels=2
    )
    return [solution.energy for _, solution in steps]


@pytest.mark.parametrize("scheme", ["euler", "bdf2"])
def test_so_are_those_in_time(scheme: str) -> None:
    assert in_time(COMM, scheme) == pytest.approx(in_time(MPI.COMM_SELF, scheme), rel=1e-8)


def all_on_the_last_rank(comm: MPI.Comm, parts: int, kinds: Any, corners: Any) -> Any:
    """A partitioner."""
    ranks = np.full((corners[0].size // 3, 1), comm.size - 1, dtype=np.int32)
    return cpp.graph.AdjacencyList_int32(ranks)


@pytest.mark.parametrize("name", ["f", "coefficient", "weight", "initial"])
def test_conditions_in_what_has_no_enclosure(name: str) -> None:
    """erf is known by its values alone; a rank without cells never asks for an enclosure of it."""

    def datum(x: Any) -> Any:
        return ufl.conditional(ufl.lt(ufl.erf(x[0]), 0.5), 1.0, 2.0)

    mesh = create_unit_square(COMM, 4, 4, partitioner=all_on_the_last_rank)
    domain = Domain.from_tags(mesh, tagged(mesh, lambda x, y: np.where(y < 1e-9, 1, 2)))
    if name == "weight":
        solution = solve(Problem(f=-2.0), domain)
        with pytest.raises(InputError, match="weight holds an operator that has no enclosure: Erf"):
            solution.mean(None, datum)
    elif name == "initial":
        steps = solve_in_time(Problem(f=0.0), domain, end=1.0, steps=2, initial=datum)
        assert len([solution.certificate for _, solution in steps]) == 2
    else:
        data = {"f": -2.0, name: datum}
        certificate = solve(Problem(**data), domain).certificate
        assert certificate.bound_h1 is None
        wanted = "no enclosure: Erf" if name == "f" else "no computable upper and lower bound"
        assert certificate.reason is not None and wanted in certificate.reason
