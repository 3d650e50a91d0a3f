"""A walk along Γ1: the contact facets in the order in which the boundary passes through them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from dolfinx.mesh import Mesh
from mpi4py import MPI

from ..arrays import BoolArray, FloatArray, Int32Array, Int64Array
from ..compat import cell_nodes, facet_nodes
from ..mesh.domain import facet_entities
from ..mesh.plane import cross


@dataclass(frozen=True, eq=False)
class Walk:
    """The order of the contact facets of all ranks, known to rank 0 alone.

    A surface has no such order: for d = 3 the facets are sorted by their midpoints, arc_length
    is NaN, and there are no transition points.

    Attributes:
        comm: The ranks.
        place: Columns that depend on nothing but the mesh, in that order: part, arc_length, x, y
            and length; none on other ranks.
        order: The order, shape (n,).
        way: What transition points are found with, for d = 2.
    """

    comm: MPI.Comm
    place: dict[str, npt.NDArray]
    order: Int64Array
    way: _Way | None

    @classmethod
    def of(cls, mesh: Mesh, facets: Int32Array, vertices: FloatArray, measure: FloatArray) -> Walk:
        """Find it; collective.

        Args:
            mesh: The mesh.
            facets: The contact facets that this rank owns, shape (n,).
            vertices: Their vertices' coordinates, shape (n, d, 3).
            measure: Their measures, shape (n,).
        """
        columns: dict[str, npt.NDArray] = {"vertices": vertices, "measure": measure}
        if mesh.topology.dim == 2:
            entities = facet_entities(mesh, facets)
            columns["reverse"] = _clockwise(mesh, entities, vertices)
            columns["nodes"] = _nodes(mesh, entities)
        rows = _gathered(mesh.comm, columns)
        if not rows:
            return cls(mesh.comm, {}, np.empty(0, dtype=np.int64), None)
        midpoints, length = rows["vertices"].mean(axis=1), rows["measure"]
        # The same order whatever the ranks held: by coordinates first
        order, way = np.lexsort(midpoints.T[::-1]), None
        piece: Int64Array = np.zeros(len(order), dtype=np.int64)
        arc_length: FloatArray = np.full(len(order), np.nan)
        if mesh.topology.dim == 2:
            way, piece, arc_length = _Way.of(rows)
            order = np.lexsort([way.steps, piece])
        place = {"part": piece, "arc_length": arc_length, "x": midpoints[:, 0]}
        place |= {"y": midpoints[:, 1], "length": length}
        return cls(mesh.comm, {name: each[order] for name, each in place.items()}, order, way)

    def along(
        self, fields: dict[str, npt.NDArray]
    ) -> tuple[dict[str, npt.NDArray] | None, FloatArray]:
        """Sort what is found on the facets, and find the transition points; collective.

        Args:
            fields: What `ContactFacts` has of them: names, obstacle, upper, u, pressure, active and
                gap_at_vertices.

        Returns:
            The table on rank 0 (None elsewhere), and the transition points on all ranks.
        """
        rows = _gathered(self.comm, fields)
        transitions: FloatArray = np.zeros((0, 3))
        if rows and self.way is not None:
            transitions = self.way.transitions(rows)
        if self.comm.size > 1:
            transitions = self.comm.bcast(transitions, root=0)
        if not rows:
            return None, transitions
        place = {name: column.copy() for name, column in self.place.items()}
        return place | _columns(rows, self.order), transitions


def _gathered(comm: MPI.Comm, columns: dict[str, npt.NDArray]) -> dict[str, npt.NDArray]:
    """Gather all ranks' columns on rank 0, one below the other; none elsewhere; collective."""
    if comm.size == 1:
        return columns
    gathered = comm.gather(columns, root=0)
    if gathered is None:
        return {}
    return {name: np.concatenate([own[name] for own in gathered]) for name in columns}


def _clockwise(mesh: Mesh, entities: Int32Array, vertices: FloatArray) -> npt.NDArray:
    """Tell whether Ω lies to the right on the way from a facet's first vertex to its second."""
    cells, local = entities.T
    apex = mesh.geometry.x[cell_nodes(mesh)[cells, local]]
    return cross(vertices[:, 1] - vertices[:, 0], apex - vertices[:, 0]) < 0


def _nodes(mesh: Mesh, entities: Int32Array) -> Int64Array:
    """Find the numbers of facets' vertices that all ranks have for them, shape (n, 2)."""
    nodes = facet_nodes(mesh, entities)
    numbers = mesh.geometry.index_map().local_to_global(nodes.ravel())
    return np.asarray(numbers, dtype=np.int64).reshape(nodes.shape)


def _columns(rows: dict[str, npt.NDArray], order: Int64Array) -> dict[str, npt.NDArray]:
    """Pick the columns of the table that depend on the solution or its bounds."""
    names = ["obstacle", "upper"] if np.isfinite(rows["upper"]).any() else ["obstacle"]
    bounds = {name: np.where(np.isfinite(rows[name]), rows[name], np.nan) for name in names}
    given = bounds | {name: rows[name] for name in ("u", "pressure", "active")}
    if (rows["names"] != rows["names"][:1]).any():
        given["name"] = rows["names"]
    return {name: column[order] for name, column in given.items()}


@dataclass(frozen=True, eq=False)
class _Way:
    """The boundary's way through the contact facets, Ω to the left.

    Attributes:
        ends: Vertices in that order, shape (n, 2, 3).
        flip: Whether they have changed places, shape (n,).
        before: For each facet the one that ends where it begins, itself where there is none.
        piece: The connected piece of Γ1, from 0.
        steps: How many facets there are from the first one of it.
    """

    ends: FloatArray
    flip: BoolArray
    before: Int64Array
    piece: Int64Array
    steps: Int64Array

    @classmethod
    def of(cls, rows: dict[str, npt.NDArray]) -> tuple[_Way, Int64Array, FloatArray]:
        """Find it, and the piece of each facet and how far its midpoint is from the beginning.

        Args:
            rows: Vertices, shape (n, 2, 3), their numbers, shape (n, 2), whether Ω lies to the
                right, and measures, shape (n,).
        """
        flip, length = rows["reverse"], rows["measure"]
        ends = _turned(rows["vertices"], flip)
        before = _predecessors(ends, _turned(rows["nodes"], flip))
        # faces of a slit, whose midpoints are the same, have Ω on either side
        along, midpoints = ends[:, 1] - ends[:, 0], ends.mean(axis=1)
        rank = np.empty(len(ends), dtype=np.int64)
        rank[np.lexsort([*along.T[::-1], *midpoints.T[::-1]])] = np.arange(len(ends))
        first, steps, distance = _way_from_first(_cut(before, rank), length)
        piece = np.unique(rank[first], return_inverse=True)[1]
        return cls(ends, flip, before, piece, steps), piece, distance + 0.5 * length[first]

    def transitions(self, rows: dict[str, npt.NDArray]) -> FloatArray:
        """Find the transition points, in order along the boundary, shape (m, 3)."""
        gaps = _turned(rows["gap_at_vertices"], self.flip)
        points, behind = _transitions(self.before, self.ends, gaps, rows)
        found: FloatArray = points[np.lexsort([self.steps[behind], self.piece[behind]])]
        return found


def _turned(pairs: npt.NDArray, flip: BoolArray) -> npt.NDArray:
    """Let what there is of a facet's two vertices change places on some facets."""
    return np.where(flip.reshape(-1, *[1] * (pairs.ndim - 1)), pairs[:, ::-1], pairs)


def _predecessors(ends: FloatArray, nodes: Int64Array) -> Int64Array:
    """Find for each facet the one that ends where it begins, itself where there is none.

    Vertices are told by their numbers, as the faces of a slit have others at the same places. Where
    several facets end in one, it is the one with nothing but Ω in between.
    """
    order = np.argsort(nodes[:, 1], kind="stable")
    heads = nodes[order, 1]
    first = np.searchsorted(heads, nodes[:, 0], side="left")
    last = np.searchsorted(heads, nodes[:, 0], side="right")
    own = np.arange(len(ends))
    before = np.where(first < last, order[np.minimum(first, len(order) - 1)], own)
    several = np.flatnonzero(last - first > 1)
    along = ends[:, 1] - ends[:, 0]
    angle = np.arctan2(along[:, 1], along[:, 0])
    for facet in several:
        arriving = order[first[facet] : last[facet]]
        # from the facet to the one before it, Ω to the left
        between = np.mod(angle[arriving] + np.pi - angle[facet], 2.0 * np.pi)
        before[facet] = arriving[between.argmin()]
    return before


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
    """Find the first facet of each one's curve, steps from there, and the midpoints' distances."""
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
    """Find where just one of two neighbours is active, and the facet before each such place.

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
