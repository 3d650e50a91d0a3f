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
from dolfinx.mesh import exterior_facet_indices
from mpi4py import MPI

from ..arrays import Int32Array
from ..fem.conditions import Data, as_number, facets_of
from ..fem.problem import Forms, Problem
from ..fem.space import facet_quadrature, facet_to_dof, function_space
from ..jit import compiled
from ..mesh.domain import Domain, facet_entities
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
        BOUND, MIXED or FREE for each contact facet that this rank owns, by their local indices,
        ascending; shape (n,).

    Raises:
        ValueError: The example's u or λ is not known, or a part has an upper bound.
    """
    forms, pressure = _forms(domain, example.problem), example.pressure
    if forms.exact is None or pressure is None:
        raise ValueError(f"the solution of {example.name} is not known")
    points = ((np.arange(SAMPLES) + 0.5) / SAMPLES)[:, None]
    facet_map = domain.mesh.topology.index_map(domain.mesh.topology.dim - 1)
    sets = np.empty(facet_map.size_local, dtype=np.int8)
    for condition in forms.bounded:
        ((_, obstacle),) = condition.bounds
        facets = domain.facets(condition.number)
        pressed = facet_values(domain.mesh, pressure, facets, points) > 0.0
        gap = facet_values(domain.mesh, forms.exact - obstacle, facets, points)
        share = (pressed | (gap <= 0.0)).mean(axis=1)
        sets[facets] = np.where(share == 1.0, BOUND, np.where(share == 0.0, FREE, MIXED))
    return sets[facets_of(domain, forms.bounded)]


def _forms(domain: Domain, problem: Problem) -> Forms:
    """Take a problem to a mesh, and insist that Γ1 has α alone."""
    forms = Forms(problem, domain.mesh, "CR", domain.parts, domain.materials)
    for condition in forms.bounded:
        if [sign for sign, _ in condition.bounds] != [1]:
            raise ValueError(f"{condition.part} has an upper bound, of which the theory is not")
    return forms


@dataclass(frozen=True)
class Judgement:
    """Numbers of contact facets, over all ranks, as u and the discrete solution see them.

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
    """Compare the discrete active set with the sets (2.2); collective.

    Raises:
        ValueError: As for `facet_sets`.
    """
    sets, contact = facet_sets(solution.domain, example), solution.contact
    active = contact.active[np.argsort(contact.facets)]
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
        ValueError: The solution is that of another element, u or λ is not known, the problem is not
            the paper's, as with another κ, or the mesh has ghost cells.
    """
    domain, problem = solution.domain, solution.problem
    if solution.element != "CR" or problem.exact is None:
        raise ValueError("the estimate is that of the CR element, and needs the exact solution")
    forms = _forms(domain, problem)
    if not _is_the_papers(forms):
        raise ValueError(
            "the estimate is that of the paper's problem: κ = 1, no reaction, no loss of heat, no"
            " flux beside an obstacle's"
        )
    mesh = domain.mesh
    if mesh.comm.allreduce(mesh.topology.index_map(mesh.topology.dim).num_ghosts):
        raise ValueError("the terms are summed over cells: make the mesh with GhostMode.none")
    interpolant = interpolate(domain, problem.exact, degree)
    w = fem.Function(interpolant.function_space)
    w.x.array[:] = interpolant.x.array - solution.u.x.array
    n, u = ufl.FacetNormal(mesh), forms.exact
    kinds = _sides(domain, forms, facet_sets(domain, example))
    sources = {
        _SOURCES + i: facet_entities(mesh, domain.facets(condition.number)).ravel()
        for i, condition in enumerate(forms.natural)
    }
    metadata = {"quadrature_degree": degree}
    dx = ufl.Measure("dx", mesh, metadata=metadata)
    ds = ufl.Measure(
        "ds", mesh, metadata=metadata, subdomain_data=[*kinds.items(), *sources.items()]
    )

    def square(v: fem.Function) -> ufl.Form:
        return ufl.inner(ufl.grad(u - v), ufl.grad(u - v)) * dx

    def side(kind: int) -> ufl.Form:
        return ufl.dot(ufl.grad(u), n) * w * ds(kind)

    load = forms.f * w * dx
    for number, condition in zip(sources, forms.natural, strict=True):
        load += condition.flux * w * ds(number)
    terms = [
        square(solution.u),
        square(interpolant),
        side(_INTERIOR),
        side(_DIRICHLET),
        side(BOUND),
        side(MIXED),
        ufl.inner(ufl.grad(u), ufl.grad(w)) * dx - load,
    ]
    integrals = [fem.assemble_scalar(compiled(mesh.comm, fem.form, term)) for term in terms]
    owned = w.function_space.dofmap.index_map.size_local
    integrals.append(float(solution.residual.x.array[:owned] @ w.x.array[:owned]))
    total = np.array(integrals)
    mesh.comm.Allreduce(MPI.IN_PLACE, total)
    sums: list[float] = [float(value) for value in total]
    error, best, interior, dirichlet, bound, mixed, consistency, slack = sums
    return Estimate(
        error, best, interior, dirichlet, bound + mixed, bound, mixed, slack, consistency
    )


def _is_the_papers(forms: Forms) -> bool:
    """Tell whether it is −Δu = f, with nothing but α on Γ1 and ∂ₙu = g on Γg."""
    return (
        forms.problem.form is None
        and (as_number(forms.kappa), as_number(forms.reaction)) == (1.0, 0.0)
        and all(condition.loss is None for condition in forms.conditions)
        and all(condition.flux is None for condition in forms.bounded)
    )


_DIRICHLET, _NATURAL, _INTERIOR, _SOURCES = 3, 4, 5, 6


def _sides(domain: Domain, forms: Forms, sets: npt.NDArray[np.int8]) -> dict[int, Int32Array]:
    """Find the sides of the owned cells in BOUND, in MIXED, on Γ0, and inside, where both count.

    DOLFINx takes any list of sides for a one-sided integral, interior facets' as well; thus no
    integral over jumps is needed, and no ghost cells.

    Returns:
        Pairs (cell, facet's number in the cell), flattened.
    """
    mesh = domain.mesh
    tdim = mesh.topology.dim
    for pair in ((tdim, tdim - 1), (tdim - 1, tdim)):
        mesh.topology.create_connectivity(*pair)
    facets = mesh.topology.index_map(tdim - 1)
    kind = np.full(facets.size_local + facets.num_ghosts, _INTERIOR, dtype=np.int8)
    kind[exterior_facet_indices(mesh.topology)] = _NATURAL
    kind[facets_of(domain, forms.fixed)] = _DIRICHLET
    kind[facets_of(domain, forms.bounded)] = sets
    cells = mesh.topology.index_map(tdim).size_local
    sides = kind[mesh.topology.connectivity(tdim, tdim - 1).array.reshape(-1, tdim + 1)[:cells]]
    return {
        number: np.argwhere(sides == number).astype(np.int32).ravel()
        for number in (BOUND, MIXED, _DIRICHLET, _INTERIOR)
    }
