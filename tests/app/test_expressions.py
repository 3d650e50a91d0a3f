"""Expressions: both readings agree with Python's own arithmetic, and bad ones say what is wrong."""

import math
import re
import sys
import time
from fractions import Fraction

import numpy as np
import pytest
import ufl
from dolfinx import fem, mesh
from mpi4py import MPI
from ufl.corealg.traversal import unique_post_traversal

from signorini_cr.app.cli import room_for_recursion
from signorini_cr.app.expressions import DEEPEST, LARGEST, LONGEST_CHAIN, check_name, parse
from signorini_cr.errors import InputError

GOOD = [
    "2",
    "1/2",
    "-x**2 + +y",
    "2**3**x / 2**-1",
    "(x - 3)**-2 + (x - 7)**3 + x**0",
    "sqrt(2 + x) + exp(x) + log(2 + x) + sin(x) + cos(x) + tan(x)",
    "asin(x/2) + acos(x/2) + atan(x) + atan2(y, x) + sinh(x) + cosh(x) + tanh(x)",
    "abs(x) + sign(x) * pi",
    "min(x, y, 0.3) - max(x, -y)",
    "where(-0.5 < x <= 0.5 and not y > 0.5 or x == y, x, 1)",
    "where(x > 0, log(x), 0) + where(1 < 2, x, 1/x) + where(2 != 2, 1, y)",
    "where(x >= 0 and 1 > 0, 1, 2) + where(x < 0 or 0 > 1, 1, 2)",
    "0*x + x*0 + 0/(x + 9)",
    "sqrt(where(x > -5, 3 + x, -1)) + where(x < 9, 3 + x, -1)**0.5 + where(y > -3, 3 + y, 0)**-2",
    "min(x, pi)**1e300 + sqrt(where(x > -5, where(y < -5, 2, 4 + x), -1))",
]
PYTHON = {name: getattr(math, name) for name in "sqrt exp log sin cos tan sinh cosh tanh".split()}
PYTHON |= {name: getattr(math, name) for name in "asin acos atan atan2 pi".split()}
PYTHON |= {"abs": abs, "min": min, "max": max, "sign": lambda a: (a > 0) - (a < 0)}


def by_python(text: str, x: float, y: float) -> float:
    """The value by Python itself; `where` must not look at the branch that is not taken."""
    text = text.replace("log(x)", "(log(x) if x > 0 else 0)")
    return eval(text, PYTHON | {"where": lambda c, a, b: a if c else b, "x": x, "y": y})


def little_mesh() -> mesh.Mesh:
    corners = [np.array([-1.0, 0.0]), np.array([1.1, 1.0])]
    return mesh.create_rectangle(MPI.COMM_WORLD, corners, [4, 3])


def in_cells(value, domain) -> np.ndarray:
    """A UFL expression at one point of each cell of this rank."""
    point = np.array([[0.3, 0.4]])
    cells = np.arange(domain.topology.index_map(2).size_local, dtype=np.int32)
    if isinstance(value, float):
        return np.full(len(cells), value)
    return (
        fem.Expression(value, point, comm=domain.comm).eval(domain, cells).reshape(len(cells), -1)
    )


@pytest.mark.parametrize("text", GOOD)
def test_both_readings_agree_with_python(text: str) -> None:
    domain = little_mesh()
    x = ufl.SpatialCoordinate(domain)
    expression = parse(text)
    points = in_cells(x, domain)
    exact = [by_python(text, *point) for point in points.tolist()]
    assert np.allclose(expression.numpy(points), exact, rtol=1e-13, atol=1e-13)
    value = expression.ufl(x)
    assert isinstance(value, float) == (expression.constant is not None)
    assert np.allclose(in_cells(value, domain).ravel(), exact, rtol=1e-13, atol=1e-13)


@pytest.mark.parametrize(
    "text, laplacian",
    [
        ("max(0, x)**1.5", "where(x > 0, 0.75*max(x, 1e-9)**-0.5, 0)"),
        ("where(x > 0, x**3, 0)", "where(x > 0, 6*x, 0)"),
        ("sqrt(max(0, x)) * y**2", "where(x > 0, 2*sqrt(abs(x)) - 0.25*y**2*abs(x)**-1.5, 0)"),
        ("abs(x)**3", "6*abs(x)"),
        ("(x**2 + y**2)**0.75 * cos(1.5*atan2(y, x))", "0"),
        ("where(x > 0, x**6*sin(pi/x)**2, 0)", None),
        ("sqrt(where(x > -5, 3 + x, -1))", "-0.25*(3 + x)**-1.5"),
        ("where(x > 9, 0, where(x > 8, y, 3 + x))**-2", "6*(3 + x)**-4"),
    ],
)
def test_derivatives_stay_within_the_branches(text: str, laplacian: str | None) -> None:
    domain = little_mesh()
    x = ufl.SpatialCoordinate(domain)
    found = in_cells(ufl.div(ufl.grad(parse(text).ufl(x))), domain).ravel()
    assert np.isfinite(found).all()
    if laplacian is not None:
        points = in_cells(x, domain)
        assert np.allclose(found, parse(laplacian).numpy(points), rtol=1e-9, atol=1e-9)


def test_names_stand_for_what_was_defined() -> None:
    names = {"r": parse("sqrt(x**2 + y**2)")}
    names["inside"] = parse("r < 1", names)
    expression = parse("where(inside, 1 - r, 0)", names)
    assert names["inside"].is_condition and not expression.is_condition
    points = np.array([[0.3, 0.4], [3.0, 4.0]])
    assert np.allclose(expression.numpy(points), [0.5, 0.0])


def test_doubling_definitions_cost_no_more_than_their_length() -> None:
    """a = x + x, b = a + a, …: 2¹⁰⁰ terms when written out, and some 300 operations."""
    expression = parse("x")
    for _ in range(100):
        expression = parse("a*0.5 + a*0.5", {"a": expression})
    assert expression.numpy([[0.7, 0.0]]) == pytest.approx(0.7)
    made = set(unique_post_traversal(expression.ufl(ufl.SpatialCoordinate(little_mesh()))))
    assert len(made) < 600
    assert in_cells(expression.ufl(ufl.SpatialCoordinate(little_mesh())), little_mesh()).size


def test_a_constant_is_known() -> None:
    assert parse("1/2").constant == 0.5
    assert isinstance(parse("2").constant, float)
    assert parse("x").constant is None
    assert parse(" 1 +\n  1 ").constant == 2.0


def test_what_is_not_finite_comes_out_as_such() -> None:
    values = parse("1/x").numpy([[0.0, 0.0], [2.0, 0.0]])
    assert np.isinf(values[0]) and values[1] == 0.5
    assert parse("where(x > 0, 1/x, 0)").numpy([[0.0, 0.0]]) == 0.0


BAD = {
    "": "empty",
    "1 + sine(x)": "no function 'sine'; did you mean sin?",
    "ln(x)": "did you mean log?",
    "lne(x)": "sqrt, exp, log",
    "foo": "no name 'foo'; names are x, y, pi and r",
    "later + 1": "defined only further down",
    "sin": "needs its arguments",
    "x(2)": "'x' is not a function; a product is written with *",
    "2(x)": "a product is written with *",
    "2x": "a product is written with *",
    "x^2": "a power is written **",
    "x // 2": "//",
    "x % 2": "%",
    "x = 1": "equality is written ==",
    "sin(x": "'(' is never closed",
    "x)": "unmatched ')'",
    "x +": "missing at the end",
    "x y": "cannot be read from here",
    "x # radius": "'#'",
    "x − 1": "invalid character '−'",
    "x\x00": "cannot be printed",
    "sin()": "one argument, but none is given",
    "atan2(y)": "two arguments, but 1 is given",
    "min(x)": "two arguments or more",
    "where(x < 0, 1)": "(condition, a, b)",
    "where(x, 1, 0)": "condition such as x < 0",
    "x and 1": "condition such as x < 0",
    "not x": "condition such as x < 0",
    "1 + (x < 0)": "a number belongs here",
    "where(x < 0, y < 0, 1)": "a number belongs here",
    "x < y < (1 < 2)": "a number belongs here",
    "x > 0 & y > 0": "'and', not &",
    "x if y else 1": "where(condition, a, b)",
    "x in y": "<, <=",
    "x.real": "a dot",
    "[x]": "square brackets",
    "(x, y)": "a comma",
    "'x'": "not a number",
    "True": "not a number",
    "2j": "not a number",
    "lambda: 1": "lambda",
    "__import__('os').system('true')": "a dot is not part of the language",
    "sin(x=1)": "plain arguments",
    "sin(*x)": "not part of the language",
    "(x := 1)": "not part of the language",
    "[x for x in y]": "not part of the language",
    "1/0": "divides by zero",
    "x/(1 - 1)": "divides by zero",
    "x/(0*y)": "divides by zero",
    "0**x": "must be above 0",
    "log(0)": "infinite",
    "sqrt(-1)": "not a real number",
    "9**9**9": "too large",
    "10**400": "too large",
    "1e999": "too large",
    "9" * 5000: "too many digits",
    "(1 - " * 180 + "x" + ")" * 180: "nested deeper",
    "(" * 3000 + "x" + ")" * 3000: "nested deeper",
    "sin(" * 180 + "x" + ")" * 180: "nested deeper",
    "-" * 9000 + "x": "nested deeper",
    "x + " * 3000 + "x": "at most 10000",
}


@pytest.mark.parametrize("text", BAD, ids=lambda text: text[:20])
def test_bad_expressions_say_what_is_wrong(text: str) -> None:
    began = time.perf_counter()
    with pytest.raises(InputError) as caught:
        parse(text, {"r": parse("x")}, later=["later"])
    message = str(caught.value)
    assert BAD[text] in message
    assert time.perf_counter() - began < 1.0
    for line in message.split("\n")[1:]:  # the picture fits a terminal
        assert line.startswith("    ") and len(line) <= 80


@pytest.mark.parametrize(
    "text",
    ["exp(-800)*exp(800*x)", "1e-200*1e-200*x", "0.5**2000 + x", "1e-300/1e300", "x + 1e-400"],
)
def test_a_constant_below_all_numbers_is_no_zero(text: str) -> None:
    """With 0 for it a boundary layer would be gone, and nothing said."""
    with pytest.raises(InputError, match="this constant is below all numbers, but not 0"):
        parse(text)


@pytest.mark.parametrize("text", ["0*1e-200", "0.00e5", "0/3 + 0**2", "sin(0)", "log(1)", "-0.0"])
def test_what_is_0_is_0(text: str) -> None:
    assert parse(text).constant == 0.0


def test_the_picture_points_at_the_part() -> None:
    with pytest.raises(InputError) as caught:
        parse("1 + sine(x)")
    assert str(caught.value).endswith("\n    1 + sine(x)\n        ^^^^")
    with pytest.raises(InputError) as caught:
        parse("x*x + " * 30 + "é + oops + " + "y + " * 30 + "1", {"é": parse("x")})
    line, mark = str(caught.value).split("\n")[1:]
    assert line[mark.index("^") : mark.rindex("^") + 1] == "oops"


def test_a_long_sum_is_not_deep_but_may_be_too_large() -> None:
    names = {"a": parse("+".join(["x"] * 4000))}
    assert names["a"].numpy([[2.0, 0.0]]) == 8000.0
    with pytest.raises(InputError, match=f"at most {LARGEST}"):
        parse("a + " + " + ".join(["x"] * 3000), names)


@pytest.mark.parametrize(
    "text",
    [
        " + ".join(["x*y - 1"] * 900),
        "*".join(["x"] * 4000),
        "/".join(["x"] * LONGEST_CHAIN),
        "sin(" * (DEEPEST - 1) + "x" + ")" * (DEEPEST - 1),
    ],
    ids=["sum", "product", "quotient", "nested"],
)
def test_ufl_takes_what_is_long_or_deep(text: str) -> None:
    square = mesh.create_unit_square(MPI.COMM_WORLD, 1, 1)
    before = sys.getrecursionlimit()
    value = parse(text).ufl(ufl.SpatialCoordinate(square))
    assert sys.getrecursionlimit() == before
    with room_for_recursion():  # as the command leaves it
        fem.form(ufl.inner(ufl.grad(value), ufl.grad(value)) * ufl.dx(square, degree=1))
    assert sys.getrecursionlimit() == before


def test_data_that_nobody_differentiates_need_no_room_for_recursion() -> None:
    square = mesh.create_unit_square(MPI.COMM_WORLD, 1, 1)
    for text in ("sin(" * 100 + "x" + ")" * 100, "+".join(["x*y"] * 1100)):
        value = parse(text).ufl(ufl.SpatialCoordinate(square))
        fem.form(value * ufl.dx(square, degree=1))


def test_what_is_too_deep_for_ufl() -> None:
    with pytest.raises(InputError, match="251 operations one upon the other; at most 250"):
        parse("/".join(["x"] * (LONGEST_CHAIN + 1)))


def test_sums_by_pairs_keep_their_signs() -> None:
    rng = np.random.default_rng(1)
    for count in range(1, 20):
        numbers, signs = rng.uniform(1, 2, count), rng.choice([-1, 1], count)
        text = "x" + "".join(
            f" {'-' if s < 0 else '+'} {n}*x" for s, n in zip(signs, numbers, strict=True)
        )
        assert parse(text).numpy([[1.0, 0.0]]) == pytest.approx(1.0 + signs @ numbers)


def test_operations_by_pairs_keep_their_order() -> None:
    """As Python reads them, in exact arithmetic."""
    rng = np.random.default_rng(2)
    for _ in range(300):
        text = "x"
        for _ in range(rng.integers(1, 9)):
            number = rng.integers(1, 4)
            if rng.random() < 0.2:
                text = f"({text})"
            text += f" {rng.choice(list('+-*/'))} {number}"
        names = {"x": Fraction(3, 7), "Fraction": Fraction}
        wanted = eval(re.sub(r"\d+", r"Fraction(\g<0>)", text), names)
        found = parse(text).numpy([[3 / 7, 0.0]])
        assert found == pytest.approx(float(wanted), rel=1e-12, abs=1e-10), text


@pytest.mark.parametrize(
    "name", ["2r", "a b", "", "and", "x", "pi", "sin", "True", "a-b", "a()", "𝑥", "ｐｉ"]
)
def test_names_that_cannot_be_used(name: str) -> None:
    with pytest.raises(InputError):
        check_name(name)


def test_names_that_can() -> None:
    assert check_name("r_1") == "r_1"
    assert check_name("α") == "α"
    assert check_name("ﬁ") == "fi"  # as Python reads it where it is used
