"""What the certificate costs beside what it certifies.

    container/run python3 benchmarks/certificate.py

The phases of the finest mesh of a case, and the certificate of its solution; medians.
"""

from __future__ import annotations

from statistics import median

from cases import by_case, finest, slowest
from harness import in_turns, medians

CERTIFIED = ("mesh", "assemble", "solve")
HEAD = ("case", "dofs", "mesh, s", "assembly, s", "VI, s", "certificate, s", "µs a dof", "quotient")


def row(name: str, limit: float, repeats: int) -> list[str]:
    """One line of the table; the first of the solves does not count."""

    def run() -> dict[str, float]:
        solution = finest(name, limit)
        times = {phase: slowest(solution.seconds[phase]) for phase in CERTIFIED}
        certificate = slowest(solution.certificate.seconds)
        return {**times, "certificate": certificate, "dofs": solution.dofs}

    runs = in_turns({name: run}, repeats)[name]
    middle = medians(runs)
    quotient = median(run["certificate"] / sum(run[phase] for phase in CERTIFIED) for run in runs)
    cells = [f"{middle[phase]:.2f}" for phase in (*CERTIFIED, "certificate")]
    each = 1e6 * middle["certificate"] / middle["dofs"]
    return [name, f"{middle['dofs']:,.0f}", *cells, f"{each:.2f}", f"{quotient:.2f}"]


if __name__ == "__main__":
    by_case(__doc__, HEAD, row, "certificate.md")
