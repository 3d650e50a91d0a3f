"""How wrong a solution can be: guaranteed bounds of its error and of the energy.

For v ∈ K and y ∈ H(div) with −div y = f, y·n = g on Γg and y·n ≥ 0 on Γ1 the gap J(v) − D(y) bounds
what neither of them knows about u. Both come from u_h at linear cost, see `flux` and `companion`.
`docs/certificate.md` has the mathematics; the letters are the same there.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
import ufl
from dolfinx import fem

from . import compat
from .cells import Cells, sum_rows
from .companion import Companion, companion, on_facet
from .domain import CONTACT
from .flux import equilibrate, unbalanced
from .gap import Sums, integrate, integrate_edge
from .loads import Load
from .moments import Coefficient, Sampled

if TYPE_CHECKING:
    from .assembly import Level
    from .solution import Solution

FloatArray = npt.NDArray[np.float64]

SHARES = ("flux", "companion", "contact", "load", "neumann", "boundary", "solver")
"""Where a bound comes from: the keys of `Certificate.parts`."""


@dataclass(frozen=True, eq=False)
class Certificate:
    """What is certain about a solution; None where nothing is, `reason` then says why.

    Attributes:
        bound_h1: ‖u − u_h‖_h, the broken norm (1.6), is at most this.
        bound_energy_norm: The same for ‖κ^{1/2} ∇_h(u − u_h)‖.
        bound_companion: The same for ‖κ^{1/2} ∇(u − v)‖, v the conforming companion.
        energy: J(u) lies between these two.
        parts: Where the bound comes from: the norms of y − κ∇u_h (flux) and of ∇(v − u_h)
            (companion), the contact term's square root (contact), the data oscillation of f
            (load), of g (neumann), of u_D and α (boundary), and what the solver left (solver).
        indicators: Square of each cell's share, shape (cells,), owned cells.
        reason: Why figures are missing.
        seconds: Wall time.
    """

    bound_h1: float | None = None
    bound_energy_norm: float | None = None
    bound_companion: float | None = None
    energy: tuple[float, float] | None = None
    parts: dict[str, float] = field(default_factory=dict)
    indicators: FloatArray | None = None
    reason: str | None = None
    seconds: float = 0.0
    _made: _Made | None = None

    @cached_property
    def flux(self) -> fem.Function | None:
        """The flux y as a function in the Raviart-Thomas space of lowest order; collective."""
        if self._made is None:
            return None
        made = self._made
        cells = Cells(made.level.domain, made.level.V)
        mesh, d = cells.domain.mesh, cells.tdim
        everywhere = slice(0, cells.number)
        fluxes = made.excess - d * made.kappa * cells.apply(made.w, everywhere)
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
        y = fem.Function(fem.functionspace(mesh, ("RT", 1)))
        points = y.function_space.element.interpolation_points
        points = points() if callable(points) else points
        y.interpolate(fem.Expression(slope * ufl.SpatialCoordinate(mesh) + shift, points))
        return y

    @cached_property
    def companion(self) -> fem.Function | None:
        """The companion v without its lifting, of degree 2 for d = 2, affine else; collective."""
        if self._made is None:
            return None
        made = self._made
        cells = Cells(made.level.domain, made.level.V)
        degree = 2 if cells.tdim == 2 else 1
        v = fem.Function(fem.functionspace(cells.domain.mesh, ("Lagrange", degree)))
        dofs = v.function_space.dofmap.list[: cells.number]
        values = made.vertices[cells.vertices]
        v.x.array[dofs[:, : cells.tdim + 1]] = values.T
        if degree == 2:
            middle = (values.sum(axis=0) - values) / 2 + made.bumps[cells.facets]
            v.x.array[dofs[:, 3:]] = middle.T
        v.x.scatter_forward()
        return v


@dataclass(frozen=True, eq=False)
class _Made:
    """What y and v are made of; the cells' geometry is made again when it is needed.

    κ is given by its means; whether it varies within cells is told. force is this rank's share of
    ∫_Γ1 y·n, reach the radius of the ball around (y + κ∇v)/2 that has κ∇u in it, loose ends added.
    """

    level: Level
    w: FloatArray
    kappa: FloatArray
    excess: FloatArray
    vertices: FloatArray
    bumps: FloatArray
    varies: bool
    force: float
    reach: float


NO_FLUX = "only a Crouzeix-Raviart solution has an equilibrated flux (see certify, flux_from)"
TENSOR = "the coefficient is not a scalar"
ADRIFT = "part of the domain has no way to Γ0, or a figure is not finite"


def certify(solution: Solution, sweeps: int = 2, flux_from: Solution | None = None) -> Certificate:
    """Bound the error of a solution; collective.

    Args:
        solution: From `solve` or `solve_levels`; it need not be converged.
        sweeps: How often the companion's bumps are improved.
        flux_from: A Crouzeix-Raviart solution on the same mesh whose flux to take; P1 has none.
    """
    began = time.perf_counter()
    base = solution if flux_from is None else flux_from
    level, u = base.level, base.u
    if base.element != "CR" or base.domain is not solution.domain:
        return Certificate(reason=NO_FLUX)
    data = Sampled.of(level.forms)
    if data.kappa is None:
        return Certificate(reason=TENSOR)
    cells, load, edge = level.cells, level.load, level.edge
    kappa = Coefficient(data.kappa, cells)
    if kappa.reason is not None:
        return Certificate(reason=kappa.reason)
    w = vertex_rows(u.x.array, cells)
    contact_side = cells.sides[CONTACT]
    obstacle = data.alpha.at(level.domain.mesh, contact_side.entities)
    gap = u.x.array[contact_side.dofs] - data.alpha.weights @ obstacle[2]
    flux = equilibrate(cells, kappa.mean, w, load, edge, gap)
    if solution.element != "CR":
        conforming = solution.u.function_space.dofmap.list[: cells.number]
        own, sweeps = np.ascontiguousarray(solution.u.x.array[conforming].T), 0
        change = cells.apply(w - own, slice(0, cells.number))
        flux.excess -= cells.tdim * kappa.mean * change
        w = own
    v = companion(cells, kappa.mean, w, u.x.array, flux, data.u_D, data.alpha, obstacle, sweeps)
    sums = integrate(cells, kappa, w, load, flux, v)
    assert sums.indicators is not None
    np.add.at(sums.indicators, contact_side.cells, v.contact)
    edge_square = integrate_edge(cells, kappa, w, load, edge, flux, v, sums)
    lift, lift_energy = _lifted(cells, kappa, load, v, sums)
    on_edge = on_facet(cells, edge.side, edge.g, v.vertices, v.bumps)
    edge_energy = edge.measure @ (edge.g.weights @ (edge.values * on_edge))
    total = dict(zip(_TOTALS, cells.total(*(getattr(sums, name) for name in _TOTALS)), strict=True))
    contact, edge_square, edge_energy, lift, lift_energy = cells.total(
        np.sum(v.contact), edge_square, edge_energy, lift, lift_energy
    )
    lift = np.sqrt(lift)
    left = unbalanced(level, cells, flux.left, kappa.low)
    loose = np.sqrt(edge_square) + left
    same = total["flux"] + total["companion"] + total["load"]
    same += 2 * (total["load_flux"] + total["slack"])
    mixed = 2 * (total["cross"] + total["load_companion"])
    far = np.sqrt(max(same - mixed, 0.0)) + lift + loose
    near = np.sqrt(max(same + mixed, 0.0)) + lift
    bound = near / 2 + loose / 2 + np.sqrt(far**2 / 4 + contact)
    energy = total["energy"] - edge_energy
    level.tidy()
    reason = v.reason or (None if np.isfinite(bound) else ADRIFT)
    if reason is not None:
        return Certificate(reason=reason, seconds=time.perf_counter() - began)
    return Certificate(
        bound_h1=float(bound / np.sqrt(kappa.smallest)),
        bound_energy_norm=float(bound),
        bound_companion=float((far + np.sqrt(far**2 + 4 * contact)) / 2 + lift),
        energy=(
            float(energy - lift_energy - far**2 / 2 - contact),
            float(energy + lift_energy),
        ),
        parts={
            "flux": float(np.sqrt(total["flux"])),
            "companion": float(np.sqrt(total["companion"])),
            "contact": float(np.sqrt(contact)),
            "load": float(np.sqrt(total["load"])),
            "neumann": float(np.sqrt(total["neumann"])),
            "boundary": float(lift),
            "solver": float(left),
        },
        indicators=sums.indicators,
        seconds=time.perf_counter() - began,
        _made=_Made(
            level=level,
            w=w,
            kappa=kappa.mean,
            varies=kappa.values is not None,
            excess=flux.excess,
            vertices=v.vertices,
            bumps=v.bumps,
            force=float(flux.contact.sum()),
            reach=float(bound - near / 2 + loose + lift / 2),
        ),
    )


_TOTALS = (
    "flux",
    "companion",
    "cross",
    "load",
    "load_flux",
    "load_companion",
    "slack",
    "energy",
    "neumann",
)


def vertex_rows(u: FloatArray, cells: Cells) -> FloatArray:
    """u_h at the cells' vertices from its facet dofs, shape (d + 1, cells)."""
    values = u[cells.facets]
    return sum_rows(values) - cells.tdim * values


def _lifted(
    cells: Cells, kappa: Coefficient, load: Load, v: Companion, sums: Sums
) -> tuple[float, float]:
    """‖κ^{1/2} ∇ℓ‖² and how far J(v + ℓ) may be from J(v), bounds of this rank's shares."""
    at, slope, size = v.lift
    if not len(at):
        return 0.0, 0.0
    which, place = np.unique(at, return_inverse=True)
    high = kappa.high[which] if kappa.high.ndim else kappa.high
    steep, area = np.sqrt(high) * np.bincount(place, slope), np.bincount(place, size)
    f = np.abs(load.mean[which])
    if load.variance is not None:
        f = np.hypot(f, np.sqrt(load.variance[which]))
    assert sums.steepness is not None
    before = np.sqrt(np.maximum(sums.steepness[which], 0.0))
    assert sums.indicators is not None
    sums.indicators[which] += steep**2
    change = before * steep + 0.5 * steep**2 + np.sqrt(cells.volume[which]) * f * area
    return float(np.sum(steep**2)), float(np.sum(change))
