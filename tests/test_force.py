"""Flows through parts, corrected by a dual solution: orders, and intervals that hold."""

from functools import lru_cache

import numpy as np
import pytest
import ufl
from dolfinx import fem
from helpers import SQUARE, on_the_square, orders, widths_of
from mpi4py import MPI

from signorini_cr import (
    Contact,
    Dirichlet,
    Neumann,
    Polygon,
    Problem,
    Robin,
    force,
    solve_levels,
)
from signorini_cr.dual import certified
from signorini_cr.estimate.force import of_bumps
from signorini_cr.mesh.families import structured

pytestmark = pytest.mark.slow


BESIDE = {"left": Neumann(), "right": Neumann()}

WEIGHTS = {
    "x": (lambda x: x[0], 1 / 2),
    "x(1-x)": (lambda x: x[0] * (1 - x[0]), 1 / 6),
    "sin2": (lambda x: ufl.sin(np.pi * x[0]) ** 2, 1 / 2),
}
"""With their means on the floor and on top."""


def widths(solutions, *parts, weight=None, inside=None):
    """Of the intervals of what flows through parts."""
    found = [force.flux(solution, *parts, weight=weight) for solution in solutions]
    assert all(abs(value - lower) < 1.0 for value, lower, _ in found)
    return widths_of([each[1:] for each in found], inside)


@pytest.mark.parametrize("part", ["floor", "top"])
def test_fluxes_of_a_linear_problem(part):
    """No part is in contact: h²."""
    around = {"left": Neumann(), "right": Neumann()}
    ends = {"floor": Dirichlet(0.0), "top": Dirichlet(1.0)}
    found = widths(on_the_square(Problem(f=5.0, reaction=4.0, conditions=ends | around)), part)
    assert (abs(orders(found) - 2.0) < 0.2).all() and found[-1] < 2e-2


def test_fluxes_beside_a_loss_of_heat():
    """Both solutions are like r² log r where parts meet: almost h²."""
    around = {"left": Neumann(), "right": Robin(1.0, coefficient=3.0, external=0.5)}
    ends = {"floor": Dirichlet(0.0), "top": Dirichlet(1.0)}
    found = widths(on_the_square(Problem(f=5.0, reaction=2.0, conditions=ends | around)), "top")
    assert (orders(found) > 1.5).all() and (np.diff(orders(found)) > 0.0).all()


def test_u_is_set_all_round():
    """No part has a natural condition; what flows in is what f brings out. h^4/3 at the corners."""
    hole = Polygon([[1, 1], [2, 1], [2, 2], [1, 2]], ("in",) * 4, names=("in",))
    around = [[0, 0], [3, 0], [3, 3], [0, 3]]
    polygon = Polygon(around, ("out",) * 4, holes=(hole,), names=("out", "in"))
    conditions = {"out": Dirichlet(0.0), "in": Dirichlet(1.0)}
    found = []
    problem = Problem(f=1.0, conditions=conditions)
    for solution in solve_levels(problem, polygon.mesh(0.5, MPI.COMM_WORLD), 3):
        inner, outer = (force.flux(solution, part) for part in ("in", "out"))
        assert inner.lower + outer.lower <= -8.0 <= inner.upper + outer.upper
        found.append(inner.upper - inner.lower)
    assert (orders(np.array(found)) > 1.25).all()


def test_a_linear_flux_is_known_to_rounding():
    """u is affine."""
    conditions = {"floor": Dirichlet(0.0), "top": Dirichlet(1.0), "left": Neumann()}
    problem = Problem(conditions=conditions | {"right": Neumann()})
    found = widths(on_the_square(problem), "top", inside=1.0)
    assert (found < 1e-6).all()


@lru_cache(maxsize=2)
def layers(floor, levels, size):
    """Solve for a u that varies along y, once for all parts and weights.

    u = ± (5 y² − 6 y) with λ = ± 6; or −u'' + 9 u = 1 with u'(0) = 0 and u(1) = 1.

    Returns:
        The solutions, and what flows through floor and top.
    """
    if floor == "nowhere":
        sides = {"floor": Contact(-3.0), "top": Dirichlet(1.0)} | BESIDE
        problem = Problem(f=1.0, reaction=9.0, conditions=sides)
        flows = {"floor": 0.0, "top": 8 / 3 * np.tanh(3.0)}
    else:
        sign = -1.0 if floor == "above" else 1.0
        below = Contact(upper=0.0) if sign < 0 else Contact(coefficient=5.0 * (floor == "lossy"))
        sides = {"floor": below, "top": Dirichlet(-sign)} | BESIDE
        problem = Problem(f=-10.0 * sign, conditions=sides)
        flows = {"floor": 6.0 * sign, "top": 4.0 * sign}
    return on_the_square(problem, levels, size), flows


@pytest.mark.parametrize("part", ["floor", "top"])
def test_contact_that_never_comes_about(part):
    """λ is at most what the gap leaves over the distance: h²."""
    solutions, flows = layers("nowhere", 4, 0.25)
    found = widths(solutions, part, inside=flows[part])
    assert (abs(orders(found) - 2.0) < 0.2).all()


@pytest.mark.parametrize("floor", ["below", "lossy"])
@pytest.mark.parametrize("part", ["floor", "top"])
def test_contact_all_along(part, floor):
    """u − α is at most what the gap leaves over λ: h²."""
    solutions, flows = layers(floor, 4, 0.25)
    found = widths(solutions, part, inside=flows[part])
    assert (abs(orders(found) - 2.0) < 0.2).all()


@pytest.mark.parametrize("touching", [False, True])
def test_where_all_data_vary_within_cells(touching):
    """κ, c and b are waves; u = sin(2x + y) + x, and h² as with numbers."""

    def phases(x):
        return 2.0 * x[0] + x[1], 3.0 * x[0] - x[1]

    def u(x):
        return ufl.sin(phases(x)[0]) + x[0]

    def kappa(x):
        return 2.0 + ufl.sin(phases(x)[1])

    def c(x):
        return 1.0 + x[0] * x[1]

    def b(x):
        return 1.0 + x[0] ** 2

    def load(x):
        p, q = phases(x)
        rise = ufl.cos(q) * (3.0 * (2.0 * ufl.cos(p) + 1.0) - ufl.cos(p))
        return 5.0 * kappa(x) * ufl.sin(p) - rise + c(x) * u(x)

    def along(x):
        return kappa(x) * (2.0 * ufl.cos(phases(x)[0]) + 1.0)

    pressure, room = (0.7, 0.0) if touching else (0.0, 1.0)

    def known(x):
        return -kappa(x) * ufl.cos(phases(x)[0]) + b(x) * (u(x) - 0.5) - pressure

    floor = Contact(lambda x: u(x) - room, g=known, coefficient=b, external=0.5)
    sides = {"floor": floor, "top": Dirichlet(u), "right": Neumann(along)}
    sides["left"] = Neumann(lambda x: -along(x))
    solutions = on_the_square(Problem(f=load, coefficient=kappa, reaction=c, conditions=sides))
    t, weights = np.polynomial.legendre.leggauss(20)
    x = 0.5 + 0.5 * t
    top = 0.5 * weights @ ((2.0 + np.sin(3.0 * x - 1.0)) * np.cos(2.0 * x + 1.0))
    for part, exact in (("floor", pressure), ("top", top)):
        found = widths(solutions, part, inside=exact)
        assert (orders(found) > 1.7).all() and found[-1] < 0.02
    top = 0.5 * weights @ (x * (2.0 + np.sin(3.0 * x - 1.0)) * np.cos(2.0 * x + 1.0))
    for part, exact in (("floor", pressure / 2), ("top", top)):
        found = widths(solutions, part, inside=exact, weight=WEIGHTS["x"][0])
        assert orders(found)[-1] > 1.8 and found[-1] < 0.03


@pytest.mark.slow
def test_contact_that_begins_somewhere():
    """h: nothing is corrected."""
    conditions = {"floor": Contact(0.0), "top": Dirichlet(0.0), "left": Neumann()}
    load = lambda x: ufl.conditional(ufl.lt(x[0], 0.5), -8.0, 8.0)  # noqa: E731
    solutions = on_the_square(Problem(f=load, conditions=conditions | {"right": Neumann()}), 3)
    found = widths(solutions, "floor")
    assert (orders(found) < 1.7).all()
    for weight, _ in WEIGHTS.values():
        found = widths(solutions, "floor", weight=weight)
        assert (orders(found) > 0.5).all() and (orders(found) < 1.7).all()


def test_a_part_without_contact_beside_one_where_contact_begins():
    """What is known of one part does not hang on the other: h², and h there."""
    sides = {"floor": Contact(-9.0), "top": Contact(0.0)} | {"left": Neumann(), "right": Neumann()}
    solutions = on_the_square(Problem(f=lambda x: 2.0 - 4.0 * x[0], reaction=2.0, conditions=sides))
    found = widths(solutions, "floor", inside=0.0)
    assert (orders(found) > 1.5).all()
    first = widths(solutions[:3], "top")
    assert (abs(orders(first) - 1.0) < 0.5).all()


@pytest.mark.parametrize("weight, mean", WEIGHTS.values(), ids=WEIGHTS)
@pytest.mark.parametrize("part", ["floor", "top"])
@pytest.mark.parametrize("floor", ["below", "above", "lossy", "nowhere"])
def test_weights_are_as_good_as_none(part, floor, weight, mean):
    """h² where contact is everywhere or nowhere; a flux is the same all along its part."""
    solutions, flows = layers(floor, 3, 0.125)
    found = widths(solutions, part, inside=flows[part] * mean, weight=weight)
    assert (orders(found) > 1.7).all()


def test_a_weight_on_a_part_in_contact_and_one_without():
    """It goes on from the floor, with λ = 6, to where there is no contact, and need not vanish."""
    sides = {"floor": Contact(0.0), "right": Contact(upper=9.0)}
    problem = Problem(f=-10.0, conditions=sides | {"top": Dirichlet(-1.0), "left": Neumann()})

    def weight(x):
        return (1.0 - x[1]) * (1.0 + x[0])

    solutions = on_the_square(problem, 3, 0.125)
    found = widths(solutions, "floor", "right", inside=9.0, weight=weight)
    assert (orders(found) > 1.7).all()
    found = widths(solutions, "right", inside=0.0, weight=lambda x: x[1] * (1.0 - x[1]))
    assert (orders(found) > 1.7).all()


@pytest.mark.parametrize("tilted", [False, True])
def test_what_bumps_of_a_dual_solution_cost(tilted):
    """‖Aβ‖² by the assembled forms; of a tensor it is no less."""
    problem = Problem(f=-10.0, conditions={"floor": Contact(0.0), "top": Dirichlet(-1.0)} | BESIDE)
    (solution,) = solve_levels(problem, SQUARE.mesh(0.25, MPI.COMM_WORLD), 1)
    kappa = [[3.0, 1.0], [1.0, 2.0]] if tilted else [[2.0, 0.0], [0.0, 2.0]]
    wave = Dirichlet(lambda x: ufl.sin(5.0 * x[0]))
    dual = Problem(
        f=0.0,
        coefficient=lambda x: ufl.as_matrix(kappa) if tilted else 2.0,
        reaction=3.0,
        conditions={"floor": wave, "top": Dirichlet(0.0)} | BESIDE,
    )
    certificate = certified(dual, solution.level)
    beta = certificate.companion
    P1 = fem.Function(fem.functionspace(beta.function_space.mesh, ("Lagrange", 1)))
    P1.interpolate(beta)
    beta = beta - P1
    flow = ufl.dot(ufl.as_matrix(kappa), ufl.grad(beta))
    form = fem.form((ufl.inner(flow, ufl.grad(beta)) + 3.0 * beta**2) * ufl.dx)
    exact = MPI.COMM_WORLD.allreduce(fem.assemble_scalar(form))
    made = certificate.made
    found = MPI.COMM_WORLD.allreduce(of_bumps(made, made.cells()))
    assert exact > 1e-3
    assert exact < found < 4.0 * exact if tilted else found == pytest.approx(exact)


@pytest.mark.parametrize("top", [0.0, 0.3])
def test_a_weight_that_vanishes_at_all_vertices(top):
    """Of ω nothing is in P1: what it has beyond makes all of the interval, which is no shorter.

    u = (y² − y)/2 + top y with λ = ½ − top on the floor.
    """
    walls = {"left": Neumann(), "right": Neumann(), "top": Dirichlet(top)}
    problem = Problem(f=-1.0, conditions=walls | {"floor": Contact(0.0)})
    domain = structured(SQUARE, 4, comm=MPI.COMM_WORLD)
    (solution,) = solve_levels(problem, domain, 1)
    for part, flow in (("floor", 0.5 - top), ("top", 0.5 + top)):
        wave = force.flux(solution, part, weight=lambda x: ufl.sin(4.0 * np.pi * x[0]) ** 2)
        assert wave.lower < flow / 2 < wave.upper
        error = solution.certificate.bound_h1
        assert 0.1 * error < wave.upper - wave.lower < 10.0 * error
