"""CG steps where cells are thin, the coefficient jumps, or one direction counts more.

    container/run python3 benchmarks/limits.py

What the cases of the other benchmarks leave out, each on nested meshes up to about 1.5 M dofs;
0.3 M where cells are squashed or the tensor is extreme, as CG and BoomerAMG take long there. Beside
the steps on each mesh stand those of one linear solve of the finest matrix by CG and BoomerAMG,
with PETSc's defaults to rtol 1e-8, and the time of the finest mesh's variational inequality over
that of this solve, the median of several. Where multigrid was given up the last column says for
what.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from statistics import median

import numpy as np
import numpy.typing as npt
import ufl
from cases import CROOKED, MOST, PUSHED, by_case, comm, meshes, slowest, solved_once
from harness import in_turns
from ufl.core.expr import Expr

from signorini_cr import Polygon, Problem, exact
from signorini_cr.mesh.domain import Domain

FloatArray = npt.NDArray[np.float64]

SQUARES = 4
"""Squares per unit length on the coarsest mesh."""

SIZE = 0.3
"""Size of the coarsest cells of a thin corner."""

THIN_DOFS = 3e5
"""Of the finest mesh, at most, where BoomerAMG takes too many steps."""


def squares() -> Domain:
    """The rectangle of S1, squares cut in two."""
    return exact.S1.structured(SQUARES, comm)


def stretched() -> Domain:
    """The same, squares four times as long as high, inner vertices moved by up to a fifth."""
    domain = squares()
    x = domain.mesh.geometry.x
    inner = (np.abs(x[:, 0]) < 1 - 1e-6) & (x[:, 1] > 1e-6) & (x[:, 1] < 1 - 1e-6)
    # as good as random, and the same on all ranks
    moves = np.sin(1e4 * (x[:, :2] + x[:, 1::-1] ** 2))
    x[inner, :2] += 0.2 / SQUARES * moves[inner]
    x[:, 0] *= 4
    return domain


def corner(degrees: float) -> Callable[[], Domain]:
    """A triangle with a thin corner, where contact meets Γ0."""
    angle = np.radians(degrees)
    vertices = [[0, 0], [1, 0], [float(np.cos(angle)), float(np.sin(angle))]]
    polygon = Polygon(vertices, ["contact", "neumann", "dirichlet"])
    return lambda: polygon.mesh(SIZE, comm)


def squashed(ratio: float, degrees: float) -> tuple[Problem, Callable[[], Domain]]:
    """The polygon and its data with one direction squashed after meshing.

    Args:
        ratio: What is left of the lengths in that direction.
        degrees: Angle by which it is off the axis of y.
    """
    squash = turned(1.0, ratio, degrees)
    back = np.linalg.inv(squash)[1].tolist()

    def domain() -> Domain:
        result = CROOKED.mesh(SIZE, comm)
        result.mesh.geometry.x[:, :2] = result.mesh.geometry.x[:, :2] @ squash.T
        return result

    def y(x: Expr) -> Expr:
        return back[0] * x[0] + back[1] * x[1]

    return replace(PUSHED, g=lambda x: y(x) - 1, dirichlet=lambda x: 0.2 + y(x)), domain


def with_coefficient(coefficient: Callable[[Expr], Expr]) -> Problem:
    """The polygon's data with another coefficient."""
    return replace(PUSHED, coefficient=coefficient)


def jump(factor: float) -> Problem:
    """A coefficient that is smaller above a line aslant to the cells; contact is below."""
    return with_coefficient(
        lambda x: ufl.conditional(x[1] < 0.37 + 0.3 * x[0], 1.0, 1 / factor),
    )


def strip(factor: float) -> Problem:
    """A coefficient that is larger within a hundredth of that line, in parts of coarse cells."""
    return with_coefficient(
        lambda x: ufl.conditional(abs(x[1] - 0.37 - 0.3 * x[0]) < 0.01, factor, 1.0),
    )


def tensor(ratio: float, degrees: float) -> Problem:
    """A coefficient ratio : 1, the larger in a direction so many degrees off the axis of x."""
    kappa = turned(ratio, 1.0, degrees)
    return with_coefficient(lambda x: ufl.as_matrix(kappa.tolist()))


def turned(first: float, second: float, degrees: float) -> FloatArray:
    """The diagonal matrix of two numbers, in axes turned by so many degrees."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    turn = np.array([[c, -s], [s, c]])
    result: FloatArray = turn @ np.diag([first, second]) @ turn.T
    return result


THIN = {
    "polygon squashed to 0.1": squashed(0.1, 0.0),
    "polygon squashed to 10⁻²": squashed(1e-2, 0.0),
    "polygon squashed to 10⁻³": squashed(1e-3, 0.0),
    "polygon squashed to 10⁻³, at 30°": squashed(1e-3, 30.0),
    "polygon squashed to 10⁻⁴": squashed(1e-4, 0.0),
    "tensor 10⁶ : 1": (tensor(1e6, 0.0), squares),
    "tensor 10⁶ : 1, at 30°": (tensor(1e6, 30.0), squares),
    "tensor 10⁶ : 1, at 90°": (tensor(1e6, 90.0), squares),
}

CASES = {
    "squares": (PUSHED, squares),
    "stretched 4 : 1, moved": (PUSHED, stretched),
    "corner of 10°": (PUSHED, corner(10)),
    "corner of 5°": (PUSHED, corner(5)),
    "jump of 10³": (jump(1e3), squares),
    "jump of 10⁶": (jump(1e6), squares),
    "thin strip of 10³": (strip(1e3), squares),
    "tensor 100 : 1": (tensor(100.0, 0.0), squares),
    "tensor 100 : 1, at 30°": (tensor(100.0, 30.0), squares),
    "tensor 100 : 1, at 90°": (tensor(100.0, 90.0), squares),
    **THIN,
}

HEAD = ("case", "dofs", "Newton", "CG", "CG with BoomerAMG", "VI / linear solve", "with")


def row(name: str, dofs: float, repeats: int) -> list[str]:
    """One line of the table."""
    limit = min(dofs, THIN_DOFS) if name in THIN else dofs

    def run() -> tuple[float, list[str]]:
        steps = []
        for solution in meshes(*CASES[name], limit):
            steps.append(solution.iterations)
        seconds, cg = solved_once(solution)
        return slowest(solution.seconds["solve"]) / seconds, [
            f"{solution.dofs / 1e6:.2f} M",
            " ".join(f"{s.newton}" for s in steps),
            " ".join(f"{s.linear}" for s in steps),
            f"{'> ' if cg >= MOST else ''}{cg}",
            steps[-1].preconditioner.split(",")[0].split(" on ")[0],
        ]

    runs = in_turns({name: run}, repeats)[name]
    *cells, preconditioner = runs[-1][1]
    below = "< " if cells[-1].startswith(">") else ""
    return [name, *cells, f"{below}{median(quotient for quotient, _ in runs):.2f}", preconditioner]


if __name__ == "__main__":
    by_case(__doc__, HEAD, row, "limits.md", CASES, 1.5e6)
