"""How much faster two ranks are than one, and what the memory has to give two of them meanwhile.

    container/run python3 benchmarks/two_ranks.py

One rank and two ranks solve the cases of one_solve.py in turns, at 3 M dofs, each time in new
processes; the times are those of the variational inequality on the finest mesh. In the middle of
each of these solves, before its first Newton step and after each, all ranks stream through arrays
for some hundredths of a second. That is not part of the solve's time, and its bandwidth is the
least that was found.

Two cores of a machine may be anything from two whole cores to one that is shared, with a way to
the memory of their own or one for both; on a virtual machine it changes while the program runs. So
the solves on two ranks are told apart, not by how fast they were but by what streaming was: where
two ranks had at least ENOUGH times the bandwidth that one has, and where they had less. What one
rank has and takes are the medians of that half of its solves in which its own streaming was the
faster, so that neither is compared with what others on the machine took from it. There are more
turns, up to MORE times as many, until LEAST solves had the memory for both.

As in one_solve.py the processes keep their memory, and the first solves of each do not count. The
memory comes in large pages where the system has them. Every solve is kept in the folder of results,
a case measured again replaces its own; the table and the picture are made of all of them.
"""

from __future__ import annotations

import argparse
import gc
import json
import os
import subprocess
import sys
from dataclasses import astuple, dataclass
from pathlib import Path
from statistics import median

from tables import line, tabulate

FIRST, SOLVES = 2, 6
"""Solves of each process that don't count, and of those that do."""

LARGE_PAGES = {"GLIBC_TUNABLES": "glibc.malloc.hugetlb=1"}

STREAM, PASSES = 20_000_000, 4
"""Numbers in each of three arrays, on all ranks together, and how often they are read."""

ENOUGH = 1.6
"""The bandwidth of two ranks over that of one from which on memory is said to be there for both."""

LEAST, MORE = 8, 4
"""How many such solves there are to be, and how many times the turns that may take."""

FINEST = 2.5e6
"""The finest mesh is the first with more than about so many dofs."""

PLAIN = ["S1", "A", "C 7/2", "C 11/2"]
NAMES = [*PLAIN, *(f"{name} mapped" for name in PLAIN), "polygon"]
"""The keys of `one_solve.cases`, which needs MPI: mpirun can't be started from within that."""


@dataclass(frozen=True)
class Solve:
    """One solve: its dofs, Newton and CG steps, seconds, and the bandwidth meanwhile in GB/s."""

    dofs: int
    newton: int
    cg: int
    seconds: float
    bandwidth: float


def run(name: str) -> None:
    """What one process does; rank 0 prints its solves as JSON."""
    import numpy as np
    import one_solve  # before MPI: where memory is not yet kept it starts the process anew
    from mpi4py import MPI

    from signorini_cr import solve_levels

    comm = MPI.COMM_WORLD
    problem, domain = one_solve.cases(comm)[name]
    a, b, c = (np.ones(STREAM // comm.size) for _ in range(3))
    streaming: list[float] = []
    finest = False

    def stream() -> None:
        for _ in range(PASSES):
            np.add(b, c, out=a)

    def monitor(*_: object) -> None:
        if finest:
            streaming.append(one_solve.timed(stream))

    found = []
    for _ in range(FIRST + SOLVES):
        for solution in solve_levels(problem, domain(), 99, monitor=monitor):
            if finest:
                break
            finest = 4 * solution.dofs > FINEST
        seconds = comm.allreduce(solution.seconds["solve"], op=MPI.MAX) - sum(streaming)
        bandwidth = 3 * 8 * STREAM * PASSES / max(streaming) / 1e9
        steps = solution.iterations
        times = round(seconds, 4), round(bandwidth, 2)
        found.append((solution.dofs, steps.newton, steps.linear, *times))
        finest = False
        streaming.clear()
        del solution
        gc.collect()  # the next solve finds its memory
    if comm.rank == 0:
        print(json.dumps(found[FIRST:]))


def launched(ranks: int, name: str) -> list[Solve]:
    """The solves of one run in new processes."""
    command = ["mpirun", "-n", str(ranks), sys.executable, __file__, "--run", name]
    surroundings = {**os.environ, **LARGE_PAGES}
    result = subprocess.run(
        command, stdout=subprocess.PIPE, check=True, text=True, env=surroundings
    )
    return [Solve(*facts) for facts in json.loads(result.stdout.splitlines()[-1])]


@dataclass(frozen=True)
class Case:
    """The solves of one case on one rank and on two, as `launched` returns them."""

    name: str
    one: list[Solve]
    two: list[Solve]

    @classmethod
    def measured(cls, name: str, turns: int) -> Case:
        """Let one rank and two take turns."""
        case = cls(name, [], [])
        for turn in range(1, MORE * turns + 1):
            case.one.extend(launched(1, name))
            case.two.extend(launched(2, name))
            if turn >= turns and len(case.with_memory) >= LEAST:
                break
        return case

    @property
    def alone(self) -> list[Solve]:
        """The solves on one rank that count."""
        return sorted(self.one, key=lambda solve: solve.bandwidth)[len(self.one) // 2 :]

    @property
    def with_memory(self) -> list[Solve]:
        """The solves on two ranks that had the memory for both."""
        return [s for s in self.two if self.memory(s) >= ENOUGH]

    def faster(self, solve: Solve) -> float:
        """One rank's time over that of a solve."""
        return median(s.seconds for s in self.alone) / solve.seconds

    def memory(self, solve: Solve) -> float:
        """A solve's bandwidth over that of one rank."""
        return solve.bandwidth / median(s.bandwidth for s in self.alone)

    def group(self, solves: list[Solve]) -> list[str]:
        """The cells of some of the solves on two ranks."""
        if not solves:
            return ["0", "–", "–", "–"]
        return [
            f"{len(solves)}",
            f"{median(map(self.memory, solves)):.2f}",
            f"{median(s.seconds for s in solves):.2f}",
            f"**{span([self.faster(s) for s in solves])}**",
        ]

    def row(self) -> list[str]:
        """The line of the table."""
        one, two = self.one[0], self.two[0]
        both = self.with_memory
        return [
            self.name,
            f"{one.dofs / 1e6:.2f} M",
            f"{one.newton} / {one.cg}",
            f"{two.newton} / {two.cg}",
            span([s.bandwidth for s in self.alone], 0),
            span([s.seconds for s in self.alone]),
            *self.group(both),
            *self.group([s for s in self.two if s not in both]),
        ]


def span(values: list[float], digits: int = 2) -> str:
    """The median, and the range behind it."""
    middle, low, high = (f"{f(values):.{digits}f}" for f in (median, min, max))
    return f"{middle} ({low}–{high})"


HEAD = (
    "case",
    "dofs",
    "Newton / CG, one rank",
    "two",
    "one rank, GB/s",
    "s",
    "memory for both: solves",
    "bandwidth, times one's",
    "two ranks, s",
    "faster by",
    "memory for less: solves",
    "bandwidth, times one's",
    "two ranks, s",
    "faster by",
)


def picture(cases: list[Case], path: Path) -> None:
    """How much faster each solve on two ranks was, over its bandwidth."""
    import matplotlib

    matplotlib.use("agg")
    from matplotlib import pyplot as plt

    figure, axis = plt.subplots(figsize=(7.5, 4.2), layout="constrained")
    for i, case in enumerate(cases):
        over = [case.memory(s) for s in case.two]
        faster = [case.faster(s) for s in case.two]
        axis.plot(over, faster, "o", color=f"C{i}", markersize=4, alpha=0.7, label=case.name)
    axis.axhline(ENOUGH, color="black", linewidth=0.8)
    axis.axvline(ENOUGH, color="black", linewidth=0.8)
    axis.set_xlabel("streaming meanwhile: two ranks' bandwidth over one's")
    axis.set_ylabel("solve: one rank's time over two ranks'")
    axis.grid(alpha=0.3)
    figure.legend(loc="outside right upper", fontsize=8)
    figure.savefig(path, dpi=130)


def main() -> None:
    """Measure what the command line asks for."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--cases", nargs="*", default=NAMES, choices=NAMES)
    parser.add_argument("--turns", type=int, default=3)
    parser.add_argument("--run", help=argparse.SUPPRESS)
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results")
    arguments = parser.parse_args()
    if arguments.run:
        run(arguments.run)
        return
    kept = arguments.out / "two_ranks.json"
    solves = json.loads(kept.read_text()) if kept.exists() else {}
    for name in arguments.cases:
        case = Case.measured(name, arguments.turns)
        print(line(case.row()), flush=True)
        solves[name] = [[astuple(solve) for solve in those] for those in (case.one, case.two)]
        kept.parent.mkdir(parents=True, exist_ok=True)
        kept.write_text(json.dumps(solves) + "\n")
    every = [
        Case(name, *([Solve(*facts) for facts in those] for those in solves[name]))
        for name in NAMES
        if name in solves
    ]
    tabulate(HEAD, (case.row() for case in every), kept.with_suffix(".md"))
    picture(every, kept.with_suffix(".png"))


if __name__ == "__main__":
    main()
