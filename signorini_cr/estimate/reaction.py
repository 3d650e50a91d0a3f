"""The term c u of the equation, as the certificate takes it: on the side of f, and of u_h."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from mpi4py import MPI

from ..arrays import FloatArray
from ..data.diffusion import DiffusionOnMesh
from ..data.loads import Certain, VolumeMoments, reacts
from ..data.quadrature import Coefficient

UNKNOWN = "the reaction is not known to be bounded, and 0 or more, on each cell"


@dataclass(frozen=True, eq=False)
class Reaction:
    """c, which is a number on each cell, or known by its bounds there.

    Attributes:
        low: c, or a lower bound of it, shape (cells,) or ().
        high: The same object, or an upper bound.
        data: The problem's data on the mesh.
        reason: Why there is no certificate, on all ranks; or None.
    """

    low: FloatArray
    high: FloatArray
    data: DiffusionOnMesh
    reason: str | None

    @classmethod
    def of(cls, data: DiffusionOnMesh) -> Reaction:
        """Ask the data; collective."""
        (low, high), reason = data.reaction, None
        if low is not high:
            bounded = bool((low >= 0.0).all() and np.isfinite(high).all())
            reason = None if data.cells.comm.allreduce(bounded, op=MPI.LAND) else UNKNOWN
        return cls(low, high, data, reason)

    @property
    def varies(self) -> bool:
        """True if it may vary within cells."""
        return self.high is not self.low

    def rest(self, w: FloatArray) -> VolumeMoments:
        """Return the moments of f − c u_h by the scheme's own rule.

        Args:
            w: u_h at the cells' vertices, shape (d + 1, cells).
        """
        if self.varies:
            f, _ = self.data.reacting(w)
            return self.data.moments.with_source(VolumeMoments.of(f, self.data.cells))
        return self._less(self.data.load, w)

    def certain(
        self, w: FloatArray, kappa: Coefficient, size: float
    ) -> tuple[Certain, Certain | None]:
        """Enclose f − c u_h and, where c varies, the means of c u_h²; collective.

        Args:
            w: As in `rest`.
            kappa: The coefficient.
            size: About how large the bound will be.
        """
        data, cells, low = self.data, self.data.cells, kappa.bounds.low
        if not self.varies:
            found = Certain.of(data.compiled.f, data.of_f, cells, low, size, self.low)
            load = self._less(data.moments.with_source(found.load), w)
            return replace(found, load=load), None
        f, c_u2 = data.reacting(w)
        found = Certain.of(f, VolumeMoments.of(f, cells), cells, low, size, self.low)
        found = replace(found, load=data.moments.with_source(found.load))
        goal = size**2 / np.sqrt(kappa.smallest)  # as it is a part of J
        moments = VolumeMoments.of(c_u2, cells)
        return found, Certain.of(c_u2, moments, cells, low, goal, self.low, norms=False)

    def _less(self, load: VolumeMoments, w: FloatArray) -> VolumeMoments:
        return load.less(self.low, w) if reacts(self.low) else load
