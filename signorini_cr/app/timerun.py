"""The run of `solve` in time: a mesh is sought, if one is to be, then each step is solved."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Any

from ..adaptive import adapt_to_run
from ..errors import NotConverged, naming
from ..evolution import SCHEMES
from ..mesh.balance import Refined
from ..output import report as output
from ..output import series, strip, tables
from ..restart import Restart
from ..solution import Solution
from . import problemfile
from .run import (
    SURE,
    Run,
    above_tolerance,
    out_of_reach,
    step_of_solver,
    tell_of_rounding,
    tell_of_tolerance,
    what_is_kept,
)
from .signals import keep


class Search:
    """The search for a mesh that serves all steps, by runs on one mesh after the other.

    Attributes:
        restart: Where a run goes on from, with the meshes that are known; None at the beginning.
        tried: Records of the meshes that all steps have been solved on.
        cut_short: What ended the search before it had come to its end.
    """

    def __init__(
        self, run: Run, said: dict[str, Any], restart: Restart | None, tried: list[output.Record]
    ):
        """Begin, or go on.

        Args:
            run: The problem and the folder.
            said: All that the meshes depend on, by the name the user knows it by.
            restart: Where it goes on from, if it does.
            tried: What has been tried by then.
        """
        self._run, self._said = run, said
        self.restart, self.tried = restart, tried
        self.cut_short: NotConverged | None = None

    def meshes(self) -> list[Refined]:
        """Find the meshes to solve on, as far as it gets; collective.

        Raises:
            NotConverged: It does not get beyond the first run.
        """
        run, case, screen = self._run, self._run.case, self._run.screen
        known = [] if self.restart is None else [*self.restart.meshes(run.domain)]
        screen.text("the mesh is sought by runs through all steps, on one mesh after the other")
        screen.line(series.search_header())
        for record in self.tried:
            screen.line(series.search_row(record))
        level = len(known)

        def through(meshes: Sequence[Refined]) -> Iterator[tuple[float, Solution]]:
            nonlocal level
            level = len(meshes)
            steps = case.steps(run.domain, meshes, max_time=run.time_left)
            assert case.time is not None
            for number, found in enumerate(steps, 1):
                screen.progress(f"level {level}, step {number} of {case.time.steps}")
                yield found

        try:
            for found in adapt_to_run(
                through,
                levels=case.levels,
                **case.adaptive,
                max_time=run.time_left,
                meshes=known,
            ):
                known = found.meshes
                if level >= len(self.tried):  # else it is the one that it goes on from
                    self._add(series.search_record(found.last, found.bound), found.last)
            if found.rounded and case.adaptive["tolerance"] == 0.0:
                tell_of_rounding(screen)
        except NotConverged as error:
            where = level if error.level is None else error.level
            failure = NotConverged(
                f"the search for a mesh stopped on level {where}: {error.reason}"
            )
            if not self.tried:
                words = what_is_kept(run.kept, run.folder)
                raise NotConverged(f"{failure}\n{words}") from None
            self.cut_short = failure
        screen.line("")
        return known

    def _add(self, record: output.Record, last: Solution) -> None:
        """Keep a mesh that was tried, and tell of it; collective."""
        run, tried = self._run, [*self.tried, record]
        self.restart = restart = Restart.of_meshes(last)
        report = {**run.report([]), "search": tried, "times": []}

        def write() -> None:
            with naming("--out"):
                series.write_search(run.folder, report, restart, self._said, run.former, run.comm)

        keep(write, run.kept, [record])
        self.tried = tried
        run.screen.line(series.search_row(record))
        if len(tried) == SURE and (doubt := out_of_reach(run.case, tried)) is not None:
            run.screen.warn(f"{run.args.file}: {doubt}")


class Steps:
    """A run in time; an adaptive one seeks its mesh first."""

    def __init__(self, run: Run):
        """Find where it begins; collective.

        Args:
            run: The problem and the folder.
        """
        self._run, case = run, run.case
        assert case.time is not None
        self._number = case.time.steps
        self._back = len(SCHEMES[case.time.scheme].weights)  # so many steps are behind the next
        levels = None if case.levels == problemfile.UNLIMITED else case.levels
        self._said = {**run.said(), "refine.levels (or --levels)": levels}
        if case.mode == "adaptive":  # the mesh depends on where the search for it ends, too
            self._said |= {f"refine.{key}": value for key, value in case.adaptive.items()}
        self._restart, facts = run.resumed(self._said)
        tried, self._done = facts.get("search", []), len(facts.get("times", []))
        if "levels" in facts:  # the search is to go on, whatever may have been solved by then
            tried, self._done = facts["levels"], 0
        self._search = Search(run, self._said, self._restart, tried)
        self._records: list[output.Record] = []
        self._last: list[Solution] = []
        self._moments: list[strip.Moment] = []
        self._earlier = self._restart.u[1:] if self._restart is not None and self._done else ()
        if self._done:
            with naming("--resume"):
                self._moments = series.read_moments(run.folder, run.comm)

    def solve(self) -> None:
        """Solve step after step; collective.

        Raises:
            NotConverged: After steps that are kept.
        """
        run, failure = self._run, None
        meshes = self._meshes()
        cut_short = self._search.cut_short
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
            if failure is None and cut_short is None:
                failure = above_tolerance(run.case, bound, self._last[0].level.number)
            self._conclude(bound, complete=failure is None and cut_short is None)
        reasons = [str(each) for each in (cut_short, failure) if each is not None]
        if reasons:
            raise NotConverged("\n".join([*reasons, what_is_kept(run.kept, run.folder)]))

    def _meshes(self) -> int | list[Refined]:
        """Find what the steps are solved on: so many uniform meshes, or those found; collective."""
        if self._run.case.mode == "uniform":
            return self._run.case.levels
        if self._done:
            assert self._restart is not None
            return [*self._restart.meshes(self._run.domain)]
        meshes = self._search.meshes()
        self._restart = self._search.restart
        return meshes

    def _solve_on(self, meshes: int | Sequence[Refined]) -> None:
        """Solve what is left, and keep what is worth it."""
        run, done = self._run, self._done
        run.screen.progress(f"step {done + 1}")

        def monitor(_: int, *facts: Any) -> None:
            run.screen.line(f"  time step {len(self._records) + 1}  {step_of_solver(*facts)}")

        steps = run.case.steps(
            run.domain,
            meshes,
            monitor=monitor if run.screen.verbose else None,
            max_time=run.time_left,
            restart=self._restart if done else None,
            done=done,
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
        tried = self._search.tried
        search = {"search": tried} if tried else {}
        return {**self._run.report(levels, complete), **search, "times": self._records}

    def _keep(self) -> None:
        """Keep the steps that are not yet safe; collective."""
        kept = self._run.kept
        if self._done < len(self._records):
            keep(self._write_steps, kept, self._records[self._done :])
            self._done = len(self._records)

    def _write_steps(self) -> None:
        """Write what a run goes on from, and the tables; collective."""
        run, last, search = self._run, self._last, self._search
        # behind the steps of this process are those that it goes on from
        earlier = self._earlier[: 1 + self._back - len(last)]
        self._restart = Restart.of_steps(last, self._restart, earlier)
        facts = {"said": self._said, "times": self._records}
        if search.tried:
            # where the search was cut short it goes on from there
            facts["search" if search.cut_short is None else "levels"] = search.tried
        with naming("--out"):
            series.write_steps(
                run.folder,
                self._report([]),
                last[0],
                self._restart,
                facts,
                self._moments,
                run.former,
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
        for sentence in (series.certificate_line(records), *series.over_time(records, units)):
            screen.text(sentence)
        head, *figures = tables.certificate_lines(finest, units)
        screen.items(f"the last step's own problem, {head}", *figures)
        tell_of_tolerance(run.case, bound, screen)
        screen.text(series.times(records))
        run.tell_the_end(f"{names}, times.csv, series.pvd and its fields")
