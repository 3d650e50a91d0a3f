"""Starts from the mesh below against starts from zero, on every mesh.

    container/run python3 benchmarks/cold_start.py

Newton steps on all meshes of a case, the coarsest first, and on the finest the time of the
variational inequality, medians. Both have the same multigrid and take turns; nothing but the start
differs.
"""

from __future__ import annotations

from functools import partial
from statistics import median

from cases import by_case, cases, meshes, slowest
from harness import in_turns

HEAD = ("case", "dofs", "Newton, nested", "VI, s", "Newton, cold", "VI, s")


def run(name: str, limit: float, nested: bool) -> tuple[list[int], list[int], float]:
    """Dofs and Newton steps of all meshes, and the time on the finest."""
    dofs, newton = [], []
    for solution in meshes(*cases()[name], limit, nested):
        dofs.append(solution.dofs)
        newton.append(solution.iterations.newton)
    return dofs, newton, slowest(solution.seconds["solve"])


def row(name: str, limit: float, repeats: int) -> list[str]:
    """One line of the table; the first solves do not count."""
    starts = {nested: partial(run, name, limit, nested) for nested in (True, False)}
    found = in_turns(starts, repeats)
    dofs = found[True][0][0]
    cells = [name, f"{dofs[0]:,} to {dofs[-1]:,}"]
    for runs in found.values():
        cells += [", ".join(map(str, runs[-1][1])), f"{median(run[2] for run in runs):.2f}"]
    return cells


if __name__ == "__main__":
    by_case(__doc__, HEAD, row, "cold_start.md")
