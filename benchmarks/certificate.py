"""What the certificate costs beside what it certifies.

    container/run python3 benchmarks/certificate.py

The phases of the finest mesh of a case, and the certificate of its solution; medians.
"""

from __future__ import annotations

import argparse
import gc
from pathlib import Path
from statistics import median

from mpi4py import MPI
from one_solve import cases, comm, meshes, tabulate, timed

CERTIFIED = ("mesh", "assemble", "solve")
HEAD = ("case", "dofs", "mesh, s", "assembly, s", "VI, s", "certificate, s", "µs a dof", "quotient")


def row(name: str, limit: float, repeats: int) -> list[str]:
    """One line of the table; the first of the solves does not count."""
    runs: list[list[float]] = []
    for _ in range(1 + repeats):
        for solution in meshes(name, limit):
            pass
        dofs = solution.dofs
        phases = [comm.allreduce(solution.seconds[p], op=MPI.MAX) for p in CERTIFIED]
        runs.append([*phases, timed(lambda s=solution: s.certificate)])
        del solution
        gc.collect()
    del runs[0]
    middle = [median(phase) for phase in zip(*runs, strict=True)]
    quotient = median(certificate / sum(phases) for *phases, certificate in runs)
    cells = [f"{seconds:.2f}" for seconds in middle]
    return [name, f"{dofs:,}", *cells, f"{1e6 * middle[-1] / dofs:.2f}", f"{quotient:.2f}"]


def main() -> None:
    """Print and keep the table."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--dofs", type=float, default=3.5e6, help="of the finest mesh, about")
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--cases", nargs="*", choices=list(cases()), default=list(cases()))
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results")
    arguments = parser.parse_args()
    rows = (row(name, arguments.dofs, arguments.repeats) for name in arguments.cases)
    tabulate(HEAD, rows, arguments.out / "certificate.md")


if __name__ == "__main__":
    main()
