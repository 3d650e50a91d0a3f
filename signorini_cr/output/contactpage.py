"""The picture of what happens along Γ1: u_h and the obstacle above, the pressure λ_h below."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from ..arrays import FloatArray
from ..errors import InputError
from .canvas import BLUE, RED, draw_lines, fit, label_ends, legend, new_figure, short_numbers
from .units import PLAIN, Units, literal

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure, SubFigure

Table = Mapping[str, npt.NDArray]

MOST_PARTS = 6
"""Contact parts with panels of their own: the longest ones."""
LEAST_ROOM = 0.015
"""Part of a panel's width that a letter takes."""


def contact_page(
    table: Table,
    transitions: FloatArray,
    size: float,
    ax: Axes | None = None,
    units: Units = PLAIN,
) -> Figure | SubFigure:
    """Draw all of Γ1, each connected part in a column of its own.

    Args:
        table: From `ContactFacts.table`.
        transitions: Points where contact begins or ends, shape (m, 2 or 3).
        size: The largest |u_h| anywhere: far smaller values are drawn as the zeros they are.
        ax: Axes in a grid, whose place the panels take.
        units: What is told of u, lengths and the pressure.
    """
    parts, lengths = _parts(table)
    shares = np.maximum(lengths / lengths.max(), 0.2)
    figure = _page(9.0, 6.6 + 0.2 * (len(parts) - 1), ax)
    panels = figure.subplots(
        2, len(parts), sharex="col", sharey="row", squeeze=False, width_ratios=shares
    )
    lines, names = [], _names(table)
    for column, rows, share in zip(panels.T, parts, shares / shares.sum(), strict=True):
        course = _contact_part(column, rows, transitions, names)
        if "name" in rows:
            _name_parts(column[0], rows)
        if len(parts) > 1:
            name = f"part {rows['part'][0]}"
            if "name" in rows:
                name = literal(", ".join(dict.fromkeys(map(str, rows["name"]))))
            else:
                column[0].set_title(name, fontsize=12)
            course = f"{name} {course}"
        column[1].locator_params(axis="x", nbins=max(int(9 * share), 1))
        lines.append(course)
    number = len(np.unique(table["part"]))
    longest = f"its {MOST_PARTS} longest parts of {number}:\n" if number > MOST_PARTS else ""
    along = f"arc length along $\\Gamma_1${units.within('x')}, {longest}" + ",\n".join(lines)
    # Not the rounding errors of a function that is zero
    _enlarge(panels[0], np.concatenate([table["u"], *(table[name] for name in names)]), size)
    _enlarge(panels[1], table["pressure"], size / lengths.sum())
    signs = " and ".join(["$u_h$", ", ".join(name.split()[-1] for name in names.values())])
    mean = f"{signs}{units.within('u')}, facet means"
    panels[0, 0].set_ylabel("\n".join(filter(None, [units.name("u").strip(), mean])), fontsize=13)
    pressure = units.name("flux", "contact pressure") + rf"$\lambda_h${units.within('flux')}"
    panels[1, 0].set_ylabel(pressure, fontsize=13)
    entries: dict[str, Any] = {}
    for axes in panels.ravel():
        handles, labels = axes.get_legend_handles_labels()
        entries |= dict(zip(labels, handles, strict=True))
    if len(parts) == 1 and ax is None:  # there is room beside the curves
        _name_curves(panels[0, 0], entries)
        del entries[r"$\lambda_h$"]  # its axis says so
    for axes in panels.ravel() if ax is not None else ():
        fit(axes)
    legend(figure, list(entries.values()), list(entries), ncols=5 if ax is None else 3, above=along)
    return figure


def _names(table: Table) -> dict[str, str]:
    """Name the bounds that there are, by their columns."""
    there = [
        name for name in ("obstacle", "upper") if name in table and np.isfinite(table[name]).any()
    ]
    if there == ["obstacle"]:
        return {"obstacle": r"obstacle $\alpha$"}
    names = {"obstacle": r"lower bound $\alpha$", "upper": r"upper bound $\beta$"}
    return {name: names[name] for name in there}


def _name_parts(axes: Axes, rows: Table) -> None:
    """Write the parts' names above the stretches of the boundary that have room for them."""
    names, whole = rows["name"], rows["length"].sum()
    changes = np.flatnonzero(names[1:] != names[:-1]) + 1
    for here in np.split(np.arange(len(names)), changes):
        length, name = rows["length"][here], str(names[here[0]])
        if length.sum() > LEAST_ROOM * len(name) * whole:
            middle = np.average(rows["arc_length"][here], weights=length)
            above = axes.get_xaxis_transform(), "offset points"
            axes.annotate(
                literal(name), (middle, 1.0), (0.0, 3.0), *above, ha="center", fontsize=12
            )


def _name_curves(axes: Axes, entries: dict[str, Any]) -> None:
    """Write what the curves are beside their right ends, and take that out of the legend."""
    axes.set_ylim(axes.get_ylim())
    curves = {label: line for label, line in entries.items() if line in axes.get_lines()}
    right, ends = -1 if axes.get_xlim()[0] < axes.get_xlim()[1] else 0, []
    for label, line in curves.items():
        seen = np.flatnonzero(np.isfinite(line.get_ydata()))[right]
        ends.append((float(line.get_xdata()[seen]), float(line.get_ydata()[seen])))
        del entries[label]
    label_ends(axes, ends, list(curves), [line.get_color() for line in curves.values()])


def _page(width: float, height: float, ax: Axes | None) -> Figure | SubFigure:
    """Make a new figure, or take what holds the axes."""
    if ax is None:
        return new_figure(width, height)
    place = ax.get_subplotspec()
    if place is None:
        raise InputError("a picture of the contact needs Axes of a grid, as from subplots")
    page = ax.figure.add_subfigure(place)
    ax.remove()
    return page


def _parts(table: Table) -> tuple[list[dict[str, npt.NDArray]], FloatArray]:
    """Take the rows of the longest parts in order along the boundary, and their lengths."""
    lengths = np.bincount(table["part"], weights=table["length"]).astype(np.float64)
    longest = np.sort(np.argsort(-lengths, kind="stable")[:MOST_PARTS])
    rows = [{name: column[table["part"] == part] for name, column in table.items()}
            for part in longest]  # fmt: skip
    return rows, lengths[longest]


def _backwards(rows: Table) -> bool:
    """Tell whether the boundary, Ω to its left, runs leftwards or downwards in an open part."""
    dx, dy = rows["x"][-1] - rows["x"][0], rows["y"][-1] - rows["y"][0]
    closed = np.hypot(dx, dy) < 1.5 * rows["length"].max() and len(rows["x"]) > 2
    return not closed and bool((dx if abs(dx) >= abs(dy) else dy) < 0)


def _contact_part(
    panels: Sequence[Axes], rows: Table, transitions: FloatArray, names: Mapping[str, str]
) -> str:
    """Draw one connected piece of Γ1, u_h above, the pressure below; say where it runs."""
    from matplotlib.collections import PolyCollection

    upper, lower = panels
    arc, length, active = rows["arc_length"], rows["length"], rows["active"].astype(int)
    middle = np.stack([rows["x"], rows["y"]], axis=1)
    edges = np.append(arc - length / 2, arc[-1] + length[-1] / 2)
    step = np.diff(active, prepend=0, append=0)
    begin, end = edges[np.flatnonzero(step == 1)], edges[np.flatnonzero(step == -1)]
    # Facet by facet along the boundary: where on this part are the transition points?
    along = np.gradient(middle, arc, axis=0) if len(arc) > 1 else np.zeros((1, 2))
    offset = transitions[:, None, :2] - middle
    near = np.argmin(np.linalg.norm(offset, axis=2), axis=1)
    shift = offset[np.arange(len(near)), near]
    here = np.linalg.norm(shift, axis=1) <= 0.75 * length[near]
    points = (arc[near] + np.sum(shift * along[near], axis=1))[here]
    begin, end = (_moved(each, points, length.max()) for each in (begin, end))
    # Corners of the shaded boxes and ends of the lines, heights as shares of the panel's
    runs = _upright(np.stack([begin, begin, end, end], axis=1), [0.0, 1.0, 1.0, 0.0])
    lines = _upright(np.stack([points, points], axis=1), [0.0, 1.0])
    for axes in panels:
        across = axes.get_xaxis_transform()
        shaded = PolyCollection(list(runs), transform=across, color=RED, alpha=0.15, linewidth=0)
        shaded.set_label("contact" if len(runs) else None)
        axes.add_collection(shaded, autolim=False)
        draw_lines(axes, lines, transform=across, color="black", linestyle=":", linewidth=1.5,
                   label="contact begins or ends" if len(points) else None)  # fmt: skip
        # From the left to the right as it is seen, in the arc length of contact.csv
        axes.set_xlim(*edges[[-1, 0] if _backwards(rows) else [0, -1]])
        axes.tick_params(labelsize=11)
        short_numbers(axes.xaxis, axes.yaxis)
        axes.grid(alpha=0.25)
    marker: dict[str, Any] = {"marker": "o", "markersize": 4} if len(arc) <= 80 else {}
    upper.plot(arc, rows["u"], color=BLUE, linewidth=2, label="$u_h$", **marker)
    for name, label in names.items():
        if np.isfinite(rows[name]).any():
            upper.plot(arc, rows[name], color="black", linestyle="--", label=label)
    lower.stairs(rows["pressure"], edges, color=RED, linewidth=2, label=r"$\lambda_h$")
    ends = middle[[0, -1]] + along[[0, -1]] * (edges[[0, -1]] - arc[[0, -1]])[:, None]
    ends[np.abs(ends) < 1e-9 * np.abs(middle).max()] = 0.0
    start, stop = (f"({x:.3g}, {y:.3g})" for x, y in ends)
    if np.linalg.norm(ends[1] - ends[0]) < 0.25 * length.min():
        return f"round from {start}"
    if _backwards(rows):
        return f"from {stop} on the left to {start}, where it is 0"
    return f"from {start}, where it is 0, to {stop}"


def _moved(places: FloatArray, points: FloatArray, facet: float) -> FloatArray:
    """Move the ends of active facets to where contact ends, inside the next one."""
    if not len(points) or not len(places):
        return places
    nearest = points[np.argmin(np.abs(places[:, None] - points), axis=1)]
    return np.where(np.abs(nearest - places) <= facet, nearest, places)


def _enlarge(panels: Sequence[Axes], values: npt.NDArray, size: float) -> None:
    """Say so where all differences are below 1e-6 of `size`, and the value."""
    values = values[np.isfinite(values)]
    value = float(values[0])
    if np.ptp(values) >= 1e-6 * size:
        return
    around = abs(value) if abs(value) > 1e-6 * size else size
    for axes in panels:
        axes.set_ylim(value - around, value + around)
        axes.set_yticks([value], [f"{value:.3g}" if around != size else "0"])


def _upright(x: FloatArray, heights: Sequence[float]) -> FloatArray:
    """Make points at abscissas of shape (n, k), row by row at k heights, shape (n, k, 2)."""
    return np.stack([x, np.broadcast_to(heights, x.shape)], axis=2)
