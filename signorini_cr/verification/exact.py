"""Test problems: those with a known solution, and two whose solution nobody knows.

On all of them Γ1 lies on y = 0 (on x = −1 for L), the obstacle is 0 unless said otherwise, and
r, θ are polar coordinates at the origin, θ = 0 to the right. λ = ∂ₙu on Γ1 is the contact
pressure; where it changes to zero lies a critical point.

    from signorini_cr import exact, solve

    solution = solve(exact.S1.problem, exact.S1.mesh(0.1))
    print(solution.errors)
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import ufl
from mpi4py import MPI
from ufl.core.expr import Expr

from ..arrays import FloatArray
from ..fem.conditions import Condition, Contact, Data, Dirichlet, Neumann, Robin
from ..fem.problem import Material, Problem, as_expression
from ..mesh import families
from ..mesh.domain import Domain, Polygon

Function = Callable[[Expr], Any]
"""A function of one coordinate, or of x = ufl.SpatialCoordinate."""


def _polygon(vertices: list[tuple[float, float]], *boundary: str) -> Polygon:
    return Polygon(np.array(vertices, dtype=np.float64), boundary)


RECTANGLE = _polygon(
    [(-1, 0), (1, 0), (1, 1), (-1, 1)], "contact", "dirichlet", "dirichlet", "dirichlet"
)
"""(−1, 1) × (0, 1) with Γ1 = {y = 0} and Γ0 the rest."""


@dataclass(frozen=True, eq=False)
class Example:
    """A problem with what is known about its solution.

    Attributes:
        name: What it is called.
        problem: The data, and u where it is known.
        polygon: Ω and its boundary parts.
        pressure: λ = ∂ₙu as a function of x, positive where there is contact; None if unknown.
        energy: J(u), to the digits given; None if unknown.
        critical: The critical points on Γ1, shape (m, 2), where they are known and finitely many.
        rates: Orders in h to expect of the errors in the broken norm (1.6) and in L2.
    """

    name: str
    problem: Problem
    polygon: Polygon
    pressure: Data | None = None
    energy: float | None = None
    critical: tuple[tuple[float, float], ...] | None = None
    rates: tuple[float, float] = (1.0, 2.0)

    def __repr__(self) -> str:
        """A line."""
        return f"<Example: {self.name}, {self.problem!r}>"

    def mesh(self, size: float, comm: MPI.Comm = MPI.COMM_WORLD) -> Domain:
        """Make an unstructured mesh with facets of about the length ``size``; collective."""
        return self.polygon.mesh(size, comm)

    def structured(
        self,
        n: int,
        comm: MPI.Comm = MPI.COMM_WORLD,
        *,
        shift: float = 0.0,
        jitter: float = 0.0,
        seed: int = 0,
    ) -> Domain:
        """Make a mesh of squares of side 1/n cut in two, see `families.structured`; collective."""
        return families.structured(self.polygon, n, comm, shift=shift, jitter=jitter, seed=seed)


def radius(x: Expr) -> Expr:
    """Return the distance r from the origin."""
    return ufl.sqrt(x[0] ** 2 + x[1] ** 2)


def angle(x: Expr) -> Expr:
    """Return θ, smooth across all of the axis y = 0 but the origin: it jumps on x = 0 below it.

    On Γ1 rounding may leave y a little below 0, where atan2(y, x) would jump to −π.
    """
    return np.pi / 2 - ufl.atan2(x[0], x[1])


def positive(t: Expr) -> Expr:
    """Return the positive part of t."""
    return ufl.max_value(t, 0.0)


def from_pair(
    a: Function,
    b: Function,
    factor: Function = lambda x: 1.0,
    *,
    name: str = "pair",
    polygon: Polygon = RECTANGLE,
    critical: tuple[tuple[float, float], ...] | None = None,
    **more: Any,
) -> Example:
    """Make an example from two functions of the first coordinate that are never both positive.

    With a, b ≥ 0, a b = 0, φ > 0 and ∂_yφ = 0 on Γ1 ⊂ {y = 0},

        u = (a(x) − y b(x)) φ(x, y)  has  u = aφ ≥ 0,  λ = −∂_yu = bφ ≥ 0  and  uλ = 0  on Γ1;

    f, g and u_D follow by differentiation. a and b must be smooth enough for −Δu to be a function:
    once continuously differentiable at least.

    Args:
        a: Takes the first coordinate; the gap.
        b: Takes the first coordinate; the pressure.
        factor: φ; takes x = (x, y).
        name: What to call the example.
        polygon: Ω, above Γ1.
        critical: The critical points, if they are to be known.
        **more: Handed over to `Problem`.
    """

    def solution(x: Expr) -> Expr:
        return (a(x[0]) - x[1] * b(x[0])) * factor(x)

    def pressure(x: Expr) -> Expr:
        return b(x[0]) * factor(x)

    return Example(name, Problem(exact=solution, **more), polygon, pressure, critical=critical)


def root(s: float, name: str = "") -> Example:
    """Make the harmonic u = r^s cos(sθ), s = 3/2, 7/2, 11/2, …: contact, λ = s|x|^{s−1} on x < 0.

    At θ = π cos(sπ) = 0 and sin((s − 1)π) = 1: u vanishes there and the pressure is positive. At
    s = 5/2, 9/2, … it would be negative.

    Raises:
        ValueError: s is another number.
    """
    if s <= 0 or (s - 1.5) % 2 != 0:
        raise ValueError(f"s is {s}; it must be 3/2, 7/2, 11/2, …")
    # J(u) = ½ s² ∫ r^{2s−2} over the rectangle, by integration along rays
    t, weights = np.polynomial.legendre.leggauss(40)
    secant = 1.0 / np.cos(np.pi / 8 * (t + 1.0))
    energy = s * np.pi / 8 * (weights @ secant ** (2 * s))
    return Example(
        name or f"r^{s:g}",
        Problem(f=0.0, exact=lambda x: radius(x) ** s * ufl.cos(s * angle(x))),
        RECTANGLE,
        pressure=lambda x: s * positive(-x[0]) ** (s - 1),
        energy=float(energy),
        critical=((0.0, 0.0),),
    )


EDGES = ("floor", "right", "top", "left")
"""Those of the unit square, as `made` calls them."""

MARGIN = 0.3
"""Least distance from 0 of the switch of `made` where u touches one of two obstacles."""


def made(
    u: Function,
    kinds: Mapping[str, str],
    *,
    switch: Function = lambda x: 1.0 - 2.0 * x[0],
    coefficient: Data = 1.0,
    reaction: float = 0.0,
    loss: float = 0.0,
    external: float = 0.0,
    line: float | None = None,
    east: Material | None = None,
    name: str = "made",
) -> Example:
    """Make an example on the unit square from a function and what is to hold on its edges.

    f, u_D, g and obstacles follow from u. A contact part is touched from below where the switch s
    is above 0, from above where it is below 0, or both with a `MARGIN` m between: there

        λ = (s − m)⁺ − (−s − m)⁺,  α = u − (m − s)⁺,  β = u + (m + s)⁺

    with m = 0 where one of the obstacles is missing; g = κ∂ₙu + b (u − u_ext) − λ makes up for any
    u. There is no Γ0 unless a kind is dirichlet.

    Args:
        u: Takes x = (x, y); smooth, or `kinked` on the line.
        kinds: For edges of `EDGES` "below", "above" or "between", for contact; or "robin",
            "neumann", "dirichlet".
        switch: s.
        coefficient: κ, a scalar or a tensor.
        reaction: c.
        loss: b of Robin and contact parts.
        external: u_ext there.
        line: Where x is above it, the domain is of a material.
        east: Its data, coefficient and reaction, if there is such a line.
        name: What to call the example.
    """

    def pressure(x: Expr, kind: str) -> tuple[Expr, Expr, Expr]:
        """Return λ, and how far α and β are from u."""
        s, m = switch(x), MARGIN if kind == "between" else 0.0
        low = positive(s - m) if kind != "above" else ufl.as_ufl(0.0)
        high = positive(-s - m) if kind != "below" else ufl.as_ufl(0.0)
        return low - high, positive(m - s), positive(m + s)

    def flux(x: Expr) -> Expr:
        """Return κ∂ₙu + b (u − u_ext)."""
        kappa = as_expression(coefficient, x)
        if line is not None and east is not None and east.coefficient is not None:
            own = as_expression(east.coefficient, x)
            kappa = ufl.conditional(ufl.lt(x[0], line), kappa, own)
        normal = ufl.FacetNormal(ufl.domain.extract_unique_domain(x))
        return ufl.dot(kappa * ufl.grad(u(x)), normal) + loss * (u(x) - external)

    def contact(kind: str) -> Contact:
        return Contact(
            None if kind == "above" else lambda x: u(x) - pressure(x, kind)[1],
            upper=None if kind == "below" else lambda x: u(x) + pressure(x, kind)[2],
            coefficient=loss,
            external=external,
            g=lambda x: flux(x) - pressure(x, kind)[0],
        )

    plain: dict[str, Condition] = {
        "dirichlet": Dirichlet(),
        "neumann": Neumann(),
        "robin": Robin(coefficient=loss, external=external),
    }
    on_contact = [kind for kind in kinds.values() if kind not in plain]
    polygon = Polygon(
        np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]]),
        EDGES,
        names=EDGES,
        materials={} if line is None else {"east": _right_of(line)},
    )
    problem = Problem(
        exact=u,
        coefficient=coefficient,
        reaction=reaction,
        conditions={edge: plain.get(kind) or contact(kind) for edge, kind in kinds.items()},
        materials={} if line is None else {"east": east or Material()},
    )
    of_all = len(set(on_contact)) == 1
    return Example(
        name, problem, polygon, (lambda x: pressure(x, on_contact[0])[0]) if of_all else None
    )


def _right_of(line: float) -> FloatArray:
    return np.array([[line, 0.0], [1.0, 0.0], [1.0, 1.0], [line, 1.0]])


def kinked(v: Function, line: float, west: float, east: float) -> Function:
    """Bend a smooth v on a line x = a: u = v(a, y) + (v − v(a, y))/κ, κ∂ₓu = ∂ₓv on both sides.

    Args:
        v: Takes x = (x, y).
        line: a.
        west: κ where x is below a.
        east: κ where it is above.
    """

    def function(x: Expr) -> Expr:
        kappa = ufl.conditional(ufl.lt(x[0], line), west, east)
        there = v(ufl.as_vector([line, x[1]]))
        return there + (v(x) - there) / kappa

    return function


def raised(example: Example, alpha: Function) -> Example:
    """Make the same contact on the obstacle α: u + α, with α given such that ∂ₙα = 0 on Γ1.

    Raises:
        ValueError: The example's solution is not known.
    """
    problem, exact = example.problem, example.problem.exact
    if exact is None:
        raise ValueError(f"the solution of {example.name} is not known")

    def solution(x: Expr) -> Expr:
        return as_expression(exact, x) + alpha(x)

    return replace(
        example,
        name=f"{example.name} raised",
        problem=replace(problem, exact=solution, obstacle=alpha, f=None, g=None, dirichlet=None),
        energy=None,
    )


def _w(x: Expr) -> Expr:
    return radius(x) ** 1.5 * ufl.cos(1.5 * angle(x))


def _s1_load(x: Expr) -> Expr:
    """Return −Δ of S1's u, without the second derivatives of w, whose sum is 0."""
    w_x = 1.5 * ufl.sqrt(radius(x)) * ufl.cos(0.5 * angle(x))
    w_y = -1.5 * ufl.sqrt(radius(x)) * ufl.sin(0.5 * angle(x))
    return (
        2 * (2 - x[0] ** 2 - x[1] ** 2) * _w(x)
        + 4 * x[0] * (1 - x[1] ** 2) * w_x
        + 4 * x[1] * (1 - x[0] ** 2) * w_y
    )


def _bubble(x: Expr) -> Expr:
    return (1 - x[0] ** 2) * (1 - x[1] ** 2)


def _spikes(sign: float, order: int = 0) -> Function:
    """Return x⁶ max(0, ± sin(π/x))³ for x > 0, else 0; or its first or second derivative.

    The powers of x are collected, so that one sees that it is small where x is.
    """

    def function(t: Expr) -> Expr:
        far = ufl.gt(t, 1e-12)
        turn = np.pi / ufl.conditional(far, t, 1.0)
        p, q = positive(sign * ufl.sin(turn)), sign * ufl.cos(turn)
        if order == 0:
            found = t**6 * p**3
        elif order == 1:
            found = 6 * t**5 * p**3 - 3 * np.pi * t**4 * p**2 * q
        else:
            found = (
                (30 * t**4 - 3 * np.pi**2 * t**2) * p**3
                - 30 * np.pi * t**3 * p**2 * q
                + 6 * np.pi**2 * t**2 * p * q**2
            )
        return ufl.conditional(far, found, 0.0)

    return function


def _i_load(x: Expr) -> Expr:
    """Return −Δ of I's u = (a − y b) φ."""
    left = positive(-x[0])
    a, da, dda = (_spikes(1.0, order)(x[0]) for order in range(3))
    b, db, ddb = (_spikes(-1.0, order)(x[0]) for order in range(3))
    b, db, ddb = b + left**3, db - 3 * left**2, ddb + 6 * left
    v, dv, ddv = a - x[1] * b, da - x[1] * db, dda - x[1] * ddb
    across, along = 1 - x[0] ** 2, 1 - x[1] ** 2
    return (
        -ddv * across * along
        + 4 * x[0] * along * dv
        - 4 * x[1] * across * b
        + 2 * (across + along) * v
    )


S1 = Example(
    "S1",
    Problem(f=_s1_load, dirichlet=0.0, exact=lambda x: _bubble(x) * _w(x)),
    RECTANGLE,
    pressure=lambda x: 1.5 * (1 - x[0] ** 2) * ufl.sqrt(positive(-x[0])),
    energy=-0.48587761266,
    critical=((0.0, 0.0),),
)
"""u = (1 − x²)(1 − y²) r^{3/2} cos(3θ/2): the regularity to expect at a critical point."""

_on_a_slope = raised(S1, lambda x: 0.2 * x[0] - 0.1)
S1_RAISED = replace(_on_a_slope, name="S1 raised", problem=replace(_on_a_slope.problem, f=_s1_load))
"""S1 on the obstacle α = x/5 − 1/10, with u_D = α. f is the same: second derivatives of r^{3/2}
are not bounded one by one."""

S1_NEUMANN = replace(
    S1,
    name="S1 Neumann",
    problem=replace(S1.problem, g=lambda x: -2 * (1 - x[1] ** 2) * _w(x)),
    polygon=Polygon(RECTANGLE.vertices, ("contact", "neumann", "dirichlet", "dirichlet")),
)
"""S1 with Γg = {x = 1}."""

A = replace(
    from_pair(lambda t: positive(t) ** 3, lambda t: positive(-t) ** 3, name="A"),
    energy=201 / 70,
    critical=((0.0, 0.0),),
)
"""u = x³ for x > 0, −y|x|³ for x < 0: the pressure fades to high order, hard on active sets."""

B = root(1.5, "B")
"""u = r^{3/2} cos(3θ/2): data on Γ0 that are not 0."""

C = root(3.5, "C")
"""u = r^{7/2} cos(7θ/2): B, smoother."""

C2 = root(5.5, "C2")
"""u = r^{11/2} cos(11θ/2): smoother still."""

D = Example(
    "D",
    Problem(f=0.0, exact=lambda x: ufl.sqrt(radius(x)) * ufl.sin(0.5 * angle(x))),
    _polygon([(-1, 0), (0, 0), (1, 0), (1, 1), (-1, 1)], "contact", *["dirichlet"] * 4),
    pressure=lambda x: 0.0,
    energy=float(0.5 * np.arcsinh(1.0)),
    critical=(),
    rates=(0.5, 1.0),
)
"""u = √r sin(θ/2) ∉ H²: outside the theory. Γ0 and Γ1 meet at the origin; no contact."""

E = Example(
    "E",
    Problem(f=lambda x: 2 * np.pi * ufl.sin(2 * np.pi * x[0])),
    _polygon([(0, 0), (1, 0), (1, 1), (0, 1)], "contact", "neumann", "dirichlet", "neumann"),
    energy=-0.461754,
)
"""f = 2π sin 2πx on the unit square; u is not known."""

I = replace(  # noqa: E741
    from_pair(
        _spikes(1.0),
        lambda t: _spikes(-1.0)(t) + positive(-t) ** 3,
        _bubble,
        name="I",
        f=_i_load,
        dirichlet=0.0,
        quadrature_degree=14,
    ),
    energy=-0.0174724919068,
)
"""Critical points at x = 1, ½, ⅓, …: infinitely many, and u ∈ W^{2,∞}.

f oscillates ever faster towards x = 0; with a quadrature of degree 4 its error would hide the rate
in L2.
"""

L = Example(
    "L",
    Problem(f=1.0, obstacle=lambda x: 1.0 + 0.3 * ufl.sin(0.5 * np.pi * x[1])),
    _polygon(
        [(-1, -1), (0, -1), (0, 0), (1, 0), (1, 1), (-1, 1)],
        *["neumann", "dirichlet", "dirichlet", "neumann", "neumann", "contact"],
    ),
    energy=-0.78841,
    rates=(2 / 3, 4 / 3),
)
"""f = 1 on an L: u behaves like r^{2/3} at the corner (0, 0), whose two edges are Γ0.

Γ1 = {x = −1} with α = 1 + 0.3 sin(πy/2), and Γg the other edges. u is not known.
"""

ALL = {example.name: example for example in (S1, S1_RAISED, S1_NEUMANN, A, B, C, C2, D, E, I, L)}
"""All of them by name."""
