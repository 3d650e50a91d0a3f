"""Guaranteed bounds of means of u: over a part of the boundary, a material, or all of Ω."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from dolfinx import fem

from .arrays import FloatArray
from .data.diffusion import diffusion
from .dual import certified
from .errors import InputError
from .estimate.certificate import Certificate, Made
from .estimate.force import Interval, against, extended, square
from .fem.cells import Cells, measures, sum_rows
from .fem.conditions import Condition, Contact, Dirichlet, Robin, facets_of
from .fem.problem import Forms, Material, Problem
from .fem.space import function_space, shared_sum
from .mesh.domain import Domain
from .solution import Solution

NO_MEAN = "the mean has no bounds"
AFLOAT = "nothing but contact holds a part of the domain, and no energy tells how high it is"
ROUNDING = 1e-14
"""What rounding may do to a mean, in parts of the mean of |u|."""


def mean(solution: Solution, where: str | None = None) -> Interval:
    """Bound the mean of u; collective.

    It is that of the companion, corrected by what a linear problem with the mean for its load says
    of the difference, up to products of two errors and to what Γ1 leaves unknown. That takes
    up to twice as long as mesh and solve have taken.

    Args:
        solution: One with a certified bound.
        where: Name of a part of the boundary on which u is not set, or else of a material; None for
            all of the domain.

    Raises:
        InputError: There is no such place, or there is no bound; the message says why.
    """
    certificate, level = solution.certificate, solution.level
    forms = diffusion(level.data).forms
    _insist_on_place(forms, level.domain, where)
    made, bound = certificate._made, certificate.bound_companion
    if made is None or bound is None:
        raise InputError(f"{NO_MEAN}: {certificate.reason}")
    if made.on_contact_alone:
        raise InputError(f"{NO_MEAN}: {AFLOAT}")
    cells = made.cells()
    size, *integrals = map(float, cells.total(*_integrals(made, cells, solution.u.x.array, where)))
    if not size > 0.0:
        raise InputError(f"{NO_MEAN}: {where!r} has no extent")
    value, middle, lift, scale = (integral / size for integral in integrals)
    dual = certified(_dual(forms, where), level)
    if dual.energy is None:
        raise InputError(f"{NO_MEAN}: {dual.reason}")
    # with the energy norm, that of the functional is the dual solution's, its square −2 J(z)
    norm = np.sqrt(max(-2.0 * dual.energy[0], 0.0))
    known = [(0.0, float(norm * bound)), *_corrected(made, cells, bound, dual)]
    loose = lift + ROUNDING * scale
    return Interval(
        value,
        middle + max(shift - reach for shift, reach in known) / size - loose,
        middle + min(shift + reach for shift, reach in known) / size + loose,
    )


def _insist_on_place(forms: Forms, domain: Domain, where: str | None) -> None:
    """Refuse what has no name here, and parts where u is a datum."""
    loose = [c.part for c in forms.conditions if c.fixed is None]
    if where is None or where in loose:
        return
    if where in domain.parts:
        raise InputError(f"{NO_MEAN}: u is set on {where!r}, where its mean is that of a datum")
    if where not in domain.materials.numbers:
        there = ", ".join([*loose, *domain.materials.numbers])
        raise InputError(f"{where!r} is no part of the boundary and no material; there are {there}")


def _dual(forms: Forms, where: str | None) -> Problem:
    """The problem whose solution z has a(z, e) = ∫ e over the place, for all e that vanish on Γ0.

    On Γ1 e is free. As z ≥ 0 anyway, for f, g ≥ 0, an obstacle 0 there changes nothing, and what
    assembles and certifies is made for one.
    """
    problem = forms.problem
    conditions: dict[str, Condition] = {}
    for each in forms.conditions:
        g, b = float(each.part == where), 0.0 if each.loss is None else each.loss
        if each.fixed is not None:
            conditions[each.part] = Dirichlet(0.0)
        elif each.bounds:
            conditions[each.part] = Contact(0.0, coefficient=b, g=g)
        else:
            conditions[each.part] = Robin(g, coefficient=b)
    materials = {name: replace(each, f=None) for name, each in problem.materials.items()}
    if where is not None and where not in conditions:
        materials[where] = replace(materials.get(where, Material()), f=1.0)
    return Problem(
        f=float(where is None),
        coefficient=problem.coefficient,
        reaction=problem.reaction,
        conditions=conditions,
        materials=materials,
        quadrature_degree=problem.quadrature_degree,
    )


def _corrected(
    made: Made, cells: Cells, bound: float, dual: Certificate
) -> list[tuple[float, float]]:
    """∫ e over the place, and how far it may be from that, for e = u − v − ℓ; or nothing.

    It is a(z₀, e) + a(φ, e) + a(z − z₀ − φ, e) with z₀ and φ in P1. z₀ vanishes on Γ1: a(z₀, u) is
    known. φ takes z's companion's values on Γ1, and there is the ball that A e is in.
    """
    of_z = dual._made
    assert of_z is not None and dual.bound_companion is not None
    bent = cells.total(float(np.abs(of_z.bumps).sum()))[0] > 0.0 or of_z.thirds is not None
    if cells.tdim != 2 or made.varies or made.beyond is not None or bent:
        return []
    domain, forms = cells.domain, diffusion(made.level.data).forms
    V = function_space(domain.mesh, "P1")
    z, marks = fem.Function(V), fem.Function(V)
    dofs = V.dofmap.list[: cells.number]
    z.x.array[dofs] = of_z.vertices[cells.vertices].T
    z.x.scatter_forward()
    facets = facets_of(domain, [*forms.fixed, *forms.bounded])
    marks.x.array[fem.locate_dofs_topological(V, cells.tdim - 1, facets)] = 1.0
    seen = shared_sum(cells.comm, V.dofmap.index_map, marks.x.array)
    phi = extended(z, np.flatnonzero(seen > 0).astype(np.int32), made)
    with_phi = np.ascontiguousarray(phi.x.array[dofs].T)
    inside = np.ascontiguousarray(z.x.array[dofs].T) - with_phi
    work, other, size, of_phi = cells.total(
        against(made, cells, inside)[0],
        against(made, cells, with_phi)[0],
        square(made, cells, inside),
        square(made, cells, with_phi),
    )
    reach = made.loose * np.sqrt(size) + made.reach * np.sqrt(of_phi)
    return [(float(-work - 0.5 * other), float(reach + dual.bound_companion * bound))]


def _integrals(made: Made, cells: Cells, u: FloatArray, where: str | None) -> tuple[float, ...]:
    """This rank's shares of the extent, and of the integrals of u_h, v, a bound of |ℓ|, and |v|.

    Bumps have the means ⅓ on cells and ⅔ on facets, cubics 0; cusps vanish on the boundary, and ℓ
    on facets of other parts than Γ0 and Γ1.
    """
    d, domain, (lifted, _, areas, edges) = cells.tdim, cells.domain, made.lift
    bumps = made.bumps if d == 2 else np.zeros(len(u))
    part = None if where is None else domain.parts.get(where)
    if part is not None:
        side = cells.sides[part]
        extent = measures(cells, side)
        at_ends = made.vertices[side.ends]
        v = at_ends.mean(axis=0) + 2 / 3 * bumps[side.dofs]
        scale = np.abs(at_ends).max(axis=0, initial=0.0) + np.abs(bumps[side.dofs])
        own = np.zeros(len(u))
        np.add.at(own, made.bounded, edges)
        lift = np.sqrt(extent) @ own[side.dofs]
        of_u = u[side.dofs]
    else:
        there = np.ones(cells.number) if where is None else domain.materials.where(where)
        extent = cells.volume * there[: cells.number]
        at_ends, height = made.vertices[cells.vertices], bumps[cells.facets]
        v = at_ends.mean(axis=0) + sum_rows(height) / 3
        if made.cusps is not None:
            v[made.cusps.at] += made.cusps.means
        scale = np.abs(at_ends).max(axis=0) + np.abs(height).max(axis=0)
        lift = np.sqrt(extent[lifted]) @ areas
        of_u = u[cells.facets].mean(axis=0)
    return (
        float(extent.sum()),
        float(extent @ of_u),
        float(extent @ v),
        float(lift),
        float(extent @ scale),
    )
