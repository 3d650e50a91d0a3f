"""Adaptive refinement: marks, stopping rules, and the rate a corner takes from uniform meshes."""

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
import ufl
from helpers import HELD_ABOVE, SQUARE
from mpi4py import MPI

from signorini_cr import (
    InputError,
    NotConverged,
    Polygon,
    Problem,
    Solution,
    adapt_to_run,
    exact,
    solve,
    solve_adaptive,
    solve_in_time,
    solve_levels,
)
from signorini_cr.adaptive import mark
from signorini_cr.fem.space import facet_measures
from signorini_cr.mesh.domain import PARTS
from signorini_cr.mesh.families import structured
from signorini_cr.restart import Restart

pytestmark = pytest.mark.slow

WORLD = MPI.COMM_WORLD


def run(example, size=4, **limits):
    return list(solve_adaptive(example.problem, example.structured(size), **limits))


THROUGH = Polygon([[0, 0], [1, 0], [1, 1], [0, 1]], ["contact", "neumann", "dirichlet", "neumann"])
"""What flows from above to the contact below."""

MOST = {"S1": 4000, "B": 4000, "D": 10_000, "I": 700}


@pytest.fixture(scope="module")
def adapted() -> Callable[[str], list[Solution]]:
    """The solutions of an example up to so many dofs, solved once for all tests."""
    return cache(lambda name: run(exact.ALL[name], max_dofs=MOST[name]))


@pytest.mark.parametrize("fraction", [0.1, 0.5, 0.9, 1.0])
def test_marks_are_the_fewest_that_hold_the_fraction(fraction):
    everything = np.random.default_rng(0).exponential(size=1000) ** 3
    mine = everything[WORLD.rank :: WORLD.size]
    marked = mark(mine, fraction, WORLD)
    held = WORLD.allreduce(mine[marked].sum())
    number = WORLD.allreduce(int(marked.sum()))
    assert held >= (fraction - 1e-9) * everything.sum()
    largest = np.sort(everything)[::-1]
    assert largest[: number - 1].sum() < fraction * everything.sum() or fraction == 1.0


def test_marks_of_nothing():
    assert not mark(np.zeros(7), 0.5, WORLD).any()
    assert mark(np.zeros(0), 0.5, WORLD).shape == (0,)


def test_a_rank_without_cells_may_take_part():
    mine = np.arange(1.0, 5.0) if WORLD.rank == 0 else np.zeros(0)
    assert WORLD.allreduce(int(mark(mine, 0.4, WORLD).sum())) == 1


@pytest.mark.parametrize(
    ("numbers", "fraction", "wanted"),
    [
        ([1e-312, 2e-312], 0.5, [False, True]),
        ([5e-324, 1e-323], 0.9, [True, True]),
        ([1e308, 1e308], 0.5, [True, True]),
        ([1.0, np.inf], 0.5, [False, True]),
        ([1.0, np.nan], 0.5, [False, False]),
    ],
)
def test_marks_of_any_numbers_come_to_an_end(numbers, fraction, wanted):
    """Their sum may be beyond all numbers, and 1e-12 of the largest below all."""
    mine = slice(None) if WORLD.rank == 0 else slice(0)
    with np.errstate(all="ignore"):
        marked = mark(np.array(numbers)[mine], fraction, WORLD)
    assert marked.tolist() == wanted[mine]


def constant(value: float) -> Problem:
    return Problem(dirichlet=value)


@pytest.mark.parametrize("value", [1.0, 1 / 3, 0.1 + 0.3])
def test_nothing_but_rounding_ends_the_sequence(value):
    """Finer meshes have more rounding: a constant needs one mesh, whatever is asked of it."""
    domain = THROUGH.mesh(0.5)
    (solution,) = solve_adaptive(constant(value), domain)
    bound = solution.certificate.bound_h1
    assert 0.0 < bound < 1e-12
    assert [s.dofs for s in solve_adaptive(constant(value), domain, levels=5)] == [solution.dofs]
    (_,) = solve_adaptive(constant(value), domain, tolerance=1.01 * bound)
    solutions = solve_adaptive(constant(value), domain, tolerance=0.5 * bound)
    assert next(solutions).dofs == solution.dofs
    with pytest.raises(NotConverged, match="what is left of it is rounding") as caught:
        next(solutions)
    assert caught.value.level == 0


def test_nothing_but_rounding_ends_the_search_for_a_mesh():
    solution = solve(constant(1.0), THROUGH.mesh(0.5))
    (tried,) = adapt_to_run(lambda _: [(1.0, solution), (2.0, solution)])
    assert tried.rounded and not tried.meshes
    search = adapt_to_run(lambda _: [(1.0, solution)], tolerance=1e-14)
    assert next(search).rounded
    with pytest.raises(NotConverged, match="what is left of it is rounding"):
        next(search)


def test_a_bound_that_is_more_than_cells_hold_is_no_rounding():
    """What κ does between points, and loads that no point sees, are parts that meshes reduce."""

    def tensor(x):
        return ufl.as_matrix([[1 + 0.3 * ufl.sin(4 * x[0]), 0], [0, 1]])

    def spot(x):
        r2 = (x[0] - 0.4371) ** 2 + (x[1] - 0.4129) ** 2
        return ufl.conditional(ufl.lt(r2, 1e-16), 1e4, 0.0)

    held = ["contact", "dirichlet", "neumann", "dirichlet"]
    flowing = Problem(coefficient=tensor, dirichlet=lambda x: -x[1], g=-1.0)
    for problem, labels in (
        (flowing, held),
        (Problem(f=spot), ["contact", *["dirichlet"] * 3]),
    ):
        domain = Polygon(SQUARE.vertices, labels).mesh(0.5)
        bounds = [s.certificate.bound_h1 for s in solve_adaptive(problem, domain, levels=4)]
        assert len(bounds) == 4 and bounds[-1] < 0.2 * bounds[0]


def test_a_line_that_no_point_sees_is_found():
    """Only what quadrature may have missed marks cells; where these are few, the bound falls."""

    def f(x):
        return ufl.conditional(ufl.lt(abs(x[0] + 0.3 * x[1] - 0.4371), 1e-12), 1e4, 0.0)

    domain = Polygon(SQUARE.vertices, ["contact", *["dirichlet"] * 3]).mesh(0.5)
    bounds = [s.certificate.bound_h1 for s in solve_adaptive(Problem(f=f), domain, levels=6)]
    assert bounds[-1] < 0.3 * bounds[0]


def test_refinement_ends_where_rounding_is_all_of_an_affine_solution():
    """The solver leaves less on finer meshes; once that is nothing, the bound would rise."""
    problem = Problem(dirichlet=lambda x: 1e6 + x[0] / 3.0, obstacle=-1e9)
    held = Polygon(THROUGH.vertices, ["contact", *["dirichlet"] * 3]).mesh(0.5)
    assert len(list(solve_adaptive(problem, held, max_dofs=3000))) == 1


def test_adaptive_meshes_restore_the_rate_at_a_corner():
    """On L uniform meshes give dofs^{-1/3}; adaptive ones must give dofs^{-1/2}."""
    solutions = run(exact.L, max_dofs=40_000)
    dofs = np.array([s.dofs for s in solutions])
    bounds = np.array([s.certificate.bound_h1 for s in solutions])
    late = dofs > 1000
    slope = np.polyfit(np.log(dofs[late]), np.log(bounds[late]), 1)[0]
    assert slope == pytest.approx(-0.5, abs=0.05)
    *_, uniform = solve_levels(exact.L.problem, exact.L.structured(4), 5)
    cheapest = dofs[bounds <= uniform.certificate.bound_h1].min()
    assert cheapest < 0.25 * uniform.dofs


@pytest.mark.parametrize("name", ["S1", "B", "D", "I"])
def test_bounds_hold_on_adaptive_meshes(name, adapted):
    example = exact.ALL[name]
    for solution in adapted(name):
        assert solution.errors[0] <= solution.certificate.bound_h1
        if example.energy is not None:
            low, high = solution.certificate.energy
            assert low <= example.energy <= high


def test_singular_solution_gets_its_rate_back(adapted):
    """D has r^{1/2}: uniform meshes give dofs^{-1/4}."""
    dofs, errors = np.array([(s.dofs, s.errors[0]) for s in adapted("D") if s.dofs > 500]).T
    assert np.polyfit(np.log(dofs), np.log(errors), 1)[0] == pytest.approx(-0.5, abs=0.06)


def test_boundary_parts_keep_their_lengths(adapted):
    first, *_, last = adapted("S1")

    def lengths(solution):
        domain = solution.domain
        return [
            WORLD.allreduce(float(facet_measures(domain.mesh, domain.facets(part))[1].sum()))
            for part in PARTS.values()
        ]

    assert np.allclose(lengths(first), lengths(last))
    assert last.cells > 10 * first.cells


def test_stopping_rules():
    tolerance = 0.2
    by_tolerance = run(exact.S1, tolerance=tolerance)
    assert [s.certificate.bound_h1 <= tolerance for s in by_tolerance[-2:]] == [False, True]
    assert len(run(exact.S1, levels=3)) == 3
    by_dofs = run(exact.S1, max_dofs=1000)
    assert 300 < by_dofs[-1].dofs <= 1000


def test_same_meshes_on_any_number_of_ranks():
    polygon = Polygon([[-1, 0], [1, 0], [0.5, 1], [-1, 0.7]], ["contact", *["dirichlet"] * 3])
    problem = Problem(f=1.0, obstacle=-0.01)
    dofs = [
        [s.dofs for s in solve_adaptive(problem, polygon.mesh(0.3, comm), levels=4)]
        for comm in (WORLD, MPI.COMM_SELF)
    ]
    assert np.allclose(*dofs, rtol=0.01)


def test_refusals():
    domain = exact.S1.structured(4)
    with pytest.raises(InputError, match="only a Crouzeix-Raviart"):
        list(solve_adaptive(exact.S1.problem, domain, element="P1"))
    with pytest.raises(InputError, match="fraction is 0"):
        list(solve_adaptive(exact.S1.problem, domain, fraction=0.0))
    with pytest.raises(InputError, match="levels is 0"):
        list(solve_adaptive(exact.S1.problem, domain, levels=0))
    for wrong in (-1.0, float("nan")):
        with pytest.raises(InputError, match=f"tolerance is {wrong}; it must be 0 or more"):
            list(solve_adaptive(exact.S1.problem, domain, tolerance=wrong))
    for how in (solve_adaptive, solve_levels):
        with pytest.raises(InputError, match="levels is of the type float: a whole number is"):
            list(how(exact.S1.problem, domain, levels=1.5))


def test_cells_that_rounding_would_spoil_end_the_sequence():
    """Where Γ0 meets Γg and κ is 1 and 1000 u is r^0.02: cells must not shrink to nothing."""
    square = Polygon(
        [[0, 0], [1, 0], [1, 1], [0.5, 1], [0, 1]],
        ["contact", "dirichlet", "neumann", "dirichlet", "neumann"],
    )
    problem = Problem(
        f=0.0,
        obstacle=-9.0,
        coefficient=lambda x: ufl.conditional(x[0] < 0.5, 1.0, 1e3),
        dirichlet=lambda x: x[0],
    )
    solutions = []
    with pytest.raises(NotConverged, match="cells have become so small") as caught:
        # κ jumps along sides of cells: there is nothing to enclose but the singularity
        for solution in solve_adaptive(problem, structured(square, 4), fraction=0.1):
            solutions.append(solution)
    assert caught.value.level == len(solutions) > 10
    h = solution.domain.mesh.h(2, np.arange(solution.level.data.cells.number, dtype=np.int32))
    assert 1e-12 < WORLD.allreduce(float(h.min()), op=MPI.MIN) < 1e-10


@pytest.mark.parametrize("read", [False, True])
@pytest.mark.parametrize("way", ["levels", "adaptive", "time"])
def test_all_ranks_go_on_from_what_was_taken_to_one_or_read_on_all(way: str, read: bool) -> None:
    domain, problem = HELD_ABOVE.mesh(0.3), Problem(f=-1.0, obstacle=-0.05)

    def solutions(**more: Any) -> list[Solution]:
        if way == "levels":
            return [*solve_levels(problem, domain, 3, **more)]
        if way == "adaptive":
            return [*solve_adaptive(problem, domain, levels=3, **more)]
        return [each for _, each in solve_in_time(problem, domain, end=0.3, steps=3, **more)]

    first, second, third = solutions()
    if way == "time":
        restart = Restart.of_steps([second, first])
    else:
        restart = Restart.of(second, Restart.of(first, None, way == "adaptive"), way == "adaptive")
    if read:
        restart = WORLD.bcast(replace(restart, space=None))
    more = {"done": 2} if way == "time" else {}
    again, last = solutions(restart=restart, **more)
    assert again.iterations.newton <= 1
    assert again.energy == pytest.approx(second.energy, rel=1e-9)
    assert (last.dofs, last.energy) == (third.dofs, pytest.approx(third.energy, rel=1e-9))
