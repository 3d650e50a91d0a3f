"""Heat losses that vary within facets: bounds and brackets against solutions in closed form."""

from dataclasses import replace

import numpy as np
import pytest
import ufl
from dolfinx import fem
from helpers import SIDES, SQUARE
from mpi4py import MPI

from signorini_cr import (
    Contact,
    Dirichlet,
    InputError,
    Neumann,
    Problem,
    Robin,
    solve,
    solve_levels,
)
from signorini_cr.estimate.certificate import certify

pytestmark = pytest.mark.slow

KAPPA = 1.5


def u(x):
    return ufl.sin(2 * x[0] + 0.3) * ufl.cos(1.5 * x[1]) + 0.2 * x[0] - 0.4 * x[1]


def external(x):
    return 0.3 - x[0] * x[1]


def slope(x):
    """∂u/∂x₁ by hand: −1 times that is the flux through the floor."""
    return -1.5 * ufl.sin(2 * x[0] + 0.3) * ufl.sin(1.5 * x[1]) - 0.4


LOSSES = {
    "affine": lambda s: 1 + s,
    "down to 0": lambda s: 30 * (1 - s),
    "wave": lambda s: 100 * (1.1 + ufl.sin(9 * s)),
    "large": lambda s: 1e4 * (1 + s),
}
FLOORS = {
    # α, and λ: one of them is u, or 0
    "no contact": (lambda x: -9.0 + 0 * x[0], lambda x: 0 * x[0]),
    "contact": (u, lambda x: 2 + x[0]),
    "both": (
        lambda x: u(x) - 3 * ufl.max_value(x[0] - 0.4, 0.0) ** 2,
        lambda x: 5 * ufl.max_value(0.4 - x[0], 0.0),
    ),
}


def problem(loss, floor="no contact", c=0.0):
    """Loss through the floor and the right side; what else there is follows from u."""
    alpha, pressure = FLOORS[floor]

    def at_floor(x):
        """κ∂ₙu + b (u − u_ext) − λ."""
        return -KAPPA * slope(x) + loss(x[0]) * (u(x) - external(x)) - pressure(x)

    conditions = {
        "floor": Contact(alpha, coefficient=lambda x: loss(x[0]), external=external, g=at_floor),
        "right": Robin(coefficient=lambda x: loss(x[1]), external=external),
        "top": Dirichlet(),
        "left": Neumann(),
    }
    return Problem(exact=u, coefficient=KAPPA, reaction=c, conditions=conditions)


class Reference:
    """Integrals of u and of u − w for a w on a mesh, by a rule of high degree."""

    def __init__(self, domain, loss, floor="no contact", c=0.0):
        self.mesh = domain.mesh
        rule = {"quadrature_degree": 16}
        ds = ufl.ds(domain.mesh, subdomain_data=domain.tags, metadata=rule)
        self.dx = ufl.dx(domain.mesh, metadata=rule)
        self.sides = {part: ds(domain.parts[part]) for part in SIDES}
        x = self.x = ufl.SpatialCoordinate(domain.mesh)
        self.losses = {"floor": loss(x[0]), "right": loss(x[1])}
        self.pressure, self.c = FLOORS[floor][1](x), c(x) if callable(c) else c

    def total(self, form):
        return self.mesh.comm.allreduce(fem.assemble_scalar(fem.form(form)))

    def error(self, w):
        """u − w in the norm of the energy."""
        e = u(self.x) - w
        inside = KAPPA * ufl.inner(ufl.grad(e), ufl.grad(e)) + self.c * e**2
        edge = sum(b * e**2 * self.sides[part] for part, b in self.losses.items())
        return np.sqrt(self.total(inside * self.dx + edge))

    def energy(self):
        """J(u)."""
        v, n = u(self.x), ufl.FacetNormal(self.mesh)
        f = -KAPPA * ufl.div(ufl.grad(v)) + self.c * v
        inside = 0.5 * KAPPA * ufl.inner(ufl.grad(v), ufl.grad(v)) + 0.5 * self.c * v**2 - f * v
        through = KAPPA * ufl.inner(ufl.grad(v), n)
        # ½ b u² − (g + b u_ext) u
        edge = -through * v * self.sides["left"]
        for part, b in self.losses.items():
            edge += (-through * v - 0.5 * b * v**2) * self.sides[part]
        # the pressure by itself: what it stands beside need not be compiled for each
        pressed = self.total(self.pressure * v * self.sides["floor"])
        return self.total(inside * self.dx + edge) + pressed


@pytest.mark.parametrize("floor", FLOORS)
@pytest.mark.parametrize("name", LOSSES)
def test_bound_and_bracket(name, floor):
    loss, ratios, brackets = LOSSES[name], [], []
    for solution in solve_levels(problem(loss, floor), SQUARE.mesh(0.2, MPI.COMM_WORLD), 3):
        certificate, known = solution.certificate, Reference(solution.domain, loss, floor)
        error = known.error(solution.u)
        assert certificate.bound_energy_norm >= error
        ratios.append(certificate.bound_energy_norm / error)
        brackets.append(certificate.energy)
    energy = known.energy()
    assert all(low <= energy <= high for low, high in brackets)
    assert max(ratios[1:]) < 1.3


@pytest.mark.parametrize("size", [50.0, 1e5])
@pytest.mark.parametrize("name", ["wave", "large"])
def test_with_a_reaction_that_varies(name, size):
    """With a large c y gives b more than what g has beyond its mean."""
    loss, c = LOSSES[name], lambda x: size * (1 + x[0] * x[1])
    posed, brackets = problem(loss, "both", c), []
    for solution in solve_levels(posed, SQUARE.mesh(0.2, MPI.COMM_WORLD), 2):
        certificate, known = solution.certificate, Reference(solution.domain, loss, "both", c)
        error = known.error(solution.u)
        assert error <= certificate.bound_energy_norm < 1.3 * error
        brackets.append(certificate.energy)
    energy = known.energy()
    assert all(low <= energy <= high for low, high in brackets)


@pytest.mark.parametrize("c", [0.0, 30.0])
@pytest.mark.parametrize("floor", FLOORS)
def test_what_a_rule_misses_is_taken_up_by_a_strong_loss(floor, c):
    """By few cells b u_ext is integrated badly: that is no flux which u has to make up for."""

    def loss(_):
        return 1e9

    rough, brackets = replace(problem(loss, floor, c), quadrature_degree=2), []
    for solution in solve_levels(rough, SQUARE.mesh(0.9), 3):
        known, certificate = Reference(solution.domain, loss, floor, c), solution.certificate
        error = known.error(solution.u)
        assert error <= certificate.bound_energy_norm < 1.5 * error
        brackets.append(certificate.energy)
    energy = known.energy()
    assert all(low <= energy <= high for low, high in brackets)


@pytest.mark.parametrize("scale", [1.0, 1.05])
@pytest.mark.parametrize("name", LOSSES)
def test_a_conforming_function_with_the_flux_of_the_other_element(name, scale):
    """Its own values are in b u_h, be it the P1 solution or near it.

    Where b is large v = u_h is not drawn to t/b, no more than with a number for b.
    """
    loss, domain = LOSSES[name], SQUARE.mesh(0.1, MPI.COMM_WORLD)
    conforming = solve(problem(loss), domain, "P1")
    conforming.u.x.array[:] *= scale
    certificate = certify(conforming, flux_from=solve(problem(loss), domain))
    known = Reference(domain, loss)
    error = known.error(conforming.u)
    assert error <= certificate.bound_energy_norm
    if scale == 1.0:
        assert certificate.bound_energy_norm <= (3.5 if name == "large" else 1.5) * error
    low, high = certificate.energy
    assert low <= known.energy() <= high


def test_a_jump_inside_facets():
    """b = 1 up to 0.43, 50 from there on: only pieces around the jump know little of it."""
    loss = lambda s: ufl.conditional(s < 0.43, 1.0, 50.0)  # noqa: E731
    for solution in solve_levels(problem(loss), SQUARE.mesh(0.2, MPI.COMM_WORLD), 3):
        e = u(ufl.SpatialCoordinate(solution.domain.mesh)) - solution.u
        known = Reference(solution.domain, loss)
        gradient = KAPPA * ufl.inner(ufl.grad(e), ufl.grad(e))
        error = np.sqrt(known.total(gradient * known.dx))
        assert error <= solution.certificate.bound_energy_norm
    assert solution.certificate.bound_energy_norm < 1.3 * error


@pytest.mark.parametrize("b", [5.0, 1e5])
def test_a_constant_that_is_not_seen_to_be_one(b):
    """cos² + sin² is 1: the bound is that of the number but for what enclosures cost."""
    bounds = []
    for loss in (b, lambda x: b * (ufl.cos(x[0] + x[1]) ** 2 + ufl.sin(x[0] + x[1]) ** 2)):
        conditions = problem(LOSSES["affine"]).conditions | {
            "floor": Contact(lambda x: ufl.sin(5 * x[0]) / 5, coefficient=loss, external=external),
            "right": Robin(coefficient=loss),
        }
        posed = Problem(exact=u, coefficient=KAPPA, conditions=conditions)
        bounds.append(solve(posed, SQUARE.mesh(0.1, MPI.COMM_WORLD)).certificate.bound_energy_norm)
    assert np.isclose(*bounds, rtol=0.03)


def test_a_loss_that_is_a_constant_or_a_function():
    """Where b is strong δ is what v lacks, whatever b is written as."""
    domain = SQUARE.mesh(0.15, MPI.COMM_WORLD)
    constant = fem.Constant(domain.mesh, 3e4)
    bounds = []
    for b in (3e4, constant):
        floor = Contact(lambda x: ufl.sin(9 * x[0]) / 5, coefficient=b, external=external)
        conditions = problem(LOSSES["affine"]).conditions | {"floor": floor, "right": Neumann()}
        posed = Problem(exact=u, coefficient=KAPPA, conditions=conditions)
        bounds.append(solve(posed, domain).certificate.bound_energy_norm)
    assert np.isclose(*bounds, rtol=1e-9)


@pytest.mark.parametrize("varies", [False, True])
def test_the_companion_is_above_an_obstacle_that_is_a_number(varies):
    """So u_ext may be below it, however strong the loss; brackets on all meshes have J(u)."""
    loss = (lambda x: 2.3e5 * (1 + x[0])) if varies else 2.3e5
    floor = Contact(0.0, coefficient=loss, external=lambda x: ufl.sin(13 * x[0] + 2))
    conditions = {"floor": floor, "right": Neumann(), "top": Dirichlet(0.0), "left": Neumann()}
    brackets = []
    posed = Problem(f=-2.0, conditions=conditions)
    for solution in solve_levels(posed, SQUARE.mesh(0.3, MPI.COMM_WORLD), 4):
        v, domain = solution.certificate.companion, solution.domain
        below = ufl.min_value(v, 0.0) ** 2
        rule = {"quadrature_degree": 16}
        ds = ufl.ds(domain.mesh, subdomain_data=domain.tags, metadata=rule)
        form = fem.form(below * ds(domain.parts["floor"]))
        assert domain.mesh.comm.allreduce(fem.assemble_scalar(form)) < 1e-20
        brackets.append(solution.certificate.energy)
    assert max(low for low, _ in brackets) <= min(high for _, high in brackets)


def test_without_a_place_where_u_is_held():
    """What is left of the equation leaves through the parts with a b, by its lower bound."""
    loss = LOSSES["affine"]
    conditions = problem(loss).conditions | {"top": Neumann()}
    posed = Problem(exact=u, coefficient=KAPPA, conditions=conditions)
    for solution in solve_levels(posed, SQUARE.mesh(0.2, MPI.COMM_WORLD), 2):
        error = Reference(solution.domain, loss).error(solution.u)
        assert error <= solution.certificate.bound_energy_norm < 1.2 * error


@pytest.mark.parametrize("floor", FLOORS)
def test_means_and_fluxes_hold(floor):
    loss = LOSSES["wave"]
    solution = solve(problem(loss, floor), SQUARE.mesh(0.1, MPI.COMM_WORLD))
    known = Reference(solution.domain, loss, floor)
    one = 1.0 + 0.0 * known.x[0]
    for where, measure in ((None, known.dx), ("right", known.sides["right"])):
        _, lower, upper = solution.mean(where)
        exact = known.total(u(known.x) * measure) / known.total(one * measure)
        assert lower <= exact <= upper and upper - lower < 0.2
    through = {"floor": known.pressure, "top": KAPPA * u(known.x).dx(1)}
    for part, density in through.items():
        _, lower, upper = solution.flux(part)
        assert lower <= known.total(density * known.sides[part]) <= upper
        assert upper - lower < 1.0


def test_reasons():
    domain = SQUARE.mesh(0.3, MPI.COMM_WORLD)
    conditions = problem(LOSSES["affine"]).conditions
    unknown = "right: its coefficient is not known to be bounded, and 0 or more, on each facet"
    for b in (lambda x: 2 + ufl.bessel_J(0, x[1]), lambda x: ufl.sin(40 * x[1]) ** 4 - 1e-6):
        posed = Problem(f=1.0, conditions=conditions | {"right": Robin(coefficient=b)})
        certificate = solve(posed, domain).certificate
        assert certificate.bound_h1 is None and certificate.reason == unknown
    posed = Problem(f=1.0, conditions=conditions | {"right": Robin(coefficient=lambda x: -x[1])})
    with pytest.raises(InputError, match="the coefficient of the part 'right'"):
        solve(posed, domain)
