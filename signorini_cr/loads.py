"""The loads f and g as moments: their share of χ (1.10), and how far they are from their means."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from .cells import Cells, blocks, measures, poincare
from .domain import NEUMANN
from .moments import Trace, Volume

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.intp]


class Load:
    """f as the certificate sees it: a few moments on each cell.

    Attributes:
        mean: f_T, the mean of f, shape (cells,).
        hats: Means of (f − f_T) λ_i, shape (d + 1, cells); None where f is constant on each cell.
        bumps: Means of (f − f_T) b_i, shape (d + 1, cells), b_i as in `Rule`; or None.
        variance: Means of (f − f_T)², shape (cells,); or None.
        vanishes: Whether f is the number 0; the same on all ranks, also on those without cells.
    """

    def __init__(
        self,
        mean: FloatArray,
        rows: FloatArray | None,
        variance: FloatArray | None,
        vanishes: bool = False,
    ):
        """Take the moments; the rows are those of hats and bumps."""
        self.mean, self.variance, self.vanishes = mean, variance, vanishes
        half = 0 if rows is None else len(rows) // 2
        self.hats = None if rows is None else rows[:half]
        self.bumps = None if rows is None else rows[half:]

    def shares(self, cells: Cells, part: slice) -> FloatArray:
        """∫_T f ψ_i for the Crouzeix-Raviart functions ψ_i = 1 − d λ_i, shape (d + 1, n)."""
        d = cells.tdim
        out = np.empty((d + 1, part.stop - part.start))
        out[:] = self.mean[part] / (d + 1)
        if self.hats is not None:
            out -= d * self.hats[:, part]
        out *= cells.volume[part]
        return out

    @classmethod
    def of(cls, f: Volume, cells: Cells) -> Load:
        """Integrate f."""
        n, rule = cells.number, f.rule
        if f.number is not None:
            return cls(np.full(n, f.number), None, None, f.number == 0.0)
        values = f.at(cells)
        mean, variance = np.empty(n), np.empty(n)
        tests = np.concatenate(
            [
                (rule.hats - (rule.hats @ rule.weights)[:, None]) * rule.weights,
                (rule.bumps - (rule.bumps @ rule.weights)[:, None]) * rule.weights,
            ]
        )
        rows = np.empty((len(tests), n))
        for part in blocks(n):
            here = values[part]
            mean[part] = here @ rule.weights
            rows[:, part] = tests @ here.T
            with np.errstate(over="ignore"):  # such data are refused where the load is known
                variance[part] = (here - mean[part, None]) ** 2 @ rule.weights
        return cls(mean, rows, variance)


class Edge:
    """What is needed of g on Γg.

    Attributes:
        side: The facets.
        measure: |F|, shape (n,).
        values: g at the quadrature points, shape (q, n).
        shares: ∫_F g λ_j for the facet's ends j, shape (d, n).
    """

    def __init__(self, g: Trace, cells: Cells):
        """Evaluate g."""
        self.g, self._cells = g, cells
        self.side = cells.sides[NEUMANN]
        _, _, self.values = g.at(cells.domain.mesh, self.side.entities)
        self.measure = measures(cells, self.side)
        self.shares = self.measure * (g.hats.T * g.weights @ self.values)

    def to_cells(self) -> FloatArray:
        """∫_F g ψ_i for the Crouzeix-Raviart functions of the facet's cell, shape (d + 1, n).

        ψ_i = 1 − d λ_i; on the facet itself λ_i = 0.
        """
        d = self._cells.tdim
        out = np.tile(self.shares.sum(axis=0), (d + 1, 1))
        at = np.arange(len(self.measure))
        for j, share in zip(self._cells.others[self.side.local].T, self.shares, strict=True):
            out[j, at] -= d * share
        return out

    @property
    def rest(self) -> FloatArray:
        """What g has beyond its mean, at the quadrature points, shape (q, n)."""
        return self.values - self.g.weights @ self.values

    def oscillation(self) -> tuple[IntArray, FloatArray]:
        """Cells at Γg and Σ_F c_F ‖g − g_F‖_F for each, where ‖e − e_T‖_F ≤ c_F ‖∇e‖_T."""
        cells, side, d = self._cells, self.side, self._cells.tdim
        at, place = np.unique(side.cells, return_inverse=True)
        h = np.sqrt(cells.diameter2[side.cells])
        # |F|⁻¹ ∫_F w² = |T|⁻¹ (∫_T w² + (2/d) ∫_T w (x − P)·∇w), P opposite F
        c = poincare(d) * h
        trace = self.measure / cells.volume[side.cells] * c * (c + 2.0 * h / d)
        norms = np.sqrt(trace * self.measure * (self.g.weights @ self.rest**2))
        sizes: FloatArray = np.bincount(place, norms, minlength=len(at)).astype(np.float64)
        return at, sizes


def chi(load: Load, edge: Edge, cells: Cells) -> FloatArray:
    """χ (1.10) by facet dof for the Crouzeix-Raviart element, this rank's cells' share."""
    if load.vanishes and edge.g.vanishes:
        return np.zeros(len(cells.exterior))
    values = np.empty((cells.tdim + 1, cells.number))
    for part in blocks(cells.number):
        values[:, part] = load.shares(cells, part)
    for row, share in zip(values, edge.to_cells(), strict=True):
        np.add.at(row, edge.side.cells, share)
    return cells.over_facets(values, shared=False)
