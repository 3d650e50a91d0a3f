"""Results of iterations depend on the ranks; what is made of them must not, but for as much."""

import numpy as np
import pytest
import ufl
from helpers import SQUARE
from mpi4py import MPI

from signorini_cr import (
    Contact,
    Dirichlet,
    Domain,
    Material,
    Neumann,
    Polygon,
    Problem,
    Robin,
    Solution,
    solve_adaptive,
)
from signorini_cr.compat import cell_nodes
from signorini_cr.estimate.force import Interval
from signorini_cr.mesh.families import structured

pytestmark = [pytest.mark.slow, pytest.mark.ranks]

COMM = MPI.COMM_WORLD


def centres(domain: Domain) -> np.ndarray:
    """Of all cells, in order, shape (cells, 2)."""
    mesh = domain.mesh
    own = cell_nodes(mesh)[: mesh.topology.index_map(2).size_local]
    places = np.concatenate(mesh.comm.allgather(mesh.geometry.x[own, :2].mean(axis=1)))
    places = places.round(9)
    return places[np.lexsort(places.T)]


def test_meshes_of_a_symmetric_problem():
    """Marking ends between two cells that are twins: both are refined, on any number of ranks."""
    square = Polygon(SQUARE.vertices, ["contact", "dirichlet", "dirichlet", "contact"])
    problem = Problem(f=-3.0, obstacle=-0.2)
    one, all_ranks = (
        [
            centres(each.domain)
            for each in solve_adaptive(problem, structured(square, 3, c), levels=4)
        ]
        for c in (MPI.COMM_SELF, COMM)
    )
    for own, shared in zip(one, all_ranks, strict=True):
        mirrored = own[:, ::-1]
        assert np.array_equal(own, mirrored[np.lexsort(mirrored.T)])
        assert np.array_equal(own, shared)


def tensor(a: float, b: float, c: float) -> ufl.core.expr.Expr:
    return ufl.as_matrix([[a, b], [b, c]])


def with_tensors(comm: MPI.Comm) -> Solution:
    """The finest solution of an adaptive run with two tensors."""
    sides = ["contact", "below", "robin", "dirichlet", "neumann"]
    plate = np.array([[0.5, 0.0], [1.5, 0.0], [1.5, 0.5], [0.5, 0.5]])
    rectangle = Polygon(
        [[0, 0], [1, 0], [2, 0], [2, 1], [0, 1]],
        sides,
        names=sides,
        materials={"plate": plate},
    )
    problem = Problem(
        f=lambda x: -3.0 - ufl.sin(5.0 * x[0]),
        coefficient=lambda x: tensor(2.0, 0.5, 1.0),
        conditions={
            "contact": Contact(obstacle=-0.1),
            "below": Contact(obstacle=-0.05),
            "robin": Robin(coefficient=1.5, external=0.3),
            "dirichlet": Dirichlet(0.0),
            "neumann": Neumann(0.0),
        },
        materials={"plate": Material(coefficient=lambda x: tensor(1.0, -0.3, 3.0))},
    )
    *_, finest = solve_adaptive(problem, rectangle.mesh(0.25, comm), levels=4)
    return finest


def test_what_is_certain_is_that_of_one_rank():
    """The ends of intervals are no less certain than the bound that they are made from."""
    one, all_ranks = with_tensors(MPI.COMM_SELF), with_tensors(COMM)
    assert np.array_equal(centres(one.domain), centres(all_ranks.domain))
    a, b = one.certificate, all_ranks.certificate
    left = max(a.parts["solver"], b.parts["solver"])
    assert left < 1e-6 * a.bound_energy_norm
    assert abs(a.bound_energy_norm - b.bound_energy_norm) <= left + 1e-9 * a.bound_energy_norm

    def certain(solution: Solution) -> list[Interval]:
        return [solution.mean("plate"), solution.mean("robin"), solution.flux("dirichlet")]

    for own, shared in zip(certain(one), certain(all_ranks), strict=True):
        assert tuple(own) == pytest.approx(tuple(shared), abs=1e-6 * (own.upper - own.lower))
