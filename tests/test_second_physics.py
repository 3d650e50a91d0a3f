"""A second physics behind the same seam: two unknowns a facet, and one of them bounded.

Find u: Ω → R² with −∇·(M ∇u) = f, M a matrix that couples the two components, u = u_D on top,
M ∂ₙu = 0 on the sides and, on an oblique straight bottom with the outer normal n, the conditions of
Signorini on u·n ≤ γ. The unknowns are those along n and along the side. All that the package does
not know of this is in `Coupled` and `OnMesh`. The reference has Cartesian components, matrices and
multipliers of its own, and of the package no more than where the vertices are and how facets are
numbered.
"""

from functools import cache

import basix.ufl
import numpy as np
import pytest
import scipy.sparse as sparse
import ufl
from dolfinx import fem
from helpers import SQUARE
from mpi4py import MPI
from scipy.sparse.linalg import spsolve

from signorini_cr import InputError, Polygon, Problem, Robin, compat, solve_levels
from signorini_cr.adaptive import adaptively
from signorini_cr.data.diffusion import DiffusionOnMesh
from signorini_cr.estimate.certificate import Certificate
from signorini_cr.fem.layout import Layout
from signorini_cr.fem.physics import Imposed, Words
from signorini_cr.fem.snapshot import Snapshot
from signorini_cr.fem.space import facet_corners, facet_measures
from signorini_cr.levels import solve_physics
from signorini_cr.limits import Limits
from signorini_cr.mesh.domain import facet_entities
from signorini_cr.mesh.refinement import refine
from signorini_cr.mesh.shared import shared_sum
from signorini_cr.restart import Restart

pytestmark = pytest.mark.ranks

WORLD = MPI.COMM_WORLD
VERTICES = np.array([[0.0, 0.6], [1.2, 0.0], [1.2, 1.5], [0.0, 1.5]])
ALONG = (VERTICES[1] - VERTICES[0]) / np.linalg.norm(VERTICES[1] - VERTICES[0])
NORMAL = np.array([ALONG[1], -ALONG[0]])
M = np.array([[2.0, 0.7], [0.7, 1.0]])


def load(x):
    """f, affine, so that the midpoints' rule integrates it against any function of CR."""
    return [2.0 - x[1], 6.0 - 10.0 * x[0]]


def top(x):
    """u_D, affine, so that its means are the values at midpoints."""
    return [0.1 * x[0], 0.05 + 0.0 * x[0]]


def room(x):
    """γ, affine as well."""
    return 0.02 + 0.25 * x[0]


class OnMesh:
    """The physics on one mesh."""

    words = Words(load="the load of both components")

    def __init__(self, domain):
        self.domain, mesh = domain, domain.mesh
        self.V = fem.functionspace(mesh, basix.ufl.element("CR", mesh.basix_cell(), 1, shape=(2,)))
        self.a = fem.form(self.energy_of(ufl.TrialFunction(self.V), ufl.TestFunction(self.V)))
        self.fixed, self.bounds = self.conditions()

    def conditions(self):
        fixed = self.imposed("dirichlet", [0, 1], lambda x: turned(np.array(top(x))))
        # u·n ≤ γ is a bound of −u·n from below
        return (fixed,), (self.imposed("contact", [0], lambda x: -room(x)[None], sign=-1),)

    def imposed(self, part, components, values, sign=1):
        facets = self.domain.all_facets[self.domain.parts[part]]
        at, _ = facet_measures(self.domain.mesh, facets)
        ends = np.moveaxis(values(np.moveaxis(at, 2, 0)), 0, 2)
        which = np.array(components, dtype=np.int32)
        return Imposed(part, facets, which, ends.mean(axis=1), ends, sign)

    @staticmethod
    def energy_of(u, v):
        turn = np.array([NORMAL, ALONG])
        return ufl.inner(ufl.as_matrix(turn @ M @ turn.T) * ufl.grad(u), ufl.grad(v)) * ufl.dx

    def force(self, x):
        return ufl.as_matrix([NORMAL.tolist(), ALONG.tolist()]) * ufl.as_vector(load(x))

    def loads(self, V):
        f, v = self.force(ufl.SpatialCoordinate(self.domain.mesh)), ufl.TestFunction(V)
        values = fem.Function(V).x.array
        fem.assemble_vector(values, fem.form(ufl.inner(f, v) * ufl.dx))
        values.flags.writeable = False  # an array is its physics' own
        return values

    def chi(self):
        return self.loads(self.V)

    def of_constants(self):
        return None

    def inflow(self):
        return None

    def conforming(self, cells, index_map):
        mesh = self.domain.mesh
        p1 = fem.functionspace(mesh, ("Lagrange", 1, (2,)))
        W = compat.with_dofs(p1, cells, index_map)
        return fem.form(self.energy_of(ufl.TrialFunction(W), ufl.TestFunction(W))), 1.0

    def at_vertices(self, u, facets):
        cells, local = facet_entities(self.domain.mesh, facets).T
        corners = facet_corners(self.domain.mesh)[local]
        values = at_corners(u)[cells, :, self.bounded(facets)]
        return np.take_along_axis(values, corners, axis=1)

    def bounded(self, facets):
        return 0

    def squared_energy_norm(self, u):
        return fem.assemble_scalar(fem.form(self.energy_of(u, u)))

    def tidy(self):
        pass


class InCorner(OnMesh):
    """On the unit square, held by nothing but what it is pressed onto, each component elsewhere."""

    pressed = 1.0

    def conditions(self):
        left = self.imposed("left", [0], lambda x: 0.1 * np.cos(7.0 * x[1])[None])
        return (), (left, self.imposed("floor", [1], lambda x: 0.1 * np.sin(5.0 * x[0])[None]))

    def force(self, x):
        return ufl.as_vector([x[0] - 1.0, self.pressed * (2.0 * x[1] - 2.0)])

    def inflow(self):
        mesh = self.domain.mesh
        owned = mesh.topology.index_map(2).size_local
        of_cells = self.loads(fem.functionspace(mesh, ("DG", 0, (2,))))[: 2 * owned]
        return np.stack([of_cells, of_cells])  # f is affine, any two rules will do

    def bounded(self, facets):
        return np.where(self.domain.names_of(facets) == "floor", 1, 0)


class Lifted(InCorner):
    pressed = -1.0


class Coupled:
    """A physics of two coupled unknowns."""

    element, problem, exact = "CR", None, None
    galerkin, not_definite = True, None

    def __init__(self, kind=OnMesh):
        self.kind = kind

    def check(self, domain):
        pass

    def on(self, domain):
        return self.kind(domain)

    def snapshot(self, domains):
        return Snapshot([], [])

    def certify(self, solution):
        """Compute how far u_h is from averages at vertices: no bound, but it marks."""
        u, mesh = solution.u, solution.domain.mesh
        local, p1 = at_corners(u), Layout.of_p1(mesh, 2)
        local = local[: mesh.topology.index_map(2).size_local]
        nodes = p1.cells[: len(local)]
        sums, count = np.zeros((2, p1.local // 2, 2))
        np.add.at(sums, nodes, local)
        np.add.at(count, nodes, 1.0)
        for each in (sums, count):
            shared_sum(mesh, p1.index_map, each.ravel(), 2)
        away = local - (sums / count)[nodes]
        x = mesh.geometry.x[compat.cell_nodes(mesh)[: len(local)], :2]
        edges = x[:, 1:] - x[:, :1]
        slopes = np.linalg.solve(edges, away[:, 1:] - away[:, :1])
        squares = 0.5 * np.abs(np.linalg.det(edges)) * (slopes**2).sum(axis=(1, 2))
        return Certificate(indicators=squares, reason="averages mark, and bound nothing")


def turned(vectors):
    """Components along n and along the side, of Cartesian ones, which come first."""
    return np.tensordot([NORMAL, ALONG], vectors, axes=1)


def at_corners(u):
    """Both unknowns at the vertices of each cell, shape (cells, 3, 2)."""
    values = u.x.array.reshape(-1, 2)[u.function_space.dofmap.list]
    return values.sum(axis=1, keepdims=True) - 2.0 * values


def gathered(solution):
    """Cells of all ranks: vertices, facets' numbers opposite them, and u there, Cartesian."""
    mesh, V = solution.domain.mesh, solution.u.function_space
    cells = mesh.topology.index_map(2).size_local
    x = mesh.geometry.x[compat.cell_nodes(mesh)[:cells], :2]
    facets = V.dofmap.index_map.local_to_global(V.dofmap.list[:cells].ravel()).reshape(-1, 3)
    x, facets, values = (
        np.concatenate(WORLD.allgather(each))
        for each in (x, facets, solution.u.x.array.reshape(-1, 2)[V.dofmap.list[:cells]])
    )
    u = np.empty((facets.max() + 1, 2))
    u[facets] = values @ [NORMAL, ALONG]
    return x, facets, u


class Reference:
    """The same problem in Cartesian components: u, multipliers λ on the bottom, and energy.

    M ⊗ K has 2 i and 2 i + 1 for facet i's components. On facets in contact a row of multipliers
    says u·n = γ; the active set is looked for by the signs of λ and u·n − γ.
    """

    def __init__(self, x, facets):
        number = facets.max() + 1
        edges = x[:, 1:] - x[:, :1]
        area = 0.5 * np.abs(np.linalg.det(edges))
        hats = np.linalg.inv(edges).transpose(0, 2, 1)  # gradients of the last two
        slopes = -2.0 * np.concatenate([-hats.sum(axis=1, keepdims=True), hats], axis=1)
        local = area[:, None, None] * slopes @ slopes.transpose(0, 2, 1)
        rows, columns = (
            np.broadcast_to(each, local.shape) for each in (facets[:, :, None], facets[:, None])
        )
        K = sparse.coo_array((local.ravel(), (rows.ravel(), columns.ravel())), (number, number))
        self.A = sparse.kron(K, M, "csr")
        middle = np.zeros((number, 2))
        middle[facets] = (x.sum(axis=1, keepdims=True) - x) / 2.0
        weight = np.bincount(facets.ravel(), np.repeat(area / 3.0, 3))
        self.b = (weight[:, None] * np.array(load(middle.T)).T).ravel()
        outer = np.bincount(facets.ravel()) == 1
        fixed = np.flatnonzero(outer & np.isclose(middle[:, 1], VERTICES[2, 1]))
        at_bottom = np.isclose((middle - VERTICES[0]) @ NORMAL, 0.0)
        self.contact = np.flatnonzero(outer & at_bottom)
        self.u, self.force = np.zeros((number, 2)), np.zeros(len(self.contact))
        self.u[fixed] = np.array(top(middle[fixed].T)).T
        free = np.setdiff1d(np.arange(number), fixed)
        self._solve((2 * free[:, None] + [0, 1]).ravel(), room(middle[self.contact].T))
        u = self.u.ravel()
        self.energy = 0.5 * u @ (self.A @ u) - self.b @ u

    def _solve(self, free, gap):
        rows = np.repeat(np.arange(len(gap)), 2), (2 * self.contact[:, None] + [0, 1]).ravel()
        B = sparse.csr_array((np.tile(NORMAL, len(gap)), rows), (len(gap), self.u.size))
        u, active = self.u.ravel(), np.ones(len(gap), dtype=bool)
        for _ in range(30):
            C = B[active][:, free]
            matrix = sparse.block_array([[self.A[free][:, free], C.T], [C, None]], format="csc")
            known = u.copy()
            known[free] = 0.0
            right = np.concatenate([(self.b - self.A @ known)[free], gap[active]])
            found = spsolve(matrix, right)
            u[free], self.force[:] = found[: len(free)], 0.0
            self.force[active] = found[len(free) :]
            before, active = active, np.where(active, self.force > 0.0, B @ u > gap)
            if np.array_equal(active, before):
                self.u, self.active = u.reshape(-1, 2), active
                return
        raise AssertionError("the active set of the reference goes round")


def check(solution):
    """Compare a solution with the reference on the same mesh."""
    x, facets, u = gathered(solution)
    reference, contact = Reference(x, facets), solution.contact
    assert solution.dofs == u.size == 2 * len(np.unique(facets))
    assert np.abs(u - reference.u).max() <= 1e-7 * np.abs(reference.u).max()
    # where a part of the bottom is in contact and a part is not, both are put to the test
    assert contact.number == len(reference.contact)
    assert 0 < contact.number_active == reference.active.sum() < contact.number
    # what u·n is held down by from above counts as negative
    assert contact.force == pytest.approx(-reference.force.sum(), rel=1e-6)
    assert solution.energy == pytest.approx(reference.energy, rel=1e-9)
    assert contact.kkt.min_gap >= 0.0 and contact.kkt.residual <= 1e-8


@pytest.fixture(scope="module")
def domain():
    parts = ["contact", "neumann", "dirichlet", "neumann"]
    return Polygon(VERTICES, parts).mesh(0.25)


def uniformly(solution):
    return (*refine(solution.domain), None) if solution.level.number < 2 else None


@pytest.mark.slow
def test_nested_meshes(domain):
    solutions = list(solve_physics(Coupled(), domain, uniformly))
    assert [s.cells for s in solutions] == [4**i * solutions[0].cells for i in range(3)]
    for number, solution in enumerate(solutions, start=1):
        check(solution)
        assert number == 1 or f"multigrid on {number} meshes" in solution.iterations.preconditioner
        assert solution.iterations.linear <= 20  # of all Newton steps together
    # a start from the mesh below brings the active set along
    *_, cold = solve_physics(Coupled(), domain, uniformly, nested=False)
    assert 2 * solutions[-1].iterations.newton < cold.iterations.newton


def adapted(domain, max_dofs=10_000, restart=None):
    step = adaptively(Limits(), tolerance=0.0, levels=3, max_dofs=max_dofs, fraction=0.5)
    return list(solve_physics(Coupled(), domain, step, restart=restart))


def test_adaptive_meshes(domain):
    solutions = adapted(domain)
    first, second, third = dofs = [s.dofs for s in solutions]
    assert first < second < third < 16 * first
    for solution in solutions:
        check(solution)
        assert solution.iterations.linear <= 20
    # both unknowns of a facet count: with one of them the third mesh would be within the limit
    assert [s.dofs for s in adapted(domain, third - 1)] == dofs[:2]


def test_going_on(domain):
    first, second, third = adapted(domain)
    restart = Restart.of(second, Restart.of(first, None, True), True)
    again, last = adapted(domain, restart=WORLD.bcast(restart))
    assert (again.dofs, last.dofs) == (second.dofs, third.dofs)
    assert again.iterations.newton <= 1  # it starts from what was found
    for solution in (again, last):
        check(solution)
    with pytest.raises(InputError, match="are those of diffusion"):
        last.force_bounds()


def test_each_component_is_held_elsewhere():
    """There is no Γ0: what each obstacle bears is all that presses the component onto it."""
    domain = SQUARE.mesh(0.25)
    for solution in solve_physics(Coupled(InCorner), domain, uniformly):
        contact, kkt = solution.contact, solution.contact.kkt
        assert 0 < contact.number_active and kkt.min_gap >= 0.0 and kkt.residual <= 1e-8
        for name, pressed in ("left", 0.5), ("floor", 1.0):
            forces = (contact.pressure * contact.measure)[contact.names == name]
            assert WORLD.allreduce(forces.sum()) == pytest.approx(pressed, rel=1e-6)
        # the mean of a facet's ends is the unknown that is bounded
        assert (contact.u >= contact.obstacle - 1e-12).all()
        assert np.allclose(contact.u[contact.active], contact.obstacle[contact.active])
    assert contact.number_active < contact.number
    with pytest.raises(
        InputError,
        match=r"unknowns fall .* has no Dirichlet facet, and a net force ∫f \+ ∫g of 1: only",
    ):
        next(solve_physics(Coupled(Lifted), domain, uniformly))


def test_marks_without_a_bound_are_told_as_that(domain):
    (solution,) = solve_physics(Coupled(), domain, lambda _: None)
    assert solution.certificate.reason in solution._repr_html_()
    assert solution.certificate.reason in repr(solution.certificate)
    assert "error at most" not in repr(solution) + solution._repr_html_()
    step = adaptively(Limits(), tolerance=0.1, levels=3, max_dofs=10_000, fraction=0.5)
    with pytest.raises(InputError, match="no bound that could be below it"):
        list(solve_physics(Coupled(), domain, step))


def test_a_bound_without_more_is_told():
    certificate = Certificate(bound_h1=0.25, indicators=np.ones(3))
    assert repr(certificate) == "<Certificate: error at most 0.25>"


def test_arrays_stay_the_physics_own(monkeypatch):
    """With c and b alone to hold u, where a_h(1, ·) is asked for again and again."""
    problem = Problem(
        f=-1.0, obstacle=-0.3, reaction=0.5, conditions={"right": Robin(coefficient=2.0)}
    )
    corners = [[0, 0], [1, 0], [1, 1], [0, 1]]
    square = Polygon(corners, ["contact", "right", "neumann", "neumann"], names=("right",))

    def solved():
        (solution,) = solve_levels(problem, square.mesh(0.3), 1)
        contact = solution.contact
        assert 0 < contact.number_active < contact.number
        return solution.energy, contact.force, solution.certificate.bound_h1

    expected = solved()
    for name in ("chi", "of_constants"):
        made = cache(getattr(DiffusionOnMesh, name))

        def kept(self, made=made):
            values = made(self)
            values.flags.writeable = False
            return values

        monkeypatch.setattr(DiffusionOnMesh, name, kept)
    assert solved() == pytest.approx(expected, rel=1e-9)
