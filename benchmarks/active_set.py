"""What the solver finds against direct solvers: residual, KKT figures and the active set.

    container/run python3 benchmarks/active_set.py --dofs 2e5

On the finest mesh of each case: the solver as it is, a cold start with a direct solver and the same
stopping test, and one that goes on until the residual is 1e-13 of the load, whose active set is
taken for the exact one. The residual is in parts of the load, the other figures of KKT are those of
`Kkt`. The last two columns have the facets in the wrong set, and how much that is: the largest
force (or gap times the diagonal) on any of them, in parts of the load.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from cases import by_case, comm, finest

from signorini_cr.options import defaults
from signorini_cr.solution import Solution

HEAD = (
    "case",
    "dofs",
    "Newton: solver / LU / exact",
    "residual: solver / LU",
    "min gap",
    "min pressure",
    "complementarity",
    "in contact: solver / LU / exact",
    "wrong: solver",
    "wrong: LU",
)
DIRECT = {"ksp_type": "preonly", "pc_type": "lu", "pc_factor_mat_solver_type": "mumps"}


def forces(solution: Solution) -> npt.NDArray[np.float64]:
    """Force less gap times the diagonal on the contact facets, in parts of the load."""
    system = solution.level.system
    dofs, bounds = system.bounded, system.bounds
    x = solution.u.x.array[dofs] - system.offset
    pushes = bounds.sign(x) * solution.residual.x.array[dofs]
    return (pushes - system.operator.diagonal * bounds.gap(x)) / system.residual_scale


def wrong(solution: Solution, exact: Solution) -> str:
    """Count the facets in another set than in the exact solution, and say what is at stake."""
    mine, other = forces(solution), forces(exact)
    differ = (mine > 0.0) != (other > 0.0)
    number = comm.allreduce(int(differ.sum()))
    largest = max(comm.allgather(float(np.abs(mine[differ]).max(initial=0.0))))
    return f"{number} ({largest:.0e})" if number else "0"


def row(name: str, dofs: float, repeats: int) -> list[str]:
    """One line of the table; there is nothing to repeat."""
    own = finest(name, dofs)
    with defaults(DIRECT):
        cold = finest(name, dofs, nested=False)
        with defaults({"snes_atol": 1e-13 * own.level.system.residual_scale}):
            exact = finest(name, dofs, nested=False)
    three, both = (own, cold, exact), (own, cold)
    return [
        name,
        f"{own.dofs:,}",
        " / ".join(f"{s.iterations.newton}" for s in three),
        " / ".join(f"{s.contact.kkt.residual:.0e}" for s in both),
        " / ".join(f"{s.contact.kkt.min_gap:.0e}" for s in both),
        " / ".join(f"{s.contact.kkt.min_pressure:.0e}" for s in both),
        " / ".join(f"{s.contact.kkt.complementarity:.0e}" for s in both),
        " / ".join(f"{s.contact.number_active}" for s in three),
        wrong(own, exact),
        wrong(cold, exact),
    ]


if __name__ == "__main__":
    by_case(__doc__, HEAD, row, "active_set.md")
