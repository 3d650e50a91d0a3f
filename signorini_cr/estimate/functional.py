"""The functional that the conforming function v is to make small, with its slopes.

E = ‖κ^{1/2}(∇v − ∇u_h)‖² + c‖v − u_h‖² + b‖v − t/b‖², the last over facets that lose heat. A
function of degree 2 is given by its values at the vertices and the heights of its bumps
b_F = 4 λ_j λ_k over the straight line through them, on each cell relative to u_h.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..arrays import BoolArray, FloatArray, IndexArray
from ..data.loads import reacts
from ..fem.cells import BoundaryFacets, Cells, blocks, dot_rows, measures, pick, sum_rows


@dataclass(frozen=True, eq=False)
class Masses:
    """Terms of E without gradients: c‖v − u_h‖² on cells, b‖v − t/b‖² on facets.

    Attributes:
        some: Whether there is a c or a b, here or on other ranks.
        reaction: c, shape (cells,) or ().
        side: Facets with a b.
        loss: b |F| there, shape (n,).
        toward: t/b − u_h there, at the ends and the height of a bump, shape (d + 1, n).
        strong: Where b takes up what g has beyond its mean, and t/b is nearer to u than u_h is.
    """

    some: bool
    reaction: FloatArray
    side: BoundaryFacets
    loss: FloatArray
    toward: FloatArray
    strong: BoolArray

    @property
    def reacts(self) -> bool:
        """True if there is a c; the same on all ranks."""
        return reacts(self.reaction)

    def on_cells(self, cells: Cells, block: slice | IndexArray) -> FloatArray:
        """Return c|T|, shape (n,)."""
        return np.asarray(pick(self.reaction, block) * cells.volume[block])

    def largest(self, cells: Cells, side: BoundaryFacets) -> float:
        """Return the largest b, nearly, on some facets of all ranks; collective."""
        here = np.isin(self.side.dofs, side.dofs)
        found = (self.loss / measures(cells, self.side))[here].max(initial=0.0)
        return max(cells.comm.allgather(float(found)))

    def fall(
        self, cells: Cells, excess: FloatArray, height: FloatArray, block: slice | IndexArray
    ) -> tuple[FloatArray, FloatArray]:
        """Compute how fast c‖v − u_h‖² falls, as `Slopes`, from both on cells, shapes (3, n)."""
        mass, whole, humps = self.on_cells(cells, block), sum_rows(excess), sum_rows(height)
        at_vertices = (whole + excess) / 12.0 + (2.0 * humps - height) / 15.0
        at_facets = (2.0 * whole - excess) / 15.0 + 4.0 / 45.0 * (humps + height)
        return -mass * at_vertices, -mass * at_facets

    def fall_on_facets(
        self, cells: Cells, excess: FloatArray, bumps: FloatArray, which: slice | IndexArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Compute how fast b‖v − t/b‖² falls, by v's ends and the height, and what it is.

        Args:
            cells: The mesh.
            excess: v − u_h at the cells' vertices without the bumps, shape (3, cells).
            bumps: Heights by facet dof.
            which: Which of the facets with a b.

        Returns:
            Shapes (2, n), (n,) and (n,).
        """
        side, loss, toward = self.side, self.loss[which], self.toward[:, which]
        local, at = side.local[which], side.cells[which]
        ends = excess[cells.others[local].T, at] - toward[:2]
        height, both = bumps[side.dofs[which]] - toward[2], ends.sum(axis=0)
        at_ends = -loss * ((both + ends) / 6.0 + height / 3.0)
        at_middle = -loss * (both / 3.0 + 8.0 / 15.0 * height)
        energy = -dot_rows(ends, at_ends) - height * at_middle
        return at_ends, at_middle, np.asarray(energy)


@dataclass(frozen=True, eq=False)
class Functional:
    """The functional that v is to make small: E = ‖κ^{1/2}(∇v − ∇u_h)‖² and masses.

    Attributes:
        cells: The mesh.
        w: u_h at the cells' vertices, shape (d + 1, cells).
        kappa: Mean of κ, shape (cells,) or ().
        steady: Where κ is constant on the cell, and c, too, and not large, shape (cells,) or ().
        masses: What E has beside gradients.
    """

    cells: Cells
    w: FloatArray
    kappa: FloatArray
    steady: BoolArray
    masses: Masses

    def excess(self, v: FloatArray) -> FloatArray:
        """Return v − u_h at the cells' vertices from v at the vertices, shape (d + 1, cells)."""
        out = np.empty_like(self.w)
        for block in blocks(self.cells.number):
            np.subtract(v[self.cells.vertices[:, block]], self.w[:, block], out=out[:, block])
        return out


@dataclass(frozen=True, eq=False)
class Slopes:
    """Rates at which E falls, cell by cell.

    Attributes:
        vertices: −½ ∂E by v's values at the vertices with the bumps kept, shape (d + 1, cells).
        facets: −½ ∂E by the heights of the bumps, shape (d + 1, cells).
        energies: The cells' shares of E, shape (cells,).
    """

    vertices: FloatArray
    facets: FloatArray
    energies: FloatArray

    @classmethod
    def of(cls, functional: Functional, excess: FloatArray, bumps: FloatArray) -> Slopes:
        """Compute them.

        Args:
            functional: E, d = 2.
            excess: v − u_h at the cells' vertices without the bumps, shape (d + 1, cells).
            bumps: Heights by facet dof.
        """
        rows = np.empty_like(excess), np.empty_like(excess)
        slopes = cls(*rows, np.empty(functional.cells.number))
        slopes.renew(functional, excess, bumps, slice(None))
        return slopes

    def renew(
        self,
        functional: Functional,
        excess: FloatArray,
        bumps: FloatArray,
        where: slice | IndexArray,
    ) -> None:
        """Compute them anew on some cells, or on all with ``slice(None)``; see `of`."""
        cells, kappa, masses = functional.cells, functional.kappa, functional.masses
        for block in blocks(cells.number) if isinstance(where, slice) else (where,):
            k, c, height = pick(kappa, block), excess[:, block], bumps[cells.facets[:, block]]
            rest = cells.trace(block) - 2.0 * cells.squares(block)
            at_vertices = -k * cells.apply(c - 4 / 3 * height, block)
            at_facets = 4 / 3 * k * (cells.apply(c - 2.0 * height, block) - rest * height)
            if masses.reacts:
                more = masses.fall(cells, c, height, block)
                at_vertices += more[0]
                at_facets += more[1]
            self.vertices[:, block], self.facets[:, block] = at_vertices, at_facets
            self.energies[block] = -dot_rows(c, at_vertices) - dot_rows(height, at_facets)
        which: slice | IndexArray = where
        if not isinstance(where, slice):
            which = np.flatnonzero(np.isin(masses.side.cells, where))
        at_ends, at_middle, energies = masses.fall_on_facets(cells, excess, bumps, which)
        local, at = masses.side.local[which], masses.side.cells[which]
        np.add.at(self.vertices, (cells.others[local].T, at), at_ends)
        np.add.at(self.facets, (local, at), at_middle)
        np.add.at(self.energies, at, energies)
