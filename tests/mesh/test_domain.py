"""Polygons, gmsh files and users' own meshes: right lengths and areas, clear complaints."""

import itertools
import sys
import time
from fractions import Fraction
from pathlib import Path

import basix.ufl
import dolfinx.mesh
import numpy as np
import pytest
import ufl
from helpers import MESHES, areas, integral, smallest_angle, stay, tagged
from mpi4py import MPI

from signorini_cr import Problem, Solver, solve, solve_adaptive, solve_in_time, solve_levels
from signorini_cr.compat import cell_nodes
from signorini_cr.errors import InputError, NotConverged, on_root, raise_together
from signorini_cr.mesh import gmshmesh
from signorini_cr.mesh.domain import CONTACT, DIRICHLET, NEUMANN, PARTS, Domain, Polygon, read_gmsh
from signorini_cr.mesh.families import structured
from signorini_cr.mesh.partition import bisect
from signorini_cr.mesh.polygon import check_loops, diameter
from signorini_cr.mesh.valid import thinness

COMM = MPI.COMM_WORLD
RECTANGLE = [[-1, 0], [1, 0], [1, 1], [-1, 1]]
LABELS = ["contact", "dirichlet", "neumann", "dirichlet"]
SQUARE = [[0.25, 0.25], [0.75, 0.25], [0.75, 0.75], [0.25, 0.75]]


def lengths(domain: Domain) -> list[float]:
    ds = ufl.Measure("ds", domain.mesh, subdomain_data=domain.tags)
    return [integral(1.0 * ds(part), domain.mesh.comm) for part in (CONTACT, DIRICHLET, NEUMANN)]


def area(domain: Domain) -> float:
    return integral(1.0 * ufl.dx(domain.mesh), domain.mesh.comm)


def counts(domain: Domain) -> list[int]:
    comm = domain.mesh.comm
    return [comm.allreduce(len(domain.facets(part))) for part in (CONTACT, DIRICHLET, NEUMANN)]


def fails_alike(function, *args) -> str:
    """The message of the InputError that every rank must raise."""
    with pytest.raises(InputError) as caught:
        function(*args)
    messages = set(COMM.allgather(str(caught.value)))
    assert len(messages) == 1
    return messages.pop()


# errors


def test_on_root_gives_all_ranks_the_result():
    assert on_root(COMM, lambda a, b: a + b, 1, 2) == 3


def test_on_root_raises_everywhere():
    def fail() -> None:
        raise InputError("no such thing")

    assert fails_alike(on_root, COMM, fail) == "no such thing"
    with pytest.raises((ZeroDivisionError, RuntimeError), match="division"):
        on_root(COMM, lambda: 1 // 0)


def test_raise_together_shows_the_lowest_rank():
    raise_together(COMM, None)
    last = COMM.size - 1
    complaint = f"rank {COMM.rank}" if COMM.rank == last else None
    assert fails_alike(raise_together, COMM, complaint) == f"rank {last}"


def test_not_converged_names_the_level():
    error = NotConverged("too many steps", level=3)
    assert (error.level, error.reason, str(error)) == (
        3,
        "too many steps",
        "level 3: too many steps",
    )


# polygons


@pytest.mark.parametrize("size", [0.1, 0.5, 5**0.5])
@pytest.mark.parametrize("turn", [1, -1])
def test_polygon_has_its_lengths_and_area(size: float, turn: int):
    # turned round, edge i runs between the same vertices if the labels are turned and shifted
    labels = LABELS if turn == 1 else [*LABELS[::-1][1:], LABELS[-1]]
    domain = Polygon(np.array(RECTANGLE)[::turn], labels).mesh(size)
    assert lengths(domain) == pytest.approx([2, 2, 2])
    assert area(domain) == pytest.approx(2)
    facets = int(np.ceil(2 / size - 1e-9))
    assert counts(domain) == [facets, 2 * max(1, int(np.ceil(1 / size - 1e-9))), facets]


def test_a_size_beyond_the_domain_is_refused():
    polygon = Polygon(RECTANGLE, LABELS)
    assert counts(polygon.mesh(polygon.diameter)) == [1, 2, 1]
    message = fails_alike(polygon.mesh, 2.3)
    assert "size is 2.3, longer than the domain, whose diameter is 2.23607" in message


@pytest.mark.parametrize("away", [0.0, 1e9])
@pytest.mark.parametrize("kind", ["cloud", "ellipse", "sliver", "line", "lattice", "small"])
def test_the_diameter_is_the_largest_of_all_distances(kind: str, away: float) -> None:
    random = np.random.default_rng(1)
    for count in range(2, 60):
        t = np.sort(random.uniform(0.0, 2 * np.pi, count))
        x = {
            "cloud": random.standard_normal((count, 2)),
            "ellipse": np.stack([np.cos(t), 0.3 * np.sin(t)], axis=1),
            "sliver": np.stack([np.cos(t), np.cos(t) + 1e-13 * np.sin(t)], axis=1),
            "line": np.stack([t, 0.37 * t], axis=1),
            "lattice": np.stack([np.arange(count) // 7, np.arange(count) % 7], axis=1),
            "small": 1e-150 * random.standard_normal((count, 2)),
        }[kind]
        x = x * (1.0 + away) + away
        if np.ptp(x, axis=0).any():
            largest = max(np.hypot(*(x - each).T).max() for each in x)
            assert diameter(x) == pytest.approx(largest, rel=1e-15)


def test_sizes_beside_short_edges_are_the_least_of_what_grows_from_all() -> None:
    random = np.random.default_rng(2)
    for count in (3, 4, 7, 64, 300):
        x = random.standard_normal((count, 2)) * [1.0, 10.0 ** random.uniform(-6.0, 0.0)]
        facets = 10.0 ** random.uniform(-4.0, 1.0, count)
        at = np.arange(count)
        edges = np.stack([at, np.roll(at, -1)], axis=1)
        own = np.minimum(facets, np.roll(facets, 1))
        distances = np.hypot(*(x[:, None] - x).transpose(2, 0, 1))
        expected = (own + 0.3 * distances).min(axis=1)
        assert np.array_equal(gmshmesh._sizes(x, edges, facets), expected)


def test_thirty_thousand_edges_take_no_time_before_they_are_meshed() -> None:
    """All on the hull, all with the size that grows from the one short edge."""
    count, began = 30_000, time.perf_counter()
    t, at = np.linspace(0.0, 2 * np.pi, count, endpoint=False), np.arange(count)
    x = np.stack([np.cos(t), np.sin(t)], axis=1)
    assert diameter(x) == pytest.approx(2.0, rel=1e-14)
    facets = np.where(at == 0, 1e-6, 10.0)
    sizes = gmshmesh._sizes(x, np.stack([at, np.roll(at, -1)], axis=1), facets)
    assert sizes[count // 2] == pytest.approx(1e-6 + 0.3 * 2.0, rel=1e-6)
    assert time.perf_counter() - began < 4.0  # twenty, where pairs are looked at


@pytest.mark.parametrize(
    "swapped, said",
    [
        (
            lambda polygon: polygon.mesh(COMM, 0.25),
            "size is of the type Intracomm: a positive number is needed",
        ),
        (
            lambda polygon: polygon.mesh(0.5, 0.25),
            "comm is of the type float: a communicator of MPI is needed",
        ),
        (
            lambda polygon: structured(polygon, COMM, 4),
            "n is of the type Intracomm: a number of squares is needed",
        ),
        (
            lambda polygon: structured(4, polygon),
            "polygon is of the type int: a Polygon is needed",
        ),
        (
            lambda _: read_gmsh(COMM, MESHES / "signorini.msh"),
            "path is of the type Intracomm: the path of a file is needed",
        ),
        (
            lambda polygon: solve(polygon.mesh(1.0), Problem()),
            "problem is of the type Domain: a Problem is needed",
        ),
        (
            lambda polygon: next(solve_levels(Problem(), polygon, 2)),
            "domain is of the type Polygon: a Domain is needed",
        ),
        (
            lambda polygon: next(solve_adaptive(polygon.mesh(1.0), Problem())),
            "problem is of the type Domain: a Problem is needed",
        ),
        (
            lambda polygon: next(solve_in_time(polygon.mesh(1.0), Problem(), end=1.0, steps=1)),
            "problem is of the type Domain: a Problem is needed",
        ),
        (
            lambda polygon: Solver(polygon.mesh(1.0), Problem()),
            "problem is of the type Domain: a Problem is needed",
        ),
    ],
)
def test_arguments_that_have_changed_places(swapped, said: str):
    assert fails_alike(swapped, Polygon(RECTANGLE, LABELS)) == said


def test_every_exterior_facet_has_one_part():
    domain = Polygon(RECTANGLE, LABELS).mesh(0.3)
    exterior = dolfinx.mesh.exterior_facet_indices(domain.mesh.topology)
    assert np.array_equal(np.sort(exterior), domain.tags.indices)
    together = np.concatenate([domain.facets(part) for part in PARTS.values()])
    assert np.array_equal(np.sort(together), domain.tags.indices)
    assert domain.mesh.topology.index_map(2).num_ghosts == 0


@pytest.mark.parametrize("size", [0.25, 2.0])
@pytest.mark.parametrize("turn", [1, -1])
def test_arcs_are_cut_into_equal_facets(size: float, turn: int):
    """A half disk in n facets has the area (n/2) sin(π/n); they stay as near as is promised."""
    ends = [[-1, 0], [1, 0]][::turn]
    polygon = Polygon.with_arcs(ends, ["contact", "dirichlet"], {1: [0, 1]}, size)
    n = len(polygon.vertices) - 1
    assert n == (13 if size == 0.25 else 12)
    assert polygon.boundary == ("contact", *["dirichlet"] * n)
    assert polygon.vertices[:2].tolist() == ends
    facet, far = 2 * np.sin(np.pi / 2 / n), 1 - np.cos(np.pi / 2 / n)
    assert facet <= size and far <= facet / 30 and far <= 0.01
    domain = polygon.mesh(size)
    assert area(domain) == pytest.approx(n / 2 * np.sin(np.pi / n), rel=1e-12)
    assert lengths(domain) == pytest.approx([2, n * facet, 0], rel=1e-12)


def test_an_arc_may_be_more_than_half_a_circle_and_hollow():
    """The unit disk without its part above y = 0.6, and that part as a bay of a rectangle."""
    ends, labels = [[-0.8, 0.6], [0.8, 0.6]], ["contact", "dirichlet"]
    disk = Polygon.with_arcs(ends, labels, {1: [0, -1]}, 0.01)
    area = np.pi - np.arccos(0.6) + 0.6 * 0.8
    x, y = disk.vertices.T
    assert 0.5 * abs(np.sum(x * np.roll(y, -1) - y * np.roll(x, -1))) == pytest.approx(area, 1e-4)
    assert np.hypot(x, y) == pytest.approx(1, abs=1e-14)
    bay = Polygon.with_arcs([*ends, [0.8, 2], [-0.8, 2]], LABELS, {0: [0, 1]}, 0.1)
    assert bay.vertices[:, 1].max() == 2 and np.hypot(*bay.vertices[1:-3].T) == pytest.approx(1)


def test_a_round_hole():
    hole = Polygon.circle([0.3, 0.5], 0.2, "neumann", 0.5)
    domain = Polygon(RECTANGLE, LABELS, holes=(hole,)).mesh(0.5)
    assert area(domain) == pytest.approx(2 - 12 * 0.04 * np.sin(np.pi / 12), rel=1e-12)
    assert lengths(domain)[2] == pytest.approx(2 + 48 * 0.2 * np.sin(np.pi / 24), rel=1e-12)


@pytest.mark.parametrize(
    "arcs, size, message",
    [
        ({2: [0, 1]}, 0.5, r"arc of edge 2: no circle passes through \(1, 1\), \(0, 1\) and"),
        ({2: [1, 1]}, 0.5, "arc of edge 2: no circle"),
        ({4: [0, 2]}, 0.5, "there is no edge 4: they are 0 to 3"),
        ({2: [0, -0.1]}, 0.5, "edge 0 crosses edge 2$"),
        ({2: [0, 0.5], 0: [0, 0.5]}, 2.0, "the point of edge 0 at .* same point as the point of"),
        ({2: [0, 2]}, 1e-5, "at the size 1e-05 it has more than 2000 facets"),
        ({2: [0, np.inf]}, 0.5, "arc of edge 2: a point"),
        ({2: [0, 2]}, 0.0, "size is 0.0: a positive number"),
    ],
)
def test_bad_arcs(arcs, size, message):
    with pytest.raises(InputError, match=message):
        Polygon.with_arcs(RECTANGLE, LABELS, arcs, size)


def test_holes_are_cut_out():
    hole = Polygon(SQUARE, ["neumann", "contact", "neumann", "neumann"])
    domain = Polygon(RECTANGLE, LABELS, (hole,)).mesh(0.2)
    assert area(domain) == pytest.approx(2 - 0.25)
    assert lengths(domain) == pytest.approx([2.5, 2, 3.5])


def test_vertices_are_mesh_vertices():
    vertices = [[-1, 0], [0.3, 0], [1, 0], [1, 1], [-1, 1]]
    domain = Polygon(vertices, ["contact", "neumann", "dirichlet", "dirichlet", "dirichlet"]).mesh(
        0.4
    )
    x = domain.mesh.geometry.x[:, :2]
    near = [np.abs(x - v).max(axis=1).min(initial=9.0) for v in vertices]
    assert np.min(COMM.allgather(near), axis=0) == pytest.approx(0, abs=1e-14)
    assert lengths(domain) == pytest.approx([1.3, 4, 0.7])


@pytest.mark.parametrize("size", [0.1, 0.25, 0.5, 1.0])
def test_short_edges_get_a_facet_and_angles_stay_away_from_zero(size: float):
    vertices = [[-1, 0], [0, 0], [0.01, 0], [1, 0], [1, 1], [-1, 1]]
    labels = ["contact", "neumann", "contact", "dirichlet", "dirichlet", "dirichlet"]
    domain = Polygon(vertices, labels).mesh(size)
    assert counts(domain)[2] == 1
    assert smallest_angle(domain.mesh) > 20


def test_triangles_grow_away_from_short_edges():
    """A disk with 120 corners at the size of its radius: far fewer cells than if all were small."""
    angle = 2 * np.pi * np.arange(120) / 120
    labels = ["contact", "dirichlet"] * 60
    domain = Polygon(np.stack([np.cos(angle), np.sin(angle)], axis=1), labels).mesh(1.0)
    assert area(domain) == pytest.approx(60 * np.sin(np.pi / 60))
    assert counts(domain) == [60, 60, 0]
    assert domain.mesh.topology.index_map(2).size_global < 1000  # 2600 equilateral ones
    assert smallest_angle(domain.mesh) > 20


def test_triangles_are_well_shaped():
    assert smallest_angle(Polygon(RECTANGLE, LABELS).mesh(0.1).mesh) > 35


def test_the_same_polygon_gives_the_same_mesh():
    polygon = Polygon(RECTANGLE, LABELS)
    a, b = (polygon.mesh(0.2, MPI.COMM_SELF).mesh.geometry.x for _ in range(2))
    assert np.array_equal(a, b)
    assert len(set(COMM.allgather(a.tobytes()))) == 1


@pytest.mark.parametrize("size", [0.1, 0.3, 1.0])
def test_every_rank_gets_its_share(size: float):
    cells = Polygon(RECTANGLE, LABELS).mesh(size).mesh.topology.index_map(2)
    fair = cells.size_global / COMM.size
    assert abs(cells.size_local - fair) < 2 + np.log2(COMM.size)


@pytest.mark.parametrize("parts", [1, 2, 3, 4, 7, 12])
def test_parts_are_even_and_compact(parts: int):
    points = np.stack(np.meshgrid(np.arange(24.0), np.arange(12.0)), axis=-1).reshape(-1, 2)
    part = bisect(points, parts)
    sizes = np.bincount(part, minlength=parts)
    assert len(sizes) == parts
    assert np.ptp(sizes) <= 2
    extents = [np.ptp(points[part == i], axis=0) + 1 for i in range(parts)]
    assert sum(extent.prod() for extent in extents) <= 1.5 * len(points)


def test_more_parts_than_points():
    assert sorted(bisect(np.eye(3), 8)) == sorted(set(bisect(np.eye(3), 8)))


@pytest.mark.parametrize(
    ("vertices", "labels", "message"),
    [
        ([[0, 0], [1, 0]], ["contact", "dirichlet"], "2 vertices: a polygon has at least 3"),
        ([[0, 0], [1, 0], [0, 1]], ["contact", "dirichlet"], "2 boundary labels for 3 edges"),
        ([[0, 0], [1, 0], [0, np.nan]], LABELS[:3], "vertex 2 is (0, nan)"),
        ([[0, 0], [1, 0], [0, np.inf]], LABELS[:3], "vertex 2 is (0, inf)"),
        ([[0, 0], [1, 0], [0, "a"]], LABELS[:3], "[x, y] pairs"),
        ([[0, 0, 0], [1, 0, 0], [0, 1, 0]], LABELS[:3], "[x, y] pairs"),
        ([[0, 0], [1, 0], [0]], LABELS[:3], "[x, y] pairs"),
        ([[0, 0], [1, 0], [0, 1]], ["contact", "glue", "neumann"], "edge 1 is labelled 'glue'"),
        ([[0, 0], [1, 0], [0, 1]], ["contact", ["a"], "neumann"], "edge 1 is labelled ['a']"),
        ([[0, 0], [1, 0], [1, 0], [0, 1]], LABELS, "vertex 1 at (1, 0) is the same point as"),
        ([[0, 0], [1, 0], [0, 1], [0, 0]], LABELS, "vertex 0 at (0, 0) is the same point as"),
        ([[0, 0], [1, 1], [1, 0], [0, 1]], LABELS, "edge 0 crosses edge 2"),
        ([[0, 0], [2, 0], [2, 1], [1, 0], [0, 1]], [*LABELS, "neumann"], "lies on edge 0"),
        ([[0, 0], [1, 0], [2, 0]], LABELS[:3], "lies on edge"),
        ([[0, 0], [1, 0], [0.5, 0], [0.5, 1]], LABELS, "lies on edge"),
    ],
)
def test_bad_polygons(vertices, labels, message):
    assert message in fails_alike(Polygon, vertices, labels)


def test_unknown_labels_name_the_allowed_ones():
    message = fails_alike(Polygon, RECTANGLE, [*LABELS[:3], "free"])
    assert all(name in message for name in PARTS)


@pytest.mark.parametrize(
    ("holes", "message"),
    [
        ([np.array(SQUARE) + 5], "hole 0 lies outside"),
        ([np.add(SQUARE, [0, 0.5])], "crosses"),
        ([np.add(SQUARE, [0, 0.25])], "lies on edge"),
        ([SQUARE, np.array(SQUARE) + 0.1], "crosses"),
        ([SQUARE, 0.5 + 0.5 * (np.array(SQUARE) - 0.5)], "hole 1 lies inside hole 0"),
        ([0.5 + 0.5 * (np.array(SQUARE) - 0.5), SQUARE], "hole 0 lies inside hole 1"),
        ([SQUARE, SQUARE], "is the same point as"),
        ([[[-2, -1], [2, -1], [2, 2], [-2, 2]]], "hole 0 lies outside"),
        ([SQUARE, np.add(SQUARE, [5, 0])], "hole 1 lies outside"),
    ],
)
def test_bad_holes(holes, message):
    holes = [Polygon(hole, ["neumann"] * 4) for hole in holes]
    assert message in fails_alike(Polygon, RECTANGLE, LABELS, holes)


def test_many_edges_and_many_holes_are_looked_at_or_refused():
    """A hole in one of two thousand is found, by its number; no list of edges has no end."""
    small = 0.2 * np.array([[1, 0], [0, 1], [-1, 0], [0, -1]])
    places = [np.array([i, j]) for i in range(1, 46) for j in range(1, 46)]
    around = np.array([[0, 0], [46, 0], [46, 46], [0, 46.0]])
    loops = [around, *(place + small for place in places)]
    check_loops(loops)
    with pytest.raises(InputError, match="hole 2025 lies inside hole 1000"):
        check_loops([*loops, places[1000] + 0.5 * small])
    turn = np.linspace(0, 2 * np.pi, 100_002)[1:]
    with pytest.raises(InputError, match="there are 100001 edges; 100000 are allowed"):
        check_loops([np.stack([np.cos(turn), np.sin(turn)], axis=1)])


@pytest.mark.slow
def test_a_hole_that_gmsh_does_not_see():
    """It would be filled, or its points be one, which DOLFINx would not survive."""
    hole = Polygon.circle((0.5, 0.5), 1e-11, "neumann", 0.4)
    polygon = Polygon(RECTANGLE, LABELS, [hole])
    assert "gmsh could not triangulate the polygon, 2 across" in fails_alike(polygon.mesh, 0.4)


def test_close_but_apart_is_fine():
    Polygon([[0, 0], [2, 0], [2, 1], [1, 1e-6], [0, 1]], [*LABELS, "neumann"])
    Polygon(np.array(RECTANGLE) * 1e-7 + 1, LABELS)


@pytest.mark.parametrize("missing", ["contact", "dirichlet"])
def test_parts_that_must_be_there(missing: str):
    labels = [label if label != missing else "neumann" for label in LABELS]
    assert f"no edge is labelled '{missing}'" in fails_alike(Polygon(RECTANGLE, labels).mesh, 0.5)


def test_a_name_that_no_edge_has_is_refused():
    """Else its condition would be none, and the default would hold where it was meant."""
    labels = ("contact", "neumann", "dirichlet", "neumann")
    polygon = Polygon(RECTANGLE, labels, names=("roof",))
    assert "no edge is labelled 'roof', which is one of the names" in fails_alike(polygon.mesh, 0.5)
    hole = Polygon([[0.4, 0.4], [0.6, 0.4], [0.5, 0.6]], ("roof",) * 3, names=("roof",))
    around = Polygon(RECTANGLE, labels, holes=(hole,), names=("roof",))
    assert "roof" in around.mesh(0.5).parts


@pytest.mark.parametrize("unit", [2.0**-40, 1e-12, 1e-13, 1e-25, 1e12, 1e22, 2.0**80, 1e25])
def test_a_polygon_is_cut_as_finely_in_any_unit(unit):
    """Powers of two give the same mesh to the digit; others round coordinates."""
    corners = np.array([[0.0, 0.0], [2.0, 0.0], [2.0, 1.0], [0.0, 1.0]])
    labels = ["contact", "neumann", "dirichlet", "neumann"]
    usual, scaled = (Polygon(u * corners, labels).mesh(0.1 * u) for u in (1.0, unit))
    cells = [domain.mesh.topology.index_map(2).size_global for domain in (usual, scaled)]
    assert cells[1] == pytest.approx(cells[0], rel=0.03)
    if np.frexp(unit)[0] == 0.5:
        assert np.array_equal(scaled.mesh.geometry.x, unit * usual.mesh.geometry.x)
    assert area(scaled) == pytest.approx(2.0 * unit**2, rel=1e-12)


@pytest.mark.parametrize("size", [0, -1, np.nan, np.inf, 1e-12, 1e-4])
def test_bad_sizes(size: float):
    assert f"size is {size}" in fails_alike(Polygon(RECTANGLE, LABELS).mesh, size)


@pytest.mark.parametrize("size", [Fraction(1, 2), np.float32(0.5), np.float16(0.5)])
def test_sizes_may_be_numbers_of_any_kind(size) -> None:
    polygon = Polygon(RECTANGLE, LABELS)
    assert np.array_equal(polygon.mesh(size).mesh.geometry.x, polygon.mesh(0.5).mesh.geometry.x)
    for radius in (Fraction(1, 3), np.float32(1 / 3)):
        given = Polygon.circle((0, 0), radius, "contact", size).vertices
        usual = Polygon.circle((0, 0), float(radius), "contact", 0.5).vertices
        assert np.array_equal(given, usual)
    arcs = [Polygon.with_arcs(RECTANGLE, LABELS, {2: (0, 2)}, each) for each in (size, 0.5)]
    assert np.array_equal(arcs[0].vertices, arcs[1].vertices)
    squares = structured(polygon, 4 * size, shift=size / 4, jitter=size / 8)
    usual = structured(polygon, 2, shift=0.125, jitter=0.0625)
    assert np.array_equal(squares.mesh.geometry.x, usual.mesh.geometry.x)


@pytest.mark.parametrize("size", [10**400, Fraction(10) ** 400])
def test_a_size_that_is_no_float_is_refused(size) -> None:
    assert "size is larger than 1.8e+308" in fails_alike(Polygon(RECTANGLE, LABELS).mesh, size)
    with pytest.raises(InputError, match="the radius is of the type str: a number is needed"):
        Polygon.circle((0, 0), "1", "contact", 0.5)


def test_a_gmsh_session_of_the_users_own_goes_on():
    gmsh = pytest.importorskip("gmsh")
    gmsh.initialize(argv=[], interruptible=False)
    try:
        gmsh.option.setNumber("General.Terminal", 0)
        gmsh.option.setNumber("Mesh.MeshSizeMax", 0.7)
        gmsh.model.add("mine")
        gmsh.model.geo.addPoint(0, 0, 0)
        gmsh.model.geo.synchronize()
        assert area(Polygon(RECTANGLE, LABELS).mesh(0.5)) == pytest.approx(2)
        assert gmsh.isInitialized()
        assert gmsh.model.getCurrent() == "mine"
        assert len(gmsh.model.getEntities(0)) == 1
        assert gmsh.option.getNumber("Mesh.MeshSizeMax") == 0.7
    finally:
        gmsh.finalize()


# gmsh files


def write_gmsh(path: Path, curves: dict[str, list[int]], **options) -> None:
    """The unit square from gmsh: edges are 0 (below), 1 (right), 2 (above), 3 (left)."""
    import gmsh

    gmsh.initialize(argv=[], readConfigFiles=False, interruptible=False)
    try:
        gmsh.option.setNumber("General.Terminal", 0)
        geo = gmsh.model.geo
        corners = [(0, 0), (1, 0), (1, 1), (0, 1)]
        points = [geo.addPoint(x, y, options.get("slope", 0) * x, 0.5) for x, y in corners]
        lines = [geo.addLine(a, b) for a, b in itertools.pairwise([*points, points[0]])]
        inner = []
        if options.get("wall"):
            middle = [geo.addPoint(x, 0.5, 0, 0.5) for x in (0.25, 0.75)]
            inner = [geo.addLine(*middle)]
        surface = geo.addPlaneSurface([geo.addCurveLoop(lines)])
        geo.synchronize()
        if inner:
            gmsh.model.mesh.embed(1, inner, 2, surface)
        for name, members in curves.items():
            group = [(lines + inner)[i] for i in members]
            gmsh.model.addPhysicalGroup(1, group, name=name)
        if options.get("surface", True):
            gmsh.model.addPhysicalGroup(2, [surface], name="inside")
        if options.get("quadrilaterals"):
            gmsh.model.mesh.setRecombine(2, surface)
        if options.get("solid"):
            geo.extrude([(2, surface)], 0, 0, 1)
            geo.synchronize()
            gmsh.model.addPhysicalGroup(3, [1])
            gmsh.model.mesh.generate(3)
        else:
            gmsh.model.mesh.generate(2)
        gmsh.model.mesh.setOrder(options.get("order", 1))
        gmsh.option.setNumber("Mesh.MshFileVersion", options.get("version", 4.1))
        gmsh.option.setNumber("Mesh.Binary", options.get("binary", 0))
        gmsh.write(str(path))
    finally:
        gmsh.finalize()


CURVES = {"Contact": [0], "DIRICHLET": [1, 3]}


@pytest.mark.parametrize("version", [2.2, 4.1])
@pytest.mark.parametrize("binary", [0, 1])
def test_gmsh_formats(shared_tmp_path: Path, version: float, binary: int):
    path = shared_tmp_path / "square.msh"
    on_root(COMM, lambda: write_gmsh(path, CURVES, version=version, binary=binary))
    domain = read_gmsh(path)
    assert lengths(domain) == pytest.approx([1, 2, 1])  # above: in no group, so Neumann
    assert area(domain) == pytest.approx(1)


@pytest.mark.parametrize("name", ["signorini.msh", "signorini-2.2.msh"])
def test_ready_meshes(name: str):
    domain = read_gmsh(MESHES / name)
    contact, dirichlet, neumann = lengths(domain)
    facets = counts(domain)[1]
    assert (contact, neumann) == pytest.approx((2, 0))
    # a polygon in the half circle, its sides equally long
    assert dirichlet == pytest.approx(2 * facets * np.sin(np.pi / 2 / facets))
    assert area(domain) == pytest.approx(facets / 2 * np.sin(np.pi / facets))


@pytest.mark.parametrize(
    ("curves", "options", "message"),
    [
        ({"floor": [0], "dirichlet": [1]}, {}, "no physical curve is named 'contact'"),
        ({"floor": [0], "dirichlet": [1]}, {}, "are: floor, dirichlet"),
        ({"contact": [0]}, {}, "no physical curve is named 'dirichlet'"),
        ({}, {}, "are: none"),
        (CURVES, {"surface": False}, "no triangles"),
        (CURVES, {"quadrilaterals": True}, "Quadrilateral"),
        (CURVES, {"order": 2}, "'Triangle 6'"),
        (CURVES, {"solid": True}, "three dimensions"),
        (CURVES, {"slope": 1}, "does not lie in the x-y plane"),
        ({"contact": [0, 1], "dirichlet": [1, 2]}, {}, "belongs to contact and to dirichlet"),
        ({**CURVES, "neumann": [4]}, {"wall": True}, "labelled neumann but lies inside"),
    ],
)
def test_bad_gmsh_files(shared_tmp_path: Path, curves, options, message):
    path = shared_tmp_path / "bad.msh"
    on_root(COMM, lambda: write_gmsh(path, curves, **options))
    found = fails_alike(read_gmsh, path)
    assert message in found
    assert str(path) in found


@pytest.mark.parametrize("keep", [0, 8, 200, 0.6])
@pytest.mark.parametrize("version", [2.2, 4.1])
@pytest.mark.parametrize("binary", [0, 1])
def test_cut_off_gmsh_files(shared_tmp_path: Path, keep: float, version: float, binary: int):
    path = shared_tmp_path / "cut.msh"

    def write() -> None:
        write_gmsh(path, CURVES, version=version, binary=binary)
        whole = path.read_bytes()
        path.write_bytes(whole[: keep if isinstance(keep, int) else int(keep * len(whole))])

    on_root(COMM, write)
    assert str(path) in fails_alike(read_gmsh, path)


@pytest.mark.parametrize(
    "content", [b"", b"hello", b"\xc3\x28\xff\x00" * 99, b"$MeshFormat\n1 0 8"]
)
def test_files_that_are_no_meshes(shared_tmp_path: Path, content: bytes):
    path = shared_tmp_path / "no.msh"
    on_root(COMM, lambda: path.write_bytes(content) and None)
    assert str(path) in fails_alike(read_gmsh, path)


def test_missing_files_and_folders(shared_tmp_path: Path):
    assert "No such file" in fails_alike(read_gmsh, shared_tmp_path / "nowhere.msh")
    assert "directory" in fails_alike(read_gmsh, shared_tmp_path)


def write_text_mesh(
    path: Path,
    nodes: list[str],
    elements: list[str],
    names: tuple[str, str] = ("contact", "dirichlet"),
) -> None:
    """A gmsh file with two curves of such names; elements get their numbers here."""
    numbered = [f"{i} {element}" for i, element in enumerate(elements, start=1)]
    sections = {
        "MeshFormat": ["2.2 0 8"],
        "PhysicalNames": ["2", *(f'1 {i} "{name}"' for i, name in enumerate(names, 1))],
        "Nodes": [f"{len(nodes)}", *nodes],
        "Elements": [f"{len(numbered)}", *numbered],
    }
    lines = [x for name, rows in sections.items() for x in (f"${name}", *rows, f"$End{name}")]
    on_root(COMM, lambda: path.write_text("\n".join(lines) + "\n") and None)


def test_pieces_that_nothing_holds(shared_tmp_path: Path):
    """What holds one is known with the conditions, which a reaction makes up for."""
    path = shared_tmp_path / "pieces.msh"
    nodes = ["1 0 0 0", "2 1 0 0", "3 0 1 0", "4 2 0 0", "5 3 0 0", "6 2 1 0"]
    elements = ["1 2 1 1 1 2", "1 2 2 2 2 3", "2 2 3 3 1 2 3", "2 2 3 3 4 5 6"]
    write_text_mesh(path, nodes, elements)
    domain = read_gmsh(path, MPI.COMM_SELF)
    for problem in (Problem(), Problem(f=-1.0)):
        with pytest.raises(InputError, match=r"around \(2.33333, 0.333333\) has no Dirichlet"):
            solve(problem, domain)
    held = solve(Problem(reaction=1.0, f=3.0), domain).u.x.array
    assert np.sort(held)[-3:] == pytest.approx(3.0)


def test_pieces_of_a_mesh_whose_curves_have_names_of_their_own(shared_tmp_path: Path):
    """What holds them, the conditions say; `vi.floating` asks these."""
    path = shared_tmp_path / "own.msh"
    nodes = ["1 0 0 0", "2 1 0 0", "3 0 1 0", "4 2 0 0", "5 3 0 0", "6 2 1 0"]
    elements = ["1 2 1 1 1 2", "1 2 2 2 4 5", "2 2 3 3 1 2 3", "2 2 3 3 4 5 6"]
    write_text_mesh(path, nodes, elements, ("floor", "walls"))
    domain = read_gmsh(path, names=["floor", "walls"])
    found = [COMM.allreduce(len(domain.facets(part))) for part in domain.parts.values()]
    assert found == [0, 0, 4, 1, 1]


@pytest.mark.parametrize("stray", [2, 9], ids=["among the nodes", "behind them"])
def test_a_labelled_facet_of_no_triangle(shared_tmp_path: Path, stray: int):
    """The node in the air is no corner of the triangle 1, 3, 4, whatever its number."""
    path = shared_tmp_path / "stray.msh"
    nodes = ["1 0 0 0", "3 1 0 0", "4 0 1 0", f"{stray} 5 5 0"]
    elements = [f"1 2 1 1 1 {stray}", "1 2 2 2 3 4", "2 2 3 3 1 3 4"]
    write_text_mesh(path, nodes, elements)
    said = fails_alike(read_gmsh, path)
    assert "from (0, 0) to (5, 5) is labelled contact but is no side of a triangle" in said


# users' own meshes


def tagged_rectangle(mode, n: int = 4, values=(7, 5, 9)) -> tuple:
    """(-1, 1) × (0, 1), tagged on y = 0, at the sides and above."""
    mesh = dolfinx.mesh.create_rectangle(COMM, [[-1, 0], [1, 1]], [2 * n, n], ghost_mode=mode)

    def labels(x, y):
        below, above = np.isclose(y, 0), np.isclose(y, 1)
        return np.where(below, values[0], np.where(above, values[2], values[1]))

    return mesh, tagged(mesh, labels)


@pytest.mark.parametrize("mode", list(dolfinx.mesh.GhostMode))
@pytest.mark.parametrize("neumann", [None, 9, [9, 10]])
def test_own_tags(mode, neumann):
    mesh, tags = tagged_rectangle(mode)
    domain = Domain.from_tags(mesh, tags, contact=7, dirichlet=[5], neumann=neumann)
    assert domain.mesh is mesh
    assert lengths(domain) == pytest.approx([2, 2, 2])
    assert counts(domain) == [8, 8, 8]


def test_own_tags_by_several_values():
    mesh, tags = tagged_rectangle(dolfinx.mesh.GhostMode.none)
    domain = Domain.from_tags(mesh, tags, contact=[7], dirichlet=(5, 9))
    assert lengths(domain) == pytest.approx([2, 4, 0])


def test_single_precision_is_refused():
    mesh = dolfinx.mesh.create_unit_square(MPI.COMM_WORLD, 2, 2, dtype=np.float32)
    tags = dolfinx.mesh.meshtags(mesh, 1, np.arange(2, dtype=np.int32), np.ones(2, np.int32))
    assert "float64 is needed" in fails_alike(lambda: Domain.from_tags(mesh, tags))


def test_own_tags_that_do_not_fit():
    mesh, tags = tagged_rectangle(dolfinx.mesh.GhostMode.shared_facet)

    def take(**parts) -> Domain:
        return Domain.from_tags(mesh, tags, **parts)

    message = fails_alike(lambda: take(contact=1, dirichlet=5))
    assert "no exterior facet is tagged contact (value 1)" in message
    assert "5, 7, 9" in message
    assert "tagged dirichlet (value 2)" in fails_alike(lambda: take(contact=7))
    both = fails_alike(lambda: take(contact=[7, 5], dirichlet=5))
    assert "the facet value 5 stands for contact and for dirichlet" in both
    cells = dolfinx.mesh.meshtags(mesh, 2, np.array([], dtype=np.int32), 1)
    assert "dimension 2" in fails_alike(lambda: Domain.from_tags(mesh, cells))
    inside = dolfinx.mesh.locate_entities(mesh, 1, lambda x: np.isclose(x[1], 0.5))
    wall = dolfinx.mesh.meshtags(mesh, 1, inside, np.full(len(inside), 1, dtype=np.int32))
    assert "inside the domain" in fails_alike(lambda: Domain.from_tags(mesh, wall))
    assert "between two cells is contact" in fails_alike(lambda: Domain(mesh, wall))


def test_own_meshes_that_are_none():
    mesh = dolfinx.mesh.create_unit_square(COMM, 2, 2)
    assert "facet_tags is of the type NoneType" in fails_alike(Domain.from_tags, mesh, None)
    assert "mesh is of the type str" in fails_alike(Domain.from_tags, "mesh.msh", None)


def test_own_quadrilaterals():
    mesh = dolfinx.mesh.create_unit_square(
        COMM, 2, 2, cell_type=dolfinx.mesh.CellType.quadrilateral
    )
    tags = dolfinx.mesh.meshtags(mesh, 1, np.array([], dtype=np.int32), 1)
    assert "quadrilateral" in fails_alike(lambda: Domain.from_tags(mesh, tags))


def test_own_surfaces_in_space():
    x = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 1]], dtype=np.float64)
    root = COMM.rank == 0
    mesh = dolfinx.mesh.create_mesh(
        COMM,
        cells=np.arange(3 if root else 0, dtype=np.int64).reshape(-1, 3),
        x=x if root else x[:0],
        e=basix.ufl.element("Lagrange", "triangle", 1, shape=(3,)),
        partitioner=stay,
    )
    mesh.topology.create_entities(1)
    tags = dolfinx.mesh.meshtags(mesh, 1, np.array([], dtype=np.int32), 1)
    assert "3 dimensions" in fails_alike(lambda: Domain.from_tags(mesh, tags))


@pytest.mark.parametrize("dim", [2, 3])
def test_thinness_is_the_longest_side_by_the_least_height(dim: int) -> None:
    """Heights are distances from the planes through the other corners, by least squares."""
    random = np.random.default_rng(dim)
    for corners in random.normal(size=(20, dim + 1, dim)) * [1.0, 0.01, 30.0][:dim]:
        heights = []
        for i, apex in enumerate(corners):
            base = np.delete(corners, i, axis=0)
            spans, way = (base[1:] - base[0]).T, apex - base[0]
            heights.append(np.linalg.norm(way - spans @ np.linalg.lstsq(spans, way)[0]))
        longest = max(np.linalg.norm(a - b) for a, b in itertools.combinations(corners, 2))
        expected = longest / min(heights)
        assert thinness(corners[None]) == pytest.approx([expected], rel=1e-9)
    assert thinness(np.zeros((1, dim + 1, dim))) == np.inf


@pytest.mark.parametrize(
    "squeezed, told", [(1e-7, "e+07 times as long as it is high"), (0.0, "has no ")]
)
@pytest.mark.parametrize("dim", [2, 3])
def test_own_cells_that_are_too_thin(squeezed: float, told: str, dim: int) -> None:
    """Some diagonals of their matrices would be 0 or negative."""
    make = dolfinx.mesh.create_unit_square if dim == 2 else dolfinx.mesh.create_unit_cube
    mesh = make(COMM, *[2] * dim)
    mesh.geometry.x[:, 1] *= squeezed
    tags = dolfinx.mesh.meshtags(mesh, dim - 1, np.array([], dtype=np.int32), 1)
    said = fails_alike(lambda: Domain.from_tags(mesh, tags))
    assert said.startswith(f"the {('triangle', 'tetrahedron')[dim - 2]} at (")
    assert told in said


@pytest.mark.parametrize("dim", [2, 3])
def test_own_meshes_that_are_too_small(dim: int) -> None:
    """Products of lengths would be 0, and intervals of means wrong, from some 1e-42 on."""
    make = dolfinx.mesh.create_unit_square if dim == 2 else dolfinx.mesh.create_unit_cube
    mesh = make(COMM, *[2] * dim)
    mesh.geometry.x[:] *= 1e-40
    tags = dolfinx.mesh.meshtags(mesh, dim - 1, np.array([], dtype=np.int32), 1)
    assert "is 5e-41 long: lengths from 1e-30 on" in fails_alike(Domain.from_tags, mesh, tags)
    polygon = Polygon([(0, 0), (1e-40, 0), (0, 1e-40)], ["contact", "dirichlet", "neumann"])
    assert "lengths from 1e-30 on are possible" in fails_alike(polygon.mesh, 1e-40)


@pytest.mark.parametrize("wrong", [1.5, "1", True, 2**40, float("nan"), [1, 2.5]])
def test_own_facet_values_that_are_none(wrong) -> None:
    mesh = dolfinx.mesh.create_unit_square(COMM, 2, 2)
    tags = dolfinx.mesh.meshtags(mesh, 1, np.array([], dtype=np.int32), 1)
    said = fails_alike(lambda: Domain.from_tags(mesh, tags, contact=wrong))
    assert said == f"contact is {wrong!r}: facet values are whole numbers of 32 bits"


def with_cell_tags(materials: object, *, beyond: int = 0, **more: object) -> Domain:
    """Two layers, with the values 5 and 9 in the tags of cells; the last rank has more, perhaps."""
    mesh, tags = tagged_rectangle(dolfinx.mesh.GhostMode.none)
    size = mesh.topology.index_map(2).size_local
    of_cells = np.where(dolfinx.mesh.compute_midpoints(mesh, 2, np.arange(size))[:, 1] > 0.5, 9, 5)
    more_of_it = beyond if COMM.rank == COMM.size - 1 else 0
    cells = np.arange(size + more_of_it, dtype=np.int32)
    values = np.append(of_cells, [9] * more_of_it).astype(np.int32)
    given = {"cell_tags": dolfinx.mesh.meshtags(mesh, 2, cells, values)} | more
    return Domain.from_tags(mesh, tags, contact=7, dirichlet=5, materials=materials, **given)


@pytest.mark.parametrize("value", [9, np.int32(9), np.int64(9), [9], (9,), np.array([9]), [[9]]])
def test_own_cell_values_are_taken_as_those_of_facets(value) -> None:
    domain = with_cell_tags({"rock": value})
    size = domain.mesh.topology.index_map(2).size_local
    y = dolfinx.mesh.compute_midpoints(domain.mesh, 2, np.arange(size))[:, 1]
    assert np.array_equal(domain.materials.where("rock")[:size], y > 0.5)


@pytest.mark.parametrize("wrong", [9.0, "9", None, True, 2**40, [9, 2.5], [[9], [5, 9]]])
def test_own_cell_values_that_are_none(wrong) -> None:
    said = fails_alike(with_cell_tags, {"rock": wrong})
    assert said == f"rock is {wrong!r}: cell values are whole numbers of 32 bits"


def test_own_cell_tags_that_are_none() -> None:
    assert "materials is of the type list" in fails_alike(with_cell_tags, ["rock"])
    assert "cell_tags is of the type str" in fails_alike(
        lambda: with_cell_tags({"rock": 9}, cell_tags="x")
    )


def test_own_cell_tags_of_another_mesh_on_one_rank() -> None:
    said = fails_alike(lambda: with_cell_tags({"rock": 9}, beyond=3))
    assert f"of rank {COMM.size - 1}, which has" in said and "tags of this mesh" in said


def test_own_facet_tags_of_another_mesh_on_one_rank() -> None:
    mesh = dolfinx.mesh.create_unit_square(COMM, 4, 4)
    facets = dolfinx.mesh.locate_entities_boundary(mesh, 1, lambda x: x[1] < 1e-9)
    if COMM.rank == COMM.size - 1:
        facets = np.append(facets, 9999).astype(np.int32)
    tags = dolfinx.mesh.meshtags(mesh, 1, facets, np.ones(len(facets), dtype=np.int32))
    said = fails_alike(lambda: Domain.from_tags(mesh, tags, contact=1))
    assert "facet 9999 is tagged" in said and "tags of this mesh are needed" in said


@pytest.mark.parametrize("dim", [2, 3])
def test_own_meshes_that_are_folded(dim: int) -> None:
    """A vertex is drawn out of the mesh: some of its cells come to lie over others."""
    make = dolfinx.mesh.create_unit_square if dim == 2 else dolfinx.mesh.create_unit_cube
    mesh = make(COMM, *[4] * dim)
    tags = dolfinx.mesh.meshtags(mesh, dim - 1, np.array([], dtype=np.int32), 1)
    with pytest.raises(InputError, match="no exterior facet is tagged"):  # after all else
        Domain.from_tags(mesh, tags)
    x = mesh.geometry.x
    x[np.isclose(x[:, :dim], 0.25).all(axis=1), :dim] = 9.0
    assert "both lie on the same side of it" in fails_alike(Domain.from_tags, mesh, tags)


def test_a_polygon_that_is_too_narrow() -> None:
    polygon = Polygon([(0, 0), (1, 0), (0.5, 1e-8)], ["contact", "dirichlet", "neumann"])
    said = fails_alike(polygon.mesh, 1.0)
    assert said.startswith("the polygon is too narrow") and "1e+08 times as long" in said
    far = Polygon([(4e5, 0), (4e5 + 1, 0), (4e5 + 0.5, 1e-8)], polygon.boundary)
    assert "the triangle at (400000, 0) is" in fails_alike(far.mesh, 1.0)


def test_no_gmsh(monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, "gmsh", None)
    with pytest.raises(InputError, match="this needs gmsh, which cannot be loaded: "):
        Polygon([(0, 0), (1, 0), (0, 1)], ["contact", "dirichlet", "neumann"]).mesh(0.5)


@pytest.mark.parametrize("away", [1e6, 1e8, 1e9])
def test_a_polygon_far_from_the_origin_has_the_mesh_of_one_at_it(away: float):
    """Up to 2^50 times the size of their last digit all coordinates are exact."""
    corners = np.array([[0, 0], [2, 0], [2, 1], [0, 1]])
    stone = np.array([[0.5, 0.25], [1.0, 0.25], [1.0, 0.75]])
    near, far = (
        Polygon(corners + shift, LABELS, materials={"stone": stone + shift}).mesh(0.125)
        for shift in (np.zeros(2), np.array([away, -3.0 * away]))
    )
    points = [domain.mesh.geometry.x[:, :2] for domain in (near, far)]
    assert np.array_equal(cell_nodes(near.mesh), cell_nodes(far.mesh))
    assert np.allclose(points[1] - [away, -3.0 * away], points[0], rtol=0, atol=1e-15 * away)
    assert counts(far) == counts(near)
    assert np.array_equal(far.materials.where("stone"), near.materials.where("stone"))


@pytest.mark.parametrize("reach", [3.0, 1e9, 1e10])
@pytest.mark.parametrize("turned", [False, True])
def test_materials_that_reach_far_out_are_cut_at_the_outline(reach: float, turned: bool):
    """A strip, and all that is above a slanted line, of known areas."""
    corners = np.array([[0, 0], [1, 0], [1, 1], [0, 1]])
    strip = np.array([[-reach, 0.2], [reach, 0.2], [reach, 0.3], [-reach, 0.3]])
    above = np.array([[-0.5, 0.3], [1.5, 0.8], [1.5, reach], [-0.5, reach]])
    polygons = {"strip": strip, "above": above}
    if turned:
        polygons = {name: x[::-1, ::-1] for name, x in polygons.items()}
    domain = Polygon(corners, LABELS, materials=polygons).mesh(0.2)
    size = areas(domain.mesh)
    for name, area in (("strip", 0.1), ("above", 1 - 0.55)):
        own = size[domain.materials.where(name)[: len(size)]].sum()
        assert domain.mesh.comm.allreduce(float(own)) == pytest.approx(area, rel=1e-12)


def test_wedges_whose_edges_meet_in_one_point():
    """Every other wedge around it: half of a disk, whatever rounding makes of their points."""
    center, angles = np.array([0.37, 0.41]), 2 * np.pi * np.arange(25) / 24 + 0.1
    rim = center + 0.3 * np.column_stack([np.cos(angles), np.sin(angles)])
    wedges = {
        f"w{i}": np.array([center + 1e-14 * np.sin(i), rim[i], rim[i + 1]]) for i in range(0, 24, 2)
    }
    domain = Polygon([[0, 0], [1, 0], [1, 1], [0, 1]], LABELS, materials=wedges).mesh(0.2)
    size = areas(domain.mesh)
    own = sum(size[domain.materials.where(name)[: len(size)]].sum() for name in wedges)
    area = domain.mesh.comm.allreduce(float(own))
    assert area == pytest.approx(12 * 0.5 * 0.3**2 * np.sin(2 * np.pi / 24), rel=1e-9)


def test_materials_that_cross_too_often_are_refused():
    """Two combs of 400 teeth, laid across one another."""

    def comb(transposed: bool) -> list[list[float]]:
        teeth = [(0.05 + 0.9 * i / 800, 0.02 if i // 2 % 2 else 0.98) for i in range(800)]
        points = [(0.01, 0.99), *teeth, (0.99, 0.99)]
        return [[y, x] if transposed else [x, y] for x, y in points]

    corners = [[0, 0], [1, 0], [1, 1], [0, 1]]
    with pytest.raises(InputError, match="more than 100000 times"):
        Polygon(corners, LABELS, materials={"a": comb(False), "b": comb(True)}).mesh(0.5)


@pytest.mark.parametrize("away", [0.0, 5e6])
def test_a_material_that_reaches_out_is_cut_at_the_outline(away: float):
    """Where lines cross, far from the origin too, where a crossing is off both by rounding."""
    corners = 100.0 * np.array([[0, 0], [1, 0], [1, 1], [0, 1]]) + away
    stone = np.array([[30.3, 50.7], [400.1, 20.9], [400.1, 80.3]]) + away
    domain = Polygon(corners, LABELS, materials={"stone": stone}).mesh(10.0)
    own = domain.materials.where("stone")[: len(areas(domain.mesh))]
    area = domain.mesh.comm.allreduce(float(areas(domain.mesh)[own].sum()))
    part = (100.0 - 30.3) / (400.1 - 30.3)
    assert area == pytest.approx(0.5 * 369.8 * 59.4 * part**2, rel=1e-7)
