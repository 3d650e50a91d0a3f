"""The command line of `signorini-cr`, and how the program was launched.

Everything here answers before NumPy, MPI or DOLFINx are loaded, but for a key of problem files that
is taken for an option.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import textwrap
from collections.abc import Sequence
from contextlib import suppress
from itertools import pairwise
from pathlib import Path
from typing import Any, NoReturn

from .. import __version__
from ..hints import guess
from ..output.meanings import SECTIONS
from .screen import WIDTH

PETSC_NOTE = (
    "Options with a single dash, such as -log_view or -signorini_snes_atol 1e-12, are left to PETSc"
    " (-options_left shows those that nothing used)."
)
EXIT_NOTE = (
    "Exit status: 0 solved, every level converged; 2 bad input, nothing written; 3 not converged,"
    " stopped by a limit, or out of memory or, after the first level, disk; 130 interrupted; 143,"
    " or 129 where a terminal is closed, or 152 by a limit of CPU time, terminated. Report and"
    " tables of a level, or step, are kept as soon as it is finished, whatever ends the run then."
)


OPTIONS_READ = ("-options_file", "-options_file_yaml")
"""PETSc's options that name files which are read."""
OPTIONS_WRITTEN = ("-history", "-log_trace", "-info")
"""The same of files which are written, beside viewers; what stands behind a colon is no file."""


class UsageError(Exception):
    """The command line cannot be understood."""


class _Parser(argparse.ArgumentParser):
    """An argparse parser that prints on rank 0 alone and raises instead of leaving."""

    def error(self, message: str) -> NoReturn:
        raise UsageError(f"{message}\n{self.format_usage()}")

    def _print_message(self, message: str, file: Any = None) -> None:
        if launched()[0] == 0:
            super()._print_message(message, file)


class _Help(argparse.Action):
    """Help on the command, or on what its figures mean."""

    def __call__(self, parser: Any, namespace: Any, values: Any, option_string: Any = None) -> None:
        if values == "columns":
            parser._print_message(columns(), sys.stdout)
        else:
            parser.print_help()
        parser.exit()


def columns() -> str:
    """Say what every figure of a run means, for a terminal."""
    lines: list[str] = []
    for head, entries in SECTIONS.items():
        lines += [*textwrap.wrap(head + ":", WIDTH), ""]
        width = max(map(len, entries)) + 4
        fold = textwrap.TextWrapper(WIDTH, subsequent_indent=" " * width)
        for name, meaning in entries.items():
            fold.initial_indent = f"  {name}".ljust(width)
            lines.append(fold.fill(meaning))
        lines.append("")
    return "\n".join(lines)


def read_arguments(argv: Sequence[str]) -> argparse.Namespace:
    """Understand the command line.

    Args:
        argv: Arguments without the program's name.

    Returns:
        The command, its arguments, and as ``petsc`` the words that are left to PETSc.

    Raises:
        UsageError: There is something in it that is not allowed.
        SystemExit: Help or the version was asked for and has been printed.
    """
    own, petsc = _split(list(argv))
    parser, commands = _parser()
    for word in argv:
        shown = word.encode("utf-8", "backslashreplace").decode("utf-8")
        if shown != word:
            parser.error(f"{shown}: this is no text in UTF-8, which DOLFINx needs")
    first = own[0] if own else ""
    if first.split("=")[0] not in ("-h", "--help", "--version", *commands):
        hint = guess(first, commands) or f"there are {' and '.join(commands)}"
        if not first or first.startswith("-"):
            parser.error(f"a command comes first; {hint}")
        parser.error(f"there is no command {first!r}; {hint}")
    args, rest = parser.parse_known_args(own)
    for word in rest:
        _unknown(word, commands[args.command])
    for option, value in pairwise(petsc):
        if (complaint := _unusable(option, value)) is not None:
            parser.error(f"{option} {value}: {complaint}")
    ours = commands[args.command]._option_string_actions
    for word in filter(_is_petsc_option, petsc):
        if word != "-help" and (name := "-" + word.split("=")[0]) in ours:
            parser.error(f"{word}, with one dash, is not known to PETSc; did you mean {name}?")
    args.petsc, args.words = petsc, list(argv)
    return args


def _unusable(option: str, value: str) -> str | None:
    """Say what keeps PETSc from the file that an option names, if it does: some are its end."""
    if option in OPTIONS_READ:
        if not os.path.lexists(value):
            return "there is no such file"
        return None if Path(value).is_file() else "this is no file"
    name, *rest = value.split(":")
    if option not in OPTIONS_WRITTEN:  # a viewer, perhaps: kind:file:format
        name = rest[0] if rest else ""
    folder = Path(name).parent
    if not name or name.startswith("-") or os.access(folder, os.W_OK):
        return None
    return f"{folder} is no folder that can be written to"


def _parser() -> tuple[_Parser, dict[str, _Parser]]:
    shared: dict[str, Any] = {
        "allow_abbrev": False,
        "formatter_class": lambda prog: argparse.HelpFormatter(prog, width=WIDTH),
    }
    parser = _Parser(
        prog="signorini-cr",
        description="Signorini problems with the Crouzeix-Raviart element.",
        epilog=f"{EXIT_NOTE} Runs alone or under mpirun -n N.",
        add_help=False,
        **shared,
    )
    _add_help(parser)
    parser.add_argument("--version", action="version", version=f"signorini-cr {__version__}")
    commands = parser.add_subparsers(dest="command", metavar="COMMAND", required=True)
    solve = commands.add_parser(
        "solve",
        help="solve on a sequence of meshes",
        description="Solve on a sequence of meshes, print one row a level, write DIR.",
        usage="signorini-cr solve FILE.toml [--out DIR] [--levels N] [--element cr|p1]\n"
        + " " * 26
        + "[--max-time SECONDS] [--resume] [--html] [--quiet]\n"
        + " " * 26
        + "[-v] [PETSc options]",
        epilog=f"{PETSC_NOTE} {EXIT_NOTE}",
        add_help=False,
        **shared,
    )
    _add_help(solve)
    check = commands.add_parser(
        "check",
        help="validate a problem file and draw its mesh",
        description="Read and validate FILE.toml, make the coarsest mesh and draw it with its"
        " boundary parts as DIR/mesh.png, or as DIR/check.png beside the results of a run. Nothing"
        " is solved.",
        usage="signorini-cr check FILE.toml [--out DIR] [--quiet]",
        **shared,
    )
    for command in (solve, check):
        command.add_argument("file", metavar="FILE.toml", type=Path, help="the problem file")
        command.add_argument(
            "--out",
            metavar="DIR",
            type=_directory,
            help="folder for the results, made if it is not there (default: FILE-out in the"
            " current folder)",
        )
        command.add_argument("-q", "--quiet", action="store_true", help="print errors only")
    solve.add_argument(
        "--levels", metavar="N", type=_at_least_one, help="number of meshes, instead of the file's"
    )
    solve.add_argument(
        "--element",
        choices=("cr", "p1"),
        type=str.lower,
        default="cr",
        metavar="cr|p1",
        help="Crouzeix-Raviart (default), or conforming linear elements to compare with",
    )
    solve.add_argument(
        "--max-time",
        metavar="SECONDS",
        type=_positive,
        help="begin no level, or step in time, that would end later, by what those before took;"
        " what is left to do then is to bound the contact force, which takes about as long as the"
        " last solve did, and to write fields and pictures",
    )
    solve.add_argument(
        "--resume",
        action="store_true",
        help="go on from the last level, or step in time, that a run into DIR has finished, on any"
        " number of ranks; the problem must be the same, but --levels and other limits that only"
        " end a run may differ where there is no [time]; where DIR has none, begin",
    )
    solve.add_argument(
        "-v", "--verbose", action="store_true", help="print every step of the solver"
    )
    solve.add_argument(
        "--html", action="store_true", help="write all of the run into one page, DIR/report.html"
    )
    for each in (parser, solve, check):
        vars(each)["color"] = False  # messages are folded, which counts every character
    return parser, {"solve": solve, "check": check}


def _add_help(parser: _Parser) -> None:
    parser.add_argument(
        "-h",
        "--help",
        action=_Help,
        nargs="?",
        metavar="columns",
        help="show this help and exit; with the word columns, what every printed and written figure"
        " means",
    )


def _directory(text: str) -> Path:
    if not text:
        raise argparse.ArgumentTypeError("the name of a folder is needed")
    return Path(text)


def _at_least_one(text: str) -> int:
    try:
        number = int(text)
    except ValueError:
        number = 0
    if number < 1:
        raise argparse.ArgumentTypeError(f"a whole number of 1 or more is needed, found {text}")
    return number


def _positive(text: str) -> float:
    try:
        number = float(text)
    except ValueError:
        number = 0.0
    if not 0.0 < number < float("inf"):
        raise argparse.ArgumentTypeError(f"a number of seconds above 0 is needed, found {text}")
    return number


def _split(argv: list[str]) -> tuple[list[str], list[str]]:
    """Part the command line in ours and PETSc's: ``-name`` and, where there is one, its value."""
    own: list[str] = []
    petsc: list[str] = []
    words = iter(range(len(argv)))
    for i in words:
        if argv[i] == "--":
            return own + argv[i:], petsc
        if not _is_petsc_option(argv[i]):
            own.append(argv[i])
            continue
        petsc.append(argv[i])
        if i + 1 < len(argv) and not _cannot_be_value(argv[i + 1]):
            petsc.append(argv[next(words)])
    return own, petsc


def _is_petsc_option(word: str) -> bool:
    return len(word) > 2 and word[0] == "-" and (word[1].isalpha() or word[1] == "_")


def _cannot_be_value(word: str) -> bool:
    return (
        (word[:1] == "-" and not word[1:2].isdigit() and word[1:2] != ".")
        or word.endswith(".toml")
        or word in ("solve", "check")
    )


def _unknown(word: str, command: _Parser) -> NoReturn:
    if not word.startswith("-"):
        command.error(f"{word!r} is one argument too many; one FILE.toml is allowed")
    option = word.split("=")[0]
    if option in command._option_string_actions:
        command.error(f"{word} is behind --, where there are no options; put it before that")
    options = [name for name in command._option_string_actions if name.startswith("--")]
    hint = guess(option, options) or f"there are {', '.join(options)}"
    key = option.lstrip("-").replace("-", "_")
    with suppress(ImportError):  # DOLFINx may be missing, which is not what this is about
        from .reference import section_of

        if (section := section_of(key)) is not None:
            hint = f"{key} is a key of {section} in the problem file"
    command.error(f"there is no option {option}; {hint}")


def start_petsc(options: list[str]) -> None:
    """Hand PETSc its options: at its start, or now where it has started already."""
    import petsc4py

    if "HOME" not in os.environ:  # Open MPI ends the process without it
        found = os.path.expanduser("~")  # what the system says
        os.environ["HOME"] = tempfile.gettempdir() if found == "~" else found
    if "petsc4py.PETSc" not in sys.modules:
        # PETSc would take a closed pipe, or being told to stop, for a crash
        petsc4py.init(["signorini-cr", "-no_signal_handler", *options])
    elif options:
        from petsc4py import PETSc

        PETSc.Options().insertString(" ".join(options))


def launched() -> tuple[int, int]:
    """Return rank and number of ranks as the launcher tells them, without loading MPI."""
    for rank, size in (
        ("OMPI_COMM_WORLD_RANK", "OMPI_COMM_WORLD_SIZE"),
        ("PMI_RANK", "PMI_SIZE"),
        ("SLURM_PROCID", "SLURM_NTASKS"),
    ):
        if os.environ.get(rank, "").isdigit():
            number = os.environ.get(size, "")
            return int(os.environ[rank]), int(number) if number.isdigit() else 1
    return 0, 1


def left_alone(size: int) -> str | None:
    """Say so where a launcher has started more processes than MPI knows of.

    Each would solve the whole problem, and all would write into the same folder.

    Args:
        size: How many MPI knows of.
    """
    for variable in ("OMPI_COMM_WORLD_SIZE", "PMI_SIZE"):  # Slurm's is set without srun, too
        number = os.environ.get(variable, "")
        if number.isdigit() and int(number) > size:
            return (
                f"launched as one of {number} processes, but MPI knows of {size}: mpirun belongs"
                " to another MPI than mpi4py, or has ended"
            )
    return None


def wait_for_all() -> None:
    """Leave together: mpirun ends all ranks when the first leaves with an error."""
    if launched()[1] > 1:
        from mpi4py import MPI

        MPI.COMM_WORLD.Barrier()
