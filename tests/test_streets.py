"""The order of the package: imports lead from the upper streets to the lower ones, never back."""

import ast
import re
import runpy
import shutil
from functools import cache
from pathlib import Path

import pytest
from helpers import ROOT

import signorini_cr

PACKAGE = Path(signorini_cr.__file__).parent
FLOORS = (
    (
        "arrays",
        "errors",
        "hints",
        "jit",
        "compat",
        "options",
        "garbage",
        "memory",
        "temporary",
        "reading",
        "shown",
        "rounding",
        "__init__",
    ),
    ("mesh",),
    ("fem",),
    ("data",),
    ("multigrid",),
    ("vi",),
    ("estimate",),
    (
        "solution",
        "diffusion",
        "limits",
        "restart",
        "levels",
        "dual",
        "force",
        "means",
        "quantities",
        "adaptive",
        "evolution",
    ),
    ("verification",),
    ("output",),
    ("app",),
    ("__main__",),
)
"""Streets, and the modules beside them, lowest first."""
FLOOR = {name: number for number, names in enumerate(FLOORS) for name in names}
LAZY = {("__init__", name) for names in FLOORS for name in names}
"""The public names are loaded when they are first used."""


IMPORTS = runpy.run_path(str(ROOT / "docs" / "architecture.py"))["imports"]


Graph = dict[tuple[str, ...], list[tuple[str, ...]]]


@cache
def graph(package: Path = PACKAGE) -> Graph:
    """The modules that each file imports, wherever in it, for types as well."""
    found: Graph = {}
    for path in sorted(package.rglob("*.py")):
        found |= imported(path, package)
    return found


def imported(path: Path, package: Path) -> Graph:
    """Those that one file imports."""
    modules = [module or ("__init__",) for module in IMPORTS(path, package)]
    return {path.relative_to(package).with_suffix("").parts: modules}


def upward(found: Graph) -> list[str]:
    """The imports that lead to a higher floor."""
    return [
        f"{'.'.join(here)} imports {'.'.join(there)}"
        for here, others in found.items()
        for there in others
        if FLOOR[there[0]] > FLOOR[here[0]] and (here[0], there[0]) not in LAZY
    ]


@pytest.mark.serial
def test_every_module_stands_on_a_floor() -> None:
    found = graph()
    assert {name[0] for name in found} == set(FLOOR)
    for street in (name[0] for name in found if len(name) == 2):
        charter = ast.get_docstring(ast.parse((PACKAGE / street / "__init__.py").read_text()))
        assert charter and len(charter.split()) >= 8, f"{street} has no charter"


@pytest.mark.serial
def test_imports_lead_downwards() -> None:
    assert upward(graph()) == []


@pytest.mark.serial
@pytest.mark.parametrize(
    "line, found",
    [
        ("from .. import plots, exact, solve", ["output.plots", "verification.exact", "levels"]),
        ("from ..output.plots import can_draw", ["output.plots"]),
        ("from .. import output, compat, InputError, __version__", ["output"]),
        ("def late():\n    from .. import notebook", ["output.notebook"]),
        ("from ..fem import space\nfrom .. import Problem", []),
    ],
)
def test_an_import_that_leads_upwards_is_seen(tmp_path: Path, line: str, found: list[str]) -> None:
    """Also one of a name that the front door hands on."""
    package = tmp_path / PACKAGE.name
    shutil.copytree(PACKAGE, package, ignore=shutil.ignore_patterns("__pycache__"))
    changed = package / "estimate" / "flux.py"
    with changed.open("a") as file:
        file.write(f"\n{line}\n")
    graph_there = graph() | imported(changed, package)
    assert upward(graph_there) == [f"estimate.flux imports {name}" for name in found]


@pytest.mark.serial
def test_an_import_by_the_name_of_the_package_is_refused(tmp_path: Path) -> None:
    package = tmp_path / PACKAGE.name
    package.mkdir()
    (package / "__init__.py").write_text("")
    (package / "arrays.py").write_text("import signorini_cr.output\n")
    with pytest.raises(ValueError, match="relative"):
        graph(package)


@pytest.mark.serial
def test_only_the_front_door_imports_by_strings() -> None:
    ways = re.compile(r"import_module|__import__|import_from|runpy")
    files = {path for path in PACKAGE.rglob("*.py") if ways.search(path.read_text())}
    assert files == {PACKAGE / "__init__.py"}
    # what is loaded already: the ground floor looks for the class of an error, and for no more
    ways = re.compile(r"sys\.modules\S*(__package__|signorini_cr)")
    files = {path for path in PACKAGE.rglob("*.py") if ways.search(path.read_text())}
    assert files == {PACKAGE / "memory.py"}


@pytest.mark.serial
def test_no_imports_in_a_circle() -> None:
    below = {here: set(others) for here, others in graph().items() if here != ("__init__",)}
    while below:
        free = [here for here, others in below.items() if not others & set(below) - {here}]
        assert free, f"a circle among {sorted('.'.join(here) for here in below)}"
        for here in free:
            del below[here]


@pytest.mark.serial
def test_no_name_of_a_module_is_given_twice():
    """A constant that another one takes the name of has its value where it is read, wherever."""
    twice = []
    for path in sorted(PACKAGE.rglob("*.py")):
        seen = set()
        for node in ast.parse(path.read_text(encoding="utf-8")).body:
            targets = node.targets if isinstance(node, ast.Assign) else []
            targets = [node.target] if isinstance(node, ast.AnnAssign) else targets
            places = [n for t in targets for n in ast.walk(t) if isinstance(n, ast.Name)]
            names = {n.id for n in places if isinstance(n.ctx, ast.Store)}
            if isinstance(node, ast.FunctionDef | ast.ClassDef):
                names = {node.name}
            if isinstance(node, ast.ImportFrom):
                names = {alias.asname or alias.name for alias in node.names}
            twice += [f"{path.relative_to(PACKAGE)}: {name}" for name in names & seen]
            seen |= names
    assert not twice
