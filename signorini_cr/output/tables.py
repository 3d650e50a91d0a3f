"""The tables: levels on a terminal, in Markdown and as CSV, contact facets as CSV.

The records are those of `output.level_record`.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any

import numpy.typing as npt

from ..rounding import at_most, interval, rounded_up
from .meanings import PRINTED
from .units import PLAIN, Units

Column = tuple[str, int, Callable[[Mapping[str, Any]], str]]

MEASURED = {"h": "x", "contact": "x"}
"""The printed columns whose unit may be told."""


def table_header(first: Mapping[str, Any]) -> str:
    """The head of the printed table; `first` is the record that decides on the columns."""
    return " ".join(f"{name:>{width}}" for name, width, _ in _columns(first))


def legend(first: Mapping[str, Any], units: Units = PLAIN) -> str:
    """What the printed columns mean, and what they are measured in."""
    words = {name: PRINTED[name][0] for name, *_ in _columns(first)}
    for name in MEASURED.keys() & words:
        if unit := units.after(MEASURED[name]):
            words[name] += f", in{unit}"
    return "; ".join(f"{name}: {short}" for name, short in words.items() if short)


def certified(record: Mapping[str, Any], units: Units = PLAIN) -> str:
    """What is certain about a level, rounded so that it stays certain.

    Args:
        record: The last level's.
        units: What forces and u are measured in.
    """
    if record["bound_h1"] is None:
        return f"no bound of the error: {record['bound_reason']}"
    facts = [f"certified: ‖∇_h(u − u_h)‖ is at most {at_most(record['bound_h1'])}"]
    energy = record["energy_bounds"]
    if energy["lower"] is not None and energy["upper"] is not None:
        facts.append(f"J(u) is in {_interval(energy['lower'], energy['upper'])}")
    wanted = {"the contact force": record["contact"]["force_bounds"], **record["quantities"]}
    for name, found in wanted.items():
        if found["reason"] is None:
            unit = units.after("u" if found.get("kind") == "mean" else "force")
            facts.append(f"{name} is in {_interval(found['lower'], found['upper'], unit)}")
        else:
            facts.append(f"{name} has no bounds: {found['reason']}")
    return "; ".join(facts)


def _interval(lower: float, upper: float, measured: str = "") -> str:
    """An interval that holds [lower, upper], its unit, and its relative width."""
    width, size = upper - lower, max(abs(lower), abs(upper))
    wide = f", {at_most(100 * width / size, 2)} % wide" if width > 0.0 else ""
    return f"{interval(lower, upper)}{measured}{wide}"


def times(records: Sequence[Mapping[str, Any]]) -> str:
    """How long the levels have taken, and what with."""
    names = {"mesh": "meshes", "assemble": "assembly", "solve": "solver", "estimate": "certificate"}
    each = {
        words: sum(record["seconds"].get(phase) or 0.0 for record in records)
        for phase, words in names.items()
    }
    parts = ", ".join(f"{words} {seconds:.2g}" for words, seconds in each.items())
    return f"{sum(each.values()):.2g} s for all levels: {parts}"


def table_row(record: Mapping[str, Any], first: Mapping[str, Any] | None = None) -> str:
    """The row of `record` in the printed table (80 columns at most below 10⁷ cells)."""
    return " ".join(f"{cell(record):>{width}}" for _, width, cell in _columns(first or record))


def markdown_table(records: Sequence[Mapping[str, Any]], units: Units = PLAIN) -> str:
    """The printed table in Markdown, units in its head."""
    columns = _columns(records[0]) if records else []
    rows = [_heads(columns, units), [(w - 1) * "-" + ":" for _, w, _ in columns]]
    rows += [[cell(record) for _, _, cell in columns] for record in records]
    lines = (
        " | ".join(f"{text:>{width}}" for text, (_, width, _) in zip(row, columns, strict=True))
        for row in rows
    )
    return "".join(f"| {line} |\n" for line in lines)


def table_rows(records: Sequence[Mapping[str, Any]], units: Units = PLAIN) -> list[list[str]]:
    """The cells of the printed table, its head first, which has the units."""
    columns = _columns(records[0])
    return [
        _heads(columns, units),
        *([cell(record) for _, _, cell in columns] for record in records),
    ]


def _heads(columns: Sequence[Column], units: Units) -> list[str]:
    measured = {name: units.after(key) for name, key in MEASURED.items()}
    return [f"{name}, {unit}" if (unit := measured.get(name, "").strip()) else name
            for name, _, _ in columns]  # fmt: skip


def levels_csv(records: Sequence[Mapping[str, Any]]) -> str:
    """One line a level, all of the record: `kkt_min_gap` is `min_gap` in `kkt`, and so on.

    What is null is left empty; the transition points read `x y; x y`.
    """

    def cells(record: Mapping[str, Any]) -> Iterator[tuple[str, Any]]:
        for key, value in record.items():
            if isinstance(value, Mapping):
                yield from ((f"{key}_{name}", cell) for name, cell in cells(value))
            elif isinstance(value, list):
                yield key, "; ".join(" ".join(map(repr, point)) for point in value)
            else:
                yield key, value

    rows = [dict(cells(record)) for record in records]
    return _csv(rows[0] if rows else (), (row.values() for row in rows))


def contact_csv(table: Mapping[str, npt.NDArray]) -> str:
    """One line a contact facet, in order along the boundary; `active` is 0 or 1.

    Args:
        table: From `Contact.table`.
    """
    columns = [column.astype(int) if column.dtype == bool else column for column in table.values()]
    return _csv(table, zip(*(column.tolist() for column in columns), strict=True))


def _csv(names: Iterable[str], rows: Iterable[Iterable[Any]]) -> str:
    text = io.StringIO()
    lines = csv.writer(text, lineterminator="\n")
    lines.writerow(names)
    lines.writerows(rows)
    return text.getvalue()


def _columns(first: Mapping[str, Any]) -> list[Column]:
    """Name, width and contents of the printed columns, for records like `first`."""
    bound, exact = first["bound_h1"] is not None, first["error_h1"] is not None
    columns: list[Column] = [
        ("level", 5, lambda r: str(r["level"])),
        ("cells", 7, lambda r: str(r["cells"])),
        ("dofs", 7, lambda r: str(r["dofs"])),
        ("h", 7, lambda r: _short(r["h"])),
        ("newton", 6, lambda r: str(r["newton_iterations"])),
        ("cg", 3, lambda r: str(r["linear_iterations"])),
        ("active", 6, lambda r: str(r["contact"]["active"])),
    ]
    if exact:
        columns += [
            ("H1 error", 8, lambda r: _short(r["error_h1"])),
            ("rate", 4, lambda r: _fixed(r["rate_h1"])),
            ("L2 error", 8, lambda r: _short(r["error_l2"])),
            ("rate", 4, lambda r: _fixed(r["rate_l2"])),
        ]
    else:
        columns += [
            ("energy", 12, lambda r: "-" if r["energy"] is None else f"{r['energy']:.7g}"),
            ("contact", 8, lambda r: _short(r["contact"]["length"])),
        ]
    if bound:
        columns.append(("bound", 7, lambda r: _short(rounded_up(r["bound_h1"]))))
    if bound and exact:
        # Eighty columns: the number of cells gives way, it is in levels.csv
        del columns[1]
        columns.append(("eff.", 4, lambda r: _fixed(r["effectivity"])))
    return columns


def _short(value: float | None) -> str:
    """Three digits in at most seven characters (below 1e10)."""
    if value is None:
        return "-"
    if value == 0 or 1e-3 <= abs(value) < 1e4:
        return f"{value:#.3g}".rstrip(".")
    mantissa, power = f"{value:.2e}".split("e")
    return f"{mantissa}e{int(power)}"


def _fixed(value: float | None) -> str:
    """Three digits in at most four characters, where they are between -9.9 and 999."""
    if value is None:
        return "-"
    digits = 2 if 0 <= value < 9.995 else 1 if value < 99.95 else 0
    return f"{value:.{digits}f}"
