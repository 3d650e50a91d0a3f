"""Problems in time: one mesh and one matrix, set up once and solved again and again.

capacity ∂u/∂t − ∇·(κ∇u) + c u = f with contact is, step by step, the problem with c + rate in the
place of c and f + rate w in the place of f: implicit Euler has rate = capacity/Δt and w = u_{n−1},
the second-order backward difference rate = 3 capacity/(2Δt) and w = (4 u_{n−1} − u_{n−2})/3. w is a
function of Crouzeix-Raviart, so that all its integrals are exact, the certificate's too.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, nullcontext
from dataclasses import replace
from numbers import Integral
from types import TracebackType
from typing import Any, NamedTuple, Protocol, Self

import numpy as np
import ufl
from dolfinx import fem
from ufl.core.expr import Expr

from .arrays import FloatArray, summed
from .data.admissible import check_boundary, check_operator
from .data.diffusion import diffusion
from .data.loads import VolumeMoments, chi
from .data.quadrature import Rule, Volume
from .diffusion import Diffusion
from .errors import InputError, insist_on_count, insist_on_kind, raise_together, to_float
from .fem.conditions import Data
from .fem.layout import Layout
from .fem.problem import Problem, as_expression, carry
from .fem.snapshot import Snapshot
from .levels import LevelMonitor, Start, check_arguments, solve_level
from .limits import Limits
from .mesh.balance import Refined
from .mesh.domain import Domain
from .mesh.refinement import check_refinable, refine
from .multigrid.hierarchy import Hierarchy, NestedMesh
from .restart import Restart
from .solution import Solution
from .vi.level import Level


class Scheme(NamedTuple):
    """A step of length Δt: rate = factor capacity / Δt, and w a sum of the solutions before.

    Attributes:
        factor: Of the rate.
        weights: Of the one or two solutions before in w, the last one first; no others are kept.
    """

    factor: float
    weights: tuple[float, ...]


MOST_STEPS = 2**53
"""The whole numbers up to it are floats, too."""
SCHEMES = {"euler": Scheme(1.0, (1.0,)), "bdf2": Scheme(1.5, (4.0 / 3.0, -1.0 / 3.0))}
"""By name; the first steps, which have too little before them, are Euler's."""


class Clock(Protocol):
    """An object with a time that can be set, as dolfinx's Constant."""

    value: Any


class Solver:
    """A problem on one mesh, set up once; for a `with` block, which frees what it holds.

    Between solves dolfinx Constants, and Functions of degree 0, in the data may get other values,
    and there may be a source of its own. What they change is assembled anew and nothing else: the
    matrix and multigrid only where a_h holds one of them, in κ, c or b.

    Attributes:
        refined: The meshes above the coarsest, and where the parents of their cells are.
    """

    def __init__(self, problem: Problem, domain: Domain, levels: int | Sequence[Refined] = 1):
        """Assemble the matrix, and set up multigrid; collective.

        Args:
            problem: The data.
            domain: The coarsest mesh of multigrid, and its boundary parts.
            levels: How many meshes there are, each with four triangles for one of the mesh below;
                or those above the coarsest, as `adapt_to_run` finds them, or another solver has
                them in `refined`. Solved is on the last.

        Raises:
            InputError: As for `solve_levels`.
            NotConverged: The last mesh would not fit into the memory there is.
        """
        check_arguments(problem, domain)
        known, more = _given(levels, domain)
        if more > 0:
            check_refinable(domain.mesh)
            Limits().begin(domain, "CR", None, 1 + more)
        physics = Diffusion(problem, domain.mesh, "CR", domain.parts, domain.materials)
        self.physics, self._domain = physics, domain
        physics.check(domain)
        self._checked = physics.snapshot_of_holding()
        self.refined = [*known, *_uniform(domain, more)]
        self._stack, self._solved, self._solving, self._closed = ExitStack(), 0, 0, False
        self._set_up()

    def _set_up(self) -> None:
        """Assemble the matrix with the data as they are, and set up multigrid; collective."""
        self._assembled: Snapshot | None = None  # for whoever goes on where this was not finished
        self._hierarchy = Hierarchy(self.physics, self._domain)
        for refined in self.refined:
            self._hierarchy.add(*refined)
        self._carry_down()
        self._level = Level(self._hierarchy.meshes)
        self._held = self._level.floating is None
        system = self._level.system
        self._stack.callback(self._hierarchy.free)
        # A matrix that has served a single solve will not be kept for many either
        for_many = self._held and self._solved != 1
        lent = self._hierarchy.multigrid(system.operator, system.owned_dirichlet, for_many)
        self._cycle = self._stack.enter_context(lent)
        self._assembled, self._solved = self.physics.a.snapshot(), 0

    def _carry_down(self) -> None:
        """Give the data's Functions of degree 0 on all meshes the values they have by now."""
        for fine, *_ in self.refined:
            self.physics.carry_data(fine)

    def _have_changed(self) -> tuple[bool, bool]:
        """Tell whether a_h, and u_D or bounds, would be others by now; collective."""
        comm, moments = self._domain.mesh.comm, (self._assembled, self._checked)
        lasts = [moment is not None and moment.lasts for moment in moments]
        changed = summed(comm, np.array(np.logical_not(lasts), dtype=float))
        return bool(changed[0]), bool(changed[1])

    def __repr__(self) -> str:
        """Describe the solver in a line."""
        dofs = self.V.dofmap.index_map.size_global
        meshes = f"the last of {1 + len(self.refined)} meshes" if self.refined else "one mesh"
        return f"<Solver: {dofs} dofs on {meshes}{', closed' if self._closed else ''}>"

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
        """Free matrix and multigrid, at the end of a solve that is under way; collective."""
        self._closed = True
        if not self._solving:
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
        monitor: LevelMonitor | None = None,
    ) -> Solution:
        """Solve with the data as they are now; collective.

        Args:
            source: Added to f, a function like those in `V`, ghosts up to date.
            before: What to start from, with its active set; from this solver or one like it.
            rate: What the source is multiplied by, one number or one for each owned cell, see
                `by_material`.
            monitor: Called after each step of the solver.

        Raises:
            InputError: As for `solve`; or the solver is closed, or what it is to start from is of
                another one.
            NotConverged: As for `solve`.
        """
        own, rates, start = self._of_this(source, rate, before)
        self._carry_down()
        operator, boundary = self._have_changed()
        if boundary:
            check_boundary(self.physics, self._domain)
            self._checked = self.physics.snapshot_of_holding()
        if operator:
            check_operator(self.physics, self._domain)
            self._stack.close()
            self._set_up()
        self._solved += 1
        meshes, last = self._hierarchy.meshes, self._hierarchy.meshes[-1]
        data = diffusion(self._level.data).renewed(own, rates)
        renewed = NestedMesh(last.physics, last.domain, last.parents, data)
        level = Level((*meshes[:-1], renewed), self._held, self._level.system)
        self._solving += 1
        try:
            lend = nullcontext(self._cycle)
            return solve_level(level, lambda _: lend, start, monitor, {"mesh": 0.0})
        finally:
            self._solving -= 1
            if self._closed:  # by the monitor
                self.close()

    def _of_this(
        self,
        source: fem.Function | None,
        rate: FloatArray | float,
        before: Solution | fem.Function | None,
    ) -> tuple[FloatArray | None, FloatArray, Start]:
        """Copy the source's values and the rates, if this solver can do with them; collective.

        Returns:
            They, which may be other ones by the time that the solution is asked for its bound; and
            the start.

        Raises:
            InputError: It can't, or it is closed.
        """
        if self._closed:
            raise InputError("the solver is closed, and what it had is freed")
        known = before.u if isinstance(before, Solution) else before
        size, comm = Layout.of_space(self.V).local, self._domain.mesh.comm
        words = _unfit_rate(rate, self._owned_cells)
        if len(set(comm.allgather(source is None))) > 1:
            words = "source: a Function is given on some ranks, and none on others"
        for name, given in (("source", source), ("before", known)):
            if given is not None and not isinstance(given, fem.Function):
                words = f"{name} is {given!r}; a dolfinx Function is needed"
            elif given is not None and len(given.x.array) != size:
                words = f"{name}: a Function on another mesh than that which is solved on"
        raise_together(comm, words)
        own = None if source is None else source.x.array.copy()
        return own, np.array(rate, dtype=np.float64), Start(known=known)

    @property
    def _owned_cells(self) -> int:
        """Number of cells that this rank owns of the mesh that is solved on."""
        topology = self.V.mesh.topology
        return int(topology.index_map(topology.dim).size_local)

    def by_material(self, usual: float, own: Mapping[str, float]) -> FloatArray:
        """Spread materials' numbers over owned cells, shape (cells,), or () if all are the same."""
        if not own:
            return np.array(usual)
        domain = self._level.domain
        found = np.full(self._owned_cells, usual)
        for name, value in own.items():
            found[domain.materials.where(name)[: len(found)]] = value
        return found

    def projected(self, data: Data) -> fem.Function:
        """Find the function of `V` that is nearest to data in L²; collective."""
        forms, on_mesh = self.physics, diffusion(self._level.data)
        rule = Rule(forms.mesh, forms.problem.quadrature_degree)
        found, V = fem.Function(self.V), self.V
        sums: list[FloatArray] = []
        for each in (data, 1.0):
            expression = as_expression(each, forms.x, "initial", in_cells=True)
            if expression.ufl_shape:
                raise InputError(
                    f"initial has the shape {expression.ufl_shape}; a scalar is needed"
                )
            carry([expression], self._level.domain)
            volume = Volume(expression, forms.mesh, rule)
            moments = chi(VolumeMoments.of(volume, on_mesh.cells), (), on_mesh.cells)
            sums.append(Layout.of_space(V).shared_sum(moments))
        # the matrix of products of CR's functions is diagonal for triangles
        found.x.array[:] = sums[0] / sums[1]
        return found


def _unfit_rate(rate: object, cells: int) -> str | None:
    """Say why something is no rate of a source on so many owned cells."""
    try:
        found = np.asarray(rate, dtype=np.float64)
    except (TypeError, ValueError):
        return f"rate is {rate!r}; a number is needed, or one for each owned cell"
    if found.shape not in ((), (cells,)):
        return (
            f"rate has the shape {found.shape}; a number is needed, or one for each owned cell,"
            f" ({cells},)"
        )
    return None if np.isfinite(found).all() else "rate: numbers that are finite are needed"


def _given(levels: object, domain: Domain) -> tuple[list[Refined], int]:
    """Return the meshes above the coarsest that are there, and how many are to be made."""
    if isinstance(levels, Integral) and int(levels) >= 1:
        return [], int(levels) - 1
    if not isinstance(levels, Sequence) or not all(isinstance(each, tuple) for each in levels):
        raise InputError(
            f"levels is {levels!r}; it must be a number, 1 or more, or meshes from adapt_to_run"
        )
    above = domain
    for fine, *_ in levels:
        if not fine.descent or fine.descent[-1].mesh() is not above.mesh:
            raise InputError("levels: meshes that were not refined from this domain, in this order")
        above = fine
    return [*levels], 0


def _uniform(domain: Domain, number: int) -> Iterator[Refined]:
    """Refine so many times, each cell into four triangles; collective."""
    for _ in range(number):
        refined: Refined = (*refine(domain), None)
        yield refined
        domain = refined[0]


def solve_in_time(
    problem: Problem,
    domain: Domain,
    *,
    end: float,
    steps: int,
    scheme: str = "euler",
    initial: Data = 0.0,
    capacity: float = 1.0,
    levels: int | Sequence[Refined] = 1,
    time: Clock | None = None,
    monitor: LevelMonitor | None = None,
    max_time: float | None = None,
    restart: Restart | None = None,
    done: int = 0,
) -> Iterator[tuple[float, Solution]]:
    """Solve capacity ∂u/∂t − ∇·(κ∇u) + c u = f with contact, step by step; collective.

    The matrix is assembled once, and anew where κ, c or b depend on the time. Every step starts
    where the line through the two before leads, where contact will have moved on with it; its
    certificate is that of its own problem, in which the steps before are data: it says nothing of
    what the step's length does to u.

    Args:
        problem: The data. What depends on the time t holds a Constant on the domain's mesh.
        domain: The coarsest mesh of multigrid, and its boundary parts.
        end: The last time; the first is 0.
        steps: How many steps of the same length there are.
        scheme: "euler", of first order, or "bdf2", of second order after a first step of Euler's.
        initial: u at the time 0; it is projected to the discrete space.
        capacity: Above 0; materials may have their own.
        levels: The meshes, as for `Solver`; solved is on the last of them.
        time: That Constant; it is set to the time of each step.
        monitor: Called after each step of the solver.
        max_time: No step is begun that would end later than so many seconds from now.
        restart: Where to go on, from `Restart.of_steps`: the first solution is the one it was taken
            from, once more.
        done: The number of that step; 0 without a restart.

    Yields:
        The time, and u_h then. The solution of a step stays as it is.

    Raises:
        InputError: An argument is not as it should be, or as for `solve_levels`.
        NotConverged: A step was not solved, or would not fit into ``max_time``; or the mesh would
            not fit into the memory there is.
    """
    end, steps, done = _checked_steps(end, steps, done, restart, scheme, time)
    check_arguments(problem, domain)
    problem = problem.called_once()  # though a scheme may take a second solver
    capacity, own = _capacities(problem, capacity)
    if problem.exact is not None and problem.f is None:
        raise InputError("f: a problem in time derives none from exact, which tells no ∂u/∂t")
    if domain.mesh.topology.dim != 2:
        raise InputError("problems in time are worked out for d = 2 only")
    stepper = _Stepper(problem, domain, levels, capacity, own)
    limits, comm = Limits(max_time), domain.mesh.comm
    known, more = _given(levels, domain)
    limits.begin(known[-1][0] if known else domain, "CR", restart, 1 + more)
    start: fem.Function | None = None
    past: list[FloatArray] = []  # u_h one step before, and two
    try:
        for step in range(max(done, 1), steps + 1):
            method = SCHEMES[scheme if step >= len(SCHEMES[scheme].weights) else "euler"]
            t = end * step / steps
            if time is not None:
                time.value = t
            solver = stepper.prepare(method.factor * steps / end)
            if not past and restart is not None:
                start, past = _gone_on(solver, restart, initial, step, time)
                if len(past) < len(method.weights):
                    raise InputError(
                        f"restart: {scheme} goes on from {1 + len(method.weights)} steps, the last"
                        f" one included, and there are {len(restart.u)}"
                    )
            elif not past:
                past = [_at_first(solver, initial, time)]
            source = fem.Function(solver.V)
            needed = past[: len(method.weights)]
            for weight, former in zip(method.weights, needed, strict=True):
                source.x.array[:] += weight * former
            solution = solver.solve(source, start, stepper.rates, monitor)
            past = [solution.u.x.array, past[0]]
            start = fem.Function(solver.V)
            start.x.array[:] = 2.0 * past[0] - past[1]
            yield t, solution
            if step < steps:
                limits.admit_step(comm)
    finally:
        stepper.close()


class _Stepper:
    """The solver of steps in time; another one where the scheme asks for another rate.

    Attributes:
        rates: What w is multiplied by, as `Solver.solve` takes it.
    """

    def __init__(
        self,
        problem: Problem,
        domain: Domain,
        levels: int | Sequence[Refined],
        capacity: float,
        own: Mapping[str, float],
    ):
        """Begin without a solver; `own` are the capacities of materials, from `_capacities`."""
        self._problem, self._domain, self._levels = problem, domain, levels
        self._capacity, self._own, self._reactions = capacity, own, _reactions(problem, domain)
        self._solver: Solver | None = None
        self._factor, self.rates = 0.0, np.array(0.0)

    def prepare(self, factor: float) -> Solver:
        """Return a solver with so many times the capacity added to c; collective."""
        if self._solver is None or factor != self._factor:
            capacities = {"": self._capacity, **self._own}
            added = {name: factor * each for name, each in capacities.items()}
            former, problem = self._solver, _stepping(self._problem, self._reactions, added)
            self._solver = solver = Solver(problem, self._domain, self._levels)
            if former is not None:
                former.close()
            self._factor, self._levels = factor, solver.refined
            self.rates = factor * solver.by_material(self._capacity, self._own)
        return self._solver

    def close(self) -> None:
        """Free what there is; collective."""
        if self._solver is not None:
            self._solver.close()


def _checked_steps(
    end: float, steps: int, done: int, restart: object, scheme: str, time: object
) -> tuple[float, int, int]:
    """Insist on times and on a scheme that there can be, and return the times."""
    end = to_float("end", end)
    if not 0.0 < end < np.inf:
        raise InputError(f"end is {end}; it must be a time after 0")
    steps = insist_on_count("steps", steps)
    insist_on_kind("done", done, Integral, "a whole number")
    if not 0 <= done <= steps:
        raise InputError(f"done is {done}; it must be the number of a step, or 0")
    if (restart is None) != (done == 0):
        raise InputError(
            "restart: what to go on from and done, the number of that step, are both needed"
        )
    if steps > MOST_STEPS or not np.isfinite(steps / end):
        raise InputError(f"end is {end}; {steps} steps would be too short for numbers to tell")
    if end > sys.float_info.max / steps:
        raise InputError(f"end is {end}; {steps} times that is too much for a number")
    if not isinstance(scheme, str) or scheme not in SCHEMES:
        raise InputError(f"scheme is {scheme!r}; it must be one of {', '.join(SCHEMES)}")
    if time is not None and not _is_clock(time):
        raise InputError(
            f"time is {time!r}; it must be a dolfinx Constant, a float64, which data hold"
        )
    return end, steps, int(done)


def _is_clock(time: object) -> bool:
    """Tell whether something has a time that can be set."""
    value = np.asarray(getattr(time, "value", None))
    return value.shape == () and value.dtype == np.float64


def _capacities(problem: Problem, usual: float) -> tuple[float, dict[str, float]]:
    """Take the usual capacity, and materials' own by name; all of them are above 0."""

    def checked(name: str, value: object) -> float:
        number = to_float(name, value, "a number above 0")
        if not 0.0 < number < np.inf:
            raise InputError(f"{name} is {number}; it must be a number above 0")
        return number

    own = {
        name: checked(f"capacity of {name}", each.capacity)
        for name, each in problem.materials.items()
        if each.capacity is not None
    }
    return checked("capacity", usual), own


def _reactions(problem: Problem, domain: Domain) -> dict[str, Expr]:
    """Take the reactions of materials that have their own, by name; "" is for all others."""
    given = {name: each.reaction for name, each in problem.materials.items()}
    x = ufl.SpatialCoordinate(domain.mesh)
    return {
        name: as_expression(each, x, "reaction", in_cells=True)
        for name, each in {"": problem.reaction, **given}.items()
        if each is not None
    }


def _stepping(
    problem: Problem, reactions: Mapping[str, Expr], rates: Mapping[str, float]
) -> Problem:
    """Make the problem of a step: c + rate in the place of c.

    Args:
        problem: The data.
        reactions: Of materials by name, "" for those that have none of their own.
        rates: The same of what the step adds.
    """
    own = {
        name: replace(
            each, reaction=reactions.get(name, reactions[""]) + rates.get(name, rates[""])
        )
        for name, each in problem.materials.items()
        if name in rates or name in reactions
    }
    materials = {**problem.materials, **own}
    return replace(problem, reaction=reactions[""] + rates[""], materials=materials)


def _gone_on(
    solver: Solver, restart: Restart, initial: Data, step: int, time: Clock | None
) -> tuple[fem.Function, list[FloatArray]]:
    """Read u_h after a step, and what it was one step before and, if need be, two; collective."""
    last, *before = (restart.function(solver.V, k) for k in range(len(restart.u)))
    past = [each.x.array for each in before]
    if len(past) < 2 and step <= 2:
        past.append(_at_first(solver, initial, time))
    return last, past


def _at_first(solver: Solver, initial: Data, time: Clock | None) -> FloatArray:
    """Compute u_h at the time 0, shape (dofs,); collective."""
    if time is None:
        return solver.projected(initial).x.array
    now, time.value = float(time.value), 0.0
    try:
        return solver.projected(initial).x.array
    finally:
        time.value = now
