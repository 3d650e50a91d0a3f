"""Integrals over the cells that the certificate is made of.

All of them are quadratic forms in a handful of numbers per cell, in which the mesh appears through
|T| ∇λ_i·∇λ_j and |X_i − X_j|² alone. With κ_T the mean of κ on T, and

    p = κ^{-1/2} (y − κ∇u_h),   b = κ^{1/2} ∇(v − u_h),   σ: −div σ = f − f_T in T, σ·n = 0 on ∂T,

‖σ‖_T ≤ C h_T ‖f − f_T‖_T by Poincaré's inequality, and ∫_T σ·∇φ = ∫_T (f − f_T) φ for any φ.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from ..arrays import BoolArray, FloatArray, IndexArray
from ..data.loads import NOTHING, Segments, VolumeMoments, reacts, trace_of
from ..data.quadrature import Coefficient
from ..fem.cells import Cells, at_points, blocks, corner_points, dot_rows, pick, poincare, sum_rows
from .companion import Companion, bend_squares, on_facet
from .flux import Flux, field_squares
from .heights import mean_square
from .shapes import local_thirds, quadrature
from .sums import INTEGRAL_ROUNDING, Sums


def integrate(
    cells: Cells,
    kappa: Coefficient,
    w: FloatArray,
    load: VolumeMoments,
    flux: Flux,
    v: Companion,
    reaction: FloatArray = NOTHING,
    most: FloatArray | None = None,
) -> Sums:
    """Sum up the parts of the duality gap.

    Args:
        cells: The mesh.
        kappa: The coefficient.
        w: u_h at the cells' vertices, shape (d + 1, cells).
        load: Moments of f − c u_h.
        flux: y.
        v: v.
        reaction: c, or a lower bound of it, shape (cells,) or ().
        most: An upper bound of c, if that is another one: then ½∫ c u_h² is left to the caller.
    """
    sums = Sums.empty(cells.number, reacts(reaction))
    if kappa.strips is not None:
        sums.fields = np.empty((3, cells.number))
    most = reaction if most is None else most
    duality_gap = DualityGap(cells, kappa, w, load, flux, v, reaction, most, sums)
    for block in blocks(cells.number):
        duality_gap.add(block)
    return sums


_QUADRATIC = {2: 36.0, 3: 16.0}
"""Most that a squared field of degree 2 is on a triangle, in parts of its mean; on a tetrahedron
one of degree 1."""


@dataclass(frozen=True)
class _Products:
    """∫_T of what the duality gap is made of, and what may be missed of it; shapes (n,).

    Attributes:
        pp: |p|².
        bb: |b|².
        pb: p·b.
        vv: κ|∇v|².
        far: How far ∫_T |p − b|² may be above its value.
        near: The same of |p + b|².
        energy: The same of ½κ|∇v|².
    """

    pp: FloatArray
    bb: FloatArray
    pb: FloatArray
    vv: FloatArray
    far: FloatArray
    near: FloatArray
    energy: FloatArray


@dataclass(frozen=True, eq=False)
class DualityGap:
    """J(v) − D(y), which is added up range by range of cells.

    Attributes but for the last are the arguments of `integrate`.

    Attributes:
        sums: What is added to.
    """

    cells: Cells
    kappa: Coefficient
    w: FloatArray
    load: VolumeMoments
    flux: Flux
    v: Companion
    reaction: FloatArray
    most: FloatArray
    sums: Sums

    def add(self, block: slice) -> None:
        """Add what a range of cells has of the duality gap."""
        height = self.v.bumps[self.cells.facets[:, block]] if self.cells.tdim == 2 else None
        products = self._products(block, height)
        self._add_fields(block, products)
        moment = self._moment(block, height)
        if moment is not None:
            self._add_oscillation(block, products.pp, moment)
        self._add_zeroth(block, height)
        self._add_energy(block, products.vv, moment, height)

    def _products(self, block: slice, height: FloatArray | None) -> _Products:
        """Integrate the products of p, b and ∇v, exactly where κ and y allow for it."""
        cells, kappa, flux, v, w = self.cells, self.kappa, self.flux, self.v, self.w
        if kappa.values is None and flux.beyond is None:
            missed = np.zeros(3)
            found = _Products(*_exact(cells, kappa, block, flux, v, w, height), *missed)
        else:
            found = _Products(*_by_quadrature(cells, kappa, block, flux, v, w))
        if kappa.tensor is None:
            return found
        square, cross = found.pp + found.bb, 2.0 * found.pb
        squares = square - cross, square + cross
        vv, far, near, energy = _of_tensor(cells, kappa, block, flux, v, w, squares)
        return replace(
            found,
            vv=vv,
            far=found.far + far,
            near=found.near + near,
            energy=found.energy + energy,
        )

    def _add_fields(self, block: slice, found: _Products) -> None:
        """Begin the cells' shares with p and b."""
        sums, totals = self.sums, self.sums.totals
        square = found.pp + found.bb
        own = square + 0.5 * (found.near + found.far)  # the bound has the roots of both by half
        sums.indicators[block], sums.steepness[block] = own, found.vv
        if sums.fields is not None:
            for row, each in enumerate((square + 2.0 * found.pb, found.near, own)):
                sums.fields[row, block] = each
        sums.middle[block] = found.near + (square + 2.0 * found.pb)
        sums.across[block] = found.far + (square - 2.0 * found.pb)
        totals.flux += float(np.sum(found.pp))
        totals.companion += float(np.sum(found.bb))
        totals.cross += float(np.sum(found.pb))
        totals.far += float(np.sum(found.far))
        totals.near += float(np.sum(found.near))
        totals.energy_slack += float(np.sum(found.energy))

    def _moment(self, block: slice, height: FloatArray | None) -> FloatArray | None:
        """Compute means of (f − f_T)(v − u_h), shape (n,); None for f constant on each cell."""
        if self.load.hats is None or self.load.bumps is None:
            return None
        moment = dot_rows(self.load.hats[:, block], self.v.excess[:, block])
        if height is not None:
            moment += dot_rows(self.load.bumps[:, block], height)
        return moment

    # what f has beyond its means

    def _add_oscillation(self, block: slice, pp: FloatArray, moment: FloatArray) -> None:
        """Add σ, or where that is dear and c is large, what c takes up instead.

        Args:
            block: Which cells.
            pp: ∫_T |p|², shape (n,).
            moment: Means of (f − f_T)(v − u_h), shape (n,).
        """
        cells, sums, reaction = self.cells, self.sums, self.reaction
        load, volume = self.load, cells.volume[block]
        left = load.variance if self.flux.beyond is None else load.rest
        assert left is not None and load.variance is not None
        square = poincare(cells.tdim) ** 2 * cells.diameter2[block] * volume * left[block]
        share = square / pick(self.kappa.bounds.low, block)
        taken = taken_up(cells, load, self.kappa.bounds.low, block, reaction)
        if taken is not None and sums.zeroth is not None:
            whole = volume * load.variance[block]
            np.divide(whole, pick(reaction, block), out=share, where=taken)
            square = np.where(taken, 0.0, square)
            sums.zeroth[block] = np.where(taken, share, 0.0)
        sums.indicators[block] += share
        sums.totals.load += float(np.sum(share))
        work = volume * moment
        if self.flux.beyond is not None:
            if taken is not None:
                sums.totals.load_companion += float(np.sum(work[taken]))
                share = np.where(taken, 0.0, share)
            _add_by_size(sums, block, share)
            return
        sums.totals.load_companion += float(np.sum(work))
        against, slack = self._against(block, pp, square, share)
        if taken is not None:
            against, slack, work, share = (
                np.where(taken, 0.0, each) for each in (against, slack, work, share)
            )
        sums.totals.load_flux += float(np.sum(against))
        sums.totals.slack += float(np.sum(slack))
        against += slack
        sums.middle[block] += share + 2.0 * (against + work)
        sums.across[block] += share + 2.0 * (against - work)

    def _against(
        self, block: slice, pp: FloatArray, square: FloatArray, weighted: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Compute ∫_T κ^{-1/2}σ·p, and bound how far that is off, shapes (n,).

        Args:
            block: Which cells.
            pp: ∫_T |p|², shape (n,).
            square: Bound of ‖σ‖²_T, shape (n,).
            weighted: Bound of ‖κ^{-1/2}σ‖²_T, shape (n,).
        """
        cells, load = self.cells, self.load
        P = self.flux.excess[:, block]
        if cells.tdim == 2 and load.hats is not None and load.bumps is not None:
            hats, bumps = load.hats[:, block], load.bumps[:, block]
            against = _against_potential(cells, P, sum_rows(P), hats, bumps, block)
            against /= pick(self.kappa.mean, block)
            slack = np.zeros_like(against)
        else:
            against, slack = np.zeros_like(pp), np.sqrt(weighted * pp)
        if self.kappa.varies:
            # κ⁻¹ − κ_T⁻¹ times y = (y − κ_T∇u_h) + κ_T∇u_h is no gradient: bound it
            slack += np.sqrt(square) * _twist(cells, self.kappa, block, P, self.w[:, block])
        return against, slack

    # terms without gradients

    def _add_zeroth(self, block: slice, height: FloatArray | None) -> None:
        """Add c‖v − u_h‖², what c takes up, and to the energy ½ c (v − u_h)² − ½ c u_h²."""
        sums, totals, c, W = self.sums, self.sums.totals, self.v.excess[:, block], self.w[:, block]
        if sums.zeroth is None or sums.apart is None:
            return
        d = self.cells.tdim
        mass = pick(self.reaction, block) * self.cells.volume[block]
        apart = pick(self.most, block) * self.cells.volume[block] * mean_square(c, height)
        totals.energy += 0.5 * float(np.sum(apart))
        if self.most is self.reaction:
            size = sum_rows(W) ** 2 + dot_rows(W, W)
            own = 0.5 * float(np.sum(mass * size / ((d + 1) * (d + 2))))
            totals.energy -= own
            totals.energy_slack += INTEGRAL_ROUNDING * own
        else:
            less = pick(self.most - self.reaction, block) * self.cells.volume[block]
            totals.energy_slack += 0.5 * float(np.sum(less * mean_square(c, height)))
        totals.companion += float(np.sum(apart))
        sums.apart[block] = apart
        sums.zeroth[block] += apart
        sums.indicators[block] += apart
        if self.flux.taken_up is not None:
            rest = np.where(self.flux.taken_up[block], self.flux.left[block], 0.0)
            given = np.divide(rest**2, mass, out=np.zeros_like(rest), where=rest != 0.0)
            means = sum_rows(c) / (d + 1)
            if height is not None:
                means += sum_rows(height) / 3
            totals.load += float(np.sum(given))
            totals.load_companion += float(rest @ means)
            sums.zeroth[block] += given
            sums.indicators[block] += given

    # the energy

    def _add_energy(
        self, block: slice, vv: FloatArray, moment: FloatArray | None, height: FloatArray | None
    ) -> None:
        """Add ½∫ κ|∇v|² − ∫ (f − c u_h) v.

        Args:
            block: Which cells.
            vv: ∫_T κ|∇v|², shape (n,).
            moment: Means of (f − f_T)(v − u_h), shape (n,); None where f is constant on each cell.
            height: Heights of v's bumps, shape (3, n); None where it has none.
        """
        cells, load, totals = self.cells, self.load, self.sums.totals
        d, volume, W = cells.tdim, cells.volume[block], self.w[:, block]
        fv = load.mean[block] * (sum_rows(self.v.excess[:, block]) + sum_rows(W)) / (d + 1)
        if height is not None:
            fv += load.mean[block] * sum_rows(height) / 3
        if self.v.bubbles is not None:
            fv += load.mean[block] * self.v.bubbles[block] / 60
        if moment is not None and load.hats is not None:
            hats = load.hats[:, block]
            fv += dot_rows(hats, W)
            fv += moment
            if self.v.thirds is not None:
                third = local_thirds(cells, self.v.thirds, block)
                rise = 12.0 / 180.0 * np.stack([hats[j] - hats[k] for j, k in cells.others])
                fv += dot_rows(third, rise)
                # ∫_T c_F² = |T|/840, for what f has beyond its affine part
                size = sum_rows(np.abs(third)) / np.sqrt(840.0)
                if self.v.bubbles is not None:
                    size += np.abs(self.v.bubbles[block]) / np.sqrt(2520.0)
                left = load.variance if self.flux.beyond is None else load.rest
                assert left is not None
                totals.energy_slack += float(np.sum(volume * np.sqrt(left[block]) * size))
        totals.energy += float(np.sum(0.5 * vv - volume * fv))

    # what there is on facets

    def add_edge(self, edge: Segments) -> None:
        """Add what g has beyond its means on Γg, and where there is a b what v − u_h is.

        σ gets a part with div σ = 0 in T and σ·n = g − g_F on F, so ∫_T σ·∇φ = ∫_F (g − g_F) φ.
        Where κ varies within cells, y − κ∇u_h is no gradient, and there is a slack as with f. Where
        b is large it takes up g − g_F, as c does with f.

        Args:
            edge: Values of g − b u_h.
        """
        cells, kappa, flux, sums = self.cells, self.kappa, self.flux, self.sums
        jump = apart(cells, self.w, edge, self.v.vertices, self.v.bumps)
        at, sizes = edge.oscillation(flux.beyond is not None)
        low = pick(kappa.bounds.low, at)
        squares = sizes**2 / low
        sums.indicators[at] += squares
        sums.totals.neumann = float(np.sum(squares))
        if edge.most.any():
            self._add_loss(edge, jump)
        if edge.given.any() and (cells.tdim != 2 or flux.beyond is not None):
            # σ is known by its norm alone; what b takes up has a product with v − u_h all the same
            taken = edge.measure * edge.weights[:, None] * edge.tau(flux.beyond is not None)
            sums.totals.load_companion += float(np.sum(taken * jump))
        if cells.tdim != 2:
            sums.totals.loose = sums.totals.neumann
            return
        if flux.beyond is not None:
            sums.totals.load += sums.totals.neumann
            _add_by_size(sums, at, squares)
            return
        # σ has been counted for f: ‖σ_f + σ_g‖² is at most ‖σ_f‖² and this more
        more = (2.0 * self._size_of_oscillation(at) * sizes + sizes**2) / low
        sums.totals.load += float(np.sum(more))
        for row in (sums.middle, sums.across):
            row[at] += more
        self._add_edge_products(edge, jump)
        if kappa.varies:
            slack = sizes * _twist(cells, kappa, at, flux.excess[:, at], self.w[:, at])
            sums.totals.slack += float(np.sum(slack))
            for row in (sums.middle, sums.across):
                row[at] += 2.0 * slack

    def _add_loss(self, edge: Segments, jump: FloatArray) -> None:
        """Add b‖v − u_h‖²_F, and ‖q − g_F‖²_F/b where b takes that up.

        Where b varies within the facet, −½∫_F b u_h² is left to the caller.

        Args:
            edge: Values of g − b u_h.
            jump: v − u_h at its points, shape (q, n).
        """
        cells, flux, sums = self.cells, self.flux, self.sums
        if sums.zeroth is None:
            sums.zeroth = np.zeros(cells.number)
        steady, (least, most) = edge.steady[edge.place] * edge.measure, edge.of_loss * edge.measure
        squares = edge.weights @ jump**2
        apart = most * squares
        own = np.einsum("qin,in->qn", edge.hats, trace_of(cells, edge.side, self.w))
        size = 0.5 * float(np.sum(steady * (edge.weights @ own**2)))
        sums.totals.energy += 0.5 * float(np.sum(apart)) - size
        sums.totals.energy_slack += INTEGRAL_ROUNDING * size
        sums.totals.energy_slack += 0.5 * float(np.sum((most - least) * squares))
        sums.totals.companion += float(np.sum(apart))
        given = edge.taken(flux.shed, flux.beyond is not None)
        if flux.shed is not None:
            n, whole = len(edge.loss), edge.measure * (edge.weights @ jump)
            area = np.bincount(edge.place, edge.measure, minlength=n)
            means = np.bincount(edge.place, whole, minlength=n) / area
            sums.totals.load_companion += float(flux.shed @ means)
        sums.totals.load += float(np.sum(given))
        for at, amounts in ((edge.side.cells, apart), (edge.facets.cells, given)):
            np.add.at(sums.indicators, at, amounts)
            np.add.at(sums.zeroth, at, amounts)

    def _size_of_oscillation(self, at: IndexArray) -> FloatArray:
        """Bound ‖σ‖_T on some cells, of what f has beyond its mean and c does not take up."""
        cells, load = self.cells, self.load
        if load.variance is None:
            return np.zeros(len(at))
        square = cells.diameter2[at] * cells.volume[at] * load.variance[at]
        size: FloatArray = poincare(cells.tdim) * np.sqrt(square)
        taken = taken_up(cells, load, self.kappa.bounds.low, at, self.reaction)
        return size if taken is None else np.where(taken, 0.0, size)

    def _add_edge_products(self, edge: Segments, jump: FloatArray) -> None:
        """Add σ's products with p and b: ∫_F (g − g_F) φ with the potentials φ of both, d = 2.

        Args:
            edge: Values of g − b u_h.
            jump: v − u_h at its points, shape (q, n).
        """
        sums, at = self.sums, edge.side.cells
        weights = edge.measure * edge.weights[:, None] * edge.rest
        sums.totals.load_companion += float(np.sum(weights * jump))
        potential = _edge_potential(self.cells, self.kappa, edge, self.flux)
        # where b takes up g − g_F there is no σ
        weights = np.where(edge.given[edge.place], 0.0, weights)
        sums.totals.load_flux += float(np.sum(weights * potential))
        np.add.at(sums.middle, at, 2.0 * (weights * (potential + jump)).sum(axis=0))
        np.add.at(sums.across, at, 2.0 * (weights * (potential - jump)).sum(axis=0))


def _add_by_size(sums: Sums, where: slice | IndexArray, squares: FloatArray) -> None:
    """Add a part of σ to the cells' squares of which no more than the norm is known.

    Args:
        sums: What to add to.
        where: Which cells, each once.
        squares: ‖κ^{-1/2}σ‖²_T, shape (n,).
    """
    far, near = (_swollen(row[where], squares) for row in (sums.across, sums.middle))
    sums.totals.far += float(np.sum(far))
    sums.totals.near += float(np.sum(near))
    sums.across[where] += squares + far
    sums.middle[where] += squares + near


def taken_up(
    cells: Cells,
    load: VolumeMoments,
    low: FloatArray,
    where: slice | IndexArray,
    reaction: FloatArray,
) -> BoolArray | None:
    """Tell where c takes up what f has beyond its mean more cheaply than σ; None for nowhere.

    Args:
        cells: The mesh.
        load: Moments of f, which is not constant on each cell.
        low: Lower bound of κ, shape (cells,) or ().
        where: Which cells.
        reaction: c, shape (cells,) or ().
    """
    if not reacts(reaction) or load.variance is None:
        return None
    variance = load.variance[where]
    square = poincare(cells.tdim) ** 2 * cells.diameter2[where] * variance
    return np.asarray(variance * pick(low, where) < pick(reaction, where) * square)


def apart(
    cells: Cells, w: FloatArray, edge: Segments, vertices: FloatArray, bumps: FloatArray
) -> FloatArray:
    """Return v − u_h at the points of facets, shape (q, n)."""
    jump = on_facet(cells, edge.side, edge.hats, vertices, bumps)
    jump -= np.einsum("qin,in->qn", edge.hats, trace_of(cells, edge.side, w))
    return jump


def _swollen(squares: FloatArray, more: FloatArray) -> FloatArray:
    """Bound what (a + b)² has beyond a² + b², a² and b² given."""
    return 2.0 * np.sqrt(np.maximum(squares, 0.0) * more)


def of_gradients(kappa: Coefficient, sums: Sums) -> FloatArray:
    """Bound ∫_T |κ^{-1/2}(p + κ^{-1/2}σ + b)|², shape (cells,).

    On strips along the sides of T, κ may be less than elsewhere: little of p + b and of σ is there.
    """
    core, lowest = kappa.eigenvalues.core[0], kappa.eigenvalues.lowest
    found = np.maximum(sums.middle, 0.0) / core
    if sums.fields is None or kappa.strips is None:
        return found
    own, missed, square = np.maximum(sums.fields, 0.0)
    rest = np.maximum(sums.indicators - square, 0.0)
    there = 1.0 / core + 36.0 * kappa.strips * core / lowest**2
    inner = core.copy()
    if kappa.cut is not None:  # along the jump, maybe, and then integrals have what is in strips
        cut = kappa.cut.pieces.parent
        inner[cut] = lowest[cut]
    apart = np.sqrt(own / inner + missed / lowest) + np.sqrt(rest * there)
    return np.where(kappa.strips > 0.0, apart**2, found)


def _twist(
    cells: Cells,
    kappa: Coefficient,
    where: slice | IndexArray,
    P: FloatArray,
    W: FloatArray,
) -> FloatArray:
    """Bound max_T |κ⁻¹ − κ_T⁻¹| ‖y‖_T, but of strips along T's sides only what fields have there.

    Args:
        cells: The mesh.
        kappa: The coefficient.
        where: Which cells.
        P: Fluxes of y − κ_T∇u_h out of them.
        W: u_h at their vertices.
    """
    mean, low, high = (pick(k, where) for k in (kappa.mean, *kappa.bounds.core))
    spread = np.maximum(1 / low - 1 / mean, 1 / mean - 1 / high)
    if kappa.strips is not None:
        spread = spread + 36.0 * pick(kappa.strips, where) / pick(kappa.bounds.lowest, where)
    steep = np.sqrt(np.maximum(dot_rows(W, cells.apply(W, where)), 0.0))
    return spread * (np.sqrt(np.maximum(field_squares(cells, P, where), 0.0)) + mean * steep)


def _exact(
    cells: Cells,
    kappa: Coefficient,
    block: slice,
    flux: Flux,
    v: Companion,
    w: FloatArray,
    height: FloatArray | None,
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Integrate |p|², |b|², p·b and κ|∇v|² over T for constant κ, shapes (cells in the block,).

    Args:
        cells: The mesh.
        kappa: The coefficient.
        block: Which cells.
        flux: y.
        v: v.
        w: u_h at the cells' vertices, shape (d + 1, cells).
        height: Heights of v's bumps, shape (3, n); None where it has none.
    """
    d, k, P = cells.tdim, pick(kappa.mean, block), flux.excess[:, block]
    s, c = sum_rows(P), v.excess[:, block]
    if height is not None:
        c = c - 4 / 3 * height
    # the mean of ∇(v − u_h) is Σ c_i ∇λ_i
    slopes, means = cells.apply(c, block), sum_rows(c)
    bb, along = dot_rows(c, slopes), dot_rows(w[:, block], slopes)
    if height is not None:
        bb += bend_squares(cells, height, block)
        means -= 2 / 3 * sum_rows(height)
    # ∫ p·∇φ = −∫ φ div p + Σ flux_i (mean of φ on facet i), with φ = v − u_h
    pb = (s * means / (d + 1) - dot_rows(P, c)) / d
    vv = flux.steepness[block] + 2.0 * along + bb
    return field_squares(cells, P, block) / k, k * bb, pb, k * vv


def _by_quadrature(
    cells: Cells, kappa: Coefficient, block: slice, flux: Flux, v: Companion, w: FloatArray
) -> tuple[FloatArray, ...]:
    """Integrate the same for any κ and any y, and bound what that misses.

    Returns:
        The fields of `_Products`, in their order.
    """
    values, cut, mean = kappa.values, kappa.cut, kappa.mean
    if values is None or cut is None:
        exact = (
            (pick(mean, block), weight, hat) for hat, weight in zip(*quadrature(), strict=True)
        )
        rows = _at_points(cells, mean, block, flux, v, w, exact)
        return *rows[:4], *np.zeros((3, block.stop - block.start))
    largest = (3 if flux.beyond is None else 6) ** 2 if cells.tdim == 2 else (cells.tdim + 1) ** 2

    def integrals(
        where: slice | IndexArray, errors: FloatArray, there: FloatArray, hats: FloatArray
    ) -> FloatArray:
        points = zip(there, kappa.rule.weights, hats, strict=True)
        rows = _at_points(cells, mean, where, flux, v, w, points)
        return _with_slack(rows, errors, cells.tdim, largest)

    return tuple(_over_pieces(kappa, block, integrals))


Integrals = Callable[[slice | IndexArray, FloatArray, FloatArray, FloatArray], FloatArray]
"""Of cells or those of pieces, errors as in `Coefficient.cut`, κ at the rule's points, and these in
barycentric coordinates: rows of what is integrated, a piece's as if it were the cell."""


def _over_pieces(kappa: Coefficient, block: slice, integrals: Integrals) -> FloatArray:
    """Integrate over a range of cells, those that are cut piece by piece, shape (rows, n)."""
    values, cut, rule = kappa.values, kappa.cut, kappa.rule
    assert values is not None and cut is not None
    rows = integrals(block, cut.errors[:, block], values[:, block], rule.hats.T)
    first, last = np.searchsorted(cut.pieces.parent, (block.start, block.stop))
    if first < last:
        pieces = cut.pieces[np.arange(first, last)]
        hats = at_points(pieces.hats, rule.hats).swapaxes(0, 1)
        known = cut.errors_inside[:, first:last], kappa.inside[:, first:last]
        there = integrals(pieces.parent, *known, hats) * pieces.share
        which, place = np.unique(pieces.parent - block.start, return_inverse=True)
        rows[:, which] = [np.bincount(place, row, minlength=len(which)) for row in there]
    return rows


def _of_tensor(
    cells: Cells,
    kappa: Coefficient,
    block: slice,
    flux: Flux,
    v: Companion,
    w: FloatArray,
    mean_squares: tuple[FloatArray, FloatArray],
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Bound what a tensor that varies within cells does to the duality gap.

    For F = y − κ∇z, z = v or 2u_h − v, and with N the root of the rule's ∫ |·|² / k where lengths
    are stretched, ‖κ^{-1/2}F‖ ≤ (1 − θ)^{-1/2} (N(F) + 2ϱ N(k∇z)): the rule is exact for the
    polynomial within ϱ κ_T of κ.

    Args:
        cells: The mesh.
        kappa: The coefficient.
        block: Which cells.
        flux: y.
        v: v.
        w: u_h at the cells' vertices, shape (d + 1, cells).
        mean_squares: ∫_T |p − b|² and ∫_T |p + b|² as they are for κ_T.

    Returns:
        ∫_T κ|∇v|² by the rule; what the duality gap has beyond that of κ_T; and what the rule may
        have missed of ½∫_T κ|∇v|².
    """
    d, k, volume = cells.tdim, pick(kappa.mean, block)[:, None], cells.volume[block]
    P, slopes, theta = flux.excess[:, block], v.slopes(cells, block), kappa.spread[block]
    s, (corners, gradients) = sum_rows(P), cells.corners(block)
    own = np.einsum("in,ink->nk", w[:, block], gradients)
    off, rule = kappa.apart(cells, block), kappa.rule
    squares, steep = np.zeros((2, 2, len(volume)))
    vv, yy = np.zeros((2, len(volume)))
    for tensor, weight, hat in zip(off, rule.weights, rule.hats.T[:, :, None], strict=True):
        Q = hat * s - P
        if flux.beyond is not None:
            Q += flux.beyond.through(cells, block, hat)
        y = np.einsum("in,ink->nk", Q, corners) / (d * volume)[:, None] + k * own
        yy += weight * (y**2).sum(axis=1)
        change = np.einsum("in,ink->nk", np.broadcast_to(slopes(hat), w[:, block].shape), gradients)
        for i, slope in enumerate((own + change, own - change)):
            flow = k * slope + np.einsum("nij,nj->ni", tensor, slope)
            squares[i] += weight * ((y - flow) ** 2).sum(axis=1)
            steep[i] += weight * (slope**2).sum(axis=1)
            if i == 0:
                vv += weight * (flow * slope).sum(axis=1)
    rough, mean = kappa.rough[block], k[:, 0]
    found = np.sqrt(volume / mean * squares) + 2.0 * rough * np.sqrt(volume * mean * steep)
    far, near = found**2 / (1.0 - theta) - np.stack(mean_squares)
    energy = rough * mean * volume * steep[0]
    if kappa.strips is not None:
        part = _QUADRATIC[d] * kappa.strips[block] * volume
        of_y = part * yy / kappa.bounds.lowest[block]
        of_v, of_other = part * kappa.bounds.high[block] * steep
        far, near = far + 4.0 * (of_y + of_v), near + 4.0 * (of_y + of_other)
        energy = energy + 0.5 * of_v
    return volume * vv, far, near, energy


class Within(NamedTuple):
    """κ∇v where κ varies within cells; of a tensor with lengths stretched.

    Attributes:
        pull: ∫_T κ∇v·∇λ_i, shape (d + 1, cells).
        unsure: How far ∫_T κ∇v·e may be from that, at most, for a unit vector e, shape (cells,).
        mean: Upper bound of κ's mean over T, shape (cells,).
    """

    pull: FloatArray
    unsure: FloatArray
    mean: FloatArray

    @classmethod
    def of(cls, cells: Cells, kappa: Coefficient, v: Companion, w: FloatArray) -> Within | None:
        """Integrate; None where κ is constant on each cell.

        Args:
            cells: The mesh.
            kappa: The coefficient.
            v: v.
            w: u_h at the cells' vertices, shape (d + 1, cells).
        """
        if not kappa.varies:
            return None
        work = _tensor_within if kappa.tensor is not None else _within
        pull, (unsure, mean) = np.empty((cells.tdim + 1, cells.number)), np.empty((2, cells.number))
        for block in blocks(cells.number):
            pull[:, block], unsure[block], mean[block] = work(cells, kappa, block, v, w)
        return cls(pull, unsure, mean)


Row = tuple[FloatArray, FloatArray, FloatArray]
"""Figures of some cells for `Within`: pull, unsure, mean."""


def _within(cells: Cells, kappa: Coefficient, block: slice, v: Companion, w: FloatArray) -> Row:
    """Integrate by quadrature on cells, or on their pieces, and bound what that misses."""
    weights = kappa.rule.weights

    def integrals(
        where: slice | IndexArray, errors: FloatArray, there: FloatArray, hats: FloatArray
    ) -> FloatArray:
        volume, slopes = cells.volume[where], v.slopes(cells, where)
        total, steep = np.zeros_like(w[:, where]), np.zeros_like(volume)
        for k, weight, hat in zip(there, weights, hats, strict=True):
            gamma = w[:, where] + slopes(hat.reshape(len(hat), -1))
            total += weight * k * gamma
            steep += weight * dot_rows(gamma, cells.apply(gamma, where))
        _, _, W, _, _, strip, _ = errors
        unsure = (2.0 * W + (cells.tdim + 1) * strip) * np.sqrt(volume * np.maximum(steep, 0.0))
        mean = weights @ there + 2.0 * W + strip
        return np.stack([*cells.apply(total, where), unsure, mean])

    *pull, unsure, mean = _over_pieces(kappa, block, integrals)
    return np.array(pull), unsure, mean


def _tensor_within(
    cells: Cells, kappa: Coefficient, block: slice, v: Companion, w: FloatArray
) -> Row:
    """Integrate the same of a tensor, which is within ϱ κ_T of what the rule is exact for."""
    k, volume, slopes = pick(kappa.mean, block), cells.volume[block], v.slopes(cells, block)
    _, gradients = cells.corners(block)
    total, steep = np.zeros((len(volume), cells.tdim)), np.zeros_like(volume)
    rule, off = kappa.rule, np.zeros((len(volume), cells.tdim, cells.tdim))
    for tensor, weight, hat in zip(
        kappa.apart(cells, block), rule.weights, rule.hats.T[:, :, None], strict=True
    ):
        slope = np.einsum("in,ink->nk", w[:, block] + slopes(hat), gradients)
        total += weight * (k[:, None] * slope + np.einsum("nij,nj->ni", tensor, slope))
        steep += weight * (slope**2).sum(axis=1)
        off += weight * tensor
    pull = volume * np.einsum("ink,nk->in", gradients, total)
    missed = 2.0 * kappa.rough[block] * k
    strips: FloatArray = np.zeros_like(missed)
    if kappa.strips is not None:
        strips = _QUADRATIC[cells.tdim] * kappa.strips[block] * kappa.bounds.high[block]
    mean = k + missed + strips + np.linalg.norm(off, axis=(1, 2))
    unsure = (missed + strips) * volume * np.sqrt(steep)
    return pull, unsure, np.fmin(mean, pick(kappa.bounds.high, block))


def _with_slack(rows: FloatArray, errors: FloatArray, d: int, largest: int) -> FloatArray:
    """Take the first four rows, and what quadrature may miss; for errors see `Coefficient.enclose`.

    With z = v or 2u_h − v it is the smaller of two bounds of what it misses of ∫ κ⁻¹|y − κ∇z|²:
    that of its three products, and what follows from ‖κ^{-1/2}(y − κ∇z)‖ ≤ N(y − κ∇z) + 2R N(∇z),
    where N(·)² is 1 + t times the quadrature of κ⁻¹|·|². |y|² is at most `largest` times its mean.
    On strips κ may be what it is nowhere else; W and W' have that for products with constants.
    """
    pp, bb, pb, vv, yy, *at_z = rows
    R, t, W, inverse_W, strip_low, strip_high, _ = errors
    slack = []
    for sign, (zz, steep) in ((-2.0, at_z[:2]), (2.0, at_z[2:])):
        # an affine field is nowhere more than d + 1 times its norm
        strips = largest * strip_low * yy + (d + 1) ** 2 * strip_high * zz
        products = 2.0 * (inverse_W * yy + W * zz) + strips
        square = np.maximum(pp + bb + sign * pb, 0.0)
        norm = (1.0 + t) * (np.sqrt(square) + 2.0 * R * np.sqrt(np.maximum(steep, 0.0))) ** 2
        slack.append(np.fmin(products, norm - square + 2.0 * strips))
    energy = (W + 0.5 * (d + 1) ** 2 * strip_high) * at_z[0]
    return np.stack([pp, bb, pb, vv, *slack, energy])


def _at_points(
    cells: Cells,
    mean: FloatArray,
    where: slice | IndexArray,
    flux: Flux,
    v: Companion,
    w: FloatArray,
    points: Iterable[tuple[FloatArray, float, FloatArray]],
) -> FloatArray:
    """Average over points |T| times what the duality gap is made of.

    It is |p|², |b|², p·b, κ|∇v|², |y|², and |∇z|² and κ⁻¹|∇z|² for z = v and z = 2u_h − v.

    At a point with barycentric coordinates λ_k, y − κ_T∇u_h = Σ Q_k X_k / (d |T|) with
    Q_k = λ_k ΣP − P_k plus what y has beyond, and ∇(v − u_h) = Σ γ_k ∇λ_k with
    γ_k = c_k + 4 Σ_l height_l λ_m, where k, l, m are the three vertices, plus what v has beyond. As
    Σ Q_k = 0, (Σ Q_k X_k)·∇λ_i = Q_i.

    Args:
        cells: The mesh.
        mean: κ_T.
        where: Which cells.
        flux: y.
        v: v.
        w: u_h at the cells' vertices, shape (d + 1, cells).
        points: κ, a weight, and the point's barycentric coordinates, shape (d + 1,) or (d + 1, n).
    """
    d, mean, volume = cells.tdim, pick(mean, where), cells.volume[where]
    P, W, slopes = flux.excess[:, where], w[:, where], v.slopes(cells, where)
    out_of_cell = sum_rows(P)
    # |T| times products of q = y − κ_T∇u_h, of ∇u_h, and of e = ∇(v − u_h)
    uu = dot_rows(W, cells.apply(W, where))
    rows = np.zeros((9, len(volume)))
    for kappa, weight, hat in points:
        hat = hat.reshape(len(hat), -1)
        Q = hat * out_of_cell - P
        if flux.beyond is not None:
            Q += flux.beyond.through(cells, where, hat)
        qq = np.zeros_like(out_of_cell)
        for (i, j), length in zip(cells.pairs, cells.lengths[:, where], strict=True):
            qq -= Q[i] * Q[j] * length
        qq /= d**2 * volume
        gamma = slopes(hat)
        of_e = cells.apply(gamma, where)
        ee, ue = dot_rows(gamma, of_e), dot_rows(W, of_e)
        qu, qe = dot_rows(Q, W) / d, dot_rows(Q, gamma) / d
        off = kappa - mean
        vv, other = uu + 2.0 * ue + ee, uu - 2.0 * ue + ee  # of ∇v, and of ∇(2u_h − v)
        values = (
            (qq - 2.0 * off * qu + off**2 * uu) / kappa,
            kappa * ee,
            qe - off * ue,
            kappa * vv,
            qq + 2.0 * mean * qu + mean**2 * uu,
            vv,
            vv / kappa,
            other,
            other / kappa,
        )
        for row, value in zip(rows, values, strict=True):
            row += weight * value
    return rows


def _edge_potential(cells: Cells, kappa: Coefficient, edge: Segments, flux: Flux) -> FloatArray:
    """Find φ with ∇φ = κ_T⁻¹ y − ∇u_h, as in `_against_potential`, at points, shape (q, n)."""
    side, d = edge.side, cells.tdim
    P = flux.excess[:, side.cells]
    s, row = sum_rows(P), np.arange(len(side.cells))
    apex, base = corner_points(cells, side, stretched=True)
    middle = (apex + base.sum(axis=0)) / (d + 1)
    pull = P[side.local, row][:, None] * (apex - middle)
    pull += np.einsum("in,ink->nk", P[cells.others[side.local].T, row], base - middle)
    x = np.einsum("qin,ink->qnk", edge.hats, base) - middle
    potential = 0.5 * s * (x**2).sum(axis=-1) - np.einsum("qnk,nk->qn", x, pull)
    potential /= d * cells.volume[side.cells] * pick(kappa.mean, side.cells)
    return potential


def _against_potential(
    cells: Cells,
    P: FloatArray,
    s: FloatArray,
    hats: FloatArray,
    bumps: FloatArray,
    block: slice,
) -> FloatArray:
    """Compute ∫_T (f − f_T) φ, ∇φ = y − κ_T∇u_h, for d = 2, shape (cells in the block,).

    2d |T| φ = Σ P_i |x − X_i|² up to a constant, and for x = Σ λ_i X_i with L_ij = |X_i − X_j|²
    |x − X_i|² = Σ_j λ_j L_ij − Σ_{j<k} λ_j λ_k L_jk.
    """
    total = np.zeros_like(s)
    quarter = s / 4
    for (i, j), length in zip(cells.pairs, cells.lengths[:, block], strict=True):
        here = hats[j] * P[i]
        here += hats[i] * P[j]
        here -= quarter * bumps[3 - i - j]
        here *= length
        total += here
    return total / (2 * cells.tdim)
