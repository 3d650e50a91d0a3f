"""Where the time of a whole run goes, from the command to the last picture.

    container/run python3 benchmarks/whole_run.py

Runs `signorini-cr solve meshes/s1.toml`, each time in new processes: with one mesh, the first time
with no form compiled and no font looked for before; then with eight, 2.1 M dofs on the last, on one
rank and on two. Seconds, medians; on two ranks those of rank 0. Each part is without the parts that
it calls, and "all else" has the end of the process, too.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial, wraps
from pathlib import Path
from statistics import median
from typing import Any

from harness import command_line, in_turns, launched, tabulate

PROBLEM = Path(__file__).parents[1] / "meshes" / "s1.toml"

PARTS = (
    "Python and packages",
    "problem file",
    "forms, compiled or found",
    "coarsest mesh",
    "refinement",
    "assembly",
    "variational inequalities",
    "certificates",
    "errors, as u is known",
    "field for ParaView",
    "tables and pictures",
)
PACKAGES, FILE, FORMS, MESH, REFINEMENT, ASSEMBLY, VI, CERTIFICATES, ERRORS, FIELD, OUTPUT = PARTS


@dataclass(frozen=True)
class Run:
    """One column: number of meshes, ranks, and whether nothing has been compiled before."""

    levels: int
    ranks: int = 1
    fresh: bool = False

    @property
    def title(self) -> str:
        """The heading of the column."""
        words = [f"{self.levels} mesh" + "es" * (self.levels > 1)]
        words += ["the first time"] * self.fresh + [f"{self.ranks} ranks"] * (self.ranks > 1)
        return ", ".join(words)


RUNS = (Run(1, fresh=True), Run(1), Run(8), Run(8, ranks=2))


class Clock:
    """Time spent in parts of a program, each without those it calls."""

    def __init__(self) -> None:
        self.seconds: Counter[str] = Counter()
        self._inside = [0.0]

    @contextmanager
    def part(self, name: str) -> Iterator[None]:
        """Count a block's time."""
        began = time.perf_counter()
        self._inside.append(0.0)
        try:
            yield
        finally:
            taken = time.perf_counter() - began
            self.seconds[name] += taken - self._inside.pop()
            self._inside[-1] += taken

    def watch(self, owner: Any, attribute: str, name: str) -> None:
        """Count the time of each call."""
        function: Callable[..., Any] = getattr(owner, attribute)

        @wraps(function)
        def watched(*args: Any, **kwargs: Any) -> Any:
            with self.part(name):
                return function(*args, **kwargs)

        setattr(owner, attribute, watched)


def run(meshes: int, folder: str, began: float) -> None:
    """Run one process; rank 0 prints its times as JSON."""
    clock = Clock()
    clock.seconds[PACKAGES] = time.time() - began
    with clock.part(PACKAGES):
        import builtins

        import dolfinx.jit
        from mpi4py import MPI

        from signorini_cr import levels, solution
        from signorini_cr.app import cli, problemfile
        from signorini_cr.fem import problem
        from signorini_cr.mesh import gmshmesh
        from signorini_cr.output import report as output
        from signorini_cr.vi import system
    for owner, attribute, name in (
        (builtins, "__import__", PACKAGES),
        (problemfile, "load", FILE),
        (dolfinx.jit, "ffcx_jit", FORMS),
        (problemfile.ProblemFile, "mesh", MESH),
        (gmshmesh, "triangulate", MESH),
        (levels, "refine", REFINEMENT),
        (system.System, "__init__", ASSEMBLY),
        (levels, "_solve", VI),
        (solution, "certify", CERTIFICATES),
        (problem.Forms, "errors", ERRORS),
        (output, "write_solution", FIELD),
        (output, "write_output", OUTPUT),
    ):
        clock.watch(owner, attribute, name)
    status = cli.main(["solve", str(PROBLEM), "--levels", str(meshes), "--out", folder, "--quiet"])
    if MPI.COMM_WORLD.rank == 0:
        print(json.dumps(clock.seconds))
    sys.exit(status)


def times(column: Run) -> dict[str, float]:
    """The times of one run in new processes, with that of the whole."""
    with tempfile.TemporaryDirectory() as folder:
        cache = {"XDG_CACHE_HOME": folder} if column.fresh else {}
        ranks = column.ranks if column.ranks > 1 else None
        began = time.time()
        arguments = "--run", str(column.levels), f"{folder}/out", str(began)
        seconds: dict[str, float] = launched(*arguments, ranks=ranks, **cache)
        return seconds | {"": time.time() - began}


def main() -> None:
    """Measure what the command line asks for."""
    parser = command_line(__doc__, repeats=5)
    parser.add_argument("--run", nargs=3, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.run:
        meshes, folder, began = arguments.run
        run(int(meshes), folder, float(began))
    times(RUNS[1])  # compiles what the columns but the first expect to find
    columns = {column: partial(times, column) for column in RUNS}
    measured = in_turns(columns, arguments.repeats, warm=0).values()

    def row(title: str, of: Callable[[dict[str, float]], float]) -> list[str]:
        return [title, *(f"{median(map(of, runs)):.2f}" for runs in measured)]

    rows = [row(name, lambda run, name=name: run.get(name, 0.0)) for name in PARTS]
    rows.append(row("all else", lambda run: 2 * run[""] - sum(run.values())))
    rows.append(row("**altogether**", lambda run: run[""]))
    tabulate(("seconds", *(column.title for column in RUNS)), rows, arguments.out / "whole_run.md")


if __name__ == "__main__":
    main()
