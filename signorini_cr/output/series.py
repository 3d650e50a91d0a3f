"""What a run in time leaves behind: a table of the steps, a field for each, and what holds them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..errors import on_root
from ..rounding import at_most
from .files import Writer, write_files, write_text
from .report import FILES, plain
from .tables import levels_csv
from .units import Units
from .vtu import write_solution

if TYPE_CHECKING:
    from ..solution import Solution

TABLE, SERIES, FIELDS = "times.csv", "series.pvd", "step_*.vtu"
WIDTHS = {
    "step": 5, "time": 10, "newton": 6, "cg": 4, "active": 6, "contact": 8, "force": 12,
    "energy": 12, "bound": 9,
}  # fmt: skip
"""The columns of the printed table."""


def step_record(step: int, time: float, solution: Solution) -> dict[str, Any]:
    """The numbers of a step, as they stand in report.json; collective."""
    contact, certificate = solution.contact, solution.certificate
    return dict(
        plain(
            {
                "step": step,
                "time": time,
                "newton_iterations": solution.iterations.newton,
                "linear_iterations": solution.iterations.linear,
                "active": contact.number_active,
                "length": contact.length,
                "force": contact.force,
                "energy": solution.energy,
                "bound_h1": certificate.bound_h1,
                "bound_energy_norm": certificate.bound_energy_norm,
                "seconds": sum(solution.seconds.values()),
            }
        )
    )


def header() -> str:
    """The head of the printed table."""
    return " ".join(f"{name:>{width}}" for name, width in WIDTHS.items())


def row(record: Mapping[str, Any]) -> str:
    """A row of the printed table."""
    bound = record["bound_h1"]
    cells = (
        str(record["step"]),
        f"{record['time']:.5g}",
        str(record["newton_iterations"]),
        str(record["linear_iterations"]),
        str(record["active"]),
        f"{record['length']:.3g}",
        f"{record['force']:.6g}",
        f"{record['energy']:.6g}",
        "none" if bound is None else at_most(bound),
    )
    return " ".join(f"{cell:>{width}}" for cell, width in zip(cells, WIDTHS.values(), strict=True))


def legend(units: Units) -> str:
    """What the printed columns are measured in, as far as that is told."""
    columns = {"time": "time", "contact": "x", "force": "force"}
    measured = {name: units.after(key) for name, key in columns.items()}
    return ", ".join(f"{name} in{unit}" for name, unit in measured.items() if unit)


def write_step(folder: Path, records: Sequence[Mapping[str, Any]], solution: Solution) -> None:
    """Write a step's field, and the table and the series with all steps so far; collective.

    With the first step what a former run has left goes.

    Args:
        folder: Made if it is not there.
        records: From `step_record`.
        solution: The last step's.

    Raises:
        InputError: The folder can't be written to.
    """
    comm = solution.domain.mesh.comm
    removed: set[str] = set()
    if len(records) == 1:
        found = on_root(comm, lambda: [path.name for path in folder.glob(FIELDS)])
        removed = {*FILES, *comm.bcast(found)}
    writers: dict[str, Writer] = {
        TABLE: lambda path: on_root(comm, write_text, path, lambda: levels_csv(records)),
        SERIES: lambda path: on_root(comm, write_text, path, lambda: _series(records)),
        _field(records[-1]): lambda path: write_solution(solution, path),
    }
    write_files(folder, writers, removed=removed, comm=comm)


def _field(record: Mapping[str, Any]) -> str:
    return FIELDS.replace("*", f"{record['step']:05d}")


def _series(records: Sequence[Mapping[str, Any]]) -> str:
    """ParaView's list of files with their times."""
    sets = "".join(
        f'<DataSet timestep="{record["time"]!r}" file="{_field(record)}"/>\n' for record in records
    )
    return (
        '<?xml version="1.0"?>\n<VTKFile type="Collection" version="0.1">\n<Collection>\n'
        f"{sets}</Collection>\n</VTKFile>\n"
    )
