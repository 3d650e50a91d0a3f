"""Steps of the solver on small problems: as many as today.

What is solved is shown elsewhere to be right; these are the figures that say at what price. More
steps break a promise; fewer are good news or a mistake, and either is to be looked at before the
table is changed.

    container/run python3 tests/vi/test_steps_pinned.py

prints the table as it would have to be now.
"""

import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest
import ufl
from mpi4py import MPI
from petsc4py import PETSc

sys.path[:0] = [str(Path(__file__).parent.parent)]

from helpers import SQUARE  # noqa: E402

from signorini_cr import (  # noqa: E402
    Contact,
    Dirichlet,
    Domain,
    Neumann,
    Problem,
    Robin,
    exact,
    solve_adaptive,
    solve_in_time,
    solve_levels,
)
from signorini_cr.mesh.families import structured  # noqa: E402
from signorini_cr.options import PREFIX  # noqa: E402

pytestmark = pytest.mark.slow

WORLD = MPI.COMM_WORLD


def square(n: int = 6, height: float = 1.0) -> Domain:
    """(0, 1)², squashed, all edges parts of their own."""
    domain = structured(SQUARE, n)
    domain.mesh.geometry.x[:, 1] *= height
    return domain


def waves(x: Any) -> Any:
    return -0.1 + 0.05 * ufl.cos(9 * x[0])


def jumping(contrast: float) -> Callable[[Any], Any]:
    return lambda x: ufl.conditional(x[0] < 0.45, contrast, 1.0)


def conditions(contact: Contact, right: Any = None, top: Any = None) -> dict[str, Any]:
    return {
        "floor": contact,
        "right": right or Neumann(0.0),
        "top": top or Dirichlet(0.0),
        "left": Neumann(lambda x: x[1]),
    }


@dataclass(frozen=True)
class Small:
    """A problem, its coarsest mesh, and how it is solved.

    Attributes:
        problem: The data.
        domain: Makes the mesh.
        steps: `solve_levels`, or what goes through other meshes.
        more: What that takes beside.
        options: PETSc's, without the prefix.
    """

    problem: Problem
    domain: Callable[[], Domain] = square
    steps: Callable[..., Any] = solve_levels
    more: Mapping[str, Any] = field(default_factory=lambda: {"levels": 4})
    options: Mapping[str, str] = field(default_factory=dict)

    def taken(self) -> tuple[str, ...]:
        """Newton steps and linear iterations on each mesh, or in each step; collective."""
        database = PETSc.Options(PREFIX)
        for name, value in self.options.items():
            database[name] = value
        try:
            solved = self.steps(self.problem, self.domain(), **self.more)
            found = [(each[1] if isinstance(each, tuple) else each).iterations for each in solved]
        finally:
            for name in self.options:
                database.delValue(name)
        return tuple(f"{each.newton}/{each.linear}" for each in found)


LOAD = -3.0
WAVY = Problem(f=lambda x: 12 * ufl.sin(5 * x[0]) - 5, conditions=conditions(Contact(waves)))
BETWEEN = Problem(
    f=lambda x: 40 * ufl.sin(7 * x[0]), conditions=conditions(Contact(waves, upper=0.05))
)
LEAKY = Problem(
    f=-5.0,
    reaction=2.0,
    conditions=conditions(
        Contact(waves, coefficient=5.0, external=0.25), Robin(coefficient=3.0, external=0.5)
    ),
)
FAR_UP = Problem(
    f=-1e-4,
    conditions=conditions(
        Contact(lambda x: 1e5 - 1e-5 + 5e-6 * ufl.cos(9 * x[0])), Neumann(0.0), Dirichlet(1e5)
    ),
)


def held_by_contact(contrast: float = 1.0) -> Problem:
    """Nothing but the obstacle holds u."""
    return Problem(
        f=LOAD,
        coefficient=jumping(contrast),
        conditions=conditions(Contact(waves), None, Neumann(0.0)),
    )


def stiff(contrast: float) -> Problem:
    return Problem(f=LOAD, coefficient=jumping(contrast), conditions=conditions(Contact(waves)))


SMALL = {
    "S1": Small(exact.S1.problem, lambda: exact.S1.structured(4)),
    "S1, each mesh from zero": Small(
        exact.S1.problem, lambda: exact.S1.structured(4), more={"levels": 4, "nested": False}
    ),
    "S1, P1": Small(
        exact.S1.problem, lambda: exact.S1.structured(4), more={"levels": 4, "element": "P1"}
    ),
    "A": Small(exact.A.problem, lambda: exact.A.structured(4)),
    "waves": Small(WAVY),
    "waves, each mesh from zero": Small(WAVY, more={"levels": 4, "nested": False}),
    "waves, Jacobi": Small(WAVY, options={"smoother": "jacobi"}),
    "waves, one mesh": Small(WAVY, lambda: square(24), more={"levels": 1}),
    "between": Small(BETWEEN),
    "c and b": Small(LEAKY),
    "held by contact": Small(held_by_contact()),
    "held by contact, P1": Small(held_by_contact(), more={"levels": 4, "element": "P1"}),
    "held by contact, κ jumps": Small(held_by_contact(1e4)),
    "κ jumps by 10²": Small(stiff(1e2)),
    "κ jumps by 10⁶": Small(stiff(1e6)),
    "κ jumps by 10⁹": Small(stiff(1e9), more={"levels": 3}),
    "thin": Small(WAVY, lambda: square(6, 0.02)),
    "thinner": Small(WAVY, lambda: square(6, 1e-3)),
    "adapted": Small(WAVY, steps=solve_adaptive, more={"levels": 6}),
    "far up": Small(FAR_UP, more={"levels": 3}),
    "in time": Small(
        Problem(f=lambda x: -9.0 * x[0], conditions=conditions(Contact(waves))),
        steps=solve_in_time,
        more={"end": 0.5, "steps": 5, "levels": 3},
    ),
}  # fmt: skip

TODAY: dict[str, tuple[str, ...]] = {
    "S1": ("2/8", "1/7", "1/7", "1/7"),
    "S1, each mesh from zero": ("2/8", "2/9", "2/10", "2/11"),
    "S1, P1": ("2/2", "1/6", "1/6", "2/8"),
    "A": ("4/13", "1/7", "1/6", "2/7"),
    "waves": ("3/11", "1/8", "2/9", "1/7"),
    "waves, each mesh from zero": ("3/11", "4/14", "5/18", "5/18"),
    "waves, Jacobi": ("3/16", "1/15", "2/18", "1/15"),
    "waves, one mesh": ("5/15",),
    "between": ("2/9", "2/8", "2/9", "1/8"),
    "c and b": ("2/8", "1/7", "1/7", "2/7"),
    "held by contact": ("1/7", "1/7", "1/7", "1/6"),
    "held by contact, P1": ("1/1", "2/8", "2/8", "2/8"),
    "held by contact, κ jumps": ("2/12", "1/11", "2/17", "1/14"),
    "κ jumps by 10²": ("2/10", "1/8", "2/13", "1/10"),
    "κ jumps by 10⁶": ("3/14", "1/10", "2/13", "1/14"),
    "κ jumps by 10⁹": ("3/15", "2/14", "2/13"),
    "thin": ("1/14", "1/21", "1/1", "1/10"),
    "thinner": ("1/14", "1/21", "1/1", "1/13"),
    "adapted": ("3/11", "1/7", "1/7", "1/8", "1/7", "1/7"),
    "far up": ("1/7", "1/6", "1/6"),
    "in time": ("2/2", "1/1", "1/1", "1/1", "1/1"),
}
"""
Newton steps and linear iterations on one rank, mesh by mesh, or step by step in time.
"""
MORE, ANYHOW = (1.5 if MPI.COMM_WORLD.size < 3 else 2.0), 12
"""Linear iterations that several ranks may take: by their number on one rank, and at least. Rows
of others are not up to date within a sweep, and what one rank factors several do not."""


@pytest.mark.parametrize("name", SMALL)
def test_steps_are_those_of_today(name: str) -> None:
    found, known = SMALL[name].taken(), TODAY[name]
    if WORLD.size == 1:
        assert found == known
        return
    assert len(found) == len(known)
    for now, before in zip(found, known, strict=True):
        (newton, linear), (least, few) = (map(int, each.split("/")) for each in (now, before))
        assert newton <= least + 1 and linear <= max(MORE * few, ANYHOW), (found, known)


if __name__ == "__main__":
    for each in SMALL:
        print(f'    "{each}": {SMALL[each].taken()},', flush=True)
