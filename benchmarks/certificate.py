"""What the certificate costs beside what it certifies.

    container/run python3 benchmarks/certificate.py

The phases of the finest mesh of a case, and the certificate of its solution; medians.
"""

from __future__ import annotations

import gc
from statistics import median

from mpi4py import MPI
from one_solve import by_case, cases, comm, meshes

CERTIFIED = ("mesh", "assemble", "solve")
HEAD = ("case", "dofs", "mesh, s", "assembly, s", "VI, s", "certificate, s", "µs a dof", "quotient")


def row(name: str, limit: float, repeats: int) -> list[str]:
    """One line of the table; the first of the solves does not count."""
    runs: list[list[float]] = []
    for _ in range(1 + repeats):
        for solution in meshes(*cases()[name], limit):
            pass
        dofs = solution.dofs
        times = [*(solution.seconds[phase] for phase in CERTIFIED), solution.certificate.seconds]
        runs.append([comm.allreduce(seconds, op=MPI.MAX) for seconds in times])
        del solution
        gc.collect()
    del runs[0]
    middle = [median(phase) for phase in zip(*runs, strict=True)]
    quotient = median(certificate / sum(phases) for *phases, certificate in runs)
    cells = [f"{seconds:.2f}" for seconds in middle]
    return [name, f"{dofs:,}", *cells, f"{1e6 * middle[-1] / dofs:.2f}", f"{quotient:.2f}"]


if __name__ == "__main__":
    by_case(__doc__, HEAD, row, "certificate.md")
