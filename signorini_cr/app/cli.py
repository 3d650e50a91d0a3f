"""The command `signorini-cr`: from a problem file to a folder of results.

Nothing heavy is imported before the command line has been understood, so that ``--help`` and a
misspelt option answer at once.
"""

from __future__ import annotations

import argparse
import os
import re
import signal
import sys
import time
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from .. import temporary
from ..memory import ran_out_of_memory, too_little
from .commandline import (
    UsageError,
    launched,
    left_alone,
    read_arguments,
    start_petsc,
    wait_for_all,
)
from .screen import Screen
from .signals import interruptible, status_of

DONE, FAULT, BAD_INPUT, NOT_CONVERGED = 0, 1, 2, 3
NO_MEMORY = "out of memory"
INTERRUPTED = 128 + signal.SIGINT
FRAMES = 10_000
"""Calls within one another: UFL differentiates by recursion, 40 calls at most for each of the 250
operations that `expressions.LONGEST_CHAIN` allows one upon the other."""
PASSED_ON = 0.3
"""Seconds for mpirun to pass on what a rank has printed, before that rank ends them all: MPICH's
drops what it has not read by then."""

LAST = 5.0
"""Seconds for rank 0 to tell what keeps all from beginning, before one that has begun sooner ends
and mpirun ends the others."""


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
    with interruptible() as asked, room_for_recursion():
        try:
            return _run(args, screen, asked)
        except KeyboardInterrupt:  # while nothing has begun, or when all has been told
            return status_of(asked)
        except MemoryError:  # there was no room to tell of it
            with suppress(OSError):
                os.write(2, f"signorini-cr: {NO_MEMORY}\n".encode())
            if launched()[1] > 1:  # the others know nothing of it
                os._exit(NOT_CONVERGED)
            return NOT_CONVERGED


@contextmanager
def room_for_recursion() -> Iterator[None]:
    """Let expressions be as deep as they may be; the process is the command's, while it runs."""
    before = sys.getrecursionlimit()
    sys.setrecursionlimit(max(before, FRAMES))
    try:
        yield
    finally:
        sys.setrecursionlimit(before)


def _run(args: argparse.Namespace, screen: Screen, asked: list[int]) -> int:
    """Start PETSc and do what the command says; whatever goes wrong becomes a message."""
    comm = _begin(args, screen, asked)
    if isinstance(comm, int):
        return comm
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
        return _end(args, screen, comm, asked, error)


def _begin(args: argparse.Namespace, screen: Screen, asked: list[int]) -> Any:
    """Start PETSc, and MPI with it.

    Returns:
        The communicator, or the exit status where that can't be done.
    """
    if (complaint := too_little()) is not None:
        return _refuse(screen, f"{args.file}: {complaint}", NOT_CONVERGED)
    if sys.flags.optimize > 1:
        words = "Python runs without docstrings (-OO, PYTHONOPTIMIZE=2), which compiling takes"
        return _refuse(screen, words, BAD_INPUT)
    epoch = os.environ.get("SOURCE_DATE_EPOCH", "0")
    if not re.fullmatch(r"\s*\d{1,11}\s*", epoch):  # SciPy begins by reading it, as a year
        words = f"SOURCE_DATE_EPOCH is {epoch!r}; the environment is to have a whole number there"
        return _refuse(screen, words, BAD_INPUT)
    try:
        os.getcwd()
    except OSError as error:
        words = f"the folder that it was started in cannot be used: {error.strerror}"
        return _refuse(screen, words, BAD_INPUT)
    try:
        elsewhere = temporary.choose()
    except OSError as error:
        return _refuse(screen, str(error), BAD_INPUT)
    if any(word.startswith("e") for word in sys.warnoptions):  # PYTHONWARNINGS=error, say
        warnings.simplefilter("default")  # what libraries warn of ends no run
    os.environ.setdefault("UCX_DEBUG_SIGNO", "0")  # of MPI's, which would take SIGHUP for itself
    os.environ.pop("MPLBACKEND", None)  # pictures go to files, and a notebook's own may be missing
    try:
        start_petsc(args.petsc)
        from mpi4py import MPI

        comm = MPI.COMM_WORLD
        screen.root = comm.rank == 0
        screen.quiet, screen.verbose = args.quiet, getattr(args, "verbose", False)
        if elsewhere is not None:
            screen.warn(elsewhere)
        if (complaint := left_alone(comm.size)) is not None:
            screen.complain(complaint)
            return BAD_INPUT
        return comm
    except (Exception, KeyboardInterrupt) as error:
        if asked or isinstance(error, KeyboardInterrupt):
            status = status_of(asked)
        elif ran_out_of_memory(error):
            status = NOT_CONVERGED
            screen.complain(f"{args.file}: {NO_MEMORY}")
        elif type(error).__module__ == "petsc4py.PETSc":
            status = BAD_INPUT
            screen.complain(
                f"PETSc cannot start, {error}: what it says stands above; it has options from the"
                " command line, from PETSC_OPTIONS and from files called .petscrc"
            )
        else:
            raise
        if launched()[1] > 1:  # the others would wait for it, and it for them when MPI ends
            os._exit(status)
        return status


def _end(
    args: argparse.Namespace, screen: Screen, comm: Any, asked: list[int], error: BaseException
) -> int:
    """Tell of an error that perhaps this rank alone has, so that the others must not wait for it.

    Args:
        args: The command line.
        screen: Where it is told.
        comm: All ranks.
        asked: The signals that have come.
        error: The error.

    Returns:
        The exit status, if there are no other ranks.
    """
    kept = "".join(getattr(error, "__notes__", ()))  # from _solve
    if asked or isinstance(error, KeyboardInterrupt):
        status = status_of(asked)
        if not screen.root:  # which tells and ends all, if it was asked and can
            time.sleep(PASSED_ON + 0.3 * min(1 + comm.rank, 5))
            screen.root = True
        word = "interrupted" if status == INTERRUPTED else "terminated"
        screen.complain(f"{word}{kept and f'; {kept}'}")
        return _end_all(comm, status)
    if ran_out_of_memory(error):  # while it began, or while it wrote
        screen.root = True
        screen.complain(f"{args.file}: {NO_MEMORY}" + (kept and f"\n{kept}"))
        return _end_all(comm, NOT_CONVERGED)
    import traceback

    where = f" on rank {comm.rank}" if comm.size > 1 else ""
    with suppress(OSError):  # whether or not it can be told
        traceback.print_exception(error)
        print(f"signorini-cr: unexpected error{where}, see above", file=sys.stderr, flush=True)
    return _end_all(comm, FAULT)


def _refuse(screen: Screen, words: str, status: int) -> int:
    """Tell why MPI is not even begun; rank 0 is the first to leave, which ends the others."""
    screen.complain(words)
    if not screen.root:
        time.sleep(LAST)
    return status


def _end_all(comm: Any, status: int) -> int:
    """End the other ranks, which know nothing of it; alone, return the status."""
    if comm.size > 1:
        time.sleep(PASSED_ON)
        comm.Abort(status)
    return status


def _solve(args: argparse.Namespace, screen: Screen, comm: Any) -> int:
    from ..errors import InputError, NotConverged, naming
    from ..output import report as output
    from ..output.files import check_writable
    from ..restart import AnotherMesh
    from .run import out_of_memory, what_is_kept
    from .runs import solve_case

    folder = _folder(args)
    with naming("--out"):
        check_writable(folder, output.FILES, comm)
    screen.progress("reading")
    records: list[output.Record] = []
    try:
        solve_case(args, screen, comm, folder, records)
        return DONE
    except (Exception, KeyboardInterrupt) as error:
        if isinstance(error, AnotherMesh):
            raise InputError(f"--resume: {error}; another --out begins anew") from error
        if isinstance(error, InputError) and records:  # a full disk; data that a finer mesh hits
            raise NotConverged(f"{error}\n{what_is_kept(records, folder)}") from error
        if not ran_out_of_memory(error):
            error.add_note(what_is_kept(records, folder) if records else "")
            raise
    told = out_of_memory(records, folder)
    if comm.size > 1:  # the other ranks know nothing of it
        screen.root = True
        screen.complain(f"{args.file}: {told}")
        _end_all(comm, NOT_CONVERGED)
    raise NotConverged(told)


def _check(args: argparse.Namespace, screen: Screen, comm: Any) -> int:
    from ..errors import naming, on_root
    from ..output import plots
    from ..output.files import check_writable, write_files
    from ..output.report import CHECKED, REPORT
    from .runs import read_case
    from .statement import folded, statement

    folder = _folder(args)
    with naming("--out"):
        check_writable(folder, ["mesh.png", CHECKED], comm)
    # mesh.png beside a report is that of its run
    picture = CHECKED if on_root(comm, os.path.exists, folder / REPORT) else "mesh.png"
    case, domain = read_case(args, screen, comm)
    screen.line(f"{args.file}: in order")
    screen.line(folded(statement(case, domain)))
    if not plots.can_draw(comm):
        screen.text("not drawn: Matplotlib is not installed")
        return DONE

    def draw(path: Path) -> None:
        plots.plot_mesh(domain, path, case.title, units=case.units, problem=case.problem)

    with naming("--out"):
        write_files(folder, {picture: draw}, comm=comm)
    screen.text(f"drawn in {folder / picture}")
    return DONE


def _folder(args: argparse.Namespace) -> Path:
    return Path(args.file.stem + "-out") if args.out is None else args.out
