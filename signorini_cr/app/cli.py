"""The command `signorini-cr`: from a problem file to a folder of results.

Nothing heavy is imported before the command line has been understood, so that ``--help`` and a
misspelt option answer at once.
"""

from __future__ import annotations

import argparse
import math
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any

from .. import __version__
from ..memory import ran_out_of_memory, too_little
from .commandline import (
    UsageError,
    launched,
    left_alone,
    read_arguments,
    start_petsc,
    wait_for_all,
)
from .screen import Screen, wrapped

if TYPE_CHECKING:
    from ..errors import NotConverged
    from ..mesh.domain import Domain
    from ..output.units import Units
    from ..restart import Restart
    from ..solution import Solution
    from .problemfile import ProblemFile

DONE, FAULT, BAD_INPUT, NOT_CONVERGED = 0, 1, 2, 3
NO_MEMORY = "out of memory"
INTERRUPTED, TERMINATED = 128 + signal.SIGINT, 128 + signal.SIGTERM
FRAMES = 10_000
"""Calls within one another: UFL differentiates by recursion, 40 calls at most for each of the 250
operations that `expressions.LONGEST_CHAIN` allows one upon the other."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; collective under mpirun.

    Args:
        argv: Arguments without the program's name, by default those of the process.

    Returns:
        The exit status, the same on every rank.
    """
    began = time.perf_counter()
    screen = Screen(launched()[0] == 0)
    try:
        args = read_arguments(sys.argv[1:] if argv is None else argv)
        args.began = began
    except SystemExit:  # --help and --version have answered
        screen.flush()
        return DONE
    except UsageError as error:
        screen.complain(str(error))
        wait_for_all()
        return BAD_INPUT
    with _interruptible() as asked, room_for_recursion():
        return _run(args, screen, asked)


@contextmanager
def room_for_recursion() -> Iterator[None]:
    """Let expressions be as deep as they may be; the process is the command's, while it runs."""
    before = sys.getrecursionlimit()
    sys.setrecursionlimit(max(before, FRAMES))
    try:
        yield
    finally:
        sys.setrecursionlimit(before)


@contextmanager
def _interruptible() -> Iterator[list[int]]:
    """Keep in mind the signals that asked for an end, and turn them into KeyboardInterrupt.

    That may reach us as another error, of PETSc, whose callback it was raised in. An import is left
    to finish, as libraries that are being loaded may end the process, and so is `_keep`, so that
    what is told of files is true; and whoever is told twice within a second, by the user and by
    mpirun, say, is told once. Where Python drops what is raised, in a finalizer, say, it is told
    anew.
    """
    asked: list[int] = []
    latest = -math.inf

    def soon(number: int) -> None:
        again = threading.Timer(0.05, os.kill, (os.getpid(), number))
        again.daemon = True
        again.start()

    def ask(number: int, frame: FrameType | None) -> None:
        nonlocal latest
        asked.append(number)
        if _must_not_be_disturbed(frame):
            soon(number)
        elif time.monotonic() - latest > 1.0:
            latest = time.monotonic()
            raise KeyboardInterrupt

    def dropped(facts: sys.UnraisableHookArgs) -> None:
        nonlocal latest
        if asked and issubclass(facts.exc_type, KeyboardInterrupt):
            latest = -math.inf
            soon(asked[0])
        else:
            drop(facts)

    drop, sys.unraisablehook = sys.unraisablehook, dropped
    found: dict[signal.Signals, Any] = {}
    if threading.current_thread() is threading.main_thread():  # others can't be interrupted
        # not where it is ignored, as in the background
        for each in (signal.SIGINT, signal.SIGTERM):
            if signal.getsignal(each) in (signal.default_int_handler, signal.SIG_DFL):
                found[each] = signal.signal(each, ask)
    try:
        yield asked
    finally:
        sys.unraisablehook = drop
        for each, handler in found.items():
            signal.signal(each, handler)


def _must_not_be_disturbed(frame: FrameType | None) -> bool:
    """Tell whether what runs has been called by an import or by `_keep`."""
    while frame is not None:
        code = frame.f_code
        if code is _keep.__code__ or code.co_filename.startswith("<frozen importlib"):
            return True
        frame = frame.f_back
    return False


def _stopped_by(asked: Sequence[int]) -> int:
    """The exit status after a signal; from here on it is too late for another one."""
    if threading.current_thread() is threading.main_thread():
        for each in (signal.SIGINT, signal.SIGTERM):
            signal.signal(each, signal.SIG_IGN)
    return 128 + (asked[0] if asked else signal.SIGINT)


def _run(args: argparse.Namespace, screen: Screen, asked: list[int]) -> int:
    """Start PETSc and do what the command says; whatever goes wrong becomes a message."""
    if (complaint := too_little()) is not None:
        screen.complain(f"{args.file}: {complaint}")
        return NOT_CONVERGED
    try:
        start_petsc(args.petsc)
        from mpi4py import MPI

        comm = MPI.COMM_WORLD
        screen.root = comm.rank == 0
        screen.quiet, screen.verbose = args.quiet, getattr(args, "verbose", False)
        if (complaint := left_alone(comm.size)) is not None:
            screen.complain(complaint)
            return BAD_INPUT
    except (Exception, KeyboardInterrupt) as error:
        if asked or isinstance(error, KeyboardInterrupt):
            status = _stopped_by(asked)
        elif ran_out_of_memory(error):
            status = NOT_CONVERGED
            screen.complain(f"{args.file}: {NO_MEMORY}")
        else:
            raise
        if launched()[1] > 1:  # the others would wait for it, and it for them when MPI ends
            os._exit(status)
        return status
    try:
        from .. import jit
        from ..errors import InputError, NotConverged

        jit.tell = screen.warn
        try:
            status = {"solve": _solve, "check": _check}[args.command](args, screen, comm)
        except (InputError, NotConverged) as error:
            screen.complain(f"{args.file}: {error}")
            status = BAD_INPUT if isinstance(error, InputError) else NOT_CONVERGED
        screen.flush()
        comm.Barrier()  # mpirun ends all ranks when the first leaves with an error
        return status
    except (Exception, KeyboardInterrupt) as error:
        # Perhaps on this rank only: the others must not wait for it
        kept = "".join(getattr(error, "__notes__", ()))  # from _solve
        if asked or isinstance(error, KeyboardInterrupt):
            status = _stopped_by(asked)
            if not screen.root:  # which tells and ends all, if it was asked and can
                time.sleep(0.3 * min(1 + comm.rank, 5))
                screen.root = True
            word = "terminated" if status == TERMINATED else "interrupted"
            screen.complain(f"{word}{kept and f'; {kept}'}")
            if comm.size > 1:
                comm.Abort(status)
            return status
        if ran_out_of_memory(error):  # while it began, or while it wrote
            screen.root = True
            screen.complain(f"{args.file}: {NO_MEMORY}" + (kept and f"\n{kept}"))
            if comm.size > 1:
                comm.Abort(NOT_CONVERGED)
            return NOT_CONVERGED
        import traceback

        where = f" on rank {comm.rank}" if comm.size > 1 else ""
        with suppress(OSError):  # whether or not it can be told
            traceback.print_exc()
            print(f"signorini-cr: unexpected error{where}, see above", file=sys.stderr, flush=True)
        if comm.size > 1:
            comm.Abort(FAULT)
        return FAULT


def _solve(args: argparse.Namespace, screen: Screen, comm: Any) -> int:
    from ..errors import NotConverged, naming
    from ..memory import most_memory
    from ..output import report as output
    from ..output.files import check_writable

    folder = _folder(args)
    with naming("--out"):
        check_writable(folder, output.FILES, comm)
    screen.progress("reading")
    records: list[output.Record] = []
    try:
        _solve_levels(args, screen, comm, folder, records)
        return DONE
    except (Exception, KeyboardInterrupt) as error:
        if not ran_out_of_memory(error):
            error.add_note(_kept(records, folder) if records else "")
            raise
    failure = NotConverged(
        f"out of memory, of which this process has had {most_memory() / 1e9:.2g} GB", len(records)
    )
    if comm.size > 1:  # the other ranks know nothing of it
        screen.root = True
        screen.complain(f"{args.file}: {_stopped(failure, records, folder)}")
        comm.Abort(NOT_CONVERGED)
    raise NotConverged(_stopped(failure, records, folder))


def _solve_levels(
    args: argparse.Namespace,
    screen: Screen,
    comm: Any,
    folder: Path,
    records: list[dict[str, Any]],
) -> None:
    """Solve, and append to `records` what is solved and safe in the folder."""
    from ..errors import NotConverged, naming
    from ..output import report as output
    from ..restart import Restart
    from .statement import folded, statement

    case, domain = _read(args, screen, comm)
    problem = statement(case, domain)
    screen.line(f"{folded(problem)}\n")
    if case.time is not None:
        _solve_steps(args, screen, comm, folder, case, domain, problem, records)
        return
    element = args.element.upper()
    said = _said(args, case, comm)
    restart = _resumed(folder, said, records, comm) if args.resume else None
    for record in records:
        _tell(record, records[0], screen)
    finest: Solution | None = None
    failure: NotConverged | None = None
    try:
        for solution in _solutions(args, case, domain, restart, screen):
            if solution.level.number < len(records):  # the one that it goes on from
                finest = solution
                continue
            _ = solution.errors, solution.certificate  # the report reads what is there
            before = records[-1] if records else None
            record = output.level_record(solution, before, case.quantities)
            report = output.make_report(
                case.title, element, comm, [*records, record], False, case.units
            )
            with naming("--out"):
                restart = Restart.of(solution, restart, case.mode == "adaptive")
                write = partial(output.write_levels, folder, report, solution, restart, said)
                _keep(write, records, [record])
            finest = solution
            if screen.verbose:
                taken = solution.iterations.preconditioner
                screen.line(wrapped(taken, "  linear systems: "))
            _tell(record, records[0], screen)
    except NotConverged as error:
        failure = error
    failure = failure or _above_tolerance(case, records)
    if finest is not None:
        screen.progress("writing")
        complete = failure is None
        report = output.make_report(case.title, element, comm, records, complete, case.units)
        with naming("--out"):
            names = output.write_output(folder, report, finest, resumable=True)
            if args.html:
                names += _write_page(args, comm, folder, problem, report)
        _conclude(screen, records, case.units)
        screen.text(f"written to {folder}: {', '.join(names)}")
    if failure is not None:
        raise NotConverged(_stopped(failure, records, folder))


def _conclude(screen: Screen, records: list[dict[str, Any]], units: Units) -> None:
    """Say what the table above means, and what has come out."""
    from ..output.tables import certified, facts, legend, times

    screen.line("")
    screen.text(legend(records[0], units))
    screen.line("")
    screen.text(facts(records[-1], units))
    screen.text(certified(records[-1], units))
    screen.text(times(records))


def _solve_steps(
    args: argparse.Namespace,
    screen: Screen,
    comm: Any,
    folder: Path,
    case: ProblemFile,
    domain: Domain,
    problem: dict[str, str],
    kept: list[dict[str, Any]],
) -> None:
    """Solve a problem in time, and append to `kept` what is safe in the folder."""
    from ..errors import InputError, NotConverged, naming
    from ..output import report as output
    from ..output import series, strip
    from ..output.tables import certified, facts
    from ..restart import Restart

    if args.element.upper() != "CR":
        raise InputError("--element: problems in time are solved with cr")
    assert case.time is not None
    said = {**_said(args, case, comm), "refine.levels (or --levels)": case.levels}
    restart = _resumed(folder, said, kept, comm) if args.resume else None
    done, failure = len(kept), None
    records: list[dict[str, Any]] = []
    moments: list[strip.Moment] = []
    if restart is not None:
        with naming("--resume"):
            moments = series.read_moments(folder, comm)

    def tell(record: dict[str, Any]) -> None:
        records.append(record)
        if len(records) == 1:
            screen.line(series.header())
        screen.line(series.row(record))

    def report(levels: list[dict[str, Any]], complete: bool = False) -> dict[str, Any]:
        made = output.make_report(case.title, "CR", comm, levels, complete, case.units)
        return {**made, "times": records}

    for record in kept:
        tell(record)
    last: list[Solution] = []
    screen.progress(f"step {done + 1}")
    steps = case.steps(
        domain, case.levels, max_time=_left(args), restart=restart, done=max(done, 1)
    )
    back = 2 if case.time.scheme == "bdf2" else 1

    def keep() -> None:
        nonlocal restart
        with naming("--out"):
            restart = Restart.of_steps([each.u for each in last], case.levels, restart)
            series.write_steps(folder, report([]), last[0], restart, said, moments)

    try:
        for time, solution in steps:
            last = [solution, *last[:back]]
            if len(records) == done > 0 and len(last) == 1:  # the one that it goes on from
                continue
            tell(series.step_record(len(records) + 1, time, solution, case.quantities))
            chosen = len(records) in strip.chosen(case.time.steps)
            if chosen:
                moments.append(strip.moment(time, solution))
            if chosen or series.is_kept(len(records)):
                _keep(keep, kept, records[len(kept) :])
            else:
                with naming("--out"):
                    series.write_step(folder, len(records), solution)
    except NotConverged as error:
        failure = NotConverged(f"time step {len(records) + 1}: {error}")
    if last:
        if len(kept) < len(records):
            _keep(keep, kept, records[len(kept) :])
        screen.progress("writing")
        finest = output.level_record(last[0]) | {"quantities": records[-1]["quantities"]}
        with naming("--out"):
            whole = report([finest], failure is None)
            names = output.write_output(folder, whole, last[0], resumable=True, moments=moments)
            if args.html:
                names += _write_page(args, comm, folder, problem, whole)
        screen.line("")
        screen.text(series.legend(case.units))
        screen.line("")
        screen.text(f"at the end {facts(finest, case.units)}")
        for sentence in (series.certified(records), *series.over_time(records, case.units)):
            screen.text(sentence)
        screen.text(f"the last step's own problem, {certified(finest, case.units)}")
        screen.text(series.times(records))
        screen.text(
            f"written to {folder}: {', '.join(names)}, times.csv, series.pvd and its fields"
        )
    if failure is not None:
        raise NotConverged(f"{failure}\n{_kept(kept, folder)}")


def _keep(
    write: Callable[[], object], kept: list[dict[str, Any]], records: list[dict[str, Any]]
) -> None:
    """Write, and note what is safe then; signals wait for that, see `_must_not_be_disturbed`."""
    write()
    kept += records


def _check(args: argparse.Namespace, screen: Screen, comm: Any) -> int:
    from ..errors import naming
    from ..output import plots
    from ..output.files import check_writable, write_files
    from .statement import folded, statement

    folder, picture = _folder(args), "mesh.png"
    with naming("--out"):
        check_writable(folder, [picture], comm)
    case, domain = _read(args, screen, comm)
    screen.line(f"{args.file}: in order")
    screen.line(folded(statement(case, domain)))
    if not plots.can_draw(comm):
        screen.text("not drawn: Matplotlib is not installed")
        return DONE

    def draw(path: Path) -> None:
        plots.plot_mesh(domain, path, case.title, units=case.units)

    with naming("--out"):
        write_files(folder, {picture: draw}, comm=comm)
    screen.text(f"drawn in {folder / picture}")
    return DONE


def _read(args: argparse.Namespace, screen: Screen, comm: Any) -> tuple[ProblemFile, Domain]:
    """The checked problem file and the coarsest mesh."""
    from dataclasses import replace

    from . import problemfile

    case = problemfile.load(args.file, comm)
    if getattr(args, "levels", None) is not None:
        case = replace(case, levels=args.levels)
    screen.progress("making the mesh")
    domain = case.mesh(comm)
    for doubt in case.check(domain):
        screen.warn(f"{args.file}: {doubt}")
    return case, domain


def _said(args: argparse.Namespace, case: ProblemFile, comm: Any) -> dict[str, Any]:
    """All that the levels depend on, by the name the user knows it by; collective."""
    import hashlib

    from petsc4py import PETSc

    from ..errors import on_root
    from ..options import PREFIX

    said = {**case.said, "--element": args.element, "signorini_cr": __version__}
    for name, value in sorted(PETSc.Options(PREFIX).getAll().items()):
        said[f"-{PREFIX}{name}"] = value
    if isinstance(case.domain, Path):
        content = on_root(comm, case.domain.read_bytes)
        said["domain.mesh, the file"] = hashlib.sha256(content).hexdigest()[:16]
    return said


def _resumed(
    folder: Path, said: dict[str, Any], records: list[dict[str, Any]], comm: Any
) -> Restart | None:
    """Find where a run goes on, and fill in the records of what is done; collective."""
    import json

    from ..errors import InputError, naming
    from ..output.checkpoint import read_checkpoint

    with naming("--resume"):
        found = read_checkpoint(folder, comm)
        if found is None:
            return None
        restart, facts = found
        for key in sorted({*said, *facts["said"]}):
            was, now = (each.get(key) for each in (facts["said"], said))
            if was != now:
                was, now = (
                    "not given" if each is None else json.dumps(each) for each in (was, now)
                )
                raise InputError(
                    f"{folder} has results of another run: {key} was {was} and is {now}; the same"
                    " is needed, or another --out"
                )
    records += facts["times" if "times" in facts else "levels"]
    return restart


def _tell(record: dict[str, Any], first: dict[str, Any], screen: Screen) -> None:
    """Print the row of a level, and the head before the first."""
    from ..output import report as output

    if record is first:
        screen.line(output.table_header(first))
    screen.line(output.table_row(record, first))


def _solutions(
    args: argparse.Namespace,
    case: ProblemFile,
    domain: Domain,
    restart: Restart | None,
    screen: Screen,
) -> Iterator[Solution]:
    def monitor(level: int, step: int, residual: float, active: int, linear: int) -> None:
        facts = f"step {step:2d}  residual {residual:9.2e}  active {active:5d}  cg {linear:4d}"
        screen.step(f"  level {level}  {facts}")

    screen.progress("level 0")
    return case.solutions(
        domain,
        element=args.element.upper(),
        monitor=monitor,
        max_time=_left(args),
        restart=restart,
    )


def _left(args: argparse.Namespace) -> float | None:
    """What is left of --max-time."""
    if args.max_time is None:
        return None
    return float(args.max_time + args.began - time.perf_counter())


def _write_page(
    args: argparse.Namespace, comm: Any, folder: Path, problem: dict[str, str], report: Any
) -> list[str]:
    """The run as one page; collective."""
    from ..errors import on_root
    from ..output.files import write_files, write_text
    from ..output.page import run_page

    def make() -> str:
        source = args.file.read_text(encoding="utf-8")
        return run_page(folder, source, report, args.words, problem)

    name = "report.html"
    write_files(folder, {name: lambda path: on_root(comm, write_text, path, make)}, comm=comm)
    return [name]


def _above_tolerance(case: ProblemFile, records: list[dict[str, Any]]) -> NotConverged | None:
    """Say what stopped an adaptive run before the bound that was asked for was reached."""
    tolerance = case.adaptive["tolerance"]
    if tolerance == 0.0 or not records:
        return None
    from ..errors import NotConverged
    from ..rounding import at_most

    bound = records[-1]["bound_h1"]
    if bound is not None and bound <= tolerance:
        return None
    limit = (
        f"levels = {case.levels}"
        if len(records) >= case.levels
        else f"max_dofs = {case.adaptive['max_dofs']}"
    )
    return NotConverged(
        f"the certified bound is {at_most(bound)}, above the tolerance of {tolerance:g}, and"
        f" {limit} allows no further mesh",
        records[-1]["level"],
    )


def _stopped(failure: NotConverged, records: list[dict[str, Any]], folder: Path) -> str:
    level = len(records) if failure.level is None else failure.level
    return f"stopped on level {level}: {failure.reason}\n{_kept(records, folder)}"


def _kept(records: list[dict[str, Any]], folder: Path) -> str:
    if not records:
        return "no level was finished, nothing was written"
    kind = "step" if "step" in records[0] else "level"
    first, last = records[0][kind], records[-1][kind]
    if first == last:
        return f"{kind} {first} is finished and kept in {folder}"
    return f"{kind}s {first} to {last} are finished and kept in {folder}"


def _folder(args: argparse.Namespace) -> Path:
    return Path(args.file.stem + "-out") if args.out is None else args.out
