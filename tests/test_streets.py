"""The order of the package: imports lead from the upper streets to the lower ones, never back."""

import ast
from pathlib import Path

import pytest

import signorini_cr

PACKAGE = Path(signorini_cr.__file__).parent
FLOORS = (
    ("arrays", "errors", "jit", "compat", "options", "garbage", "memory", "__init__"),
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


def module_name(path: Path) -> tuple[str, ...]:
    return path.relative_to(PACKAGE).with_suffix("").parts


def imported(path: Path) -> list[tuple[str, ...]]:
    """The modules of the package that a file imports, wherever in it, for types as well."""
    here = module_name(path)
    found = []
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and node.level:
            base = [*here[: len(here) - node.level], *(node.module or "").split(".")]
            base = [part for part in base if part]
            for alias in node.names:
                whole = (*base, alias.name)
                is_module = PACKAGE.joinpath(*whole).with_suffix(".py").exists()
                found.append(whole if is_module else tuple(base) or ("__init__",))
        elif isinstance(node, ast.ImportFrom | ast.Import):
            names = (
                [node.module] if isinstance(node, ast.ImportFrom) else [a.name for a in node.names]
            )
            assert not any(name.split(".")[0] == "signorini_cr" for name in names if name), (
                f"{path.name}: imports within the package are relative"
            )
    return found


FILES = sorted(path for path in PACKAGE.rglob("*.py"))
GRAPH = {module_name(path): imported(path) for path in FILES}


@pytest.mark.serial
def test_every_module_stands_on_a_floor() -> None:
    assert {name[0] for name in GRAPH} == set(FLOOR)
    for street in (name[0] for name in GRAPH if len(name) == 2):
        charter = ast.get_docstring(ast.parse((PACKAGE / street / "__init__.py").read_text()))
        assert charter and len(charter.split()) >= 8, f"{street} has no charter"


@pytest.mark.serial
def test_imports_lead_downwards() -> None:
    upward = [
        f"{'.'.join(here)} imports {'.'.join(there)}"
        for here, others in GRAPH.items()
        for there in others
        if FLOOR[there[0]] > FLOOR[here[0]] and (here[0], there[0]) not in LAZY
    ]
    assert upward == []


@pytest.mark.serial
def test_no_imports_in_a_circle() -> None:
    below = {here: set(others) for here, others in GRAPH.items() if here != ("__init__",)}
    while below:
        free = [here for here, others in below.items() if not others & set(below) - {here}]
        assert free, f"a circle among {sorted('.'.join(here) for here in below)}"
        for here in free:
            del below[here]
