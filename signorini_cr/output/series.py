"""The output of a run in time: a table of the steps, a field for each, and what holds them."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

from mpi4py import MPI

from ..errors import on_root
from ..rounding import at_most, counted, digits_of, interval
from . import checkpoint
from .files import Where, Writer, text_writer, write_files
from .meanings import OF_STEPS
from .report import FIELDS, REPORT, bounded, energy_bounds, plain, report_json
from .strip import Moment, as_arrays, from_arrays
from .tables import (
    Column,
    bound_of,
    energy,
    explained,
    is_plain_force,
    levels_csv,
    rows_of,
    short,
    unit_of,
)
from .units import GLUE, PLAIN, Units
from .vtu import write_solution

if TYPE_CHECKING:
    from ..quantities import Quantity
    from ..restart import Restart
    from ..solution import Solution

TABLE, SERIES = "times.csv", "series.pvd"
COLUMNS: tuple[Column, ...] = (
    ("step", 5, lambda r: str(r["step"])),
    ("time", 10, lambda r: r["told"]),
    ("newton", 6, lambda r: str(r["newton_iterations"])),
    ("cg", 4, lambda r: str(r["linear_iterations"])),
    ("active", 6, lambda r: str(r["active"])),
    ("contact", 8, lambda r: short(r["length"])),
    ("force", 12, lambda r: _force(r)),
    ("energy", 12, lambda r: energy(r, 4)),
    ("bound", 9, bound_of),
)
"""The printed table."""

SEARCH: tuple[Column, ...] = (
    ("level", 5, lambda r: str(r["level"])),
    ("cells", 8, lambda r: str(r["cells"])),
    ("dofs", 8, lambda r: str(r["dofs"])),
    ("bound", 9, lambda r: at_most(r["bound_h1"])),
)
"""Columns that are printed for the meshes that an adaptive run in time tries."""

MEASURED = {"time": "time", "contact": "x", "force": "force"}
"""The columns whose unit may be told."""


def step_record(
    step: int,
    time: float,
    solution: Solution,
    quantities: Mapping[str, Quantity] = MappingProxyType({}),
) -> dict[str, Any]:
    """Collect the numbers of a step, as they stand in report.json; collective.

    Args:
        step: Its number, from 1.
        time: Its end.
        solution: Of its own problem, in which the steps before are data.
        quantities: What is wanted of that in an interval, by name.
    """
    contact, certificate = solution.contact, solution.certificate
    asked = bounded(solution, quantities)
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
                "energy_bounds": energy_bounds(solution),
                "quantities": asked,
                "seconds": sum(solution.seconds.values()),
            }
        )
    )


def header() -> str:
    """Return the head of the printed table."""
    return " ".join(f"{name:>{width}}" for name, width, _ in COLUMNS)


def row(record: Mapping[str, Any], first: Mapping[str, Any]) -> str:
    """Return a row of the printed table, whose times have the digits of the first step's."""
    told = _told(record, first)
    return " ".join(f"{cell(told):>{width}}" for _, width, cell in COLUMNS)


def _told(record: Mapping[str, Any], first: Mapping[str, Any]) -> dict[str, Any]:
    """Return a record, and its time in digits that suit the whole table."""
    usual = f"{first['time']:.5g}"
    _, _, decimals = usual.partition(".")
    told = f"{record['time']:.{len(decimals)}f}"
    if "e" in usual or len(told) > 10:
        told = f"{record['time']:.5g}"
    return {**record, "told": told}


def _force(record: Mapping[str, Any]) -> str:
    """Format the contact force, where an interval for it was asked for with the digits of that."""
    force = record["force"]
    for found in record["quantities"].values():
        if is_plain_force(found) and math.isclose(found["value"], force, rel_tol=1e-9):
            return digits_of(force, found["upper"] - found["lower"], 4)
    return short(force, 4) if abs(force) < 1e4 else digits_of(force, None, 4)


def search_header() -> str:
    """Return the head of what is told of meshes that are tried."""
    return " ".join(f"{name:>{width}}" for name, width, _ in SEARCH)


def search_row(record: Mapping[str, Any]) -> str:
    """Say what is known of a mesh that was tried; the record is from `search_record`."""
    return " ".join(f"{cell(record):>{width}}" for _, width, cell in SEARCH)


def search_rows(records: Sequence[Mapping[str, Any]]) -> list[list[str]]:
    """Return the cells of these rows, their head first."""
    return rows_of(SEARCH, records, {}, PLAIN)


def search_record(last: Solution, bound: float) -> dict[str, Any]:
    """Collect what is known of a mesh on which all steps were solved; collective.

    Args:
        last: Of the last step.
        bound: The largest of all steps.
    """
    topology = last.domain.mesh.topology
    cells = topology.index_map(topology.dim).size_global
    return {"level": last.level.number, "cells": cells, "dofs": last.dofs, "bound_h1": bound}


def table_rows(records: Sequence[Mapping[str, Any]], units: Units) -> list[list[str]]:
    """Return the cells of the printed table, its head first, which has the units."""
    return rows_of(COLUMNS, [_told(record, records[0]) for record in records], MEASURED, units)


def legend(units: Units) -> str:
    """Say what the printed columns mean, and what they are measured in, as far as that is told."""
    return explained({name: OF_STEPS[name][0] for name, *_ in COLUMNS}, MEASURED, units)


def certificate_line(records: Sequence[Mapping[str, Any]]) -> str:
    """Say what is certain about the steps."""
    bounds = [record["bound_h1"] for record in records if record["bound_h1"] is not None]
    if len(bounds) < len(records):
        missing = len(records) - len(bounds)
        have = "has" if missing == 1 else "have"
        return f"{missing} of {counted(len(records), 'step')} {have} no bound of the error"
    return (
        "certified: in no step is ‖∇_h(u − u_h)‖ of its own problem, in which the steps before"
        f" are data, above {at_most(max(bounds))}"
    )


def over_time(records: Sequence[Mapping[str, Any]], units: Units) -> list[str]:
    """Say what is certain about each quantity in all steps, a sentence each."""
    said = []
    for name, last in records[-1]["quantities"].items():
        found = [record["quantities"][name] for record in records]
        reasons = [each["reason"] for each in found if each["reason"] is not None]
        if reasons:
            said.append(f"{name} has no bounds in {counted(len(reasons), 'step')}: {reasons[0]}")
            continue
        lower, upper = min(each["lower"] for each in found), max(each["upper"] for each in found)
        ends = interval(lower, upper).replace(" ", GLUE)
        said.append(
            f"certified: in no step's own problem, in which the steps before are data, is {name}"
            f" outside {ends}{unit_of(last, units)}; its interval in each step is in {TABLE}"
        )
    return said


def times(records: Sequence[Mapping[str, Any]]) -> str:
    """Say how long the steps have taken."""
    total = sum(record["seconds"] for record in records)
    whole, each = (digits_of(seconds, None, 2) for seconds in (total, total / len(records)))
    return f"{whole}{GLUE}s for {counted(len(records), 'step')}, {each}{GLUE}s a step"


def is_kept(step: int) -> bool:
    """Tell whether table, report and restart are written with a step: with all of the first 200.

    Later on that would take longer than to solve: what they take grows with the steps before.
    """
    return step % (1 + step // 200) == 0


def write_step(folder: Where, step: int, solution: Solution) -> None:
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


def write_search(
    folder: Where,
    report: Mapping[str, Any],
    restart: Restart,
    said: Mapping[str, Any],
    former: Sequence[str],
    comm: MPI.Comm,
) -> None:
    """Write how far the search for a mesh has come, for a run that is resumed; collective.

    With the first mesh what a former run has left goes.

    Args:
        folder: Made if it is not there.
        report: From `make_report`, with records from `search_record` as ``search``.
        restart: `Restart.of_meshes` of the last one.
        said: What the run was told to solve; nothing but what JSON knows.
        former: What `of_former_runs` has found before this run wrote anything.
        comm: The ranks.

    Raises:
        InputError: The folder can't be written to.
    """
    facts = {"said": said, "levels": report["search"]}
    begins = len(report["search"]) == 1
    writers: dict[str, Writer] = {
        REPORT: text_writer(comm, lambda: report_json(report)),
        checkpoint.NAME: lambda path: checkpoint.write_checkpoint(path, restart, facts, comm),
    }
    write_files(folder, writers, former if begins else (), comm, begins)


def write_steps(
    folder: Where,
    report: Mapping[str, Any],
    solution: Solution,
    restart: Restart,
    facts: dict[str, Any],
    moments: Sequence[Moment],
    former: Sequence[str],
) -> None:
    """Write the last step's field, and all that tells of the steps so far; collective.

    These are the report, the table, the series, and what a run that is resumed goes on from. With
    the first step what a former run has left goes.

    Args:
        folder: Made if it is not there.
        report: From `make_report`, with records from `step_record` as ``times``.
        solution: The last step's.
        restart: From there.
        facts: What else a run that is resumed is to know; nothing but what JSON knows.
        moments: So far, for the strip.
        former: What `of_former_runs` has found before this run wrote anything.

    Raises:
        InputError: The folder can't be written to.
    """
    comm, records = solution.domain.mesh.comm, report["times"]
    begins = len(records) == 1
    text = partial(text_writer, comm)
    writers: dict[str, Writer] = {
        REPORT: text(lambda: report_json(report)),
        checkpoint.NAME: lambda path: checkpoint.write_checkpoint(path, restart, facts, comm),
        TABLE: text(lambda: levels_csv(records)),
        SERIES: text(lambda: _series(records)),
        _field(len(records)): lambda path: write_solution(solution, path),
    }
    if moments and moments[-1].time == records[-1]["time"]:
        arrays = as_arrays(moments)
        writers[checkpoint.MOMENTS] = lambda path: on_root(
            comm, checkpoint.write_arrays, path, arrays
        )
    write_files(folder, writers, former if begins else (), comm, begins)


def read_moments(folder: Where, comm: MPI.Comm) -> list[Moment]:
    """Read the moments of a run that is resumed; collective.

    Raises:
        InputError: They can't be read.
    """
    arrays = on_root(comm, checkpoint.read_arrays, Path(folder) / checkpoint.MOMENTS)
    return from_arrays(arrays or {})


def _field(step: int) -> str:
    return FIELDS.replace("*", f"{step:05d}")


def _series(records: Sequence[Mapping[str, Any]]) -> str:
    """Return ParaView's list of files with their times."""
    sets = "".join(
        f'<DataSet timestep="{record["time"]!r}" file="{_field(record["step"])}"/>\n'
        for record in records
    )
    return (
        '<?xml version="1.0"?>\n<VTKFile type="Collection" version="0.1">\n<Collection>\n'
        f"{sets}</Collection>\n</VTKFile>\n"
    )
