"""What a variational inequality costs in units of one linear solve with the same matrix.

    container/run python3 benchmarks/one_solve.py
    container/run mpirun -n 2 python3 benchmarks/one_solve.py

Each case is solved on a sequence of nested meshes, several times over. On each mesh, right after
the variational inequality, one linear system with the same matrix and right-hand side is solved by
CG and BoomerAMG with PETSc's defaults to rtol 1e-8, set-up included, and one product is timed.
Times are medians over the repetitions, the quotients medians of those of each repetition, memory is
the largest ever held until the variational inequality on that mesh was solved. Only a case that
needs more than those before it shows its own; with `--cases`, alone, each does.

The process keeps the memory it has once had from the system. On virtual machines fresh memory can
come at a quarter of a gigabyte a second, which would be all that is measured. So there is one more
repetition, the first, whose times do not count: after it both solvers find memory that is there.

A case measured again replaces its own rows in the folder of results; the table and the picture are
made of all that is there. `--cases` with no name behind it measures nothing: it draws the picture
anew.
"""

from __future__ import annotations

import csv
import math
import resource
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, fields
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
from cases import cases, comm, meshes, slowest, solved_once, timed
from harness import command_line, head, in_turns, keep, keep_memory, line, medians
from petsc4py import PETSc

from signorini_cr.solution import Solution

SHOWN = 4e4
"""Meshes with more dofs are in the table and in the picture."""

LARGE = 3e5
"""Dofs from which on the claims about times hold."""

ALIKE = {
    "S1, A, C 7/2, C 11/2": ("S1", "A", "C 7/2", "C 11/2"),
    "the same, mapped": ("S1 mapped", "A mapped", "C 7/2 mapped", "C 11/2 mapped"),
    "reaction, Robin, both sides": ("reaction", "Robin", "both sides"),
    "materials": ("materials",),
    "polygon": ("polygon",),
}
"""The cases of each colour in the picture."""


@dataclass(frozen=True)
class Row:
    """One mesh of one case. Times in seconds, medians; shares of the mesh's own total.

    Attributes:
        case: The problem and the kind of mesh.
        ranks: Number of processes.
        dofs: Degrees of freedom.
        newton: Newton steps on this mesh.
        cg: CG steps on this mesh.
        vi: Time of the variational inequality on this mesh.
        all_levels: The same, with all coarser meshes.
        linear: Time of one linear solve.
        linear_cg: Its CG steps.
        product: Time of one product with the matrix.
        finest_ratio: vi / linear.
        all_ratio: all_levels / linear.
        mesh: Time for refinement, on this mesh.
        assemble: Time for assembly.
        estimate: Time for what is computed from the solution.
        bytes: Peak memory a dof, everything included; not a number where an earlier case took more.
    """

    case: str
    ranks: int
    dofs: int
    newton: int
    cg: int
    vi: float
    all_levels: float
    linear: float
    linear_cg: int
    product: float
    finest_ratio: float
    all_ratio: float
    mesh: float
    assemble: float
    estimate: float
    bytes: float


def peak() -> int:
    """Peak memory of this run in bytes, over all ranks (Linux)."""
    return int(comm.allreduce(1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss))


def product(A: PETSc.Mat) -> float:
    """Time of one product, the median of several."""
    x, y = A.createVecs()
    x.set(1.0)
    seconds = median(timed(lambda: A.mult(x, y)) for _ in range(7))
    x.destroy()
    y.destroy()
    return seconds


def facts(solution: Solution) -> dict[str, float]:
    """Return the figures of one mesh in one repetition."""
    memory = peak()
    linear, linear_cg = solved_once(solution)
    times = {name: slowest(value) for name, value in solution.seconds.items()}
    return {
        "dofs": solution.dofs,
        "newton": solution.iterations.newton,
        "cg": solution.iterations.linear,
        "vi": times["solve"],
        "linear": linear,
        "linear_cg": linear_cg,
        "product": product(solution.level.system.A),
        "mesh": times["mesh"],
        "assemble": times["assemble"],
        "estimate": times["estimate"],
        "memory": memory,
    }


def measure(name: str, dofs: float, repeats: int) -> Iterator[Row]:
    """Solve one case several times over."""
    before = peak()

    def run() -> list[dict[str, float]]:
        return [facts(solution) for solution in meshes(*cases()[name], dofs)]

    first, *runs = in_turns({name: run}, 1 + repeats, warm=0)[name]
    for level, at_first in enumerate(first):
        sums = [sum(row["vi"] for row in run[: level + 1]) for run in runs]
        at = [run[level] for run in runs]
        middle, memory = medians(at), at_first["memory"]
        yield Row(
            case=name,
            ranks=comm.size,
            dofs=int(middle["dofs"]),
            newton=int(max(row["newton"] for row in at)),
            cg=int(max(row["cg"] for row in at)),
            vi=middle["vi"],
            all_levels=median(sums),
            linear=middle["linear"],
            linear_cg=int(middle["linear_cg"]),
            product=middle["product"],
            finest_ratio=median(row["vi"] / row["linear"] for row in at),
            all_ratio=median(s / row["linear"] for s, row in zip(sums, at, strict=True)),
            mesh=middle["mesh"],
            assemble=middle["assemble"],
            estimate=middle["estimate"],
            bytes=memory / middle["dofs"] if memory > 1.1 * before else np.nan,
        )


KINDS: dict[str, Callable[[str], Any]] = {"str": str, "int": int, "float": float}
COLUMNS: dict[str, Callable[[Row], str]] = {
    "case": lambda r: r.case,
    "ranks": lambda r: f"{r.ranks}",
    "dofs": lambda r: f"{r.dofs / 1e6:.2f} M",
    "Newton": lambda r: f"{r.newton}",
    "CG": lambda r: f"{r.cg}",
    "VI / linear solve": lambda r: f"{r.finest_ratio:.2f}",
    "all meshes / linear solve": lambda r: f"**{r.all_ratio:.2f}**",
    "all meshes, products": lambda r: f"{r.all_levels / r.product:.0f}",
    "VI, products": lambda r: f"{r.vi / r.product:.0f}",
    "linear solve, products": lambda r: f"{r.linear / r.product:.0f}",
    "VI, µs a dof": lambda r: f"{1e6 * r.vi / r.dofs:.2f}",
    "linear solve, µs a dof": lambda r: f"{1e6 * r.linear / r.dofs:.2f}",
    "mesh": lambda r: share(r, r.mesh),
    "assembly": lambda r: share(r, r.assemble),
    "VI": lambda r: share(r, r.vi),
    "facts": lambda r: share(r, r.estimate),
    "kB a dof": lambda r: f"{r.bytes / 1e3:.2f}" if r.bytes == r.bytes else "–",
}


def share(row: Row, seconds: float) -> str:
    """A phase's part of the time spent on one mesh."""
    return f"{100 * seconds / (row.mesh + row.assemble + row.vi + row.estimate):.0f} %"


def columns(row: Row) -> list[str]:
    """A row's cells in the table."""
    return [show(row) for show in COLUMNS.values()]


def picture(rows: list[Row], path: Path) -> None:
    """All meshes together against one linear solve, and CG steps, over the number of dofs."""
    from signorini_cr.output import canvas

    figure = canvas.new_figure(13.0, 5.6)
    rows = sorted((r for r in rows if r.ranks == 1 and r.dofs > SHOWN), key=lambda r: r.dofs)
    shares = [100 * r.all_ratio for r in rows if r.dofs > LARGE]
    steps = [r.cg for r in rows]
    titles = (
        f"From {LARGE / 1e6:g} M unknowns on all meshes together take\n"
        f"{math.floor(min(shares)) / 100:.2f} to {math.ceil(max(shares)) / 100:.2f} "
        "of the time of one linear solve",
        f"CG steps stay between {min(steps)} and {max(steps)}\nhowever fine the mesh",
    )
    values: list[Callable[[Row], float]] = [lambda r: r.all_ratio, lambda r: r.cg]
    sides = ("time over that of one linear solve", "CG steps on the finest mesh")
    paints = (canvas.BLUE, canvas.RED, canvas.YELLOW, canvas.GREY, "black")
    for axes, title, side, value in zip(figure.subplots(1, 2), titles, sides, values, strict=True):
        for (words, names), color, marker in zip(ALIKE.items(), paints, "os^Dv", strict=True):
            for name in names:
                curve = [r for r in rows if r.case == name]
                axes.semilogx([r.dofs for r in curve], [value(r) for r in curve], "-", color=color,
                              marker=marker, markersize=6, linewidth=1.4,
                              label=words if name == names[0] else None)  # fmt: skip
        axes.set_title(title, fontsize=14)
        axes.set_xlabel("degrees of freedom on the finest mesh", fontsize=13)
        axes.set_ylabel(side, fontsize=13)
        axes.set_ylim(bottom=0)
        axes.grid(alpha=0.25)
    left = figure.axes[0]
    canvas.legend(figure, *left.get_legend_handles_labels(), ncols=len(ALIKE))
    left.axhline(1.0, color="black", linewidth=1)
    left.axvline(LARGE, color="black", linewidth=1, linestyle=":")
    left.annotate(
        "one linear solve",
        (0.98, 1.0),
        xytext=(0, 4),
        ha="right",
        xycoords=("axes fraction", "data"),
        textcoords="offset points",
        fontsize=12,
    )
    canvas.save(figure, path)


def read(paths: Iterable[Path]) -> list[Row]:
    """All results in some files, by ranks, case and number of dofs."""
    rows, order = [], list(cases())
    for path in paths:
        with path.open(newline="") as file:
            for record in csv.DictReader(file):
                rows.append(
                    Row(**{f.name: KINDS[str(f.type)](record[f.name]) for f in fields(Row)})
                )
    rows.sort(key=lambda r: (r.ranks, order.index(r.case), r.dofs))
    return rows


def main() -> None:
    """Measure what the command line asks for."""
    arguments = command_line(__doc__, cases=cases(), dofs=3.5e6, repeats=3).parse_args()
    keep_memory()
    path = arguments.out / f"ranks-{comm.size}.csv"
    if comm.rank == 0:
        arguments.out.mkdir(parents=True, exist_ok=True)
    for name in arguments.cases:
        rows = []
        for row in measure(name, arguments.dofs, arguments.repeats):
            rows.append(row)
            if comm.rank == 0:
                print(line(columns(row)), flush=True)
        if comm.rank == 0:
            others = [row for row in read([path] if path.exists() else []) if row.case != name]
            with path.open("w", newline="") as file:
                writer = csv.DictWriter(file, [f.name for f in fields(Row)])
                writer.writeheader()
                writer.writerows(vars(row) for row in [*others, *rows])
    if comm.rank == 0:
        everything = read(sorted(arguments.out.glob("ranks-*.csv")))
        shown = [line(columns(row)) for row in everything if row.dofs > SHOWN]
        if arguments.cases:
            keep([head(COLUMNS), *shown], arguments.out / "table.md")
        picture(everything, arguments.out / "one_solve.png")


if __name__ == "__main__":
    main()
