"""Contact from above and from both sides."""

import numpy as np
import pytest
import ufl
from mpi4py import MPI
from scipy.optimize import lsq_linear

from signorini_cr import (
    Contact,
    Dirichlet,
    InputError,
    Material,
    Neumann,
    Polygon,
    Problem,
    Robin,
    families,
    solve,
    solve_adaptive,
    solve_levels,
)

WORLD = MPI.COMM_WORLD
RECTANGLE = [[-1, 0], [1, 0], [1, 1], [-1, 1]]
EDGES = ["floor", "right", "top", "left"]


def domain(size=0.25, comm=WORLD, edges=EDGES):
    return Polygon(RECTANGLE, edges, names=edges).mesh(size, comm)


def floor(x):
    return -0.1 + 0.05 * ufl.cos(9 * x[0])


def rim(x):
    return 0.2 + 0.1 * x[0]


def mirrored(sign, **terms):
    """The same problem, and with sign −1 the one that −u solves."""
    obstacle = (
        Contact(floor, **terms)
        if sign > 0
        else Contact(
            upper=lambda x: -floor(x),
            **{k: (v if k == "coefficient" else -v) for k, v in terms.items()},
        )
    )
    return Problem(
        f=lambda x: sign * (12 * ufl.sin(5 * x[0]) - 5),
        reaction=2.0,
        conditions={
            "floor": obstacle,
            "right": Robin(coefficient=3.0, external=sign * 0.5),
            "top": Dirichlet(lambda x: sign * rim(x)),
            "left": Neumann(lambda x: sign * x[1]),
        },
    )


@pytest.mark.slow
@pytest.mark.parametrize("terms", [{}, {"coefficient": 5.0, "external": 0.25, "g": 0.5}])
def test_contact_from_above_is_contact_from_below_upside_down(terms):
    """Whatever is computed, to the last digits that the order of operations leaves."""
    below, above = (solve_levels(mirrored(s, **terms), domain(), 4) for s in (1, -1))
    for one, other in zip(below, above, strict=True):
        size = np.abs(one.u.x.array).max(initial=0.0)
        assert np.allclose(one.u.x.array, -other.u.x.array, rtol=0, atol=1e-12 * max(size, 1.0))
        assert np.array_equal(one.contact.active, other.contact.active)
        assert one.contact.number_active > 0
        assert one.iterations.newton == other.iterations.newton
        assert one.iterations.linear == other.iterations.linear
        assert other.contact.force == pytest.approx(-one.contact.force, rel=1e-9)
        assert np.allclose(one.contact.transitions, other.contact.transitions, atol=1e-9)
        for name in ("min_gap", "min_pressure", "complementarity"):
            assert getattr(other.contact.kkt, name) == pytest.approx(
                getattr(one.contact.kkt, name), abs=1e-9
            )
        found, twin = one.certificate, other.certificate
        assert twin.bound_h1 == pytest.approx(found.bound_h1, rel=1e-9)
        assert twin.energy == pytest.approx(found.energy, rel=1e-9)
        assert np.allclose(one.contact.bounds["obstacle"], -other.contact.bounds["upper"])


def between(x):
    return 40 * ufl.sin(np.pi * x[0]) + 2


def dense(system):
    """The matrix, the right-hand side, and the bounds of all dofs."""
    indptr, columns, values = system.A.getValuesCSR()
    n = len(indptr) - 1
    A = np.zeros((n, n))
    A[np.repeat(np.arange(n), np.diff(indptr)), columns] = values
    low, high = (
        np.where(np.abs(v) < 1e15, v, np.copysign(np.inf, v)) for v in (system.lower, system.upper)
    )
    return A, system.b.copy(), low, high


def in_a_box(A, b, low, high):
    """min ½ xᵀA x − bᵀx in a box is min |Lᵀx − L⁻¹b|, A = L Lᵀ: SciPy's, on a dense matrix.

    That has but what is bounded, and by how much the rest follows it is solved for.
    """
    held = np.isfinite(low) | np.isfinite(high)
    held[0] = True  # there is to be one
    to_rest, x = A[np.ix_(~held, held)], np.empty(len(b))
    follows = np.linalg.solve(A[np.ix_(~held, ~held)], np.column_stack([b[~held], to_rest]))
    small, load = A[np.ix_(held, held)] - to_rest.T @ follows[:, 1:], b[held]
    L = np.linalg.cholesky(small)
    rhs = np.linalg.solve(L, load - to_rest.T @ follows[:, 0])
    found = lsq_linear(L.T, rhs, (low[held], high[held]), method="bvls", tol=1e-15)
    assert found.success
    x[held], x[~held] = found.x, follows[:, 0] - follows[:, 1:] @ found.x
    return x


@pytest.mark.slow
@pytest.mark.serial
@pytest.mark.parametrize("element", ["CR", "P1"])
@pytest.mark.parametrize("nested", [True, False])
def test_both_sides_against_a_solver_for_bounded_least_squares(element, nested):
    conditions = {
        "floor": Contact(lambda x: -0.1 + 0.02 * x[0], upper=0.15, g=-1.0),
        "right": Contact(upper=lambda x: 0.4 * x[1] - 0.05),
        "top": Dirichlet(0.0),
        "left": Contact(-0.2),
    }
    problem = Problem(f=between, reaction=1.0, conditions=conditions)
    meshes = families.structured(Polygon(RECTANGLE, EDGES, names=EDGES), 3, WORLD)
    sides = set()
    for solution in solve_levels(problem, meshes, 3, element=element, nested=nested):
        system = solution.level.system
        A, b, low, high = dense(system)
        x = in_a_box(A, b, low, high)
        assert np.allclose(solution.u.x.array, x, rtol=0, atol=1e-7 * np.abs(x).max())
        force = (A @ x - b)[system.bounded]
        at = (x <= low)[system.bounded] & (force > 0) | (x >= high)[system.bounded] & (force < 0)
        assert np.array_equal(solution.contact.active_set.mask, at)
        assert solution.contact.force == pytest.approx(force[at].sum(), rel=1e-6)
        assert solution.contact.kkt.min_gap >= 0.0
        assert solution.contact.kkt.min_pressure >= 0.0
        sides |= set(np.sign(solution.contact.pressure[solution.contact.active]))
    assert sides >= {1.0, -1.0}


WALLS = {"right": Neumann(), "top": Dirichlet(0.0), "left": Neumann()}
BUMP = lambda x: ufl.max_value(x[0] - 0.3, 0.0)  # noqa: E731
WAVE = lambda x: 0.1 * ufl.sin(7 * x[0])  # noqa: E731
ALIKE = {
    "all": (WAVE, WAVE),
    "zero": (0.0, 0.0),
    "from below": (lambda x: WAVE(x) - BUMP(x), WAVE),
    "from above": (0.0, BUMP),
}


@pytest.mark.slow
@pytest.mark.serial
@pytest.mark.parametrize("f", [-1.0, 1.0, between])
@pytest.mark.parametrize("name", ALIKE)
@pytest.mark.parametrize("element", ["CR", "P1"])
def test_bounds_that_are_the_same_hold_u_from_both_sides(element, name, f):
    """Where α = β u is given, as on Γ0, and the force has either sign."""
    obstacle, upper = ALIKE[name]
    conditions = WALLS | {"floor": Contact(obstacle, upper=upper)}
    meshes = families.structured(Polygon(RECTANGLE, EDGES, names=EDGES), 3, WORLD)
    pinned = 0
    for solution in solve_levels(Problem(f=f, conditions=conditions), meshes, 2, element=element):
        system = solution.level.system
        A, b, low, high = dense(system)
        held = high - low < 1e-12
        pinned += np.count_nonzero(held)
        x, rest = np.where(held, low, 0.0), ~held
        b -= A @ x
        x[rest] = in_a_box(A[np.ix_(rest, rest)], b[rest], low[rest], high[rest])
        assert np.allclose(solution.u.x.array, x, rtol=0, atol=1e-7 * np.abs(x).max())
        force = (A @ (x * rest) - b)[system.bounded]
        at, sides = np.abs(force) > 1e-9 * np.abs(force).max(), held[system.bounded]
        on_bound = sides | (x <= low)[system.bounded] | (x >= high)[system.bounded]
        assert np.array_equal(solution.contact.active_set.mask, at & on_bound)
        assert solution.contact.force == pytest.approx(force[at & on_bound].sum(), rel=1e-6)
        if element == "CR":
            assert solution.certificate.bound_h1 is not None
    assert pinned


@pytest.mark.parametrize("steep", [1e5, 1e8])
def test_without_a_function_between_the_bounds_there_is_no_certificate(steep):
    """A bump of α that no point of a facet shows: K is empty, and u is not."""

    def bump(x):
        return -0.1 + 0.3 * ufl.exp(-steep * (x[0] - 0.011) ** 2)

    conditions = WALLS | {"floor": Contact(bump, upper=0.1)}
    mesh = families.structured(Polygon(RECTANGLE, EDGES, names=EDGES), 2, WORLD)
    certificate = solve(Problem(f=-1.0, conditions=conditions), mesh).certificate
    assert certificate.bound_h1 is None and "nowhere above the upper bound" in certificate.reason


def test_bounds_that_touch_have_a_certificate():
    """In one point: a square in other words, two squares, sin x and x."""
    for below, above in (
        (lambda x: 0.0 * x[0], lambda x: x[0] ** 2 - 0.74 * x[0] + 0.1369),
        (lambda x: -(x[0] ** 2), lambda x: x[0] ** 2),
        (lambda x: ufl.sin(x[0] + 1.0), lambda x: x[0] + 1.0),
    ):
        conditions = WALLS | {"floor": Contact(below, upper=above)}
        mesh = families.structured(Polygon(RECTANGLE, EDGES, names=EDGES), 2, WORLD)
        certificate = solve(Problem(f=-1.0, conditions=conditions), mesh).certificate
        assert certificate.bound_h1 is not None, certificate.reason


@pytest.mark.slow
def test_rates_between_two_obstacles():
    """u smooth, on α for x < −0.3, on β for x > 0.3: H1 like h, L2 like h², bounds hold."""

    def u(x):
        return ufl.sin(2 * x[0]) * ufl.cosh(x[1]) + x[1] * s(x)

    def s(x):
        return (
            ufl.conditional(ufl.lt(x[0], 0.0), -1.0, 1.0) * ufl.max_value(abs(x[0]) - 0.3, 0.0) ** 3
        )

    def apart(x, sign):
        return 0.5 * ufl.max_value(0.3 - sign * -x[0], 0.0) ** 2

    # κ∂ₙu = −∂u/∂y = −s on the floor: above 0 for x < −0.3
    problem = Problem(
        exact=u,
        conditions={
            "floor": Contact(
                lambda x: ufl.sin(2 * x[0]) - apart(x, 1.0),
                upper=lambda x: ufl.sin(2 * x[0]) + apart(x, -1.0),
            ),
            "right": Neumann(),
            "top": Dirichlet(),
            "left": Dirichlet(),
        },
    )
    errors = []
    for solution in solve_levels(problem, domain(0.3), 4):
        errors.append(solution.errors)
        certificate = solution.certificate
        assert certificate.bound_h1 >= solution.errors[0]
        assert certificate.bound_h1 <= 1.35 * solution.errors[0]
    found = np.array(errors)
    rates = np.log2(found[:-1] / found[1:])[-1]
    assert rates[0] == pytest.approx(1.0, abs=0.03)
    assert rates[1] == pytest.approx(2.0, abs=0.1)
    table = solution.contact.table()
    if WORLD.rank == 0:
        x, pressure = table["x"], table["pressure"]
        assert (pressure[x < -0.4] > 0).all()
        assert (pressure[x > 0.4] < 0).all()
        assert (pressure[np.abs(x) < 0.2] == 0).all()
        assert list(table)[5:7] == ["obstacle", "upper"]


def test_pieces_that_an_upper_bound_holds():
    """Without Γ0: pushed up onto β; refused where nothing is in the way."""
    conditions = {
        "floor": Contact(upper=lambda x: 0.2 * x[0]), "right": Neumann(), "top": Neumann(),
        "left": Neumann(),
    }  # fmt: skip
    solution = solve(Problem(f=3.0, conditions=conditions), domain())
    assert solution.contact.force == pytest.approx(-6.0, rel=1e-7)
    with pytest.raises(InputError, match=r"net force .* of -6: only one above 0"):
        solve(Problem(f=-3.0, conditions=conditions), domain())
    both = conditions | {"floor": Contact(-0.1, upper=0.1)}
    for sign in (1, -1):
        solution = solve(Problem(f=sign * 3.0, conditions=both), domain())
        assert solution.contact.force == pytest.approx(-sign * 6.0, rel=1e-7)
    with pytest.raises(InputError, match="any constant that fits between the obstacles"):
        solve(Problem(f=0.0, conditions=both), domain())


@pytest.mark.parametrize(
    ("condition", "said"),
    [
        (Contact(0.2, upper=0.1), r"floor.obstacle: at \(.*\) it is 0.1 above the upper bound"),
        (
            Contact(upper=-0.5),
            r"^\S+.upper: .* the upper bound is -0.5 but the dirichlet value is 0; the upper "
            "bound must not be below it",
        ),
        (Contact(0.5, upper=1.0), "the obstacle is 0.5 but the dirichlet value is only 0"),
        (Contact(-0.1), r"at \(1, 0\), where .*is -0.1 but the other part's bound is only -0.2"),
    ],
)
def test_bounds_that_leave_nothing(condition, said):
    rest = {name: Dirichlet(0.0) for name in EDGES[1:]}
    if "above the upper" in said:  # not next to Γ0, which would be told first
        rest |= {"right": Neumann(), "left": Neumann()}
    if "other part" in said:
        rest["right"] = Contact(upper=lambda x: x[1] - 0.2)
    with pytest.raises(InputError, match=said):
        solve(Problem(f=1.0, conditions={"floor": condition, **rest}), domain())


def test_exact_solutions_that_pull_at_the_upper_bound():
    """u = −y has ∂ₙu = 1 on the floor: from above that is a pull."""
    from signorini_cr.data.consistency import doubts
    from signorini_cr.fem.problem import Forms

    where = domain()
    rest = {name: Dirichlet() for name in EDGES[1:]}
    problem = Problem(exact=lambda x: -x[1], conditions={"floor": Contact(upper=0.0), **rest})
    (said,) = doubts(Forms(problem, where.mesh, parts=where.parts), where)
    assert "the pressure on the obstacle is -1, below 0" in said


@pytest.mark.ranks
@pytest.mark.parametrize("adaptive", [False, True])
def test_ranks_make_no_difference(adaptive):
    """Reaction, losses of heat, bounds on both sides, a material: by one rank and by all."""
    inner = np.array([[-0.5, 0.3], [0.5, 0.3], [0.5, 0.6], [-0.5, 0.6]])
    whole = Polygon(RECTANGLE, EDGES, names=EDGES, materials={"steel": inner})
    problem = Problem(
        f=between,
        reaction=1.5,
        materials={"steel": Material(coefficient=300.0)},
        conditions={
            "floor": Contact(-0.1, upper=0.15, coefficient=2.0, external=-0.3),
            "right": Contact(upper=0.2, g=0.1),
            "top": Robin(coefficient=4.0, external=0.1),
            "left": Dirichlet(lambda x: 0.05 * x[1]),
        },
    )
    found = []
    for comm in (MPI.COMM_SELF, WORLD):
        meshes = whole.mesh(0.4, comm)
        solutions = (
            solve_adaptive(problem, meshes, levels=4)
            if adaptive
            else solve_levels(problem, meshes, 3)
        )
        for solution in solutions:
            contact, certificate = solution.contact, solution.certificate
        found.append([solution.dofs, solution.energy, contact.force, contact.length])
        found[-1] += [contact.number_active, certificate.bound_h1, *certificate.energy]
        found[-1] += np.sort(contact.transitions[:, :2].ravel()).tolist()
    assert found[1] == pytest.approx(found[0], rel=1e-7, abs=1e-9)
