"""A walk along Γ1: the contact facets in the order in which the boundary passes through them."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from dolfinx.mesh import Mesh

from ..arrays import FloatArray, Int32Array, Int64Array
from ..compat import cell_nodes
from .space import facet_entities


def along_boundary(
    mesh: Mesh, facets: Int32Array, fields: dict[str, npt.NDArray]
) -> tuple[dict[str, npt.NDArray] | None, FloatArray]:
    """Sort the contact facets along the boundary and find the transition points; collective.

    A surface has no such order: for d = 3 the facets are sorted by their midpoints, arc_length
    is NaN, and there are no transition points.

    Args:
        mesh: The mesh.
        facets: The contact facets that this rank owns, shape (n,).
        fields: What `Contact` has of them: vertices, measure, obstacle, upper, u, pressure, active
            and gap_at_vertices.

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


def _clockwise(mesh: Mesh, facets: Int32Array, vertices: FloatArray) -> npt.NDArray:
    """Tell whether Ω lies to the right on the way from a facet's first vertex to its second."""
    cells, local = facet_entities(mesh, facets).T
    apex = mesh.geometry.x[cell_nodes(mesh)[cells, local]]
    along, inward = vertices[:, 1] - vertices[:, 0], apex - vertices[:, 0]
    return along[:, 0] * inward[:, 1] - along[:, 1] * inward[:, 0] < 0


def _columns(
    rows: dict[str, npt.NDArray], part: npt.NDArray, arc_length: FloatArray
) -> dict[str, npt.NDArray]:
    """The columns of the table, rows in the order they are in."""
    midpoints = rows["vertices"].mean(axis=1)
    names = ["obstacle", "upper"] if np.isfinite(rows["upper"]).any() else ["obstacle"]
    bounds = {name: np.where(np.isfinite(rows[name]), rows[name], np.nan) for name in names}
    given = bounds | {name: rows[name] for name in ("u", "pressure", "active")}
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
    ends = np.where(flip[:, None, None], rows["vertices"][:, ::-1], rows["vertices"])
    gaps = np.where(flip[:, None], rows["gap_at_vertices"][:, ::-1], rows["gap_at_vertices"])
    before = _predecessors(ends)
    # The same order whatever the ranks held: by coordinates first
    rank = np.empty(len(ends), dtype=np.int64)
    rank[np.lexsort(ends.mean(axis=1).T[::-1])] = np.arange(len(ends))
    length = rows["measure"]
    first, steps, distance = _way_from_first(_cut(before, rank), length)
    part = np.unique(rank[first], return_inverse=True)[1]
    order = np.lexsort([steps, rank[first]])
    table = _columns(rows, part, distance + 0.5 * length[first])
    points, behind = _transitions(before, ends, gaps, rows)
    along = np.lexsort([steps[behind], part[behind]])
    return {name: column[order] for name, column in table.items()}, points[along]


def _predecessors(ends: FloatArray) -> Int64Array:
    """For each facet the one that ends where it begins, itself where there is none."""
    own = np.arange(len(ends))
    _, vertex = np.unique(ends.reshape(-1, 3), axis=0, return_inverse=True)
    tail, head = vertex.reshape(-1, 2).T
    arriving = np.full(vertex.max(initial=-1) + 1, -1)
    arriving[head] = own
    return np.where(arriving[tail] >= 0, arriving[tail], own)


def _cut(before: Int64Array, rank: Int64Array) -> Int64Array:
    """Give closed curves, which have no first facet, one: that of lowest rank."""
    lowest, jump = rank, before
    for _ in range(_doublings(before)):
        lowest, jump = np.minimum(lowest, lowest[jump]), jump[jump]
    closed = before[jump] != jump
    return np.where(closed & (lowest == rank), np.arange(len(before)), before)


def _way_from_first(
    before: Int64Array, length: FloatArray
) -> tuple[Int64Array, Int64Array, FloatArray]:
    """The first facet of each one's curve, steps from there, and the distance of the midpoints."""
    is_first = before == np.arange(len(before))
    distance = np.where(is_first, 0.0, 0.5 * (length + length[before]))
    steps, jump = (~is_first).astype(np.int64), before
    for _ in range(_doublings(before)):
        distance, steps, jump = distance + distance[jump], steps + steps[jump], jump[jump]
    return jump, steps, distance


def _doublings(before: Int64Array) -> int:
    """Count how often a stride has to be doubled to pass through all facets."""
    return max(len(before), 1).bit_length()


def _transitions(
    before: Int64Array, ends: FloatArray, gaps: FloatArray, rows: dict[str, npt.NDArray]
) -> tuple[FloatArray, Int64Array]:
    """Find where just one of two neighbours is active, and the facet behind each such place.

    The transition lies inside the free facet if its trace changes sign there, else at the vertex
    between the two.
    """
    active, midpoints = rows["active"], ends.mean(axis=1)
    later = np.flatnonzero((active != active[before]) & (before != np.arange(len(before))))
    earlier = before[later]
    free_is_later = active[earlier]
    free = np.where(free_is_later, later, earlier)
    vertex_gap = gaps[free, np.where(free_is_later, 0, 1)]
    u = rows["u"][free]
    middle_gap = np.minimum(u - rows["obstacle"][free], rows["upper"][free] - u)
    inside = (vertex_gap < 0) & (middle_gap > 0)
    share = np.where(inside, middle_gap / np.where(inside, middle_gap - vertex_gap, 1.0), 1.0)
    return midpoints[free] + share[:, None] * (ends[later, 0] - midpoints[free]), earlier
