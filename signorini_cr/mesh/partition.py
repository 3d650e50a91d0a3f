"""Distribution over the ranks of the cells of a mesh that is made on rank 0."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from dolfinx import cpp

from ..arrays import FloatArray, IndexArray, Int32Array, Int64Array


def bisect(points: FloatArray, parts: int) -> Int32Array:
    """Cut a set of points in two across its longer side, and the halves again.

    The parts differ by a point or two in size, and are the same on every machine.

    Args:
        points: Shape (n, d).
        parts: How many there shall be.

    Returns:
        The part of every point, shape (n,).
    """
    part = np.zeros(len(points), dtype=np.int32)
    todo: list[tuple[IndexArray, int, int]] = [(np.arange(len(points)), 0, parts)]
    while todo:
        these, first, number = todo.pop()
        if number == 1 or not len(these):
            part[these] = first
            continue
        axis = int(np.ptp(points[these], axis=0).argmax())
        these = these[np.argsort(points[these, axis], kind="stable")]
        less = number // 2
        cut = round(len(these) * less / number)
        todo += [(these[:cut], first, less), (these[cut:], first + less, number - less)]
    return part


def by_position(points: FloatArray, cells: Int64Array) -> Callable:
    """Make a partitioner for DOLFINx's `create_mesh`, which makes no ghost cells.

    It is better than the graph partitioners at what small meshes need: every rank gets cells as
    long as there are enough, the same ones whatever partitioner DOLFINx was built with. Refining
    leaves cells where they are, so that the coarsest mesh decides.

    Args:
        points: Coordinates of the mesh on rank 0, shape (points, d); none elsewhere.
        cells: Corners of the cells on rank 0, shape (cells, d + 1); none elsewhere.
    """

    def partitioner(comm: Any, parts: int, kinds: Any, corners: Any) -> Any:
        ranks = bisect(points[cells].mean(axis=1), parts)
        return cpp.graph.AdjacencyList_int32(ranks.reshape(-1, 1))

    return partitioner
