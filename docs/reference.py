"""Write the reference's pages from the tables that the program itself goes by.

container/run python3 docs/reference.py
"""

import contextlib
import io
from pathlib import Path

from signorini_cr import options
from signorini_cr.app.commandline import read_arguments
from signorini_cr.app.reference import page
from signorini_cr.multigrid.smoothing import SMOOTHERS
from signorini_cr.output.meanings import SECTIONS

MADE = "\n*This page is made by `./container/run python3 docs/reference.py` from {}.*\n"


def command() -> str:
    """What `--help` says, in Markdown."""
    lines = ["# The command", ""]
    for words in ([], ["solve"], ["check"]):
        text = io.StringIO()
        with contextlib.redirect_stdout(text), contextlib.suppress(SystemExit):
            read_arguments([*words, "--help"])
        lines += [f"## {' '.join(['signorini-cr', *words])}", "", "```text"]
        lines += [text.getvalue().rstrip(), "```", ""]
    lines += ["## Options of PETSc", "", ABOUT_OPTIONS, *_options(), ""]
    return "\n".join(lines) + MADE.format("`signorini-cr --help` and `signorini_cr/options.py`")


ABOUT_OPTIONS = f"""\
PETSc's options that begin with `-{options.PREFIX}` reach the solvers of this program, from its
command line and from that of any script. What follows the prefix is PETSc's own, such as
`ksp_rtol 1e-10`; users' come before what the program sets. Tolerances that are not named here are
computed.

| they begin with | they are about | set by the program |
|---|---|---|"""

AMG = "BoomerAMG, or GAMG where PETSc is without hypre"
P = options.PREFIX
PREFIXES: dict[str, tuple[str, str | dict[str, object]]] = {
    f"{P}snes_": ("the active set method; its steps are Newton's", options.NEWTON),
    f"{P}ksp_": ("the linear systems of its steps", options.REDUCED),
    f"{P}pc_": ("what preconditions them, in Python: the multigrid cycle", options.REDUCED),
    options.REDUCED_PREFIX: ("what SNES itself asks: a shell around those two", "its `ksp_type`"),
    options.BOTTOM_PREFIX: ("the bottom of the cycle", f"small ones are factorised; {AMG}"),
    options.ALONE_PREFIX: (
        "what takes the cycle's place where it is given up",
        f"factors, where they fit; {AMG}",
    ),
    options.ESTIMATE_PREFIX: ("the certificate: its sharpness, not its validity", f"CG; {AMG}"),
}


def _options() -> list[str]:
    """A table of the prefixes, and what is the program's own."""
    lines = []
    for prefix, (what, settings) in PREFIXES.items():
        if not isinstance(settings, str):
            kind = prefix.removeprefix(P)
            values = {
                name: f"{value:g}" if isinstance(value, float) else value
                for name, value in settings.items()
                if name.startswith(kind)
            }
            settings = ", ".join(f"`{name} {value}`" for name, value in values.items())
        lines.append(f"| `-{prefix}` | {what} | {settings} |")
    first, *others = SMOOTHERS
    named = " or ".join(f"`{name}`" for name in others)
    lines += [
        "",
        f"`-{P}smoother NAME` is the program's own: what smooths in the cycle, `{first}`, "
        f"the default, or {named}.",
        "`jacobi` takes twice the steps, and gives the same figures on any number of ranks.",
    ]
    return lines


def figures() -> str:
    """What every figure of a run means, in Markdown."""
    lines = [
        "# The figures",
        "",
        "What is printed, and what lies in the folder of a run: each column and each key. "
        "`signorini-cr solve --help columns` says the same. What does not exist is null, `-` on "
        "the screen, and empty in CSV.",
        "",
    ]
    for head, entries in SECTIONS.items():
        lines += [f"## {head}", "", "| name | meaning |", "|---|---|"]
        lines += [
            f"| `{name}` | {meaning.replace('|', chr(92) + '|')} |"
            for name, meaning in entries.items()
        ]
        lines.append("")
    return "\n".join(lines) + MADE.format("the table that the program prints its legend from")


PAGES = {"problem-file.md": page, "command.md": command, "figures.md": figures}

if __name__ == "__main__":
    for name, make in PAGES.items():
        (Path(__file__).parent / name).write_text(make(), encoding="utf-8")
