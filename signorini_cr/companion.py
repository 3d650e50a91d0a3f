"""A conforming function near u_h: the primal half of the certificate.

v is continuous, v = u_D on Γ0 and v ≥ α on Γ1. It is P1 with the means of u_h's vertex values, plus
(for d = 2) a quadratic bump b_F = 4 λ_j λ_k on each facet, whose heights are found by a sweep that
brings ∇v nearer to ∇u_h. What u_D and α have beyond quadratic polynomials goes into a lifting ℓ in
the boundary cells, of which the norm is known. `docs/certificate.md` has the mathematics.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from .cells import Cells, Side, blocks, corner_points, dot_rows, pick
from .domain import CONTACT, DIRICHLET
from .flux import Flux
from .moments import Trace

FloatArray = npt.NDArray[np.float64]

JUMP = "u_D jumps where boundary facets meet: no function of finite energy has such values"
BELOW = "u_D is below α where Γ0 meets Γ1: no function satisfies both"
CURVED = "u_D or α is not affine on the facets: their lifting is known for d = 2 only"


@dataclass(eq=False)
class Companion:
    """v, and what is needed of it.

    Attributes:
        vertices: v at the vertices, ghosts included.
        bumps: Heights of v's bumps by facet dof, ghosts included.
        excess: v − u_h at the cells' vertices, before the bumps, shape (d + 1, cells).
        contact: Σ over Γ1 of ∫_F (y·n)(v + ℓ − α), by facet, shape (n,).
        lift: Pairs of cells and bounds of ‖∇ℓ‖_T, ‖ℓ‖_T, shapes (n,).
        reason: Why v is not admissible, if it isn't.
    """

    vertices: FloatArray
    bumps: FloatArray
    excess: FloatArray
    contact: FloatArray
    lift: tuple[npt.NDArray[np.intp], FloatArray, FloatArray]
    reason: str | None


def companion(
    cells: Cells,
    kappa: FloatArray,
    w: FloatArray,
    u: FloatArray,
    flux: Flux,
    u_D: Trace,
    alpha: Trace,
    on_contact: tuple[FloatArray, FloatArray, FloatArray],
    sweeps: int,
) -> Companion:
    """Make v.

    Args:
        cells: The mesh.
        kappa: Mean of κ, shape (cells,) or ().
        w: u_h at the cells' vertices, shape (d + 1, cells).
        u: u_h by facet dof.
        flux: y.
        u_D: Values on Γ0.
        alpha: Obstacle on Γ1.
        on_contact: Its values.
        sweeps: How often the bumps are improved.
    """
    fixed, contact = cells.sides[DIRICHLET], cells.sides[CONTACT]
    on_fixed = u_D.at(cells.domain.mesh, fixed.entities)
    obstacle, middle, inside = on_contact
    touching = flux.touching
    v = _at_vertices(cells, w, fixed, on_fixed[0], contact, obstacle, touching)
    scale = max(1e-300, float(np.abs(v).max(initial=0.0)))
    scale = max(cells.comm.allgather(scale))
    wrong = [
        JUMP if np.abs(v[fixed.ends] - on_fixed[0]).max(initial=0.0) > 1e-9 * scale else None,
        BELOW if (obstacle - v[contact.ends]).max(initial=0.0) > 1e-9 * scale else None,
    ]
    bumps = np.zeros(len(u))
    lowest = np.full(len(u), -np.inf)
    free = np.ones(len(u), dtype=bool)
    if cells.tdim == 2:
        bumps[fixed.dofs] = on_fixed[1] - v[fixed.ends].mean(axis=0)
        free[fixed.dofs] = False
        # The quadratic through α's three values stays below v as long as the bump is this high
        room = np.sqrt(np.maximum(v[contact.ends] - obstacle, 0.0)).sum(axis=0) ** 2 / 4
        lowest[contact.dofs] = middle - obstacle.mean(axis=0) - room
        free[contact.dofs[touching]] = False
        bumps[contact.dofs] = np.maximum(lowest[contact.dofs], 0.0)
        bumps[contact.dofs[touching]] = lowest[contact.dofs[touching]]
        # A facet's values reach the ranks that share it
        if cells.comm.size > 1:
            cells.share(bumps)
            taken = np.zeros(len(u))
            taken[~free] = 1.0
            free = cells.share(taken) == 0.0
    excess = v[cells.vertices]
    excess -= w
    for _ in range(sweeps if cells.tdim == 2 else 0):
        _sweep(cells, kappa, excess, bumps, free)
        bumps[contact.dofs] = np.maximum(bumps[contact.dofs], lowest[contact.dofs])
    miss = [
        _miss(cells, side, trace, values, v, bumps)
        for side, trace, values in ((fixed, u_D, on_fixed), (contact, alpha, on_contact))
    ]
    miss[1] = (np.maximum(miss[1][0], 0.0), np.where(miss[1][0] > 0, miss[1][1], 0.0))
    above = inside - on_facet(cells, contact, alpha, v, bumps)
    gap = alpha.weights @ np.maximum(-above, 0.0)
    lifts = [
        _lift(cells, side, trace, *values)
        for side, trace, values in zip((fixed, contact), (u_D, alpha), miss, strict=True)
    ]
    if cells.tdim > 2 and any(lift[0].max(initial=0.0) > 1e-9 * scale for lift in lifts):
        wrong.append(CURVED)
    words = [word for word in wrong if word]
    words = [word for rank in cells.comm.allgather(words) for word in rank]
    return Companion(
        v,
        bumps,
        excess,
        flux.contact * gap,
        (
            np.concatenate([fixed.cells, contact.cells]),
            np.concatenate([lifts[0][0], lifts[1][0]]),
            np.concatenate([lifts[0][1], lifts[1][1]]),
        ),
        words[0] if words else None,
    )


def _at_vertices(
    cells: Cells,
    w: FloatArray,
    fixed: Side,
    u_D: FloatArray,
    contact: Side,
    obstacle: FloatArray,
    touching: npt.NDArray[np.bool_],
) -> FloatArray:
    """Means of u_h's values at the vertices, raised to α on Γ1, u_D on Γ0."""
    index_map = cells.domain.mesh.topology.index_map(0)
    size = index_map.size_local + index_map.num_ghosts
    flat = cells.vertices.ravel()

    def collect(where: Any, values: Any) -> FloatArray:
        return cells.share(np.bincount(where, values, minlength=size).astype(np.float64), 0)

    v = collect(flat, w.ravel())
    v /= np.maximum(collect(flat, None), 1.0)
    ends = contact.ends.ravel()
    count = collect(ends, None)
    value = collect(ends, obstacle.ravel()) / np.maximum(count, 1.0)
    held = collect(contact.ends[:, touching].ravel(), None) > 0
    np.copyto(v, np.where(held, value, np.maximum(v, value)), where=count > 0)
    ends = fixed.ends.ravel()
    count = collect(ends, None)
    np.copyto(v, collect(ends, u_D.ravel()) / np.maximum(count, 1.0), where=count > 0)
    return v


def _sweep(
    cells: Cells,
    kappa: FloatArray,
    excess: FloatArray,
    bumps: FloatArray,
    free: npt.NDArray[np.bool_],
) -> None:
    """One step of steepest descent for ‖κ^{1/2}(∇v − ∇u_h)‖² in the heights of the bumps."""
    slope = np.empty_like(excess)
    diagonal = np.empty_like(excess)
    for part in blocks(cells.number):
        k = pick(kappa, part)
        height = bumps[cells.facets[:, part]]
        trace = cells.trace(part)
        diagonal[:, part] = trace * k
        slope[:, part] = k * (
            cells.apply(excess[:, part], part) - trace * height - 2.0 * _across(cells, height, part)
        )
    down = cells.over_facets(slope)
    diagonal_of_facets = cells.over_facets(diagonal)
    owned = cells.owned_facets()
    down *= free
    gain = down[:owned] @ (down[:owned] / diagonal_of_facets[:owned])
    down /= diagonal_of_facets
    energy = 0.0
    for part in blocks(cells.number):
        k = pick(kappa, part)
        step = down[cells.facets[:, part]]
        energy += float(np.sum(k * bump_squares(cells, step, part)))
    gain, energy = cells.total(4 / 3 * gain, energy)
    if energy > 0:
        bumps += gain / energy * down


def _across(cells: Cells, height: FloatArray, part: slice) -> FloatArray:
    """Σ_{j ≠ i} |T| ∇λ_i·∇λ_j height_j."""
    out = np.zeros_like(height)
    for (i, j), s in zip(cells.pairs, cells.stiffness[:, part], strict=True):
        out[i] += s * height[j]
        out[j] += s * height[i]
    return out


def bump_squares(cells: Cells, height: FloatArray, part: slice) -> FloatArray:
    """‖∇ Σ height_i b_i‖²_T for d = 2, shape (cells in the part,)."""
    out = cells.trace(part) * dot_rows(height, height)
    for (i, j), s in zip(cells.pairs, cells.stiffness[:, part], strict=True):
        out += 4.0 * s * height[i] * height[j]
    out *= 4 / 3
    return out


def on_facet(
    cells: Cells, side: Side, trace: Trace, v: FloatArray, bumps: FloatArray
) -> FloatArray:
    """Values of v at the quadrature points of facets, shape (q, n)."""
    values = trace.hats @ v[side.ends]
    if cells.tdim == 2:
        values += 4.0 * np.outer(trace.hats.prod(axis=1), bumps[side.dofs])
    return values


def _miss(
    cells: Cells,
    side: Side,
    trace: Trace,
    values: tuple[FloatArray, FloatArray, FloatArray],
    v: FloatArray,
    bumps: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Data less v at the quadrature points, shape (q, n), and the derivative along a segment."""
    gap = values[2] - on_facet(cells, side, trace, v, bumps)
    if cells.tdim != 2:
        return gap, np.zeros_like(gap)
    _, (a, b) = corner_points(cells, side)
    length = np.linalg.norm(b - a, axis=1)
    along = np.zeros_like(gap)
    slopes = trace.slopes(cells.domain.mesh, side.entities)
    along += (slopes * ((b - a) / length[:, None])).sum(axis=-1)
    s = trace.points
    first, second = v[side.ends]
    along = along - (second - first + 4.0 * (1.0 - 2.0 * s) * bumps[side.dofs]) / length
    return gap, along


def _lift(
    cells: Cells, side: Side, trace: Trace, gap: FloatArray, along: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """‖∇ℓ‖_T and ‖ℓ‖_T of the lifting ℓ(P + t (z − P)) = t gap(z), P opposite the facet.

    With H the height of P and s the coordinate along the facet from P's foot,
    ‖∇ℓ‖² = (H/d) ∫_F |gap'|² + (gap − s gap')²/H² and ‖ℓ‖² = H/(d + 2) ∫_F gap².
    """
    d = cells.tdim
    apex, ends = corner_points(cells, side)
    if d != 2:
        top = np.abs(gap).max(axis=0, initial=0.0)
        return top, top
    length = np.linalg.norm(ends[1] - ends[0], axis=1)
    height = d * cells.volume[side.cells] / length
    unit = (ends[1] - ends[0]) / length[:, None]
    foot = ((ends[0] - apex) * unit).sum(axis=1)
    s = foot + trace.points * length
    square = along**2 + ((gap - s * along) / height) ** 2
    return (
        np.sqrt(height / d * length * (trace.weights @ square)),
        np.sqrt(height / (d + 2) * length * (trace.weights @ gap**2)),
    )
