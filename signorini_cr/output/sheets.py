"""The CSV files that have columns of their own: their writers, and what the columns mean.

Nothing heavy is imported here: ``--help columns`` answers at once.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Iterable, Mapping
from typing import TYPE_CHECKING, Any, NamedTuple

if TYPE_CHECKING:
    import numpy.typing as npt

    Facets = Mapping[str, npt.NDArray]
    """The columns of `ContactFacts.table`."""


class Sheet(NamedTuple):
    """A CSV file that a run leaves behind; it is written anew after each mesh.

    Attributes:
        head: What stands over the columns in help and reference.
        columns: What they mean, by name.
        text: Makes the text from what report.json holds and from the contact facets.
    """

    head: str
    columns: Mapping[str, str]
    text: Callable[[Mapping[str, Any], Facets], str]


FACET = {
    "part": "Connected piece of Γ1, from 0.",
    "arc_length": "Of the facet's midpoint, from the piece's beginning, Ω to the left.",
    "x": "Of its midpoint.",
    "y": "Of its midpoint.",
    "length": "Of the facet.",
    "obstacle": "The lower bound of u_h there, the mean of α.",
    "upper": "The upper bound of u_h there, the mean of β; only if there are some.",
    "u": "u_h at the midpoint.",
    "pressure": "λ_h, constant on the facet; below 0 on the upper bound, 0 without contact.",
    "active": "1 in contact, 0 elsewhere.",
    "name": "Of its part of the boundary; only if several have contact.",
}
"""The columns of contact.csv."""


def contact_csv(table: Facets) -> str:
    """Write one line a contact facet, in order along the boundary; `active` is 0 or 1.

    Args:
        table: From `ContactFacts.table`.
    """
    columns = [column.astype(int) if column.dtype == bool else column for column in table.values()]
    return as_csv(table, zip(*(column.tolist() for column in columns), strict=True))


def as_csv(names: Iterable[str], rows: Iterable[Iterable[Any]]) -> str:
    """Write a head and the lines below it."""
    text = io.StringIO()
    lines = csv.writer(text, lineterminator="\n")
    lines.writerow(names)
    lines.writerows(rows)
    return text.getvalue()


SHEETS = {
    "contact.csv": Sheet(
        "Columns of contact.csv, a line a facet in order along the boundary",
        FACET,
        lambda _, facets: contact_csv(facets),
    ),
}
"""All there are, by name."""
