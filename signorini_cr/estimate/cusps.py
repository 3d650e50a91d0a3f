"""Functions with a point: what v takes at vertices where no polynomial comes near to u.

Where four coefficients meet, u may behave like r^{1/10}, and most of the error sits in the cells
around one vertex z. On the two cells of a facet with the ends z and j, and with t = 1 − λ_z,

    ψ = (t^{s−1} − 1) λ_j,   0 < s < 1,

is continuous, vanishes at z, on all other facets and elsewhere, and is t^s − t on the facet itself.
v gets such functions for two s and all inner facets that end in z; the coefficients come from a
small system for each z. With t = τ^{1/s} all integrands on a cell are polynomials in τ and in the
coordinate along the side opposite z: Gauss's rule is exact for them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from .. import compat
from ..arrays import BoolArray, FloatArray, IndexArray, Int64Array
from ..data.loads import VolumeMoments
from ..fem.cells import Cells, pick, poincare, sum_rows
from .flux import Flux
from .sums import Sums

EXPONENTS = (0.5, 0.25)
"""s. Both with t = τ⁴ make polynomials of τ, of degree 15 or less with their weights."""

HOLDS = 0.1
"""Part of ‖κ^{1/2}(∇v − ∇u_h)‖² that the cells around a vertex hold if it is to get a cusp."""


class _Share(NamedTuple):
    """A cell's share of the system around a vertex.

    Attributes:
        facets: Global numbers of the two facets that its functions belong to, −1 on the boundary.
        matrix: For the functions of the one and then the other, shape (functions, functions).
        right: Right-hand side, shape (functions,).
    """

    facets: list[int]
    matrix: FloatArray
    right: FloatArray


def _solved(around: Sequence[_Share]) -> dict[int, FloatArray]:
    """Solve the system around a vertex, in least squares; the coefficients by facet."""
    facets = sorted({facet for share in around for facet in share.facets if facet >= 0})
    # what belongs to the boundary, which has no such functions, goes behind all that is solved for
    number = {facet: i for i, facet in enumerate(facets)} | {-1: len(facets)}
    count = len(EXPONENTS)
    size = count * len(facets)
    matrix, right = np.zeros(2 * (size + count,)), np.zeros(size + count)
    for share in around:
        rows = np.concatenate([count * number[facet] + np.arange(count) for facet in share.facets])
        np.add.at(matrix, np.ix_(rows, rows), share.matrix)
        np.add.at(right, rows, share.right)
    found = np.linalg.lstsq(matrix[:size, :size], right[:size], rcond=None)[0]
    return dict(zip(facets, found.reshape(-1, count), strict=True))


@dataclass(eq=False)
class Cusps:
    """The cells around some vertices, no two of them neighbours, and ψ there.

    Attributes:
        at: Cells of this rank with such a vertex, shape (n,).
        apex: Its number in the cell, shape (n,).
        kappa: κ on the cell, shape (n,).
        names: Global numbers of the vertex, shape (n,), and of the cells' facets, −1 for those on
            the boundary, shape (d + 1, n).
        weights: Of the quadrature points, adding up to 1, shape (q,).
        hats: λ_i at the points, shape (q, d + 1, n).
        slopes: ∇ψ = Σ_i γ_i ∇λ_i: γ for each of the functions, shape (functions, q, d + 1, n).
        values: The functions themselves, shape (functions, q, n).
        heights: Their coefficients, shape (functions, n).
    """

    at: IndexArray
    apex: IndexArray
    kappa: FloatArray
    names: tuple[Int64Array, Int64Array]
    weights: FloatArray
    hats: FloatArray
    slopes: FloatArray
    values: FloatArray
    heights: FloatArray

    @classmethod
    def of(
        cls, cells: Cells, kappa: FloatArray, steady: BoolArray, energies: FloatArray
    ) -> Cusps | None:
        """Look for the vertices; collective.

        Args:
            cells: The mesh, d = 2.
            kappa: Mean of κ, shape (cells,) or ().
            steady: Where κ is constant on the cell, and c, shape (cells,) or ().
            energies: The cells' shares of E, shape (cells,).

        Returns:
            None if there is no such vertex on any rank.
        """
        chosen = _vertices(cells, np.broadcast_to(steady, energies.shape), energies)
        if chosen is None:
            return None
        there = chosen[cells.vertices]
        at = np.flatnonzero(there.any(axis=0))
        apex = np.argmax(there[:, at], axis=0)
        vertex_map, facet_map = cells.domain.mesh.topology.index_map(0), cells.V.dofmap.index_map
        facets = cells.facets[:, at]
        name = facet_map.local_to_global(facets.ravel().astype(np.int32)).reshape(facets.shape)
        t, along, weights = _rule()
        n, row = len(at), np.arange(len(at))
        hats = np.empty((len(t), cells.tdim + 1, n))
        first, second = cells.others[apex].T
        hats[:, apex, row] = (1.0 - t)[:, None]
        hats[:, first, row] = (t * (1.0 - along))[:, None]
        hats[:, second, row] = (t * along)[:, None]
        slopes = np.zeros((2 * len(EXPONENTS), *hats.shape))
        values = np.zeros((len(slopes), len(t), n))
        for i, (end, s) in enumerate((end, s) for end in (first, second) for s in EXPONENTS):
            bend = (t ** (s - 1.0) - 1.0)[:, None]
            slopes[i][:, end, row] = bend
            slopes[i][:, apex, row] = (1.0 - s) * t[:, None] ** (s - 2.0) * hats[:, end, row]
            values[i] = bend * hats[:, end, row]
        return cls(
            at,
            apex,
            np.broadcast_to(kappa, energies.shape)[at],
            (
                vertex_map.local_to_global(cells.vertices[apex, at].astype(np.int32)),
                np.where(cells.exterior[facets], -1, name),
            ),
            weights,
            hats,
            slopes,
            values,
            np.zeros((len(slopes), n)),
        )

    @property
    def slope(self) -> FloatArray:
        """γ of ψ as a whole, shape (q, d + 1, n)."""
        return np.einsum("fn,fqin->qin", self.heights, self.slopes)

    @property
    def value(self) -> FloatArray:
        """ψ as a whole, shape (q, n)."""
        return np.einsum("fn,fqn->qn", self.heights, self.values)

    @property
    def means(self) -> FloatArray:
        """Means of ψ over the cells, shape (n,)."""
        return np.asarray(self.weights @ self.value)

    @property
    def moments(self) -> FloatArray:
        """Means of ψ λ_i, shape (d + 1, n)."""
        return np.einsum("q,qn,qin->in", self.weights, self.value, self.hats)

    def fitted(self, cells: Cells, excess: FloatArray, bumps: FloatArray) -> Cusps:
        """Fit the heights so that ∇(v + ψ) is nearest to ∇u_h, v given; collective.

        Args:
            cells: The mesh.
            excess: v − u_h at the cells' vertices without the bumps, shape (d + 1, cells).
            bumps: Heights of v's bumps.
        """
        flows = np.stack([self._flow(cells, slope) for slope in self.slopes])
        matrices = np.einsum("q,fqin,gqin->nfg", self.weights, self.slopes, flows)
        right = -np.einsum("q,qin,fqin->nf", self.weights, self.before(cells, excess, bumps), flows)
        # The function of the facet from the apex to an end belongs to the facet opposite the other
        number = self.names[1][cells.others[self.apex].T[::-1], np.arange(len(self.at))]
        vertices = [int(name) for name in self.names[0]]
        facets = [[int(name) for name in pair] for pair in number.T]
        mine = list(zip(vertices, facets, matrices, right, strict=True))
        around: dict[int, list[_Share]] = {}
        for vertex, *share in (each for rank in cells.comm.allgather(mine) for each in rank):
            around.setdefault(vertex, []).append(_Share(*share))
        heights = {vertex: _solved(shares) for vertex, shares in around.items()}
        nothing = np.zeros(len(EXPONENTS))  # on the boundary
        own = [
            [heights[vertex].get(facet, nothing) for facet in pair]
            for vertex, pair in zip(vertices, facets, strict=True)
        ]
        best = np.array(own).reshape(len(own), len(self.heights)).T
        return replace(self, heights=np.ascontiguousarray(best))

    def before(self, cells: Cells, excess: FloatArray, bumps: FloatArray) -> FloatArray:
        """Compute ∇(v − u_h) without ψ, as γ_i by ∇λ_i, at the points, shape (q, d + 1, n)."""
        height = bumps[cells.facets[:, self.at]]
        out = np.repeat(excess[None, :, self.at], len(self.weights), axis=0)
        for (i, j), m in ((pair, 3 - sum(pair)) for pair in cells.pairs):
            out[:, i] += 4.0 * self.hats[:, m] * height[j]
            out[:, j] += 4.0 * self.hats[:, m] * height[i]
        return out

    def gains(self, cells: Cells, excess: FloatArray, bumps: FloatArray) -> FloatArray:
        """Return what ψ adds to ∫_T κ|∇(v − u_h)|², mostly less than 0, shape (n,)."""
        return self._products(cells, 2.0 * self.before(cells, excess, bumps) + self.slope)

    def pulls(self, cells: Cells) -> tuple[FloatArray, FloatArray]:
        """Compute ∫_T κ∇ψ·∇λ_i, and ∫_T κ∇ψ·∇b_i for the bumps, shapes (d + 1, n)."""
        flow = self._flow(cells, self.slope)
        of_bumps = np.stack(
            [
                4.0 * np.einsum("q,qn->n", self.weights, self.hats[:, k] * flow[:, j])
                + 4.0 * np.einsum("q,qn->n", self.weights, self.hats[:, j] * flow[:, k])
                for j, k in cells.others
            ]
        )
        return np.einsum("q,qin->in", self.weights, flow), of_bumps

    def add(
        self, cells: Cells, w: FloatArray, load: VolumeMoments, low: FloatArray, flux: Flux,
        reaction: FloatArray, v: tuple[FloatArray, FloatArray], sums: Sums,
    ) -> float:  # fmt: skip
        """Add ψ to the parts of the duality gap.

        ∫ (f − f_T) ψ is bounded by ‖κ^{-1/2}σ‖ ‖κ^{1/2}∇ψ‖ and goes into the slack.
        c is a number on each of these cells, see `steady` of `Functional`.

        Args:
            cells: The mesh.
            w: u_h at the cells' vertices, shape (d + 1, cells).
            load: Moments of f.
            low: Lower bound of κ, shape (cells,) or ().
            flux: y.
            reaction: c, shape (cells,) or ().
            v: Excess and bumps of v without ψ, see `fitted`.
            sums: What to add to.

        Returns:
            How far this rank's share of the energy may be from the truth.
        """
        d, at = cells.tdim, self.at
        slope = self.slope
        more = self.gains(cells, *v)
        steeper = more + 2.0 * self._products(cells, np.repeat(w[None, :, at], len(slope), axis=0))
        P = flux.excess[:, at]
        through = self.hats * sum_rows(P) - P
        if flux.beyond is not None:
            through += np.stack([flux.beyond.through(cells, at, hat) for hat in self.hats])
        cross = np.einsum("q,qin,qin->n", self.weights, through, slope) / d
        sums.totals.companion += float(np.sum(more))
        sums.totals.cross += float(np.sum(cross))
        sums.totals.energy += float(
            np.sum(0.5 * steeper - cells.volume[at] * load.mean[at] * self.means)
        )
        sums.indicators[at] += more
        sums.steepness[at] += steeper
        sums.middle[at] += more + 2.0 * cross
        sums.across[at] += more - 2.0 * cross
        self._add_reaction(cells, reaction, flux, v, sums)
        if load.variance is None:
            return 0.0
        square = poincare(d) ** 2 * cells.diameter2[at] * cells.volume[at] * load.variance[at]
        steep = self._products(cells, slope)
        slack = np.sqrt(np.maximum(square * steep, 0.0) / pick(low, at))
        for row in (sums.middle, sums.across):
            row[at] += 2.0 * slack
        sums.totals.slack += float(np.sum(slack))
        return float(np.sum(slack))

    def _add_reaction(
        self,
        cells: Cells,
        reaction: FloatArray,
        flux: Flux,
        v: tuple[FloatArray, FloatArray],
        sums: Sums,
    ) -> None:
        """Add what ψ changes c‖v − u_h‖² by, and what c takes up of the equation's loose ends."""
        if sums.apart is None or sums.zeroth is None:
            return
        (excess, bumps), at, value = v, self.at, self.value
        apart = np.einsum("qin,in->qn", self.hats, excess[:, at])
        for height, (j, k) in zip(bumps[cells.facets[:, at]], cells.others, strict=True):
            apart += 4.0 * self.hats[:, j] * self.hats[:, k] * height
        mass = pick(reaction, at) * cells.volume[at]
        more = mass * (self.weights @ (value * (2.0 * apart + value)))
        sums.totals.energy += 0.5 * float(np.sum(more))
        sums.totals.companion += float(np.sum(more))
        for row in (sums.apart, sums.zeroth, sums.indicators):
            row[at] += more
        if flux.taken_up is not None:
            rest = np.where(flux.taken_up[at], flux.left[at], 0.0)
            sums.totals.load_companion += float(rest @ self.means)

    def _flow(self, cells: Cells, slope: FloatArray) -> FloatArray:
        """Compute κ |T| ∇λ_i·Σ_j γ_j ∇λ_j, shape (q, d + 1, n)."""
        flow = np.zeros_like(slope)
        for (i, j), s in zip(cells.pairs, cells.stiffness[:, self.at], strict=True):
            part = (slope[:, j] - slope[:, i]) * (self.kappa * s)
            flow[:, i] += part
            flow[:, j] -= part
        return flow

    def _products(self, cells: Cells, slope: FloatArray) -> FloatArray:
        """Compute ∫_T κ∇ψ·Σ_i γ_i ∇λ_i, shape (n,)."""
        return np.einsum("q,qin,qin->n", self.weights, slope, self._flow(cells, self.slope))


def _rule() -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return 1 − λ at the apex, the place along the opposite side, and weights, shapes (q,)."""
    (tau, across), (place, beside) = _gauss(9), _gauss(3)
    t = tau**4
    weights = np.outer(8.0 * t * tau**3 * across, beside).ravel().astype(np.float64)
    return np.repeat(t, len(place)), np.tile(place, len(t)), weights


def _gauss(n: int) -> tuple[FloatArray, FloatArray]:
    """Return points and weights on (0, 1)."""
    points, weights = np.polynomial.legendre.leggauss(n)
    return 0.5 * (points + 1.0), np.asarray(0.5 * weights, dtype=np.float64)


def _vertices(cells: Cells, steady: BoolArray, energies: FloatArray) -> BoolArray | None:
    """Choose the local vertices that get a cusp; None if none do on any rank."""
    total = cells.total(np.sum(energies))[0]
    around = cells.over_vertices(np.tile(energies, (cells.tdim + 1, 1)))
    unsteady = cells.over_vertices(np.tile(~steady, (cells.tdim + 1, 1)).astype(np.float64))
    found = (around > HOLDS * total) & (unsteady == 0.0)
    index_map = cells.domain.mesh.topology.index_map(0)
    name = index_map.local_to_global(np.arange(len(around), dtype=np.int32))
    mesh = cells.domain.mesh
    there = np.flatnonzero(found[cells.vertices].any(axis=0))
    corners, nodes = cells.vertices[:, there].T, compat.cell_nodes(mesh)[there]
    # By what they hold, and where that is the same by place: no matter how many ranks there are
    mine = {
        (-round(float(around[i] / total), 6), *mesh.geometry.x[node].tolist(), int(name[i]))
        for i, node in zip(corners.ravel(), nodes.ravel(), strict=True)
        if found[i]
    }
    near = [set(name[cell[found[cell]]].tolist()) for cell in corners]
    ranks = cells.comm.allgather((mine, near))
    chosen: set[int] = set()
    for *_, vertex in sorted(set().union(*(candidates for candidates, _ in ranks))):
        cells_of_it = (cell for _, groups in ranks for cell in groups if vertex in cell)
        if all(cell.isdisjoint(chosen) for cell in cells_of_it):
            chosen.add(vertex)
    return np.isin(name, list(chosen)) if chosen else None
