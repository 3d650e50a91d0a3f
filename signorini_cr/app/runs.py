"""What `solve` does: meshes or steps in time, solved one by one, told, and kept in the folder."""

from __future__ import annotations

import argparse
import hashlib
import json
import math
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from petsc4py import PETSc

from .. import __version__
from ..adaptive import adapt_to_run
from ..errors import InputError, NotConverged, naming, on_root
from ..evolution import SCHEMES
from ..mesh.balance import Refined
from ..mesh.domain import Domain
from ..options import PREFIX
from ..output import report as output
from ..output import series, strip, tables
from ..output.checkpoint import NAME as RESTART
from ..output.checkpoint import read_checkpoint
from ..output.files import write_files, write_text
from ..output.page import run_page
from ..output.units import GLUE
from ..restart import Restart
from ..rounding import at_most, known
from ..solution import Solution
from . import problemfile
from .problemfile import ProblemFile
from .reference import ENDS
from .screen import Screen, wrapped
from .signals import keep
from .statement import folded, statement

SURE = 3
"""So many bounds tell at which rate they fall."""
FAR = 10
"""So many times the unknowns that there may be are out of reach."""


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
    run = _Run(args, screen, comm, folder, case, domain, problem, kept)
    if case.time is None:
        _solve_levels(run)
    else:
        _Steps(run).solve()


def read_case(args: argparse.Namespace, screen: Screen, comm: Any) -> tuple[ProblemFile, Domain]:
    """The checked problem file and the coarsest mesh; collective."""
    case = problemfile.load(args.file, comm)
    if getattr(args, "levels", None) is not None:
        case = replace(case, levels=args.levels)
    if case.time is not None and getattr(args, "element", "cr") != "cr":
        raise InputError("--element: problems in time are solved with cr")
    screen.progress("making the mesh")
    domain = case.mesh(comm)
    for doubt in case.check(domain):
        screen.warn(f"{args.file}: {doubt}")
    return case, domain


def stopped(failure: NotConverged, kept: list[output.Record], folder: Path) -> str:
    """What to say of a run that stops on a level."""
    level = len(kept) if failure.level is None else failure.level
    return f"stopped on level {level}: {failure.reason}\n{what_is_kept(kept, folder)}"


def what_is_kept(kept: list[output.Record], folder: Path) -> str:
    """What a run that has been ended leaves."""
    if not kept:
        return "no level was finished, nothing was written"
    kind = _kind(kept[0])
    first, last = kept[0][kind], kept[-1][kind]
    if first == last:
        return f"{kind} {first} is finished and kept in {folder}"
    return f"{kind}s {first} to {last} are finished and kept in {folder}"


def _kind(record: output.Record) -> str:
    """What a record is of, which its number goes by, too."""
    return "step" if "step" in record else "level"


@dataclass(frozen=True, eq=False)
class _Run:
    """A problem, and where its solution goes.

    Attributes:
        args: The command line.
        screen: Where it is told.
        comm: The ranks.
        folder: What is written goes there.
        case: The problem.
        domain: The coarsest mesh.
        problem: What is told of it, by name.
        kept: Records of what is safe in the folder.
    """

    args: argparse.Namespace
    screen: Screen
    comm: Any
    folder: Path
    case: ProblemFile
    domain: Domain
    problem: dict[str, str]
    kept: list[output.Record]

    @property
    def element(self) -> str:
        """As it is in the report."""
        return str(self.args.element.upper())

    @property
    def time_left(self) -> float | None:
        """What is left of --max-time."""
        if self.args.max_time is None:
            return None
        return float(self.args.max_time + self.args.began - time.perf_counter())

    def said(self) -> dict[str, Any]:
        """All that the levels depend on, by the name the user knows it by; collective."""
        said = {
            **self.case.said,
            "--element": self.args.element,
            "signorini_cr": __version__,
        }
        for name, value in sorted(PETSc.Options(PREFIX).getAll().items()):
            said[f"-{PREFIX}{name}"] = value
        if isinstance(self.case.domain, Path):
            content = on_root(self.comm, self.case.domain.read_bytes)
            said["domain.mesh, the file"] = hashlib.sha256(content).hexdigest()[:16]
        return said

    def resumed(self, said: dict[str, Any]) -> tuple[Restart | None, dict[str, Any]]:
        """Find where a run goes on, if it is to, and fill in what is kept of it; collective.

        Returns:
            From `read_checkpoint`; None and nothing where it begins.
        """
        if not self.args.resume:
            return None, {}
        with naming("--resume"):
            found = read_checkpoint(self.folder, self.comm)
            if found is None:
                return None, {}
            restart, facts = found
            for key in sorted({*said, *facts["said"]}):
                was, now = (each.get(key) for each in (facts["said"], said))
                if was != now:
                    was, now = (
                        "not given" if each is None else json.dumps(each) for each in (was, now)
                    )
                    raise InputError(
                        f"{self.folder} has results of another run: {key} was {was} and is {now}; "
                        "the same is needed, or another --out"
                    )
        self.kept.extend(facts["levels" if "levels" in facts else "times"])
        kind = _kind(self.kept[-1])
        self.screen.line(f"going on after {kind} {self.kept[-1][kind]}, kept in {self.folder}\n")
        return restart, facts

    def report(self, levels: list[output.Record], complete: bool = False) -> output.Record:
        """What report.json is made of; collective."""
        case = self.case
        return output.make_report(case.title, self.element, self.comm, levels, complete, case.units)

    def write(
        self, report: output.Record, finest: Solution, moments: Sequence[strip.Moment] = ()
    ) -> str:
        """Write what comes at the end, and return the names of the files; collective."""
        self.screen.progress("writing")
        with naming("--out"):
            names = output.write_output(
                self.folder, report, finest, resumable=True, moments=moments
            )
            if self.args.html:
                names.append(self._write_page(report))
        return ", ".join(names)

    def tell_the_end(self, names: str) -> None:
        """Say which files there are, and how long it all has taken."""
        seconds = known(time.perf_counter() - self.args.began, None, 2)
        self.screen.text(
            f"written to {self.folder}: {names}, and {RESTART} for --resume;"
            f" {seconds}{GLUE}s with start, pictures and files"
        )

    def _write_page(self, report: output.Record) -> str:
        """The run as one page; collective."""

        def make() -> str:
            source = self.args.file.read_text(encoding="utf-8")
            return run_page(self.folder, source, report, self.args.words, self.problem)

        def draw(path: Path) -> None:
            on_root(self.comm, write_text, path, make)

        name = "report.html"
        write_files(self.folder, {name: draw}, comm=self.comm)
        return name


def _solve_levels(run: _Run) -> None:
    """Solve on one mesh after the other; collective."""
    said, kept, screen = run.said(), run.kept, run.screen
    restart, _ = run.resumed(said)
    for record in kept:
        _tell(record, kept[0], screen)
    finest: Solution | None = None
    failure: NotConverged | None = None
    warned = False
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
                write = partial(output.write_levels, run.folder, report, solution, restart, said)
                keep(write, kept, [record])
            finest = solution
            if screen.verbose:
                taken = solution.iterations.preconditioner
                screen.line(wrapped(taken, "  linear systems: "))
            _tell(record, kept[0], screen)
            if not warned and (doubt := _out_of_reach(run.case, kept)) is not None:
                screen.warn(f"{run.args.file}: {doubt}")
                warned = True
    except NotConverged as error:
        failure = error
    if kept:
        failure = failure or _above_tolerance(run.case, kept[-1]["bound_h1"], kept[-1]["level"])
    if finest is not None:
        names = run.write(run.report(kept, failure is None), finest)
        _conclude(run, names)
    if failure is not None:
        raise NotConverged(stopped(failure, kept, run.folder))


def _step_of_solver(step: int, residual: float, active: int, linear: int) -> str:
    """What `-v` tells of a step of the active set method."""
    return f"step {step:2d}  residual {residual:9.2e}  active {active:5d}  cg {linear:4d}"


def _solutions(run: _Run, restart: Restart | None) -> Iterator[Solution]:
    def monitor(level: int, *facts: Any) -> None:
        run.screen.step(f"  level {level}  {_step_of_solver(*facts)}")

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


def _conclude(run: _Run, names: str) -> None:
    """Say what the table above means, and what has come out."""
    screen, records, units = run.screen, run.kept, run.case.units
    screen.line("")
    screen.text(tables.legend(records[0], units))
    screen.line("")
    screen.text(tables.facts(records[-1], units))
    screen.items(*tables.certified(records[-1], units))
    _tell_of_tolerance(run.case, records[-1]["bound_h1"], screen)
    screen.text(tables.times(records))
    run.tell_the_end(names)


def _out_of_reach(case: ProblemFile, records: list[output.Record]) -> str | None:
    """Say so where the bounds so far tell that far too many unknowns would be needed."""
    tolerance, most = (case.adaptive[key] for key in ("tolerance", "max_dofs"))
    if case.mode != "adaptive" or tolerance == 0.0 or len(records) < SURE:
        return None
    (n, bound), (m, last) = ((each["dofs"], each["bound_h1"]) for each in records[-2:])
    if bound is None or last is None or last <= tolerance or m <= n:
        return None
    rate = max(math.log(bound / last) / math.log(m / n), 0.5)
    # the logarithm, as the number itself may be beyond all floats
    digits = math.log10(m) + math.log10(last / tolerance) / rate
    if digits <= math.log10(FAR * most):
        return None
    return (
        f"refine.tolerance: at this rate the tolerance {tolerance:g} takes about"
        f" {10.0 ** min(digits, 300.0):.0e} unknowns; max_dofs is {most}"
    )


def _tolerance_met(case: ProblemFile, bound: float | None) -> bool:
    """Tell whether a bound was asked for, and is reached."""
    tolerance = case.adaptive["tolerance"]
    return tolerance > 0.0 and bound is not None and bound <= tolerance


def _tell_of_tolerance(case: ProblemFile, bound: float | None, screen: Screen) -> None:
    """Say so where the bound that was asked for is reached."""
    if _tolerance_met(case, bound):
        tolerance = case.adaptive["tolerance"]
        screen.text(
            f"the bound has reached the tolerance of {tolerance:g}: no further mesh is needed"
        )


def _above_tolerance(case: ProblemFile, bound: float, level: int) -> NotConverged | None:
    """Say what stopped an adaptive run before the bound that was asked for was reached.

    Args:
        case: The problem.
        bound: Of the finest mesh; if there are steps in time, the largest of all.
        level: The finest mesh.
    """
    tolerance = case.adaptive["tolerance"]
    if tolerance == 0.0 or _tolerance_met(case, bound):
        return None
    limits = [
        f"{key} = {value}"
        for key, value in case.adaptive.items()
        if f"refine.{key}" in ENDS and key != "tolerance"
    ]
    limit = f"levels = {case.levels}" if level + 1 >= case.levels else " or ".join(limits)
    return NotConverged(
        f"the certified bound is {at_most(bound)}, above the tolerance of {tolerance:g}, and"
        f" {limit} allows no further mesh",
        level,
    )


class _Steps:
    """A run in time; an adaptive one seeks its mesh first.

    Args:
        run: Its problem and its folder.
    """

    def __init__(self, run: _Run):
        """Find where it begins; collective."""
        self._run, case = run, run.case
        assert case.time is not None
        self._number = case.time.steps
        self._back = len(SCHEMES[case.time.scheme].weights)  # so many steps are behind the next
        levels = None if case.levels == problemfile.ENOUGH else case.levels
        self._said = {**run.said(), "refine.levels (or --levels)": levels}
        if case.mode == "adaptive":  # the mesh depends on where the search for it ends, too
            self._said |= {f"refine.{key}": value for key, value in case.adaptive.items()}
        self._restart, facts = run.resumed(self._said)
        self._tried: list[output.Record] = facts.get("search", [])
        self._records: list[output.Record] = []
        self._moments: list[strip.Moment] = []
        self._last: list[Solution] = []
        self._cut_short: NotConverged | None = None  # the search
        self._done = len(facts.get("times", []))
        if "levels" in facts:  # the search is to go on, whatever may have been solved by then
            self._tried, self._done = facts["levels"], 0
        if self._done:
            with naming("--resume"):
                self._moments = series.read_moments(run.folder, run.comm)

    def solve(self) -> None:
        """Solve step after step; collective.

        Raises:
            NotConverged: After steps that are kept.
        """
        run, failure = self._run, None
        meshes = run.case.levels if run.case.mode == "uniform" else self._meshes()
        for record in run.kept[: self._done]:
            self._tell(record)
        try:
            self._solve_on(meshes)
        except NotConverged as error:
            failure = NotConverged(f"time step {len(self._records) + 1}: {error}")
        if self._last:
            self._keep()
            bound = max(
                math.inf if record["bound_h1"] is None else record["bound_h1"]
                for record in self._records
            )
            if failure is None and self._cut_short is None:
                failure = _above_tolerance(run.case, bound, self._last[0].level.number)
            self._conclude(bound, complete=failure is None and self._cut_short is None)
        reasons = [str(each) for each in (self._cut_short, failure) if each is not None]
        if reasons:
            raise NotConverged("\n".join([*reasons, what_is_kept(run.kept, run.folder)]))

    def _meshes(self) -> list[Refined]:
        """Find the meshes to solve on, as far as it gets; collective.

        Raises:
            NotConverged: It does not get beyond the first run.
        """
        run, case, screen = self._run, self._run.case, self._run.screen
        known = [] if self._restart is None else [*self._restart.meshes(run.domain)]
        if self._done:
            return known
        screen.text("the mesh is sought by runs through all steps, on one mesh after the other")
        screen.line(series.search_header())
        for record in self._tried:
            screen.line(series.search_row(record))
        begun = len(known)

        def through(meshes: Sequence[Refined]) -> Iterator[tuple[float, Solution]]:
            nonlocal begun
            begun = len(meshes)
            steps = case.steps(run.domain, meshes, max_time=run.time_left)
            for number, found in enumerate(steps, 1):
                screen.progress(f"level {begun}, step {number} of {self._number}")
                yield found

        try:
            for tried in adapt_to_run(
                through,
                levels=case.levels,
                **case.adaptive,
                max_time=run.time_left,
                meshes=known,
            ):
                known = tried.meshes
                if begun >= len(self._tried):  # else it is the one that it goes on from
                    self._add(series.search_record(tried.last, tried.bound), tried.last)
        except NotConverged as error:
            level = begun if error.level is None else error.level
            failure = NotConverged(
                f"the search for a mesh stopped on level {level}: {error.reason}"
            )
            if not self._tried:
                words = what_is_kept(run.kept, run.folder)
                raise NotConverged(f"{failure}\n{words}") from None
            self._cut_short = failure
        screen.line("")
        return known

    def _add(self, record: output.Record, last: Solution) -> None:
        """Keep a mesh that was tried, and tell of it; collective."""
        run, tried = self._run, [*self._tried, record]
        self._restart = restart = Restart.of_meshes(last)
        report = {**run.report([]), "search": tried, "times": []}

        def write() -> None:
            with naming("--out"):
                series.write_search(run.folder, report, restart, self._said, run.comm)

        keep(write, run.kept, [record])
        self._tried = tried
        run.screen.line(series.search_row(record))
        if len(tried) == SURE and (doubt := _out_of_reach(run.case, tried)) is not None:
            run.screen.warn(f"{run.args.file}: {doubt}")

    def _solve_on(self, meshes: int | Sequence[Refined]) -> None:
        """Solve what is left, and keep what is worth it."""
        run, done = self._run, self._done
        run.screen.progress(f"step {done + 1}")

        def monitor(_: int, *facts: Any) -> None:
            run.screen.line(f"  time step {len(self._records) + 1}  {_step_of_solver(*facts)}")

        steps = run.case.steps(
            run.domain,
            meshes,
            monitor=monitor if run.screen.verbose else None,
            max_time=run.time_left,
            restart=self._restart if done else None,
            done=max(done, 1),
        )
        for moment, solution in steps:
            self._last = [solution, *self._last[: self._back]]
            number = len(self._records) + 1
            if number == done + 1 > 1 and len(self._last) == 1:  # the one that it goes on from
                continue
            record = series.step_record(number, moment, solution, run.case.quantities)
            self._tell(record)
            chosen = number in strip.chosen(self._number)
            if chosen:
                self._moments.append(strip.moment(moment, solution))
            if chosen or series.is_kept(number):
                self._keep()
            else:
                with naming("--out"):
                    series.write_step(run.folder, number, solution)

    def _tell(self, record: output.Record) -> None:
        """Print the row of a step, and the head before the first."""
        self._records.append(record)
        if len(self._records) == 1:
            self._run.screen.line(series.header())
        self._run.screen.line(series.row(record, self._records[0]))

    def _report(self, levels: list[output.Record], complete: bool = False) -> output.Record:
        search = {"search": self._tried} if self._tried else {}
        return {**self._run.report(levels, complete), **search, "times": self._records}

    def _keep(self) -> None:
        """Keep the steps that are not yet safe; collective."""
        kept = self._run.kept
        if self._done < len(self._records):
            keep(self._write_steps, kept, self._records[self._done :])
            self._done = len(self._records)

    def _write_steps(self) -> None:
        """Write what a run goes on from, and the tables; collective."""
        run, last = self._run, self._last
        self._restart = Restart.of_steps(last, self._restart)
        facts = {"said": self._said, "times": self._records}
        if self._tried:
            # where the search was cut short it goes on from there
            facts["search" if self._cut_short is None else "levels"] = self._tried
        with naming("--out"):
            series.write_steps(
                run.folder, self._report([]), last[0], self._restart, facts, self._moments
            )
        if not self._done:  # meshes that were tried, so far
            run.kept.clear()

    def _conclude(self, bound: float, complete: bool) -> None:
        """Write what comes at the end, and say what has come out; collective."""
        run, records, units = self._run, self._records, self._run.case.units
        finest = output.level_record(self._last[0]) | {"quantities": records[-1]["quantities"]}
        names = run.write(self._report([finest], complete), self._last[0], self._moments)
        screen = run.screen
        screen.line("")
        screen.text(series.legend(units))
        screen.line("")
        screen.text(f"at the end {tables.facts(finest, units)}")
        for sentence in (series.certified(records), *series.over_time(records, units)):
            screen.text(sentence)
        head, *figures = tables.certified(finest, units)
        screen.items(f"the last step's own problem, {head}", *figures)
        _tell_of_tolerance(run.case, bound, screen)
        screen.text(series.times(records))
        run.tell_the_end(f"{names}, times.csv, series.pvd and its fields")
