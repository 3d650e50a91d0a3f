"""The program's own V-cycle against PETSc's PCMG, made of the same matrices.

    container/run python3 benchmarks/pcmg.py

On the finest mesh of each case, with the active set of its solution constrained on all grids, both
are applied in turns to a random vector, as CG's preconditioners are. PCMG gets the same constrained
matrices, the same transfers, as many sweeps of SOR with the same ω, forward before and backward
after the coarse correction, and the same factors at the bottom. One rank only: on several the
program's sweeps are not PETSc's. Times are medians, those of a cycle with quartiles, and so is the
quotient, of pairs; all is made anew several times, as where vectors lie in memory counts, too. The
difference is the largest in any dof, in parts of the result's largest.

What is restricted to constrained dofs is dropped by the program's cycle. PCMG has no place for
that, so it gets transfers without these dofs' columns, which coarse functions of the constrained
space do not use. A first cycle is one in another active set than before, with what there is to do
for that: matrices constrained, later whole again, the bottom factorised, for PCMG columns taken out
of all transfers. Once a mesh the transfers are made as matrices, and PCMG is set up; a program that
is made for PCMG would have these transfers in place of its own. A solve is that of the variational
inequality on that mesh, and has a first cycle for each Newton step and as many cycles in all as CG
steps. With PCMG it takes what was measured and what set-up and cycles differ by; for the last
column the transfers are not counted.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from statistics import median, quantiles

import numpy as np
from cases import comm, finest, timed
from harness import command_line, head, in_turns, keep, keep_memory, line
from petsc4py import PETSc

from signorini_cr.multigrid.cycle import LONG_SWEEPS, SWEEPS, Grid, Multigrid
from signorini_cr.multigrid.hierarchy import Hierarchy
from signorini_cr.multigrid.smoothing import OVER_RELAXATION
from signorini_cr.options import SMALL_FACTORS, defaults
from signorini_cr.solution import Solution

CYCLES = ("case", "dofs", "grids", "own cycle, ms", "PCMG, ms", "PCMG / own", "difference")
FIRST = ("set up, ms: transfers / PCMG", "first cycle, ms: own / PCMG", "Newton / CG")
SOLVES = ("case", *FIRST, "solve, ms", "with PCMG / own", "without transfers")
PREFIX = "pcmg_"

ROUNDS = 6
"""Times that all is made anew: where the vectors lie in memory makes some per cent."""


def settings(top: int) -> dict[str, object]:
    """PETSc's options that make PCMG, its finest level being number `top`, what our cycle is."""
    found: dict[str, object] = {
        "pc_mg_distinct_smoothup": None,
        "mg_coarse_ksp_type": "preonly",
        "mg_coarse_pc_type": "cholesky",
        **{f"mg_coarse_{name}": value for name, value in SMALL_FACTORS.items()},
    }
    for level, way in itertools.product(range(1, top + 1), ("forward", "backward")):
        name = f"mg_levels_{level}_" + ("up_" if way == "backward" else "")
        found |= {
            f"{name}ksp_type": "richardson",
            f"{name}ksp_max_it": LONG_SWEEPS if level == top else SWEEPS,
            f"{name}pc_type": "sor",
            f"{name}pc_sor_omega": OVER_RELAXATION,
            f"{name}pc_sor_local_{way}": None,
        }
    return found


def whole_transfers(grids: Sequence[Grid]) -> list[PETSc.Mat]:
    """The transfers as matrices, finest first."""
    return [grid.transfer.matrix() for grid in grids if grid.transfer is not None]


class Theirs:
    """PCMG on a chain of grids, finest first, set up for what is constrained at present."""

    def __init__(self, grids: Sequence[Grid], whole: Sequence[PETSc.Mat]):
        """Set it up; the transfers stay whole."""
        self._coarse, self._whole, top = grids[1:], whole, len(whole)
        self._transfers = [matrix.duplicate(copy=True) for matrix in whole]
        self.pc = PETSc.PC().create(comm)
        self.pc.setOptionsPrefix(PREFIX)
        self.pc.setType("mg")
        self.pc.setMGLevels(top + 1)
        self.pc.setOperators(grids[0].matrix)
        for place, grid in enumerate(grids):
            self.pc.getMGSmoother(top - place).setOperators(grid.matrix)
        for place, matrix in enumerate(self._transfers):
            self.pc.setMGInterpolation(top - place, matrix)
        self.constrain()
        with defaults(settings(top), PREFIX):
            self.pc.setFromOptions()
            self.pc.setUp()

    def constrain(self) -> None:
        """Take the columns of the dofs that are constrained now out of the transfers."""
        for whole, matrix, grid in zip(self._whole, self._transfers, self._coarse, strict=True):
            kept = grid.matrix.createVecRight()
            kept.set(1.0)
            kept.array[grid.held] = 0.0
            whole.copy(matrix, PETSc.Mat.Structure.SAME_NONZERO_PATTERN)
            matrix.diagonalScale(R=kept)


Figures = dict[str, list[float]]


def compared(solution: Solution, cycle: Multigrid, repeats: int) -> Figures:
    """Times in ms of all that is in turns, and the largest difference of the results."""
    active, found = solution.contact.active_set.dofs, Figures()
    pcs = {"own": PETSc.PC().createPython(cycle, comm)}
    pcs["own"].setOperators(cycle.matrix)
    b = cycle.matrix.createVecRight()
    x = {name: b.duplicate() for name in ("own", "PCMG")}
    whole = whole_transfers(cycle.grids)
    with cycle.constrained(active):
        b.array[:] = np.random.default_rng(0).standard_normal(b.local_size)
        b.array[cycle.finest.held] = 0.0
        once = {
            "transfers": lambda: 1e3 * timed(lambda: whole_transfers(cycle.grids)),
            "set up": lambda: 1e3 * timed(lambda: Theirs(cycle.grids, whole)),
        }
        found |= in_turns(once, 2)
        theirs = Theirs(cycle.grids, whole)
        pcs["PCMG"] = theirs.pc
        cycles = {
            name: lambda name=name: 1e3 * timed(lambda: pcs[name].apply(b, x[name])) for name in x
        }
        found |= in_turns(cycles, repeats)
        ours, other = (result.array_r for result in x.values())
        found["difference"] = [float(np.abs(ours - other).max() / np.abs(ours).max())]

    # each of the two has both sets, in turns
    sets = itertools.cycle([active, active, active[1:], active[1:]])

    def first(name: str) -> None:
        with cycle.constrained(next(sets)):
            if name == "PCMG":
                theirs.constrain()
            pcs[name].apply(b, x[name])

    firsts = in_turns(
        {name: lambda name=name: 1e3 * timed(lambda: first(name)) for name in x}, repeats
    )
    return found | {f"first {name}": values for name, values in firsts.items()}


def spread(values: Sequence[float], digits: int) -> str:
    """Median and quartiles."""
    low, middle, high = quantiles(values, n=4)
    return f"{middle:.{digits}f} ({low:.{digits}f} to {high:.{digits}f})"


def rows(name: str, dofs: float, repeats: int) -> tuple[str, str]:
    """The case's line in each table."""
    rounds = []
    for _ in range(ROUNDS):
        solution = finest(name, dofs)
        level, hierarchy = solution.level, Hierarchy(solution.level.physics, solution.domain)
        hierarchy.meshes = level.meshes
        with hierarchy.multigrid(level.system.operator, level.system.owned_dirichlet) as cycle:
            rounds.append(compared(solution, cycle, repeats))
            grids = len(cycle.grids)
        hierarchy.free()
        rounds[-1]["solve"] = [1e3 * solution.seconds["solve"]]
    found = {key: [value for each in rounds for value in each[key]] for key in rounds[0]}

    def pairs(start: str = "") -> zip[tuple[float, float]]:
        return zip(found[f"{start}own"], found[f"{start}PCMG"], strict=True)

    newton, cg = solution.iterations.newton, solution.iterations.linear
    later, first = (median(other - own for own, other in pairs(s)) for s in ("", "first "))
    transfers, set_up, solve = (median(found[key]) for key in ("transfers", "set up", "solve"))
    more = set_up + newton * first + (cg - newton) * later
    quotients = spread([other / own for own, other in pairs()], 3)
    cells = [name, f"{solution.dofs:,}", f"{grids}"]
    cells += [spread(found["own"], 1), spread(found["PCMG"], 1), f"**{quotients}**"]
    whole = [name, f"{transfers:.0f} / {set_up:.0f}"]
    whole += [f"{median(found['first own']):.1f} / {median(found['first PCMG']):.1f}"]
    whole += [f"{newton} / {cg}", f"{solve:.0f}"]
    whole += [f"**{1 + (more + transfers) / solve:.3f}**", f"{1 + more / solve:.3f}"]
    return line([*cells, f"{max(found['difference']):.1e}"]), line(whole)


def main() -> None:
    """Print and keep both tables."""
    parser = command_line(__doc__, cases=("S1", "A"), dofs=8e5, repeats=25)
    arguments = parser.parse_args()
    keep_memory()
    found = [rows(name, arguments.dofs, arguments.repeats) for name in arguments.cases]
    cycles, solves = zip(*found, strict=True)
    lines = [head(CYCLES), *cycles, "", head(SOLVES), *solves]
    print("\n".join(lines))
    keep(lines, arguments.out / "pcmg.md")


if __name__ == "__main__":
    main()
