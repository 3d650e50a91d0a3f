"""Factors of the whole matrix, whatever is constrained, against dense solves."""

import numpy as np
import pytest
from helpers import SQUARE
from mpi4py import MPI
from petsc4py import PETSc

from signorini_cr import Contact, Dirichlet, Neumann, Problem, Solver
from signorini_cr.multigrid.constrained import ConstrainedMatrix
from signorini_cr.multigrid.whole import Whole

SIZE = 40


@pytest.mark.serial
def test_any_active_set():
    rng = np.random.default_rng(0)
    root = rng.standard_normal((SIZE, SIZE))
    dense = root @ root.T + np.eye(SIZE)
    matrix = PETSc.Mat().createDense((SIZE, SIZE), array=dense, comm=MPI.COMM_SELF)
    matrix = matrix.convert("aij")
    bounded = np.arange(3, SIZE, 3, dtype=np.int32)
    operator = ConstrainedMatrix(matrix, bounded)
    solver, b, x = Whole(matrix, bounded), *matrix.createVecs()
    for some in ([], [2, 5], [5], [], list(range(len(bounded)))):
        dofs = bounded[some]
        free = np.setdiff1d(np.arange(SIZE), dofs)
        b.array[:] = rng.standard_normal(SIZE)
        b.array[dofs] = 0.0
        expected = np.zeros(SIZE)
        expected[free] = np.linalg.solve(dense[np.ix_(free, free)], b.array_r[free])
        with operator.constrained(dofs):
            solver.constrain(dofs)
            solver.solve(b, x)
        assert x.array_r == pytest.approx(expected, abs=1e-11)
    solver.free()
    operator.free()


@pytest.mark.serial
def test_a_linear_system_of_a_solver_takes_one_step():
    problem = Problem(
        f=lambda x: 10.0 * (0.4 - x[0]),
        coefficient=lambda x: 1.0 + x[1],
        conditions={"right": Neumann(), "left": Neumann()}
        | {"floor": Contact(-0.05), "top": Dirichlet(0.0)},
    )
    with Solver(problem, SQUARE.mesh(0.1)) as solver:
        solution = solver.solve()
        assert 0 < solution.contact.number_active < solution.contact.number
        assert solution.iterations.linear == solution.iterations.newton
        assert solution.iterations.preconditioner == "a direct solver"
        again = solver.solve(before=solution)
        assert again.iterations.newton == 1
        assert again.contact.force == pytest.approx(solution.contact.force, rel=1e-10)
