"""Reactions that vary within cells: bounds, brackets and means against solutions in closed form."""

import numpy as np
import pytest
import ufl
from dolfinx import fem
from mpi4py import MPI

from signorini_cr import (
    Contact,
    Dirichlet,
    InputError,
    Neumann,
    Polygon,
    Problem,
    Robin,
    solve,
    solve_levels,
)

pytestmark = pytest.mark.slow

SIDES = ("floor", "right", "top", "left")
SQUARE = Polygon([[0, 0], [1, 0], [1, 1], [0, 1]], SIDES, names=SIDES)


def u(x):
    return ufl.sin(2 * x[0] + 0.3) * ufl.cos(1.5 * x[1]) + 0.2 * x[0]


def problem(c):
    """The load is derived from u; the obstacle is out of reach, and u_ext is 0."""
    conditions = {
        "floor": Contact(-9.0, g=lambda x: 0.0 * x[0]),
        "right": Robin(coefficient=2.0),
        "top": Dirichlet(),
        "left": Neumann(),
    }
    return Problem(exact=u, coefficient=1.5, reaction=c, conditions=conditions)


def integral(domain, integrand):
    """Of a smooth function over the domain."""
    form = fem.form(integrand * ufl.dx(domain.mesh, metadata={"quadrature_degree": 10}))
    return domain.mesh.comm.allreduce(fem.assemble_scalar(form))


REACTIONS = {
    "affine": lambda x: 1 + x[0],
    "down to 0": lambda x: 30 * x[0] ** 2,
    "wave": lambda x: 100 * (1.1 + ufl.sin(9 * x[0] * x[1])),
    "large": lambda x: 1e4 * (1 + x[0]),
}


@pytest.mark.parametrize("name", REACTIONS)
def test_bound_and_bracket(name):
    """u'(0) in y vanishes at the bottom: nothing is in contact. In the norm with c, too."""
    c, ratios = REACTIONS[name], []
    for solution in solve_levels(problem(c), SQUARE.mesh(0.25, MPI.COMM_WORLD), 3):
        mesh, certificate = solution.domain.mesh, solution.certificate
        x = ufl.SpatialCoordinate(mesh)
        e = u(x) - solution.u
        square = integral(solution.domain, 1.5 * ufl.inner(ufl.grad(e), ufl.grad(e)))
        with_c = square + integral(solution.domain, c(x) * e**2)
        assert certificate.bound_energy_norm >= np.sqrt(with_c)
        ratios.append(certificate.bound_energy_norm / np.sqrt(with_c))
        low, high = certificate.energy
        slope = ufl.grad(u(x))
        f = -1.5 * ufl.div(slope) + c(x) * u(x)
        energy = integral(
            solution.domain, 0.75 * ufl.inner(slope, slope) + 0.5 * c(x) * u(x) ** 2 - f * u(x)
        )
        n, tags = ufl.FacetNormal(mesh), solution.domain.tags
        ds = ufl.ds(mesh, subdomain_data=tags, metadata={"quadrature_degree": 10})
        right, left = (ds(solution.domain.parts[part]) for part in ("right", "left"))
        known = 1.5 * ufl.inner(slope, n)
        edge = (u(x) ** 2 - (known + 2 * u(x)) * u(x)) * right - known * u(x) * left
        energy += mesh.comm.allreduce(fem.assemble_scalar(fem.form(edge)))
        assert low <= energy <= high
    assert max(ratios) < 1.3 and (name == "large" or ratios[-1] < 1.1)


def test_a_jump_inside_cells():
    """c = 1 below a slant line, 100 above: the bound knows of it, and so does the mean."""
    c = lambda x: ufl.conditional(x[0] + 0.3 * x[1] < 0.6, 1.0, 100.0)  # noqa: E731
    exact = (np.cos(0.3) - np.cos(2.3)) / 2 * np.sin(1.5) / 1.5 + 0.1
    for solution in solve_levels(problem(c), SQUARE.mesh(0.25, MPI.COMM_WORLD), 3):
        x = ufl.SpatialCoordinate(solution.domain.mesh)
        slope = ufl.grad(u(x) - solution.u)
        error = np.sqrt(integral(solution.domain, 1.5 * ufl.inner(slope, slope)))
        bound = solution.certificate.bound_energy_norm
        _, lower, upper = solution.mean()
        assert error <= bound and lower <= exact <= upper
    assert bound < 1.05 * error and upper - lower < 0.1


def test_a_constant_that_is_not_seen_to_be_one():
    """cos² + sin² is 1: the bound is that of the number but for what enclosures cost."""
    bounds = [
        solve(problem(c), SQUARE.mesh(0.15, MPI.COMM_WORLD)).certificate.bound_energy_norm
        for c in (5.0, lambda x: 5 * (ufl.cos(x[0]) ** 2 + ufl.sin(x[0]) ** 2))
    ]
    assert np.isclose(*bounds, rtol=1e-3)


def test_reasons():
    domain = SQUARE.mesh(0.3, MPI.COMM_WORLD)
    for c, words in (
        (lambda x: 2 + ufl.bessel_J(0, x[0]), "no enclosure|not known to be bounded"),
        (
            lambda x: x[0] - x[0] ** 2 + 1e-3,
            "the reaction is not known to be bounded, and 0 or more",
        ),
    ):
        given = Problem(f=1.0, reaction=c, conditions=problem(c).conditions)
        certificate = solve(given, domain).certificate
        assert certificate.bound_h1 is None
        assert any(each in str(certificate.reason) for each in words.split("|"))


def test_forces_are_refused():
    solution = solve(problem(REACTIONS["affine"]), SQUARE.mesh(0.3, MPI.COMM_WORLD))
    with pytest.raises(InputError, match="the coefficient or the reaction varies within cells"):
        solution.flux("floor")
