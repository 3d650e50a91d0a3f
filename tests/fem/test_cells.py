"""The mesh as arrays, against DOLFINx's own geometry, cell by cell."""

import numpy as np
import pytest
from dolfinx.mesh import entities_to_geometry
from helpers import SQUARE

from signorini_cr.fem.cells import Cells
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
