"""The loads f and g as moments: their share of χ (1.10), and how far they are from their means."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from mpi4py import MPI
from ufl.core.expr import Expr

from ..arrays import BoolArray, FloatArray, IndexArray
from ..fem.cells import (
    BoundaryFacets,
    Cells,
    at_points,
    blocks,
    dot_rows,
    measures,
    pick,
    poincare,
    sum_rows,
)
from ..fem.pointwise import Unknown
from ..fem.space import facet_quadrature
from .cutting import Cut, cut, refine
from .jets import Boxes, Enclosure
from .pieces import Pieces
from .quadrature import LOAD_DEGREE, OnFacets, Volume
from .ranges import errors_on, range_on
from .triangles import Triangles, trace_constant

NOTHING = np.array(0.0)
"""A reaction that is none."""


class VolumeMoments:
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

    @cached_property
    def rest(self) -> FloatArray:
        """Means of (f − f_T − ℓ)², d = 2, shape (cells,), with the affine function ℓ nearest to f.

        ℓ is 12 times its moment (f − f_T) λ_i at the vertex i.
        """
        assert self.variance is not None and self.hats is not None
        return np.maximum(self.variance - 12.0 * dot_rows(self.hats, self.hats), 0.0)

    def shares(self, cells: Cells, block: slice) -> FloatArray:
        """Compute ∫_T f ψ_i for the Crouzeix-Raviart ψ_i = 1 − d λ_i, shape (d + 1, n)."""
        d = cells.tdim
        out = np.empty((d + 1, block.stop - block.start))
        out[:] = self.mean[block] / (d + 1)
        if self.hats is not None:
            out -= d * self.hats[:, block]
        out *= cells.volume[block]
        return out

    def less(self, c: float | FloatArray, w: FloatArray) -> VolumeMoments:
        """Compute the same of f − c w, w affine on each cell.

        Args:
            c: A number, or one for each cell, shape (cells,).
            w: Values at the cells' vertices, shape (d + 1, cells).
        """
        k = len(w)
        total = sum_rows(w)
        middle = total / k
        deviation, rows = w - middle, np.zeros((2 * k, w.shape[1]))
        hats = np.divide(deviation, k * (k + 1), out=rows[:k])  # means of (w − w_T) λ_i
        variance = dot_rows(deviation, hats)
        if k == 3:
            rows[k:] = total / 45.0 - w / 15.0
        rows *= -c
        variance *= c**2
        if self.hats is not None and self.bumps is not None and self.variance is not None:
            rows[:k] += self.hats
            rows[k:] += self.bumps
            variance += self.variance - 2.0 * c * dot_rows(w, self.hats)
            np.maximum(variance, 0.0, out=variance)
        return VolumeMoments(self.mean - c * middle, rows, variance)

    @classmethod
    def of(cls, f: Volume, cells: Cells) -> VolumeMoments:
        """Integrate f."""
        n, rule = cells.number, f.rule
        if f.number is not None:
            return cls(np.full(n, f.number), None, None, f.number == 0.0)
        values = f.at(cells)
        tests = np.concatenate([rule.hats, rule.bumps])
        tests = (tests - (tests @ rule.weights)[:, None]) * rule.weights
        tests, variance = np.vstack([rule.weights, tests]), np.empty(n)
        rows = np.empty((len(tests), n))
        for block in blocks(n):
            rows[:, block] = tests @ values[block].T
            off = values[block] - rows[0, block, None]
            with np.errstate(over="ignore"):  # such data are refused where the load is known
                variance[block] = np.square(off, out=off) @ rule.weights
        return cls(rows[0], rows[1:], variance)

    def refined(self, f: Volume, cells: Cells, cut: Cut) -> VolumeMoments:
        """Return the same, with f integrated piece by piece where cells are cut."""
        which, place = cut.of
        if self.hats is None or self.bumps is None or self.variance is None or not len(which):
            return self
        rule = f.plain
        values = f.deviation.values(cut.pieces, cells, rule.hats)
        weights = rule.weights[:, None] * cut.pieces.share
        hats = at_points(cut.pieces.hats, rule.hats)
        bumps = np.stack([4.0 * np.delete(hats, i, axis=0).prod(axis=0) for i in range(len(hats))])

        def integral(integrand: FloatArray) -> FloatArray:
            sums = np.bincount(place, (weights * integrand).sum(axis=0), minlength=len(which))
            return sums.astype(np.float64)

        mean, rows, variance = self.mean.copy(), np.vstack([self.hats, self.bumps]), self.variance
        variance = variance.copy()
        mean[which] = integral(values)
        off = values - mean[which][place]
        variance[which] = integral(off**2)
        for row, test in zip(rows, (*hats, *bumps), strict=True):
            row[which] = integral(off * test)
        return VolumeMoments(mean, rows, variance)


@dataclass(frozen=True, eq=False)
class Certain:
    """f by a rule that is good enough for the certificate, and what that rule may have missed.

    There is a q with the moments of `load`, and so little of f − q that
    |∫_T (f − q)| ≤ missed and ‖f − q‖_T ≤ rough.

    Attributes:
        load: Moments of f.
        missed: Shape (cells,); None where f is a number.
        rough: Shape (cells,); or None.
        reason: Why there are none, if there are none.
    """

    load: VolumeMoments
    missed: FloatArray | None = None
    rough: FloatArray | None = None
    reason: str | None = None

    @classmethod
    def of(
        cls,
        f: Volume,
        load: VolumeMoments,
        cells: Cells,
        low: FloatArray,
        size: float,
        reaction: FloatArray = NOTHING,
        norms: bool = True,
    ) -> Certain:
        """Enclose f; collective.

        Args:
            f: The load.
            load: Its moments by the scheme's own rule.
            cells: The mesh.
            low: Lower bound of κ, shape (cells,) or ().
            size: Of the bound, to which what is missed should be small.
            reaction: c, shape (cells,) or ().
            norms: Whether ‖f − q‖ is to be small, too, and not the integrals alone.
        """
        if f.number is not None:
            return cls(load)
        fine = f.exact_for(LOAD_DEGREE)
        if fine is not f:
            load = VolumeMoments.of(fine, cells)
        deviation, points = f.deviation, np.hstack([fine.rule.hats, fine.plain.hats])
        inner = float(points.min())

        def errors(boxes: Boxes, half: FloatArray) -> FloatArray:
            quadratic, cubic = deviation(Enclosure(boxes, inner=inner), half, hats=points)
            return np.stack([cubic, quadratic**2])

        goal = TOLERANCE * size
        weights = np.empty((2, cells.number))
        np.multiply(2.0 / (np.sqrt(low) * goal), cells.volume, out=weights[0])
        # J(v) asks for the first of these, the bound for the second
        by_slope = norm = mean_to_norm(cells, low, NOTHING)
        if reacts(reaction):
            norm = mean_to_norm(cells, low, reaction)
        np.multiply((2.0 / goal) ** 2 * cells.volume * norms, by_slope * norm, out=weights[1])
        try:
            found = cut(
                cells,
                errors,
                weights,
                deviation.local,
                deviation.decides,
                deviation.apart,
                deviation.levels(cells) if cells.tdim == 2 else None,
            )
        except Unknown as error:
            return cls(load, reason=f"f holds an operator that has no enclosure: {error}")
        missed = 2.0 * cells.volume * found.errors[0]
        rough = 2.0 * np.sqrt(cells.volume * found.errors[1])
        bounded = np.isfinite(missed).all() and np.isfinite(rough).all()
        reason = None if cells.comm.allreduce(bool(bounded), op=MPI.LAND) else UNBOUNDED
        return cls(load.refined(fine, cells, found), missed, rough, reason)


def mean_to_norm(
    cells: Cells, low: FloatArray, reaction: FloatArray, block: slice | None = None
) -> FloatArray:
    """Find C with ‖e − e_T‖_T ≤ C times e's energy norm on T, shape (cells in the block,).

    Args:
        cells: The mesh.
        low: Lower bound of κ, shape (cells,) or ().
        reaction: c, shape (cells,) or ().
        block: Which cells; None for all.
    """
    block = slice(0, cells.number) if block is None else block
    by_slope = poincare(cells.tdim) * np.sqrt(cells.diameter2[block] / pick(low, block))
    if not reacts(reaction):
        return by_slope
    c = pick(reaction, block)
    inverse = np.divide(1.0, c, out=np.full_like(by_slope, np.inf), where=c > 0.0)
    return np.minimum(by_slope, np.sqrt(inverse))


def reacts(reaction: FloatArray) -> bool:
    """Tell whether there is a reaction; the same on all ranks."""
    return reaction.ndim > 0 or bool(reaction > 0.0)


TOLERANCE = 4e-3
"""Part of the bound that may be missed of f, or thereabouts."""
UNBOUNDED = "f is not bounded on the mesh, or not known to be"


class NeumannMoments:
    """Moments of g, and b, on a part of the boundary.

    Attributes:
        side: The facets.
        measure: |F|, shape (n,).
        shares: ∫_F g λ_j for the facet's ends j, shape (d, n).
        loss: b, where g − b u_h is what is meant in the end; 0 where there is none, shape (n,).
            Where b varies within facets a lower bound of it.
        most: The same object, or an upper bound; then g may be g − b u_h already.
        datum: B as a formula.
        bounded: Whether u is bounded there.
    """

    def __init__(
        self, sampled: OnFacets, cells: Cells, loss: FloatArray, most: FloatArray | None = None
    ):
        """Take g's values, and integrate them; bounds of b have the shape (n,) or ()."""
        g = self.g = sampled.trace
        self.side, self._cells = sampled.side(cells), cells
        self.measure = measures(cells, self.side)
        inside = sampled.seen_from(cells).inside
        self.shares = self.measure * (g.hats.T * g.weights @ inside)
        self.loss = self.most = np.broadcast_to(loss, self.measure.shape)
        if most is not None and most is not loss:
            self.most = np.broadcast_to(most, self.measure.shape)
        self.bounded, self.datum = bool(sampled.condition.bounds), sampled.condition.loss

    @property
    def varies(self) -> bool:
        """True if b may vary within facets."""
        return self.most is not self.loss

    def between(self, pieces: Pieces, cells: Cells) -> FloatArray:
        """Bound a b that varies, on pieces of the facets, shape (2, n)."""
        outer = np.stack([self.loss[pieces.parent], self.most[pieces.parent]])
        found = range_on(self.datum, pieces, cells)
        if found is None:
            return outer
        return np.stack([np.maximum(outer[0], found[0]), np.minimum(outer[1], found[1])])

    @property
    def steady(self) -> FloatArray:
        """The b whose product with u_h is still to be taken off g, shape (n,)."""
        return np.zeros_like(self.loss) if self.varies else self.loss

    def to_cells(self) -> FloatArray:
        """Compute ∫_F g ψ_i for the Crouzeix-Raviart ψ_i of the facet's cell, shape (d + 1, n).

        ψ_i = 1 − d λ_i; on the facet itself λ_i = 0.
        """
        return to_cells(self._cells, self.side, self.shares)


def bounds_on_facets(b: Expr, cells: Cells, side: BoundaryFacets) -> tuple[FloatArray, FloatArray]:
    """Enclose b on facets, shapes (n,); infinite for no bounds, 0 for below 0 by rounding."""
    pieces, n = Pieces.of_facets(cells, side).finer(HALVINGS), len(side.cells)
    low, high = np.full(n, np.inf), np.full(n, -np.inf)
    found = range_on(b, pieces, cells)
    if found is None:
        return -low, -high
    np.minimum.at(low, pieces.parent, found[0])
    np.maximum.at(high, pieces.parent, found[1])
    return np.where((low < 0.0) & (low >= -ROUNDED * high), 0.0, low), high


HALVINGS = 3
"""Halvings of facets on which b varies."""
ROUNDED = 1e-13
"""Part of b on a facet by which it may seem to be below 0."""


def to_cells(cells: Cells, side: BoundaryFacets, shares: FloatArray) -> FloatArray:
    """Integrate g ψ_i over facets from the integrals of g λ_j, see `NeumannMoments`."""
    d = cells.tdim
    out = np.tile(shares.sum(axis=0), (d + 1, 1))
    at = np.arange(shares.shape[1])
    for j, share in zip(cells.others[side.local].T, shares, strict=True):
        out[j, at] -= d * share
    return out


@dataclass(frozen=True, eq=False)
class Known:
    """Known fluxes through the boundary: g − b u_h on all parts with a g or a b.

    Attributes:
        side: The facets.
        shares: ∫_F (g − b u_h) λ_j for the facet's ends j, shape (d, n).
        loss: b, or a lower bound of it, shape (n,).
        bounded: Whether u is bounded there, shape (n,).
    """

    side: BoundaryFacets
    shares: FloatArray
    loss: FloatArray
    bounded: BoolArray

    @classmethod
    def of(cls, edges: Sequence[NeumannMoments], cells: Cells, w: FloatArray) -> Known:
        """Put all parts together.

        Args:
            edges: g on them, g − b u_h where b varies within facets.
            cells: The mesh.
            w: u_h at the cells' vertices, shape (d + 1, cells).
        """
        d = cells.tdim
        side = BoundaryFacets.joined([edge.side for edge in edges], d)
        loss = np.concatenate([e.loss for e in edges] or [np.empty(0)])
        bounded = [np.full(len(edge.measure), edge.bounded) for edge in edges]
        shares = np.concatenate([np.empty((d, 0)), *(edge.shares for edge in edges)], axis=1)
        steady = np.concatenate([e.steady for e in edges] or [np.empty(0)])
        if steady.any():
            ends = trace_of(cells, side, w)
            measure = np.concatenate([edge.measure for edge in edges])
            shares -= steady * measure * (ends + ends.sum(axis=0)) / (d * (d + 1))
        return cls(side, shares, loss, np.concatenate([np.empty(0, dtype=bool), *bounded]))


def trace_of(cells: Cells, side: BoundaryFacets, w: FloatArray) -> FloatArray:
    """Find a function's values at the ends of boundary facets, from their cells, shape (d, n)."""
    return w[cells.others[side.local].T, side.cells]


@dataclass(frozen=True, eq=False)
class Segments:
    """g − b u_h on pieces of facets, and what quadrature may have missed of it.

    On each facet there is a q with the moments that these values have, |∫_F (g − q)| ≤ missed
    and ‖g − q‖_F ≤ rough.

    Attributes:
        facets: The facets.
        side: The facet of each piece, shapes (n,).
        place: Its number among the facets, shape (n,).
        hats: The facet's barycentric coordinates at the points, shape (q, d, n).
        weights: Quadrature weights, which add up to 1.
        measure: The pieces' measures, shape (n,).
        values: g at the points, shape (q, n).
        through: ∫_F g, shape (facets,).
        missed: Shape (facets,).
        rough: Shape (facets,).
        loss: b, or a lower bound of it, shape (facets,).
        bounded: Whether u is bounded there, shape (facets,).
        low: Lower bound of κ, shape (cells,) or ().
        reason: Why there are none, if there are none.
        between: Bounds of b on the pieces, shape (2, n); None where it is constant on each facet.
        varies: On which facets it may not be, shape (facets,); or None.
    """

    cells: Cells
    facets: BoundaryFacets
    side: BoundaryFacets
    place: IndexArray
    hats: FloatArray
    weights: FloatArray
    measure: FloatArray
    values: FloatArray
    through: FloatArray
    missed: FloatArray
    rough: FloatArray
    loss: FloatArray
    bounded: BoolArray
    low: FloatArray
    reason: str | None = None
    between: FloatArray | None = None
    varies: BoolArray | None = None

    @classmethod
    def joined(
        cls,
        edges: Sequence[NeumannMoments],
        cells: Cells,
        w: FloatArray,
        low: FloatArray,
        size: float,
    ) -> Segments:
        """Enclose g on several parts, and take b u_h off; collective.

        Args:
            edges: g on them by the scheme's own rule, on one part or more; g − b u_h where b varies
                within facets.
            cells: The mesh.
            w: u_h at the cells' vertices, shape (d + 1, cells).
            low: Lower bound of κ, shape (cells,) or ().
            size: Of the bound, to which what is missed should be small.
        """
        found = [cls.of(edge, cells, low, size) for edge in edges]
        first = np.cumsum([0, *(len(each.through) for each in found)])

        def rows(datum: Callable[[Segments], FloatArray]) -> FloatArray:
            return np.concatenate([datum(each) for each in found], axis=-1)

        facets = BoundaryFacets.joined([each.facets for each in found], cells.tdim)
        loss, hats = rows(lambda each: each.loss), rows(lambda each: each.hats)
        varying = any(edge.varies for edge in edges)
        steady = np.concatenate([edge.steady for edge in edges])
        values, through = rows(lambda each: each.values), rows(lambda each: each.through)
        place = np.concatenate([e.place + k for e, k in zip(found, first[:-1], strict=True)])
        measure = rows(lambda each: each.measure)
        if steady.any():
            ends = trace_of(cells, facets, w)
            lost = steady[place] * np.einsum("qdn,dn->qn", hats, ends[:, place])
            values = values - lost
            through = through - np.bincount(
                place, measure * (found[0].weights @ lost), minlength=len(through)
            )
        return cls(
            cells=cells,
            facets=facets,
            side=BoundaryFacets.joined([each.side for each in found], cells.tdim),
            place=place,
            hats=hats,
            weights=found[0].weights,
            measure=measure,
            values=values,
            through=through,
            missed=rows(lambda each: each.missed),
            rough=rows(lambda each: each.rough),
            loss=loss,
            bounded=np.concatenate([each.bounded for each in found]),
            low=low,
            reason=next((each.reason for each in found if each.reason), None),
            between=rows(lambda each: each.of_loss) if varying else None,
            varies=np.repeat([e.varies for e in edges], np.diff(first)) if varying else None,
        )

    @classmethod
    def of(
        cls,
        edge: NeumannMoments,
        cells: Cells,
        low: FloatArray,
        size: float,
        norms: bool = True,
    ) -> Segments:
        """Enclose g alone; collective.

        Args:
            edge: g by the scheme's own rule.
            cells: The mesh.
            low: Lower bound of κ, shape (cells,) or ().
            size: Of the bound, to which what is missed should be small.
            norms: Whether ‖g − q‖ is to be small, too, and not the integrals alone.
        """
        g, facets, n = edge.g, edge.side, len(edge.measure)
        points, weights = facet_quadrature(cells.domain.mesh, max(LOAD_DEGREE, g.degree))
        hats = np.column_stack([1.0 - points.sum(axis=1), points]).T
        pieces = Pieces.of_facets(cells, facets).finer(HALVINGS * edge.varies)
        of_integral, of_square = np.zeros((2, len(pieces.share)))
        values, reasons = None, []
        if g.constant is None and cells.comm.allreduce(n):
            reason = None
            try:
                pieces, (of_integral, of_square) = _cut_facets(
                    pieces, edge, cells, low, TOLERANCE * size, norms, hats
                )
                values = g.deviation.values(pieces, cells, hats)
            except Unknown as error:
                reason = f"g holds an operator that has no enclosure: {error}"
            if not (np.isfinite(of_integral).all() and np.isfinite(of_square).all()):
                reason = G_UNBOUNDED
            reasons = [words for words in cells.comm.allgather(reason) if words]
        if values is None or reasons:
            values = np.full((len(weights), len(pieces.share)), g.constant or 0.0)
        at, measure = pieces.parent, edge.measure[pieces.parent] * pieces.share

        def total(amounts: FloatArray) -> FloatArray:
            return np.bincount(at, measure * amounts, minlength=n).astype(np.float64)

        return cls(
            cells=cells,
            facets=facets,
            side=facets.picked(at),
            place=at,
            hats=at_points(pieces.hats, hats).swapaxes(0, 1),
            weights=weights,
            measure=measure,
            values=values,
            through=total(weights @ values),
            missed=2.0 * total(of_integral),
            rough=2.0 * np.sqrt(total(of_square)),
            loss=edge.loss,
            bounded=np.full(n, edge.bounded),
            low=low,
            reason=reasons[0] if reasons else None,
            between=edge.between(pieces, cells) if edge.varies else None,
        )

    @property
    def of_loss(self) -> FloatArray:
        """Bounds of b on the pieces, shape (2, n)."""
        return np.stack(2 * [self.loss[self.place]]) if self.between is None else self.between

    @cached_property
    def usual(self) -> FloatArray:
        """b, or about its mean, shape (facets,)."""
        if self.between is None:
            return self.loss
        middle = self.measure * self.between.mean(axis=0)
        return self._over_facets(middle) / self._over_facets(self.measure)

    @cached_property
    def most(self) -> FloatArray:
        """b, or an upper bound of it, shape (facets,)."""
        if self.between is None:
            return self.loss
        found = np.zeros(len(self.loss))
        np.maximum.at(found, self.place, self.between[1])
        return found

    @property
    def steady(self) -> FloatArray:
        """The b that is constant on its facet, 0 where it may not be, shape (facets,)."""
        return self.loss if self.varies is None else np.where(self.varies, 0.0, self.loss)

    @cached_property
    def rest(self) -> FloatArray:
        """The part of g that is beyond its mean over the facet, shape (q, n)."""
        n = len(self.through)
        area = np.bincount(self.place, self.measure, minlength=n)
        return self.values - (self.through / area)[self.place]

    def _by_cell(self, sizes: FloatArray) -> tuple[IndexArray, FloatArray]:
        """Find the cells at Γg, and the sums over their facets."""
        at, place = np.unique(self.facets.cells, return_inverse=True)
        return at, np.bincount(place, sizes, minlength=len(at)).astype(np.float64)

    @cached_property
    def _constant(self) -> FloatArray:
        """C with |∫_F ϱ e| ≤ C ‖ϱ‖_F ‖∇e‖_T where ∫_F ϱ = 0, shape (facets,)."""
        if self.cells.tdim != 2:
            return trace_constant(self.cells, self.facets)
        measure = measures(self.cells, self.facets)
        return np.minimum(*(each.constant(measure) for each in self._triangles))

    @cached_property
    def _triangles(self) -> tuple[Triangles, Triangles]:
        """The facets' cells, and triangles in them, d = 2."""
        own = Triangles.of(self.cells, self.facets, stretched=True)
        return own, own.nearer()

    @cached_property
    def slope(self) -> FloatArray:
        """The a with a (λ_j − λ_k) nearest to q − g_F, j < k the ends, d = 2, shape (facets,)."""
        moments = self.measure * (self.weights @ (self.rest * (self.hats[:, 0] - self.hats[:, 1])))
        return np.asarray(3.0 * self._over_facets(moments) / self._over_facets(self.measure))

    def _over_facets(self, amounts: FloatArray) -> FloatArray:
        found = np.bincount(self.place, amounts, minlength=len(self.through))
        return found.astype(np.float64)

    @cached_property
    def given(self) -> BoolArray:
        """True where b takes up q − g_F more cheaply than a field in the cell, shape (facets,)."""
        return self.loss * self._constant**2 > pick(self.low, self.facets.cells)

    @cached_property
    def squares(self) -> FloatArray:
        """‖q − g_F‖²_F, shape (facets,)."""
        return self._over_facets(self.measure * (self.weights @ self.rest**2))

    @cached_property
    def followed(self) -> BoolArray:
        """True where y·n on thin cells is to have q's affine part, shape (facets,).

        What that is wrong by, b times the error of u_h, costs little where b |F| is below κ, in
        cells of any shape.
        """
        weak = self.loss * measures(self.cells, self.facets) <= pick(self.low, self.facets.cells)
        return ~self.given | weak

    def tau(self, carried: bool) -> FloatArray:
        """Compute what b takes up of q − g_F, shape (q, n).

        Args:
            carried: Whether y carries q's affine part where it is to.
        """
        tau = np.where(self.given[self.place], self.rest, 0.0)
        if carried:
            slope = np.where(self.given & self.followed, self.slope, 0.0)[self.place]
            tau -= slope * (self.hats[:, 0] - self.hats[:, 1])
        return tau

    def taken(self, shed: FloatArray | None, carried: bool) -> FloatArray:
        """Bound ‖b^{-1/2}τ‖²_F of what b takes up, shape (facets,).

        Args:
            shed: As in `target`.
            carried: As in `tau`.
        """
        area = self._over_facets(self.measure)
        if self.between is None and not carried:
            loss = np.maximum(self.loss, 1e-300)
            found = np.where(self.given, self.squares / loss, 0.0)
            return found if shed is None else found + shed**2 / (loss * area)
        tau = self.tau(carried)
        if shed is not None:
            tau = tau + (shed / area)[self.place]
        least = np.maximum(self.of_loss[0], 1e-300)
        return self._over_facets(self.measure * (self.weights @ tau**2) / least)

    @cached_property
    def bend(self) -> FloatArray:
        """The c with q − g_F nearest to a (λ_j − λ_k) + c (6 λ_j λ_k − 1), shape (facets,)."""
        test = 6.0 * self.hats[:, 0] * self.hats[:, 1] - 1.0
        moments = self.measure * (self.weights @ (self.rest * test))
        return np.asarray(5.0 * self._over_facets(moments) / self._over_facets(self.measure))

    def target(self, shed: FloatArray | None) -> FloatArray:
        """Find what t/b − u_h is like: a quadratic's values at the ends and its bump.

        Where b takes nothing up, and for d = 3, it is 0.

        Args:
            shed: Integrals that b takes up beside q − g_F, shape (facets,); None for nothing.

        Returns:
            Shape (d + 1, facets).
        """
        d = self.hats.shape[1]
        found = np.zeros((d + 1, len(self.loss)))
        if d != 2 or not self.given.any():
            return found
        inverse = np.divide(1.0, self.usual, out=np.zeros_like(self.loss), where=self.given)
        mean = 0.0 if shed is None else shed / self._over_facets(self.measure)
        found[0], found[1] = (mean + s * self.slope - self.bend for s in (1.0, -1.0))
        found[2] = 1.5 * self.bend
        return np.asarray(found * inverse)

    def oscillation(self, carried: bool) -> tuple[IndexArray, FloatArray]:
        """Find the cells at Γg and Σ_F ‖σ‖_T for each, where b does not take up q − g_F.

        That is C ‖q − g_F‖_F at most, or for d = 2 what a quadratic part has of its own, and C
        times what is left: σ may vanish outside of a triangle in the cell.

        Args:
            carried: Whether y carries q's affine part, and what is left of q − g_F is meant.
        """
        squares = np.where(self.given, 0.0, self.squares)
        if self.cells.tdim != 2:
            return self._by_cell(self._constant * np.sqrt(squares))
        area = self._over_facets(self.measure)
        a, c = (np.where(self.given, 0.0, each) for each in (self.slope, self.bend))
        if carried:
            squares, a = squares - area * a**2 / 3.0, np.zeros_like(a)
        rest = squares - area * (a**2 / 3.0 + c**2 / 5.0)
        measure = measures(self.cells, self.facets)
        known = np.minimum(*(each.quadratic(measure, a, c) for each in self._triangles))
        known += self._constant * np.sqrt(np.maximum(rest, 0.0))
        return self._by_cell(np.minimum(self._constant * np.sqrt(np.maximum(squares, 0.0)), known))

    def beyond(self) -> tuple[IndexArray, FloatArray]:
        """Find the cells at Γg and Σ_F c_F ‖g − q‖_F for each, where b does not take up g − q."""
        constant = trace_constant(self.cells, self.facets)
        return self._by_cell(constant * np.where(self.given, 0.0, self.rough))

    @property
    def beyond_loss(self) -> FloatArray:
        """‖b^{-1/2}(g − q)‖²_F, or more, where b takes it up; 0 elsewhere, shape (facets,)."""
        return np.where(self.given, self.rough**2 / np.maximum(self.loss, 1e-300), 0.0)

    def at_facets(
        self, vertices: FloatArray, bumps: FloatArray, w: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Bound b, ‖g − b u_h‖_F and ‖v − u_h‖_F, by facet dof; 0 on other facets.

        Args:
            vertices: v at the vertices.
            bumps: Heights of v's bumps.
            w: u_h at the cells' vertices, shape (d + 1, cells).
        """
        found = np.zeros((3, len(self.cells.exterior)))
        at = self.facets.dofs
        area = np.bincount(self.place, self.measure, minlength=len(at))
        ends = np.abs(vertices[self.facets.ends] - trace_of(self.cells, self.facets, w)).max(axis=0)
        bump = np.abs(bumps[at]) if self.cells.tdim == 2 else 0.0
        norm = np.sqrt(self._over_facets(self.measure * (self.weights @ self.values**2)))
        found[:, at] = self.most, norm + self.rough, np.sqrt(area) * (ends + bump)
        return found[0], found[1], found[2]

    def change(
        self, vertices: FloatArray, bumps: FloatArray, thirds: FloatArray | None = None
    ) -> float:
        """Bound |∫_Γg (g − q) v|, v by vertices, bumps and cubics; this rank's share.

        The rule is exact for quadratics times cubics.
        """
        ends = vertices[self.facets.ends]
        area = np.bincount(self.place, self.measure, minlength=len(self.through))
        bump = np.abs(bumps[self.facets.dofs]) if len(ends) == 2 else 0.0
        mean = np.abs(ends.mean(axis=0)) + bump
        swing = np.ptp(ends, axis=0) + 2.0 * bump
        if thirds is not None:  # their means are 0
            swing = swing + THIRD * np.abs(thirds[self.facets.dofs])
        return float(np.sum(mean * self.missed + swing * np.sqrt(area) * self.rough))


def _cut_facets(
    pieces: Pieces,
    edge: NeumannMoments,
    cells: Cells,
    low: FloatArray,
    goal: float,
    norms: bool,
    hats: FloatArray,
) -> tuple[Pieces, FloatArray]:
    """Cut pieces of facets until quadrature misses little of g; collective.

    Args:
        pieces: To begin with.
        edge: g.
        cells: The mesh.
        low: Lower bound of κ, shape (cells,) or ().
        goal: The share of the bound, or thereabouts, that may come of it.
        norms: As for `Segments.of`.
        hats: The points' barycentric coordinates on a piece, shape (d, q).

    Returns:
        Pieces; and half of what may be missed of ∫ g on each, and a quarter of that of ‖g − q‖²,
        both in parts of its measure, shape (2, n).

    Raises:
        Unknown: An operator in g has no enclosure.
    """

    def errors(boxes: Boxes, half: FloatArray) -> FloatArray:
        quadratic, cubic = edge.g.deviation(Enclosure(boxes), half, hats=hats)
        return np.stack([cubic, quadratic**2])

    kappa, n = pick(low, edge.side.cells), len(edge.measure)
    # C with ‖e‖²_F at most C times the square of e's energy, which b has a share in
    of_gradients = trace_constant(cells, edge.side) ** 2 / kappa
    of_loss = np.divide(1.0, edge.loss, out=np.full(n, np.inf), where=edge.loss > 0.0)
    importance = np.zeros((2, n))
    with np.errstate(divide="ignore", over="ignore"):  # without a goal none is too small to be cut
        importance[0] = 2.0 * edge.measure / np.sqrt(kappa) / goal
        if norms:
            importance[1] = 4.0 * edge.measure * np.minimum(of_gradients, of_loss) / goal**2
    room = 8 * cells.comm.allreduce(len(pieces.share)) + 1000
    return refine(
        pieces,
        lambda some: errors_on(some, errors, cells),
        importance,
        room,
        cells,
        edge.g.deviation.apart,
    )


THIRD = 0.1
"""No λ_j λ_k (λ_j − λ_k) is larger."""
G_UNBOUNDED = "g is not bounded on the mesh, or not known to be"


def chi(load: VolumeMoments, edges: Sequence[NeumannMoments], cells: Cells) -> FloatArray:
    """Compute χ (1.10) by facet dof for the Crouzeix-Raviart element, this rank's cells' share."""
    if load.vanishes and all(edge.g.vanishes for edge in edges):
        return np.zeros(len(cells.exterior))
    values = np.empty((cells.tdim + 1, cells.number))
    for block in blocks(cells.number):
        values[:, block] = load.shares(cells, block)
    for edge in edges:
        if edge.g.vanishes:
            continue
        for row, share in zip(values, edge.to_cells(), strict=True):
            np.add.at(row, edge.side.cells, share)
    return cells.over_facets(values, shared=False)
