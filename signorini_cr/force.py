"""Guaranteed bounds of what flows through parts of the boundary, corrected by a dual solution."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from .arrays import FloatArray
from .data.diffusion import diffusion
from .data.moments import OnParts
from .dual import certified
from .errors import InputError
from .estimate.certificate import Made
from .estimate.flux import unbalanced
from .estimate.force import (
    Certified,
    Interval,
    against,
    interval,
    made_of,
    square,
    through,
    unsure,
)
from .estimate.lifting import gaps
from .fem.cells import measures
from .fem.conditions import Condition, Data, Dirichlet, Robin
from .fem.problem import Problem

__all__ = ["Interval", "flux", "force_bounds"]


def force_bounds(solution: Certified) -> tuple[float, float]:
    """Two numbers with the contact force of u itself between them; collective.

    The force is ∫_Γ1 λ, λ = κ∂ₙu + b (u − u_ext) − g, which is κ∂ₙu unless the condition says more.

    Args:
        solution: One with a certified bound.

    Raises:
        InputError: There is no bound; the message says why.
    """
    return _interval(solution, diffusion(made_of(solution).level.data).forms.bounded)[1:]


def flux(solution: Certified, *parts: str, weight: Data | None = None) -> Interval:
    """Put what flows into Ω through parts of the boundary between two numbers; collective.

    On a Dirichlet part that is ∫ κ∂ₙu, on a contact part the contact force, as in `force_bounds`.

    Args:
        solution: One with a certified bound.
        *parts: Names of Dirichlet or contact parts; without a weight they must touch no others of
            these.
        weight: What is integrated with it, as ∫ λ ω, continuous on the parts and 0 where they touch
            others; None for 1.

    Raises:
        InputError: There is no such part, or there is no bound; the message says why.
    """
    forms = diffusion(made_of(solution).level.data).forms
    known = {c.part: c for c in (*forms.fixed, *forms.bounded)}
    for part in parts:
        if part not in known:
            raise InputError(
                f"{part!r} is no Dirichlet or contact part of the boundary; there are"
                f" {', '.join(known)}"
            )
    conditions = [known[part] for part in parts]
    if weight is not None:
        return interval(solution, conditions, weight)
    return _interval(solution, conditions)


def _interval(solution: Certified, conditions: Sequence[Condition]) -> Interval:
    """Take the better ends of both intervals; collective."""
    found = interval(solution, conditions)
    other = _corrected(made_of(solution), solution, conditions)
    if other is None:
        return found
    lower, upper = max(found.lower, other[0]), min(found.upper, other[1])
    return Interval(found.value, lower, max(lower, upper))


def _corrected(
    made: Made, solution: Certified, conditions: Sequence[Condition]
) -> tuple[float, float] | None:
    """Bound ∫ λ over parts by a(v, φ) − χ(φ), a-harmonic φ; None where contact begins or ends.

    a(u − v, φ) is a product of two errors, and what Γ1 leaves: y·n of φ's flux times u − v where
    there is contact, φ times λ where there is none.
    """
    cells = made.cells()
    forms = diffusion(made.level.data).forms
    alpha = OnParts.of(diffusion(made.level.data).alpha, cells)
    force = np.zeros(len(cells.exterior))
    np.maximum.at(force, alpha.side.dofs, made.contact)
    held: list[Condition] = []
    for condition in forms.bounded:
        dofs = cells.sides[condition.number].dofs
        touching, number = cells.total(float((force[dofs] > 0.0).sum()), float(len(dofs)))
        if 0 < touching < number:
            return None
        held += [condition] if touching else []
    free = [condition for condition in forms.bounded if condition not in held]
    bound = solution.certificate.bound_companion
    assert bound is not None
    product, middle, reach = 0.0, 0.0, 0.0
    at: FloatArray = np.zeros((cells.tdim + 1, cells.number))
    flows = np.zeros_like(at)
    if any(condition not in free for condition in conditions):
        problem = _harmonic(forms.problem, forms.conditions, conditions, free)
        dual = certified(problem, made.level)
        of_phi = dual._made
        if of_phi is None or dual.bound_companion is None:
            return None
        at, flows = of_phi.vertices[cells.vertices], of_phi.through(cells)
        bent = cells.total(float(np.abs(of_phi.bumps).sum()))[0] > 0.0
        if bent or of_phi.thirds is not None:
            return None
        product = bound * dual.bound_companion
        if held:  # z's certificate asks of e what only z does: to vanish where there is contact
            left = of_phi.left if of_phi.taken_up is None else of_phi.left * ~of_phi.taken_up
            around = diffusion(made.level.data).cells  # these know Γ0
            product += bound * unbalanced(made.level, around, left, made.least, 0.0, made.reaction)
            if not np.isfinite(product):
                return None
        work, slack = against(made, cells, at)
        own, work, energy, more = cells.total(
            sum(through(made, cells, c) for c in conditions if c not in free),
            work,
            square(made, cells, at),
            unsure(made, at, slack),
        )
        middle, reach = own + work, made.loose * np.sqrt(energy) + more
    most, loss = 0.0, np.zeros(len(cells.exterior))
    loss[made.segments.facets.dofs] = made.segments.loss
    for condition in held:
        side = cells.sides[condition.number]
        lost = loss[side.dofs] * measures(cells, side) * float(condition in conditions)
        flow = np.abs(flows[side.local, side.cells] + lost)
        most = max(most, float((flow / force[side.dofs]).max(initial=0.0)))
    held_most = max(cells.comm.allgather(most))
    room = gaps(cells, alpha, made.vertices, made.bumps, made.thirds)
    on_facets = np.full(len(cells.exterior), np.inf)
    np.minimum.at(on_facets, alpha.side.dofs, room)
    for condition in free:
        side = cells.sides[condition.number]
        ends = [at[i, side.cells] for i in range(cells.tdim + 1)]
        off = np.abs(np.stack(ends) - float(condition in conditions))
        off[side.local, np.arange(len(side.cells))] = 0.0
        with np.errstate(divide="ignore", invalid="ignore"):
            ratio = np.where(
                on_facets[side.dofs] > 0.0, off.max(axis=0) / on_facets[side.dofs], np.inf
            )
        most = max(most, float(np.where(off.max(axis=0) == 0.0, 0.0, ratio).max(initial=0.0)))
    most = max(cells.comm.allgather(most))
    reach += product + most * made.complementary
    reach += held_most * made.above if held else 0.0
    return float(middle - reach), float(middle + reach)


def _harmonic(
    problem: Problem,
    conditions: Sequence[Condition],
    chosen: Sequence[Condition],
    free: Sequence[Condition],
) -> Problem:
    """Return the linear problem whose solution is 1 on some parts and 0 on the rest of Γ0 and Γ1.

    Elsewhere its flux is 0.

    Args:
        problem: What a comes from.
        conditions: All conditions.
        chosen: Where it is 1.
        free: Parts of Γ1 on which it is neither: there is no contact.
    """
    found: dict[str, Condition] = {}
    for each in conditions:
        if (each.fixed is not None or each.bounds) and each not in free:
            found[each.part] = Dirichlet(float(each in chosen))
        else:
            found[each.part] = Robin(0.0, coefficient=0.0 if each.loss is None else each.loss)
    return Problem(
        f=0.0,
        coefficient=problem.coefficient,
        reaction=problem.reaction,
        conditions=found,
        materials={name: replace(each, f=None) for name, each in problem.materials.items()},
        quadrature_degree=problem.quadrature_degree,
    )
