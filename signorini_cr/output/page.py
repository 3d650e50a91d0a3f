"""One page that holds a whole run, to be sent or kept: nothing in it points elsewhere."""

from __future__ import annotations

import base64
import shlex
from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any

from .tables import certified, legend, table_rows, times
from .units import Units

PICTURES = {
    "mesh.png": "The mesh and the parts of its boundary",
    "solution.png": "The solution u_h, and where there is contact",
    "contact.png": "What happens along the contact boundary",
    "convergence.png": "Errors and bounds of the levels",
}
STYLE = (
    "body{font:16px/1.5 sans-serif;max-width:60rem;margin:auto;padding:0 1rem;color:#222}"
    "img{max-width:100%;height:auto}figure{margin:1rem 0}"
    "pre,.wide{overflow-x:auto;background:#f4f4f4;padding:.5rem}"
    "pre{white-space:pre-wrap;overflow-wrap:anywhere}"
    "table{border-collapse:collapse}td,th{padding:.1rem .5rem;text-align:right}"
    "@media(max-width:30rem){pre{font-size:.75rem}table{font-size:.65rem}td,th{padding:.1rem}}"
)


def run_page(
    folder: Path,
    source: str,
    report: Mapping[str, Any],
    words: Sequence[str],
    problem: str,
    fact: str,
) -> str:
    """The HTML of a run; of the pictures there are those that lie in the folder.

    Args:
        folder: With the run's results.
        source: The text of the problem file.
        report: From `make_report`.
        words: The command line, without the program's name.
        problem: What is solved, as on the screen.
        fact: What happens on Γ1, as on the screen.
    """
    title, levels = escape(report["title"] or "Signorini problem"), report["levels"]
    units = Units.of(report)
    head, *rows = table_rows(levels, units)
    table = "".join(
        "<tr>" + "".join(f"<{kind}>{escape(cell)}</{kind}>" for cell in row) + "</tr>"
        for kind, row in [("th", head), *(("td", row) for row in rows)]
    )
    certain = certified(levels[-1], units)
    versions = ", ".join(f"{name} {number}" for name, number in report["versions"].items())
    launch = ["mpirun", "-n", str(report["ranks"])] if report["ranks"] > 1 else []
    pictures = "".join(
        f'<figure><img alt="{escape(what)}" src="data:image/png;base64,'
        f'{base64.b64encode((folder / name).read_bytes()).decode()}">'
        f"<figcaption>{escape(what)}</figcaption></figure>"
        for name, what in PICTURES.items()
        if (folder / name).exists()
    )
    return (
        '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{title}</title><style>{STYLE}</style></head><body>\n<h1>{title}</h1>\n"
        f"<pre>{escape(problem)}</pre>\n<p>{escape(fact)}</p>\n<p>{escape(certain)}</p>\n"
        f'{pictures}\n<h2>Levels</h2>\n<div class="wide"><table>{table}</table></div>\n'
        f"<p>{escape(legend(levels[0], units))}</p>\n<p>{escape(times(levels))}</p>\n"
        f"<h2>Problem file</h2>\n<pre>{escape(source)}</pre>\n"
        f"<h2>To do it again</h2>\n<pre>{escape(shlex.join([*launch, 'signorini-cr', *words]))}"
        f"</pre>\n<p>{escape(versions)}</p>\n</body></html>\n"
    )
