"""Bounds against errors, and energies against brackets, on data as rough as a user's may be."""

from __future__ import annotations

import gc
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from exactly import slopes
from manufactured import CLASSES, Exact
from mpi4py import MPI
from report import Group, Row, told

from signorini_cr import (
    InputError,
    NotConverged,
    Solution,
    families,
    solve_adaptive,
    solve_levels,
)

COMM = MPI.COMM_WORLD

SLACK = 1e-7
"""Error that the integration of the exact error may have, relative."""
NEARLY = 1e-8
"""The same for J(u), relative to what it is made of."""
MISSING = 0.05
"""Part of the cases of a class that may be left without bounds."""
LEAST = 1e-12
"""Least fault of a solution that is told; below it depends on the machine."""
SOLVES = 1e-7
"""Fault that `Exact.checked` may find in a solution."""

Run = Callable[[Exact], Solution]


@dataclass(frozen=True)
class Outcome:
    """One case.

    Attributes:
        energy_norm: Bound of ‖κ^{1/2} ∇_h(u − u_h)‖ over the error.
        h1: The same for ‖∇_h(u − u_h)‖.
        misses: By how much J(u) lies outside its bracket, in widths of it; negative inside.
        reason: Why there are no bounds, if there are none.
    """

    energy_norm: float = np.inf
    h1: float = np.inf
    misses: float = -np.inf
    reason: str | None = None


def distances(solution: Solution, exact: Exact) -> tuple[float, float, float, float]:
    """Errors in both norms, J(u), and what J(u) is made of; collective."""
    points, slope = slopes(solution)
    pieces = exact.pieces(points)
    a, b = exact.slope(pieces.x, pieces.y)
    kappa = exact.kappa(pieces.x, pieces.y)
    at = slope[pieces.owner]
    square = (a - at[:, :1]) ** 2 + (b - at[:, 1:]) ** 2
    own = [pieces.integral(v) for v in (square, kappa * square, kappa * (a**2 + b**2))]
    h1, energy_norm, whole = solution.domain.mesh.comm.allreduce(np.array(own))
    held = exact.held()
    return (
        float(np.sqrt(h1)),
        float(np.sqrt(energy_norm)),
        float(held - whole / 2),
        float(abs(held) + whole),
    )


def judge(solution: Solution, exact: Exact) -> Outcome:
    """Compare what the certificate says with what is so; collective."""
    certificate = solution.certificate
    if certificate.bound_h1 is None or certificate.bound_energy_norm is None:
        return Outcome(reason=certificate.reason or "no reason given")
    if certificate.energy is None:
        return Outcome(reason=certificate.reason or "no reason given")
    h1, energy_norm, J, made_of = distances(solution, exact)
    low, high = certificate.energy
    outside = max(low - J, J - high) - NEARLY * made_of
    return Outcome(
        certificate.bound_energy_norm / energy_norm,
        certificate.bound_h1 / h1,
        outside / max(high - low, 1e-300),
    )


def _structured(rng: np.random.Generator, levels: int) -> Run:
    n = int(rng.choice([8, 8, 8, 12, 16] if levels == 1 else [4, 6, 8]))
    shape: dict[str, Any] = {}
    if rng.random() < 0.4:
        shape = {"jitter": 0.2, "seed": int(rng.integers(100))}

    def run(exact: Exact) -> Solution:
        domain = families.structured(exact.polygon, n, COMM, **shape)
        *_, solution = solve_levels(exact.problem(domain), domain, levels)
        return solution

    return run


def _gmsh(rng: np.random.Generator, levels: int) -> Run:
    size = float(rng.uniform(0.09, 0.2)) * levels

    def run(exact: Exact) -> Solution:
        domain = exact.polygon.mesh(size, COMM)
        *_, solution = solve_levels(exact.problem(domain), domain, levels)
        return solution

    return run


def _adaptive(rng: np.random.Generator, levels: int) -> Run:
    n, size = int(rng.integers(4, 9)), float(rng.uniform(0.15, 0.3))
    squares = rng.random() < 0.5

    def run(exact: Exact) -> Solution:
        polygon = exact.polygon
        domain = families.structured(polygon, n, COMM) if squares else polygon.mesh(size, COMM)
        *_, solution = solve_adaptive(exact.problem(domain), domain, levels=4)
        return solution

    return run


def meshes(rng: np.random.Generator) -> tuple[str, Run]:
    """One of the ways to make meshes."""
    kind = rng.choice(["structured", "gmsh", "adaptive"], p=[0.5, 0.25, 0.25])
    levels = int(rng.integers(1, 3))
    make = {"structured": _structured, "gmsh": _gmsh, "adaptive": _adaptive}[str(kind)]
    return f"{kind}, level {levels - 1}" if kind != "adaptive" else "adaptive", make(rng, levels)


@dataclass
class Tally:
    """Outcomes of a class."""

    outcomes: list[Outcome] = field(default_factory=list)
    failures: list[str] = field(default_factory=list)
    reasons: Counter[str] = field(default_factory=Counter)

    def add(self, outcome: Outcome, name: str) -> None:
        """Take one in."""
        self.outcomes.append(outcome)
        if outcome.reason is not None:
            self.reasons[outcome.reason] += 1
            return
        said = []
        if not outcome.energy_norm >= 1 - SLACK:
            said.append(f"energy norm: bound {outcome.energy_norm:.3f} of the error")
        if not outcome.h1 >= 1 - SLACK:
            said.append(f"H1: bound {outcome.h1:.3f} of the error")
        if not outcome.misses <= 0:
            said.append(f"bracket misses J(u) by {outcome.misses:.2g} widths")
        if said:
            self.failures.append(f"{name}: {'; '.join(said)}")

    def row(self, name: str, reference: str) -> Row:
        """Sum up."""
        known = [outcome for outcome in self.outcomes if outcome.reason is None]
        if len(self.outcomes) - len(known) > MISSING * len(self.outcomes):
            told = "; ".join(f"{n} times: {reason}" for reason, n in self.reasons.most_common(3))
            self.failures.append(f"no bounds in {len(self.outcomes) - len(known)} cases ({told})")
        if not known:
            return Row(name, len(self.outcomes), "no bounds", reference, self.failures)
        figures = np.array([[o.energy_norm, o.h1, o.misses] for o in known])
        least, most = figures.min(axis=0), figures.max(axis=0)
        middle = np.median(figures, axis=0)
        low = int((figures[:, :2].min(axis=1) < 1 - SLACK).sum())
        missed = int((figures[:, 2] > 0).sum())
        worst = (
            f"{low} bounds too low, {missed} brackets miss, "
            f"{len(self.outcomes) - len(known)} without; bound over error in the energy norm "
            f"{least[0]:.3g} … {middle[0]:.3g} … {most[0]:.3g} (least, median, most), "
            f"in H1 {least[1]:.3g} … {middle[1]:.3g} … {most[1]:.3g}"
        )
        return Row(name, len(self.outcomes), worst, reference, self.failures)


CLOSED = (
    "u in closed form, integrated on split triangles; Green's formula with polynomials, the "
    "signs on Γ1 and all boundary values hold to {:.0e} or better"
)


def bounds(seed: int, quick: bool) -> Group:
    """All classes of data."""
    rows: list[Row] = []
    for make, number in CLASSES.items():
        tally, wrong, kind = Tally(), 0.0, ""
        for k in range(2 if quick else number):
            rng = np.random.default_rng((seed, k, len(rows)))
            exact = make(rng)
            kind = exact.kind
            way, run = meshes(rng)
            name = f"case {k} of seed {seed} ({way})"
            off = COMM.bcast(exact.checked() if COMM.rank == 0 else 0.0)
            wrong = max(wrong, off)
            if not off <= SOLVES:
                tally.failures.append(f"{name}: the reference is no solution: {off:.0e}")
                continue
            try:
                outcome = judge(run(exact), exact)
            except (InputError, NotConverged) as error:  # the same on all ranks
                outcome = Outcome(reason=str(error))
            except Exception as error:
                if COMM.size > 1:  # the other ranks may be waiting for this one
                    raise
                tally.failures.append(f"{name}: ended in {error!r}")
                outcome = Outcome(reason="ended in an error")
            tally.add(outcome, name)
            if k % 10 == 9:
                gc.collect()  # meshes hang in circles
        rows.append(told(tally.row(kind, CLOSED.format(max(wrong, LEAST)))))
    total = sum(row.cases for row in rows)
    return Group(
        "bounds",
        "Bounds and energies",
        f"{total} cases on the unit square with contact below, all of it or a part, at the default "
        "settings but where a degree is named: squares cut in two, vertices moved at random, gmsh, "
        "adaptive refinement. Passed: no bound below the error in either norm, J(u) inside its "
        f"bracket, at most {MISSING:.0%} without bounds.",
        rows,
    )
