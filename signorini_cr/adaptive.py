"""Meshes that adapt to the solution: solve, certify, mark, refine.

The cells' shares of the certified bound say where the error sits. Dörfler's marking takes the
fewest cells that hold a given part of it; their sides are halved.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from numbers import Real
from typing import NamedTuple

import numpy as np
from mpi4py import MPI

from .arrays import BoolArray, FloatArray
from .errors import (
    InputError,
    NotConverged,
    insist_on_count,
    insist_on_function,
    insist_on_kind,
    insist_on_number,
)
from .fem.problem import Problem
from .levels import LevelMonitor, check_arguments, solve_sequence
from .limits import Limits
from .mesh.balance import Refined, balance
from .mesh.domain import Domain
from .mesh.refinement import refine_marked
from .restart import Restart
from .rounding import at_most
from .solution import Solution

ALIKE = 1e-6
"""Part by which indicators may differ that count as one: the solver leaves 1e-9 to 1e-7 of them,
and where a problem is symmetric, cells are twins but for that."""

HALVINGS = 40
"""Steps of the bisection for the value that separates marks: they leave 1e-12 of the largest."""

SOLVED = 1e-8
"""Part of (2|J|)^{1/2} that a solver leaves which ends at a residual of 10⁻⁸ of the load."""
NOTHING = 0.1
"""Part of the rounding in a bound that is nothing beside it: cells' shares that are all noise come
to 0.07 of it at most, and to cut what is left once more adds more rounding than it takes away."""

RUNS = 3.0
"""Time that a run in time, the one on the mesh that is found, and its output take, in runs."""

RESOLUTION = 1e-11
"""Least diameter of a cell to be refined, in parts of the largest coordinate."""


def solve_adaptive(
    problem: Problem,
    domain: Domain,
    *,
    tolerance: float = 0.0,
    levels: int | None = None,
    max_dofs: int = 1_000_000,
    fraction: float = 0.5,
    element: str = "CR",
    monitor: LevelMonitor | None = None,
    max_time: float | None = None,
    restart: Restart | None = None,
) -> Iterator[Solution]:
    """Solve on meshes that are refined where the error is; each starts from the one below.

    The sequence ends, too, where what is left of the bound is rounding, see `Shares.rounded`.

    Args:
        problem: The data; a Function in them must be of degree 0, on the coarsest mesh.
        domain: The coarsest mesh and its boundary parts.
        tolerance: The end: a certified bound of the broken error (1.6) not above it.
        levels: The end: so many meshes, the coarsest included; None for any number.
        max_dofs: The end: the next mesh would have more degrees of freedom.
        fraction: Part of the bound's square that the marked cells hold, in (0, 1].
        element: "CR"; with another one there is no bound.
        monitor: Called after each step of the solver.
        max_time: No level is begun that would end later than so many seconds from now.
        restart: Where to go on: the first solution is the one it was taken from, once more.

    Yields:
        The solutions, coarsest first; `Solution.certificate` has the bounds.

    Raises:
        InputError: As for `solve`; or there is no bound to go by, and the message says why; or
            a mesh of other cells than straight-sided triangles is to be refined; or the fraction or
            the number of levels is out of its range.
        NotConverged: The solver stopped short on one of the meshes, or cells got too small, or the
            next level would not fit into the memory there is, or into ``max_time``; or what is left
            of the bound is rounding, and above a ``tolerance`` that is not 0.
    """
    check_arguments(problem, domain)
    limits = Limits(max_time)
    step = adaptively(
        limits, tolerance=tolerance, levels=levels, max_dofs=max_dofs, fraction=fraction
    )
    limits.begin(domain, element, restart)
    for solution in solve_sequence(problem, domain, step, element, monitor, restart=restart):
        _ = solution.certificate  # made here, so that it doesn't count as time for the mesh
        yield solution


class Shares(NamedTuple):
    """Bound of the error, and the cells' shares of it.

    Attributes:
        bound: Of the broken error (1.6); infinite where a physics knows none, and only marks.
        indicators: What this rank's cells hold of its square, shape (cells,).
        of_energy: The same bound in the norm of the energy.
        rounding: What this one has for rounding in the certificate's own sums, which grows with the
            number of cells. 0 where it is not known.
        left: What the solver may leave of u_h in that norm, by the energy's size; 0 likewise.
    """

    bound: float
    indicators: FloatArray
    of_energy: float = np.inf
    rounding: float = 0.0
    left: float = 0.0

    @classmethod
    def of(cls, solution: Solution) -> Shares:
        """Take the shares from what the certificate says; collective.

        Raises:
            InputError: There are no shares; the message says why.
        """
        certificate = solution.certificate
        if certificate.indicators is None:
            raise InputError(
                f"adaptive refinement goes by the certified bound, and there is none: "
                f"{certificate.reason}"
            )
        energy = max(map(abs, certificate.energy or (0.0,)))
        return cls(
            np.inf if certificate.bound_h1 is None else certificate.bound_h1,
            certificate.indicators,
            np.inf if certificate.bound_energy_norm is None else certificate.bound_energy_norm,
            certificate.rounding,
            SOLVED * float(np.sqrt(2.0 * energy)),
        )

    def rounded(self, comm: MPI.Comm) -> bool:
        """Tell whether refinement has nothing to reduce but rounding; collective.

        Or what the solver leaves. That is so where all cells together hold less than a hundredth of
        the square of the one, or than the square of the other, and no more than twice of both is
        all that the bound has.

        Args:
            comm: The ranks that take part.
        """
        held = comm.allreduce(float(np.sum(self.indicators)))
        nothing = max(NOTHING * self.rounding, self.left)
        return held <= nothing**2 and 0.0 < self.of_energy <= 2.0 * (self.rounding + self.left)


class Tried(NamedTuple):
    """A mesh on which all steps of a run in time have been solved.

    Attributes:
        meshes: Those above the coarsest, as ``levels`` of `solve_in_time` takes them; it is the
            last of these, or the coarsest.
        last: The solution of the last step.
        bound: The largest of the bounds of the steps.
        rounded: Whether what is left of the bounds is rounding, which no finer mesh makes smaller.
    """

    meshes: list[Refined]
    last: Solution
    bound: float
    rounded: bool


def adapt_to_run(
    run: Callable[[Sequence[Refined]], Iterable[tuple[float, Solution]]],
    *,
    tolerance: float = 0.0,
    levels: int | None = None,
    max_dofs: int = 1_000_000,
    fraction: float = 0.5,
    max_time: float | None = None,
    meshes: Sequence[Refined] = (),
) -> Iterator[Tried]:
    """Find a mesh that suits all steps of a run in time, by runs on one after the other.

    Cells are marked by the sum of their shares over all steps, each in the bound of its own
    problem; the mesh they lead to is that of the next run. What the length of the steps does to u
    is in none of these bounds. As with `solve_adaptive` it ends where rounding is all that is left.

    Args:
        run: Solves step by step, as `solve_in_time` does, on the last of some refined meshes.
        tolerance: The end: in no step a bound above it.
        levels: The end: so many meshes, the coarsest included; None for any number.
        max_dofs: The end: the next mesh would have more degrees of freedom.
        fraction: Part of the sum that the marked cells hold, in (0, 1].
        max_time: No run is begun unless it and another one on the mesh that is found, with what
            that writes, would end in so many seconds from now.
        meshes: Where to begin, coarsest first; on none but the coarsest if left out.

    Yields:
        What was tried, the mesh to stay on last.

    Raises:
        InputError: As for `solve_adaptive`; or the run has no steps, or is on another mesh.
        NotConverged: As for `solve_adaptive`, or the run raised it.
    """
    insist_on_function("run", run)
    step = _by_shares(Limits(max_time), tolerance, levels, max_dofs, fraction, runs=RUNS)
    insist_on_kind("meshes", meshes, Sequence, "a list of refined meshes")
    refined = [*meshes]
    while True:
        total, last = Shares(0.0, np.zeros(1), of_energy=0.0), None
        steps = run(refined)
        insist_on_kind("what run returns", steps, Iterable, "pairs of a time and a solution")
        for each in steps:
            if not (isinstance(each, tuple) and len(each) == 2 and isinstance(each[1], Solution)):
                raise InputError(f"the run gives {each!r}: a time and a solution are needed")
            last = each[1]
            shares = Shares.of(last)
            total = Shares(
                max(total.bound, shares.bound),
                total.indicators + shares.indicators,
                *(float(np.hypot(*both)) for both in zip(total[2:], shares[2:], strict=True)),
            )
        if last is None:
            raise InputError("the run has no steps")
        if last.level.number != len(refined):
            raise InputError("the run is to be on the meshes that it is given, as its levels")
        yield Tried([*refined], last, total.bound, total.rounded(last.domain.mesh.comm))
        following = step(last, total)
        if following is None:
            break
        refined.append(following)


def adaptively(
    limits: Limits, *, tolerance: float, levels: int | None, max_dofs: int, fraction: float
) -> Callable[[Solution], Refined | None]:
    """Make a step for `solve_sequence`, or for `solve_physics`, that refines where the error is.

    Args:
        limits: What the levels may take in all.
        tolerance: The end: a bound not above it.
        levels: The end: so many meshes.
        max_dofs: The end: the next mesh would have more degrees of freedom.
        fraction: Part of the bound's square that the marked cells hold, in (0, 1].
    """
    step = _by_shares(limits, tolerance, levels, max_dofs, fraction)
    return lambda solution: step(solution, Shares.of(solution))


def _by_shares(
    limits: Limits,
    tolerance: float,
    levels: int | None,
    max_dofs: int,
    fraction: float,
    runs: float = 1.0,
) -> Callable[[Solution, Shares], Refined | None]:
    """Make such a step from what is said of where the error is; for ``runs`` see `Limits.admit`."""
    insist_on_kind("fraction", fraction, Real, "a number")
    if not 0.0 < fraction <= 1.0:
        raise InputError(f"fraction is {fraction}; it must be above 0 and not above 1")
    if levels is not None:
        levels = insist_on_count("levels", levels)
    tolerance = insist_on_number("tolerance", tolerance, 0.0)
    most = insist_on_number("max_dofs", max_dofs, 1.0)

    def step(solution: Solution, shares: Shares) -> Refined | None:
        if tolerance > 0.0 and shares.bound == np.inf:
            raise InputError("tolerance: there is no bound that could be below it")
        last = levels is not None and solution.level.number + 1 >= levels
        if last or shares.bound <= tolerance or solution.dofs >= most:
            return None
        comm = solution.domain.mesh.comm
        if shares.rounded(comm):
            if tolerance == 0.0:
                return None
            raise NotConverged(
                f"the certified bound is {at_most(shares.bound)}, above the tolerance of"
                f" {tolerance:g}, and what is left of it is rounding, which no finer mesh makes"
                " smaller",
                solution.level.number,
            )
        marked = mark(shares.indicators, fraction, comm)
        if not comm.allreduce(bool(marked.any()), op=MPI.LOR):  # all is what no cell has a share in
            marked[:] = True
        if _smallest(solution.domain, marked) < RESOLUTION:
            raise NotConverged(
                "cells have become so small that rounding spoils their shape",
                solution.level.number + 1,
            )
        fine, parent_cell = refine_marked(solution.domain, marked)
        facets = fine.mesh.topology.index_map(fine.mesh.topology.dim - 1).size_global
        dofs = facets * solution.u.function_space.dofmap.index_map_bs
        if dofs > most:
            return None
        limits.admit(solution, dofs, runs)
        return balance(fine, parent_cell)

    return step


def _smallest(domain: Domain, marked: BoolArray) -> float:
    """Find the least diameter of marked cells, in parts of the largest coordinate; collective."""
    mesh = domain.mesh
    h = mesh.h(mesh.topology.dim, np.flatnonzero(marked).astype(np.int32))
    largest = mesh.comm.allreduce(float(np.abs(mesh.geometry.x).max(initial=0.0)), op=MPI.MAX)
    return mesh.comm.allreduce(float(h.min(initial=np.inf)), op=MPI.MIN) / largest


def mark(indicators: FloatArray, fraction: float, comm: MPI.Comm) -> BoolArray:
    """Mark the largest indicators that make up a fraction of their sum (Dörfler); collective.

    The ranks agree on the value that separates them by bisection; cells that share this value as
    far as the solver knows it are all marked, so that meshes don't depend on what it leaves.

    Args:
        indicators: Not negative, this rank's cells, shape (cells,).
        fraction: In (0, 1].
        comm: The ranks that take part.

    Returns:
        Whether to refine the cell, shape (cells,).
    """
    ordered = np.sort(indicators)
    above = np.concatenate([np.cumsum(ordered[::-1])[::-1], [0.0]])
    total, top = comm.allreduce(above[0]), comm.allreduce(ordered.max(initial=0.0), op=MPI.MAX)
    low, high = 0.0, float(top)
    for _ in range(HALVINGS):  # whatever the numbers are: beside tiny ones 1e-12 of them is 0
        middle = 0.5 * (low + high)
        held = comm.allreduce(above[np.searchsorted(ordered, middle)])
        low, high = (middle, high) if held >= fraction * total else (low, middle)
    return indicators >= (1.0 - ALIKE) * low if top > 0 else np.zeros(len(indicators), dtype=bool)
