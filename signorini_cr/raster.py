"""u_h on a grid of pixels: its value at each pixel's centre, by all ranks, without a gather."""

from __future__ import annotations

import itertools

import numpy as np
import numpy.typing as npt
from dolfinx import fem
from mpi4py import MPI

from .compat import cell_nodes
from .space import vertex_values

FloatArray = npt.NDArray[np.float64]
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
    corners = mesh.geometry.x[cell_nodes(mesh)[:owned, :3], :2]
    values = vertex_values(u, slice(owned))
    lowest = np.append(corners.min(axis=(0, 1), initial=np.inf), values.min(initial=np.inf))
    highest = np.append(corners.max(axis=(0, 1), initial=-np.inf), values.max(initial=-np.inf))
    comm.Allreduce(MPI.IN_PLACE, lowest, op=MPI.MIN)
    comm.Allreduce(MPI.IN_PLACE, highest, op=MPI.MAX)
    box = np.stack([lowest[:2], highest[:2]])
    size = box[1] - box[0]
    columns, rows = np.maximum(np.rint(pixels * size / size.max()), pixels // 5).astype(int)
    image = np.full((rows, columns), -np.inf)
    # In these coordinates pixel (i, j) has its centre at (i, j)
    _paint(image, (corners - box[0]) * (np.array([columns, rows]) / size) - 0.5, values)
    comm.Reduce(MPI.IN_PLACE if comm.rank == 0 else image, image, op=MPI.MAX, root=0)
    image[np.isneginf(image)] = np.nan
    return image, box, (float(lowest[2]), float(highest[2]))


def _paint(image: FloatArray, corners: FloatArray, values: FloatArray) -> None:
    """Paint affine functions on triangles; where they meet the greatest value wins.

    Args:
        image: Changed in place.
        corners: Shape (cells, 3, 2).
        values: At the corners, shape (cells, 3).
    """
    first = np.ceil(corners.min(axis=1) - 1e-9).astype(int)
    width, height = np.maximum(np.floor(corners.max(axis=1) + 1e-9).astype(int) - first + 1, 0).T
    before = np.cumsum(np.append(0, width * height))
    # Barycentric coordinates 1 and 2 of a point are inverse @ (point - corner 0)
    (ax, ay), (bx, by) = np.moveaxis(corners[:, 1:] - corners[:, :1], 0, -1)
    inverse = np.moveaxis(np.array([[by, -bx], [-ay, ax]]) / (ax * by - ay * bx), -1, 0)
    cuts = np.searchsorted(before, np.append(np.arange(0, before[-1], AT_ONCE), before[-1]))
    for begin, end in itertools.pairwise(cuts):
        cell = np.repeat(np.arange(begin, end), (width * height)[begin:end])
        place = np.arange(len(cell)) + before[begin] - before[cell]
        column = first[cell, 0] + place % width[cell]
        row = first[cell, 1] + place // width[cell]
        offset = np.stack([column, row], axis=1) - corners[cell, 0]
        second, third = np.einsum("nij,nj->in", inverse[cell], offset)
        inside = np.minimum(np.minimum(second, third), 1.0 - second - third) >= -1e-9
        cell, second, third = cell[inside], second[inside], third[inside]
        value = values[cell, 0] * (1 - second - third)
        value += values[cell, 1] * second + values[cell, 2] * third
        np.maximum.at(image, (row[inside], column[inside]), value)
