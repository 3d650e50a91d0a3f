"""Thin cells and strong anisotropy: few CG steps, and the answer of a direct solver.

The reference is assembled here, in NumPy, from the vertices of the cells and the data alone, and
solved by SciPy's factorisations in a primal-dual active set method.
"""

import numpy as np
import pytest
import ufl
from mpi4py import MPI
from petsc4py import PETSc
from scipy.sparse import coo_matrix
from scipy.sparse.linalg import splu
from scipy.spatial import cKDTree

from signorini_cr import Polygon, Problem, compat, exact, solve, solve_levels
from signorini_cr.multigrid import bottom
from signorini_cr.options import AMG
from signorini_cr.vi.level import Level

pytestmark = pytest.mark.slow

comm = MPI.COMM_WORLD

CORNERS = np.array([[0, 0], [3, -0.4], [3.6, 1.1], [0.2, 2.0]])
PARTS = ["contact", "dirichlet", "neumann", "dirichlet"]


def turned(ratio, degrees):
    """The matrix diag(1, ratio) in axes turned by so many degrees."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    turn = np.array([[c, -s], [s, c]])
    return turn @ np.diag([1.0, ratio]) @ turn.T


class Thin:
    """A quadrilateral squashed after meshing, or a tensor on it; data affine in what it was."""

    def __init__(self, squash=None, kappa=None):
        self.squash = np.eye(2) if squash is None else squash
        self.kappa = np.eye(2) if kappa is None else kappa
        self.back = np.linalg.inv(self.squash)

    @staticmethod
    def f(x, y):
        return 30.0 * x - 51.0

    @staticmethod
    def u_D(x, y):
        return 0.3 + 0.2 * y

    @staticmethod
    def alpha(x, y):
        return 0.02 * x

    @property
    def problem(self):
        def data(function):
            def squashed(x):
                first, second = (row[0] * x[0] + row[1] * x[1] for row in self.back.tolist())
                return function(first, second)

            return squashed

        kappa = self.kappa.tolist()
        return Problem(
            f=data(self.f),
            dirichlet=data(self.u_D),
            obstacle=data(self.alpha),
            coefficient=lambda x: ufl.as_matrix(kappa),
        )

    def domain(self):
        domain = Polygon(CORNERS.tolist(), PARTS).mesh(0.5, comm)
        x = domain.mesh.geometry.x
        x[:, :2] = x[:, :2] @ self.squash.T
        return domain

    def reference(self, mesh):
        """Midpoints before the squash, u, forces and contact of the facets, all on all ranks."""
        owned = mesh.topology.index_map(2).size_local
        points = mesh.geometry.x[compat.cell_nodes(mesh)[:owned]][:, :, :2]
        points = np.concatenate(comm.allgather(points))
        flat = points.reshape(-1, 2) @ self.back.T
        _, vertex = np.unique(np.round(flat, 7), axis=0, return_inverse=True)
        vertex = vertex.reshape(-1, 3)
        opposite = np.array([[1, 2], [2, 0], [0, 1]])
        ends = np.sort(vertex[:, opposite].reshape(-1, 2), axis=1)
        _, first, facet, count = np.unique(
            ends, axis=0, return_index=True, return_inverse=True, return_counts=True
        )
        facet = facet.reshape(-1, 3)
        middles = flat.reshape(-1, 3, 2)[:, opposite].mean(axis=2).reshape(-1, 2)[first]

        along = points[:, opposite[:, 1]] - points[:, opposite[:, 0]]
        normal = np.stack([along[:, :, 1], -along[:, :, 0]], axis=2)
        area = 0.5 * np.abs(along[:, 0, 0] * along[:, 1, 1] - along[:, 0, 1] * along[:, 1, 0])
        blocks = np.einsum("cix,xy,cjy->cij", normal, self.kappa, normal) / area[:, None, None]
        n = len(middles)
        rows, columns = (
            np.broadcast_to(facet[s], blocks.shape).ravel()
            for s in (np.s_[:, :, None], np.s_[:, None, :])
        )
        A = coo_matrix((blocks.ravel(), (rows, columns)), (n, n)).tocsr()
        weight = np.bincount(facet.ravel(), np.repeat(area / 3.0, 3), n)
        b = weight * self.f(*middles.T)  # midpoints integrate what is quadratic

        fixed, bounded = np.zeros(n, dtype=bool), np.zeros(n, dtype=bool)
        for start, end, part in zip(CORNERS, np.roll(CORNERS, -1, axis=0), PARTS, strict=True):
            edge, to = end - start, middles - start
            on = (count == 1) & (np.abs(edge[0] * to[:, 1] - edge[1] * to[:, 0]) < 1e-6)
            fixed |= on & (part == "dirichlet")
            bounded |= on & (part == "contact")
        u, lower = np.where(fixed, self.u_D(*middles.T), 0.0), self.alpha(*middles.T)
        active = np.zeros(n, dtype=bool)
        for _ in range(50):
            u[active] = lower[active]
            free = ~(fixed | active)
            inner = A[free]
            u[free] = 0.0
            factors = splu(inner[:, free].tocsc())
            for _ in range(3):  # refined, or rounding would be all there is to see
                u[free] += factors.solve(b[free] - inner @ u)
            force = A @ u - b
            now = bounded & np.where(active, force > 0.0, u < lower)
            if (now == active).all():
                return middles, u, np.where(bounded, force, 0.0), active
            active = now
        raise AssertionError("the reference does not converge")


def compare(case, solution):
    """The largest differences of u and of the forces, relative, and whether the sets are equal."""
    V, system = solution.u.function_space, solution.level.system
    bounded = system.bounded
    owned = V.dofmap.index_map.size_local
    middles, u, force, active = case.reference(solution.domain.mesh)
    x = V.tabulate_dof_coordinates()[:owned, :2] @ case.back.T
    distance, facet = cKDTree(middles).query(x)
    assert distance.max(initial=0.0) < 1e-6
    own_u, own_force = (w.x.array[:owned] for w in (solution.u, solution.residual))
    is_active = np.zeros(owned, dtype=bool)
    is_active[bounded] = own_u[bounded] <= system.lower[bounded]
    facts = [
        np.abs(own_u - u[facet]).max(initial=0.0) / np.abs(u).max(),
        np.abs(own_force - force[facet])[bounded].max(initial=0.0) / force.max(),
        (is_active != active[facet]).any(),
    ]
    of_u, of_force, differ = np.max(comm.allgather(facts), axis=0)
    assert 0 < active.sum() < comm.allreduce(len(bounded))
    return of_u, of_force, not differ


CASES = {
    "squashed": Thin(squash=turned(1e-3, 0)),
    "squashed at 30°": Thin(squash=turned(1e-3, 30)),
    "tensor 1e3": Thin(kappa=turned(1e-3, 0)),
    "tensor 1e3 at 30°": Thin(kappa=turned(1e-3, 30)),
    "tensor 1e3 at 90°": Thin(kappa=turned(1e-3, 90)),
    "tensor 1e6 at 30°": Thin(kappa=turned(1e-6, 30)),
    "tensor 1e6 at 90°": Thin(kappa=turned(1e-6, 90)),
}


@pytest.mark.parametrize("nested", [True, False])
@pytest.mark.parametrize("name", CASES)
def test_few_steps_to_the_answer_of_a_direct_solver(name, nested):
    case = CASES[name]
    for solution in solve_levels(case.problem, case.domain(), 4, nested=nested):
        assert solution.iterations.linear <= 60
        of_u, of_force, same = compare(case, solution)
        assert of_u < 1e-6 and of_force < 1e-6 and same
    # 8,000 dofs: the coarser meshes have been enough to know
    assert solution.iterations.linear <= 3 * solution.iterations.newton
    words = "a direct solver, as multigrid took too many CG steps on a coarser mesh"
    assert solution.iterations.preconditioner == words


def test_squashed_to_a_ten_thousandth():
    """The matrix's own rounding is 1e-16 / 1e-4², and is multiplied by the square of 1 / h."""
    case = Thin(squash=np.diag([1.0, 1e-4]))
    for solution in solve_levels(case.problem, case.domain(), 4):
        assert solution.iterations.linear <= 60
        of_u, of_force, same = compare(case, solution)
        assert of_u < 1e-5 and of_force < 1e-5 and same


@pytest.mark.parametrize("element", ["CR", "P1"])
def test_boomeramg_where_cells_are_aligned(element):
    """Right-angled cells make an M-matrix, however thin they are."""
    domain = exact.S1.structured(8, comm)
    domain.mesh.geometry.x[:, 1] *= 1e-3
    problem = Problem(f=lambda x: 12 * ufl.sin(5 * x[0]) - 5, dirichlet=0.2)
    steps = []
    for solution in solve_levels(problem, domain, 5, element):
        steps.append(solution.iterations.linear)
        whole = solution.level.system.A.copy()
        whole.axpy(-1.0, Level(solution.level.meshes).system.A)
        assert whole.norm() == 0.0
    assert max(steps) <= 60 and steps[-1] <= 15
    words = "BoomerAMG, as multigrid took too many CG steps on a coarser mesh"
    if AMG != PETSc.PC.Type.HYPRE:
        words = "a direct solver, as multigrid took too many CG steps on a coarser mesh"
    assert solution.iterations.preconditioner == words


def test_without_mumps(monkeypatch):
    monkeypatch.setattr(bottom, "HAS_MUMPS", False)
    monkeypatch.setattr(bottom, "DIRECT", 100)
    case = CASES["squashed at 30°"]
    for solution in solve_levels(case.problem, case.domain(), 3):
        assert solution.iterations.linear <= 60
        of_u, of_force, same = compare(case, solution)
        assert of_u < 1e-6 and of_force < 1e-6 and same


def test_an_option_for_what_comes_instead(options):
    options("alone_pc_type", "jacobi")
    case = CASES["tensor 1e3 at 30°"]
    solution = solve(case.problem, case.domain())
    assert solution.iterations.preconditioner == "jacobi (option -signorini_alone_pc_type)"


def test_cells_that_are_not_thin_keep_multigrid():
    case = Thin()
    for solution in solve_levels(case.problem, case.domain(), 4, nested=False):
        assert solution.iterations.linear <= 9 * solution.iterations.newton
    words = "multigrid on 4 meshes with a direct solver on the coarsest"
    assert solution.iterations.preconditioner == words


CIRCLES = (
    ([[0, 0], [1, 0], [1.3, 1], [-0.5, 0.7]], "cdcd", 1e-4, 0.3, -3e4, 0.05, 0.03),
    ([[0.98, -0.5], [0.05, 0.71], [-0.19, -0.99]], "cdc", 1e-3, 0.2, -3.0, 0.6, 0.5),
    (
        [[0.79, 0.1], [0.73, 0.69], [-0.32, 0.57], [-0.51, 0.19], [-0.72, -0.79], [0.25, -0.76]],
        "cndccd",
        1e-3,
        0.2,
        -94868.0,
        0.6,
        0.03,
    ),
)
"""Corners, kinds of edges, by how much it is squashed, size, load, depth and waves of α."""


@pytest.mark.serial
@pytest.mark.parametrize("case", CIRCLES)
def test_the_active_set_does_not_go_round_in_circles(case):
    """Full steps do, here; the discrete conditions hold in extended precision."""
    corners, kinds, squash, size, f, depth, waves = case
    names = {"c": "contact", "d": "dirichlet", "n": "neumann"}
    polygon = Polygon([(x, y * squash) for x, y in corners], [names[kind] for kind in kinds])
    problem = Problem(f=f, obstacle=lambda x: -depth + waves * ufl.cos(9 * x[0]))
    for solution in solve_levels(problem, polygon.mesh(size, MPI.COMM_SELF), 4):
        assert solution.iterations.newton < 40
        system = solution.level.system
        A = system.A.convert("dense").getDenseArray().astype(np.longdouble)
        x = solution.u.x.array.astype(np.longdouble)
        residual, made_of = A @ x - system.b, np.abs(A) @ np.abs(x) + np.abs(system.b)
        bounded, free = system.bounded, np.ones(len(x), dtype=bool)
        free[system.dirichlet] = free[bounded] = False
        assert (np.abs(residual[free]) <= 1e-9 * made_of[free]).all()
        force, gap = residual[bounded], x[bounded] - system.lower[bounded]
        large = 1e-7 * float(np.maximum(force, 0.0).sum())
        assert gap.min() >= -1e-12 and force.min() >= -large
        assert np.abs(force[gap > 1e-9]).max(initial=0.0) <= large
