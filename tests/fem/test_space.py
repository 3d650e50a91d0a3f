"""The CR space: its dofs are facet means, its vertex values those of the affine pieces."""

import numpy as np
import pytest
from dolfinx.mesh import GhostMode, create_rectangle, locate_entities_boundary
from mpi4py import MPI

from signorini_cr.compat import cell_nodes
from signorini_cr.errors import InputError
from signorini_cr.fem.fields import discontinuous
from signorini_cr.fem.space import (
    closure_dofs,
    facet_measures,
    facet_to_dof,
    function_space,
    vertex_values,
)
from signorini_cr.mesh.domain import facet_entities


@pytest.fixture(params=[GhostMode.none, GhostMode.shared_facet], ids=lambda mode: mode.name)
def mesh(request):
    return create_rectangle(
        MPI.COMM_WORLD, [[-1.0, 0.0], [1.0, 1.0]], [7, 5], ghost_mode=request.param
    )


def bottom(mesh):
    return locate_entities_boundary(mesh, 1, lambda x: np.isclose(x[1], 0.0))


@pytest.mark.parametrize("element", ["CR", "P1"])
def test_vertex_values_of_an_affine_function_are_its_own(mesh, element):
    from dolfinx.fem import Function

    u = Function(function_space(mesh, element))
    u.interpolate(lambda x: 2.0 - 3.0 * x[0] + 5.0 * x[1])
    x = mesh.geometry.x[cell_nodes(mesh)]
    assert np.allclose(vertex_values(u), 2.0 - 3.0 * x[..., 0] + 5.0 * x[..., 1], atol=1e-13)


def test_a_function_of_two_components_is_not_drawn_as_one(mesh):
    from dolfinx.fem import Function, functionspace

    u = Function(functionspace(mesh, ("CR", 1, (2,))), name="shift")
    for of in (vertex_values, discontinuous):
        with pytest.raises(InputError, match=r"shift has 2 components.*u\.sub\(0\)\.collapse"):
            of(u)
    u.interpolate(lambda x: (x[0], x[1]))
    y = mesh.geometry.x[cell_nodes(mesh)][..., 1]
    assert np.allclose(vertex_values(u.sub(1).collapse()), y, atol=1e-13)


def test_facet_dof_sits_at_the_midpoint(mesh):
    V = function_space(mesh)
    facets = bottom(mesh)
    vertices, _ = facet_measures(mesh, facets)
    points = V.tabulate_dof_coordinates()
    assert np.allclose(points[facet_to_dof(V)[facets]], vertices.mean(axis=1))
    assert np.array_equal(closure_dofs(V, facets)[:, 0], facet_to_dof(V)[facets])


def test_measures_add_up_to_the_side(mesh):
    fdim = mesh.topology.dim - 1
    facets = bottom(mesh)
    facets = facets[facets < mesh.topology.index_map(fdim).size_local]
    _, measure = facet_measures(mesh, facets)
    assert np.isclose(mesh.comm.allreduce(measure.sum()), 2.0)


def test_facet_entities_name_the_facet_within_its_cell(mesh):
    facets = bottom(mesh)
    cells, local = facet_entities(mesh, facets).T
    c2f = mesh.topology.connectivity(2, 1).array.reshape(-1, 3)
    assert np.array_equal(c2f[cells, local], facets)


def test_p1_closure_are_the_vertices_of_the_facet(mesh):
    V = function_space(mesh, "P1")
    facets = bottom(mesh)
    vertices, _ = facet_measures(mesh, facets)
    assert np.allclose(V.tabulate_dof_coordinates()[closure_dofs(V, facets)], vertices)


def test_unknown_element_is_named(mesh):
    with pytest.raises(InputError, match=r"'P7' is unknown; allowed: CR, P1"):
        function_space(mesh, "P7")
