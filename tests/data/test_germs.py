"""Bounds near points at which data have none."""

import operator
import tracemalloc

import numpy as np
import pytest
import ufl
from mpi4py import MPI

from signorini_cr import exact
from signorini_cr.data.cutting import refine
from signorini_cr.data.germs import allowance, holders, singular_points
from signorini_cr.data.jets import Enclosure, lowered
from signorini_cr.data.pieces import Pieces
from signorini_cr.data.ranges import Deviation, errors_on
from signorini_cr.fem.cells import Cells
from signorini_cr.fem.space import function_space
from signorini_cr.mesh.domain import DIRICHLET, Polygon

pytestmark = pytest.mark.serial

MESH = Polygon([[0, 0], [1, 0], [0, 1]], ["contact", "dirichlet", "dirichlet"])
POINT = (0.3, -0.2)


def expressions():
    """Singular at the point, each with its power and as a function of NumPy."""
    x = ufl.SpatialCoordinate(MESH.mesh(MESH.diameter, MPI.COMM_SELF).mesh)
    a, b = x[0] - POINT[0], x[1] - POINT[1]
    r, theta = ufl.sqrt(a**2 + b**2), ufl.atan2(b, a)
    half = lambda r, t: r**-0.5 * np.cos(1.5 * t)  # noqa: E731
    return [
        (r**-0.5 * ufl.cos(1.5 * theta), -0.5, half),
        (1 / ufl.sqrt(r) + 3, -0.5, lambda r, t: r**-0.5 + 3),
        (a * b / r**2.5, -0.5, lambda r, t: np.cos(t) * np.sin(t) * r**-0.5),
        (-ufl.div(ufl.grad(r**1.5)), -0.5, lambda r, t: -2.25 * r**-0.5),
        (abs(a) ** 2 * r**-2.25, -0.25, lambda r, t: np.cos(t) ** 2 * r**-0.25),
        (ufl.conditional(b > 0, r**-0.3, -1.0), -0.3, lambda r, t: np.where(t > 0, r**-0.3, -1)),
    ]


@pytest.mark.parametrize("number", range(6))
@pytest.mark.parametrize("shift", [0.0, 2e-10])
def test_error_of_quadrature_is_below_what_is_allowed(number, shift):
    """‖f‖ and the largest |f| at points of a rule, by integration in polar coordinates."""
    expression, power, f = expressions()[number]
    expression = lowered(expression)
    rng = np.random.default_rng(number)
    hats = np.array([[1.0 - CLEARANCE, 0.5, 0.1], [0.09, 0.3, 0.5], [0.09, 0.2, 0.4]])
    for _ in range(5):
        start, turn = rng.uniform(-np.pi, 0.4 * np.pi), rng.uniform(0.2, 2.0)
        lengths = rng.uniform(0.1, 2.0, 2)
        angles = start + np.array([0.0, turn])
        directions = np.stack([np.cos(angles), np.sin(angles)])
        other = np.array(POINT)[:, None] + lengths * directions
        # the vertex that is next to the singular point may lie beyond it, or before it
        vertex = np.array(POINT) + shift * rng.choice([-1, 1]) * directions.sum(axis=1)
        corners = np.stack([vertex, *other.T])[:, :, None]
        rough, missed = (float(x[0]) for x in allowance(expression, corners, hats))
        t, weights = np.polynomial.legendre.leggauss(60)
        theta = start + 0.5 * turn * (t + 1)
        edge = other[:, 1] - other[:, 0]
        offset = other[:, 0] - POINT
        ray = np.stack([np.cos(theta), np.sin(theta)])
        reach = (offset[0] * edge[1] - offset[1] * edge[0]) / (ray[0] * edge[1] - ray[1] * edge[0])
        s = 0.5 * (t + 1)  # ρ = reach s⁴
        rho, where = np.outer(s**4, reach), np.broadcast_to(theta, (60, 60))
        where = np.where(where > np.pi, where - 2 * np.pi, where)
        area = 0.5 * turn * np.outer(0.5 * weights * 4 * s**3, weights * reach) * rho
        norm = np.sqrt((f(rho, where) ** 2 * area).sum())
        measure = area.sum()
        near = np.linalg.norm(hats.T @ (corners[..., 0] - POINT), axis=1).min()
        largest = np.abs(f(np.full(60, near * (1 - 1e-6)), where[0])).max() if shift == 0 else 0.0
        assert 2 * rough * np.sqrt(measure) >= norm + largest * np.sqrt(measure) - 1e-9
        assert 2 * missed * measure >= (np.abs(f(rho, where)) * area).sum()
        assert missed <= rough < 30 * norm / np.sqrt(measure)
        # a part of a triangle has as much less as the power says
        small = np.array(POINT)[:, None, None] + 1e-3 * (corners.transpose(1, 0, 2) - POINT_3)
        smaller = allowance(expression, small.transpose(1, 0, 2), hats)[0][0]
        if shift == 0 and number not in (1, 5):
            assert smaller == pytest.approx(rough * 1e-3**power, rel=0.2)


CLEARANCE = 0.18
POINT_3 = np.array(POINT)[:, None, None]


def test_what_has_no_integral_has_no_bound():
    x = ufl.SpatialCoordinate(MESH.mesh(MESH.diameter, MPI.COMM_SELF).mesh)
    r2 = (x[0] - POINT[0]) ** 2 + (x[1] - POINT[1]) ** 2
    corners = np.array([POINT, (0.8, 0.1), (0.2, 0.7)])[:, :, None]
    hats = np.full((3, 1), 1 / 3)
    assert np.isinf(allowance(lowered(1 / ufl.sqrt(r2)), corners, hats)[0][0])
    assert np.isinf(allowance(lowered(1 / (x[0] - POINT[0])), corners, hats)[0][0])
    assert np.isfinite(allowance(lowered(r2**-0.45), corners, hats)[0][0])


@pytest.mark.parametrize("kind", ["squares", "power"])
def test_numbers_with_too_many_digits_are_given_up(kind):
    """Constants are exact, and would have 2⁴⁰ digits; nothing known is an answer."""
    x = ufl.SpatialCoordinate(MESH.mesh(MESH.diameter, MPI.COMM_SELF).mesh)
    r2 = (x[0] - POINT[0]) ** 2 + (x[1] - POINT[1]) ** 2
    factor = x[0] + 0.3
    for _ in range(40 if kind == "squares" else 0):
        factor = factor * factor
    if kind == "power":
        factor = factor**1e12
    corners = np.array([POINT, (0.8, 0.1), (0.2, 0.7)])[:, :, None]
    found = allowance(lowered(factor * r2**-0.25), corners, np.full((3, 1), 1 / 3))
    assert not np.isnan(found).any()


def first_inside(expression, corners):
    """A singular point, who holds it, and where it is there; None where there is none."""
    for point in singular_points(expression, corners):
        which, hats = holders(point, corners)
        if len(which):
            return point, which, hats
    return None


def test_points_inside_are_found():
    x = ufl.SpatialCoordinate(MESH.mesh(MESH.diameter, MPI.COMM_SELF).mesh)
    expression = lowered(((x[0] - POINT[0]) ** 2 + (x[1] - POINT[1]) ** 2) ** -0.4)
    corners = np.array([(0.0, -0.5), (0.9, -0.4), (0.2, 0.7)])[:, :, None]
    point, which, hats = first_inside(expression, corners)
    assert point.tolist() == list(POINT) and which.tolist() == [0]
    assert np.allclose(hats[:, 0] @ corners[:, :, 0], POINT)
    apart = np.array([POINT, (0.9, -0.4), (0.2, 0.7)])[:, :, None]
    assert first_inside(expression, apart) is None


@pytest.mark.parametrize("scale", [1e-12, 1.0, 1e9])
def test_points_of_many_peaks_are_found_one_by_one(scale):
    """As many as there are peaks, not as many as there are pairs of their numbers."""
    x = ufl.SpatialCoordinate(MESH.mesh(MESH.diameter, MPI.COMM_SELF).mesh)
    places = scale * np.random.default_rng(0).uniform(0.05, 0.45, (120, 2))
    distances = [ufl.sqrt((x[0] - float(a)) ** 2 + (x[1] - float(b)) ** 2) for a, b in places]
    corners = scale * np.array([(0.0, 0.0), (1.0, 0.0), (0.0, 1.0)])[:, :, None]

    def joined(parts, join):
        middle = len(parts) // 2
        halves = [joined(half, join) for half in (parts[:middle], parts[middle:]) if middle]
        return join(*halves) if halves else parts[0]

    tracemalloc.start()
    product = joined(distances, operator.mul)
    for peaks in (joined([r**-0.5 for r in distances], operator.add), 1 / ufl.sqrt(product)):
        found = singular_points(lowered(peaks), corners)
        assert np.array_equal(sorted(map(tuple, found)), sorted(map(tuple, places)))
    # a denominator with all of the numbers would take 240² looks at it, and is given up
    assert singular_points(lowered(1 / (1 + joined(distances, operator.add))), corners) == []
    assert tracemalloc.get_traced_memory()[1] < 2e8
    tracemalloc.stop()


def test_slivers_at_a_singular_point_are_not_cut_into_slabs():
    """A vertex that is near a singular point leaves a sliver, which has a bound as a triangle."""
    domain = exact.S1.structured(1, MPI.COMM_SELF)
    cells = Cells(domain, function_space(domain.mesh, "CR"), (DIRICHLET,))
    x = ufl.SpatialCoordinate(domain.mesh)
    deviation = Deviation(x[0] ** 4 * (x[0] ** 2 + x[1] ** 2) ** -0.25)
    corners = np.array([[1.6e-3, 3.4e-3], [0.0, 0.0], [-2.75e-12, 0.0]])[:, :, None]
    sliver = Pieces(np.zeros(1, dtype=int), corners, np.eye(3)[:, :, None], np.ones(1))

    def errors(boxes, half):
        rough, missed = deviation(Enclosure(boxes), half, hats=np.full((3, 1), 1 / 3))
        return np.stack([missed, rough**2])

    weights = np.array([[1e3], [0.0]]) / errors_on(sliver, errors, cells)
    pieces, found = refine(
        sliver, lambda p: errors_on(p, errors, cells), weights, 300, cells, deviation.apart
    )
    assert np.isfinite(found).all()
    assert len(pieces.share) < 20


@pytest.mark.parametrize("off", [0.0, 3e-17, -3e-17, 4e-14, -4e-14])
def test_a_singular_point_on_a_side(off):
    """Whichever way that was rounded, the triangle is cut there, and what is left has bounds."""
    x = ufl.SpatialCoordinate(MESH.mesh(MESH.diameter, MPI.COMM_SELF).mesh)
    expression = lowered(ufl.sqrt(x[0] ** 2 + x[1] ** 2) ** -0.5)
    corners = np.array([[-3e-12, off], [0.5, off], [0.2, 0.4]])[:, :, None]
    point, which, hats = first_inside(expression, corners)
    assert (point == 0.0).all() and which == [0]
    assert hats.min() >= 0.0 and np.isclose(hats.sum(), 1.0)
    deviation = Deviation(expression)
    pieces = Pieces(np.zeros(1, dtype=int), corners, np.eye(3)[:, :, None], np.ones(1))
    cut = deviation.apart(pieces)
    assert first_inside(expression, cut.corners) is None
    assert np.isclose(cut.share.sum(), 1.0, rtol=1e-12)
    rule = np.array([[0.6, 0.2, 0.2], [0.2, 0.6, 0.2], [0.2, 0.2, 0.6]])
    assert np.isfinite(allowance(expression, cut.corners, rule)[0]).any()
