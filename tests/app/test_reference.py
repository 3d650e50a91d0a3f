"""The page about the problem file against what the program reads."""

from pathlib import Path

import pytest
from helpers import ROOT
from mpi4py import MPI

from signorini_cr.app.datacheck import USED_ON
from signorini_cr.app.problemfile import load
from signorini_cr.app.reference import ABOUT, KEYS, page

BASE = {
    "domain": {
        "vertices": "vertices = [[-1, 0], [1, 0], [1, 1], [-1, 1]]",
        "boundary": 'boundary = ["contact", "dirichlet", "neumann", "dirichlet"]',
        "size": "size = 0.5",
    },
    "data": {"obstacle": 'obstacle = "-1"'},
}


def test_the_page_is_that_of_the_table() -> None:
    found = (ROOT / "docs" / "problem-file.md").read_text(encoding="utf-8")
    assert found == page(), "docs/problem-file.md: run docs/reference.py"


@pytest.mark.serial
@pytest.mark.parametrize("key", KEYS, ids=lambda key: f"{key.section}.{key.name}")
def test_examples_are_read(key, tmp_path: Path) -> None:
    """Each in the place of its key in a file that is in order."""
    sections = {name: dict(BASE.get(name, {})) for name in ABOUT}
    if key.name == "mesh":
        sections["domain"] = {}
    if key.section == "refine":
        sections["refine"]["mode"] = 'mode = "adaptive"'
    sections[key.section][key.name] = key.example
    lines = [*sections.pop("").values()]
    for name, rows in sections.items():
        lines += [f"[{name}]", *rows.values()] if rows else []
    path = tmp_path / "case.toml"
    path.write_text("\n".join(lines), encoding="utf-8")
    load(path, MPI.COMM_SELF)


def test_every_expression_of_the_table_is_used() -> None:
    """A datum that nothing asks for would be read and forgotten."""
    expressions = {f"{key.section}.{key.name}" for key in KEYS if key.section in ("data", "exact")}
    assert set(USED_ON) == expressions


@pytest.mark.serial
def test_every_key_of_the_ready_files_is_in_the_table() -> None:
    import tomllib

    known = {(key.section, key.name) for key in KEYS}
    for path in (ROOT / "meshes").glob("*.toml"):
        table = tomllib.loads(path.read_text(encoding="utf-8"))
        for section, content in table.items():
            if section == "define":
                continue
            keys = content if isinstance(content, dict) else [section]
            where = section if isinstance(content, dict) else ""
            assert {(where, key) for key in keys} <= known, path.name
