"""u_h for ParaView: one .vtu file, written by all ranks at once.

A CR function jumps across the edges, so every cell brings its own d + 1 points: the field is
the DG1 interpolant, which is u_h itself, and nothing is averaged on the way to the screen.
"""

from __future__ import annotations

import errno
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from dolfinx import fem
from mpi4py import MPI

from ..compat import cell_nodes
from ..errors import on_root, raise_together
from ..fem.space import vertex_values
from .files import disk_errors

CELL_TYPES = {1: 3, 2: 5, 3: 10}
"""VTK's numbers for interval, triangle and tetrahedron, by topological dimension."""

NUMPY_TYPES = {"Float64": "<f8", "Int64": "<i8", "UInt8": "u1"}


def write_vtu(u: fem.Function, path: Path, name: str = "u") -> None:
    """Write a CR or P1 function as a piecewise affine field; collective.

    Args:
        u: The function, ghosts up to date.
        path: The file; overwritten if it is there.
        name: What ParaView calls the field.

    Raises:
        InputError: The system refuses to write.
    """
    mesh = u.function_space.mesh
    comm, tdim = mesh.comm, mesh.topology.dim
    owned = mesh.topology.index_map(tdim).size_local
    offset = mesh.topology.index_map(tdim).local_range[0]
    cells = mesh.topology.index_map(tdim).size_global
    corners = tdim + 1
    x = mesh.geometry.x[cell_nodes(mesh)[:owned, :corners]]
    points = np.arange(offset * corners, (offset + owned) * corners)
    # name, components, type, values of this rank, values per cell
    arrays = [
        ("points", 3, "Float64", x, 3 * corners),
        (name, 1, "Float64", vertex_values(u, slice(owned)), corners),
        ("connectivity", 1, "Int64", points, corners),
        ("offsets", 1, "Int64", np.arange(offset + 1, offset + owned + 1) * corners, 1),
        ("types", 1, "UInt8", np.full(owned, CELL_TYPES[tdim]), 1),
    ]
    tags, places, end = [], [], 0
    for label, components, kind, _, per_cell in arrays:
        size = cells * per_cell * np.dtype(NUMPY_TYPES[kind]).itemsize
        tags.append(
            f'<DataArray type="{kind}" Name="{label}" NumberOfComponents="{components}"'
            f' format="appended" offset="{end}"/>'
        )
        places.append((end, size))
        end += 8 + size
    head = "\n".join(
        [
            '<?xml version="1.0"?>',
            '<VTKFile type="UnstructuredGrid" version="1.0" byte_order="LittleEndian"'
            ' header_type="UInt64">',
            f'<UnstructuredGrid><Piece NumberOfPoints="{cells * corners}" NumberOfCells="{cells}">',
            f"<Points>{tags[0]}</Points>",
            f'<PointData Scalars="{name}">{tags[1]}</PointData>',
            f"<Cells>{''.join(tags[2:])}</Cells>",
            "</Piece></UnstructuredGrid>",
            '<AppendedData encoding="raw">\n_',
        ]
    ).encode()

    def begin() -> None:
        with disk_errors(path), path.open("w+b") as file:
            file.write(head)
            for place, size in places:
                file.seek(len(head) + place)
                file.write(np.array(size, dtype="<u8").tobytes())
            file.seek(len(head) + end)
            file.write(b"\n</AppendedData>\n</VTKFile>\n")
            _reserve(file.fileno(), file.tell())

    on_root(comm, begin)
    complaint: str | None = None

    def attempt(action: Callable[..., Any], *args: object) -> Any:
        """Keep what goes wrong, on this rank alone perhaps, while the others go on."""
        nonlocal complaint
        try:
            return action(*args)
        except MPI.Exception as error:
            complaint = complaint or f"cannot write {path.name}: {error}"

    file = attempt(MPI.File.Open, comm, str(path), MPI.MODE_WRONLY)
    raise_together(comm, complaint)
    for (place, _), (_, _, kind, values, per_cell) in zip(places, arrays, strict=True):
        data = np.ascontiguousarray(values, dtype=NUMPY_TYPES[kind])
        at = len(head) + place + 8 + offset * per_cell * data.itemsize
        attempt(file.Write_at_all, at, data)
    attempt(file.Close)
    raise_together(comm, complaint)


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
