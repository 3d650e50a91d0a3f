"""The style of the pictures: nothing clipped, one orientation, lines that are lines."""

from itertools import pairwise

import numpy as np
import pytest
import ufl
from dolfinx import fem
from helpers import HELD_ALL_ROUND, SQUARE
from mpi4py import MPI

from signorini_cr import Contact, Dirichlet, Polygon, Problem, plots, solve
from signorini_cr.fem.space import function_space
from signorini_cr.output import canvas
from signorini_cr.output.raster import averaged
from signorini_cr.output.touching import contact_lines

pytest.importorskip("matplotlib")
WORLD = MPI.COMM_WORLD
LONG = "A membrane over a floor of gentle waves, pulled down in the middle by 5 $ of weight"
THIN = [[0, 0], [1, 0], [1, 30], [0, 30]]


def solved(vertices, contact, size=0.25):
    sides = ["contact" if i in contact else "dirichlet" for i in range(len(vertices))]
    problem = Problem(f=lambda x: -8 * x[0], obstacle=lambda x: -0.02 + 0 * x[0])
    return solve(problem, Polygon(vertices, sides).mesh(size))


def overhang(figure):
    """Compute the inches that what is drawn goes beyond the edges of the figure."""
    figure.canvas.draw()
    box = figure.get_tightbbox(figure.canvas.get_renderer())
    return max(-box.x0, -box.y0, box.x1 - figure.get_figwidth(), box.y1 - figure.get_figheight())


@pytest.mark.slow
@pytest.mark.parametrize(("vertices", "size"), [(SQUARE.vertices, 0.25), (THIN, 1.0)])
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
    """In the arc length of contact.csv, which decreases on an upper edge, as Ω is to the left."""
    solution = solved(SQUARE.vertices, {edge}, 0.1)
    figure = plots.plot_contact(solution)
    table, transitions = solution.contact.table(), solution.contact.transitions
    if figure is None:
        return
    axes, below = figure.axes
    (curve,) = (line for line in axes.get_lines() if line.get_label() == "$u_h$")
    assert curve.get_xdata() == pytest.approx(table["arc_length"])
    assert curve.get_ydata() == pytest.approx(table["u"])
    # pixels go with x on both edges
    pixels = axes.transData.transform(np.c_[table["arc_length"], table["u"]])[:, 0]
    assert np.all(np.diff(pixels[np.argsort(table["x"])]) > 0)
    for panel in (axes, below):
        assert panel.get_xlim() == pytest.approx((0, 1) if edge == 0 else (1, 0))
    # contact is shaded up to where it ends, at the same place in terms of arc length
    along = np.sort(transitions[:, 0] if edge == 0 else 1 - transitions[:, 0])
    shaded = axes.collections[0].get_paths()[0].vertices[:, 0]
    lines = np.array([line[0, 0] for line in axes.collections[1].get_segments()])
    assert len(along) == 1 and lines == pytest.approx(along)
    assert np.min(np.abs(shaded - along[0])) < 1e-12


@pytest.mark.parametrize("edge", [0, 2])
def test_the_screen_tells_places_in_the_order_of_arc_length(edge):
    bump = Problem(f=lambda x: 300 * ufl.cos(6 * np.pi * x[0]))
    sides = ["contact" if i == edge else "dirichlet" for i in range(4)]
    solution = solve(bump, Polygon(SQUARE.vertices, sides).mesh(0.05))
    table, points = solution.contact.table(), solution.contact.transitions[:, 0]
    assert len(points) > 2
    if table is not None:
        arc = np.interp(points, *(column[np.argsort(table["x"])] for column in
                                  (table["x"], table["arc_length"])))  # fmt: skip
        assert np.all(np.diff(arc) > 0)


@pytest.mark.parametrize(
    ("bounds", "names", "signs"),
    [
        ({"obstacle": -0.1}, [r"obstacle $\alpha$"], r"$u_h$ and $\alpha$"),
        ({"upper": 0.1}, [r"upper bound $\beta$"], r"$u_h$ and $\beta$"),
        (
            {"obstacle": -0.1, "upper": 0.1},
            [r"lower bound $\alpha$", r"upper bound $\beta$"],
            r"$u_h$ and $\alpha$, $\beta$",
        ),
    ],
)
def test_bounds_have_their_names(bounds, names, signs):
    conditions = {
        "contact": Contact(**{key: lambda x, value=value: value + 0 * x[0]
                              for key, value in bounds.items()}),
        "dirichlet": Dirichlet(0.0),
    }  # fmt: skip
    problem = Problem(f=lambda x: 8 * ufl.sin(6 * x[0]), conditions=conditions)
    figure = plots.plot_contact(solve(problem, HELD_ALL_ROUND.mesh(0.2)))
    if figure is None:
        return
    axes = figure.axes[0]
    assert axes.get_ylabel() == f"{signs}, facet means"
    # they stand in the order of their heights, which the mesh decides
    assert sorted(text.get_text() for text in axes.texts) == sorted(["$u_h$", *names])


def test_the_mark_sits_where_the_bar_ends():
    solution = solved(SQUARE.vertices, {2}, 0.1)
    touching, free = contact_lines(solution.contact)
    point = solution.contact.transitions[0, :2]
    if WORLD.rank > 0:
        return
    facets = solution.contact.table()["x"] - 0.5 * solution.contact.table()["length"]
    assert np.min(np.abs(facets - point[0])) > 1e-3  # inside one
    (red,), (white,) = canvas.chains(touching), canvas.chains(free)
    for line in (red, white):
        assert np.min(np.linalg.norm(line - point, axis=1)) < 1e-12
    lengths = [np.linalg.norm(np.diff(line, axis=0), axis=1).sum() for line in (red, white)]
    assert sum(lengths) == pytest.approx(1.0)


def test_means_at_vertices_are_those_of_the_cells_around():
    """Exact for a continuous function, and the mean of both sides for one that jumps."""
    domain = HELD_ALL_ROUND.mesh(0.3)
    u = fem.Function(function_space(domain.mesh, "CR"))
    u.interpolate(lambda x: 2 * x[0] - 3 * x[1])
    u.x.scatter_forward()
    means = averaged(u)
    exact = fem.Function(means.function_space)
    exact.interpolate(lambda x: 2 * x[0] - 3 * x[1])
    assert np.allclose(means.x.array, exact.x.array)


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
@pytest.mark.parametrize(
    ("keys", "sizes", "says"),
    [
        (("error_h1", "bound_h1"), [8, 4, 2], "the error falls like $h^{0.99}$, the bound with it"),
        (("error_l2",), [8, 4, 2], "the error falls like $h^{1.98}$"),
        (("bound_h1",), [8, 4, 2], "the bound falls like $h^{1.00}$"),
        (("bound_h1",), [8, 7, 6], "the bound falls like $N^{-0.50}$"),
    ],
)
def test_the_title_of_convergence_says_how_the_error_falls(keys, sizes, says):
    rows = [{"h": h, "dofs": 100 * 4**k, "error_h1": None, "error_l2": None, "bound_h1": None,
             "rate_h1": 0.99, "rate_l2": 1.98} | dict.fromkeys(keys, 0.5**k)
            for k, h in enumerate(sizes)]  # fmt: skip
    axes = plots.plot_convergence(rows, units=plots.Units(u="K", x="m")).axes[0]
    assert axes.get_title() == says
    labels = [text.get_text() for text in axes.texts if "u_h" in text.get_text()]
    assert all(("in K m" if "nabla" not in label else "in K") in label for label in labels)
    axes.figure.canvas.draw()
    low, high = axes.get_xlim()
    shown = [tick.get_text() for tick, at in zip(axes.get_xticklabels(), axes.get_xticks(),
             strict=True) if low <= at <= high]  # fmt: skip
    assert sum(bool(text) for text in shown) >= 2


@pytest.mark.serial
@pytest.mark.parametrize(
    ("dofs", "rows", "says"),
    [
        ([25, 25, 25], {"bound_h1": [1.0, 1.0, 1.0]}, "the bound stays as it is"),
        ([25, 25, 25], {"bound_h1": [1.0, 0.5, 0.25]}, "the bound falls"),
        ([25, 50, 100], {"bound_h1": [1.0, 0.5, 1.0]}, "the bound rises"),
        ([25, 50, 100], {"bound_h1": [1.0, 0.5, 0.49999]}, "the bound falls"),
        ([25, 50, 100], {"error_l2": [1.0, 2.0, 2.0]}, "the error stays as it is"),
        (
            [25, 50, 100],
            {"error_h1": [1.0, 1.0, 0.5], "bound_h1": [2.0, 1.0, 2.0]},
            "the error falls like $N^{-1.00}$, the bound rises",
        ),
        (
            [25, 50, 100],
            {"error_h1": [1.0, 1.0, 2.0], "bound_h1": [2.0, 1.0, 3.0]},
            "the error rises, the bound with it",
        ),
    ],
)
def test_the_title_of_convergence_has_a_power_where_there_is_one(dofs, rows, says, tmp_path):
    """None of equal sizes, nor where nothing falls."""
    records = [
        {"h": 0.5, "dofs": n} | {key: rows.get(key, [None] * 3)[k] for key in plots.SERIES}
        for k, n in enumerate(dofs)
    ]
    figure = plots.plot_convergence(records, tmp_path / "convergence.png")
    assert figure.axes[0].get_title() == says
    drawn = [text.get_text() for text in figure.axes[0].texts]
    assert any("N^" in text for text in drawn) == (len(set(dofs)) > 1)


@pytest.mark.serial
def test_the_colours_are_told_apart_in_grey():
    def luminance(colour):
        c = np.array([int(colour[i : i + 2], 16) for i in (1, 3, 5)]) / 255
        c = np.where(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4)
        return c @ [0.2126, 0.7152, 0.0722] + 0.05

    light = sorted(luminance(c) for c in (canvas.BLUE, canvas.RED, canvas.YELLOW, "#ffffff"))
    assert all(high / low > 1.8 for low, high in pairwise(light))
