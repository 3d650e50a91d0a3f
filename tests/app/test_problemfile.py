"""Problem files: what they say is what one gets, and what they leave out has its default."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
import ufl
from dolfinx import fem
from helpers import MESHES
from mpi4py import MPI

from signorini_cr.app.problemfile import ProblemFile, load
from signorini_cr.app.reference import KEYS
from signorini_cr.app.statement import statement
from signorini_cr.errors import InputError
from signorini_cr.levels import solve, solve_levels
from signorini_cr.mesh.domain import CONTACT, DIRICHLET, NEUMANN, Polygon
from signorini_cr.output.report import level_record
from signorini_cr.output.tables import certificate_lines
from signorini_cr.output.units import Units

SQUARE = """
[domain]
vertices = [[0, 0], [1, 0], [1, 1], [0, 1]]
boundary = ["contact", "neumann", "dirichlet", "neumann"]
size = 0.5
"""
MESH = """$MeshFormat
2.2 0 8
$EndMeshFormat
$PhysicalNames
3
1 1 "contact"
1 2 "dirichlet"
2 3 "body"
$EndPhysicalNames
$Nodes
4
1 0 0 0
2 1 0 0
3 1 1 0
4 0 1 0
$EndNodes
$Elements
4
1 1 2 1 1 1 2
2 1 2 2 2 3 4
3 2 2 3 1 1 2 3
4 2 2 3 1 1 3 4
$EndElements
"""


@pytest.fixture
def read(shared_tmp_path: Path):
    def read(text: str, name: str = "case.toml") -> ProblemFile:
        path = shared_tmp_path / name
        if MPI.COMM_WORLD.rank == 0:
            path.write_text(text, encoding="utf-8")
        MPI.COMM_WORLD.Barrier()
        return load(path)

    return read


def test_defaults(read) -> None:
    case = read(SQUARE + "[data]\n")
    assert (case.title, case.mode, case.levels, case.adaptive["tolerance"]) == (
        "case",
        "uniform",
        1,
        0.0,
    )
    assert case.adaptive["max_dofs"] >= 10**5
    problem = case.problem
    assert (problem.f, problem.g, problem.dirichlet, problem.exact) == (None,) * 4
    assert (problem.obstacle, problem.coefficient) == (0.0, 1.0)


def test_everything_is_taken_over(read) -> None:
    case = read(
        '\ufefftitle = "All of it"\r\n'
        + SQUARE
        + """
        [[domain.holes]]
        vertices = [[0.4, 0.4], [0.6, 0.4], [0.5, 0.6]]
        boundary = ["neumann", "dirichlet", "contact"]
        [define]
        a = 2
        b = "a*x"
        [data]
        f = "b + 1"
        g = 3
        obstacle = -1.5
        dirichlet = "where(x < 0.5, b,\\n 1)"
        coefficient = "1 + x**2"
        [exact]
        u = "sin(x)*y"
        [refine]
        mode = "adaptive"
        levels = 7
        tolerance = 1e-2
        max_dofs = 5000
        fraction = 0.7
        """
    )
    assert isinstance(case.domain, Polygon)
    assert len(case.domain.holes) == 1 and case.domain.holes[0].boundary[1] == "dirichlet"
    assert (case.title, case.size) == ("All of it", 0.5)
    assert (case.mode, case.levels, case.adaptive["tolerance"]) == ("adaptive", 7, 0.01)
    assert case.adaptive == {"tolerance": 0.01, "max_dofs": 5000, "fraction": 0.7}
    assert (case.problem.g, case.problem.obstacle) == (3.0, -1.5)
    assert case.problem.f((2.0, 0.0)) == 5.0  # any coordinates will do
    points = np.array([[0.25, 0.0], [0.75, 0.0]])
    expressions = {str(datum): expression for datum, expression in case.expressions.items()}
    assert np.allclose(expressions["data.dirichlet"].numpy(points), [0.5, 1.0])
    assert np.allclose(expressions["exact.u"].numpy([[1.0, 2.0]]), 2 * np.sin(1.0))


PARTS = """
[domain]
vertices = [[0, 0], [1, 0], [1, 1], [0, 1]]
boundary = ["floor", "air", "roof", "wall"]
size = 0.25
[boundary.floor]
type = "contact"
obstacle = "where(x < 2, 2*x + y, 9)"
coefficient = 2
external = 1
g = "1.5 - 5 + 2*(2*x + y - 1) + 2"
[boundary.air]
type = "robin"
coefficient = 4
external = -1
[boundary.roof]
type = "dirichlet"
[boundary.wall]
type = "neumann"
[data]
coefficient = 5
reaction = 3
[exact]
u = "2*x + y"
"""


def test_parts_with_names_of_ones_own(read) -> None:
    """u = 2x + y, which CR has: all that is left out follows from it; on the floor λ is 0.5.

    There −5 ∂u/∂y + 2 (u − 1) − g = −5 + 2 (u − 1) − (2 (u − 1) − 1.5) = −3.5 < 0 would pull: so g
    is such that λ = −5 + 2 (u − 1) − g = 0.5.
    """
    text = PARTS.replace('"1.5 - 5 + 2*(2*x + y - 1) + 2"', '"-5.5 + 2*(2*x + y - 1)"')
    case = read(text)
    domain = case.mesh()
    assert case.check(domain) == []
    assert list(domain.parts) == ["contact", "dirichlet", "neumann", "floor", "air", "roof", "wall"]
    *_, solution = solve_levels(case.problem, domain, 2)
    assert solution.errors is not None and max(solution.errors) < 1e-7
    assert solution.contact.force == pytest.approx(0.5, rel=1e-6)
    assert solution.contact.active.all()


NAMED = """
[domain]
vertices = [[-1, 0], [1, 0], [1, 1], [-1, 1]]
boundary = ["FLOOR", "FIX", "FREE", "ROB"]
size = 0.5
[boundary."FLOOR"]
type = "contact"
obstacle = "-0.5 + 0.1*x"
[boundary."FIX"]
type = "dirichlet"
value = "0.2*y"
[boundary."FREE"]
type = "neumann"
g = "0.5*x"
[boundary."ROB"]
type = "robin"
coefficient = "1 + y"
external = 0.2
[material."EAST"]
polygon = [[0, 0], [1, 0], [1, 1], [0, 1]]
coefficient = "1 + x"
f = -2
[material."WEST"]
polygon = [[-1, 0], [0, 0], [0, 1], [-1, 1]]
coefficient = [["2", "0"], ["0", "1 - x"]]
reaction = "-x"
[quantities]
"FORCE" = { force = "FLOOR", weight = "1 - x" }
"MEAN" = { mean = "EAST" }
[data]
f = -3
coefficient = "0.5 - x"
"""
ODD = {
    "dots": ("a", "a.b", ".", "..", "a.", "a..b", ".a", "x.f"),
    "brackets": ("a[0]", "a[0][1]", "a", "[", "]", "a[1][1].coefficient", "b", "c[0]"),
    "words of the file": (
        "data.f", "coefficient", "u.coefficient", "domain", "time", "boundary", "where", "material",
    ),
    "marks": ("a,b", 'a"b', "a|b", "<b>", "$x$", "$\\q{$", "ä ß ж", "%"),
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("kind", ODD)
def test_names_are_of_no_matter(kind: str, read) -> None:
    """What is solved, and asked for, is what it is with plain names."""
    plain = ("FLOOR", "FIX", "FREE", "ROB", "EAST", "WEST", "FORCE", "MEAN")
    found = []
    for names in (plain, ODD[kind]):
        text = NAMED
        for before, after in zip(plain, names, strict=True):
            text = text.replace(f'"{before}"', json.dumps(after, ensure_ascii=False))
        case = read(text)
        domain = case.mesh()
        assert case.check(domain) == []
        solution = solve(case.problem, domain)
        record = level_record(solution, None, case.quantities)
        intervals = record["quantities"].values()
        rows = statement(case, domain)
        found.append([solution.energy, *(v[k] for v in intervals for k in ("lower", "upper"))])
        assert solution.energy == pytest.approx(found[0][0], rel=1e-13)
        assert found[-1] == pytest.approx(found[0], rel=1e-9)
        assert len(rows) == len(plain), "a row for each part and material, domain and equation"


@pytest.mark.parametrize(
    "name", ["", " a", "a ", "a\nb", "a\u001b[31m", "\u202ea", "a\u0000", 81 * "a"]
)
@pytest.mark.parametrize("of", ["FLOOR", "EAST", "FORCE"])
def test_names_that_nobody_can_read_are_refused(name: str, of: str, read) -> None:
    text = NAMED.replace(f'"{of}"', json.dumps(name))
    with pytest.raises(InputError, match=r": a name has 1 to 80 characters on one line"):
        read(text)


def test_the_deck_is_in_balance() -> None:
    """No load: the losses b ∫(u − u_ext) through all parts add up to the contact force."""
    case = load(MESHES / "deck.toml")
    solution = solve(case.problem, case.mesh())
    domain = solution.domain
    ds = ufl.Measure("ds", domain.mesh, subdomain_data=domain.tags)
    losses = {"surface": (20.0, -5.0), "air": (8.0, -5.0), "duct": (25.0, 20.0)}
    form = sum(b * (solution.u - e) * ds(domain.parts[name]) for name, (b, e) in losses.items())
    total = domain.mesh.comm.allreduce(fem.assemble_scalar(fem.form(form)))
    assert total == pytest.approx(solution.contact.force, rel=1e-7)
    assert total > 200.0


def test_arcs_and_round_holes(read) -> None:
    """u = 1 + 2y, which CR has, on a half disk with a round hole, in contact on the floor."""
    case = read("""
        [domain]
        vertices = [[-1, 0], [1, 0]]
        boundary = ["floor", "roof"]
        arcs = [{ edge = 1, through = [0, 1] }]
        holes = [{ center = [0, 0.5], radius = 0.2, boundary = "duct" }]
        size = 0.3
        [boundary.floor]
        type = "contact"
        g = -3
        obstacle = 1
        [boundary.roof]
        type = "dirichlet"
        [boundary.duct]
        type = "dirichlet"
        [exact]
        u = "1 + 2*y"
        """)
    domain = case.mesh()
    assert case.check(domain) == []
    *_, solution = solve_levels(case.problem, domain, 2)
    assert max(solution.errors) < 1e-7
    # λ = ∂u/∂n − g = −2 + 3 on all of the floor; 24 facets are a circle
    assert solution.contact.force == pytest.approx(2.0, rel=1e-6)
    ends = domain.mesh.comm.allreduce(len(domain.facets(domain.parts["duct"])))
    assert ends == 24


def test_no_dirichlet_part_where_something_else_holds_the_solution(read) -> None:
    """u = 2 on the strip for c u = f with c = 3 and f = 6; refused without c."""
    text = PARTS.split("[boundary.floor]")[0] + (
        '[boundary.floor]\ntype = "contact"\nobstacle = -1\n'
        + "".join(f'[boundary.{name}]\ntype = "neumann"\n' for name in ("air", "roof", "wall"))
        + "[data]\nf = 6\n"
    )
    case = read(text + "reaction = 3\n")
    solution = solve(case.problem, case.mesh())
    assert np.allclose(solution.u.x.array, 2.0, atol=1e-8)
    case = read(text)
    with pytest.raises(InputError, match="there is no Dirichlet facet, no loss of heat, no rea"):
        solve(case.problem, case.mesh())


def test_parts_may_say_it_all(read) -> None:
    """u = 2x + y again, κ = 1, no section [data]: ∂u/∂y = 1 on the roof, and λ = 0 on the floor."""
    text = PARTS.split("[boundary.floor]")[0] + (
        '[boundary.floor]\ntype = "contact"\nobstacle = "2*x + y - 1"\ng = -1\n'
        '[boundary.roof]\ntype = "neumann"\ng = 1\n'
        + "".join(
            f'[boundary.{name}]\ntype = "dirichlet"\nvalue = "2*x + y"\n'
            for name in ("air", "wall")
        )
    )
    case = read(text)
    domain = case.mesh()
    solution = solve(case.problem, domain)
    x = solution.u.function_space.tabulate_dof_coordinates()
    assert np.allclose(solution.u.x.array, 2 * x[:, 0] + x[:, 1], atol=1e-9)
    assert solution.contact.force == pytest.approx(0.0, abs=1e-9)


def test_arguments_of_adaptive_refinement_are_keys_of_one_section() -> None:
    assert {key.section for key in KEYS if key.argument is not None} == {"refine"}


def test_the_fraction_decides_what_is_refined(read) -> None:
    """All cells for 1; the fewest cells that hold so much for less: 2 meshes of each."""
    cells = []
    for fraction in (0.1, 0.5, 1.0):
        text = SQUARE + "[data]\nf = 1\n[refine]\nmode = 'adaptive'\nlevels = 2\n"
        case = read(text + f"fraction = {fraction}\n")
        sizes = [
            s.domain.mesh.topology.index_map(2).size_global for s in case.solutions(case.mesh())
        ]
        cells.append(sizes)
    assert cells[0][1] < cells[1][1] < cells[2][1] == 4 * cells[2][0]


def test_expressions_and_numbers_are_the_same(read) -> None:
    """-Δu = 2 on the strip with u = 0 at the top: the energy is the same either way."""
    energies = []
    for f in ("2", '"1 + 1"', '"2 + 0*x"', '"where(y < 2, 2, x)"'):
        case = read(SQUARE + f"[data]\nf = {f}\n")
        energies.append(solve(case.problem, case.mesh()).energy)
    assert np.ptp(energies) < 1e-12 * abs(energies[0])


def test_what_is_left_out_follows_from_the_exact_solution(read) -> None:
    """u = x (1 − y)², in contact with α = x on all of Γ1 under the pressure 2 x."""
    case = read(SQUARE + '[exact]\nu = "x*(1 - y)**2"\n[data]\nobstacle = "x"\n')
    domain = case.mesh()
    case.check(domain)
    errors = [s.errors[0] for s in solve_levels(case.problem, domain, 3)]
    assert np.allclose(np.log2(np.divide(errors[:-1], errors[1:])), 1.0, atol=0.1)


def test_a_constant_may_be_the_exact_solution(read) -> None:
    case = read(SQUARE + "[exact]\nu = 2\n")
    solution = solve(case.problem, case.mesh())
    assert max(solution.errors) < 1e-6


def test_a_mesh_file_lies_beside_the_problem_file(read, shared_tmp_path: Path) -> None:
    if MPI.COMM_WORLD.rank == 0:
        (shared_tmp_path / "two.msh").write_text(MESH)
    case = read('domain.mesh = "two.msh"\n[data]\nf = 1\n')
    domain = case.mesh()
    numbers = [
        MPI.COMM_WORLD.allreduce(len(domain.facets(p))) for p in (CONTACT, DIRICHLET, NEUMANN)
    ]
    assert numbers == [1, 1, 2]
    case.check(domain)


@pytest.mark.parametrize(
    "data",
    [
        'f = "1/y"',  # at a vertex
        'f = "1/(y - 1)"',
        'g = "sqrt(x - 0.5)"',  # on x = 0
        'obstacle = "1/x"',
        'dirichlet = "log(x)"',
        'coefficient = "x"',
        "coefficient = 0",
        'coefficient = "1/y"',
    ],
)
def test_data_are_tried_out_where_they_are_used(read, data: str) -> None:
    case = read(SQUARE + f"[data]\n{data}\n")
    domain = case.mesh()
    with pytest.raises(InputError, match=rf"data\.{data.split(' ')[0]}: the value at \("):
        case.check(domain)


@pytest.mark.parametrize(
    "data",
    [
        'g = "1/(x - 0.5)"',  # on x = 0 and x = 1 only
        'obstacle = "1/(1 - y)"',  # on y = 0
        'dirichlet = "1/y"',  # on y = 1
        'f = "where(y > 0, 1/y, 0)"',
    ],
)
def test_and_only_there(read, data: str) -> None:
    case = read(SQUARE + f"[data]\n{data}\n")
    case.check(case.mesh())


def test_the_obstacle_may_touch_the_dirichlet_value_where_they_meet(read) -> None:
    """sin(pi) is 1e-16, which is not above 0 for this purpose."""
    triangle = SQUARE.replace('"neumann", "dirichlet"', '"dirichlet", "dirichlet"')
    case = read(triangle + '[data]\nobstacle = "sin(pi*x)"\n')
    case.check(case.mesh())
    case = read(triangle + '[data]\nobstacle = "sin(pi*x) + x*1e-6"\n')
    domain = case.mesh()
    with pytest.raises(InputError, match=r"data\.obstacle: at \(1, 0\), where contact and diri"):
        case.check(domain)


def test_too_many_levels_are_told_before_anything_is_solved(read) -> None:
    case = read(SQUARE + "[data]\n[refine]\nlevels = 40\n")
    domain = case.mesh()
    with pytest.raises(InputError, match=r"refine.levels .* 40 meshes"):
        case.check(domain)


def test_means_are_of_parts_of_materials_or_of_all(read) -> None:
    """u = −1, far above the obstacle."""
    text = (
        SQUARE
        + """
[data]
dirichlet = -1
obstacle = -9
[material.low]
polygon = [[0, 0], [1, 0], [1, 0.5], [0, 0.5]]
[quantities]
side = { mean = "neumann" }
low = { mean = "low" }
all = { mean = "domain" }
"""
    )
    case = read(text)
    asked = {
        "side": ("mean", "neumann", None),
        "low": ("mean", "low", None),
        "all": ("mean", None, None),
    }
    assert case.quantities == asked
    *_, solution = solve_levels(case.problem, case.mesh(), 1)
    solution_record = level_record(solution, None, case.quantities)
    found = solution_record["quantities"]
    for each in found.values():
        assert each["lower"] <= -1 <= each["upper"] and each["reason"] is None
        assert each["upper"] - each["lower"] < 1e-9
    measured = Units(u="K", force="W")
    wanted = {"heat": {**found["low"], "kind": "flux"}, "low": found["low"]}
    bounds = {"contact": {"force_bounds": {"reason": "x"}}, "quantities": wanted}
    told = "; ".join(certificate_lines(solution_record | bounds, measured))
    assert re.search(r"heat is in \[[^]]*\]\sW, .*; low is in \[[^]]*\]\sK, ", told)
    named = read(text.replace("[material.low]", "[material.domain]").replace('"low"', '"domain"'))
    renamed = {name: ("mean", "domain", None) for name in ("low", "all")}
    assert named.quantities == {**asked, **renamed}


def test_weights_are_expressions(read) -> None:
    """u = −1 on the obstacle; λ = −∂u/∂y = 0 there but for what f brings."""
    text = (
        SQUARE
        + """
[define]
tent = "1 - abs(x)"
[data]
dirichlet = -1
obstacle = -9
[material.low]
polygon = [[0, 0], [1, 0], [1, 0.5], [0, 0.5]]
[quantities]
push = { force = "contact", weight = "tent*(1 - x)*x" }
low = { integral = "low", weight = "1/(3 - y) + x" }
tilt = { mean = "low", weight = "2" }
all = { integral = "domain", weight = "x - y" }
"""
    )
    case = read(text)
    domain = case.mesh()
    case.check(domain)
    *_, solution = solve_levels(case.problem, domain, 1)
    record = level_record(solution, None, case.quantities)
    exact = {"push": 0.0, "low": -(np.log(3 / 2.5) + 0.25), "tilt": -1.0, "all": 0.0}
    for name, each in record["quantities"].items():
        assert each["weighted"] and each["reason"] is None
        assert each["lower"] <= exact[name] <= each["upper"]
        assert each["upper"] - each["lower"] < 1e-8
    told = "; ".join(certificate_lines(record, Units(u="K", force="W")))
    assert re.search(r"tilt is in \[[^]]*\]\sK,", told)
    assert re.search(r"push is in \[[^]]*\];", told) and re.search(r"all is in \[[^]]*\]$", told)
    for old, new, said in [
        ('"x - y"', '"log(x - 5)"', "quantities.all.weight: the value at"),
        ('"1/(3 - y) + x"', '"log(0.4 - y)"', "quantities.low.weight: the value at"),
        ('"x - y"', '"x < y"', "quantities.all.weight: a number is needed"),
        ('"x - y"', '"x - z"', "quantities.all.weight:"),
        ('weight = "2"', 'weigth = "2"', "quantities.tilt.weigth: there is no such key"),
        ('mean = "low", ', "", "quantities.tilt: { force"),
        (
            'mean = "low", ',
            'mean = "low", flux = "contact", ',
            "quantities.tilt: one of force, flux, mean, integral is to be given, found flux and"
            " mean",
        ),
    ]:
        with pytest.raises(InputError, match=re.escape(said)):
            other = read(text.replace(old, new))
            other.check(other.mesh())
    read(text.replace('"1/(3 - y) + x"', '"log(0.6 - y)"')).check(domain)  # finite where it is used
