"""Conditions say what they add: one more kind is solved right; data are sampled once a mesh."""

from dataclasses import dataclass

import numpy as np
import pytest
import ufl

from signorini_cr import Polygon, Problem, compat, exact, solve, solve_levels
from signorini_cr.diffusion import Diffusion
from signorini_cr.fem.conditions import Condition
from signorini_cr.fem.space import ghosted_vector
from signorini_cr.multigrid.hierarchy import NestedMesh, conforming
from signorini_cr.multigrid.parents import Layout
from signorini_cr.multigrid.transfer import inclusion
from signorini_cr.vi.level import Level

SQUARE = [[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]]
PARTS = ("contact", "neumann", "dirichlet", "dirichlet")


@dataclass(frozen=True, eq=False)
class Spring(Condition):
    """κ∂ₙu + 3 u = g."""

    g: object = 0.0
    uncertified = "there is a spring"

    @property
    def flux(self):
        return self.g

    @property
    def loss(self):
        return ufl.as_ufl(3.0)


def u(x):
    return ufl.sin(2.0 * x[0] + 1.0) * ufl.cosh(x[1]) + 1.0


SPRUNG = Problem(
    exact=u,
    obstacle=-10.0,
    conditions={"neumann": Spring(lambda x: 2.0 * ufl.cos(3.0) * ufl.cosh(x[1]) + 3.0 * u(x))},
)


@pytest.mark.parametrize("element", ["CR", "P1"])
def test_another_kind_is_solved_right(element):
    domain = Polygon(SQUARE, PARTS).mesh(0.25)
    *_, coarse, fine = solve_levels(SPRUNG, domain, 4, element)
    assert coarse.errors and fine.errors
    h1, l2 = np.log2(np.array(coarse.errors) / np.array(fine.errors))
    assert h1 == pytest.approx(1.0, abs=0.03) and l2 == pytest.approx(2.0, abs=0.1)
    assert fine.iterations.linear <= 14
    certificate = solve(SPRUNG, domain).certificate
    assert certificate.bound_h1 is None and certificate.reason == "there is a spring"


def test_terms_without_gradients_are_in_p1_and_in_the_sums_of_rows():
    domain = Polygon(SQUARE, PARTS).mesh(0.3)
    mesh = NestedMesh(Diffusion(SPRUNG, domain.mesh), domain)
    level, (operator, p1, dirichlet) = Level((mesh,)), conforming(mesh)
    product = level.system.A.ptap(inclusion(p1, Layout.of_space(level.V)).matrix())
    product.zeroRowsColumns(dirichlet + operator.matrix.getOwnershipRange()[0], 1.0)
    product.axpy(-1.0, operator.matrix)
    assert product.norm() <= 1e-12 * operator.matrix.norm()
    ones = np.ones_like(level.system.b.x.array)
    x, y = (ghosted_vector(level.V, array) for array in (ones, np.zeros_like(ones)))
    level.system.A.mult(x, y)
    assert np.allclose(level.system.row_sums(), y.array_r, atol=1e-12)
    held, fixed = (
        domain.mesh.comm.allreduce(len(dofs))
        for dofs in (level.system.held, level.system.dirichlet)
    )
    assert held > fixed


def test_boundary_data_are_sampled_once_a_mesh(monkeypatch):
    seen = []
    at = compat.FacetExpression.at

    def counted(self, mesh, entities):
        seen.append(id(self))
        return at(self, mesh, entities)

    monkeypatch.setattr(compat.FacetExpression, "at", counted)
    example = exact.S1_NEUMANN.problem
    problem = Problem(
        exact=example.exact,
        g=example.g or (lambda x: 0.0 * x[0]),
        obstacle=lambda x: 0.0 * x[0],
        dirichlet=lambda x: example.exact(x),
    )
    for solution in solve_levels(problem, exact.S1_NEUMANN.mesh(0.5), 2):
        assert solution.certificate.bound_h1 is not None
        assert len(seen) == len(set(seen)) > 1
        seen.clear()
