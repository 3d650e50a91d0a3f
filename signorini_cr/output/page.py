"""One page that holds a whole run, to be sent or kept: nothing in it points elsewhere."""

from __future__ import annotations

import base64
import os
import shlex
from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any

from . import series, tables
from .report import FIELDS
from .units import Units

PICTURES = {
    "strip.png": "The solution u_h at some moments, and where there is contact",
    "mesh.png": "The mesh, the finest whose cells can be told apart, and the parts of its boundary",
    "solution.png": "The solution u_h, and where there is contact",
    "contact.png": "What happens along the contact boundary",
    "convergence.png": "{} of the levels",
}
AT_THE_END = {"solution.png", "contact.png"}
"""Those that are of the last step, in a run in time."""

STYLE = (
    "body{font:16px/1.5 sans-serif;max-width:60rem;margin:auto;padding:0 1rem;color:#222}"
    "h1,p{overflow-wrap:anywhere}"
    "figure{margin:1rem 0}figure span{display:block;overflow-x:auto}"
    "img{display:block;max-width:100%;height:auto;cursor:zoom-in}"
    # a picture is drawn large: touched, it is shown as large as that, to be moved about
    "input{position:absolute;opacity:0}input:focus-visible+span{outline:2px solid #004488}"
    "input:checked+span img{max-width:none;cursor:zoom-out}"
    "pre,.wide{overflow-x:auto;background:#f4f4f4;padding:.5rem}"
    "pre{white-space:pre-wrap;overflow-wrap:anywhere;font-size:.875rem}"
    "dl{display:grid;grid-template-columns:max-content 1fr;gap:0 1rem;"
    "background:#f4f4f4;padding:.5rem}dd{margin:0;overflow-wrap:anywhere}dt{font-weight:bold}"
    "table{border-collapse:collapse}td,th{padding:.1rem .5rem;text-align:right;white-space:nowrap}"
    "@media(max-width:40rem){table{font-size:.8rem}td,th{padding:.1rem .4rem}"
    "dl{display:block}dd{margin:0 0 .5rem 1rem}}"
)


def run_page(
    folder: Path,
    source: str,
    report: Mapping[str, Any],
    words: Sequence[str],
    problem: Mapping[str, str],
) -> str:
    """Write the HTML of a run; of the pictures there are those that lie in the folder.

    Args:
        folder: With the run's results.
        source: The text of the problem file.
        report: From `make_report`, with the `times` of a run in time.
        words: The command line, without the program's name.
        problem: What is solved: a line by the name of what it is about.
    """
    title, level, units = (
        report["title"] or "Signorini problem",
        report["levels"][-1],
        Units.of(report),
    )
    steps = report.get("times")
    # the launcher's environment has the command, and nothing else of the system has
    launch = ["./container/run"] if "SIGNORINI_CR_SUITE" in os.environ else []
    launch += ["mpirun", "-n", str(report["ranks"])] if report["ranks"] > 1 else []
    versions = ", ".join(f"{name} {number}" for name, number in report["versions"].items())
    statement = "".join(
        f"<dt>{escape(name)}</dt><dd>{escape(text)}</dd>" for name, text in problem.items()
    )
    head, *figures = tables.certificate_lines(level, units)
    if steps is None:
        known = [tables.facts(level, units), head]
    else:
        known = [
            f"At the end {tables.facts(level, units)}",
            series.certificate_line(steps),
            *series.over_time(steps, units),
            f"the last step's own problem, {head}",
        ]
    parts = [
        f"<h1>{escape(title)}</h1>",
        f"<dl>{statement}</dl>",
        *(_paragraph(text[0].upper() + text[1:]) for text in known),
        _list(figures),
        *(
            _picture(
                folder / name,
                what.format(_drawn(report["levels"]))
                + (" at the end" if steps and name in AT_THE_END else ""),
            )
            for name, what in PICTURES.items()
            if (folder / name).exists()
        ),
        *_search(report.get("search", [])),
        *(_levels(report["levels"], units) if steps is None else _steps(steps, units)),
        "<h2>Problem file</h2>",
        f"<pre>{escape(source)}</pre>",
        "<h2>To do it again</h2>",
        f"<pre>{escape(shlex.join([*launch, 'signorini-cr', *words]))}</pre>",
        _paragraph(versions),
    ]
    return (
        '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{escape(title)}</title><style>{STYLE}</style></head><body>\n"
        + "\n".join(parts)
        + "\n</body></html>\n"
    )


def _drawn(records: Sequence[Mapping[str, Any]]) -> str:
    """Say whether errors, bounds or both are known."""
    names = {"error_h1": "errors", "bound_h1": "bounds"}
    there = [name for key, name in names.items() if any(record[key] for record in records)]
    return " and ".join(there).capitalize()


def _levels(records: Sequence[Mapping[str, Any]], units: Units) -> list[str]:
    return [
        "<h2>Levels</h2>",
        _table(tables.table_rows(records, units)),
        _paragraph(tables.legend(records[0], units)),
        _paragraph(tables.times(records)),
    ]


def _search(records: Sequence[Mapping[str, Any]]) -> list[str]:
    """List the meshes that were tried."""
    if not records:
        return []
    words = "Meshes on which all steps were solved, to find the last: bound is the largest of all."
    return ["<h2>Search for the mesh</h2>", _table(series.search_rows(records)), _paragraph(words)]


def _steps(records: Sequence[Mapping[str, Any]], units: Units) -> list[str]:
    fields = f"{series.SERIES} opens the fields of all steps, {FIELDS}, in ParaView"
    return [
        "<h2>Steps</h2>",
        _table(series.table_rows(records, units)),
        _paragraph(series.legend(units)),
        _paragraph(series.times(records)),
        _paragraph(f"Beside this page, {fields}; {series.TABLE} is the table."),
    ]


def _paragraph(text: str) -> str:
    return f"<p>{escape(text)}</p>"


def _list(items: Sequence[str]) -> str:
    entries = "".join(f"<li>{escape(item)}</li>" for item in items)
    return f"<ul>{entries}</ul>" if items else ""


def _table(rows: Sequence[Sequence[str]]) -> str:
    """Make a table whose first row is the head; what is too wide can be moved sideways."""
    lines = "".join(
        "<tr>" + "".join(f"<{kind}>{escape(cell)}</{kind}>" for cell in row) + "</tr>"
        for kind, row in zip(["th", *["td"] * (len(rows) - 1)], rows, strict=True)
    )
    return f'<div class="wide" tabindex="0"><table>{lines}</table></div>'


def _picture(path: Path, what: str) -> str:
    data = base64.b64encode(path.read_bytes()).decode()
    return (
        f'<figure><label><input type="checkbox" aria-label="full size"><span>'
        f'<img alt="{escape(what)}" src="data:image/png;base64,{data}"></span></label>'
        f"<figcaption>{escape(what)} (a touch enlarges it)</figcaption></figure>"
    )
