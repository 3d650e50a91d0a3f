"""The places where DOLFINx versions differ; found by looking, not by version numbers."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import numpy.typing as npt
from dolfinx import fem
from dolfinx.mesh import GhostMode, Mesh, create_cell_partitioner


def unghosted_partitioner() -> Callable:
    """DOLFINx's partitioner for meshes whose ranks see their own cells only."""
    try:
        return create_cell_partitioner(GhostMode.none)
    except TypeError:  # a second argument since 0.10: how many cells meet in a facet
        return create_cell_partitioner(GhostMode.none, 2)


def evaluate_on_facets(
    expression: fem.Expression, mesh: Mesh, entities: npt.NDArray[np.int32]
) -> npt.NDArray[np.float64]:
    """Evaluate an Expression with points on the reference facet.

    Args:
        expression: Compiled on a mesh of the same kind.
        mesh: Where to evaluate.
        entities: Pairs (cell, facet's number in the cell), shape (n, 2).
    """
    if not len(entities):
        return np.zeros((0, len(expression.X()) * expression.value_size))
    try:
        return expression.eval(mesh, entities)
    except (AssertionError, TypeError, ValueError, RuntimeError):  # 0.9 wants them flattened
        return expression.eval(mesh, entities.ravel())
