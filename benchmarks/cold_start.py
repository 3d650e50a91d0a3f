"""Starts from the mesh below against starts from zero, on every mesh.

    container/run python3 benchmarks/cold_start.py

Newton steps on all meshes of a case, the coarsest first, and on the finest the time of the
variational inequality, medians. Both have the same multigrid and take turns; nothing but the start
differs.
"""

from __future__ import annotations

import gc
from statistics import median

from mpi4py import MPI
from one_solve import by_case, cases, comm, meshes

HEAD = ("case", "dofs", "Newton, nested", "VI, s", "Newton, cold", "VI, s")


def row(name: str, limit: float, repeats: int) -> list[str]:
    """One line of the table; the first solves do not count."""
    newton: dict[bool, list[int]] = {}
    seconds: dict[bool, list[float]] = {True: [], False: []}
    for _ in range(1 + repeats):
        for nested, times in seconds.items():
            dofs, newton[nested] = [], []
            for solution in meshes(*cases()[name], limit, nested):
                dofs.append(solution.dofs)
                newton[nested].append(solution.iterations.newton)
            times.append(comm.allreduce(solution.seconds["solve"], op=MPI.MAX))
            del solution
            gc.collect()
    cells = [name, f"{dofs[0]:,} to {dofs[-1]:,}"]
    for nested, times in seconds.items():
        cells += [", ".join(map(str, newton[nested])), f"{median(times[1:]):.2f}"]
    return cells


if __name__ == "__main__":
    by_case(__doc__, HEAD, row, "cold_start.md")
