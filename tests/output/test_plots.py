"""The pictures: is there on them what the solution says?"""

import numpy as np
import pytest
from dolfinx import fem
from dolfinx.geometry import bb_tree, compute_colliding_cells, compute_collisions_points
from dolfinx.mesh import (
    compute_midpoints,
    create_rectangle,
    create_unit_cube,
    exterior_facet_indices,
    meshtags,
)
from helpers import SQUARE, is_picture, rectangle
from mpi4py import MPI

from signorini_cr import (
    Contact,
    Dirichlet,
    Domain,
    InputError,
    Neumann,
    Polygon,
    Problem,
    Robin,
    exact,
    plots,
    solve,
)
from signorini_cr.fem.space import function_space
from signorini_cr.output import canvas
from signorini_cr.output.raster import raster

pytestmark = pytest.mark.slow

image = pytest.importorskip("matplotlib.image")
WORLD = MPI.COMM_WORLD


def holed():
    """A square, all of its square hole in contact."""
    square = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    hole = Polygon(0.4 * square, ("contact",) * 4)
    sides = ("dirichlet", "contact", "neumann", "contact")
    return Polygon(square, sides, holes=(hole,)).mesh(0.2)


def share(path, color):
    """Compute the percentage of a picture that has this colour; on rank 0, 0 elsewhere."""
    if WORLD.rank != 0:
        return 0.0
    wanted = np.array([int(color[i : i + 2], 16) for i in (1, 3, 5)]) / 255
    pixels = image.imread(path)[..., :3]
    return 100 * np.mean(np.abs(pixels - wanted).max(axis=-1) < 0.02)


def on_rank_0(value):
    return WORLD.bcast(value, root=0)


def test_the_mesh_shows_its_materials(shared_tmp_path):
    half = np.array([[-1.0, 0.0], [0.0, 0.0], [0.0, 2.0], [-1.0, 2.0]])
    sides = ("contact", "dirichlet", "dirichlet", "dirichlet")
    corners = [[-1.0, 0.0], [1.0, 0.0], [1.0, 1.0], [-1.0, 1.0]]
    domain = Polygon(corners, sides, materials={"price in $": half}).mesh(0.4)
    path = shared_tmp_path / "mesh.png"
    plots.plot_mesh(domain, path)
    assert on_rank_0(share(path, plots.TINTS[0])) > 10
    plots.plot_mesh(rectangle(4), str(path))
    assert on_rank_0(share(path, plots.TINTS[0])) < 0.5


def test_the_mesh_shows_each_boundary_part_in_its_colour(shared_tmp_path):
    path = shared_tmp_path / "mesh.png"
    for neumann in (False, True):
        plots.plot_mesh(rectangle(4, neumann=neumann), path, "price in $, 5 % off")
        assert on_rank_0(share(path, canvas.RED)) > 0.5
        assert on_rank_0(share(path, canvas.BLUE)) > 0.3
        assert (on_rank_0(share(path, canvas.YELLOW)) > 0.1) == neumann


def test_the_mesh_tells_what_holds_on_parts_of_other_names():
    sides = ["floor", "air", "top in $", "wall"]
    domain = Polygon(SQUARE.vertices, sides, names=sides).mesh(0.5, WORLD)
    held = {"floor": Contact(0.0), "air": Robin(0.0), "top in $": Dirichlet(0.0), "wall": Neumann()}
    figure = plots.plot_mesh(domain, problem=Problem(conditions=held))
    bare = plots.plot_mesh(domain)
    if WORLD.rank == 0:
        told = [text.get_text() for text in figure.legends[0].get_texts()]
        assert told == ["floor: contact", "air: Robin", r"top in \$: Dirichlet", "wall: Neumann"]
        told = [text.get_text() for text in bare.legends[0].get_texts()]
        assert told == [name.replace("$", r"\$") for name in sides]


def test_names_of_parts_are_no_formulas_on_any_picture(shared_tmp_path):
    """Two pieces of Γ1, so that they are named below as well as above; all are in the legend."""
    sides = ["w$x^^$", "$a_{$", "_b$", r"\$c\$d$"]
    domain = Polygon(SQUARE.vertices, sides, names=sides).mesh(0.5, WORLD)
    held = dict.fromkeys(sides[::2], Contact(-1.0)) | dict.fromkeys(sides[1::2], Dirichlet(0.0))
    problem = Problem(f=-1.0, conditions=held)
    units = plots.Units(x="$_", u="_$u", names={"u": "_$", "x": "$x_$"})
    paths = [shared_tmp_path / name for name in ("mesh.png", "contact.png", "solution.png")]
    mesh = plots.plot_mesh(domain, paths[0], "_$", units=units, problem=problem)
    solution = solve(problem, domain)
    contact = plots.plot_contact(solution, paths[1], "$^$", units=units)
    plots.plot_solution(solution, paths[2], "$_$", units=units)
    if WORLD.rank == 0:
        told = [text.get_text() for text in mesh.legends[0].get_texts()]
        assert len(told) == 4 and told[0] == r"w\$x^^\$: contact"
        above = [text.get_text() for axes in contact.axes for text in axes.texts]
        below = contact.legends[0].get_title().get_text()
        for name in (r"w\$x^^\$", "\u200b_b\\$"):
            assert name in above and f"{name} from" in below


def test_the_mesh_tells_what_holds_on_parts_of_usual_names():
    """By their conditions, not by their names."""
    sides = ["contact", "neumann", "dirichlet", "neumann"]
    domain = Polygon(SQUARE.vertices, sides).mesh(0.5, WORLD)
    usual = [r"$\Gamma_1$: contact", r"$\Gamma_g$: Neumann", r"$\Gamma_0$: Dirichlet"]
    for held, words in (
        ({}, usual),
        ({"contact": Contact(0.0), "neumann": Neumann(1.0)}, usual),
        ({"neumann": Robin(1.0)}, [usual[0], "neumann: Robin", usual[2]]),
        (
            {"contact": Robin(1.0), "dirichlet": Contact(0.0)},
            ["contact: Robin", usual[1], "dirichlet: contact"],
        ),
    ):
        figure = plots.plot_mesh(domain, problem=Problem(conditions=held))
        if WORLD.rank == 0:
            told = [text.get_text() for text in figure.legends[0].get_texts()]
            assert sorted(told) == sorted(words)


def test_a_mesh_of_too_many_edges_is_drawn_without(shared_tmp_path, monkeypatch):
    path = shared_tmp_path / "mesh.png"
    plots.plot_mesh(rectangle(16), path)
    with_edges = on_rank_0(share(path, "#ffffff"))
    monkeypatch.setattr(plots, "MOST_EDGES", 10)
    plots.plot_mesh(rectangle(16), path)
    assert on_rank_0(share(path, "#ffffff")) > with_edges + 3
    assert on_rank_0(share(path, canvas.RED)) > 0.5


def test_the_solution_shows_where_it_is_in_contact(shared_tmp_path):
    path = shared_tmp_path / "solution.png"
    reds = []
    for f in (1.0, lambda x: -x[0], -1.0):
        solution = solve(Problem(f=f), rectangle(8))
        plots.plot_solution(solution, path)
        reds.append((solution.contact.number_active, on_rank_0(share(path, canvas.RED))))
    (none, white), (half, some), (every, all_red) = reds
    assert none == 0 < half < every == 16
    assert white == 0.0
    assert 0.2 < some < all_red


@pytest.mark.parametrize("load", [1.0, -1.0])
def test_no_contour_line_follows_a_part(load):
    """u is 0 on Γ0 and nowhere else, but means at vertices are not."""
    sides = ("contact", "dirichlet", "dirichlet", "dirichlet")
    domain = Polygon([[0, 0], [2, 0], [2, 1], [0, 1]], sides).mesh(0.2, WORLD)
    solution = solve(Problem(f=load, obstacle=-9.0), domain)
    figure = plots.plot_solution(solution)
    if WORLD.rank == 0:
        (lines,) = (each for each in figure.axes[0].collections if hasattr(each, "levels"))
        (zero,) = np.flatnonzero(np.abs(lines.levels) < 1e-5)
        sizes = [sum(map(len, segments)) for segments in lines.allsegs]
        assert sizes.pop(zero) == 0 and min(sizes) > 0


def test_a_contour_line_inside_stays():
    """u is 0 on Γ0 and on a line between."""
    solution = solve(Problem(f=lambda x: x[0], obstacle=-9.0), rectangle(8))
    figure = plots.plot_solution(solution)
    if WORLD.rank == 0:
        (lines,) = (each for each in figure.axes[0].collections if hasattr(each, "levels"))
        (zero,) = np.flatnonzero(np.abs(lines.levels) < 1e-5)
        line = max(lines.allsegs[zero], key=len)
        assert np.abs(line[:, 0]).max() < 0.1 and np.ptp(line[:, 1]) > 0.8


def test_parts_of_a_piece_are_named_where_they_are(shared_tmp_path):
    """Two sides of a square and a stretch of 1/16, which has no room for its name."""
    corners = [[0.0, 0.0], [1.0, 0.0], [1.0, 1 / 16], [1.0, 1.0], [0.0, 1.0]]
    names = ["floor", "step", "wall", "roof", "roof"]
    domain = Polygon(corners, names, names=names[:4]).mesh(0.1, WORLD)
    held = dict.fromkeys(names[:3], Contact(0.0)) | {"roof": Dirichlet(0.0)}
    solution = solve(Problem(f=-1.0, conditions=held), domain)
    figure = plots.plot_contact(solution)
    if WORLD.rank == 0:
        above, _ = figure.axes
        found = {text.get_text(): text.xy[0] for text in above.texts if text.get_text() in names}
        assert found == {"floor": pytest.approx(0.5), "wall": pytest.approx(1 + 17 / 32)}


@pytest.mark.parametrize("f", [1.0, -1.0, lambda x: x[0]])
def test_contact_is_drawn_on_a_domain_with_a_hole(shared_tmp_path, f):
    solution = solve(Problem(f=f, obstacle=lambda x: -0.01 + 0 * x[0]), holed())
    assert set(on_rank_0((solution.contact.table() or {"part": [0]})["part"])) == {0, 1, 2}
    plots.plot_contact(solution, shared_tmp_path / "contact.png", "hole")
    plots.plot_solution(solution, shared_tmp_path / "solution.png", "hole")
    # λ_h is drawn in red, u_h in blue
    for color in (canvas.RED, canvas.BLUE):
        assert on_rank_0(share(shared_tmp_path / "contact.png", color)) > 0.05


@pytest.mark.parametrize("scale", [1e-6, 1e6])
def test_scales_do_not_matter(shared_tmp_path, scale):
    sides = ("contact", "dirichlet", "dirichlet", "dirichlet")
    domain = Polygon(scale * np.array([[5, 0], [25, 0], [25, 1], [5, 1.0]]), sides).mesh(scale / 2)
    solution = solve(Problem(f=lambda x: x[0] / scale - 15), domain)
    plots.plot_mesh(domain, shared_tmp_path / "mesh.png")
    plots.plot_contact(solution, shared_tmp_path / "contact.png")
    plots.plot_solution(solution, shared_tmp_path / "solution.png")
    for name in ("mesh", "contact", "solution"):
        assert on_rank_0(share(shared_tmp_path / f"{name}.png", canvas.RED)) > 0.2


def test_the_raster_is_exact_for_an_affine_function_and_empty_outside():
    domain = holed()
    u = fem.Function(function_space(domain.mesh, "CR"))
    u.interpolate(lambda x: 2 * x[0] - 3 * x[1])
    u.x.scatter_forward()
    pixels, box, limits = raster(u, 100)
    assert box == pytest.approx(np.array([[-1, -1], [1, 1]]))
    assert limits == pytest.approx((-5, 5))
    if WORLD.rank == 0:
        y, x = np.meshgrid(*2 * [np.linspace(-0.99, 0.99, 100)], indexing="ij")
        in_hole = np.maximum(np.abs(x), np.abs(y)) < 0.4
        assert np.array_equal(np.isnan(pixels), in_hole)
        assert pixels[~in_hole] == pytest.approx((2 * x - 3 * y)[~in_hole])


@pytest.mark.serial
@pytest.mark.parametrize("n", [2, 60])
def test_the_raster_has_the_values_of_a_jumping_function(n):
    mesh = create_rectangle(WORLD, [[0.0, 0.0], [np.pi, 1.0]], [n, n])
    u = fem.Function(function_space(mesh, "CR"))
    u.x.array[:] = np.random.default_rng(1).random(len(u.x.array))
    pixels, _, _ = raster(u, 50)
    rows, columns = pixels.shape
    x = np.zeros((rows * columns, 3))
    x[:, 0] = np.tile((np.arange(columns) + 0.5) * np.pi / columns, rows)
    x[:, 1] = np.repeat((np.arange(rows) + 0.5) / rows, columns)
    candidates = compute_collisions_points(bb_tree(mesh, 2), x)
    cells = compute_colliding_cells(mesh, candidates, x)
    alone = np.flatnonzero(np.diff(cells.offsets) == 1)
    assert len(alone) > 0.7 * len(x)
    values = u.eval(x[alone], cells.array[cells.offsets[alone]])
    assert pixels.ravel()[alone] == pytest.approx(values.ravel())


def record(h, h1, l2=None, bound=None, dofs=100):
    return {"h": h, "dofs": dofs, "error_h1": h1, "error_l2": l2, "bound_h1": bound,
            "rate_h1": 1.0, "rate_l2": 2.0}  # fmt: skip


@pytest.mark.serial
def test_convergence_draws_what_there_is(tmp_path):
    path = tmp_path / "convergence.png"
    uniform = [record(2.0**-k, 2.0**-k, 4.0**-k, 1.4 * 2.0**-k) for k in range(5)]
    assert set(plots.convergence_series(uniform)) == {"error_h1", "error_l2", "bound_h1"}
    plots.plot_convergence(uniform, path)
    assert all(share(path, color) > 0.05 for color in (canvas.BLUE, canvas.RED, canvas.YELLOW))
    bound_only = [record(0.5, None, None, 0.7, 100), record(0.5, None, None, 0.3, 400)]
    for records, label in (uniform, "error, bound"), (bound_only, "bound"):
        assert plots.plot_convergence(records).axes[0].get_ylabel() == label
    errors = [{**each, "bound_h1": None} for each in uniform]
    assert plots.plot_convergence(errors).axes[0].get_ylabel() == "error"
    plots.plot_convergence(bound_only, path)
    assert share(path, canvas.BLUE) == share(path, canvas.RED) == 0.0 < share(path, canvas.YELLOW)
    for nothing in (uniform[:1], [], [record(1.0, None), record(0.5, None)]):
        assert plots.convergence_series(nothing) == []
        with pytest.raises(InputError, match="two levels"):
            plots.plot_convergence(nothing, path)


def test_the_error_is_where_the_cells_shares_are(shared_tmp_path):
    """Squares of the colours' values, times the areas, sum up to the bound's square."""
    path = shared_tmp_path / "error.png"
    solution = solve(exact.S1.problem, exact.S1.structured(6))
    figure = plots.plot_error(solution, path, "S1")
    assert is_picture(path)
    assert (figure is None) == (WORLD.rank > 0)
    if figure is None:
        return
    (cells, *_) = figure.axes[0].collections
    x, y = np.stack([path.vertices[:3] for path in cells.get_paths()]).transpose(2, 1, 0)
    area = 0.5 * np.abs((x[1] - x[0]) * (y[2] - y[0]) - (x[2] - x[0]) * (y[1] - y[0]))
    assert len(area) == 2 * 12 * 6 and np.isclose(area.sum(), 2.0)
    # but for the two cells of 144 whose colours are cut off
    total = np.sum(np.asarray(cells.get_array()) ** 2 * area)
    assert np.isclose(total, solution.certificate.bound_h1**2, rtol=0.02)


def test_no_picture_of_an_error_without_a_bound():
    with pytest.raises(InputError, match="no bound to draw"):
        plots.plot_error(solve(exact.S1.problem, exact.S1.structured(2), "P1"))


def test_what_can_not_be_drawn_is_told_on_all_ranks(shared_tmp_path):
    mesh = create_unit_cube(WORLD, 2, 2, 2)
    mesh.topology.create_connectivity(2, 3)
    facets = exterior_facet_indices(mesh.topology)
    below = compute_midpoints(mesh, 2, facets)[:, 2] < 1e-12
    cube = Domain.from_tags(mesh, meshtags(mesh, 2, facets, np.where(below, 1, 2).astype(np.int32)))
    with pytest.raises(InputError, match="plane"):
        plots.plot_mesh(cube, shared_tmp_path / "mesh.png")
    with pytest.raises(InputError, match=r"cannot write mesh\.png"):
        plots.plot_mesh(rectangle(2), shared_tmp_path / "nowhere" / "mesh.png")


@pytest.mark.serial
def test_nothing_global_is_touched(tmp_path):
    import matplotlib
    from matplotlib._pylab_helpers import Gcf

    settings = dict(matplotlib.rcParams)
    plots.plot_mesh(rectangle(2), tmp_path / "mesh.png")
    assert dict(matplotlib.rcParams) == settings
    assert Gcf.get_all_fig_managers() == []
