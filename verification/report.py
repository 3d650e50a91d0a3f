"""The results of a group of cases, and the document that tells them."""

from __future__ import annotations

import re
import sys
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from mpi4py import MPI

SHOWN = 5
"""Failures that are named; the others are counted."""


@dataclass
class Row:
    """Cases of one kind.

    Attributes:
        name: What they have in common.
        cases: How many.
        worst: The worst figure, and whatever else was counted.
        reference: What they were compared with, and how that is known.
        failures: One line for each that failed.
    """

    name: str
    cases: int
    worst: str
    reference: str
    failures: list[str] = field(default_factory=list)

    @property
    def passed(self) -> bool:
        """True if none failed, and there were any."""
        return self.cases > 0 and not self.failures


@dataclass
class Group:
    """Rows that share a table.

    Attributes:
        name: Of the command line.
        title: Of the table.
        claim: What passing means.
        rows: In order.
    """

    name: str
    title: str
    claim: str
    rows: list[Row]

    def lines(self) -> list[str]:
        """The table in Markdown."""
        out = [f"## {self.title}", "", self.claim, ""]
        out.append(f"    ./container/run python3 verification --only {self.name}")
        out += ["", "| case | number | worst | reference, and how it is known | passed |"]
        out.append("|---|---:|---|---|---|")
        for row in self.rows:
            verdict = "yes" if row.passed else f"**no**, {len(row.failures)} failed"
            out.append(f"| {row.name} | {row.cases} | {row.worst} | {row.reference} | {verdict} |")
        failed = [row for row in self.rows if row.failures]
        if failed:
            out += ["", "What failed:", ""]
            for row in failed:
                out += [f"- {row.name}: {line}" for line in row.failures[:SHOWN]]
                if len(row.failures) > SHOWN:
                    out.append(f"- {row.name}: and {len(row.failures) - SHOWN} more")
        return [*out, ""]


def told(row: Row) -> Row:
    """Say on rank 0 that a row is done, as the whole takes minutes."""
    if MPI.COMM_WORLD.rank == 0:
        verdict = "passed" if row.passed else f"{len(row.failures)} failed"
        print(f"{row.name}: {row.cases} cases, {verdict}", file=sys.stderr, flush=True)
    return row


HEAD = """# Verification

What the program claims, checked by code that shares nothing with the part under test: discrete
solutions against a direct solver of its own matrices, bounds and energies against solutions in
closed form integrated on triangles that are split where the data jump. `make verify` runs all of it
and writes this page; `verification/` has the code, and says what is independent of what. The
figures are those of RANKS, each row's figure that of its worst case;
[the counts](promises.md#counts) tell what has been run on more.
"""


def document(sections: Iterable[str]) -> str:
    """The whole page."""
    size = MPI.COMM_WORLD.size
    ranks = "one rank" if size == 1 else f"{size} ranks"
    return HEAD.replace("RANKS", ranks) + "\n" + "\n".join(sections)


def write(groups: Sequence[Group], names: Sequence[str], path: Path) -> None:
    """Put groups into the page; the tables of others stay as they are.

    Args:
        groups: Some.
        names: Of all groups, in their order on the page.
        path: The page; made if it is not there.
    """
    before = path.read_text(encoding="utf-8") if path.exists() else ""
    found = {}
    for section in re.split(r"^(?=## )", before, flags=re.MULTILINE)[1:]:
        command = re.search(r"^    .* verification --only (\w+)$", section, re.MULTILINE)
        if command is not None:
            found[command[1]] = section.rstrip("\n") + "\n"
    found |= {group.name: "\n".join(group.lines()) for group in groups}
    path.write_text(document(found[name] for name in names if name in found), encoding="utf-8")
