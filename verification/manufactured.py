"""Solutions in closed form whose data are as rough as a user's may be.

Every one is a solution of the Signorini problem by construction: −∇·(κ∇u) = f on each side of the
lines where data jump, u and κ∂ₙu the same from both sides; on Γ1, the lower side, κ∂ₙu ≥ 0, and
the obstacle is u where κ∂ₙu > 0. `Exact.checked` puts that to the test: the weak form with
polynomials, the sign of the pressure and the gap.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from exactly import Corner, FloatArray, Line, Pieces, graded
from formulas import NUMBERS, Formula, numeric, symbolic

from signorini_cr import Domain, Polygon, Problem

SQUARE = ((0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0))
HELD = ("contact", "dirichlet", "dirichlet", "dirichlet")
FREE = ("contact", "neumann", "dirichlet", "neumann")
GATE = ("contact", "dirichlet", "neumann", "dirichlet")
Fields = Callable[[Any, Any, Any, Sequence[Any]], tuple[Any, Any]]


@dataclass(frozen=True, eq=False)
class Exact:
    """A problem and its solution.

    Attributes:
        kind: The class of problems.
        parameters: Of the formulas.
        boundary: Parts of the square's sides, from the lower one counterclockwise.
        u: The solution.
        gradient: Its derivatives by x and y.
        f: Load; None for 0.
        g: Flux; None for 0.
        obstacle: α.
        dirichlet: u_D.
        coefficient: κ; None for 1.
        lines: Where the gradient, or its derivatives, jump.
        corners: Where it has no bound, or bends sharply.
        degree: Of the program's quadrature; None for its default.
        vertices: Of the domain.
    """

    kind: str
    parameters: tuple[float, ...]
    boundary: tuple[str, ...]
    u: Formula
    gradient: Fields
    obstacle: Formula
    dirichlet: Formula
    f: Formula | None = None
    g: Formula | None = None
    coefficient: Formula | None = None
    lines: tuple[Line, ...] = ()
    corners: tuple[Corner, ...] = ()
    degree: int | None = None
    vertices: tuple[tuple[float, float], ...] = SQUARE

    @property
    def polygon(self) -> Polygon:
        """The domain."""
        return Polygon(np.array(self.vertices), self.boundary)

    def problem(self, domain: Domain) -> Problem:
        """Return the program's part: the data, not the solution."""
        keys = {"f": 0.0, "g": 0.0, "obstacle": 0.0, "dirichlet": 0.0, "coefficient": 1.0}
        data: dict[str, Any] = {}
        for key, number in keys.items():
            formula = getattr(self, key)
            data[key] = (
                number if formula is None else symbolic(formula, domain.mesh, self.parameters)
            )
        if self.degree is not None:
            data["quadrature_degree"] = self.degree
        return Problem(**data)

    def slope(self, x: Any, y: Any) -> tuple[FloatArray, FloatArray]:
        """∇u at points."""
        a, b = self.gradient(NUMBERS, x, y, self.parameters)
        return np.broadcast_to(a, np.shape(x)), np.broadcast_to(b, np.shape(x))

    def _value(self, formula: Formula | None, x: Any, y: Any, absent: float = 0.0) -> FloatArray:
        """A formula at points."""
        if formula is None:
            return np.full(np.shape(x), absent)
        found: FloatArray = numeric(formula, self.parameters)(x, y)
        return found

    def kappa(self, x: Any, y: Any) -> FloatArray:
        """κ at points."""
        return self._value(self.coefficient, x, y, absent=1.0)

    def _flux(self, x: Any, y: Any, normal: FloatArray) -> FloatArray:
        """κ∂ₙu at points."""
        a, b = self.slope(x, y)
        flux: FloatArray = self.kappa(x, y) * (normal[0] * a + normal[1] * b)
        return flux

    def pieces(self, points: FloatArray) -> Pieces:
        """Cells, in pieces on which u is smooth."""
        return Pieces(points, self.lines, self.corners)

    def _sides(self) -> list[tuple[str, FloatArray, FloatArray, FloatArray, FloatArray]]:
        """Of each side: its part, points, weights and outward normal."""
        out = []
        ends = [np.array(v) for v in self.vertices]
        for part, a, b in zip(self.boundary, ends, [*ends[1:], ends[0]], strict=True):
            along, breaks = b - a, []
            for n_x, n_y, c in self.lines:
                slope = n_x * along[0] + n_y * along[1]
                if abs(slope) > 1e-12:
                    breaks.append(float((c - n_x * a[0] - n_y * a[1]) / slope))
            for p_x, p_y, _ in self.corners:
                off = np.array([p_x, p_y]) - a
                breaks.append(float(off @ along / (along @ along)))
            x, y, w = graded(a, b, breaks)
            n = np.array([along[1], -along[0]]) / np.linalg.norm(along)
            out.append((part, x, y, w, n))
        return out

    def held(self) -> float:
        """∫ κ∂ₙu u over Γ0 and Γ1: J(u) is this less half of ∫ κ|∇u|², by Green's formula."""
        total = 0.0
        for part, x, y, w, n in self._sides():
            if part != "neumann":
                total += float(w @ (self._flux(x, y, n) * self._value(self.u, x, y)))
        return total

    def checked(self) -> float:
        """Compute how far this is from a solution: the largest of several relative figures."""
        n = 7
        i, j = np.meshgrid(np.arange(n), np.arange(n))
        v = np.array(self.vertices)
        sides = np.stack([v[1] - v[0], v[3] - v[0]]) / n  # a parallelogram
        corner = v[0] + np.stack([i.ravel(), j.ravel()], axis=1) @ sides
        right, up, both = (corner + np.array(s) @ sides for s in ([1, 0], [0, 1], [1, 1]))
        cells = np.concatenate(
            [np.stack([corner, right, both], axis=1), np.stack([corner, both, up], axis=1)]
        )
        inside = self.pieces(cells)
        x, y = inside.x, inside.y
        kappa, (u_x, u_y) = self.kappa(x, y), self.slope(x, y)
        f = self._value(self.f, x, y)
        worst = 0.0
        edges = self._sides()
        tests: list[tuple[Callable, Callable, Callable]] = [
            (lambda x, y: 1 + 0 * x, lambda x, y: 0 * x, lambda x, y: 0 * x),
            (lambda x, y: x * y, lambda x, y: y, lambda x, y: x),
            (lambda x, y: x**2 + y**3, lambda x, y: 2 * x, lambda x, y: 3 * y**2),
        ]
        for phi, phi_x, phi_y in tests:
            terms = [
                inside.integral(kappa * u_x * phi_x(x, y)),
                inside.integral(kappa * u_y * phi_y(x, y)),
                -inside.integral(f * phi(x, y)),
            ]
            for _, s, t, w, normal in edges:
                terms.append(-float(w @ (self._flux(s, t, normal) * phi(s, t))))
            worst = max(worst, abs(sum(terms)) / sum(map(abs, terms)))
        for part, s, t, w, normal in edges:
            u, flux = self._value(self.u, s, t), self._flux(s, t, normal)
            if part == "dirichlet":
                wrong = self._value(self.dirichlet, s, t) - u
                worst = max(worst, float(w @ abs(wrong) / (w @ abs(u) + 1e-3)))
            elif part == "neumann":
                wrong = self._value(self.g, s, t) - flux
                worst = max(worst, float(w @ abs(wrong) / (w @ abs(flux) + 1e-3)))
            else:
                gap = u - self._value(self.obstacle, s, t)
                size_u, size_f = w @ abs(u) + 1e-3, w @ abs(flux) + 1e-3
                worst = max(worst, float(w @ np.maximum(-gap, 0) / size_u))
                worst = max(worst, float(w @ np.maximum(-flux, 0) / size_f))
                worst = max(worst, float(w @ abs(gap * flux) / size_u / size_f))
        return worst


def _direction(rng: np.random.Generator, level: bool) -> tuple[float, float]:
    angle = 0.0 if level else float(rng.uniform(0.15, 1.0) * rng.choice([-1, 1]))
    return float(np.sin(angle)), float(np.cos(angle))


def _line(rng: np.random.Generator, level: bool) -> Line:
    """A line through the square; level ones at any height."""
    n_x, n_y = _direction(rng, level)
    x, y = (0.5, rng.uniform(0.1, 0.99)) if level else rng.uniform(0.3, 0.7, 2)
    return n_x, n_y, float(n_x * x + n_y * y)


# ---- f jumps: p = n_x, n_y, c, f1, f2, A, K, e, Q, P, x0, kink


def _f_u(m: Any, x: Any, y: Any, p: Sequence[Any]) -> Any:
    t = p[0] * x + p[1] * y - p[2]
    # not by a condition: that u is continuous shall be plain to whoever encloses it
    bent = p[4] * m.larger(t, 0.0) ** 2 / 2 + p[3] * m.smaller(t, 0.0) ** 2 / 2
    rest = p[7] * (x**3 - 3.0 * x * y**2) - p[6] * y
    return p[5] * t - bent + rest - p[8] * y * m.larger(p[10] - x, 0.0) ** 3


def _f_gradient(m: Any, x: Any, y: Any, p: Sequence[Any]) -> tuple[Any, Any]:
    t = p[0] * x + p[1] * y - p[2]
    along = p[5] - m.where(m.above(t, 0.0), p[4], p[3]) * t
    left = m.larger(p[10] - x, 0.0)
    return (
        p[0] * along + p[7] * (3 * x**2 - 3 * y**2) + 3 * p[8] * y * left**2,
        p[1] * along - p[7] * 6 * x * y - p[6] - p[8] * left**3,
    )


def _f_f(m: Any, x: Any, y: Any, p: Sequence[Any]) -> Any:
    t = p[0] * x + p[1] * y - p[2]
    return m.where(m.above(t, 0.0), p[4], p[3]) + 6.0 * p[8] * y * m.larger(p[10] - x, 0.0)


def _f_g(m: Any, x: Any, y: Any, p: Sequence[Any]) -> Any:
    return m.where(m.above(x, 0.5), 1.0, -1.0) * _f_gradient(m, x, y, p)[0]


def _lowered(u: Formula, P: int, x0: int) -> Formula:
    """U less something positive to the right of a point, which may begin with a kink."""

    def alpha(m: Any, x: Any, y: Any, p: Sequence[Any]) -> Any:
        right = m.larger(x - p[x0], 0.0)
        return u(m, x, y, p) - p[P] * right * (right + p[P + 2])

    return alpha


def _across(
    kind: str,
    rng: np.random.Generator,
    parameters: Sequence[float],
    u: Formula,
    gradient: Fields,
    line: Line,
    **data: Formula,
) -> Exact:
    """Data that jump across a line; from the ninth on the parameters are those of `_lowered`."""
    p = tuple(map(float, parameters))
    return Exact(
        kind,
        p,
        HELD if rng.random() < 0.6 else FREE,
        u,
        gradient,
        _lowered(u, 9, 10),
        u,
        lines=(line, (1.0, 0.0, p[10])),
        **data,
    )


def load_jumps(rng: np.random.Generator) -> Exact:
    """F jumps across a level or a slant line."""
    level = bool(rng.random() < 0.6)
    line = _line(rng, level)
    n_x, n_y, c = line
    f1, f2 = rng.uniform(-10, 10, 2)
    A, e = rng.uniform(-1, 1, 2)
    if rng.random() < 0.4:  # the load alone, and that on one side only
        A, e = 0.0, 0.0
        f1, f2 = (f1, 0.0) if rng.random() < 0.5 else (0.0, f2)
    x0, kink = rng.uniform(0.3, 0.7), rng.choice([0.0, 1.0])
    if level and rng.random() < 0.5:  # contact to the left of x0
        K, Q, P = A + f1 * c, rng.uniform(1, 8), rng.uniform(0.5, 3)
    else:
        K, Q, P = abs(A) + 1.6 * max(abs(f1), abs(f2)) + 0.1, 0.0, 0.0
    parameters = (n_x, n_y, c, f1, f2, A, K, e, Q, P, x0, kink)
    return _across(
        "f jumps across a line", rng, parameters, _f_u, _f_gradient, line, f=_f_f, g=_f_g
    )


# ---- κ jumps: p = n_x, n_y, c, κ1, κ2, A, f0, B, q, P, x0, kink, e, Q


def _k(m: Any, x: Any, y: Any, p: Sequence[Any]) -> Any:
    return m.where(m.above(p[0] * x + p[1] * y - p[2], 0.0), p[4], p[3])


def _k_u(m: Any, x: Any, y: Any, p: Sequence[Any]) -> Any:
    t, r = p[0] * x + p[1] * y - p[2], p[1] * x - p[0] * y
    over = m.larger(t, 0.0) / p[4] + m.smaller(t, 0.0) / p[3]  # t / κ, continuous by its looks
    across = over * (p[5] - p[6] * t / 2 + p[7] * t * r)
    w = y * m.larger(1.0 - y / p[2], 0.0) ** 2  # used with level lines only
    return across + p[8] * r**2 + p[12] * r - p[13] * m.larger(p[10] - x, 0.0) ** 3 * w / p[3]


def _k_gradient(m: Any, x: Any, y: Any, p: Sequence[Any]) -> tuple[Any, Any]:
    t, r = p[0] * x + p[1] * y - p[2], p[1] * x - p[0] * y
    k = _k(m, x, y, p)
    normal = (p[5] - p[6] * t + 2 * p[7] * t * r) / k
    tangent = p[7] * t**2 / k + 2 * p[8] * r + p[12]
    left, below = m.larger(p[10] - x, 0.0), m.above(0.0, t)
    w = m.where(below, y * (1 - y / p[2]) ** 2, 0.0)
    w_y = m.where(below, 1 - 4 * y / p[2] + 3 * y**2 / p[2] ** 2, 0.0)
    return (
        p[0] * normal + p[1] * tangent + 3 * p[13] * left**2 * w / p[3],
        p[1] * normal - p[0] * tangent - p[13] * left**3 * w_y / p[3],
    )


def _k_f(m: Any, x: Any, y: Any, p: Sequence[Any]) -> Any:
    t, r = p[0] * x + p[1] * y - p[2], p[1] * x - p[0] * y
    left, below = m.larger(p[10] - x, 0.0), m.above(0.0, t)
    w = y * (1.0 - y / p[2]) ** 2
    bent = 6.0 * left * w + left**3 * (-4.0 / p[2] + 6.0 * y / p[2] ** 2)
    return p[6] - 2.0 * p[7] * r - 2.0 * p[8] * _k(m, x, y, p) + m.where(below, p[13] * bent, 0.0)


def _k_g(m: Any, x: Any, y: Any, p: Sequence[Any]) -> Any:
    slope = _k_gradient(m, x, y, p)[0]
    return m.where(m.above(x, 0.5), 1.0, -1.0) * _k(m, x, y, p) * slope


def _coefficient_jumps(rng: np.random.Generator, ratio: float) -> Exact:
    level = bool(rng.random() < 0.6)
    line = _line(rng, level)
    n_x, n_y, c = line
    k1, k2 = (1.0, ratio) if rng.random() < 0.5 else (ratio, 1.0)
    f0, B, q, e = rng.uniform(-3, 3), rng.uniform(-1, 1), rng.uniform(-1, 1), rng.uniform(-1, 1)
    x0, kink, Q, P = rng.uniform(0.3, 0.7), rng.choice([0.0, 1.0]), 0.0, 0.0
    if level and rng.random() < 0.5:
        A, B, Q, P = -f0 * c, 0.0, rng.uniform(1, 8), rng.uniform(0.5, 3)
    else:
        if not level:
            q, e = q / ratio, e / ratio
        A = -(1.6 * abs(f0) + 6 * abs(B) + 4 * (abs(q) + abs(e)) * ratio * abs(n_x) + 0.2) / n_y
    kind, data = f"κ jumps 1 : {ratio:.0f} across a line", {"f": _k_f, "g": _k_g, "coefficient": _k}
    parameters = (n_x, n_y, c, k1, k2, A, f0, B, q, P, x0, kink, e, Q)
    return _across(kind, rng, parameters, _k_u, _k_gradient, line, **data)


def coefficient_jumps(rng: np.random.Generator) -> Exact:
    """Κ jumps by 10."""
    return _coefficient_jumps(rng, 10.0)


def coefficient_jumps_far(rng: np.random.Generator) -> Exact:
    """Κ jumps by 1000."""
    return _coefficient_jumps(rng, 1000.0)


# ---- a tent: p = P, w, x0, C, floor. The potential −P (z/(2(z + S)) + ½ log(z + S)), S² = z² − w²


def _root(m: Any, x: Any, y: Any, p: Sequence[Any], beside: bool) -> tuple[Any, Any, Any]:
    """Distance along x from the tent, and both parts of S."""
    X = x - p[2]
    a = X**2 - y**2 - p[1] ** 2
    R = m.sqrt(a**2 + 4.0 * X**2 * y**2)
    if beside:
        real = m.where(m.above(X, 0.0), 1.0, -1.0) * m.sqrt((R + a) / 2)
        return X, real, X * y / real
    imaginary = m.sqrt((R - a) / 2)
    return X, X * y / imaginary, imaginary


def _tent_slope(X: Any, y: Any, S: tuple[Any, Any], P: Any) -> tuple[Any, Any]:
    a, b = X + S[0], y + S[1]
    return -P * a / (a**2 + b**2), -P * b / (a**2 + b**2)


def _tent_of(m: Any, X: Any, y: Any, S: tuple[Any, Any], p: Sequence[Any]) -> Any:
    a, b = X + S[0], y + S[1]
    D = a**2 + b**2
    return p[3] - p[0] * ((X * a + y * b) / (2.0 * D) + m.log(D) / 4.0)


def _tent_both(x: Any, y: Any, p: Sequence[Any]) -> tuple[Any, Any, tuple[Any, Any]]:
    X = np.asarray(x - p[2], dtype=np.float64)
    z = X + 1j * np.asarray(y)
    S = np.sqrt(z - p[1] + 0j) * np.sqrt(z + p[1] + 0j)  # cut between −w and w
    return X, y, (S.real, S.imag)


def _tent_u(m: Any, x: Any, y: Any, p: Sequence[Any]) -> Any:
    X, y, S = _tent_both(x, y, p)
    return _tent_of(m, X, y, S, p)


def _tent_gradient(m: Any, x: Any, y: Any, p: Sequence[Any]) -> tuple[Any, Any]:
    X, y, S = _tent_both(x, y, p)
    return _tent_slope(X, y, S, p[0])


def _tent_obstacle(m: Any, x: Any, y: Any, p: Sequence[Any]) -> Any:
    return m.larger(p[5] - p[0] * (x - p[2]) ** 2 / (2.0 * p[1] ** 2), p[4])


def _tent_dirichlet(m: Any, x: Any, y: Any, p: Sequence[Any]) -> Any:
    X, *S = _root(m, x, y, p, beside=False)
    return _tent_of(m, X, y, (S[0], S[1]), p)


def _tent_g(m: Any, x: Any, y: Any, p: Sequence[Any]) -> Any:
    X, *S = _root(m, x, y, p, beside=True)
    return m.where(m.above(X, 0.0), 1.0, -1.0) * _tent_slope(X, y, (S[0], S[1]), p[0])[0]


def tent(rng: np.random.Generator) -> Exact:
    """A narrow tent pushes from below."""
    P, x0 = float(rng.uniform(0.3, 2)), float(rng.uniform(0.3, 0.7))
    w = float(10 ** rng.uniform(-2.3, -1.5))
    C = float(rng.uniform(-1, 1))
    peak = C - P / 2 * np.log(w)
    floor = C - P * (0.25 + 0.5 * np.log(2.0)) - 0.05 - rng.uniform(0, 0.2)
    return Exact(
        "α a tent narrower than a facet",
        (P, w, x0, C, float(floor), float(peak)),
        FREE,
        _tent_u,
        _tent_gradient,
        _tent_obstacle,
        _tent_dirichlet,
        g=_tent_g,
        corners=((x0 - w, 0.0, w / 64), (x0 + w, 0.0, w / 64)),
    )


# ---- g and u_D that jump or bend at (1, c): p = J, c, K; X = 1 − x, Y = y − c


def _polar(m: Any, x: Any, y: Any, p: Sequence[Any]) -> tuple[Any, Any, Any, Any]:
    """X, Y, log ρ and θ where Y is not 0."""
    X, Y = 1.0 - x, y - p[1]
    turn = m.where(m.above(Y, 0.0), np.pi / 2, -np.pi / 2)
    return X, Y, m.log(X**2 + Y**2) / 2, turn - m.atan(X / Y)


def _polar_numbers(m: Any, x: Any, y: Any, p: Sequence[Any]) -> tuple[Any, Any, Any, Any]:
    """The same inside as well, in numbers only."""
    X, Y = 1.0 - x, y - p[1]
    return X, Y, np.log(np.maximum(np.hypot(X, Y), 1e-300)), np.arctan2(Y, X)


def _formula(value: Callable[..., Any], polar: Callable[..., Any]) -> Formula:
    def formula(m: Any, x: Any, y: Any, p: Sequence[Any]) -> Any:
        return value(m, *polar(m, x, y, p), p) - p[2] * y

    return formula


def _slopes(pair: Callable[..., tuple[Any, Any]]) -> Fields:
    def gradient(m: Any, x: Any, y: Any, p: Sequence[Any]) -> tuple[Any, Any]:
        a, b = pair(m, *_polar_numbers(m, x, y, p), p)
        return -a, b - p[2]

    return gradient


def _beside(right: Callable[..., Any], pair: Callable[..., tuple[Any, Any]]) -> Formula:
    """The flux on the right from one formula, on the left, where X = 1, from the gradient."""

    def flux(m: Any, x: Any, y: Any, p: Sequence[Any]) -> Any:
        Y = y - p[1]
        left = pair(m, 1.0, Y, m.log(1.0 + Y**2) / 2, m.atan(Y), p)[0]
        return m.where(m.above(x, 0.5), right(m, Y, p), left)

    return flux


def _jump(m: Any, X: Any, Y: Any, log: Any, turn: Any, p: Sequence[Any]) -> Any:
    return -p[0] / np.pi * (Y * log + X * turn - Y)


def _jump_slope(m: Any, X: Any, Y: Any, log: Any, turn: Any, p: Sequence[Any]) -> tuple[Any, Any]:
    return -p[0] / np.pi * turn, -p[0] / np.pi * log


def _bend(m: Any, X: Any, Y: Any, log: Any, turn: Any, p: Sequence[Any]) -> Any:
    square = X**2 - Y**2
    return 2.0 * p[0] / np.pi * ((square * log - 2.0 * X * Y * turn) / 2 - square / 4)


def _bend_slope(m: Any, X: Any, Y: Any, log: Any, turn: Any, p: Sequence[Any]) -> tuple[Any, Any]:
    factor = 2.0 * p[0] / np.pi
    return factor * (X * log - Y * turn), -factor * (X * turn + Y * log)


def _power(m: Any, X: Any, Y: Any, log: Any, turn: Any, p: Sequence[Any]) -> Any:
    return -p[0] / 0.6 * m.exp(0.6 * log) * m.cos(0.6 * turn)


def _power_slope(m: Any, X: Any, Y: Any, log: Any, turn: Any, p: Sequence[Any]) -> tuple[Any, Any]:
    size = -p[0] * m.exp(-0.4 * log)
    return size * m.cos(0.4 * turn), size * m.sin(0.4 * turn)


def _at_side(
    kind: str,
    parameters: tuple[float, float, float],
    value: Callable[..., Any],
    pair: Callable[..., tuple[Any, Any]],
    right: Callable[..., Any],
) -> Exact:
    c = parameters[1]
    return Exact(
        kind,
        parameters,
        FREE,
        _formula(value, _polar_numbers),
        _slopes(pair),
        _formula(value, _polar),
        _formula(value, _polar),
        g=_beside(right, pair),
        lines=((0.0, 1.0, c),),
        corners=((1.0, c, 1e-9),),
    )


def flux_jumps(rng: np.random.Generator) -> Exact:
    """G jumps on the right side."""
    J, c = float(rng.uniform(-4, 4)), float(rng.uniform(0.2, 0.8))
    K = abs(J) * (abs(np.log(c)) + 1) / np.pi + 0.1
    return _at_side(
        "g jumps",
        (J, c, float(K)),
        _jump,
        _jump_slope,
        lambda m, Y, p: m.where(m.above(Y, 0.0), p[0] / 2, -p[0] / 2),
    )


def flux_bends(rng: np.random.Generator) -> Exact:
    """G has a kink on the right side."""
    J, c = float(rng.uniform(-6, 6)), float(rng.uniform(0.2, 0.8))
    return _at_side(
        "g has a kink",
        (J, c, 2 * abs(J) + 0.1),
        _bend,
        _bend_slope,
        lambda m, Y, p: p[0] * abs(Y),
    )


def flux_unbounded(rng: np.random.Generator) -> Exact:
    """G = |y − c|^−0.4 on the right side."""
    J, c = float(rng.uniform(-2, 2)), float(rng.uniform(0.2, 0.8))
    return _at_side(
        "g = |y − c|^−0.4",
        (J, c, float(abs(J) * c**-0.4 + 0.1)),
        _power,
        _power_slope,
        lambda m, Y, p: p[0] * np.cos(0.2 * np.pi) * abs(Y) ** -0.4,
    )


def _corner(m: Any, X: Any, Y: Any, log: Any, turn: Any, p: Sequence[Any]) -> Any:
    return -2.0 * p[0] / np.pi * (X * log - Y * turn)


def _corner_slope(m: Any, X: Any, Y: Any, log: Any, turn: Any, p: Sequence[Any]) -> tuple[Any, Any]:
    return -2.0 * p[0] / np.pi * (log + 1.0), 2.0 * p[0] / np.pi * turn


def _corner_dirichlet(m: Any, x: Any, y: Any, p: Sequence[Any]) -> Any:
    Y = y - p[1]
    left = _corner(m, 1.0, Y, m.log(1.0 + Y**2) / 2, m.atan(Y), p)
    return m.where(m.above(x, 0.5), p[0] * abs(Y), left) - p[2] * y


def _corner_g(m: Any, x: Any, y: Any, p: Sequence[Any]) -> Any:
    X, Y = 1.0 - x, y - p[1]
    return 2.0 * p[0] / np.pi * (np.pi / 2 - m.atan(X / Y)) - p[2]


def boundary_bends(rng: np.random.Generator) -> Exact:
    """u_D has a kink on the right side."""
    J, c = float(rng.uniform(-3, 3)), float(rng.uniform(0.2, 0.8))
    return Exact(
        "u_D has a kink",
        (J, c, abs(J) + 0.1),
        GATE,
        _formula(_corner, _polar_numbers),
        _slopes(_corner_slope),
        _formula(_corner, _polar),
        _corner_dirichlet,
        g=_corner_g,
        lines=((0.0, 1.0, c),),
        corners=((1.0, c, 1e-9),),
    )


# ---- load spots: p = n_x, n_y, c, ε, F, K, e


def _ripple(m: Any, x: Any, y: Any, p: Sequence[Any]) -> Any:
    tau = (p[0] * x + p[1] * y - p[2]) / p[3]
    inside = m.smaller(m.larger(tau, -1.0), 1.0)
    height = inside**2 / 2 - inside**4 / 6 + inside**6 / 30
    height = height + 8.0 / 15.0 * (abs(tau) - abs(inside))
    return -p[4] * p[3] ** 2 * height - p[5] * y + p[6] * (x**2 - y**2)


def _ripple_gradient(m: Any, x: Any, y: Any, p: Sequence[Any]) -> tuple[Any, Any]:
    tau = (p[0] * x + p[1] * y - p[2]) / p[3]
    inside = m.smaller(m.larger(tau, -1.0), 1.0)
    slope = -p[4] * p[3] * (inside - 2 * inside**3 / 3 + inside**5 / 5)
    return p[0] * slope + 2 * p[6] * x, p[1] * slope - 2 * p[6] * y - p[5]


def _ripple_f(m: Any, x: Any, y: Any, p: Sequence[Any]) -> Any:
    tau = (p[0] * x + p[1] * y - p[2]) / p[3]
    return p[4] * m.larger(1.0 - tau**2, 0.0) ** 2


def _peak(m: Any, x: Any, y: Any, p: Sequence[Any]) -> Any:
    tau = (p[0] * x + p[1] * y - p[2]) / p[3]
    height = tau * m.atan(tau) - m.log(1.0 + tau**2) / 2
    return -p[4] * p[3] ** 2 * height - p[5] * y + p[6] * (x**2 - y**2)


def _peak_gradient(m: Any, x: Any, y: Any, p: Sequence[Any]) -> tuple[Any, Any]:
    slope = -p[4] * p[3] * m.atan((p[0] * x + p[1] * y - p[2]) / p[3])
    return p[0] * slope + 2 * p[6] * x, p[1] * slope - 2 * p[6] * y - p[5]


def _peak_f(m: Any, x: Any, y: Any, p: Sequence[Any]) -> Any:
    return p[4] / (1.0 + ((p[0] * x + p[1] * y - p[2]) / p[3]) ** 2)


def _strip(rng: np.random.Generator, kind: str, formulas: tuple, marks: Sequence[float]) -> Exact:
    n_x, n_y, c = _line(rng, bool(rng.random() < 0.5))
    epsilon = float(10 ** rng.uniform(-2.5, -1))
    F = float(rng.uniform(0.5, 4) / epsilon * rng.choice([-1, 1]))
    K = 1.6 * abs(F) * epsilon + 0.1
    u, gradient, f = formulas
    return Exact(
        kind,
        (n_x, n_y, c, epsilon, F, K, float(rng.uniform(-0.3, 0.3))),
        HELD,
        u,
        gradient,
        u,
        u,
        f=f,
        lines=tuple((n_x, n_y, c + epsilon * mark) for mark in marks),
    )


def load_strip(rng: np.random.Generator) -> Exact:
    """F lives on a narrow strip."""
    return _strip(rng, "load on a narrow strip", (_ripple, _ripple_gradient, _ripple_f), (-1, 1))


def load_peak(rng: np.random.Generator) -> Exact:
    """F is a narrow rational function."""
    marks = (-64, -32, -16, -8, -4, -2, -1, -0.5, 0, 0.5, 1, 2, 4, 8, 16, 32, 64)
    return _strip(rng, "load a narrow peak", (_peak, _peak_gradient, _peak_f), marks)


# a disc: p = x0, y0, ε, F, K


def _disc_u(m: Any, x: Any, y: Any, p: Sequence[Any]) -> Any:
    s = ((x - p[0]) ** 2 + (y - p[1]) ** 2) / p[2] ** 2
    near = m.smaller(s, 1.0)
    height = near / 4 - near**2 / 8 + near**3 / 36 + m.log(m.larger(s, 1.0)) / 12
    return -p[3] * p[2] ** 2 * height - p[4] * y


def _disc_trace(m: Any, x: Any, y: Any, p: Sequence[Any]) -> Any:
    s = ((x - p[0]) ** 2 + (y - p[1]) ** 2) / p[2] ** 2
    return -p[3] * p[2] ** 2 * (11.0 / 72.0 + m.log(s) / 12) - p[4] * y


def _disc_gradient(m: Any, x: Any, y: Any, p: Sequence[Any]) -> tuple[Any, Any]:
    s = ((x - p[0]) ** 2 + (y - p[1]) ** 2) / p[2] ** 2
    near = np.minimum(s, 1.0)
    over = (0.5 - near / 2 + near**2 / 6) / np.maximum(s, 1.0)  # u' = −F ε² M/r, and M/σ²
    return -p[3] * over * (x - p[0]), -p[3] * over * (y - p[1]) - p[4]


def _disc_f(m: Any, x: Any, y: Any, p: Sequence[Any]) -> Any:
    s = ((x - p[0]) ** 2 + (y - p[1]) ** 2) / p[2] ** 2
    return p[3] * m.larger(1.0 - s, 0.0) ** 2


def load_disc(rng: np.random.Generator) -> Exact:
    """F lives on a small disc, between quadrature points at times."""
    x0, y0 = map(float, rng.uniform(0.2, 0.8, 2))
    epsilon = float(10 ** rng.uniform(-2.5, -1))
    F = float(rng.uniform(1, 10) / epsilon**2 * rng.choice([-1, 1]))
    return Exact(
        "load on a small disc",
        (x0, y0, epsilon, F, float(abs(F) * epsilon**2 / (6 * y0) + 0.05)),
        HELD,
        _disc_u,
        _disc_gradient,
        _disc_trace,
        _disc_trace,
        f=_disc_f,
        corners=tuple(
            (x0 + epsilon * np.cos(t), y0 + epsilon * np.sin(t), epsilon / 12)
            for t in np.linspace(0, 2 * np.pi, 17)[:-1]
        ),
    )


# ---- smooth data: p = A, a, φ, b, β, K, Q, x0, P, _, kink


def _even_derivatives(m: Any, x: Any, y: Any, p: Sequence[Any]) -> tuple[Any, Any, Any, Any]:
    """u, u_x, u_y and Δu."""
    s, c = m.sin(p[1] * x + p[2]), m.cos(p[1] * x + p[2])
    t, d = m.cos(p[3] * y), m.sin(p[3] * y)
    left = m.larger(p[7] - x, 0.0)
    return (
        p[0] * s * t - p[5] * y - p[6] * y * left**3,
        p[0] * p[1] * c * t + 3.0 * p[6] * y * left**2,
        -p[0] * p[3] * s * d - p[5] - p[6] * left**3,
        -p[0] * (p[1] ** 2 + p[3] ** 2) * s * t - 6.0 * p[6] * y * left,
    )


def _even_u(m: Any, x: Any, y: Any, p: Sequence[Any]) -> Any:
    return _even_derivatives(m, x, y, p)[0]


def _even_gradient(m: Any, x: Any, y: Any, p: Sequence[Any]) -> tuple[Any, Any]:
    return _even_derivatives(m, x, y, p)[1:3]


def _even_kappa(m: Any, x: Any, y: Any, p: Sequence[Any]) -> Any:
    return m.exp(p[4] * x)


def _even_f(m: Any, x: Any, y: Any, p: Sequence[Any]) -> Any:
    _, u_x, _, laplace = _even_derivatives(m, x, y, p)
    return -m.exp(p[4] * x) * (laplace + p[4] * u_x)


def _even_g(m: Any, x: Any, y: Any, p: Sequence[Any]) -> Any:
    sign = m.where(m.above(x, 0.5), 1.0, -1.0)
    return sign * m.exp(p[4] * x) * _even_derivatives(m, x, y, p)[1]


def _even_obstacle(m: Any, x: Any, y: Any, p: Sequence[Any]) -> Any:
    right = m.larger(x - p[7], 0.0)
    return p[0] * m.sin(p[1] * x + p[2]) - p[8] * right * (right + p[10])


def smooth(rng: np.random.Generator) -> Exact:
    """Smooth data, integrated by few points."""
    K, Q, P = (rng.uniform(0, 1), 0.0, 0.0) if rng.random() < 0.4 else (0.0, 4.0, 1.0)
    a, b = rng.uniform(1, 12, 2)
    parameters = (rng.uniform(0.2, 1), a, rng.uniform(0, 6), b, rng.uniform(-2, 2), K, Q)
    x0, kink = float(rng.uniform(0.3, 0.7)), float(rng.choice([0.0, 1.0]))
    return Exact(
        "smooth data, quadrature of degree 0, 1 or 2",
        (*map(float, parameters), x0, P, 0.0, kink),
        HELD if rng.random() < 0.5 else FREE,
        _even_u,
        _even_gradient,
        _even_obstacle,
        _even_u,
        f=_even_f,
        g=_even_g,
        coefficient=_even_kappa,
        lines=((1.0, 0.0, x0),),
        degree=int(rng.integers(3)),
    )


def waves(rng: np.random.Generator) -> Exact:
    """F oscillates within cells, as far as the quadrature can see."""
    a, b = rng.uniform(10, 40, 2)
    amplitude, phase, beta = rng.uniform(0.2, 1), rng.uniform(0, 6), rng.uniform(-1, 1)
    return Exact(
        "f oscillates within cells",
        tuple(map(float, (amplitude, a, phase, b, beta, 1.0, 0.0, 0.5, 0.0, 0.0, 0.0))),
        HELD,
        _even_u,
        _even_gradient,
        _even_obstacle,
        _even_u,
        f=_even_f,
        coefficient=_even_kappa,
        lines=tuple((1.0, 0.0, k / 10) for k in range(1, 10))
        + tuple((0.0, 1.0, k / 10) for k in range(1, 10)),
    )


# ---- κ varies slowly: p = n_x, n_y, b, room. Heat flows along n, by 1 per length


def _slow_kappa(m: Any, x: Any, y: Any, p: Sequence[Any]) -> Any:
    return m.exp(p[2] * (p[0] * x + p[1] * y))


def _slow_u(m: Any, x: Any, y: Any, p: Sequence[Any]) -> Any:
    return (1.0 - 1.0 / _slow_kappa(m, x, y, p)) / p[2]


def _slow_gradient(m: Any, x: Any, y: Any, p: Sequence[Any]) -> tuple[Any, Any]:
    flow = 1.0 / _slow_kappa(m, x, y, p)
    return p[0] * flow, p[1] * flow


def _slow_g(m: Any, x: Any, y: Any, p: Sequence[Any]) -> Any:
    return p[1] + 0.0 * x  # on top


def _slow_obstacle(m: Any, x: Any, y: Any, p: Sequence[Any]) -> Any:
    return _slow_u(m, x, y, p) - p[3]


def coefficient_slow(rng: np.random.Generator) -> Exact:
    """Κ varies by a ten-thousandth to a tenth of itself in a cell, and no load hides it."""
    pressed = bool(rng.random() < 0.6)
    angle = float(rng.uniform(-0.9, -0.1)) * np.pi if pressed else 0.0
    b = float(10.0 ** rng.uniform(-3.0, 0.0) * rng.choice([-1, 1]))
    return Exact(
        "κ varies slowly, no load",
        (float(np.cos(angle)), float(np.sin(angle)), b, 0.0 if pressed else 1.0),
        HELD if rng.random() < 0.5 else GATE,
        _slow_u,
        _slow_gradient,
        _slow_obstacle,
        _slow_u,
        g=_slow_g,
        coefficient=_slow_kappa,
    )


CLASSES: dict[Callable[[np.random.Generator], Exact], int] = {
    load_jumps: 150,
    coefficient_jumps: 100,
    coefficient_jumps_far: 100,
    tent: 120,
    flux_jumps: 80,
    flux_bends: 60,
    flux_unbounded: 80,
    boundary_bends: 80,
    load_strip: 80,
    load_peak: 60,
    load_disc: 80,
    smooth: 90,
    waves: 60,
    coefficient_slow: 90,
}
"""Functions that make a problem of each class, and the numbers that are made."""
