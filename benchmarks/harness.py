"""Tools that all benchmarks share: their command line, turns, processes, medians and tables.

Nothing here starts MPI, as mpirun cannot be started from a process that has: what needs it is in
`cases.py`.
"""

from __future__ import annotations

import argparse
import ctypes
import gc
import json
import os
import platform
import subprocess
import sys
import time
from collections.abc import Callable, Collection, Hashable, Iterable, Mapping, Sequence
from pathlib import Path
from statistics import median
from typing import Any, TypeVar

Key = TypeVar("Key", bound=Hashable)
Found = TypeVar("Found")

PUBLISHED = Path(__file__).parent / "results"
"""Folder of the results that documents quote; written to with `--publish` and never else."""

NEVER = -1
"""For glibc's mallopt: memory is not given back."""


def command_line(
    text: str,
    *,
    cases: Collection[str] = (),
    dofs: float | None = None,
    repeats: int | None = None,
) -> argparse.ArgumentParser:
    """Make the parser of a benchmark; what is left out is no option of it.

    Args:
        text: The benchmark's docstring.
        cases: Names to choose from with `--cases`; all of them are the default.
        dofs: Degrees of freedom of the finest mesh, about.
        repeats: How often a measurement that counts is repeated.
    """
    parser = argparse.ArgumentParser(description=text.split("\n")[0])
    if cases:
        parser.add_argument("--cases", nargs="*", choices=list(cases), default=list(cases))
    if dofs is not None:
        parser.add_argument("--dofs", type=float, default=dofs, help="of the finest mesh, about")
    if repeats is not None:
        parser.add_argument("--repeats", type=int, default=repeats)
    folder = parser.add_mutually_exclusive_group()
    folder.add_argument(
        "--out", type=Path, default=Path("benchmark-out"), help="folder of results (%(default)s)"
    )
    folder.add_argument(
        "--publish",
        dest="out",
        action="store_const",
        const=PUBLISHED,
        help="write the results that the documents quote",
    )
    return parser


def launched(*arguments: str, ranks: int | None = None, **environment: str) -> Any:
    """Start the running script anew.

    Args:
        arguments: Its command line.
        ranks: With mpirun and so many processes; without mpirun if left out.
        environment: What is added to the variables of this process.

    Returns:
        What the last line that it printed says, as JSON.

    Raises:
        subprocess.CalledProcessError: If it fails.
    """
    command = [] if ranks is None else ["mpirun", "-n", str(ranks)]
    result = subprocess.run(
        [*command, sys.executable, sys.argv[0], *arguments],
        stdout=subprocess.PIPE,
        check=True,
        text=True,
        env={**os.environ, **environment},
    )
    return json.loads(result.stdout.splitlines()[-1])


def keep_memory() -> None:
    """Have this process keep the memory it once had from the system, if its C library is glibc.

    On virtual machines fresh memory can come at a quarter of a gigabyte a second, which would be
    all that is measured.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        trim_threshold, mmap_max = -1, -4  # the numbers of glibc's malloc.h
        mallopt(trim_threshold, NEVER)
        mallopt(mmap_max, 0)


def in_turns(
    actions: Mapping[Key, Callable[[], Found]], repeats: int, warm: int = 1
) -> dict[Key, list[Found]]:
    """Repeat several measurements in turns, so that what the machine does meanwhile meets all.

    Args:
        actions: What measures, by name; what it holds is freed before the next.
        repeats: So many of each count.
        warm: So many before those don't: they find memory, or fill caches.
    """
    found: dict[Key, list[Found]] = {key: [] for key in actions}
    for _ in range(warm + repeats):
        for key, action in actions.items():
            found[key].append(action())
            gc.collect()
    return {key: results[warm:] for key, results in found.items()}


def medians(runs: Sequence[Mapping[str, float]]) -> dict[str, float]:
    """The median of each figure over all runs."""
    return {key: median(run[key] for run in runs) for key in runs[0]}


def machine() -> str:
    """Say what was measured on: processor, cores, Python, and the day."""
    model, info = platform.machine(), Path("/proc/cpuinfo")
    if info.exists():
        names = [line for line in info.read_text().splitlines() if line.startswith("model name")]
        model = names[0].partition(":")[2].strip() if names else model
    cores, python = os.cpu_count(), platform.python_version()
    return f"{model}, {cores} cores, Python {python}, {time.strftime('%Y-%m-%d')}"


def line(cells: Iterable[str]) -> str:
    """A line of a table in Markdown."""
    return "| " + " | ".join(cells) + " |"


def head(names: Collection[str]) -> str:
    """The first two lines."""
    return line(names) + "\n|---|" + "---:|" * (len(names) - 1)


def keep(lines: Iterable[str], path: Path) -> None:
    """Write a page of tables, and what they were measured on."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("\n".join([*lines, "", f"Last measured on: {machine()}"]) + "\n")


def tabulate(
    names: Collection[str], rows: Iterable[Iterable[str]], path: Path, first: bool = True
) -> None:
    """Print a table as its rows come in, and keep it.

    Args:
        names: Of the columns.
        rows: Their cells; all ranks ask for them.
        path: Where the table is kept.
        first: Whether this is rank 0, the one that prints and keeps.
    """
    lines = [head(names)]
    if first:
        print(lines[-1], flush=True)
    for row in rows:
        lines.append(line(row))
        if first:
            print(lines[-1], flush=True)
            keep(lines, path)
