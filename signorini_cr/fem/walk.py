"""A walk along Γ1: the contact facets in the order in which the boundary passes through them."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from dolfinx.mesh import Mesh

from ..compat import cell_nodes
from .space import facet_entities

FloatArray = npt.NDArray[np.float64]


def along_boundary(
    mesh: Mesh, facets: npt.NDArray[np.int32], fields: dict[str, npt.NDArray]
) -> tuple[dict[str, npt.NDArray] | None, FloatArray]:
    """Sort the contact facets along the boundary and find the transition points; collective.

    A surface has no such order: for d = 3 the facets are sorted by their midpoints, arc_length
    is NaN, and there are no transition points.

    Args:
        mesh: The mesh.
        facets: The contact facets that this rank owns, shape (n,).
        fields: What `Contact` has of them: vertices, measure, obstacle, u, pressure, active and
            gap_at_vertices.

    Returns:
        The table on rank 0 (None elsewhere), and the transition points on all ranks.
    """
    columns = dict(fields)
    if mesh.topology.dim == 2:
        columns["reverse"] = _clockwise(mesh, facets, fields["vertices"])
    gathered = mesh.comm.gather(columns, root=0)
    table = None
    transitions: FloatArray = np.zeros((0, 3))
    if gathered is not None:
        rows = {name: np.concatenate([part[name] for part in gathered]) for name in columns}
        if "reverse" in rows:
            table, transitions = _ordered(rows)
        else:
            table = _by_position(rows)
    return table, mesh.comm.bcast(transitions, root=0)


def _clockwise(mesh: Mesh, facets: npt.NDArray[np.int32], vertices: FloatArray) -> npt.NDArray:
    """Whether Ω lies to the right when a facet is walked from its first vertex to its second."""
    cells, local = facet_entities(mesh, facets).T
    apex = mesh.geometry.x[cell_nodes(mesh)[cells, local]]
    along, inward = vertices[:, 1] - vertices[:, 0], apex - vertices[:, 0]
    return along[:, 0] * inward[:, 1] - along[:, 1] * inward[:, 0] < 0


def _columns(
    rows: dict[str, npt.NDArray], part: npt.NDArray, arc_length: FloatArray
) -> dict[str, npt.NDArray]:
    """The columns of the table, rows in the order they are in."""
    midpoints = rows["vertices"].mean(axis=1)
    given = {name: rows[name] for name in ("obstacle", "u", "pressure", "active")}
    place = {"part": part, "arc_length": arc_length, "x": midpoints[:, 0], "y": midpoints[:, 1]}
    return place | {"length": rows["measure"]} | given


def _by_position(rows: dict[str, npt.NDArray]) -> dict[str, npt.NDArray]:
    """Sort the facets of a surface by their midpoints."""
    order = np.lexsort(rows["vertices"].mean(axis=1).T[::-1])
    table = _columns(rows, np.zeros(len(order), dtype=np.int64), np.full(len(order), np.nan))
    return {name: column[order] for name, column in table.items()}


def _ordered(rows: dict[str, npt.NDArray]) -> tuple[dict[str, npt.NDArray], FloatArray]:
    """Put facets in the order in which the boundary passes through them, Ω to the left."""
    flip = rows["reverse"]
    ends, gaps = rows["vertices"], rows["gap_at_vertices"]
    ends = np.where(flip[:, None, None], ends[:, ::-1], ends)
    gaps = np.where(flip[:, None], gaps[:, ::-1], gaps)
    number = len(ends)
    midpoints = ends.mean(axis=1)
    # The same order whatever the ranks held: by coordinates first
    start = np.lexsort(midpoints.T[::-1])
    rank = np.empty(number, dtype=np.int64)
    rank[start] = np.arange(number)
    _, vertex = np.unique(ends.reshape(-1, 3), axis=0, return_inverse=True)
    tail, head = vertex.reshape(-1, 2).T
    arriving = np.full(vertex.max(initial=-1) + 1, -1)
    arriving[head] = np.arange(number)
    before = np.where(arriving[tail] >= 0, arriving[tail], np.arange(number))
    # Closed curves have no first facet: cut them at the one of lowest rank
    lowest, jump = rank.copy(), before.copy()
    for _ in range(max(number, 1).bit_length()):
        lowest, jump = np.minimum(lowest, lowest[jump]), jump[jump]
    closed = before[jump] != jump
    cut = closed & (lowest == rank)
    before = np.where(cut, np.arange(number), before)
    # Distance to the first facet of the part, by doubling the stride
    length = rows["measure"]
    is_first = before == np.arange(number)
    distance = np.where(is_first, 0.0, 0.5 * (length + length[before]))
    steps, jump = (~is_first).astype(np.int64), before
    for _ in range(max(number, 1).bit_length()):
        distance, steps, jump = distance + distance[jump], steps + steps[jump], jump[jump]
    order = np.lexsort([steps, rank[jump]])
    part = np.unique(rank[jump], return_inverse=True)[1]
    table = _columns(rows, part, distance + 0.5 * length[jump])
    # A transition lies between a facet and the one after it when just one of them is active;
    # inside the free one if its trace changes sign there, at the vertex between them if not
    later = np.flatnonzero(arriving[tail] >= 0)
    earlier = arriving[tail[later]]
    differ = rows["active"][later] != rows["active"][earlier]
    later, earlier = later[differ], earlier[differ]
    free_is_later = rows["active"][earlier]
    free = np.where(free_is_later, later, earlier)
    vertex_gap = gaps[free, np.where(free_is_later, 0, 1)]
    middle_gap = rows["u"][free] - rows["obstacle"][free]
    inside = (vertex_gap < 0) & (middle_gap > 0)
    share = np.where(inside, middle_gap / np.where(inside, middle_gap - vertex_gap, 1.0), 1.0)
    between = ends[later, 0]
    points = midpoints[free] + share[:, None] * (between - midpoints[free])
    along = np.lexsort([steps[earlier], part[earlier]])
    return {name: column[order] for name, column in table.items()}, points[along]
