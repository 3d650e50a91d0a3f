"""The solver: bounds where they belong, errors with names, options under the prefix."""

import contextlib
import gc

import numpy as np
import pytest
import ufl
from dolfinx.fem import Function
from helpers import HELD_ABOVE
from mpi4py import MPI
from petsc4py import PETSc
from ufl.domain import extract_unique_domain

from signorini_cr import (
    Contact,
    InputError,
    NotConverged,
    Polygon,
    Problem,
    exact,
    solve,
    solve_levels,
)
from signorini_cr.fem.space import closure_dofs, function_space
from signorini_cr.mesh.domain import CONTACT
from signorini_cr.options import explained
from signorini_cr.rounding import at_most
from signorini_cr.vi.stopping import WINDOWS

pytestmark = pytest.mark.ranks

PROBLEM = Problem(f=lambda x: 2 * np.pi * ufl.sin(2 * np.pi * x[0]))


def test_bounds_on_contact_facets_only():
    solution = solve(PROBLEM, HELD_ABOVE.mesh(0.1))
    lower = solution.level.system.lower
    V = solution.u.function_space
    bounded = np.flatnonzero(lower > PETSc.NINFINITY)
    owned = bounded[bounded < V.dofmap.index_map.size_local]
    expected = closure_dofs(V, solution.domain.facets(CONTACT)).ravel()
    assert np.array_equal(owned, np.sort(expected))
    assert np.all(lower[bounded] == 0.0)


def test_failure_names_the_reason(options):
    options("snes_max_it", 1)
    with pytest.raises(NotConverged, match="DIVERGED_MAX_IT") as caught:
        solve(PROBLEM, HELD_ABOVE.mesh(0.05))
    assert caught.value.level == 0


def test_linear_failure_is_named(options):
    options("ksp_max_it", 1)
    options("ksp_rtol", 1e-12)
    options("pc_type", "none")
    said = r"DIVERGED_LINEAR_SOLVE \(KSP DIVERGED_(MAX_IT|ITS)\) after 0 .* and 1 linear"
    with pytest.raises(NotConverged, match=said):
        solve(PROBLEM, HELD_ABOVE.mesh(0.05))


@pytest.mark.parametrize("name", ["ksp_type", "pc_type", "snes_type"])
def test_unknown_types_are_the_users_mistake(options, name):
    options(name, "nonsense")
    with pytest.raises(InputError, match=r"begins with -signorini_: Unable to find .* nonsense"):
        solve(PROBLEM, HELD_ABOVE.mesh(0.25))


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("snes_type", "newtonls", "does not support bounds"),
        ("snes_type", "vinewtonssls", "method diagonalScale"),
        ("reduced_ksp_type", "cg", "method mult"),
    ],
)
def test_solvers_that_do_not_suit_are_the_users_mistake(options, name, value, words):
    options(name, value)
    said = f"PETSc can't solve with -signorini_{name} {value}: .*{words}"
    with pytest.raises(InputError, match=said):
        solve(PROBLEM, HELD_ABOVE.mesh(0.25))


def test_a_norm_that_cg_cannot_end_by_is_the_users_mistake(options):
    options("ksp_norm_type", "natural")
    with pytest.raises(InputError, match="-signorini_ksp_norm_type is 'natural'; allowed are unp"):
        solve(PROBLEM, HELD_ABOVE.mesh(0.25))
    options("ksp_norm_type", "unpreconditioned")
    assert solve(PROBLEM, HELD_ABOVE.mesh(0.25)).iterations.linear > 0


def test_a_petsc_of_other_numbers(monkeypatch):
    monkeypatch.setattr(PETSc, "ScalarType", np.complex128)
    with pytest.raises(InputError, match="PETSc's numbers are complex128; float64 is needed"):
        solve(PROBLEM, HELD_ABOVE.mesh(0.5))


def test_one_rank_alone_may_monitor():
    seen = []
    monitor = (lambda *facts: seen.append(facts)) if MPI.COMM_WORLD.rank == 0 else None
    solution = solve(PROBLEM, HELD_ABOVE.mesh(0.1), monitor=monitor)
    steps = solution.iterations.newton + 1
    assert len(seen) == (steps if MPI.COMM_WORLD.rank == 0 else 0)


def test_what_a_monitor_raises_reaches_the_caller():
    class Enough(Exception):
        """Ours, and nobody else's."""

    def monitor(*_):
        raise Enough("of that")

    with pytest.raises(Enough, match=r"^of that$"):
        solve(PROBLEM, HELD_ABOVE.mesh(0.25), monitor=monitor)


@pytest.mark.parametrize("height", [0.0, 1.0, -0.3])
def test_where_there_is_no_load_there_is_nothing_to_solve(height):
    """Steps went on from the rounding of the prolonged start until squares were lost."""
    kinds = ["contact", "contact", "dirichlet", "dirichlet", "contact"]
    domain = Polygon([[0.2, 0.4], [-0.2, 0.3], [-2, -0.2], [-0.5, -1.4], [1, 0]], kinds).mesh(0.7)
    problem = Problem(dirichlet=height, obstacle=-2.0, coefficient=1.85)
    for solution in solve_levels(problem, domain, levels=3):
        assert solution.iterations.newton == solution.iterations.linear == 0
        assert np.array_equal(solution.u.x.array, np.full_like(solution.u.x.array, height))
        assert solution.contact.number_active == 0
        assert solution.certificate.bound_h1 < 1e-10


def test_garbage_may_pile_up_when_a_monitor_raises():
    """Collected before PETSc is back it took the exception along, and the process with it."""
    thresholds = gc.get_threshold()

    def monitor(*_):
        gc.set_threshold(1)
        raise KeyError("ours")

    mesh = HELD_ABOVE.mesh(0.25)
    try:
        with pytest.raises(KeyError, match="ours"):
            solve(PROBLEM, mesh, monitor=monitor)
    finally:
        gc.set_threshold(*thresholds)
    assert gc.isenabled()


def test_what_petsc_loses_on_the_way_reaches_the_caller():
    """Garbage that Python collects while PETSc returns may take the pending exception with it."""

    def monitor():
        raise KeyError("ours")

    with pytest.raises(KeyError, match="ours"), explained() as keep:
        with contextlib.suppress(KeyError):
            keep(monitor)()
        raise PETSc.Error(101)


def test_the_bottom_solver_is_named(options):
    named = [solve(PROBLEM, HELD_ABOVE.mesh(0.25)).iterations.preconditioner]
    options("bottom_pc_type", "jacobi")
    named.append(solve(PROBLEM, HELD_ABOVE.mesh(0.25)).iterations.preconditioner)
    assert "a direct solver" in named[0]
    assert "jacobi (option -signorini_bottom_pc_type)" in named[1]


def test_coordinates_whose_squares_overflow_are_refused():
    with pytest.raises(InputError, match=r"vertex 1 .*: coordinates up to 1e\+100"):
        Polygon([[0, 0], [1e200, 0], [1, 1]], ["contact", "dirichlet", "neumann"])


def test_options_choose_another_solver(options):
    reference = solve(PROBLEM, HELD_ABOVE.mesh(0.1))
    options("ksp_type", "minres")
    options("pc_type", "jacobi")
    other = solve(PROBLEM, HELD_ABOVE.mesh(0.1))
    assert other.iterations.preconditioner.startswith("jacobi")
    assert other.iterations.linear > reference.iterations.linear
    assert np.allclose(other.u.x.array, reference.u.x.array, atol=1e-7)


@pytest.mark.parametrize("element", ["CR", "P1"])
@pytest.mark.parametrize("key", ["f", "obstacle", "coefficient"])
def test_a_function_of_one_mesh_is_not_taken_to_another(key, element):
    domain = HELD_ABOVE.mesh(0.25)
    function = Function(function_space(domain.mesh, "P1"))
    function.x.array[:] = 1.0
    data = {"f": -1.0, "dirichlet": 2.0} | {key: function}
    solutions = solve_levels(Problem(**data), domain, 2, element)
    assert next(solutions).level.number == 0
    with pytest.raises(InputError, match="live on one mesh only"):
        next(solutions)


@pytest.mark.parametrize("scale", [1e-14, 1e-7, 1e9])
@pytest.mark.parametrize("shift", [0.0, 1e5])
@pytest.mark.parametrize("levels", [1, 3])
def test_coefficients_of_any_magnitude(scale, shift, levels):
    """The solution does not depend on what κ and f are multiplied by, nor on a constant."""

    def last(scale, shift):
        problem = Problem(
            f=lambda x: scale * (30 * ufl.sin(7 * x[0]) - 10),
            obstacle=lambda x: shift + 0.02 * x[0],
            dirichlet=lambda x: shift + 1.0 + x[0],
            coefficient=scale,
        )
        *_, solution = solve_levels(problem, HELD_ABOVE.mesh(0.05 if levels == 1 else 0.25), levels)
        return solution

    one, scaled = last(1.0, shift), last(scale, shift)
    assert one.contact.number_active > 3
    assert scaled.contact.number_active == one.contact.number_active
    assert scaled.iterations.newton == one.iterations.newton
    assert scaled.contact.kkt.residual < 1e-8
    assert scaled.contact.force / scale == pytest.approx(one.contact.force, rel=1e-6)


@pytest.mark.parametrize("value", [-1.0, 0.0, lambda x: x[0] - 0.5, lambda x: 1 / (x[0] - x[0])])
def test_a_coefficient_that_is_not_positive_is_refused(value):
    with pytest.raises(InputError, match="coefficient"):
        solve(Problem(f=-1.0, coefficient=value), HELD_ABOVE.mesh(0.2))


def test_arrays_of_one_number_are_numbers():
    number, array = (solve(Problem(f=f), HELD_ABOVE.mesh(0.5)) for f in (-3.0, np.array(-3.0)))
    assert array.energy == number.energy < 0.0


@pytest.mark.parametrize(
    ("data", "said"),
    [
        ({"f": "x"}, "^f: 'x' does not give a number or a UFL expression"),
        ({"f": "x"}, "expressions as text are for problem files"),
        ({"obstacle": None}, "^obstacle: None does not give a number"),
        ({"dirichlet": "x"}, "^dirichlet: 'x' does not give"),
        ({"exact": "x"}, "^exact: 'x' does not give"),
        (
            {"conditions": {"contact": Contact(0.0, upper=lambda x: "y")}},
            r"^conditions\['contact'\].upper: <function .* does not give",
        ),
        ({"f": lambda x: ufl.lt(x[0], 0.5)}, "it is a condition, of which ufl.conditional"),
        ({"f": 1j}, "1j does not give a number or a UFL expression .it holds a complex number"),
        ({"obstacle": lambda x: 2j * x[0]}, "it holds a complex number"),
        ({"f": lambda x: ufl.avg(x[0])}, "it holds values of one side of a facet"),
        ({"obstacle": lambda x: x[0]("-")}, "it holds values of one side of a facet"),
        (
            {"coefficient": lambda x: ufl.FacetNormal(extract_unique_domain(x))[0]},
            "it holds what facets",
        ),
        (
            {"f": lambda x: ufl.TestFunction(function_space(HELD_ABOVE.mesh(0.5).mesh))},
            "it holds a test or trial function",
        ),
        ({"f": -(10**400)}, "int too large to convert to float"),
        ({"f": lambda x: np.sin(x[0])}, r"as in ufl.sin\(x\[0\]\)"),
        ({"f": lambda x: x}, r"f has the shape \(2,\); a scalar"),
        ({"g": lambda x: ufl.as_vector([x[0], 1.0])}, "g has the shape"),
        ({"coefficient": lambda x: ufl.as_vector([1.0, 1.0])}, "coefficient has the shape"),
    ],
)
def test_data_that_are_no_numbers_are_refused(data, said):
    with pytest.raises(InputError, match=said):
        solve(Problem(**data), HELD_ABOVE.mesh(0.2))


@pytest.mark.parametrize("key", ["f", "coefficient", "obstacle"])
def test_data_on_another_mesh_are_refused(key):
    other = Function(function_space(HELD_ABOVE.mesh(0.2).mesh, "P1"))
    other.x.array[:] = 1.0
    with pytest.raises(InputError, match=f"{key} is given on another mesh"):
        solve(Problem(**{key: other}), HELD_ABOVE.mesh(0.2))


@pytest.mark.parametrize("name", ["quadrature_degree", "error_degree"])
@pytest.mark.parametrize("degree", [-1, 2.5, "4"])
def test_degrees_that_there_are_none_of(name, degree):
    with pytest.raises(InputError, match=f"{name} is {degree!r}"):
        Problem(**{name: degree})
    assert type(getattr(Problem(**{name: np.int8(4)}), name)) is int


@pytest.mark.parametrize("element", ["CR", "P1"])
def test_an_obstacle_that_is_no_number_at_one_vertex_is_refused_on_any_number_of_ranks(element):
    """Also where the rank that owns the vertex has no contact facet, and a number for it."""
    sides = ["contact", "neumann", "neumann", "dirichlet", "neumann"]
    domain = Polygon([[0, 0], [1, 0], [2, 0], [2, 1], [0, 1]], sides).mesh(0.1)
    edge = 1.0 if element == "P1" else 0.98
    problem = Problem(f=-1.0, obstacle=lambda x: ufl.sqrt(edge - 1e-4 - x[0]) - 2.0)
    with pytest.raises(InputError, match="obstacle is not finite"):
        solve(problem, domain, element)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("element", ["CR", "P1"])
@pytest.mark.parametrize(
    "data",
    [
        {"f": 1e200},
        {"f": lambda x: 1e200 * (1.0 + x[0])},
        {"g": 1e200},
        {"dirichlet": 1e200},
        {"obstacle": -1e308},  # below what PETSc takes for no bound
    ],
)
def test_data_that_are_too_large_are_refused(data, element):
    with pytest.raises(InputError, match=r"squares overflow|obstacle is not finite"):
        solve(Problem(**data), HELD_ABOVE.mesh(0.25), element)


@pytest.mark.parametrize("element", ["CR", "P1"])
@pytest.mark.parametrize("f", [-5.0, lambda x: -5.0 + x[0]], ids=["number", "function"])
def test_ranks_without_cells(element, f):
    """One triangle for all ranks; a process of its own solves the same."""
    triangle = Polygon([[0, 0], [1, 0], [0, 1]], ["contact", "dirichlet", "neumann"])
    *_, solution = solve_levels(Problem(f=f), triangle.mesh(2**0.5), 4, element)
    *_, alone = solve_levels(Problem(f=f), triangle.mesh(2**0.5, MPI.COMM_SELF), 4, element)
    assert solution.energy == pytest.approx(alone.energy, rel=1e-8)
    assert solution.contact.number_active == alone.contact.number_active == 8
    if element == "CR":
        assert solution.certificate.bound_h1 == pytest.approx(alone.certificate.bound_h1)


@pytest.mark.parametrize(
    ("value", "said"), [("abc", "refuses -signorini_snes_atol: .*abc"), ("-1", "is -1; it must")]
)
def test_a_tolerance_that_is_none_is_the_users_mistake(options, value, said):
    options("snes_atol", value)
    with pytest.raises(InputError, match=said):
        solve(PROBLEM, HELD_ABOVE.mesh(0.25))


def test_a_tolerance_of_zero_ends_in_rounding(options):
    options("snes_atol", 0)
    *_, solution = solve_levels(PROBLEM, HELD_ABOVE.mesh(0.25), 3)
    assert solution.contact.kkt.residual < 1e-12


def test_a_smaller_tolerance_costs_no_newton_steps(options):
    usual = solve(PROBLEM, HELD_ABOVE.mesh(0.05))
    options("snes_atol", 1e-12 * usual.level.system.residual_scale)
    exact = solve(PROBLEM, HELD_ABOVE.mesh(0.05))
    assert exact.contact.kkt.residual <= 1e-12
    assert exact.iterations.newton == usual.iterations.newton
    assert exact.iterations.linear > usual.iterations.linear


def test_no_option_is_left_behind():
    before = PETSc.Options().getAll()
    solve(PROBLEM, HELD_ABOVE.mesh(0.2))
    assert PETSc.Options().getAll() == before


def test_monitor_sees_every_step():
    seen = []
    solution = solve(PROBLEM, HELD_ABOVE.mesh(0.05), monitor=lambda *facts: seen.append(facts))
    steps = [fact[1] for fact in seen]
    assert steps == list(range(solution.iterations.newton + 1))
    assert seen[-1][2] <= 1e-8 * solution.level.system.residual_scale
    assert seen[-1][3] == solution.contact.number_active
    assert seen[-1][4] == solution.iterations.linear
    assert all(MPI.COMM_WORLD.bcast(fact) == fact for fact in seen)


@pytest.mark.parametrize("scale", [1e-35, 1e-8, 1.0, 1e8])
def test_data_of_any_magnitude(scale):
    """u is linear in the data while the obstacle is 0: nothing in the solver is absolute."""
    one = solve(PROBLEM, HELD_ABOVE.mesh(0.1))
    scaled = solve(
        Problem(f=lambda x: scale * 2 * np.pi * ufl.sin(2 * np.pi * x[0])), HELD_ABOVE.mesh(0.1)
    )
    assert np.allclose(scaled.u.x.array / scale, one.u.x.array, atol=1e-7)
    assert scaled.contact.number_active == one.contact.number_active


@pytest.mark.parametrize("element", ["CR", "P1"])
def test_zero_data_give_zero(element):
    solution = solve(Problem(), HELD_ABOVE.mesh(0.25), element)
    assert np.all(solution.u.x.array == 0.0)
    assert solution.energy == 0.0


@pytest.mark.slow
def test_levels_start_where_the_one_below_ended():
    """Each mesh has four times the cells, and energies of CR approach J from below."""
    solutions = list(solve_levels(PROBLEM, HELD_ABOVE.mesh(0.25), 4))
    cells = [solution.cells for solution in solutions]
    assert cells == [cells[0] * 4**k for k in range(4)]
    energies = np.array([solution.energy for solution in solutions])
    assert np.all(np.diff(energies) > 0)
    assert energies[-1] == pytest.approx(-0.461754, rel=2e-3)
    assert [solution.level.number for solution in solutions] == [0, 1, 2, 3]


def test_what_python_shows_is_a_line() -> None:
    """And takes no part in what is collective: on one rank alone it does not hang."""
    example = exact.S1
    domain = example.structured(8)
    solution = solve(example.problem, domain)
    shown = [repr(each) for each in (solution, solution.contact, domain, example.problem)]
    assert shown[0].startswith("<Solution: CR, 408 dofs, 8 of 16 facets in contact, force ")
    assert shown[1].startswith("<ContactFacts: 8 of 16 facets, length 1, force ")
    assert shown[2].startswith("<Domain: 256 cells; facets")
    assert shown[3] == "Problem(f=_s1_load, dirichlet=0.0, exact=<lambda>)"
    assert repr(example) == f"<Example: S1, {shown[3]}>"
    assert repr(Polygon.circle([0, 0], 1, "neumann", 0.05)) == "<Polygon: 126 edges: 126 neumann>"
    hole = Polygon(0.5 + 0.1 * HELD_ABOVE.vertices, ["neumann"] * 4)
    assert repr(Polygon(HELD_ABOVE.vertices, HELD_ABOVE.boundary, holes=[hole])) == (
        "<Polygon: 8 edges: 1 contact, 6 neumann, 1 dirichlet, 1 hole>"
    )
    assert "np." not in repr(solution.contact.kkt) + repr(solution.iterations)
    certificate = solution.certificate
    assert repr(solution).endswith(f", error at most {at_most(certificate.bound_h1)}>")
    assert repr(certificate).startswith("<Certificate: error at most ")
    assert all(len(line) < 100 for line in (*shown, repr(solution), repr(certificate)))


@pytest.mark.parametrize("element", ["CR", "P1"])
def test_windows_are_where_the_dofs_are(element):
    """Squares along Γ1 by coordinates that DOLFINx gives, whichever rank has a dof's facets."""
    size = 0.05
    solution = solve(PROBLEM, HELD_ABOVE.mesh(size), element=element)
    system, V = solution.level.system, solution.u.function_space
    x = V.tabulate_dof_coordinates()[system.bounded, 0]
    everywhere = np.concatenate(MPI.COMM_WORLD.allgather(x))
    low, high = everywhere.min(), everywhere.max()
    expected = WINDOWS * (x - low) / (high - low)
    # P1 takes a point of a facet beside the vertex
    near = 1e-9 if element == "CR" else WINDOWS * size
    found = system.windows  # all on one line, the first of the coordinates
    assert (found >= np.floor(expected - near).clip(0, WINDOWS - 1)).all()
    assert (found <= np.floor(expected + near).clip(0, WINDOWS - 1)).all()
    assert len(np.unique(np.concatenate(MPI.COMM_WORLD.allgather(found)))) == WINDOWS
