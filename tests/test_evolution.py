"""Problems in time: orders of the schemes, contact against a dense solver, certificates, ranks."""

from dataclasses import replace
from fractions import Fraction
from itertools import islice

import numpy as np
import pytest
import ufl
from dolfinx import fem
from helpers import SQUARE
from mpi4py import MPI
from scipy.optimize import lsq_linear

from signorini_cr import (
    Contact,
    Dirichlet,
    Form,
    InputError,
    Material,
    Neumann,
    NotConverged,
    Polygon,
    Problem,
    Robin,
    Solver,
    adapt_to_run,
    evolution,
    limits,
    norms,
    solve,
    solve_adaptive,
    solve_in_time,
    solve_levels,
)
from signorini_cr.compat import cell_nodes

pytestmark = pytest.mark.slow

WORLD = MPI.COMM_WORLD

HELD_ABOVE = {"floor": Contact(-0.1), "right": Neumann(), "top": Dirichlet(), "left": Neumann()}


def clock(domain):
    return fem.Constant(domain.mesh, 0.0)


@pytest.mark.parametrize(("scheme", "order"), [("euler", 1), ("bdf2", 2)])
def test_order_in_time(scheme, order):
    """u = (1 + x) e^{−t} + t³ y is in the space at any time: all of the error is the scheme's."""
    domain = SQUARE.mesh(0.4)
    t = clock(domain)

    def u(x):
        return (1 + x[0]) * ufl.exp(-t) + t**3 * x[1]

    problem = Problem(
        f=lambda x: 2.0 * (3 * t**2 * x[1] - (1 + x[0]) * ufl.exp(-t)) + 0.5 * u(x),
        reaction=0.5,
        conditions={
            "floor": Contact(-100.0, g=lambda x: -3.0 * t**3),
            "right": Dirichlet(u),
            "top": Dirichlet(u),
            "left": Neumann(lambda x: -3.0 * ufl.exp(-t)),
        },
        coefficient=3.0,
    )
    errors = []
    for steps in (12, 24):
        *_, (end, solution) = solve_in_time(
            problem, domain, end=1.0, steps=steps, scheme=scheme, capacity=2.0, time=t,
            initial=lambda x: 1 + x[0], levels=2,
        )  # fmt: skip
        assert end == 1.0
        exact = fem.Function(solution.u.function_space)
        exact.interpolate(lambda x: (1 + x[0]) * np.exp(-1.0) + x[1])
        off = np.abs(exact.x.array - solution.u.x.array).max(initial=0.0)
        errors.append(WORLD.allreduce(float(off), op=MPI.MAX))
    rates = np.log2(np.array(errors[:-1]) / errors[1:])
    assert rates == pytest.approx(order, abs=0.06)


def waves(t):
    """Contact that comes and goes."""
    walls = {"right": Neumann(), "top": Dirichlet(0.0), "left": Neumann()}
    return Problem(
        f=lambda x: -20.0 * ufl.sin(4.0 * t) * x[0],
        conditions=walls | {"floor": Contact(lambda x: -0.1 - 0.05 * ufl.sin(t), upper=0.08)},
    )


@pytest.mark.serial
@pytest.mark.parametrize("c", [0.0, lambda x, t: 1 + 40 * x[0] * t], ids=["no c", "c(x, t)"])
@pytest.mark.parametrize("scheme", ["euler", "bdf2"])
def test_steps_with_contact_against_a_dense_solver(scheme, c):
    """Mass and stiffness put together anew, each step SciPy's least squares in a box."""
    domain, steps, end = SQUARE.mesh(0.3), 12, 3.0
    t, k = clock(domain), 3.0 / 12
    past, states = [], set()
    problem = waves(t)
    if c:
        problem = replace(problem, reaction=lambda x: c(x, t))
    for time, solution in solve_in_time(
        problem, domain, end=end, steps=steps, scheme=scheme, time=t, initial=lambda x: x[1] - 1
    ):
        V = solution.u.function_space
        u, v = ufl.TrialFunction(V), ufl.TestFunction(V)

        def dense(form):
            return fem.assemble_matrix(fem.form(form)).to_dense()

        M, S = dense(u * v * ufl.dx), dense(ufl.inner(ufl.grad(u), ufl.grad(v)) * ufl.dx)
        if c:
            now = fem.Constant(domain.mesh, time)  # as a number it would be another form each time
            S += dense(c(ufl.SpatialCoordinate(domain.mesh), now) * u * v * ufl.dx)
        if not past:
            first = fem.Function(V)
            first.interpolate(lambda x: x[1] - 1)
            past = [first.x.array.copy()]
        x = ufl.SpatialCoordinate(domain.mesh)
        load = fem.assemble_vector(
            fem.form(waves(fem.Constant(domain.mesh, time)).f(x) * v * ufl.dx)
        )
        if scheme == "bdf2" and len(past) > 1:
            A, b = 1.5 / k * M + S, load.array + M @ (2.0 * past[-1] - 0.5 * past[-2]) / k
        else:
            A, b = M / k + S, load.array + M @ past[-1] / k
        system = solution.level.system
        free = np.setdiff1d(np.arange(len(b)), system.dirichlet)
        low, high = np.full(len(b), -np.inf), np.full(len(b), np.inf)
        middles = V.tabulate_dof_coordinates()[system.bounded]
        assert np.allclose(middles[:, 1], 0.0)
        low[system.bounded], high[system.bounded] = -0.1 - 0.05 * np.sin(time), 0.08
        L = np.linalg.cholesky(A[np.ix_(free, free)])
        found = np.zeros(len(b))
        found[free] = lsq_linear(
            L.T, np.linalg.solve(L, b[free]), (low[free], high[free]), method="bvls", tol=1e-15
        ).x
        assert np.allclose(solution.u.x.array, found, rtol=0, atol=2e-7)
        force = (A @ found - b)[system.bounded]
        held = (found <= low)[system.bounded] | (found >= high)[system.bounded]
        assert solution.contact.force == pytest.approx(force[held].sum(), abs=1e-6)
        states |= {int(np.sign(force[held].sum())) if held.any() else 0}
        past = [*past[-1:], found]
    assert states >= {-1, 1}


@pytest.mark.parametrize(
    "c",
    [lambda x, t: 1 + x[0] + t, lambda x, t: ufl.conditional(x[0] < 0.37, 100 * (1 + t), 0.0)],
    ids=["affine", "jumps"],
)
def test_reactions_that_vary_within_cells(c):
    """u = t φ(x), on which Euler is exact: the first step's own problem is solved by it, too."""
    domain, steps = SQUARE.mesh(0.2), 4
    t = clock(domain)

    def phi(x):
        return ufl.sin(2 * x[0] + x[1]) + x[0]

    problem = Problem(
        f=lambda x: (1 + c(x, t) * t) * phi(x) + 5 * t * ufl.sin(2 * x[0] + x[1]),
        reaction=lambda x: c(x, t),
        conditions={
            "floor": Contact(-100.0, g=lambda x: -t * ufl.cos(2 * x[0] + x[1])),
            **dict.fromkeys(["right", "top", "left"], Dirichlet(lambda x: t * phi(x))),
        },
    )
    errors = []
    for levels in (1, 2):
        steps_there = solve_in_time(problem, domain, end=1.0, steps=steps, time=t, levels=levels)
        for number, (time, solution) in enumerate(steps_there):
            mesh = solution.u.function_space.mesh
            e = solution.u - fem.Constant(mesh, time) * phi(ufl.SpatialCoordinate(mesh))
            square = fem.assemble_scalar(fem.form(ufl.inner(ufl.grad(e), ufl.grad(e)) * ufl.dx))
            error = np.sqrt(WORLD.allreduce(square))
            if number == 0:
                assert error <= solution.certificate.bound_h1 <= 1.1 * error
        errors.append(error)
    assert np.log2(errors[0] / errors[1]) == pytest.approx(1.0, abs=0.05)


def test_steps_are_those_of_problems_with_a_reaction():
    """The first step, solved by itself; and its certificate, which knows u₀ exactly."""
    domain = SQUARE.mesh(0.3)
    t = clock(domain)
    initial = lambda x: 0.5 * (x[1] - 1) + 0.1 * x[0]  # noqa: E731
    _, first = next(
        iter(solve_in_time(waves(t), domain, end=1.0, steps=4, time=t, initial=initial))
    )
    assert float(t.value) == 0.25
    alone = waves(t)
    by_itself = solve(
        Problem(
            f=lambda x: alone.f(x) + 4.0 * initial(x), reaction=4.0, conditions=alone.conditions
        ),
        domain,
    )
    assert np.allclose(first.u.x.array, by_itself.u.x.array, atol=1e-8)
    assert first.contact.force == pytest.approx(by_itself.contact.force, rel=1e-6)
    assert first.energy == pytest.approx(by_itself.energy, rel=1e-8)
    mine, other = first.certificate, by_itself.certificate
    assert mine.bound_energy_norm == pytest.approx(other.bound_energy_norm, rel=1e-3)
    assert mine.energy == pytest.approx(other.energy, rel=1e-4)


WALLS = {"right": Neumann(), "top": Dirichlet(0.0), "left": Neumann()}


def by_cells(domain, value):
    function = fem.Function(fem.functionspace(domain.mesh, ("DG", 0)))
    function.x.array[:] = value
    return function


def by_a_number(domain, value):
    return fem.Constant(domain.mesh, value)


@pytest.mark.parametrize("make", [by_cells, by_a_number])
@pytest.mark.parametrize("levels", [1, 3])
@pytest.mark.parametrize("where", ["f", "obstacle", "coefficient", "reaction", "b", "form"])
def test_what_changes_between_solves_is_assembled_anew(make, levels, where):
    """Also on meshes below, and with its certificate: all as if it had never been another."""
    domain = SQUARE.mesh(0.35)
    datum = make(domain, 1.0)
    data = {where: datum} if where in ("f", "coefficient", "reaction") else {}
    if where == "form":
        data = {"form": Form(lambda u, v, dx, ds: datum * ufl.inner(ufl.grad(u), ufl.grad(v)) * dx)}
    conditions = WALLS | {"floor": Contact(-0.1 * datum if where == "obstacle" else -0.1)}
    if where == "b":
        conditions["right"] = Robin(coefficient=datum, external=-0.3)
    problem = Problem(**{"f": -4.0, "conditions": conditions} | data)
    with Solver(problem, domain, levels) as solver:
        before = solver.solve()
        if make is by_cells:
            datum.x.array[:] = 6.0
        else:
            datum.value = 6.0
        after = solver.solve(before=before)
    *_, wanted = solve_levels(problem, domain, levels)
    assert np.allclose(after.u.x.array, wanted.u.x.array, rtol=0, atol=1e-7)
    assert abs(after.energy - before.energy) > 0.01
    assert after.contact.force == pytest.approx(wanted.contact.force, rel=1e-6, abs=1e-9)
    found, alone = after.certificate, wanted.certificate
    if where == "form":
        assert found.bound_h1 is None
    else:
        assert found.bound_energy_norm == pytest.approx(alone.bound_energy_norm, rel=1e-4)


@pytest.mark.serial
def test_factors_serve_as_long_as_the_matrix_is_the_same():
    """On one small mesh: kept while f, u_D or the obstacle change, made anew for another κ or b."""
    domain = SQUARE.mesh(0.15)
    numbers = {"f": 3.0, "obstacle": -0.05, "u_D": 0.1, "kappa": 1.0, "b": 0.5}
    data = {name: fem.Constant(domain.mesh, value) for name, value in numbers.items()}
    problem = Problem(
        f=lambda x: -data["f"] * (0.2 + x[0]),
        coefficient=data["kappa"],
        conditions={
            "floor": Contact(data["u_D"] + data["obstacle"]),
            "right": Robin(coefficient=data["b"], external=data["u_D"] - 0.1),
            "top": Dirichlet(data["u_D"]),
            "left": Neumann(),
        },
    )
    changes = [
        *(("f", 2.0), ("f", 5.0), ("obstacle", -0.08), ("u_D", 0.0), ("kappa", 0.6), ("f", 4.0)),
        *(("obstacle", -0.1), ("u_D", 301.0), ("b", 3.0), ("f", 6.0), ("kappa", 1.5)),
        ("kappa", 0.8),
    ]
    forces, kinds, solution = [], [], None
    with Solver(problem, domain) as solver:
        for name, value in changes:
            data[name].value = value
            solution = solver.solve(before=solution)
            alone = solve(problem, domain)
            assert np.allclose(solution.u.x.array, alone.u.x.array, rtol=0, atol=1e-7)
            assert solution.contact.force == pytest.approx(alone.contact.force, rel=1e-6)
            assert 0 < solution.contact.number_active == alone.contact.number_active
            assert solution.energy == pytest.approx(alone.energy, rel=1e-6)
            forces.append(solution.contact.force)
            kinds.append(solution.iterations.preconditioner)
    changed = np.abs(np.diff(forces)) > 1e-3
    assert changed.tolist() == [name != "u_D" for name, _ in changes[1:]]  # all is relative to it
    # factors are not worth while for what changes each time
    assert [kind == "a direct solver" for kind in kinds] == [True] * (len(changes) - 1) + [False]


@pytest.mark.parametrize("scheme", ["euler", "bdf2"])
def test_all_of_the_equation_may_depend_on_the_time(scheme):
    """u = (1 + t) y is in the space, and both schemes are exact for it."""
    domain = SQUARE.mesh(0.4)
    t = clock(domain)
    u, kappa = lambda x: (1 + t) * x[1], 1 + t**2
    problem = Problem(
        f=lambda x: x[1] + 2 * t * u(x),
        coefficient=lambda x: kappa,
        reaction=lambda x: 2 * t,
        conditions={
            "floor": Contact(-9.0, g=lambda x: -kappa * (1 + t)),
            "right": Robin(lambda x: 3 * t * u(x), coefficient=3 * t),
            "top": Robin(lambda x: kappa * (1 + t) + t * u(x), coefficient=t),
            "left": Neumann(),
        },
    )
    steps = solve_in_time(
        problem, domain, end=1.0, steps=4, scheme=scheme, time=t, initial=lambda x: x[1], levels=2
    )
    for time, solution in steps:
        exact = fem.Function(solution.u.function_space)
        exact.interpolate(lambda x, now=time: (1 + now) * x[1])
        assert np.allclose(solution.u.x.array, exact.x.array, rtol=0, atol=1e-7)
        assert 0.0 <= solution.certificate.bound_energy_norm < 1e-5


def test_a_pulse_that_is_next_to_nothing_at_first():
    """Its square is no number for some steps; the last ones are as if it were 0 there."""
    domain = SQUARE.mesh(0.5)
    t, start = clock(domain), 0.4

    def pulse(x):
        return -100.0 * ufl.exp(-(((t - 0.5) / 0.02) ** 2))

    def from_half(x):
        return ufl.conditional(t > start, pulse(x), 0.0)

    forces = []
    for f in (pulse, from_half):
        problem = Problem(f=f, conditions=WALLS | {"floor": Contact(-0.05)})
        steps = [*solve_in_time(problem, domain, end=1.0, steps=20, time=t)]
        forces.append([solution.contact.force for _, solution in steps])
        assert all(solution.certificate.bound_h1 is not None for _, solution in steps)
        assert max(forces[-1]) > 1.0
    assert forces[0] == pytest.approx(forces[1], rel=1e-6, abs=1e-9)


def test_what_goes_on_for_long_stands_still():
    """u_n tends to the stationary solution; steps then take nothing; multigrid, with its meshes."""
    domain = SQUARE.mesh(0.3)
    walls = {name: Dirichlet(0.0) for name in ("right", "top", "left")}
    problem = Problem(f=-30.0, conditions=walls | {"floor": Contact(-0.05), "right": Neumann()})
    for _, solution in solve_in_time(problem, domain, end=20.0, steps=10, levels=3):
        pass
    with Solver(problem, domain, 3) as solver:
        still = solver.solve()
        assert solver.solve(before=still).iterations.newton <= 1
    assert np.allclose(solution.u.x.array, still.u.x.array, atol=1e-6)
    assert solution.contact.force == pytest.approx(still.contact.force, rel=1e-5)
    assert solution.contact.number_active > 0


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"end": 0.0}, "end is 0.0"),
        ({"steps": 0}, "steps is 0"),
        ({"steps": 2.5}, "steps is of the type float: a whole number is needed"),
        ({"end": 1e-320}, "end is 1e-320; 2 steps would be too short"),
        ({"scheme": "crank"}, "one of euler, bdf2"),
        ({"capacity": -1.0}, "capacity is -1.0; it must be a number above 0"),
        ({"capacity": lambda x: x[0]}, "capacity is of the type function: a number above 0 is"),
        ({"capacity": 10**400}, r"capacity is larger than 1\.8e\+308"),
        ({"levels": 0}, "levels is 0"),
        ({"time": 0.5}, "time is 0.5; it must be a dolfinx Constant"),
    ],
)
def test_what_makes_no_sense_is_refused(wrong, said):
    domain = SQUARE.mesh(0.5)
    given = {"end": 1.0, "steps": 2} | wrong
    with pytest.raises(InputError, match=said):
        next(solve_in_time(waves(clock(domain)), domain, **given))
    problem = Problem(exact=lambda x: x[0], conditions=waves(0.0).conditions)
    with pytest.raises(InputError, match="f: a problem in time derives none from exact"):
        next(solve_in_time(problem, domain, end=1.0, steps=1))


@pytest.mark.parametrize("end", [np.float32(0.7), np.float16(0.7), Fraction(7, 10), np.int8(2)])
def test_times_are_floats_whatever_they_are_given_as(end) -> None:
    domain = SQUARE.mesh(0.5)
    problem, given = waves(clock(domain)), {"steps": np.uint8(255), "max_time": Fraction(10**4)}
    steps = solve_in_time(problem, domain, end=end, **given)
    assert [t for t, _ in islice(steps, 3)] == [float(end) * n / 255 for n in (1, 2, 3)]
    steps = solve_in_time(problem, domain, end=end, steps=np.int8(127))
    assert next(steps)[0] == float(end) * 1 / 127


@pytest.mark.parametrize("capacity", [np.float32(0.1), Fraction(1, 3), np.uint8(100)])
def test_a_capacity_counts_as_a_float(capacity) -> None:
    """Of the problem, and of a material beside another one."""
    given = replace(SQUARE, materials={"left": SQUARE.vertices * [0.5, 1.0]})
    for domain in (SQUARE.mesh(0.5), given.mesh(0.5)):
        found = []
        for each in (capacity, float(capacity)):
            own = {"left": Material(capacity=2 * each)} if domain.materials.numbers else {}
            problem = Problem(f=-1.0, conditions=HELD_ABOVE, materials=own)
            *_, (_, last) = solve_in_time(problem, domain, end=0.7, steps=2, capacity=each)
            found.append(last.u.x.array.tolist())
        assert found[0] == found[1]


def test_a_clock_of_another_precision_is_refused() -> None:
    domain = SQUARE.mesh(0.5)
    low = fem.Constant(domain.mesh, np.float32(0.0))
    with pytest.raises(InputError, match="it must be a dolfinx Constant, a float64"):
        next(solve_in_time(waves(low), domain, end=1.0, steps=1, time=low))


def test_bounds_that_come_to_contradict_one_another_are_refused():
    domain = SQUARE.mesh(0.5)
    low, held = clock(domain), clock(domain)
    held.value = 1.0
    problem = Problem(
        f=-1.0,
        conditions={
            "floor": Contact(low, upper=0.5),
            "right": Neumann(),
            "top": Dirichlet(held),
            "left": Contact(-1.0),
        },
    )
    with Solver(problem, domain, levels=2) as solver:
        solver.solve()
        low.value = 0.75
        with pytest.raises(InputError, match=r"floor.obstacle: at .* it is 0.25 above the upper"):
            solver.solve()
        low.value, held.value = 0.25, -2.0
        with pytest.raises(InputError, match=r"the obstacle is -1 but the dirichlet value is only"):
            solver.solve()
        held.value = 1.0
        assert solver.solve().contact.kkt.min_gap >= 0.0
    held.value, low.value = 1.0, 0.0
    steps = solve_in_time(problem, domain, end=1.0, steps=2, time=low)
    assert next(steps)[0] == 0.5
    with pytest.raises(InputError, match=r"it is 0.5 above the upper bound"):
        next(steps)


def test_no_time_counts_but_those_of_the_steps():
    """Neither the one a run before has left, nor the first, at which data may have no value."""
    domain = SQUARE.mesh(0.5)
    t = clock(domain)
    problem = Problem(
        f=lambda x: -1.0 / ufl.sqrt(t),
        coefficient=lambda x: 2.0 - t,
        conditions=waves(t).conditions | {"top": Dirichlet(lambda x: 1.0 - 0.9 * t)},
    )
    found = []
    for stale in (0.0, 5.0):
        t.value = stale
        run = solve_in_time(problem, domain, end=1.0, steps=2, time=t, initial=lambda x: 1.0 + t)
        found.append([solution.energy for _, solution in run])
    assert found[0] == pytest.approx(found[1], rel=1e-12)


def test_what_a_solver_cannot_do_with_is_refused():
    domain = SQUARE.mesh(0.5)
    with Solver(waves(clock(domain)), domain, levels=2) as solver:
        solution = solver.solve()
        assert repr(solver) == f"<Solver: {solution.dofs} dofs on the last of 2 meshes>"
        below = solve(waves(clock(domain)), domain)
        with pytest.raises(InputError, match=r"before: a Function on another mesh"):
            solver.solve(before=below)
        with pytest.raises(InputError, match=r"source is <function .*; a dolfinx Function"):
            solver.solve(source=lambda x: x[0])
    assert repr(solver).endswith("meshes, closed>")
    with pytest.raises(InputError, match="the solver is closed"):
        solver.solve(before=solution)


def known(solution):
    """Return what is certain about a solution."""
    found = solution.certificate
    return [found.bound_energy_norm, *found.energy, *solution.mean("domain"), *solution.flux("top")]


MOVING = {
    "external": lambda t: {"left": Robin(coefficient=2.0, external=1.0 - 4.0 * t)},
    "loss": lambda t: {"left": Robin(coefficient=2.0 + 50.0 * t)},
    "g": lambda t: {"left": Neumann(3.0 * t)},
    "given": lambda t: {"top": Dirichlet(t)},
    "obstacle": lambda t: {"floor": Contact(-0.2 + 0.1 * t)},
}


@pytest.mark.slow
@pytest.mark.parametrize("name", [*MOVING, "coefficient", "reaction", "f"])
def test_what_is_certain_of_a_solution_is_so_when_data_have_moved_on(name):
    """Asked for at once and after the last step, and of `Solver` and `solve` as well."""
    domain = SQUARE.mesh(0.4)
    t = clock(domain)
    conditions = {"floor": Contact(-0.2), "right": Neumann(), "top": Dirichlet(), "left": Neumann()}
    if name in MOVING:
        problem = Problem(f=-3.0, conditions=conditions | MOVING[name](t))
    else:
        problem = Problem(**({"f": -3.0, "conditions": conditions} | {name: 1.0 + 5.0 * t}))
    timing = {"end": 1.0, "steps": 2, "time": t}
    at_once = [known(solution) for _, solution in solve_in_time(problem, domain, **timing)]
    steps = list(solve_in_time(problem, domain, **timing))
    for expected, (_, solution) in zip(at_once, steps, strict=True):
        assert known(solution) == pytest.approx(expected, rel=1e-6, abs=1e-9)
    assert t.value == 1.0
    with Solver(problem, domain, levels=2) as solver:
        t.value = 0.25
        expected, first = known(solver.solve()), solver.solve()
        plain = solve(problem, domain)
        bound, bracket = plain.certificate.bound_energy_norm, plain.certificate.energy
        t.value = 1.0
        solver.solve(before=first)
        assert known(first) == pytest.approx(expected, rel=1e-6, abs=1e-9)
    again = solve(problem, domain)
    assert again.energy != pytest.approx(plain.energy, rel=1e-3)
    assert (plain.certificate.bound_energy_norm, plain.certificate.energy) == (bound, bracket)


CORNER = Polygon(
    [[0, 0], [1, 0], [1, -1], [2, -1], [2, 1], [0, 1]],
    ["top", "top", "floor", "right", "top", "left"],
    names=["top", "floor", "right", "left"],
)
"""L-shaped: at the reentrant corner, whose sides are both fixed, u is like r^(2/3)."""


def on_meshes(problem, domain, end, steps, **others):
    return lambda meshes: solve_in_time(
        problem, domain, end=end, steps=steps, levels=meshes, **others
    )


@pytest.mark.ranks
def test_a_single_step_adapts_as_the_problem_with_a_reaction_does():
    """The same meshes and bounds: from u = 0 a step has c + capacity/Δt and no other load."""
    domain = CORNER.mesh(0.6)
    problem = Problem(f=-4.0, reaction=0.5, conditions=waves(0.0).conditions)
    run = on_meshes(problem, domain, 0.25, 1, capacity=2.0)
    tried = list(adapt_to_run(run, max_dofs=900))
    told = [(each.last.dofs, each.bound) for each in tried]
    still = solve_adaptive(replace(problem, reaction=8.5), domain, max_dofs=900)
    wanted = [(each.dofs, each.certificate.bound_h1) for each in still]
    assert [dofs for dofs, _ in told] == [dofs for dofs, _ in wanted]
    assert [each for _, each in told] == pytest.approx([each for _, each in wanted], rel=1e-6)
    assert [len(each.meshes) for each in tried] == list(range(len(wanted))) and len(wanted) > 4
    first, *_ = adapt_to_run(run, max_dofs=900, meshes=tried[2].meshes)
    assert (first.last.dofs, first.bound) == pytest.approx(told[2], rel=1e-9)


def test_meshes_adapted_to_a_run_reach_the_best_order():
    """n^(−1/2) for n dofs, where uniform meshes have the corner's n^(−1/3)."""
    domain = CORNER.mesh(0.6)
    t = clock(domain)
    problem = waves(t)
    tried = adapt_to_run(on_meshes(problem, domain, 1.0, 3, time=t), max_dofs=3300)
    told = [(each.last.dofs, each.bound) for each in tried]
    uniform = []
    for levels in (2, 3, 4):
        run = list(on_meshes(problem, domain, 1.0, 3, time=t)(levels))
        bound = max(solution.certificate.bound_h1 for _, solution in run)
        uniform.append((run[-1][1].dofs, bound))
    half = [each for each in told if each[0] > 300]

    def order(found):
        n, bounds = np.log(found).T
        return -np.polyfit(n, bounds, 1)[0]

    assert order(half) == pytest.approx(0.5, abs=0.05)
    assert order(uniform) < 0.43
    (n, adapted), (m, refined) = half[-1], uniform[2]
    assert n == pytest.approx(m, rel=0.1) and adapted < 0.75 * refined


def middles(domain):
    return fem.functionspace(domain.mesh, ("DG", 0)).tabulate_dof_coordinates()[:, :2]


def by_place(points):
    """Unlike for any two cells."""
    return 3.0 + np.sin(7.0 * points[:, 0]) + np.cos(5.0 * points[:, 1])


def holder(corners, points):
    """The triangle that each point lies in, by barycentric coordinates."""
    sides = np.stack([corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]], axis=2)
    off = points[:, None] - corners[None, :, 0]
    first = np.linalg.solve(sides[None], off[..., None])[..., 0]
    least = np.minimum(first.min(axis=2), 1.0 - first.sum(axis=2))
    assert least.max(axis=1).min(initial=1.0) > 0.0
    return least.argmax(axis=1)


@pytest.mark.ranks
def test_functions_follow_meshes_that_are_shared_out_anew():
    """What is given after all is set up comes down to the cells that it would have come to."""
    domain = CORNER.mesh(0.6)
    problem = Problem(f=-4.0, conditions=waves(0.0).conditions)
    *_, tried = adapt_to_run(on_meshes(problem, domain, 0.01, 1), max_dofs=3000)
    meshes = tried.meshes
    if WORLD.size > 1:
        assert any(exchange is not None for _, _, exchange in meshes)
    datum = by_cells(domain, 1.0)
    problem = replace(problem, coefficient=datum)
    with Solver(problem, domain, meshes) as solver:
        first = solver.solve()
        datum.x.array[:] = by_place(middles(domain))
        found = solver.solve()
    corners = domain.mesh.geometry.x[cell_nodes(domain.mesh)][..., :2]
    corners = np.concatenate(WORLD.allgather(corners))
    fine = meshes[-1][0]
    last = by_cells(fine, 1.0)
    last.x.array[:] = by_place(corners[holder(corners, middles(fine))].mean(axis=1))
    wanted = solve(replace(problem, coefficient=last), fine)
    assert abs(found.energy - first.energy) > 0.01 * abs(first.energy)
    assert np.allclose(found.u.x.array, wanted.u.x.array, rtol=0, atol=1e-8)


def test_without_a_bound_no_mesh_is_adapted():
    domain = SQUARE.mesh(0.5)
    form = Form(lambda u, v, dx, ds: ufl.inner(ufl.grad(u), ufl.grad(v)) * dx)
    problem = Problem(f=-4.0, conditions=WALLS | {"floor": Contact(-0.1)}, form=form)
    with pytest.raises(InputError, match="goes by the certified bound, and there is none"):
        next(adapt_to_run(on_meshes(problem, domain, 1.0, 2), levels=2))


def test_what_makes_no_sense_to_adapt_is_refused():
    domain, other = CORNER.mesh(0.6), SQUARE.mesh(0.6)
    problem = waves(0.4)
    run = on_meshes(problem, domain, 1.0, 2)
    *_, tried = adapt_to_run(run, levels=3)
    for levels, said in (
        ("3", "levels is '3'; it must be a number"),
        (2.0, "levels is 2.0; it must be a number"),
        (tried.meshes[::-1], "not refined from this domain, in this order"),
    ):
        with pytest.raises(InputError, match=said):
            Solver(problem, domain, levels)
    with pytest.raises(InputError, match="not refined from this domain"):
        next(solve_in_time(problem, other, end=1.0, steps=1, levels=tried.meshes))
    with pytest.raises(InputError, match="the run has no steps"):
        next(adapt_to_run(lambda meshes: []))
    with pytest.raises(InputError, match="on the meshes that it is given"):
        list(adapt_to_run(lambda meshes: run([])))


def test_what_was_found_before_time_ran_out_is_there(monkeypatch):
    """A run takes a second; a third one, and what is to follow it, would end after five."""
    domain = CORNER.mesh(0.6)

    class Clock:
        now = 0.0

        @classmethod
        def perf_counter(cls):
            return cls.now

    monkeypatch.setattr(limits, "time", Clock)

    def run(meshes):
        yield from on_meshes(waves(0.4), domain, 1.0, 2)(meshes)
        Clock.now += 1.0

    found = []
    with pytest.raises(NotConverged, match="would take about 3 s, and of the time limit there"):
        for tried in adapt_to_run(run, max_time=4.5):
            found.append(len(tried.meshes))
    assert found == [0, 1]


def test_functions_with_other_values_are_carried_anew():
    """As weights, as what is projected and as initial values, on meshes that have seen them."""
    domain = SQUARE.mesh(0.5)
    k = fem.Function(fem.functionspace(domain.mesh, ("DG", 0)))
    problem = Problem(f=-3.0, conditions=HELD_ABOVE)
    *_, solution = solve_levels(problem, domain, 2)
    of_one = solution.integral(weight=1.0), solution.flux("top", weight=1.0)
    for value in (1.0, 2.0, -3.0):
        k.x.array[:] = value
        for weight in (k, lambda x: k * (1.0 + 0.0 * x[0])):
            found = solution.integral(weight=weight), solution.flux("top", weight=weight)
            for one, other in zip(of_one, found, strict=True):
                assert other.value == pytest.approx(value * one.value, rel=1e-8)
                ends = sorted((value * one.lower, value * one.upper))
                assert [other.lower, other.upper] == pytest.approx(ends, rel=1e-5)
    with Solver(problem, domain, levels=2) as solver:
        for value in (1.0, 2.0):
            k.x.array[:] = value
            assert solver.projected(k).x.array == pytest.approx(value, rel=1e-12)
        meshes = solver.refined

    def means(initial):
        run = solve_in_time(problem, domain, end=0.1, steps=2, initial=initial, levels=meshes)
        return [solution.mean().value for _, solution in run]

    for value in (0.0, 5.0):
        k.x.array[:] = value
        assert means(k) == pytest.approx(means(value), rel=1e-10)


def test_sources_and_rates_are_those_of_their_solve():
    """Bounds are asked for when both have other values; f = −3 with a source of 1 is −2."""
    domain = SQUARE.mesh(0.5)
    *_, wanted = solve_levels(Problem(f=-2.0, conditions=HELD_ABOVE), domain, 2)
    with Solver(Problem(f=-3.0, conditions=HELD_ABOVE), domain, levels=2) as solver:
        source = fem.Function(solver.V)
        source.x.array[:] = 0.5
        rate = np.full(solver.V.mesh.topology.index_map(2).size_local, 2.0)
        found = solver.solve(source=source, rate=rate)
        source.x.array[:], rate[:] = -7.0, 3.0
        solver.solve(source=source)
        assert found.certificate.energy == pytest.approx(wanted.certificate.energy, rel=1e-6)
        assert found.certificate.bound_h1 == pytest.approx(wanted.certificate.bound_h1, rel=1e-6)
        assert found.flux("top") == pytest.approx(wanted.flux("top"), rel=1e-6)
        wrong = np.ones(len(rate) + 3) if WORLD.rank == 0 else rate
        with pytest.raises(InputError, match="rate has the shape"):
            solver.solve(source=source, rate=wrong)
        with pytest.raises(InputError, match="source is 3; a dolfinx Function is needed"):
            solver.solve(source=3 if WORLD.rank == 0 else source)
        if WORLD.size > 1:
            with pytest.raises(InputError, match="given on some ranks, and none on others"):
                solver.solve(source=source if WORLD.rank == 0 else None)


def test_errors_of_another_degree_are_those_of_their_time():
    domain = SQUARE.mesh(0.5)
    t = clock(domain)
    problem = Problem(
        f=0.0, exact=lambda x: t * x[0] * x[1] ** 2, conditions=HELD_ABOVE, error_degree=8
    )
    run = [s for _, s in solve_in_time(problem, domain, end=1.0, steps=2, time=t)]
    wanted = [solution.errors for solution in run]
    t.value = 77.0
    assert [norms.errors(solution, 8) for solution in run] == pytest.approx(wanted, rel=1e-12)


def test_bounds_are_those_of_the_data_that_were_solved():
    """u = 1.5 (y² − 1), whatever variables and dictionaries of the data hold later."""
    domain, k, air = SQUARE.mesh(0.3), 1.0, {}
    free = HELD_ABOVE | {"floor": Neumann()}
    given = {"coefficient": lambda x: k, "exact": lambda x: k * 1.5 * (x[1] ** 2 - 1.0)}
    solution = solve(Problem(f=-3.0, conditions=free, materials=air, **given), domain)
    errors, flux = solution.errors, solution.flux("top")
    k, air["none"], free["top"] = 0.01, Material(coefficient=9.0), Neumann()
    for found, exact in ((solution.mean(), -1.0), (solution.integral(), -1.0), (flux, 3.0)):
        assert found.lower <= exact <= found.upper <= found.lower + 0.1
    assert solution.flux("top") == pytest.approx(flux, rel=1e-9)
    assert norms.errors(solution, 6) == pytest.approx(errors, rel=1e-9)


def of_ones_own(size):
    return Form(
        lambda u, v, dx, ds: size() * ufl.inner(ufl.grad(u), ufl.grad(v)) * dx,
        lambda v, dx, ds: -size() * v * dx,
    )


@pytest.mark.parametrize("form", [False, True], ids=["", "form"])
@pytest.mark.parametrize("scheme", ["euler", "bdf2"])
def test_functions_are_called_once_for_all_steps(scheme, form):
    """Though a scheme of second order takes two solvers: with 1 all the way, or 0.01 later."""
    domain, runs = SQUARE.mesh(0.5), []
    for later in (1.0, 0.01):
        k = 1.0
        given = {"form": of_ones_own(lambda: k)} if form else {"coefficient": lambda x: k}
        problem = Problem(
            f=lambda x: -3.0 * k,
            conditions={**HELD_ABOVE, "floor": Contact(lambda x: -0.1 * k)},
            **given,
        )
        energies = []
        for _, solution in solve_in_time(problem, domain, end=0.1, steps=3, scheme=scheme):
            energies.append(solution.energy)
            k = later
        runs.append(energies)
    assert runs[0] == pytest.approx(runs[1], rel=1e-12)


class Interrupted(Exception):
    pass


def test_a_solver_goes_on_where_setting_up_was_not_finished(monkeypatch):
    """With data that it refuses, or by an interruption, and then the former data again."""
    domain = SQUARE.mesh(0.5)
    c = fem.Constant(domain.mesh, 1.0)
    problem = Problem(f=-3.0, coefficient=lambda x: c * (1 + x[0]), conditions=HELD_ABOVE)
    with Solver(problem, domain, levels=2) as solver:
        first = solver.solve().energy
        for value in (np.inf, 1e308, -1.0):
            c.value = value
            with pytest.raises(InputError):
                solver.solve()
            c.value = 1.0
            assert solver.solve().energy == pytest.approx(first, rel=1e-8)
        for where in ("add", "multigrid"):
            c.value = 2.0
            with monkeypatch.context() as patch:
                patch.setattr(evolution.Hierarchy, where, raising(Interrupted))
                with pytest.raises(Interrupted):
                    solver.solve()
            c.value = 1.0
            assert solver.solve().energy == pytest.approx(first, rel=1e-8)


def raising(error):
    def function(*_, **__):
        raise error

    return function


def test_what_a_monitor_does_to_the_solver_it_watches():
    """J(u_h) is that of the data that were solved; a solver that it closes is freed afterwards."""
    domain = SQUARE.mesh(0.5)
    c = fem.Constant(domain.mesh, 1.0)
    problem = Problem(f=-3.0, coefficient=lambda x: c * (1 + x[0]), conditions=HELD_ABOVE)

    def change(*_):
        c.value = 3.0

    with Solver(problem, domain, levels=2) as solver:
        usual = solver.solve().energy
        solution = solver.solve(monitor=change)
        c.value = 1.0
        low, high = solution.certificate.energy
        assert solution.energy == pytest.approx(usual, rel=1e-8) and low < solution.energy < high
        closing = solver.solve(monitor=lambda *_: solver.close())
        assert closing.energy == pytest.approx(usual, rel=1e-8)
        with pytest.raises(InputError, match="the solver is closed"):
            solver.solve()


def test_weights_that_are_no_numbers():
    solution = solve(Problem(f=-3.0, conditions=HELD_ABOVE), SQUARE.mesh(0.5))
    for weight in (np.nan, np.inf):
        for figure in (solution.integral, lambda weight: solution.flux("top", weight=weight)):
            with pytest.raises(InputError, match=f"the weight is {weight}; it must be finite"):
                figure(weight=weight)


def test_a_solution_knows_the_problem_as_it_was_given():
    """Who solves it again has its functions called anew; a class may have arguments of its own."""

    class Ours(Problem):
        def __init__(self, load):
            super().__init__(f=load, conditions=HELD_ABOVE)

    domain, k = SQUARE.mesh(0.5), 1.0
    for problem in (Problem(f=lambda x: -3.0 * k, conditions=HELD_ABOVE), Ours(lambda x: -3.0 * k)):
        k = 1.0
        solution = solve(problem, domain)
        assert solution.problem is problem and solution.mean().lower < solution.mean().upper
        k = 2.0
        again, other = solve(solution.problem, domain), solve(Ours(-6.0), domain)
        assert again.energy == pytest.approx(other.energy, rel=1e-10)


def test_small_loads_of_later_solves_matter_as_well():
    domain = SQUARE.mesh(0.5)
    f = fem.Constant(domain.mesh, -3e10)
    small = {**HELD_ABOVE, "floor": Contact(-1e-113)}
    with Solver(Problem(f=f, coefficient=1e-20, conditions=small), domain) as solver:
        assert solver.solve().contact.number_active > 0
        f.value = -1e-131  # which holds u on the obstacle
        with pytest.raises(InputError, match="so small that their squares are lost"):
            solver.solve()
