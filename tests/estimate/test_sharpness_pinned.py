"""Sharpness of bounds, brackets and intervals on small problems: no looser, and no sharper.

The figures in `TODAY` are those of today. Looser ones break a promise; sharper ones are good news
or a mistake, and either is to be looked at before it is taken for the new figure. What they are
compared with is known in closed form and integrated by `verification/`, which shares no code with
the certificate.

    container/run python3 tests/estimate/test_sharpness_pinned.py

prints the table as it would have to be now.
"""

import sys
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from dolfinx.mesh import (
    create_rectangle,
    locate_entities,
    meshtags,
)
from helpers import tagged
from mpi4py import MPI

sys.path[:0] = [str(Path(__file__).parent.parent), str(Path(__file__).parents[2] / "verification")]

import bounds  # noqa: E402
import manufactured  # noqa: E402
import terms  # noqa: E402
from terms import SIDES, Side, Weight  # noqa: E402

from signorini_cr import (  # noqa: E402
    Contact,
    Dirichlet,
    Domain,
    Neumann,
    Problem,
    solve,
    solve_adaptive,
)

pytestmark = pytest.mark.slow

WORLD = MPI.COMM_WORLD
WITHIN, OF_INTERVALS = 5e-4, 3e-3
"""Relative changes that figures may have; the intervals' hang on dual solutions, not converged."""
SLACK = 1e-9
"""Errors that the exact figures may have, relative."""


def grid(columns, rows, layered):
    """The unit square, from rectangles cut in two; from x = ½ on it may be of another material."""
    mesh = create_rectangle(WORLD, [(0.0, 0.0), (1.0, 1.0)], [columns, rows])

    def sides(x, y):
        return np.select([y < 1e-9, x > 1 - 1e-9, y > 1 - 1e-9], [1, 2, 3], 4)

    tags = tagged(mesh, sides)
    more = {name: i + 1 for i, name in enumerate(SIDES)}
    if layered:
        east = locate_entities(mesh, 2, lambda x: x[0] > 0.5 - 1e-9)
        kinds = meshtags(mesh, 2, east, np.full(len(east), 7, dtype=np.int32))
        more |= {"cell_tags": kinds, "materials": {"east": 7}}
    return Domain.from_tags(mesh, tags, **more)


# ---- problems; sides are floor, right, top, left

BEGINS, PRESSED, OFF = (2.0, 3.0, 1.0), (1.0, 1e-9, 1.0), (1.0, 1e-9, -1.0)
"""The wave s on a contact part: contact ends at 0.71, is everywhere, or nowhere."""
GIVEN, FREE = (Side(kind, 0.0, 0.0, OFF) for kind in ("dirichlet", "neumann"))
BESIDE = FREE, GIVEN, FREE
WAVE = Weight((2.0, 1.0, 0.4), 0.3, (True, True))
"""A weight that vanishes at the ends of edges; OPEN is of either sign there, too."""
OPEN = replace(WAVE, zeros=(False, False))


def contact(bounds="lower", b=0.0, wave=BEGINS):
    return Side("contact", b, 0.3, wave, bounds)


def robin(b):
    return Side("robin", b, 0.3, OFF)


def case(kind, *sides, **more):
    """A case of `verification/terms.py` with nothing left to chance."""
    made = kind(np.random.default_rng(0))
    waves = {"amplitudes": [1.0, 0.5, 0.3], "phases": [1.0, 0.4, 2.0], "kappa": 1.0, "c": 0.0}
    waves["waves"] = [[2.0, 1.0], [-1.0, 2.0], [1.0, 1.5]]
    for name, value in (waves | more).items():
        assert hasattr(made, name)
        setattr(made, name, np.array(value) if isinstance(value, list) else value)
    made.sides = [*sides, *[GIVEN] * (4 - len(sides))]
    return made


QUICK = {"waves": [[6.0, 1.0], [-4.0, 5.0], [3.0, 7.0]]}
EVEN = {"wave": [5.0, 2.0], "phase": 0.3, "swing": 0.0}
UNEVEN = EVEN | {"swing": 0.9}
LEAKY = {"swings": [1.0, 0.8, 0.5, 0.0], "ripples": ([7.0, 5.0, 3.0, 0.0], [0.5, 1.0, 2.0, 0.0])}
BEATS = {"beats": [3.0, 2.0], "beat": 0.5, "depth": 0.4, "right": 0.0} | EVEN | LEAKY
TENSOR = {"still": [[3.0, 1.0], [1.0, 1.0]], "moved": np.zeros((2, 2))}
MOVED = TENSOR | {"moved": [[0.3, 0.1], [0.1, -0.1]], "wave": [1.0, -2.0], "phase": 0.7}
LAYERS = {"kappas": (1.0, 30.0), "masses": (2.0, 2e3)}
P, C, A = terms.Case, terms.Uneven, terms.Anisotropic


def jumping_load(*boundary):
    """f jumps on a slant line inside cells, and g has a kink on it; pressed all along."""
    n, m, at = manufactured, (0.6, 0.8), 0.43
    first, second, rise, pressure = 6.0, -4.0, 0.7, 12.0
    parameters = (*m, at, first, second, rise, pressure, 0.3, 0.0, 0.0, 0.0, 0.0)
    u, slope = n._f_u, n._f_gradient

    def g(m, x, y, p):
        along, up = slope(m, x, y, p)
        return m.where(m.above(y, 1 - 1e-9), up, m.where(m.above(x, 0.5), 1.0, -1.0) * along)

    return n.Exact("", parameters, boundary, u, slope, u, u, n._f_f, g, lines=((*m, at),))


def on_parts(made, domain):
    """The problem with a condition for each side, of which none has to be Γ0."""
    data = made.problem(domain)
    kinds = {
        "contact": Contact(data.obstacle),
        "dirichlet": Dirichlet(data.dirichlet),
        "neumann": Neumann(data.g),
    }
    conditions = {side: kinds[kind] for side, kind in zip(SIDES, made.boundary, strict=True)}
    return Problem(f=data.f, coefficient=data.coefficient, conditions=conditions)


@dataclass(frozen=True)
class Small:
    """A problem, its mesh, and what is asked for.

    Attributes:
        made: With the solution.
        columns: Rectangles in a row.
        rows: How many rows of them; 0 for as many.
        asked: "flux" or "weighted", and an edge; "integral", and an edge, a material or nothing.
        levels: Meshes, all but the first of which are adapted.
    """

    made: terms.Case | manufactured.Exact
    columns: int = 6
    rows: int = 0
    asked: tuple[str, ...] = ()
    levels: int = 1

    def solution(self):
        """u_h; collective."""
        layered = isinstance(self.made, terms.Layered)
        domain = grid(self.columns, self.rows or self.columns, layered)
        problem = self.made.problem() if isinstance(self.made, P) else on_parts(self.made, domain)
        if self.levels == 1:
            return solve(problem, domain)
        return list(solve_adaptive(problem, domain, levels=self.levels))[-1]

    def exact(self, solution):
        """Errors in H1 and in the energy norm, J(u); collective."""
        if isinstance(self.made, P):
            return *terms.distances(solution, self.made), self.made.energy()
        return bounds.distances(solution, self.made)[:3]

    def interval(self, solution, what):
        """An interval, and the exact figure; collective."""
        kind, _, place = what.partition(" ")
        edge = SIDES.index(place) if place in SIDES else place or None
        if kind == "flux":
            return solution.flux(place), terms.exact_flux(self.made, edge)
        if kind == "weighted":
            found = solution.flux(place, weight=WAVE.along(edge % 2))
            return found, terms.exact_flux(self.made, edge, WAVE)
        found = solution.integral(place or None, OPEN.plane)
        return found, terms.exact_integral(edge, self.made.u, OPEN)


SMALL = {
    "contact": Small(case(P, contact()), asked=("weighted floor", "integral")),
    "contact from above": Small(case(P, contact("upper"), FREE), asked=("integral floor",)),
    "between two obstacles": Small(case(P, contact("both"), *BESIDE), asked=("flux floor",)),
    "pressed, and off": Small(
        case(P, contact(wave=PRESSED), FREE, contact("upper", wave=OFF), FREE, c=3.0),
        asked=("flux floor", "flux top", "integral floor", "integral"),
    ),
    "f and g wave": Small(case(P, contact(), *BESIDE, **QUICK), 5),
    "c and b": Small(
        case(P, contact(b=2.0), robin(5.0), GIVEN, FREE, c=10.0), asked=("integral right",)
    ),
    "c and b are large": Small(
        case(P, contact("both", 1e4), robin(1e5), GIVEN, FREE, c=1e4, **QUICK),
        asked=("flux top",),
    ),
    "a weak b holds u": Small(case(P, contact(), FREE, robin(0.1), FREE)),
    "c alone holds u": Small(
        case(P, contact(), FREE, contact("upper"), FREE, c=30.0), asked=("flux top", "integral")
    ),
    "contact alone holds u": Small(case(terms.Alone, contact(), FREE, FREE, FREE)),
    "c varies": Small(
        case(C, contact(), robin(1.0), c=60.0, right=60.0, **UNEVEN), asked=("integral",)
    ),
    "c is cut off, κ varies": Small(
        case(terms.Waving, contact(), FREE, c=30.0, **BEATS | {"right": 3.0}), asked=("integral",)
    ),
    "b varies": Small(
        case(terms.Leaky, contact(b=20.0), robin(200.0), robin(1e4), c=1.0, right=1.0,
             **EVEN, **LEAKY),
        asked=("integral right",),
    ),
    "κ varies": Small(case(terms.Waving, contact(), *BESIDE, **BEATS), 8, asked=("flux top",)),
    "κ, c and b vary": Small(
        case(terms.Waving, contact(b=20.0), robin(20.0), GIVEN, FREE, c=40.0,
             **BEATS | {"swing": 0.5, "right": 40.0}),
        8, asked=("integral",),
    ),
    "tensor": Small(case(A, contact(), FREE, **TENSOR), asked=("integral right",)),
    "tensor, c and b": Small(case(A, contact(b=3.0), robin(9.0), c=500.0, **TENSOR)),
    "tensor varies": Small(case(A, contact(), *BESIDE, **MOVED), 8, asked=("flux top",)),
    "tensor varies, c and b": Small(case(A, contact(b=3.0), robin(9.0), c=90.0, **MOVED), 7),
    "layers": Small(
        case(terms.Layered, contact(), robin(3.0), c=2.0, **LAYERS), asked=("integral east",)
    ),
    "f jumps": Small(jumping_load(*manufactured.FREE)),
    "f jumps, contact alone holds u": Small(jumping_load("contact", *["neumann"] * 3)),
    "adapted": Small(case(P, contact(), FREE, **QUICK), 4, levels=3),
    "thin": Small(case(P, contact(), *BESIDE), 2, 60, asked=("flux top", "integral")),
    "thin, c and b": Small(
        case(P, contact(b=1.0), robin(50.0), GIVEN, FREE, c=60.0, **QUICK), 2, 60,
        asked=("flux top",),
    ),
    "thin, v is solved for around the foremost": Small(case(P, contact(), *BESIDE), 8, 400),
    "thin, and everywhere": Small(case(P, contact(), *BESIDE), 4, 240),
    "thin, pressed": Small(case(P, contact(wave=PRESSED), *BESIDE, kappa=30.0), 4, 240),
    "thin, κ varies": Small(case(terms.Waving, contact(), *BESIDE, **BEATS), 3, 60),
}  # fmt: skip

TODAY: dict[str, tuple[float, ...]] = {
    "contact": (1.14574, 1.14574, 0.997151, 1.16504, 0.736181, 2.55719, 1.97355),
    "contact from above": (1.17076, 1.17076, 1.08773, 1.17149, 0.86513, 7.19251),
    "between two obstacles": (1.18336, 1.18336, 1.07641, 1.18366, 0.771391, 5.85118),
    "pressed, and off": (
        1.12039,
        1.1226,
        0.960188,
        1.114,
        0.585242,
        2.30155,
        2.29794,
        5.60185,
        0.950816,
    ),
    "f and g wave": (1.1684, 1.1684, 1.10209, 1.18408, 0.664935),
    "c and b": (1.17304, 1.17127, 1.05598, 1.1721, 0.769243, 1.16531),
    "c and b are large": (1.22352, 2.0996, 0.76157, 1.29593, 0.435432, 11.0725),
    "a weak b holds u": (1.18065, 1.18078, 1.08312, 1.15083, 0.77553),
    "c alone holds u": (1.23008, 1.24708, 1.13536, 1.21088, 0.967878, 14.1234, 1.0007),
    "contact alone holds u": (1.15986, 1.15986, 1.06251, 1.15081, 0.754843),
    "c varies": (1.20984, 1.24499, 1.04109, 1.16865, 1.15412, 1.24316),
    "c is cut off, κ varies": (1.58314, 1.92757, 1.54232, 1.22311, 2.56815, 2.74345),
    "b varies": (1.28617, 1.31395, 0.797114, 1.38203, 0.379748, 0.0870671),
    "κ varies": (1.41455, 1.69118, 1.38741, 1.19458, 1.11742, 8.76176),
    "κ, c and b vary": (1.43809, 1.73485, 1.40581, 1.22839, 1.55461, 1.2012),
    "tensor": (1.1808, 2.60679, 1.18149, 1.19464, 0.885485, 1.80327),
    "tensor, c and b": (1.23749, 2.74039, 1.14084, 1.25408, 0.785825),
    "tensor varies": (1.44666, 3.57502, 1.54002, 1.236, 1.43458, 4.96425),
    "tensor varies, c and b": (1.47018, 3.65105, 1.44371, 1.26838, 1.20096),
    "layers": (1.06753, 1.84668, 1.02945, 1.06418, 0.537779, 0.0252669),
    "f jumps": (1.20777, 1.20777, 1.07932, 1.21922, 1.04866),
    "f jumps, contact alone holds u": (1.43148, 1.43148, 1.3095, 1.185, 1.18201),
    "adapted": (1.09106, 1.09106, 1.06032, 1.09463, 0.610848),
    "thin": (1.80369, 1.80369, 1.57657, 1.39097, 1.13794, 1.91815, 2.43787),
    "thin, c and b": (2.04656, 2.10606, 2.85551, 1.86654, 3.32727, 2.98386),
    "thin, v is solved for around the foremost": (1.40637, 1.40637, 1.10927, 1.34233, 0.609971),
    "thin, and everywhere": (1.50611, 1.50611, 1.26926, 1.3352, 0.683487),
    "thin, pressed": (1.19273, 1.19273, 0.893246, 1.22642, 0.372932),
    "thin, κ varies": (1.38482, 1.63656, 1.17602, 1.28406, 0.719045),
}
BOUNDS = 5
"""
Of each problem bounds over errors: of u in the energy norm and in H1, of the companion's error, and
the indicators' sum, both over the first of these errors; the width of the bracket of J(u) over its
square; then the widths of intervals over the same.
"""


def figures(name):
    """Return the figures of a problem for `TODAY`; insists that bounds hold; collective."""
    small = SMALL[name]
    solution = small.solution()
    certificate = solution.certificate
    assert certificate.reason is None
    h1, error, J = small.exact(solution)
    low, high = certificate.energy
    assert h1 <= certificate.bound_h1 * (1 + SLACK)
    assert error <= certificate.bound_energy_norm * (1 + SLACK)
    assert low - SLACK * abs(J) <= J <= high + SLACK * abs(J)
    shares = WORLD.allreduce(certificate.indicators.sum())
    found = [certificate.bound_energy_norm / error, certificate.bound_h1 / h1]
    found += [certificate.bound_companion / error, np.sqrt(shares) / error, (high - low) / error**2]
    for what in small.asked:
        (_, lower, upper), exact = small.interval(solution, what)
        assert lower - SLACK * abs(exact) <= exact <= upper + SLACK * abs(exact), what
        found.append((upper - lower) / error**2)
    return found


@pytest.mark.parametrize("name", SMALL)
def test_figures_are_those_of_today(name):
    found, known = np.array(figures(name)), np.array(TODAY[name])
    within = np.where(np.arange(len(known)) < BOUNDS, WITHIN, OF_INTERVALS)
    assert (abs(found - known) <= within * known).all(), found


if __name__ == "__main__":
    for each in SMALL:
        row = ", ".join(f"{value:.6g}" for value in figures(each))
        if WORLD.rank == 0:
            print(f'    "{each}": ({row}),', flush=True)
