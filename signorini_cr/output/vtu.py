"""A solution for ParaView: one .vtu file, written by all ranks at once.

A CR function jumps across the edges, so every cell brings its own d + 1 points: the field is
the DG1 interpolant, which is u_h itself, and nothing is averaged on the way to the screen. What
lives on Γ1 is on cells of one dimension less, its facets, beside the others in the same file.

There is one piece, and arrays stand in it as base64: not all readers take several pieces, or binary
data behind the XML.
"""

from __future__ import annotations

import binascii
import errno
import fcntl
import os
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
from dolfinx import fem
from mpi4py import MPI

from ..arrays import FloatArray
from ..compat import cell_nodes
from ..errors import InputError, on_root, raise_together
from ..fem.space import facet_corners, vertex_values
from ..mesh.domain import facet_entities
from .files import Where, as_path, disk_errors

if TYPE_CHECKING:
    from ..solution import Solution

CELL_TYPES = {2: 3, 3: 5, 4: 10}
"""VTK's numbers for interval, triangle and tetrahedron, by the number of corners."""

NUMBERS = {"f": "Float", "i": "Int", "u": "UInt"}
"""VTK's names for NumPy's kinds of numbers."""

HEAD = """<?xml version="1.0"?>
<VTKFile type="UnstructuredGrid" version="1.0" byte_order="LittleEndian" header_type="UInt64">
<UnstructuredGrid><Piece NumberOfPoints="{points}" NumberOfCells="{cells}">
"""
TAIL = "</Piece></UnstructuredGrid>\n</VTKFile>\n"

Fields = Mapping[str, npt.NDArray]


def write_vtu(u: fem.Function, path: Where, name: str = "u") -> None:
    """Write a CR or P1 function as a piecewise affine field; collective.

    Args:
        u: The function, ghosts up to date.
        path: The file; overwritten if it is there.
        name: What ParaView calls the field.

    Raises:
        InputError: The system refuses to write.
    """
    mesh = u.function_space.mesh
    owned = slice(mesh.topology.index_map(mesh.topology.dim).size_local)
    x = mesh.geometry.x[cell_nodes(mesh)[owned, : mesh.topology.dim + 1]]
    _write(mesh.comm, as_path(path), [x], {name: vertex_values(u, owned).ravel()}, {})


def write_solution(solution: Solution, path: Where) -> None:
    """Write u_h and what is known about it; collective.

    At the corners of each cell, and of each facet of Γ1: `u`, and `companion`, the vertex values
    of the conforming companion. On each cell: `indicator`, the square root of its share of the
    certified bound. On each facet of Γ1: `pressure`, `contact` (0 or 1), `obstacle`, and `upper`
    if there is an upper bound. Elsewhere these are 0, and bounds are NaN. The certificate is made
    if there is none.

    Args:
        solution: The solution.
        path: The file; overwritten if it is there.

    Raises:
        InputError: The system refuses to write.
    """
    mesh, contact, certificate = solution.domain.mesh, solution.contact, solution.certificate
    corners = mesh.topology.dim + 1
    owned = mesh.topology.index_map(mesh.topology.dim).size_local
    behind, local = facet_entities(mesh, contact.facets).T
    ends = facet_corners(mesh)[local]

    def at_corners(values: npt.NDArray) -> list[npt.NDArray]:
        """Choose among values at all cells' corners those of own cells, and of the facets."""
        return [values[:owned], np.take_along_axis(values[behind], ends, axis=1)]

    def flat(values: npt.NDArray) -> npt.NDArray:
        return np.concatenate([each.ravel() for each in at_corners(values)])

    on_points = {"u": flat(vertex_values(solution.u))}
    v = certificate.companion_at_vertices
    if v is not None:
        vertices = mesh.topology.connectivity(mesh.topology.dim, 0).array
        on_points["companion"] = flat(v[vertices.reshape(-1, corners)])
    nowhere = np.zeros(owned)
    on_cells = {
        "pressure": np.append(nowhere, contact.pressure),
        "contact": np.append(nowhere, contact.active).astype(np.uint8),
        **{
            name: np.append(np.full(owned, np.nan), bound) for name, bound in contact.bounds.items()
        },
    }
    if certificate.indicators is not None:
        on_facets = np.zeros(len(contact.facets))
        # where v differs from u_h by a constant, rounding decides on which side of 0 shares are
        shares = np.sqrt(np.maximum(certificate.indicators, 0.0))
        on_cells["indicator"] = np.append(shares, on_facets)
    shapes = [mesh.geometry.x[nodes] for nodes in at_corners(cell_nodes(mesh)[:, :corners])]
    _write(mesh.comm, as_path(path), shapes, on_points, on_cells)


def _write(
    comm: MPI.Comm, path: Path, shapes: list[FloatArray], on_points: Fields, on_cells: Fields
) -> None:
    """Write a grid, of which each rank has a part; collective.

    Args:
        comm: The ranks.
        path: The file.
        shapes: Corners of the cells, those of one kind in one array, shape (n, corners, 3).
        on_points: Values at the corners, in the same order, by name, shape (points,).
        on_cells: Values on the cells, by name, shape (cells,).
    """
    points = np.concatenate([cells.reshape(-1, 3) for cells in shapes])
    sizes = np.repeat([cells.shape[1] for cells in shapes], [len(cells) for cells in shapes])
    numbers = np.array(comm.allgather((len(points), len(sizes))))
    before = numbers[: comm.rank, 0].sum()
    grid = {
        "connectivity": before + np.arange(len(points)),
        "offsets": before + np.cumsum(sizes),
        "types": np.array([CELL_TYPES.get(size, 0) for size in range(5)], dtype=np.uint8)[sizes],
    }
    head = HEAD.format(points=numbers[:, 0].sum(), cells=numbers[:, 1].sum())
    texts, arrays = [], []  # the words before each array, and the array
    groups: dict[str, Fields] = {
        "Points": {"points": points},
        "PointData": on_points,
        "CellData": on_cells,
        "Cells": grid,
    }
    for tag, group in groups.items():
        head += f"<{tag}>\n"
        for name, values in group.items():
            kind = f"{NUMBERS[values.dtype.kind]}{8 * values.dtype.itemsize}"
            shape = f' NumberOfComponents="{values.shape[1]}"' if values.ndim == 2 else ""
            texts.append(f'{head}<DataArray type="{kind}" Name="{name}"{shape} format="binary">')
            arrays.append(values)
            head = "</DataArray>\n"
        head += f"</{tag}>\n"
    encoded, lengths = _encoded(comm, arrays)
    starts = np.cumsum([len(text) for text in texts]) + np.cumsum([0, *lengths[:-1]])
    end = starts[-1] + lengths[-1]

    def begin() -> None:
        with disk_errors(path), path.open("w+b") as file:
            for text, start in zip(texts, starts, strict=True):
                file.seek(start - len(text))
                file.write(text.encode())
            file.seek(end)
            file.write((head + TAIL).encode())
            _reserve(file.fileno(), file.tell())

    def fill() -> None:
        with disk_errors(path), path.open("r+b", buffering=0) as file:
            for start, (place, data) in zip(starts.tolist(), encoded, strict=True):
                _put(file.fileno(), data, start + place)

    on_root(comm, begin)
    complaint: str | None = None
    try:
        fill()
    except InputError as error:  # on this rank alone, perhaps
        complaint = str(error)
    raise_together(comm, complaint)


def _put(file: int, data: bytes, at: int) -> None:
    """Write bytes of a file that others write at other places of."""
    if not data:  # for a lock that would be all there is
        return
    with suppress(OSError):
        # Not to wait for anyone: a network's file system then sends these bytes and no others,
        # where it might send blocks as it had known them. Closing the file lets go.
        fcntl.lockf(file, fcntl.LOCK_EX, len(data), at)
    left = memoryview(data)
    while left:
        written = os.pwrite(file, left, at)
        left, at = left[written:], at + written


def _encoded(
    comm: MPI.Comm, arrays: list[npt.NDArray]
) -> tuple[list[tuple[int, bytes]], list[int]]:
    """Encode this rank's share of arrays, of which each rank has a part, in base64; collective.

    Three bytes become four letters, so a rank leaves bytes at its beginning that belong to letters
    of the one before, and takes as many from behind.

    Returns:
        For each array where the share begins, and the share; then the lengths of the whole.
    """
    bits = [
        values.astype(values.dtype.newbyteorder("<"), copy=False).tobytes() for values in arrays
    ]
    totals = np.sum(comm.allgather([len(each) for each in bits]), axis=0)
    if comm.rank == 0:  # an array begins with its length
        bits = [int(n).to_bytes(8, "little") + each for n, each in zip(totals, bits, strict=True)]
    ends = np.cumsum(comm.allgather([len(each) for each in bits]), axis=0)[comm.rank]
    heads = comm.allgather([each[:2] for each in bits])[comm.rank + 1 :]
    shares = []
    for k, (end, each) in enumerate(zip(ends.tolist(), bits, strict=True)):
        left = (len(each) - end) % 3
        taken = b"".join(head[k] for head in heads)[: -end % 3] if len(each) > left else b""
        data = binascii.b2a_base64(each[left:] + taken, newline=False)
        shares.append(((end - len(each) + left) // 3 * 4, data))
    return shares, [(int(n) + 10) // 3 * 4 for n in totals]


def _reserve(file: int, length: int) -> None:
    """Find out that a disk is full before all ranks write to it; not every system can tell.

    The file must be readable, too: some C libraries read where the system does not do it for them.
    """
    if hasattr(os, "posix_fallocate"):
        try:
            os.posix_fallocate(file, 0, length)
        except OSError as error:
            if error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG):
                raise
