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
