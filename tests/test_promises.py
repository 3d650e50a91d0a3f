"""docs/promises.md: each promise has a row, and each row names tests that are there."""

import ast
import re

import pytest
from helpers import ROOT

pytestmark = pytest.mark.serial

TEXT = (ROOT / "docs" / "promises.md").read_text(encoding="utf-8")
ROWS = [
    [cell.strip() for cell in line.strip("|").split("|")]
    for line in TEXT.split("## How each promise is tested")[1].split("## Counts")[0].splitlines()
    if line.startswith("| ") and not line.startswith("| promise")
]
COMMANDED = {"… and memory does not grow"}
"""Promises whose test takes a process too long for a test."""


def names_in(file: str) -> set[str]:
    tree = ast.parse((ROOT / file).read_text(encoding="utf-8"))
    return {node.name for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)}


def named(cell: str) -> list[tuple[str, str]]:
    """Files and tests; a name that begins with :: is of the file before it."""
    found, file = [], ""
    for own, test in re.findall(r"`((?:tests/[\w/]+\.py)?)::(\w+)`", cell):
        file = own or file
        found.append((file, test))
    return found


@pytest.mark.parametrize("row", ROWS, ids=lambda row: row[0])
def test_the_tests_that_are_named_are_there(row: list[str]) -> None:
    tests = named(row[1])
    assert tests or row[0] in COMMANDED
    for file, test in tests:
        assert test.startswith("test_") and test in names_in(file), f"{file}::{test}"
    assert row[1].count("::") == len(tests)


def test_every_promise_has_a_row() -> None:
    promised = TEXT.split("## Promised")[1].split("## Not promised")[0]
    names = {name.rstrip(".,") for name in re.findall(r"\*\*(.+?)\*\*", promised)}
    assert names == {row[0] for row in ROWS if not row[0].startswith("…")}


def test_the_commands_are_there() -> None:
    text = (ROOT / "Makefile").read_text(encoding="utf-8")
    for target in re.findall(r"`make ([\w ]+)`", TEXT):
        assert all(re.search(rf"^{name}:", text, re.MULTILINE) for name in target.split()), target
    for file in re.findall(r"`python3 ([\w/.]+)", TEXT):
        assert (ROOT / file).exists(), file
