"""Files that users name: read whole, if they have an end."""

from __future__ import annotations

import stat
from pathlib import Path

from .errors import InputError


def read_regular(path: Path, most: int) -> bytes:
    """Read what a file holds that has an end; not a pipe, a terminal or /dev/zero.

    Args:
        path: The file.
        most: Bytes that it may have.

    Raises:
        OSError: The system refuses to read it.
        InputError: It is no such file, or has more.
    """
    kind = path.stat().st_mode  # looked at before it is opened, which may never end
    if not stat.S_ISREG(kind) and not stat.S_ISDIR(kind):
        raise InputError("this is a device or a pipe; a file is needed")
    with path.open("rb") as file:
        data = file.read(most + 1)
    if len(data) > most:
        raise InputError(f"the file has more than {most / 1e6:g} MB; up to that are read")
    return data
