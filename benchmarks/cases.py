"""The problems that benchmarks solve, and the linear solve that they are compared with."""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager

from mpi4py import MPI  # first: the PETSc of the wheels finds the MPI that is loaded

# isort: split
import petsc4py

petsc4py.init(["benchmark", "-options_left", "no"])  # the command line is not PETSc's

import numpy as np  # noqa: E402
import ufl  # noqa: E402
from harness import command_line, keep_memory, tabulate  # noqa: E402
from petsc4py import PETSc  # noqa: E402

from signorini_cr import (  # noqa: E402
    Contact,
    Dirichlet,
    Material,
    Neumann,
    Polygon,
    Problem,
    Robin,
    exact,
    families,
    solve_levels,
)
from signorini_cr.fem.space import ghosted_vector  # noqa: E402
from signorini_cr.mesh.domain import Domain  # noqa: E402
from signorini_cr.multigrid.cycle import Multigrid  # noqa: E402
from signorini_cr.multigrid.hierarchy import Hierarchy  # noqa: E402
from signorini_cr.solution import Solution  # noqa: E402

comm = MPI.COMM_WORLD

COARSEST = 23
"""Squares per unit length on the coarsest mesh: 0.05, 0.2, 0.8, 3.3, 13 M dofs on the third on."""

SIZE = 0.08
"""Size of the polygon's coarsest cells: as many dofs as the others."""

MOST = 500
"""CG steps after which a linear solve that is compared with is ended."""

Coarsest = Callable[[], Domain]

EXAMPLES = {"S1": exact.S1, "A": exact.A, "C 7/2": exact.root(3.5), "C 11/2": exact.root(5.5)}

CROOKED = Polygon(
    [[0, 0], [3, -0.4], [3.6, 1.1], [1.2, 1.4], [0.2, 2.0]],
    ["contact", "contact", "dirichlet", "neumann", "dirichlet"],
    holes=[Polygon([[1, 0.5], [1.7, 0.4], [1.3, 0.9]], ["contact", "neumann", "dirichlet"])],
)
PUSHED = Problem(
    f=lambda x: 12 * ufl.sin(5 * x[0]) - 5, g=lambda x: x[1] - 1, dirichlet=lambda x: 0.2 + x[1]
)


EDGES = ("floor", "right", "top", "left")


BURIED = Polygon(
    [[-1, 0], [1, 0], [1, 1], [-1, 1]],
    ["contact", "neumann", "dirichlet", "neumann"],
    materials={
        "layer": [[-2, 0.3], [2, 0.5], [2, 0.7], [-2, 0.5]],
        "block": [[-0.7, 0], [-0.2, 0], [-0.3, 0.25], [-0.6, 0.2]],
        "pipe": [[0.5, 0.2], [0.6, 0.1], [0.7, 0.2], [0.6, 0.3]],
    },
)
LAYERED = Problem(
    f=lambda x: 40 * ufl.sin(np.pi * x[0]) + 2,
    obstacle=-0.1,
    materials={
        "layer": Material(coefficient=0.01),
        "block": Material(coefficient=100.0),
        "pipe": Material(coefficient=0.01, f=-5.0),
    },
)


def _with_terms() -> dict[str, Problem]:
    """Problems on (−1, 1) × (0, 1) with more than the model problem has."""
    top, waves = Dirichlet(0.0), lambda x: 40 * ufl.sin(np.pi * x[0]) + 2
    walls = {"right": Neumann(), "left": Neumann(), "top": top}
    lossy = Robin(coefficient=10.0, external=-1.0)
    return {
        "reaction": Problem(waves, reaction=100.0, conditions=walls | {"floor": Contact(-0.1)}),
        "Robin": Problem(
            waves,
            conditions={
                "floor": Contact(-0.1, coefficient=20.0, external=-1.0),
                "right": lossy,
                "top": lossy,
                "left": lossy,
            },
        ),
        "both sides": Problem(waves, conditions=walls | {"floor": Contact(-0.1, upper=0.15)}),
    }


def cases() -> dict[str, tuple[Problem, Coarsest]]:
    """Problems and what makes their coarsest meshes, by name."""
    result: dict[str, tuple[Problem, Coarsest]] = {}
    for name, example in EXAMPLES.items():
        for kind, shift in (("", 0.0), (" mapped", 0.31)):
            result[name + kind] = (
                example.problem,
                lambda example=example, shift=shift: example.structured(
                    COARSEST, comm, shift=shift
                ),
            )
    rectangle = Polygon([[-1, 0], [1, 0], [1, 1], [-1, 1]], EDGES, names=EDGES)
    for name, problem in _with_terms().items():
        result[name] = problem, lambda: families.structured(rectangle, COARSEST, comm)
    result["materials"] = (LAYERED, lambda: BURIED.mesh(SIZE, comm))
    result["polygon"] = (PUSHED, lambda: CROOKED.mesh(SIZE, comm))
    return result


def meshes(
    problem: Problem, coarsest: Coarsest, dofs: float, nested: bool = True
) -> Iterator[Solution]:
    """Solve one case on meshes of up to about so many dofs."""
    for solution in solve_levels(problem, coarsest(), 99, nested=nested):
        yield solution
        if 4 * solution.dofs > 1.1 * dofs:
            return


@contextmanager
def cycle_of(solution: Solution) -> Iterator[Multigrid]:
    """Lend a cycle for a solution's matrix, on its meshes."""
    level = solution.level
    hierarchy = Hierarchy(level.physics, solution.domain)
    hierarchy.meshes = level.meshes
    try:
        with hierarchy.multigrid(level.system.operator, level.system.owned_dirichlet) as cycle:
            yield cycle
    finally:
        hierarchy.free()


def finest(name: str, dofs: float, nested: bool = True) -> Solution:
    """Solve one case and keep no solution but the one on the finest mesh."""
    for solution in meshes(*cases()[name], dofs, nested):
        pass
    return solution


def slowest(seconds: float) -> float:
    """The longest of the ranks' times."""
    return float(comm.allreduce(seconds, op=MPI.MAX))


def timed(action: Callable[[], object]) -> float:
    """Wall time of the slowest rank."""
    comm.barrier()
    began = time.perf_counter()
    action()
    return slowest(time.perf_counter() - began)


def linear_solve(A: PETSc.Mat, b: PETSc.Vec) -> tuple[float, int]:
    """Time and steps of CG + BoomerAMG with PETSc's defaults, rtol 1e-8, set-up included.

    It ends after `MOST` steps.
    """
    x, steps = b.duplicate(), 0

    def action() -> None:
        nonlocal steps
        ksp = PETSc.KSP().create(A.getComm())
        ksp.setOperators(A)
        ksp.setType("cg")
        ksp.getPC().setType("hypre")
        ksp.setTolerances(rtol=1e-8, max_it=MOST)
        ksp.solve(b, x)
        steps = ksp.getIterationNumber()
        ksp.destroy()

    seconds = timed(action)
    x.destroy()
    return seconds, steps


def solved_once(solution: Solution) -> tuple[float, int]:
    """`linear_solve` with a solution's own matrix and right-hand side."""
    system = solution.level.system
    b = ghosted_vector(solution.level.V, system.b)
    found = linear_solve(system.A, b)
    b.destroy()
    return found


def by_case(
    text: str,
    columns: Collection[str],
    row: Callable[[str, float, int], list[str]],
    file: str,
    names: Collection[str] | None = None,
    dofs: float = 3.5e6,
) -> None:
    """Run a benchmark with one row a case.

    Args:
        text: Its docstring.
        columns: Names of the columns.
        row: Makes a row of a case, the finest mesh's dofs and the number of repetitions.
        file: What the table is called in the folder of results.
        names: Of the cases; those of `cases` if left out.
        dofs: Of the finest mesh, about, where the command line does not say.
    """
    parser = command_line(text, cases=cases() if names is None else names, dofs=dofs, repeats=3)
    arguments = parser.parse_args()
    keep_memory()
    rows = (row(name, arguments.dofs, arguments.repeats) for name in arguments.cases)
    tabulate(columns, rows, arguments.out / file, comm.rank == 0)
