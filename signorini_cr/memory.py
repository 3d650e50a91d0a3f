"""Memory: how much of it there has been, and whether it was at an end."""

from __future__ import annotations

import errno
import resource
from pathlib import Path

from petsc4py import PETSc

_PETSC_ERR_MEM = 55
# The last one stands in what the other ranks are told of a rank's error, see errors.fail_together
_WORDS = ("std::bad_alloc", "Cannot allocate memory", "MemoryError")


def ran_out_of_memory(error: BaseException | None) -> bool:
    """Whether an error, or what it was raised from, says that no memory is left."""
    while error is not None:
        if (
            isinstance(error, MemoryError)
            or (isinstance(error, PETSc.Error) and error.ierr == _PETSC_ERR_MEM)
            or (isinstance(error, OSError) and error.errno == errno.ENOMEM)
            or any(words in str(error) for words in _WORDS)
        ):
            return True
        error = error.__cause__
    return False


def most_memory() -> float:
    """The most memory, in bytes, that this program has held at a time."""
    try:
        lines = Path("/proc/self/status").read_text().splitlines()
        # ru_maxrss counts what the process held before it became this program, as a copy of another
        return next(1024.0 * int(line.split()[1]) for line in lines if line.startswith("VmHWM"))
    except (OSError, StopIteration):
        return 1024.0 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
