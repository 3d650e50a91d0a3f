"""Terms without gradients and several parts of each kind: bounds against errors.

u is a sum of waves, smooth; on each contact part λ = max(s, 0) and u − α = max(−s, 0) with a wave s
along the edge, so that contact begins and ends where s has its zeros; or the same from above; or
both, λ = max(s − m, 0) − max(−s − m, 0), u − α = max(m − s, 0), β − u = max(m + s, 0) up to
factors. g there is what that takes.
All integrals are of smooth functions on triangles and between those zeros, by Gauss's rules.
"""

from __future__ import annotations

import gc
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import product
from typing import Any

import numpy as np
import ufl
from bounds import MISSING, NEARLY, Outcome, Tally
from mpi4py import MPI
from report import Group, Row, told

from signorini_cr import (
    Contact,
    Dirichlet,
    InputError,
    Material,
    Neumann,
    NotConverged,
    Polygon,
    Problem,
    Robin,
    Solution,
    families,
    force,
    solve_adaptive,
    solve_levels,
)

COMM = MPI.COMM_WORLD
SIDES = ("floor", "right", "top", "left")
CORNERS = [[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]]
KINDS = ["contact", "dirichlet", "neumann", "robin"]
NORMALS = np.array([[0.0, -1.0], [1.0, 0.0], [0.0, 1.0], [-1.0, 0.0]])
SIZES = (0.0, 1.0, 1e2, 1e4, 1e6, 1e8)
"""Values of c and b."""
GAP = 0.1
"""Distance of u from the obstacle, in parts of what the pressure is where they touch."""
BETWEEN = 0.3
"""m, in parts of the wave's amplitude."""
MOST = 1.3
"""Bound over error in the energy norm where u is smooth."""


@dataclass(frozen=True)
class Side:
    """Conditions on an edge of the square.

    Attributes:
        kind: "contact", "dirichlet", "neumann" or "robin".
        b: The coefficient.
        external: u_ext.
        wave: Amplitude, frequency and phase of s along the edge.
        bounds: Of a contact part: "lower", "upper" or "both".
        pressed: What λ has beyond the wave, in parts of its amplitude; not between two bounds.
    """

    kind: str
    b: float
    external: float
    wave: tuple[float, float, float]
    bounds: str = "lower"
    pressed: float = 0.0

    @property
    def middle(self) -> float:
        """Value of s up to which λ = 0 between the bounds."""
        return (BETWEEN if self.bounds == "both" else -self.pressed) * self.wave[0]

    def pressure(self, s: Any, largest: Callable[[Any, Any], Any] = np.maximum) -> Any:
        """λ."""
        below = largest(s - self.middle, 0.0) if self.bounds != "upper" else 0.0
        above = largest(-s - self.middle, 0.0) if self.bounds != "lower" else 0.0
        return below - above


class Case:
    """A problem with its solution, for UFL and for NumPy.

    Args:
        rng: What it is drawn by.
    """

    height = 1.0
    """Of the domain, which is 1 wide."""

    def __init__(self, rng: np.random.Generator):
        self.amplitudes, self.phases = rng.uniform(-1, 1, 3), rng.uniform(0, 6, 3)
        self.waves = rng.uniform(-3, 3, (3, 2))
        self.kappa, self.c = float(rng.choice([1.0, 1.0, 1e-2, 1e3])), float(rng.choice(SIZES))
        self.sides = []
        for i in range(4):
            kind = (
                "contact"
                if i == 0
                else str(rng.choice(["contact", "dirichlet", "neumann", "robin"]))
            )
            b = float(rng.choice(SIZES)) if kind in ("contact", "robin") else 0.0
            wave = (
                float(rng.uniform(0.5, 3)) * self.kappa,
                float(rng.uniform(2, 4)),
                float(rng.uniform(0, 6)),
            )
            self.sides.append(Side(kind, b, float(rng.uniform(-1, 1)), wave))
        self.sides = [
            replace(side, bounds=str(rng.choice(["lower", "upper", "both"]))) for side in self.sides
        ]
        held = self.c > 0 or any(s.kind == "dirichlet" or s.b > 0 for s in self.sides)
        if not held:
            self.sides[2] = Side("dirichlet", 0.0, 0.0, (1.0, 1.0, 0.0))

    def u(self, x: Any, y: Any, sin: Callable[[Any], Any] = np.sin) -> Any:
        """U."""
        rows = zip(self.amplitudes, self.waves, self.phases, strict=True)
        return sum(float(a) * sin(float(p) * x + float(q) * y + float(s)) for a, (p, q), s in rows)

    def slope(self, x: Any, y: Any, cos: Callable[[Any], Any] = np.cos) -> tuple[Any, Any]:
        """∇u."""
        rows = list(zip(self.amplitudes, self.waves, self.phases, strict=True))
        common = [float(a) * cos(float(p) * x + float(q) * y + float(s)) for a, (p, q), s in rows]
        return tuple(
            sum(float(wave[axis]) * each for wave, each in zip(self.waves, common, strict=True))
            for axis in (0, 1)
        )  # type: ignore[return-value]

    def f(self, x: Any, y: Any, sin: Callable[[Any], Any] = np.sin) -> Any:
        """−κΔu + c u."""
        rows = zip(self.amplitudes, self.waves, self.phases, strict=True)
        return sum(
            (self.kappa * float(p * p + q * q) + self.c)
            * float(a)
            * sin(float(p) * x + float(q) * y + float(s))
            for a, (p, q), s in rows
        )

    def tensor(self, x: Any, y: Any, sin: Any = np.sin) -> tuple[Any, Any, Any]:
        """κ's entries: both on the diagonal, with the other one between them."""
        return self.kappa, 0.0, self.kappa

    @property
    def coefficient(self) -> Any:
        """κ for UFL."""
        return self.kappa

    def mass(self, x: Any, y: Any, sin: Any = np.sin) -> Any:
        """C."""
        return self.c

    def loss(self, i: int, x: Any, y: Any, sin: Any = np.sin) -> Any:
        """B on an edge."""
        return self.sides[i].b

    def through(self, i: int, x: Any, y: Any, sin: Any = np.sin, cos: Any = np.cos) -> Any:
        """κ∇u·n on an edge."""
        (p, q), (a, b), (xx, xy, yy) = NORMALS[i], self.slope(x, y, cos), self.tensor(x, y, sin)
        return float(p) * (xx * a + xy * b) + float(q) * (xy * a + yy * b)

    def squares(self, a: Any, b: Any, x: Any, y: Any) -> Any:
        """∇w·κ∇w for a function w with the slope (a, b)."""
        xx, xy, yy = self.tensor(x, y)
        return xx * a**2 + 2.0 * xy * a * b + yy * b**2

    def known(self, i: int, x: Any, y: Any, sin: Any = np.sin, cos: Any = np.cos) -> Any:
        """κ∂ₙu + b (u − u_ext), which is g where there is no contact."""
        side = self.sides[i]
        off = self.loss(i, x, y, sin) * (self.u(x, y, sin) - side.external)
        return self.through(i, x, y, sin, cos) + off

    def coefficient_on(self, i: int) -> Any:
        """B on an edge, for a Problem."""
        return self.sides[i].b

    def along(self, i: int, t: Any, sin: Any = np.sin) -> Any:
        """S on an edge."""
        amplitude, frequency, phase = self.sides[i].wave
        return amplitude * sin(frequency * t + phase)

    def problem(self) -> Problem:
        """All data, none derived from u."""

        def on(i: int) -> Any:
            side = self.sides[i]

            def wave(x: Any) -> Any:
                return self.along(i, x[i % 2], ufl.sin)

            def g(x: Any) -> Any:
                return self.known(i, x[0], x[1], ufl.sin, ufl.cos)

            def off(x: Any, sign: float) -> Any:
                apart = ufl.max_value(side.middle - sign * wave(x), 0.0)
                return self.u(x[0], x[1], ufl.sin) - (sign * GAP / self.kappa) * apart

            lossy = {"coefficient": self.coefficient_on(i), "external": side.external}
            if side.kind == "contact":
                return Contact(
                    None if side.bounds == "upper" else lambda x: off(x, 1.0),
                    upper=None if side.bounds == "lower" else lambda x: off(x, -1.0),
                    g=lambda x: g(x) - side.pressure(wave(x), ufl.max_value),
                    **lossy,
                )
            if side.kind == "robin":
                return Robin(g, **lossy)
            if side.kind == "neumann":
                return Neumann(g)
            return Dirichlet(lambda x: self.u(x[0], x[1], ufl.sin))

        return Problem(
            f=lambda x: self.f(x[0], x[1], ufl.sin),
            coefficient=self.coefficient,
            reaction=self.c,
            conditions={name: on(i) for i, name in enumerate(SIDES)},
        )

    def mass_of_square(self) -> float:
        """∫ c u²."""
        t, weights = _gauss(np.linspace(0.0, 1.0, 9))
        x, y = np.meshgrid(t, t)
        return float(weights @ (self.mass(x, y) * self.u(x, y) ** 2) @ weights)

    def energy(self) -> float:
        """J(u), by Gauss's rules on the square and on the edges between the zeros of s."""
        t, weights = _gauss(np.linspace(0.0, 1.0, 9))
        x, y = np.meshgrid(t, self.height * t)
        a, b = self.slope(x, y)
        u = self.u(x, y)
        rest = self.f(x, y) - self.mass(x, y) * u  # smooth
        total = float(weights @ (0.5 * self.squares(a, b, x, y) - rest * u) @ weights)
        total *= self.height
        total -= 0.5 * self.mass_of_square()
        for i, side in enumerate(self.sides):
            if side.kind == "dirichlet":
                continue
            amplitude, frequency, phase = side.wave
            level = np.arcsin(np.clip(side.middle / amplitude, -1.0, 1.0))
            turns = np.arange(-5, 12) * np.pi
            zeros = np.concatenate([turns - level, turns + level]) - phase
            zeros = np.unique(zeros / frequency)
            length = self.height if i % 2 else 1.0
            cuts = np.linspace(0.0, length, 9)
            if side.kind == "contact":
                cuts = np.unique([*cuts, *zeros[(zeros > 0) & (zeros < length)]])
            t, weights = _gauss(cuts)
            x, y = edge(i, t, self.height)
            u, g = self.u(x, y), self.known(i, x, y)
            if side.kind == "contact":
                g = g - side.pressure(self.along(i, t))
            b = self.loss(i, x, y)
            total += float(weights @ (0.5 * b * u**2 - (g + b * side.external) * u))
        return total


class Anisotropic(Case):
    """The same with a turned tensor, up to 10⁴ times as large in one direction, perhaps with waves.

    Args:
        rng: What it is drawn by.
    """

    def __init__(self, rng: np.random.Generator):
        super().__init__(rng)
        angle, ratio = float(rng.uniform(0, np.pi)), 10.0 ** float(rng.uniform(0, 4))
        axis = np.array([np.cos(angle), np.sin(angle)])
        self.still = np.eye(2) + (ratio - 1.0) * np.outer(axis, axis)
        self.wave, self.phase = rng.uniform(-3, 3, 2), float(rng.uniform(0, 6))
        moved = rng.uniform(-0.4, 0.4, (2, 2)) if rng.random() < 0.4 else np.zeros((2, 2))
        self.moved = 0.5 * (moved + moved.T)

    def _entries(self, amount: Any) -> tuple[Any, Any, Any]:
        rows = (self.kappa * float(s) + self.kappa * float(m) * amount for s, m in self._pairs())
        return tuple(rows)  # type: ignore[return-value]

    def _pairs(self) -> list[tuple[float, float]]:
        return [(self.still[i, j], self.moved[i, j]) for i, j in ((0, 0), (0, 1), (1, 1))]

    def tensor(self, x: Any, y: Any, sin: Any = np.sin) -> tuple[Any, Any, Any]:
        """κ's entries."""
        if not self.moved.any():
            return self._entries(0.0)
        return self._entries(sin(float(self.wave[0]) * x + float(self.wave[1]) * y + self.phase))

    @property
    def coefficient(self) -> Any:
        """κ for UFL."""

        def matrix(x: Any) -> Any:
            xx, xy, yy = self.tensor(x[0], x[1], ufl.sin)
            return ufl.as_matrix([[xx, xy], [xy, yy]])

        return matrix

    def f(self, x: Any, y: Any, sin: Callable[[Any], Any] = np.sin) -> Any:
        """−∇·(κ∇u) + c u."""
        cos = np.cos if sin is np.sin else ufl.cos
        xx, xy, yy = self.tensor(x, y, sin)
        rows = zip(self.amplitudes, self.waves, self.phases, strict=True)
        bend = sum(
            (float(p * p) * xx + 2.0 * float(p * q) * xy + float(q * q) * yy + self.c)
            * float(a)
            * sin(float(p) * x + float(q) * y + float(s))
            for a, (p, q), s in rows
        )
        p, q = map(float, self.wave)
        rise = cos(p * x + q * y + self.phase)
        a, b = self.slope(x, y, cos)
        for i, j, slope in ((0, 0, a), (0, 1, b), (1, 0, a), (1, 1, b)):
            bend -= self.kappa * float(self.moved[i, j]) * (p, q)[i] * rise * slope
        return bend


class Layered(Case):
    """The same with κ and c of their own for x > ½; there u oscillates less where κ is larger.

    u is a function of y and of (x − ½) times the smaller κ over κ: it and κ∂u/∂x have no jump.

    Args:
        rng: What it is drawn by.
    """

    def __init__(self, rng: np.random.Generator):
        super().__init__(rng)
        ratio = 10.0 ** float(rng.uniform(0, 4)) if rng.random() < 0.7 else 1.0
        self.kappas = tuple(self.kappa * k for k in ((1.0, ratio), (ratio, 1.0))[rng.integers(2)])
        self.masses = self.c, float(rng.choice([0.0, 1.0, 1e4, 1e8]))

    def _here(self, x: Any, west: Any, east: Any) -> Any:
        if isinstance(x, np.ndarray):
            return np.where(x < 0.5, west, east)
        return ufl.conditional(ufl.lt(x, 0.5), west, east)

    def _place(self, x: Any) -> Any:
        west, east = (self.kappa / k for k in self.kappas)
        return 0.5 + self._here(x, west * (x - 0.5), east * (x - 0.5))

    def u(self, x: Any, y: Any, sin: Callable[[Any], Any] = np.sin) -> Any:
        """U."""
        return super().u(self._place(x), y, sin)

    def slope(self, x: Any, y: Any, cos: Callable[[Any], Any] = np.cos) -> tuple[Any, Any]:
        """∇u."""
        a, b = super().slope(self._place(x), y, cos)
        return a * self._here(x, *(self.kappa / k for k in self.kappas)), b

    def tensor(self, x: Any, y: Any, sin: Any = np.sin) -> tuple[Any, Any, Any]:
        """κ's entries."""
        here = self._here(x, *self.kappas)
        return here, 0.0, here

    def mass(self, x: Any, y: Any, sin: Any = np.sin) -> Any:
        """C."""
        return self._here(x, *self.masses)

    def f(self, x: Any, y: Any, sin: Callable[[Any], Any] = np.sin) -> Any:
        """−∇·(κ∇u) + c u."""
        rows = zip(self.amplitudes, self.waves, self.phases, strict=True)
        along, c = self._place(x), self.mass(x, y)
        across, up = self._here(x, *(self.kappa**2 / k for k in self.kappas)), self.tensor(x, y)[2]
        return sum(
            (float(p * p) * across + float(q * q) * up + c)
            * float(a)
            * sin(float(p) * along + float(q) * y + float(s))
            for a, (p, q), s in rows
        )

    def problem(self) -> Problem:
        """All data, none derived from u."""
        (west, east), (first, second) = self.kappas, self.masses
        materials = {"east": Material(coefficient=east, reaction=second)}
        return replace(super().problem(), coefficient=west, reaction=first, materials=materials)


class Uneven(Case):
    """The same with a c that varies within cells: a wave that may go down to 0, perhaps cut off.

    Args:
        rng: What it is drawn by.
    """

    def __init__(self, rng: np.random.Generator):
        super().__init__(rng)
        self.c = float(rng.choice(SIZES[1:]))
        self.wave, self.phase = rng.uniform(-6, 6, 2), float(rng.uniform(0, 6))
        self.swing = float(rng.uniform(0.1, 1.0))
        self.right = self.c * float(rng.choice([1.0, 1.0, 0.0, 1e-2]))

    def mass(self, x: Any, y: Any, sin: Any = np.sin) -> Any:
        """C: waves everywhere, or a number and waves to the right of a slant line."""
        p, q = map(float, self.wave)
        waves = self.c * (1.0 + self.swing * sin(p * x + q * y + self.phase))
        if self.right == self.c:
            return waves
        if isinstance(x, np.ndarray):
            return np.where(x + 0.3 * y < CUT, waves, self.right)
        return ufl.conditional(ufl.lt(x + 0.3 * y, CUT), waves, self.right)

    def f(self, x: Any, y: Any, sin: Callable[[Any], Any] = np.sin) -> Any:
        """−κΔu + c u."""
        more = self.mass(x, y, sin) - self.c
        return super().f(x, y, sin) + more * self.u(x, y, sin)

    def mass_of_square(self) -> float:
        """∫ c u², on either side of the line."""
        t, weights = _gauss(np.linspace(0.0, 1.0, 9))
        found = 0.0
        for y, weight in zip(t, weights, strict=True):
            middle = CUT - 0.3 * y
            for start, width in ((0.0, middle), (middle, 1.0 - middle)):
                x = start + width * t
                found += weight * width * float(weights @ (self.mass(x, y) * self.u(x, y) ** 2))
        return found

    def problem(self) -> Problem:
        """All data, none derived from u."""
        return replace(super().problem(), reaction=lambda x: self.mass(x[0], x[1], ufl.sin))


class Leaky(Uneven):
    """The same, or c a number, with losses that vary within facets: waves, perhaps down to 0.

    Args:
        rng: What it is drawn by.
    """

    def __init__(self, rng: np.random.Generator):
        super().__init__(rng)
        if rng.random() < 0.5:
            self.swing, self.right = 0.0, self.c
        self.swings = [float(rng.choice([0.0, 1.0, 1.0, rng.uniform(0, 1)])) for _ in range(4)]
        self.ripples = rng.uniform(-9, 9, 4), rng.uniform(0, 6, 4)

    def loss(self, i: int, x: Any, y: Any, sin: Any = np.sin) -> Any:
        """B (1 + a wave along the edge)."""
        along, (frequencies, phases) = y if i % 2 else x, self.ripples
        wave = sin(float(frequencies[i]) * along + float(phases[i]))
        return self.sides[i].b * (1.0 + self.swings[i] * wave)

    def coefficient_on(self, i: int) -> Any:
        """B on an edge, for a Problem."""
        if not self.sides[i].b * self.swings[i]:
            return self.sides[i].b
        return lambda x: self.loss(i, x[0], x[1], ufl.sin)


class Waving(Leaky):
    """The same with a coefficient that varies within cells: waves."""

    def __init__(self, rng: np.random.Generator):
        super().__init__(rng)
        self.beats, self.beat = rng.uniform(-9, 9, 2), float(rng.uniform(0, 6))
        self.depth = float(rng.uniform(0.1, 0.9))

    def _rise(self, x: Any, y: Any, sin: Any) -> Any:
        p, q = map(float, self.beats)
        return self.depth * sin(p * x + q * y + self.beat)

    def tensor(self, x: Any, y: Any, sin: Any = np.sin) -> tuple[Any, Any, Any]:
        """κ's entries."""
        here = self.kappa * (1.0 + self._rise(x, y, sin))
        return here, 0.0, here

    @property
    def coefficient(self) -> Any:
        """κ for UFL."""
        return lambda x: self.tensor(x[0], x[1], ufl.sin)[0]

    def f(self, x: Any, y: Any, sin: Callable[[Any], Any] = np.sin) -> Any:
        """−∇·(κ∇u) + c u."""
        cos = np.cos if sin is np.sin else ufl.cos
        mass, (a, b) = self.mass(x, y, sin) * self.u(x, y, sin), self.slope(x, y, cos)
        p, q = map(float, self.beats)
        bend = (1.0 + self._rise(x, y, sin)) * (super().f(x, y, sin) - mass)
        return bend - self.kappa * self._rise(x, y, cos) * (p * a + q * b) + mass


CUT = 0.55
"""Place where the line that cuts c off meets y = 0."""


class Alone(Case):
    """Contact presses on one to four edges, nothing else holds u.

    Args:
        rng: What it is drawn by.
    """

    def __init__(self, rng: np.random.Generator):
        pressed = False
        while not pressed:
            super().__init__(rng)
            self.c = 0.0
            kinds = ["contact" if side.kind == "contact" else "neumann" for side in self.sides]
            bounds = str(rng.choice(["lower", "upper"]))
            self.sides = [
                replace(side, kind=kind, b=0.0, bounds=bounds)
                for side, kind in zip(self.sides, kinds, strict=True)
            ]
            forces = [exact_flux(self, i) for i, kind in enumerate(kinds) if kind == "contact"]
            pressed = abs(sum(forces)) > 0.1 * self.kappa


class OneHolds(Layered):
    """A reaction on one side of x = ½ holds all.

    Args:
        rng: What it is drawn by.
    """

    def __init__(self, rng: np.random.Generator):
        super().__init__(rng)
        c = float(rng.choice([1e-2, 1.0, 1e4, 1e8]))
        self.masses = ((c, 0.0), (0.0, c))[rng.integers(2)]
        self.sides = [
            replace(
                side, kind="neumann" if side.kind in ("dirichlet", "robin") else side.kind, b=0.0
            )
            for side in self.sides
        ]


class Flat(Case):
    """No reaction and no loss, in a strip of one to three layers of cells that are wide and low.

    In half of the cases v is all but known: one layer; u is a cubic, touches the floor all along,
    with a cubic for a pressure, and is given on the other sides.

    Args:
        rng: What it is drawn by.
    """

    def __init__(self, rng: np.random.Generator):
        super().__init__(rng)
        self.c, self.held = 0.0, bool(rng.random() < 0.5)
        self.columns = int(rng.integers(1, 5) if self.held else rng.integers(2, 9))
        self.layers, self.levels = (1, 1) if self.held else map(int, rng.integers(1, (4, 3)))
        self.height = self.layers / self.columns / float(rng.uniform(8, 60))
        self.cubic = rng.uniform(-1, 1, 5)
        kinds = ["neumann" if side.kind == "robin" else side.kind for side in self.sides]
        if self.held:
            kinds[1:] = 3 * ["dirichlet"]
        elif "dirichlet" not in kinds:
            kinds[2] = "dirichlet"
        self.sides = [
            replace(side, kind=kind, b=0.0) for side, kind in zip(self.sides, kinds, strict=True)
        ]
        if self.held:
            bounds = str(rng.choice(["lower", "upper"]))
            self.sides[0] = replace(self.sides[0], pressed=33.0, bounds=bounds)

    def along(self, i: int, t: Any, sin: Any = np.sin) -> Any:
        """S on an edge: a cubic below."""
        if not self.held or i:
            return super().along(i, t, sin)
        z = 2.0 * t - 1.0
        return 30.0 * self.sides[0].wave[0] * z * (4.0 * z**2 - 3.0)

    def u(self, x: Any, y: Any, sin: Callable[[Any], Any] = np.sin) -> Any:
        """U."""
        if not self.held:
            return super().u(x, y, sin)
        a, b, c, d, e = map(float, self.cubic)
        return a + x * (b + x * (c + d * x)) + e * y

    def slope(self, x: Any, y: Any, cos: Callable[[Any], Any] = np.cos) -> tuple[Any, Any]:
        """∇u."""
        if not self.held:
            return super().slope(x, y, cos)
        _, b, c, d, e = map(float, self.cubic)
        return b + x * (2.0 * c + 3.0 * d * x), e + 0.0 * y

    def f(self, x: Any, y: Any, sin: Callable[[Any], Any] = np.sin) -> Any:
        """−κΔu."""
        if not self.held:
            return super().f(x, y, sin)
        return -self.kappa * (2.0 * float(self.cubic[2]) + 6.0 * float(self.cubic[3]) * x)


EAST = [[0.5, 0.0], [1.0, 0.0], [1.0, 1.0], [0.5, 1.0]]


def _gauss(cuts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Ten points between any two of the cuts."""
    x, w = np.polynomial.legendre.leggauss(10)
    start, length = cuts[:-1, None], np.diff(cuts)[:, None]
    return (start + 0.5 * (x + 1.0) * length).ravel(), (0.5 * w * length).ravel()


def distances(solution: Solution, case: Case) -> tuple[float, float]:
    """Errors in H1 and in the energy norm; collective."""
    mesh, V = solution.domain.mesh, solution.u.function_space
    cells = mesh.topology.index_map(2).size_local
    corner = mesh.geometry.x[mesh.geometry.dofmap[:cells], :2]
    at_facets = solution.u.x.array[V.dofmap.list[:cells]]  # facet i is opposite vertex i
    values = at_facets.sum(axis=1, keepdims=True) - 2.0 * at_facets
    edges = corner[:, 1:] - corner[:, :1]
    rise = values[:, 1:] - values[:, :1]
    slope = np.linalg.solve(edges, rise[..., None])[..., 0]
    area = 0.5 * np.abs(np.linalg.det(edges))
    x, w = np.polynomial.legendre.leggauss(7)
    s, t = np.meshgrid(0.5 * (x + 1.0), 0.5 * (x + 1.0))
    first, second = s.ravel(), (t * (1.0 - s)).ravel()  # a square, collapsed to the triangle
    weights = 0.5 * np.outer(w, w).ravel() * (1.0 - first)
    hats = np.stack([1.0 - first - second, first, second])
    points = np.einsum("qc,nck->nqk", hats.T, corner)
    here = points[..., 0], points[..., 1]
    a, b = (exact - own for exact, own in zip(case.slope(*here), slope.T[..., None], strict=True))
    off = (case.u(*here) - values @ hats) ** 2
    h1 = float(area @ ((a**2 + b**2) @ weights))
    whole = float(area @ ((case.squares(a, b, *here) + case.mass(*here) * off) @ weights))
    t, w = 0.5 * (x + 1.0), 0.5 * w
    for i, side in enumerate(case.sides):
        if side.b == 0.0:
            continue
        assert case.height == 1.0
        here = np.abs(corner @ NORMALS[i] - (NORMALS[i].sum() > 0)) < 1e-9
        for j in range(3):
            on = np.flatnonzero(here[:, (j + 1) % 3] & here[:, (j + 2) % 3])
            p, q = corner[on, (j + 1) % 3], corner[on, (j + 2) % 3]
            up, uq = values[on, (j + 1) % 3], values[on, (j + 2) % 3]
            z = p[:, None] + t[:, None] * (q - p)[:, None]
            gap = case.u(z[..., 0], z[..., 1]) - (up[:, None] + t * (uq - up)[:, None])
            b = case.loss(i, z[..., 0], z[..., 1])
            whole += float(np.linalg.norm(q - p, axis=1) @ ((b * gap**2) @ w))
    h1, whole = mesh.comm.allreduce(np.array([h1, whole]))
    return float(np.sqrt(h1)), float(np.sqrt(whole))


def judge(solution: Solution, case: Case) -> Outcome:
    """Compare what the certificate says with what is so; collective."""
    certificate = solution.certificate
    if certificate.bound_h1 is None or certificate.bound_energy_norm is None:
        return Outcome(reason=certificate.reason or "no reason given")
    assert certificate.energy is not None
    (h1, whole), (low, high), J = distances(solution, case), certificate.energy, case.energy()
    outside = max(low - J, J - high) - NEARLY * max(abs(J), abs(low), abs(high))
    return Outcome(
        certificate.bound_energy_norm / whole,
        certificate.bound_h1 / h1,
        outside / max(high - low, 1e-300),
    )


def solved(case: Case, rng: np.random.Generator) -> Solution:
    """On one of several kinds of meshes; collective."""
    if isinstance(case, Flat):
        shape = np.array([1.0, case.layers / case.columns])
        squares = Polygon(np.array(CORNERS) * shape, SIDES, names=SIDES)
        domain = families.structured(squares, case.columns, COMM)
        domain.mesh.geometry.x[:, 1] *= case.height / shape[1]
        *_, solution = solve_levels(case.problem(), domain, case.levels)
        return solution
    layered = isinstance(case, Layered)
    polygon = Polygon(CORNERS, SIDES, names=SIDES, materials={"east": EAST} if layered else {})
    kind, levels = str(rng.choice(["structured", "gmsh", "adaptive"])), int(rng.integers(1, 4))
    if kind == "structured" and layered:
        kind = "gmsh"
    if kind == "structured":
        domain = families.structured(polygon, int(rng.integers(4, 12)), COMM)
    else:
        domain = polygon.mesh(float(rng.uniform(0.1, 0.3)), COMM)
    if kind == "adaptive":
        *_, solution = solve_adaptive(case.problem(), domain, levels=3)
    else:
        *_, solution = solve_levels(case.problem(), domain, levels)
    return solution


def smooth(c: float, b: float, bounds: str | None = None) -> Case:
    """U smooth: a Robin condition on the right, Dirichlet conditions on two sides.

    Below there is no contact, or with bounds there is, and a loss of heat with the same b.
    """
    case = Case(np.random.default_rng(7))
    case.amplitudes, case.phases = np.array([1.0, 0.5, 0.3]), np.array([1.0, 0.4, 2.0])
    case.waves = np.array([[2.0, 1.0], [-1.0, 2.0], [1.0, 1.5]])
    case.kappa, case.c = 1.0, c
    wave = (1.0, 1e-9, -1.0)  # s < 0: u is above the obstacle, and no force acts
    case.sides = [
        Side("contact", 0.0, 0.0, wave),
        Side("robin", b, 0.3, wave),
        Side("dirichlet", 0.0, 0.0, wave),
        Side("dirichlet", 0.0, 0.0, wave),
    ]
    if bounds is not None:
        case.sides[0] = Side("contact", b, 0.3, (2.0, 3.0, 1.0), bounds)
    return case


def edge(i: int, t: Any, height: float = 1.0) -> tuple[Any, Any]:
    """Points of an edge, t from 0 to its length."""
    zero, one = np.zeros_like(t), np.ones_like(t)
    return ((t, zero), (one, t), (t, height * one), (zero, t))[i]


def exact_flux(case: Case, i: int, weight: Callable[[Any], Any] = np.ones_like) -> float:
    """∫ λ w on a contact edge, ∫ κ∂ₙu w on another, so finely that kinks do not count."""
    side = case.sides[i]
    t, weights = _gauss(np.linspace(0.0, 1.0, 4001))
    weights = weights * weight(t)
    if side.kind == "contact":
        return float(weights @ side.pressure(case.along(i, t)))
    return float(weights @ case.through(i, *edge(i, t)))


def apart(rng: np.random.Generator, draw: type[Case] = Case) -> Case:
    """Contact below, contact or Dirichlet's condition above, others between them."""
    case = draw(rng)
    kind = str(rng.choice(["robin", "neumann"]))
    b = float(rng.choice(SIZES)) if kind == "robin" else 0.0
    floor, right, top, left = case.sides
    top = replace(top, kind=str(rng.choice(["contact", "dirichlet"])))
    if top.kind == "dirichlet":
        top = replace(top, b=0.0)
    sides = [floor, replace(right, kind=kind, b=b), top, replace(left, kind=kind, b=b)]
    held = case.c > 0 or any(side.kind == "dirichlet" or side.b > 0 for side in sides)
    case.sides = sides if held else [*sides[:2], replace(top, kind="dirichlet"), sides[3]]
    return case


def settled(rng: np.random.Generator, draw: type[Case] = Case) -> Case:
    """The same, with contact everywhere on a part or nowhere."""
    case = apart(rng, draw)
    case.sides = [
        replace(
            side, wave=(side.wave[0], 1e-9, float(rng.choice([-1.0, 1.0]) * rng.uniform(0.5, 1.5)))
        )
        for side in case.sides
    ]
    return case


REFERENCE = "u in closed form, written anew; Gauss's rules on triangles and edges"


DRAWN = "c and b up to 1e8, one to four contact parts, bounds on either side"
TENSORS = "the same with κ a tensor, its eigenvalues up to 1 : 10⁴, in two fifths with waves"

ALONE = "contact alone holds u, on one to four edges"
ONE_HOLDS = "a reaction in one half, up to 1e8, and no Γ0"
FLAT = "no c, no b: strips of cells 8 to 60 times as wide as high"
FLUXES = "Forces and fluxes of parts, c and b up to 1e8, contact anywhere"
SETTLED = "Forces and fluxes of parts, c and b up to 1e8, contact everywhere or nowhere"
WEIGHTED = "The same with weights of either sign, also where contact and Dirichlet parts meet"
WEIGHTED_SETTLED = "The same with weights where contact is everywhere or nowhere"
MEANS = "Means of parts and of the domain"
INTEGRALS = "Integrals and means with weights, of parts, materials and the domain"
UNEVEN = "the same with c that varies within cells: waves, down to 0 or cut off along a slant line"
LEAKY = "the same with b that varies within facets, waves, down to 0 as well; c may vary, too"
VARYING = "All of these where κ, a tensor at times, c and b vary within cells: waves"
LAYERS = "the same with κ, up to 1 : 10⁴, and c, up to 1e8 or 0, of their own left and right"


def _drawn(seed: int, number: int, kind: type[Case], name: str) -> Row:
    tally = Tally()
    for k in range(number):
        rng = np.random.default_rng((seed, k, 77))
        case = kind(rng)
        try:
            outcome = judge(solved(case, rng), case)
        except (InputError, NotConverged) as error:  # the same on all ranks
            outcome = Outcome(reason=str(error))
        tally.add(outcome, f"case {k} of seed {seed}")
        if k % 10 == 9:
            gc.collect()  # meshes hang in circles
    return tally.row(name, REFERENCE)


Found = Iterator[tuple[str, force.Interval, float]]
"""The quantities asked for, each with its interval and the exact number."""


def _intervals(
    name: str,
    seed: int,
    number: int,
    row: int,
    draw: Callable[[np.random.Generator], Case],
    found: Callable[[Case, Solution, np.random.Generator], Found],
) -> Row:
    """Tell whether the exact numbers of some cases are in their intervals."""
    count, none, misses = 0, 0, []
    for k in range(number):
        rng = np.random.default_rng((seed, k, row))
        case = draw(rng)
        try:
            intervals = list(found(case, solved(case, rng), rng))
        except (InputError, NotConverged):  # the same on all ranks
            none += 1
            continue
        for what, interval, exact in intervals:
            count += 1
            slack = NEARLY * max(abs(exact), abs(interval.value))
            if not interval.lower - slack <= exact <= interval.upper + slack:
                misses.append(f"case {k} of seed {seed}, {what}: {exact:g} is not in {interval}")
        if k % 10 == 9:
            gc.collect()
    if none > MISSING * number:
        misses.append(f"{none} cases have no intervals")
    measured = f"{len(misses)} intervals that miss; {none} of {number} cases without any"
    return Row(name, count, measured, REFERENCE, misses)


def _fluxes(case: Case, solution: Solution, rng: np.random.Generator) -> Found:
    for i in (0, 2):
        yield SIDES[i], solution.flux(SIDES[i]), exact_flux(case, i)


def varying(rng: np.random.Generator) -> Case:
    """A case in which κ, c or b vary within cells, and parts that keep clear of one another."""
    kind = (Waving, Waving, Leaky, Anisotropic)[rng.integers(4)]
    return (apart, settled)[rng.integers(2)](rng, kind)


def _all_of_them(case: Case, solution: Solution, rng: np.random.Generator) -> Found:
    yield from _fluxes(case, solution, rng)
    yield from _weighted_fluxes(case, solution, rng)
    yield from _means(case, solution, rng)


def mixed(rng: np.random.Generator) -> Case:
    """A case of any kind, with κ constant on each cell."""
    kind = (Case, Layered, Anisotropic)[rng.integers(3)]
    case = kind(rng)
    if isinstance(case, Anisotropic):
        case.moved = np.zeros((2, 2))
    return case


@dataclass(frozen=True)
class Weight:
    """A wave of either sign, perhaps 0 where its first coordinate is 0 or 1.

    Attributes:
        wave: Its frequencies and phase.
        base: What is added.
        zeros: Whether it is 0 at 0, and at 1.
    """

    wave: tuple[float, ...]
    base: float
    zeros: tuple[bool, bool] = (False, False)

    @classmethod
    def drawn(cls, rng: np.random.Generator, *zeros: bool) -> Weight:
        """By chance."""
        wave, base = tuple(map(float, rng.uniform(-4, 4, 3))), float(rng.uniform(-0.8, 0.8))
        return cls(wave, base, zeros or (False, False))  # type: ignore[arg-type]

    def __call__(self, x: Any, y: Any = 0.0, sin: Any = np.sin) -> Any:
        """Its values."""
        p, q, shift = self.wave
        rise = (x if self.zeros[0] else 1.0) * (1.0 - x if self.zeros[1] else 1.0)
        return rise * (sin(p * x + q * y + shift) + self.base)

    def along(self, axis: int) -> Callable[[Any], Any]:
        """For UFL, as a function of one coordinate."""
        return lambda x: self(x[axis], 0.0, ufl.sin)

    def plane(self, x: Any) -> Any:
        """For UFL, as a function of both."""
        return self(x[0], x[1], ufl.sin)


def _weighted_fluxes(case: Case, solution: Solution, rng: np.random.Generator) -> Found:
    """Each with a weight that is 0 at the ends at which another such part begins."""
    held = [side.kind in ("contact", "dirichlet") for side in case.sides]
    for i, name in enumerate(SIDES):
        if held[i]:
            weight = Weight.drawn(rng, held[(3, 0, 3, 0)[i]], held[(1, 2, 1, 2)[i]])
            interval = solution.flux(name, weight=weight.along(i % 2))
            yield name, interval, exact_flux(case, i, weight)


Function = Callable[[Any, Any], Any]


def exact_integral(place: int | str | None, *factors: Function) -> float:
    """The integral of a product over an edge, the right half or the square."""
    t, weights = _gauss(np.linspace(0.0, 1.0, 9))

    def together(x: Any, y: Any) -> Any:
        return np.prod([factor(x, y) + 0.0 * x for factor in factors], axis=0)

    if isinstance(place, int):
        return float(weights @ together(*edge(place, t)))
    width = 0.5 if place == "east" else 1.0
    return width * float(weights @ together(*np.meshgrid(1.0 - width * (1.0 - t), t)) @ weights)


def _places(case: Case) -> list[int | str | None]:
    loose = [i for i, side in enumerate(case.sides) if side.kind != "dirichlet"]
    return [None, *(["east"] if isinstance(case, Layered) else []), *loose]


def _named(place: int | str | None) -> str | None:
    return SIDES[place] if isinstance(place, int) else place


def _means(case: Case, solution: Solution, rng: np.random.Generator) -> Found:
    for place in _places(case):
        exact = exact_integral(place, case.u) / exact_integral(place, lambda x, y: 1.0)
        yield str(place), solution.mean(_named(place)), exact


def _integrals(case: Case, solution: Solution, rng: np.random.Generator) -> Found:
    """Means with what is above 0."""
    for place in _places(case):
        weight = Weight.drawn(rng)
        found = solution.integral(_named(place), weight.plane)
        yield f"integral over {place}", found, exact_integral(place, case.u, weight)
        weight = replace(weight, base=1.5)
        found = solution.mean(_named(place), weight.plane)
        exact = exact_integral(place, case.u, weight) / exact_integral(place, weight)
        yield f"mean over {place}", found, exact


def _smooth(levels: int, bounds: str | None) -> Row:
    tally, most, failed = Tally(), 0.0, []
    for c, b in product((0.0, 1.0, 1e4, 1e8), repeat=2):
        case = smooth(c, b, bounds)
        domain = Polygon(CORNERS, SIDES, names=SIDES).mesh(0.25, COMM)
        try:
            for solution in solve_levels(case.problem(), domain, levels):
                outcome = judge(solution, case)
                most = max(most, outcome.energy_norm)
                tally.add(outcome, f"c = {c:g}, b = {b:g}")
        except NotConverged as error:  # the same on all ranks
            failed.append(f"c = {c:g}, b = {b:g}: {error}")
    row = tally.row(SMOOTH[bounds], REFERENCE)
    row.failures.extend(failed)
    if not most <= MOST:
        row.failures.append(f"the bound is {most:.3f} of the error")
    return row


SMOOTH = {
    bounds: f"u smooth, {where}, c and b up to 1e8: bound at most {MOST} of the error"
    for bounds, where in (
        (None, "no contact"),
        ("lower", "contact from below"),
        ("upper", "contact from above"),
        ("both", "contact from both sides"),
    )
}


def terms(seed: int, quick: bool) -> Group:
    """Seeded cases over all terms and conditions."""
    return Group(
        "terms",
        "Reaction, loss of heat, several parts",
        "−∇·(κ∇u) + c u = f on the unit square, each edge a part of its own: Dirichlet, Neumann, "
        "Robin, or contact from below, from above or both, with a flux or a loss of heat of its "
        "own. Passed: no bound below the error in either norm, J(u) inside its bracket, at most "
        f"{MISSING:.0%} without bounds.",
        [
            told(_drawn(seed, 4 if quick else 500, Case, DRAWN)),
            told(_drawn(seed, 2 if quick else 150, Anisotropic, TENSORS)),
            told(_drawn(seed, 2 if quick else 150, Layered, LAYERS)),
            told(_drawn(seed, 2 if quick else 150, Uneven, UNEVEN)),
            told(_drawn(seed, 1 if quick else 60, Leaky, LEAKY)),
            told(_drawn(seed, 2 if quick else 60, Alone, ALONE)),
            told(_drawn(seed, 2 if quick else 60, OneHolds, ONE_HOLDS)),
            told(_drawn(seed, 2 if quick else 100, Flat, FLAT)),
            *(
                told(_smooth(1 if quick else 4, bounds))
                for bounds in (None, "lower", "upper", "both")
            ),
        ],
    )


def quantities(seed: int, quick: bool) -> Group:
    """Check fluxes through parts, and integrals, of such problems."""
    return Group(
        "quantities",
        "Forces, fluxes, means and integrals",
        "Of problems like those above. Passed: each is inside its interval, and at most "
        f"{MISSING:.0%} of the cases are without any.",
        [
            told(_intervals(FLUXES, seed, 2 if quick else 100, 78, apart, _fluxes)),
            told(_intervals(SETTLED, seed, 2 if quick else 100, 78, settled, _fluxes)),
            told(_intervals(WEIGHTED, seed, 2 if quick else 50, 80, mixed, _weighted_fluxes)),
            told(
                _intervals(
                    WEIGHTED_SETTLED, seed, 2 if quick else 50, 83, settled, _weighted_fluxes
                )
            ),
            told(_intervals(MEANS, seed, 1 if quick else 50, 79, Case, _means)),
            told(_intervals(INTEGRALS, seed, 1 if quick else 50, 81, mixed, _integrals)),
            told(_intervals(VARYING, seed, 1 if quick else 60, 82, varying, _all_of_them)),
        ],
    )
