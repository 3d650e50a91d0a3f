"""Time to the same error: CR through this program against conforming P1 through plain DOLFINx.

    container/run python3 benchmarks/same_error.py

S1 on squares of side 1/720 cut in two, where both elements have an error of about 2.0e-3 in the
(broken) H1 seminorm; P1 has a third of the dofs. P1 is solved as a script would do it: DOLFINx's
own rectangle, SNES `vinewtonrsls` from zero, CG and BoomerAMG on the reduced systems. Each run is
a process of its own, the two take turns; the whole run is everything from the start of Python to
the solution, the error comes after that. Medians. Before each run as much memory as either needs is
touched and given back: on virtual machines fresh memory can come at a quarter of a gigabyte a
second, and who comes first would pay for both.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from functools import partial

from harness import command_line, in_turns, launched, medians, tabulate

HEAD = ("", "dofs", "H1 error", "Newton, finest", "mesh", "assembly", "VI", "whole run")

WARM = "import numpy; numpy.ones(1 << 29)"
BEGAN = time.time() - float(os.environ.get("SAME_ERROR_AGE", "0"))


def cr(n: int) -> dict[str, float]:
    """CR on nested meshes, the finest with squares of side 1/n."""
    from signorini_cr import exact, solve_levels

    levels = 1
    while n % 2 == 0 and n > 45:
        n, levels = n // 2, levels + 1
    vi = mesh = assemble = 0.0
    for solution in solve_levels(exact.S1.problem, exact.S1.structured(n), levels):
        vi += solution.seconds["solve"]
        mesh += solution.seconds["mesh"]
        assemble += solution.seconds["assemble"]
    whole = time.time() - BEGAN
    newton = solution.iterations.newton
    assert solution.errors is not None
    return {
        "dofs": solution.dofs, "newton": newton, "mesh": mesh, "assemble": assemble,
        "vi": vi, "whole": whole, "error": solution.errors[0],
    }  # fmt: skip


def p1(n: int) -> dict[str, float]:
    """P1, nothing but DOLFINx and PETSc."""
    import numpy as np
    import ufl
    from dolfinx import fem, mesh
    from dolfinx.fem.petsc import assemble_matrix, assemble_vector, set_bc
    from mpi4py import MPI
    from petsc4py import PETSc

    from signorini_cr import exact

    clock = time.time()
    domain = mesh.create_rectangle(MPI.COMM_WORLD, [[-1, 0], [1, 1]], [2 * n, n])
    meshed = time.time() - clock
    V = fem.functionspace(domain, ("Lagrange", 1))
    u, v, x = ufl.TrialFunction(V), ufl.TestFunction(V), ufl.SpatialCoordinate(domain)
    a = fem.form(ufl.inner(ufl.grad(u), ufl.grad(v)) * ufl.dx)
    L = fem.form(exact.S1.problem.f(x) * v * ufl.dx(metadata={"quadrature_degree": 2}))
    facets = mesh.locate_entities_boundary(
        domain, 1, lambda x: np.isclose(abs(x[0]), 1) | np.isclose(x[1], 1)
    )
    bc = fem.dirichletbc(0.0, fem.locate_dofs_topological(V, 1, facets), V)
    A = assemble_matrix(a, [bc])
    A.assemble()
    b = assemble_vector(L)
    set_bc(b, [bc])
    solution, lower = fem.Function(V), fem.Function(V)
    lower.x.array[:] = PETSc.NINFINITY
    lower.x.array[fem.locate_dofs_geometrical(V, lambda x: np.isclose(x[1], 0))] = 0.0
    lower.x.array[fem.locate_dofs_topological(V, 1, facets)] = PETSc.NINFINITY
    assembled = time.time() - clock - meshed

    upper, residual = b.duplicate(), b.duplicate()
    upper.set(PETSc.INFINITY)
    snes = PETSc.SNES().create(domain.comm)
    snes.setType("vinewtonrsls")

    def function(_: PETSc.SNES, x: PETSc.Vec, f: PETSc.Vec) -> None:
        A.mult(x, f)
        f.axpy(-1.0, b)

    snes.setFunction(function, residual)
    snes.setJacobian(lambda *_: None, A)
    snes.setVariableBounds(lower.x.petsc_vec, upper)
    snes.setTolerances(atol=1e-8 * b.norm(), rtol=0.0)
    snes.getKSP().setType("cg")
    snes.getKSP().getPC().setType("hypre")
    snes.solve(None, solution.x.petsc_vec)
    whole = time.time() - BEGAN
    assert snes.getConvergedReason() > 0
    difference = ufl.grad(solution) - ufl.grad(exact.S1.problem.exact(x))
    square = fem.form(ufl.inner(difference, difference) * ufl.dx(metadata={"quadrature_degree": 4}))
    return {
        "dofs": A.getSize()[0], "newton": snes.getIterationNumber(), "mesh": meshed,
        "assemble": assembled, "vi": whole - (clock - BEGAN) - meshed - assembled, "whole": whole,
        "error": float(np.sqrt(fem.assemble_scalar(square))),
    }  # fmt: skip


ELEMENTS = {"cr": cr, "p1": p1}
NAMES = {"cr": "CR, this program", "p1": "P1, plain DOLFINx"}


def alone(n: int, element: str) -> dict[str, float]:
    """One run in a process of its own, that finds memory."""
    subprocess.run([sys.executable, "-c", WARM], check=True)
    # what Python needs to get as far as this file belongs to the whole run
    found: dict[str, float] = launched("--n", str(n), "--only", element, SAME_ERROR_AGE="0.03")
    return found


def row(name: str, runs: list[dict[str, float]]) -> list[str]:
    """One line of the table."""
    mid = medians(runs)
    facts = f"{mid['dofs'] / 1e6:.2f} M", f"{mid['error']:.2e}", f"{mid['newton']:.0f}"
    times = f"{mid['mesh']:.2f} s", f"{mid['assemble']:.2f} s"
    return [name, *facts, *times, f"**{mid['vi']:.2f} s**", f"**{mid['whole']:.2f} s**"]


def main() -> None:
    """Let the two take turns; the first run of each fills the cache of compiled forms."""
    parser = command_line(__doc__, repeats=3)
    parser.add_argument("--n", type=int, default=720)
    parser.add_argument("--only", choices=list(ELEMENTS), help="one run, as JSON")
    arguments = parser.parse_args()
    if arguments.only:
        print(json.dumps(ELEMENTS[arguments.only](arguments.n)))
        return
    actions = {element: partial(alone, arguments.n, element) for element in ELEMENTS}
    found = in_turns(actions, arguments.repeats)
    rows = (row(NAMES[element], runs) for element, runs in found.items())
    tabulate(HEAD, rows, arguments.out / "same_error.md")


if __name__ == "__main__":
    main()
