"""Data with which there is no problem are refused, and what rounding has made of data is not."""

import math
from collections.abc import Callable
from pathlib import Path

import dolfinx
import numpy as np
import pytest
import ufl
from dolfinx import fem
from helpers import HELD_ABOVE, tagged
from mpi4py import MPI

from signorini_cr import exact
from signorini_cr.app import cli
from signorini_cr.app.expressions import parse
from signorini_cr.data.admissible import check_data
from signorini_cr.data.consistency import doubts
from signorini_cr.errors import InputError, on_root
from signorini_cr.fem.conditions import Contact, Dirichlet, Robin
from signorini_cr.fem.pointwise import evaluate
from signorini_cr.fem.problem import Forms, Material, Problem
from signorini_cr.levels import solve, solve_levels
from signorini_cr.mesh.domain import Domain, Polygon, read_gmsh

pytestmark = pytest.mark.slow

COMM = MPI.COMM_WORLD
RECTANGLE = np.array([(-1, 0), (1, 0), (1, 1), (-1, 1)], dtype=np.float64)
ALL_ROUND = ("contact", "dirichlet", "dirichlet", "dirichlet")
ABOVE = ("contact", "neumann", "dirichlet", "neumann")
SIDES = ("contact", "dirichlet", "neumann", "dirichlet")


def refused(function: Callable[[], object]) -> str:
    """The message, the same on all ranks."""
    with pytest.raises(InputError) as caught:
        function()
    messages = set(COMM.allgather(str(caught.value)))
    assert len(messages) == 1
    return messages.pop()


def checked(problem: Problem, domain: Domain) -> None:
    check_data(Forms(problem, domain.mesh), domain)


# rounding


def test_bounds_of_rounding_cover_what_rounding_does():
    """1 − cos x near 0 is known exactly, as 2 sin²(x/2), and so is 1e8 + x − 1e8."""
    x = np.zeros((50, 3))
    x[:, 0] = np.geomspace(1e-9, 1.0, 50)
    wave = evaluate(parse("1 - cos(x)").ufl(_coordinates(2)), x)
    shift = evaluate(parse("(1e8 + x) - 1e8").ufl(_coordinates(2)), x)
    assert wave is not None and shift is not None
    for (value, bound), wanted in ((wave, 2 * np.sin(x[:, 0] / 2) ** 2), (shift, x[:, 0])):
        assert (np.abs(value - wanted) <= bound).all()
    assert wave[1].max() < 1e-15 and shift[1].max() < 1e-7
    # x is known to 1e-6, and its root at 0 to 1e-3
    at_zero = evaluate(parse("sqrt(x)").ufl(_coordinates(2)), np.zeros((1, 3)), 1e-6)
    assert at_zero is not None and 0.9e-3 < at_zero[1][0] < 1.1e-3


def _coordinates(d: int) -> ufl.SpatialCoordinate:
    mesh = dolfinx.mesh.create_unit_square(MPI.COMM_SELF, 1, 1)
    return ufl.SpatialCoordinate(mesh)


def turned(
    degrees: float, shift: float, scale: float, theta: str = "atan2(Y, X)"
) -> tuple[dict, Domain]:
    """S1's domain turned, moved and scaled, with u in its coordinates."""
    c, s = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    names: dict = {}
    for name, text in (
        ("X", f"(({c!r})*(x - ({shift!r})) + ({s!r})*(y + ({shift!r})))/{scale!r}"),
        ("Y", f"(-({s!r})*(x - ({shift!r})) + ({c!r})*(y + ({shift!r})))/{scale!r}"),
        ("r", "sqrt(X**2 + Y**2)"),
        ("theta", theta),
        ("u", "(1 - X**2)*(1 - Y**2)*r**1.5*cos(1.5*theta)"),
        # No second derivatives of r^1.5, which are not bounded
        ("f_r", "6*X*(1 - Y**2)*cos(theta/2) - 6*Y*(1 - X**2)*sin(theta/2)"),
        ("f", "2*(2 - X**2 - Y**2)*r**1.5*cos(1.5*theta) + sqrt(r)*f_r"),
    ):
        names[name] = parse(text, names)
    vertices = scale * RECTANGLE @ np.array([[c, s], [-s, c]]) + [shift, -shift]
    return names, Polygon(vertices, ALL_ROUND).mesh(0.5 * scale)


@pytest.mark.parametrize(
    ("shift", "scale"), [(0.0, 1.0), (1e6, 1.0), (0.0, 1e-9), (0.0, 1e9), (-3e6, 20.0)]
)
def test_an_exact_solution_may_be_turned_and_moved(shift: float, scale: float):
    for degrees in (0, 17, 45, 90, 123.4, 180, 271, 333):
        names, domain = turned(degrees, shift, scale)
        checked(Problem(exact=names["u"].ufl), domain)
        # u is 0.3 at most
        wrong = Problem(exact=names["u"].ufl, obstacle=3e-7)
        assert "the obstacle is 3e-07 but" in refused(lambda: checked(wrong, domain))


@pytest.mark.parametrize(("away", "size"), [(1e8, 0.25), (1e9, 0.25), (1e9, 0.06), (1e10, 0.25)])
def test_a_domain_far_from_the_origin(away: float, size: float):
    """Continuous data pass, jumps do not; where digits don't tell, that is said."""
    domain = Polygon(0.5 * RECTANGLE + away, ALL_ROUND).mesh(size)

    def steep(x):
        return (x[1] - away) ** 2 + ufl.sin(x[0] - away)

    def jumps(x):
        return ufl.conditional(x[0] > away + 0.1, 1.0, 0.0)

    checked(Problem(dirichlet=1e4, obstacle=0.0), domain)
    words = refused(lambda: checked(Problem(dirichlet=jumps, obstacle=-9.0), domain))
    if away < 1e10:
        checked(Problem(dirichlet=steep, obstacle=-9.0), domain)
        assert "the dirichlet value jumps from" in words
    else:
        assert "coordinates have too few digits" in words


@pytest.mark.parametrize(("degrees", "shift"), [(17, 0.0), (200, 0.0), (45, 1e6)])
def test_a_turned_solution_has_its_error_and_bound(degrees: float, shift: float):
    # Γ1 keeps clear of the angle's cut: with rounding, cells reach across it
    names, domain = turned(degrees, shift, 1.0, "pi/2 - atan2(X, Y)")
    *_, solution = solve_levels(Problem(f=names["f"].ufl, exact=names["u"].ufl), domain, 3)
    error, bound = solution.errors[0], solution.certificate.bound_h1
    assert error == pytest.approx(0.15, rel=0.1)  # of 0.97 in all
    assert bound is not None and error < bound < 1.2 * error


# u_D


CONTINUOUS = [
    (ABOVE, "tanh(1e8*x)"),
    (ABOVE, "tanh((x - 0.123)*1e9)"),
    (ABOVE, "abs(x)"),
    (ABOVE, "sqrt(abs(x))"),
    (ABOVE, "abs(x - 0.1)**0.2"),
    (ABOVE, "sqrt(1 - x**2)"),
    (ABOVE, "where(x < 1/3, 0, (x - 1/3)*1e5)"),
    (ABOVE, "sign(x)*x"),
    (ABOVE, "sin(300*x)"),
    (ABOVE, "where(x == 0, 0, x*sin(1/x))"),
    (ABOVE, "(x + 1e8) - 1e8"),
    (ABOVE, "1e-12*x"),
    (SIDES, "where(x < 0, 0, 1)"),  # the sides do not touch
    (ALL_ROUND, "atan2(y + 1, x)"),
]
JUMPS = [
    (ABOVE, "where(x < 0, 0, 1)", (0, 1), (0, 1)),  # at a vertex, whose value is that of the right
    (ABOVE, "where(x <= 0, 0, 1)", (0, 1), (0, 1)),  # … of the left
    (ABOVE, "sign(x)", (0, 1), (-1, 1)),  # … of neither
    (ABOVE, "where(x < 0.123, 0, 1)", (0.123, 1), (0, 1)),  # within a facet
    (ABOVE, "x + where(x < 0.3, 0, -1e-3)", (0.3, 1), (0.299, 0.3)),
    (ABOVE, "1 + 1e-6*sign(x - 0.7)", (0.7, 1), (0.999999, 1.000001)),
    (ABOVE, "sin(10*x) + where(x < 0.777, 0, 1)", (0.777, 1), (0.9964756, 1.9964756)),
    (ABOVE, "atan2(x, y - 1)", (0, 1), (-1.5707963, 1.5707963)),
    (ALL_ROUND, "where(y < 1, 0, 1)", (-1, 1), (0, 1)),  # from edge to edge
]


@pytest.mark.parametrize("size", [0.5, 0.07])
def test_continuous_values_are_taken(size: float):
    domains = {labels: Polygon(RECTANGLE, labels).mesh(size) for labels, _ in CONTINUOUS}
    for labels, u_D in CONTINUOUS:
        checked(Problem(dirichlet=parse(u_D).ufl, obstacle=-9.0), domains[labels])


@pytest.mark.parametrize("size", [0.5, 0.07])
def test_values_that_jump_are_refused(size: float):
    domains = {labels: Polygon(RECTANGLE, labels).mesh(size) for labels, *_ in JUMPS}
    for labels, u_D, place, values in JUMPS:
        problem = Problem(dirichlet=parse(u_D).ufl, obstacle=-9.0)
        message = refused(lambda: checked(problem, domains[labels]))
        words = message.replace("(", " ").replace(")", " ").replace(",", " ").replace(";", " ")
        numbers = [float(w) for w in words.split() if w.lstrip("-")[:1].isdigit()]
        assert message.startswith("data.dirichlet: at (")
        assert numbers[:2] == pytest.approx(place, abs=1e-6)
        assert sorted(numbers[2:4]) == pytest.approx(values, abs=1e-6)


def test_a_value_without_bound_is_refused():
    domain = Polygon(RECTANGLE, ABOVE).mesh(0.5)
    problem = Problem(dirichlet=lambda x: 1 / (x[0] - 0.01))
    assert "grows without bound towards (0.0" in refused(lambda: checked(problem, domain))


def test_solving_refuses_a_jump_in_two_and_three_dimensions():
    domain = Polygon(RECTANGLE, ABOVE).mesh(0.5)
    jump = Problem(dirichlet=lambda x: ufl.conditional(ufl.lt(x[0], 0.2), 0.0, 1.0))
    assert "at (0.2, 1) the dirichlet value jumps" in refused(lambda: solve(jump, domain))
    assert "jumps" in refused(lambda: list(solve_levels(jump, domain, 2)))
    mesh = dolfinx.mesh.create_unit_cube(COMM, 3, 3, 3)
    cube = marked(mesh, lambda x: np.where(np.isclose(x[:, 2], 0), 1, 2))
    assert "jumps from" in refused(lambda: solve(jump, cube))
    checked(Problem(dirichlet=lambda x: ufl.tanh(50 * x[0])), cube)


def marked(mesh, label: Callable) -> Domain:
    tdim = mesh.topology.dim
    mesh.topology.create_connectivity(tdim - 1, tdim)
    facets = dolfinx.mesh.exterior_facet_indices(mesh.topology)
    middle = dolfinx.mesh.compute_midpoints(mesh, tdim - 1, facets)
    values = label(middle).astype(np.int32)
    return Domain.from_tags(mesh, dolfinx.mesh.meshtags(mesh, tdim - 1, facets, values))


@pytest.mark.parametrize(
    ("element", "function", "fits"),
    [
        (("Lagrange", 2), lambda x: x[0] ** 2, True),
        (("Discontinuous Lagrange", 1), lambda x: x[0], True),
        (("Discontinuous Lagrange", 0), lambda x: np.where(x[0] < 0, 0.0, 1.0), False),
    ],
)
def test_functions_may_not_jump_either(element, function, fits: bool):
    mesh = dolfinx.mesh.create_rectangle(COMM, RECTANGLE[[0, 2]], [8, 4])
    domain = marked(mesh, lambda x: np.where(np.isclose(x[:, 1], 0), 1, 2))
    u_D = fem.Function(fem.functionspace(mesh, element))
    u_D.interpolate(function)
    problem = Problem(dirichlet=u_D, obstacle=-9.0)
    if fits:
        checked(problem, domain)
    else:
        assert "at (0, 1) the dirichlet value jumps from 0 to 1" in refused(
            lambda: checked(problem, domain)
        )


# κ


@pytest.mark.parametrize(
    ("rows", "words"),
    [
        ([[1, 0.5], [0.5, 1]], None),
        ([[1, 0.5], [0.5 + 1e-16, 1]], None),
        ([[1, 0.5], [0.4, 1]], "[[1, 0.5], [0.4, 1]], which is not symmetric"),
        ([[1, 0.5], [0.5 + 1e-9, 1]], "[[1, 0.5], [0.500000001, 1]], which is not symmetric"),
        ([[1, 2], [2, 1]], "[[1, 2], [2, 1]], with the eigenvalue -1"),
        ([[1, 0], [0, 0]], "[[1, 0], [0, 0]], with the eigenvalue 0"),
    ],
)
def test_tensors(rows: list, words: str | None):
    domain = Polygon(RECTANGLE, ABOVE).mesh(0.5)
    tensor = ufl.as_matrix(rows)
    constant = fem.Constant(domain.mesh, np.array(rows, dtype=np.float64))
    above = 1e-13  # x is known to so much only
    for kappa in (tensor, constant, lambda x: (1 + above * x[0]) * tensor):
        problem = Problem(f=1.0, coefficient=kappa)
        if words is None:
            checked(problem, domain)
        else:
            message = refused(lambda: solve(problem, domain))
            assert message.startswith("data.coefficient: the value at (-1, 0) is [[")
            if not callable(kappa) or isinstance(kappa, ufl.core.expr.Expr):
                assert words in message


def skew_in_a_disc(x):
    there = ufl.lt((x[0] - 0.5) ** 2 + (x[1] - 0.3) ** 2, 0.1**2)
    skew = ufl.conditional(there, 0.9, 0.0)
    return ufl.as_matrix([[1.0, skew], [-skew, 1.0]])


def test_a_tensor_that_is_skew_where_the_coarsest_mesh_does_not_look():
    """A finer mesh does, and is refused; the coarsest has no certificate."""
    levels = solve_levels(
        Problem(f=-1.0, obstacle=-0.1, coefficient=skew_in_a_disc),
        HELD_ABOVE.mesh(1.0),
        5,
    )
    coarsest = next(levels)
    assert coarsest.certificate.bound_h1 is None
    assert "could not be shown to be symmetric" in str(coarsest.certificate.reason)
    message = refused(lambda: list(levels))
    assert "which is not symmetric" in message
    found = np.array([float(v) for v in message.split("(")[1].split(")")[0].split(",")])
    assert np.linalg.norm(found - [0.5, 0.3]) < 0.1


@pytest.mark.parametrize("same", [lambda x: x[0] * x[1], lambda x: ufl.sin(x[0]) / 3])
def test_tensors_that_are_symmetric_by_their_formulas_cost_nothing(same):
    def kappa(x):
        return ufl.as_matrix([[2.0, 0.3 * same(x)], [same(x) * 0.1 + 0.2 * same(x), 2.0]])

    solution = solve(
        Problem(f=-1.0, obstacle=-0.1, coefficient=kappa), Polygon(RECTANGLE, ABOVE).mesh(0.5)
    )
    assert solution.level.physics.compiled.kappa.skew == []
    assert solution.certificate.bound_h1 is not None


def test_a_tensor_that_is_no_coefficient_somewhere():
    domain = Polygon(RECTANGLE, ABOVE).mesh(0.5)
    problem = Problem(coefficient=lambda x: ufl.as_matrix([[1.0, x[1]], [x[1], 1.0]]))
    message = refused(lambda: checked(problem, domain))
    assert "at (-1, 1) is [[1, 1], [1, 1]], with the eigenvalue 0" in message
    negative = Problem(coefficient=lambda x: 0.5 - x[0])
    assert "at (0.5, " in refused(lambda: checked(negative, domain))


@pytest.mark.parametrize(
    ("data", "words"),
    [
        ({"reaction": np.nan}, "the reaction is nan at ("),
        ({"reaction": np.inf}, "the reaction is inf at ("),
        ({"reaction": -1.0}, "the reaction is -1 at ("),
        ({"coefficient": np.inf}, "data: the coefficient is inf; it must be finite and above 0"),
        ({"b": np.inf}, "the coefficient of the part 'neumann' is inf at (-1, "),
        ({"b": np.nan}, "the coefficient of the part 'neumann' is nan at (-1, "),
        ({"rock": Material(reaction=np.nan)}, "the reaction of 'rock' is nan at ("),
        ({"rock": Material(reaction=-2.0)}, "the reaction of 'rock' is -2 at ("),
        (
            {"rock": Material(coefficient=ufl.as_matrix([[3, 9], [9, 2]]))},
            "material.rock.coefficient: the value at (-1, 0) is [[3, 9], [9, 2]], with the eigen",
        ),
        ({"rock": Material(coefficient=-1.0)}, "material.rock.coefficient: the value at (-1, 0)"),
    ],
)
def test_the_datum_that_is_wrong_is_named(data: dict, words: str):
    rock = {"rock": [[-1, 0], [0, 0], [0, 1], [-1, 1]]}
    domain = Polygon(RECTANGLE, ABOVE, materials=rock).mesh(0.5)
    more = {name: value for name, value in data.items() if name not in ("b", "rock")}
    if "b" in data:
        more["conditions"] = {"neumann": Robin(coefficient=data["b"])}
    if "rock" in data:
        more["materials"] = {"rock": data["rock"]}
    assert refused(lambda: solve(Problem(**more), domain)).startswith(words)


# boundary parts


def test_every_value_must_be_on_the_boundary():
    mesh = dolfinx.mesh.create_unit_square(COMM, 4, 4)

    def values(x, y):
        return np.select([np.isclose(x, 1), np.isclose(y, 0), np.isclose(y, 1)], [4, 1, 2], 0)

    tags = tagged(mesh, values)
    for parts, words in (
        ({"contact": 7}, "tagged contact (value 7): the values there are 0, 1, 2, 4"),
        ({"contact": [1, 7]}, "tagged contact (value 7)"),
        ({"dirichlet": [2, 5]}, "tagged dirichlet (value 5)"),
        ({"neumann": 3}, "are tagged 4, which stands for nothing: contact is 1, dirichlet 2 and"),
        ({"neumann": 0}, "are tagged 4, which stands for nothing"),
        ({"contact": []}, "no exterior facet is tagged contact"),
    ):
        assert words in refused(lambda: Domain.from_tags(mesh, tags, **parts))
    for neumann in (None, 4, [0, 4], [4, 5]):
        Domain.from_tags(mesh, tags, neumann=neumann)


NODES = "5\n1 0 0 0\n2 1 0 0\n3 1 1 0\n4 0 1 0\n5 0.5 0.5 0"
CELLS = [(1, 2), (2, 3), (3, 4), (4, 1)]


def write(path: Path, names: list[str], curves: list[tuple[int, int, int]]) -> None:
    """A square of four triangles; curves are (name's number, node, node)."""
    lines = [f"1 2 {tag} {10 * a + b} {a} {b}" for tag, a, b in curves]
    lines += [f"2 2 99 1 {a} {b} 5" for a, b in CELLS]
    groups = [f'1 {i + 1} "{name}"' for i, name in enumerate(names) if name]
    path.write_text(
        "$MeshFormat\n2.2 0 8\n$EndMeshFormat\n$PhysicalNames\n"
        + "\n".join([f"{len(groups) + 1}", *groups, '2 99 "body"'])
        + f"\n$EndPhysicalNames\n$Nodes\n{NODES}\n$EndNodes\n$Elements\n"
        + "\n".join([f"{len(lines)}", *(f"{i + 1} {line}" for i, line in enumerate(lines))])
        + "\n$EndElements\n"
    )


PARTS = [(1, 1, 2), (2, 3, 4)]


@pytest.mark.parametrize(
    ("name", "words"),
    [
        (
            "dirichlet_left",
            "curve 'dirichlet_left' has 1 facet on the boundary; did you mean diri",
        ),
        ("neuman", "curve 'neuman' has 1 facet on the boundary; did you mean neumann?"),
        ("wall", "allowed there are contact, dirichlet, neumann"),
        ("", "curve with the number 3 and no name has 1 facet on the boundary"),
    ],
)
def test_curves_of_other_names_on_the_boundary(shared_tmp_path: Path, name: str, words: str):
    path = shared_tmp_path / "square.msh"
    names = ["contact", "dirichlet", name]
    on_root(COMM, lambda: write(path, names, [*PARTS, (3, 4, 1)]))
    message = refused(lambda: read_gmsh(path))
    assert words in message and message.startswith(f"{path}: ")


def test_curves_of_other_names_elsewhere(shared_tmp_path: Path):
    """Inside, or on facets that have one of the names, too."""
    path = shared_tmp_path / "square.msh"
    curves = [*PARTS, (3, 1, 5), (3, 5, 3), (4, 1, 2)]
    on_root(COMM, lambda: write(path, ["contact", "dirichlet", "interface", "floor"], curves))
    domain = read_gmsh(path)
    assert [COMM.allreduce(len(domain.facets(part))) for part in (1, 2, 3)] == [1, 1, 2]


# problem files


FILE = """[domain]
vertices = [[-1, 0], [1, 0], [1, 1], [-1, 1]]
boundary = ["contact", "dirichlet", "dirichlet", "dirichlet"]
size = 0.5
[data]
"""


@pytest.fixture
def run(shared_tmp_path: Path, capfd) -> Callable[..., tuple[int, str]]:
    def run(text: str, command: str = "solve") -> tuple[int, str]:
        path = shared_tmp_path / "case.toml"
        on_root(COMM, lambda: path.write_text(text) and None)
        status = cli.main([command, str(path), "--out", str(shared_tmp_path / "out")])
        COMM.Barrier()
        said = COMM.bcast(capfd.readouterr().err)
        assert all(len(line) <= 80 for line in said.splitlines() if str(path) not in line)
        return status, " ".join(said.split())

    return run


@pytest.mark.parametrize("command", ["solve", "check"])
@pytest.mark.parametrize(
    ("text", "words"),
    [
        (FILE + 'dirichlet = "where(x < 1, 0, 2)"\n', ["data.dirichlet: at (1, 1) the", "0", "2"]),
        (FILE + '[exact]\nu = "where(x < 0.1, 0, 2)"\n', ["exact.u: at (0.1, 1) the dirichlet"]),
        (
            FILE + "obstacle = 1e-6\n",
            ["data.obstacle: at (-1, 0), where", "is 1e-06 but", "only 0"],
        ),
        (FILE.replace("0.5", "2.5"), ["domain.size: 2.5 is longer", "diameter is 2.23607"]),
    ],
    ids=["jump", "jump of the exact solution", "obstacle", "size"],
)
def test_a_file_that_is_refused(run, shared_tmp_path: Path, text, words, command: str):
    status, said = run(text, command)
    assert status == 2
    assert said.startswith("signorini-cr: ") and said.count("signorini-cr: ") == 1
    assert all(word in said for word in words)
    assert not (shared_tmp_path / "out").exists()


def test_a_size_as_long_as_the_domain_is_taken(run):
    assert run(FILE.replace("0.5", "2.236"), "check") == (0, "")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (FILE + "g = 1\n", "data.g: it acts nowhere, for no facet is neumann"),
        (
            FILE.replace('"contact"', '"floor"')
            + 'obstacle = -1\n[boundary.floor]\ntype = "contact"',
            "data.obstacle: it acts nowhere, for no edge is labelled contact; parts with a section"
            " of their own take boundary.NAME.obstacle",
        ),
        (FILE + '[exact]\nu = "-y"\n', None),
        (FILE + '[exact]\nu = "y"\n', "the pressure on the obstacle is -1, below 0: it is not"),
        (FILE + 'obstacle = "-x**2"\n[exact]\nu = "-2*x**2 + y"\n', "data.obstacle: at (-1, 0)"),
    ],
    ids=[
        "flux on no facet",
        "obstacle elsewhere",
        "a solution",
        "pulled down",
        "below the obstacle",
    ],
)
def test_what_contradicts_itself_is_told(run, text: str, words: str | None):
    status, said = run(text, "check")
    if words is None:
        assert (status, said) == (0, "")
    else:
        refuses = "obstacle: at" in words
        assert status == (2 if refuses else 0)
        assert words in said and refuses == ("warning" not in said)


@pytest.mark.parametrize(
    ("data", "words"),
    [
        ({"exact": lambda x: x[1] - x[0] ** 2 + 0.25}, "u is -0."),
        ({"exact": lambda x: 1 - x[1]}, "though u is above it by 1"),
        ({"exact": lambda x: 1 + x[1]}, "is -1, below 0"),
        ({"exact": lambda x: x[0] ** 2, "f": 3.0}, "data.f is 3, but it asks for -2"),
        ({"exact": lambda x: x[0] ** 2, "dirichlet": 1.0}, "data.dirichlet is 1, but it asks for"),
        ({"exact": lambda x: x[0] ** 2 * x[1] ** 2, "g": 1.0}, "data.g is 1, but it asks for"),
    ],
)
def test_exact_solutions_that_are_none(data, words: str):
    domain = Polygon(RECTANGLE, ("contact", "neumann", "dirichlet", "dirichlet")).mesh(0.5)
    (said,) = doubts(Forms(Problem(**data), domain.mesh), domain)
    assert words in said and "it is not the solution" in said


@pytest.mark.parametrize("name", ["to{p", "a{}b", "{0}", "}{1!r}", "{{"])
def test_braces_in_the_name_of_a_part_that_contradicts_an_exact_solution(name):
    mesh = dolfinx.mesh.create_unit_square(COMM, 2, 2)
    tags = tagged(mesh, lambda x, y: np.where(y < 1e-9, 1, 2))
    domain = Domain.from_tags(mesh, tags, contact=1, **{name: 2})
    conditions = {"contact": Contact(-10.0), name: Dirichlet(1.0)}
    problem = Problem(f=0.0, exact=lambda x: 2.0 + 0.0 * x[0], conditions=conditions)
    (said,) = doubts(Forms(problem, mesh, parts=domain.parts), domain)
    assert name in said and said.partition(" is ")[2].startswith("1, but it asks for 2")


@pytest.mark.parametrize(
    ("kappa", "factor"),
    [
        (lambda x: ufl.conditional(x[0] + 0.3 * x[1] < 0.123, 50.0, 1.0), 50.0),
        (lambda x: 2.0 + ufl.sign(x[1] - 0.55 + 0.1 * x[0]), 3.0),
        (lambda x: ufl.conditional(x[0] < 0.123, 50.0, 1.0) * ufl.Identity(2), 50.0),
        (lambda x: ufl.conditional(x[0] < 0.123, 1.9, 1.0), None),
        (lambda x: ufl.conditional(x[0] < 0.0, 1.0 + 1e6 * abs(x[0]), 1.0), None),  # a kink
        (lambda x: 2.0 + 1.9 * ufl.sin(60 * x[0]), None),
        (lambda x: ufl.exp(40 * x[0]), None),
    ],
)
def test_coefficients_that_jump_inside_of_cells(kappa, factor):
    domain = Polygon(RECTANGLE, ("contact", "neumann", "dirichlet", "dirichlet")).mesh(0.3)
    said = doubts(Forms(Problem(coefficient=kappa), domain.mesh), domain)
    assert len(said) == (factor is not None)
    assert factor is None or f"jumps by a factor of up to {factor:.4g} inside of " in said[0]


def test_coefficients_that_jump_in_one_of_two_cells():
    """On more ranks than that some have none."""
    domain = Polygon([[0, 0], [1, 0], [0, 1]], ("contact", "dirichlet", "neumann")).mesh(1.0)
    for kappa, words in (
        (
            lambda x: ufl.conditional(x[0] < 0.9, 1.0, 7.0),
            ["of up to 7 inside of a cell, and"],
        ),
        (lambda x: 7.0 + x[0], []),
        (lambda x: ufl.as_matrix([[7.0 + x[0], 0.0], [0.0, 2.0]]), []),
    ):
        said = doubts(Forms(Problem(coefficient=kappa), domain.mesh), domain)
        assert len(said) == len(words)
        assert all(word in each for word, each in zip(words, said, strict=True))


def test_coefficients_that_jump_between_cells():
    """Materials, a Function of degree 0, and a condition that lines of the mesh follow."""
    halves = {"left": [[-2, 0], [0, 0], [0, 2], [-2, 2]]}
    kinds = ("contact", "neumann", "dirichlet", "dirichlet")
    domain = Polygon([[-1, 0], [1, 0], [1, 1], [-1, 1]], kinds, materials=halves).mesh(0.3)
    step = Problem(coefficient=lambda x: ufl.conditional(x[0] < 0.0, 50.0, 1.0))
    stiff = Problem(materials={"left": Material(coefficient=50.0)})
    for problem in (step, stiff):
        forms = Forms(problem, domain.mesh, "CR", domain.parts, domain.materials)
        assert doubts(forms, domain) == []


def test_the_examples_are_solutions():
    for example in exact.ALL.values():
        domain = example.mesh(0.3)
        assert doubts(Forms(example.problem, domain.mesh), domain) == []
