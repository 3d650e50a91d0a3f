"""The rules by which dofs are active: one of solutions, and of what is none each its own."""

from __future__ import annotations

import numpy as np
import pytest

from signorini_cr.vi.active import ActiveSet, touching

BOUNDED = np.arange(4, dtype=np.int32)


def test_of_solutions_all_rules_say_the_same() -> None:
    """u ≥ α, A u − b ≥ 0, and one of them an equality; where both are, nothing is held."""
    gap, force = np.array([0.0, 0.0, 2.0, 3e-300]), np.array([5.0, 0.0, 0.0, 0.0])
    by_iterate = ActiveSet.of(BOUNDED, gap, force)
    assert by_iterate.mask.tolist() == [True, False, False, False]
    assert (touching(gap, force, 3.0) == by_iterate.mask).all()
    assert (by_iterate.exchanged(force, gap).mask == by_iterate.mask).all()
    assert (
        ActiveSet.of(BOUNDED, 0.0, force).exchanged(force, 3.0 * gap).mask == by_iterate.mask
    ).all()
    held = ActiveSet.on_bounds(BOUNDED, gap, freed=1)  # a force of 0 is its tie to break
    assert (held.mask == by_iterate.mask).all()


@pytest.mark.parametrize(
    "gap, force, by_iterate, by_touching",
    [
        (0.1, 1.0, False, True),  # a force beside which the gap is next to nothing
        (0.1, 0.1, False, False),
        (-1.0, -0.5, False, False),  # below the bound, and pulled: let go
        (-1.0, 0.5, True, True),
    ],
)
def test_where_there_is_no_solution_yet(
    gap: float, force: float, by_iterate: bool, by_touching: bool
) -> None:
    gaps, forces = np.full(4, gap), np.full(4, force)
    assert (ActiveSet.of(BOUNDED, gaps, forces).mask == by_iterate).all()
    assert (touching(gaps, forces, 1.0) == by_touching).all()


def test_a_reduced_system_exchanges_by_the_primal_dual_criterion() -> None:
    """Its solution has no gap where it is active, and no force elsewhere: force − A_ii gap > 0."""
    active = ActiveSet(BOUNDED, np.array([True, True, False, False]))
    gap, force = np.array([0.0, 0.0, 0.5, -0.5]), np.array([1.0, -1.0, 0.0, 0.0])
    for diagonal in (1.0, 1e6):
        wanted = force - diagonal * gap > 0.0
        assert (active.exchanged(force, diagonal * gap).mask == wanted).all()
