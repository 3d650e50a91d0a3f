"""From data and a domain to solutions, on one mesh or on a sequence of refined ones."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
import numpy.typing as npt
from dolfinx import fem
from dolfinx.fem.petsc import assemble_matrix
from dolfinx.la import InsertMode
from mpi4py import MPI
from petsc4py import PETSc

from .cells import Cells
from .certificate import Certificate, certify
from .contact import Contact, contact_facts
from .domain import CONTACT, DIRICHLET, Domain
from .errors import InputError, raise_together
from .hierarchy import refine
from .loads import Edge, Load, chi
from .moments import Data
from .multigrid import Below, Grid, p1_grid
from .nested import Coarse, nested_start
from .problem import Forms, Problem
from .solver import ContactRows, Iterations, solve_vi
from .space import closure_dofs, function_space, ghosted_vector, shared_maximum
from .transfer import Layout, prolongation

FloatArray = npt.NDArray[np.float64]
LevelMonitor = Callable[[int, int, float, int, int], None]
"""Called on all ranks: level, step, residual norm, active dofs, linear iterations so far."""


@dataclass
class Level:
    """One mesh with everything that is assembled on it.

    Attributes:
        forms: The compiled forms, shared by all levels.
        domain: Mesh and boundary parts.
        number: Position in the sequence, from 0.
        coarser: The level below, if there is one.
        parent_cell: For each local cell the cell of the coarser mesh that holds it.
    """

    forms: Forms
    domain: Domain
    number: int = 0
    coarser: Level | None = None
    parent_cell: npt.NDArray[np.int32] | None = None

    @cached_property
    def V(self) -> fem.FunctionSpace:
        """The discrete space."""
        return function_space(self.domain.mesh, self.forms.element)

    @cached_property
    def cells(self) -> Cells:
        """The mesh as arrays, for the Crouzeix-Raviart element."""
        return Cells(self.domain, self.V)

    @cached_property
    def load(self) -> Load:
        """Moments of f."""
        return Load.of(Data.of(self.forms).f, self.cells)

    @cached_property
    def edge(self) -> Edge:
        """Moments of g."""
        return Edge(Data.of(self.forms).g, self.cells)

    def tidy(self) -> None:
        """Drop what only solution and certificate needed; it is made again if asked for."""
        for name in ("cells", "load", "edge"):
            self.__dict__.pop(name, None)

    @cached_property
    def system(self) -> System:
        """The assembled variational inequality."""
        return System(self)

    @cached_property
    def grid(self) -> Grid:
        """The multigrid that starts with the discrete space."""
        A, dofs, dirichlet = self.system.A, Layout.of_space(self.V), self._owned_dirichlet
        if self._below is not None:
            grid, coarse_dofs, parent_cell = self._below
            transfer = prolongation(coarse_dofs, dofs, parent_cell)
            return Grid(A, dirichlet, transfer, grid, sweeps=2 if dofs.cr else 1)
        if dofs.cr:
            p1, _, into_cr = self._p1
            return Grid(A, dirichlet, into_cr, p1, on_same_mesh=True)
        return Grid(A, dirichlet)

    @cached_property
    def conforming(self) -> tuple[Grid, Layout]:
        """P1 on this mesh, for the next one, and its dofs."""
        if self.forms.element == "P1":
            return self.grid, Layout.of_space(self.V)
        return self._p1[:2]

    @cached_property
    def _p1(self) -> tuple[Grid, Layout, PETSc.Mat]:
        dofs = Layout.of_space(self.V)
        return p1_grid(self.system.A, dofs, self._owned_dirichlet, self._below)

    @property
    def _below(self) -> Below | None:
        if self.coarser is None or self.parent_cell is None:
            return None
        return (*self.coarser.conforming, self.parent_cell)

    @property
    def _owned_dirichlet(self) -> npt.NDArray[np.int32]:
        dofs = self.system.dirichlet
        return dofs[dofs < self.V.dofmap.index_map.size_local]


class System:
    """The variational inequality (1.8) as matrix, vector and bounds.

    Attributes:
        A: Matrix of a_h with the rows and columns of Γ0's dofs replaced by the identity's.
        b: Vector of χ less the Dirichlet values' share, the values themselves in their rows.
        chi: Vector of χ alone, ghosts up to date.
        lower: Bounds, α on Γ1 and `PETSc.NINFINITY` elsewhere, ghosts up to date, shape (dofs,).
        dirichlet: Local dofs on Γ0, ghosts included.
        u_D: Function with the Dirichlet values, 0 elsewhere.
        obstacle_at_vertices: α at the vertices of the contact facets, shape (n, d).
        load: Norm of the residual at the most trivial start, which all residuals are measured
            against: zero, raised to α on Γ1 where that is positive, u_D on Γ0.
    """

    def __init__(self, level: Level):
        forms, domain, V = level.forms, level.domain, level.V
        comm = domain.mesh.comm
        on_dirichlet, self.u_D, _ = _boundary_values(level, DIRICHLET)
        on_contact, lower, self.obstacle_at_vertices = _boundary_values(level, CONTACT)
        for key, values in (("dirichlet", self.u_D), ("obstacle", lower)):
            _require_finite(comm, key, values.x.array)
        # Where the two parts meet in a P1 vertex the Dirichlet value holds
        bounded = on_contact & ~on_dirichlet
        self.lower = np.where(bounded, lower.x.array, PETSc.NINFINITY)
        self.dirichlet = np.flatnonzero(on_dirichlet).astype(np.int32)
        bc = fem.dirichletbc(self.u_D, self.dirichlet)
        a = forms.a.on(domain, [V, V])
        self.A = assemble_matrix(a, [bc])
        self.A.assemble()
        self.A.setOption(PETSc.Mat.Option.SPD, True)
        self.chi = fem.Function(V)
        if forms.chi is not None:
            if forms.element == "CR":
                self.chi.x.array[:] = chi(level.load, level.edge, level.cells)
            else:
                fem.assemble_vector(self.chi.x.array, forms.chi.on(domain, [V]))
        self.b = fem.Function(V)
        self.b.x.array[:] = self.chi.x.array
        fem.apply_lifting(self.b.x.array, [a], [[bc]])
        for vector in (self.chi, self.b):
            vector.x.scatter_reverse(InsertMode.add)
            vector.x.scatter_forward()
        self.b.x.array[self.dirichlet] = self.u_D.x.array[self.dirichlet]
        _require_finite(comm, "f, g or coefficient", self.b.x.array)
        start, residual = self.start(), fem.Function(V)
        start.x.array[bounded] = np.maximum(self.lower[bounded], 0.0)
        self.load = self.residual(start, residual)

    def start(self) -> fem.Function:
        """The function that is u_D on Γ0 and 0 elsewhere."""
        u = fem.Function(self.u_D.function_space)
        u.x.array[:] = self.u_D.x.array
        return u

    def residual(self, u: fem.Function, r: fem.Function) -> float:
        """Compute r = A u − b, ghosts included, and its norm."""
        V = u.function_space
        x, y, b = (ghosted_vector(V, w.x.array) for w in (u, r, self.b))
        self.A.mult(x, y)
        y.axpy(-1.0, b)
        norm = y.norm()
        for vector in (x, y, b):
            vector.destroy()
        r.x.scatter_forward()
        return norm


@dataclass
class Solution:
    """u_h on one mesh, and what is known about it.

    Attributes:
        level: Mesh, space and assembled system.
        u: u_h.
        residual: r = A u_h − b; on Γ1 the contact forces, elsewhere what the solver left.
        contact: The state of Γ1.
        energy: J(u_h) = ½ a_h(u_h, u_h) − χ(u_h).
        iterations: Newton steps and linear iterations.
        seconds: Wall time of the phases mesh, assemble, solve, estimate.
        before: The solution on the mesh below that it was started from, if it was.
    """

    level: Level
    u: fem.Function
    residual: fem.Function
    contact: Contact
    energy: float
    iterations: Iterations
    seconds: dict[str, float] = field(default_factory=dict)
    before: fem.Function | None = None

    @property
    def domain(self) -> Domain:
        """Mesh and boundary parts."""
        return self.level.domain

    @property
    def problem(self) -> Problem:
        """The data."""
        return self.level.forms.problem

    @property
    def element(self) -> str:
        """The element's name: "CR" or "P1"."""
        return self.level.forms.element

    @property
    def cells(self) -> int:
        """Number of cells, over all ranks."""
        topology = self.domain.mesh.topology
        return topology.index_map(topology.dim).size_global

    @property
    def dofs(self) -> int:
        """Number of degrees of freedom, over all ranks."""
        return self.u.function_space.dofmap.index_map.size_global

    @cached_property
    def h(self) -> float:
        """Largest cell diameter, over all ranks."""
        mesh = self.domain.mesh
        number = mesh.topology.index_map(mesh.topology.dim).size_local
        h = mesh.h(mesh.topology.dim, np.arange(number, dtype=np.int32))
        return float(mesh.comm.allreduce(float(h.max(initial=0.0)), op=MPI.MAX))

    @cached_property
    def errors(self) -> tuple[float, float] | None:
        """‖u − u_h‖_h (1.6) and ‖u − u_h‖ in L2; None where u is not known."""
        forms = self.level.forms
        if forms.exact is None:
            return None
        h1, l2 = (
            np.sqrt(self._integrate(kernel.on(self.domain, (), [self.u])))
            for kernel in forms.squared_errors
        )
        return float(h1), float(l2)

    @cached_property
    def certificate(self) -> Certificate:
        """What is certain about the error; made when first asked for, collectively."""
        return certify(self)

    def _integrate(self, form: fem.Form) -> float:
        return float(self.domain.mesh.comm.allreduce(fem.assemble_scalar(form)))


def solve(
    problem: Problem,
    domain: Domain,
    element: str = "CR",
    monitor: LevelMonitor | None = None,
) -> Solution:
    """Solve on one mesh.

    Args:
        problem: The data; UFL expressions may be tied to the domain's mesh.
        domain: Mesh and boundary parts.
        element: "CR", or "P1" for the conforming element to compare with.
        monitor: Called after each step of the solver.

    Raises:
        InputError: The data are not finite on the mesh.
        NotConverged: The solver stopped short, with PETSc's name for the reason.
    """
    return _solve(Level(Forms(problem, domain.mesh, element), domain), None, monitor)


def solve_levels(
    problem: Problem,
    domain: Domain,
    levels: int,
    element: str = "CR",
    monitor: LevelMonitor | None = None,
    nested: bool = True,
) -> Iterator[Solution]:
    """Solve on a mesh and its uniform refinements, each starting from the one below.

    Args:
        problem: The data; they must not hold a Function, which lives on one mesh only.
        domain: The coarsest mesh and its boundary parts.
        levels: Number of meshes, the coarsest included.
        element: "CR" or "P1".
        monitor: Called after each step of the solver.
        nested: Start from the solution on the mesh below; otherwise from zero, to compare.

    Yields:
        The solutions, coarsest first.

    Raises:
        InputError: The data are not finite on a mesh, or tied to one.
        NotConverged: The solver stopped short on one of the levels.
    """
    if levels < 1:
        raise InputError(f"levels is {levels}; it must be 1 or more")

    def step(solution: Solution) -> tuple[Domain, npt.NDArray[np.int32]] | None:
        return refine(solution.domain) if solution.level.number + 1 < levels else None

    yield from solve_sequence(problem, domain, step, element, monitor, nested)


def solve_sequence(
    problem: Problem,
    domain: Domain,
    step: Callable[[Solution], tuple[Domain, npt.NDArray[np.int32]] | None],
    element: str = "CR",
    monitor: LevelMonitor | None = None,
    nested: bool = True,
) -> Iterator[Solution]:
    """Solve on a mesh and on those that ``step`` makes of it, one from the other.

    Args:
        problem: As for `solve_levels`.
        domain: The coarsest mesh and its boundary parts.
        step: Makes the next domain, and the parent of each of its cells, from a solution; None
            ends the sequence. `hierarchy.refine` and `hierarchy.refine_marked` return such pairs.
        element: "CR" or "P1".
        monitor: Called after each step of the solver.
        nested: Start from the solution on the mesh below; otherwise from zero, to compare.

    Yields:
        The solutions, coarsest first.
    """
    level = Level(Forms(problem, domain.mesh, element), domain)
    solution = _solve(level, None, monitor)
    while True:
        yield solution
        began = time.perf_counter()
        refined = step(solution)
        if refined is None:
            return
        level.tidy()
        level = Level(level.forms, refined[0], level.number + 1, level, refined[1])
        seconds = {"mesh": time.perf_counter() - began}
        solution = _solve(level, solution if nested else None, monitor, seconds)


def _solve(
    level: Level,
    coarser: Solution | None,
    monitor: LevelMonitor | None,
    seconds: dict[str, float] | None = None,
) -> Solution:
    seconds = {"mesh": 0.0} if seconds is None else seconds
    clock = time.perf_counter()
    system = level.system
    clock, seconds["assemble"] = time.perf_counter(), time.perf_counter() - clock
    u, residual = system.start(), fem.Function(level.V)
    arrays = system.b.x.array, system.lower, u.x.array, residual.x.array
    vectors = [ghosted_vector(level.V, array) for array in arrays]
    rows = ContactRows(system.A, vectors[1])
    if coarser is not None and level.parent_cell is not None:
        parents = coarser.level.parent_cell
        before = None if coarser.before is None or parents is None else (coarser.before, parents)
        lower = coarser.level.system.lower
        below = Coarse(coarser.domain, coarser.u, coarser.residual, lower, before)
        b, dirichlet = system.b.x.array, system.dirichlet
        nested_start(below, level.domain, level.parent_cell, u, rows, b, dirichlet)
    iterations = solve_vi(
        level.grid,
        rows,
        *vectors,
        load=system.load,
        monitor=None if monitor is None else lambda *facts: monitor(level.number, *facts),
        level=level.number,
    )
    if level.forms.element != "P1":
        level.grid.free()  # the next level needs P1 alone
        del level.grid
    for thing in (rows, *vectors):
        thing.destroy()
    for function in (u, residual):
        function.x.scatter_forward()
    clock, seconds["solve"] = time.perf_counter(), time.perf_counter() - clock
    contact = contact_facts(
        level.domain,
        u,
        residual,
        diagonal=system.A.getDiagonal().array,
        lower=system.lower,
        obstacle_at_vertices=system.obstacle_at_vertices,
        load=system.load,
    )
    owned = level.V.dofmap.index_map.size_local
    comm = level.domain.mesh.comm
    form = level.forms.a_of_w.on(level.domain, (), [u])
    energy = comm.allreduce(
        0.5 * fem.assemble_scalar(form) - system.chi.x.array[:owned] @ u.x.array[:owned]
    )
    seconds["estimate"] = time.perf_counter() - clock
    before = None if coarser is None else coarser.u
    return Solution(level, u, residual, contact, float(energy), iterations, seconds, before)


def _boundary_values(
    level: Level, part: int
) -> tuple[npt.NDArray[np.bool_], fem.Function, FloatArray]:
    """Data on one boundary part as the element takes them.

    Returns:
        Which dofs lie on the part, a Function with the values there, and the values at the
        facets' vertices, shape (n, d).
    """
    V, domain = level.V, level.domain
    facets = domain.facets(part)
    means, at_vertices = level.forms.boundary_data[part].at(domain, facets)
    dofs = closure_dofs(V, facets)
    values, on_part = fem.Function(V), np.zeros(len(fem.Function(V).x.array))
    values.x.array[:] = PETSc.NINFINITY
    values.x.array[dofs] = means[:, None] if dofs.shape[1] == 1 else at_vertices
    on_part[dofs] = 1.0
    # A rank may own a dof of the part without owning any of its facets
    for array in (values.x.array, on_part):
        shared_maximum(V, array)
    values.x.array[on_part == 0.0] = 0.0
    return on_part > 0.0, values, at_vertices


def _require_finite(comm: MPI.Comm, key: str, values: FloatArray) -> None:
    raise_together(
        comm, None if np.isfinite(values).all() else f"{key} is not finite everywhere on the mesh"
    )
