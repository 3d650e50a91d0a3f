"""Mistakes put into the program one at a time, and whether the tests notice.

    container/run python3 tests/mutants.py estimate --count 200 --seed 0

draws mutants of a street (or of one file), runs the street's tests on each in a process of its
own, forked from this one so that nothing large is imported twice, and prints those that survive.
With `--ranks 2` tests are run once more on those that survive on one rank, for what only ranks say
to each other. `--only signorini_cr/multigrid/smoothing.py:GaussSeidel._sweep` takes the mutants of
a function, and with `:text` behind it those of its lines that have this text.
"""

from __future__ import annotations

import argparse
import ast
import importlib.util
import os
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator
from importlib.machinery import ModuleSpec, SourceFileLoader
from pathlib import Path
from types import CodeType
from typing import Any

import numpy as np

ROOT = Path(__file__).parent.parent
PACKAGE = ROOT / "signorini_cr"
TESTS = {
    "estimate": "estimate/test_products.py estimate/test_pieces.py estimate/test_terms.py"
    " estimate/test_sharpness_pinned.py estimate/test_sharpness.py estimate/test_tensors.py"
    " test_force.py test_means.py",
    "vi": "vi fem/test_conditions.py",
    "multigrid": "multigrid vi/test_steps_pinned.py",
}
"""Tests that are run on the mutants of a street."""
SLOW = "not waving and not need_two_sweeps and not rates"
"""Tests of these that are left out."""


def _table(pairs: str) -> dict[type[ast.AST], type[ast.AST]]:
    return {getattr(ast, a): getattr(ast, b) for a, b in (one.split(">") for one in pairs.split())}


OPERATORS = _table(
    "Add>Sub Sub>Add Mult>Div Div>Mult Pow>Mult FloorDiv>Mult Mod>Mult And>Or Or>And"
)
OFF_BY_ONE = _table("Lt>LtE LtE>Lt Gt>GtE GtE>Gt")
NEGATED = _table(
    "Lt>GtE LtE>Gt Gt>LtE GtE>Lt Eq>NotEq NotEq>Eq Is>IsNot IsNot>Is In>NotIn NotIn>In"
)
NAMES = {"min": "max", "minimum": "maximum", "any": "all", "low": "high"}
NAMES |= {new: old for old, new in NAMES.items()}
ELSEWHERE = ("scatter_forward()", "scatter_reverse(InsertMode.add)", "destroy()")
"""Calls that only other ranks or the memory would miss, which are not dropped."""
OTHERS = "comm.size > 1"
"""Condition that is left alone, with what hangs on it: it is what a rank says to others, and here
there is one, which has nobody to say it to."""
MUTANT = "SIGNORINI_CR_MUTANT"
"""Number and file of the mutant that a process under mpirun, which has this for a plugin of pytest,
is to load."""
ARGUMENTS = ["-qx", "-p", "no:cacheprovider", "-k", SLOW]
Mutant = tuple[int, str, Callable[[], None]]
"""Line, what is changed, and the change."""


def mutants(node: ast.AST) -> Iterator[Mutant]:
    """All mutants of a module; a tree takes one change and is then to be parsed anew."""
    yield from _of_node(node)
    for field, value in ast.iter_fields(node):
        if field in ("annotation", "returns", "decorator_list"):
            continue
        if field in ("body", "test") and _text(getattr(node, "test", node)).endswith(OTHERS):
            continue
        for i, child in enumerate(value if isinstance(value, list) else [value]):
            if isinstance(child, ast.expr | ast.stmt):
                place = (node, field, i if isinstance(value, list) else None)
                yield from ((child.lineno, *one) for one in _in_place(child, *place))
            if isinstance(child, ast.AST) and "TYPE_CHECKING" not in _text(child):
                yield from mutants(child)


def _text(node: ast.AST) -> str:
    return ast.unparse(node).split("\n")[0][:60]


def _of_node(node: ast.AST) -> Iterator[Mutant]:
    """Changes of what a node holds itself."""
    line = getattr(node, "lineno", 0)
    match node:
        case ast.BinOp(op=op) | ast.BoolOp(op=op) | ast.AugAssign(op=op):
            if new := OPERATORS.get(type(op)):
                what = f"{type(op).__name__} -> {new.__name__}"
                yield line, what, lambda: setattr(node, "op", new())
        case ast.Compare(ops=[op]):
            for table in (OFF_BY_ONE, NEGATED):
                if new := table.get(type(op)):
                    what = f"{type(op).__name__} -> {new.__name__}"
                    yield line, what, lambda new=new: setattr(node, "ops", [new()])
        case ast.Constant(value=bool(value)):
            yield line, f"{value} -> {not value}", lambda: setattr(node, "value", not value)
        case ast.Constant(value=int(value)):
            yield line, f"{value} -> {value + 1}", lambda: setattr(node, "value", value + 1)
        case ast.Constant(value=float(value)):
            new = 2.0 * value if value else 1.0
            yield line, f"{value} -> {new}", lambda: setattr(node, "value", new)
        case ast.Name(id=name) if name in NAMES:
            yield line, f"{name} -> {NAMES[name]}", lambda: setattr(node, "id", NAMES[name])
        case ast.Attribute(attr=name) if name in NAMES:
            yield line, f"{name} -> {NAMES[name]}", lambda: setattr(node, "attr", NAMES[name])


def _in_place(
    node: ast.AST, parent: ast.AST, field: str, i: int | None
) -> Iterator[tuple[str, Callable[[], None]]]:
    """Changes that put something else in the place of a node."""

    def put(new: ast.AST) -> Callable[[], None]:
        ast.copy_location(new, node)
        if i is None:
            return lambda: setattr(parent, field, new)
        return lambda: getattr(parent, field).__setitem__(i, new)

    text = _text(node)
    match node:
        case ast.UnaryOp(operand=operand):
            yield f"{text} -> {_text(operand)}", put(operand)
        case ast.Call(func=ast.Attribute(attr="abs" | "sqrt") | ast.Name(id="abs"), args=[inner]):
            yield f"{text} -> {_text(inner)}", put(inner)
        case (
            ast.AugAssign() | ast.Expr(value=ast.Call()) | ast.Continue() | ast.Break()
            | ast.Assert() | ast.Assign(targets=[ast.Subscript() | ast.Attribute()])
        ) if not text.endswith(ELSEWHERE):  # fmt: skip
            yield f"{text} dropped", put(ast.Pass())
    if field == "test" and not isinstance(parent, ast.Assert):
        yield f"not {text}", put(ast.UnaryOp(ast.Not(), node))


class Mutated(SourceFileLoader):
    """Finds and loads one module from code that is not that of its file."""

    code: CodeType

    def find_spec(self, name: str, *_: object) -> ModuleSpec | None:
        if name != self.name:
            return None
        return importlib.util.spec_from_file_location(name, self.path, loader=self)

    def get_code(self, _: str) -> CodeType:
        return self.code


def load(path: Path, index: int) -> Mutated:
    """The mutant of this number of a file."""
    tree = ast.parse(path.read_text())
    list(mutants(tree))[index][2]()
    mutated = Mutated(".".join(path.relative_to(ROOT).with_suffix("").parts), str(path))
    mutated.code = compile(ast.fix_missing_locations(tree), str(path), "exec")
    return mutated


def lines_of(place: str) -> tuple[Path, set[int]]:
    """The lines of a function, as `FILE:NAME`, or those with a text in them, as `FILE:NAME:TEXT`.

    The name is the qualified one, `Class.method`; a class stands for all of it.
    """
    file, name, *text = place.split(":", 2)
    source = (ROOT / file).read_text()
    lines = source.splitlines()
    found: list[Any] = [ast.parse(source)]
    for part in name.split("."):
        inside = [one for node in found for one in getattr(node, "body", ())]
        found = [one for one in inside if getattr(one, "name", None) == part]
    numbers = {i for node in found for i in range(node.lineno, node.end_lineno + 1)}
    if text:
        numbers = {i for i in numbers if text[0] in lines[i - 1]}
    if not numbers:
        raise argparse.ArgumentTypeError(f"{place}: there is no such line")
    return ROOT / file, numbers


def end_of(mutated: Mutated | None, tests: list[str], seconds: float) -> str:
    """Return the end of the tests: passed, failed, or timeout."""
    child = os.fork()
    if not child:
        os.setpgid(0, 0)
        null = os.open(os.devnull, os.O_RDWR)
        for number in range(3):
            os.dup2(null, number)
        if mutated is not None:
            sys.meta_path.insert(0, mutated)
        import pytest

        os._exit(pytest.main([*ARGUMENTS, *tests]))
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        pid, status = os.waitpid(child, os.WNOHANG)
        if pid:
            return "failed" if status else "passed"
        time.sleep(0.05)
    os.killpg(child, signal.SIGKILL)
    os.waitpid(child, 0)
    return "timeout"


def end_on(ranks: int, path: Path, index: int, tests: list[str], seconds: float) -> str:
    """The same on several ranks, which are started anew; a mutant below 0 is none."""
    found = os.pathsep.join([str(ROOT / "tests"), str(ROOT)])
    surroundings = {**os.environ, "PYTHONPATH": found, MUTANT: f"{index} {path}"}
    command = ["mpirun", "-n", str(ranks), sys.executable, "-m", "pytest", "-p", "mutants"]
    with subprocess.Popen(
        [*command, *ARGUMENTS, *tests],
        env=surroundings,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    ) as started:
        try:
            return "failed" if started.wait(seconds) else "passed"
        except subprocess.TimeoutExpired:
            os.killpg(started.pid, signal.SIGKILL)
            return "timeout"


def plug_in(words: str) -> None:
    """Let this process load a mutant."""
    index, path = words.split(maxsplit=1)
    if int(index) >= 0:
        sys.meta_path.insert(0, load(Path(path), int(index)))


def main() -> None:
    """Draw mutants, run the tests on each, print those that none of them fails on."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("what", help="a street of the package, or one of its files")
    parser.add_argument("--count", type=int, default=150)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument(
        "--only",
        metavar="FILE:NAME[:TEXT]",
        nargs="*",
        type=lines_of,
        help="the mutants of these functions, or of their lines with this text",
    )
    parser.add_argument("--tests", nargs="*", help="what to run instead of the street's tests")
    parser.add_argument(
        "--ranks", type=int, default=1, help="for a second try of those that survive"
    )
    parser.add_argument("--all", action="store_true", help="print those that are noticed as well")
    arguments = parser.parse_args()
    at = PACKAGE / arguments.what
    files = sorted(at.glob("*.py")) if at.is_dir() else [at]
    tests = arguments.tests or [str(ROOT / "tests" / name) for name in TESTS[at.name].split()]
    import dolfinx.fem.petsc, gmsh, matplotlib.pyplot, petsc4py.PETSc, pytest, scipy.optimize  # noqa

    began = time.monotonic()
    if end_of(None, tests, 3600) != "passed":
        sys.exit("the tests fail as it is")
    limit = 30 + 5 * (time.monotonic() - began)
    if arguments.ranks > 1:
        began = time.monotonic()
        if end_on(arguments.ranks, files[0], -1, tests, 3600) != "passed":
            sys.exit(f"the tests fail as it is on {arguments.ranks} ranks")
        limit_on_ranks = 30 + 5 * (time.monotonic() - began)
    pool = [
        (path, i, line, what)
        for path in files
        for i, (line, what, _) in enumerate(mutants(ast.parse(path.read_text())))
    ]
    drawn = [pool[i] for i in np.random.default_rng(arguments.seed).permutation(len(pool))]
    if arguments.only:
        wanted = {(path, line) for path, lines in arguments.only for line in lines}
        drawn = [one for one in drawn if (one[0], one[2]) in wanted]
    ends: Counter[str] = Counter()
    for path, index, line, what in drawn[: arguments.count]:
        end = end_of(load(path, index), tests, limit)
        if end == "passed" and arguments.ranks > 1:
            end = end_on(arguments.ranks, path, index, tests, limit_on_ranks)
        ends[end] += 1
        if end == "passed" or arguments.all:
            print(f"{end}: {path.relative_to(ROOT)}:{line}: {what}", flush=True)
    noticed, number = ends["failed"] + ends["timeout"], ends.total()
    print(f"{noticed} of {number} mutants noticed, {noticed / number:.1%}; {len(pool)} there are")


if __name__ == "__main__":
    main()
elif MUTANT in os.environ:
    plug_in(os.environ[MUTANT])
