"""Guaranteed bounds of the contact force, where the contact boundary keeps clear of Γ0."""

from __future__ import annotations

from typing import Protocol

import numpy as np
import ufl
from dolfinx import fem
from dolfinx.fem.petsc import assemble_matrix
from dolfinx.la import InsertMode

from ..data.diffusion import diffusion
from ..errors import InputError
from ..fem.cells import Cells, dot_rows, sum_rows
from ..fem.conditions import facets_of
from ..fem.space import ghosted_vector, shared_sum
from ..garbage import release
from ..jit import compiled
from ..options import ESTIMATE_PREFIX, WEIGHT, solve_once
from ..vi.solved import Solved
from .certificate import Certificate

NO_BOUNDS = "the contact force has no bounds"
TOUCHES = "Γ1 touches Γ0: the force is no bounded functional of the solution there"
VARIES = "the coefficient varies within cells"
LOST = "terms without gradients are not worked out"
SPATIAL = "they are worked out for d = 2 only"


class Certified(Solved, Protocol):
    """A solution that knows its certificate."""

    @property
    def certificate(self) -> Certificate:
        """What is certain about the error."""


def force_bounds(solution: Certified) -> tuple[float, float]:
    """Two numbers with ∫_Γ1 κ∂ₙu between them; collective.

    With φ = 1 on Γ1 and 0 on Γ0, ∫_Γ1 κ∂ₙu − ∫_Γ1 y·n is the integral of (κ∇u − y)·∇φ, and the
    certificate knows a ball in which κ∇u is. φ is found by solving for a harmonic function, as
    accurately as the figures deserve; that costs about as much as the solve.

    Args:
        solution: One with a certified bound.

    Raises:
        InputError: There is no bound; the message says why.
    """
    certificate = solution.certificate
    made = certificate._made
    if made is None or certificate.bound_h1 is None:
        raise InputError(f"{NO_BOUNDS}: {certificate.reason}")
    level = made.level
    cells = Cells(level.domain, level.V)
    lost = diffusion(level.data).forms.of_one is not None
    if lost or made.varies or cells.tdim != 2:
        why = LOST if lost else VARIES if made.varies else SPATIAL
        raise InputError(f"{NO_BOUNDS}: {why}")
    phi = _weight(solution)
    at_vertices = np.ascontiguousarray(
        phi.x.array[phi.function_space.dofmap.list[: cells.number]].T
    )
    everywhere = slice(0, cells.number)
    slopes = cells.apply(at_vertices, everywhere)
    w = made.w
    v = made.vertices[cells.vertices]
    P, d = made.excess, cells.tdim
    # ½ ∫ (κ∇v − y − σ)·∇φ
    total = sum_rows(at_vertices)
    work = made.kappa * (dot_rows(v, slopes) - dot_rows(w, slopes))
    work -= made.kappa * 4 / 3 * dot_rows(made.bumps[cells.facets], slopes)
    if made.cusps is not None:
        pull, _ = made.cusps.pulls(cells)
        work[made.cusps.at] += dot_rows(pull, at_vertices[:, made.cusps.at])
    s = sum_rows(P)
    work -= (s * total - dot_rows(P, at_vertices)) / d - s * total / (d + 1)
    if made.hats is not None:
        work -= cells.volume * dot_rows(made.hats, at_vertices)
    edge = made.segments
    ends = at_vertices[cells.others[edge.side.local].T, edge.side.cells]
    on_edge = np.einsum("qin,in->qn", edge.hats, ends)
    edge_work = np.sum(edge.measure * edge.weights[:, None] * edge.rest * on_edge)
    energy = np.sum(made.kappa * dot_rows(at_vertices, slopes))
    middle, energy = cells.total(
        made.force + 0.5 * (float(np.sum(work)) - float(edge_work)), float(energy)
    )
    reach = made.reach * np.sqrt(energy)
    conditions = diffusion(level.data).forms.bounded
    signs = {sign for condition in conditions for sign, _ in condition.bounds}
    lowest, highest = (0.0 if signs == {s} else s * -np.inf for s in (1, -1))
    return max(float(middle - reach), lowest), min(float(middle + reach), highest)


def _weight(solution: Certified) -> fem.Function:
    """A P1 function that is 1 on Γ1, 0 on Γ0, and nearly harmonic between them."""
    domain = solution.domain
    mesh, fdim = domain.mesh, domain.mesh.topology.dim - 1
    V = fem.functionspace(mesh, ("Lagrange", 1))
    phi, marks = fem.Function(V), fem.Function(V)
    forms, parts = diffusion(solution.level.data).forms, []
    for conditions in (forms.bounded, forms.fixed):
        marks.x.array[:] = 0.0
        marks.x.array[fem.locate_dofs_topological(V, fdim, facets_of(domain, conditions))] = 1.0
        seen = shared_sum(mesh.comm, V.dofmap.index_map, marks.x.array)
        parts.append(np.flatnonzero(seen > 0).astype(np.int32))
    bounded, fixed = parts
    both = len(np.intersect1d(bounded, fixed))
    if mesh.comm.allreduce(both) > 0:
        raise InputError(f"{NO_BOUNDS}: {TOUCHES}")
    u, w = ufl.TrialFunction(V), ufl.TestFunction(V)
    known = np.concatenate(parts)
    marks.x.array[:] = 0.0
    marks.x.array[bounded] = 1.0
    bc = fem.dirichletbc(marks, known)
    form = compiled(mesh.comm, fem.form, ufl.inner(ufl.grad(u), ufl.grad(w)) * ufl.dx)
    A, b = assemble_matrix(form, [bc]), fem.Function(V)
    A.assemble()
    fem.apply_lifting(b.x.array, [form], [[bc]])
    b.x.scatter_reverse(InsertMode.add)
    b.x.array[known] = marks.x.array[known]
    load, found = (ghosted_vector(V, function.x.array) for function in (b, phi))
    solve_once(A, load, found, WEIGHT, ESTIMATE_PREFIX)
    release(A, load, found)
    # Exactly so, whatever the solver did
    phi.x.array[bounded] = 1.0
    phi.x.array[fixed] = 0.0
    phi.x.scatter_forward()
    return phi
