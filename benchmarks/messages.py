"""Work and communication of each mesh, as PETSc counts them.

    container/run mpirun --oversubscribe -n 4 python3 benchmarks/messages.py

S1 on nested meshes, twice, so that only the second time counts. What DOLFINx sends for itself, when
it refines and assembles, is not in PETSc's books; flops and messages are of all ranks together.
"""

from __future__ import annotations

import re
import tempfile
from pathlib import Path

from cases import comm
from harness import command_line, tabulate
from petsc4py import PETSc

from signorini_cr import exact, solve_levels

LEVELS = 7

HEAD = ("mesh", "dofs", "CG", "flops a dof", "messages", "reductions", "bytes a message")


def main() -> None:
    """Print and keep one row a mesh."""
    arguments = command_line(__doc__).parse_args()
    PETSc.Log.begin()
    stages = [PETSc.Log.Stage(f"mesh {i}") for i in range(LEVELS)]
    facts = []
    for counted in (False, True):
        solutions = solve_levels(exact.S1.problem, exact.S1.structured(8), LEVELS)
        for stage in stages:
            if counted:
                stage.push()
            solution = next(solutions)
            if counted:
                stage.pop()
                facts.append((solution.dofs, solution.iterations.linear))
    folder = comm.bcast(tempfile.mkdtemp() if comm.rank == 0 else None)
    path = Path(folder) / "log.txt"
    PETSc.Log.view(PETSc.Viewer().createASCII(str(path), comm=PETSc.COMM_WORLD))
    if comm.rank > 0:
        return
    rows = []
    number = r"(\S+) +\S+% +"  # and the part of the whole
    row = re.compile(rf"^ *\d+: +mesh (\d+): +{number}{number}{number}(\S+) +\S+% +(\S+)", re.M)
    for mesh, _, flops, *counts in row.findall(path.read_text()):
        messages, length, reductions = (f"{float(count):,.0f}" for count in counts)
        dofs, cg = facts[int(mesh)]
        each = f"{float(flops) / dofs:,.0f}"
        rows.append([mesh, f"{dofs:,}", f"{cg}", each, messages, reductions, length])
    tabulate(HEAD, rows, arguments.out / f"messages-{comm.size}.md")


if __name__ == "__main__":
    main()
