"""Guaranteed bounds of integrals of u: over a part of the boundary, a material, or all of Ω."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from dolfinx import fem

from .data.diffusion import diffusion
from .data.loads import Certain, Segments, trace_of
from .dual import Dual, certified, solved
from .errors import InputError
from .estimate.certificate import Certificate, Made, certify
from .estimate.force import Certified, Interval, against, extended, square
from .estimate.pairing import Pairing, in_cells, on_side
from .estimate.settled import Settled, in_p1, left_by
from .estimate.sums import INTEGRAL_ROUNDING
from .estimate.weights import scalar
from .fem.cells import Cells, measures
from .fem.conditions import Condition, Data, Dirichlet, Robin, facets_of
from .fem.layout import Layout
from .fem.problem import Forms, Problem
from .fem.space import function_space
from .hints import meant
from .mesh.domain import Domain, named

DOMAIN = "domain"
"""The place that all of Ω is, unless u has a mean on something else that is called so."""
BOTH = "is a part and a material: one of them needs another name"
NO_MEAN = "u has no bounds there"
NO_WEIGHT = "the weight's integral may be 0, and there is no mean; its integral with u has bounds"
AFLOAT = (
    "nothing but contact is known to hold a part of the domain, and no energy tells how high it is"
)


def mean(
    solution: Certified, where: str | int | None = None, weight: Data | None = None
) -> Interval:
    """Bound the mean of u; collective.

    Args:
        solution: One with a certified bound.
        where: Name or facet value of a part of the boundary on which u is not set, or name of a
            material; None or "domain" for all of the domain.
        weight: ψ, for the weighted mean ∫ ψ u / ∫ ψ; None for 1.

    Raises:
        InputError: There is no such place, or there is no bound; the message says why.
    """
    known, found = _bounded(solution, where, weight)
    if weight is None:
        return Interval(*(each / known.total for each in found))
    low, high = known.total - known.missed, known.total + known.missed
    if low <= 0.0 <= high:
        raise InputError(f"{NO_MEAN}: {NO_WEIGHT}")
    ends = [each / total for each in found[1:] for total in (low, high)]
    return Interval(found.value / known.total, min(ends), max(ends))


def integral(
    solution: Certified, where: str | int | None = None, weight: Data | None = None
) -> Interval:
    """Bound ∫ ψ u; collective.

    It is that of the companion, corrected by what a linear problem with ψ for its load says of the
    difference, up to products of two errors and to what Γ1 leaves unknown, which is of the same
    order where contact is everywhere or nowhere on each part. That takes up to twice as long as
    mesh and solve have taken, where parts are in contact everywhere three times.

    Args:
        solution: One with a certified bound.
        where: Name or facet value of a part of the boundary on which u is not set, or name of a
            material; None or "domain" for all of the domain.
        weight: ψ, of either sign; None for 1.

    Raises:
        InputError: There is no such place, or there is no bound; the message says why.
    """
    return _bounded(solution, where, weight)[1]


def _bounded(
    solution: Certified, where: str | int | None, weight: Data | None
) -> tuple[Pairing, Interval]:
    """Bound ∫ ψ u by two numbers, and return what is known of ψ."""
    with solution.level.as_made():  # for whom the data have changed since
        return _bounded_as_made(solution, where, weight)


def _bounded_as_made(
    solution: Certified, where: str | int | None, weight: Data | None
) -> tuple[Pairing, Interval]:
    """Do so with data that are as they were when the solution was made; collective."""
    certificate, level = solution.certificate, solution.level
    forms = diffusion(level.data).forms
    place = _place(forms, level.domain, where)
    made, bound = certificate.made, certificate.bound_companion
    if made is None or bound is None:
        raise InputError(f"{NO_MEAN}: {certificate.reason}")
    if made.on_contact_alone:
        raise InputError(f"{NO_MEAN}: {AFLOAT}")
    cells = made.cells()
    _insist_on_extent(cells, place)
    psi = 1.0 if weight is None else scalar(weight, forms, level.domain)
    with solved(_dual(forms, place, psi), level) as z:
        dual = certify(z, sweeps=0)
        if dual.energy is None or dual.bound_companion is None:
            _insist_on_weight(dual.reason)
        assert dual.energy is not None and dual.bound_companion is not None
        known = _paired(z, made, cells, place, bound * dual.bound_companion)
    # with the energy norm, that of the functional is the dual solution's, its square −2 J(z)
    norm = np.sqrt(max(-2.0 * dual.energy[0], 0.0))
    shifts = [
        (0.0, float(norm * bound)),
        *_corrected(made, cells, bound, dual),
        *_settled(made, cells, bound, dual, place, weight),
    ]
    loose = known.unsure + INTEGRAL_ROUNDING * known.scale
    return known, Interval(
        known.of_u,
        known.of_v + max(shift - reach for shift, reach in shifts) - loose,
        known.of_v + min(shift + reach for shift, reach in shifts) + loose,
    )


def _place(forms: Forms, domain: Domain, where: str | int | None) -> str | None:
    """Name a part or a material, None for all of Ω; refuse others, and where u is a datum."""
    place = None if where is None else named(domain.parts, where)
    materials = list(domain.materials.numbers)
    own = [c.part for c in forms.conditions if c.fixed is None] + materials
    if place in domain.parts and place in materials:
        raise InputError(f"{where!r} {BOTH}")
    if place is None or place in own:
        return place
    if place == DOMAIN:
        return None
    if place in domain.parts:
        raise InputError(
            f"{NO_MEAN}: {where!r} is a Dirichlet part, on which u, and its mean, is what is given"
        )
    there = meant(where, [*own, DOMAIN])
    raise InputError(f"{where!r} is no part of the boundary and no material; {there}")


def _insist_on_extent(cells: Cells, where: str | None) -> None:
    """Refuse places that are empty; collective."""
    domain = cells.domain
    if where is None:
        return
    if where in domain.parts:
        found: int = len(cells.sides[domain.parts[where]].cells)
    else:
        found = int(np.sum(domain.materials.where(where)[: cells.number]))
    if not cells.comm.allreduce(found):
        raise InputError(f"{NO_MEAN}: {where!r} has no extent")


def _dual(forms: Forms, where: str | None, weight: Data, held: Sequence[Condition] = ()) -> Problem:
    """Make the linear problem with solution z, a(z, e) = ∫ ψ e for all e that vanish on Γ0.

    On Γ1 e is free, and so is z, but for the parts that are held.
    """
    conditions: dict[str, Condition] = {}
    for each in forms.conditions:
        if each.fixed is not None or each in held:
            conditions[each.part] = Dirichlet(0.0)
        else:
            g, b = weight if each.part == where else 0.0, 0.0 if each.loss is None else each.loss
            conditions[each.part] = Robin(g, coefficient=b)
    if where is None:
        return forms.called.linear(weight, conditions)
    return forms.called.linear(0.0, conditions, {} if where in conditions else {where: weight})


def _paired(z: Dual, made: Made, cells: Cells, where: str | None, width: float) -> Pairing:
    """Enclose ψ, and integrate it against v; collective.

    Args:
        z: Whose load is ψ.
        made: v.
        cells: The mesh.
        where: The place.
        width: Of the interval, to which what is missed should be small.
    """
    data, domain, low = diffusion(z.level.data), cells.domain, made.kappa
    largest = max(cells.comm.allgather(float(np.abs(made.vertices).max(initial=1e-300))))
    weakest = min(cells.comm.allgather(float(np.min(low, initial=np.inf))))
    size = width / (largest * np.sqrt(weakest))
    if where in domain.parts:
        (edge,) = (
            moments
            for condition, moments in zip(data.forms.natural, data.edges, strict=True)
            if condition.part == where
        )
        segments = Segments.of(edge, cells, low, size)
        _insist_on_weight(segments.reason)
        return on_side(made, cells, segments).over_ranks(cells)
    certain = Certain.of(data.compiled.f, data.of_f, cells, low, size)
    _insist_on_weight(certain.reason)
    there = np.ones(cells.number)
    if where is not None:
        there[:] = domain.materials.where(where)[: cells.number]
    return in_cells(made, cells, certain, there).over_ranks(cells)


def _insist_on_weight(reason: str | None) -> None:
    """Refuse a weight of which too little is known, or whatever else there is a reason for."""
    if reason is not None:
        load = reason.startswith(("f ", "g "))  # which ψ is of the dual problem
        raise InputError(f"{NO_MEAN}: {f'the weight{reason[1:]}' if load else reason}")


def _simple(made: Made, cells: Cells) -> bool:
    """Tell whether the products of v and y with functions of P1 are known."""
    return cells.tdim == 2 and made.beyond is None


def _corrected(
    made: Made, cells: Cells, bound: float, dual: Certificate
) -> list[tuple[float, float]]:
    """Estimate ∫ e over the place, and how far it may be from that, e = u − v − ℓ; or nothing.

    It is a(z₀, e) + a(φ, e) + a(z − z₀ − φ, e) with z₀ and φ in P1. z₀ vanishes on Γ1: a(z₀, u) is
    known. φ takes z's companion's values on Γ1, and there is the ball that A e is in.
    """
    of_z = in_p1(dual, cells)
    if of_z is None or not _simple(made, cells):
        return []
    assert dual.bound_companion is not None
    domain, forms = cells.domain, made.data.forms
    V = function_space(domain.mesh, "P1")
    z = fem.Function(V)
    dofs = V.dofmap.list[: cells.number]
    z.x.array[dofs] = of_z.vertices[cells.vertices].T
    z.x.scatter_forward()
    facets = facets_of(domain, [*forms.fixed, *forms.bounded])
    phi = extended(z, Layout.of_space(V).nodes_at(facets), made, cells)
    with_phi = np.ascontiguousarray(phi.x.array[dofs].T)
    inside = np.ascontiguousarray(z.x.array[dofs].T) - with_phi
    work, missed, _ = against(made, cells, inside)
    other, more, _ = against(made, cells, with_phi)
    work, other, missed, size, of_phi = cells.total(
        work,
        other,
        missed + 0.5 * more,
        square(made, cells, inside),
        square(made, cells, with_phi),
    )
    reach = made.loose_and_lift * np.sqrt(size) + made.reach * np.sqrt(of_phi) + missed
    return [(float(-work - 0.5 * other), float(reach + dual.bound_companion * bound))]


def _settled(
    made: Made,
    cells: Cells,
    bound: float,
    dual: Certificate,
    where: str | None,
    weight: Data | None,
) -> list[tuple[float, float]]:
    """Estimate ∫ e to second order if contact is everywhere or nowhere on each part; or nothing.

    Where there is none, λ is next to nothing, and φ may be whatever z is. Where there is, e is, and
    z is solved for once more, so that it vanishes there.
    """
    if not _simple(made, cells):
        return []
    settled = Settled.of(made, cells)
    if settled.mixed or not (settled.held or settled.free):
        return []
    through, off = np.zeros((2, len(cells.exterior)))
    pinned = [each for each in settled.held if each.part == where]
    if pinned:
        if weight is not None:
            return []
        side = cells.sides[pinned[0].number]
        through[side.dofs] = measures(cells, side)
        reach = settled.unknown(made, cells, through, off)
        return [(0.0, reach)] if np.isfinite(reach) else []
    if settled.held:
        forms = made.data.forms
        psi = 1.0 if weight is None else scalar(weight, forms, made.level.domain)
        dual = certified(_dual(forms, where, psi, settled.held), made.level)
    of_z = in_p1(dual, cells)
    if of_z is None:
        return []
    assert dual.bound_companion is not None
    at, flows = of_z.vertices[cells.vertices], of_z.through(cells)
    for each in (*settled.held, *settled.free):
        side = cells.sides[each.number]
        through[side.dofs] = np.abs(flows[side.local, side.cells])
        off[side.dofs] = np.abs(trace_of(cells, side, at)).max(axis=0)
    work, missed, _ = against(made, cells, at)
    work, missed, size = cells.total(work, missed, square(made, cells, at))
    reach = made.loose_and_lift * np.sqrt(size) + missed + bound * dual.bound_companion
    if settled.held:
        reach += bound * left_by(of_z, made)
    reach += settled.unknown(made, cells, through, off)
    return [(float(-work), float(reach))] if np.isfinite(reach) else []
