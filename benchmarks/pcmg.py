"""The program's own V-cycle against PETSc's PCMG, made of the same matrices.

    container/run python3 benchmarks/pcmg.py

On the finest mesh of each case, with the active set of its solution constrained on all grids, all
are applied in turns to a random vector, as CG's preconditioners are. PCMG gets the same constrained
matrices, as many sweeps of SOR with the same ω, forward before and backward after the coarse
correction, and the same factors at the bottom. The transfers it gets as matrices, and, as another
PCMG, as shells: matrices of type python that do what the program's own transfers do. One rank only:
on several the program's sweeps are not PETSc's. Times are medians, those of a cycle with quartiles,
and so is the quotient, of pairs; all is made anew several times, as where vectors lie in memory
counts, too. The difference is the largest in any dof, in parts of the result's largest.

What is restricted to constrained dofs is dropped by the program's cycle, and by shells. PCMG has no
place for that, so as matrices it gets transfers without these dofs' columns, which coarse functions
of the constrained space do not use. A first cycle is one in another active set than before, with
what there is to do for that: matrices constrained, later whole again, the bottom factorised, but by
the program only if it has changed, columns taken out of all transfers where they are matrices. The
first of all, on a new mesh, has what is set up there besides: PCMG for the whole chain, the
program's cycle for the two grids that are new. Once a mesh the transfers are made as matrices; a
program that is made for PCMG would have these in place of its own. A solve is that of the
variational inequality on that mesh, and has a first cycle for each Newton step and as many cycles
in all as CG steps. With PCMG it takes what was measured and what its cycles differ by; for the last
column the transfers are not counted.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from statistics import median, quantiles

import numpy as np
from cases import comm, cycle_of, finest, timed
from harness import command_line, head, in_turns, keep, keep_memory, line
from petsc4py import PETSc

from signorini_cr.multigrid.cycle import LONG_SWEEPS, SWEEPS, Grid, Multigrid, TwoGrids
from signorini_cr.multigrid.smoothing import OVER_RELAXATION
from signorini_cr.multigrid.transfer import Transfer
from signorini_cr.options import SMALL_FACTORS, defaults
from signorini_cr.solution import Solution

WHAT = ("case", "transfers")
CYCLES = (*WHAT, "dofs", "grids", "own cycle, ms", "PCMG, ms", "PCMG / own", "difference")
FIRST = ("first of all, ms: own / PCMG", "first, ms: own / PCMG", "Newton / CG", "solve, ms")
SOLVES = (*WHAT, "made in, ms", *FIRST, "with PCMG / own", "without transfers")
KINDS = ("matrices", "shells")
"""Kinds of transfers that PCMG has."""

PREFIX = "pcmg_"

ROUNDS = 6
"""Times that all is made anew: where the vectors lie in memory makes some per cent."""


def settings(top: int) -> dict[str, object]:
    """PETSc's options that make PCMG, its finest level being number `top`, what our cycle is."""
    found: dict[str, object] = {
        "pc_mg_distinct_smoothup": None,
        "mg_coarse_ksp_type": "preonly",
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


class Shell:
    """The context of a matrix that is a transfer of the program, for PCMG to prolong by."""

    def __init__(self, transfer: Transfer, coarse: Grid):
        """Note the transfer, and the grid that knows what is constrained."""
        self._transfer, self._coarse = transfer, coarse

    def multAdd(self, _: PETSc.Mat, x_coarse: PETSc.Vec, x: PETSc.Vec, result: PETSc.Vec) -> None:
        """Add a coarse function to x, which is the result for PCMG."""
        assert result.handle == x.handle
        self._transfer.add(x_coarse, x)

    def multTranspose(self, _: PETSc.Mat, b: PETSc.Vec, b_coarse: PETSc.Vec) -> None:
        """Restrict b, and drop what constrained dofs get."""
        self._transfer.restrict(b, b_coarse)
        b_coarse.array[self._coarse.left_out] = 0.0


def shells(grids: Sequence[Grid]) -> list[PETSc.Mat]:
    """The transfers as they are, in matrices of type python, finest first."""
    return [
        PETSc.Mat().createPython(
            [fine.dofs.size, coarse.dofs.size], Shell(fine.transfer, coarse), comm
        )
        for fine, coarse in itertools.pairwise(grids)
        if fine.transfer is not None
    ]


class Theirs:
    """PCMG on a chain of grids, finest first, set up for what is constrained at present."""

    def __init__(self, grids: Sequence[Grid], whole: Sequence[PETSc.Mat] | None = None):
        """Set it up, with shells or with matrices, which stay whole."""
        self._coarse, self._whole, top = grids[1:], whole, len(grids) - 1
        self._transfers = (
            shells(grids) if whole is None else [matrix.duplicate(copy=True) for matrix in whole]
        )
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
        """Take the columns of the dofs that are constrained now out of matrices."""
        if self._whole is None:
            return
        for whole, matrix, grid in zip(self._whole, self._transfers, self._coarse, strict=True):
            kept = grid.matrix.createVecRight()
            kept.set(1.0)
            kept.array[grid.left_out] = 0.0
            whole.copy(matrix, PETSc.Mat.Structure.SAME_NONZERO_PATTERN)
            matrix.diagonalScale(R=kept)


Figures = dict[str, list[float]]


def compared(solution: Solution, cycle: Multigrid, repeats: int) -> Figures:
    """Times in ms of all that is in turns, and the largest difference of the results."""
    active, grids = solution.contact.active_set.dofs, cycle.grids
    pcs = {"own": PETSc.PC().createPython(cycle, comm)}
    pcs["own"].setOperators(cycle.matrix)
    theirs: dict[str, Theirs] = {}
    b, whole = cycle.matrix.createVecRight(), whole_transfers(grids)
    x = {name: b.duplicate() for name in ("own", *KINDS)}
    # each of them has both sets, in turns
    sets = itertools.cycle([*len(x) * [active], *len(x) * [active[1:]]])

    def apply(name: str) -> None:
        pcs[name].apply(b, x[name])

    def first_of_all(name: str) -> None:
        with cycle.constrained(next(sets)):
            if name == "own":
                for grid in grids[:2]:
                    if grid.transfer is not None:
                        TwoGrids(grid.matrix, grid.dofs, grid.transfer, SWEEPS).free()
            else:
                theirs[name] = Theirs(grids, whole if name == "matrices" else None)
                pcs[name] = theirs[name].pc
            apply(name)

    def first(name: str) -> None:
        with cycle.constrained(next(sets)):
            if name != "own":
                theirs[name].constrain()
            apply(name)

    def measured(what: str, action: Callable[[str], None]) -> Figures:
        actions = {
            f"{what} {name}": lambda name=name: 1e3 * timed(lambda: action(name)) for name in x
        }
        return in_turns(actions, repeats)

    with cycle.constrained(active):
        b.array[:] = np.random.default_rng(0).standard_normal(b.local_size)
        b.array[cycle.finest.left_out] = 0.0
    found = in_turns({"made": lambda: 1e3 * timed(lambda: whole_transfers(grids))}, 2)
    found |= measured("first of all", first_of_all) | measured("first", first)
    with cycle.constrained(active):
        for each in theirs.values():
            each.constrain()
        found |= measured("cycle", apply)
    ours = x["own"].array_r
    for name in KINDS:
        difference = np.abs(x[name].array_r - ours).max() / np.abs(ours).max()
        found[f"difference {name}"] = [float(difference)]
    return found


def spread(values: Sequence[float], digits: int) -> str:
    """Median and quartiles."""
    low, middle, high = quantiles(values, n=4)
    return f"{middle:.{digits}f} ({low:.{digits}f} to {high:.{digits}f})"


def rows(name: str, dofs: float, repeats: int) -> list[tuple[str, str]]:
    """The case's lines in both tables, one pair for each kind of transfers."""
    rounds = []
    for _ in range(ROUNDS):
        solution = finest(name, dofs)
        with cycle_of(solution) as cycle:
            rounds.append(compared(solution, cycle, repeats))
            grids = len(cycle.grids)
        rounds[-1]["solve"] = [1e3 * solution.seconds["solve"]]
    found = {key: [value for each in rounds for value in each[key]] for key in rounds[0]}
    newton, cg = solution.iterations.newton, solution.iterations.linear
    middle = {key: median(values) for key, values in found.items()}
    lines = []
    for kind in KINDS:
        more = {
            what: median(np.subtract(found[f"{what} {kind}"], found[f"{what} own"]))
            for what in ("first of all", "first", "cycle")
        }
        longer = more["first of all"] + (newton - 1) * more["first"] + (cg - newton) * more["cycle"]
        made = middle["made"] if kind == "matrices" else 0.0
        quotients = spread(list(np.divide(found[f"cycle {kind}"], found["cycle own"])), 3)
        cells = [name, kind, f"{solution.dofs:,}", f"{grids}"]
        cells += [spread(found[f"cycle {each}"], 1) for each in ("own", kind)]
        cells += [f"**{quotients}**", f"{max(found[f'difference {kind}']):.1e}"]
        whole = [name, kind, f"{made:.0f}"]
        whole += [
            f"{middle[f'{what} own']:.1f} / {middle[f'{what} {kind}']:.1f}"
            for what in ("first of all", "first")
        ]
        solve = middle["solve"]
        whole += [f"{newton} / {cg}", f"{solve:.0f}"]
        whole += [f"**{1 + (longer + made) / solve:.3f}**", f"{1 + longer / solve:.3f}"]
        lines.append((line(cells), line(whole)))
    return lines


def main() -> None:
    """Print and keep both tables."""
    parser = command_line(__doc__, cases=("S1", "A"), dofs=8e5, repeats=25)
    arguments = parser.parse_args()
    keep_memory()
    found = [
        pair for name in arguments.cases for pair in rows(name, arguments.dofs, arguments.repeats)
    ]
    cycles, solves = zip(*found, strict=True)
    lines = [head(CYCLES), *cycles, "", head(SOLVES), *solves]
    print("\n".join(lines))
    keep(lines, arguments.out / "pcmg.md")


if __name__ == "__main__":
    main()
