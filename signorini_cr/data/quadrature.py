"""The data of a problem as numbers: values, means and moments by quadrature.

f, g, u_D, α and κ are known by their values at quadrature points (`Problem.quadrature_degree`), and
where they are numbers exactly.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations, product
from math import factorial

import basix
import numpy as np
import ufl
from dolfinx import fem
from dolfinx.mesh import Mesh
from mpi4py import MPI
from ufl.core.expr import Expr

from .. import compat
from ..arrays import FloatArray, Int32Array
from ..fem.cells import BoundaryFacets, Cells, points_of
from ..fem.conditions import Condition, as_number, may_change
from ..fem.lowering import by_components
from ..fem.physics import Imposed
from ..fem.pointwise import Samples, Unknown
from ..fem.problem import Forms
from ..fem.simplified import simplified
from ..fem.space import facet_quadrature
from ..mesh.domain import Domain, facet_entities
from .cutting import Cut, cut
from .jets import Boxes, Enclosure, Range, lowered, values
from .pieces import Pieces
from .ranges import Deviation, errors_on, range_of, ranges_on

NO_RANGE = "the coefficient has no computable upper and lower bound"

STEADY = 1e-13
"""Part of κ by which its bounds on a cell may differ where it is a constant, rounded."""

LOAD_DEGREE, KAPPA_DEGREE = 4, 8
"""Degrees of the certificate's rules, which are exact for products of two quadratics, and, for q
and s quadratic, y and ∇z affine, for s |y − q ∇z|²."""


class Rule:
    """Quadrature on cells.

    Attributes:
        weights: Weights, which add up to 1, shape (q,).
        hats: λ_i at the points, shape (d + 1, q).
        bumps: b_i = 4 λ_j λ_k, i, j, k different, at the points, shape (d + 1, q); for d = 2.
    """

    def __init__(self, mesh: Mesh, degree: int):
        """Take the rule that is exact for polynomials of a degree."""
        self.degree = degree
        self.points, weights = basix.make_quadrature(mesh.basix_cell(), degree)
        self.weights = weights / weights.sum()
        self.hats = np.vstack([1.0 - self.points.sum(axis=1), self.points.T])
        self.bumps = np.stack(
            [4.0 * np.delete(self.hats, i, axis=0).prod(axis=0) for i in range(len(self.hats))]
        )


FEW = 1 << 14
"""At so many points, on all ranks, NumPy has evaluated a formula before a compiler has begun."""


class Volume:
    """Values of an expression in cells.

    Args:
        expression: A scalar.
        mesh: The mesh that it was written for.
        rule: Where to evaluate.
    """

    def __init__(self, expression: Expr, mesh: Mesh, rule: Rule):
        """Note what is to be evaluated."""
        self.number, self.rule = as_number(expression), rule
        self.expression, self._mesh = expression, mesh

    def at(self, cells: Cells) -> FloatArray:
        """Evaluate at the quadrature points of owned cells, shape (cells, q); collective."""
        found = self._by_numpy(cells) if self._few_on(cells.domain.mesh) else None
        if found is None:
            which = np.arange(cells.number, dtype=np.int32)
            values = compat.bound(self._compiled, cells.domain.own)
            found = values.eval(cells.domain.mesh, which).reshape(
                cells.number, len(self.rule.weights)
            )
        self.deviation.off_null_sets(found.T, None, cells, self.rule.hats)
        return found

    def _few_on(self, mesh: Mesh) -> bool:
        """Tell whether there are so few points that compiling would take longer; on all ranks."""
        number = mesh.topology.index_map(mesh.topology.dim).size_global
        return number * len(self.rule.weights) <= FEW

    def _by_numpy(self, cells: Cells) -> FloatArray | None:
        """Evaluate without compiling; None where that can't be done, the same on all ranks."""
        samples = Samples(cells.domain, np.arange(cells.number), self.rule.hats.T)
        try:
            return samples.of(self.deviation.expression)
        except Unknown:
            return None

    @cached_property
    def _compiled(self) -> fem.Expression:
        """The expression, compiled; collective when first asked for."""
        return compat.compile_expression(self.expression, self.rule.points, self._mesh)

    @cached_property
    def deviation(self) -> Deviation:
        """The `Deviation` from polynomials."""
        return Deviation(self.expression)

    def exact_for(self, degree: int) -> Volume:
        """Return the same by a rule that is exact for a degree at least."""
        if self.number is not None or self.rule.degree >= degree:
            return self
        if degree not in self._others:
            rule = Rule(self._mesh, degree)
            self._others[degree] = Volume(self.expression, self._mesh, rule)
        return self._others[degree]

    @cached_property
    def plain(self) -> Rule:
        """A rule for pieces of cells: what is missed on these is known."""
        return Rule(self._mesh, LOAD_DEGREE)

    @cached_property
    def _others(self) -> dict[int, Volume]:
        return {}


class Tensor:
    """A coefficient that is a symmetric tensor.

    Args:
        expression: A tensor.
        mesh: The mesh that it was written for.
        rule: Where to evaluate.

    Attributes:
        entries: The d² scalars, row by row.
        skew: κ_ij − κ_ji, i < j, but for those that formulas say are 0.
        rule: What the means are found by.
        fine: What else is integrated by; exact for degree 8.
    """

    def __init__(self, expression: Expr, mesh: Mesh, rule: Rule):
        """Take its entries apart."""
        self._d, self._mesh, self.rule = mesh.geometry.dim, mesh, rule
        pairs = product(range(self._d), repeat=2)
        self.entries = [by_components(expression[i, j]) for i, j in pairs]
        self.skew = [
            self.entries[i * self._d + j] - self.entries[j * self._d + i]
            for i, j in combinations(range(self._d), 2)
            if not _same(self.entries[i * self._d + j], self.entries[j * self._d + i])
        ]
        self.fine = Rule(mesh, KAPPA_DEGREE)
        self._compiled: dict[int, fem.Expression] = {}

    def prepare(self, rule: Rule) -> None:
        """Compile what evaluates at a rule's points; collective where that has not been done."""
        if rule.degree not in self._compiled:
            rows = ufl.as_vector(self.entries)
            self._compiled[rule.degree] = compat.compile_expression(rows, rule.points, self._mesh)

    def at(self, domain: Domain, rule: Rule, block: slice) -> FloatArray:
        """Evaluate the symmetric part at points of some owned cells, shape (cells, q, d, d)."""
        found = self.as_given(domain, rule, block)
        return np.asarray(0.5 * (found + found.transpose(0, 1, 3, 2)))

    def as_given(self, domain: Domain, rule: Rule, block: slice) -> FloatArray:
        """Evaluate the same with what is not symmetric."""
        self.prepare(rule)
        which = np.arange(block.start, block.stop, dtype=np.int32)
        found = compat.bound(self._compiled[rule.degree], domain.own).eval(domain.mesh, which)
        return np.asarray(found.reshape(len(which), len(rule.weights), self._d, self._d))

    def means(self, domain: Domain) -> FloatArray:
        """Average over owned cells, shape (cells, d, d)."""
        number = domain.mesh.topology.index_map(domain.mesh.topology.dim).size_local
        values = self.at(domain, self.rule, slice(0, number))
        return np.asarray(np.einsum("nqij,q->nij", values, self.rule.weights))

    def stretch(self, domain: Domain) -> FloatArray:
        """Compute (κ_T/k)^{-1/2}, κ_T a cell's mean and k^d its determinant, shape (cells, d, d).

        With these for `Cells.stretch` k is a scalar coefficient.
        """
        eigenvalues, vectors = np.linalg.eigh(self.means(domain))
        mean = np.exp(np.log(eigenvalues).mean(axis=1, keepdims=True))
        scaled: FloatArray = vectors * np.sqrt(mean / eigenvalues)[:, None]
        return scaled @ vectors.transpose(0, 2, 1)


def _same(a: Expr, b: Expr) -> bool:
    """Tell whether two formulas are the same, as formulas or where they cancel."""
    return bool(a == b) or as_number(simplified(a - b)) == 0.0


@dataclass(frozen=True, eq=False)
class Between:
    """Bounds of κ on each cell, or of its eigenvalues, shape (cells,), or () where κ is a number.

    Attributes:
        core: Lower and upper bound but for strips along the cells' sides.
        lowest: Lower bound, strips included.
        high: Upper bound, strips included.
        low: What stands for the lower bound where fields are weighed by 1/κ: less than in `core`
            where there are strips with another κ, and more than in these.
    """

    core: Range
    lowest: FloatArray
    high: FloatArray
    low: FloatArray

    @classmethod
    def all_over(cls, low: FloatArray, high: FloatArray) -> Between:
        """Take what holds in strips as it does elsewhere."""
        return cls((low, high), low, high, low)

    @classmethod
    def with_strips(
        cls, core: Range, part: FloatArray, lowest: FloatArray, high: FloatArray
    ) -> Between:
        """Take what does not; for the strips' part of each cell see `Coefficient.strips`."""
        return cls(core, lowest, high, _with_strips(core[0], part, lowest))


class Coefficient:
    """κ on each cell; of a tensor what it is where lengths are measured by `Tensor.stretch`.

    Attributes:
        mean: κ_T, shape (cells,), or () where κ is a number.
        bounds: Of κ.
        eigenvalues: Of its eigenvalues with lengths as they are; of a scalar the same.
        strips: Part of each cell that its strips along the sides have, shape (cells,); None where
            there are none on any rank.
        tensor: The same where it is a tensor that varies within cells; else None.
        spread: θ, (1 − θ) κ_T ≤ κ ≤ (1 + θ) κ_T, for that tensor, shape (cells,).
        rough: ϱ, where that tensor is within ϱ κ_T of a quadratic polynomial, shape (cells,).
        values: κ at the points of a rule that is exact for degree 8, shape (q, cells); None where
            κ is constant on each cell of all ranks.
        rule: That rule.
        smallest: Lower bound of κ over all ranks.
        cut: How far κ and 1/κ are from polynomials on each cell, see `enclose`.
        inside: κ at the points of the pieces, shape (q, pieces).
        reason: Why there are no bounds, if there are none.
    """

    cut: Cut | None = None
    inside: FloatArray

    tensor: Tensor | None = None
    spread: FloatArray
    rough: FloatArray
    strips: FloatArray | None = None

    def __init__(self, kappa: Volume | Tensor, cells: Cells):
        """Evaluate κ; collective."""
        self.reason: str | None = None
        self.values: FloatArray | None = None
        if isinstance(kappa, Tensor):
            self.bounds, self.eigenvalues = self._of_tensor(kappa, cells)
        else:
            self.bounds = self.eigenvalues = self._of_scalar(kappa, cells)
        # The same way on all ranks
        strips = self.strips is not None and bool((self.strips > 0.0).any())
        if not cells.comm.allreduce(strips, op=MPI.LOR):
            self.strips = None
        smallest = float(np.min(self.eigenvalues.lowest, initial=np.inf))
        self.smallest = min(cells.comm.allgather(smallest))
        reasons = [reason for reason in cells.comm.allgather(self.reason) if reason]
        self.reason = reasons[0] if reasons else None
        if self.reason is None and not self.smallest > 0:
            self.reason = "the coefficient's computable lower bound is not positive"

    @property
    def varies(self) -> bool:
        """True if κ varies within cells, on some rank."""
        return self.values is not None or self.tensor is not None

    def _of_tensor(self, kappa: Tensor, cells: Cells) -> tuple[Between, Between]:
        """Bound κ where lengths are stretched, and its eigenvalues; collective."""
        means = kappa.means(cells.domain)
        eigenvalues = np.linalg.eigvalsh(means).astype(np.float64, copy=False)
        least, most = eigenvalues[:, 0], eigenvalues[:, -1]
        self.mean = np.exp(np.log(eigenvalues).mean(axis=1))
        off, part, low, high = self._entries(kappa, means, cells)
        if any(cells.comm.allgather(self.reason)):
            return Between.all_over(self.mean, self.mean), Between.all_over(least, most)
        self.strips, there = part, part > 0.0
        theta = self._by_mean(np.maximum(off, 0.0), cells)
        varies = bool((off > _steady(means)).any() or there.any())
        if cells.comm.allreduce(varies, op=MPI.LOR):
            self.tensor, self.rule, self.spread = kappa, kappa.fine, theta
            kappa.prepare(kappa.fine)  # here, as a rank without cells never asks for values
            self.rough = np.fmin(self._roughness(kappa, cells), theta)
        else:
            theta = np.zeros_like(theta)
        if (theta >= 1.0).any():
            self.reason = "the coefficient is a tensor that varies too much within a cell"
        inner, outer = 1.0 - theta, 1.0 + theta
        first, last = _eigenvalues_between(low, high)
        lowest = np.where(there, np.minimum(first, inner * least), inner * least)
        highest = np.where(there, np.maximum(last, outer * most), outer * most)
        own = Between.with_strips((inner * least, outer * most), part, lowest, highest)
        # with lengths stretched, where it is all the same κ_T
        lowest = self.mean * np.where(there, np.minimum(lowest / most, inner), inner)
        highest = self.mean * np.where(there, np.maximum(highest / least, outer), outer)
        core = self.mean * inner, self.mean * outer
        return Between.with_strips(core, part, lowest, highest), own

    def _entries(
        self, kappa: Tensor, means: FloatArray, cells: Cells
    ) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Bound a tensor's entries on each cell, or note why that can't be done; local.

        Returns:
            How far they are from their means but for strips, what part of the cell these have, and
            bounds on all of it; shapes (d², cells), but for the part's (cells,).
        """
        low, high, off = np.zeros((3, cells.tdim**2, len(means)))
        strips = np.zeros(len(means))
        of_entries = means.reshape(-1, cells.tdim**2).T
        for i, (entry, mean) in enumerate(zip(kappa.entries, of_entries, strict=True)):
            found = ranges_on(entry, Pieces.of_cells(cells), cells)
            if found is None:
                self.reason = NO_RANGE
                break
            (inner, outer), (part, low[i], high[i]) = found
            off[i] = np.maximum(outer - mean, mean - inner)
            strips += part
        for difference in kappa.skew:
            between = range_of(difference, cells)
            if between is None or (np.maximum(-between[0], between[1]) > _steady(means)).any():
                self.reason = "the coefficient is a tensor that could not be shown to be symmetric"
                break
        return off, strips, low, high

    def _roughness(self, kappa: Tensor, cells: Cells) -> FloatArray:
        """Bound how far a tensor is from quadratic polynomials, in parts of κ_T, shape (cells,)."""
        deviations = [Deviation(entry) for entry in kappa.entries]

        def errors(boxes: Boxes, half: FloatArray) -> FloatArray:
            at = Enclosure(boxes)
            # v's gradient may be quadratic on triangles, and is affine or constant else
            largest = 36.0 if cells.tdim == 2 else (cells.tdim + 1) ** 2
            each = (deviation(at, half, largest=largest) for deviation in deviations)
            return np.stack([quadratic for quadratic, _ in each])

        return self._by_mean(errors_on(Pieces.of_cells(cells), errors, cells), cells)

    def _by_mean(self, sizes: FloatArray, cells: Cells) -> FloatArray:
        """Bound |κ_T^{-1/2} E κ_T^{-1/2}|, E with entries of such sizes, shape (cells,)."""
        d, stretch = cells.tdim, cells.stretch
        assert stretch is not None
        stretched = np.abs(stretch) @ sizes.T.reshape(-1, d, d) @ np.abs(stretch)
        return np.asarray(np.linalg.norm(stretched, axis=(1, 2)) / self.mean)

    def apart(self, cells: Cells, block: slice) -> FloatArray:
        """Compute κ − κ_T with lengths stretched, at the rule's points, shape (q, cells, d, d)."""
        assert self.tensor is not None and cells.stretch is not None
        stretch = cells.stretch[block]
        found = stretch[:, None] @ self.tensor.at(cells.domain, self.rule, block) @ stretch[:, None]
        return found.transpose(1, 0, 2, 3) - self.mean[block, None, None] * np.eye(cells.tdim)

    def _of_scalar(self, kappa: Volume, cells: Cells) -> Between:
        """Bound κ; collective."""
        fine = kappa.exact_for(KAPPA_DEGREE)
        self.rule = fine.rule
        if kappa.number is not None:
            self.mean = np.array(kappa.number, dtype=np.float64)
            return Between.all_over(self.mean, self.mean)
        self.deviation = kappa.deviation
        found = ranges_on(kappa.expression, Pieces.of_cells(cells), cells)
        values = kappa.at(cells)
        self.mean = values @ kappa.rule.weights
        if found is None:
            self.reason = NO_RANGE
            bounds = Between.all_over(self.mean, self.mean)
        else:
            core, (self.strips, lowest, high) = found
            bounds = Between.with_strips(core, self.strips, lowest, high)
        varies = bool((bounds.high - bounds.lowest > STEADY * np.abs(self.mean)).any())
        if cells.comm.allreduce(varies, op=MPI.LOR):  # or the bound would depend on the ranks
            values = values if fine is kappa else fine.at(cells)
            self.values = np.ascontiguousarray(values.T)
        return bounds

    def enclose(self, cells: Cells, steepness: FloatArray, excess: FloatArray, size: float) -> None:
        """Enclose a κ that varies within cells; collective.

        The errors in `cut` are R, t, W, W', the strips' part of the cell times 1/κ and κ there,
        and R²: κ is within R of a quadratic polynomial and W of a cubic one, κ⁻¹ is within W' of a
        cubic one, and a quadratic one is between (1 ± τ) κ⁻¹, t = (1 + τ)/(1 − τ) − 1.

        Args:
            cells: The mesh.
            steepness: ‖∇u_h‖² on each cell, shape (cells,).
            excess: ‖y − κ_T ∇u_h‖² on each cell, shape (cells,).
            size: Of the bound, to which what quadrature misses should be small.
        """
        assert self.values is not None
        inner = float(self.rule.hats.min())

        def errors(boxes: Boxes, half: FloatArray) -> FloatArray:
            at = Enclosure(boxes, inner=inner)
            (r, w), (s, x) = (self.deviation(at, half, inverse) for inverse in (False, True))
            low, high = np.zeros((2, len(r)))
            if at.left_out.any():
                which = np.flatnonzero(at.left_out)
                jet = Enclosure(boxes.whole(which), order=0)(self.deviation.expression)
                part = at.left_out[which]
                low[which], high[which] = part / np.maximum(jet.low, 1e-300), part * jet.high
            return np.stack([r, self._ratio(at, r, s), w, x, low, high, r**2])

        # of the bound's square: (e + 2 R a)² for e², a norm κ^{-1/2} weighs
        weights = self.rule.weights
        inverse = weights @ (1.0 / self.values)
        e = excess / self.mean + steepness * (weights @ (self.values - self.mean) ** 2 * inverse)
        a, none = steepness * inverse, np.zeros(cells.number)
        shares = np.stack([4.0 * np.sqrt(e * a), e, *[none] * 4, 4.0 * a])
        shares /= KAPPA_SHARE * size**2
        self.cut = cut(
            cells,
            errors,
            shares,
            self.deviation.local,
            self.deviation.decides,
            levels=self.deviation.levels(cells) if cells.tdim == 2 else None,
            at_most=KAPPA_PIECES,
        )
        np.fmin(
            self.cut.errors[1],
            self._by_points(self.values, self.cut.errors[0]),
            out=self.cut.errors[1],
        )
        self.inside = self.deviation.values(self.cut.pieces, cells, self.rule.hats)

    def _ratio(self, at: Enclosure, r: FloatArray, s: FloatArray) -> FloatArray:
        """Compute T on boxes, with R for κ and for 1/κ given, shape (n,).

        Let q be the quadratic through κ⁻¹ at the rule's points. 1 − κq is within R|q| of a
        polynomial of degree 4, which is known at the points up to R|q|. Without points R for κ⁻¹
        has to do.
        """
        boxes = at.boxes
        with np.errstate(all="ignore"):
            excess = 2.0 * at(self.deviation.expression).high * s
            if boxes.corners is None:
                return np.where(np.isnan(excess), np.inf, excess)
            hats = self.rule.hats
            x = points_of(boxes.corners, hats).reshape(len(boxes.low), -1)
            cells = None if boxes.cells is None else np.tile(boxes.cells, hats.shape[1])
            there = values(self.deviation.expression, Boxes(x, x, cells=cells, domain=boxes.domain))
            excess = np.fmin(excess, self._by_points(there.reshape(hats.shape[1], len(r)), r))
            return np.where(np.isnan(excess), np.inf, excess)

    def _by_points(self, values: FloatArray, r: FloatArray) -> FloatArray:
        """Compute T by κ at the rule's points, shape (q, n), and R for κ."""
        (of_two, basis), (of_four, _) = (bernstein(self.rule.hats, k) for k in (2, 4))
        with np.errstate(all="ignore"):
            coefficients = of_two @ (1.0 / values)
            q = basis @ coefficients
            top = np.abs(of_four @ (1.0 - values * q)) + r * (np.abs(of_four) @ np.abs(q))
            tau = (top.max(axis=0) + r * np.abs(coefficients).max(axis=0)) * (1 + 1e-10)
            return np.where(tau < 1.0, 2.0 * tau / (1.0 - tau), np.inf)


def _steady(means: FloatArray) -> FloatArray:
    """Say how much of a tensor's entries counts as rounding, from means (cells, d, d), (cells,)."""
    return np.asarray(STEADY * np.abs(means).max(axis=(1, 2), initial=0.0))


def _with_strips(core: FloatArray, part: FloatArray, lowest: FloatArray) -> FloatArray:
    """Find k with ‖κ^{-1/2} y‖ ≤ ‖k^{-1/2} y‖ for fields y that are nowhere much above their mean.

    A strip's part π adds κ_S^{-1/2} times the root of 36 π at most, which of fields of degree 2 is
    the part they have in it, and with Poincaré's inequality 2.1 times as much.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        found = (core**-0.5 + 12.6 * np.sqrt(part / lowest)) ** -2.0
    return np.where((part > 0.0) & (lowest < core), np.maximum(found, lowest), core)


def _eigenvalues_between(low: FloatArray, high: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Bound eigenvalues of symmetric matrices whose entries lie in between, shapes (n,).

    Args:
        low: Their entries, row by row, shape (d², n).
        high: The same.
    """
    d = round(len(low) ** 0.5)
    middle, reach = (x.T.reshape(-1, d, d) for x in (0.5 * (low + high), 0.5 * (high - low)))
    eigenvalues = np.linalg.eigvalsh(0.5 * (middle + middle.swapaxes(1, 2)))
    room = np.linalg.norm(reach, ord=2, axis=(1, 2)) * (1 + 1e-12)
    return eigenvalues[:, 0] - room, eigenvalues[:, -1] + room


def bernstein(hats: FloatArray, degree: int) -> tuple[FloatArray, FloatArray]:
    """Return the matrices from values at points to coefficients in Bernstein's basis, and back.

    A polynomial is nowhere larger than its largest coefficient.

    Args:
        hats: Barycentric coordinates of the points, shape (d + 1, q).
        degree: Of the polynomials; the points must determine them.
    """
    powers = [k for k in product(range(degree + 1), repeat=len(hats)) if sum(k) == degree]
    basis = np.stack(
        [
            factorial(degree)
            * np.prod([h**i / factorial(i) for h, i in zip(hats, k, strict=True)], axis=0)
            for k in powers
        ],
        axis=1,
    )
    return np.linalg.pinv(basis), basis


KAPPA_PIECES = 20_000
"""Pieces that cells are cut into for it."""
KAPPA_SHARE = 1e-2
"""Part of the square of the bound that quadrature may miss, or thereabouts."""


BESIDE = 1e-3, 1e-5
"""Parts of the way from a facet's vertex to its middle that show whether data have a step there;
FFCx takes what is nearer for the vertex."""
STEP = 1e-6
"""Part of the values on the facet above which they may."""
EVEN = 0.01
"""Part of the step that they change by from one of these places to the other, at most."""


class Trace:
    """Values of an expression on boundary facets.

    Attributes:
        degree: What the quadrature is exact for.
        points: Quadrature points on the reference facet, shape (q, d - 1).
        weights: Their weights, which add up to 1.
        hats: Barycentric coordinates of the points, shape (q, d).
        constant: The number that it is, or None.
    """

    def __init__(self, expression: Expr, mesh: Mesh, degree: int):
        """Prepare the expression, which was written for a mesh."""
        self._expression, self.degree = expression, degree
        facet = basix.cell.subentity_types(mesh.basix_cell())[-2][0]
        corners = basix.geometry(facet)
        self.points, self.weights = facet_quadrature(mesh, degree)
        self.hats = np.column_stack([1.0 - self.points.sum(axis=1), self.points])
        self._corners = len(corners)
        self.constant = as_number(expression)
        if self.constant is None:
            middle = corners.mean(axis=0)
            near = [corners + part * (middle - corners) for part in BESIDE]
            at = np.vstack([corners, *near, middle, self.points])
            self._plain, self._at = lowered(expression), np.column_stack([1.0 - at.sum(axis=1), at])
            self._mesh = mesh

    @property
    def expression(self) -> Expr:
        """The expression whose values it has."""
        return self._expression

    @property
    def vanishes(self) -> bool:
        """True if it is the number 0."""
        return self.constant == 0.0

    @cached_property
    def deviation(self) -> Deviation:
        """The `Deviation` from polynomials."""
        return Deviation(self._expression)

    def at(self, domain: Domain, entities: Int32Array) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Evaluate at the vertices, the midpoint and the quadrature points of facets.

        Where the datum has a step at a vertex, what it is like on the facet counts, not at the
        point.

        Args:
            domain: Where.
            entities: Pairs (cell, facet's number in the cell), shape (n, 2).

        Returns:
            Arrays of shapes (d, n), (n,) and (q, n); vertices in the order of the cell's closure.
        """
        n, k = len(entities), self._corners
        if self.constant is not None:
            count = len(self.weights)
            return tuple(np.full(s, self.constant) for s in ((k, n), n, (count, n)))  # type: ignore
        values = self._values(domain, entities)
        at, far, near, middle, inside = np.split(values, [k, 2 * k, 3 * k, 3 * k + 1])
        with np.errstate(invalid="ignore"):  # infinite ones are refused by those who know where
            step = np.abs(near - at)
            is_step = step > STEP * np.abs(values).max(axis=0)
            is_step &= np.abs(far - near) < EVEN * step
            limit = near + (near - far) * (BESIDE[1] / (BESIDE[0] - BESIDE[1]))
        return np.where(is_step, limit, at), middle[0], inside

    def _values(self, domain: Domain, entities: Int32Array) -> FloatArray:
        """Evaluate at all of the points, shape (points, n)."""
        try:  # compiling would take longer than all of a boundary's points do
            found = Samples.on_facets(domain, entities, self._at).of(self._plain)
        except Unknown:
            found = self._compiled.at(domain.mesh, entities, domain.own)[:, :, 0]
        return np.ascontiguousarray(found.T)

    @cached_property
    def _compiled(self) -> compat.FacetExpression:
        """The expression, compiled; collective when first asked for."""
        return compat.FacetExpression(self._expression, self._at[:, 1:], self._mesh)


@dataclass(frozen=True, eq=False)
class OnFacets:
    """A condition's datum on all facets of its part that a rank sees, evaluated once.

    Attributes:
        condition: The condition.
        trace: The datum.
        facets: Local indices, ghosts included, ascending, shape (n,).
        entities: Pairs (cell, facet's number in the cell), shape (n, 2).
        ends: Values at the vertices, in the order of the cell's closure, shape (d, n).
        middle: At the midpoints, shape (n,).
        inside: At the trace's quadrature points, shape (q, n).
        sign: Of a bound: s, where s u must not be below the datum.
    """

    condition: Condition
    trace: Trace
    facets: Int32Array
    entities: Int32Array
    ends: FloatArray
    middle: FloatArray
    inside: FloatArray
    sign: int = 1

    @classmethod
    def of(cls, condition: Condition, trace: Trace, domain: Domain, sign: int = 1) -> OnFacets:
        """Evaluate a datum on a mesh; collective."""
        facets = domain.all_facets[condition.number]
        entities = facet_entities(domain.mesh, facets)
        return cls(condition, trace, facets, entities, *trace.at(domain, entities), sign)

    @property
    def means(self) -> FloatArray:
        """Means over the facets, shape (n,)."""
        return self.trace.weights @ self.inside

    @property
    def rest(self) -> FloatArray:
        """`inside` less the quadratic through the three others, shape (q, n)."""
        ends, middle = self.ends, self.middle
        s = self.trace.hats[:, 1][:, None]
        straight = (1.0 - s) * ends[0] + s * ends[1]
        bump = 4.0 * s * (1.0 - s) * (middle - ends.mean(axis=0))
        rest: FloatArray = self.inside - straight - bump
        return rest

    @property
    def imposed(self) -> Imposed:
        """The same for the one unknown of each facet."""
        only = np.zeros(1, dtype=np.int32)
        means, ends = self.means[:, None], self.ends.T[:, :, None]
        key = self.condition.label.removeprefix("data.")
        return Imposed(key, self.facets, only, means, ends, self.sign)

    def seen_from(self, cells: Cells) -> OnFacets:
        """Keep the facets of owned cells, those of the part's `BoundaryFacets`."""
        own = self.entities[:, 0] < cells.number
        where = self.facets[own], self.entities[own]
        values = self.ends[:, own], self.middle[own], self.inside[:, own]
        return OnFacets(self.condition, self.trace, *where, *values, self.sign)

    def side(self, cells: Cells) -> BoundaryFacets:
        """Return the facets of owned cells, seen from these."""
        return cells.sides[self.condition.number]


@dataclass(frozen=True, eq=False)
class OnParts:
    """Data of conditions of one kind, on the facets of owned cells, part after part.

    Attributes:
        parts: The parts' data, seen from the cells.
        side: All facets.
    """

    parts: tuple[OnFacets, ...]
    side: BoundaryFacets

    @classmethod
    def of(cls, sampled: Sequence[OnFacets], cells: Cells) -> OnParts:
        """Keep the facets of owned cells."""
        parts = tuple(each.seen_from(cells) for each in sampled)
        return cls(parts, BoundaryFacets.joined([each.side(cells) for each in parts], cells.tdim))

    @property
    def ends(self) -> FloatArray:
        """Values at the vertices, in the order of the cell's closure, shape (d, n)."""
        none = np.empty((len(self.side.ends), 0))
        return np.concatenate([none, *(each.ends for each in self.parts)], axis=1)

    @property
    def middle(self) -> FloatArray:
        """Values at the midpoints, shape (n,)."""
        return np.concatenate([np.empty(0), *(each.middle for each in self.parts)])

    @property
    def means(self) -> FloatArray:
        """Means over the facets, shape (n,)."""
        return np.concatenate([np.empty(0), *(each.means for each in self.parts)])

    @property
    def signs(self) -> FloatArray:
        """The bounds' signs, shape (n,)."""
        count = [len(each.middle) for each in self.parts]
        return np.repeat([float(each.sign) for each in self.parts], count)

    @property
    def traces(self) -> list[Trace]:
        """The data themselves."""
        return [each.trace for each in self.parts]


class Compiled:
    """The data of a problem ready for evaluation on any mesh, each compiled when first asked for.

    Args:
        forms: The problem's.
    """

    def __init__(self, forms: Forms):
        """Note whose data."""
        self.forms = forms
        self._rule = Rule(forms.mesh, forms.problem.quadrature_degree)
        self._traces: dict[Expr, Trace] = {}
        self._by_cells: dict[Expr, fem.Expression] = {}
        self._changing: dict[Expr, bool] = {}

    @cached_property
    def f(self) -> Volume:
        """Volume load; collective."""
        return Volume(self.forms.f, self.forms.mesh, self._rule)

    @cached_property
    def kappa(self) -> Volume | Tensor:
        """Coefficient; collective."""
        kappa = self.forms.kappa
        return (Tensor if ufl.shape(kappa) else Volume)(kappa, self.forms.mesh, self._rule)

    @cached_property
    def stand_in(self) -> fem.Function:
        """A function w that is affine on each cell, in the place of u_h; collective."""
        return fem.Function(fem.functionspace(self.forms.mesh, ("DG", 1)))

    @cached_property
    def with_reaction(self) -> tuple[Volume, Volume]:
        """F − c w and c w² with the `stand_in` w; collective."""
        mesh, c, w = self.forms.mesh, self.forms.reaction, self.stand_in
        f, c_w2 = (Volume(each, mesh, self._rule) for each in (self.forms.f - c * w, c * w**2))
        return f, c_w2

    def with_loss(self, condition: Condition) -> tuple[Trace, Trace]:
        """Make g − b w and b w² on a condition's part, likewise; collective."""
        b, w = condition.loss, self.stand_in
        return self.trace(condition.flux - b * w), self.trace(b * w**2)

    def by_cells(self, expression: Expr) -> fem.Expression:
        """Compile what is constant on each cell, at one point there; collective."""
        if expression not in self._by_cells:
            middle = Rule(self.forms.mesh, 0).points
            found = compat.compile_expression(expression, middle, self.forms.mesh)
            self._by_cells[expression] = found
        return self._by_cells[expression]

    def may_change(self, expression: Expr) -> bool:
        """Ask `conditions.may_change` once: UFL goes through the whole expression."""
        if expression not in self._changing:
            self._changing[expression] = may_change(expression)
        return self._changing[expression]

    def trace(self, expression: Expr) -> Trace:
        """Prepare a condition's datum for evaluation on facets; collective."""
        if expression not in self._traces:
            degree = self.forms.problem.quadrature_degree
            self._traces[expression] = Trace(expression, self.forms.mesh, degree)
        return self._traces[expression]
