"""What a submatrix of the inactive dofs takes, which the solver goes without.

    container/run python3 benchmarks/submatrix.py
    container/run mpirun -n 2 python3 benchmarks/submatrix.py

On the finest mesh of each case the dofs that are not active in its solution are taken out of the
matrix in the ways that PETSc has: anew, as its active set method does in each Newton step; again,
into a submatrix of the same dofs that is there already; and as a virtual one, which PETSc makes of
matrices that have no other, and which multiplies with the whole matrix. They take turns with a
product, and with `STEPS` steps of CG with the program's cycle, these dofs left over, of which one
step's share is shown. Times are medians, in brackets in products; the mesh is made anew several
times, as where things lie in memory counts, too. The last column is what each way would add to the
variational inequality on that mesh, once a Newton step.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from statistics import median

import numpy as np
from cases import by_case, comm, cycle_of, finest, slowest, timed
from harness import in_turns
from petsc4py import PETSc

from signorini_cr.garbage import release
from signorini_cr.multigrid.constrained import numbers_of
from signorini_cr.multigrid.cycle import Multigrid
from signorini_cr.solution import Solution

Way = Callable[[PETSc.Mat, PETSc.IS, PETSc.Mat], PETSc.Mat]
WAYS: dict[str, Way] = {
    "anew": lambda A, dofs, _: A.createSubMatrix(dofs, dofs),
    "again": lambda A, dofs, known: A.createSubMatrix(dofs, dofs, known),
    "virtual": lambda A, dofs, _: PETSc.Mat().createSubMatrixVirtual(A, dofs, dofs),
}
"""Ways to make a submatrix from a matrix, the dofs, and a submatrix of them.

Whatever petsc4py says, `createSubMatrix` takes all columns where none are named.
"""

HEAD = (
    "case",
    "dofs",
    "product, ms",
    *(f"submatrix {way}, ms (products)" for way in WAYS),
    "CG step, ms (products)",
    "Newton / CG",
    "solve, ms",
    f"of the solve, %: {' / '.join(WAYS)}",
)

STEPS = 6
"""CG steps, about as many as a variational inequality takes on a fine mesh."""

TURNS = 15
"""Times that all is measured on a mesh."""


def measured(solution: Solution, cycle: Multigrid) -> dict[str, list[float]]:
    """Times in ms of all that is in turns."""
    A, active = cycle.matrix, solution.contact.active_set.dofs
    inactive = numbers_of(A, np.delete(np.arange(A.getLocalSize()[0]), active))

    def chosen() -> PETSc.IS:
        # new for each, as in each Newton step: it keeps what has been found out about it
        return PETSc.IS().createGeneral(inactive, comm=comm)

    first = chosen()
    known = A.createSubMatrix(first, first)
    x, b = A.createVecs()
    b.array[:] = np.random.default_rng(0).standard_normal(b.local_size)
    ksp = PETSc.KSP().create(comm)
    ksp.setOperators(A)
    ksp.setType("cg")
    ksp.setNormType(PETSc.KSP.NormType.UNPRECONDITIONED)
    ksp.getPC().setType("python")
    ksp.getPC().setPythonContext(cycle)
    reason = PETSc.KSP.ConvergedReason
    ksp.setConvergenceTest(
        lambda _, step, __: reason.CONVERGED_ITS if step == STEPS else reason.ITERATING
    )

    def steps() -> float:
        with cycle.constrained(active):
            b.array[cycle.finest.left_out] = 0.0
            cycle.apply(None, b, x)  # where the bottom is factorised
            return timed(lambda: ksp.solve(b, x)) / STEPS

    def taken(way: Way) -> float:
        dofs, made = chosen(), []
        seconds = timed(lambda: made.append(way(A, dofs, known)))
        release(dofs, *(matrix for matrix in made if matrix is not known))
        return seconds

    actions: dict[str, Callable[[], float]] = {
        "product": lambda: timed(lambda: A.mult(b, x)),
        **{name: partial(taken, way) for name, way in WAYS.items()},
        "CG step": steps,
    }
    found = in_turns(actions, TURNS)
    release(known, first, x, b, ksp)
    return {key: [1e3 * value for value in values] for key, values in found.items()}


def row(name: str, dofs: float, repeats: int) -> list[str]:
    """One line of the table."""
    rounds = []
    for _ in range(repeats):
        solution = finest(name, dofs)
        with cycle_of(solution) as cycle:
            rounds.append(measured(solution, cycle))
        rounds[-1]["solve"] = [1e3 * slowest(solution.seconds["solve"])]
    found = {key: median(v for each in rounds for v in each[key]) for key in rounds[0]}
    newton, product = solution.iterations.newton, found["product"]
    cells = [f"{found[key]:.1f} (**{found[key] / product:.1f}**)" for key in (*WAYS, "CG step")]
    steps = f"{newton} / {solution.iterations.linear}"
    shares = " / ".join(f"{100 * newton * found[way] / found['solve']:.1f}" for way in WAYS)
    solve = f"{found['solve']:.0f}"
    return [name, f"{solution.dofs:,}", f"{product:.2f}", *cells, steps, solve, shares]


def main() -> None:
    """Print and keep the table."""
    name = "submatrix.md" if comm.size == 1 else f"submatrix-{comm.size}.md"
    by_case(__doc__, HEAD, row, name, ("S1", "A"), 8e5)


if __name__ == "__main__":
    main()
