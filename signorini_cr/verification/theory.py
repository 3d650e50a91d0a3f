r"""The paper's analysis, evaluated: the facet sets (2.2) and the abstract estimate (1.11).

With v_h = Π_h u, the function of V_h that has u's mean on every facet, and w_h = Π_h u − u_h,
(1.11) holds with the constant 1, and what is lost in it is known:

    ‖u − u_h‖_h² = ‖u − Π_h u‖_h² + I_1 + I_2 + I_3 − Σ_F λ_F |F| (Π_h u − α)(m_F),

I_1, I_2, I_3 the sums (4.2) of ∫ ∂ₙu w_h over both sides of the interior facets, over Γ0 and over
Γ1. For ∇Π_h u is the mean of ∇u on each cell: the first term is orthogonal to the gradients of V_h
(so that Π_h u is the best approximation, in K_h and beyond), and what remains is

    ‖w_h‖_h² = a_h(u − u_h, w_h) = [a_h(u, w_h) − χ(w_h)] − [a_h(u_h, w_h) − χ(w_h)],

where the last bracket is Σ_F λ_F |F| w_h(m_F) ≥ 0, because λ_F vanishes unless u_h = α at m_F.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import ufl
from dolfinx import fem
from mpi4py import MPI

from ..arrays import Int32Array
from ..fem.problem import Data, as_expression
from ..fem.space import facet_quadrature, facet_to_dof, function_space
from ..jit import compiled
from ..mesh.domain import CONTACT, DIRICHLET, Domain
from ..solution import Solution
from .exact import Example
from .norms import facet_values

BOUND, MIXED, FREE = 0, 1, 2
"""The sets (2.2): facets inside Γ1⁰, where u = α; those in both; those inside Γ1⁺, where u > α."""

SAMPLES = 64
"""Points per facet at which contact and gap are told apart."""


def facet_sets(domain: Domain, example: Example) -> npt.NDArray[np.int8]:
    """Sort the contact facets of this rank into the sets (2.2); collective.

    A facet that has only an end in the other set counts for the set of its interior. λ is asked
    first: where it is positive, u = α whatever rounding makes of u − α.

    Returns:
        BOUND, MIXED or FREE for every facet of `Domain.facets(CONTACT)`, shape (n,).

    Raises:
        ValueError: The example's u or λ is not known.
    """
    exact, pressure = example.problem.exact, example.pressure
    if exact is None or pressure is None:
        raise ValueError(f"the solution of {example.name} is not known")
    facets = domain.facets(CONTACT)
    points = ((np.arange(SAMPLES) + 0.5) / SAMPLES)[:, None]

    def gap(x: ufl.core.expr.Expr) -> ufl.core.expr.Expr:
        return as_expression(exact, x) - as_expression(example.problem.obstacle, x)

    pressed = facet_values(domain.mesh, pressure, facets, points) > 0.0
    bound = pressed | (facet_values(domain.mesh, gap, facets, points) <= 0.0)
    share = bound.mean(axis=1)
    return np.where(share == 1.0, BOUND, np.where(share == 0.0, FREE, MIXED)).astype(np.int8)


@dataclass(frozen=True)
class Judgement:
    """How many contact facets there are, over all ranks, and how the discrete solution sees them.

    Attributes:
        bound: Facets in Γ1h⁰.
        mixed: Facets in Γ1h⁻, which the paper's proofs have to treat one by one.
        free: Facets in Γ1h⁺.
        active: Discrete active set.
        missed: Facets in Γ1h⁰ that are not active.
        extra: Facets in Γ1h⁺ that are active.
    """

    bound: int
    mixed: int
    free: int
    active: int
    missed: int
    extra: int

    @property
    def misjudged(self) -> int:
        """Facets where the discrete active set is wrong."""
        return self.missed + self.extra


def judge(solution: Solution, example: Example) -> Judgement:
    """Compare the discrete active set with the sets (2.2); collective."""
    sets, active = facet_sets(solution.domain, example), solution.contact.active
    comm = solution.domain.mesh.comm
    counts = np.array(
        [
            np.count_nonzero(which)
            for which in (
                sets == BOUND,
                sets == MIXED,
                sets == FREE,
                active,
                (sets == BOUND) & ~active,
                (sets == FREE) & active,
            )
        ]
    )
    comm.Allreduce(MPI.IN_PLACE, counts)
    return Judgement(*counts.tolist())


def interpolate(domain: Domain, data: Data, degree: int = 12) -> fem.Function:
    """Compute Π_h v, the CR function with v's mean on every facet; collective.

    Args:
        domain: Where.
        data: The function v of x.
        degree: Degree of the quadrature on the facets.
    """
    mesh = domain.mesh
    V = function_space(mesh)
    fdim = mesh.topology.dim - 1
    facets = np.arange(
        mesh.topology.index_map(fdim).size_local + mesh.topology.index_map(fdim).num_ghosts,
        dtype=np.int32,
    )
    points, weights = facet_quadrature(mesh, degree)
    interpolant = fem.Function(V)
    interpolant.x.array[facet_to_dof(V)] = facet_values(mesh, data, facets, points) @ weights
    return interpolant


@dataclass(frozen=True)
class Estimate:
    """The terms of (1.11) for v_h = Π_h u; squares of norms, over all ranks.

    Attributes:
        error: ‖u − u_h‖_h².
        best: ‖u − Π_h u‖_h², the best approximation.
        interior: I_1, jumps of w_h across interior facets.
        dirichlet: I_2, over Γ0.
        contact: I_3, over Γ1; the sum of the next two, as ∂ₙu = 0 on Γ1h⁺.
        contact_bound: D_1 of (4.14), over Γ1h⁰.
        contact_mixed: D_2 + B_2 of (4.14), over Γ1h⁻.
        slack: Σ_F λ_F |F| (Π_h u − α)(m_F), what (1.11) loses.
        consistency: a_h(u, w_h) − χ(w_h), integrated over the cells; I_1 + I_2 + I_3 once more.
    """

    error: float
    best: float
    interior: float
    dirichlet: float
    contact: float
    contact_bound: float
    contact_mixed: float
    slack: float
    consistency: float

    @property
    def right_side(self) -> float:
        """The right-hand side of (1.11): best + I_1 + I_2 + I_3."""
        return self.best + self.interior + self.dirichlet + self.contact


def abstract_estimate(solution: Solution, example: Example, degree: int = 12) -> Estimate:
    """Evaluate (1.11) term by term for a CR solution with κ = 1; collective.

    Args:
        solution: u_h.
        example: The problem, with u and λ known.
        degree: Degree of the quadratures.

    Raises:
        ValueError: The solution is that of another element, u or λ is not known, or the mesh has
            ghost cells.
    """
    domain, problem = solution.domain, solution.problem
    if solution.element != "CR" or problem.exact is None:
        raise ValueError("the estimate is that of the CR element, and needs the exact solution")
    mesh = domain.mesh
    if mesh.comm.allreduce(mesh.topology.index_map(mesh.topology.dim).num_ghosts):
        raise ValueError("the terms are summed over cells: make the mesh with GhostMode.none")
    interpolant = interpolate(domain, problem.exact, degree)
    w = fem.Function(interpolant.function_space)
    w.x.array[:] = interpolant.x.array - solution.u.x.array
    x, n = ufl.SpatialCoordinate(mesh), ufl.FacetNormal(mesh)
    u = as_expression(problem.exact, x)
    f = -ufl.div(ufl.grad(u)) if problem.f is None else as_expression(problem.f, x)
    g = ufl.dot(ufl.grad(u), n) if problem.g is None else as_expression(problem.g, x)
    kinds = _sides(domain, facet_sets(domain, example))
    metadata = {"quadrature_degree": degree}
    dx = ufl.Measure("dx", mesh, metadata=metadata)
    ds = ufl.Measure("ds", mesh, metadata=metadata, subdomain_data=list(kinds.items()))

    def square(v: fem.Function) -> ufl.Form:
        return ufl.inner(ufl.grad(u - v), ufl.grad(u - v)) * dx

    def side(kind: int) -> ufl.Form:
        return ufl.dot(ufl.grad(u), n) * w * ds(kind)

    forms = [
        square(solution.u),
        square(interpolant),
        side(_INTERIOR),
        side(_DIRICHLET),
        side(BOUND),
        side(MIXED),
        ufl.inner(ufl.grad(u), ufl.grad(w)) * dx - f * w * dx - g * w * ds(_NEUMANN),
    ]
    integrals = [fem.assemble_scalar(compiled(mesh.comm, fem.form, form)) for form in forms]
    owned = w.function_space.dofmap.index_map.size_local
    integrals.append(float(solution.residual.x.array[:owned] @ w.x.array[:owned]))
    total = np.array(integrals)
    mesh.comm.Allreduce(MPI.IN_PLACE, total)
    sums: list[float] = [float(value) for value in total]
    error, best, interior, dirichlet, bound, mixed, consistency, slack = sums
    return Estimate(
        error, best, interior, dirichlet, bound + mixed, bound, mixed, slack, consistency
    )


_DIRICHLET, _NEUMANN, _INTERIOR = 3, 4, 5


def _sides(domain: Domain, sets: npt.NDArray[np.int8]) -> dict[int, Int32Array]:
    """Sort the sides of the owned cells by kind: BOUND, MIXED, FREE, Γ0, Γg, or both sides inside.

    DOLFINx takes any list of sides for a one-sided integral, interior facets' as well; thus no
    integral over jumps is needed, and no ghost cells.

    Returns:
        Pairs (cell, facet's number in the cell), flattened.
    """
    mesh = domain.mesh
    tdim = mesh.topology.dim
    mesh.topology.create_connectivity(tdim, tdim - 1)
    facets = mesh.topology.index_map(tdim - 1)
    kind = np.full(facets.size_local + facets.num_ghosts, _INTERIOR, dtype=np.int8)
    kind[domain.tags.indices] = _NEUMANN
    kind[domain.tags.find(DIRICHLET)] = _DIRICHLET
    kind[domain.facets(CONTACT)] = sets
    cells = mesh.topology.index_map(tdim).size_local
    sides = kind[mesh.topology.connectivity(tdim, tdim - 1).array.reshape(-1, tdim + 1)[:cells]]
    return {
        number: np.argwhere(sides == number).astype(np.int32).ravel()
        for number in (BOUND, MIXED, FREE, _DIRICHLET, _NEUMANN, _INTERIOR)
    }
