"""Steps in time against the lines one writes by hand, and against solving from cold.

    container/run python3 benchmarks/time_steps.py

A plate is heated and cooled, and one edge must not fall below −0.1: implicit Euler, with contact
that comes and goes. By hand means thirty lines of DOLFINx: the matrix of Crouzeix-Raviart, the
active set method, and a factorisation of the reduced matrix that is used again until the active set
changes. Who writes ten more need factorise but once, the whole matrix, and has its inverse on the
contact dofs for the rest. Cold means a solve of the first step by itself, mesh, matrix and
multigrid included. All must find the same forces, or the benchmark ends. Measured is processor
time.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from statistics import median

import numpy as np
import scipy.sparse as sparse
import ufl
from cases import comm
from dolfinx import fem
from dolfinx.fem.petsc import assemble_matrix, assemble_vector
from dolfinx.mesh import locate_entities_boundary
from harness import command_line, head, in_turns, keep, line
from scipy.sparse.linalg import splu

from signorini_cr import Contact, Dirichlet, Domain, Neumann, Polygon, Problem, solve_in_time

EDGES = ["floor", "right", "top", "left"]
SQUARE = Polygon([[0, 0], [1, 0], [1, 1], [0, 1]], EDGES, names=EDGES)
ALPHA, END = -0.1, 3.0

STEPS, FEW = 100, 20
"""Numbers of steps on the small mesh and on the large one."""

Run = tuple[list[float], list[float]]
"""The processor's seconds before the first step and in each, and the contact force after each."""


def heat(x, t):
    """The load."""
    return -20.0 * ufl.sin(3.0 * t) * x[0]


class ByHand:
    """A solver as one writes it by hand: `__init__`, `load` and `solve`."""

    def __init__(self, domain: Domain, steps: int):
        """Assemble the matrix."""
        mesh, self.k, self.t = domain.mesh, END / steps, fem.Constant(domain.mesh, 0.0)
        V = fem.functionspace(mesh, ("CR", 1))
        u, v, self.old = ufl.TrialFunction(V), ufl.TestFunction(V), fem.Function(V)
        top = locate_entities_boundary(mesh, 1, lambda x: np.isclose(x[1], 1.0))
        floor = locate_entities_boundary(mesh, 1, lambda x: np.isclose(x[1], 0.0))
        self.top, self.floor = (fem.locate_dofs_topological(V, 1, each) for each in (top, floor))
        a = fem.form((u * v / self.k + ufl.inner(ufl.grad(u), ufl.grad(v))) * ufl.dx)
        load = self.old / self.k + heat(ufl.SpatialCoordinate(mesh), self.t)
        self.L = fem.form(load * v * ufl.dx)
        A = assemble_matrix(a, [fem.dirichletbc(0.0, self.top, V)])
        A.assemble()
        self.A = sparse.csr_matrix(A.getValuesCSR()[::-1]).tocsc()
        self.active, self.lu = np.zeros(len(floor), dtype=bool), None

    def load(self, step: int) -> np.ndarray:
        """Assemble the right-hand side."""
        self.t.value = step * self.k
        b = assemble_vector(self.L).array
        b[self.top] = 0.0
        return b

    def solve(self, b: np.ndarray) -> float:
        """Factorise the reduced matrix whenever the active set has changed."""
        while True:
            u, on = np.zeros(len(b)), self.floor[self.active]
            u[on] = ALPHA
            if self.lu is None:
                self.inner = np.setdiff1d(np.arange(len(b)), on)
                self.lu = splu(self.A[self.inner][:, self.inner])
            u[self.inner] = self.lu.solve((b - self.A @ u)[self.inner])
            push = (self.A @ u - b)[self.floor]
            wanted = np.where(self.active, push > 0.0, u[self.floor] < ALPHA)
            if np.array_equal(wanted, self.active):
                self.old.x.array[:] = u
                return float(push[wanted].sum())
            self.active, self.lu = wanted, None


class WithInverse(ByHand):
    """The same with one factorisation."""

    def __init__(self, domain: Domain, steps: int):
        """Make the inverse on the contact dofs."""
        super().__init__(domain, steps)
        self.lu, unit = splu(self.A), np.zeros((self.A.shape[0], len(self.floor)))
        unit[self.floor, np.arange(len(self.floor))] = 1.0
        self.inverse = self.lu.solve(unit)

    def solve(self, b: np.ndarray) -> float:
        """Solve on the contact dofs."""
        free, floor = self.lu.solve(b), self.floor
        while True:
            push, on = np.zeros(len(floor)), np.flatnonzero(self.active)
            push[on] = np.linalg.solve(self.inverse[floor[on]][:, on], ALPHA - free[floor[on]])
            gap = free[floor] + self.inverse[floor] @ push - ALPHA
            wanted = np.where(self.active, push > 0.0, gap < 0.0)
            if np.array_equal(wanted, self.active):
                self.old.x.array[:] = free + self.inverse @ push
                return float(push.sum())
            self.active = wanted


def by_hand(kind: type[ByHand], domain: Domain, steps: int) -> Run:
    """Run what is written by hand."""
    clock, forces = [time.process_time()], []
    system = kind(domain, steps)
    clock.append(time.process_time())
    for step in range(1, steps + 1):
        forces.append(system.solve(system.load(step)))
        clock.append(time.process_time())
    return [after - before for before, after in pairwise(clock)], forces


def problem(t: fem.Constant) -> Problem:
    """The same for the program."""
    walls = {"right": Neumann(), "left": Neumann(), "top": Dirichlet(0.0)}
    return Problem(f=lambda x: heat(x, t), conditions=walls | {"floor": Contact(ALPHA)})


def by_program(domain: Domain, steps: int, levels: int = 1) -> Run:
    """Run the program; the first step counts as what comes before."""
    t = fem.Constant(domain.mesh, 0.0)
    clock, forces = [time.process_time()], []
    for _, solution in solve_in_time(
        problem(t), domain, end=END, steps=steps, levels=levels, time=t
    ):
        forces.append(solution.contact.force)
        clock.append(time.process_time())
    return [after - before for before, after in pairwise(clock)], forces


def small(repeats: int) -> list[str]:
    """Measure on one mesh, which the lines by hand can do as well; a table."""
    domain = SQUARE.mesh(0.025, comm)
    ways: dict[str, Callable[[], Run]] = {
        "the program": lambda: by_program(domain, STEPS),
        "by hand, factors of the reduced matrix": lambda: by_hand(ByHand, domain, STEPS),
        "by hand, with an inverse": lambda: by_hand(WithInverse, domain, STEPS),
    }
    runs = in_turns(ways, repeats)
    forces = [found[0][1] for found in runs.values()]
    if not all(np.allclose(each, forces[0], rtol=1e-6, atol=1e-6) for each in forces):
        raise SystemExit("forces differ")
    facets = domain.mesh.topology.index_map(1).size_global
    rows = [head([f"{STEPS} steps, {facets:,} dofs", "set up, ms", "a step, ms", "all, s"])]
    for name, found in runs.items():
        set_up = 1e3 * median(seconds[0] for seconds, _ in found)
        step = 1e3 * median(float(np.mean(seconds[1:])) for seconds, _ in found)
        whole = median(sum(seconds) for seconds, _ in found)
        rows.append(line([name, f"{set_up:.0f}", f"{step:.2f}", f"{whole:.2f}"]))
    return rows


def large(dofs: float, repeats: int) -> list[str]:
    """Measure with multigrid; a table."""
    levels = max(1, 1 + round(np.log(dofs / 4000) / np.log(4)))

    def steps() -> list[float]:
        seconds, _ = by_program(SQUARE.mesh(0.03, comm), FEW, levels)
        return seconds[1:]

    def cold() -> list[float]:
        began = time.process_time()
        by_program(SQUARE.mesh(0.03, comm), 1, levels)
        return [time.process_time() - began]

    runs = in_turns({"steps": steps, "cold": cold}, repeats)
    facets = SQUARE.mesh(0.03, comm).mesh.topology.index_map(1).size_global
    several = [seconds for run in runs["steps"] for seconds in run]
    names = ["dofs, about", "a step, s", "the slowest, s", "the first step by itself, s"]
    cells = [f"{facets * 4 ** (levels - 1):,}", f"{median(several):.3f}", f"{max(several):.2f}"]
    return [head(names), line([*cells, f"{median(each for (each,) in runs['cold']):.2f}"])]


def main() -> None:
    """Measure."""
    arguments = command_line(__doc__, dofs=2.4e5, repeats=3).parse_args()
    out: Path = arguments.out
    lines = small(arguments.repeats)
    print("\n".join(lines), flush=True)
    lines += ["", *large(arguments.dofs, arguments.repeats)]
    print("\n".join(lines[-3:]))
    keep([*lines, "", "Processor time."], out / "time_steps.md")


if __name__ == "__main__":
    main()
