"""What iterations leave depends on the ranks; what is made of it must not, but for as much."""

import numpy as np
import pytest
from mpi4py import MPI

from signorini_cr import (
    Domain,
    Polygon,
    Problem,
    solve_adaptive,
)
from signorini_cr.compat import cell_nodes
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
    square = Polygon(
        [[0, 0], [1, 0], [1, 1], [0, 1]], ["contact", "dirichlet", "dirichlet", "contact"]
    )
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
