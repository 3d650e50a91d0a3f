"""From data and a domain to solutions, on one mesh or on a sequence of refined ones."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from functools import partial
from typing import NamedTuple

from dolfinx import fem

from .diffusion import Diffusion
from .errors import InputError, NotConverged, insist_on_count, insist_on_function, insist_on_kind
from .fem.conditions import facets_of
from .fem.physics import Physics
from .fem.problem import Problem
from .limits import Limits
from .mesh.balance import Refined
from .mesh.domain import Domain
from .mesh.refinement import check_refinable, refine
from .multigrid.cycle import Multigrid
from .multigrid.hierarchy import Hierarchy, NestedMesh
from .restart import Restart
from .solution import Solution
from .vi.contact import contact_facts
from .vi.floating import Floating
from .vi.level import Level
from .vi.nested import known_start, nested_start
from .vi.solver import Indefinite, solve_vi
from .vi.system import System

LevelMonitor = Callable[[int, int, float, int, int], None]
"""Called with level, step, residual norm, active dofs and linear iterations so far, which are the
same on all ranks; a rank may do without one."""


def solve(
    problem: Problem,
    domain: Domain,
    element: str = "CR",
    monitor: LevelMonitor | None = None,
) -> Solution:
    """Solve on one mesh.

    Args:
        problem: The data; UFL expressions may be tied to the domain's mesh.
        domain: Mesh and boundary parts.
        element: "CR", or "P1" for the conforming element to compare with.
        monitor: Called after each step of the solver.

    Raises:
        InputError: The data are not finite on the mesh, of a wrong shape, or at home on another
            mesh; u_D jumps, or lies below α where Γ0 meets Γ1; κ is not symmetric and positive
            definite; there is no such element; a piece of the domain has no Dirichlet facet and
            is not pressed onto the obstacle; or PETSc can't solve with the options that are set.
        NotConverged: The solver stopped short, with PETSc's name for the reason; or the contact
            forces, or the equations of a part, are lost in rounding.
    """
    check_arguments(problem, domain)
    (solution,) = solve_sequence(problem, domain, lambda _: None, element, monitor)
    return solution


def solve_levels(
    problem: Problem,
    domain: Domain,
    levels: int,
    element: str = "CR",
    monitor: LevelMonitor | None = None,
    nested: bool = True,
    max_time: float | None = None,
    restart: Restart | None = None,
) -> Iterator[Solution]:
    """Solve on a mesh and its uniform refinements, each starting from the one below.

    Args:
        problem: The data; a Function in them must be of degree 0, on the coarsest mesh.
        domain: The coarsest mesh and its boundary parts.
        levels: Number of meshes, the coarsest included.
        element: "CR" or "P1".
        monitor: Called after each step of the solver.
        nested: Start from the solution on the mesh below; otherwise from zero, to compare.
        max_time: No level is begun that would end later than so many seconds from now.
        restart: Where to go on: the first solution is the one it was taken from, once more.

    Yields:
        The solutions, coarsest first.

    Raises:
        InputError: As for `solve`; or the data are tied to a mesh, or the mesh is to be refined and
            does not consist of straight-sided triangles.
        NotConverged: The solver stopped short on one of the levels, or a level would not fit into
            the memory there is, or into ``max_time``.
    """
    check_arguments(problem, domain)
    levels = insist_on_count("levels", levels)
    if levels > 1:
        check_refinable(domain.mesh)

    limits = Limits(max_time)
    limits.begin(domain, element, restart)

    def step(solution: Solution) -> Refined | None:
        if solution.level.number + 1 >= levels:
            return None
        limits.admit(solution, 2**domain.mesh.topology.dim * solution.dofs)
        return (*refine(solution.domain), None)

    yield from solve_sequence(problem, domain, step, element, monitor, nested, restart)


def solve_sequence(
    problem: Problem,
    domain: Domain,
    step: Callable[[Solution], Refined | None],
    element: str = "CR",
    monitor: LevelMonitor | None = None,
    nested: bool = True,
    restart: Restart | None = None,
) -> Iterator[Solution]:
    """Solve on a mesh and on those that ``step`` makes of it, one from the other.

    Args:
        problem: As for `solve_levels`.
        domain: The coarsest mesh and its boundary parts.
        step: Makes the next domain and says where its cells' parents are, as `balance` does, from
            a solution; None ends the sequence.
        element: "CR" or "P1".
        monitor: Called after each step of the solver.
        nested: Start from the solution on the mesh below; otherwise from zero, to compare.
        restart: As for `solve_levels`.

    Yields:
        The solutions, coarsest first.
    """
    yield from solve_physics(
        Diffusion(problem, domain.mesh, element, domain.parts, domain.materials),
        domain,
        step,
        monitor,
        nested,
        restart,
    )


def solve_physics(
    physics: Physics,
    domain: Domain,
    step: Callable[[Solution], Refined | None],
    monitor: LevelMonitor | None = None,
    nested: bool = True,
    restart: Restart | None = None,
) -> Iterator[Solution]:
    """Solve any physics on a mesh and on those that ``step`` makes of it; see `solve_sequence`.

    What is left of a sequence that nobody asks to its end is freed with its meshes, see `garbage`.
    """
    physics.check(domain)
    hierarchy, seconds = Hierarchy(physics, domain), {"mesh": domain.seconds}
    level, start, before = Level(hierarchy.meshes), Start(), None

    def lend(system: System) -> AbstractContextManager[Multigrid]:
        return hierarchy.multigrid(system.operator, system.owned_dirichlet)

    if restart is not None:
        # so it is on finer meshes, of which none needs a system
        nothing_floats = level.floating is None
        for refined in restart.meshes(domain):
            hierarchy.add(*refined)
            level = Level(hierarchy.meshes, nothing_floats=nothing_floats)
        start = Start(known=restart.function(level.V, 0))
        before = restart.function(hierarchy.meshes[-2].V, 1) if restart.added else None
    while True:
        solution = solve_level(level, lend, start, monitor, seconds)
        yield solution
        began = time.perf_counter()
        try:
            following = step(solution)
        except (InputError, NotConverged):  # a limit, for one: all ranks come to it together
            hierarchy.free()
            raise
        if following is None:
            break
        hierarchy.add(*following)
        level = Level(hierarchy.meshes, nothing_floats=level.floating is None)
        start = Start()
        if nested:
            start, before = Start(solution, before), solution.u
        seconds = {"mesh": time.perf_counter() - began}
    hierarchy.free()


def check_arguments(problem: object, domain: object) -> None:
    """Insist on a problem and a domain, in this order."""
    insist_on_kind("problem", problem, Problem, "a Problem")
    insist_on_kind("domain", domain, Domain, "a Domain")


def check_pieces(physics: Diffusion, domain: Domain) -> None:
    """Insist that something holds each piece that a domain falls into; collective.

    Raises:
        InputError: A piece has no Dirichlet facet, no reaction and no loss, and is not pressed onto
            an obstacle.
    """
    level = Level((NestedMesh(physics, domain),))
    fixed = fem.locate_dofs_topological(
        level.V, domain.mesh.topology.dim - 1, facets_of(domain, physics.fixed)
    )
    # without a floating piece nothing needs to be assembled
    if Floating.of(level.V, fixed).count and level.floating is not None:
        level.floating.check(level.system, level.data.inflow())


class Start(NamedTuple):
    """The start of a solve: zero, unless there is something here.

    Attributes:
        coarser: The solution on the mesh below.
        before: What that one was started from.
        known: What was found on the same mesh before.
    """

    coarser: Solution | None = None
    before: fem.Function | None = None
    known: fem.Function | None = None


def solve_level(
    level: Level,
    lend: Callable[[System], AbstractContextManager[Multigrid]],
    start: Start,
    monitor: LevelMonitor | None,
    seconds: dict[str, float],
) -> Solution:
    """Assemble and solve on the finest mesh, and say what has come of it; collective.

    Args:
        level: That mesh.
        lend: Lends the cycle for a system.
        start: What to start from.
        monitor: Called after each step of the solver.
        seconds: Wall time of the phases so far; others are added.
    """
    clock = time.perf_counter()
    system = level.system
    clock, seconds["assemble"] = time.perf_counter(), time.perf_counter() - clock
    less, residual = system.start(), fem.Function(level.V)  # u_h less the offset
    if level.floating is not None:
        level.floating.check(system, level.data.inflow())
    # or u is the solution already; or near it, and another u has too many digits of the offset
    if not (system.is_trivial or system.drifts):
        if start.known is not None:
            known_start(start.known, level, less)
        elif start.coarser is not None:
            nested_start(start.coarser, level, less, start.before)
    if level.floating is not None:
        level.floating.hold(system, less)
    told = None
    if monitor is not None:
        insist_on_function("monitor", monitor)
        told = partial(monitor, level.number)
    try:
        with (
            lend(system) as cycle,
            system.vectors(less, residual) as vectors,
        ):
            iterations = solve_vi(
                cycle, vectors, system.residual_scale, monitor=told, system=system
            )
    except NotConverged as failure:
        doubt = level.physics.not_definite
        if doubt is not None and isinstance(failure, Indefinite):
            raise InputError(f"{doubt}; level {level.number} shows it") from None
        raise NotConverged(failure.reason, level.number) from None
    for function in (less, residual):
        function.x.scatter_forward()
    clock, seconds["solve"] = time.perf_counter(), time.perf_counter() - clock
    contact = contact_facts(level.data, system, less, residual, iterations)
    u = system.with_offset(less)
    owned = system.A.getLocalSize()[0]
    with level.as_made():  # whatever a monitor has done to the data
        square = level.data.squared_energy_norm(u)
    energy = level.domain.mesh.comm.allreduce(0.5 * square - system.chi[:owned] @ u.x.array[:owned])
    seconds["estimate"] = time.perf_counter() - clock
    return Solution(level, u, residual, contact, float(energy), iterations, seconds)
