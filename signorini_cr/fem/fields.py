"""Functions in spaces that DOLFINx's own writers draw as they are: DG1 for u_h, DG0 for the rest.

A Crouzeix-Raviart function jumps between cells and has its values at facet midpoints, which a
writer takes for vertices of a mesh. What lives on facets lives on a mesh of those facets.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import numpy.typing as npt
from dolfinx import fem
from dolfinx.mesh import Mesh

from ..arrays import Int32Array
from ..compat import submesh
from .cells import on_cells
from .space import vertex_values


def discontinuous(u: fem.Function, name: str = "u") -> fem.Function:
    """Turn a CR or P1 function into the discontinuous P1 function that equals it; collective.

    Args:
        u: The function, ghosts up to date.
        name: What writers are to call it.
    """
    V = fem.functionspace(u.function_space.mesh, ("DG", 1))
    function = fem.Function(V, name=name)
    function.x.array[V.dofmap.list] = vertex_values(u)
    return function


def on_facets(
    mesh: Mesh, facets: Int32Array, values: Mapping[str, npt.NDArray]
) -> dict[str, fem.Function]:
    """Make functions that are constant on each facet, on one mesh of these facets; collective.

    Args:
        mesh: The mesh that the facets are of.
        facets: Local indices of facets that this rank owns, ascending, shape (n,).
        values: By the functions' names, one a facet, shape (n,).
    """
    lines, parents = submesh(mesh, mesh.topology.dim - 1, facets)
    rows = np.searchsorted(facets, parents)
    return {name: on_cells(lines, column[rows], name) for name, column in values.items()}
