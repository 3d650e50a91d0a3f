"""Guaranteed bounds of a solution's error and of the energy.

For v ∈ K and y ∈ H(div) with −div y = f, y·n = g on Γg and y·n ≥ 0 on Γ1 the duality gap
J(v) − D(y) bounds what neither of them knows about u. Both come from u_h at linear cost, see `flux`
and `companion`. `docs/certificate.md` has the mathematics; the letters are the same there.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
import ufl
from dolfinx import fem
from mpi4py import MPI

from .. import compat
from ..arrays import BoolArray, FloatArray, IndexArray
from ..data.diffusion import DiffusionOnMesh, diffusion
from ..data.loads import NOTHING, Certain, Segments, VolumeMoments, mean_to_norm, reacts
from ..data.quadrature import STEADY, Coefficient, OnParts
from ..fem.cells import BoundaryFacets, Cells, blocks, measures, pick, sum_rows, vertex_rows
from ..jit import compiled
from ..rounding import at_most, interval
from .beyond import Beyond
from .companion import Companion, Lifted, companion, on_facet
from .cubic import cubed, with_cubics
from .curl import improve, promising
from .cusps import Cusps
from .duality import DualityGap, Within, integrate, of_gradients
from .flux import Flux, carried_to_contact, equilibrate, field_squares, rebalance, relax, unbalanced
from .functional import Functional, Masses
from .lifting import below
from .loss import Loss, half
from .reaction import Reaction
from .sums import Sums, Totals

if TYPE_CHECKING:
    from ..vi.level import Level
    from ..vi.solved import Found


SHARES = ("flux", "companion", "contact", "load", "neumann", "boundary", "solver")
"""Sources of a bound: the keys of `Certificate.parts`."""


@dataclass(frozen=True, eq=False)
class Certificate:
    """Guaranteed bounds for a solution; None where there are none, `reason` then says why.

    Attributes:
        bound_h1: ‖u − u_h‖_h, the broken norm (1.6), is at most this.
        bound_energy_norm: The same for the norm of the energy, whose square is
            ‖κ^{1/2} ∇_h(u − u_h)‖² and, where there are a reaction c and a loss of heat b,
            ‖c^{1/2} (u − u_h)‖² and ‖b^{1/2} (u − u_h)‖² on the boundary.
        bound_companion: The same for ‖κ^{1/2} ∇(u − v)‖, v the conforming companion.
        energy: J(u) lies between these two.
        parts: Where the bound comes from: the norms of y − κ∇u_h (flux) and of ∇(v − u_h)
            (companion), the contact term's square root (contact), the data oscillation of f
            (load), of g (neumann), of u_D and α (boundary), and what the solver left (solver).
        indicators: Square of each cell's share, shape (cells,), owned cells.
        rounding: What `bound_energy_norm` has for rounding in its own sums.
        reason: Why figures are missing.
        seconds: Wall time.
    """

    bound_h1: float | None = None
    bound_energy_norm: float | None = None
    bound_companion: float | None = None
    energy: tuple[float, float] | None = None
    parts: dict[str, float] = field(default_factory=dict)
    indicators: FloatArray | None = None
    rounding: float = 0.0
    reason: str | None = None
    seconds: float = 0.0
    made: Made | None = None  # told of nowhere: bounds of quantities go on from it, users don't

    def __repr__(self) -> str:
        """Write bound and energy on a line, or why there are none."""
        if self.bound_h1 is None or self.reason is not None:
            return f"<Certificate: no bound, {self.reason}>"
        energy = "" if self.energy is None else f", energy in {interval(*self.energy)}"
        return f"<Certificate: error at most {at_most(self.bound_h1)}{energy}>"

    @cached_property
    def flux(self) -> fem.Function | None:
        """The flux y; collective.

        It is in the Raviart-Thomas space of lowest order, on thin cells perhaps in the next one.
        """
        made = self.made
        if made is None:
            return None
        cells = made.cells()
        mesh, d = cells.domain.mesh, cells.tdim
        fluxes = made.through(cells)
        # y = slope x + shift on each cell
        corners = mesh.geometry.x[compat.cell_nodes(mesh)[: cells.number], : mesh.geometry.dim]
        constants = fem.functionspace(mesh, ("DG", 0))
        vectors = fem.functionspace(mesh, ("DG", 0, (mesh.geometry.dim,)))
        slope, shift = fem.Function(constants), fem.Function(vectors)
        slope.x.array[: cells.number] = fluxes.sum(axis=0) / (d * cells.volume)
        shift.x.array[: cells.number * mesh.geometry.dim] = (
            -np.einsum("in,nik->nk", fluxes, corners) / (d * cells.volume)[:, None]
        ).ravel()
        for function in (slope, shift):
            function.x.scatter_forward()
        field, beyond = slope * ufl.SpatialCoordinate(mesh) + shift, made.beyond
        if beyond is not None:
            field += beyond.field(cells)
        y = fem.Function(fem.functionspace(mesh, ("RT", 1 if beyond is None else 2)))
        points = compat.interpolation_points(y.function_space)
        y.interpolate(compiled(mesh.comm, fem.Expression, field, points))
        return y

    @property
    def companion_at_vertices(self) -> FloatArray | None:
        """The companion v at the mesh's vertices, ghosts included, shape (vertices,)."""
        return None if self.made is None else self.made.vertices

    @cached_property
    def companion(self) -> fem.Function | None:
        """The companion v; collective.

        It is of degree 2 for d = 2, on thin cells perhaps 3, and affine else; without its lifting
        and, where there are some, its cusps.
        """
        made = self.made
        if made is None:
            return None
        cells = made.cells()
        degree = 2 if cells.tdim == 2 else 1
        v = fem.Function(fem.functionspace(cells.domain.mesh, ("Lagrange", degree)))
        dofs = v.function_space.dofmap.list[: cells.number]
        values = made.vertices[cells.vertices]
        v.x.array[dofs[:, : cells.tdim + 1]] = values.T
        if degree == 2:
            middle = (values.sum(axis=0) - values) / 2 + made.bumps[cells.facets]
            v.x.array[dofs[:, 3:]] = middle.T
        v.x.scatter_forward()
        if made.thirds is None or made.bubbles is None:
            return v
        return with_cubics(cells, v, made.thirds, made.bubbles)


@dataclass(frozen=True, eq=False)
class Made:
    """The parts that y and v are made of; the cells' geometry is made again when it is needed.

    Attributes:
        level: The mesh, with those below it.
        w: u_h at the cells' vertices, shape (d + 1, cells).
        kappa: κ_T, as `Coefficient` has it.
        least: A lower bound of κ's eigenvalues, lengths as they are, shape (cells,) or ().
        most: An upper bound, likewise.
        stretch: How lengths are measured where κ is a tensor, see `Tensor.stretch`.
        excess: Fluxes of y − κ_T∇u_h out of the cells, shape (d + 1, cells).
        vertices: v at the vertices, ghosts included.
        bumps: Heights of its bumps, by facet.
        hats: Moments of f.
        segments: g − b u_h.
        beyond: What y has beyond that, if it has anything.
        thirds: Heights of v's cubics, by facet.
        bubbles: The same of cells.
        cusps: Those of v.
        within: What κ is within cells; None where it is constant on each.
        reaction: c, or a lower bound of it.
        most_reaction: The same object, or an upper bound.
        left: ∫_T (f + div y), shape (cells,).
        taken_up: Where c has taken that up.
        shed: What b has taken up, by facet.
        forces: This rank's shares of the contact forces in y, by the parts' numbers.
        missed: What quadrature may have missed of f and g, shape (cells,) or ().
        reach: Radius of the ball around the middle of p and b that A(u − u_h) is in, with loose
            ends.
        loose_and_lift: These and ‖Aℓ‖ alone.
        lift: Bounds of ℓ, which v lacks.
        bounded: Facet dofs of Γ1, which the last row of lift is about.
        on_contact_alone: Whether part of the domain is held by contact alone: the residual is then
            known for functions that vanish on Γ1.
        contact: y's forces off each bound, facet by facet.
        complementary: Bound of what λ makes of v + ℓ − α and these make of u − α.
        above: Bound of what they make of v + ℓ − α.
    """

    level: Level
    w: FloatArray
    kappa: FloatArray
    least: FloatArray
    most: FloatArray
    stretch: FloatArray | None
    excess: FloatArray
    vertices: FloatArray
    bumps: FloatArray
    hats: FloatArray | None
    segments: Segments
    beyond: Beyond | None
    thirds: FloatArray | None
    bubbles: FloatArray | None
    cusps: Cusps | None
    within: Within | None
    reaction: FloatArray
    most_reaction: FloatArray
    left: FloatArray
    taken_up: BoolArray | None
    shed: FloatArray | None
    forces: dict[int, float]
    missed: FloatArray
    reach: float
    loose_and_lift: float
    lift: Lifted
    bounded: IndexArray
    on_contact_alone: bool
    contact: FloatArray
    complementary: float
    above: float

    @property
    def data(self) -> DiffusionOnMesh:
        """The scalar equation on the mesh."""
        return diffusion(self.level.data)

    def cells(self) -> Cells:
        """Return the mesh's geometry."""
        gamma_0 = self.data.forms.gamma_0
        return Cells(self.level.domain, self.level.V, gamma_0, stretch=self.stretch)

    def through(self, cells: Cells) -> FloatArray:
        """Compute the fluxes of y out of the cells, shape (d + 1, cells)."""
        own = cells.apply(self.w, slice(0, cells.number))
        return self.excess - cells.tdim * self.kappa * own


DEAR = 1.0
"""Most that may be left of the equation, in parts of the bound, before contact has to take it."""

LIFT_SHARE = 1e-2
"""Part of the bound that the lifting's norm may be overestimated by, or thereabouts."""

NO_FLUX = "only a Crouzeix-Raviart solution has an equilibrated flux"
ADRIFT = (
    "part of the domain has no way to a place where u is held: there is no Γ0, no part that loses"
    " heat everywhere and no reaction, and no contact whose force is larger than what is left of"
    " the equation"
)
CROSSED = "{} is not shown to be nowhere above the upper bound of the part"
NOT_FINITE = "a figure is not finite: some datum has no square integral, or squares overflow"


def certify(solution: Found, sweeps: int = 2, flux_from: Found | None = None) -> Certificate:
    """Bound the error of a solution; collective.

    Args:
        solution: From `solve` or `solve_levels`; it need not be converged.
        sweeps: How often the companion's bumps are improved.
        flux_from: A Crouzeix-Raviart solution on the same mesh whose flux to take; P1 has none.
    """
    began = time.perf_counter()
    base = solution if flux_from is None else flux_from
    try:
        with base.level.as_made():
            known = _equilibrated(solution, base)
            certificate = _best(_companions(solution, known, sweeps))
    except _NoBound as why:
        certificate = Certificate(reason=str(why))
    return replace(certificate, seconds=time.perf_counter() - began)


class _NoBound(Exception):
    """The reason why there is no bound; raised on all ranks."""


def _insist(reason: str | None) -> None:
    """Raise _NoBound if there is a reason, which all ranks have."""
    if reason is not None:
        raise _NoBound(reason)


@dataclass(eq=False)
class _Known:
    """The enclosed data, y, and what is left of −div y = f, on the way to a certificate.

    Attributes:
        level: The mesh, with those below it.
        cells: What the certificate needs to know of it.
        kappa: The coefficient.
        c: The reaction.
        b: The losses.
        square: Means of c u_h², and what these miss, where c varies within cells; else None.
        squares: Integrals of b u_h², and what these miss, on parts where b varies within facets.
        certain: f − c u_h.
        segments: g − b u_h.
        flux: y.
        w: u_h at the cells' vertices, shape (d + 1, cells).
        size: About how large the bound will be.
        left: What the loose ends of −div y = f add to it.
        unsure: What quadrature may have missed of integrals of f and g adds, unless contact or b
            takes it.
        carried: The norm of what was added to y for their sake.
    """

    level: Level
    cells: Cells
    kappa: Coefficient
    c: Reaction
    b: Loss
    square: Certain | None
    squares: Sequence[Segments]
    certain: Certain
    segments: Segments
    flux: Flux
    w: FloatArray
    size: float
    left: float = 0.0
    unsure: float = 0.0
    carried: float = 0.0


def _equilibrated(solution: Found, base: Found) -> _Known:
    """Make y from u_h, and enclose f, g and κ as finely as it calls for; collective.

    Raises:
        _NoBound: With the reason.
    """
    level, u = base.level, base.u.x.array
    if base.element != "CR" or base.domain is not solution.domain:
        raise _NoBound(NO_FLUX)
    data = diffusion(level.data)
    _insist(data.forms.uncertified)
    cells, alpha = data.cells, OnParts.of(data.alpha, data.cells)
    kappa, c, b = Coefficient(data.compiled.kappa, cells), Reaction.of(data), Loss.of(data)
    _insist(kappa.reason or c.reason or b.reason or _crossed(data))
    w = vertex_rows(u, cells)
    edge, rest = b.known(w), c.rest(w)
    contact, signs = alpha.side, alpha.signs
    gap = signs * u[contact.dofs] - alpha.means
    flux = equilibrate(cells, kappa.mean, w, rest, edge, contact, signs, gap)
    flux.taken_up = relax(cells, kappa.mean, flux, c.low, edge, contact, signs)
    if solution.element != "CR":
        w = _seen_from(solution, cells, kappa, flux, w)
    size = _size(cells, kappa, w, flux)
    certain, square = c.certain(w, kappa, size)
    _insist(certain.reason or (None if square is None else square.reason))
    segments, squares = b.certain(w, kappa, size)
    _insist(next((each.reason for each in (segments, *squares) if each.reason), None))
    # y is to have the means that f − c u_h and g − b u_h have now
    flux.left += cells.volume * (certain.load.mean - rest.mean)
    _give_means(flux, segments, segments.through - edge.shares.sum(axis=0))
    known = _Known(level, cells, kappa, c, b, square, squares, certain, segments, flux, w, size)
    _close(known, contact, sum(len(cells.sides[each.number].dofs) for each in data.forms.fixed))
    if kappa.values is not None:
        kappa.enclose(cells, flux.steepness, field_squares(cells, flux.excess), size)
    return known


def _give_means(flux: Flux, segments: Segments, change: FloatArray) -> None:
    """Change the integrals of y·n, but where it is cheaper that b takes the change up; collective.

    Where b is large, what the scheme's own rule misses of b u_ext would be large in y.
    """
    taken = np.where(segments.given, change, 0.0)
    if segments.cells.comm.allreduce(bool(taken.any()), op=MPI.LOR):
        flux.shed = taken if flux.shed is None else flux.shed + taken
    side, change = segments.facets, change - taken
    flux.excess[side.local, side.cells] += change
    np.add.at(flux.left, side.cells, change)


def _close(known: _Known, contact: BoundaryFacets, fixed: int) -> None:
    """See to what is left of −div y = f: `left`, `unsure` and `carried`; collective.

    Args:
        known: All else.
        contact: Γ1, in the order of `Flux.contact`.
        fixed: How many facets Γ0 has, seen from this rank's cells.
    """
    cells, flux, c = known.cells, known.flux, known.c.low
    known.left, known.carried = _balanced(known)
    known.unsure = _of_means(known) if known.left < np.inf else 0.0
    dear = known.left + known.unsure > DEAR * known.size
    if not (np.isposinf(known.left) or (dear and not cells.total(fixed)[0])):
        return
    # nothing but contact holds u, or nothing firm does: a weak b or c is a dear way out
    by_contact = _carried_to_contact(
        cells, known.kappa, c, flux, contact, _missed(cells, known.certain, known.segments)
    )
    if by_contact < known.left + known.unsure or np.isposinf(known.left):
        known.left, known.unsure = by_contact, 0.0
    else:
        flux.carried = None


def _balanced(known: _Known) -> tuple[float, float]:
    """Balance y where no reaction takes up what is left of the equation; collective.

    Returns:
        `_Known.left`, infinite where nothing holds u, and `_Known.carried`.
    """
    cells, flux, kappa, c = known.cells, known.flux, known.kappa, known.c.low
    if flux.taken_up is not None and not c.ndim:
        return 0.0, 0.0
    left = unbalanced(known.level, cells, flux.unbalanced, kappa.eigenvalues.low, known.size, c)
    carried = rebalance(cells, flux, kappa.bounds.low, known.size, left)
    if carried:
        left = unbalanced(known.level, cells, flux.unbalanced, kappa.eigenvalues.low, known.size, c)
    return left, carried


def _carried_to_contact(
    cells: Cells,
    kappa: Coefficient,
    c: FloatArray,
    flux: Flux,
    contact: BoundaryFacets,
    missed: FloatArray,
) -> float:
    """Let the contact force, which alone holds u, take what is left and what is missed; collective.

    Returns:
        What that adds to the bound, infinite where the force is too small.
    """
    left, flux.carried = 0.0, np.zeros_like(flux.contact)
    for amounts, signed in ((flux.unbalanced, True), (missed, False)):
        norm, change = carried_to_contact(
            cells, flux, amounts, kappa.eigenvalues.low, contact, c, signed
        )
        left += norm
        flux.carried += change
    enough = bool((flux.carried <= flux.contact).all())
    return left if cells.comm.allreduce(enough, op=MPI.LAND) else float(np.inf)


def _crossed(data: DiffusionOnMesh) -> str | None:
    """Say where α is not shown to be nowhere above β; without that there may be no u; collective.

    On tetrahedra both are affine on facets, or `affine` refuses, and their vertices are looked at
    before anything is solved.
    """
    cells = data.cells
    for condition in data.forms.bounded if cells.tdim == 2 else ():
        if len(condition.bounds) < 2:
            continue
        (_, lower), (_, upper) = condition.bounds  # β with the other sign
        off = data.compiled.trace(lower + upper)
        if off.constant is not None:
            continue  # looked at before anything is solved
        size = max(float(np.abs(each.ends).max(initial=0.0)) for each in data.alpha)
        size = cells.comm.allreduce(size, op=MPI.MAX)
        if not below(cells, cells.sides[condition.number], off, size):
            return CROSSED.format(condition.label)
    return None


def _seen_from(
    solution: Found, cells: Cells, kappa: Coefficient, flux: Flux, w: FloatArray
) -> FloatArray:
    """See y from a conforming u_h instead of w, and return that at the cells' vertices."""
    dofs = solution.u.function_space.dofmap.list[: cells.number]
    own: FloatArray = np.ascontiguousarray(solution.u.x.array[dofs].T)
    flux.excess -= cells.tdim * kappa.mean * cells.apply(w - own, slice(0, cells.number))
    flux.steepness = cells.slopes(own)
    return own


_Way = tuple[_Known, Companion, Sums]
"""y, v, and what their duality gap is made of."""


def _companions(solution: Found, known: _Known, sweeps: int) -> Iterator[_Way]:
    """Make v, on thin cells in other ways as well, each with its y, and add up; collective."""
    cells, kappa, flux = known.cells, known.kappa, known.flux
    if solution.element != "CR":
        sweeps = 0  # v is the solution itself
    data = diffusion(known.level.data)
    u_D, alpha = (OnParts.of(sampled, cells) for sampled in (data.u_D, data.alpha))
    plain = data.forms.of_one is None
    highest = max(cells.comm.allgather(kappa.eigenvalues.high.max(initial=1e-300)))
    goal = LIFT_SHARE * known.size / np.sqrt(highest)
    functional = _functional(known, plain)
    for on_obstacle in (False, True):
        v = companion(functional, flux, u_D, alpha, sweeps, goal, highest, on_obstacle)
        sums = _integrated(known, v)
        of_y, of_alpha = promising(cells, kappa.mean, flux, v, sums)
        _complete(known, v, sums)
        yield known, v, sums
        ways = []
        if of_y and (v.cusps is not None or not plain or kappa.values is not None):
            ways.append(v)
        if of_y and plain and kappa.values is None:
            ways.append(cubed(cells, kappa.mean, flux, replace(v, cusps=None)))
        for way in ways:
            y = improve(cells, kappa, known.certain.load, known.segments, flux, way, known.c.low)
            other = replace(known, flux=y)
            sums = _integrated(other, way)
            _complete(other, way, sums)
            yield other, way, sums
        if not of_alpha:
            return


def _integrated(known: _Known, v: Companion) -> Sums:
    """Integrate the duality gap between y and v."""
    cells, kappa, flux, load = known.cells, known.kappa, known.flux, known.certain.load
    sums = integrate(cells, kappa, known.w, load, flux, v, known.c.low, known.c.high)
    if v.cusps is not None:
        sums.totals.energy_slack += v.cusps.add(
            cells, known.w, load, kappa.bounds.low, flux, known.c.low, (v.excess, v.bumps), sums
        )
    np.add.at(sums.indicators, v.boundary.alpha.side.cells, v.contact)
    return sums


def _complete(known: _Known, v: Companion, sums: Sums) -> None:
    """Add to what was integrated over cells what facets, ℓ, and c and b that vary have of it."""
    cells, kappa, segments, totals = known.cells, known.kappa, known.segments, sums.totals
    load, c = known.certain.load, known.c
    duality = DualityGap(cells, kappa, known.w, load, known.flux, v, c.low, c.high, sums)
    duality.add_edge(segments)
    totals.lift, more_energy, totals.lift_far, totals.lift_near = _lifted(known, v, sums)
    on_edge = on_facet(cells, segments.side, segments.hats, v.vertices, v.bumps, v.thirds)
    lost, unsure = half(known.squares)
    totals.energy -= lost + float(
        segments.measure @ (segments.weights @ (segments.values * on_edge))
    )
    totals.energy_slack += more_energy + unsure
    if known.square is not None:
        means = known.square.load.mean
        own = 1e-14 * cells.volume * np.abs(means)
        if known.square.missed is not None:
            own += known.square.missed
        totals.energy -= 0.5 * float(cells.volume @ means)
        totals.energy_slack += 0.5 * float(np.sum(own))
    totals.contact = float(np.sum(v.contact))
    totals.of_gradients = float(np.sum(of_gradients(kappa, sums)))
    totals.steepness = float(np.sum(np.maximum(sums.steepness, 0.0)))


def _best(ways: Iterator[_Way]) -> Certificate:
    """Take the way with the least bound, and of all what they know of J(u) and ∇u; collective.

    Raises:
        _NoBound: With the first one's reason.
    """
    found, reasons = [], []
    for way in ways:
        try:
            found.append(_added_up(*way))
        except _NoBound as why:
            reasons.append(why)
    if not found:
        raise reasons[0]
    best = min(found, key=lambda each: each.bound_energy_norm or 0.0)
    lows, highs = zip(*(each.energy for each in found if each.energy), strict=True)
    bound_h1 = min(each.bound_h1 for each in found if each.bound_h1 is not None)
    return replace(best, bound_h1=bound_h1, energy=(max(lows), min(highs)))


def _functional(known: _Known, plain: bool) -> Functional:
    """Say what v is to make small; plain tells that there are gradients only, on all ranks."""
    cells, kappa, segments = known.cells, known.kappa, known.segments
    steady = kappa.bounds.high - kappa.bounds.low <= STEADY * kappa.mean
    if reacts(known.c.high):  # next to a c that is large there u is like no power of the distance
        steady &= known.c.high == known.c.low
        steady &= known.c.high * cells.diameter2 <= kappa.bounds.low
    lossy = segments.usual > 0.0
    side = segments.facets.picked(lossy)
    loss = segments.usual[lossy] * measures(cells, side)
    toward, strong = segments.target(known.flux.shed)[:, lossy], segments.given[lossy]
    masses = Masses(not plain, known.c.low, side, loss, toward, strong)
    return Functional(cells, known.w, kappa.mean, steady, masses)


def _added_up(known: _Known, v: Companion, sums: Sums) -> Certificate:
    """Add up the bounds and the energy's bracket; collective.

    Raises:
        _NoBound: With the reason.
    """
    cells, kappa = known.cells, known.kappa
    hidden, hidden_energy = _hidden(known, v, sums)
    rounding = _rounding(cells, kappa, known.c.high, known.w, known.certain.load, known.flux)
    total = sums.totals.over_ranks(cells)

    ball = _Ball.of(total, known.left, hidden, rounding)
    _insist(v.reason or (ADRIFT if np.isposinf(known.left) else None))
    _insist(None if np.isfinite(ball.bound) else NOT_FINITE)
    bound_h1 = np.sqrt(total.of_gradients) / 2
    bound_h1 += (rounding / 2 + ball.radius) / np.sqrt(kappa.smallest)
    lift = np.sqrt(total.lift)
    return Certificate(
        bound_h1=float(min(bound_h1, ball.bound / np.sqrt(kappa.smallest))),
        bound_energy_norm=float(ball.bound),
        bound_companion=float(ball.of_companion + lift),
        energy=_bracket(total, ball, hidden_energy, rounding),
        parts={
            "flux": float(np.sqrt(total.flux)),
            "companion": float(np.sqrt(total.companion)),
            "contact": float(np.sqrt(total.contact)),
            "load": float(np.sqrt(total.load) + hidden),
            "neumann": float(np.sqrt(total.neumann)),
            "boundary": float(lift),
            "solver": float(known.left + known.carried),
        },
        indicators=sums.indicators,
        rounding=1.5 * rounding,
        made=_made(known, v, ball, lift),
    )


@dataclass(frozen=True)
class _Ball:
    """The ball around (y + κ∇v)/2 that has κ∇u in it.

    Attributes:
        far: Bound of ‖p + κ^{-1/2}σ − b‖, what is loose included.
        near: Bound of ‖p + κ^{-1/2}σ + b‖.
        loose: What is known of −div y = f and y·n = g by its size alone, and rounding.
        contact: The contact term.
    """

    far: float
    near: float
    loose: float
    contact: float

    @classmethod
    def of(cls, total: Totals, left: float, hidden: float, rounding: float) -> _Ball:
        """Put it together.

        Args:
            total: The integrals over all ranks' cells.
            left: What is left of −div y = f.
            hidden: What quadrature may have missed of f and g.
            rounding: What rounding may do.
        """
        loose = np.sqrt(total.loose) + left + hidden + rounding
        same = total.flux + total.companion + total.load + 2 * (total.load_flux + total.slack)
        mixed = 2 * (total.cross + total.load_companion)
        far = np.sqrt(max(same - mixed + total.far, 0.0) + total.lift_far) + loose
        near = np.sqrt(max(same + mixed + total.near, 0.0) + total.lift_near) + rounding
        return cls(far, near, loose, total.contact)

    @property
    def radius(self) -> float:
        """Its radius."""
        return float(self.loose / 2 + np.sqrt(self.far**2 / 4 + self.contact))

    @property
    def bound(self) -> float:
        """The largest distance of its points from κ∇u_h, at most."""
        return self.near / 2 + self.radius

    @property
    def of_companion(self) -> float:
        """The largest distance of its points from κ∇v, at most."""
        return float((self.far + np.sqrt(self.far**2 + 4 * self.contact)) / 2)


def _bracket(total: Totals, ball: _Ball, hidden: float, rounding: float) -> tuple[float, float]:
    """Find two numbers with J(u) between them: J(v) is above it, by the duality gap at most.

    Args:
        total: The integrals over all ranks' cells.
        ball: What the duality gap is made of.
        hidden: What quadrature may have missed of J(v).
        rounding: What rounding may do to norms.
    """
    steep, energy = total.steepness, total.energy
    unsure = hidden + total.energy_slack
    unsure += rounding * (2.0 * np.sqrt(steep) + rounding) + 1e-14 * (steep + abs(energy))
    return float(energy - unsure - ball.far**2 / 2 - ball.contact), float(energy + unsure)


def _made(known: _Known, v: Companion, ball: _Ball, lift: float) -> Made:
    """Keep what y and v are made of, and the ball, lift being ℓ's norm."""
    flux, certain, segments, alpha = known.flux, known.certain, known.segments, v.boundary.alpha
    some = certain.missed is not None or bool(segments.missed.any())
    return Made(
        level=known.level,
        w=known.w,
        kappa=known.kappa.mean,
        least=known.kappa.eigenvalues.low,
        most=known.kappa.eigenvalues.high,
        stretch=known.cells.stretch,
        hats=certain.load.hats,
        segments=segments,
        within=Within.of(known.cells, known.kappa, v, known.w),
        excess=flux.excess,
        beyond=flux.beyond,
        vertices=v.vertices,
        bumps=v.bumps,
        thirds=v.thirds,
        bubbles=v.bubbles,
        cusps=v.cusps,
        reaction=known.c.low,
        most_reaction=known.c.high,
        left=flux.left,
        taken_up=flux.taken_up,
        shed=flux.shed,
        forces=_forces(alpha, flux),
        missed=_missed(known.cells, certain, segments) if some else np.array(0.0),
        reach=float(ball.bound - ball.near / 2 + ball.loose + lift / 2),
        loose_and_lift=float(ball.loose + lift),
        lift=v.lift,
        bounded=alpha.side.dofs,
        on_contact_alone=flux.carried is not None,
        contact=flux.contact if flux.carried is None else flux.contact - flux.carried,
        complementary=float(ball.contact + ball.far**2 / 4),
        above=float(ball.contact),
    )


def _forces(alpha: OnParts, flux: Flux) -> dict[int, float]:
    """Return this rank's share of the contact force on each part, by the part's number."""
    found: dict[int, float] = {}
    first = 0
    for part in alpha.parts:
        end = first + len(part.middle)
        number = part.condition.number
        own = part.sign * float(flux.contact[first:end].sum())
        found[number] = found.get(number, 0.0) + own
        first = end
    return found


def _size(cells: Cells, kappa: Coefficient, w: FloatArray, flux: Flux) -> float:
    """Estimate the bound: ‖p‖, but for κ within cells; collective.

    Where that is next to nothing, as without a load, the jumps of u_h tell.
    """
    squares = field_squares(cells, flux.excess) / kappa.mean
    scales = kappa.mean * flux.steepness
    square, scale, number = cells.total(np.sum(squares), np.sum(scales), cells.number)
    if square < 0.05 * scale / number:
        index_map = cells.domain.mesh.topology.index_map(0)
        size, flat = index_map.size_local + index_map.num_ghosts, cells.vertices.ravel()
        total, count = (
            cells.share(np.bincount(flat, values, minlength=size).astype(np.float64), 0)
            for values in (w.ravel(), None)
        )
        change = (total / np.maximum(count, 1.0))[cells.vertices] - w
        jumps = kappa.mean * cells.slopes(change)
        square += float(cells.total(np.sum(np.maximum(jumps, 0.0)))[0])
    return float(np.sqrt(max(square, 1e-16 * scale, 1e-200)))


NORM_ROUNDING = 64 * np.finfo(np.float64).eps
"""Relative error of what a cell adds to the certificate's norms."""
UNDERFLOW = 1e-150
"""Most that a cell may lose of a norm: squares of what is below 1e-154 are hardly numbers."""


def _rounding(
    cells: Cells,
    kappa: Coefficient,
    reaction: FloatArray,
    w: FloatArray,
    load: VolumeMoments,
    flux: Flux,
) -> float:
    """Bound what rounding may do to ‖p ± b‖; collective.

    Gradients are differences of values, fluxes are differences of gradients' and loads' shares: all
    is as large as the values times the hat functions' gradients, and as h‖f‖, or smaller. So it is
    with ω, of which y may have the curl. And what squares below all numbers have lost is there.
    """
    largest = None if flux.beyond is None else flux.beyond.largest(cells)
    total, size, stiff, some = 0.0, 0.0, 0.0, bool(flux.excess.any())
    for block in blocks(cells.number):
        low, high = pick(kappa.bounds.low, block), pick(kappa.bounds.high, block)
        size = max(size, float(cells.diameter2[block].max(initial=0.0)))
        stiff = max(stiff, float(np.max(high, initial=0.0)))
        values = np.maximum(w[:, block].max(axis=0), -w[:, block].min(axis=0))
        trace = cells.trace(block)
        square = high * trace * values**2
        of_load = np.abs(load.mean[block])
        if load.variance is not None:
            of_load += np.sqrt(load.variance[block])
        some = some or bool(of_load.any()) or bool(values.any())
        square += cells.diameter2[block] * cells.volume[block] * of_load**2 / low
        square += pick(reaction, block) * cells.volume[block] * values**2
        if largest is not None:
            square += trace * largest[block] ** 2 / low
        if cells.stretch is not None:  # it is as good as κ's eigenvalues are near to one another
            square *= (kappa.eigenvalues.high[block] / kappa.eigenvalues.low[block]) ** 2
        total += float(np.sum(square))
    own = total, cells.number, float(cells.volume.sum()), some
    total, number, volume, there = cells.total(*own)
    size, stiff = np.sqrt(np.max(cells.comm.allgather((size, stiff)), axis=0))
    lost = UNDERFLOW * (stiff + (1.0 + size) * (1.0 + np.sqrt(volume)) / np.sqrt(kappa.smallest))
    return float(NORM_ROUNDING * np.sqrt(total) + lost * np.sqrt(number) * (there > 0.0))


def _hidden(known: _Known, v: Companion, sums: Sums) -> tuple[float, float]:
    """Bound what quadrature may have missed of f and g: shares of ω and of J(v); collective.

    On T, ∫ (f − q) e = e_T ∫ (f − q) + ∫ (f − q)(e − e_T), with Poincaré's inequality for the last;
    on F, ∫ (g − q) e = e_T ∫ (g − q) + ∫ (g − q)(e − e_T) likewise. Whatever the signs of the first
    terms, they are bounded as if all were the same: by what they are for |e|, which has ∇e's norm.
    Where b is strong, ∫ (g − q) e is at most ‖b^{-1/2}(g − q)‖ ‖b^{1/2} e‖ as a whole.
    """
    cells, kappa, certain, segments = known.cells, known.kappa, known.certain, known.segments
    if not _misses(cells, certain, segments):
        return 0.0, 0.0
    square, change = 0.0, 0.0
    if certain.missed is not None and certain.rough is not None:
        missed = certain.missed
        for block in blocks(cells.number):
            by_slope = rough = (
                mean_to_norm(cells, kappa.bounds.low, NOTHING, block) * certain.rough[block]
            )
            if reacts(known.c.low):
                rough = (
                    mean_to_norm(cells, kappa.bounds.low, known.c.low, block) * certain.rough[block]
                )
            means = np.abs(sum_rows(v.vertices[cells.vertices[:, block]])) / (cells.tdim + 1)
            if cells.tdim == 2:
                means += sum_rows(np.abs(v.bumps[cells.facets[:, block]])) / 3
            if v.bubbles is not None:
                means += np.abs(v.bubbles[block]) / 60
            steep = np.sqrt(np.maximum(sums.steepness[block], 0.0))
            change += float(means @ missed[block] + by_slope @ steep)
            square += float(rough @ rough)
            sums.indicators[block] += rough**2
        if v.cusps is not None:
            change += float(np.abs(v.cusps.means) @ missed[v.cusps.at])
    at, sizes = segments.beyond()
    on_edge = np.sum(shares := sizes**2 / pick(kappa.bounds.low, at))
    np.add.at(sums.indicators, at, shares)
    change += segments.change(v.vertices, v.bumps, v.thirds)
    square, on_edge, of_loss, change = cells.total(
        square, on_edge, np.sum(segments.beyond_loss), change
    )
    loose = np.hypot(np.sqrt(square) + np.sqrt(on_edge), np.sqrt(of_loss))
    return float(loose + known.unsure), float(change)


def _misses(cells: Cells, certain: Certain, segments: Segments) -> bool:
    """Tell whether quadrature may have missed anything of f and g; collective."""
    return any(cells.total(certain.missed is not None, bool(segments.missed.any())))


def _of_means(known: _Known) -> float:
    """Bound what quadrature may have missed of integrals of f and g, see `_missed`; collective."""
    cells, certain, segments = known.cells, known.certain, known.segments
    if not _misses(cells, certain, segments):
        return 0.0
    missed = _missed(cells, certain, segments)
    return unbalanced(
        known.level, cells, missed, known.kappa.eigenvalues.low, known.size, known.c.low
    )


def _missed(cells: Cells, certain: Certain, segments: Segments) -> FloatArray:
    """Bound what quadrature may have missed of integrals of f, and of g but where b takes it up."""
    on_facets = np.where(segments.given, 0.0, segments.missed)
    on_edge = np.bincount(segments.facets.cells, on_facets, minlength=cells.number)
    return np.asarray(on_edge if certain.missed is None else certain.missed + on_edge)


def _lifted(known: _Known, v: Companion, sums: Sums) -> tuple[float, float, float, float]:
    """Bound what ℓ changes, this rank's shares.

    Returns:
        ℓ's energy norm squared, how far J(v + ℓ) may be from J(v), and what ‖p − b‖² and ‖p + b‖²
        grow by, the last put into the cells' shares.
    """
    at, slope, size, edge = v.lift
    if not len(at):
        return 0.0, 0.0, 0.0, 0.0
    cells, kappa = known.cells, known.kappa
    which, place = np.unique(at, return_inverse=True)
    high = kappa.eigenvalues.high[which] if kappa.eigenvalues.high.ndim else kappa.eigenvalues.high
    steep, area = np.sqrt(high) * np.bincount(place, slope), np.bincount(place, size)
    before = np.sqrt(np.maximum(sums.steepness[which], 0.0))
    with np.errstate(invalid="ignore"):  # infinite where v has a reason for no bound
        change = before * steep + np.sqrt(cells.volume[which]) * _mean_square(known, which) * area
    if sums.apart is not None:
        c = pick(known.c.high, which)
        steep = np.hypot(steep, np.sqrt(c) * area)
        change += np.sqrt(c * sums.apart[which]) * area
    # on facets of Γ1 with a flux that is known
    loss, known_flux, apart = known.segments.at_facets(v.vertices, v.bumps, known.w)
    there, on_contact = v.boundary.alpha.side.dofs, place[len(place) - len(edge) :]
    more = edge * (known_flux[there] + loss[there] * apart[there])
    change += np.bincount(on_contact, more, minlength=len(which))
    steep = steep + np.bincount(on_contact, np.sqrt(loss[there]) * edge, minlength=len(which))
    change += 0.5 * steep**2
    noise = 1e-14 * np.abs(sums.indicators[which])  # rounding may put shares below 0
    if sums.zeroth is not None:
        noise = noise + 2.0 * sums.zeroth[which]
    far, near = (
        steep * (2.0 * np.sqrt(np.maximum(row[which], 0.0) + noise) + steep)
        for row in (sums.across, sums.middle)
    )
    sums.middle[which] = np.maximum(sums.middle[which], 0.0) + near
    sums.indicators[which] += steep**2
    return float(np.sum(steep**2)), float(np.sum(change)), float(np.sum(far)), float(np.sum(near))


def _mean_square(known: _Known, which: IndexArray) -> FloatArray:
    """Bound |T|^{-1/2}‖f − c u_h‖_T on some cells, shape (n,)."""
    load, rough = known.certain.load, known.certain.rough
    f = np.abs(load.mean[which])
    if load.variance is not None:
        f = np.hypot(f, np.sqrt(load.variance[which]))
    if rough is not None:
        f += rough[which] / np.sqrt(known.cells.volume[which])
    return f
