"""Loads derived from a solution: simpler, and the same numbers."""

from fractions import Fraction

import basix.ufl
import numpy as np
import pytest
import ufl
from ufl.corealg.traversal import unique_pre_traversal

from signorini_cr import exact, solve
from signorini_cr.fem.pointwise import evaluate
from signorini_cr.fem.problem import Forms, Problem, as_number
from signorini_cr.fem.simplified import simplified

X = ufl.SpatialCoordinate(ufl.Mesh(basix.ufl.element("Lagrange", "triangle", 1, shape=(2,))))
x, y = X
r, theta = ufl.sqrt(x**2 + y**2), ufl.atan2(y, x)
POINTS = np.random.default_rng(0).uniform(-0.9, 0.9, (200, 3))


def minus_laplace(u):
    return -ufl.div(ufl.grad(u))


HARMONIC = {
    "r^{3/2} cos": r**1.5 * ufl.cos(1.5 * theta),
    "the same without r": (x**2 + y**2) ** 0.75 * ufl.cos(1.5 * (np.pi / 2 - ufl.atan2(x, y))),
    "r^{2/3}, a number that is rounded": r ** (2 / 3) * ufl.sin(2 * theta / 3),
    "around another point": ((x - 0.3) ** 2 + y**2) ** 0.25 * ufl.sin(0.5 * ufl.atan2(y, x - 0.3)),
    "logarithm": ufl.ln(x**2 + y**2) + 3 * x * y,
    "inversion": x / (x**2 + y**2),
    "no root": ufl.exp(2 * x) * ufl.sin(2 * y),
}


@pytest.mark.parametrize("name", HARMONIC)
def test_harmonic_functions_have_no_load(name):
    assert as_number(simplified(minus_laplace(HARMONIC[name]))) == 0.0


def test_nearly_harmonic_functions_have_one():
    """2.25 r^{-1/2} (1 − s²/1.5²) cos(sθ) for another s: nothing is rounded away."""
    for s in (1.5 + 1e-9, 1.25):
        f = simplified(minus_laplace(r**1.5 * ufl.cos(s * theta)))
        assert as_number(f) is None
        radius, angle = np.hypot(*POINTS.T[:2]), np.arctan2(POINTS[:, 1], POINTS[:, 0])
        known = (s**2 - 1.5**2) * radius**-0.5 * np.cos(s * angle)
        assert np.allclose(evaluate(f, POINTS)[0], known, rtol=1e-6, atol=0)


SAME = {
    "S1": minus_laplace((1 - x**2) * (1 - y**2) * r**1.5 * ufl.cos(1.5 * theta)),
    "coefficient": -ufl.div((1 + x**2) * ufl.grad(r**1.5 * ufl.cos(1.5 * theta))),
    "root of a square": minus_laplace(x**3 * ufl.sqrt(x**2)),
    "root of a sum squared": minus_laplace(((x + y) ** 2) ** 0.5 * (x + y) ** 2),
    "root of a product": minus_laplace(x * y * ufl.sqrt(x**2 * y**2)),
    "two centres": minus_laplace(r * ufl.sqrt((x - 1) ** 2 + y**2)),
    "choice": minus_laplace(ufl.conditional(x > 0, x**3, y * x**3)),
    "square of a root": minus_laplace((2 - x - y) ** 0.5 * (2 - x - y) / (3 + x)),
    "power of x": minus_laplace(2.0 ** (x * y)),
    "extremes": minus_laplace(ufl.max_value(x, 0.0) ** 3 * ufl.min_value(y, x) ** 3),
    "negative sum": minus_laplace((x**2 - 2 * y**2) ** 2 / (x**2 - 2 * y**2)),
}


@pytest.mark.parametrize("origin", [(2, 0), (0.1, 0.2), (3.7, -2.1)])
def test_harmonic_about_another_point(origin):
    """r^{3/2} cos(3θ/2), with r and θ seen from there."""
    a, b = x - origin[0], y - origin[1]
    u = ufl.sqrt(a**2 + b**2) ** 1.5 * ufl.cos(1.5 * ufl.atan2(b, a))
    assert as_number(simplified(minus_laplace(u))) == 0.0


@pytest.mark.parametrize("name", SAME)
def test_values_stay_the_same(name):
    values, bounds = evaluate(SAME[name], POINTS)
    found = evaluate(simplified(SAME[name]), POINTS)
    assert np.all(np.abs(found[0] - values) <= 100 * (bounds + found[1]) + 1e-14)


def test_numbers_for_which_squares_come_back_again_and_again():
    """(x − 1000.7)² + y², divided by 1000.7² and with its square root written out in digits."""
    square = 9.98601468629199e-7 * y**2 + (0.00099930048965724 * x - 1) ** 2
    load = minus_laplace(31.6 * square**1.25 * ufl.cos(2.5 * ufl.atan2(y, x - 1000.7)))
    one, other = (evaluate(each, POINTS) for each in (load, simplified(load)))
    assert np.all(np.abs(one[0] - other[0]) <= 100 * (one[1] + other[1]) + 1e-14)


@pytest.mark.parametrize("scale", [1e-150, 1e-80, 1e-20, 3e-16, 1e20, 1e150])
def test_no_number_is_too_small_to_count(scale):
    """Fractions take the place of numbers that are one but for rounding, which is relative."""
    load = minus_laplace(scale * (x**3 + x * y**2) * (1 + x * y - y * x))
    found, known = evaluate(simplified(load), POINTS)[0], -8.0 * scale * POINTS[:, 0]
    assert np.allclose(found / scale, known / scale, rtol=1e-12, atol=1e-14)


def test_a_solution_of_any_size_has_its_load():
    def solved(scale):
        problem = Problem(exact=lambda x: scale * (1 - x[0] ** 2) * (1 - x[1] ** 2) ** 2)
        return np.array(solve(problem, exact.S1.structured(8)).errors) / scale

    assert np.allclose(solved(1e-20), solved(1.0), rtol=1e-6)


@pytest.mark.parametrize("p", [60, 800, 1000])
def test_powers_beyond_the_range_of_numbers(p):
    """3⁻⁸⁰⁰ is 0 among floats, and (x/3)⁸⁰⁰ is 1 at x = 3."""
    points = np.array([[3.0, 0.2, 0.0], [2.99, -1.0, 0.0], [-3.0, 0.5, 0.0]])
    known = -p * (p - 1) / 9 * (points[:, 0] / 3) ** (p - 2)
    for u in ((x / 3) ** p, (x / 3) ** (p // 2) * (x / 3) ** (p // 2) * (1 + x * y - y * x)):
        assert np.allclose(evaluate(simplified(minus_laplace(u)), points)[0], known, rtol=1e-10)


@pytest.mark.parametrize("p", [1e9, 1e300])
def test_powers_that_no_memory_holds(p):
    """0.3 to such a power, as a fraction, would have as many digits."""
    simplified(minus_laplace((0.3 * x) ** p + y**2))


@pytest.mark.parametrize("number", [np.inf, np.nan])
def test_what_is_not_finite_is_left_alone(number):
    f = minus_laplace(x**2 * y) + (x + number)
    assert simplified(f) is f


def test_large_exponents_are_no_integers():
    """C has none of 10³⁶, and would take them modulo 2⁶⁴."""
    f = simplified(minus_laplace(x**1e36 * (1 + x * y - y * x)))
    powers = [e for e in unique_pre_traversal(f) if isinstance(e, ufl.classes.Power)]
    assert powers
    for e in powers:
        assert abs(float(e.ufl_operands[1])) <= 64 or isinstance(
            e.ufl_operands[1], ufl.classes.FloatValue
        )


def test_squares_of_squares():
    """Forty times: x to the power of 2⁴⁰, divided by a number of so many digits."""
    u = x / 3
    for _ in range(40):
        u = u * u
    simplified(minus_laplace(u))


def _product_about(x, at, roots):
    """A polynomial and its second derivative, in whatever kind of number x is."""
    p, first, second = 1 + 0 * x, 0 * x, 0 * x
    for root in roots:
        factor = x - (at + root)
        p, first, second = p * factor, first * factor + p, second * factor + 2 * first
    return p, second


@pytest.mark.parametrize("near", [0, 1])
@pytest.mark.parametrize("at", [0, 1000, 2**20])
@pytest.mark.parametrize("roots", [(0, 0, 1, 1, 2, 2), (0, 0, 0, 1, 1, 1, 1), (-1, 3, 3, 5)])
def test_powers_about_a_far_point_keep_their_digits(at, near, roots):
    """By rational numbers; multiplied out about 0 they would be lost, near or far from there."""
    expression = _product_about(x, at, roots)[0] + (x - at - roots[-1]) ** 2 + x * y
    points = POINTS + np.array([at * near, 0, 0])
    f = simplified(minus_laplace(expression), points)
    exact = [-2 - _product_about(Fraction(value), at, roots)[1] for value in points[:, 0]]
    known = np.array([float(each) for each in exact])
    assert np.abs(evaluate(f, points)[0] - known).max() <= 1e-12 * np.abs(known).max()


def test_what_gets_longer_is_left_alone():
    for f in (minus_laplace((x**2 + y + 3 * x * y) ** 8 * ufl.sin(x)), exact.I.problem.exact(X)):
        assert simplified(f) is f


def test_a_formula_is_worked_on_once_for_all_meshes(monkeypatch):
    first = simplified(minus_laplace((1 - x**2) * r**2.5 * ufl.cos(2.5 * theta)))
    monkeypatch.setattr("signorini_cr.fem.simplified._Reader", None)
    mesh = exact.S1.structured(2).mesh
    x0, y0 = there = ufl.SpatialCoordinate(mesh)
    radius = ufl.sqrt(x0**2 + y0**2)
    u = (1 - x0**2) * radius**2.5 * ufl.cos(2.5 * ufl.atan2(y0, x0))
    again = simplified(minus_laplace(u))
    assert again == ufl.replace(first, {X: there})
    assert ufl.domain.extract_unique_domain(again) == mesh.ufl_domain()
    with pytest.raises(TypeError):  # nor is a cell's size a formula of coordinates
        simplified(minus_laplace(u) * ufl.CellVolume(mesh))


def test_forms_with_derived_loads():
    """A harmonic u needs no load; the bound for S1 is that of the load written down by hand."""
    harmonic = Problem(exact=lambda x: exact.B.problem.exact(x))
    domain = exact.S1.structured(8)
    assert as_number(Forms(harmonic, domain.mesh).f) == 0.0
    u = exact.S1.problem.exact
    by_hand, derived = (
        solve(problem, domain).certificate.bound_h1
        for problem in (exact.S1.problem, Problem(exact=u, dirichlet=0.0))
    )
    assert derived == pytest.approx(by_hand, rel=0.005)
