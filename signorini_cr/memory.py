"""Memory: how much of it there has been, how much is left, and whether it was at an end."""

from __future__ import annotations

import errno
import math
import os
import resource
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:  # it is asked before they are loaded, and where they can't be
    from mpi4py import MPI

CGROUPS = Path("/sys/fs/cgroup")

LEAST_SPACE = 4e8
"""Bytes of address space; libraries that are loaded with less end the process in many ways."""
FEWEST = 64
"""Files open at a time. MPI, which would end the process, takes 24 for itself and two ranks."""

_ASKED = ("VmPeak", "VmHWM", "VmRSS")
_PETSC_ERR_MEM = 55
_WORDS = (
    "std::bad_alloc",
    "Cannot allocate memory",
    "failed to map segment",  # of a library that is being loaded
    # what Python says that has no room for an error
    "returned NULL without setting an exception",
    "error return without exception set",
    "MemoryError",  # what the other ranks are told of a rank's error, see errors.fail_together
)


def ran_out_of_memory(error: BaseException | None) -> bool:
    """Tell whether an error, or what it was raised from, says that no memory is left."""
    petsc: Any = getattr(sys.modules.get("petsc4py.PETSc"), "Error", ())
    refusal: Any = getattr(sys.modules.get(f"{__package__}.errors"), "InputError", ())
    while error is not None:
        if (
            isinstance(error, MemoryError)
            or (isinstance(error, petsc) and error.ierr == _PETSC_ERR_MEM)
            or (isinstance(error, OSError) and error.errno == errno.ENOMEM)
            # an InputError quotes what the user has written
            or (not isinstance(error, refusal) and any(words in str(error) for words in _WORDS))
        ):
            return True
        error = error.__cause__
    return False


def too_little() -> str | None:
    """Say so where ``ulimit`` leaves no room for MPI, PETSc and DOLFINx."""
    files = resource.getrlimit(resource.RLIMIT_NOFILE)[0]
    if files != resource.RLIM_INFINITY and files < FEWEST:
        return f"ulimit -n allows {files} open files, and {FEWEST} are needed"
    limit = resource.getrlimit(resource.RLIMIT_AS)[0]
    if limit == resource.RLIM_INFINITY or limit >= LEAST_SPACE:
        return None
    return (
        f"out of memory: ulimit -v leaves {_shown(limit)}, and to load the program alone takes"
        f" {_shown(LEAST_SPACE)}"
    )


def most_memory() -> float:
    """Return the most memory, in bytes, that this program has held at a time."""
    # ru_maxrss counts what the process held before it became this program, as a copy of another
    ours = _status().get("VmHWM")
    return 1024.0 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss if ours is None else ours


def shortage(comm: MPI.Comm, growth: float) -> str | None:
    """Say what keeps the ranks from more memory than they have ever held; collective.

    Counted are the address space (``ulimit -v``) of each, and what is left to all of them on a
    machine and in their cgroups, file caches not counted as taken.

    Args:
        comm: The ranks.
        growth: How much more this one needs, in bytes.

    Returns:
        What the lowest rank with too little of it has, in words, on all ranks; None if it fits.
    """
    from mpi4py import MPI

    own, words = _status(), None
    limit = resource.getrlimit(resource.RLIMIT_AS)[0]
    spare = math.inf if limit == resource.RLIM_INFINITY else limit - own.get("VmPeak", 0.0)
    if growth > spare:
        words = f"{_shown(growth)} more memory, and ulimit -v leaves {_shown(spare)}"
    together = comm.Split_type(MPI.COMM_TYPE_SHARED)
    wanted = together.allreduce(growth + own.get("VmHWM", 0.0) - own.get("VmRSS", 0.0))
    together.Free()
    if words is None and wanted > (spare := _spare()):
        words = f"{_shown(wanted)} more memory, and there are {_shown(spare)}"
    return next((each for each in comm.allgather(words) if each is not None), None)


def _shown(size: float) -> str:
    return f"{max(size, 0.0) / 1e9:.2g} GB"


def _status() -> dict[str, float]:
    """Ask the system what it knows of this process, in bytes."""
    facts = [line.split(":") for line in _lines(Path("/proc/self/status"))]
    return {name: 1024.0 * int(fact[0].split()[0]) for name, *fact in facts if name in _ASKED}


def _spare() -> float:
    """Find the memory, in bytes, left to the processes of this machine, or of this cgroup."""
    spare = [math.inf]
    for line in _lines(Path("/proc/meminfo")):
        if line.startswith("MemAvailable:"):
            spare.append(1024.0 * int(line.split()[1]))
    for line in _lines(Path("/proc/self/cgroup")):
        _, kinds, path = line.split(":", 2)
        if kinds and "memory" not in kinds.split(","):
            continue
        top = CGROUPS / kinds  # the first version has a tree for each kind, the second one for all
        names = ("limit_in_bytes", "usage_in_bytes") if kinds else ("max", "current")
        place = top / path.strip("/")
        for group in (place, *place.parents):
            if not group.is_relative_to(top):
                break
            limit, used = (_text(group / f"memory.{name}").strip() for name in names)
            if limit.isdigit() and used.isdigit():
                spare.append(int(limit) - int(used) + _cached(group))
    return min(spare)


def _cached(group: Path) -> int:
    """Ask what a cgroup's processes have read or written and would give back."""
    facts = dict(line.split() for line in _lines(group / "memory.stat"))
    return sum(
        int(facts.get(f"total_{name}", facts.get(name, 0)))
        for name in ("inactive_file", "active_file")
    )


def _lines(path: Path) -> list[str]:
    """Read the lines of a file of the system's; what programs are called may hold other ends."""
    return [line for line in _text(path).split("\n") if line]


def _text(path: Path) -> str:
    """Read a file of the system's, with names of any bytes; nothing where there is none."""
    try:
        return os.fsdecode(path.read_bytes())
    except OSError:
        return ""
