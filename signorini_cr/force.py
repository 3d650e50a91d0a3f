"""Guaranteed bounds of what flows through parts of the boundary, corrected by a dual solution."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from ufl.core.expr import Expr

from .arrays import FloatArray
from .data.loads import trace_of
from .dual import certified
from .errors import InputError
from .estimate.certificate import Made
from .estimate.force import (
    Certified,
    Interval,
    against,
    force_interval,
    lost_of_norms,
    made_of,
    of_bumps,
    square,
    through,
    unsure,
)
from .estimate.settled import Settled, in_p1, left_by
from .estimate.weights import Weighed, Weight, ranges, scalar
from .fem.cells import Cells, measures
from .fem.conditions import Condition, Data, Dirichlet, Robin
from .fem.problem import Forms, Problem
from .hints import meant
from .mesh.domain import named

__all__ = ["Interval", "flux", "force_bounds"]


def force_bounds(solution: Certified) -> tuple[float, float]:
    """Bound the contact force of u itself by two numbers; collective.

    The force is ∫_Γ1 λ, λ = κ∂ₙu + b (u − u_ext) − g, which is κ∂ₙu unless the condition says more.

    Args:
        solution: One with a certified bound.

    Raises:
        InputError: There is no bound; the message says why.
    """
    return _interval(solution, made_of(solution).data.forms.bounded)[1:]


def flux(solution: Certified, *parts: str | int, weight: Data | None = None) -> Interval:
    """Put what flows into Ω through parts of the boundary between two numbers; collective.

    On a Dirichlet part that is ∫ κ∂ₙu, on a contact part the contact force, as in `force_bounds`.

    Args:
        solution: One with a certified bound.
        *parts: Names or facet values of Dirichlet or contact parts; without a weight they must
            touch no others of these.
        weight: What is integrated with it, as ∫ λ ω, continuous on the parts and 0 where they touch
            others; None for 1.

    Raises:
        InputError: No part is named, there is no such part, or there is no bound; the message says
            why.
    """
    made = made_of(solution)
    forms = made.data.forms
    known = {c.part: c for c in (*forms.fixed, *forms.bounded)}
    if not parts:
        raise InputError(f"parts: there is none; {meant('', known)}")
    names = [named(made.level.domain.parts, part) for part in parts]
    for part, name in zip(parts, names, strict=True):
        if name not in known:
            raise InputError(
                f"{part!r} is no Dirichlet or contact part of the boundary; {meant(part, known)}"
            )
    if len(set(names)) < len(names):
        raise InputError(f"parts: {', '.join(names)}: each may be given once")
    conditions = [known[name] for name in names]
    return _interval(solution, conditions, weight)


def _interval(
    solution: Certified, conditions: Sequence[Condition], weight: Data | None = None
) -> Interval:
    """Take the better ends of both intervals, with the data as they were; collective."""
    made = made_of(solution)
    cells = made.cells()
    with made.level.as_made():
        found = force_interval(made, cells, conditions, weight)
        other = _corrected(made, cells, solution, conditions, weight)
    if other is None:
        return found
    lower, upper = max(found.lower, other[0]), min(found.upper, other[1])
    return Interval(found.value, lower, max(lower, upper))


class _ByPhi(NamedTuple):
    """∫ λ as a(v, φ) − χ(φ), before what Γ1 leaves.

    Attributes:
        middle: The number.
        reach: How far it may be from the truth.
        at: φ at the cells' vertices, shape (d + 1, cells).
        flows: y·n of φ's flux, shape (d + 1, cells).
    """

    middle: float
    reach: float
    at: FloatArray
    flows: FloatArray


def _corrected(
    made: Made,
    cells: Cells,
    solution: Certified,
    conditions: Sequence[Condition],
    weight: Data | None,
) -> tuple[float, float] | None:
    """Bound ∫ λ over parts by a(v, φ) − χ(φ), a-harmonic φ; None where contact begins or ends.

    Parts without contact are bounded for themselves, whatever there is on others.

    a(u − v, φ) is a product of two errors, and what Γ1 leaves: y·n of φ's flux times u − v where
    there is contact, φ times λ where there is none. With a weight ω φ has its values at vertices,
    and ℓ is what it lacks, as in `force_interval`.
    """
    settled = Settled.of(made, cells)
    known = [condition for condition in conditions if condition not in settled.free]
    if settled.mixed and known:
        return None
    omega = None if weight is None else scalar(weight, made.data.forms, made.level.domain)
    none: FloatArray = np.zeros((cells.tdim + 1, cells.number))
    found: _ByPhi | None = _ByPhi(0.0, 0.0, none, none)
    if known:
        found = _by_phi(made, cells, solution, settled, conditions, known, omega)
    if found is None:
        return None
    reach = found.reach + _left_on_contact(made, cells, settled, conditions, omega, found)
    return float(found.middle - reach), float(found.middle + reach)


def _by_phi(
    made: Made,
    cells: Cells,
    solution: Certified,
    settled: Settled,
    conditions: Sequence[Condition],
    known: Sequence[Condition],
    omega: Expr | None,
) -> _ByPhi | None:
    """Solve for φ, and work it against v; None where φ has no bound; collective.

    Args:
        made: v and y.
        cells: The mesh.
        solution: Of the problem.
        settled: Where there is contact for certain, and where there is none.
        conditions: The parts.
        known: Those of them with contact, or on which u is set.
        omega: ω; None for 1.
    """
    bound = solution.certificate.bound_companion
    assert bound is not None
    forms = made.data.forms
    value = 1.0 if omega is None else omega
    dual = certified(_harmonic(forms, conditions, settled.free, value), made.level)
    phi = in_p1(dual, cells, bent=omega is not None)
    if phi is None:
        return None
    assert dual.bound_companion is not None
    at = phi.vertices[cells.vertices]
    lost = lost_of_norms(made, cells)
    apart, weighed = 0.0, Weighed(force=sum(through(made, cells, c) for c in known))
    if omega is not None:
        given, own = Weight.of(made, cells, known, omega, settled.free), at
        at = given.put_into(own)
        *off_companion, size = np.sqrt(
            cells.total(
                square(made, cells, at - own), of_bumps(phi, cells), square(made, cells, at)
            )
        )
        apart = float(sum(off_companion)) + 2.0 * lost
        weighed = given.weighed(made, cells, float(size) + lost)
    product = bound * (dual.bound_companion + apart)
    if settled.held:
        product += bound * left_by(phi, made)
        if not np.isfinite(product):
            return None
    work, missed, slack = against(made, cells, at)
    force, work, energy, lifted, more = cells.total(
        weighed.force,
        work,
        square(made, cells, at),
        weighed.square,
        missed + unsure(made, at, slack, weighed) + weighed.unsure,
    )
    reach = made.loose_and_lift * (np.sqrt(energy) + lost) + more + product
    reach += 2.0 * made.reach * (np.sqrt(lifted) + lost)
    return _ByPhi(force + work, reach, at, phi.through(cells))


def _left_on_contact(
    made: Made,
    cells: Cells,
    settled: Settled,
    conditions: Sequence[Condition],
    omega: Expr | None,
    found: _ByPhi,
) -> float:
    """Bound what Γ1 leaves of a(u − v, φ); collective.

    Args:
        made: v and y.
        cells: The mesh.
        settled: Where there is contact for certain, and where there is none.
        conditions: The parts that are asked for.
        omega: ω; None for 1.
        found: φ.
    """
    through_facets, off = np.zeros((2, len(cells.exterior)))
    loss = np.zeros((2, len(cells.exterior)))
    loss[:, made.segments.facets.dofs] = made.segments.loss, made.segments.most
    for condition in (*settled.held, *settled.free):
        side, chosen = cells.sides[condition.number], float(condition in conditions)
        trace = trace_of(cells, side, found.at)
        ends: Sequence[float | FloatArray] = (chosen,)
        flows = found.flows[side.local, side.cells]
        lost = loss[:, None, side.dofs] * measures(cells, side) * trace
        through_facets[side.dofs] = np.abs(flows + lost).max(axis=(0, 1))
        if omega is not None and chosen and condition in settled.free:
            ends = ranges(made.data.compiled.trace(omega), cells, side)
        off[side.dofs] = np.max([np.abs(trace - end).max(axis=0) for end in ends], axis=0)
    return settled.unknown(made, cells, through_facets, off)


def _harmonic(
    forms: Forms, chosen: Sequence[Condition], free: Sequence[Condition], value: Data
) -> Problem:
    """Return the linear problem whose solution is set on some parts, 0 on the rest of Γ0 and Γ1.

    Elsewhere its flux is 0.

    Args:
        forms: What a comes from.
        chosen: Where it is set.
        free: Parts of Γ1 on which it is neither: there is no contact.
        value: What it is there, 1 or a weight.
    """
    found: dict[str, Condition] = {}
    for each in forms.conditions:
        if (each.fixed is not None or each.bounds) and each not in free:
            found[each.part] = Dirichlet(value if each in chosen else 0.0)
        else:
            found[each.part] = Robin(0.0, coefficient=0.0 if each.loss is None else each.loss)
    return forms.called.linear(0.0, found)
