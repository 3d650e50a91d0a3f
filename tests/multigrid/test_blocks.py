"""Several unknowns a node: what is made for one does for each."""

from dataclasses import replace

import basix.ufl
import numpy as np
import pytest
import ufl
from dolfinx import fem
from dolfinx.fem.petsc import assemble_matrix

from signorini_cr import compat, exact
from signorini_cr.fem.layout import Layout
from signorini_cr.fem.space import function_space, ghosted_vector
from signorini_cr.mesh.refinement import refine
from signorini_cr.multigrid.parents import Parents
from signorini_cr.multigrid.pattern import empty_matrix
from signorini_cr.multigrid.smoothing import GaussSeidel
from signorini_cr.multigrid.transfer import inclusion, prolongate, prolongation


@pytest.fixture(scope="module")
def nested():
    coarse = exact.A.mesh(0.4)
    fine, parent_cell = refine(coarse)
    return coarse.mesh, fine.mesh, Parents(coarse.mesh, fine.mesh, parent_cell)


def vectors(mesh):
    return fem.functionspace(mesh, basix.ufl.element("CR", mesh.basix_cell(), 1, shape=(2,)))


def laplacian(V):
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    return ufl.inner(ufl.grad(u), ufl.grad(v)) * ufl.dx


def test_transfers_are_those_of_each_component(nested):
    coarse, fine, parents = nested
    p1, cr = Layout.of_p1(coarse), Layout.of_space(function_space(fine))
    beside = Layout.of_p1(fine)
    for make in (
        lambda block: prolongation(replace(p1, block=block), replace(cr, block=block), parents),
        lambda block: prolongation(replace(p1, block=block), replace(beside, block=block), parents),
        lambda block: inclusion(replace(beside, block=block), replace(cr, block=block)),
    ):
        scalar, vector = make(1), make(2)
        few, many = scalar.coarse_vector(), vector.coarse_vector()
        few.array[:] = np.random.default_rng(few.comm.rank).random(few.local_size)
        many.array[:] = np.column_stack([few.array, -2.0 * few.array]).ravel()
        results = [transfer.matrix().createVecLeft() for transfer in (scalar, vector)]
        scalar.add(few, results[0])
        vector.add(many, results[1])
        first, second = results[1].array.reshape(-1, 2).T
        assert np.allclose(first, results[0].array) and np.allclose(second, -2.0 * first)
        back = vector.matrix().multTranspose
        product, own = vector.coarse_vector(), vector.coarse_vector()
        back(results[1], product)
        vector.restrict(results[1], own)
        assert np.allclose(product.array, own.array)


def test_prolongation_of_a_function(nested):
    coarse, fine, parents = nested
    u, w = fem.Function(vectors(coarse)), fem.Function(function_space(coarse))
    w.interpolate(lambda x: np.sin(3.0 * x[0]) + x[1] ** 2)
    u.x.array[:] = np.column_stack([w.x.array, 3.0 * w.x.array]).ravel()
    values = prolongate(u, vectors(fine), parents).reshape(-1, 2)
    expected = prolongate(w, function_space(fine), parents)
    assert np.allclose(values[:, 0], expected) and np.allclose(values[:, 1], 3.0 * expected)


def test_matrix_of_a_vector_space(nested):
    V = vectors(nested[1])
    layout, form = Layout.of_space(V), fem.form(laplacian(V))
    assert layout.block == 2
    matrix, theirs = assemble_matrix(empty_matrix(layout), form), assemble_matrix(form)
    for each in (matrix, theirs):
        each.assemble()
    theirs.axpy(-1.0, matrix)
    assert theirs.norm() <= 1e-12 * matrix.norm()


def test_kernel_of_cr_makes_the_matrix_of_p1(nested):
    mesh = nested[1]
    V, p1 = vectors(mesh), Layout.of_p1(mesh, 2)
    W = compat.with_dofs(V, p1.cells, p1.index_map)
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    a = fem.compile_form(mesh.comm, ufl.inner(ufl.grad(u), ufl.grad(v)) * ufl.dx)
    matrix = assemble_matrix(empty_matrix(p1), fem.create_form(a, [W, W], mesh, {}, {}, {}))
    matrix.assemble()
    cr = assemble_matrix(fem.form(laplacian(V)))
    cr.assemble()
    product = cr.ptap(inclusion(p1, Layout.of_space(V)).matrix())
    product.axpy(-0.25, matrix)
    assert product.norm() <= 1e-12 * cr.norm()


def test_sweeps_over_a_vector_space_are_those_of_each_component(nested):
    """On one rank a sweep is that of each component; on several, at least as symmetric."""
    V = vectors(nested[1])
    A = assemble_matrix(fem.form(laplacian(V) + ufl.inner(*trial_and_test(V)) * ufl.dx))
    A.assemble()
    smoother = GaussSeidel(A, Layout.of_space(V), 2)
    rng = np.random.default_rng(A.comm.rank)
    b, c, x, y = (ghosted_vector(V, np.zeros(Layout.of_space(V).local)) for _ in range(4))
    b.array[:], c.array[:] = rng.random(b.local_size), rng.random(c.local_size)
    cycle = (smoother.forward, smoother.backward)
    for right, result in ((b, x), (c, y)):
        for sweep in cycle:
            sweep(right, result)
    assert x.dot(c) == pytest.approx(y.dot(b), rel=1e-10)


def trial_and_test(V):
    return ufl.TrialFunction(V), ufl.TestFunction(V)
