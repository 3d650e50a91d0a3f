"""Formulas in scalar operators: the same as UFL's, in as many steps as there are operations."""

from __future__ import annotations

from typing import Any

import basix.ufl
import numpy as np
import pytest
import ufl
from ufl.algorithms.apply_algebra_lowering import apply_algebra_lowering
from ufl.algorithms.apply_derivatives import apply_derivatives
from ufl.algorithms.expand_indices import expand_indices
from ufl.corealg.traversal import unique_pre_traversal

from signorini_cr.fem.lowering import by_components
from signorini_cr.fem.pointwise import evaluate
from signorini_cr.fem.simplified import simplified

MESH = ufl.Mesh(basix.ufl.element("Lagrange", "triangle", 1, shape=(2,)))
X = ufl.SpatialCoordinate(MESH)
MANY = 60


def _nested(count: int, last: float = 7.0) -> Any:
    """Return the largest of count + 1 numbers, each maximum within the next one."""
    found = X[0]
    for i in range(count):
        other = X[1] / last if i % 2 else -(i + 1) * X[0]
        found = ufl.conditional(ufl.gt(found, other), found, other)
    return found


def _size(expression: Any) -> int:
    return sum(1 for _ in unique_pre_traversal(expression))


@pytest.mark.parametrize("count", [3, 6])
def test_it_is_what_ufl_makes(count: int) -> None:
    x, y = X
    u = _nested(count) * y**2
    v = ufl.Coefficient(ufl.FunctionSpace(MESH, MESH.ufl_coordinate_element()))
    tensor = ufl.as_matrix([[2 + x**2, y], [y, 3]])
    for e in (u, -ufl.div(tensor * ufl.grad(u)), u.dx(1), ufl.dot(v, v) + u * ufl.div(v)):
        wanted = expand_indices(apply_derivatives(apply_algebra_lowering(e)))
        assert by_components(e) == wanted


def test_what_is_used_twice_is_worked_on_once() -> None:
    """Each maximum uses the one within it twice: 2⁶⁰ ways lead to the innermost."""
    few, many = (_size(by_components(-ufl.div(ufl.grad(_nested(n))))) for n in (20, MANY))
    assert many < 1.5 * MANY / 20 * few
    assert _size(by_components(_nested(MANY))) < 8 * MANY


def test_sizes_of_sizes_are_sizes() -> None:
    """UFL takes |x| for ||x||, which must not become a part of itself."""
    x = X[0]
    point = np.array([[-0.3, 0.2, 0.0]])
    for size in (abs(abs(x)), abs(1 * abs(x)), abs(abs(abs(x)))):
        assert not any(e in e.ufl_operands for e in unique_pre_traversal(size))
        assert evaluate(by_components(size), point)[0] == 0.3
    assert _size(simplified(-ufl.div(ufl.grad(abs(abs(x)) ** 3)))) < 40


def test_formulas_made_twice_are_equal() -> None:
    """UFL's sets and dicts ask for it, for all that is in a form."""
    one, two, other = _nested(MANY), _nested(MANY), _nested(MANY, 7.5)
    assert one is not two
    assert one == two and hash(one) == hash(two)
    assert one != other
    assert one.ufl_operands is two.ufl_operands  # the next comparison ends at once
    assert len({_nested(MANY), _nested(MANY), other}) == 2


def test_a_formula_is_made_shorter_the_second_time_as_well() -> None:
    """Now it is known, which takes a comparison."""
    points = np.array([[0.3, 0.2, 0.0], [-0.4, 0.9, 0.0]])
    for _ in range(2):
        found = simplified(-ufl.div(ufl.grad(_nested(MANY) + X[0] ** 2)))
        assert _size(found) < 40 * MANY
        assert np.allclose(evaluate(found, points)[0], -2.0)
