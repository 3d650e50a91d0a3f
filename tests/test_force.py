"""What flows through parts, corrected by a dual solution: orders, and intervals that hold."""

import numpy as np
import pytest
import ufl
from helpers import SQUARE
from mpi4py import MPI

from signorini_cr import Contact, Dirichlet, Neumann, Polygon, Problem, Robin, force, solve_levels
from signorini_cr.mesh.families import structured

pytestmark = pytest.mark.slow


def widths(problem, *parts, levels=4, inside=None):
    """Widths of the intervals on four meshes, each twice as fine as the one before."""
    found = []
    for solution in solve_levels(problem, SQUARE.mesh(0.25, MPI.COMM_WORLD), levels):
        value, lower, upper = force.flux(solution, *parts)
        assert inside is None or lower <= inside <= upper
        assert lower <= upper and abs(value - lower) < 1.0
        found.append(upper - lower)
    return np.array(found)


def orders(found):
    return np.log2(found[:-1] / found[1:])


@pytest.mark.parametrize("part", ["floor", "top"])
def test_fluxes_of_a_linear_problem(part):
    """No part is in contact: h²."""
    around = {"left": Neumann(), "right": Neumann()}
    ends = {"floor": Dirichlet(0.0), "top": Dirichlet(1.0)}
    found = widths(Problem(f=5.0, reaction=4.0, conditions=ends | around), part)
    assert (abs(orders(found) - 2.0) < 0.2).all() and found[-1] < 2e-2


def test_fluxes_beside_a_loss_of_heat():
    """Both solutions are like r² log r where parts meet: almost h²."""
    around = {"left": Neumann(), "right": Robin(1.0, coefficient=3.0, external=0.5)}
    ends = {"floor": Dirichlet(0.0), "top": Dirichlet(1.0)}
    found = widths(Problem(f=5.0, reaction=2.0, conditions=ends | around), "top")
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
    found = widths(Problem(conditions=conditions | {"right": Neumann()}), "top", inside=1.0)
    assert (found < 1e-6).all()


@pytest.mark.parametrize("part", ["floor", "top"])
def test_contact_that_never_comes_about(part):
    """λ is at most what the gap leaves over the distance: h²."""
    conditions = {"floor": Contact(-3.0), "top": Dirichlet(1.0), "left": Neumann()}
    found = widths(Problem(f=1.0, reaction=9.0, conditions=conditions | {"right": Neumann()}), part)
    assert (abs(orders(found) - 2.0) < 0.2).all()


@pytest.mark.parametrize("loss", [0.0, 5.0])
@pytest.mark.parametrize("part", ["floor", "top"])
def test_contact_all_along(part, loss):
    """u − α is at most what the gap leaves over λ: h². u = 5 y² − 6 y and λ = 6 with f = −10."""
    floor = Contact(0.0, coefficient=loss)
    conditions = {"floor": floor, "top": Dirichlet(-1.0), "left": Neumann(), "right": Neumann()}
    exact = 6.0 if part == "floor" else 4.0
    found = widths(Problem(f=-10.0, conditions=conditions), part, inside=exact)
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
    problem = Problem(f=load, coefficient=kappa, reaction=c, conditions=sides)
    t, weights = np.polynomial.legendre.leggauss(20)
    x = 0.5 + 0.5 * t
    top = 0.5 * weights @ ((2.0 + np.sin(3.0 * x - 1.0)) * np.cos(2.0 * x + 1.0))
    for part, exact in (("floor", pressure), ("top", top)):
        found = widths(problem, part, inside=exact)
        assert (orders(found) > 1.7).all() and found[-1] < 0.02


@pytest.mark.slow
def test_contact_that_begins_somewhere():
    """h: nothing is corrected."""
    conditions = {"floor": Contact(0.0), "top": Dirichlet(0.0), "left": Neumann()}
    load = lambda x: ufl.conditional(ufl.lt(x[0], 0.5), -8.0, 8.0)  # noqa: E731
    found = widths(Problem(f=load, conditions=conditions | {"right": Neumann()}), "floor", levels=3)
    assert (orders(found) < 1.7).all()


def test_a_part_without_contact_beside_one_where_contact_begins():
    """What is known of one part does not hang on the other: h², and h there."""
    sides = {"floor": Contact(-9.0), "top": Contact(0.0)} | {"left": Neumann(), "right": Neumann()}
    problem = Problem(f=lambda x: 2.0 - 4.0 * x[0], reaction=2.0, conditions=sides)
    found = widths(problem, "floor", inside=0.0)
    assert (orders(found) > 1.5).all()
    first = widths(problem, "top", levels=3)
    assert (abs(orders(first) - 1.0) < 0.5).all()


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
