"""Steps in time against the lines one writes by hand, and against solving from cold.

    container/run python3 benchmarks/time_steps.py

A plate is heated and cooled, and one edge must not fall below −0.1: implicit Euler, with contact
that comes and goes. By hand means the matrix of Crouzeix-Raviart, the active set method, and a
factorisation that is used again: that of the reduced matrix, until the active set changes; or that
of the whole matrix, with its inverse on the contact dofs. Cold means a solve of the step's problem
by itself, matrix and multigrid included. All must agree with the
program's forces, or the benchmark ends.
"""

from __future__ import annotations

import time
from statistics import median

import numpy as np
import scipy.sparse as sparse
import ufl
from cases import comm
from dolfinx import fem
from dolfinx.fem.petsc import assemble_matrix, assemble_vector
from dolfinx.mesh import locate_entities_boundary
from harness import command_line
from scipy.sparse.linalg import splu

from signorini_cr import Contact, Dirichlet, Domain, Neumann, Polygon, Problem, solve_in_time

EDGES = ["floor", "right", "top", "left"]
SQUARE = Polygon([[0, 0], [1, 0], [1, 1], [0, 1]], EDGES, names=EDGES)
ALPHA, END = -0.1, 3.0


def heat(x, t):
    """The load."""
    return -20.0 * ufl.sin(3.0 * t) * x[0]


class ByHand:
    """The matrix, the load, and what a step does.

    Args:
        domain: The mesh.
        steps: How many there are.
    """

    def __init__(self, domain: Domain, steps: int):
        mesh, self.k = domain.mesh, END / steps
        V, self.t, self.old = (
            fem.functionspace(mesh, ("CR", 1)),
            fem.Constant(mesh, 0.0),
            fem.Function(fem.functionspace(mesh, ("CR", 1))),
        )
        u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
        top = locate_entities_boundary(mesh, 1, lambda x: np.isclose(x[1], 1.0))
        floor = locate_entities_boundary(mesh, 1, lambda x: np.isclose(x[1], 0.0))
        self.fixed = fem.locate_dofs_topological(V, 1, top)
        self.dofs = fem.locate_dofs_topological(V, 1, floor)
        a = fem.form((u * v / self.k + ufl.inner(ufl.grad(u), ufl.grad(v))) * ufl.dx)
        load = self.old / self.k + heat(ufl.SpatialCoordinate(mesh), self.t)
        self.L = fem.form(load * v * ufl.dx)
        A = assemble_matrix(a, [fem.dirichletbc(0.0, self.fixed, V)])
        A.assemble()
        rows, columns, values = A.getValuesCSR()
        self.A = sparse.csr_matrix((values, columns, rows)).tocsc()
        self.active, self.kept = np.zeros(len(self.dofs), dtype=bool), np.empty(0)

    def load(self, step: int) -> np.ndarray:
        """The right-hand side."""
        self.t.value = step * self.k
        b = assemble_vector(self.L).array
        b[self.fixed] = 0.0
        return b

    def reduced(self, b: np.ndarray) -> float:
        """Solve by factorising the reduced matrix whenever the active set has changed."""
        for _ in range(50):
            u, on = np.zeros(len(b)), self.dofs[self.active]
            u[on], inner = ALPHA, np.setdiff1d(np.arange(len(b)), on)
            if not np.array_equal(inner, self.kept):
                self.lu, self.kept = splu(self.A[inner][:, inner]), inner
            u[inner] = self.lu.solve((b - self.A @ u)[inner])
            push = (self.A @ u - b)[self.dofs]
            former = self.active
            self.active = np.where(former, push > 0.0, u[self.dofs] < ALPHA)
            if np.array_equal(former, self.active):
                break
        self.old.x.array[:] = u
        return float(push[self.active].sum())

    def prepare(self) -> None:
        """Make the inverse on the contact dofs."""
        self.lu, unit = splu(self.A), np.zeros((self.A.shape[0], len(self.dofs)))
        unit[self.dofs, np.arange(len(self.dofs))] = 1.0
        self.inverse = self.lu.solve(unit)

    def dense(self, b: np.ndarray) -> float:
        """Solve by the inverse on the contact dofs."""
        free, dofs = self.lu.solve(b), self.dofs
        for _ in range(50):
            push, on = np.zeros(len(dofs)), np.flatnonzero(self.active)
            push[on] = np.linalg.solve(self.inverse[dofs[on]][:, on], ALPHA - free[dofs[on]])
            gap = free[dofs] + self.inverse[dofs] @ push - ALPHA
            former = self.active
            self.active = np.where(former, push > 0.0, gap < 0.0)
            if np.array_equal(former, self.active):
                break
        self.old.x.array[:] = free + self.inverse @ push
        return float(push.sum())


def by_hand(domain: Domain, steps: int, dense: bool) -> tuple[float, list[float]]:
    """Seconds a step, and the contact force after each."""
    system = ByHand(domain, steps)
    if dense:
        system.prepare()
    solve = system.dense if dense else system.reduced
    began = time.perf_counter()
    forces = [solve(system.load(step)) for step in range(1, steps + 1)]
    return (time.perf_counter() - began) / steps, forces


def problem(t: fem.Constant) -> Problem:
    """The same for the program."""
    walls = {"right": Neumann(), "left": Neumann(), "top": Dirichlet(0.0)}
    floor = {"floor": Contact(ALPHA)}
    return Problem(f=lambda x: heat(x, t), conditions=walls | floor)


def by_program(domain: Domain, steps: int, levels: int) -> tuple[list[float], list[float], int]:
    """Seconds of each step, the contact force after each, and the number of dofs."""
    t, seconds, forces = fem.Constant(domain.mesh, 0.0), [], []
    began, dofs = time.perf_counter(), 0
    for _, solution in solve_in_time(
        problem(t), domain, end=END, steps=steps, levels=levels, time=t
    ):
        seconds.append(time.perf_counter() - began)
        forces.append(solution.contact.force)
        dofs, began = solution.dofs, time.perf_counter()
    return seconds, forces, dofs


def main() -> None:
    """Measure."""
    arguments = command_line(__doc__, dofs=2.4e5, repeats=3).parse_args()
    steps = 100
    small = SQUARE.mesh(0.025, comm)
    for _ in range(arguments.repeats):
        seconds, ours, dofs = by_program(small, steps, 1)
        hand = []
        for dense in (False, True):
            taken, theirs = by_hand(small, steps, dense)
            if not np.allclose(theirs, ours, rtol=1e-6, atol=1e-6):
                raise SystemExit("forces differ")
            hand.append(f"{1e3 * taken:.1f}")
        own = 1e3 * float(np.mean(seconds[1:]))
        print(f"{dofs} dofs, {steps} steps, ms a step: {own:.1f}; by hand {' and '.join(hand)}")
    levels = max(1, 1 + round(np.log(arguments.dofs / 3750) / np.log(4)))
    for _ in range(arguments.repeats):
        seconds, _, dofs = by_program(SQUARE.mesh(0.03, comm), 20, levels)
        cold = []
        for _ in range(3):
            alone, _, _ = by_program(SQUARE.mesh(0.03, comm), 1, levels)
            cold += alone
        print(
            f"{dofs} dofs: {median(seconds[1:]):.3f} s a step (median of 19),"
            f" {median(cold):.2f} s for a step by itself from the coarsest mesh on"
        )


if __name__ == "__main__":
    main()
