"""The tables: levels on a terminal, in Markdown and as CSV.

The records are those of `output.level_record`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

from ..quantities import KINDS
from ..rounding import at_most, counted, digits_of, interval, rounded_up
from .meanings import PRINTED
from .sheets import as_csv
from .units import GLUE, PLAIN, Units

Column = tuple[str, int, Callable[[Mapping[str, Any]], str]]

FORCE = "the contact force"
LEFT, WRONG = 1e-8, 1.001e-6
"""Parts of the load and of the contact forces that a solver leaves at most, as it is by itself."""

MEASURED = {"h": "x", "contact": "x"}
"""The printed columns whose unit may be told."""


def table_header(first: Mapping[str, Any]) -> str:
    """Return the head of the printed table; `first` is the record that decides on the columns."""
    return " ".join(f"{name:>{width}}" for name, width, _ in _columns(first))


def legend(first: Mapping[str, Any], units: Units = PLAIN) -> str:
    """Say what the printed columns mean, and what they are measured in."""
    return explained({name: PRINTED[name][0] for name, *_ in _columns(first)}, MEASURED, units)


def explained(words: Mapping[str, str], measured: Mapping[str, str], units: Units) -> str:
    """Explain columns in a legend: what they mean, and their units.

    Args:
        words: What the columns mean, by name; those without words are left out.
        measured: Which unit they have, by name.
        units: What is told of that.
    """
    entries = (
        f"{name}: {short}{units.told(measured[name]) if name in measured else ''}"
        for name, short in words.items()
        if short
    )
    return "; ".join(entries)


def facts(record: Mapping[str, Any], units: Units = PLAIN) -> str:
    """Say what happens on Γ1, in a sentence, with the digits that are known.

    A place on Γ1 is known to within a facet, the force as well as it is certain. Where PETSc's
    options have let the solver end before it would have, or rounding has, that is said as well.

    Args:
        record: The last level's.
        units: What lengths and forces are measured in.
    """
    contact, force = record["contact"], record["contact"]["force_bounds"]
    facet = contact["length"] / contact["active"] if contact["active"] else None
    wide = None if force["reason"] is not None else force["upper"] - force["lower"]
    line = (
        f"contact on {contact['active']} of {counted(contact['facets'], 'facet')}, length"
        f" {digits_of(contact['length'], facet)}{units.after('x')}, force"
        f" {digits_of(contact['force'], wide, 4 if wide is None else 6)}{units.after('force')}"
    )
    points = [
        "(" + f",{GLUE}".join(digits_of(value, facet, least=0) for value in point) + ")"
        for point in contact["transitions"]
    ]
    if points:
        more = f" and {len(points) - 6} more" if len(points) > 6 else ""
        line += f"; it begins or ends at {', '.join(points[:6])}{more}{units.after('x')}"
    left, wrong = record["kkt"]["residual"], record["kkt"]["force_error"]
    if left is None or left > LEFT or wrong is None or wrong > WRONG:
        known_to = f"forces are known to {short(wrong)} of their sum"
        line += (
            "; not converged as usual, as an option or rounding ends the solver early: the residual"
            f" is {short(left)} of the load, and"
            f" {'how well forces are known is not known' if wrong is None else known_to}"
        )
    return line


def certificate_lines(record: Mapping[str, Any], units: Units = PLAIN) -> list[str]:
    """Say what is certain about a level, rounded so that it stays certain.

    Args:
        record: The last level's.
        units: What forces and u are measured in.

    Returns:
        A head and what stands under it, a figure each; or one sentence, if there is no bound.
    """
    if record["bound_h1"] is None:
        return [f"no bound of the error: {record['bound_reason']}"]
    facts = ["certified:", f"‖∇_h(u − u_h)‖ is at most {at_most(record['bound_h1'])}"]
    own = at_most(record["bound_energy_norm"])
    if own != at_most(record["bound_h1"]):  # where κ is not 1, or with c or b
        facts.append(f"in the norm of the energy it is at most {own}")
    energy = record["energy_bounds"]
    if energy["lower"] is not None and energy["upper"] is not None:
        facts.append(f"J(u) is in {_interval(energy['lower'], energy['upper'])}")
    force, quantities = record["contact"]["force_bounds"], record["quantities"]
    same = [name for name, found in quantities.items() if _is_all_of(force, found)]
    others = {name: found for name, found in quantities.items() if name not in same}
    for name, found in {FORCE: force, **others}.items():
        if found["reason"] is None:
            unit = unit_of(found, units)
            also = f" (this is {', '.join(same)})" if found is force and same else ""
            facts.append(f"{name} is in {_interval(found['lower'], found['upper'], unit)}{also}")
        else:
            facts.append(f"{name} has no bounds: {found['reason']}")
    return facts


def _is_all_of(force: Mapping[str, Any], found: Mapping[str, Any]) -> bool:
    """Tell whether a quantity is the total contact force under another name."""
    return is_plain_force(found) and all(found[end] == force[end] for end in ("lower", "upper"))


def is_plain_force(found: Mapping[str, Any]) -> bool:
    """Tell whether a quantity is a contact force without a weight, and has bounds."""
    plain = found.get("kind") == "force" and not found["weighted"]
    return plain and found["reason"] is None


def unit_of(found: Mapping[str, Any], units: Units) -> str:
    """Return the unit of a quantity, "" where it depends on a weight's or is not told."""
    kind = KINDS[found.get("kind", "force")]
    unit = kind.weighted_unit if found.get("weighted") else kind.unit
    return units.after(unit) if unit else ""


def _interval(lower: float, upper: float, measured: str = "") -> str:
    """Format an interval that holds [lower, upper], its unit, its width in parts of the middle."""
    width, middle = upper - lower, 0.5 * abs(lower + upper)
    apart = 0.0 < width < 2.0 * middle  # from 0
    # rounded up, but not for what is rounding itself: 1.1 − 0.9 is 20 % of 1
    wide = f", {at_most((100 - 1e-9) * width / middle, 2)}{GLUE}% wide" if apart else ""
    ends = interval(lower, upper).replace(" ", GLUE)
    return f"{ends}{measured}{wide}"


def times(records: Sequence[Mapping[str, Any]]) -> str:
    """Say how long the levels have taken, and what with."""
    names = {"mesh": "meshes", "assemble": "assembly", "solve": "solver", "estimate": "certificate"}
    each = {
        words: sum(record["seconds"].get(phase) or 0.0 for record in records)
        for phase, words in names.items()
    }
    parts = ", ".join(f"{words} {_time(seconds)}" for words, seconds in each.items())
    text = f"{_time(sum(each.values()))}{GLUE}s for all levels: {parts}"
    if len(records) > 1:
        levels = (sum(r["seconds"].get(phase) or 0.0 for phase in names) for r in records)
        text += f"; level by level {', '.join(map(_time, levels))}"
    return text


def _time(seconds: float) -> str:
    return digits_of(seconds, None, 2)


def table_row(record: Mapping[str, Any], first: Mapping[str, Any] | None = None) -> str:
    """Return the row of `record` in the printed table (80 columns at most below 10⁷ cells)."""
    return " ".join(f"{cell(record):>{width}}" for _, width, cell in _columns(first or record))


def markdown_table(records: Sequence[Mapping[str, Any]], units: Units = PLAIN) -> str:
    """Return the printed table in Markdown, units in its head."""
    columns = _columns_of_all(records) if records else []
    head, *rows = rows_of(columns, records, MEASURED, units)
    rows = [head, [(w - 1) * "-" + ":" for _, w, _ in columns], *rows]
    lines = (
        " | ".join(f"{text:>{width}}" for text, (_, width, _) in zip(row, columns, strict=True))
        for row in rows
    )
    return "".join(f"| {line} |\n" for line in lines)


def table_rows(records: Sequence[Mapping[str, Any]], units: Units = PLAIN) -> list[list[str]]:
    """Return the cells of the printed table, its head first, which has the units."""
    return rows_of(_columns_of_all(records), records, MEASURED, units)


def rows_of(
    columns: Sequence[Column],
    records: Sequence[Mapping[str, Any]],
    measured: Mapping[str, str],
    units: Units,
) -> list[list[str]]:
    """Return the cells of a table, its head first.

    Args:
        columns: Name, width and contents of each.
        records: One a row.
        measured: Which unit the columns have, by name.
        units: What is told of that.
    """
    told = {name: units.after(key).strip() for name, key in measured.items()}
    head = [f"{name}, {told[name]}" if told.get(name) else name for name, *_ in columns]
    return [head, *([cell(record) for _, _, cell in columns] for record in records)]


def levels_csv(records: Sequence[Mapping[str, Any]]) -> str:
    """Write one line a level, all of the record: `kkt_min_gap` is `min_gap` in `kkt`, and so on.

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
    names = list(rows[0]) if rows else []  # later rows may be a newer version's, and have more
    return as_csv(names, (map(row.get, names) for row in rows))


def _columns(first: Mapping[str, Any]) -> list[Column]:
    """Return name, width and contents of the printed columns, for records like `first`."""
    bound, exact = first["bound_h1"] is not None, first["error_h1"] is not None
    columns: list[Column] = [
        ("level", 5, lambda r: str(r["level"])),
        ("cells", 7, lambda r: str(r["cells"])),
        ("dofs", 7, lambda r: str(r["dofs"])),
        ("h", 7, lambda r: short(r["h"])),
        ("newton", 6, lambda r: str(r["newton_iterations"])),
        ("cg", 3, lambda r: str(r["linear_iterations"])),
        ("active", 6, lambda r: str(r["contact"]["active"])),
    ]
    if exact:
        columns += [
            ("H1 error", 8, lambda r: short(r["error_h1"])),
            ("rate", 4, lambda r: _fixed(r["rate_h1"])),
            ("L2 error", 8, lambda r: short(r["error_l2"])),
            ("rate", 4, lambda r: _fixed(r["rate_l2"])),
        ]
    else:
        columns += [
            ("energy", 12, energy),
            ("contact", 8, lambda r: short(r["contact"]["length"])),
        ]
    if bound:
        columns.append(("bound", 7, bound_of))
    if bound and exact:
        # Eighty columns: the number of cells gives way, it is in levels.csv
        del columns[1]
        columns.append(("eff.", 4, lambda r: _fixed(r["effectivity"])))
    return columns


def _columns_of_all(records: Sequence[Mapping[str, Any]]) -> list[Column]:
    """Return the same for all records, of which some may have a bound and others none."""
    bounded = (record for record in records if record["bound_h1"] is not None)
    return _columns(next(bounded, records[0]))


def bound_of(record: Mapping[str, Any]) -> str:
    """Format the certified bound of a level or a step, some of which may have none."""
    bound = record["bound_h1"]
    return "none" if bound is None else short(rounded_up(bound))


def energy(record: Mapping[str, Any], otherwise: int = 7) -> str:
    """Format J(u_h) with the digits that J(u) has for certain.

    Args:
        record: A level's, or a step's.
        otherwise: How many digits it has where nothing is certain.
    """
    if record["energy"] is None:
        return "-"
    ends = record.get("energy_bounds", {})  # steps that an older version has left have none
    low, high = ends.get("lower"), ends.get("upper")
    wide = None if low is None or high is None else high - low
    return digits_of(record["energy"], wide, otherwise if wide is None else 7)


def short(value: float | None, digits: int = 3) -> str:
    """Format a number in so many digits and at most four characters more (below 1e10)."""
    if value is None:
        return "-"
    mantissa, power = f"{value:.{digits - 1}e}".split("e")
    if -3 <= int(power) < digits:
        return f"{value:#.{digits}g}".rstrip(".")
    return f"{mantissa}e{int(power)}"


def _fixed(value: float | None) -> str:
    """Format a number in three digits, in at most four characters between -9.9 and 999."""
    if value is None:
        return "-"
    digits = 2 if 0 <= value < 9.995 else 1 if value < 99.95 else 0
    return f"{value:.{digits}f}"
