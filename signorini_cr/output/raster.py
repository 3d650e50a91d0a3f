"""u_h on a grid of pixels: its value at each pixel's centre, by all ranks, without a gather."""

from __future__ import annotations

import itertools

import numpy as np
from dolfinx import fem
from dolfinx.mesh import Mesh
from mpi4py import MPI

from ..arrays import FloatArray, Int64Array
from ..compat import cell_nodes
from ..errors import InputError
from ..fem.layout import Layout
from ..fem.space import function_space, vertex_values
from ..mesh.domain import Domain

AT_ONCE = 2**16
"""Pairs of a pixel and a cell near it that are looked at in one go."""

EDGE = 1e-9
"""Rounding in a barycentric coordinate."""


def plane(domain: Domain) -> Mesh:
    """Return the mesh of a plane domain, or refuse to draw another."""
    if domain.mesh.geometry.dim != 2 or domain.mesh.topology.dim != 2:
        raise InputError("pictures are of plane domains only; for others open solution.vtu")
    return domain.mesh


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

    Row by row of the image: barycentric coordinates are affine along a row, so that a triangle's
    pixels there are those between two numbers.

    Args:
        image: Changed in place.
        x: First coordinates of the corners, shape (3, cells).
        y: Second coordinates.
        values: At the corners, shape (3, cells).
    """
    first_row, height = _between(y)
    area = (x[1] - x[0]) * (y[2] - y[0]) - (x[2] - x[0]) * (y[1] - y[0])
    right = np.stack([y[1] - y[2], y[2] - y[0], y[0] - y[1]]) / area
    up = np.stack([x[2] - x[1], x[0] - x[2], x[1] - x[0]]) / area
    slope = (values * right).sum(axis=0)
    # Pixels in the boxes around them are no more than those in so many rows
    before = np.cumsum(np.append(0, height * _between(x)[1]))
    cuts = np.searchsorted(before, np.append(np.arange(0, before[-1], AT_ONCE), before[-1]))
    for begin, end in itertools.pairwise(cuts):
        cell = np.repeat(np.arange(begin, end), height[begin:end])
        row = first_row[cell] + _counted(height[begin:end])
        # Barycentric coordinates in this row, beside the first corner
        there = up[:, cell] * (row - y[0, cell])
        there[0] += 1.0
        across = right[:, cell]
        with np.errstate(divide="ignore", invalid="ignore"):
            ends = (-EDGE - there) / across
        low = np.where(across > 0.0, ends, -np.inf).max(axis=0)
        high = np.where(across < 0.0, ends, np.inf).min(axis=0)
        low[((across == 0.0) & (there < -EDGE)).any(axis=0)] = np.inf
        first, last = np.ceil(x[0, cell] + low), np.floor(x[0, cell] + high)
        spans = np.flatnonzero(last >= first)
        first, last = first[spans].astype(int), last[spans].astype(int)
        cell, number = cell[spans], last - first + 1
        start = (values[:, cell] * there[:, spans]).sum(axis=0) + slope[cell] * (first - x[0, cell])
        place, along = row[spans] * image.shape[1] + first, _counted(number)
        value = np.repeat(start, number) + np.repeat(slope[cell], number) * along
        np.maximum.at(image.reshape(-1), np.repeat(place, number) + along, value)


def _counted(number: Int64Array) -> Int64Array:
    """Count from 0 to each of these numbers, one after the other: 0, 1, 0, 1, 2 for 2 and 3."""
    return np.arange(number.sum()) - np.repeat(np.cumsum(number) - number, number)


def _between(x: FloatArray) -> tuple[Int64Array, Int64Array]:
    """Find the first whole number between the least and greatest of each column, and how many."""
    first = np.ceil(x.min(axis=0) - 1e-9).astype(int)
    return first, np.maximum(np.floor(x.max(axis=0) + 1e-9).astype(int) - first + 1, 0)
