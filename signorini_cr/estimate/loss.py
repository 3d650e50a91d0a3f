"""The term b u of boundary conditions, as the certificate takes it: beside g, and of u_h."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from mpi4py import MPI

from ..arrays import FloatArray
from ..data.diffusion import DiffusionOnMesh
from ..data.loads import Known, Segments
from ..data.quadrature import Coefficient
from .sums import INTEGRAL_ROUNDING

UNKNOWN = "{}: its coefficient is not known to be bounded, and 0 or more, on each facet"


@dataclass(frozen=True, eq=False)
class Loss:
    """b, which is a number on each facet, or known by its bounds there.

    Attributes:
        data: The problem's data on the mesh.
        reason: Why there is no certificate, on all ranks; or None.
    """

    data: DiffusionOnMesh
    reason: str | None

    @classmethod
    def of(cls, data: DiffusionOnMesh) -> Loss:
        """Ask the data; collective."""
        reason = None
        for condition, edge in zip(data.forms.natural, data.edges, strict=True):
            if edge.varies:
                bounded = bool((edge.loss >= 0.0).all() and np.isfinite(edge.most).all())
                if not data.cells.comm.allreduce(bounded, op=MPI.LAND):
                    reason = reason or UNKNOWN.format(condition.part)
        return cls(data, reason)

    @property
    def varies(self) -> bool:
        """True if it may vary within facets."""
        return any(edge.varies for edge in self.data.edges)

    def known(self, w: FloatArray) -> Known:
        """Return the integrals of g − b u_h by the scheme's own rule.

        Args:
            w: u_h at the cells' vertices, shape (d + 1, cells).
        """
        return Known.of(self.data.losing(w)[0], self.data.cells, w)

    def certain(
        self, w: FloatArray, kappa: Coefficient, size: float
    ) -> tuple[Segments, tuple[Segments, ...]]:
        """Enclose g − b u_h and, where b varies, the integrals of b u_h²; collective.

        Args:
            w: As in `known`.
            kappa: The coefficient.
            size: About how large the bound will be.
        """
        cells = self.data.cells
        edges, squares = self.data.losing(w)
        goal = size**2 / np.sqrt(kappa.smallest)  # as they are a part of J
        return Segments.joined(edges, cells, w, kappa.bounds.low, size), tuple(
            Segments.of(each, cells, kappa.bounds.low, goal, norms=False) for each in squares
        )


def half(squares: Sequence[Segments]) -> tuple[float, float]:
    """Compute ½∫ b u_h² by what `Loss.certain` gives, and bound the error; this rank's share."""
    value, off = 0.0, 0.0
    for each in squares:
        value += 0.5 * float(np.sum(each.through))
        off += 0.5 * float(np.sum(each.missed + INTEGRAL_ROUNDING * np.abs(each.through)))
    return value, off
