"""The paper that all pictures are drawn on: sizes, fonts, colours, and how a file is saved.

Matplotlib is loaded when the first figure is made, and used through its objects: nothing global
is touched.
"""

from __future__ import annotations

import functools
import io
import textwrap
from collections import defaultdict
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from ..arrays import FloatArray
from .files import Where, as_path, disk_errors
from .units import PLAIN, Units, literal

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.axis import XAxis, YAxis
    from matplotlib.collections import PolyCollection
    from matplotlib.colorbar import Colorbar
    from matplotlib.figure import Figure, SubFigure
    from matplotlib.transforms import Transform

# Told apart by colour-blind eyes and in grey
BLUE, RED, YELLOW, GREY = "#004488", "#BB5566", "#DDAA33", "#777777"

LONGEST = 54
"""Characters in a line of a title, which the narrowest picture has room for."""


@functools.cache
def _page() -> type[Figure]:
    from matplotlib.figure import Figure

    class Page(Figure):
        """A figure that notebooks can show, whether or not they have heard of Matplotlib."""

        def _repr_png_(self) -> bytes:
            return as_png(self)

    return Page


def new_figure(width: float, height: float) -> Figure:
    """Make an empty figure of so many inches that knows how to become a PNG."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    figure = _page()(figsize=(width, height), dpi=150, layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def as_png(figure: Figure | SubFigure) -> bytes:
    """Return the bytes of a PNG."""
    file = io.BytesIO()
    # whatever the layout has left no room for, a title of several lines for one, is on it
    figure.canvas.print_figure(file, format="png", bbox_inches="tight", pad_inches=0.1)
    _drop_glyphs()
    return file.getvalue()


def _drop_glyphs() -> None:
    """Make fonts forget what formulas were set with; they would keep it, some kB a picture."""
    from matplotlib.font_manager import FontProperties, findfont, get_font

    for style in ("normal", "italic"):
        get_font(findfont(FontProperties(style=style))).clear()


def label_bar(bar: Colorbar, units: Units) -> None:
    """Say what the colours are those of."""
    if (label := f"{units.name('u')}$u_h${units.within('u')}") == "$u_h$":
        bar.set_label(label, fontsize=15, rotation=0, labelpad=8, ha="left", va="center")
    else:  # too long to stand upright
        bar.set_label(label, fontsize=13)


def plane_axes(
    points: FloatArray, room: float = 0.0, ax: Axes | None = None, units: Units = PLAIN
) -> tuple[Figure | SubFigure, Axes, float]:
    """Make axes of equal scale for what lies in the box of `points`.

    Only a very slender domain is stretched, and its axis says so.

    Args:
        points: Shape (n, 2).
        room: Inches left free beside the axes.
        ax: Axes to take in the place of new ones.
        units: What the axes are called and measured in.

    Returns:
        The figure, the axes and their width in inches.
    """
    low, high = points.min(axis=0), points.max(axis=0)
    margin = 0.03 * (high - low).max()
    inches = 7.0 * (high - low) / (high - low).max()
    stretch = np.where(inches < 0.7, 2.2 / inches, 1.0)
    width, height = inches * stretch
    axes = ax or new_figure(max(width + 1.5, 6.5) + room, height + 2.0).subplots()
    figure = axes.figure
    if ax is not None:
        width = ax.bbox.width / figure.dpi
    axes.set_aspect(stretch[1] / stretch[0])
    margins = margin / stretch
    axes.set_xlim(low[0] - margins[0], high[0] + margins[0])
    axes.set_ylim(low[1] - margins[1], high[1] + margins[1])
    labels = (
        f"{units.name(name)}${name}${units.within('x')}{'' if factor == 1.0 else ' (stretched)'}"
        for name, factor in zip("xy", stretch, strict=True)
    )
    axes.set_xlabel(next(labels), fontsize=13)
    axes.set_ylabel(next(labels), fontsize=13)
    axes.tick_params(labelsize=11)
    if width < 3.0:
        axes.locator_params(nbins=4, axis="x")
    short_numbers(axes.xaxis, axes.yaxis)
    return figure, axes, float(width)


def short_numbers(*axes: XAxis | YAxis) -> None:
    """Label axes with few digits, and with a power of ten beside them if need be."""
    from matplotlib.ticker import ScalarFormatter

    class Ticks(ScalarFormatter):
        """Numbers as text, which takes a tenth of the time that formulas do."""

        def __call__(self, x: float, pos: int | None = None) -> str:
            return super().__call__(x, pos).removeprefix(r"$\mathdefault{").removesuffix("}$")

    for axis in axes:
        ticks = Ticks(useMathText=True)
        ticks.set_powerlimits((-3, 4))
        axis.set_major_formatter(ticks)


def draw_lines(axes: Axes, segments: FloatArray | Sequence[FloatArray], **style: Any) -> None:
    """Draw lines given by their points: segments of shape (n, 2, 2), or `chains` of them."""
    from matplotlib.collections import LineCollection

    axes.add_collection(LineCollection(list(segments), **style), autolim=False)


def draw_cells(axes: Axes, corners: FloatArray, **style: Any) -> PolyCollection:
    """Fill triangles given by their corners, shape (n, 3, 2), beneath everything else."""
    from matplotlib.collections import PolyCollection

    cells = PolyCollection(list(corners), zorder=0, **style)
    axes.add_collection(cells, autolim=False)
    return cells


def contour_heights(limits: tuple[float, float]) -> FloatArray:
    """Round numbers between two, for contour lines."""
    from matplotlib.ticker import MaxNLocator

    heights = np.asarray(MaxNLocator(9).tick_values(*limits))
    return heights[(heights > limits[0]) & (heights < limits[1])]


def draw_contours(axes: Axes, image: FloatArray, box: FloatArray, heights: FloatArray) -> None:
    """Draw contour lines.

    Args:
        axes: Where.
        image: A continuous function, from `raster`.
        box: Lowest and highest corner of its pixels.
        heights: Of the lines.
    """
    if not len(heights):
        return
    rows, columns = ((np.arange(n) + 0.5) / n for n in image.shape)
    size = box[1] - box[0]
    axes.contour(box[0, 0] + columns * size[0], box[0, 1] + rows * size[1], image, levels=heights,
                 colors="white", linewidths=0.8, alpha=0.7, linestyles="solid")  # fmt: skip


def legend(
    figure: Figure | SubFigure, *entries: Any, ncols: int, above: str = "", ax: Axes | None = None
) -> None:
    """Put a legend below everything, or below Axes that were given, and a text above it."""
    holder = figure if ax is None else ax
    size = 12 * letters(holder)
    if size < 12:
        labels = entries[1] if entries else (ax or figure.gca()).get_legend_handles_labels()[1]
        letter = 0.55 * size / 72 * holder.figure.dpi  # about as wide as that
        most = holder.bbox.width / letter
        ncols = min(max(int(most / (9 + max(map(len, labels), default=0))), 1), ncols)
        above = "\n".join(textwrap.fill(line, int(most)) for line in above.split("\n"))
    place: dict[str, Any] = {"loc": "outside lower center"}
    if ax is not None:
        place = {"loc": "upper center"}
        # below the axis and its label, whose letters are as small
        place["bbox_to_anchor"] = (0.5, 0.0)
        place["bbox_transform"] = _below(ax, 3.2 * size / 72)
    holder.legend(
        *entries,
        **place,
        ncols=ncols,
        fontsize=size,
        frameon=False,
        title=above or None,
        title_fontsize=size,
    )


def _below(ax: Axes, inches: float) -> Transform:
    """Return the coordinates of Axes, so far below them."""
    from matplotlib.transforms import ScaledTranslation

    return ax.transAxes + ScaledTranslation(0.0, -inches, ax.figure.dpi_scale_trans)


def letters(holder: Axes | Figure | SubFigure) -> float:
    """Compute how small letters are on narrow Axes, or pages, in parts of the usual."""
    return float(np.clip(holder.bbox.width / holder.figure.dpi / 6.0, 0.55, 1.0))


def fit(ax: Axes | None, *bars: Axes) -> None:
    """Have letters on Axes that were given, and on bars beside them, as small as these ask for."""
    if ax is None:
        return
    part = letters(ax)
    for each in (ax, *bars):
        each.tick_params(labelsize=11 * part)
        others = each.xaxis.get_offset_text(), each.yaxis.get_offset_text()
        for text in (each.title, each.xaxis.label, each.yaxis.label, *others):
            text.set_fontsize(part * float(text.get_fontsize()))


def headline(title: str, what: str) -> str:
    """Return the problem's name, dollar signs and all, and what is seen of it."""
    if not title:
        return what
    name = literal(textwrap.fill(title, LONGEST))
    last = len(name) - name.rfind("\n") - 1
    return f"{name}:{' ' if last + len(what) <= LONGEST else chr(10)}{what}"


def label_ends(
    axes: Axes, ends: Sequence[tuple[float, float]], labels: Sequence[str], colors: Sequence[str]
) -> None:
    """Name curves beside their right ends, apart where these are close; limits are to be final.

    Args:
        axes: With limits and scales as they are to stay.
        ends: The right end of each curve.
        labels: What to write, the same number.
        colors: The curves', for the lines from the labels to them.
    """
    points = axes.transAxes.inverted().transform(axes.transData.transform(ends))
    high = axes.get_window_extent().height / axes.figure.dpi
    height = [0.21 * (1 + label.count("\n")) / high for label in labels]
    order = np.argsort(points[:, 1], kind="stable")
    places = apart(points[order, 1], [height[i] for i in order])
    top = 0.0  # of those before; none stands below the axes
    for i, wanted in zip(order, places, strict=True):
        y = max(wanted, top + 0.5 * height[i])
        top = y + 0.5 * height[i]
        axes.annotate(labels[i], ends[i], (1.02, y), textcoords="axes fraction", va="center",
                      fontsize=12, annotation_clip=False,
                      arrowprops={"arrowstyle": "-", "color": colors[i], "linewidth": 0.6,
                                  "relpos": (0.0, 0.5)})  # fmt: skip


def apart(wanted: Sequence[float] | FloatArray, heights: Sequence[float]) -> list[float]:
    """Place things in a column so that none overlap, as near as can be to where they belong.

    Args:
        wanted: Where their middles belong, ascending.
        heights: How high they are.
    """
    blocks: list[tuple[float, float, int]] = []  # lower end, height, number of things
    for middle, height in zip(wanted, heights, strict=True):
        low, high, number = float(middle) - height / 2, height, 1
        while blocks and sum(blocks[-1][:2]) > low:
            under, size, others = blocks.pop()
            low = (others * under + number * (low - size)) / (others + number)
            high, number = high + size, others + number
        blocks.append((low, high, number))
    places, left = [], iter(heights)
    for low, _, number in blocks:
        for _ in range(number):
            height = next(left)
            places.append(low + height / 2)
            low += height
    return places


def log_ticks(axis: XAxis | YAxis) -> None:
    """Mark decades with what is between; where there are few of them, 1, 2 and 5 of each."""
    from matplotlib.ticker import LogFormatterSciNotation, LogLocator

    low, high = axis.get_view_interval()
    few = high < 200 * low
    axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0) if few else (1.0,), numticks=12))
    axis.set_minor_locator(LogLocator(subs=range(2, 10), numticks=99))
    if few:
        axis.set_major_formatter(
            lambda value, _: f"{value:g}" if value < 1000 else grouped(round(value))
        )
    else:
        axis.set_major_formatter(LogFormatterSciNotation())
    axis.set_minor_formatter(lambda *_: "")


def chains(segments: FloatArray) -> list[FloatArray]:
    """Join straight lines where two of them meet, so that they are drawn as one.

    Args:
        segments: Their ends, shape (n, 2, 2).

    Returns:
        Polygonal lines, each of shape (points, 2); closed ones return to their first point.
    """
    if not len(segments):
        return []
    points = segments.reshape(-1, 2)
    grid = np.rint((points - points.min(axis=0)) / (1e-9 * np.ptp(points, axis=0).max()))
    _, first, place = np.unique(grid, axis=0, return_index=True, return_inverse=True)
    ends = place.reshape(-1, 2).tolist()
    at = defaultdict(set)
    for segment, pair in enumerate(ends):
        for point in pair:
            at[point].add(segment)
    lines = []
    # From loose ends and crossings first; what is left then is closed
    for start in sorted(at, key=lambda point: len(at[point]) == 2):
        while at[start]:
            line, point = [start], start
            while at[point]:
                segment = at[point].pop()
                point = ends[segment][ends[segment][0] == point]
                at[point].discard(segment)
                line.append(point)
            lines.append(points[first[line]])
    return lines


def grouped(number: float) -> str:
    """Format a number with its digits in groups of three."""
    return f"{number:,}".replace(",", "\u2009")


def save(figure: Figure | SubFigure, path: Where | None) -> None:
    """Write the PNG, if a path is given.

    Raises:
        InputError: The system does not let us.
    """
    if path is not None:
        with disk_errors(file := as_path(path)):
            file.write_bytes(as_png(figure))
