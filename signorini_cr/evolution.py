"""Problems in time: one mesh and one matrix, set up once and solved again and again.

capacity ∂u/∂t − ∇·(κ∇u) + c u = f with contact is, step by step, the problem with c + rate in the
place of c and f + rate w in the place of f: implicit Euler has rate = capacity/Δt and w = u_{n−1},
the second-order backward difference rate = 3 capacity/(2Δt) and w = (4 u_{n−1} − u_{n−2})/3. w is a
function of Crouzeix-Raviart, so that all its integrals are exact, the certificate's too.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import ExitStack, nullcontext
from dataclasses import replace
from types import TracebackType
from typing import Any, Protocol, Self

import numpy as np
import ufl
from dolfinx import fem

from .arrays import FloatArray
from .data.diffusion import diffusion
from .data.loads import VolumeMoments, chi
from .data.moments import Rule, Volume
from .diffusion import Diffusion
from .errors import InputError
from .fem.conditions import Data, number
from .fem.problem import Problem, as_expression
from .levels import Start, solve_level
from .limits import Limits
from .mesh.domain import Domain
from .mesh.refinement import check_refinable, refine
from .multigrid.hierarchy import Hierarchy, NestedMesh
from .multigrid.parents import Layout
from .restart import Restart
from .solution import Solution
from .vi.level import Level

SCHEMES = ("euler", "bdf2")


class Clock(Protocol):
    """What has a time that can be set, as dolfinx's Constant."""

    value: Any


class Solver:
    """A problem on one mesh, set up once; for a `with` block, which frees what it holds.

    What a_h is made of, κ, c and b, must stay. Everything else may change between solves: the
    values of dolfinx Constants that f, g, u_D and obstacles hold, and a source of its own.
    """

    def __init__(
        self, problem: Problem, domain: Domain, levels: int = 1, like: Solver | None = None
    ):
        """Assemble the matrix, and set up multigrid; collective.

        Args:
            problem: The data.
            domain: The coarsest mesh of multigrid, and its boundary parts.
            levels: How many meshes there are; solved is on the last of them.
            like: A solver for another problem on the same domain, whose meshes are taken.

        Raises:
            InputError: As for `solve_levels`.
        """
        if levels < 1:
            raise InputError(f"levels is {levels}; it must be 1 or more")
        if levels > 1:
            check_refinable(domain.mesh)
        physics = Diffusion(problem, domain.mesh, "CR", domain.parts, domain.materials)
        physics.check(domain)
        hierarchy = Hierarchy(physics, domain)
        if like is None:
            for _ in range(levels - 1):
                hierarchy.add(*refine(hierarchy.meshes[-1].domain))
        else:
            for mesh in like._hierarchy.meshes[1:]:
                assert mesh.parents is not None
                hierarchy.add(mesh.domain, mesh.parents.cell)
        self.physics = physics
        self._hierarchy: Hierarchy = hierarchy
        self._level = Level(hierarchy.meshes)
        self._held = self._level.loose is None
        system = self._level.system
        self._stack = ExitStack()
        self._stack.callback(hierarchy.free)
        lent = hierarchy.multigrid(system.operator, system.owned_dirichlet)
        self._cycle = self._stack.enter_context(lent)

    def __enter__(self) -> Self:
        """Begin."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Free what there is."""
        self.close()

    def close(self) -> None:
        """Free matrix and multigrid; collective."""
        self._stack.close()

    @property
    def V(self) -> fem.FunctionSpace:
        """The discrete space."""
        return self._level.V

    def solve(
        self,
        source: fem.Function | None = None,
        before: Solution | fem.Function | None = None,
        rate: FloatArray | float = 1.0,
    ) -> Solution:
        """Solve with the data as they are now; collective.

        Args:
            source: Added to f, a function in `V`, ghosts up to date.
            before: What to start from, with its active set; from this solver or one like it.
            rate: What the source is multiplied by, one number or one for each owned cell, see
                `by_material`.

        Raises:
            InputError: As for `solve`.
            NotConverged: As for `solve`.
        """
        meshes, last = self._hierarchy.meshes, self._hierarchy.meshes[-1]
        own = None if source is None else source.x.array
        data = diffusion(self._level.data).renewed(own, np.asarray(rate, dtype=np.float64))
        renewed = NestedMesh(last.physics, last.domain, last.parents, data)
        level = Level((*meshes[:-1], renewed), self._held, self._level.system)
        start = Start(known=before.u if isinstance(before, Solution) else before)
        return solve_level(level, lambda _: nullcontext(self._cycle), start, None, {"mesh": 0.0})

    def by_material(self, usual: float, own: Mapping[str, float]) -> FloatArray:
        """Numbers of materials on owned cells, shape (cells,), or () where all are the same."""
        if not own:
            return np.array(usual)
        domain = self._level.domain
        index_map = domain.mesh.topology.index_map(domain.mesh.topology.dim)
        found = np.full(index_map.size_local, usual)
        for name, value in own.items():
            found[domain.materials.where(name)[: len(found)]] = value
        return found

    def projected(self, data: Data) -> fem.Function:
        """The function of `V` that is nearest to data in L²; collective."""
        forms, on_mesh = self.physics, diffusion(self._level.data)
        rule = Rule(forms.mesh, forms.problem.quadrature_degree)
        found, V = fem.Function(self.V), self.V
        sums: list[FloatArray] = []
        for each in (data, 1.0):
            volume = Volume(as_expression(each, forms.x), forms.mesh, rule)
            moments = chi(VolumeMoments.of(volume, on_mesh.cells), (), on_mesh.cells)
            sums.append(Layout.of_space(V).shared_sum(moments))
        # the matrix of products of CR's functions is diagonal for triangles
        found.x.array[:] = sums[0] / sums[1]
        return found


def solve_in_time(
    problem: Problem,
    domain: Domain,
    *,
    end: float,
    steps: int,
    scheme: str = "euler",
    initial: Data = 0.0,
    capacity: float = 1.0,
    levels: int = 1,
    time: Clock | None = None,
    max_time: float | None = None,
    restart: Restart | None = None,
    done: int = 0,
) -> Iterator[tuple[float, Solution]]:
    """Solve capacity ∂u/∂t − ∇·(κ∇u) + c u = f with contact, step by step; collective.

    The matrix is assembled once. Every step starts from the last one with its active set; its
    certificate is that of its own problem, in which the steps before are data: it says nothing of
    what the step's length does to u.

    Args:
        problem: The data. What depends on the time t holds a Constant on the domain's mesh; κ, c
            and b must not.
        domain: The coarsest mesh of multigrid, and its boundary parts.
        end: The last time; the first is 0.
        steps: How many steps of the same length there are.
        scheme: "euler", of first order, or "bdf2", of second order after a first step of Euler's.
        initial: u at the time 0; it is projected to the discrete space.
        capacity: Above 0; materials may have their own.
        levels: How many nested meshes there are; solved is on the last of them.
        time: That Constant; it is set to the time of each step.
        max_time: No step is begun that would end later than so many seconds from now.
        restart: Where to go on, from `Restart.of_steps`: the first solution is the one it was taken
            from, once more.
        done: The number of that step.

    Yields:
        The time, and u_h then. The solution of a step stays as it is.

    Raises:
        InputError: An argument is not as it should be, or as for `solve_levels`.
        NotConverged: A step was not solved, or would not fit into ``max_time``; or the mesh would
            not fit into the memory there is.
    """
    if not (end > 0.0 and np.isfinite(end)):
        raise InputError(f"end is {end}; it must be a time after 0")
    if steps < 1:
        raise InputError(f"steps is {steps}; it must be 1 or more")
    if scheme not in SCHEMES:
        raise InputError(f"scheme is {scheme!r}; it must be one of {', '.join(SCHEMES)}")
    capacities = {name: each.capacity for name, each in problem.materials.items()}
    own = {name: each for name, each in capacities.items() if each is not None}
    for name, each in {"": capacity, **own}.items():
        if not (each > 0.0 and np.isfinite(each)):
            of = f" of {name}" if name else ""
            raise InputError(f"capacity{of} is {each}; it must be above 0")
    if domain.mesh.topology.dim != 2:
        raise InputError("problems in time are worked out for d = 2 only")
    x = ufl.SpatialCoordinate(domain.mesh)
    reactions = {"": problem.reaction}
    reactions |= {n: m.reaction for n, m in problem.materials.items() if m.reaction is not None}
    found = {n: number(as_expression(c, x)) for n, c in reactions.items()}
    c = {name: each for name, each in found.items() if each is not None}
    if len(c) < len(found):
        raise InputError("problems in time need a reaction that is a number in each material")

    def stepping(factor: float) -> Problem:
        """The problem of a step: rate + c in the place of c."""
        materials = {
            name: replace(each, reaction=c.get(name, c[""]) + factor * own.get(name, capacity))
            for name, each in problem.materials.items()
            if name in own or name in c
        }
        return replace(
            problem,
            reaction=c[""] + factor * capacity,
            materials={**problem.materials, **materials},
        )

    rates: FloatArray = np.empty(0)
    factor = 0.0
    solver: Solver | None = None
    last: Solution | fem.Function | None = None
    then: FloatArray = np.empty(0)
    before: FloatArray = then
    limits, comm = Limits(max_time), domain.mesh.comm
    limits.begin(domain, "CR", restart, levels)
    try:
        for step in range(max(done, 1), steps + 1):
            second = scheme == "bdf2" and step > 1
            needed = (1.5 if second else 1.0) * steps / end
            if solver is None or needed != factor:
                factor, former = needed, solver
                solver = Solver(stepping(factor), domain, levels, former)
                rates = factor * solver.by_material(capacity, own)
                if former is not None:
                    former.close()
                elif restart is None:
                    then = solver.projected(initial).x.array
                else:
                    last, then, before = _gone_on(solver, restart, initial, step)
            source = fem.Function(solver.V)
            source.x.array[:] = (4.0 * then - before) / 3.0 if second else then
            t = end * step / steps
            if time is not None:
                time.value = t
            last = solver.solve(source, last, rates)
            before, then = then, last.u.x.array
            yield t, last
            if step < steps:
                limits.admit_step(comm)
    finally:
        if solver is not None:
            solver.close()


def _gone_on(
    solver: Solver, restart: Restart, initial: Data, step: int
) -> tuple[fem.Function, FloatArray, FloatArray]:
    """u_h after a step, and what u was one and two steps before; collective."""
    known = [restart.function(solver.V, k) for k in range(len(restart.u))]
    former = [each.x.array for each in known[1:]]
    if len(former) < 2:
        former.append(solver.projected(initial).x.array if step <= 2 else np.empty(0))
    return known[0], former[0], former[-1]
