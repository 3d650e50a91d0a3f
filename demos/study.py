"""Tools that the demos share: runs over a sequence of meshes, tables, pictures, and their folder.

A demo takes a folder as its argument (`demo-output` without one) and leaves there its pictures
and its tables, as Markdown. SIGNORINI_DEMO_LEVELS in the environment limits the number of meshes.
`notebook.py` runs a demo cell by cell and has its prose as well.
"""

from __future__ import annotations

import gc
import itertools
import os
import sys
import textwrap
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np
from mpi4py import MPI  # first: the DOLFINx of the wheels finds the MPI that is loaded

# isort: split
from dolfinx.mesh import Mesh, entities_to_geometry

from signorini_cr import exact, norms, plots, solve, solve_levels, theory
from signorini_cr.errors import on_root
from signorini_cr.output import canvas
from signorini_cr.output.strip import Moment, plot_strip
from signorini_cr.output.units import Units
from signorini_cr.solution import Solution
from signorini_cr.verification.exact import Example

if TYPE_CHECKING:
    from matplotlib.axes import Axes

comm = MPI.COMM_WORLD

COLOURS = (
    canvas.BLUE,
    canvas.RED,
    canvas.YELLOW,
    "#117733",
    "#66A6D9",
    "#882255",
    canvas.GREY,
    "black",
)
MARKERS = "osD^vP*X"

ENDS = "contact begins or ends"
"""Name of such points in pictures of a solution."""

CALLED = {"C": "C 7/2", "C2": "C 11/2"}
"""Names of examples whose names in `exact.ALL` say too little."""


def called(name: str) -> str:
    """Return the name of an example in tables and pictures."""
    return CALLED.get(name, name)


FAMILIES = {
    "structured": "squares cut in two",
    "mapped": "the same, mapped by $x \\mapsto x + 0.31(1-x^2)$",
    "gmsh": "unstructured, from gmsh, refined",
    "jitter": "squares cut in two, every vertex moved at random",
}
"""Kinds of mesh sequences that `run` knows."""


LARGE = 100_000
"""Degrees of freedom of a mesh that is not left to Python to look for, which takes a while."""


@dataclass(frozen=True)
class Row:
    """Figures of a solution; None or not a number where one is not known."""

    h: float
    cells: int
    dofs: int
    h1: float
    l2: float
    pressure: float
    distance: float
    energy: float
    newton: int
    active: int
    facets: int
    judgement: theory.Judgement | None


def wanted_folder(usual: str) -> Path:
    """Take the folder for the results from the command line; what looks like an option ends it."""
    given = sys.argv[1] if len(sys.argv) > 1 else usual
    if given.startswith("-"):
        if comm.rank == 0:
            print(f"usage: python3 {sys.argv[0]} [FOLDER]\n\nFOLDER is {usual} without an argument")
        sys.exit(0 if given in ("-h", "--help") else 2)
    return Path(given)


def levels_wanted(default: int, least: int = 3) -> int:
    """The number of meshes, limited by SIGNORINI_DEMO_LEVELS.

    Args:
        default: Without a limit.
        least: With any limit; three for a rate, more where rates settle late.
    """
    return min(default, max(least, int(os.environ.get("SIGNORINI_DEMO_LEVELS", default))))


def solutions(
    example: Example, element: str, family: str, levels: int, coarsest: int = 4
) -> Iterator[Solution]:
    """Solve on a sequence of meshes, each with half the facet length of the one before.

    Args:
        example: What to solve.
        element: "CR" or "P1".
        family: A key of `FAMILIES`.
        levels: Number of meshes.
        coarsest: Squares (or gmsh facets) per unit length on the first.
    """
    if family == "jitter":
        # These meshes are not nested: each is solved from nothing
        for level in range(levels):
            domain = example.structured(coarsest * 2**level, jitter=0.2, seed=level)
            yield solve(example.problem, domain, element)
        return
    domain = {
        "structured": lambda: example.structured(coarsest),
        "mapped": lambda: example.structured(coarsest, shift=0.31),
        "gmsh": lambda: example.mesh(1 / coarsest),
    }[family]()
    yield from solve_levels(example.problem, domain, levels, element)


def run(
    name: str, element: str = "CR", family: str = "structured", levels: int = 8
) -> tuple[Row, ...]:
    """Solve `exact.ALL[name]` on a sequence of meshes; asked again, the answer is there."""
    return _run(name, element, family, levels)


@cache
def _run(name: str, element: str, family: str, levels: int) -> tuple[Row, ...]:
    example = exact.ALL[name]
    rows: list[Row] = []
    before: Solution | None = None
    for solution in solutions(example, element, family, levels):
        h1, l2 = solution.errors or (np.nan, np.nan)
        pressure = distance = np.nan
        if example.pressure is not None:
            pressure = norms.pressure_error(solution, example.pressure)
        if example.problem.exact is None and before is not None:
            distance = norms.distance(before, solution)
        rows.append(
            Row(
                solution.h,
                solution.cells,
                solution.dofs,
                h1,
                l2,
                pressure,
                distance,
                solution.energy,
                solution.iterations.newton,
                solution.contact.number_active,
                solution.contact.number,
                None if example.pressure is None else theory.judge(solution, example),
            )
        )
        before = solution
    del before, solution
    if rows[-1].dofs > LARGE:
        gc.collect()
    _dofs.append(rows[-1].dofs)
    return tuple(rows)


def most_dofs() -> int:
    """The largest number of degrees of freedom that `run` has solved for."""
    return max(_dofs, default=0)


_dofs: list[int] = []


def column(rows: Sequence[Row], name: str) -> np.ndarray:
    """One attribute of all rows."""
    return np.array([getattr(row, name) for row in rows], dtype=float)


def orders(rows: Sequence[Row], name: str) -> np.ndarray:
    """The rates of one attribute in h, not a number on the first level."""
    return np.append(np.nan, norms.rates(column(rows, "h"), column(rows, name)))


def edges(mesh: Mesh) -> np.ndarray:
    """Ends of all edges on rank 0, shape (n, 2, 2); none on the others."""
    mesh.topology.create_entities(1)
    mesh.topology.create_connectivity(1, mesh.topology.dim)
    own = np.arange(mesh.topology.index_map(1).size_local, dtype=np.int32)
    ends = mesh.geometry.x[entities_to_geometry(mesh, 1, own), :2]
    pieces = comm.gather(ends.reshape(-1, 2, 2), root=0)
    return np.zeros((0, 2, 2)) if pieces is None else np.concatenate(pieces)


class Study:
    """The tables and pictures of one demo, in the order in which they are made.

    Args:
        name: The demo's file name without ending; its tables go to `name.md`.
        title: The heading.

    Attributes:
        folder: Where all of it goes; there from now on, on every rank.
        parts: Paragraphs, tables and references to pictures, in Markdown.
        pictures: The names of these pictures.
    """

    def __init__(self, name: str, title: str):
        """Take the folder from the command line and make it; collective."""
        self.name = name
        self.title = title
        self.folder = wanted_folder("demo-output")
        self.parts: list[str] = []
        self.pictures: list[str] = []
        on_root(comm, lambda: self.folder.mkdir(parents=True, exist_ok=True))
        self.tell(f"\n{title}\n{'=' * len(title)}")

    def tell(self, text: str) -> None:
        """Print on rank 0, formulas without their signs, and keep nothing."""
        if comm.rank == 0:
            print(_plain(text), flush=True)

    def say(self, text: str) -> None:
        """Add a paragraph."""
        self.parts.append(text)
        self.tell("\n" + text)

    def table(self, caption: str, columns: dict[str, tuple[str, Sequence]]) -> None:
        """Print a table and keep it.

        Args:
            caption: What it shows.
            columns: By heading a format, as in "{:.2f}", and the values; what is not a number
                shows as a dash.
        """
        cells = [
            [heading, *(_cell(form, value) for value in values)]
            for heading, (form, values) in columns.items()
        ]
        widths = [max(len(cell) for cell in column) for column in cells]
        rows = [
            [cell.rjust(width) for cell, width in zip(line, widths, strict=True)]
            for line in zip(*cells, strict=True)
        ]
        rule = ["-" * (width - 1) + ":" for width in widths]
        markdown = [
            "| " + " | ".join(cell.replace("|", "\\|") for cell in row) + " |"
            for row in (rows[0], rule, *rows[1:])
        ]
        self.parts.append("\n".join([f"{caption}\n", *markdown]))
        printed = [[_plain(cell).rjust(len(cell)) for cell in row] for row in rows]
        self.tell("\n".join(["", caption, *("  ".join(row) for row in printed)]))

    def picture(
        self,
        file: str,
        caption: str,
        draw: Callable[..., None],
        panels: int = 1,
        columns: int = 1,
        size: tuple[float, float] = (8.5, 4.4),
    ) -> None:
        """Draw a picture on rank 0 and keep a reference to it.

        Args:
            file: Name of the PNG.
            caption: What it shows.
            draw: Called with as many axes as there are panels.
            panels: Axes, row by row.
            columns: Axes side by side. A page shows nine inches of a picture in letters that can
                be read.
            size: Inches of one panel.
        """

        def paint() -> None:
            rows = panels // columns
            figure = canvas.new_figure(size[0] * columns, size[1] * rows)
            draw(*np.atleast_1d(figure.subplots(rows, columns)).ravel())
            canvas.save(figure, self.folder / file)

        on_root(comm, paint)
        self.show(file, caption)

    def show(self, file: str, caption: str) -> None:
        """Keep a reference to a picture that is there."""
        self.parts.append(f"![{caption}]({file})\n\n*{caption}*")
        self.pictures.append(file)

    def strip(
        self,
        file: str,
        caption: str,
        moments: Sequence[Moment],
        *,
        units: Units,
        title: str,
        words: Mapping[str, str],
    ) -> None:
        """Draw u_h at some moments on rank 0.

        Args:
            file: Name of the PNG.
            caption: What it shows.
            moments: From `strip.moment`.
            units: What u, the axes and time are called and measured in.
            title: The heading.
            words: What stands in the legend and above the moments in the place of what
                `plot_strip` writes there; one after the other.
        """

        def paint() -> None:
            figure = plot_strip(moments, units=units)
            texts = [axes.title for axes in figure.axes] + figure.legends[0].get_texts()
            for text, (usual, own) in itertools.product(texts, words.items()):
                text.set_text(text.get_text().replace(usual, own))
            figure.suptitle(title, fontsize=14)
            canvas.save(figure, self.folder / file)

        on_root(comm, paint)
        self.show(file, caption)

    def finish(self) -> None:
        """Write what was kept."""
        path = self.folder / f"{self.name}.md"
        page = "\n\n".join([f"## {self.title}", *self.parts]) + "\n"
        on_root(comm, lambda: path.write_text(page, encoding="utf-8"))
        names = ["no pictures"] if not self.pictures else self.pictures
        fold = textwrap.TextWrapper(80, break_long_words=False, break_on_hyphens=False)
        self.tell("\n" + fold.fill(f"written: {path} and, beside it, {', '.join(names)}"))

    def intervals(
        self,
        caption: str,
        name: str,
        found: tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray],
        digits: int,
        more: Mapping[str, tuple[str, Sequence]] = MappingProxyType({}),
    ) -> tuple[np.ndarray, np.ndarray]:
        """Keep a table of a figure that is certain to lie in an interval, mesh by mesh.

        Args:
            caption: What it shows.
            name: What the figure is called.
            found: Numbers of cells, values, and their lower and upper bounds.
            digits: Of the bounds, behind the point.
            more: Further columns, as in `table`.

        Returns:
            The bounds as they are shown, rounded outward.
        """
        cells, values, lower, upper = found
        unit = 10.0**digits
        lower, upper = np.floor(unit * lower) / unit, np.ceil(unit * upper) / unit
        columns = {
            "cells": ("{}", cells),
            name: (f"{{:.{max(digits, 2)}f}}", values),
            "at least": (f"{{:.{digits}f}}", lower),
            "at most": (f"{{:.{digits}f}}", upper),
            "width": ("{:.2%}", (upper - lower) / values),
        }
        self.table(caption, columns | dict(more))
        return lower, upper

    def field(
        self,
        file: str,
        caption: str,
        solution: Solution,
        draw: Callable[..., None],
        *,
        units: Units,
        title: str,
        size: tuple[float, float],
        words: Mapping[str, str] = MappingProxyType({}),
        **grid: Any,
    ) -> None:
        """Draw u_h and, on axes beside it, what happens along Γ1; collective.

        Args:
            file: Name of the PNG.
            caption: What it shows.
            solution: On a plane domain.
            draw: Called on rank 0 with both axes and the table of Γ1.
            units: What u and the axes are called and measured in.
            title: The heading.
            size: Inches of the whole.
            words: What stands in the legend for contact, no contact, and where it ends; what has
                an empty one is left out.
            grid: Of the two axes, as `subplots` takes it.
        """
        figure, panels = None, (None, None)
        if comm.rank == 0:
            figure = canvas.new_figure(*size)
            panels = figure.subplots(**grid)
        plots.plot_solution(solution, ax=panels[0], units=units)
        table = solution.contact.table()
        if figure is not None:
            upper = panels[0]
            entries = {
                words.get(label, label): handle
                for handle, label in zip(*upper.get_legend_handles_labels(), strict=True)
            }
            entries.pop("", None)
            upper.get_legend().remove()
            canvas.legend(figure, [*entries.values()], [*entries], ncols=3)
            upper.set_title("")
            upper.set_aspect("auto")
            figure.suptitle(title, fontsize=16)
            draw(*panels, table)
            canvas.save(figure, self.folder / file)
        self.show(file, caption)


def _plain(text: str) -> str:
    """Formulas as one can read them where nothing sets them."""
    return text.replace("$", "").replace("\\", "")


def _cell(form: str, value: object) -> str:
    if value is None or (isinstance(value, float) and not np.isfinite(value)):
        return "–"
    return form.format(value)


def loglog(
    axes: Axes,
    curves: dict[str, tuple[Sequence[float], Sequence[float]]],
    slopes: dict[float, str],
    *,
    title: str,
    x: str = "$h$",
    y: str = "error",
    below: float = 0.5,
    dashed: Sequence[str] = (),
    scale: str = "log",
    colours: Sequence[str] = COLOURS,
    named: Mapping[str, str] | None = None,
) -> None:
    """Draw curves in logarithmic scales, and dotted lines of given slopes below them.

    Args:
        axes: Where.
        curves: By label the abscissae and ordinates.
        slopes: By exponent the label of a dotted line, drawn below the curves.
        title: The heading.
        x: Label of the abscissa.
        y: Label of the ordinate.
        below: The dotted lines pass so far below the lowest end of a curve.
        dashed: Labels of curves to draw dashed.
        scale: Of the ordinate, "log" or "linear".
        colours: One a curve, in a circle.
        named: The labels that are written, by those of the curves; all of them if left out.
    """
    axes.set_xscale("log")
    axes.set_yscale(scale)
    for k, (label, (abscissae, ordinates)) in enumerate(curves.items()):
        axes.plot(
            abscissae,
            ordinates,
            "--" if label in dashed else "-",
            color=colours[k % len(colours)],
            marker=MARKERS[k % len(colours) % len(MARKERS)],
            markersize=6,
            linewidth=1.8,
        )
    for k, (slope, label) in enumerate(slopes.items()):
        guide(axes, list(curves.values()), slope, label, below * 0.7**k)
    axes.set_xlabel(x, fontsize=14)
    axes.set_ylabel(y, fontsize=13)
    axes.tick_params(labelsize=11)
    axes.grid(which="major", alpha=0.3)
    if x == "$h$":
        ticks = next(iter(curves.values()))[0]
        axes.set_xticks(ticks, [f"{tick:.2g}" for tick in ticks])
        axes.set_xticks([], minor=True)
    axes.set_title(title, fontsize=14)
    drawn = dict(zip(curves, itertools.cycle(colours)))
    named = {label: label for label in curves} if named is None else named
    name_curves(
        axes,
        {words: curves[label] for label, words in named.items()},
        [drawn[label] for label in named],
    )


def name_curves(
    axes: Axes,
    curves: dict[str, tuple[Sequence[float], Sequence[float]]],
    colours: Sequence[str] = COLOURS,
) -> None:
    """Write the label of each curve beside its right end; nothing is to be drawn after that."""
    axes.set_xlim(axes.get_xlim())
    axes.set_ylim(axes.get_ylim())
    ends = [max(zip(*curve, strict=True)) for curve in curves.values()]
    used = [colours[k % len(colours)] for k in range(len(ends))]
    canvas.label_ends(axes, ends, list(curves), used)


def _ascending(curve: tuple) -> tuple[np.ndarray, np.ndarray]:
    """Logarithms of a curve's points, from the left to the right."""
    x, y = (np.log(np.asarray(values, dtype=float)) for values in curve)
    order = np.argsort(x)
    return x[order], y[order]


def guide(axes: Axes, curves: Sequence[tuple], slope: float, label: str, below: float) -> None:
    """A dotted line of one slope, below the curves whose own slope at the end is nearest to it."""

    def steepness(curve: tuple) -> float:
        (x0, x1), (y0, y1) = (np.log(np.asarray(values, dtype=float)[-2:]) for values in curve)
        return float((y1 - y0) / (x1 - x0))

    near = min(abs(steepness(curve) - slope) for curve in curves)
    alike = [curve for curve in curves if abs(steepness(curve) - slope) < near + 0.2]
    lowest = min(alike, key=lambda curve: curve[1][-1] / curve[0][-1] ** slope)
    x, y = (np.asarray(v, dtype=float) for v in lowest)
    line = below * y[-1] * (x / x[-1]) ** slope
    axes.plot(x, line, ":", color="black", linewidth=1.5)
    # Below the line, where the next curve is far away
    room = []
    for i in range(1, len(x) - 1):
        others = [np.interp(np.log(x[i]), *_ascending(curve)) for curve in curves]
        under = [np.log(line[i]) - other for other in others if other < np.log(line[i])]
        room.append(min(under, default=np.inf))
    wide = np.flatnonzero(np.minimum(room, 2.0) >= min(max(room, default=0.0), 2.0))
    middle = 1 + int(wide[np.argmin(abs(wide + 1 - len(x) // 2))]) if len(wide) else len(x) // 2
    axes.annotate(
        label,
        (x[middle], line[middle]),
        fontsize=13,
        xytext=(np.copysign(5, slope), -5),
        textcoords="offset points",
        ha="left" if slope > 0 else "right",
        va="top",
    )
