"""Measures of u − u_h: the broken norm (1.6), L2, λ on Γ1, and the rates."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import ufl
from dolfinx import fem
from dolfinx.mesh import Mesh
from mpi4py import MPI

from .. import compat
from ..arrays import FloatArray, Int32Array
from ..data.diffusion import diffusion
from ..fem.conditions import Data, changed
from ..fem.problem import Forms, as_expression
from ..fem.space import facet_quadrature, vertex_values
from ..mesh.domain import facet_entities
from ..solution import Solution


def rates(h: Sequence[float], errors: Sequence[float]) -> FloatArray:
    """Compute orders observed between levels, log(e_k / e_{k+1}) / log(h_k / h_{k+1}).

    Returns:
        One less than there are levels; not a number where an error is 0.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        found = np.diff(np.log(np.asarray(errors))) / np.diff(np.log(np.asarray(h)))
    return np.where(np.isfinite(found), found, np.nan)


def errors(solution: Solution, degree: int) -> tuple[float, float]:
    """Compute `Solution.errors` with a quadrature of another degree; collective.

    What u depends on, as the time, is what it was when the solution was made.

    Returns:
        ‖u − u_h‖_h in the broken norm (1.6) and ‖u − u_h‖ in L2.
    """
    problem = changed(diffusion(solution.level.data).forms.called, error_degree=degree)
    forms = Forms(
        problem,
        solution.domain.mesh,
        solution.element,
        solution.domain.parts,
        solution.domain.materials,
    )
    with solution.level.as_made():
        return forms.errors(solution.domain, solution.u)


def pressure_error(solution: Solution, pressure: Data, degree: int = 12) -> float:
    """Compute ‖λ − λ_h‖ in L2(Γ1), with λ_h constant on each facet; collective.

    Args:
        solution: u_h and λ_h.
        pressure: λ = ∂ₙu, a function of x.
        degree: Degree of the quadrature on the facets.
    """
    mesh, contact = solution.domain.mesh, solution.contact
    points, weights = facet_quadrature(mesh, degree)
    difference = facet_values(mesh, pressure, contact.facets, points) - contact.pressure[:, None]
    return _total(mesh, float(np.sum((difference**2 @ weights) * contact.measure))) ** 0.5


def distance(coarse: Solution, fine: Solution) -> float:
    """Compute ‖u_H − u_h‖_h of the solutions on a mesh and on the next in sequence; collective.

    Where u is not known, these distances fall as the errors do.

    Args:
        coarse: u_H, the solution that the fine one started from.
        fine: u_h.

    Raises:
        ValueError: They are not neighbours in a sequence.
    """
    parents = fine.level.parents
    if parents is None or fine.level.meshes[:-1] != coarse.level.meshes:
        raise ValueError("the second solution isn't from the level after the first one's")
    mesh = fine.domain.mesh
    gradients, volumes = cell_gradients(fine.u)
    coarse_gradients, _ = cell_gradients(coarse.u)
    each = np.arange(len(coarse_gradients), dtype=np.int32)
    difference = gradients - parents.take(coarse_gradients, each, slice(len(gradients)))
    return _total(mesh, float(volumes @ (difference**2).sum(axis=1))) ** 0.5


def cell_gradients(u: fem.Function) -> tuple[FloatArray, FloatArray]:
    """Compute the gradient of a CR or P1 function on each cell of this rank.

    Returns:
        Gradients, shape (cells, gdim), and the cells' volumes, shape (cells,).
    """
    mesh = u.function_space.mesh
    tdim, gdim = mesh.topology.dim, mesh.geometry.dim
    cells = slice(mesh.topology.index_map(tdim).size_local)
    values = vertex_values(u, cells)
    x = mesh.geometry.x[compat.cell_nodes(mesh)[cells], :gdim]
    edges = x[:, 1:] - x[:, :1]
    rises = (values[:, 1:] - values[:, :1])[..., None]
    # `simplex_measures` squares lengths' ratios, and is no good for cells 10⁶ times as long as high
    volumes = np.abs(np.linalg.det(edges)) / np.prod(np.arange(1, tdim + 1))
    return np.linalg.solve(edges, rises)[..., 0], volumes


def facet_values(mesh: Mesh, data: Data, facets: Int32Array, points: FloatArray) -> FloatArray:
    """Evaluate data at the same points of each facet; collective.

    Args:
        mesh: Where.
        data: A function of x, say.
        facets: Local indices, shape (n,).
        points: On the reference facet, shape (q, d − 1).

    Returns:
        Shape (n, q).
    """
    expression = as_expression(data, ufl.SpatialCoordinate(mesh))
    compiled = compat.FacetExpression(expression, points, mesh)
    return compiled.at(mesh, facet_entities(mesh, facets))[:, :, 0]


def _total(mesh: Mesh, share: float) -> float:
    return float(mesh.comm.allreduce(share, op=MPI.SUM))
