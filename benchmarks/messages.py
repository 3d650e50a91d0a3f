"""Work and communication of each mesh, as PETSc counts them.

    container/run mpirun --oversubscribe -n 4 python3 benchmarks/messages.py

S1 on nested meshes, twice, so that only the second time counts. What DOLFINx sends for itself, when
it refines and assembles, is not in PETSc's books; flops and messages are of all ranks together.
"""

from __future__ import annotations

import re
import tempfile
from pathlib import Path

import petsc4py

petsc4py.init(["messages", "-options_left", "no"])

from petsc4py import PETSc  # noqa: E402

from signorini_cr import exact, solve_levels  # noqa: E402

LEVELS = 7


def main() -> None:
    """Print one row a mesh."""
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
    comm = PETSc.COMM_WORLD.tompi4py()
    folder = comm.bcast(tempfile.mkdtemp() if comm.rank == 0 else None)
    path = Path(folder) / "log.txt"
    PETSc.Log.view(PETSc.Viewer().createASCII(str(path), comm=PETSc.COMM_WORLD))
    if comm.rank > 0:
        return
    print("| mesh | dofs | CG | flops a dof | messages | reductions | bytes a message |")
    print("|---:|---:|---:|---:|---:|---:|---:|")
    number = r"(\S+) +\S+% +"  # and the part of the whole
    row = re.compile(rf"^ *\d+: +mesh (\d+): +{number}{number}{number}(\S+) +\S+% +(\S+)", re.M)
    for mesh, _, flops, messages, length, reductions in row.findall(path.read_text()):
        dofs, cg = facts[int(mesh)]
        print(
            f"| {mesh} | {dofs:,} | {cg} | {float(flops) / dofs:,.0f} | {float(messages):,.0f} "
            f"| {float(reductions):,.0f} | {float(length):,.0f} |"
        )


if __name__ == "__main__":
    main()
