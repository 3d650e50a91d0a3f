"""Files that are gone when a run ends: where there is room for them.

MPI keeps some while it runs, and ends the process where it can't; the compiler has some for each
form that it is given.
"""

from __future__ import annotations

import os
import tempfile

ROOM = 2_000_000
"""Bytes that compiling a form takes, at most."""
VARIABLES = ("TMPDIR", "TEMP", "TMP")
"""Variables that may name the folder, the first before the others."""
USUAL = ("/tmp", "/var/tmp")


def fault(folder: str | os.PathLike[str]) -> str | None:
    """Say in words what keeps us from writing as much as `ROOM` into a folder."""
    try:
        with tempfile.TemporaryFile(dir=folder) as file:
            file.write(bytes(ROOM))
            file.flush()
    except OSError as error:
        return error.strerror or str(error)
    return None


def choose() -> str | None:
    """See to it that there is a folder, for this process and those that it starts.

    To be called before MPI is loaded.

    Returns:
        What a user should know if it is not the one that is named, or usual.

    Raises:
        OSError: There is none; the message is for the user.
    """
    named = [place for name in VARIABLES if (place := os.environ.get(name))]
    faults: list[str] = []
    for place in (*named, *USUAL):
        if (words := fault(place)) is None:
            break
        faults.append(f"temporary files cannot be kept in {place} ({words})")
    else:
        raise OSError(f"{faults[0]}, nor in another usual place; TMPDIR may name a folder")
    if not faults:
        return None
    os.environ["TMPDIR"] = tempfile.tempdir = place
    return f"{faults[0]}: {place} takes them"
