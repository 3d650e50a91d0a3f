"""Which dofs the obstacle holds: decided by one criterion, here, for everyone who asks."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

IntArray = npt.NDArray[np.int32]
FloatArray = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class ActiveSet:
    """The dofs on their bound that a force keeps there; nothing in it can be changed.

    Attributes:
        bounded: Owned dofs with a bound, local numbers, ascending, shape (n,).
        mask: Which of them are active, shape (n,).
    """

    bounded: IntArray
    mask: npt.NDArray[np.bool_]

    def __post_init__(self) -> None:
        """Close the mask for writing."""
        self.mask.setflags(write=False)

    @classmethod
    def of(cls, bounded: IntArray, gap: FloatArray | float, force: FloatArray) -> ActiveSet:
        """Apply the criterion of the reduced-space method: u_i ≤ α_i and (A u − b)_i > 0.

        Args:
            bounded: Owned dofs with a bound, local numbers, ascending, shape (n,).
            gap: u − α there, shape (n,) or ().
            force: A u − b there, shape (n,).
        """
        return cls(bounded, (gap <= 0.0) & (force > 0.0))

    @classmethod
    def without(cls, bounded: IntArray, inactive: npt.NDArray[np.integer], size: int) -> ActiveSet:
        """Take over what PETSc has decided.

        Args:
            bounded: Owned dofs with a bound, local numbers, ascending, shape (n,).
            inactive: All other owned dofs but the active ones, local numbers.
            size: Number of owned dofs.
        """
        outside = np.ones(size, dtype=bool)
        outside[inactive] = False
        return cls(bounded, outside[bounded])

    @property
    def dofs(self) -> IntArray:
        """The active dofs, local numbers, ascending."""
        return self.bounded[self.mask]
