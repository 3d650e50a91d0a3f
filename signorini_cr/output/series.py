"""What a run in time leaves behind: a table of the steps, a field for each, and what holds them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mpi4py import MPI

from ..errors import on_root
from . import checkpoint
from .files import Writer, write_files, write_text
from .report import FILES, plain, report_json
from .strip import Moment, as_arrays, from_arrays
from .tables import levels_csv
from .units import Units
from .vtu import write_solution

if TYPE_CHECKING:
    from ..restart import Restart
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
        "none" if bound is None else f"{bound:.3g}",
    )
    return " ".join(f"{cell:>{width}}" for cell, width in zip(cells, WIDTHS.values(), strict=True))


def legend(units: Units) -> str:
    """What the printed columns are measured in, as far as that is told."""
    columns = {"time": "time", "contact": "x", "force": "force"}
    measured = {name: units.after(key) for name, key in columns.items()}
    return ", ".join(f"{name} in{unit}" for name, unit in measured.items() if unit)


def is_kept(step: int) -> bool:
    """Whether table, report and restart are written with a step: with each of the first 200.

    Later on that would take longer than to solve: what they take grows with the steps before.
    """
    return step % (1 + step // 200) == 0


def write_step(folder: Path, step: int, solution: Solution) -> None:
    """Write a step's field; collective.

    Args:
        folder: Made if it is not there.
        step: Its number.
        solution: What was found.

    Raises:
        InputError: The folder can't be written to.
    """
    comm = solution.domain.mesh.comm
    write_files(folder, {_field(step): lambda path: write_solution(solution, path)}, comm=comm)


def write_steps(
    folder: Path,
    report: Mapping[str, Any],
    solution: Solution,
    restart: Restart,
    said: Mapping[str, Any],
    moments: Sequence[Moment],
) -> None:
    """Write the last step's field, and all that tells of the steps so far; collective.

    These are the report, the table, the series, and what a run that is resumed goes on from. With
    the first step what a former run has left goes.

    Args:
        folder: Made if it is not there.
        report: From `make_report`, with records from `step_record` as ``times``.
        solution: The last step's.
        restart: From there.
        said: What the run was told to solve; nothing but what JSON knows.
        moments: So far, for the strip.

    Raises:
        InputError: The folder can't be written to.
    """
    comm, records = solution.domain.mesh.comm, report["times"]
    removed: set[str] = set()
    if len(records) == 1:
        found = on_root(comm, lambda: [path.name for path in folder.glob(FIELDS)])
        removed = {*FILES, *found}
    facts = {"said": said, "times": records}

    def text(make: Callable[[], str]) -> Writer:
        return lambda path: on_root(comm, write_text, path, make)

    writers: dict[str, Writer] = {
        "report.json": text(lambda: report_json(report)),
        TABLE: text(lambda: levels_csv(records)),
        SERIES: text(lambda: _series(records)),
        checkpoint.NAME: lambda path: checkpoint.write_checkpoint(path, restart, facts, comm),
        _field(len(records)): lambda path: write_solution(solution, path),
    }
    if moments and moments[-1].time == records[-1]["time"]:
        arrays = as_arrays(moments)
        writers[checkpoint.MOMENTS] = lambda path: on_root(
            comm, checkpoint.write_arrays, path, arrays
        )
    write_files(folder, writers, removed=removed, comm=comm)


def read_moments(folder: Path, comm: MPI.Comm) -> list[Moment]:
    """The moments of a run that is resumed; collective.

    Raises:
        InputError: They can't be read.
    """
    arrays = on_root(comm, checkpoint.read_arrays, folder / checkpoint.MOMENTS)
    return from_arrays(arrays or {})


def _field(step: int) -> str:
    return FIELDS.replace("*", f"{step:05d}")


def _series(records: Sequence[Mapping[str, Any]]) -> str:
    """ParaView's list of files with their times."""
    sets = "".join(
        f'<DataSet timestep="{record["time"]!r}" file="{_field(record["step"])}"/>\n'
        for record in records
    )
    return (
        '<?xml version="1.0"?>\n<VTKFile type="Collection" version="0.1">\n<Collection>\n'
        f"{sets}</Collection>\n</VTKFile>\n"
    )
