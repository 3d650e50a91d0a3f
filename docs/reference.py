"""Write the reference's pages from the tables that the program itself goes by.

container/run python3 docs/reference.py
"""

import contextlib
import io
from pathlib import Path

from signorini_cr.app.commandline import read_arguments
from signorini_cr.app.reference import page
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
    return "\n".join(lines) + MADE.format("`signorini-cr --help`")


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
