"""The style of the pictures: nothing clipped, one orientation, lines that are lines."""

from itertools import pairwise

import numpy as np
import pytest
from mpi4py import MPI

from signorini_cr import Polygon, Problem, plots, solve
from signorini_cr.output import canvas

pytest.importorskip("matplotlib")
WORLD = MPI.COMM_WORLD
LONG = "A membrane over a floor of gentle waves, pulled down in the middle by 5 $ of weight"
SQUARE = [[0, 0], [1, 0], [1, 1], [0, 1]]
THIN = [[0, 0], [1, 0], [1, 30], [0, 30]]


def solved(vertices, contact, size=0.25):
    sides = ["contact" if i in contact else "dirichlet" for i in range(len(vertices))]
    problem = Problem(f=lambda x: -8 * x[0], obstacle=lambda x: -0.02 + 0 * x[0])
    return solve(problem, Polygon(vertices, sides).mesh(size))


def overhang(figure):
    """By how many inches what is drawn goes beyond the edges of the figure."""
    figure.canvas.draw()
    box = figure.get_tightbbox(figure.canvas.get_renderer())
    return max(-box.x0, -box.y0, box.x1 - figure.get_figwidth(), box.y1 - figure.get_figheight())


@pytest.mark.parametrize(("vertices", "size"), [(SQUARE, 0.25), (THIN, 1.0)])
def test_nothing_is_cut_off(vertices, size):
    solution = solved(vertices, {0, 2}, size)
    rows = [{"h": h, "dofs": 1 / h, "error_h1": h, "error_l2": 0.9 * h, "bound_h1": 1.1 * h,
             "rate_h1": 1.0, "rate_l2": 1.0} for h in (0.5, 0.25, 0.125)]  # fmt: skip
    figures = [
        plots.plot_mesh(solution.domain, title=LONG),
        plots.plot_solution(solution, title=LONG),
        plots.plot_contact(solution, title=LONG),
        plots.plot_convergence(rows, title=LONG),
    ]
    for figure in figures if WORLD.rank == 0 else []:
        assert overhang(figure) < 0.01


@pytest.mark.parametrize("edge", [0, 2])
def test_contact_runs_from_the_left_to_the_right_on_any_edge(edge):
    """u falls with x, as the load grows: so it does on the picture, above and below."""
    solution = solved(SQUARE, {edge}, 0.1)
    figure = plots.plot_contact(solution)
    table = solution.contact.table()
    if figure is not None:
        (curve,) = (line for line in figure.axes[0].get_lines() if line.get_label() == "$u_h$")
        order = np.argsort(table["x"])
        assert curve.get_xdata() == pytest.approx(table["x"][order])
        assert curve.get_ydata() == pytest.approx(table["u"][order])


@pytest.mark.serial
def test_lines_that_meet_become_one():
    corners = np.array([[0, 0], [1, 0], [1, 1], [0, 1.0]])
    square = np.stack([corners, np.roll(corners, -1, axis=0)], axis=1)
    shuffled = square[[2, 0, 3, 1]][:, ::-1]
    (closed,) = canvas.chains(shuffled)
    assert len(closed) == 5
    assert np.array_equal(closed[0], closed[-1])
    assert {tuple(point) for point in closed} == {tuple(point) for point in corners}
    (opened,) = canvas.chains(square[[0, 2, 1]])
    assert opened[[0, -1]].tolist() in ([[0, 0], [0, 1]], [[0, 1], [0, 0]])
    assert len(canvas.chains(square[[0, 2]])) == 2
    assert canvas.chains(square[:0]) == []


@pytest.mark.serial
@pytest.mark.parametrize("span", [1.5, 30.0, 1e6])
def test_the_error_axis_has_several_ticks(span):
    rows = [{"h": h, "dofs": 1 / h, "error_h1": 0.1 * span**-i, "error_l2": None,
             "bound_h1": None, "rate_h1": None} for i, h in enumerate((0.5, 0.25))]  # fmt: skip
    (axes,) = plots.plot_convergence(rows).axes
    low, high = axes.get_ylim()
    axes.figure.canvas.draw()
    shown = [tick.get_text() for tick, at in zip(axes.get_yticklabels(), axes.get_yticks(),
             strict=True) if low <= at <= high]  # fmt: skip
    assert sum(bool(text) for text in shown) >= 2


@pytest.mark.serial
def test_the_colours_are_told_apart_in_grey():
    def luminance(colour):
        c = np.array([int(colour[i : i + 2], 16) for i in (1, 3, 5)]) / 255
        c = np.where(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4)
        return c @ [0.2126, 0.7152, 0.0722] + 0.05

    light = sorted(luminance(c) for c in (canvas.BLUE, canvas.RED, canvas.YELLOW, "#ffffff"))
    assert all(high / low > 1.8 for low, high in pairwise(light))
