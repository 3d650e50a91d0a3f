"""The mesh as arrays, against DOLFINx's own geometry, cell by cell."""

import gc

import numpy as np
import pytest
from dolfinx.mesh import (
    GhostMode,
    compute_midpoints,
    create_unit_square,
    entities_to_geometry,
    exterior_facet_indices,
    meshtags,
)
from helpers import SQUARE, corners
from mpi4py import MPI

from signorini_cr.fem.cells import Cells, at_points
from signorini_cr.fem.space import function_space
from signorini_cr.mesh import balance as balancing
from signorini_cr.mesh.balance import balance
from signorini_cr.mesh.domain import Domain
from signorini_cr.mesh.refinement import refine, refine_marked


@pytest.mark.parametrize("first", [0, 3])
def test_extents(first):
    domain = SQUARE.mesh(0.2)
    mesh = domain.mesh
    cells = Cells(domain, function_space(mesh, "CR"), [])
    low, high = cells.extents(slice(first, cells.number))
    which = np.arange(first, cells.number, dtype=np.int32)
    for cell, nodes in enumerate(entities_to_geometry(mesh, 2, which)):
        corners = mesh.geometry.x[nodes, :2]
        assert (low[:, cell] == corners.min(axis=0)).all()
        assert (high[:, cell] == corners.max(axis=0)).all()
    assert low.shape == high.shape == (2, cells.number - first)


def crossed(low, high):
    """Boxes that x + 2 y = 0.83 meets."""
    return (low[0] + 2 * low[1] <= 0.83) & (high[0] + 2 * high[1] >= 0.83)


def with_ghosts():
    """The unit square; each rank knows the cells of others beside its own."""
    mesh = create_unit_square(MPI.COMM_WORLD, 6, 6, ghost_mode=GhostMode.shared_facet)
    mesh.topology.create_connectivity(1, 2)
    facets = exterior_facet_indices(mesh.topology)
    below = compute_midpoints(mesh, 1, facets)[:, 1] < 1e-9
    return Domain.from_tags(mesh, meshtags(mesh, 1, facets, np.where(below, 1, 2).astype(np.int32)))


@pytest.mark.parametrize("how", ["uniform", "marked", "forgotten", "moved", "ghosts"])
def test_search(how, monkeypatch):
    """What is found by way of coarser cells is what is found in all; few of these are looked at."""
    monkeypatch.setattr(balancing, "LIMIT", 0.0)
    meshes = [with_ghosts() if how == "ghosts" else SQUARE.mesh(0.2)]
    for _ in range(4):
        coarse = meshes[-1]
        if how == "marked":
            meshes.append(refine_marked(coarse, corners(coarse.mesh).mean(axis=1)[:, 0] < 0.6)[0])
        else:
            fine, parent = refine(coarse)
            meshes.append(balance(fine, parent)[0] if how == "moved" else fine)
    fine = meshes[-1]
    if how == "forgotten":
        del meshes[1:3], coarse
        gc.collect()
    cells = Cells(fine, function_space(fine.mesh, "CR"), [])
    seen = 0

    def may(low, high):
        """Tell which boxes a line meets."""
        nonlocal seen
        seen += low.shape[1]
        return (low[0] + 2 * low[1] <= 0.83) & (high[0] + 2 * high[1] >= 0.83)

    found = cells.search(may)
    looked_at, seen = seen, 0
    expected = np.flatnonzero(may(*cells.extents(slice(None))))
    assert found.tolist() == expected.tolist()
    assert cells.comm.allreduce(len(found)) > 0
    if how in ("uniform", "marked", "ghosts"):
        assert looked_at < seen / 2


@pytest.mark.parametrize("shape", [(), (2,)])
@pytest.mark.parametrize("d", [1, 2, 3])
@pytest.mark.parametrize("n", [0, 5])
def test_affine_functions_at_points(shape, d, n):
    """Weighted sums of the values at the vertices, simplex by simplex."""
    rng = np.random.default_rng(0)
    hats = rng.dirichlet(np.ones(d + 1), 4).T
    ends = rng.standard_normal((d + 1, *shape, n))
    found = at_points(ends, hats)
    assert found.shape == (*shape, 4, n)
    for q, weights in enumerate(hats.T):
        expected = sum(weight * end for weight, end in zip(weights, ends, strict=True))
        assert np.allclose(found[..., q, :], expected, atol=1e-15)
