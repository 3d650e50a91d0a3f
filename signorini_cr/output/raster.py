"""u_h on a grid of pixels: its value at each pixel's centre, by all ranks, without a gather."""

from __future__ import annotations

import itertools

import numpy as np
from dolfinx import fem
from mpi4py import MPI

from ..arrays import FloatArray, Int64Array
from ..compat import cell_nodes
from ..fem.space import function_space, vertex_values
from ..multigrid.parents import Layout

AT_ONCE = 2**20
"""Pairs of a pixel and a cell near it that are looked at in one go."""


def raster(
    u: fem.Function, pixels: int = 1000
) -> tuple[FloatArray, FloatArray, tuple[float, float]]:
    """Draw a CR or P1 function of two variables; collective.

    Every pixel has the value of u at its centre, however large the cells are: nothing is
    averaged or smoothed, and the cost is that of the pixels plus that of the cells.

    Args:
        u: The function, ghosts up to date.
        pixels: Number of pixels along the longer side of the box around the domain.

    Returns:
        On rank 0 the image, shape (rows from below, columns), NaN outside the domain; then on
        all ranks the box, shape (2, 2): lowest and highest corner, and the least and the
        greatest value of u.
    """
    mesh = u.function_space.mesh
    comm, owned = mesh.comm, mesh.topology.index_map(2).size_local
    # A row for each vertex of a cell: numpy is slow where rows are short
    nodes = np.ascontiguousarray(cell_nodes(mesh)[:owned, :3].T)
    x, y = (np.ascontiguousarray(mesh.geometry.x[:, i]).take(nodes) for i in range(2))
    values = np.ascontiguousarray(vertex_values(u, slice(owned)).T)
    lowest = np.array([each.min(initial=np.inf) for each in (x, y, values)])
    highest = np.array([each.max(initial=-np.inf) for each in (x, y, values)])
    comm.Allreduce(MPI.IN_PLACE, lowest, op=MPI.MIN)
    comm.Allreduce(MPI.IN_PLACE, highest, op=MPI.MAX)
    box = np.stack([lowest[:2], highest[:2]])
    size = box[1] - box[0]
    columns, rows = np.maximum(np.rint(pixels * size / size.max()), pixels // 5).astype(int)
    image = np.full((rows, columns), -np.inf)
    # In these coordinates pixel (i, j) has its centre at (i, j)
    x, y = (x - box[0, 0]) * (columns / size[0]) - 0.5, (y - box[0, 1]) * (rows / size[1]) - 0.5
    _paint(image, x, y, values)
    comm.Reduce(MPI.IN_PLACE if comm.rank == 0 else image, image, op=MPI.MAX, root=0)
    image[np.isneginf(image)] = np.nan
    return image, box, (float(lowest[2]), float(highest[2]))


def averaged(u: fem.Function) -> fem.Function:
    """Make the continuous P1 function of the means at the vertices; collective.

    Contour lines of u itself would be torn at every edge.

    Args:
        u: CR or P1, ghosts up to date.
    """
    V = function_space(u.function_space.mesh, "P1")
    layout, owned = Layout.of_space(V), V.mesh.topology.index_map(2).size_local
    nodes = V.dofmap.list[:owned]
    function = fem.Function(V)
    sums = [np.zeros(len(function.x.array)) for _ in range(2)]
    np.add.at(sums[0], nodes, vertex_values(u, slice(owned)))
    np.add.at(sums[1], nodes, 1.0)
    total, number = (layout.shared_sum(each) for each in sums)
    function.x.array[:] = total / number
    return function


def _paint(image: FloatArray, x: FloatArray, y: FloatArray, values: FloatArray) -> None:
    """Paint affine functions on triangles; where they meet the greatest value wins.

    Args:
        image: Changed in place.
        x: First coordinates of the corners, shape (3, cells).
        y: Second coordinates.
        values: At the corners, shape (3, cells).
    """
    first_column, width = _between(x)
    first_row, height = _between(y)
    number = width * height
    before = np.cumsum(np.append(0, number))
    cuts = np.searchsorted(before, np.append(np.arange(0, before[-1], AT_ONCE), before[-1]))
    for begin, end in itertools.pairwise(cuts):
        cell = np.repeat(np.arange(begin, end), number[begin:end])
        place = np.arange(len(cell)) + before[begin] - before[cell]
        across = width[cell]
        row = place // across
        column = first_column[cell] + place - row * across
        row += first_row[cell]
        (x0, x1, x2), (y0, y1, y2) = x[:, cell], y[:, cell]
        # Barycentric coordinates
        right, up = column - x0, row - y0
        area = (x1 - x0) * (y2 - y0) - (x2 - x0) * (y1 - y0)
        second = (right * (y2 - y0) - up * (x2 - x0)) / area
        third = (up * (x1 - x0) - right * (y1 - y0)) / area
        inside = np.minimum(np.minimum(second, third), 1.0 - second - third) >= -1e-9
        u0, u1, u2 = values[:, cell[inside]]
        second, third = second[inside], third[inside]
        pixel = row[inside] * image.shape[1] + column[inside]
        value = u0 * (1.0 - second - third) + u1 * second + u2 * third
        np.maximum.at(image.reshape(-1), pixel, value)


def _between(x: FloatArray) -> tuple[Int64Array, Int64Array]:
    """Find the first whole number between the least and greatest of each column, and how many."""
    first = np.ceil(x.min(axis=0) - 1e-9).astype(int)
    return first, np.maximum(np.floor(x.max(axis=0) + 1e-9).astype(int) - first + 1, 0)
