"""Pictures without a file: on Axes of one's own, or for a notebook."""

from io import BytesIO

import numpy as np
import pytest
from helpers import on_a_slope
from mpi4py import MPI

from signorini_cr import InputError, plots
from signorini_cr.output import canvas
from signorini_cr.output.raster import raster

pytestmark = pytest.mark.slow

image = pytest.importorskip("matplotlib.image")
WORLD = MPI.COMM_WORLD


@pytest.fixture(scope="module")
def solution():
    return on_a_slope(2)


def records():
    rows = [{"h": 2.0**-k, "dofs": 4**k, "error_h1": 2.0**-k, "error_l2": None} for k in range(4)]
    return [row | {"bound_h1": 2 * row["error_h1"], "rate_h1": 1.0} for row in rows]


def grid(rows, columns):
    """Axes in a grid; on rank 0, which draws."""
    figure = canvas.new_figure(12.0, 9.0)
    return figure, figure.subplots(rows, columns)


def test_without_a_path_there_is_a_figure_that_shows_itself(solution):
    figures = [
        plots.plot_mesh(solution.domain),
        plots.plot_solution(solution),
        plots.plot_contact(solution),
        plots.plot_convergence(records()) if WORLD.rank == 0 else None,
    ]
    assert all((figure is None) == (WORLD.rank > 0) for figure in figures)
    for figure in figures if WORLD.rank == 0 else []:
        pixels = image.imread(BytesIO(figure._repr_png_()))
        assert abs(pixels.shape[1] - figure.get_figwidth() * figure.dpi) <= 0.5 * figure.dpi
        # nothing reaches the edge, so nothing is cut off there
        for edge in (pixels[0], pixels[-1], pixels[:, 0], pixels[:, -1]):
            assert edge[..., :3].min() == 1.0
        assert np.ptp(pixels[..., :3]) > 0.9


@pytest.mark.serial
def test_fonts_keep_nothing_of_a_picture():
    """Or each formula's glyphs would stay for as long as the process lives."""
    manager = pytest.importorskip("matplotlib.font_manager")
    names = (manager.FontProperties(style=style) for style in ("normal", "italic"))
    fonts = [manager.get_font(manager.findfont(name)) for name in names]
    figure = canvas.new_figure(4.0, 3.0)
    figure.suptitle("$u_h$, 1 of $\\mathrm{two}$")
    figure.canvas.draw()
    assert all(font.get_num_glyphs() > 0 for font in fonts)
    canvas.as_png(figure)
    assert [font.get_num_glyphs() for font in fonts] == [0, 0]


def test_axes_show_what_the_solution_says(solution):
    figure, (ours, theirs) = grid(1, 2) if WORLD.rank == 0 else (None, (None, None))
    drawn = plots.plot_solution(solution, ax=ours)
    pixels, _, limits = raster(solution.u)
    plots.plot_mesh(solution.domain, ax=theirs)
    if figure is None:
        assert drawn is None
        return
    assert drawn is figure
    (shown,) = ours.get_images()
    assert np.array_equal(shown.get_array().filled(np.nan), pixels, equal_nan=True)
    assert shown.get_clim() == limits
    assert shown.get_extent() == pytest.approx([-1, 1, 0, 1])
    for axes in (ours, theirs):
        low, high = axes.get_xlim()
        assert low < -1 and high > 1 and axes.get_legend() is not None
    # mesh: all edges; Γ0, Γ1, each as one line through the ends of its facets
    edges = solution.domain.mesh.topology.index_map(1).size_global
    inner, *parts = (lines.get_segments() for lines in theirs.collections)
    assert len(inner) == edges
    assert [[len(line) for line in part] for part in parts] == [[33], [17]]


@pytest.mark.parametrize("layout", ["constrained", None])
def test_narrow_axes_have_room_for_what_stands_there(solution, layout):
    """Two pictures on what Matplotlib makes unasked: nothing is cut off, no legend on another."""
    figures = pytest.importorskip("matplotlib.figure")
    figure = figures.Figure(figsize=(6.4, 4.8), layout=layout)
    left, right = figure.subplots(1, 2)
    plots.plot_mesh(solution.domain, ax=left)
    plots.plot_solution(solution, ax=right)
    if WORLD.rank > 0:
        return
    figure.draw_without_rendering()
    places = [axes.get_legend().get_window_extent() for axes in (left, right)]
    assert places[0].x1 < places[1].x0
    (bar,) = right.child_axes
    places += [axes.get_tightbbox() for axes in (left, right, bar)]
    for place in places:
        assert place.x0 >= -1 and place.x1 <= figure.bbox.width + 1
    assert min(axes.bbox.width for axes in (left, right)) > 0.25 * figure.bbox.width


def test_names_and_units_stand_beside_the_axes(solution):
    names = {"x": "distance", "u": "price", "flux": "heat"}
    units = plots.Units(x="km", u="$", flux="W/m²", names=names)
    figures = [plot(solution, units=units) for plot in (plots.plot_solution, plots.plot_contact)]
    if WORLD.rank > 0:
        return
    (plane,) = figures[0].axes
    (bar,) = plane.child_axes
    assert (
        plane.get_xlabel() == "distance $x$ in\u00a0km" and plane.get_ylabel() == "$y$ in\u00a0km"
    )
    assert bar.get_ylabel() == "price $u_h$ in\u00a0\\$"
    upper, lower = figures[1].axes
    assert (
        upper.get_ylabel().startswith("price\n$u_h$ and") and "in\u00a0\\$," in upper.get_ylabel()
    )
    assert lower.get_ylabel() == "heat $\\lambda_h$ in\u00a0W/m²"
    assert "$\\Gamma_1$ in\u00a0km, from" in figures[1].legends[0].get_title().get_text()
    for figure in figures:
        assert figure._repr_png_()
    assert plots.plot_convergence(records(), units=units).axes[0].get_xlabel() == "$h$ in\u00a0km"


def test_contact_takes_the_place_of_axes(solution):
    figure, axes = grid(2, 2) if WORLD.rank == 0 else (None, np.full((2, 2), None))
    plots.plot_contact(solution, ax=axes[0, 1])
    table = solution.contact.table()
    if figure is not None:
        assert axes[0, 1] not in figure.axes
        (page,) = figure.subfigs
        upper, lower = page.axes
        curves = {line.get_label(): line.get_ydata() for line in upper.get_lines()}
        assert np.array_equal(curves["$u_h$"], table["u"])
        (steps,) = (patch for patch in lower.patches if patch.get_label() == r"$\lambda_h$")
        assert np.array_equal(steps.get_data().values, table["pressure"])
        figure.canvas.draw()
        # in the upper right quarter
        box = upper.get_window_extent().transformed(figure.transFigure.inverted())
        assert box.x0 > 0.5 and box.y0 > 0.5
        alone = figure.add_axes((0.0, 0.0, 0.1, 0.1))
    with pytest.raises(InputError, match="Axes of a grid"):
        plots.plot_contact(solution, ax=alone if figure is not None else None)


@pytest.mark.serial
def test_convergence_on_axes_of_ones_own():
    _, axes = grid(1, 1)
    plots.plot_convergence(records(), ax=axes)
    lines = {line.get_label().split(",")[0]: line for line in axes.get_lines()}
    assert lines[plots.SERIES["bound_h1"]["label"]].get_ydata() == pytest.approx(
        [2.0, 1.0, 0.5, 0.25]
    )
