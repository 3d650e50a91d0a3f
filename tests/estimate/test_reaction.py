"""Reactions that vary within cells: bounds, brackets and means against solutions in closed form."""

import numpy as np
import pytest
import ufl
from dolfinx import fem
from helpers import SIDES, SQUARE
from mpi4py import MPI

from signorini_cr import (
    Contact,
    Dirichlet,
    Neumann,
    Polygon,
    Problem,
    Robin,
    families,
    solve,
    solve_levels,
)
from signorini_cr.estimate.certificate import certify

pytestmark = pytest.mark.slow


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


def energy_of_the_solution(domain, c, b):
    """J(u), from u itself."""
    x = ufl.SpatialCoordinate(domain.mesh)
    n, slope = ufl.FacetNormal(domain.mesh), ufl.grad(u(x))
    f = -1.5 * ufl.div(slope) + c * u(x)
    inside = 0.75 * ufl.inner(slope, slope) + 0.5 * c * u(x) ** 2 - f * u(x)
    ds = ufl.ds(domain.mesh, subdomain_data=domain.tags, metadata={"quadrature_degree": 10})
    right, left = (ds(domain.parts[part]) for part in ("right", "left"))
    known = 1.5 * ufl.inner(slope, n)
    edge = (0.5 * b * u(x) ** 2 - (known + b * u(x)) * u(x)) * right - known * u(x) * left
    on_edge = domain.mesh.comm.allreduce(fem.assemble_scalar(fem.form(edge)))
    return integral(domain, inside) + on_edge


REACTIONS = {
    "affine": lambda x: 1 + x[0],
    "down to 0": lambda x: 30 * x[0] ** 2,
    "wave": lambda x: 100 * (1.1 + ufl.sin(9 * x[0] * x[1])),
    "large": lambda x: 1e4 * (1 + x[0]),
}


@pytest.mark.parametrize("name", REACTIONS)
def test_bound_and_bracket(name):
    """u'(0) in y vanishes at the bottom: nothing is in contact. In the norm with c, too."""
    c, ratios, brackets = REACTIONS[name], [], []
    for solution in solve_levels(problem(c), SQUARE.mesh(0.25, MPI.COMM_WORLD), 3):
        mesh, certificate = solution.domain.mesh, solution.certificate
        x = ufl.SpatialCoordinate(mesh)
        e = u(x) - solution.u
        square = 1.5 * ufl.inner(ufl.grad(e), ufl.grad(e)) + c(x) * e**2
        with_c = integral(solution.domain, square)
        assert certificate.bound_energy_norm >= np.sqrt(with_c)
        ratios.append(certificate.bound_energy_norm / np.sqrt(with_c))
        brackets.append(certificate.energy)
    energy = energy_of_the_solution(solution.domain, c(x), fem.Constant(mesh, 2.0))
    assert all(low <= energy <= high for low, high in brackets)
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


def test_fluxes_hold():
    widths = []
    for solution in solve_levels(problem(REACTIONS["wave"]), SQUARE.mesh(0.3, MPI.COMM_WORLD), 3):
        mesh = solution.domain.mesh
        ds = ufl.ds(mesh, subdomain_data=solution.domain.tags)(solution.domain.parts["top"])
        through = 1.5 * u(ufl.SpatialCoordinate(mesh)).dx(1) * ds
        exact = mesh.comm.allreduce(fem.assemble_scalar(fem.form(through)))
        _, lower, upper = solution.flux("top")
        assert lower <= exact <= upper
        widths.append(upper - lower)
    assert 3.0 < widths[1] / widths[2] < 5.0


@pytest.mark.parametrize("scale", [1.0, 1.05, 1.5])
@pytest.mark.parametrize("b", [2.0, 1e3])
@pytest.mark.parametrize("c", [0.0, 100.0, 1e4, REACTIONS["wave"]])
def test_a_conforming_function_with_the_flux_of_the_other_element(c, b, scale):
    """Its own values are in c u_h and b u_h, be it the P1 solution or far from it."""
    conditions = problem(0.0).conditions | {"right": Robin(coefficient=b)}
    posed = Problem(exact=u, coefficient=1.5, reaction=c, conditions=conditions)
    domain = SQUARE.mesh(0.25, MPI.COMM_WORLD)
    conforming = solve(posed, domain, "P1")
    conforming.u.x.array[:] *= scale
    certificate = certify(conforming, flux_from=solve(posed, domain))
    x = ufl.SpatialCoordinate(domain.mesh)
    loss = fem.Constant(domain.mesh, b)  # one form for all numbers
    e, at = u(x) - conforming.u, c(x) if callable(c) else fem.Constant(domain.mesh, c)
    ds = ufl.ds(domain.mesh, subdomain_data=domain.tags, metadata={"quadrature_degree": 10})
    square = integral(domain, 1.5 * ufl.inner(ufl.grad(e), ufl.grad(e)) + at * e**2)
    right = fem.form(loss * e**2 * ds(domain.parts["right"]))
    square += domain.mesh.comm.allreduce(fem.assemble_scalar(right))
    assert certificate.bound_energy_norm >= np.sqrt(square)
    if scale == 1.0:
        assert certificate.bound_energy_norm <= 2.0 * np.sqrt(square)
    low, high = certificate.energy
    assert low <= energy_of_the_solution(domain, at, loss) <= high


@pytest.mark.parametrize("sides", ["both", "below"])
@pytest.mark.parametrize("size", [1e4, 1e6, 1e8])
def test_contact_that_yields_to_a_reaction_and_a_loss(size, sides):
    """On coarse meshes forces decide little: where c and b want a pull, b takes it, not y."""

    def exact(x):
        return ufl.sin(2 * x[0]) * ufl.cosh(x[1]) + x[1] * pull(x)

    def pull(x):
        # ∂u/∂y on the floor: below 0 where u = α, and above 0 where u = β
        below = -(ufl.max_value(-x[0] - 0.3, 0.0) ** 3)
        return below if sides == "below" else below + ufl.max_value(x[0] - 0.3, 0.0) ** 3

    def off(x, sign):
        return 0.5 * ufl.max_value(0.3 + sign * x[0], 0.0) ** 2

    def external(x):
        return ufl.sin(2 * x[0])

    floor = Contact(
        lambda x: external(x) - off(x, 1.0),
        upper=None if sides == "below" else lambda x: external(x) + off(x, -1.0),
        coefficient=size,
        external=external,
    )
    conditions = dict(zip(SIDES, (floor, Neumann(), Dirichlet(), Dirichlet()), strict=True))
    polygon = Polygon([[-1, 0], [1, 0], [1, 1], [-1, 1]], SIDES, names=SIDES)
    mesh = families.structured(polygon, 2, MPI.COMM_WORLD)
    for solution in solve_levels(
        Problem(exact=exact, reaction=size, conditions=conditions), mesh, 4
    ):
        domain = solution.domain
        off_by = exact(ufl.SpatialCoordinate(domain.mesh)) - solution.u
        slopes = ufl.grad(off_by)
        ds = ufl.ds(domain.mesh, subdomain_data=domain.tags, metadata={"quadrature_degree": 10})
        weight = fem.Constant(domain.mesh, size)  # one form for all sizes
        on_floor = fem.assemble_scalar(fem.form(weight * off_by**2 * ds(domain.parts["floor"])))
        inside = integral(domain, ufl.inner(slopes, slopes) + weight * off_by**2)
        error = np.sqrt(inside + domain.mesh.comm.allreduce(on_floor))
        assert error <= solution.certificate.bound_energy_norm < 1.6 * error
