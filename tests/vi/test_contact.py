"""Contact facts against what a solution with known pressure and known contact must show."""

import numpy as np
import pytest
import ufl
from dolfinx.mesh import GhostMode, create_unit_cube, locate_entities_boundary, meshtags
from mpi4py import MPI

from signorini_cr import Contact, Dirichlet, Domain, Polygon, Problem, solve
from signorini_cr.output.sheets import contact_csv

pytestmark = pytest.mark.ranks

RECTANGLE = [[-1.0, 0.0], [1.0, 0.0], [1.0, 1.0], [-1.0, 1.0]]


def rectangle(size, boundary=("contact", "dirichlet", "dirichlet", "dirichlet"), **more):
    return Polygon(RECTANGLE, boundary, **more).mesh(size, MPI.COMM_WORLD)


def root(x):
    """r^{3/2} cos(3θ/2): contact on x < 0, pressure 3/2 √|x|."""
    return (x[0] ** 2 + x[1] ** 2) ** 0.75 * ufl.cos(1.5 * ufl.atan2(x[1], x[0]))


@pytest.fixture(scope="module", params=["CR", "P1"])
def solution(request):
    return solve(Problem(exact=root, f=0.0), rectangle(1 / 32), request.param)


def test_force_is_the_integral_of_the_pressure(solution):
    # ∫_{-1}^0 3/2 √|x| dx = 1; for P1 the share of the corner dof on Γ0 is lost: 3/4 h
    assert solution.contact.force == pytest.approx(1.0, abs=0.003 + (solution.element == "P1") / 32)


def test_contact_is_where_it_must_be(solution):
    contact = solution.contact
    assert contact.number == 64
    assert contact.length == pytest.approx(1.0, abs=2 / 32)
    assert len(contact.transitions) == 1
    assert np.allclose(contact.transitions[0], 0.0, atol=2 / 32)


def test_pressure_per_facet(solution):
    table = solution.contact.table()
    if MPI.COMM_WORLD.rank == 0:
        inner = (table["x"] < -0.1) & (table["x"] > -0.9)
        exact = 1.5 * np.sqrt(-table["x"][inner])
        assert np.abs(table["pressure"][inner] - exact).max() < 0.03
        # A facet of P1 next to the contact shares a vertex with it
        beyond = ~table["active"] & (table["x"] > table["x"][table["active"]].max() + 1.5 / 32)
        assert np.abs(table["pressure"][beyond]).max() < 1e-6
        touching = np.abs(table["u"][table["active"]])
        assert touching[table["x"][table["active"]] > -1.0 + 1 / 32].max() < 1e-12
        # With P1 a vertex of the first facet is on Γ0: an equation, solved like the others
        residual = solution.contact.kkt.residual * solution.level.system.residual_scale
        assert touching.max() < (1e-12 if solution.element == "CR" else max(1e-12, residual))


def test_kkt_figures(solution):
    kkt = solution.contact.kkt
    assert kkt.min_gap >= 0.0
    assert kkt.min_pressure > -1e-6
    assert kkt.residual < 1e-8
    # On active dofs the gap is zero; on the others Cauchy and Schwarz bound Σ |r (u − α)|
    system, comm = solution.level.system, MPI.COMM_WORLD
    gap = solution.u.x.array[system.bounded] - system.lower[system.bounded]
    norm = np.sqrt(comm.allreduce(float(gap @ gap)))
    assert kkt.complementarity <= kkt.residual * system.residual_scale * norm
    if solution.element == "CR":
        assert kkt.complementarity < 1e-8


def test_table_runs_along_the_boundary(solution):
    table = solution.contact.table()
    if MPI.COMM_WORLD.rank == 0:
        assert np.allclose(table["arc_length"], (np.arange(64) + 0.5) / 32)
        assert np.allclose(table["x"], table["arc_length"] - 1.0)
        assert set(table["part"]) == {0}
    else:
        assert table is None


def test_names_of_several_parts():
    """By where the facets are: below and on the right, one piece of Γ1."""
    domain = rectangle(0.2, ("floor", "wall", "top", "top"), names=["floor", "wall", "top"])
    held = {"floor": Contact(0.0), "wall": Contact(-0.1), "top": Dirichlet(0.0)}
    contact = solve(Problem(f=-1.0, conditions=held), domain).contact
    assert set(contact.names[contact.midpoints[:, 1] < 1e-9]) <= {"floor"}
    table = contact.table()
    if MPI.COMM_WORLD.rank == 0:
        assert set(table["part"]) == {0} and list(table)[-1] == "name"
        assert np.array_equal(table["name"] == "floor", table["y"] < 1e-9)
        assert np.array_equal(table["name"] == "wall", table["x"] > 1.0 - 1e-9)
        text = contact_csv(table)
        assert text.splitlines()[0].endswith(",name") and text.splitlines()[-1].endswith(",wall")


def test_closed_curves_and_several_parts():
    hole = Polygon([[-0.2, 0.4], [0.2, 0.4], [0.2, 0.7], [-0.2, 0.7]], ["contact"] * 4)
    domain = rectangle(0.1, ["contact", "dirichlet", "contact", "dirichlet"], holes=[hole])
    contact = solve(Problem(f=-1.0, obstacle=-0.05), domain).contact
    table = contact.table()
    if MPI.COMM_WORLD.rank == 0:
        x, y = table["x"], table["y"]
        assert sorted(np.unique(table["part"])) == [0, 1, 2]
        for part in range(3):
            arc = table["arc_length"][table["part"] == part]
            length = table["length"][table["part"] == part]
            assert np.allclose(arc, np.cumsum(length) - 0.5 * length)
        around = (np.abs(x) < 0.25) & (np.abs(y - 0.55) < 0.2)
        assert np.isclose(table["length"][around].sum(), 1.4)
        # Neighbours in the table are neighbours on the curve
        step = np.hypot(np.diff(x[around]), np.diff(y[around]))
        assert step.max() < 0.11
        # Ω to the left: around a hole the walk is clockwise
        area = 0.5 * np.sum(
            (x - 0.0)[around] * (np.roll(y[around], -1) - y[around])
            - (y - 0.5)[around] * (np.roll(x[around], -1) - x[around])
        )
        assert area < 0


def test_symmetry_gives_symmetric_facts():
    contact = solve(
        Problem(f=lambda x: -ufl.cos(np.pi * x[0]), obstacle=-0.01), rectangle(1 / 16)
    ).contact
    points = np.sort(contact.transitions[:, 0])
    assert len(points) > 0
    assert np.allclose(points, -points[::-1], atol=1 / 16)


def test_no_contact_and_all_contact():
    free = solve(Problem(f=1.0, obstacle=-5.0), rectangle(0.2)).contact
    assert free.number_active == 0 and abs(free.force) < 1e-8
    assert free.length == 0.0 and len(free.transitions) == 0
    pressed = solve(Problem(f=-1.0, obstacle=5.0, dirichlet=5.0), rectangle(0.2)).contact
    assert pressed.number_active == pressed.number > 0
    assert pressed.length == pytest.approx(2.0) and len(pressed.transitions) == 0


@pytest.mark.parametrize("element", ["CR", "P1"])
def test_three_dimensions(element):
    """A problem of the plane, carried into space: u does not depend on the third coordinate."""
    mesh = create_unit_cube(MPI.COMM_WORLD, 6, 6, 6, ghost_mode=GhostMode.none)
    bottom = locate_entities_boundary(mesh, 2, lambda x: np.isclose(x[2], 0.0))
    top = locate_entities_boundary(mesh, 2, lambda x: np.isclose(x[2], 1.0))
    facets = np.concatenate([bottom, top]).astype(np.int32)
    values = np.repeat(np.array([1, 2], dtype=np.int32), [len(bottom), len(top)])
    order = np.argsort(facets)
    domain = Domain.from_tags(mesh, meshtags(mesh, 2, facets[order], values[order]))
    contact = solve(
        Problem(f=lambda x: 2 * np.pi * ufl.sin(2 * np.pi * x[0])), domain, element
    ).contact
    assert contact.number == 72
    assert contact.force == pytest.approx(0.2658, abs=0.01)
    assert contact.kkt.residual < 1e-8
    table = contact.table()
    if MPI.COMM_WORLD.rank == 0:
        assert table["length"].sum() == pytest.approx(1.0)
        # f pulls up for x < 1/2: no contact there, but next to the middle
        assert table["x"][table["active"]].min() > 0.5
