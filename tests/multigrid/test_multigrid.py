"""Nested meshes in the solver: prolongation, multigrid in the active set, starts from below."""

import gc
import weakref
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
import pytest
import ufl
from dolfinx import fem
from dolfinx.fem.petsc import assemble_matrix
from dolfinx.mesh import (
    compute_midpoints,
    create_rectangle,
    create_unit_cube,
    exterior_facet_indices,
    meshtags,
)
from helpers import SQUARE
from mpi4py import MPI
from petsc4py import PETSc

from signorini_cr import NotConverged, Polygon, Problem, exact, garbage, solve, solve_levels
from signorini_cr.diffusion import Diffusion
from signorini_cr.fem.layout import Layout
from signorini_cr.fem.space import function_space, ghosted_vector
from signorini_cr.mesh.domain import CONTACT, DIRICHLET, NEUMANN, Domain
from signorini_cr.mesh.refinement import SIMILAR, refine, refine_marked
from signorini_cr.multigrid import bottom
from signorini_cr.multigrid.constrained import ConstrainedMatrix
from signorini_cr.multigrid.cycle import Grid, Multigrid, is_galerkin_product
from signorini_cr.multigrid.hierarchy import Hierarchy, NestedMesh, conforming
from signorini_cr.multigrid.parents import Parents
from signorini_cr.multigrid.smoothing import GaussSeidel
from signorini_cr.multigrid.transfer import Ancestor, inclusion, prolongate, prolongation
from signorini_cr.options import AMG
from signorini_cr.vi import solver
from signorini_cr.vi.level import Level
from signorini_cr.vi.nested import nested_start
from signorini_cr.vi.reduced import ReducedSolver
from signorini_cr.vi.solver import solve_vi

pytestmark = [pytest.mark.slow, pytest.mark.ranks]

# Obtuse corners, a hole, and contact in three pieces that meet in a corner and at the hole
CROOKED = Polygon(
    [[0, 0], [3, -0.4], [3.6, 1.1], [1.2, 1.4], [0.2, 2.0]],
    ["contact", "contact", "dirichlet", "neumann", "dirichlet"],
    holes=[Polygon([[1, 0.5], [1.7, 0.4], [1.3, 0.9]], ["contact", "neumann", "dirichlet"])],
)


TRIANGLE = Polygon([[0, 0], [1, 0], [0, 1]], ["contact", "dirichlet", "neumann"])


def stiffness(x):
    return ufl.conditional(x[0] < 1.3, 1.0, 50.0)


PUSHED = Problem(
    f=lambda x: stiffness(x) * (12 * ufl.sin(5 * x[0]) - 5),
    g=lambda x: x[1] - 1,
    obstacle=lambda x: 0.05 * x[0],
    dirichlet=lambda x: 0.5 + x[1],
    coefficient=stiffness,
)
HARD = [exact.S1, exact.A, exact.root(3.5), exact.root(5.5)]


def refined(domain, pattern):
    """Refine everywhere, or every third cell, or near a point."""
    if pattern == "all":
        return refine(domain)
    cells = domain.mesh.topology.index_map(2).size_local
    return refine_marked(domain, np.arange(0, cells, 3, dtype=np.int32))


def related(coarse, fine, parent_cell):
    """As a hierarchy does it, which knows of the pattern where there is one."""
    return Parents(coarse.mesh, fine.mesh, parent_cell, pattern=fine.descent[-1].pattern)


def vector(V, array):
    return ghosted_vector(V, array.copy())


def difference(a, b):
    """Largest difference over all ranks."""
    return MPI.COMM_WORLD.allreduce(float(np.abs(a - b).max(initial=0.0)), op=MPI.MAX)


def affine(x):
    return 2.0 * x[0] - 3.0 * x[1] + 1.0


@pytest.mark.parametrize("element", ["CR", "P1"])
@pytest.mark.parametrize("pattern", ["all", "marked"])
def test_affine_functions_are_prolonged_exactly(element, pattern):
    coarse = CROOKED.mesh(0.4)
    fine, parent_cell = refined(coarse, pattern)
    u, v = (fem.Function(function_space(d.mesh, element)) for d in (coarse, fine))
    for function in (u, v):
        function.interpolate(affine)
    parents = related(coarse, fine, parent_cell)
    result = prolongate(u, v.function_space, parents)
    assert difference(result, v.x.array) < 1e-12


@pytest.mark.parametrize("seed", range(20))
def test_children_in_a_row_need_not_repeat(seed):
    """Every cell has four children, but not all of them the same four."""
    rng = np.random.default_rng(seed)
    corners = np.array([[0, 0], [1, 0], [1, 1], [0, 1]]) + rng.uniform(-0.3, 0.3, (4, 2))
    polygon = Polygon(corners, ["contact", "dirichlet", "neumann", "dirichlet"])
    coarse = polygon.mesh(polygon.diameter)
    cells = coarse.mesh.topology.index_map(2).size_local
    fine, parent_cell = refine_marked(coarse, np.ones(cells, dtype=bool))
    u, v = (fem.Function(function_space(d.mesh)) for d in (coarse, fine))
    for function in (u, v):
        function.interpolate(affine)
    parents = related(coarse, fine, parent_cell)
    assert difference(prolongate(u, v.function_space, parents), v.x.array) < 1e-12


def test_a_hierarchy_knows_how_cells_were_cut():
    """What it knows is what a search among the cells finds."""
    *_, last = solve_levels(exact.S1.problem, exact.S1.structured(4), 2)
    parents = last.level.parents
    assert parents.barycentric is SIMILAR
    coarse = last.level.meshes[0].domain.mesh
    found = Parents(coarse, last.domain.mesh, parents.cell).barycentric
    assert found.shape == SIMILAR.shape and np.abs(found - SIMILAR).max() < 1e-14


def averaging(coarse, fine, parents):
    """The matrix of the prolongation from CR to CR, put together cell by cell."""
    weights = parents.weights(coarse, fine)
    weights = np.tile(weights, (len(parents.cell) // max(len(weights), 1), 1, 1))
    touching = np.zeros(fine.index_map.size_local + fine.index_map.num_ghosts)
    np.add.at(touching, fine.cells, 1.0)
    shares = weights / fine.shared_sum(touching)[fine.cells][:, :, None]
    matrix = PETSc.Mat().createAIJ((fine.size, coarse.size), nnz=(6, 6), comm=fine.mesh.comm)
    rows, columns = fine.numbers(fine.cells), coarse.numbers(coarse.cells)
    for cell, parent in enumerate(parents.cell):
        matrix.setValues(rows[cell], columns[parent], shares[cell], PETSc.InsertMode.ADD_VALUES)
    matrix.assemble()
    return matrix


@pytest.mark.parametrize("element", ["CR", "P1"])
@pytest.mark.parametrize("pattern", ["all", "marked"])
@pytest.mark.parametrize("size", [0.4, TRIANGLE.diameter])
def test_prolongation_is_its_matrix(element, pattern, size):
    """On few cells, too, when ranks have none."""
    coarse = (CROOKED if size < 1.0 else TRIANGLE).mesh(size)
    fine, parent_cell = refined(coarse, pattern)
    V, W = (function_space(d.mesh, element) for d in (coarse, fine))
    parents = related(coarse, fine, parent_cell)
    spaces = Layout.of_space(V), Layout.of_space(W), parents
    matrix = averaging(*spaces) if element == "CR" else prolongation(*spaces).matrix()
    u = fem.Function(V)
    u.x.array[:] = np.random.default_rng(MPI.COMM_WORLD.rank).standard_normal(len(u.x.array))
    u.x.scatter_forward()
    product = matrix.createVecLeft()
    matrix.mult(vector(V, u.x.array), product)
    owned = W.dofmap.index_map.size_local
    assert difference(product.array_r, prolongate(u, W, parents)[:owned]) < 1e-12


@pytest.mark.parametrize("element", ["CR", "P1", "same mesh"])
@pytest.mark.parametrize("pattern", ["all", "marked"])
@pytest.mark.parametrize("size", [0.4, TRIANGLE.diameter])
def test_transfers_are_their_matrices(element, pattern, size):
    """What they add, restrict and touch, on few cells, too, when ranks have none."""
    coarse = (CROOKED if size < 1.0 else TRIANGLE).mesh(size)
    fine, parent_cell = refined(coarse, pattern)
    if element == "same mesh":
        p1, dofs = Layout.of_p1(fine.mesh), Layout.of_space(function_space(fine.mesh))
        transfer = inclusion(p1, dofs)
    else:
        parents = related(coarse, fine, parent_cell)
        p1, dofs = Layout.of_p1(coarse.mesh), Layout.of_space(function_space(fine.mesh, element))
        transfer = prolongation(p1, dofs, parents)
    matrix = transfer.matrix()
    rng = np.random.default_rng(MPI.COMM_WORLD.rank)
    x_coarse, x, b_coarse = transfer.coarse_vector(), *matrix.createVecs()[::-1]
    x_coarse.array[:] = rng.standard_normal(x_coarse.local_size)
    x.array[:] = rng.standard_normal(x.local_size)
    expected = matrix.createVecLeft()
    matrix.multAdd(x_coarse, x, expected)
    transfer.add(x_coarse, x)
    assert difference(x.array_r, expected.array_r) < 1e-14

    matrix.multTranspose(x, b_coarse)
    transfer.restrict(x, x_coarse)
    assert difference(x_coarse.array_r, b_coarse.array_r) < 1e-13

    chosen = np.flatnonzero(rng.random(x.local_size) < 0.1).astype(np.int32)
    x.set(0.0)
    x.array[chosen] = 1.0
    matrix.multTranspose(x, b_coarse)
    for _ in range(2):  # the second time where there are marks already
        assert np.array_equal(transfer.coarse_support(chosen), np.flatnonzero(b_coarse.array_r))
    assert not len(transfer.coarse_support(chosen[:0]))


def test_p1_in_cr_has_the_p1_stiffness_matrix():
    """Also with a coefficient that varies and a term of order zero."""
    mesh = CROOKED.mesh(0.3).mesh
    V, W = function_space(mesh, "CR"), fem.functionspace(mesh, ("Lagrange", 1))

    def matrix(space):
        u, v, x = ufl.TrialFunction(space), ufl.TestFunction(space), ufl.SpatialCoordinate(mesh)
        form = (2 + x[0] ** 2) * ufl.inner(ufl.grad(u), ufl.grad(v)) + u * v
        A = assemble_matrix(fem.form(form * ufl.dx))
        A.assemble()
        return A

    product = matrix(V).ptap(inclusion(Layout.of_space(W), Layout.of_space(V)).matrix())
    product.axpy(-1.0, matrix(W))
    assert product.norm() < 1e-12


def tensor(x):
    return ufl.as_matrix([[2.0 + x[0], 0.5], [0.5, 1.0]])


@pytest.mark.parametrize(
    ("make", "coefficient"),
    [
        (lambda: exact.S1.structured(4), 3.0),
        (lambda: CROOKED.mesh(0.3), stiffness),
        (lambda: refined(CROOKED.mesh(0.5), "some")[0], tensor),
        (lambda: boxed(create_rectangle(MPI.COMM_WORLD, [[0.0, 0.0], [2.0, 1.0]], [9, 5])), tensor),
        (lambda: boxed(create_unit_cube(MPI.COMM_WORLD, 3, 4, 3)), stiffness),
        (lambda: TRIANGLE.mesh(TRIANGLE.diameter), stiffness),  # one rank has all
    ],
    ids=["structured", "crooked", "marked", "ghosts", "space", "tiny"],
)
def test_matrix_of_p1_without_a_product(make, coefficient):
    """It is what the product with the inclusion gives, on Γ0 the identity."""
    domain = make()
    level = alone(Problem(coefficient=coefficient), domain)
    operator, p1, _ = conforming(level.meshes[0])
    product = level.system.A.ptap(inclusion(p1, Layout.of_space(level.V)).matrix())
    on_dirichlet = vertex_dofs(domain, p1, DIRICHLET)
    product.zeroRowsColumns(on_dirichlet + product.getOwnershipRange()[0], 1.0)
    assert np.array_equal(operator.dofs, vertex_dofs(domain, p1, CONTACT))
    product.axpy(-1.0, operator.matrix)
    assert product.norm() <= 1e-14 * operator.matrix.norm()


def alone(problem, domain):
    return Level(Hierarchy(Diffusion(problem, domain.mesh), domain).meshes)


def boxed(mesh):
    """A box with contact on its lower, Γ0 on its upper side."""
    d = mesh.topology.dim
    mesh.topology.create_connectivity(d - 1, d)
    facets = exterior_facet_indices(mesh.topology)
    height = compute_midpoints(mesh, d - 1, facets)[:, d - 1]
    values = np.where(np.isclose(height, 0.0), CONTACT, NEUMANN)
    values[np.isclose(height, 1.0)] = DIRICHLET
    return Domain.from_tags(mesh, meshtags(mesh, d - 1, facets, values.astype(np.int32)))


def vertex_dofs(domain, p1, part):
    """Owned dofs of P1 at the vertices of a boundary part, found by DOLFINx."""
    W = fem.functionspace(domain.mesh, ("Lagrange", 1))
    there = fem.Function(W)
    dofs = fem.locate_dofs_topological(W, domain.mesh.topology.dim - 1, domain.facets(part))
    there.x.array[dofs] = 1.0
    values = np.zeros(p1.size[0] + p1.index_map.num_ghosts)
    values[p1.cells] = there.x.array[W.dofmap.list]
    return np.flatnonzero(values[: p1.size[0]]).astype(np.int32)


def last(problem, domain, levels, **more):
    *_, solution = solve_levels(problem, domain, levels, **more)
    return solution


@pytest.mark.parametrize("shift", [0.0, 0.31])
@pytest.mark.parametrize("example", HARD, ids=lambda e: e.name)
def test_few_steps_on_every_level(example, shift):
    """Also where contact ends inside a facet; a cold start needs up to 12 Newton steps here."""
    domain = example.structured(4, shift=shift)
    for solution in solve_levels(example.problem, domain, 6):
        if solution.level.number > 1:
            assert solution.iterations.newton <= 3
            assert solution.iterations.linear <= 17


def active(system, u, residual):
    at_bound = u.x.array[system.bounded] <= system.lower[system.bounded]
    return at_bound & (residual.x.array[system.bounded] > 0)


@pytest.mark.parametrize(
    ("example", "shift", "squares", "levels"),
    [
        *((example, shift, 4, 5) for example in HARD for shift in (0.0, 0.31)),
        (exact.root(5.5), 0.0, 23, 3),
    ],
    ids=lambda value: getattr(value, "name", str(value)),
)
def test_the_same_solution_as_a_direct_solver(
    example, shift, squares, levels, options, monkeypatch
):
    """The active set facet by facet, and the residual the report promises.

    Contact ends in C with a pressure that grows like the power 2.5 or 4.5 of the distance, so that
    whether the last facet is active shows in digits that the residual as a whole does not need. On
    the last of these meshes a cold start with our tolerance has one facet wrong.
    """
    solution = last(example.problem, example.structured(squares, shift=shift), levels)
    system, V, comm = solution.level.system, solution.u.function_space, MPI.COMM_WORLD
    u, r = system.start(), fem.Function(V)
    options("ksp_type", "preonly")
    options("pc_type", "lu")
    options("pc_factor_mat_solver_type", "mumps")
    monkeypatch.setattr(solver, "TOLERANCE", 1e-13)
    grid = Grid.at_bottom(system.operator, Layout.of_space(V), system.owned_dirichlet)
    with system.vectors(u, r) as vectors:
        cold = solve_vi(Multigrid([grid]), vectors, system.residual_scale)
    assert cold.newton > 1
    for function in (u, r):
        function.x.scatter_forward()
    # in the energy norm, far below the error of the discretisation
    error, image = fem.Function(V), fem.Function(V)
    error.x.array[:] = u.x.array - solution.u.x.array
    system.A.mult(ghosted_vector(V, error.x.array), ghosted_vector(V, image.x.array))
    owned = V.dofmap.index_map.size_local
    energy = comm.allreduce(float(error.x.array[:owned] @ image.x.array[:owned]))
    assert np.sqrt(energy) < 1e-4 * solution.errors[0]

    theirs = active(system, u, r)
    assert np.array_equal(theirs, active(system, solution.u, solution.residual))
    free = solution.residual.x.array[:owned].copy()
    free[system.bounded[theirs]] = 0.0
    norm = np.sqrt(comm.allreduce(float(free @ free)))
    assert norm <= 1e-8 * system.residual_scale


def test_a_matrix_is_constrained_in_a_block_and_whole_after_it():
    """The identity in rows and columns, Gauss-Seidel as on a copy; afterwards bit for bit A."""
    system = alone(PUSHED, CROOKED.mesh(0.3)).system
    A, before = system.A, system.A.copy()
    operator = ConstrainedMatrix(A, system.bounded)
    x, y, z = (A.createVecRight() for _ in range(3))
    first = A.getOwnershipRange()[0]
    x.array = np.sin(1.0 + np.arange(first, first + x.local_size))
    norm = before.norm()
    for fixed in (operator.dofs[::2], operator.dofs[1::3], operator.dofs, operator.dofs[:0]):
        expected = before.copy()
        expected.zeroRowsColumns((fixed + first).astype(PETSc.IntType), 1.0)
        before.mult(x, z)
        with operator.constrained(fixed) as constrained:
            assert np.array_equal(constrained, fixed)
            assert difference(operator.times(x), z.array[operator.dofs]) < 1e-14 * norm
            sweep = PETSc.Mat.SORType.LOCAL_FORWARD_SWEEP | PETSc.Mat.SORType.ZERO_INITIAL_GUESS
            A.SOR(x, y, 1.3, sweep)
            expected.SOR(x, z, 1.3, sweep)
            assert difference(y.array, z.array) < 1e-14
            expected.axpy(-1.0, A)
            assert expected.norm() == 0.0
        assert same(A, before)


def same(A, B):
    rest = A.copy()
    rest.axpy(-1.0, B)
    return rest.norm() == 0.0


@pytest.mark.ranks
@pytest.mark.parametrize("lone", [0, MPI.COMM_WORLD.size - 1])
def test_after_a_failure_on_one_rank_a_matrix_is_whole_on_all(lone):
    """The others leave the block when it is their time; no rank waits for another."""
    comm, system = MPI.COMM_WORLD, alone(PUSHED, CROOKED.mesh(0.3)).system
    before = system.A.copy()
    try:
        with system.operator.constrained(system.bounded):
            assert not same(system.A, before)
            if comm.rank == lone:
                raise RuntimeError("alone")
            comm.recv(source=lone)
    except RuntimeError:
        for rank in set(range(comm.size)) - {lone}:
            comm.send("out of the block", dest=rank)
    assert same(system.A, before)


@contextmanager
def watched(levels=3):
    """A cycle, a system and its vectors, and the matrices of all grids with copies of them."""
    meshes = list(solve_levels(PUSHED, CROOKED.mesh(0.4), levels))[-1].level.meshes
    hierarchy = Hierarchy(meshes[0].physics, meshes[0].domain)
    for mesh in meshes[1:]:
        hierarchy.add(mesh.domain, mesh.parents.cell)
    system = Level(hierarchy.meshes).system
    u, r = system.start(), fem.Function(system.u_D.function_space)
    with (
        hierarchy.multigrid(system.operator, system.owned_dirichlet) as cycle,
        system.vectors(u, r) as vectors,
    ):
        matrices = [(grid.matrix, grid.matrix.copy()) for grid in cycle.grids]
        yield cycle, vectors, system.residual_scale, matrices
    hierarchy.free()


@pytest.mark.ranks
@pytest.mark.parametrize("levels", [1, 3])
def test_after_a_block_the_cycle_is_that_of_the_whole_matrices(levels):
    """With factors, Schur complements and sweeps: what it makes of a vector is as it was before."""
    with watched(levels) as (cycle, _, _, matrices):
        (b, x), bounded = cycle.matrix.createVecs(), cycle.operator.dofs
        values = np.random.default_rng(MPI.COMM_WORLD.rank).standard_normal(b.local_size)

        def applied(left_out):
            b.array[:] = values
            b.array[left_out] = b.array[cycle.finest.dirichlet] = 0.0
            cycle.apply(None, b, x)
            return x.array.copy()

        before = applied(bounded[:0])
        with cycle.constrained(bounded):
            assert difference(applied(bounded), before) > 0.01 * np.abs(before).max(initial=0.0)
        assert difference(applied(bounded[:0]), before) < 1e-12
        with cycle.constrained(bounded[::2]):
            within = applied(bounded[::2])
        with cycle.constrained(bounded[1::2]):
            pass
        with cycle.constrained(bounded[::2]):
            assert difference(applied(bounded[::2]), within) < 1e-12
        assert all(same(*pair) for pair in matrices)


@pytest.mark.ranks
@pytest.mark.parametrize("lone", [0, MPI.COMM_WORLD.size - 1])
def test_after_a_failure_on_one_rank_in_a_solve_all_matrices_are_whole(lone):
    """What a monitor raises on one rank stops all; then they solve as if nothing had been."""
    rank, seen = MPI.COMM_WORLD.rank, []

    def monitor(*_):
        seen.append(0)
        if rank == lone and len(seen) == 2:
            raise KeyError("alone")

    with watched() as (cycle, vectors, scale, matrices):
        # PETSc leaves a vector locked that a monitor was to look at
        first, other = (replace(vectors, x=vectors.x.copy()) for _ in range(2))
        undisturbed = solve_vi(cycle, first, scale)
        with pytest.raises(KeyError if rank == lone else RuntimeError, match="alone"):
            solve_vi(cycle, vectors, scale, monitor=monitor)
        assert len(seen) == 2 and len(matrices) == 3
        assert all([same(*pair) for pair in matrices])
        assert solve_vi(cycle, other, scale) == undisturbed
        assert np.array_equal(first.x.array, other.x.array)


@pytest.mark.ranks
@pytest.mark.parametrize("lone", [0, MPI.COMM_WORLD.size - 1])
def test_after_a_failure_on_one_rank_amid_constrained_matrices_all_are_whole(monkeypatch, lone):
    """One rank leaves the block by an error, which tells the others nothing."""
    run, solve_reduced = ReducedSolver._run, ReducedSolver.solve
    with watched() as (cycle, vectors, scale, matrices):

        def fail_there(self, forces):
            test = run(self, forces)
            assert not any([same(*pair) for pair in matrices])
            if MPI.COMM_WORLD.rank == lone:
                raise ArithmeticError("alone")
            return test

        def end_here(*args):
            solve_reduced(*args)
            raise RuntimeError("out of the block")

        monkeypatch.setattr(ReducedSolver, "_run", fail_there)
        monkeypatch.setattr(ReducedSolver, "solve", end_here)
        with pytest.raises(ArithmeticError if MPI.COMM_WORLD.rank == lone else RuntimeError):
            solve_vi(cycle, vectors, scale)
        assert len(matrices) == 3 and all([same(*pair) for pair in matrices])


def test_after_an_error_inside_the_cycle_all_matrices_are_whole(monkeypatch):
    """With every grid constrained when it happens."""
    with watched() as (cycle, vectors, scale, matrices):

        def fail(*_):
            assert not any([same(*pair) for pair in matrices])
            raise ArithmeticError("in the cycle")

        monkeypatch.setattr(GaussSeidel, "backward", fail)
        with pytest.raises(ArithmeticError):
            solve_vi(cycle, vectors, scale)
        assert len(matrices) == 3 and all(same(*pair) for pair in matrices)


def test_petsc_frees_what_is_left_of_a_sequence(monkeypatch):
    """On several ranks it keeps what is not freed in so many words, until it is told to."""
    told, cleanup = [], PETSc.garbage_cleanup

    def clean_up(comm):
        told.append(comm)
        cleanup(comm)

    monkeypatch.setattr(PETSc, "garbage_cleanup", clean_up)
    others = [mesh for _, mesh in garbage._held]  # of tests before
    for _ in range(2):
        last(exact.A.problem, exact.A.structured(4), 3)
        gc.collect()
    alone = MPI.COMM_WORLD.size == 1
    assert (len(told) == 0) if alone else (len(told) >= 3)
    gone = {id(mesh) for owner, mesh in garbage._held if owner() is None}
    gone -= set(map(id, others))
    assert len(gone) == (0 if alone else 3)  # the second sequence's, until there is a third


def test_nothing_outlives_its_solution():
    """Nobody else holds on to a solution's matrix."""
    solution = last(exact.A.problem, exact.A.structured(4), 3)
    matrix = weakref.ref(solution.level.system.A)
    assert matrix() is not None
    del solution
    gc.collect()
    assert matrix() is None


@pytest.mark.parametrize("element", ["CR", "P1"])
def test_contact_in_several_pieces_and_corners(element):
    """With a coefficient that jumps, a linear obstacle, Neumann data."""
    nested = last(PUSHED, CROOKED.mesh(0.4), 5, element=element)
    cold = last(PUSHED, CROOKED.mesh(0.4), 5, element=element, nested=False)
    assert nested.energy == pytest.approx(cold.energy, rel=1e-9)
    assert nested.contact.number_active == cold.contact.number_active
    assert len(nested.contact.transitions) == (8 if element == "CR" else 6)
    assert nested.iterations.newton < cold.iterations.newton
    if element == "CR":
        assert nested.iterations.newton <= 3
    assert nested.iterations.linear <= 40


@pytest.mark.parametrize("element", ["CR", "P1"])
@pytest.mark.parametrize("jump", [1e3, 1e6])
def test_a_coefficient_that_jumps_inside_coarse_cells(element, jump, options):
    """Coarse matrices made on their own meshes needed 172 steps with CR and the larger jump."""
    disc = Problem(
        f=-5.0,
        coefficient=lambda x: ufl.conditional(
            (x[0] - 0.5) ** 2 + (x[1] - 0.2) ** 2 < 0.04, jump, 1.0
        ),
    )
    domain = exact.S1.mesh(0.3)
    solutions = list(solve_levels(disc, domain, 6, element))
    assert max(s.iterations.linear for s in solutions) <= 25
    level, below = solutions[-1].level, solutions[-2].level
    with in_cycle(solutions) as cycle:
        layout = cycle.grids[1].dofs
        transfer = prolongation(layout, Layout.of_space(level.V), level.parents)
        assert is_galerkin_product(cycle.grids[1], level.system.A, transfer)
    if element == "P1":
        own = Grid.at_bottom(below.system.operator, layout, below.system.owned_dirichlet)
    else:
        own = Grid.at_bottom(*conforming(below.meshes[-1]))
    assert not is_galerkin_product(own, level.system.A, transfer)

    options("pc_type", AMG)
    options("snes_atol", 1e-12 * level.system.residual_scale)
    other = last(disc, domain, 6, element=element)
    assert other.energy == pytest.approx(solutions[-1].energy, rel=1e-9)
    assert other.contact.number_active == solutions[-1].contact.number_active


def test_a_residual_lost_in_rounding_ends_the_solve():
    """A strip a million times stiffer: A u is known to ten times what the tolerance asks for."""
    strip = Problem(
        f=-5.0,
        coefficient=lambda x: ufl.conditional(abs(x[1] - 0.31) < 0.01, 1e6, 1.0),
    )
    for solution in solve_levels(strip, exact.S1.mesh(0.3), 5):
        terms = solution.level.system.A.getDiagonal()
        terms.pointwiseMult(terms, vector(solution.u.function_space, solution.u.x.array))
        rounding = terms.norm() / 2**52
        residual = solution.contact.kkt.residual * solution.level.system.residual_scale
        assert residual < 1e-8 * solution.level.system.residual_scale or residual < 2.0 * rounding
        assert solution.iterations.newton <= 3


@pytest.mark.parametrize("example", [exact.S1, exact.A], ids=lambda e: e.name)
def test_the_first_active_set_is_nearly_the_last(example):
    """At most one facet off where contact ends, and with forces that hold it there."""
    *_, before, coarse, fine = solve_levels(example.problem, example.mesh(0.2), 4)
    system, level = fine.level.system, fine.level
    start, residual = system.start(), fem.Function(level.V)
    nested_start(coarse, level, start, before.u)
    start.x.scatter_forward()
    system.residual(start, residual)
    bounded, comm = system.bounded, MPI.COMM_WORLD
    gap = start.x.array[bounded] - system.lower[bounded]
    force = residual.x.array[bounded]
    assert np.all(gap >= 0)
    first = gap == 0
    assert np.all(force[first] > 0)
    last = fine.u.x.array[bounded] <= system.lower[bounded]
    assert comm.allreduce(int(np.sum(first != last))) <= 1
    assert comm.allreduce(int(first.sum())) > 20
    assert comm.allreduce(float(force[first].sum())) == pytest.approx(fine.contact.force, rel=0.01)
    assert len(level.domain.facets(CONTACT)) == len(bounded)


def test_a_constant_added_to_the_data_changes_nothing():
    """Neither the set nor, up to what is left of the residual, the force."""

    def shifted(c):
        problem = Problem(
            f=lambda x: 5 * ufl.sin(9 * x[0] + 5 * x[1]),
            obstacle=lambda x: c + 0.2 * x[1] * (1 - x[1]),
            dirichlet=c,
        )
        square = Polygon(SQUARE.vertices, ["contact"] * 3 + ["dirichlet"])
        return last(problem, square.mesh(0.3), 4)

    plain, lifted = shifted(0.0), shifted(1e3)
    scales = [each.level.system.residual_scale for each in (lifted, plain)]
    assert scales[0] == pytest.approx(scales[1], rel=1e-6)
    assert lifted.contact.number_active == plain.contact.number_active > 0
    assert lifted.contact.force == pytest.approx(plain.contact.force, rel=1e-6)


@contextmanager
def in_cycle(solutions):
    """The cycle on the last mesh of a sequence, made anew."""
    meshes = solutions[-1].level.meshes
    hierarchy = Hierarchy(meshes[0].physics, meshes[0].domain)
    for number, solution in enumerate(solutions):
        if number > 0:
            hierarchy.add(meshes[number].domain, meshes[number].parents.cell)
        system = solution.level.system
        with hierarchy.multigrid(system.operator, system.owned_dirichlet) as cycle:
            if solution is solutions[-1]:
                yield cycle
    hierarchy.free()


def test_a_level_can_be_solved_again():
    """The multigrid is made anew, on the coarsest mesh too."""
    solution = last(exact.S1.problem, exact.S1.structured(4), 1)
    system = solution.level.system
    u, r = system.start(), fem.Function(solution.level.V)
    with in_cycle([solution]) as cycle, system.vectors(u, r) as vectors:
        again = solve_vi(cycle, vectors, system.residual_scale)
    assert again.newton == solution.iterations.newton
    owned = solution.level.V.dofmap.index_map.size_local
    assert difference(u.x.array[:owned], solution.u.x.array[:owned]) < 1e-12


def test_extrapolation_comes_nearer():
    """By an order of magnitude where the solution is smooth."""
    *_, middle, coarse = solve_levels(exact.A.problem, exact.A.mesh(0.2), 4)
    fine, parent_cell = refine(coarse.domain)
    parents = Parents(coarse.domain.mesh, fine.mesh, parent_cell)
    level = Level((*coarse.level.meshes, NestedMesh(coarse.level.physics, fine, parents)))
    below = Ancestor(middle.u, coarse.level.parents)
    norms = []
    for start in (prolongate(coarse.u, level.V, level.parents, b) for b in (None, below)):
        u, residual = level.system.start(), fem.Function(level.V)
        boundary = u.x.array[level.system.dirichlet].copy()
        u.x.array[:] = start
        u.x.array[level.system.dirichlet] = boundary
        level.system.residual(u, residual)
        inside = residual.x.array[: level.V.dofmap.index_map.size_local].copy()
        inside[np.flatnonzero(level.system.lower[: len(inside)] > PETSc.NINFINITY)] = 0.0
        norms.append(np.sqrt(MPI.COMM_WORLD.allreduce(float(inside @ inside))))
    assert norms[1] < 0.3 * norms[0]


def test_the_figures_do_not_depend_on_the_ranks():
    """Against the same run on one process, by every rank for itself."""
    example, comm = exact.A, MPI.COMM_WORLD
    alone = last(example.problem, example.structured(3, MPI.COMM_SELF), 5)
    together = last(example.problem, example.structured(3), 5)
    assert together.dofs == alone.dofs
    assert together.energy == pytest.approx(alone.energy, rel=1e-10)
    assert together.contact.number_active == alone.contact.number_active
    assert together.contact.force == pytest.approx(alone.contact.force, rel=1e-7)
    assert abs(together.iterations.linear - alone.iterations.linear) <= 4
    assert comm.allreduce(together.iterations.linear, op=MPI.MAX) == together.iterations.linear


def test_a_mesh_without_a_hierarchy():
    """Fine enough for algebraic multigrid to take the P1 part over."""
    one = solve(exact.S1.problem, exact.S1.mesh(0.02))
    assert ("BoomerAMG" if AMG == "hypre" else "GAMG") in one.iterations.preconditioner
    assert one.iterations.linear <= 25
    assert one.errors[0] < 0.05
    few = solve(exact.S1.problem, exact.S1.mesh(0.1))
    assert "direct" in few.iterations.preconditioner


def test_a_petsc_without_hypre(monkeypatch):
    """GAMG is in every PETSc."""
    domain = exact.S1.mesh(0.02)
    usual = solve(exact.S1.problem, domain)
    monkeypatch.setitem(bottom.BOOMERAMG, "pc_type", PETSc.PC.Type.GAMG)
    other = solve(exact.S1.problem, domain)
    assert "GAMG" in other.iterations.preconditioner
    assert other.iterations.linear <= 30
    assert other.energy == pytest.approx(usual.energy, rel=1e-9)
    assert other.contact.number_active == usual.contact.number_active


@pytest.mark.parametrize("finished", [2, 3])
def test_solving_leaves_the_matrices_of_all_meshes_whole(finished, options):
    """Those of P1 are the multigrid's, too, whether or not it converges."""
    sequence = solve_levels(exact.A.problem, exact.A.mesh(0.25), 3, "P1")
    solutions = [next(sequence) for _ in range(finished)]
    if finished < 3:
        options("ksp_max_it", 1)
        with pytest.raises(NotConverged):
            next(sequence)
    for solution in solutions:
        residual = fem.Function(solution.u.function_space)
        solution.level.system.residual(solution.u, residual)
        assert solution.contact.number_active > 0
        assert difference(residual.x.array, solution.residual.x.array) < 1e-10


@pytest.mark.parametrize("away", [0.0, 4.6e6])
def test_the_cycle_is_symmetric_and_keeps_fixed_dofs_out(away):
    """Far from the origin, too, where midpoints are rounded to few digits of a cell."""
    domain = CROOKED.mesh(0.25)
    domain.mesh.geometry.x[:, :2] += away
    solutions = list(solve_levels(Problem(f=-1.0), domain, 3))
    system = solutions[-1].level.system
    bounded = system.bounded
    with in_cycle(solutions) as cycle:
        for fixed in (bounded[::2], bounded[:0], bounded):
            vectors = [cycle.matrix.createVecRight() for _ in range(4)]
            for i, v in enumerate(vectors[:2]):
                random = np.random.default_rng(10 * MPI.COMM_WORLD.rank + i)
                v.array = random.standard_normal(v.local_size)
                v.array[fixed] = 0.0
                v.array[system.owned_dirichlet] = 0.0
            b, c, x, y = vectors
            with cycle.constrained(fixed):
                cycle.apply(None, b, x)
                cycle.apply(None, c, y)
            assert c.dot(x) == pytest.approx(b.dot(y), rel=1e-10)
            assert b.dot(x) > 0
            assert np.all(x.array_r[fixed] == 0.0)
