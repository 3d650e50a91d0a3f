"""What a uniform refinement takes, on as many ranks as it is started on.

    container/run python3 benchmarks/refinement.py
    container/run mpirun -n 2 python3 benchmarks/refinement.py

The mesh of example S1 is refined until the next one has the dofs that are asked for; that step is
repeated, and its median and least wall time are printed. The first, which finds no memory that the
process already has, does not count.
"""

from __future__ import annotations

import argparse
from statistics import median

from cases import comm, timed
from harness import in_turns, keep_memory

from signorini_cr import exact
from signorini_cr.mesh.refinement import refine


def main() -> None:
    """Refine, and say how long it takes."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--dofs", type=float, default=3e6, help="of the mesh that is made")
    parser.add_argument("--repeats", type=int, default=7)
    arguments = parser.parse_args()
    keep_memory()
    domain = exact.S1.structured(23)
    while 4 * 1.5 * domain.mesh.topology.index_map(2).size_global < arguments.dofs:
        domain, _ = refine(domain)
    cells = 4 * domain.mesh.topology.index_map(2).size_global
    runs = in_turns({"refine": lambda: timed(lambda: refine(domain))}, arguments.repeats)
    seconds = runs["refine"]
    if comm.rank == 0:
        print(
            f"{comm.size} ranks, {cells} cells: median {median(seconds):.3f} s,"
            f" least {min(seconds):.3f} s"
        )


if __name__ == "__main__":
    main()
