"""How much faster two ranks are than one, beside what two cores of the machine have to give.

    container/run python3 benchmarks/two_ranks.py

One rank and two ranks solve the cases of one_solve.py in turns, at 3 M dofs, each time in new
processes; the times are those of the variational inequality on the finest mesh. A third run has two
ranks "apart": each solves all of the problem by itself and has nothing to do with the other, so
that twice the time of one rank over theirs is what the machine has to give in these minutes.

After every solve arrays are streamed through, twice. Once the ranks have nothing to do with one
another until the end. The other time they are "in step": after each of PIECES pieces, every few
milliseconds as in the solver, they wait for the slower one. Two ranks are compared with one; those
apart do it, too, so that the three runs differ in nothing else.

A process has the median of its solves, a turn the quotients of these medians; the table has the
median over the turns and, behind it, the range. What stands apart is the fastest solve of all turns
and the quotient of the fastest: on a machine that others use, too, a delay of either rank is one of
both, and the fastest solves are those that nothing delayed.

As in one_solve.py the processes keep their memory, and the first solves of each do not count. The
memory comes in large pages where the system has them.
"""

from __future__ import annotations

import argparse
import gc
import json
import os
import subprocess
import sys
from pathlib import Path
from statistics import median
from typing import Any

from tables import tabulate

FIRST, SOLVES = 2, 3
"""Solves of each process that don't count, and of those that do."""

LARGE_PAGES = {"GLIBC_TUNABLES": "glibc.malloc.hugetlb=1"}

STREAM = 40_000_000
"""Numbers in each of three arrays that are streamed through, on all ranks together."""

PIECES = 20
"""How many pieces of them there are."""

FINEST = 2.5e6
"""The finest mesh is the first with more dofs than this."""

PLAIN = ["S1", "A", "C 7/2", "C 11/2"]
NAMES = [*PLAIN, *(f"{name} mapped" for name in PLAIN), "polygon"]
"""The keys of `one_solve.cases`, which needs MPI: mpirun can't be started from within that."""

MODES = {"one": 1, "two": 2, "apart": 2}


def run(mode: str, name: str) -> None:
    """What one process does; rank 0 prints its figures as JSON."""
    import numpy as np
    import one_solve  # before MPI: where memory is not yet kept it starts the process anew
    from mpi4py import MPI

    from signorini_cr import solve_levels

    comm = MPI.COMM_WORLD
    problem, domain = one_solve.cases(MPI.COMM_SELF if mode == "apart" else comm)[name]
    a, b, c = (np.ones(STREAM // comm.size) for _ in range(3))

    def stream(in_step: bool) -> None:
        for start in range(0, len(a), len(a) // PIECES):
            piece = slice(start, start + len(a) // PIECES)
            np.add(b[piece], c[piece], out=a[piece])
            if in_step:
                comm.barrier()

    seconds, alone, in_step = [], [], []
    for _ in range(FIRST + SOLVES):
        for solution in solve_levels(problem, domain(), 99):
            if solution.dofs > FINEST:
                break
        seconds.append(comm.allreduce(solution.seconds["solve"], op=MPI.MAX))
        dofs, steps = solution.dofs, solution.iterations
        del solution
        gc.collect()  # the next solve finds its memory
        alone.append(one_solve.timed(lambda: stream(in_step=False)))
        in_step.append(one_solve.timed(lambda: stream(in_step=True)))
    facts = {
        "dofs": dofs,
        "steps": f"{steps.newton} / {steps.linear}",
        "seconds": median(seconds[FIRST:]),
        "fastest": min(seconds[FIRST:]),
        "bandwidth": 3 * 8 * STREAM / median(alone) / 1e9,
        "in step": 3 * 8 * STREAM / median(in_step) / 1e9,
    }
    if comm.rank == 0:
        print(json.dumps(facts))


def launched(mode: str, name: str) -> dict[str, Any]:
    """The figures of one run in new processes."""
    command = ["mpirun", "-n", str(MODES[mode]), sys.executable, __file__, "--run", mode, name]
    surroundings = {**os.environ, **LARGE_PAGES}
    result = subprocess.run(
        command, stdout=subprocess.PIPE, check=True, text=True, env=surroundings
    )
    facts: dict[str, Any] = json.loads(result.stdout.splitlines()[-1])
    return facts


def span(values: list[float], digits: int = 2) -> str:
    """The median, and the range behind it."""
    middle, low, high = (f"{f(values):.{digits}f}" for f in (median, min, max))
    return f"{middle} ({low}–{high})"


def row(name: str, turns: int) -> list[str]:
    """One line of the table."""
    found = [{mode: launched(mode, name) for mode in MODES} for _ in range(turns)]

    def of(mode: str, key: str) -> list[float]:
        return [turn[mode][key] for turn in found]

    def quotients(mode: str, key: str = "seconds") -> list[float]:
        return [a / b for a, b in zip(of("one", key), of(mode, key), strict=True)]

    first = found[0]
    one, two, apart = (min(of(mode, "fastest")) for mode in MODES)
    return [
        name,
        f"{first['one']['dofs'] / 1e6:.2f} M",
        first["one"]["steps"],
        first["two"]["steps"],
        span(of("one", "seconds")),
        span(of("two", "seconds")),
        f"**{span(quotients('two'))}**",
        span([2.0 * q for q in quotients("apart")]),
        *(span([1.0 / q for q in quotients("two", key)]) for key in ("bandwidth", "in step")),
        f"{one:.2f}",
        f"{two:.2f}",
        f"**{one / two:.2f}**",
        f"{2.0 * one / apart:.2f}",
    ]


HEAD = (
    "case",
    "dofs",
    "Newton / CG, one",
    "two",
    "one rank, s",
    "two ranks, s",
    "faster by",
    "two apart",
    "bandwidth",
    "in step",
    "fastest, one",
    "two",
    "faster by",
    "two apart",
)


def main() -> None:
    """Measure what the command line asks for."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--cases", nargs="*", default=NAMES, choices=NAMES)
    parser.add_argument("--turns", type=int, default=3)
    parser.add_argument("--run", nargs=2, help=argparse.SUPPRESS)
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results")
    arguments = parser.parse_args()
    if arguments.run:
        run(*arguments.run)
        return
    rows = (row(name, arguments.turns) for name in arguments.cases)
    tabulate(HEAD, rows, arguments.out / "two_ranks.md")


if __name__ == "__main__":
    main()
