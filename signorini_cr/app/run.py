"""A problem and the folder its solution goes to: what runs on meshes and in time share."""

from __future__ import annotations

import argparse
import hashlib
import json
import math
import os
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mpi4py import MPI
from petsc4py import PETSc

from .. import __version__
from ..errors import InputError, NotConverged, naming, on_root
from ..memory import most_memory
from ..mesh.domain import Domain
from ..options import PREFIX
from ..output import report as output
from ..output import strip
from ..output.checkpoint import NAME as RESTART
from ..output.checkpoint import read_checkpoint
from ..output.files import text_writer, write_files
from ..output.page import run_page
from ..output.tables import short
from ..output.units import GLUE
from ..restart import Restart
from ..rounding import at_most, digits_of
from ..solution import Solution
from .problemfile import ProblemFile
from .reference import ENDS
from .screen import Screen

SURE = 3
"""So many bounds tell at which rate they fall."""
OFF = 1e-3
"""Part of an error by which it may be wrong."""
OUT_OF_REACH = 10
"""So many times the unknowns that there may be are out of reach."""


@dataclass(frozen=True, eq=False)
class Run:
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
        former: What there is in it of former runs.
    """

    args: argparse.Namespace
    screen: Screen
    comm: Any
    folder: Path
    case: ProblemFile
    domain: Domain
    problem: dict[str, str]
    kept: list[output.Record]
    former: Sequence[str]

    @property
    def element(self) -> str:
        """As it is in the report."""
        return str(self.args.element.upper())

    @property
    def time_left(self) -> float | None:
        """The time left of --max-time, a moment at least; None for any."""
        if self.args.max_time is None:
            return None
        return max(float(self.args.max_time + self.args.began - time.perf_counter()), 1e-9)

    def said(self) -> dict[str, Any]:
        """Say all that the levels depend on, by the name the user knows it by; collective."""
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
            # steps in time change the defaults of other keys, and are told before these
            keys = sorted({*said, *facts["said"]})
            keys.sort(key=lambda key: not key.startswith("time."))
            for key in keys:
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
        """Collect what report.json is made of; collective."""
        case = self.case
        return output.make_report(case.title, self.element, self.comm, levels, complete, case.units)

    def write(
        self, report: output.Record, finest: Solution, moments: Sequence[strip.Moment] = ()
    ) -> str:
        """Write what comes at the end, and return the names of the files; collective."""
        self.screen.progress("writing")
        with naming("--out"):
            names = output.write_output(
                self.folder,
                report,
                finest,
                resumable=True,
                moments=moments,
                tell=self.screen.warn,
                former=self.former,
            )
            if self.args.html:
                names.append(self._write_page(report))
        return ", ".join(names)

    def tell_the_end(self, names: str) -> None:
        """Say which files there are, and how long it all has taken."""
        seconds = digits_of(time.perf_counter() - self.args.began, None, 2)
        self.screen.text(
            f"written to {self.folder}: {names}, and {RESTART} for --resume;"
            f" {seconds}{GLUE}s with start, pictures and files"
        )

    def _write_page(self, report: output.Record) -> str:
        """Write the run as one page; collective."""

        def make() -> str:
            return run_page(self.folder, self.case.source, report, self.args.words, self.problem)

        name = "report.html"
        write_files(self.folder, {name: text_writer(self.comm, make)}, comm=self.comm)
        return name


def stopped(failure: NotConverged, kept: list[output.Record], folder: Path) -> str:
    """Say that a run stops on a level, and why."""
    level = len(kept) if failure.level is None else failure.level
    return f"stopped on level {level}: {failure.reason}\n{what_is_kept(kept, folder)}"


def out_of_memory(kept: list[output.Record], folder: Path) -> str:
    """Say that memory has ended, for the next level or for what is made of all."""
    where = f"after {_kind(kept[-1])} {kept[-1][_kind(kept[-1])]}" if kept else "on level 0"
    told = f"out of memory, of which this process has had {most_memory() / 1e9:.2g} GB"
    return f"stopped {where}: {told}\n{what_is_kept(kept, folder)}"


def what_is_kept(kept: list[output.Record], folder: Path) -> str:
    """Say what a run that has been ended leaves."""
    if not kept:
        return "no level was finished, nothing was written"
    kind = _kind(kept[0])
    first, last = kept[0][kind], kept[-1][kind]
    # another rank's machine may not have it
    if MPI.COMM_WORLD.rank == 0 and not os.path.exists(folder):
        return f"{folder} has been taken away, and what was kept in it"
    if first == last:
        return f"{kind} {first} is finished and kept in {folder}"
    return f"{kind}s {first} to {last} are finished and kept in {folder}"


def _kind(record: output.Record) -> str:
    """Say what a record is of, which its number goes by, too."""
    return "step" if "step" in record else "level"


def out_of_reach(case: ProblemFile, records: list[output.Record]) -> str | None:
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
    if digits <= math.log10(OUT_OF_REACH * most):
        return None
    return (
        f"refine.tolerance: at this rate the tolerance {tolerance:g} takes about"
        f" {10.0 ** min(digits, 300.0):.0e} unknowns; max_dofs is {most}"
    )


def no_solution(record: output.Record) -> str | None:
    """Say so where an error is above the bound that is certain: what is compared with is wrong.

    An error is integrated by quadrature, and may be a little off.
    """
    error, bound = record["error_h1"], record["bound_h1"]
    if error is None or bound is None or error <= bound * (1.0 + OFF):
        return None
    return (
        f"exact.u: this is not the solution, as the error of {short(error)} is above the certified"
        f" bound of {at_most(bound)}; where it has a kink, or the coefficient jumps, what is"
        " derived from it leaves out what flows there"
    )


def _tolerance_met(case: ProblemFile, bound: float | None) -> bool:
    """Tell whether a bound was asked for, and is reached."""
    tolerance = case.adaptive["tolerance"]
    return tolerance > 0.0 and bound is not None and bound <= tolerance


def tell_of_tolerance(case: ProblemFile, bound: float | None, screen: Screen) -> None:
    """Say so where the bound that was asked for is reached."""
    if _tolerance_met(case, bound):
        tolerance = case.adaptive["tolerance"]
        screen.text(
            f"the bound has reached the tolerance of {tolerance:g}: no further mesh is needed"
        )


def tell_of_rounding(screen: Screen) -> None:
    """Say what ended a run that no tolerance was to end."""
    screen.text("what is left of the bound is rounding: no finer mesh would make it smaller")


def above_tolerance(case: ProblemFile, bound: float, level: int) -> NotConverged | None:
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


def step_of_solver(step: int, residual: float, active: int, linear: int) -> str:
    """Say what `-v` tells of a step of the active set method."""
    return f"step {step:2d}  residual {residual:9.2e}  active {active:5d}  cg {linear:4d}"
