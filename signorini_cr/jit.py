"""Compiling forms, also where a run that was ended has left one half compiled.

FFCx begins with an empty source file in a folder that all programs share, and ends with a mark
beside it; where the mark is missing, it waits for whoever may be at work, ten seconds by default,
and gives up. After a run that was killed in between, every run would give up, for ever.
"""

from __future__ import annotations

import re
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import TypeVar

from dolfinx import jit
from mpi4py import MPI

T = TypeVar("T")

ABANDONED = 60.0
"""Seconds without a change from which on a source file without mark belongs to nobody."""


def compiled(comm: MPI.Comm, build: Callable[..., T], *args: object) -> T:
    """Call `build(*args)`, which compiles, as often as that takes; collective.

    Args:
        comm: The ranks that compile together.
        build: `dolfinx.fem.form`, `compile_form` or `Expression`.
        *args: Handed over to `build`.

    Returns:
        What `build` returns.
    """
    began = time.time() - 0.1  # the clock that files are dated by may lag a little
    while True:
        try:
            return build(*args)
        except (TimeoutError, RuntimeError) as error:
            # With several ranks DOLFINx raises RuntimeError on all of them, rank 0's with the words
            if comm.size > 1 and not re.search("(JIT|just-in-time) compilation", str(error)):
                raise
            if not comm.bcast(comm.rank == 0 and _waited_in_vain(str(error)), root=0):
                raise
        except (KeyboardInterrupt, SystemExit):
            if comm.rank == 0:
                remove_unfinished(began)
            raise


def _waited_in_vain(words: str) -> bool:
    """Tell whether FFCx has given up waiting; the source file goes if nobody is at work at it."""
    found = re.search(r"timed out.*remove (.*\.c)\)", words, re.DOTALL)
    if found is None:
        return False
    source = Path(found[1])
    with suppress(OSError):
        if time.time() - source.stat().st_mtime > ABANDONED:
            source.unlink()
    return True


def remove_unfinished(since: float = 0.0, until: float = float("inf")) -> None:
    """Remove source files without mark that were last changed in an interval of time."""
    folder = Path(jit.get_options()["cache_dir"])
    for source in folder.glob("libffcx_*.c"):
        with suppress(OSError):
            marked = source.with_suffix(".c.cached").exists()
            if not marked and since <= source.stat().st_mtime <= until:
                source.unlink()
