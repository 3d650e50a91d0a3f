"""Limits of time and memory: another level or step fits or not, by those before."""

from __future__ import annotations

import time
from typing import NamedTuple

from mpi4py import MPI

from .errors import NotConverged, insist_on_kind, insist_on_number
from .memory import most_memory, shortage
from .mesh.domain import Domain
from .restart import Restart
from .vi.solved import Solved

BYTES = 800.0
"""Peak memory that a dof more takes, with all coarser meshes and the certificate."""
DOFS_APART = 20_000
"""Dofs that two levels must be apart for their peaks to tell more than that."""


class _Taken(NamedTuple):
    """Cost of a level: its dofs, seconds, and the most bytes this rank has held until its end."""

    dofs: int
    seconds: float
    peak: float


class Limits:
    """Limits of time and memory for the levels of a sequence.

    Args:
        max_time: Wall time in seconds from now on, None for any.
    """

    def __init__(self, max_time: float | None = None):
        """Begin to count.

        Raises:
            InputError: That is no time.
        """
        if max_time is not None:
            max_time = insist_on_number("max_time", max_time, 0.0, strict=True)
        self._max_time = max_time
        self._began = time.perf_counter()
        self._passed = 0.0
        self._before: _Taken | None = None

    def begin(self, domain: Domain, element: str, restart: Restart | None, levels: int = 1) -> None:
        """Look whether memory holds the first level to be solved; collective.

        Args:
            domain: The coarsest mesh.
            element: "CR" or "P1".
            restart: Where to go on, if it is not the coarsest mesh.
            levels: The mesh that is solved on first, counted from 1; with CR.

        Raises:
            NotConverged: It does not.
            InputError: There is something else in the place of `restart`.
        """
        comm, topology, number = domain.mesh.comm, domain.mesh.topology, levels - 1
        dofs = topology.index_map(0 if element == "P1" else topology.dim - 1).size_global
        for k in range(levels - 1):  # the halves of all facets, and three in each triangle
            dofs = 2 * dofs + 3 * 4**k * topology.index_map(topology.dim).size_global
        if restart is not None:
            insist_on_kind("restart", restart, Restart, "a Restart")
            number, dofs = len(restart.added), comm.bcast(restart.u[0][1].size)
        _refuse(number, dofs, shortage(comm, BYTES * dofs / comm.size))

    def admit(self, solution: Solved, dofs: int, runs: float = 1.0) -> None:
        """Look, when a level is done, whether the next one fits; collective.

        Time and peak memory are taken to grow with the dofs as between the last two levels, time
        not to fall and memory not to grow more slowly than usual.

        Args:
            solution: Of the level that is done.
            dofs: Of the next one.
            runs: How many times as long as the next one all takes that is left.

        Raises:
            NotConverged: It does not; the message has the figures.
        """
        comm, dofmap = solution.domain.mesh.comm, solution.u.function_space.dofmap
        n = dofmap.index_map.size_global * dofmap.index_map_bs
        passed = comm.allreduce(time.perf_counter() - self._began, op=MPI.MAX)
        last = _Taken(n, passed - self._passed, most_memory())
        before = self._before or last
        self._before, self._passed = last, passed
        more, grown = dofs - n, max(n - before.dofs, 1)
        seconds = runs * (last.seconds + max(last.seconds - before.seconds, 0.0) * more / grown)
        growth = BYTES * dofmap.index_map.size_local * dofmap.index_map_bs / n
        if grown >= DOFS_APART:
            growth = max(growth, (last.peak - before.peak) / grown)
        words = shortage(comm, growth * more)
        left = self._left(comm)
        if left is not None and seconds > left:
            words = _words(seconds, left)
        _refuse(solution.level.number + 1, dofs, words)

    def admit_step(self, comm: MPI.Comm) -> None:
        """Look, when a step in time is done, whether there is time for another one; collective.

        The first one tells nothing of the next, as it has set all up.

        Raises:
            NotConverged: There is not.
        """
        passed = comm.allreduce(time.perf_counter() - self._began, op=MPI.MAX)
        seconds, self._passed = passed - (self._passed or passed), passed
        left = self._left(comm)
        if left is not None and left <= 0.0:
            raise NotConverged("the time limit, max_time, is over")
        if left is not None and seconds > left:
            raise NotConverged(f"it would take about {_words(seconds, left)}")

    def _left(self, comm: MPI.Comm) -> float | None:
        """Find the time left when `_passed` was set; ranks may have begun apart; collective."""
        if self._max_time is None:
            return None
        return float(comm.allreduce(self._max_time, op=MPI.MIN)) - self._passed


def _words(seconds: float, left: float) -> str:
    """Say what is asked for, and what there is."""
    return f"{seconds:.2g} s, and of the time limit there are {max(left, 0.0):.2g} s left"


def _refuse(number: int, dofs: int, words: str | None) -> None:
    """Raise NotConverged if a level would take too much of something."""
    if words is not None:
        raise NotConverged(f"its {dofs} degrees of freedom would take about {words}", number)
