"""Check what the program claims by code that shares nothing with the part under test.

    container/run python3 verification
    container/run mpirun -n 2 python3 verification --only bounds
    container/run python3 verification --quick -signorini_snes_atol 1e-3   # PETSc's options

What is independent of what:

- `forces`, `offset`, `random`, `thin`: `reference.py` takes the coordinates of the cells, the
  facets' numbers and the boundary parts from the program's mesh, and nothing else: its matrices,
  right-hand sides, bounds, solver and arithmetic (extended precision) are its own. Basix gives the
  quadrature points, as the discrete problem is defined with them.
- `bounds`, `sharpness`: solutions in closed form; `exactly.py` integrates their distance from the
  program's u_h on triangles that it splits along the lines where data jump, by rules of its own.
  Of the program it takes the coordinates of the cells and u_h's values at the facets.
- `terms`, `quantities`: waves written in NumPy and in UFL, derivatives by hand; of the program the
  coordinates of the cells and u_h's values at the facets are taken.
- `formulas.py` has each datum once, for UFL and for NumPy: what the program and the reference
  solve is the same problem by construction.

The exit status is 1 when any row fails, and 0 otherwise. `make verify` has a process for each
group: one has room for some ten thousand forms, each a library, and cases have few in common.
"""

from __future__ import annotations

import argparse
import sys
import traceback
from collections.abc import Callable
from pathlib import Path

from mpi4py import MPI  # first: the PETSc of the wheels finds the MPI that is loaded

# isort: split
import petsc4py

petsc4py.init(["verification", "-options_left", "no", *sys.argv[1:]])

import bounds  # noqa: E402
import sharpness  # noqa: E402
import solves  # noqa: E402
import terms  # noqa: E402
from report import Group, Row, write  # noqa: E402

COMM = MPI.COMM_WORLD

GROUPS: dict[str, Callable[[int, bool], Group]] = {
    "forces": solves.stiff,
    "offset": solves.offset,
    "random": solves.random,
    "bounds": bounds.bounds,
    "sharpness": sharpness.sharpness,
    "thin": solves.thin,
    "terms": terms.terms,
    "quantities": terms.quantities,
}


def run(names: list[str], seed: int, quick: bool) -> list[Group]:
    """Run groups; one that ends in an error is a group that fails."""
    groups = []
    for name in names:
        try:
            group = GROUPS[name](seed, quick)
        except Exception as error:
            if COMM.size > 1:  # the others may be waiting for this rank
                traceback.print_exc()
                COMM.Abort(1)
            traceback.print_exc()
            group = Group(name, name, "", [Row(name, 0, "-", "-", [f"ended in {error!r}"])])
        groups.append(group)
        if COMM.rank == 0:
            print("\n".join(group.lines()), flush=True)
    return groups


def main() -> int:
    """Run what is asked for, print and keep the tables."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--only", nargs="+", choices=list(GROUPS), default=list(GROUPS))
    parser.add_argument("--out", type=Path, help="the page whose tables of these are made anew")
    parser.add_argument("--seed", type=int, default=20)
    parser.add_argument("--quick", action="store_true", help="a sample in half a minute")
    arguments, _ = parser.parse_known_args()  # the others are PETSc's
    groups = run(arguments.only, arguments.seed, arguments.quick)
    if arguments.out is not None and COMM.rank == 0:
        write(groups, list(GROUPS), arguments.out)
    passed = all(row.passed for group in groups for row in group.rows)
    return 0 if COMM.bcast(passed) else 1


if __name__ == "__main__":
    sys.exit(main())
