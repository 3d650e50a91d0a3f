"""The command `signorini-cr`: from a problem file to a folder of results.

Nothing heavy is imported before the command line has been understood, so that ``--help`` and a
misspelt option answer at once.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from .commandline import UsageError, launched, read_arguments, start_petsc, wait_for_all
from .screen import Screen, wrapped

if TYPE_CHECKING:
    from .domain import Domain
    from .errors import NotConverged
    from .problemfile import ProblemFile
    from .solution import Solution

DONE, FAULT, BAD_INPUT, NOT_CONVERGED, INTERRUPTED = 0, 1, 2, 3, 130


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; collective under mpirun.

    Args:
        argv: Arguments without the program's name, by default those of the process.

    Returns:
        The exit status, the same on every rank.
    """
    screen = Screen(launched()[0] == 0)
    try:
        args = read_arguments(sys.argv[1:] if argv is None else argv)
    except SystemExit:  # --help and --version have answered
        screen.flush()
        return DONE
    except UsageError as error:
        screen.complain(str(error))
        wait_for_all()
        return BAD_INPUT
    return _run(args, screen)


def _run(args: argparse.Namespace, screen: Screen) -> int:
    """Start PETSc and do what the command says; whatever goes wrong becomes a message."""
    try:
        start_petsc(args.petsc)
        from mpi4py import MPI

        comm = MPI.COMM_WORLD
        screen.root = comm.rank == 0
        screen.quiet, screen.verbose = args.quiet, getattr(args, "verbose", False)
    except KeyboardInterrupt:
        return INTERRUPTED
    try:
        from .errors import InputError, NotConverged

        try:
            status = {"solve": _solve, "check": _check}[args.command](args, screen, comm)
        except InputError as error:
            screen.complain(str(error))
            status = BAD_INPUT
        except NotConverged as error:
            screen.complain(str(error))
            status = NOT_CONVERGED
        screen.flush()
        comm.Barrier()  # mpirun ends all ranks when the first leaves with an error
        return status
    except KeyboardInterrupt:
        screen.complain("interrupted")
        if comm.size > 1:
            comm.Abort(INTERRUPTED)
        return INTERRUPTED
    except Exception:
        # Perhaps on this rank only: the others must not wait for it
        import traceback

        where = f" on rank {comm.rank}" if comm.size > 1 else ""
        with suppress(OSError):  # whether or not it can be told
            traceback.print_exc()
            print(f"signorini-cr: unexpected error{where}, see above", file=sys.stderr, flush=True)
        if comm.size > 1:
            comm.Abort(FAULT)
        return FAULT


def _solve(args: argparse.Namespace, screen: Screen, comm: Any) -> int:
    from . import output
    from .errors import InputError, NotConverged
    from .files import check_writable

    folder = _folder(args)
    with _named("--out"):
        check_writable(folder, output.FILES, comm)
    screen.progress("reading")
    case, domain, seconds = _read(args, screen, comm)
    records: list[output.Record] = []
    finest: Solution | None = None
    failure: NotConverged | None = None
    try:
        for solution in _solutions(case, domain, args.element.upper(), screen):
            if not records:
                solution.seconds["mesh"] = seconds
            records.append(output.level_record(solution, records[-1] if records else None))
            finest = solution
            if screen.verbose:
                taken = solution.iterations.preconditioner
                screen.line(wrapped(taken, "  linear systems: "))
            if len(records) == 1:
                screen.line(output.table_header(records[0]))
            screen.line(output.table_row(records[-1], records[0]))
    except NotConverged as error:
        failure = error
    except MemoryError:
        if comm.size > 1:  # the other ranks know nothing of it
            raise
        failure = NotConverged("out of memory", len(records))
    except InputError as error:
        raise InputError(f"{case.path}: {error}") from None
    failure = failure or _above_tolerance(case, records)
    screen.progress("writing")
    if finest is not None:
        report = output.make_report(case.title, args.element.upper(), comm, records)
        with _named("--out"):
            names = output.write_output(folder, report, finest)
        screen.line("")
        screen.text(_facts(records[-1]))
        if (reason := records[-1]["bound_reason"]) is not None:
            screen.text(f"no bound of the error: {reason}")
        screen.text(f"written to {folder}: {', '.join(names)}")
    if failure is not None:
        screen.complain(f"{case.path}: {_stopped(failure, len(records), folder)}")
        return NOT_CONVERGED
    return DONE


def _check(args: argparse.Namespace, screen: Screen, comm: Any) -> int:
    from . import plots
    from .domain import PARTS
    from .files import check_writable, write_files
    from .space import facet_measures

    folder, picture = _folder(args), "mesh.png"
    with _named("--out"):
        check_writable(folder, [picture], comm)
    case, domain, _ = _read(args, screen, comm)
    topology = domain.mesh.topology
    screen.line(f"{case.path}: in order")
    screen.text(f"{topology.index_map(topology.dim).size_global} cells on the coarsest mesh")
    for name, part in PARTS.items():
        _, lengths = facet_measures(domain.mesh, domain.facets(part))
        number, length = comm.allreduce(len(lengths)), comm.allreduce(float(lengths.sum()))
        screen.text(f"{name}: {number} facets, length {length:.6g}")
    if not plots.can_draw(comm):
        screen.text("not drawn: Matplotlib is not installed")
        return DONE

    def draw(path: Path) -> None:
        plots.plot_mesh(domain, path, case.title)

    with _named("--out"):
        write_files(folder, {picture: draw}, comm=comm)
    screen.text(f"drawn in {folder / picture}")
    return DONE


def _read(args: argparse.Namespace, screen: Screen, comm: Any) -> tuple[ProblemFile, Domain, float]:
    """The checked problem file, the coarsest mesh and how long the mesh took."""
    import time
    from dataclasses import replace

    from . import problemfile

    case = problemfile.load(args.file, comm)
    if getattr(args, "levels", None) is not None:
        case = replace(case, levels=args.levels)
    screen.progress("making the mesh")
    began = time.perf_counter()
    domain = case.mesh(comm)
    seconds = time.perf_counter() - began
    case.check(domain)
    return case, domain, seconds


def _solutions(
    case: ProblemFile, domain: Domain, element: str, screen: Screen
) -> Iterator[Solution]:
    from . import levels

    def monitor(level: int, step: int, residual: float, active: int, linear: int) -> None:
        facts = f"step {step:2d}  residual {residual:9.2e}  active {active:5d}  cg {linear:4d}"
        screen.step(f"  level {level}  {facts}")

    screen.progress("level 0")
    if case.mode == "uniform":
        return levels.solve_levels(case.problem, domain, case.levels, element, monitor)
    from .adaptive import solve_adaptive

    return solve_adaptive(
        case.problem,
        domain,
        tolerance=case.tolerance,
        levels=case.levels,
        max_dofs=case.max_dofs,
        element=element,
        monitor=monitor,
    )


def _facts(record: dict[str, Any]) -> str:
    """What happens on Γ1, in a sentence."""
    contact = record["contact"]
    line = (
        f"contact on {contact['active']} of {contact['facets']} facets, length"
        f" {contact['length']:.6g}, force {contact['force']:.6g}"
    )
    points = [
        "(" + ", ".join(f"{value:.6g}" for value in point) + ")" for point in contact["transitions"]
    ]
    if points:
        more = f" and {len(points) - 6} more" if len(points) > 6 else ""
        line += f"; it begins or ends at {', '.join(points[:6])}{more}"
    return line


def _above_tolerance(case: ProblemFile, records: list[dict[str, Any]]) -> NotConverged | None:
    """What stopped an adaptive run before the bound that was asked for was reached."""
    if case.mode == "uniform" or case.tolerance == 0.0 or not records:
        return None
    from .errors import NotConverged

    bound = records[-1]["bound_h1"]
    if bound is not None and bound <= case.tolerance:
        return None
    limit = (
        f"levels = {case.levels}" if len(records) >= case.levels else f"max_dofs = {case.max_dofs}"
    )
    return NotConverged(
        f"the certified bound is {bound:.3g}, above the tolerance of {case.tolerance:g}, and"
        f" {limit} allows no further mesh",
        records[-1]["level"],
    )


def _stopped(failure: Any, finished: int, folder: Path) -> str:
    kept = {
        0: "no level was finished, nothing was written",
        1: f"level 0 is finished and kept in {folder}",
    }.get(finished, f"levels 0 to {finished - 1} are finished and kept in {folder}")
    level = finished if failure.level is None else failure.level
    return f"stopped on level {level}: {failure.reason}\n{kept}"


@contextmanager
def _named(key: str) -> Iterator[None]:
    """Put the key before what an InputError says."""
    from .errors import InputError

    try:
        yield
    except InputError as error:
        raise InputError(f"{key}: {error}") from None


def _folder(args: argparse.Namespace) -> Path:
    return Path(args.file.stem + "-out") if args.out is None else args.out
