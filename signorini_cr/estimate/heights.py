"""Steps that improve the heights of v's bumps, and what more would be gained; d = 2."""

from __future__ import annotations

import numpy as np

from ..arrays import BoolArray, FloatArray, IndexArray
from ..fem.cells import BoundaryFacets, blocks, dot_rows, pick, sum_rows
from .descent import descend, nonzero
from .functional import Functional


def sweep(
    functional: Functional,
    excess: FloatArray,
    bumps: FloatArray,
    free_facets: BoolArray,
    bumped: tuple[BoundaryFacets, ...],
    steps: int,
) -> tuple[float, float]:
    """Make E smaller by conjugate gradients in the heights of the bumps; collective.

    Args:
        functional: E.
        excess: v − u_h at the cells' vertices without the bumps, shape (d + 1, cells).
        bumps: Heights, improved in place.
        free_facets: Which of them may be.
        bumped: The facets on which there are some to begin with.
        steps: How many steps.

    Returns:
        E, and what it would fall by if each height were put right as if it were alone.
    """
    cells, held = functional.cells, np.flatnonzero(~free_facets)
    matrix = _OfHeights(functional)
    energy, local = matrix.without_bumps(excess)
    energy += matrix.with_bumps(bumps, bumped, local)

    def assembled(local: FloatArray) -> FloatArray:
        out = cells.over_facets(local)
        out[held] = 0.0
        return out

    def image(way: FloatArray) -> FloatArray:
        matrix.multiply(way, local)
        return assembled(local)

    down = assembled(local)
    fall, square = descend(cells, image, bumps, down, matrix.diagonal(), steps)
    return float(cells.total(energy)[0] - 4 / 3 * fall), float(4 / 3 * square)


class _OfHeights:
    """E as a quadratic functional of the heights of bumps, in units of 4/3.

    On a cell its matrix is 2κ|T| ∇λ_i·∇λ_j outside the diagonal and κ|T| Σ|∇λ_k|² on it, and to
    each entry c|T|/15 is added, on the diagonal twice.

    Attributes:
        functional: E.
        own: κ|T| Σ|∇λ_k|² + c|T|/15, shape (cells,).
        lost: What b adds to the diagonal, by facet dof.
        at: Local numbers and cells of the facets with a b.
    """

    def __init__(self, functional: Functional):
        """Take what is on the diagonal."""
        cells, masses = functional.cells, functional.masses
        self.functional, self.own = functional, np.empty(cells.number)
        self.lost = np.zeros(len(cells.exterior))
        self.lost[masses.side.dofs] = 0.4 * masses.loss
        self.at = masses.side.local, masses.side.cells
        self._reacts = masses.reacts
        for block in blocks(cells.number):
            self.own[block] = pick(functional.kappa, block) * cells.trace(block)
            if self._reacts:
                self.own[block] += masses.on_cells(cells, block) / 15.0

    def without_bumps(self, excess: FloatArray) -> tuple[float, FloatArray]:
        """Return E for no bumps, this rank's share, and −½ its slope on each cell.

        Args:
            excess: v − u_h at the cells' vertices, shape (3, cells).
        """
        cells, kappa, masses = self.functional.cells, self.functional.kappa, self.functional.masses
        slope, energy = np.empty_like(excess), 0.0
        for block in blocks(cells.number):
            k = pick(kappa, block)
            np.multiply(k, cells.apply(excess[:, block], block), out=slope[:, block])
            energy += float(np.sum(dot_rows(excess[:, block], slope[:, block])))
            if self._reacts:
                flat = np.zeros_like(excess[:, block])
                at_vertices, at_facets = masses.fall(cells, excess[:, block], flat, block)
                energy -= float(np.sum(dot_rows(excess[:, block], at_vertices)))
                slope[:, block] += 0.75 * at_facets
        none = np.zeros(len(cells.exterior))
        _, at_middle, of_facets = masses.fall_on_facets(cells, excess, none, slice(None))
        np.add.at(slope, self.at, 0.75 * at_middle)
        return energy + float(np.sum(of_facets)), slope

    def with_bumps(
        self, bumps: FloatArray, bumped: tuple[BoundaryFacets, ...], slope: FloatArray
    ) -> float:
        """Return what E changes by with some bumps, this rank's share.

        Args:
            bumps: Heights by facet dof.
            bumped: The facets on which there are some.
            slope: −½ E's slope on each cell, shape (3, cells), changed in place.
        """
        cells, side = self.functional.cells, self.functional.masses.side
        near = np.unique(np.concatenate([each.cells for each in (*bumped, side)]))
        flow, height = slope[:, near], bumps[cells.facets[:, near]]
        change = self._times(height, near, np.empty_like(height))
        slope[:, near] = flow - change
        energy = -4 / 3 * float(np.sum(dot_rows(height, 2.0 * flow - change)))
        lost, height = self.lost[side.dofs], bumps[side.dofs]
        np.subtract.at(slope, self.at, lost * height)
        return energy + 4 / 3 * float(np.sum(lost * height**2))

    def multiply(self, heights: FloatArray, out: FloatArray) -> None:
        """Put the cells' matrices times heights by facet dof into an array, shape (3, cells)."""
        cells, side = self.functional.cells, self.functional.masses.side
        for block in blocks(cells.number):
            self._times(heights[cells.facets[:, block]], block, out[:, block])
        np.add.at(out, self.at, self.lost[side.dofs] * heights[side.dofs])

    def _times(self, height: FloatArray, block: slice | IndexArray, out: FloatArray) -> FloatArray:
        """Put the matrices, but for b, times heights of local bumps into an array."""
        cells, own = self.functional.cells, self.own[block]
        twice, stiffness = 2.0 * pick(self.functional.kappa, block), cells.stiffness[:, block]
        for i, (j, k) in enumerate(cells.others):
            row = np.multiply(stiffness[i + j - 1], height[j], out=out[i])
            row += stiffness[i + k - 1] * height[k]
            row *= twice
            row += own * height[i]
        if self._reacts:
            mass = self.functional.masses.on_cells(cells, block)
            out += mass / 15.0 * sum_rows(height)
        return out

    def diagonal(self) -> FloatArray:
        """Compute the diagonal by facet dof; collective."""
        cells = self.functional.cells
        local = np.tile(self.own, (3, 1))
        if self._reacts:
            local += self.functional.masses.on_cells(cells, slice(0, cells.number)) / 15.0
        np.add.at(local, self.at, self.lost[self.functional.masses.side.dofs])
        return nonzero(cells.over_facets(local))


def curvatures(functional: Functional) -> tuple[FloatArray, FloatArray]:
    """Return ½ ∂²E by single values at vertices and by single heights, ghosts included; collective.

    Args:
        functional: E.
    """
    return _of_vertices(functional), 4 / 3 * _OfHeights(functional).diagonal()


def _of_vertices(functional: Functional) -> FloatArray:
    """Return ½ ∂²E by values at vertices, ghosts included; collective."""
    cells, masses = functional.cells, functional.masses
    local = np.empty((3, cells.number))
    for block in blocks(cells.number):
        np.multiply(pick(functional.kappa, block), cells.squares(block), out=local[:, block])
        if masses.reacts:
            local[:, block] += masses.on_cells(cells, block) / 6.0
    ends = cells.others[masses.side.local].T, masses.side.cells
    np.add.at(local, ends, masses.loss / 3.0)
    return nonzero(cells.over_vertices(local))


def promise_of_vertices(
    functional: Functional, excess: FloatArray, bumps: FloatArray, free_vertices: BoolArray
) -> float:
    """Return what E would fall by if each vertex were put right alone.

    Args:
        functional: E.
        excess: v − u_h at the cells' vertices without the bumps, shape (d + 1, cells).
        bumps: Their heights.
        free_vertices: Which values at vertices may be changed.
    """
    cells, kappa, masses = functional.cells, functional.kappa, functional.masses
    slope = np.empty_like(excess)
    for block in blocks(cells.number):
        k, height = pick(kappa, block), bumps[cells.facets[:, block]]
        if masses.reacts:
            fall, _ = masses.fall(cells, excess[:, block], height, block)
        height *= -4 / 3
        height += excess[:, block]
        np.multiply(k, cells.apply(height, block), out=slope[:, block])
        if masses.reacts:
            slope[:, block] -= fall
    ends = cells.others[masses.side.local].T, masses.side.cells
    np.subtract.at(slope, ends, masses.fall_on_facets(cells, excess, bumps, slice(None))[0])
    owned = slice(cells.owned_vertices())
    down, weight = cells.over_vertices(slope)[owned], _of_vertices(functional)[owned]
    return float(cells.total(np.sum(down**2 * free_vertices[owned] / weight))[0])


def mean_square(c: FloatArray, height: FloatArray | None) -> FloatArray:
    """Compute means of (v − u_h)² over simplices of one, two or three dimensions, shape (n,).

    Args:
        c: v − u_h at the vertices, shape (k, n).
        height: Heights of v's bumps on triangles, shape (3, n), if there are any.
    """
    k, total = len(c), sum_rows(c)
    out = (total**2 + dot_rows(c, c)) / (k * (k + 1))
    if height is not None:
        whole = sum_rows(height)
        out += (4.0 * total * whole - 2.0 * dot_rows(c, height)) / 15.0
        out += 4.0 * (whole**2 + dot_rows(height, height)) / 45.0
    return np.asarray(out)
