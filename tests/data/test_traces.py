"""Data in few cells and on boundary facets: the values of compiled code, without compiling."""

import numpy as np
import pytest
import ufl
from dolfinx import fem
from dolfinx.mesh import create_unit_cube, exterior_facet_indices
from helpers import SQUARE
from mpi4py import MPI

from signorini_cr import compat
from signorini_cr.data import quadrature
from signorini_cr.data.quadrature import Rule, Trace, Volume
from signorini_cr.fem.cells import Cells
from signorini_cr.fem.pointwise import Samples
from signorini_cr.fem.space import function_space
from signorini_cr.mesh.domain import facet_entities

FORMULAS = {
    "polynomial": lambda x: x[0] ** 3 - 2 * x[0] * x[1] + 0.1,
    "functions": lambda x: ufl.exp(x[0]) * ufl.sin(7 * x[1]) / (2 + ufl.cos(x[0])),
    "no number on the left": lambda x: ufl.sqrt(x[0] - 0.437),
    "infinite": lambda x: 1 / ufl.max_value(x[0] - 0.437, 0.0),
    "one is no number": lambda x: ufl.max_value(ufl.ln(x[0] - 0.437), x[1]),
    "choice": lambda x: ufl.conditional(x[0] < 0.37, x[1] ** 1.5, abs(x[0] - x[1])),
    "angle": lambda x: ufl.atan2(x[1] - 0.3, x[0] - 0.4),
    "derivative": lambda x: ufl.grad(ufl.sin(x[0] * x[1]))[0],
}


def affine(mesh, name, degree):
    w = fem.Function(fem.functionspace(mesh, (name, degree)))
    w.interpolate(lambda x: 2 * x[0] - x[1] + 0.5 * x[2])
    return w


OF_MESHES = {
    "normal": lambda mesh: ufl.FacetNormal(mesh)[0] - 3 * ufl.FacetNormal(mesh)[1],
    "affine": lambda mesh: affine(mesh, "Lagrange", 1) ** 2,
    "affine, with steps": lambda mesh: ufl.exp(affine(mesh, "DG", 1)),
    "steps": lambda mesh: 1 + affine(mesh, "DG", 0),
}
"""Data that depend on more than x."""


def written(name, mesh):
    if name in OF_MESHES:
        return OF_MESHES[name](mesh)
    return FORMULAS[name](ufl.SpatialCoordinate(mesh))


def traced(expression, mesh, domain, monkeypatch):
    """Values at a rule's points on all facets of the boundary, by both ways."""
    mesh.topology.create_connectivity(mesh.topology.dim - 1, mesh.topology.dim)
    entities = facet_entities(mesh, exterior_facet_indices(mesh.topology))
    compiled = compat.FacetExpression(expression, Trace(expression, mesh, 4).points, mesh)
    monkeypatch.setattr(compat, "FacetExpression", None)
    found = Trace(expression, mesh, 4).at(domain, entities)[-1]
    return found, compiled.at(mesh, entities)[:, :, 0].T


@pytest.mark.parametrize("name", [*FORMULAS, *OF_MESHES])
def test_formulas_have_the_values_of_compiled_code(name, monkeypatch):
    domain = SQUARE.mesh(0.2)
    found, known = traced(written(name, domain.mesh), domain.mesh, domain, monkeypatch)
    assert found == pytest.approx(known, rel=1e-13, abs=1e-15, nan_ok=True)


@pytest.mark.parametrize("name", sorted({*FORMULAS, *OF_MESHES} - {"normal"}))
def test_in_cells_they_have_them_too(name, monkeypatch):
    domain = SQUARE.mesh(0.2)
    cells = Cells(domain, function_space(domain.mesh, "CR"), [])
    volume = Volume(written(name, domain.mesh), domain.mesh, Rule(domain.mesh, 4))
    monkeypatch.setattr(quadrature, "FEW", 0)
    known = volume.at(cells)
    monkeypatch.undo()
    monkeypatch.setattr(compat, "bound", None)
    assert volume.at(cells) == pytest.approx(known, rel=1e-13, abs=1e-15, nan_ok=True)


class Cube:
    """The part of a domain that is asked for here."""

    def __init__(self):
        self.mesh = create_unit_cube(MPI.COMM_WORLD, 2, 3, 2)

    def own(self, function):
        return function


@pytest.mark.parametrize(
    "formula",
    [
        lambda mesh, x: x[0] + x[1] ** 2 * x[2],
        lambda mesh, x: ufl.FacetNormal(mesh)[2] + 2 * ufl.FacetNormal(mesh)[0],
        lambda mesh, x: x[0] * affine(mesh, "DG", 1),
    ],
)
def test_on_tetrahedra(formula, monkeypatch):
    cube = Cube()
    expression = formula(cube.mesh, ufl.SpatialCoordinate(cube.mesh))
    found, known = traced(expression, cube.mesh, cube, monkeypatch)
    assert found == pytest.approx(known, rel=1e-13, abs=1e-15)


def test_what_is_no_such_formula_is_compiled():
    domain = SQUARE.mesh(0.3)
    w = fem.Function(function_space(domain.mesh, "P1"))
    w.interpolate(lambda x: 2 * x[0] - x[1])
    facets = np.sort(np.concatenate(list(domain.all_facets.values())))
    entities = facet_entities(domain.mesh, facets)
    slope = Trace(ufl.dot(ufl.grad(w), ufl.FacetNormal(domain.mesh)), domain.mesh, 2)
    slopes = slope.at(domain, entities)[1]
    assert set(np.round(slopes, 12)) <= {2.0, -2.0, 1.0, -1.0}
    assert domain.mesh.comm.allreduce(float(slopes.max(initial=-9.0)), op=MPI.MAX) == pytest.approx(
        2.0
    )
    cells = Cells(domain, function_space(domain.mesh, "CR"), [])
    second = Volume(ufl.grad(w)[0], domain.mesh, Rule(domain.mesh, 2))
    assert second.at(cells) == pytest.approx(2.0)


def test_formulas_may_be_deep():
    domain = SQUARE.mesh(0.5)
    x = ufl.SpatialCoordinate(domain.mesh)
    deep = x[0]
    for _ in range(800):
        deep = deep + x[1] * 0.5**20
    cells = Cells(domain, function_space(domain.mesh, "CR"), [])
    rule = Rule(domain.mesh, 2)
    found = Samples(domain, np.arange(cells.number), rule.hats.T)
    assert found.of(deep) == pytest.approx(found.of(x[0]) + 800 * 0.5**20 * found.of(x[1]))


def test_constants_count_as_they_are_then():
    domain = SQUARE.mesh(0.5)
    t = fem.Constant(domain.mesh, 2.0)
    trace = Trace(t * ufl.SpatialCoordinate(domain.mesh)[0], domain.mesh, 2)
    entities = facet_entities(domain.mesh, domain.all_facets[domain.parts["floor"]])
    before = trace.at(domain, entities)[1]
    t.value = 6.0
    assert trace.at(domain, entities)[1] == pytest.approx(3.0 * before)
