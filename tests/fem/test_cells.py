"""The mesh as arrays, against DOLFINx's own geometry, cell by cell."""

import numpy as np
import pytest
from dolfinx.mesh import entities_to_geometry
from helpers import SQUARE

from signorini_cr.fem.cells import Cells, at_points
from signorini_cr.fem.space import function_space


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


@pytest.mark.parametrize("shape", [(), (2,)])
def test_affine_functions_at_points(shape):
    """Values at the middles of edges and inside, from those at the vertices, simplex by simplex."""
    hats = np.array([[0.5, 0.5, 0.0, 0.2], [0.5, 0.0, 0.5, 0.3], [0.0, 0.5, 0.5, 0.5]])
    ends = np.random.default_rng(0).standard_normal((3, *shape, 5))
    found = at_points(ends, hats)
    assert found.shape == (*shape, 4, 5)
    for q, (a, b, c) in enumerate(hats.T):
        assert np.allclose(found[..., q, :], a * ends[0] + b * ends[1] + c * ends[2], atol=1e-15)
