"""Newton and CG steps where contact ends in random places.

    container/run python3 benchmarks/random_ends.py

The examples of cases.py on meshes that are mapped by a random shift, so that contact ends anywhere
in its facet. Counted are the meshes from the third on, each started from the one below.
"""

from __future__ import annotations

from collections import Counter

import numpy as np
from cases import EXAMPLES, comm
from harness import command_line, tabulate

from signorini_cr import solve_levels

SQUARES = 8
"""Squares per unit length on the coarsest mesh."""

LEVELS = 6
"""Number of meshes; the last one has 0.4 M dofs."""

SHIFT = 0.35
"""Largest shift."""

MANY = 4
"""So many Newton steps and more are counted together."""

HEAD = (
    "case",
    "meshes",
    *(f"{steps} Newton" for steps in range(1, MANY)),
    f"{MANY} or more",
    "CG, median",
    "CG, most",
)


def row(name: str, shifts: list[float]) -> list[str]:
    """One line of the table."""
    example = EXAMPLES[name]
    newton: Counter[int] = Counter()
    linear = []
    for shift in shifts:
        domain = example.structured(SQUARES, comm, shift=shift)
        for level, solution in enumerate(solve_levels(example.problem, domain, LEVELS)):
            if level >= 2:
                newton[min(solution.iterations.newton, MANY)] += 1
                linear.append(solution.iterations.linear)
    counts = [f"{newton[steps]}" for steps in range(1, MANY + 1)]
    return [name, f"{len(linear)}", *counts, f"{np.median(linear):.0f}", f"{max(linear)}"]


def main() -> None:
    """Print and keep the table."""
    parser = command_line(__doc__)
    parser.add_argument("--draws", type=int, default=65, help="shifts of each case")
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    random = np.random.default_rng(arguments.seed)
    shifts = random.uniform(-SHIFT, SHIFT, (len(EXAMPLES), arguments.draws)).tolist()
    rows = (row(name, own) for name, own in zip(EXAMPLES, shifts, strict=True))
    tabulate(HEAD, rows, arguments.out / "random_ends.md", comm.rank == 0)


if __name__ == "__main__":
    main()
