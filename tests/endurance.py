"""A thousand solves, refinements, certificates and pictures in one process: does memory grow?

    container/run python3 tests/endurance.py --count 1000

prints what the process holds after a tenth, in between and at the end, and ends with status 1 where
it has grown by more than pictures leave in Matplotlib. Four solves are a round: a mesh by gmsh,
refined as a whole and by the error in turns, with certificate and picture at each level, and tables
and field at the end.
"""

from __future__ import annotations

import argparse
import ctypes
import gc
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
import ufl
from mpi4py import MPI

from signorini_cr import Polygon, Problem, solve_adaptive, solve_levels
from signorini_cr.output.plots import plot_contact, plot_error, plot_mesh, plot_solution
from signorini_cr.output.report import level_record, make_report, write_output

WORLD = MPI.COMM_WORLD
LEVELS = 4
DRAWN = (
    lambda solution, path: plot_mesh(solution.domain, path),
    plot_solution,
    plot_contact,
    plot_error,
)
"""Pictures that are drawn of each level."""
DATA: tuple[dict[str, Any], ...] = (
    {"f": -9.0, "obstacle": -0.05, "coefficient": 2.0},
    {"f": lambda x: -20 * x[0], "obstacle": lambda x: 0.1 * x[0] - 0.1},
    {"f": -5.0, "obstacle": lambda x: -0.1 * ufl.cos(x[0]), "coefficient": lambda x: 1 + x[1] / 9},
)
"""Few, as each formula is compiled and stays loaded; there are meshes enough."""
GROWTH = 50_000.0
"""Bytes a solve from which on it is a leak: what a solve holds is some megabytes. Matplotlib keeps
about 20 kB a picture, of which its caches of text are a part; with `--undrawn` it is not there."""


def round_of(number: int, folder: Path, drawn: bool) -> None:
    """Solve on a few meshes, look at all there is to see of them, and forget them; collective."""
    random = np.random.default_rng(number)
    width, height = random.uniform(1, 2, size=2)
    polygon = Polygon(
        [[0, 0], [width, 0], [width, height], [0, height]],
        ("contact", "neumann", "dirichlet", "dirichlet"),
    )
    problem = Problem(**DATA[number % len(DATA)], g=0.3)
    domain, records = polygon.mesh(0.5), []
    steps = solve_adaptive if number % 2 else solve_levels
    for solution, draw in zip(steps(problem, domain, levels=LEVELS), DRAWN, strict=True):
        assert solution.certificate.reason is None
        records.append(level_record(solution, records[-1] if records else None))
        if drawn:
            draw(solution, folder / "one.png")
    report = make_report("Endurance", "CR", WORLD, records)
    write_output(folder, report, solution, pictures=False)


def held() -> int:
    """Return the bytes that this process holds when all that can be given back has been."""
    gc.collect()
    ctypes.CDLL(None).malloc_trim(0)
    words = Path("/proc/self/status").read_text().split()
    return 1024 * int(words[words.index("VmRSS:") + 1])


def main() -> None:
    """Solve, and say what is held."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--count", type=int, default=1000, help="how many solves")
    parser.add_argument("--undrawn", action="store_true", help="without pictures")
    arguments = parser.parse_args()
    rounds, began = arguments.count // LEVELS, time.monotonic()
    looks = [max(rounds * part // 10, 1) for part in (1, 3, 5, 7, 10)]
    found: dict[int, int] = {}
    with tempfile.TemporaryDirectory() as folder:
        for number in range(1, rounds + 1):
            round_of(number, Path(WORLD.bcast(folder)), not arguments.undrawn)
            if number in looks:
                solves, spent = LEVELS * number, time.monotonic() - began
                found[solves] = max(WORLD.allgather(held()))
                if WORLD.rank == 0:
                    size = found[solves] / 1e6
                    print(f"{solves:6} solves {size:8.1f} MB {spent:6.0f} s", flush=True)
    first, last = min(found), max(found)
    growth = (found[last] - found[first]) / max(last - first, 1)
    if WORLD.rank == 0:
        print(f"{growth:.0f} bytes a solve")
    sys.exit(growth > GROWTH)


if __name__ == "__main__":
    main()
