"""The integrals that a certificate is made of, as totals and by cell."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

from ..arrays import FloatArray
from ..fem.cells import Cells


@dataclass(eq=False)
class Sums:
    """Totals over this rank's cells.

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
        energy: ½∫ κ|∇v|² + c v² − ∫ f v.
        energy_slack: How far this may be from the truth.
        neumann: The part of load that comes from g alone.
        indicators: The cells' shares of ‖p‖² + ‖b‖² + ‖κ^{-1/2}σ‖², shape (cells,).
        steepness: ∫_T κ|∇v|², shape (cells,).
        middle: Bounds of ∫_T |p + κ^{-1/2}σ + b|², shape (cells,).
        across: The same of ∫_T |p + κ^{-1/2}σ − b|².
        zeroth: What the terms without gradients add to the cells' shares, shape (cells,); None
            where there are none.
        apart: c‖v − u_h‖²_T, shape (cells,); or None.
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
    indicators: FloatArray | None = None
    steepness: FloatArray | None = None
    middle: FloatArray | None = None
    across: FloatArray | None = None
    zeroth: FloatArray | None = None
    apart: FloatArray | None = None

    def over_ranks(self, cells: Cells) -> Sums:
        """The totals over all ranks' cells; collective."""
        names = [field.name for field in fields(self) if field.type == "float"]
        total, found = replace(self), cells.total(*(getattr(self, name) for name in names))
        for name, value in zip(names, found, strict=True):
            setattr(total, name, float(value))
        return total
