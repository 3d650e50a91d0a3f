"""Sharpness of bounds where coefficients jump, cells are thin, or corners are sharp."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import manufactured
import numpy as np
from bounds import CLOSED, LEAST, distances
from exactly import Corner, FloatArray, Line, Pieces, slopes
from manufactured import Exact
from mpi4py import MPI
from report import Group, Row, told

from signorini_cr import Domain, Polygon, Problem, Solution, exact, families, solve_levels
from signorini_cr import solve as solve_one

COMM = MPI.COMM_WORLD

GOAL = 1.5
"""Bound over error in the energy norm, at most."""
WITHIN = 0.01
"""Excess over the published figures that it may have."""
SLACK = 1e-6


def figure(solution: Solution, error: float, name: str, goal: float) -> tuple[float, str | None]:
    """Bound over error, and what is wrong with it."""
    bound = solution.certificate.bound_energy_norm
    if bound is None:
        return np.nan, f"{name}: no bound, {solution.certificate.reason}"
    quotient = bound / error
    if quotient < 1 - SLACK:
        return quotient, f"{name}: bound {quotient:.4f} of the error"
    return quotient, None if quotient <= goal else f"{name}: {quotient:.3f}, above {goal:.3f}"


def row_of(
    name: str, reference: str, runs: Sequence[tuple[str, Solution, float]], goal: float = GOAL
) -> Row:
    """Sum up runs: what they are called, their solutions and exact errors."""
    found = [figure(solution, error, way, goal) for way, solution, error in runs]
    worst = " … ".join(f"{quotient:.3f}" for quotient, _ in found)
    failures = [complaint for _, complaint in found if complaint is not None]
    return told(Row(name, len(runs), f"bound over error {worst}", reference, failures))


# ---- harmonic on each cell: the error from its values on the cells' sides


@dataclass(frozen=True, eq=False)
class Harmonic:
    """A function that is a power r^s of the distance from the origin on each ray.

    Attributes:
        power: s.
        angular: μ(θ) and μ'(θ) on the sector that a cell lies in; called with θ and the sectors.
        sector: Number of the sector that points lie in, given x and y.
        kappa: κ on the sectors.
        begins: Where each sector begins, from which θ is counted on.
    """

    power: float
    angular: Callable[[Any, Any], tuple[Any, Any]]
    sector: Callable[[Any, Any], Any]
    kappa: FloatArray
    begins: FloatArray

    def _at(self, x: Any, y: Any, sector: Any) -> tuple[Any, Any, Any]:
        """u, u_x and u_y, sectors told, so that their sides are seen from within."""
        begin = self.begins[sector]
        middle = begin + np.diff([*self.begins, self.begins[0] + 2 * np.pi])[sector] / 2
        angle = np.arctan2(y, x)
        angle = angle + 2 * np.pi * np.round((middle - angle) / (2 * np.pi))
        value, slope = self.angular(angle, sector)
        r = np.hypot(x, y)
        u, size = r**self.power * value, r ** (self.power - 1)
        c, s = np.cos(angle), np.sin(angle)
        radial, across = self.power * value, slope
        return u, size * (radial * c - across * s), size * (radial * s + across * c)

    def error(self, solution: Solution) -> float:
        """‖κ^{1/2} ∇_h(u − u_h)‖ by Green's formula on each cell; collective.

        With w = u − u_h, ∫_T |∇w|² = ∮ w ∂ₙw, w harmonic in T; a constant more makes no difference.
        """
        p, slope = slopes(solution)
        middle = p.mean(axis=1)
        sector = self.sector(middle[:, 0], middle[:, 1])
        side = p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]
        turned = np.sign(side[0][:, 0] * side[1][:, 1] - side[0][:, 1] * side[1][:, 0])
        at_origin = np.linalg.norm(p, axis=2).min(axis=1) < 1e-12
        total = 0.0
        for cells, levels in ((~at_origin, 6), (at_origin, 500)):
            own, q, m, k = slope[cells], p[cells], middle[cells], sector[cells][:, None]
            square = np.zeros(len(q))
            for i in range(3):
                a, b = q[:, i], q[:, (i + 1) % 3]
                t, weights = _towards_end(levels)
                # from the nearer end, so that no digits are lost near the origin
                x, y = (
                    np.concatenate(
                        [
                            a[:, j, None] + t * (b - a)[:, j, None],
                            b[:, j, None] - t * (b - a)[:, j, None],
                        ],
                        axis=1,
                    )
                    for j in (0, 1)
                )
                u, u_x, u_y = self._at(x, y, np.broadcast_to(k, x.shape))
                w = u - own[:, :1] * (x - m[:, :1]) - own[:, 1:] * (y - m[:, 1:])
                n_x, n_y = (b - a)[:, 1:], -(b - a)[:, :1]
                flux = n_x * (u_x - own[:, :1]) + n_y * (u_y - own[:, 1:])
                w = w - self._offset(m, own, k)
                square += turned[cells] * ((w * flux) @ np.tile(weights, 2))
            total += float(self.kappa[sector[cells]] @ square)
        return float(np.sqrt(solution.domain.mesh.comm.allreduce(total)))

    def runs(
        self, problem: Problem, domain: Domain, quick: bool
    ) -> list[tuple[str, Solution, float]]:
        """Solve a problem that this is the solution of, and tell the errors; collective."""
        return [
            (f"level {solution.level.number}", solution, self.error(solution))
            for solution in solve_levels(problem, domain, 2 if quick else 4)
        ]

    def _offset(self, m: FloatArray, own: FloatArray, sector: Any) -> Any:
        return self._at(m[:, :1], m[:, 1:], sector)[0]


def _towards_end(levels: int) -> tuple[FloatArray, FloatArray]:
    """Points and weights on [0, ½], graded towards 0."""
    t, w = np.polynomial.legendre.leggauss(10)
    marks = np.concatenate([[0.0], 0.5 ** np.arange(levels, 0, -1.0)])
    length = np.diff(marks)
    at = (marks[:-1, None] + length[:, None] * (t + 1) / 2).ravel()
    return at, (length[:, None] * w / 2).ravel()


GAMMA, SIGMA, RATIO = 0.1, -14.92256510455152, 161.4476387975881
"""Kellogg's: r^γ with ρ = π/4."""


def _kellogg_angular(angle: Any, sector: Any) -> tuple[Any, Any]:
    quarter = np.pi / 4
    factors = np.array(
        [
            np.cos((np.pi / 2 - SIGMA) * GAMMA),
            np.cos(quarter * GAMMA),
            np.cos(SIGMA * GAMMA),
            np.cos((np.pi / 2 - quarter) * GAMMA),
        ]
    )
    shifts = _kellogg_shifts()
    phase = (angle - shifts[sector]) * GAMMA
    return factors[sector] * np.cos(phase), -GAMMA * factors[sector] * np.sin(phase)


def _kellogg_shifts() -> FloatArray:
    quarter = np.pi / 4
    return np.array([np.pi / 2 - quarter, np.pi - SIGMA, np.pi + quarter, 3 * np.pi / 2 + SIGMA])


KELLOGG = Harmonic(
    GAMMA,
    _kellogg_angular,
    lambda x, y: np.where(y > 0, np.where(x > 0, 0, 1), np.where(x > 0, 3, 2)),
    np.array([RATIO, 1.0, RATIO, 1.0]),
    np.arange(4) * np.pi / 2,
)


def _kellogg_transmits() -> float:
    """Compute how far u and κ∂ₙu are from the same on both sides of the axes; relative."""
    worst = 0.0
    for k in range(4):
        angle, other = (k + 1) * np.pi / 2, (k + 1) % 4
        turned = angle - 2 * np.pi * (other == 0)
        u, slope = _kellogg_angular(angle, k)
        v, tilt = _kellogg_angular(turned, other)
        flux, flow = KELLOGG.kappa[k] * slope, KELLOGG.kappa[other] * tilt
        worst = max(worst, abs(u - v), abs(flux - flow) / max(abs(flux), 1.0))
    return float(worst)


def _angles(x: Any) -> tuple[Any, Any, Any]:
    """Tell whether |y| > |x|, and the angles from the axes of x and y, without atan2.

    Where the other one is asked for they are 0: nothing is divided by 0.
    """
    import ufl

    steep = ufl.gt(abs(x[1]), abs(x[0]))
    flat = ufl.atan(x[1] / ufl.conditional(steep, 1.0, x[0]))
    return steep, flat, -ufl.atan(x[0] / ufl.conditional(steep, x[1], 1.0))


def _kellogg_data(x: Any) -> Any:
    """Values of u on the square's sides in UFL, without atan2."""
    import ufl

    k = [*map(float, _kellogg_shifts())]
    factor = [float(_kellogg_angular(k[i], i)[0]) for i in range(4)]
    power = (x[0] ** 2 + x[1] ** 2) ** (GAMMA / 2)

    def wave(angle: Any, i: int) -> Any:
        return factor[i] * ufl.cos(GAMMA * (angle - k[i]))

    upper, right = ufl.gt(x[1], 0), ufl.gt(x[0], 0)
    steep, beside_right, slant = _angles(x)
    flat = ufl.conditional(
        right,
        ufl.conditional(upper, wave(beside_right, 0), wave(2 * np.pi + beside_right, 3)),
        ufl.conditional(upper, wave(np.pi + beside_right, 1), wave(np.pi + beside_right, 2)),
    )
    high = ufl.conditional(
        upper,
        ufl.conditional(right, wave(np.pi / 2 + slant, 0), wave(np.pi / 2 + slant, 1)),
        ufl.conditional(right, wave(1.5 * np.pi + slant, 3), wave(1.5 * np.pi + slant, 2)),
    )
    return power * ufl.conditional(steep, high, flat)


def _checkerboard(quick: bool) -> Row:
    """Contact where κ∂ₙu ≥ 0 on the lower side; found by looking."""
    import ufl

    flux = []
    for left in (True, False):
        x = np.linspace(-1, 0, 101) if left else np.linspace(0, 1, 101)
        sector = np.full(x.shape, 2 if left else 3)
        flux.append(-KELLOGG._at(x, np.full_like(x, -1.0), sector)[2])
    contact = ["contact" if (part >= 0).all() else "dirichlet" for part in flux]
    if "contact" not in contact:  # then the other sign of u
        raise AssertionError("the lower side has no flux of one sign")
    vertices = [[-1, -1], [0, -1], [1, -1], [1, 1], [-1, 1]]
    polygon = Polygon(np.array(vertices), (*contact, "dirichlet", "dirichlet", "dirichlet"))
    problem = Problem(
        f=0.0,
        obstacle=_kellogg_data,
        dirichlet=_kellogg_data,
        coefficient=lambda x: ufl.conditional(ufl.gt(x[0] * x[1], 0.0), RATIO, 1.0),
    )
    domain = families.structured(polygon, 4, COMM)
    return row_of(
        "checkerboard 1 : 161, u like r^0.1",
        "Kellogg's solution, by Green's formula on each cell; u and κ∂ₙu are the same from both "
        f"sides to {max(_kellogg_transmits(), LEAST):.0e}",
        KELLOGG.runs(problem, domain, quick),
    )


OPENING = 0.02
"""Of the slit, in radians."""


def _slit(quick: bool) -> Row:
    """Γ0 on one face of a slit, Γ1 on the other."""
    import ufl

    whole = 2 * np.pi - OPENING
    power = np.pi / (2 * whole)
    tip = [0, 0]
    vertices = [tip, [1, 0], [1, 1], [-1, 1], [-1, -1], [1, -1], [1, float(-np.tan(OPENING))]]
    polygon = Polygon(np.array(vertices), ("dirichlet", *["neumann"] * 5, "contact"))
    known = Harmonic(
        power,
        lambda angle, _: (np.sin(power * angle), power * np.cos(power * angle)),
        lambda x, y: np.zeros(np.shape(x), dtype=np.int64),
        np.ones(1),
        np.zeros(1),
    )

    def flux(x: Any) -> Any:
        """∂ₙu on the square's sides."""
        right, upper = ufl.gt(x[0], 0), ufl.gt(x[1], -0.5 * np.tan(OPENING))
        steep, beside, slant = _angles(x)
        on_right = ufl.conditional(upper, beside, 2 * np.pi + beside)
        high = ufl.conditional(upper, np.pi / 2 + slant, 1.5 * np.pi + slant)
        angle = ufl.conditional(steep, high, ufl.conditional(right, on_right, np.pi + beside))
        size = power * (x[0] ** 2 + x[1] ** 2) ** ((power - 1) / 2)
        across = ufl.conditional(right, 1.0, -1.0) * ufl.sin((power - 1) * angle)
        up = ufl.conditional(upper, 1.0, -1.0) * ufl.cos((power - 1) * angle)
        return size * ufl.conditional(steep, up, across)

    problem = Problem(f=0.0, obstacle=0.0, dirichlet=0.0, g=flux)
    return row_of(
        "contact meets Γ0 at the tip of a slit",
        "u = r^s sin sθ, s = π/2ω for the angle ω: harmonic, 0 on one face, no flux through the "
        "other; by Green's formula on each cell",
        known.runs(problem, polygon.mesh(0.3, COMM), quick),
    )


# ---- by quadrature


def _measured(made: Exact, domains: Sequence[tuple[str, Domain]]) -> list:
    runs = []
    for way, domain in domains:
        solution = solve_one(made.problem(domain), domain)
        runs.append((way, solution, distances(solution, made)[1]))
    return runs


def _across_sides(seed: int, quick: bool) -> Row:
    """10⁶ across cell sides."""
    runs, wrong = [], 0.0
    for k, n in enumerate((8, 8) if quick else (8, 8, 16, 16, 32, 32)):
        rng = np.random.default_rng((seed, k))
        k1, k2 = ((1.0, 1e6), (1e6, 1.0))[k % 2]
        f0, q, e = rng.uniform(1, 3), rng.uniform(-1, 1), rng.uniform(-1, 1)
        A = -(1.6 * f0 + 0.2)
        parameters = (0.0, 1.0, 0.5, k1, k2, A, f0, 0.0, q, 0.0, 0.5, 0.0, e, 0.0)
        made = Exact(
            "10⁶ across cell sides",
            tuple(map(float, parameters)),
            manufactured.HELD,
            manufactured._k_u,
            manufactured._k_gradient,
            manufactured._k_u,
            manufactured._k_u,
            f=manufactured._k_f,
            coefficient=manufactured._k,
            lines=((0.0, 1.0, 0.5),),
        )
        wrong = max(wrong, made.checked())
        runs += _measured(made, [(f"n = {n}", families.structured(made.polygon, n, COMM))])
    return row_of("κ jumps by 10⁶ across cell sides", CLOSED.format(max(wrong, LEAST)), runs)


def _sheared_u(m: Any, x: Any, y: Any, p: Sequence[Any]) -> Any:
    return p[0] * m.sin(p[1] * x + p[2]) * m.cos(p[3] * y) - p[5] * y


def _sheared_gradient(m: Any, x: Any, y: Any, p: Sequence[Any]) -> tuple[Any, Any]:
    s, c = m.sin(p[1] * x + p[2]), m.cos(p[1] * x + p[2])
    return p[0] * p[1] * c * m.cos(p[3] * y), -p[0] * p[3] * s * m.sin(p[3] * y) - p[5]


def _sheared_f(m: Any, x: Any, y: Any, p: Sequence[Any]) -> Any:
    return p[0] * (p[1] ** 2 + p[3] ** 2) * m.sin(p[1] * x + p[2]) * m.cos(p[3] * y)


def _along_u(m: Any, x: Any, y: Any, p: Sequence[Any]) -> Any:
    return _sheared_u(m, x - SHEAR * y, y, p)


def _along_gradient(m: Any, x: Any, y: Any, p: Sequence[Any]) -> tuple[Any, Any]:
    a, b = _sheared_gradient(m, x - SHEAR * y, y, p)
    return a, b - SHEAR * a


def _along_f(m: Any, x: Any, y: Any, p: Sequence[Any]) -> Any:
    s, c = m.sin(p[1] * (x - SHEAR * y) + p[2]), m.cos(p[1] * (x - SHEAR * y) + p[2])
    straight = ((1 + SHEAR**2) * p[1] ** 2 + p[3] ** 2) * s * m.cos(p[3] * y)
    return p[0] * (straight - 2 * SHEAR * p[1] * p[3] * c * m.sin(p[3] * y))


def _even_load_u(m: Any, x: Any, y: Any, p: Sequence[Any]) -> Any:
    rise = (m.exp(p[0] * y) + m.exp(-p[0] * y)) / 2
    return m.sin(p[0] * x + 0.3) * rise - p[1] * y**2 / 2 - p[2] * y


def _even_load_gradient(m: Any, x: Any, y: Any, p: Sequence[Any]) -> tuple[Any, Any]:
    up, down = m.exp(p[0] * y), m.exp(-p[0] * y)
    return (
        p[0] * m.cos(p[0] * x + 0.3) * (up + down) / 2,
        p[0] * m.sin(p[0] * x + 0.3) * (up - down) / 2 - p[1] * y - p[2],
    )


def _even_load_f(m: Any, x: Any, y: Any, p: Sequence[Any]) -> Any:
    return p[1] + 0.0 * x


# Three waves that cross the domain aslant, less 0.5 y: amplitudes, wave numbers by x and y, phases.


def _waves_u(m: Any, x: Any, y: Any, p: Sequence[Any]) -> Any:
    return sum(a * m.sin(k * x + q * y + s) for a, k, q, s in np.reshape(p, (3, 4))) - 0.5 * y


def _waves_gradient(m: Any, x: Any, y: Any, p: Sequence[Any]) -> tuple[Any, Any]:
    rows = [(k, q, a * m.cos(k * x + q * y + s)) for a, k, q, s in np.reshape(p, (3, 4))]
    return sum(k * each for k, _, each in rows), sum(q * each for _, q, each in rows) - 0.5


def _waves_f(m: Any, x: Any, y: Any, p: Sequence[Any]) -> Any:
    rows = np.reshape(p, (3, 4))
    return sum((k**2 + q**2) * a * m.sin(k * x + q * y + s) for a, k, q, s in rows)


SHEAR = 50.0


def _thin(
    name: str,
    formulas: tuple[Any, Any, Any],
    parameters: Any,
    edges: Any,
    quick: bool,
    open_side: bool = False,
) -> Row:
    """Squares mapped to parallelograms.

    Args:
        name: What they are called.
        formulas: u, its gradient and f.
        parameters: Theirs.
        edges: Where the square's lower and left side go.
        quick: Whether one mesh is enough.
        open_side: Whether the right side is Neumann's, and there is one mesh more.
    """
    u, gradient, f = formulas
    lower, left = (np.array(edge, dtype=np.float64) for edge in edges)
    corners = [(0.0, 0.0), tuple(lower), tuple(lower + left), tuple(left)]
    labels = ("contact", "neumann", "dirichlet", "dirichlet") if open_side else manufactured.HELD
    normal = np.array([left[1], -left[0]]) / np.hypot(*left)

    def g(m: Any, x: Any, y: Any, p: Sequence[Any]) -> Any:
        along, up = gradient(m, x, y, p)
        return along * float(normal[0]) + up * float(normal[1])

    made = Exact(
        "thin",
        parameters,
        labels,
        u,
        gradient,
        u,
        u,
        f=f,
        g=g if open_side else None,
        vertices=tuple(corners),
    )
    domains = []
    for n in (8,) if quick else (8, 16, 32, 64)[: 3 + open_side]:
        square = Polygon(np.array(manufactured.SQUARE), labels)
        domain = families.structured(square, n, COMM)
        x = domain.mesh.geometry.x
        x[:, :2] = x[:, :2] @ np.array([lower, left])
        domains.append((f"n = {n}", domain))
    return row_of(name, CLOSED.format(max(made.checked(), LEAST)), _measured(made, domains))


# κ = a + b sin kx; p = A, K, E. u = A I(x) − K y + E y² with I' = 1/κ: contact on the left.


def _wave(m: Any, x: Any, y: Any, p: Sequence[Any]) -> Any:
    return 2.0 + 1.9 * m.sin(60.0 * x)


def _wave_integral(x: Any) -> Any:
    """∫_0^x 1/κ, by the tangent of half the angle, its branches joined."""
    root = np.sqrt(2.0**2 - 1.9**2)
    half = 30.0 * np.asarray(x)
    value = np.arctan2(2.0 * np.sin(half) + 1.9 * np.cos(half), root * np.cos(half))
    value = value + 2 * np.pi * np.round((half - value) / (2 * np.pi))
    return (value - np.arctan2(1.9, root)) / (30.0 * root)


def _wave_u(m: Any, x: Any, y: Any, p: Sequence[Any]) -> Any:
    return p[0] * _wave_integral(x) - p[1] * y + p[2] * y**2


def _wave_gradient(m: Any, x: Any, y: Any, p: Sequence[Any]) -> tuple[Any, Any]:
    return p[0] / _wave(m, x, y, p), 2 * p[2] * y - p[1]


def _wave_f(m: Any, x: Any, y: Any, p: Sequence[Any]) -> Any:
    return -2.0 * p[2] * _wave(m, x, y, p)


def _wave_g(m: Any, x: Any, y: Any, p: Sequence[Any]) -> Any:
    slope = 2 * p[2] * y - p[1]
    return m.where(m.above(y, 0.5), 1.0, -1.0) * _wave(m, x, y, p) * slope


def _wave_alpha(m: Any, x: Any, y: Any, p: Sequence[Any]) -> Any:
    return p[2] * y**2 - p[1] * y


def _wave_dirichlet(m: Any, x: Any, y: Any, p: Sequence[Any]) -> Any:
    return p[3] + p[2] * y**2 - p[1] * y


def _waves(quick: bool) -> Row:
    """κ = 2 + 1.9 sin 60x."""
    A = -1.0
    made = Exact(
        "waves",
        (A, 0.7, 0.4, float(A * _wave_integral(1.0))),
        ("neumann", "dirichlet", "neumann", "contact"),
        _wave_u,
        _wave_gradient,
        _wave_alpha,
        _wave_dirichlet,
        f=_wave_f,
        g=_wave_g,
        coefficient=_wave,
        lines=tuple((1.0, 0.0, k / 48) for k in range(1, 48)),
    )
    domains = [
        (f"n = {n}", families.structured(made.polygon, n, COMM))
        for n in ((64,) if quick else (64, 128))
    ]
    # the first figure is of a mesh with some seven cells in a period
    return row_of(
        "κ = 2 + 1.9 sin 60x", CLOSED.format(max(made.checked(), LEAST)), _measured(made, domains)
    )


# ---- the published figures

Known = tuple[
    Callable[[Any, Any], tuple[Any, Any]], tuple[Line, ...], tuple[Corner, ...], tuple[float, float]
]


def _bubble(x: Any, y: Any) -> tuple[Any, Any, Any]:
    return (
        (1 - x**2) * (1 - y**2),
        -2 * x * (1 - y**2),
        -2 * y * (1 - x**2),
    )


def _harmonic_power(s: float) -> Callable[[Any, Any], tuple[Any, Any]]:
    def slope(x: Any, y: Any) -> tuple[Any, Any]:
        derivative = s * (x + 1j * y) ** (s - 1)
        return derivative.real, -derivative.imag

    return slope


def _s1(x: Any, y: Any) -> tuple[Any, Any]:
    b, b_x, b_y = _bubble(x, y)
    w = ((x + 1j * y) ** 1.5).real
    w_x, w_y = _harmonic_power(1.5)(x, y)
    return b * w_x + b_x * w, b * w_y + b_y * w


def _a(x: Any, y: Any) -> tuple[Any, Any]:
    right, left = np.maximum(x, 0), np.maximum(-x, 0)
    return 3 * right**2 + 3 * y * left**2, -(left**3)


def _i(x: Any, y: Any) -> tuple[Any, Any]:
    right = x > 1e-9
    t = np.where(right, x, 1.0)
    s, c = np.sin(np.pi / t), np.cos(np.pi / t)

    def spike(sign: float) -> tuple[Any, Any]:
        top = np.maximum(sign * s, 0)
        value = t**6 * top**3
        slope = 6 * t**5 * top**3 - 3 * sign * np.pi * t**4 * top**2 * c
        return np.where(right, value, 0), np.where(right, slope, 0)

    (a, a_x), (b, b_x) = spike(1.0), spike(-1.0)
    left = np.maximum(-x, 0)
    b, b_x = b + left**3, b_x - 3 * left**2
    phi, phi_x, phi_y = _bubble(x, y)
    core = a - y * b
    return (a_x - y * b_x) * phi + core * phi_x, -b * phi + core * phi_y


_MIDDLE: tuple[Line, ...] = ((1.0, 0.0, 0.0),)
_ORIGIN: tuple[Corner, ...] = ((0.0, 0.0, 1e-5),)
PUBLISHED: dict[str, Known] = {
    "S1": (_s1, (), _ORIGIN, (1.065, 1.040)),
    "A": (_a, _MIDDLE, (), (1.057, 1.029)),
    "B": (_harmonic_power(1.5), (), _ORIGIN, (1.021, 1.019)),
    "C": (_harmonic_power(3.5), (), _ORIGIN, (1.026, 1.019)),
    "I": (_i, tuple((1.0, 0.0, 1 / k) for k in range(1, 21)) + _MIDDLE, (), (1.156, 1.039)),
}
"""Gradient of u, lines, corners; the figures in docs/certificate.md, coarsest and finest mesh."""


def _published(name: str, quick: bool) -> Row:
    slope, lines, corners, figures = PUBLISHED[name]
    example = getattr(exact, name)
    quotients, failures = [], []
    levels = 1 if quick else 5
    for solution in solve_levels(example.problem, example.structured(8, COMM), levels):
        number = solution.level.number
        if number not in (0, 4):
            continue
        points, own = slopes(solution)
        pieces = Pieces(points, lines, corners)
        a, b = slope(pieces.x, pieces.y)
        at = own[pieces.owner]
        square = pieces.integral((a - at[:, :1]) ** 2 + (b - at[:, 1:]) ** 2)
        error = float(np.sqrt(COMM.allreduce(square)))
        limit = figures[0 if number == 0 else 1] + WITHIN
        quotient, complaint = figure(solution, error, f"level {number}", limit)
        quotients.append(quotient)
        failures += [] if complaint is None else [complaint]
    shown = " … ".join(f"{quotient:.3f}" for quotient in quotients)
    return Row(
        f"{name}, published {figures[0]:.3f} … {figures[1]:.3f}",
        len(quotients),
        f"bound over error {shown}",
        "u in closed form, its gradient written anew and integrated on split triangles; the "
        "figures of docs/certificate.md",
        failures,
    )


def _parallelograms(quick: bool) -> list[Row]:
    """Squares stretched, squashed, and sheared."""
    plain = (_sheared_u, _sheared_gradient, _sheared_f)
    along = (_along_u, _along_gradient, _along_f)
    even = (_even_load_u, _even_load_gradient, _even_load_f)
    flat, root = 1 / SHEAR, 0.5**0.5
    return [
        _thin(
            "squares sheared 1 : 50, f constant",
            even,
            (5.0 / SHEAR, 3.0, 0.5),
            ([1, 0], [SHEAR, 1]),
            quick,
        ),
        _thin(
            "squares stretched to 1 : 50",
            plain,
            (1.0, 3.0, 0.3, 3.0 / SHEAR, 0.0, 0.5),
            ([1, 0], [0, SHEAR]),
            quick,
        ),
        _thin(
            "squares squashed to 50 : 1, and sheared by 45°",
            plain,
            (1.0, 3.0, 0.3, 3.0, 0.0, 0.5),
            ([1, 0], [flat, flat]),
            quick,
        ),
        _thin(
            "squares squashed to 50 : 1, and turned by 45°",
            plain,
            (0.1, 3.0, 0.3, 3.0, 0.0, 1.0),
            ([root, root], [-flat * root, flat * root]),
            quick,
        ),
        _thin(
            "squares sheared 1 : 50, u smooth",
            plain,
            (1.0, 3.0 / SHEAR, 0.3, 3.0, 0.0, 0.5),
            ([1, 0], [SHEAR, 1]),
            quick,
        ),
        _thin(
            "squares sheared 1 : 50, u smooth, a side Neumann",
            plain,
            (1.0, 3.0 / SHEAR, 0.3, 3.0, 0.0, 0.5),
            ([1, 0], [SHEAR, 1]),
            quick,
            open_side=True,
        ),
        _thin(
            "squares sheared 1 : 50, three waves along them",
            (_waves_u, _waves_gradient, _waves_f),
            (0.5, 0.05, 0.03, 1.0, 0.4, -0.04, 0.05, 2.0, 0.8, 0.1, -0.06, 5.0),
            ([1, 0], [-SHEAR, 1]),
            quick,
        ),
        _thin(
            "squares sheared 1 : 50, u sheared as well",
            along,
            (0.2, 2.0, 0.3, 2.0, 0.0, SHEAR),
            ([1, 0], [SHEAR, 1]),
            quick,
        ),
    ]


def sharpness(seed: int, quick: bool) -> Group:
    """All cases."""
    rows = [
        _checkerboard(quick),
        _across_sides(seed, quick),
        *_parallelograms(quick),
        _waves(quick),
        _slit(quick),
        *(_published(name, quick) for name in PUBLISHED),
    ]
    return Group(
        "sharpness",
        "How sharp the bounds are",
        "Bound over error in the energy norm, mesh by mesh. Passed: not below 1 and at most "
        f"{GOAL}; for the published examples at most {WITHIN} above the published figures.",
        rows,
    )
