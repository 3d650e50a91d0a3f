"""Output of the command, on rank 0: results to stdout, progress and complaints to stderr."""

from __future__ import annotations

import io
import os
import sys
import textwrap
from typing import TextIO

WIDTH = 80


class Screen:
    """Standard output and error of one run.

    Args:
        root: Whether this rank prints.

    Attributes:
        quiet: Print complaints only.
        verbose: Print every step of the solver for good.
    """

    def __init__(self, root: bool) -> None:
        """Take everything as it comes at first."""
        for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
            if getattr(sys, name) is None:  # closed: no other file shall get its number
                setattr(sys, name, open(os.devnull, mode))
        if isinstance(sys.stdout, io.TextIOWrapper):  # not all terminals know Γ
            sys.stdout.reconfigure(errors="backslashreplace")
        self.root, self.quiet, self.verbose = root, False, False
        self.passing = 0  # width of the progress line that stands on the terminal

    def line(self, text: str) -> None:
        """Print a line of results."""
        if self.root and not self.quiet:
            self.clear()
            self._put(sys.stdout, printable(text) + "\n")

    def text(self, text: str) -> None:
        """Print results as a paragraph."""
        self.line(wrapped(text))

    def items(self, head: str, *items: str) -> None:
        """Print results as a list under a head: a paragraph each, whose further lines hang."""
        self.text(head)
        for item in items:
            self.line(wrapped(item, "  ", " " * 4))

    def step(self, text: str) -> None:
        """Print a step of the solver: for good with -v, else as the progress line."""
        if self.verbose:
            self.line(text)
        else:
            self.progress(text.strip())

    def progress(self, text: str) -> None:
        """Show what is going on, on a terminal, until the next line."""
        if self.root and not self.quiet and sys.stderr.isatty():
            self.clear()
            self._put(sys.stderr, text[: WIDTH - 1])
            self.passing = len(text[: WIDTH - 1])

    def clear(self) -> None:
        """Take the progress line away."""
        if self.passing:
            self._put(sys.stderr, "\r" + " " * self.passing + "\r")
            self.passing = 0

    def complain(self, message: str) -> None:
        """Say what went wrong, quiet or not."""
        if self.root:
            self.clear()
            self.flush()
            self._put(sys.stderr, wrapped(printable(message), "signorini-cr: ") + "\n")

    def warn(self, message: str) -> None:
        """Say what is strange, but no reason to stop."""
        if not self.quiet:
            self.complain(f"warning: {message}")

    def flush(self) -> None:
        """Bring out what was printed, and take away the progress line."""
        self.clear()
        if self.root:
            self._put(sys.stdout, "")

    def _put(self, stream: TextIO, text: str) -> None:
        try:
            # No-break spaces have done their work; not all terminals know them
            stream.write(text.replace("\u00a0", " "))
            stream.flush()
        except OSError as error:  # the results are still wanted
            os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())
            if stream is sys.stdout:
                self.quiet = True
                if not isinstance(error, BrokenPipeError):  # the reader may leave
                    self.complain(f"cannot print to standard output: {error.strerror}")


def printable(text: str) -> str:
    """Remove what would move a terminal's cursor or change its colours."""
    return "".join(c if c.isprintable() or c in "\n\u00a0" else ascii(c)[1:-1] for c in text)


def wrapped(text: str, before: str = "", hanging: str = "") -> str:
    """Fold to the width of a terminal; lines that begin with blanks are left as they are.

    Args:
        text: One paragraph a line.
        before: What the first line begins with.
        hanging: What the lines begin with on which a paragraph goes on.
    """
    fold = textwrap.TextWrapper(
        WIDTH, break_long_words=False, break_on_hyphens=False, subsequent_indent=hanging
    )
    lines: list[str] = []
    for line in text.rstrip().split("\n"):
        fold.initial_indent = before if not lines else ""
        lines.append(line if line.startswith(" ") else fold.fill(line))
    return "\n".join(lines)
