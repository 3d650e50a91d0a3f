"""Tools that tests share: folders of the checkout, and processes started as users start them."""

import contextlib
import io
import os
import re
import runpy
import subprocess
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import ufl
from dolfinx import cpp, fem
from dolfinx.mesh import (
    Mesh,
    MeshTags,
    compute_midpoints,
    create_rectangle,
    create_unit_cube,
    exterior_facet_indices,
    meshtags,
)
from mpi4py import MPI

from signorini_cr import (
    Contact,
    Dirichlet,
    Domain,
    Neumann,
    Polygon,
    Problem,
    Solution,
    solve_levels,
)
from signorini_cr.compat import cell_nodes
from signorini_cr.estimate.functional import Functional, Masses
from signorini_cr.fem.cells import BoundaryFacets, Cells
from signorini_cr.output import plots

ROOT = Path(__file__).parent.parent
DEMOS = ROOT / "demos"
MESHES = ROOT / "meshes"
SIDES = ("floor", "right", "top", "left")
SQUARE = Polygon([[0, 0], [1, 0], [1, 1], [0, 1]], SIDES, names=SIDES)
"""The unit square, each side a part of its own."""
HELD_ABOVE = Polygon(SQUARE.vertices, ("contact", "neumann", "dirichlet", "neumann"))
HELD_ALL_ROUND = Polygon(SQUARE.vertices, ("contact", "dirichlet", "dirichlet", "dirichlet"))
"""The unit square with contact below: held above, or on all other sides."""
STRIP = [[0, 0], [2, 0], [2, 1], [0, 1]]
"""Corners of (0, 2) × (0, 1), whose edges are `SIDES`."""


def clean_environment(**more: str) -> dict[str, str]:
    """The environment without what the MPI of this process left in it."""
    left = re.compile(r"PMIX|PMI_|MPI_LOCALRANKID|PRTE_(?!MCA)|OMPI_(?!MCA|ALLOW)")
    return {name: value for name, value in os.environ.items() if not left.match(name)} | more


def start(
    *arguments: str | Path,
    ranks: int = 1,
    seconds: float = 240,
    cwd: Path | None = None,
    **more: str,
) -> subprocess.CompletedProcess[str]:
    """Run this Python with such arguments, under mpirun unless one rank is asked for.

    Args:
        arguments: Script and its arguments, or `-m` and a module.
        ranks: How many processes.
        seconds: How long it may take.
        cwd: Where it starts.
        more: Variables of its environment.
    """
    launch = ["mpirun", "-n", str(ranks)] if ranks > 1 else []
    return subprocess.run(
        [*launch, sys.executable, *map(str, arguments)],
        capture_output=True,
        text=True,
        timeout=seconds,
        env=clean_environment(**more),
        cwd=cwd,
        check=False,
    )


def command(*arguments: str | Path, **options: Any) -> subprocess.CompletedProcess[str]:
    """Start `signorini-cr` as users do; `options` are those of `start`."""
    return start("-m", "signorini_cr", *arguments, **options)


UNDRAWN = """import sys
from signorini_cr.app import cli

def begin(*given, do=cli._begin):
    begun = do(*given)
    from signorini_cr.output import plots
    plots.can_draw = lambda comm: False
    return begun

cli._begin = begin
sys.exit(cli.main())
"""
"""The command that draws no pictures, which take longer than all else it does with few cells."""


def undrawn_command(*arguments: str | Path, **options: Any) -> subprocess.CompletedProcess[str]:
    """Start `signorini-cr` in a process of its own, without pictures; `options` as `start`."""
    return start("-c", UNDRAWN, *arguments, **options)


def altered(
    folder: Path, case: str, program: str, *words: str, **options: Any
) -> subprocess.CompletedProcess[str]:
    """Solve a problem by a command that something has been done to; results are in `out`.

    Args:
        folder: Where problem, program and results are.
        case: The problem file's text.
        program: What the process does before it runs the command.
        words: Options of the command.
        options: Those of `start`.
    """
    (folder / "case.toml").write_text(case)
    ending = "import sys\nfrom signorini_cr.app import cli\nsys.exit(cli.main())\n"
    (folder / "run.py").write_text(f"{program}\n{ending}")
    argv = ["solve", folder / "case.toml", "--out", folder / "out", *words]
    return start(folder / "run.py", *argv, **options)


def script(path: Path, *arguments: str | Path, **variables: str) -> tuple[int, str]:
    """Run a program on the ranks of this process, as under mpirun; collective.

    Args:
        path: A script, or a folder with a `__main__.py`.
        arguments: What stands behind it on the command line.
        variables: Variables of its environment.

    Returns:
        Its exit status, and what this rank printed.
    """
    printed, status = io.StringIO(), 0
    with pytest.MonkeyPatch.context() as patch, contextlib.redirect_stdout(printed):
        patch.setattr(sys, "argv", [str(path), *map(str, arguments)])
        patch.syspath_prepend(path if path.is_dir() else path.parent)
        for name, value in variables.items():
            patch.setenv(name, value)
        try:
            runpy.run_path(str(path), run_name="__main__")
        except SystemExit as end:
            status = end.code if isinstance(end.code, int) else 1 if end.code else 0
    MPI.COMM_WORLD.Barrier()  # whoever writes has written
    return status, printed.getvalue()


def bar(materials: Mapping[str, Any]) -> tuple[Domain, Problem]:
    """Make the bar on (0, 2) × (0, 1) that u varies along y in, and what holds there.

    2 u'' = 3 u, u = 0 above, and below a loss of heat and a pressure that hold u at 1:
    u = sinh k(1 − y)/sinh k with k = √1.5.

    Args:
        materials: What parts of it consist of, as for `Polygon`.
    """
    sides = [Contact(1.0, coefficient=5.0, external=-4.0), Neumann(), Dirichlet(0.0), Neumann()]
    conditions = dict(zip(SIDES, sides, strict=True))
    domain = Polygon(STRIP, SIDES, names=SIDES, materials=materials).mesh(0.4)
    return domain, Problem(coefficient=2.0, reaction=3.0, conditions=conditions)


def strip(
    conditions: Sequence[Any], levels: int, size: float = 0.2, **data: Any
) -> Iterator[Solution]:
    """Solve on the levels of (0, 2) × (0, 1) with a condition for each edge."""
    domain = Polygon(STRIP, SIDES, names=SIDES).mesh(size)
    named = dict(zip(SIDES, conditions, strict=True))
    return solve_levels(Problem(conditions=named, **data), domain, levels)


def undrawn(patch: pytest.MonkeyPatch) -> None:
    """Have runs in this process draw no pictures, which take longest: as without Matplotlib."""
    patch.setattr(plots, "can_draw", lambda comm: False)


def is_picture(path: Path) -> bool:
    """Tell whether it is a PNG with something on it."""
    return path.read_bytes()[:8] == b"\x89PNG\r\n\x1a\n" and path.stat().st_size > 10_000


def stay(comm: MPI.Comm, parts: int, kinds: Any, corners: Any) -> Any:
    """A partitioner that leaves every triangle where it is."""
    ranks = np.full((corners[0].size // 3, 1), comm.rank, dtype=np.int32)
    return cpp.graph.AdjacencyList_int32(ranks)


def rectangle(n: int, comm: MPI.Comm = MPI.COMM_WORLD, neumann: bool = False) -> Domain:
    """(−1, 1) × (0, 1) with Γ1 below and Γ0 elsewhere, or a Neumann part on the right."""
    mesh = create_rectangle(comm, [[-1.0, 0.0], [1.0, 1.0]], [2 * n, n])

    def parts(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return np.where(y < 1e-12, 1, np.where(neumann & (x > 1 - 1e-12), 3, 2))

    return Domain.from_tags(mesh, tagged(mesh, parts))


def tagged(mesh: Mesh, values: Callable[[np.ndarray, np.ndarray], np.ndarray]) -> MeshTags:
    """Tag the exterior facets by where their midpoints are."""
    mesh.topology.create_connectivity(1, 2)
    facets = exterior_facet_indices(mesh.topology)
    x, y, _ = compute_midpoints(mesh, 1, facets).T
    return meshtags(mesh, 1, facets, np.asarray(values(x, y), dtype=np.int32))


def corners(mesh: Mesh) -> np.ndarray:
    """Of the triangles that this rank owns, shape (cells, 3, 2)."""
    return mesh.geometry.x[cell_nodes(mesh)[: mesh.topology.index_map(2).size_local], :2]


def areas(mesh: Mesh) -> np.ndarray:
    """Of the triangles that this rank owns."""
    x = corners(mesh)
    (a, b), (c, d) = (x[:, 1:] - x[:, :1]).T
    return 0.5 * np.abs(a * d - b * c)


def smallest_angle(mesh: Mesh) -> float:
    """In degrees, over all ranks."""
    x = corners(mesh)
    sides = np.roll(x, -1, axis=1) - x
    sides = sides / np.linalg.norm(sides, axis=2, keepdims=True)
    angles = np.degrees(np.arccos(-(sides * np.roll(sides, 1, axis=1)).sum(axis=2)))
    return mesh.comm.allreduce(angles.min(initial=180), op=MPI.MIN)


def integral(form: ufl.Form, comm: MPI.Comm = MPI.COMM_WORLD) -> float:
    """Compute what the form is, over all ranks."""
    return comm.allreduce(fem.assemble_scalar(fem.form(form)))


def on_the_square(problem: Problem, levels: int = 4, size: float = 0.25) -> list[Solution]:
    """On meshes of the unit square, each twice as fine as the one before."""
    return list(solve_levels(problem, SQUARE.mesh(size, MPI.COMM_WORLD), levels))


def widths_of(intervals: Iterable[tuple[float, float]], inside: float | None = None) -> np.ndarray:
    """Return the widths of intervals, each of which must hold a number if there is one."""
    found = []
    for lower, upper in intervals:
        assert lower <= upper and (inside is None or lower <= inside <= upper)
        found.append(upper - lower)
    return np.array(found)


def orders(found: np.ndarray) -> np.ndarray:
    """Compute orders of what is found on meshes, each twice as fine as the one before."""
    return np.log2(found[:-1] / found[1:])


def slope(x: Any) -> Any:
    """The obstacle, and u on Γ0, of `on_a_slope`."""
    return 0.05 * x[0]


def on_a_slope(dim: int, comm: MPI.Comm = MPI.COMM_WORLD, element: str = "CR") -> Solution:
    """A solution whose contact is on a part of Γ1, where the last coordinate is 0; collective.

    In the plane it is on a refined mesh, in space on a cube.
    """
    if dim == 3:
        mesh, levels, middle = create_unit_cube(comm, 3, 3, 3), 1, 0.4
    else:
        mesh, levels = create_rectangle(comm, [[-1.0, 0.0], [1.0, 1.0]], [8, 4]), 2
        middle = 0.0
    mesh.topology.create_connectivity(dim - 1, dim)
    facets = exterior_facet_indices(mesh.topology)
    below = compute_midpoints(mesh, dim - 1, facets)[:, dim - 1] < 1e-12
    tags = meshtags(mesh, dim - 1, facets, np.where(below, 1, 2).astype(np.int32))
    problem = Problem(f=lambda x: 4.0 * (middle - x[0]), obstacle=slope, dirichlet=slope)
    *_, finest = solve_levels(problem, Domain.from_tags(mesh, tags), levels, element)
    return finest


def of_gradients(cells: Cells, kappa: np.ndarray, w: np.ndarray | None = None) -> Functional:
    """‖κ^{1/2}(∇v − ∇u_h)‖² and no masses."""
    none = BoundaryFacets.joined([], 2), np.empty(0), np.empty((3, 0)), np.empty(0, dtype=bool)
    w = np.empty((3, cells.number)) if w is None else w
    return Functional(cells, w, kappa, np.array(True), Masses(False, np.array(0.0), *none))
