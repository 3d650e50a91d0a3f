"""The program's contact forces against the reference's."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from mpi4py import MPI
from reference import CONTACT, Cells, Data, Discrete, FloatArray, Found, gathered

from signorini_cr import Domain, NotConverged, Problem, Solution, solve_levels

EXACT = 1e-6
"""Largest error of the contact forces, relative, their sum and the sum of all facets' errors."""
NEAR = 1e-6
"""Error that transition points may have, in parts of the facet's length."""
NOTHING = 1e-12
"""Part of what forces are made of that counts as none where nothing touches."""
EPSILON = float(np.finfo(float).eps)
STANDING = 1e-9
"""Change of the forces by the reference's last refinement at most, relative."""


@dataclass(frozen=True)
class Verdict:
    """One run of the program against the reference.

    Attributes:
        refused: Whether the program said that it did not converge.
        error: Sum of the facets' errors over the sum of the forces.
        total: The same for the total force that the program reports.
        facets: Facets in another state than in the reference, degenerate ones left out.
        transitions: How far transition points are from the reference's, in parts of the facet's
            length; 0 where a facet is in another state, or degenerate.
        proper: Whether contact is on a part of Γ1, not all and not none.
        degenerate: Facets left out.
        steps: CG steps on each mesh.
        fault: What else went wrong, if anything.
    """

    refused: bool = False
    error: float = 0.0
    total: float = 0.0
    facets: int = 0
    transitions: float = 0.0
    proper: bool = False
    degenerate: int = 0
    steps: tuple[int, ...] = ()
    fault: str = ""

    @property
    def right(self) -> bool:
        """True if it is what the reference says."""
        apart = self.transitions > NEAR
        return not (self.refused or self.fault or self.facets or apart) and self.exact

    @property
    def exact(self) -> bool:
        """True if the forces are."""
        return self.error <= EXACT and self.total <= EXACT


def finest(
    problem: Problem, domain: Domain, levels: int, nested: bool
) -> tuple[Solution | None, tuple[int, ...]]:
    """The solution on the last mesh, None where the program refuses, and CG steps; collective."""
    solution, steps = None, []
    try:
        for solution in solve_levels(problem, domain, levels, nested=nested):
            steps.append(solution.iterations.linear)
    except NotConverged:
        return None, tuple(steps)
    return solution, tuple(steps)


def forces(solution: Solution) -> tuple[FloatArray, FloatArray] | None:
    """Force and state of all contact facets in the order of their numbers, on rank 0."""
    mesh, contact = solution.domain.mesh, solution.contact
    number = mesh.topology.index_map(1).local_to_global(contact.facets.astype(np.int32))
    rows = np.column_stack([number, contact.pressure * contact.measure, contact.active])
    together = mesh.comm.gather(rows)
    if together is None:
        return None
    rows = np.concatenate(together)
    rows = rows[np.argsort(rows[:, 0])]
    return rows[:, 1], rows[:, 2] > 0.5


class Judge:
    """A discrete problem whose reference is solved once for all runs on the same meshes.

    Attributes:
        data: The problem.
        bare: Whether errors are relative to the forces alone, however small these are, and no facet
            is left out.
    """

    def __init__(self, data: Data, bare: bool = False):
        self.data, self.bare = data, bare
        self._found: Found | None = None
        self._cells: Cells | None = None
        self._asked = False

    def twice(self) -> float:
        """Compute how far the reference is from itself started from the opposite set; rank 0."""
        assert self._cells is not None and self._found is not None
        other = Discrete(self._cells, self.data).solve(start=True)
        size = self._size(self._found)
        return float(abs(other.force - self._found.force).sum() / size)

    def verdict(self, solution: Solution | None, steps: tuple[int, ...], comm: MPI.Comm) -> Verdict:
        """Compare; collective, the same on all ranks."""
        if solution is None:
            return Verdict(refused=True, steps=steps)
        mine, total, verdict = forces(solution), solution.contact.force, None
        if not self._asked:
            self._asked, self._cells = True, gathered(solution.domain)
        if comm.rank == 0:
            try:
                assert mine is not None and self._cells is not None
                if self._found is None:
                    self._found = Discrete(self._cells, self.data).solve()
                points = solution.contact.transitions[:, :2]
                verdict = self._compare(*mine, total, points, steps)
            except Exception as error:  # the other ranks wait for a verdict
                verdict = Verdict(fault=f"{type(error).__name__}: {error}", steps=steps)
        answer: Verdict = comm.bcast(verdict)
        return answer

    def _compare(
        self,
        force: FloatArray,
        active: FloatArray,
        total: float,
        points: FloatArray,
        steps: tuple[int, ...],
    ) -> Verdict:
        found = self._found
        assert found is not None and self._cells is not None
        assert np.array_equal(found.facets, self._cells.parts[CONTACT])
        if found.change > STANDING:
            return Verdict(fault=f"the reference does not stand: {found.change:.0e}", steps=steps)
        size = self._size(found)
        differ = (active != found.active) & (self.bare | ~found.degenerate)
        return Verdict(
            error=float(abs(force - found.force).sum()) / size,
            total=abs(total - float(found.force.sum())) / size,
            facets=int(differ.sum()),
            transitions=0.0 if (active != found.active).any() else _apart(points, found),
            proper=0 < int(found.active.sum()) < len(found.active),
            degenerate=int(found.degenerate.sum()),
            steps=steps,
        )

    def _size(self, found: Found) -> float:
        """Return the scale of errors of the forces.

        Their sum; not less than what the rounding of data in double precision makes of them, unless
        the judgement is bare.
        """
        if self.bare:
            return max(float(found.force.sum()), 1e-300)
        if not found.active.any():
            return NOTHING * float(found.made_of.sum()) / EXACT
        rounding = 4 * EPSILON * float(found.made_of[found.active].sum())
        return max(float(found.force.sum()), rounding / EXACT)


def _apart(points: FloatArray, found: Found) -> float:
    """Compute how far points are from the reference's transitions; ∞ if their numbers differ."""
    expected, length = found.transitions
    if len(points) != len(expected):
        return np.inf
    if not len(points):
        return 0.0
    distance = np.linalg.norm(points[:, None] - expected[None], axis=2)
    nearest = distance.argmin(axis=0)
    if len(np.unique(nearest)) < len(points):
        return np.inf
    return float((distance.min(axis=0) / length).max())
