"""The paper that all pictures are drawn on: sizes, fonts, colours, and how a file is saved.

Matplotlib is loaded when the first figure is made, and used through its objects: nothing global
is touched.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from .files import disk_errors

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Where = str | os.PathLike[str]
FloatArray = npt.NDArray[np.float64]

# Told apart by colour-blind eyes and in grey
BLUE, RED, YELLOW, GREY = "#004488", "#BB5566", "#DDAA33", "#777777"


def new_figure(width: float, height: float) -> Figure:
    """An empty figure of so many inches that knows how to become a PNG."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), dpi=150, layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def plane_axes(points: FloatArray, room: float = 0.0) -> tuple[Figure, Axes]:
    """Axes of equal scale for what lies in the box of `points`, `room` inches free beside it."""
    low, high = points.min(axis=0), points.max(axis=0)
    size = high - low
    size = np.clip(size * (7.5 / size.max()), 1.5, None)
    figure = new_figure(max(size[0] + 1.0, 6.0) + room, size[1] + 1.6)
    axes = figure.subplots()
    axes.set_aspect("equal")
    margin = 0.03 * (high - low).max()
    axes.set_xlim(low[0] - margin, high[0] + margin)
    axes.set_ylim(low[1] - margin, high[1] + margin)
    axes.set_xlabel("$x$", fontsize=13)
    axes.set_ylabel("$y$", fontsize=13)
    axes.tick_params(labelsize=11)
    axes.ticklabel_format(scilimits=(-3, 4), useMathText=True)
    return figure, axes


def draw_lines(axes: Axes, segments: FloatArray, **style: Any) -> None:
    """Draw straight lines given by their ends, shape (n, 2, 2)."""
    from matplotlib.collections import LineCollection

    axes.add_collection(LineCollection(segments, **style), autolim=False)


def legend(figure: Figure, *entries: Any, ncols: int) -> None:
    """Put a legend below everything."""
    figure.legend(*entries, loc="outside lower center", ncols=ncols, fontsize=12, frameon=False)


def headline(title: str, what: str) -> str:
    """The problem's name, dollar signs and all, and what is seen of it."""
    name = title if len(title) <= 40 else title[:39] + "…"
    return name.replace("$", r"\$") + ": " + what if title else what


def grouped(number: int) -> str:
    """A number with its digits in groups of three."""
    return f"{number:,}".replace(",", "\u2009")


def save(figure: Figure, path: Where) -> None:
    """Write the PNG.

    Raises:
        InputError: The system does not let us.
    """
    with disk_errors(Path(path)):
        figure.savefig(path, format="png")
