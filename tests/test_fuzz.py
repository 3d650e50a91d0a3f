"""Input that nobody would write: expressions, problem files and problems drawn at random.

    container/run python3 tests/test_fuzz.py --expressions 100000 --files 20000 --problems 3000

draws as many as one likes and prints how they ended; under pytest there are few, always the same.
Under mpirun each problem is solved by all ranks together, and by each alone.
"""

from __future__ import annotations

import argparse
import ast
import contextlib
import functools
import io
import json
import math
import shutil
import tempfile
import time
import tomllib
import zlib
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import basix.ufl
import numpy as np
import pytest
import ufl
from helpers import MESHES, undrawn
from hypothesis import HealthCheck, example, given, seed, settings
from hypothesis import strategies as st
from mpi4py import MPI

from signorini_cr.app import cli, problemfile
from signorini_cr.app.expressions import parse
from signorini_cr.errors import InputError, NotConverged, fail_together
from signorini_cr.fem.pointwise import evaluate
from signorini_cr.fem.simplified import simplified
from signorini_cr.solution import Solution

few = settings(
    derandomize=True, database=None, deadline=None, max_examples=60,
    suppress_health_check=list(HealthCheck),
)  # fmt: skip
ENDS: Counter[str] = Counter()
"""Ends of the examples of a long run."""
SECONDS = 20.0
"""Nothing that is drawn here takes a second; this is for machines that are busy."""


# Expressions

ONE = ("sqrt", "exp", "log", "sin", "cos", "tan", "asin", "acos", "atan", "sinh", "cosh", "tanh")
ONE = (*ONE, "abs", "sign")
numbers = st.one_of(
    st.integers(0, 9).map(str),
    st.floats(0, 20, width=16).map(repr),
    st.sampled_from(["1e300", "1e-300", "5e-324", ".5", "3.", "1_000", "12345678901234567890"]),
)
leaves = st.one_of(st.sampled_from(["x", "y", "pi"]), numbers)


def _larger(inner: st.SearchStrategy[str]) -> st.SearchStrategy[str]:
    condition = st.builds(
        "{} {} {}".format, inner, st.sampled_from("< <= > >= == !=".split()), inner
    )
    conditions = st.one_of(
        condition,
        condition.map("not ({})".format),
        st.builds("({}) {} ({})".format, condition, st.sampled_from(["and", "or"]), condition),
    )
    return st.one_of(
        st.builds("({}) {} ({})".format, inner, st.sampled_from(["+", "-", "*", "/", "**"]), inner),
        st.builds("{} {} {}".format, leaves, st.sampled_from(["+", "-", "*", "/", "**"]), inner),
        inner.map("-({})".format),
        st.builds("{}({})".format, st.sampled_from(ONE), inner),
        st.builds("atan2({}, {})".format, inner, inner),
        st.builds("{}({}, {})".format, st.sampled_from(["min", "max"]), inner, inner),
        st.builds("where({}, {}, {})".format, conditions, inner, inner),
    )


expressions = st.recursive(leaves, _larger, max_leaves=12)
JUNK = (
    "(",
    ")",
    ",",
    "**",
    "^",
    "=",
    "==",
    "<",
    "and",
    "not",
    "lambda",
    "x.y",
    "[0]",
    "'",
    '"',
    "#",
)
JUNK = (
    *JUNK,
    "\\",
    "\n",
    "\t",
    "\0",
    "é",
    "∞",
    "e",
    "1e",
    "0x1",
    "1j",
    "nan",
    "inf",
    "where(",
    "…",
)
JUNK = (*JUNK, "((((((((", "9" * 400, "__import__('os')", ":=", "if", "*", ";", "\u202e", "½")


@st.composite
def damaged(draw: st.DrawFn, texts: st.SearchStrategy[str], junk: tuple[str, ...] = JUNK) -> str:
    """A text with pieces cut out, doubled, exchanged, or put in."""
    text = draw(texts)
    for _ in range(draw(st.integers(1, 3))):
        a, b = sorted(draw(st.tuples(*[st.integers(0, len(text))] * 2)))
        b = min(b, a + 12)
        piece = draw(st.sampled_from(["", text[a:b] * 2, text[a:b][::-1], *junk]))
        text = text[:a] + piece + text[b:]
    return text


class _Floats(ast.NodeTransformer):
    def visit_Constant(self, node: ast.Constant) -> ast.AST:
        new = ast.Call(ast.Name("number", ast.Load()), [ast.Constant(float(node.value))], [])
        return ast.copy_location(new, node)


def _sign(value: Any) -> Any:
    return np.float64(np.sign(value))


class Undefined(Exception):
    """Rounding, or the sign of a zero, decides on the value."""


def _atan2(y: Any, x: Any) -> Any:
    """On its cut the sign of a zero decides, which folding constants does not keep."""
    if y == 0.0 and x <= 0.0:
        raise Undefined
    return np.arctan2(y, x)


NAMES: dict[str, Callable[..., Any]] = {
    name: getattr(np, {"asin": "arcsin", "acos": "arccos", "atan": "arctan"}.get(name, name))
    for name in ONE
}
NAMES |= {"atan2": _atan2, "min": min, "max": max, "number": np.float64, "sign": _sign}
NAMES["where"] = lambda condition, yes, no: yes if condition else no


def by_python(text: str, x: float, y: float, off: float = 0.0) -> float:
    """The value that Python finds, if each function is off by a part of its value."""
    tree = _Floats().visit(ast.parse(" ".join(text.split()), mode="eval"))
    ast.fix_missing_locations(tree)
    names = {**NAMES, "x": np.float64(x), "y": np.float64(y), "pi": np.float64(math.pi)}
    if off:
        names |= {
            name: lambda *given, function=function: function(*given) * np.float64(1 + off)
            for name, function in NAMES.items()
            if name not in ("number", "where")
        }
    # Constants are folded, 0 times what is not finite to 0
    with (
        np.errstate(all="raise", under="ignore"),
        contextlib.suppress(Undefined, FloatingPointError),
    ):
        return float(eval(compile(tree, "text", "eval"), {"__builtins__": {}}, names))
    return math.nan


POINTS = np.array([[0.3, 0.7], [-1.25, 0.5], [2.0, -3.0], [0.0, 1.0]])
X = ufl.SpatialCoordinate(ufl.Mesh(basix.ufl.element("Lagrange", "triangle", 1, shape=(2,))))


def check_expression(text: str) -> None:
    """It is refused in words, or it has the values that Python finds, in UFL as well."""
    began = time.perf_counter()
    try:
        found = parse(text)
    except InputError as error:
        words = str(error)
        assert words and len(words) < 1000 and words.count("\n") in (0, 2), words
        ENDS["expressions refused"] += 1
        return
    finally:
        assert time.perf_counter() - began < SECONDS
    ENDS["expressions read"] += 1
    if found.is_condition:
        return
    values = found.numpy(POINTS)
    assert values.dtype == np.float64 and values.shape == (len(POINTS),)
    for (x, y), value in zip(POINTS, values, strict=True):
        truth = by_python(text, x, y)
        # Rounding may decide a comparison, or be all that is left of a difference, in one order of
        # sums and not in another.
        if not (math.isfinite(truth) and math.isfinite(value)):
            continue
        if not math.isclose(value, truth, rel_tol=1e-9, abs_tol=1e-9):
            near = {by_python(text, x * (1 + e), y * (1 + e), e) for e in (1e-13, -1e-13)}
            assert any(not math.isclose(each, truth, rel_tol=1e-9, abs_tol=1e-9) for each in near)
            ENDS["values that rounding decides"] += 1


@pytest.mark.serial
@few
@example("-(sin((atan2(1, 1_000)) ** (-(3))))")
@given(expressions)
def test_expressions_mean_what_python_means(text: str) -> None:
    check_expression(text)


@pytest.mark.serial
@few
@given(damaged(expressions))
def test_damaged_expressions_are_read_or_refused(text: str) -> None:
    check_expression(text)


def check_ufl(text: str) -> None:
    """UFL's own evaluation finds what NumPy finds."""
    try:
        found = parse(text)
    except InputError:
        ENDS["expressions refused"] += 1
        return
    form = found.ufl(X)
    if isinstance(form, float | bool):
        return
    ENDS["expressions in UFL"] += 1
    for point, value in zip(POINTS, found.numpy(POINTS), strict=True):
        try:
            other = float(form(tuple(point), {}, ()))
        except (ValueError, OverflowError, ZeroDivisionError, TypeError):
            continue  # UFL's own evaluation is Python's, which raises where C gives inf or nan
        if all(map(math.isfinite, (other, value, by_python(text, *point)))):
            close = math.isclose(value, other, rel_tol=1e-9, abs_tol=1e-9)
            near = found.numpy(point[None] * (1 + np.array([[1e-13], [-1e-13]])))
            assert close or not np.allclose(near, value, rtol=1e-9, atol=1e-9)


@pytest.mark.serial
@few
@example("-((min(x, pi)) ** (1e300))")
@given(expressions)
def test_ufl_agrees_with_numpy(text: str) -> None:
    check_ufl(text)


TOWERS = (
    "max({}, {}*x)", "min(y/{1}, {0})", "abs({} - {})", "sqrt(1 + ({})**2/{})", "sin({1}*({0}))",
    "(1 + ({})**2/9)**(y + 0.{})", "atan2({}, {} + x)", "where(x < 0.{1}, {0}, y)",
)  # fmt: skip
"""Functions of what comes in the place of the first braces, and of a digit."""


@st.composite
def towers(draw: st.DrawFn) -> str:
    """Draw functions of functions, up to the depth that is allowed: all is used all the way up."""
    found = draw(st.sampled_from(["x", "y", "x*y"]))
    kinds = draw(st.lists(st.sampled_from(TOWERS), min_size=1, max_size=3))
    for i in range(draw(st.integers(1, 40))):
        found = kinds[i % len(kinds)].format(found, 1 + i % 9)
    return found


def check_tower(text: str) -> None:
    """Its derivatives are found as long as it may be, and are the same in a normal form."""
    began = time.perf_counter()
    u = parse(text).ufl(X)
    load = -ufl.div(ufl.grad(u))
    points = np.pad(POINTS, ((0, 0), (0, 1)))
    with cli.room_for_recursion():
        found, known = evaluate(simplified(load), points), evaluate(load, points)
    assert time.perf_counter() - began < SECONDS
    if found is None or known is None:  # the derivative of a modulus is a sign
        assert "abs" in text
        ENDS["towers with a kink"] += 1
        return
    sure = np.isfinite(known[0] + found[0]) & (known[1] + found[1] < 1e-6 * (1 + abs(known[0])))
    assert np.allclose(found[0][sure], known[0][sure], rtol=1e-5, atol=1e-5)
    ENDS["towers"] += 1


@pytest.mark.serial
@settings(few, max_examples=20)
@given(towers())
def test_functions_of_functions_are_differentiated(text: str) -> None:
    check_tower(text)


# Problem files

SOURCES = [path.read_text() for path in sorted(MESHES.glob("*.toml"))]
WORDS = (
    "nan",
    "inf",
    "-1",
    "0",
    "1e400",
    "1e-320",
    "true",
    '"',
    "'",
    "[",
    "]",
    "[[",
    "{",
    "}",
    "=",
)
WORDS = (*WORDS, "\n", "#", "size", "vertices", '"contact"', '"neumann"', '"dirichlet"', "[0, 0]")
WORDS = (
    *WORDS,
    "mesh",
    "levels",
    "9" * 30,
    "\ufeff",
    "\x00",
    "adaptive",
    "tolerance",
    "1979-05-27",
)
VALUES = st.recursive(
    st.one_of(
        st.sampled_from([0, -1, 1, 10**30, 0.0, -0.5, 1e308, math.inf, math.nan, True, "", "x"]),
        st.sampled_from(["contact", "dirichlet", "neumann", "adaptive", "uniform", "y < 0", "1/0"]),
    ),
    lambda inner: st.lists(inner, max_size=4),
    max_leaves=4,
)


@st.composite
def tables(draw: st.DrawFn) -> str:
    """A problem file that reads as TOML, with values exchanged, away, or under other names."""
    table = tomllib.loads(draw(st.sampled_from(SOURCES)))
    for _ in range(draw(st.integers(1, 3))):
        at: Any = table
        while True:
            keys = list(at) if isinstance(at, dict) else list(range(len(at)))
            if not keys:
                break
            key = draw(st.sampled_from(keys))
            if isinstance(at[key], dict | list) and at[key] and draw(st.integers(0, 3)):
                at = at[key]
                continue
            change = draw(st.integers(0, 3))
            if change == 0:
                del at[key]
            elif change == 1 and isinstance(at, dict):
                at[key + "s"] = at.pop(key)
            elif change == 2 and isinstance(at, list):
                at.insert(key, at[key])
            else:
                at[key] = draw(VALUES)
            break
    return as_toml(table)


def as_toml(table: dict[str, Any]) -> str:
    """Plain TOML: what is not a section is written in line."""

    def value(what: Any) -> str:
        match what:
            case bool():
                return "true" if what else "false"
            case str():
                marks = {'"': '\\"', "\\": "\\\\", "\n": "\\n"}
                return '"' + "".join(marks.get(c, c) for c in what) + '"'
            case list():
                return "[" + ", ".join(map(value, what)) + "]"
            case dict():
                return "{" + ", ".join(f"{k} = {value(v)}" for k, v in what.items()) + "}"
        return repr(what)

    lines = [f"{key} = {value(what)}" for key, what in table.items() if not isinstance(what, dict)]
    for name, section in table.items():
        if isinstance(section, dict):
            lines += [f"[{name}]", *(f"{key} = {value(what)}" for key, what in section.items())]
    return "\n".join(lines)


ONE_IN = 20
"""Of files that are read so many are solved, on few cells."""
FEW = 400
"""Cells that are few."""


@functools.cache
def scratch() -> tempfile.TemporaryDirectory[str]:
    """A folder, made when it is first needed and gone when the program ends."""
    return tempfile.TemporaryDirectory()


def check_file(text: str) -> None:
    """As `look_at_file`; given to hypothesis, which allows no defaults."""
    look_at_file(text, ONE_IN)


def look_at_file(text: str, one_in: int) -> None:
    """It is refused with one message, or read; then `check` does the same, and some are solved."""
    path = Path(scratch().name) / "case.toml"
    path.write_bytes(text.encode("utf-8", "surrogatepass"))
    began, end = time.perf_counter(), "files read"
    try:
        file = problemfile.load(path, MPI.COMM_SELF)
        sizes = [file.size or 0.0]
        cheap = isinstance(file.domain, Path) or sizes[0] > file.domain.diameter / 40
        if cheap:
            domain = file.mesh(MPI.COMM_SELF)
            file.check(domain)
            end = "files checked on their mesh"
            steps = 0 if file.time is None else file.time.steps
            cells = domain.mesh.topology.index_map(2).size_local
            if cells <= FEW and steps <= 10 and zlib.crc32(path.read_bytes()) % one_in == 0:
                solve_file(path)
                end = "files solved"
    except InputError as error:
        words = str(error)
        assert words and len(words) < 2000, words
        end = "files refused"
    assert time.perf_counter() - began < SECONDS
    ENDS[end] += 1


def solve_file(path: Path) -> None:
    """The command ends as it should, with words where it has no results; nothing is drawn."""
    out, said = Path(scratch().name) / "out", io.StringIO()
    with pytest.MonkeyPatch.context() as patch, contextlib.redirect_stderr(said):
        undrawn(patch)
        status = cli.main(["solve", str(path), "--levels", "1", "--out", str(out), "-q"])
    assert status in (cli.DONE, cli.BAD_INPUT, cli.NOT_CONVERGED), said.getvalue()
    assert "Traceback" not in said.getvalue()
    if status == cli.DONE:
        report = json.loads((out / "report.json").read_text())
        assert report["complete"] and len(report["levels"]) == 1
    else:
        assert f"signorini-cr: {path}" in " ".join(said.getvalue().split())
    ENDS[f"files solved, status {status}"] += 1
    shutil.rmtree(out, ignore_errors=True)


@pytest.mark.serial
@settings(few, max_examples=8)
@given(tables())
def test_problem_files_are_solved_or_refused(text: str) -> None:
    look_at_file(text, 1)


@pytest.mark.serial
@pytest.mark.slow
@few
@given(damaged(st.sampled_from(SOURCES), WORDS))
def test_damaged_problem_files_are_read_or_refused(text: str) -> None:
    check_file(text)


@pytest.mark.serial
@few
@given(tables())
def test_changed_problem_files_are_read_or_refused(text: str) -> None:
    check_file(text)


# Problems

rounded = st.floats(-1, 1).map(lambda a: round(a, 2))


@st.composite
def problems(draw: st.DrawFn) -> str:
    """A polygon that sees its middle from all corners, labels and data, some of them steep."""
    corners = draw(st.integers(3, 7))
    radii = [draw(st.floats(0.3, 2.0)) for _ in range(corners)]
    turn, stretch = draw(st.floats(0, 6.28)), 10.0 ** draw(st.floats(-1, 1))
    angles = [turn + 2 * math.pi * (i + 0.35 * draw(rounded)) / corners for i in range(corners)]
    vertices = [
        [round(r * math.cos(a), 3), round(stretch * r * math.sin(a), 3)]
        for r, a in zip(radii, angles, strict=True)
    ]
    kinds = st.sampled_from(["contact", "dirichlet", "neumann"])
    boundary = [draw(kinds) for _ in range(corners)]
    at = draw(st.permutations(range(corners)))
    boundary[at[0]], boundary[at[1]] = "contact", "dirichlet"
    a, b, c, k = (draw(rounded) for _ in range(4))
    steep = 10 ** draw(st.integers(0, 4))
    data = {
        "f": draw(st.sampled_from([f"{9 * a}", f"{9 * a} + {b}*sin(5*x)",
                                   f"where(x < {b}, {9 * a}, 0)", f"{9 * a}*exp(-abs(y - {b}))"])),
        "g": draw(st.sampled_from([f"{c}", f"{c}*y", f"where(y > {b}, {c}, 0)"])),
        "dirichlet": draw(st.sampled_from(["0", f"{b}", f"{b} + 0.3*x - 0.1*y", f"{c}*cos(x)"])),
        "obstacle": draw(st.sampled_from([f"-1 + {0.5 * c}", f"-1.5 + {0.3 * b}*sin(4*x)",
                                          f"-2 + {0.3 * c}*abs(x - {b})"])),
        "coefficient": draw(st.sampled_from(["1", f"{1.5 + k}", f"2 + sin(3*x*{k})",
                                             f"where(x < {k}, {steep}, 1)"])),
    }  # fmt: skip
    size = 0.5 * min(max(map(abs, column)) for column in zip(*vertices, strict=True))
    table: dict[str, Any] = {
        "domain": {"vertices": vertices, "boundary": boundary, "size": max(size, 0.02)},
        "data": data,
        "refine": {"levels": 3},
    }
    width = 0.2 * min(radii) * min(1.0, stretch)
    for feature in draw(st.lists(st.sampled_from(list(FEATURES)), unique=True, max_size=3)):
        FEATURES[feature](table, draw, width)
    return as_toml(table)


def _hole(table: dict[str, Any], draw: st.DrawFn, width: float) -> None:
    """In the middle, a square or a circle."""
    part = draw(st.sampled_from(["contact", "dirichlet", "neumann"]))
    square = [[-width, -width], [width, -width], [width, width], [-width, width]]
    hole = draw(
        st.sampled_from(
            [
                {"vertices": square, "boundary": [part] * 4},
                {"center": [0.0, 0.1 * width], "radius": width, "boundary": part},
            ]
        )
    )
    table["domain"]["holes"] = [hole]


def _material(table: dict[str, Any], draw: st.DrawFn, width: float) -> None:
    """To the right of a line, or in a corner of the middle."""
    x, far = round(draw(rounded) * width, 3), 50.0
    low = draw(st.sampled_from([-far, round(0.5 * width, 3)]))
    kappa: Any = 10.0 ** draw(st.integers(-2, 3))
    if draw(st.booleans()):
        kappa = [[2 * kappa, 0.3 * kappa], [0.3 * kappa, kappa]]
    polygon = [[x, low], [far, low], [far, far], [x, far]]
    own = {"polygon": polygon, "coefficient": kappa, "reaction": draw(st.sampled_from([0, 2.5]))}
    table["material"] = {"soil": own}


def _renamed(table: dict[str, Any], old: str, name: str, part: dict[str, Any]) -> None:
    """The last edge of a kind becomes a part of another type."""
    boundary = table["domain"]["boundary"]
    if old in boundary:
        boundary[len(boundary) - 1 - boundary[::-1].index(old)] = name
        table.setdefault("boundary", {})[name] = part


def _robin(table: dict[str, Any], draw: st.DrawFn, width: float) -> None:
    """Something is lost through an edge."""
    part = {"type": "robin", "coefficient": 10.0 ** draw(st.integers(-2, 2)), "external": 0.5}
    _renamed(table, "neumann", "air", part)


def _both(table: dict[str, Any], draw: st.DrawFn, width: float) -> None:
    """An edge between two bounds, which may lose something, too."""
    part = {"type": "contact", "obstacle": -1.5, "upper": draw(st.sampled_from([1.4, "2 - 0.1*x"]))}
    if draw(st.booleans()):
        part |= {"coefficient": 3, "external": -1}
    _renamed(table, "contact", "both", part)


def _adaptive(table: dict[str, Any], draw: st.DrawFn, width: float) -> None:
    """Meshes that adapt."""
    table["refine"] = {"levels": 4, "mode": "adaptive", "fraction": draw(st.floats(0.2, 0.9))}


def _time(table: dict[str, Any], draw: st.DrawFn, width: float) -> None:
    """A few steps in time, with a load that changes."""
    scheme = draw(st.sampled_from(["euler", "bdf2"]))
    table["time"] = {"end": 10.0 ** draw(st.integers(-2, 2)), "steps": 3, "scheme": scheme}
    table["data"]["f"] += " + 2*sin(t)"
    table["refine"] = {"levels": 2}


FEATURES: dict[str, Callable[[dict[str, Any], st.DrawFn, float], None]] = {
    "hole": _hole,
    "material": _material,
    "robin": _robin,
    "both": _both,
    "adaptive": _adaptive,
    "time": _time,
}


def check_problem(text: str) -> None:
    """Solved or refused, by all ranks that there are; and by one alone as by several."""
    comm, error, solved = MPI.COMM_WORLD, None, None
    try:
        solved = solve_problem(text, comm)
        alone = solve_problem(text, MPI.COMM_SELF) if comm.size > 1 else None
        if alone is not None:
            assert (solved is None) == (not alone)
            compare(solved or [], alone)
    except Exception as caught:
        error = caught
    fail_together(comm, error)  # or hypothesis would go on with another problem on some ranks


def compare(solved: Sequence[Solution], alone: Sequence[Solution]) -> None:
    """Figures on several ranks are those on one, as long as meshes are the same."""
    for one, other in zip(solved, alone, strict=True):
        if one.dofs != other.dofs:
            ENDS["meshes that differ between ranks"] += 1
            return
        # in time a step has what is left of the one before in its data, and J may all but vanish
        low, high = one.certificate.energy or (one.energy, one.energy)
        room = 1e-8 * abs(one.energy) + 1e-5 * (high - low)
        assert abs(one.energy - other.energy) <= room, (one.energy, other.energy, room)
        force = max(abs(one.contact.force), abs(other.contact.force))
        assert abs(one.contact.force - other.contact.force) <= 1e-6 * force + 1e-9
        bounds = one.certificate.bound_h1, other.certificate.bound_h1
        assert (bounds[0] is None) == (bounds[1] is None), bounds
        if bounds[0] is not None and bounds[1] is not None:
            assert abs(bounds[0] - bounds[1]) <= 0.03 * bounds[1] + 1e-12, bounds
        ENDS["solutions as on one rank"] += 1


def solve_problem(text: str, comm: MPI.Comm) -> list[Solution] | None:
    """Solve, with figures of three meshes that do not contradict one another; None if refused.

    The energy lies in every mesh's bracket, so that any two of them overlap. In time each step is
    a problem of its own.
    """
    path = Path(scratch().name) / "case.toml"
    path.write_text(text)
    try:
        file = problemfile.load(path, comm)
        domain = file.mesh(comm)
        cells = domain.mesh.topology.index_map(2).size_global
        if cells > 4000:
            ENDS["problems left out, too many cells"] += 1
            return None
        file.check(domain)
        if file.time is None:
            solutions = list(file.solutions(domain))
        else:
            solutions = [solution for _, solution in file.steps(domain, file.levels)]
    except InputError as error:
        assert str(error)
        ENDS["problems refused"] += 1
        return None
    except NotConverged as error:
        assert error.reason
        ENDS["problems not converged"] += 1
        return None
    ENDS["problems solved"] += 1
    table = tomllib.loads(text)
    for name in table.keys() & {"material", "boundary", "time"} | table["domain"].keys() & {
        "holes"
    }:
        ENDS[f"problems solved, with {name}"] += 1
    ENDS[f"problems solved, {file.mode}"] += 1
    lowest, highest = -math.inf, math.inf
    for solution in solutions:
        kkt = solution.contact.kkt
        force = max(abs(solution.contact.force), 1e-12)
        assert kkt.min_gap >= -1e-9 and kkt.residual <= 1e-7, kkt
        pressure = comm.allreduce(
            float(np.abs(solution.contact.pressure).max(initial=1e-12)), op=MPI.MAX
        )
        assert kkt.min_pressure >= -1e-6 * pressure, (kkt, force)
        certificate = solution.certificate
        if certificate.bound_h1 is None:
            ENDS[f"no bound: {certificate.reason}"] += 1
            continue
        assert certificate.bound_h1 >= 0.0
        low, high = certificate.energy
        slack = 1e-9 * max(abs(low), abs(high))
        assert low <= high
        if file.time is None:
            lowest, highest = max(lowest, low), min(highest, high)
        assert lowest <= highest + slack, "the brackets of two meshes do not overlap"
        ENDS["bounds"] += 1
    return solutions


@pytest.mark.slow
@settings(few, max_examples=4)
@given(problems())
def test_random_problems_are_solved_or_refused(text: str) -> None:
    check_problem(text)


LONG: dict[str, tuple[Callable[[str], None], tuple[st.SearchStrategy[str], ...]]] = {
    "expressions": (check_expression, (expressions, damaged(expressions))),
    "ufl": (check_ufl, (expressions,)),
    "towers": (check_tower, (towers(),)),
    "files": (check_file, (damaged(st.sampled_from(SOURCES), WORDS), tables())),
    "problems": (check_problem, (problems(),)),
}


def main() -> None:
    """Draw many, and print how they ended."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    for name in LONG:
        parser.add_argument(f"--{name}", type=int, default=0, metavar="N")
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    for name, (check, strategies) in LONG.items():
        for strategy in strategies:
            number = getattr(arguments, name) // len(strategies)
            if number:
                long = settings(few, derandomize=False, max_examples=number)
                seed(arguments.seed)(long(given(strategy)(check)))()
    for end, count in sorted(ENDS.items() if MPI.COMM_WORLD.rank == 0 else []):
        print(f"{count:8d} {end}")


if __name__ == "__main__":
    main()
