"""Demos as notebooks: run cell by cell, with their prose where it stands among the results."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any


@dataclass(frozen=True)
class Cell:
    """A cell of a script in py:percent format.

    Attributes:
        before: Number of lines above its source.
        markdown: Whether it is prose.
        source: Its lines, with the comment signs where it is prose.
    """

    before: int
    markdown: bool
    source: str

    def prose(self) -> list[str]:
        """The text, headings one level down and the title left out; none if it is a heading."""
        lines = [re.sub("^# ?", "", line) for line in self.source.splitlines()]
        lines = [f"#{line}" if line.startswith("## ") else line for line in lines]
        text = "\n".join(line for line in lines if not line.startswith("# ")).strip()
        return [text] if "\n" in text else []


def cells(text: str) -> list[Cell]:
    """Split a script that begins with a cell."""
    lines = text.splitlines()
    starts = [k for k, line in enumerate(lines) if line.startswith("# %%")]
    return [
        Cell(start + 1, lines[start].endswith("[markdown]"), "\n".join(lines[start + 1 : end]))
        for start, end in zip(starts, [*starts[1:], len(lines)], strict=True)
    ]


def run(script: Path) -> tuple[str, list[str]]:
    """Run a demo whose `study` is a `Study`; collective.

    Returns:
        Title and parts of its page: the prose, and behind each cell what the study got from it.
    """
    names: dict[str, Any] = {"__name__": "__main__", "__file__": str(script)}
    page: list[str] = []
    told = 0
    for cell in cells(script.read_text(encoding="utf-8")):
        if cell.markdown:
            page += cell.prose()
            continue
        # with the lines above it, so that a traceback names the right one
        code = compile("\n" * cell.before + cell.source, str(script), "exec", dont_inherit=True)
        exec(code, names)
        if "study" in names:
            page += names["study"].parts[told:]
            told = len(names["study"].parts)
    return names["study"].title, page
