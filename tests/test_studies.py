"""Solutions against an independent dense solver, limits that are linear, ranks, and rates."""

import numpy as np
import pytest
import ufl
from dolfinx.mesh import meshtags
from mpi4py import MPI
from scipy.optimize import lsq_linear

from signorini_cr import Problem, exact, norms, solve, solve_levels
from signorini_cr.compat import cell_nodes
from signorini_cr.mesh.domain import CONTACT, DIRICHLET, NEUMANN, Domain

pytestmark = [pytest.mark.slow, pytest.mark.ranks]

COMM = MPI.COMM_WORLD


def by_place(solution):
    """Coordinates and values of all dofs, on every rank, in an order of their own."""
    V = solution.u.function_space
    owned = V.dofmap.index_map.size_local
    rows = np.column_stack([V.tabulate_dof_coordinates()[:owned, :2], solution.u.x.array[:owned]])
    rows = np.concatenate(COMM.allgather(rows))
    return rows[np.lexsort(np.round(rows[:, :2], 9).T)]


def dense(domain, load, obstacle, dirichlet):
    """u_h with affine data from NumPy and SciPy alone, on a mesh of COMM_SELF.

    With ψ_i = 1 − d λ_i the CR basis, ∇ψ_i = −d ∇λ_i; on straight facets the mean of an affine
    function is its value at the midpoint. Minimising ½ xᵀAx − bᵀx subject to bounds is a
    least-squares problem in the Cholesky factor of A.

    Args:
        domain: The mesh.
        load: f at points of shape (3, n), affine: the midpoint rule is exact.
        obstacle: α at such points.
        dirichlet: u_D at such points.

    Returns:
        Rows x, y, u_h in the order of `by_place`, and whether each dof is on its bound.
    """
    mesh = domain.mesh
    c2f = mesh.topology.connectivity(2, 1).array.reshape(-1, 3)
    x = mesh.geometry.x[cell_nodes(mesh), :2]
    barycentric = np.linalg.inv(np.concatenate([np.ones((len(x), 3, 1)), x], axis=2))
    gradients = -2.0 * np.moveaxis(barycentric[:, 1:], 1, 2)  # (cells, i, component)
    area = np.abs(np.linalg.det(x[:, 1:] - x[:, :1])) / 2
    size = c2f.max() + 1
    A, b, middle = np.zeros((size, size)), np.zeros(size), np.zeros((size, 3))
    local = area[:, None, None] * np.einsum("cik,cjk->cij", gradients, gradients)
    np.add.at(A, (c2f[:, :, None], c2f[:, None, :]), local)
    middle[c2f, :2] = 0.5 * (x[:, [1, 2, 0]] + x[:, [2, 0, 1]])
    np.add.at(b, c2f, load(middle.T)[c2f] * area[:, None] / 3)
    fixed = domain.facets(DIRICHLET)
    free = np.setdiff1d(np.arange(size), fixed)
    u = np.zeros(size)
    u[fixed] = dirichlet(middle[fixed].T)
    lower = np.full(size, -np.inf)
    contact = domain.facets(CONTACT)
    lower[contact] = obstacle(middle[contact].T)
    factor = np.linalg.cholesky(A[np.ix_(free, free)])
    right = np.linalg.solve(factor, b[free] - A[np.ix_(free, fixed)] @ u[fixed])
    found = lsq_linear(factor.T, right, (lower[free], np.inf), method="bvls", tol=1e-14)
    u[free] = found.x
    order = np.lexsort(np.round(middle[:, :2], 9).T)
    return np.column_stack([middle[:, :2], u])[order], (u <= lower + 1e-12)[order]


def affine(constant, *slopes):
    """A function of x, for UFL as for NumPy."""
    return lambda x: constant + sum(slope * x[i] for i, slope in enumerate(slopes))


CASES = {
    "S1": (exact.S1, affine(0.0, 4.0), affine(0.0, 0.0), affine(0.0, 0.0)),
    "slanted obstacle": (exact.S1, affine(-1.0, 6.0), affine(0.0, 0.1), affine(0.0, 0.1)),
    "E": (exact.E, affine(0.0, -6.0, 8.0), affine(-0.3, 0.2), affine(0.0, 0.0)),
    "L": (exact.L, affine(1.0, 0.0), affine(0.9, 0.0, 0.2), affine(0.0, 0.0)),
}


@pytest.mark.parametrize("mesh", ["structured", "jitter", "gmsh"])
@pytest.mark.parametrize("name", CASES)
def test_dense_quadratic_programme(name, mesh):
    """Dof by dof the solution of an independent solver, whatever the mesh and the ranks."""
    example, load, obstacle, dirichlet = CASES[name]

    def domain(comm):
        if mesh == "gmsh":
            return example.mesh(0.3, comm)
        return example.structured(4, comm, jitter=0.2 * (mesh == "jitter"))

    problem = Problem(f=load, obstacle=obstacle, dirichlet=dirichlet)
    expected, on_bound = dense(domain(MPI.COMM_SELF), load, obstacle, dirichlet)
    solution = solve(problem, domain(COMM))
    found = by_place(solution)
    assert np.allclose(found[:, :2], expected[:, :2])
    assert np.allclose(found[:, 2], expected[:, 2], atol=1e-7 * np.abs(expected[:, 2]).max())
    assert np.count_nonzero(on_bound) == solution.contact.number_active
    assert 0 < solution.contact.number_active < solution.contact.number


@pytest.mark.parametrize("contact", [False, True])
def test_limits_are_linear_problems(contact):
    """Far below, the obstacle isn't felt; far above, it is a Dirichlet condition u = α on Γ1."""
    alpha, load = (0.5, -9.0) if contact else (-5.0, 1.0)
    alone = exact.S1.structured(4, MPI.COMM_SELF, jitter=0.2)
    expected, _ = dense(
        replace_parts(alone, CONTACT, DIRICHLET if contact else NEUMANN),
        affine(load, 0.0),
        affine(alpha, 0.0),
        affine(max(alpha, 0.0), 0.0),
    )
    problem = Problem(f=load, obstacle=alpha, dirichlet=max(alpha, 0.0))
    solution = solve(problem, exact.S1.structured(4, jitter=0.2))
    assert solution.contact.number_active == (8 if contact else 0)
    assert np.allclose(by_place(solution), expected, atol=1e-7)


def replace_parts(domain, old, new):
    """The same mesh with one boundary part made another."""
    values = np.where(domain.tags.values == old, new, domain.tags.values).astype(np.int32)
    return Domain(domain.mesh, meshtags(domain.mesh, 1, domain.tags.indices, values))


@pytest.mark.parametrize("element", ["CR", "P1"])
@pytest.mark.parametrize(
    ("coefficient", "contact"),
    [(1.0, True), (1.0, False), (2.5, True), (2.5, False), ("jump", True), ("jump", None)],
)
def test_patch(element, coefficient, contact):
    """An affine u is reproduced, in contact (λ = 3κ) or free, or a constant, whatever κ."""
    slope = -3.0 if contact else 0.0

    def u(x):
        return 2.0 + slope * x[1] + (0.0 if coefficient == "jump" else x[0])

    def kappa(x):
        return (
            ufl.conditional(ufl.lt(x[0], 0.0), 1.0, 4.0) if coefficient == "jump" else coefficient
        )

    problem = Problem(f=0.0, exact=u, obstacle=u if contact else -9.0, coefficient=kappa)
    if contact is None:
        problem = Problem(exact=2.0, obstacle=-9.0, coefficient=kappa)
    # The jump lies on facets of the mesh without jitter
    solution = solve(problem, exact.D.structured(4, jitter=0.0 if coefficient == "jump" else 0.2))
    assert solution.errors[0] < 1e-7 and solution.errors[1] < 1e-8
    if contact and element == "CR":
        middle = solution.contact.midpoints[:, 0]
        scale = np.where(middle < 0, 1.0, 4.0) if coefficient == "jump" else coefficient
        assert np.allclose(solution.contact.pressure, 3.0 * scale, atol=1e-5)


@pytest.mark.parametrize("element", ["CR", "P1"])
@pytest.mark.parametrize("name", ["S1", "L"])
def test_ranks_do_not_matter(name, element):
    """The same gmsh mesh, solved by this many ranks and by one alone."""
    example = exact.ALL[name]
    together = list(solve_levels(example.problem, example.mesh(0.25), 3, element))[-1]
    alone = list(solve_levels(example.problem, example.mesh(0.25, MPI.COMM_SELF), 3, element))[-1]
    assert together.dofs == alone.dofs
    assert together.energy == pytest.approx(alone.energy, rel=1e-10)
    assert together.h == pytest.approx(alone.h, rel=1e-12)
    assert together.contact.number_active == alone.contact.number_active
    assert together.contact.force == pytest.approx(alone.contact.force, rel=1e-6)
    if alone.errors:
        assert together.errors == pytest.approx(alone.errors, rel=1e-7)
    V = alone.u.function_space
    rows = np.column_stack([V.tabulate_dof_coordinates()[:, :2], alone.u.x.array])
    rows = rows[np.lexsort(np.round(rows[:, :2], 9).T)]
    assert np.allclose(by_place(together), rows, atol=1e-7)


@pytest.mark.parametrize("element", ["CR", "P1"])
@pytest.mark.parametrize("name", ["S1", "A", "B", "C", "C2", "I", "D", "L"])
def test_rates(name, element):
    """Last two of six levels: 1.00 ± 0.03 and 2.0 ± 0.1 in H², ½ for D, ⅔ for L."""
    example = exact.ALL[name]
    h, h1, l2, distances, before = [], [], [], [], None
    for solution in solve_levels(example.problem, example.structured(4), 6, element):
        h.append(solution.h)
        if example.problem.exact is None:
            distances.append(norms.distance(before, solution) if before else np.nan)
        else:
            h1.append(solution.errors[0])
            l2.append(solution.errors[1])
        before = solution
    if example.problem.exact is None:
        assert np.all(abs(norms.rates(h, distances)[-2:] - 2 / 3) < 0.05)
        return
    rate_h1, rate_l2 = example.rates
    assert np.all(abs(norms.rates(h, h1)[-2:] - rate_h1) < 0.03)
    assert np.all(abs(norms.rates(h, l2)[-2:] - rate_l2) < 0.1)


@pytest.mark.parametrize("family", [{"shift": 0.31}, {"jitter": 0.2}], ids=str)
@pytest.mark.parametrize("name", ["S1", "A"])
def test_rates_on_other_families(name, family):
    """Critical points inside facets, and vertices moved at random, anew on each level."""
    example = exact.ALL[name]
    found = [
        solve(
            example.problem,
            example.structured(n, **family, **({"seed": n} if "jitter" in family else {})),
        )
        for n in (8, 16, 32)
    ]
    h = [2.0**-k for k in range(3)]
    assert np.all(abs(norms.rates(h, [s.errors[0] for s in found]) - 1.0) < 0.1)
    assert np.all(abs(norms.rates(h, [s.errors[1] for s in found]) - 2.0) < 0.2)
