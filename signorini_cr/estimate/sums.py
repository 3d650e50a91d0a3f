"""The integrals that a certificate is made of, as totals and by cell."""

from __future__ import annotations

from dataclasses import astuple, dataclass, field

import numpy as np

from ..arrays import FloatArray
from ..fem.cells import Cells

INTEGRAL_ROUNDING = 1e-14
"""Rounding of an integral, in parts of that of the absolute value."""


@dataclass(eq=False)
class Totals:
    """Sums over cells: of this rank, or of all.

    Attributes:
        flux: ‖p‖².
        companion: ‖b‖².
        cross: ∫ p·b.
        far: How far ‖p − b‖² may be above its value by quadrature.
        near: The same of ‖p + b‖².
        load: Bound of ‖κ^{-1/2}σ‖².
        load_flux: ∫ κ^{-1/2}σ·p.
        load_companion: ∫ κ^{-1/2}σ·b.
        slack: How far load_flux may be from the truth.
        energy: J(v) without ℓ: ½∫ κ|∇v|² + c v² − ∫ f v, and likewise on facets.
        energy_slack: How far this may be from the truth.
        neumann: The part of load that comes from g alone.
        loose: Square of what g has beyond its means, where it does not count as load.
        contact: The contact term.
        lift: ‖κ^{1/2}∇ℓ‖², terms without gradients included.
        lift_far: What ‖p − b‖² grows by with ℓ.
        lift_near: The same of ‖p + b‖².
        of_gradients: Bound of ‖κ^{-1/2}(p + κ^{-1/2}σ + b)‖².
        steepness: ∫ κ|∇v|².
    """

    flux: float = 0.0
    companion: float = 0.0
    cross: float = 0.0
    far: float = 0.0
    near: float = 0.0
    load: float = 0.0
    load_flux: float = 0.0
    load_companion: float = 0.0
    slack: float = 0.0
    energy: float = 0.0
    energy_slack: float = 0.0
    neumann: float = 0.0
    loose: float = 0.0
    contact: float = 0.0
    lift: float = 0.0
    lift_far: float = 0.0
    lift_near: float = 0.0
    of_gradients: float = 0.0
    steepness: float = 0.0

    def over_ranks(self, cells: Cells) -> Totals:
        """Add up the same over all ranks' cells; collective."""
        return Totals(*(float(value) for value in cells.total(*astuple(self))))


@dataclass(eq=False)
class Sums:
    """Shares of this rank's cells in the duality gap, each for itself and all together.

    Attributes:
        indicators: The cells' shares of ‖p‖² + ‖b‖² + ‖κ^{-1/2}σ‖², shape (cells,).
        steepness: ∫_T κ|∇v|², shape (cells,).
        middle: Bounds of ∫_T |p + κ^{-1/2}σ + b|², shape (cells,).
        across: The same of ∫_T |p + κ^{-1/2}σ − b|².
        zeroth: What the terms without gradients add to the cells' shares, shape (cells,); None
            where there are none.
        apart: c‖v − u_h‖²_T, shape (cells,); or None.
        fields: ∫_T |p + b|², how far that may be off, and what p and b have of the cells' shares,
            shape (3, cells); None where no κ is another one on strips along the cells' sides.
        totals: All cells' together.
    """

    indicators: FloatArray
    steepness: FloatArray
    middle: FloatArray
    across: FloatArray
    zeroth: FloatArray | None = None
    apart: FloatArray | None = None
    fields: FloatArray | None = None
    totals: Totals = field(default_factory=Totals)

    @classmethod
    def empty(cls, cells: int, reacts: bool) -> Sums:
        """Make room for what comes range by range of cells.

        Args:
            cells: How many cells there are.
            reacts: Whether there are terms without gradients.
        """
        sums = cls(*np.empty((4, cells)))
        if reacts:
            sums.zeroth, sums.apart = np.zeros((2, cells))
        return sums
