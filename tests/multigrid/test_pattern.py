"""Room for the matrix: what DOLFINx finds by searching."""

import numpy as np
import pytest
import ufl
from dolfinx import fem
from dolfinx.fem.petsc import assemble_matrix
from dolfinx.mesh import GhostMode, create_rectangle, create_unit_cube
from mpi4py import MPI

from signorini_cr import Polygon, exact
from signorini_cr.fem.layout import Layout
from signorini_cr.fem.space import function_space
from signorini_cr.mesh.refinement import refine
from signorini_cr.multigrid.pattern import empty_matrix

pytestmark = pytest.mark.ranks

WORLD = MPI.COMM_WORLD
TRIANGLE = Polygon([[0, 0], [1, 0], [0, 1]], ["contact", "dirichlet", "neumann"])


def rectangle(mode):
    return create_rectangle(WORLD, [[0.0, 0.0], [2.0, 1.0]], [9, 5], ghost_mode=mode)


@pytest.mark.parametrize(
    "make",
    [
        lambda: rectangle(GhostMode.none),
        lambda: rectangle(GhostMode.shared_facet),
        lambda: create_unit_cube(WORLD, 3, 4, 3, ghost_mode=GhostMode.none),
        lambda: create_unit_cube(WORLD, 3, 4, 3, ghost_mode=GhostMode.shared_facet),
        lambda: refine(exact.S1.mesh(0.3))[0].mesh,
        lambda: refine(TRIANGLE.mesh(TRIANGLE.diameter))[0].mesh,  # one rank has all
    ],
    ids=["plane", "plane, ghosts", "space", "space, ghosts", "refined", "tiny"],
)
@pytest.mark.parametrize("element", ["CR", "P1"])
def test_rows_are_those_that_a_search_finds(make, element):
    """With no room left over for CR; P1 counts what its cells share more than once."""
    mesh = make()
    V = function_space(mesh, element)
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    a = fem.form(ufl.inner(ufl.grad(u), ufl.grad(v)) * ufl.dx)
    searched = assemble_matrix(a)
    searched.assemble()
    matrix = assemble_matrix(empty_matrix(Layout.of_space(V)), a)
    matrix.assemble()
    for ours, theirs in zip(matrix.getValuesCSR()[:2], searched.getValuesCSR()[:2], strict=True):
        assert np.array_equal(ours, theirs)
    info = matrix.getInfo()
    assert info["mallocs"] == 0
    assert info["nz_unneeded"] <= {"CR": 0, "P1": 5}[element] * info["nz_used"]
    matrix.axpy(-1.0, searched)
    assert matrix.norm() <= 1e-14 * searched.norm()
    for thing in (matrix, searched):
        thing.destroy()
