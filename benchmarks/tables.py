"""Tables in Markdown; nothing here starts MPI, for the benchmarks that start others."""

from __future__ import annotations

from collections.abc import Collection, Iterable
from pathlib import Path


def line(cells: Iterable[str]) -> str:
    """A line of a table."""
    return "| " + " | ".join(cells) + " |"


def head(names: Collection[str]) -> str:
    """The first two lines."""
    return line(names) + "\n|---|" + "---:|" * (len(names) - 1)


def tabulate(
    names: Collection[str], rows: Iterable[Iterable[str]], path: Path, first: bool = True
) -> None:
    """Print a table as its rows come in, and keep it.

    Args:
        names: Of the columns.
        rows: Their cells; all ranks ask for them.
        path: Where the table is kept.
        first: Whether this is rank 0, the one that prints and keeps.
    """
    lines = [head(names)]
    if first:
        print(lines[-1], flush=True)
        path.parent.mkdir(parents=True, exist_ok=True)
    for row in rows:
        lines.append(line(row))
        if first:
            print(lines[-1], flush=True)
            path.write_text("\n".join(lines) + "\n")
