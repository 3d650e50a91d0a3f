"""How much faster two ranks are than one, and what the memory has to give two of them meanwhile.

    container/run python3 benchmarks/two_ranks.py

One rank and two ranks solve the cases of cases.py in turns, at 3 M dofs, each time in new
processes; the times are those of the variational inequality on the finest mesh. In the middle of
each of these solves, before its first Newton step and after each, all ranks stream through arrays
for some hundredths of a second. That is not part of the solve's time, and its bandwidth is the
least that was found.

Two cores of a machine may be anything from two whole cores to one that is shared, with a way to
the memory of their own or one for both; on a virtual machine it changes while the program runs. So
each solve on two ranks stands beside what streaming was meanwhile, and a second table has the
solves of all cases sorted by that. What one rank has and takes are the medians of that half of its
solves in which its own streaming was the faster, so that two ranks are not compared with what
others on the machine took from one. The last column has the fastest solve of all on either side.

As in one_solve.py the processes keep their memory, and the first solves of each do not count. The
memory comes in large pages where the system has them. Every solve is kept in the folder of results,
where those of further runs are added; the table and the picture are made of all of them. After
changes to the solver remove the file and begin anew. `--cases` with no name behind it measures
nothing: it draws the picture anew.
"""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Iterator
from dataclasses import astuple, dataclass
from functools import partial
from itertools import pairwise
from pathlib import Path
from statistics import median, quantiles

from harness import command_line, head, in_turns, keep, keep_memory, launched, line

FIRST, SOLVES = 2, 6
"""Solves of each process that don't count, and of those that do."""

LARGE_PAGES = {"GLIBC_TUNABLES": "glibc.malloc.hugetlb=1"}

STREAM, PASSES = 20_000_000, 4
"""Numbers in each of three arrays, on all ranks together, and how often they are read."""

EDGES = (1.2, 1.4, 1.6, 1.8)
"""The solves are sorted by the bandwidth of two ranks over that of one."""

FINEST = 2.5e6
"""The finest mesh is the first with more than about so many dofs."""

PLAIN = ["S1", "A", "C 7/2", "C 11/2"]
NAMES = [*PLAIN, *(f"{name} mapped" for name in PLAIN), "polygon"]
"""The keys of `cases.cases`, which needs MPI: mpirun can't be started from within that."""


@dataclass(frozen=True)
class Solve:
    """One solve: its dofs, Newton and CG steps, seconds, and the bandwidth meanwhile in GB/s."""

    dofs: int
    newton: int
    cg: int
    seconds: float
    bandwidth: float


def run(name: str) -> None:
    """Run one process; rank 0 prints its solves as JSON."""
    import numpy as np
    from cases import cases, comm, slowest, timed

    from signorini_cr import solve_levels

    keep_memory()
    problem, domain = cases()[name]
    a, b, c = (np.ones(STREAM // comm.size) for _ in range(3))
    streaming: list[float] = []
    finest = False

    def stream() -> None:
        for _ in range(PASSES):
            np.add(b, c, out=a)

    def monitor(*_: object) -> None:
        if finest:
            streaming.append(timed(stream))

    def solve() -> tuple[int, int, int, float, float]:
        nonlocal finest
        finest = False
        streaming.clear()
        for solution in solve_levels(problem, domain(), 99, monitor=monitor):
            if finest:
                break
            finest = 4 * solution.dofs > FINEST
        seconds = slowest(solution.seconds["solve"]) - sum(streaming)
        bandwidth = 3 * 8 * STREAM * PASSES / max(streaming) / 1e9
        steps = solution.iterations
        return solution.dofs, steps.newton, steps.linear, round(seconds, 4), round(bandwidth, 2)

    found = in_turns({name: solve}, SOLVES, warm=FIRST)[name]
    if comm.rank == 0:
        print(json.dumps(found))


def solved(ranks: int, name: str) -> list[Solve]:
    """The solves of one run in new processes."""
    found = launched("--run", name, ranks=ranks, **LARGE_PAGES)
    return [Solve(*facts) for facts in found]


@dataclass(frozen=True)
class Point:
    """A solve on two ranks: its bandwidth over one rank's, and one rank's time over its own."""

    memory: float
    faster: float


@dataclass(frozen=True)
class Case:
    """The solves of one case on one rank and on two, as `solved` returns them."""

    name: str
    one: list[Solve]
    two: list[Solve]

    @classmethod
    def measured(cls, name: str, turns: int) -> Case:
        """Let one rank and two take turns."""
        runs = in_turns({ranks: partial(solved, ranks, name) for ranks in (1, 2)}, turns, warm=0)
        return cls(name, *([solve for run in found for solve in run] for found in runs.values()))

    @property
    def alone(self) -> list[Solve]:
        """The solves on one rank that count."""
        return sorted(self.one, key=lambda solve: solve.bandwidth)[len(self.one) // 2 :]

    def points(self) -> list[Point]:
        """Each solve on two ranks against one rank."""
        seconds = median(s.seconds for s in self.alone)
        bandwidth = median(s.bandwidth for s in self.alone)
        return [Point(s.bandwidth / bandwidth, seconds / s.seconds) for s in self.two]

    def row(self) -> list[str]:
        """The line of the table."""
        one, two = self.one[0], self.two[0]
        return [
            self.name,
            f"{one.dofs / 1e6:.2f} M",
            f"{one.newton} / {one.cg}",
            f"{two.newton} / {two.cg}",
            span([s.bandwidth for s in self.alone], 0),
            span([s.seconds for s in self.alone]),
            span([s.seconds for s in self.two]),
            span([p.memory for p in self.points()]),
            f"**{span([p.faster for p in self.points()])}**",
            f"{min(s.seconds for s in self.one) / min(s.seconds for s in self.two):.2f}",
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
    "two ranks, s",
    "bandwidth, times one's",
    "faster by",
    "fastest, faster by",
)
BINS = ("bandwidth, times one's", "solves", "faster by")


def by_bandwidth(points: list[Point]) -> Iterator[list[str]]:
    """The lines of the table of all cases' solves, sorted by bandwidth."""
    for low, high in pairwise((0.0, *EDGES, math.inf)):
        faster = [p.faster for p in points if low <= p.memory < high]
        if faster:
            quarter, _, three = quantiles(faster, n=4) if len(faster) > 1 else 3 * faster
            middle = f"**{median(faster):.2f}**, half of them {quarter:.2f}–{three:.2f}"
            bounds = f"to {high}" if low == 0.0 else f"{low} and more" if high == math.inf else ""
            yield [bounds or f"{low} to {high}", f"{len(faster)}", middle]


def picture(cases: list[Case], path: Path) -> None:
    """Draw how much faster each solve on two ranks was, over its bandwidth."""
    from signorini_cr.output import canvas

    points = sorted((p for case in cases for p in case.points()), key=lambda p: p.memory)
    third = len(points) // 3
    slow, fast = (median(p.faster for p in some) for some in (points[:third], points[-third:]))
    figure = canvas.new_figure(9.0, 5.5)
    axes = figure.subplots()
    axes.plot([p.memory for p in points], [p.faster for p in points], "o", color=canvas.GREY,
              markersize=4, alpha=0.5)  # fmt: skip
    for some, value, at, shift, side in (
        (points[:third], slow, 0, -7, "right"),
        (points[-third:], fast, -1, 7, "left"),
    ):
        axes.plot([some[0].memory, some[-1].memory], [value, value], color=canvas.BLUE, linewidth=4)
        axes.annotate(f"half are faster\nthan {value:.2f} times", (some[at].memory, value),
                      (shift, 0), textcoords="offset points", ha=side, va="center", fontsize=12,
                      color=canvas.BLUE)  # fmt: skip
    room = 0.5  # for the labels, beyond all points
    axes.set_xlim(points[0].memory - room, points[-1].memory + room)
    axes.axline((1.0, 1.0), slope=1.0, color="black", linewidth=1)
    axes.annotate("as much faster\nas memory is", (1.0, 1.0), xytext=(32, -8),
                  textcoords="offset points", fontsize=12)  # fmt: skip
    axes.set_title(
        f"Two ranks solve {slow:.1f} times as fast as one where memory is shared,\n"
        f"{fast:.1f} times where each has nearly its own",
        fontsize=14,
    )
    axes.set_xlabel("bandwidth of two ranks over that of one, meanwhile", fontsize=13)
    axes.set_ylabel("one rank's time over two ranks'", fontsize=13)
    axes.grid(alpha=0.25)
    canvas.save(figure, path)


def main() -> None:
    """Measure what the command line asks for."""
    parser = command_line(__doc__, cases=NAMES)
    parser.add_argument("--turns", type=int, default=3)
    parser.add_argument("--run", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.run:
        run(arguments.run)
        return
    kept = arguments.out / "two_ranks.json"
    solves = json.loads(kept.read_text()) if kept.exists() else {}
    for name in arguments.cases:
        case = Case.measured(name, arguments.turns)
        print(line(case.row()), flush=True)
        before = solves.get(name, ([], []))
        new = ([astuple(solve) for solve in those] for those in (case.one, case.two))
        solves[name] = [old + more for old, more in zip(before, new, strict=True)]
        kept.parent.mkdir(parents=True, exist_ok=True)
        kept.write_text(json.dumps(solves) + "\n")
    every = [
        Case(name, *([Solve(*facts) for facts in those] for those in solves[name]))
        for name in NAMES
        if name in solves
    ]
    points = [point for case in every for point in case.points()]
    lines = [head(HEAD), *(line(case.row()) for case in every), ""]
    lines += [head(BINS), *(line(cells) for cells in by_bandwidth(points))]
    if arguments.cases:
        keep(lines, kept.with_suffix(".md"))
    picture(every, kept.with_suffix(".png"))


if __name__ == "__main__":
    main()
