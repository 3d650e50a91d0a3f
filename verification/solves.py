"""Contact forces of discrete problems: stiff data, random ones, thin cells."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from formulas import Formula, numeric, symbolic
from judgement import EXACT, NEAR, NOTHING, Judge, Verdict, finest
from mpi4py import MPI
from reference import Data
from report import Group, Row, told

from signorini_cr import Domain, Polygon, Problem

COMM = MPI.COMM_WORLD

OWN = (
    "the same discrete problem, assembled and solved by other code: direct solver, active set "
    "method, residuals in extended precision; refinement changes its forces by less than 1e-9"
)
CERTAIN = 1e8
"""Contrast up to which the program may not refuse."""


@dataclass(frozen=True, eq=False)
class Case:
    """A discrete problem.

    Attributes:
        name: To find it again.
        mesh: Makes the coarsest mesh.
        levels: Meshes, the coarsest included.
        formulas: f, g, α, u_D and κ.
        parameters: Theirs.
        contrast: Largest κ over the smallest.
        degree: Of the quadrature.
        bare: Whether it is judged so, see `Judge`.
    """

    name: str
    mesh: Callable[[], Domain]
    levels: int
    formulas: dict[str, Formula]
    parameters: tuple[float, ...]
    contrast: float = 1.0
    degree: int = 4
    bare: bool = False

    def run(self, ways: Sequence[bool] = (True, False)) -> list[Verdict]:
        """Solve nested, cold, or both, and judge; collective."""
        domain = self.mesh()
        given: dict[str, Any] = {
            key: symbolic(formula, domain.mesh, self.parameters)
            for key, formula in self.formulas.items()
        }
        problem = Problem(**given, quadrature_degree=self.degree)
        values = {key: numeric(formula, self.parameters) for key, formula in self.formulas.items()}
        judge = Judge(Data(**values, degree=self.degree), self.bare)
        out = []
        for nested in ways:
            solution, steps = finest(problem, domain, self.levels, nested)
            out.append(judge.verdict(solution, steps, COMM))
        return out


def squashed(domain: Domain, factor: float) -> Domain:
    """The same mesh made thin."""
    domain.mesh.geometry.x[:, 1] *= factor
    return domain


def tell(case: Case, way: str, verdict: Verdict) -> str:
    """Say what went wrong, in a line."""
    words = f"{case.name}, {way}: "
    if verdict.fault:
        return words + verdict.fault
    if verdict.refused:
        return words + "refused"
    return words + (
        f"forces wrong by {verdict.error:.0e}, their sum by {verdict.total:.0e}, "
        f"{verdict.facets} facets in the wrong state, "
        f"transition points off by {verdict.transitions:.0e} of a facet"
    )


POINTS = f"points where contact begins or ends to {NEAR:.0e} of a facet"
WAYS = {True: "nested", False: "cold"}


def row_of(
    name: str,
    cases: Sequence[Case],
    may_refuse: Callable[[Case], bool],
    more: Callable[[Case, Verdict], str | None] = lambda *_: None,
    least_proper: int = 0,
) -> Row:
    """Run cases and count.

    Args:
        name: What they have in common.
        cases: To be run.
        may_refuse: Whether the program may say that it did not converge.
        more: What else there is to complain about, if anything.
        least_proper: So many must have contact on a part of Γ1, not on all and not on none.
    """
    refused, proper, degenerate, number, steps = 0, 0, 0, 0, 0
    error, apart, failures = 0.0, 0.0, []
    for case in cases:
        verdicts = case.run()
        proper += any(verdict.proper for verdict in verdicts)
        for way, verdict in zip(WAYS.values(), verdicts, strict=True):
            number += 1
            refused += verdict.refused
            degenerate += verdict.degenerate
            if not (verdict.refused or verdict.fault):
                error = max(error, verdict.error, verdict.total)
                apart = max(apart, verdict.transitions)
            steps = max(steps, *verdict.steps, 0)
            complaint = more(case, verdict)
            if not verdict.right and not (verdict.refused and may_refuse(case)):
                failures.append(tell(case, way, verdict))
            if complaint is not None:
                failures.append(f"{case.name}, {way}: {complaint}")
    if proper < least_proper:
        failures.append(f"contact on a proper part of Γ1 in {proper} problems only")
    worst = f"error of the forces {error:.0e}, of transition points {apart:.0e} of a facet"
    worst += f"; {refused} refused"
    worst += f"; at most {steps} CG steps"
    worst += f"; contact on a proper part of Γ1 in {proper} of {len(cases)} problems"
    if degenerate:
        worst += f"; {degenerate} facets on the fence left out"
    return told(Row(name, number, worst, OWN, failures))


# ---- stiff data


def _zero(m: Any, x: Any, y: Any, p: Sequence[Any]) -> Any:
    return 0.0 * x


def _weight(m: Any, x: Any, y: Any, p: Sequence[Any]) -> Any:
    return -3.0 + 0.0 * x


def _waves(m: Any, x: Any, y: Any, p: Sequence[Any]) -> Any:
    return -0.3 + 0.1 * m.cos(9.0 * x)


def _slope(m: Any, x: Any, y: Any, p: Sequence[Any]) -> Any:
    return x / 5


def _aslant(m: Any, x: Any, y: Any, p: Sequence[Any]) -> Any:
    return m.where(m.above(0.05 - 0.13 * y, x), p[0], 1.0)


def _lumps(m: Any, x: Any, y: Any, p: Sequence[Any]) -> Any:
    """Two discs, one on the boundary above."""
    first = (x + 0.45) ** 2 + (y - 0.95) ** 2
    second = (x - 0.5) ** 2 + (y - 0.55) ** 2
    return m.where(m.above(0.09, m.smaller(first, second)), p[0], 1.0)


def _layers(m: Any, x: Any, y: Any, p: Sequence[Any]) -> Any:
    """A stiff plate between soft layers, tied to the sides."""
    return m.where(m.above(0.06, abs(y - 0.55 - 0.1 * x)), p[0], 1.0)


def _board(m: Any, x: Any, y: Any, p: Sequence[Any]) -> Any:
    """Stiff and soft fields in turn, and soft along most of Γ1."""
    wave = m.sin(4.1 * x + 0.3) * m.sin(4.7 * y + 0.9)
    soft = m.above(m.where(m.above(x, -0.4), 0.35, 0.02), y)
    return m.where(soft, 1.0, m.where(m.above(wave, 0.0), p[0], 1.0))


RECTANGLE = ([[-1, 0], [1, 0], [1, 1], [-1, 1]], ["contact", "neumann", "dirichlet", "neumann"])
HELD = ([[-1, 0], [1, 0], [1, 1], [-1, 1]], ["contact", "dirichlet", "dirichlet", "dirichlet"])
CROOKED = (
    [[-1, 0], [0.2, -0.15], [1, 0.1], [1.2, 0.9], [0, 1.2], [-0.9, 0.8]],
    ["contact", "contact", "neumann", "dirichlet", "dirichlet", "neumann"],
)
ANGLE = (
    [[-1, 0], [1, 0], [1, 0.5], [0.1, 0.5], [0.1, 1], [-1, 1]],
    ["contact", "neumann", "dirichlet", "neumann", "dirichlet", "neumann"],
)


def _stiff(name: str, polygon: Any, kappa: Formula, contrast: float, levels: int = 4) -> Case:
    vertices, boundary = polygon
    return Case(
        f"{name}, C = {contrast:.0e}",
        lambda: Polygon(vertices, boundary).mesh(0.25, COMM),
        levels,
        {
            "f": _weight,
            "g": _zero,
            "obstacle": _waves,
            "dirichlet": _slope,
            "coefficient": kappa,
        },
        (contrast,),
        contrast,
    )


STIFF = {
    "rectangle, κ = C left of a slant line": (RECTANGLE, _aslant),
    "rectangle held on three sides, C in two discs": (HELD, _lumps),
    "crooked hexagon, C in a plate": (CROOKED, _layers),
    "L-shape, C in every other field": (ANGLE, _board),
}


def _bottom(m: Any, x: Any, y: Any, p: Sequence[Any]) -> Any:
    """A stiff block that rests on Γ1."""
    return m.where(m.above(0.3, y), p[0], 1.0)


def _high_waves(m: Any, x: Any, y: Any, p: Sequence[Any]) -> Any:
    return p[1] - 0.3 + 0.1 * m.cos(9.0 * x)


def _high_slope(m: Any, x: Any, y: Any, p: Sequence[Any]) -> Any:
    return p[1] + x / 5


def _block(contrast: float, height: float, levels: int) -> Case:
    vertices, boundary = RECTANGLE
    return Case(
        f"C = {contrast:.0e}, u = {height:g}",
        lambda: Polygon(vertices, boundary).mesh(0.25, COMM),
        levels,
        {
            "f": _weight,
            "g": _zero,
            "obstacle": _high_waves,
            "dirichlet": _high_slope,
            "coefficient": _bottom,
        },
        (contrast, height),
        contrast,
        bare=True,
    )


def _pull(m: Any, x: Any, y: Any, p: Sequence[Any]) -> Any:
    return -p[1] + 0.0 * x


def _near(m: Any, x: Any, y: Any, p: Sequence[Any]) -> Any:
    return p[0] - 0.1 * p[1] + 0.05 * p[1] * m.cos(9.0 * x)


def _level(m: Any, x: Any, y: Any, p: Sequence[Any]) -> Any:
    return p[0] + 0.0 * x


def _one(m: Any, x: Any, y: Any, p: Sequence[Any]) -> Any:
    return 1.0 + 0.0 * x


def _weak(height: float, force: float, levels: int) -> Case:
    square = [[0, 0], [1, 0], [1, 1], [0, 1]]
    return Case(
        f"u = {height:g}, f = {-force:g}",
        lambda: Polygon(square, RECTANGLE[1]).mesh(0.3, COMM),
        levels,
        {
            "f": _pull,
            "g": _zero,
            "obstacle": _near,
            "dirichlet": _level,
            "coefficient": _one,
        },
        (height, force),
        bare=True,
    )


def offset(seed: int, quick: bool) -> Group:
    """Forces that are small beside what rounding leaves of them."""
    levels, heights = 3, (100.0,) if quick else (0.0, 100.0)
    exponents = (4, 12) if quick else range(2, 14)
    forces = (1e-2, 1e-8) if quick else [10.0**-k for k in range(1, 13)]
    rows = []
    for height in heights:
        for title, chosen in (
            ("C ≤ 1e7", [e for e in exponents if e <= 7]),
            ("C > 1e7", [e for e in exponents if e > 7]),
        ):
            cases = [_block(10.0**e, height, levels) for e in chosen]
            name = f"stiff block (C : 1) that rests on Γ1 at u = {height:g}, {title}"
            rows.append(row_of(name, cases, lambda case: case.contrast > 1e7))
    for height in (1e5,) if quick else (293.15, 1e5):
        for title, chosen in (
            ("f ≥ 1e-8 u", [f for f in forces if f >= 1e-8 * height]),
            ("f < 1e-8 u", [f for f in forces if f < 1e-8 * height]),
        ):
            cases = [_weak(height, force, levels) for force in chosen]
            may = title.startswith("f <")
            name = f"forces of the order of f beside u = {height:g}, {title}"
            rows.append(row_of(name, cases, lambda case, may=may: may))
    return Group(
        "offset",
        "Forces that rounding may hide",
        "A stiff block on Γ1, held by a soft part above, α = u − 0.3 + 0.1 cos 9x, u_D = u + x/5, "
        "f = −3; and κ = 1, α = u − f/10 + f/20 cos 9x, u_D = u. "
        f"{levels} meshes, nested and cold. Passed: the same facets in contact, forces right to "
        f"{EXACT:.0e} of their sum, however small that is, and {POINTS}; where so noted, or "
        "refused.",
        rows,
    )


def stiff(seed: int, quick: bool) -> Group:
    """κ that jumps by many orders of magnitude, u_D that varies along the stiff part."""
    rows = []
    exponents = (4, 12) if quick else (2, 4, 6, 7, 8, 9, 10, 11, 12)
    patterns = list(STIFF.items())[:2] if quick else list(STIFF.items())
    levels = 2 if quick else 4
    for name, (polygon, kappa) in patterns:
        for title, chosen in (
            ("C ≤ 1e8", [e for e in exponents if e <= 8]),
            ("C > 1e8", [e for e in exponents if e > 8]),
        ):
            cases = [_stiff(name, polygon, kappa, 10.0**e, levels) for e in chosen]
            rows.append(row_of(f"{name}, {title}", cases, lambda case: case.contrast > CERTAIN))
    return Group(
        "forces",
        "Contact forces where the coefficient jumps",
        f"f = −3, α = −0.3 + 0.1 cos 9x, u_D = x/5, κ = C on a part and 1 elsewhere, {levels} "
        "meshes, each case from nested and from cold starts. Passed: the force on every facet and "
        f"their sum right to {EXACT:.0e} (relative, the sum of all facets' errors), the same "
        f"facets in contact, and {POINTS}; for C above 1e8 that or refused.",
        rows,
    )


# ---- random problems


def _any_load(m: Any, x: Any, y: Any, p: Sequence[Any]) -> Any:
    return p[0] * (1.0 + p[1] * m.sin(3.0 * x + p[2]))


def _any_flux(m: Any, x: Any, y: Any, p: Sequence[Any]) -> Any:
    return p[3] * m.cos(2.0 * x + p[2])


def _any_obstacle(m: Any, x: Any, y: Any, p: Sequence[Any]) -> Any:
    return p[4] + p[5] * m.cos(p[6] * x + p[7])


def _any_value(m: Any, x: Any, y: Any, p: Sequence[Any]) -> Any:
    return p[8] * x + p[9] * y


def _half(m: Any, x: Any, y: Any, p: Sequence[Any]) -> Any:
    return m.where(m.above(p[11] * x + p[12] * y, p[13]), p[10], 1.0)


def _disc(m: Any, x: Any, y: Any, p: Sequence[Any]) -> Any:
    return m.where(
        m.above(0.12, (x - p[13]) ** 2 + p[14] * (y - p[15]) ** 2),
        p[10],
        1.0,
    )


def _strip(m: Any, x: Any, y: Any, p: Sequence[Any]) -> Any:
    return m.where(m.above(0.15, abs(p[11] * x + p[12] * y - p[13])), p[10], 1.0)


def _fields(m: Any, x: Any, y: Any, p: Sequence[Any]) -> Any:
    wave = m.sin(4.0 * x + p[7]) * m.sin(p[16] * y + p[2])
    return m.where(m.above(wave, 0.0), p[10], 1.0)


KAPPAS: tuple[Formula, ...] = (_half, _disc, _strip, _fields)


def _any_case(seed: int, number: int, thin: bool, levels: int) -> Case:
    """A random polygon above one or two contact edges, random data."""
    rng = np.random.default_rng((seed, number))
    corners = int(rng.integers(3, 6))
    angles = np.sort(rng.uniform(0.2, np.pi - 0.2, corners))
    while np.diff(angles).min() < 0.2:
        angles = np.sort(rng.uniform(0.2, np.pi - 0.2, corners))
    radii = rng.uniform(0.7, 1.3, corners)
    top = np.column_stack([radii * np.cos(angles), radii * np.sin(angles)])
    bottom = [[-1.0, 0.0], [1.0, 0.0]]
    boundary = ["contact"]
    if rng.random() < 0.4:
        bottom.insert(1, [rng.uniform(-0.4, 0.4), rng.uniform(-0.3, -0.05)])
        boundary.append("contact")
    vertices = np.concatenate([bottom, top])
    sides = rng.choice(["dirichlet", "neumann"], corners + 1, p=[0.6, 0.4])
    sides[rng.integers(0, corners + 1)] = "dirichlet"
    aspect = 10.0 ** rng.uniform(1, 3) if thin else 1.0
    size = float(rng.uniform(0.22, 0.4))
    contrast = float(10.0 ** rng.uniform(0, 10)) if rng.random() < 0.85 else 1.0
    inside = contrast if rng.random() < 0.7 else 1.0 / contrast
    angle = rng.uniform(0, 2 * np.pi)
    slope = rng.uniform(-0.3, 0.3)
    parameters = [
        -rng.uniform(0.5, 4),
        rng.uniform(-0.5, 0.5),
        rng.uniform(0, 6),
        rng.uniform(-0.3, 0.3),
        rng.uniform(-0.35, 0.0),
        rng.uniform(0.1, 0.35),
        rng.uniform(3, 11),
        rng.uniform(0, 6),
        slope,
        rng.uniform(-0.2, 0.2),
        inside,
        np.cos(angle),
        aspect * np.sin(angle),
        rng.uniform(-0.3, 0.5),
        aspect**2,
        rng.uniform(0.2, 0.7) / aspect,
        4.0 * aspect,
    ]
    for x, side in ((1.0, sides[0]), (-1.0, sides[-1])):
        if side == "dirichlet":  # where Γ0 meets Γ1 the obstacle may not be above u_D
            above = _any_obstacle(np, x, 0.0, parameters) - _any_value(np, x, 0.0, parameters)
            parameters[4] -= max(above + 0.01, 0.0)
    kappa = KAPPAS[int(rng.integers(len(KAPPAS)))]
    return Case(
        f"problem {number} of seed {seed} (aspect {aspect:.0f}, contrast {contrast:.0e})",
        lambda: squashed(
            Polygon(vertices, (*boundary, *map(str, sides))).mesh(size, COMM), 1.0 / aspect
        ),
        levels,
        {
            "f": _any_load,
            "g": _any_flux,
            "obstacle": _any_obstacle,
            "dirichlet": _any_value,
            "coefficient": kappa,
        },
        tuple(float(p) for p in parameters),
        contrast,
    )


def random(seed: int, quick: bool) -> Group:
    """Random polygons and data."""
    number, levels = (8, 2) if quick else (300, 3)
    rows = []
    for title, thin in (("cells of any shape", False), ("cells up to 1000 times as long", True)):
        own = [n for n in range(number) if (n % 4 == 3) == thin]
        cases = [_any_case(seed, n, thin, levels) for n in own]
        rows.append(
            row_of(title, cases, lambda case: True, least_proper=0 if quick else 2 * len(own) // 3)
        )
    return Group(
        "random",
        "Random problems",
        "Random polygons, f, g, α and u_D, κ in half planes, discs, strips and fields with a "
        f"contrast up to 1e10; {levels} meshes, each case from nested and from cold starts. "
        f"Passed: the same facets in contact, forces right to {EXACT:.0e}, and {POINTS}, or "
        "refused. A facet is on the fence, and may be in either state, where the rounding of data "
        f"in double precision decides; forces below {NOTHING:.0e} of what they are made of are "
        "none.",
        rows,
    )


# ---- thin cells

STEPS = 60 if COMM.size < 3 else 90
"""CG steps that thin cells may take on any mesh; sweeps know no dofs of other ranks, and with three
and more, coarse meshes have as many on borders of ranks as within them."""


def _hexagon(factor: float) -> Polygon:
    vertices = np.array([[-1, 0], [0.1, -0.1], [1, 0], [1.1, 0.8], [0, 1.1], [-0.9, 0.9]])
    boundary = ("contact", "contact", "neumann", "dirichlet", "dirichlet", "neumann")
    return Polygon(vertices * [1, factor], boundary)


def _angle(factor: float) -> Polygon:
    return Polygon(np.array(ANGLE[0]) * [1, factor], ANGLE[1])


def _strip_of(factor: float) -> Polygon:
    return Polygon(
        np.array(RECTANGLE[0]) * [1, factor], ("contact", "neumann", "dirichlet", "neumann")
    )


def _half_disc(factor: float) -> Polygon:
    angles = np.linspace(0, np.pi, 17)
    arc = np.column_stack([np.cos(angles), np.sin(angles)]) * [1, factor]
    return Polygon(arc, (*["dirichlet"] * 8, *["neumann"] * 8, "contact"))


def _with_hole(factor: float) -> Polygon:
    hole = np.array([[-0.3, 0.3], [0.2, 0.3], [0, 0.7]]) * [1, factor]
    sides = np.array(RECTANGLE[0]) * [1, factor]
    return Polygon(sides, RECTANGLE[1], [Polygon(hole, ["neumann"] * 3)])


SHAPES: dict[str, Callable[[float], Polygon]] = {
    "hexagon": _hexagon,
    "L-shape": _angle,
    "strip": _strip_of,
    "half disc": _half_disc,
    "rectangle with a hole": _with_hole,
}


def _flat(
    name: str, factor: float, levels: int, whole: bool, size: float = 0.25, load: float = 3.0
) -> Case:
    """A polygon squashed, and meshed before or after."""

    def mesh() -> Domain:
        if whole:
            return SHAPES[name](factor).mesh(size, COMM)
        return squashed(SHAPES[name](1.0).mesh(size, COMM), factor)

    kind = "after" if whole else "before"
    return Case(
        f"{name} squashed to {factor:.0e}, meshed {kind}, size {size:g}, f = {-load:.0e}",
        mesh,
        levels,
        {
            "f": _load,
            "g": _zero,
            "obstacle": _any_obstacle,
            "dirichlet": _slope,
            "coefficient": _one,
        },
        (load, 0, 0, 0, -0.1, 0.2, 7.0, 0.5),
    )


def _load(m: Any, x: Any, y: Any, p: Sequence[Any]) -> Any:
    return -p[0] + 0.0 * x


def thin(seed: int, quick: bool) -> Group:
    """Polygons squashed."""

    def long(case: Case, verdict: Verdict) -> str | None:
        steps = max(verdict.steps, default=0)
        return f"{steps} CG steps" if steps > STEPS else None

    shapes = ["hexagon", "L-shape"] if quick else list(SHAPES)
    sizes = (0.25,) if quick else (0.25, 0.1)
    rows = []
    for name in shapes:
        for factor in (1e-3, 1e-4):
            levels = 3 if quick or name != "hexagon" else 4
            cases = [
                _flat(name, factor, levels, whole, size, load)
                for whole, size in [*((False, size) for size in sizes), (True, 0.25)]
                for load in (3.0, 3.0 * factor**-1.5)
                if name == "hexagon" or not whole
            ]
            title, more = f"{name} squashed to {factor:.0e}", None
            if factor >= 1e-3:
                title, more = f"{title}, ≤ {STEPS} CG steps on every mesh", long
            rows.append(row_of(title, cases, lambda case: False, more or (lambda *_: None)))
    return Group(
        "thin",
        "Thin cells",
        "Polygons squashed, triangulated before, the hexagon after, too, 3 meshes, 4 of the "
        "hexagon, nested and cold; f = −3 and a load that brings contact whatever the thickness. "
        f"Passed: solved, the same facets in contact, forces right to {EXACT:.0e}, and {POINTS}.",
        rows,
    )
