"""Integrals with weights of one's own, between numbers that are certain, on any ranks."""

import numpy as np
import pytest
import ufl
from dolfinx.fem import Constant
from dolfinx.mesh import compute_midpoints, create_unit_cube, exterior_facet_indices, meshtags
from helpers import HELD_ABOVE, SIDES, STRIP, bar, strip
from mpi4py import MPI

from signorini_cr import (
    Contact,
    Dirichlet,
    Domain,
    InputError,
    Neumann,
    Polygon,
    Problem,
    solve,
    solve_levels,
)
from signorini_cr.force import flux, force_bounds
from signorini_cr.means import integral, mean
from signorini_cr.mesh.domain import CONTACT, DIRICHLET, NEUMANN
from signorini_cr.mesh.families import structured
from signorini_cr.quantities import Quantity

pytestmark = pytest.mark.slow


def of_bar(x):
    """u of the bar that is held at 1 below and at 0 above."""
    k = np.sqrt(1.5)
    return np.sinh(k * (1.0 - x)) / np.sinh(k)


def test_weighted_integrals_are_bracketed_in_one_dimension():
    """Weights of either sign, on all of the domain, in a material and on sides, by Gauss's rule."""
    half = {"half": [[0, 0], [1, 0], [1, 1], [0, 1]]}
    domain, problem = bar(half)
    t, w = np.polynomial.legendre.leggauss(30)
    y, w = (t + 1) / 2, w / 2
    x, ends = 2 * y, {"left": (0.0 * y, y, w), "floor": (2 * y, 0.0 * y, 2 * w)}
    grid = {None: (2, x[:, None], y), "half": (1, y[:, None], y)}

    def psi(x, sin, exp):
        return sin(3 * x[0] + 1) * exp(x[1]) - 0.2

    exact_values = {
        where: size * (w @ (psi((a, b), np.sin, np.exp) * of_bar(b)) @ w)
        for where, (size, a, b) in grid.items()
    } | {where: c @ (psi((a, b), np.sin, np.exp) * of_bar(b)) for where, (a, b, c) in ends.items()}
    weights = {
        where: size * (w @ psi((a, b), np.sin, np.exp) @ w) for where, (size, a, b) in grid.items()
    } | {where: c @ psi((a, b), np.sin, np.exp) for where, (a, b, c) in ends.items()}
    widths = []
    for solution in solve_levels(problem, domain, 3):
        widths.append([])
        for where, exact_value in exact_values.items():
            value, lower, upper = solution.integral(where, lambda x: psi(x, ufl.sin, ufl.exp))
            assert lower <= exact_value <= upper
            assert value == pytest.approx(exact_value, abs=0.02)
            widths[-1].append(upper - lower)
        _, lower, upper = solution.mean("left", lambda x: psi(x, ufl.sin, ufl.exp))
        assert lower <= exact_values["left"] / weights["left"] <= upper
    assert np.all(np.log2(np.array(widths[:-1]) / widths[1:]) > 0.9)
    whole, mean_of_all = solution.integral(), solution.mean()
    assert whole[1:] == pytest.approx(tuple(2 * end for end in mean_of_all[1:]), rel=1e-12)
    with pytest.raises(InputError, match="the weight's integral may be 0"):
        solution.mean(None, lambda x: x[0] - 1)
    with pytest.raises(InputError, match="the weight is not bounded"):
        solution.integral(None, lambda x: 1 / x[0])
    with pytest.raises(InputError, match=r"the weight has the shape \(2,\)"):
        solution.integral(None, lambda x: x)


def test_a_weight_is_what_is_needed_where_contact_meets_dirichlet():
    """u = (1 − x²)(1 − y) lies on the floor, where λ = 1 − x²; the other sides are Dirichlet's."""
    floor = Contact(lambda x: 1.0 - x[0] ** 2)
    sides = dict.fromkeys(SIDES, Dirichlet(0.0)) | {"floor": floor}
    problem = Problem(f=lambda x: 2.0 * (1.0 - x[1]), conditions=sides)
    polygon = Polygon([[-1, 0], [1, 0], [1, 1], [-1, 1]], SIDES, names=SIDES)
    asked = [
        ("floor", lambda x: 1.0 - x[0] ** 2, 16 / 15),
        ("floor", lambda x: 1.0 - abs(x[0]), 5 / 6),
        ("floor", lambda x: ufl.sin(np.pi * x[0]), 0.0),
        ("top", lambda x: x[0] ** 2 - 1.0, 16 / 15),
        ("right", lambda x: x[1] * (1.0 - x[1]), -1 / 6),
        ("right", lambda x: x[1] * (1.0 - x[1]) * ufl.exp(x[1]), -2 * (11 - 4 * np.e)),
    ]
    widths = []
    for solution in solve_levels(problem, polygon.mesh(0.4), 4):
        widths.append([])
        for part, weight, exact_value in asked:
            value, lower, upper = solution.flux(part, weight=weight)
            assert lower <= exact_value <= upper
            assert abs(value - exact_value) < 0.2 * 0.5**solution.level.number
            widths[-1].append(upper - lower)
    # weights at the sides rise from where λ is 0: h
    rates = np.log2(np.array(widths[1:-1]) / widths[2:])
    assert (rates[:, :4] > 1.7).all() and (rates > 0.85).all()
    with pytest.raises(InputError, match=r"the weight is 1 at \(-1, 0\), where the part touches"):
        solution.flux("floor", weight=1.0)
    with pytest.raises(InputError, match="the weight jumps on a boundary facet"):
        solution.flux("floor", weight=lambda x: ufl.conditional(ufl.gt(x[0], 0.1), 0.0, 1.0 + x[0]))


def test_a_solution_knows_its_quantities():
    """As the functions say them; what they take is booked as the certificate's is."""
    (solution, *_) = strip([Contact(0.1), Neumann(), Dirichlet(0.0), Neumann()], 2, f=-3.0)
    weight = {"weight": lambda x: x[0]}
    before = (solution.certificate, dict(solution.seconds))[1]
    assert solution.flux("floor", **weight) == flux(solution, "floor", **weight)
    assert solution.mean("left") == mean(solution, "left")
    assert solution.integral(**weight) == integral(solution, **weight)
    assert solution.force_bounds() == force_bounds(solution) == solution.flux("floor")[1:]
    assert solution.seconds["estimate"] > before.pop("estimate")
    assert before.items() <= solution.seconds.items()
    kinds = {"force": solution.flux("floor"), "flux": solution.flux("top")}
    kinds |= {"mean": solution.mean("left"), "integral": solution.integral("left")}
    places = {"force": "floor", "flux": "top", "mean": "left", "integral": "left"}
    for kind, expected in kinds.items():
        assert Quantity(kind, places[kind]).of(solution) == expected


def test_all_of_the_domain_has_a_name_unless_something_else_has_it():
    """u = y on the strip, above the obstacle: 1/2 in the mean, and 1/4 where y < 1/2."""
    sides = [Contact(-9.0, g=-1.0), Neumann(), Dirichlet(1.0), Neumann()]
    (solution, *_) = strip(sides, 2)
    assert solution.mean("domain") == mean(solution, "domain") == solution.mean()
    assert solution.integral("domain", lambda x: x[0]) == solution.integral(None, lambda x: x[0])
    for kind, expected in {"mean": 0.5, "integral": 1.0}.items():
        found = Quantity(kind, "domain").of(solution)
        assert found == Quantity(kind).of(solution)
    with pytest.raises(InputError, match="no kind of quantity is called 'men'; did you mean mean"):
        Quantity("men").of(solution)
        assert found.value == pytest.approx(expected)
    there = r"no material; did you mean domain\? There are .*floor, right, left, domain$"
    with pytest.raises(InputError, match=there):
        solution.mean("domian")
    below = {"domain": [[0, 0], [2, 0], [2, 0.5], [0, 0.5]]}
    polygon = Polygon(STRIP, SIDES, names=SIDES, materials=below)
    problem = Problem(conditions=dict(zip(SIDES, sides, strict=True)))
    (solution,) = solve_levels(problem, polygon.mesh(0.2), 1)
    assert solution.mean("domain").value == pytest.approx(0.25)
    assert solution.mean().value == pytest.approx(0.5)


def test_weighted_forces_have_the_sign_that_is_certain():
    """Of a force off one bound and a weight that is not below 0, in places with no force at all."""
    (solution, *_) = strip([Contact(-1.0), Neumann(), Dirichlet(0.0), Neumann()], 2, f=-1.0)
    assert solution.contact.force == 0.0
    assert solution.flux("floor", weight=lambda x: x[0] ** 2).lower == 0.0
    assert solution.flux("floor", weight=lambda x: x[0] - 1.0).lower < 0.0


def test_a_weight_that_vanishes_at_the_ends_of_one_facet():
    """What is 0 at the vertices is measured by what it is between them; finer meshes agree."""
    sides = ("floor", "right", "top", "left")
    corners = [[0, 0], [1, 0], [1, 0.25], [0, 0.25]]
    domain = structured(Polygon(corners, sides, names=sides), 4, MPI.COMM_WORLD)
    conditions = {"floor": Contact(-0.1), "top": Contact(-0.2)}
    conditions |= dict.fromkeys(("right", "left"), Dirichlet(0.0))
    problem = Problem(f=-1.0, conditions=conditions)
    found = [
        solution.flux("right", weight=lambda x: ufl.sin(4 * np.pi * x[1]))
        for solution in solve_levels(problem, domain, 3)
    ]
    assert max(each.lower for each in found) <= min(each.upper for each in found)
    widths = [each.upper - each.lower for each in found]
    assert widths[2] < 0.6 * widths[1] < 0.36 * widths[0]


def test_two_parts_with_one_weight():
    """It goes on from one to the other; what each gets alone it must not have where they meet."""
    sides = [Contact(1.0), Contact(1.0), Neumann(), Neumann()]
    (solution, *_) = strip(sides, 2, f=-1.0, reaction=1.0)
    whole = solution.flux("floor", "right", weight=lambda x: x[0] + x[1])
    assert whole.lower < whole.value < whole.upper
    with pytest.raises(InputError, match=r"the weight is 2 at \(2, 0\)"):
        solution.flux("floor", weight=lambda x: x[0] + x[1])


@pytest.mark.serial
def test_integrals_over_tetrahedra():
    """u = x on a cube, on sides z = 0, far above the obstacle, and z = 1 as well."""
    mesh = create_unit_cube(MPI.COMM_SELF, 3, 3, 3)
    mesh.topology.create_connectivity(2, 3)
    facets = exterior_facet_indices(mesh.topology)
    z = compute_midpoints(mesh, 2, facets)[:, 2]
    parts = np.where(z < 1e-9, CONTACT, np.where(z > 1 - 1e-9, NEUMANN, DIRICHLET))
    domain = Domain.from_tags(mesh, meshtags(mesh, 2, facets, parts.astype(np.int32)))
    solution = solve(Problem(obstacle=-9.0, dirichlet=lambda x: x[0]), domain)
    found = {
        7 / 12: solution.integral(None, lambda x: x[0] + x[1]),
        3 / 4: solution.mean(None, lambda x: x[0] ** 2),
        np.sin(1) - np.cos(1): solution.integral("contact", lambda x: ufl.sin(x[0])),
        1 / 4: solution.integral("neumann", lambda x: ufl.exp(x[0]) - 1.5),
    }
    for exact_value, (_, lower, upper) in found.items():
        assert lower <= exact_value <= upper < lower + 1e-6
    with pytest.raises(InputError, match="for d = 2 only"):
        solution.flux("contact", weight=1.0)


def test_a_part_and_a_material_of_the_same_name_are_not_told_apart():
    below = {"right": [[0, 0], [2, 0], [2, 0.5], [0, 0.5]]}
    polygon = Polygon(STRIP, SIDES, names=SIDES, materials=below)
    sides = [Contact(-9.0, g=-1.0), Neumann(), Dirichlet(1.0), Neumann()]
    problem = Problem(conditions=dict(zip(SIDES, sides, strict=True)))
    solution = solve(problem, polygon.mesh(0.5))
    with pytest.raises(InputError, match="'right' is a part and a material"):
        solution.mean("right")


def test_where_contact_alone_holds_u_a_mean_is_refused_and_a_force_is_not():
    """A weak loss of heat, which says how high u is, is enough for both."""
    for loss, held in ((0.0, False), (0.5, True)):
        solution = list(strip([Contact(coefficient=loss), *[Neumann()] * 3], 2, f=-1.0))[-1]
        _, low, high = solution.flux("floor")
        assert low <= 2.0 <= high
        for ask in (solution.mean, solution.integral):
            if held:
                assert ask().lower <= 0.0
                continue
            with pytest.raises(InputError, match="nothing but contact is known to hold"):
                ask()


@pytest.mark.ranks
def test_intervals_are_of_the_data_that_were_solved_with():
    """Asked for by a method, or by the function of the module that it calls."""
    domain = HELD_ABOVE.mesh(0.3)
    data = [Constant(domain.mesh, value) for value in (-3.0, 1.0, 1.0)]
    f, c, kappa = data
    problem = Problem(f=f, reaction=c, coefficient=kappa, obstacle=lambda x: -0.1 - 0.3 * x[0])
    solution = solve(problem, domain)
    asked = (
        (solution.mean, lambda: mean(solution), ()),
        (solution.integral, lambda: integral(solution, "neumann"), ("neumann",)),
        (solution.flux, lambda: flux(solution, "dirichlet"), ("dirichlet",)),
        (solution.force_bounds, lambda: force_bounds(solution), ()),
    )
    before = [method(*arguments) for method, _, arguments in asked]
    for each in data:
        each.value = 1e3
    for (method, function, arguments), expected in zip(asked, before, strict=True):
        assert function() == pytest.approx(expected, rel=1e-12)
        assert method(*arguments) == pytest.approx(expected, rel=1e-12)
    assert [float(each.value) for each in data] == [1e3] * 3
