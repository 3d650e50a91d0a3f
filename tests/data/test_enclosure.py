"""Enclosures: jets against values elsewhere, and bounds of data that quadrature does not see."""

import basix
import numpy as np
import pytest
import ufl
from dolfinx import fem
from dolfinx.mesh import create_unit_square
from helpers import HELD_ABOVE, HELD_ALL_ROUND, SQUARE
from mpi4py import MPI

from signorini_cr import Polygon, Problem, exact, solve
from signorini_cr.app import expressions
from signorini_cr.compat import cell_nodes
from signorini_cr.data import jets
from signorini_cr.data.balls import indices
from signorini_cr.data.jets import Boxes, Enclosure, lowered, values
from signorini_cr.data.pieces import Pieces
from signorini_cr.data.ranges import Deviation, means
from signorini_cr.fem.cells import Cells
from signorini_cr.mesh.domain import DIRICHLET
from signorini_cr.mesh.families import structured

pytestmark = pytest.mark.slow

WORLD = MPI.COMM_WORLD

FORMULAS = [
    "sin(7*x*y) - cos(9*x)",
    "abs(x)**3/(2 + y) - x**2",
    "max(x, y) + min(x**3, exp(-y))",
    "where(x > 0.1 and y <= 0.4, x, sqrt(y + 2))",
    "(1 + y**2)**-2 + (2 + x)**0.5",
    "sqrt(x**2 + y**2)**1.5*cos(1.5*atan2(y, x))",
    "tan(x) + asin(x/3) - acos(y/3)",
    "atan(x*3 - y) + sinh(x)*cosh(y - x) + tanh(3*x)",
    "sign(x - y)*x",
    "(2 + x)**y",
    "(abs(x) + 0.01)**(y - x)",
    "exp(-30*((x - 0.3)**2 + y**2)) + log(3 + x*y)",
    "where(x < 0.2, 0, (x - 0.2)**2)",
    "max(0, x)**1.5",
    "where(not (x > y) or x == 0, 1, where(y != 2, 2, 3))",
    "1/x",
    "sqrt(x)",
]


def made(text):
    mesh = create_unit_square(MPI.COMM_SELF, 1, 1)
    formula = expressions.parse(text)
    return formula, lowered(ufl.as_ufl(formula.ufl(ufl.SpatialCoordinate(mesh))))


@pytest.mark.parametrize("text", FORMULAS)
def test_jets_hold_at_every_point(text):
    """Values by NumPy's reading of the formula, derivatives by Taylor's formula with them."""
    formula, expression = made(text)
    rng = np.random.default_rng(len(text))
    n = 300
    middle = rng.uniform(-1.5, 1.5, (2, n))
    half = 10.0 ** rng.uniform(-5, -0.3, n) * rng.uniform(0.2, 1, (2, n))
    low, high = middle - half, middle + half
    jet = Enclosure(Boxes(low, high))(expression)
    for _ in range(30):
        at, step = low + (high - low) * rng.random((2, 2, n))
        value = formula.numpy(at.T)
        known = np.isfinite(value)
        assert np.all(((jet.low <= value) & (value <= jet.high))[known])
        # f(b) − f(a) is Taylor's polynomial at a, with the last coefficient from anywhere between
        value_there = formula.numpy(step.T)
        for order in (1, 2, 3):
            start = Enclosure(Boxes(at, at), order=order)(expression)
            off, room = value_there - value, 1e-12 * (1 + np.abs(value) + np.abs(value_there))
            rows = tuple(range(1, 10))
            here, over = (zip(*found.rest.on(rows), strict=True) for found in (start, jet))
            for index, *balls in zip(indices(2, order)[1:], here, over, strict=False):
                mid, rad = balls[sum(index) == order]
                size = (step[0] - at[0]) ** index[0] * (step[1] - at[1]) ** index[1]
                off = off - mid * size
                room = room + rad * np.abs(size) + 1e-12 * np.abs(mid * size)
            fine = np.isfinite(off) & np.isfinite(room)
            assert np.all(np.abs(off[fine]) <= room[fine] * (1 + 1e-9))


@pytest.mark.parametrize(
    "text, same",
    [
        ("(1e-200*(x + 2))**2*1e300*1e100", "(x + 2)**2"),
        ("(1e-200*(x + 2))*(1e-200*(y - 0.3))*1e300*1e100", "(x + 2)*(y - 0.3)"),
        ("1e100*(-(1e-200*(x + 2))*(1e-200*(y - 0.3))*1e300)", "(x + 2)*(0.3 - y)"),
        ("(1e-110*(x - 0.1))**3*1e300*1e30", "(x - 0.1)**3"),
        ("1e40*(sqrt(2 + x)*(1e-200*(y + 2))**1.7*1e300)", "sqrt(2 + x)*(y + 2)**1.7"),
        ("1/(1e200*(x + 2))/(1e200*(y + 2))*1e300*1e100", "1/(x + 2)/(y + 2)"),
        ("exp(-700*(x + 3))*exp(700*(x + 3))", "1 + 0*x"),
        ("(1e-155*sin(x))**2*1e300*1e10", "sin(x)**2"),
    ],
)
def test_products_below_all_numbers_are_no_zeros(text, same):
    """On the way they are, at the end they are not: by the same formula in another order."""
    (_, lost), (_, known) = made(text), made(same)
    middle = np.random.default_rng(len(text)).uniform(-1, 1, (2, 40))
    at = Boxes(middle, middle)
    found, exact = (Enclosure(at)(expression) for expression in (lost, known))
    assert np.all((found.low <= exact.high) & (found.high >= exact.low))
    rows = tuple(range(1, 10))
    (mid, rad), (of, room) = found.rest.on(rows), exact.rest.on(rows)
    apart = np.where(np.isfinite(rad), np.abs(mid - of), 0.0)
    assert np.all(apart <= np.where(np.isfinite(rad), rad, 0.0) + room + 1e-12)


@pytest.mark.parametrize("text", ["sin(7*x*y) - cos(9*x)", "exp(x)*(2 + y)**0.5/(3 + x)"])
def test_jets_are_sharp_to_first_order(text):
    """The width of a range is the variation plus O(h²)."""
    formula, expression = made(text)
    middle = np.random.default_rng(0).uniform(-1, 1, (2, 50))
    excess = []
    for h in (1e-2, 1e-3):
        jet = Enclosure(Boxes(middle - h, middle + h))(expression)
        grid = np.linspace(-h, h, 9)
        values = [formula.numpy((middle + np.array([[a], [b]])).T) for a in grid for b in grid]
        excess.append(np.max(jet.high - jet.low - np.ptp(values, axis=0)))
    assert excess[1] < 0.2 * excess[0]


def test_values_at_points_are_those_of_the_formula():
    for text in FORMULAS:
        formula, expression = made(text)
        at = np.random.default_rng(3).uniform(0.1, 1.4, (2, 50))
        assert np.allclose(values(expression, Boxes(at, at)), formula.numpy(at.T), rtol=1e-13)
    # where rounding has made a number negative, its root is 0 and not unknown
    assert values(made("sqrt(1e-18*(x - 3))")[1], Boxes(at, at)).tolist() == [0.0] * 50


@pytest.mark.parametrize("text, factor", [("atan2(y, x)", 1.6), ("sqrt(x**2 + y**2)**1.5", 6.0)])
def test_polar_coordinates_are_enclosed_sharply(text, factor):
    """Radii on boxes are not much above the variation at points; none is 0 here."""
    expression = made(text)[1]
    middle = np.array([[0.5], [0.4]])
    grid = np.linspace(-0.01, 0.01, 5)
    points = middle + np.stack(np.meshgrid(grid, grid)).reshape(2, -1)
    rows = tuple(range(1, 10))
    there = Enclosure(Boxes(points, points))(expression).rest.on(rows)[0]
    radii = Enclosure(Boxes(middle - 0.01, middle + 0.01))(expression).rest.on(rows)[1]
    assert np.all(radii[:, 0] <= factor * np.ptp(there, axis=1))


def test_means_over_triangles_and_slabs():
    """Means of |t^i| and of t^2i by Gauss's rule, and by the certificate's."""
    t, weights = np.polynomial.legendre.leggauss(30)
    s, weights = (t + 1) / 2, weights / 2
    fine_weights = (2 * np.outer(weights * (1 - s), weights)).ravel()
    fine = np.stack([np.outer(1 - s, s).ravel(), np.outer(s, np.ones(30)).ravel()])
    points, rule = basix.make_quadrature(basix.CellType.triangle, 4)
    of_square, of_mean = means(2)
    rng = np.random.default_rng(5)
    for kind in range(40):
        apex, *sides = rng.normal(size=(3, 2))
        a, b = np.sort(rng.uniform(0, 1, 2)) if kind % 2 else (0.0, 1.0)
        near, far = ([apex + c * (side - apex) for side in sides] for c in (a, b))
        ends = np.array([*near, *far])
        low, high = ends.min(axis=0), ends.max(axis=0)
        p, q, r, z = (2 * ends - low - high) / (high - low)
        for at, weight in ((fine, fine_weights), (points.T, rule / rule.sum())):
            total = np.zeros((2, 4, 4))
            area = 0.0
            for corners in ((p, q, z), (p, r, z)):
                edges = np.array([corners[1] - corners[0], corners[2] - corners[0]])
                size = abs(np.linalg.det(edges))
                x, y = np.abs(corners[0][:, None] + edges.T @ at)
                area += size
                for i, j in ((i, k - i) for k in range(4) for i in range(k + 1)):
                    monomial = x**i * y**j
                    total[:, i, j] += size * np.array([weight @ monomial**2, weight @ monomial])
            total /= area
            for i, j in ((i, k - i) for k in range(4) for i in range(k + 1)):
                assert total[0, i, j] <= of_square[i + j] ** 2 * (1 + 1e-9)
                assert total[1, i, j] <= of_mean[i + j] * (1 + 1e-9)


# ---- exact problems in one variable, whose data jump inside cells


def test_slanted_cells_are_enclosed_in_their_own_coordinates():
    """R is no less than what the best quadratic leaves at random points, and not much more."""
    domain = structured(HELD_ALL_ROUND, 8, WORLD)
    mesh = domain.mesh
    mesh.geometry.x[:, 0] += 50 * mesh.geometry.x[:, 1]
    cells = Cells(domain, fem.functionspace(mesh, ("CR", 1)), (DIRICHLET,))
    x = ufl.SpatialCoordinate(mesh)
    deviation = Deviation(ufl.sin(2 * (x[0] - 50 * x[1]) + 0.3) * ufl.cos(2 * x[1]))
    pieces = Pieces.of_cells(cells)
    boxes = pieces.boxes(cells)
    bound, _ = deviation(Enclosure(boxes), pieces.half(boxes))
    hats = np.random.default_rng(1).dirichlet(np.ones(3), 60).T
    values = deviation.values(pieces, cells, hats)
    basis = np.stack([hats[i] * hats[j] for i in range(3) for j in range(i + 1)], axis=1)
    rest = values - basis @ np.linalg.lstsq(basis, values, rcond=None)[0]
    rough = np.sqrt((rest**2).mean(axis=0))
    assert (rough <= bound).all()
    # third derivatives are at most 1, the arguments change by ⅛ from the middle along both edges
    assert (bound <= 0.25**3 / 6 * (1 + 1e-9)).all()


def clipped(triangle, normal, c):
    """The parts of a triangle on both sides of normal·x = c."""
    s = triangle @ normal - c
    if (s >= 0).all() or (s <= 0).all():
        return [triangle]
    i = next(i for i in range(3) if np.sum((s > 0) == (s[i] > 0)) == 1)
    a, b, d = triangle[i], triangle[i - 2], triangle[i - 1]
    p, q = (a + (z - a) * s[i] / (s[i] - z @ normal + c) for z in (b, d))
    return [np.array(t) for t in ([a, p, q], [p, b, q], [b, d, q])]


def weighted_error(solution, normal, breaks, slope, kappa):
    """‖κ^{1/2}∇_h(u − u_h)‖ for ∇u = slope(s, middle) normal, affine in s between the breaks."""
    mesh, V = solution.domain.mesh, solution.u.function_space
    own = mesh.topology.index_map(2).size_local
    corners = mesh.geometry.x[cell_nodes(mesh)[:own], :2]
    facets = solution.u.x.array[V.dofmap.list[:own]]
    w = facets.sum(axis=1, keepdims=True) - 2 * facets
    rise = (w[:, 1:] - w[:, :1])[:, :, None]
    gradients = np.linalg.solve(corners[:, 1:] - corners[:, :1], rise)[:, :, 0]
    total = 0.0
    for cell, gradient in zip(corners, gradients, strict=True):
        parts = [cell]
        for c in breaks:
            parts = [piece for part in parts for piece in clipped(part, normal, c)]
        for part in parts:
            area = 0.5 * abs(np.linalg.det(part[1:] - part[0]))
            middle = part.mean(axis=0) @ normal
            mids = (part + np.roll(part, 1, axis=0)) / 2  # exact for quadratics
            off = slope(mids @ normal, middle)[:, None] * normal - gradient
            total += area / 3 * kappa(middle) * np.sum(off**2)
    return np.sqrt(WORLD.allreduce(total))


def square(kind, sides=("contact", "neumann", "dirichlet", "neumann")):
    polygon = Polygon(SQUARE.vertices, sides)
    return structured(polygon, 8) if kind == "squares" else polygon.mesh(0.13)


def holds(solution, error, energy):
    certificate = solution.certificate
    assert certificate.reason is None
    low, high = certificate.energy
    assert certificate.bound_energy_norm >= error * (1 - 1e-9)
    assert low <= energy + 1e-12 and energy - 1e-12 <= high
    return certificate.bound_energy_norm / error


UP = np.array([0.0, 1.0])


@pytest.mark.parametrize("degree", [0, 1, 4])
@pytest.mark.parametrize("kind", ["squares", "gmsh"])
def test_a_load_that_jumps_inside_cells(kind, degree):
    """−u'' = 3 below c and −2 above, ∂ₙu = 0 at the bottom, where α is out of reach."""
    for c in (0.31, 0.5, 0.77):
        problem = Problem(
            f=lambda x, c=c: ufl.conditional(x[1] < c, 3.0, -2.0),
            obstacle=-9.0,
            quadrature_degree=degree,
        )
        solution = solve(problem, square(kind))
        slope = lambda s, m, c=c: np.where(m < c, -3 * s, 2 * s - 5 * c)  # noqa: E731
        error = weighted_error(solution, UP, [c], slope, lambda m: 1.0)
        left = 2 - 5 * c  # u' at the top
        energy = -0.5 * (3 * c**3 + (left**3 + 27 * c**3) / 6)
        assert holds(solution, error, energy) < 1.9 or degree < 4


@pytest.mark.parametrize("degree", [0, 4, 8])
@pytest.mark.parametrize("kind", ["squares", "gmsh"])
def test_a_coefficient_that_jumps_inside_cells(kind, degree):
    for c in (0.31, 0.55):
        kappa = lambda m, c=c: 1.0 if m < c else 10.0  # noqa: E731
        problem = Problem(
            f=2.0,
            obstacle=-9.0,
            coefficient=lambda x, c=c: ufl.conditional(x[1] < c, 1.0, 10.0),
            quadrature_degree=degree,
        )
        solution = solve(problem, square(kind))
        slope = lambda s, m, k=kappa: -2 * s / k(m)  # noqa: E731
        error = weighted_error(solution, UP, [c], slope, kappa)
        holds(solution, error, -(2 / 3) * (c**3 + (1 - c**3) / 10))


def test_a_spot_between_all_quadrature_points():
    """f = 40 for |y − c| < 0.005: u_h = 0, and the bound must know."""
    c, w = 0.519, 0.005
    problem = Problem(f=lambda x: ufl.conditional(abs(x[1] - c) < w, 40.0, 0.0), obstacle=-9.0)
    solution = solve(problem, square("squares"))
    slope = lambda s, m: -40 * np.clip(s - c + w, 0, 2 * w)  # noqa: E731
    error = weighted_error(solution, UP, [c - w, c + w], slope, lambda m: 1.0)
    energy = -0.5 * 1600 * ((2 * w) ** 3 / 3 + (2 * w) ** 2 * (1 - c - w))
    holds(solution, error, energy)


def ramp(x):
    """0 up to 0.2, 1 from 0.6 on."""
    return ufl.conditional(x < 0.2, 0, ufl.conditional(x > 0.6, 1, (x - 0.2) / 0.4))


def step(condition):
    return ufl.conditional(condition, 1.0, 0.0)


@pytest.mark.parametrize(
    ("choice", "same"),
    [
        (lambda x: ramp(x[0]), lambda x: ufl.min_value(ufl.max_value((x[0] - 0.2) / 0.4, 0), 1)),
        (
            lambda x: ufl.conditional(x[0] > 0.3, 1.1 + 2 * x[0] + x[1], 0.8 + 3 * x[0] + x[1]),
            lambda x: ufl.min_value(1.1 + 2 * x[0], 0.8 + 3 * x[0]) + x[1],
        ),
        (
            lambda x: ufl.conditional(
                ufl.And(x[0] > 0.2, x[0] < 0.6), (x[0] - 0.2) * (0.6 - x[0]), 0
            ),
            lambda x: ufl.max_value((x[0] - 0.2) * (0.6 - x[0]), 0),
        ),
        (
            lambda x: ufl.conditional(x[0] ** 2 + x[1] > 1.3, ufl.exp(x[0] ** 2 + x[1] - 1.3), 1),
            lambda x: ufl.max_value(ufl.exp(x[0] ** 2 + x[1] - 1.3), 1),
        ),
        (lambda x: step(x[0] > 0.3) * (x[0] - 0.3), lambda x: ufl.max_value(x[0] - 0.3, 0)),
    ],
    ids=["ramp", "two lines", "between", "curved", "a step times what vanishes"],
)
def test_choices_that_are_continuous(choice, same):
    """Bounds are those with max and min in their place; u_D above, α on a part with contact."""
    domain = square("squares", ("contact", "neumann", "dirichlet", "neumann"))
    bounds = []
    for data in (choice, same):
        problem = Problem(f=-3.0, dirichlet=data, obstacle=lambda x, data=data: data(x) - 0.5)
        solution = solve(problem, domain)
        assert 0 < solution.contact.number_active
        assert solution.certificate.reason is None
        bounds.append(solution.certificate.bound_h1)
    assert bounds[0] == pytest.approx(bounds[1], rel=0.01)


@pytest.mark.parametrize("jump", [1e-8, -1e-8])
def test_choices_that_are_not_continuous(jump):
    """A jump within facets that is below what data are checked for by their values."""
    domain = square("squares", ("contact", "neumann", "dirichlet", "neumann"))
    for data in (
        lambda x: ufl.conditional(x[0] > 0.3, 1.1 + 2 * x[0], 0.8 + 3 * x[0] + jump),
        lambda x: step(x[0] > 0.3) * (x[0] - 0.3 + jump),
    ):
        certificate = solve(Problem(f=-3.0, dirichlet=data, obstacle=-0.5), domain).certificate
        assert certificate.bound_h1 is None
        assert "u_D jumps on a boundary facet" in certificate.reason


@pytest.mark.parametrize("kind", ["squares", "gmsh"])
def test_data_that_jump_across_an_oblique_line(kind):
    """u = −s/κ with κ 1:10 at s = 0: κ jumps, u_D and α have kinks inside facets."""
    normal, c = np.array([0.6, 0.8]), 0.63
    kappa = lambda m: 1.0 if m < c else 10.0  # noqa: E731

    def far(x):
        return 0.6 * x[0] + 0.8 * x[1] - c

    problem = Problem(
        f=0.0,
        dirichlet=lambda x: ufl.conditional(far(x) < 0, -far(x), -far(x) / 10),
        obstacle=lambda x: ufl.conditional(far(x) < 0, -far(x), -far(x) / 10),
        coefficient=lambda x: ufl.conditional(far(x) < 0, 1.0, 10.0),
    )
    sides = ("contact", "dirichlet", "dirichlet", "dirichlet")
    solution = solve(problem, square(kind, sides))
    slope = lambda s, m: np.full_like(s, -1 / kappa(m))  # noqa: E731
    error = weighted_error(solution, normal, [c], slope, kappa)
    corner = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    parts = [p for t in (corner[:3], corner[[0, 2, 3]]) for p in clipped(t, normal, c)]
    energy = sum(
        0.25 * abs(np.linalg.det(p[1:] - p[0])) / kappa(p.mean(axis=0) @ normal) for p in parts
    )
    holds(solution, error, energy)


def test_flux_data_with_a_jump_inside_a_facet():
    """g = −2 at the bottom left of c, 0 else: the bracket of a finer mesh is inside."""
    sides = ("neumann", "contact", "dirichlet", "contact")
    problem = Problem(
        g=lambda x: ufl.conditional(x[0] < 0.47, -2.0, 0.0), obstacle=-9.0, quadrature_degree=0
    )
    polygon = Polygon(SQUARE.vertices, sides)
    brackets = [solve(problem, structured(polygon, n)).certificate.energy for n in (4, 8, 64)]
    for low, high in brackets[:2]:
        assert low <= brackets[2][0] and brackets[2][1] <= high


def test_a_tent_narrower_than_a_facet():
    """α rises between the points of its quadrature: the companion must be above it."""
    problem = Problem(f=-1.0, obstacle=lambda x: ufl.max_value(-0.2, 0.3 - 40 * abs(x[0] - 0.563)))
    brackets = [solve(problem, exact.E.structured(n)).certificate.energy for n in (4, 8, 160)]
    for low, high in brackets[:2]:
        assert low <= brackets[2][1] and brackets[2][0] <= high


def test_reasons():
    sides = ("contact", "neumann", "dirichlet", "neumann")
    domain = square("squares", sides)
    cases = {
        "f is not bounded": Problem(f=lambda x: abs(x[1] - 0.3) ** -0.4, obstacle=-9.0),
        "g is not bounded": Problem(g=lambda x: abs(x[1] - 0.3) ** -0.6, obstacle=-9.0),
        # A jump would be refused; so steep is nearly one
        "u_D jumps on a boundary facet, or its derivative is not known to be bounded": Problem(
            dirichlet=lambda x: abs(x[0] - 0.3) ** 0.6, obstacle=-9.0
        ),
        "α jumps": Problem(
            f=-9.0, obstacle=lambda x: ufl.conditional(abs(x[0] - 0.3) < 0.01, 0.5, -0.5)
        ),
        "no enclosure": Problem(f=lambda x: ufl.bessel_J(0, x[0]), obstacle=-9.0),
    }
    for words, problem in cases.items():
        certificate = solve(problem, domain).certificate
        assert certificate.bound_h1 is None and certificate.energy is None
        assert words in certificate.reason


def test_a_jump_along_cell_sides_costs_nothing():
    """On a line of the mesh, straight or oblique, a jump is no jump inside any cell."""
    for condition in (lambda x: x[1] < 0.375, lambda x: x[0] < x[1]):
        problem = Problem(f=lambda x, c=condition: ufl.conditional(c(x), 3.0, -2.0), obstacle=-9.0)
        parts = solve(problem, square("squares")).certificate.parts
        assert parts["load"] < 1e-5 * parts["flux"]


def test_same_figures_on_any_number_of_ranks():
    problem = Problem(
        f=lambda x: ufl.conditional(x[0] + 2 * x[1] < 1.1, 3.0, -2.0),
        g=lambda x: ufl.conditional(x[1] < 0.43, 1.0, 0.0),
        coefficient=lambda x: ufl.conditional(x[0] < 0.61, 1.0, 4.0),
        obstacle=lambda x: -0.05 * abs(x[0] - 0.4),
    )
    here, alone = (
        solve(problem, structured(HELD_ABOVE, 8, comm)).certificate
        for comm in (WORLD, MPI.COMM_SELF)
    )
    assert np.isclose(here.bound_h1, alone.bound_h1, rtol=1e-5)
    assert np.allclose(here.energy, alone.energy, rtol=1e-5)


@pytest.mark.parametrize("side", [1, -1])
def test_an_angle_that_jumps_along_the_boundary(side):
    """r^{3/2} cos(3θ/2) on a turned square, with the cut of atan2 along its contact side."""
    c, s = np.cos(0.7), np.sin(0.7)
    corners = np.array([(-1, 0), (1, 0), (1, 1), (-1, 1)]) @ np.array([[c, s], [-s, c]])
    polygon = Polygon(corners, ["contact", "dirichlet", "dirichlet", "dirichlet"])

    def u(x):
        a, b = c * x[0] + s * x[1], c * x[1] - s * x[0]
        return (a**2 + b**2) ** 0.75 * ufl.cos(1.5 * ufl.atan2(side * b, a))

    solution = solve(Problem(f=0.0, exact=u), polygon.mesh(0.25))
    assert 1.0 <= solution.certificate.bound_h1 / solution.errors[0] <= 1.02


@pytest.mark.parametrize("side", [1, -1])
def test_angles_hold_on_triangles_beside_their_cut(side):
    x = ufl.SpatialCoordinate(exact.S1.structured(1, MPI.COMM_SELF).mesh)
    rng = np.random.default_rng(5)
    turn = rng.uniform(-np.pi, np.pi, 30)
    c, s = np.cos(turn), np.sin(turn)
    for k in range(30):
        a, b = c[k] * x[0] + s[k] * x[1], c[k] * x[1] - s[k] * x[0]
        flat = np.array([rng.uniform(-2, 0.3, 3), [0.0, 0.0, side * rng.uniform(0.1, 1)]])
        triangle = np.array([[c[k], -s[k]], [s[k], c[k]]]) @ flat
        low, high = triangle.min(axis=1)[:, None], triangle.max(axis=1)[:, None]
        jet = Enclosure(Boxes(low, high, corners=triangle.T[:, :, None]))(ufl.atan2(b, a))
        hats = rng.dirichlet(np.ones(3), 50).T
        at = flat @ hats
        angle = np.arctan2(at[1], at[0])
        assert np.all((jet.low <= angle) & (angle <= jet.high))
        if flat[0].max() < -0.1:  # one-sided
            assert jet.high - jet.low < np.pi


@pytest.mark.serial
def test_one_rule_for_each_kind_of_expression():
    """What kinds include one another would hang on their order."""
    known = [kind for kind in jets._KINDS if kind is not fem.Function and kind is not fem.Constant]
    every = [kind for kind in vars(ufl.classes).values() if isinstance(kind, type)]
    for each in every:
        assert sum(issubclass(each, kind) for kind in known) <= 1, each
