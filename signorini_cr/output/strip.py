"""The picture strip of a run in time: u_h at some moments, in one scale of colours."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from typing import TYPE_CHECKING, Any

import numpy as np

from ..arrays import FloatArray
from ..errors import InputError
from ..fem.space import facet_measures
from .canvas import (
    RED,
    chains,
    contour_heights,
    draw_contours,
    draw_lines,
    headline,
    label_bar,
    legend,
    new_figure,
    plane_axes,
    save,
    short_numbers,
)
from .files import Where
from .raster import averaged, plane, raster
from .touching import contact_lines, in_words
from .units import PLAIN, Units, literal

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from ..solution import Solution

MOST_MOMENTS = 6
"""Moments in a strip."""

PIXELS = 600
"""Along the longer side of the domain."""


@dataclass(frozen=True)
class Moment:
    """One step, as a strip shows it.

    Attributes:
        time: Its end.
        image: u_h on rank 0, from `raster`.
        smooth: Its means at the vertices, for contour lines.
        box: Lowest and highest corner of the domain, shape (2, 2).
        limits: The least and the greatest value of u_h.
        boundary: Ends of all boundary facets on rank 0, shape (n, 2, 2); none on the others.
        touching: Of the lines in contact, from `contact_lines`.
        free: Of those of Γ1 that are not.
        words: How much of Γ1 is in contact.
    """

    time: float
    image: FloatArray
    smooth: FloatArray
    box: FloatArray
    limits: tuple[float, float]
    boundary: FloatArray
    touching: FloatArray
    free: FloatArray
    words: str


def as_arrays(moments: Sequence[Moment]) -> dict[str, Any]:
    """Make arrays of moments, of which `from_arrays` makes moments again."""
    facts = [asdict(each) for each in moments]
    return {f"{name}{k}": np.array(v) for k, each in enumerate(facts) for name, v in each.items()}


def from_arrays(arrays: Mapping[str, Any]) -> list[Moment]:
    """Make moments of what `as_arrays` has made of them."""
    names = [each.name for each in fields(Moment)]
    found: list[Moment] = []
    while f"time{len(found)}" in arrays:
        facts = {name: arrays[f"{name}{len(found)}"] for name in names}
        low, high = map(float, facts.pop("limits"))
        found.append(Moment(time=float(facts.pop("time")), limits=(low, high), **facts))
    return found


def chosen(steps: int) -> set[int]:
    """Choose the steps of so many that a strip shows, evenly apart, first and last among them."""
    return set(np.rint(np.linspace(1, steps, min(MOST_MOMENTS, steps))).astype(int).tolist())


def moment(time: float, solution: Solution) -> Moment:
    """Keep what a strip shows of a step on a plane domain; collective.

    Raises:
        InputError: The domain is not plane.
    """
    domain, contact = solution.domain, solution.contact
    plane(domain)
    ends = [facet_measures(domain.mesh, domain.facets(i))[0] for i in domain.parts.values()]
    pieces = domain.mesh.comm.gather(np.concatenate(ends)[..., :2], root=0)
    boundary = np.zeros((0, 2, 2)) if pieces is None else np.concatenate(pieces)
    image, box, limits = raster(solution.u, PIXELS)
    smooth = raster(averaged(solution.u), PIXELS)[0]
    lines = contact_lines(contact)
    return Moment(time, image, smooth, box, limits, boundary, *lines, in_words(contact))


def plot_strip(
    moments: Sequence[Moment],
    path: Where | None = None,
    title: str = "",
    units: Units = PLAIN,
) -> Figure:
    """Draw u_h at some moments, and where it is in contact then; on rank 0 alone.

    Domains that are wide are drawn below one another.

    Args:
        moments: One at least, of one domain, from `moment`.
        path: The PNG to write, if any.
        title: What the picture is of, say the problem's name.
        units: What u, the axes and time are called and measured in.

    Raises:
        InputError: There are no moments, or the file can't be written.
    """
    from matplotlib.lines import Line2D
    from matplotlib.patheffects import Normal, Stroke

    if not moments:
        raise InputError("a strip of pictures needs one moment at least")
    box = moments[0].box
    wide = np.divide(*(box[1] - box[0]))
    columns = min(len(moments), 1 if wide > 2.5 else 2 if wide > 1.4 else 3)
    rows = -(-len(moments) // columns)
    width = 8.0 / columns  # and a bar beside them: more inches make letters small on a page
    gap, above = ("\n", 1.15) if columns == 3 else (" ", 0.75)
    figure = new_figure(9.3, rows * (max((width - 1.0) / wide, 0.9) + above) + 1.2)
    panels = figure.subplots(rows, columns, squeeze=False, sharex=True, sharey=True)
    marks: dict[str, Line2D] = {}
    time = literal(units.after("time"))
    low, high = (pick(each.limits[i] for each in moments) for i, pick in enumerate((min, max)))
    for number, (each, axes) in enumerate(zip(moments, panels.flat, strict=False)):
        plane_axes(box, ax=axes, units=units)
        name = axes.get_xlabel()
        axes.label_outer()
        if number >= len(moments) - columns:  # with nothing below it
            axes.tick_params(labelbottom=True)
            axes.set_xlabel(name)
        shown = axes.imshow(
            each.image,
            extent=(box[0, 0], box[1, 0], box[0, 1], box[1, 1]),
            origin="lower",
            aspect=1.0 if axes.get_aspect() == 1.0 else "auto",  # stretched, it may fill its place
            vmin=low,
            vmax=high,
        )
        draw_contours(axes, each.smooth, box, contour_heights((low, high)))
        draw_lines(axes, chains(each.boundary), color="black", linewidth=1.0, joinstyle="round")
        for lines, color in ((each.free, "white"), (each.touching, RED)):
            outlined = [Stroke(linewidth=7.5, foreground="black"), Normal()]
            style: dict[str, Any] = {"color": color, "linewidth": 5.5, "path_effects": outlined}
            draw_lines(axes, chains(lines), zorder=3, **style)
            marks["contact" if color == RED else "no contact"] = Line2D([], [], **style)
        axes.set_title(f"$t$ = {each.time:.4g}{time}:{gap}{each.words}", fontsize=12)
    figure.supylabel(panels[0, 0].get_ylabel(), fontsize=13)  # on low panels they would overlap
    for axes in panels.flat:
        axes.set_ylabel("")
    for axes in panels.flat[len(moments) :]:
        axes.remove()
    bar = figure.colorbar(shown, ax=list(panels.flat[: len(moments)]), aspect=30)
    label_bar(bar, units)
    bar.ax.tick_params(labelsize=11)
    short_numbers(bar.ax.yaxis)
    legend(figure, list(marks.values()), list(marks), ncols=2)
    figure.suptitle(headline(title, "$u_h$ in time"), fontsize=14)
    save(figure, path)
    return figure
