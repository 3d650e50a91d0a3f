"""Errors of one rank, as all ranks see them."""

from collections.abc import Callable, Iterator
from math import nan
from typing import Any

import pytest
import ufl
from dolfinx.fem import Constant
from helpers import HELD_ABOVE
from mpi4py import MPI

from signorini_cr import (
    Contact,
    Domain,
    Form,
    Polygon,
    Problem,
    Robin,
    Solver,
    adapt_to_run,
    read_gmsh,
    solve,
    solve_adaptive,
    solve_in_time,
    solve_levels,
)
from signorini_cr.errors import InputError, on_root
from signorini_cr.memory import ran_out_of_memory
from signorini_cr.output.vtu import write_solution
from signorini_cr.restart import Restart

WORLD = MPI.COMM_WORLD
SIDES = HELD_ABOVE.boundary


def test_the_end_of_memory_on_one_rank_is_told_as_such_on_all() -> None:
    def without_room() -> None:
        raise MemoryError("Unable to allocate 8 GiB")

    with pytest.raises((MemoryError, RuntimeError)) as caught:
        on_root(MPI.COMM_WORLD, without_room)
    assert ran_out_of_memory(caught.value)


def test_mistakes_have_the_same_words_on_all_ranks() -> None:
    def refused() -> None:
        raise InputError("size is 0; it must be above 0")

    with pytest.raises(InputError, match=r"^size is 0; it must be above 0$"):
        on_root(MPI.COMM_WORLD, refused)
    with pytest.raises((ZeroDivisionError, RuntimeError)) as caught:
        on_root(MPI.COMM_WORLD, lambda: 1 / 0)
    assert not ran_out_of_memory(caught.value)


def failing(here: Callable[..., Any]) -> Callable[..., Any]:
    """Fail on the last rank, say for want of a file; the others go on."""

    def function(*arguments: Any) -> Any:
        if WORLD.rank == WORLD.size - 1:
            raise OSError("table.csv: no such file")
        return here(*arguments)

    return function


def one(x: Any) -> float:
    return 1.0


def in_time(domain: Domain, **arguments: Any) -> Iterator[Any]:
    return solve_in_time(Problem(f=-1.0), domain, **{"end": 1.0, "steps": 2, **arguments})


def going_on(domain: Domain, **arguments: Any) -> None:
    _, solution = next(in_time(domain, steps=4))
    next(in_time(domain, steps=4, restart=Restart.of_steps([solution]), **arguments))


def laplace(u: Any, v: Any, dx: Any, ds: Any) -> ufl.Form:
    return ufl.inner(ufl.grad(u), ufl.grad(v)) * dx


def on_a_part(condition: Any, part: str = "neumann") -> Problem:
    return Problem(conditions={part: condition})


class OfOnesOwn(Robin):
    """A condition whose loss fails on one rank."""

    @property
    def loss(self) -> Any:
        return failing(one)(0)


class MadeOnesOwn(Robin):
    """A condition that can't be made on one rank."""

    def made(self, *arguments: Any) -> Any:
        return failing(super().made)(*arguments)


PROBLEMS = {
    **{
        key: Problem(**{key: failing(one)})
        for key in ("f", "g", "coefficient", "reaction", "obstacle", "dirichlet", "exact")
    },
    "b": on_a_part(Robin(coefficient=failing(one))),
    "u_ext": on_a_part(Robin(coefficient=1.0, external=failing(one))),
    "upper": on_a_part(Contact(-1.0, upper=failing(one)), "contact"),
    "loss": on_a_part(OfOnesOwn(coefficient=1.0)),
    "made": on_a_part(MadeOnesOwn(coefficient=1.0)),
    "form": Problem(form=Form(failing(laplace))),
    "load": Problem(form=Form(laplace, failing(lambda v, dx, ds: v * dx))),
}


@pytest.mark.parametrize("problem", PROBLEMS.values(), ids=PROBLEMS)
def test_a_datum_that_fails_on_one_rank_fails_on_all(problem: Problem) -> None:
    """And the next problem is solved by all of them."""
    domain = HELD_ABOVE.mesh(0.5)
    with pytest.raises((OSError, RuntimeError), match=r"table\.csv: no such file"):
        solve(problem, domain)
    assert solve(Problem(f=-1.0, obstacle=-0.1), domain).contact.force > 0.0


def test_weights_and_what_is_begun_with_fail_on_all_ranks() -> None:
    domain, problem = HELD_ABOVE.mesh(0.5), Problem(f=-1.0, obstacle=-0.1)
    solution = solve(problem, domain)
    for ask in (solution.mean, solution.integral):
        with pytest.raises((OSError, RuntimeError), match=r"table\.csv"):
            ask(weight=failing(one))
    with pytest.raises((OSError, RuntimeError), match=r"table\.csv"):
        solution.flux("contact", weight=failing(one))
    with pytest.raises((OSError, RuntimeError), match=r"table\.csv"):
        next(solve_in_time(problem, domain, end=1.0, steps=2, initial=failing(one)))


def test_a_size_that_one_rank_alone_refuses_is_refused_by_all() -> None:
    with pytest.raises(InputError, match=r"^size is -1: a positive number is needed$"):
        HELD_ABOVE.mesh(-1 if WORLD.rank == WORLD.size - 1 else 0.5)


@pytest.mark.parametrize(
    ("ask", "said"),
    [
        (lambda d: Problem(conditions=[1]), "conditions is of the type list: a dictionary by"),
        (lambda d: Problem(materials=None), "materials is of the type NoneType: a dictionary by"),
        (lambda d: Problem(form=3), "form is of the type int: a Form is needed"),
        (lambda d: solve(on_a_part(Robin(coefficient=None)), d), r"\].coefficient: None does not"),
        (lambda d: solve(Problem(), d, element=["CR"]), r"element \['CR'\] is unknown"),
        (lambda d: solve(Problem(), d, monitor="a"), "monitor is of the type str: a function"),
        (lambda d: next(solve_levels(Problem(), d, 2, max_time=-1)), "max_time is -1; it must be"),
        (lambda d: next(solve_levels(Problem(), d, 2, max_time=nan)), "max_time is nan; it must"),
        (lambda d: next(solve_levels(Problem(), d, 2, restart="x")), "restart is of the type str"),
        (lambda d: next(solve_adaptive(Problem(), d, max_dofs=nan)), "max_dofs is nan; it must"),
        (lambda d: next(solve_adaptive(Problem(), d, fraction="a")), "fraction is of the type str"),
        (lambda d: next(solve_adaptive(Problem(), d, tolerance=None)), "tolerance is of the type"),
        (lambda d: next(adapt_to_run(3)), "run is of the type int: a function is needed"),
        (lambda d: next(adapt_to_run(lambda _: None)), "what run returns is of the type NoneType"),
        (lambda d: next(adapt_to_run(lambda _: [], meshes=3)), "meshes is of the type int: a list"),
        (
            lambda d: next(adapt_to_run(lambda _: [solve(Problem(), d)])),
            "a time and a solution",
        ),
        (lambda d: solve(Problem(), d).flux(["contact"]), "a part is of the type list: a name or"),
        (lambda d: solve(Problem(), d).mean(["contact"]), "a part is of the type list: a name or"),
        (lambda d: write_solution(solve(Problem(), d), None), "path is of the type NoneType: the"),
        (
            lambda d: solve(Problem(g=ufl.FacetArea(d.mesh)), d),
            "it holds FacetArea, which can",
        ),
        (lambda d: next(in_time(d, end="1")), "end is of the type str: a number is needed"),
        (lambda d: next(in_time(d, steps=10**400)), "steps would be too short for numbers to tell"),
        (lambda d: next(in_time(d, end=1e308)), "times that is too much for a number"),
        (lambda d: next(in_time(d, end=10**400)), "end is larger than 1.8e"),
        (lambda d: next(in_time(d, scheme=["euler"])), r"scheme is \['euler'\]; it must be one of"),
        (lambda d: next(in_time(d, done=5)), "done is 5; it must be the number of a step"),
        (lambda d: next(in_time(d, done=1)), "restart: what to go on from and done, the number"),
        (lambda d: going_on(d), "restart: what to go on from and done, the number"),
        (lambda d: going_on(d, done=3), "euler goes on from 2 steps, the last one included, and t"),
        (lambda d: next(in_time(d, time=Constant(d.mesh, (1.0, 2.0)))), "it must be a dolfinx Con"),
        (
            lambda d: next(in_time(d, initial=lambda x: x)),
            r"initial has the shape \(2,\); a scalar",
        ),
        (
            lambda d: Solver(Problem(), d).solve(rate=nan),
            "rate: numbers that are finite are needed",
        ),
        (lambda d: solve(Problem(f=-1.0), d).flux("contact", "contact"), "each may be given once"),
        (lambda d: Polygon(HELD_ABOVE.vertices, SIDES, holes=[[1, 2]]), "a hole is of the type li"),
        (lambda d: Polygon.circle("a", 1.0, "neumann", 1.0), r"a point \[x, y\] of numbers"),
        (lambda d: Domain.from_tags(d.mesh, d.tags, parts=3), "parts is of the type int: a list"),
        (lambda d: read_gmsh("a.msh", names=3), "names is of the type int: a list of names"),
    ],
)
def test_arguments_of_other_kinds_are_refused_in_words(ask: Callable[[Domain], Any], said: str):
    with pytest.raises(InputError, match=said):
        ask(HELD_ABOVE.mesh(0.5))
