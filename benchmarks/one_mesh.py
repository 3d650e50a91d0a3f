"""The linear solver where there is no hierarchy below a mesh, as with one from a file.

    container/run python3 benchmarks/one_mesh.py
    container/run mpirun -n 2 python3 benchmarks/one_mesh.py

gmsh meshes of the rectangle of S1 and of a polygon with obtuse corners and a hole, as they are. One
linear system with the matrix of the Crouzeix-Raviart element, no dof on the obstacle, is solved by
CG to rtol 1e-8, PETSc's way of counting, with the program's two-level method (P1 auxiliary space,
BoomerAMG below) and with BoomerAMG on the matrix itself, PETSc's defaults. Set-up is included, both
take turns, medians of the quotients. The last columns have the variational inequality on that mesh,
from a cold start as there is no other, and its time in units of BoomerAMG's linear solve.
"""

from __future__ import annotations

from statistics import median

from cases import CROOKED, PUSHED, comm, linear_solve, slowest, timed
from harness import command_line, in_turns, keep_memory, tabulate
from petsc4py import PETSc

from signorini_cr import exact, solve
from signorini_cr.diffusion import Diffusion
from signorini_cr.fem.problem import Problem
from signorini_cr.fem.space import ghosted_vector
from signorini_cr.mesh.domain import Domain
from signorini_cr.multigrid.hierarchy import Hierarchy, NestedMesh
from signorini_cr.vi.level import Level

HEAD = (
    "mesh",
    "dofs",
    "CG, two levels",
    "CG, BoomerAMG",
    "two levels, µs a dof",
    "BoomerAMG, µs a dof",
    "quotient",
    "VI: Newton / CG",
    "VI / BoomerAMG",
)


def two_levels(level: Level, b: PETSc.Vec) -> tuple[float, int]:
    """Time and steps of the program's method, set-up included."""
    system, x, steps = level.system, b.duplicate(), 0

    def action() -> None:
        nonlocal steps
        hierarchy = Hierarchy(level.physics, level.domain)
        with hierarchy.multigrid(system.operator, system.owned_dirichlet) as cycle:
            ksp = PETSc.KSP().create(system.A.getComm())
            ksp.setOperators(system.A)
            ksp.setType("cg")
            ksp.setTolerances(rtol=1e-8)
            ksp.getPC().setType("python")
            ksp.getPC().setPythonContext(cycle)
            with cycle.constrained(system.bounded[:0]):
                ksp.solve(b, x)
            steps = ksp.getIterationNumber()
            ksp.destroy()
        hierarchy.free()

    seconds = timed(action)
    x.destroy()
    return seconds, steps


def inequality(problem: Problem, domain: Domain) -> tuple[float, str]:
    """Time and steps of the variational inequality."""
    solution = solve(problem, domain)
    steps = f"{solution.iterations.newton} / {solution.iterations.linear}"
    return slowest(solution.seconds["solve"]), steps


def row(name: str, problem: Problem, domain: Domain, repeats: int) -> list[str]:
    """One line of the table."""
    level = Level((NestedMesh(Diffusion(problem, domain.mesh, "CR"), domain),))
    b = ghosted_vector(level.V, level.system.b)
    actions = {
        "theirs": lambda: linear_solve(level.system.A, b),
        "ours": lambda: two_levels(level, b),
    }
    theirs, ours = in_turns(actions, repeats, warm=0).values()
    whole = in_turns({"VI": lambda: inequality(problem, domain)}, repeats, warm=0)["VI"]
    dofs = b.getSize()
    ratio = median(mine[0] / other[0] for mine, other in zip(ours, theirs, strict=True))
    mine, other, vi = (1e6 * median(t for t, _ in runs) / dofs for runs in (ours, theirs, whole))
    steps = f"{ours[0][1]}", f"{theirs[0][1]}"
    return [
        name,
        f"{dofs / 1e6:.2f} M",
        *steps,
        f"{mine:.2f}",
        f"{other:.2f}",
        f"**{ratio:.2f}**",
        whole[0][1],
        f"{vi / other:.2f}",
    ]


def main() -> None:
    """Print and keep the table."""
    parser = command_line(__doc__, repeats=5)
    parser.add_argument("--sizes", type=float, nargs="*", default=[0.01, 0.005, 0.0025])
    arguments = parser.parse_args()
    keep_memory()
    cases = (
        ("rectangle", exact.S1.problem, exact.S1.polygon),
        ("polygon", PUSHED, CROOKED),
    )
    rows = (
        row(name, problem, polygon.mesh(size), arguments.repeats)
        for size in arguments.sizes
        for name, problem, polygon in cases
    )
    name = "one_mesh.md" if comm.size == 1 else f"one_mesh-{comm.size}.md"
    tabulate(HEAD, rows, arguments.out / name, comm.rank == 0)


if __name__ == "__main__":
    main()
