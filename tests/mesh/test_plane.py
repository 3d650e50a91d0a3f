"""Geometry of the plane against rational arithmetic, which floats of few digits are exact in."""

from fractions import Fraction

import numpy as np
import pytest

from signorini_cr.mesh.plane import (
    angle,
    cross,
    crossing,
    distance,
    ends_in_words,
    in_words,
    share,
    side,
)

pytestmark = pytest.mark.serial
RANDOM = np.random.default_rng(1)
# on a coarse grid, so that many points coincide, or lie on lines through others
A, B, C, D = RANDOM.integers(-3, 4, (4, 2000, 2)) / 4


def exact_cross(u, v):
    (a, b), (c, d) = ([Fraction(x) for x in each] for each in (u, v))
    return a * d - b * c


def sign(x):
    return (x > 0) - (x < 0)


def test_cross_products_and_sides():
    wanted = [exact_cross(b - a, c - a) for a, b, c in zip(A, B, C, strict=True)]
    assert cross(B - A, C - A).tolist() == wanted
    for near in (0.0, 1e-12):
        assert side(A, B, C, near).tolist() == [sign(x) for x in wanted]
    assert set(side(A, B, C)) == {-1, 0, 1}
    one = side(A[0], B[0], C)  # a line and many points
    assert one.tolist() == [sign(exact_cross(B[0] - A[0], c - A[0])) for c in C]


def test_a_point_near_a_line_is_on_it():
    a, b = np.array([0.0, 0.0]), np.array([1.0, 1.0])
    x = np.array([[0.5, 0.5 + 1e-14], [0.5, 0.5 + 1e-9], [0.5 + 1e-9, 0.5]])
    assert side(a, b, x).tolist() == [1, 1, -1]
    assert side(a, b, x, 1e-12).tolist() == [0, 1, -1]


def test_segments_cross_where_their_lines_do_inside_both():
    wanted = []
    for a, b, c, d in zip(A, B, C, D, strict=True):
        det = exact_cross(b - a, d - c)
        t, s = ((exact_cross(c - a, w) / det if det else 0) for w in (d - c, b - a))
        wanted.append(0 < t < 1 and 0 < s < 1)
    for near in (0.0, 1e-12):
        assert crossing(A, B, C, D, near).tolist() == wanted
    assert 100 < sum(wanted) < 1900


def test_feet_and_distances():
    some = (A != B).any(axis=1)
    shares, found = share(A[some], B[some], C[some]), distance(C[some], A[some], B[some])
    for a, b, c, t, r in zip(A[some], B[some], C[some], shares, found, strict=True):
        u, v = ([Fraction(x) for x in each] for each in (b - a, c - a))
        exact = sum(x * y for x, y in zip(u, v, strict=True)) / sum(x * x for x in u)
        assert t == float(exact)
        nearest = min(max(exact, 0), 1)
        square = sum((nearest * x - y) ** 2 for x, y in zip(u, v, strict=True))
        assert r == pytest.approx(float(square) ** 0.5, rel=1e-14, abs=1e-15)


def test_angles():
    u = np.array([[1.0, 0.0], [1.0, 0.0], [1.0, 0.0], [0.0, 2.0], [1.0, 1.0]])
    v = np.array([[0.0, 3.0], [0.0, -3.0], [-1.0, 0.0], [0.0, 1.0], [-1.0, 0.0]])
    assert angle(u, v) == pytest.approx(np.pi * np.array([0.5, -0.5, 1.0, 0.0, 0.75]), rel=1e-15)


def test_words():
    assert in_words(np.array([0.1, -2.0])) == "(0.1, -2)"
    assert in_words(np.array([1e-7, 0.0, 1234567.0])) == "(1e-07, 0, 1.23457e+06)"
    assert ends_in_words(np.array([[0.0, 1.0], [2.5, 3.0]])) == "from (0, 1) to (2.5, 3)"
