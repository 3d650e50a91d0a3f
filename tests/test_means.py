"""Integrals of u: orders of their intervals, which hold what is known in closed form."""

from functools import cache

import numpy as np
import pytest
import ufl
from helpers import on_the_square, orders, widths_of

from signorini_cr import Contact, Dirichlet, Neumann, Problem, means

pytestmark = pytest.mark.slow

BESIDE = {"left": Neumann(), "right": Neumann()}


@cache
def out_of_reach():
    """−u'' + 9 u = 1, u'(0) = 0, u(1) = 1; solved once for all that is asked of it."""
    conditions = {"floor": Contact(-3.0), "top": Dirichlet(1.0)} | BESIDE
    return on_the_square(Problem(f=1.0, reaction=9.0, conditions=conditions))


@cache
def pressed(loss):
    """u = 5 y² − 6 y and λ = 6 with f = −10; likewise."""
    conditions = {"floor": Contact(0.0, coefficient=loss), "top": Dirichlet(-1.0)} | BESIDE
    return on_the_square(Problem(f=-10.0, conditions=conditions))


def widths(solutions, where=None, weight=None, inside=None):
    """Of the integrals' intervals."""
    return widths_of([means.integral(each, where, weight)[1:] for each in solutions], inside)


def bent(x):
    return x[0] * (1 - x[0]) + x[1]


def wavy(x):
    return ufl.sin(3 * x[1])


@pytest.mark.parametrize("where, weight", [(None, None), ("floor", None), (None, wavy)])
def test_contact_that_never_comes_about(where, weight):
    """λ is at most what the gap leaves over the distance: h²."""
    c = (8 / 9) / np.cosh(3)
    exact = {
        (None, None): 1 / 9 + c * np.sinh(3) / 3,
        ("floor", None): 1 / 9 + c,
        # ∫ sin 3y (1/9 + c cosh 3y)
        (None, wavy): (1 - np.cos(3)) / 27
        + c * (3 * np.sinh(3) * np.sin(3) - 3 * np.cosh(3) * np.cos(3) + 3) / 18,
    }[where, weight]
    found = widths(out_of_reach(), where, weight, exact)
    assert (abs(orders(found)[1:] - 2.0) < 0.2).all()


@pytest.mark.parametrize("loss", [0.0, 5.0])
@pytest.mark.parametrize(
    "where, weight, exact",
    [
        (None, None, -4 / 3),
        ("floor", None, 0.0),
        (None, bent, -4 / 18 - 3 / 4),
        # ∫ sin 3y (5 y² − 6 y)
        (
            None,
            wavy,
            5 * (6 * np.sin(3) - 7 * np.cos(3) - 2) / 27 - 6 * (np.sin(3) - 3 * np.cos(3)) / 9,
        ),
    ],
)
def test_contact_all_along(where, weight, exact, loss):
    """u − α is at most what the gap leaves over λ: h²."""
    found = widths(pressed(loss), where, weight, exact)
    assert (abs(orders(found) - 2.0) < 0.1).all()


def test_one_part_held_and_one_free():
    """Contact at the bottom, from above and out of reach on the right."""
    conditions = {
        "floor": Contact(0.0),
        "right": Contact(upper=9.0),
        "top": Dirichlet(-1.0),
        "left": Neumann(),
    }
    found = widths(on_the_square(Problem(f=-10.0, conditions=conditions)), inside=-4 / 3)
    assert (abs(orders(found) - 2.0) < 0.1).all()


def test_a_weight_on_a_part_in_contact():
    """u = 0 there; what is known is of the first order."""
    found = widths(pressed(0.0)[:3], "floor", lambda x: x[0], 0.0)
    assert (orders(found) > 0.8).all()


def test_contact_that_begins_somewhere():
    """Where nothing more is known the width is of the first order."""
    load = lambda x: ufl.conditional(ufl.lt(x[0], 0.5), -8.0, 8.0)  # noqa: E731
    conditions = {"floor": Contact(0.0), "top": Dirichlet(0.0)} | BESIDE
    found = widths(on_the_square(Problem(f=load, conditions=conditions)))
    assert (orders(found) > 0.8).all() and (orders(found) < 1.7).all()
