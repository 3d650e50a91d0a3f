"""The output of a run: the report, the tables, the fields and the pictures.

`level_record` turns a solution into numbers, `table_header` and `table_row` show them on a
terminal, `write_levels` keeps what is finished, `write_output` fills a folder. Nothing here prints.
Functions that take a solution or a communicator are collective: every rank calls them.
"""

from __future__ import annotations

import importlib.metadata
import json
import math
import re
import sys
import warnings
from collections.abc import Callable, Mapping, Sequence
from functools import cache, partial
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import dolfinx
import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from .. import __version__
from ..errors import InputError, on_root
from ..estimate.certificate import SHARES
from ..estimate.force import NO_BOUNDS
from ..means import NO_MEAN
from ..memory import ran_out_of_memory
from ..options import OptionRefused
from . import checkpoint, plots
from .files import Where, Writer, text_writer, write_files
from .sheets import SHEETS
from .strip import Moment, plot_strip
from .tables import levels_csv, markdown_table
from .tables import table_header as table_header
from .tables import table_row as table_row
from .units import PLAIN, Units
from .vtu import write_solution

if TYPE_CHECKING:
    from ..mesh.domain import Domain
    from ..quantities import Quantity
    from ..restart import Restart
    from ..solution import Solution

REPORT = "report.json"
"""Name of the report, which the other files of a run lie beside."""
CHECKED = "check.png"
"""The mesh of a problem that is checked where the results of a run lie."""
FILES = (
    REPORT,
    "levels.csv",
    "levels.md",
    *SHEETS,
    checkpoint.NAME,
    "solution.vtu",
    "mesh.png",
    "solution.png",
    "contact.png",
    "convergence.png",
    "report.html",
    "times.csv",
    "series.pvd",
    "strip.png",
    checkpoint.MOMENTS,
    CHECKED,
)
"""All that runs may leave in a folder, but for fields of steps in time."""
FIELDS = "step_*.vtu"
"""Those; their numbers have five digits or more."""

MOST_CELLS = 4000
"""Of a mesh that is drawn, if there is a coarser one."""

UNDER_WAY = {"lower": None, "upper": None, "reason": "the run is under way, or was ended"}
PHASES = ("mesh", "assemble", "solve", "estimate")
Record = dict[str, Any]


def level_record(
    solution: Solution,
    previous: Mapping[str, Any] | None = None,
    quantities: Mapping[str, Quantity] = MappingProxyType({}),
) -> Record:
    """Collect the numbers of one level, as they stand in report.json.

    Args:
        solution: What was found on this mesh.
        previous: The record of the level before, for the rates.
        quantities: What is wanted in an interval, by name. Each takes about as long as the solve,
            or twice as long for a mean or an integral of u.

    Returns:
        Nothing but dict, list, str, int, float, bool and None; not-a-number and infinity
        are None. The same on all ranks.
    """
    contact, kkt = solution.contact, solution.contact.kkt
    h1, l2 = solution.errors or (None, None)
    gdim = solution.domain.mesh.geometry.dim
    certificate = solution.certificate
    bound = certificate.bound_h1
    return plain(
        {
            "level": solution.level.number,
            "cells": solution.cells,
            "dofs": solution.dofs,
            "h": solution.h,
            "newton_iterations": solution.iterations.newton,
            "linear_iterations": solution.iterations.linear,
            "energy": solution.energy,
            "kkt": {
                "min_gap": kkt.min_gap,
                "min_pressure": kkt.min_pressure,
                "complementarity": kkt.complementarity,
                "residual": kkt.residual,
                "force_error": kkt.force_error,
            },
            "contact": {
                "facets": contact.number,
                "active": contact.number_active,
                "length": contact.length,
                "force": contact.force,
                "transitions": contact.transitions[:, :gdim],
                "force_bounds": _bounded(solution, None),
            },
            "quantities": bounded(solution, quantities),
            "error_h1": h1,
            "error_l2": l2,
            "rate_h1": _rate("error_h1", h1, solution, previous),
            "rate_l2": _rate("error_l2", l2, solution, previous),
            "bound_h1": bound,
            "bound_energy_norm": certificate.bound_energy_norm,
            "effectivity": bound / h1 if bound is not None and h1 else None,
            "bound_reason": certificate.reason,
            "bound_parts": {name: certificate.parts.get(name) for name in SHARES},
            "energy_bounds": energy_bounds(solution),
            "seconds": {phase: solution.seconds.get(phase, 0.0) for phase in PHASES},
        }
    )


def energy_bounds(solution: Solution) -> Record:
    """Find what J(u) is between, as it stands in report.json; collective."""
    return dict(zip(("lower", "upper"), solution.certificate.energy or (None, None), strict=True))


def bounded(solution: Solution, quantities: Mapping[str, Quantity]) -> dict[str, Record]:
    """Bound what is wanted of a solution, as it stands in report.json; collective."""
    return {
        name: {"kind": what.kind, "weighted": what.weight is not None, **_bounded(solution, what)}
        for name, what in quantities.items()
    }


def _bounded(solution: Solution, what: Quantity | None) -> Record:
    """Bound a quantity, None for the contact force, or say why not; collective."""
    try:
        if what is not None:
            return {**what.of(solution)._asdict(), "reason": None}
        lower, upper = solution.force_bounds()
        return {"lower": lower, "upper": upper, "reason": None}
    except OptionRefused:  # is no matter of this figure
        raise
    except InputError as error:
        value = {} if what is None else {"value": None}
        reason = str(error).removeprefix(f"{NO_BOUNDS}: ").removeprefix(f"{NO_MEAN}: ")
        return {**value, "lower": None, "upper": None, "reason": reason}


def make_report(
    title: str,
    element: str,
    comm: MPI.Comm,
    records: Sequence[Record],
    complete: bool = True,
    units: Units = PLAIN,
) -> Record:
    """Make the whole of report.json from the records of its levels.

    Args:
        title: The problem's.
        element: "CR" or "P1".
        comm: The ranks that solved it.
        records: From `level_record`, coarsest level first; none of a run in time that is under
            way.
        complete: Whether these are all the levels that were asked for.
        units: What is told of u, lengths and the rest; also for tables and pictures.
    """
    versions = {
        "signorini_cr": __version__,
        "dolfinx": dolfinx.__version__,
        "petsc": ".".join(str(number) for number in PETSc.Sys.getVersion()),
        "gmsh": _version("gmsh"),
    }
    return {
        "title": title,
        "element": element,
        "ranks": comm.size,
        "versions": versions,
        **units.record(),
        "complete": complete,
        "force_bounds": records[-1]["contact"]["force_bounds"] if records else UNDER_WAY,
        "levels": list(records),
    }


def plain(value: Any) -> Any:
    """Return `value` with nothing in it that JSON does not know (NumPy, NaN, infinities)."""
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, np.ndarray | np.generic):
        return plain(value.tolist())
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return value


def write_levels(
    folder: Where,
    report: Record,
    solution: Solution,
    restart: Restart,
    said: Record,
    former: Sequence[str],
) -> list[str]:
    """Write what costs little, so that it outlives whatever ends the run; collective.

    These are the report, the tables, contact.csv, and what a run that is resumed goes on from.
    Fields and pictures of a former run are removed.

    Args:
        folder: Made if it is not there.
        report: From `make_report`.
        solution: The finest level so far.
        restart: From there.
        said: What the run was told to solve; nothing but what JSON knows.
        former: What `of_former_runs` has found before this run wrote anything.

    Returns:
        The names of the files written.

    Raises:
        InputError: The folder can't be written to.
    """
    comm = solution.domain.mesh.comm
    facts = {"said": said, "levels": report["levels"]}
    texts = _texts(report, solution)
    # next to the first, so that what a run leaves that is ended on the way is known as a run's
    writers = {
        REPORT: texts.pop(REPORT),
        checkpoint.NAME: lambda path: checkpoint.write_checkpoint(path, restart, facts, comm),
        **texts,
    }
    write_files(folder, writers, former, comm, begins=len(report["levels"]) == 1)
    return list(writers)


def of_former_runs(folder: Where, comm: MPI.Comm) -> tuple[str, ...]:
    """Find the names of what a run may have left in a folder, in time or not; collective.

    Returns:
        Nothing where neither a report nor a file to resume from tells of a run: what is called as
        its files are is somebody else's. The latter is the last, as by it the others are known.
    """

    def look() -> list[str]:
        path = Path(folder)
        if not any((path / name).exists() for name in (REPORT, checkpoint.NAME)):
            return []
        fields = [each.name for each in path.glob(FIELDS) if _FIELD.fullmatch(each.name)]
        return [*(name for name in FILES if name != checkpoint.NAME), *fields, checkpoint.NAME]

    return tuple(on_root(comm, look))


_FIELD = re.compile(re.escape(FIELDS).replace(r"\*", "[0-9]{5,}"))


def write_output(
    folder: Where,
    report: Record,
    solution: Solution,
    pictures: bool = True,
    resumable: bool = False,
    moments: Sequence[Moment] = (),
    tell: Callable[[str], object] = warnings.warn,
    former: Sequence[str] | None = None,
) -> list[str]:
    """Write everything a run leaves behind, whole or not at all; collective.

    A picture that Matplotlib fails to draw is left out.

    Args:
        folder: Made if it is not there. What a former run has left and this one does not give, as
            its `convergence.png`, is removed.
        report: From `make_report`.
        solution: The finest level: contact.csv, the field and the pictures are of this one.
        pictures: Whether to draw. There are none of three-dimensional domains, and none where
            Matplotlib is not installed.
        resumable: Whether what `write_levels` has left for a run that is resumed is of this one.
        moments: Of a run in time, for the strip; what `series.write_step` has left is of this one.
        tell: Called on all ranks with what a user should know.
        former: As for `write_levels`; None to look now.

    Returns:
        The names of the files written.

    Raises:
        InputError: The folder can't be written to.
    """
    comm, title, records = solution.domain.mesh.comm, report["title"], report["levels"]
    units, writers = Units.of(report), _texts(report, solution)
    writers["solution.vtu"] = lambda path: write_solution(solution, path)
    drawable = pictures and solution.domain.mesh.geometry.dim == 2
    if drawable and plots.can_draw(comm):
        writers["mesh.png"] = lambda path: plots.plot_mesh(
            *_clear_mesh(solution, path, title), units=units, problem=solution.problem
        )
        writers["solution.png"] = lambda path: plots.plot_solution(
            solution, path, title, units=units
        )
        if solution.contact.number:
            writers["contact.png"] = lambda path: plots.plot_contact(
                solution, path, title, units=units
            )
        if plots.convergence_series(records):
            writers["convergence.png"] = lambda path: plots.drawn(
                comm, lambda: plots.plot_convergence(records, path, title, units=units)
            )
        if moments:
            writers["strip.png"] = lambda path: plots.drawn(
                comm, lambda: plot_strip(moments, path, title, units)
            )
    for name in [name for name in writers if name.endswith(".png")]:
        writers[name] = _if_drawn(writers[name], tell)
    kept = {checkpoint.NAME} if resumable else set()
    if moments:
        kept |= {"times.csv", "series.pvd", checkpoint.MOMENTS}
    found = of_former_runs(folder, comm) if former is None else former
    removed = [
        name for name in found if name not in kept and not (moments and _FIELD.fullmatch(name))
    ]
    return write_files(folder, writers, removed, comm)


def _if_drawn(write: Writer, tell: Callable[[str], object]) -> Writer:
    """Leave a picture out that can't be drawn, as where a user's settings of Matplotlib fail."""

    def attempt(path: Path) -> None:
        try:
            write(path)
        except Exception as error:
            if isinstance(error, InputError) or ran_out_of_memory(error):
                raise
            tell(f"{path.name} cannot be drawn: {type(error).__name__}: {error}")

    return attempt


def _clear_mesh(solution: Solution, path: Path, title: str) -> tuple[Domain, Path, str]:
    """Find the finest mesh whose cells can be told apart in a picture, and a title that says so."""
    domains = [mesh.domain for mesh in solution.level.meshes]
    sizes = [domain.mesh.topology.index_map(2).size_global for domain in domains]
    level = max((i for i, size in enumerate(sizes) if size <= MOST_CELLS), default=0)
    if level == solution.level.number:
        return domains[level], path, title
    return domains[level], path, f"{title}, level {level} of 0 to {solution.level.number}"


def _texts(report: Record, solution: Solution) -> dict[str, Writer]:
    """Prepare the report, which vouches for what lies beside it, and the tables; collective."""
    comm, records = solution.domain.mesh.comm, report["levels"]
    facets = solution.contact.table() or {}
    text = partial(text_writer, comm)
    return {
        REPORT: text(lambda: report_json(report)),
        "levels.csv": text(lambda: levels_csv(records)),
        "levels.md": text(lambda: markdown_table(records, Units.of(report))),
        **{name: text(partial(sheet.text, report, facets)) for name, sheet in SHEETS.items()},
    }


def report_json(report: Mapping[str, Any]) -> str:
    """Return the text of report.json."""
    return json.dumps(plain(report), indent=2, ensure_ascii=False, allow_nan=False) + "\n"


def _rate(
    key: str, value: float | None, solution: Solution, previous: Mapping[str, Any] | None
) -> float | None:
    """Compute log(e/e') / log(h/h'), None where there are no two errors to compare.

    On meshes that are not refined everywhere h, the largest diameter, says nothing; N^(−1/d) with
    the number N of dofs takes its place.
    """
    before = None if previous is None else previous[key]
    if previous is None or not value or not before:
        return None
    d = solution.domain.mesh.topology.dim
    if solution.cells == 2**d * previous["cells"]:
        finer = math.log(solution.h / previous["h"])
    else:
        finer = math.log(previous["dofs"] / solution.dofs) / d
    return math.log(value / before) / finer if finer else None


@cache  # looking takes longer than writing the report of a level
def _version(package: str) -> str | None:
    """Find the installed version, None if it can't be told."""
    module = sys.modules.get(package)
    if (version := getattr(module, "__version__", None)) is not None:
        return str(version)
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None
