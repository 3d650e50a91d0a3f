"""Sums over what ranks share, against what all of them have, gathered."""

import numpy as np
import pytest
from dolfinx.mesh import GhostMode, create_rectangle
from helpers import HELD_ABOVE
from mpi4py import MPI

from signorini_cr.fem.space import function_space
from signorini_cr.mesh.shared import KEPT, shared_maximum, shared_sum


@pytest.fixture(params=[GhostMode.none, GhostMode.shared_facet], ids=lambda mode: mode.name)
def mesh(request):
    return create_rectangle(
        MPI.COMM_WORLD, [[-1.0, 0.0], [1.0, 1.0]], [7, 5], ghost_mode=request.param
    )


def test_shared_maximum_agrees_on_all_copies(mesh):
    V = function_space(mesh, "P1")
    index_map = V.dofmap.index_map
    number = index_map.local_to_global(
        np.arange(index_map.size_local + index_map.num_ghosts, dtype=np.int32)
    )
    values = 1000.0 * mesh.comm.rank + number
    shared_maximum(mesh, V.dofmap.index_map, values)
    rank = np.floor((values - number) / 1000.0 + 0.5)
    holders = mesh.comm.allgather(number)
    highest = [max(r for r, held in enumerate(holders) if n in held) for n in number]
    assert np.array_equal(rank, highest)


def test_shared_sums_of_more_index_maps_than_are_kept(mesh):
    """Again and again, with one number and with two a node: each copy counts once."""
    spaces = [function_space(mesh, element) for element in ("CR", "P1") * KEPT]
    for block, V in [(1 + k % 2, V) for k in range(3) for V in spaces]:
        index_map = V.dofmap.index_map
        nodes = np.arange(index_map.size_local + index_map.num_ghosts, dtype=np.int32)
        numbers = index_map.local_to_global(nodes)
        everywhere = np.concatenate(mesh.comm.allgather(numbers))
        copies = np.bincount(everywhere, minlength=index_map.size_global)[numbers]
        sums = shared_sum(mesh, index_map, np.ones(block * len(nodes)), block)
        assert np.array_equal(sums.reshape(-1, block), np.tile(copies, (block, 1)).T)


@pytest.mark.ranks
def test_sums_where_a_rank_owns_nothing():
    """Some cells: on three ranks one has nodes of others alone."""
    mesh = HELD_ABOVE.mesh(1.0).mesh
    index_map = mesh.geometry.index_map()
    nodes = np.arange(index_map.size_local + index_map.num_ghosts, dtype=np.int32)
    numbers = index_map.local_to_global(nodes)
    everywhere = np.concatenate(mesh.comm.allgather(numbers))
    copies = np.bincount(everywhere, minlength=index_map.size_global)[numbers]
    for _ in range(2):
        assert np.array_equal(shared_sum(mesh, index_map, np.ones(len(nodes))), copies)
        most = shared_maximum(mesh, index_map, np.full(len(nodes), float(mesh.comm.rank)))
        held = mesh.comm.allgather(numbers)
        assert most.tolist() == [max(r for r, own in enumerate(held) if n in own) for n in numbers]
