"""The dofs that the obstacle holds, for everyone who asks: all rules are here.

Of a solution all of them say the same, as gap · force = 0 with neither below 0: active is what a
force holds. Of what is none yet they differ, each for a reason. `ActiveSet.of` takes an iterate as
the reduced-space method does, on its bound and pushed, also where the gap is below 0; SNES decides
by it while it solves, and `ActiveSet.without` takes that over. The solution of a reduced system has
forces on active dofs and gaps on others alone: `ActiveSet.indicator` exchanges them as the
primal-dual method does, by force − A_ii gap > 0, and `ActiveSet.on_bounds` where that goes round in
circles. `touching` is for other fields' gaps and forces, where a gap may be all but 0. From dofs to
facets leads `contact_facts`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from ..arrays import BoolArray, FloatArray, Int32Array, found_in


def touching(gap: FloatArray, force: FloatArray, diagonal: FloatArray | float) -> BoolArray:
    """Tell where there is contact by the primal-dual criterion: A_ii (u − α)_i < (A u − b)_i > 0.

    That is for those who take a solution as they find it, as the certificate does. Its gap need not
    be exactly 0 where the solver held it, for α has been sampled anew, nor has it to be converged;
    but a gap that is nothing against the force is none. Where all gaps are 0 or less, and else for
    what a solver has finished, it says the same as `ActiveSet.of`.

    Args:
        gap: u − α, shape (n,).
        force: A u − b, shape (n,).
        diagonal: A's entries, shape (n,) or ().
    """
    return np.asarray(force > np.maximum(diagonal * gap, 0.0))


@dataclass(frozen=True, eq=False)
class ActiveSet:
    """The dofs on their bound that a force keeps there; nothing in it can be changed.

    Attributes:
        bounded: Owned dofs with a bound, local numbers, ascending, shape (n,).
        mask: Which of them are active, shape (n,).
    """

    bounded: Int32Array
    mask: BoolArray

    def __post_init__(self) -> None:
        """Close both for writing; the dofs are the caller's, too, who may write to theirs."""
        object.__setattr__(self, "bounded", self.bounded.view())
        for each in (self.bounded, self.mask):
            each.setflags(write=False)

    @classmethod
    def of(cls, bounded: Int32Array, gap: FloatArray | float, force: FloatArray) -> ActiveSet:
        """Apply the criterion of the reduced-space method: u_i ≤ α_i and (A u − b)_i > 0.

        Args:
            bounded: Owned dofs with a bound, local numbers, ascending, shape (n,).
            gap: u − α there, shape (n,) or ().
            force: A u − b there, shape (n,).
        """
        return cls(bounded, (gap <= 0.0) & (force > 0.0))

    @classmethod
    def none(cls, bounded: Int32Array) -> ActiveSet:
        """Take none of them."""
        return cls(bounded, np.zeros(len(bounded), dtype=bool))

    @classmethod
    def on_bounds(cls, bounded: Int32Array, gap: FloatArray, freed: int | None) -> ActiveSet:
        """Hold what is on its bound, whatever the force, as the primal method does.

        Args:
            bounded: Owned dofs with a bound, local numbers, ascending, shape (n,).
            gap: u − α there, shape (n,).
            freed: The place of one that is let go.
        """
        mask = gap <= 0.0
        if freed is not None:
            mask[freed] = False
        return cls(bounded, mask)

    @classmethod
    def without(
        cls, bounded: Int32Array, inactive: npt.NDArray[np.integer], first: int
    ) -> ActiveSet:
        """Take over what PETSc has decided.

        Args:
            bounded: Owned dofs with a bound, local numbers, ascending, shape (n,).
            inactive: All other owned dofs but the active ones, global numbers, ascending.
            first: Global number of the first owned dof.
        """
        # bounded dofs are few, and all others many
        numbers = bounded.astype(inactive.dtype) + inactive.dtype.type(first)
        return cls(bounded, ~found_in(inactive, numbers)[1])

    @property
    def dofs(self) -> Int32Array:
        """The active dofs, local numbers, ascending."""
        return self.bounded[self.mask]

    def indicator(self, force: FloatArray, gap: FloatArray) -> FloatArray:
        """Return forces on active dofs and minus gaps on others: what is above 0 is to be active.

        Args:
            force: A u − b in the bounded dofs, shape (n,).
            gap: u − α there, or A_ii times that, shape (n,).
        """
        return np.where(self.mask, force, -gap)

    def exchanged(self, force: FloatArray, gap: FloatArray) -> ActiveSet:
        """Return the set that the solution in this one asks for; see `indicator`."""
        return self.changed(self.indicator(force, gap))

    def changed(self, indicator: FloatArray) -> ActiveSet:
        """Return the set that an indicator asks for, shape (n,)."""
        return ActiveSet(self.bounded, indicator > 0.0)
