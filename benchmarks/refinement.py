"""What a uniform refinement takes, on one rank and on two, and what comes of handing over facets.

    container/run python3 benchmarks/refinement.py

The mesh of example S1 is refined until the next one has the dofs that are asked for; that step is
repeated, and so is the solve of S1 on all meshes to the last but one. Both are done as the program
does them, which gives DOLFINx 0.9 the facets of the mesh that it makes, and with the facets left to
DOLFINx, which is what later versions insist on. The four ways take turns, each time in new
processes; these keep their memory, and the first of what they repeat does not count.
"""

from __future__ import annotations

import argparse
import json
from functools import partial
from itertools import product
from statistics import median

from harness import command_line, head, in_turns, keep, keep_memory, launched, line

TURNS, REPEATS = 3, 3
"""New processes for each way, and what each of them repeats."""
WAYS = ("handed over", "looked for")
"""Origins of the facets."""


def run(way: str, dofs: float) -> None:
    """Run one process; rank 0 prints the cells, and seconds of refinements and of solves."""
    from cases import comm, timed

    from signorini_cr import compat, exact, solve_levels
    from signorini_cr.mesh.refinement import refine

    keep_memory()
    if way != WAYS[0]:
        compat.can_take_facets = lambda: False
    domain, levels = exact.S1.structured(23), 1
    while 4 * 1.5 * domain.mesh.topology.index_map(2).size_global < dofs:
        domain, levels = refine(domain)[0], levels + 1

    def solve() -> None:
        for _ in solve_levels(exact.S1.problem, exact.S1.structured(23), levels):
            pass

    actions = {"refine": lambda: timed(lambda: refine(domain)), "solve": lambda: timed(solve)}
    seconds = in_turns(actions, REPEATS)
    cells = 4 * domain.mesh.topology.index_map(2).size_global
    if comm.rank == 0:
        print(json.dumps([cells, seconds["refine"], seconds["solve"]]))


def main() -> None:
    """Refine and solve, and keep how long it takes."""
    parser = command_line(__doc__, dofs=3e6)
    parser.add_argument("--run", choices=WAYS, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.run:
        run(arguments.run, arguments.dofs)
        return
    processes = {
        (ranks, way): partial(launched, "--run", way, "--dofs", str(arguments.dofs), ranks=ranks)
        for ranks, way in product((1, 2), WAYS)
    }
    names = ["ranks", "facets", "cells made", "refinement, s", "all meshes before, s"]
    lines = [head(names)]
    for (ranks, way), found in in_turns(processes, TURNS, warm=0).items():
        refined, solved = ([s for each in found for s in each[k]] for k in (1, 2))
        cells = [
            f"{found[0][0]:,}",
            *(f"{median(s):.3f} ({min(s):.3f})" for s in (refined, solved)),
        ]
        lines.append(line([str(ranks), way, *cells]))
    print("\n".join(lines))
    keep([*lines, "", "Medians, in brackets the least."], arguments.out / "refinement.md")


if __name__ == "__main__":
    main()
