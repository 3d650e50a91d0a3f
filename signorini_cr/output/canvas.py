"""The paper that all pictures are drawn on: sizes, fonts, colours, and how a file is saved.

Matplotlib is loaded when the first figure is made, and used through its objects: nothing global
is touched.
"""

from __future__ import annotations

import functools
import io
import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ..arrays import FloatArray
from .files import disk_errors

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure, SubFigure

Where = str | os.PathLike[str]

# Told apart by colour-blind eyes and in grey
BLUE, RED, YELLOW, GREY = "#004488", "#BB5566", "#DDAA33", "#777777"


@functools.cache
def _page() -> type[Figure]:
    from matplotlib.figure import Figure

    class Page(Figure):
        """A figure that notebooks can show, whether or not they have heard of Matplotlib."""

        def _repr_png_(self) -> bytes:
            return as_png(self)

    return Page


def new_figure(width: float, height: float) -> Figure:
    """An empty figure of so many inches that knows how to become a PNG."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    figure = _page()(figsize=(width, height), dpi=150, layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def as_png(figure: Figure | SubFigure) -> bytes:
    """The bytes of a PNG."""
    file = io.BytesIO()
    figure.canvas.print_figure(file, format="png")
    return file.getvalue()


def plane_axes(
    points: FloatArray, room: float = 0.0, ax: Axes | None = None
) -> tuple[Figure | SubFigure, Axes, float]:
    """Axes of equal scale for what lies in the box of `points`.

    Only a very slender domain is stretched, and its axis says so.

    Args:
        points: Shape (n, 2).
        room: Inches left free beside the axes.
        ax: Axes to take in the place of new ones.

    Returns:
        The figure, the axes and their width in inches.
    """
    low, high = points.min(axis=0), points.max(axis=0)
    margin = 0.03 * (high - low).max()
    inches = 7.0 * (high - low) / (high - low).max()
    stretch = np.where(inches < 0.7, 2.2 / inches, 1.0)
    width, height = inches * stretch
    axes = ax or new_figure(max(width + 1.2, 6.0) + room, height + 2.0).subplots()
    figure = axes.figure
    if ax is not None:
        width = ax.bbox.width / figure.dpi
    axes.set_aspect(stretch[1] / stretch[0])
    margins = margin / stretch
    axes.set_xlim(low[0] - margins[0], high[0] + margins[0])
    axes.set_ylim(low[1] - margins[1], high[1] + margins[1])
    labels = (
        f"${name}$" if factor == 1.0 else f"${name}$ (stretched)"
        for name, factor in zip("xy", stretch, strict=True)
    )
    axes.set_xlabel(next(labels), fontsize=13)
    axes.set_ylabel(next(labels), fontsize=13)
    axes.tick_params(labelsize=11)
    if width < 3.0:
        axes.locator_params(nbins=4, axis="x")
    axes.ticklabel_format(scilimits=(-3, 4), useMathText=True)
    return figure, axes, float(width)


def draw_lines(axes: Axes, segments: FloatArray, **style: Any) -> None:
    """Draw straight lines given by their ends, shape (n, 2, 2)."""
    from matplotlib.collections import LineCollection

    axes.add_collection(LineCollection(list(segments), **style), autolim=False)


def legend(
    figure: Figure | SubFigure, *entries: Any, ncols: int, above: str = "", ax: Axes | None = None
) -> None:
    """Put a legend below everything, or below Axes that were given, and a text above it."""
    below: dict[str, Any] = {"loc": "upper center", "bbox_to_anchor": (0.5, -0.18)}
    (figure if ax is None else ax).legend(
        *entries,
        **({"loc": "outside lower center"} if ax is None else below),
        ncols=ncols,
        fontsize=12,
        frameon=False,
        title=above or None,
        title_fontsize=12,
    )


def headline(title: str, what: str) -> str:
    """The problem's name, dollar signs and all, and what is seen of it."""
    name = title if len(title) <= 40 else title[:39] + "…"
    return name.replace("$", r"\$") + ": " + what if title else what


def grouped(number: int) -> str:
    """A number with its digits in groups of three."""
    return f"{number:,}".replace(",", "\u2009")


def save(figure: Figure | SubFigure, path: Where | None) -> None:
    """Write the PNG, if a path is given.

    Raises:
        InputError: The system does not let us.
    """
    if path is not None:
        with disk_errors(Path(path)):
            figure.canvas.print_figure(path, format="png")
