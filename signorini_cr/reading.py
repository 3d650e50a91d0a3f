"""Files that users name: read whole, if they have an end."""

from __future__ import annotations

import stat
from pathlib import Path

from .errors import InputError


def insist_on_end(path: Path) -> None:
    """Refuse what may be without an end, before it is opened, which alone may take for ever.

    Raises:
        OSError: The system does not tell.
        InputError: It is a device or a pipe.
    """
    kind = path.stat().st_mode
    if not stat.S_ISREG(kind) and not stat.S_ISDIR(kind):
        raise InputError("this is a device or a pipe; a file is needed")


def read_regular(path: Path, most: int) -> bytes:
    """Read what a file holds that has an end; not a pipe, a terminal or /dev/zero.

    Args:
        path: The file.
        most: Bytes that it may have.

    Raises:
        OSError: The system refuses to read it.
        InputError: It is no such file, or has more.
    """
    insist_on_end(path)
    with path.open("rb") as file:
        data = file.read(most + 1)
    if len(data) > most:
        raise InputError(f"the file has more than {most / 1e6:g} MB; up to that are read")
    return data
