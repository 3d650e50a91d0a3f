"""The run of `solve`: meshes, or steps in time, solved one by one, told, and kept in the folder."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from ..adaptive import Shares
from ..errors import InputError, NotConverged, naming
from ..mesh.domain import Domain
from ..output import report as output
from ..output import tables
from ..restart import Restart
from ..solution import Solution
from . import problemfile
from .problemfile import ProblemFile
from .run import (
    Run,
    above_tolerance,
    no_solution,
    out_of_reach,
    step_of_solver,
    stopped,
    tell_of_rounding,
    tell_of_tolerance,
)
from .screen import Screen, wrapped
from .signals import keep
from .statement import folded, statement
from .timerun import Steps


def solve_case(
    args: argparse.Namespace, screen: Screen, comm: Any, folder: Path, kept: list[output.Record]
) -> None:
    """Solve what the problem file says, and write it into a folder; collective.

    Args:
        args: The command line.
        screen: Where it is told.
        comm: The ranks.
        folder: What is written goes there.
        kept: Gets the records of the levels, or steps in time, that are safe in the folder.

    Raises:
        InputError: Of the problem file, or a folder with results of another run.
        NotConverged: After levels, or steps, that are kept.
    """
    case, domain = read_case(args, screen, comm)
    problem = statement(case, domain)
    screen.line(f"{folded(problem)}\n")
    former = output.of_former_runs(folder, comm)
    run = Run(args, screen, comm, folder, case, domain, problem, kept, former)
    if case.time is None:
        _solve_levels(run)
    else:
        Steps(run).solve()


def read_case(args: argparse.Namespace, screen: Screen, comm: Any) -> tuple[ProblemFile, Domain]:
    """Read the checked problem file, and make the coarsest mesh; collective."""
    case = problemfile.load(args.file, comm)
    if getattr(args, "levels", None) is not None:
        case = replace(case, levels=args.levels)
    if getattr(args, "element", "cr") != "cr":
        if case.time is not None:
            raise InputError("--element: problems in time are solved with cr")
        if case.mode == "adaptive":
            raise InputError("--element: meshes are adapted by bounds, which only cr has")
    screen.progress("making the mesh")
    domain = case.mesh(comm)
    limit = getattr(args, "max_time", None)  # `check` has none
    for doubt in case.check(domain, None if limit is None else args.began + limit):
        screen.warn(f"{args.file}: {doubt}")
    return case, domain


def _solve_levels(run: Run) -> None:
    """Solve on one mesh after the other; collective."""
    said, kept, screen = run.said(), run.kept, run.screen
    restart, _ = run.resumed(said)
    for record in kept:
        _tell(record, kept[0], screen)
    finest: Solution | None = None
    failure: NotConverged | None = None
    warned = doubted = False
    try:
        for solution in _solutions(run, restart):
            if solution.level.number < len(kept):  # the one that it goes on from
                finest = solution
                continue
            _ = solution.errors, solution.certificate  # the report reads what is there
            before = kept[-1] if kept else None
            record = output.level_record(solution, before, run.case.quantities)
            report = run.report([*kept, record])
            with naming("--out"):
                restart = Restart.of(solution, restart, run.case.mode == "adaptive")
                facts = report, solution, restart, said, run.former
                keep(partial(output.write_levels, run.folder, *facts), kept, [record])
            finest = solution
            if screen.verbose:
                taken = solution.iterations.preconditioner
                screen.line(wrapped(taken, "  linear systems: "))
            _tell(record, kept[0], screen)
            if not doubted and (doubt := no_solution(record)) is not None:
                screen.warn(f"{run.args.file}: {doubt}")
                doubted = True
            if not warned and (doubt := out_of_reach(run.case, kept)) is not None:
                screen.warn(f"{run.args.file}: {doubt}")
                warned = True
    except NotConverged as error:
        failure = error
    if kept:
        failure = failure or above_tolerance(run.case, kept[-1]["bound_h1"], kept[-1]["level"])
    if finest is not None:
        names = run.write(run.report(kept, failure is None), finest)
        _conclude(run, finest, names)
    if failure is not None:
        raise NotConverged(stopped(failure, kept, run.folder))


def _solutions(run: Run, restart: Restart | None) -> Iterator[Solution]:
    def monitor(level: int, *facts: Any) -> None:
        run.screen.step(f"  level {level}  {step_of_solver(*facts)}")

    run.screen.progress("level 0")
    return run.case.solutions(
        run.domain,
        element=run.element,
        monitor=monitor,
        max_time=run.time_left,
        restart=restart,
    )


def _tell(record: output.Record, first: output.Record, screen: Screen) -> None:
    """Print the row of a level, and the head before the first."""
    if record is first:
        screen.line(output.table_header(first))
    screen.line(output.table_row(record, first))


def _conclude(run: Run, finest: Solution, names: str) -> None:
    """Say what the table above means, and what has come out; collective."""
    screen, records, units = run.screen, run.kept, run.case.units
    screen.line("")
    screen.text(tables.legend(records[0], units))
    screen.line("")
    screen.text(tables.facts(records[-1], units))
    screen.items(*tables.certificate_lines(records[-1], units))
    tell_of_tolerance(run.case, records[-1]["bound_h1"], screen)
    endless = run.case.mode == "adaptive" and run.case.adaptive["tolerance"] == 0.0
    if endless and Shares.of(finest).rounded(run.comm):
        tell_of_rounding(screen)
    screen.text(tables.times(records))
    run.tell_the_end(names)
