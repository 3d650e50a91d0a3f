"""Simplices that cells and facets are cut into, and the ways to cut them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from ..arrays import BoolArray, FloatArray, IndexArray
from ..compat import cell_nodes
from ..fem.cells import BoundaryFacets, Cells, corner_points, points_of
from .jets import Boxes

Levels = Callable[["Pieces"], FloatArray]
"""Function that changes sign where data may jump, at triangles' vertices and edges' middles.

The shape is (differences, 6, n).
"""
SLABS = 4
"""Slabs that a triangle is cut into across an axis."""
QUARTERS, UNKNOWN, JUMP = -1, -2, -3
"""Ways to cut pieces, besides across an axis; the last is along a line where data may jump."""
SLANTED = 4.0
"""Box of a triangle over twice its area, from which on its own coordinates are tried, too."""
EDGES = np.array([[0.0, 0.5, 0.5], [0.5, 0.0, 0.5], [0.5, 0.5, 0.0]])
"""The middles of a triangle's edges, each opposite to a vertex."""
AFFINE = 1e-13
"""Rounding in values of an affine function, in parts of the largest."""


@dataclass(frozen=True, eq=False)
class Frame:
    """Cells, directions and normals of facets.

    Attributes:
        cells: Their cells, shape (facets,).
        along: Orthonormal vectors in the facet, shape (d − 1, gdim, facets).
        normal: Outward normals, shape (gdim, facets).
    """

    cells: IndexArray
    along: FloatArray
    normal: FloatArray

    @classmethod
    def of(cls, cells: Cells, side: BoundaryFacets) -> Frame:
        """Make those of the facets of one part of the boundary."""
        apex, ends = corner_points(cells, side)
        # Gram and Schmidt; what is left of the way to the opposite vertex points inwards
        rows: list[FloatArray] = []
        for vector in (*(ends[1:] - ends[:1]), apex - ends[0]):
            for row in rows:
                vector = vector - np.einsum("nk,nk->n", row, vector)[:, None] * row
            rows.append(vector / np.linalg.norm(vector, axis=1)[:, None])
        return cls(side.cells, np.stack(rows[:-1]).transpose(0, 2, 1), -rows[-1].T)


@dataclass(frozen=True, eq=False)
class Pieces:
    """Simplices that cells, or facets, are cut into.

    Attributes:
        parent: The cell, or the facet, shape (n,).
        corners: Coordinates of the vertices, shape (d + 1, gdim, n).
        hats: The cell's barycentric coordinates there, shape (d + 1, d + 1, n), vertices first.
        share: The piece's share of the cell's volume, shape (n,).
        frame: Of facets.
        span: Where pieces begin and end on the way from their first corner (0) to the opposite
            side (1), shape (2, n): slabs of triangles lie between two parallels of that side.
    """

    parent: IndexArray
    corners: FloatArray
    hats: FloatArray
    share: FloatArray
    frame: Frame | None = None
    span: FloatArray = field(default_factory=lambda: np.zeros((2, 0)))

    def __post_init__(self) -> None:
        """Make them simplices where there is no span."""
        if self.span.shape[1] != len(self.share):
            span = np.stack([np.zeros(len(self.share)), np.ones(len(self.share))])
            object.__setattr__(self, "span", span)

    @classmethod
    def of_facets(cls, cells: Cells, side: BoundaryFacets) -> Pieces:
        """Take boundary facets themselves."""
        _, ends = corner_points(cells, side)
        n, corners = len(side.cells), ends.transpose(0, 2, 1)
        hats = _unit(len(corners), n)
        return cls(np.arange(n), corners, hats, np.ones(n), Frame.of(cells, side))

    @classmethod
    def of_cells(cls, cells: Cells, which: IndexArray | None = None) -> Pieces:
        """Take the cells themselves."""
        mesh = cells.domain.mesh
        which = np.arange(cells.number) if which is None else which
        nodes = cell_nodes(mesh)[which]
        # NumPy is quick where rows are long
        points = mesh.geometry.x.take(nodes.T, axis=0)[..., : mesh.geometry.dim]
        corners = np.ascontiguousarray(points.transpose(0, 2, 1))
        hats = _unit(len(corners), len(which))
        return cls(which, corners, hats, np.ones(len(which)))

    def __getitem__(self, which: BoolArray | IndexArray | slice) -> Pieces:
        """Take some of them."""
        return Pieces(
            self.parent[which],
            self.corners[..., which],
            self.hats[..., which],
            self.share[which],
            self.frame,
            self.span[:, which],
        )

    def __add__(self, others: Pieces) -> Pieces:
        """Join these and others."""
        return Pieces(
            np.concatenate([self.parent, others.parent]),
            np.concatenate([self.corners, others.corners], axis=-1),
            np.concatenate([self.hats, others.hats], axis=-1),
            np.concatenate([self.share, others.share]),
            self.frame,
            np.concatenate([self.span, others.span], axis=1),
        )

    def halves(self) -> Pieces:
        """Halve each, through the longest edge's middle."""
        d = len(self.corners) - 1
        pairs = np.array([(i, j) for i in range(d + 1) for j in range(i)])
        lengths = np.sum((self.corners[pairs[:, 0]] - self.corners[pairs[:, 1]]) ** 2, axis=1)
        longest = pairs[lengths.argmax(axis=0)].T
        at = np.arange(len(self.parent))
        halves = []
        for end, other in (longest, longest[::-1]):
            corners, hats = self.corners.copy(), self.hats.copy()
            for array in (corners, hats):
                array[end, :, at] = 0.5 * (array[end, :, at] + array[other, :, at])
            halves.append(Pieces(self.parent, corners, hats, 0.5 * self.share, self.frame))
        return halves[0] + halves[1]

    def finer(self, rounds: int) -> Pieces:
        """Halve them again and again, so many times."""
        return self.halves().finer(rounds - 1) if rounds else self

    def around(self, point: FloatArray, hats: FloatArray) -> Pieces:
        """Cut each at a point inside of it with some barycentric coordinates, shape (d + 1, n)."""
        own = np.einsum("cn,chn->hn", hats, self.hats)
        found = []
        for i, part in enumerate(hats):
            corners, coordinates = self.corners.copy(), self.hats.copy()
            corners[i], coordinates[i] = point[:, None], own
            new = Pieces(self.parent, corners, coordinates, part * self.share, self.frame)
            found.append(new[np.flatnonzero(part > 1e-15)])
        return sum(found[1:], found[0])

    def quarters(self) -> tuple[Pieces, IndexArray]:
        """Cut each into four; also tell from which."""
        return self.halves().halves(), np.tile(np.arange(len(self.share)), 4)

    def slabs(self, axis: int) -> tuple[Pieces, IndexArray]:
        """Cut triangles across an axis, at the middle vertex and in between; tell from which."""
        at, x = np.arange(len(self.share)), self.corners[:, axis]
        low, middle, high = np.argsort(x, axis=0)
        length = x[high, at] - x[low, at]
        s = np.divide(
            x[middle, at] - x[low, at], length, out=np.zeros_like(length), where=length > 0
        )
        pieces, origin = [], []
        for apex, part in ((low, s), (high, 1.0 - s)):
            there = np.flatnonzero(part > 1e-12)
            corners, hats = (
                np.stack([x[apex, :, at].T, x[middle, :, at].T, _between(x, low, high, s)])
                for x in (self.corners, self.hats)
            )
            corners, hats = corners[..., there], hats[..., there]
            whole = self.share[there] * part[there]
            for k in range(SLABS):
                span = np.repeat([[k / SLABS], [(k + 1) / SLABS]], len(there), axis=1)
                share = whole * (2 * k + 1) / SLABS**2
                pieces.append(Pieces(self.parent[there], corners, hats, share, self.frame, span))
                origin.append(there)
        return sum(pieces[1:], pieces[0]), np.concatenate(origin)

    def along(self, levels: Levels) -> tuple[Pieces, IndexArray]:
        """Cut triangles along lines on which something changes its sign, nearly; tell from which.

        That is one line where it is affine. Others are the nearer to one the smaller the triangle:
        it is cut into quarters first. So it is where there is no line.
        """
        curved, level = _crossed(levels(self))
        pieces, origin = self[~curved], np.flatnonzero(~curved)
        level = level[:, ~curved]
        if curved.any():
            quarters, of = self[curved].quarters()
            _, of_quarters = _crossed(levels(quarters))
            pieces, level = pieces + quarters, np.hstack([level, of_quarters])
            origin = np.concatenate([origin, np.flatnonzero(curved)[of]])
        cut, of = pieces.capped(level)
        return cut, origin[of]

    def capped(self, level: FloatArray) -> tuple[Pieces, IndexArray]:
        """Cut triangles along the line on which an affine function is 0; tell from which.

        Args:
            level: Its values at the vertices, shape (3, n).
        """
        at = np.arange(len(self.share))
        order = np.argsort(level, axis=0)
        low, middle, high = level[order, at]
        crossed = np.flatnonzero((low < 0.0) & (high > 0.0))
        # the vertex that is alone on its side, and the two others
        alone = np.where(middle >= 0.0, order, order[::-1])[:, crossed]
        a, b, c = level[alone, crossed]
        s, t = np.clip(a / (a - b), 0.0, 1.0), np.clip(a / (a - c), 0.0, 1.0)
        rest = np.setdiff1d(at, crossed)
        pieces, origin = [self[rest]], [rest]
        ends = [
            np.stack([x[vertex, :, crossed].T for vertex in alone])
            for x in (self.corners, self.hats)
        ]
        ends = [np.stack([*x, x[0] + s * (x[1] - x[0]), x[0] + t * (x[2] - x[0])]) for x in ends]
        for vertices, share in (
            ((0, 3, 4), s * t),
            ((3, 1, 2), 1.0 - s),
            ((3, 2, 4), s * (1.0 - t)),
        ):
            there = np.flatnonzero(share > 1e-15)
            corners, hats = (x[list(vertices)][..., there] for x in ends)
            of = crossed[there]
            part = self.share[of] * share[there]
            pieces.append(Pieces(self.parent[of], corners, hats, part, self.frame))
            origin.append(of)
        return pieces[0] + pieces[1] + pieces[2] + pieces[3], np.concatenate(origin)

    def thinner(self) -> tuple[Pieces, IndexArray]:
        """Halve each slab; tell from which."""
        start, end = self.span
        middle, halves = 0.5 * (start + end), []
        for a, b in ((start, middle), (middle, end)):
            part = self.share * ((a + b) * (b - a) / ((start + end) * (end - start)))
            halves.append(replace(self, share=part, span=np.stack([a, b])))
        return halves[0] + halves[1], np.tile(np.arange(len(self.share)), 2)

    def triangles(self) -> tuple[Pieces, IndexArray]:
        """Cut slabs into triangles; return all, and from which."""
        thin = ~self.whole
        if not thin.any():
            return self, np.arange(len(self.share))
        slab, which = self[thin], np.flatnonzero(thin)
        (start, end), made, origin = slab.span, [self[~thin]], [np.flatnonzero(~thin)]
        corners, hats = slab._ends(slab.corners), slab._ends(slab.hats)
        for rows, part in (((0, 2, 3), end), ((0, 3, 1), start)):
            there = np.flatnonzero(part > 0)
            part = (slab.share * part / (start + end))[there]
            new = corners[list(rows)][..., there], hats[list(rows)][..., there]
            made.append(Pieces(slab.parent[there], *new, part, self.frame))
            origin.append(which[there])
        return made[0] + made[1] + made[2], np.concatenate(origin)

    @property
    def whole(self) -> BoolArray:
        """True for each that is a simplex and no slab, shape (n,)."""
        return np.asarray((self.span[0] == 0.0) & (self.span[1] == 1.0))

    def _ends(self, array: FloatArray) -> FloatArray:
        """Return a slab's four vertices, two at its start and two at its end; a simplex' own."""
        if self.corners.shape[:2] != (3, 2):
            return array
        apex, sides = array[0], array[1:] - array[0]
        return np.concatenate([apex + self.span[0] * sides, apex + self.span[1] * sides])

    def shrunk(self, axes: tuple[int, ...]) -> Pieces:
        """Make pieces half as wide along some axes."""
        ends = self._ends(self.corners)
        middle = 0.5 * (ends.min(axis=0) + ends.max(axis=0))
        scale = np.ones((len(middle), 1))
        scale[list(axes)] = 0.5
        return replace(self, corners=middle + scale * (self.corners - middle))

    def cut(
        self, ways: IndexArray, levels: Levels | None = None
    ) -> tuple[Pieces, IndexArray, IndexArray]:
        """Cut each in its way: into four, or across an axis; also from which, and the way.

        Args:
            ways: `QUARTERS`, `JUMP`, or the number of the axis.
            levels: For `JUMP`.
        """
        made, origin = [], []
        of_slab = ~self.whole
        along = np.zeros(len(ways), dtype=bool)
        if of_slab.any():
            base = np.abs(self.corners[2] - self.corners[1])
            along = of_slab & (base.argmin(axis=0) == ways)
        for way in (JUMP, QUARTERS, *range(0 if self.corners.shape[:2] != (3, 2) else 2)):
            which = np.flatnonzero((ways == way) & ~along)
            if len(which):
                triangles, of = self[which].triangles()
                if way == JUMP and levels is not None:
                    new, which_of = triangles.along(levels)
                elif way >= 0:
                    new, which_of = triangles.slabs(way)
                else:
                    new, which_of = triangles.quarters()
                made.append(new)
                origin.append(which[of[which_of]])
        which = np.flatnonzero(along)
        if len(which) or not made:
            new, of = self[which].thinner()
            made.append(new)
            origin.append(which[of])
        whole = made[0]
        for more in made[1:]:
            whole = whole + more
        every = np.concatenate(origin)
        return whole, every, ways[every]

    def boxes(self, cells: Cells, decide: bool = False) -> Boxes:
        """Make the boxes around them; for `decide` see `Boxes.corners`, it is for simplices."""
        boxes = self.hulls(cells, decide)
        if self.corners.shape[:2] != (3, 2):
            return boxes
        slanted, edges = self._slanted(boxes.low, boxes.high)
        return replace(boxes, slanted=slanted, edges=edges)

    def hulls(self, cells: Cells, decide: bool = False) -> Boxes:
        """Make the same, and do not look which are slanted."""
        if decide or self.whole.all():
            low, high = self.corners.min(axis=0), self.corners.max(axis=0)
        else:
            ends = self._ends(self.corners)
            low, high = ends.min(axis=0), ends.max(axis=0)
            room = 1e-15 * np.maximum(np.abs(low), np.abs(high))
            low, high = low - room, high + room
        return self._boxes(low, high, self.parent, cells, self.corners if decide else None)

    def points(self, cells: Cells, hats: FloatArray) -> Boxes:
        """Find the points with some barycentric coordinates, shape (d + 1, q), piece by piece."""
        points = points_of(self.corners, hats)
        flat = points.reshape(len(points), -1)
        return self._boxes(flat, flat, np.tile(self.parent, hats.shape[1]), cells, None)

    def _boxes(
        self,
        low: FloatArray,
        high: FloatArray,
        parent: IndexArray,
        cells: Cells,
        corners: FloatArray | None,
    ) -> Boxes:
        domain, frame = cells.domain, self.frame
        if frame is None:
            return Boxes(low, high, corners=corners, cells=parent, domain=domain)
        along, normal = frame.along[..., parent], frame.normal[:, parent]
        return Boxes(low, high, along, corners, frame.cells[parent], normal, domain)

    def _slanted(self, low: FloatArray, high: FloatArray) -> tuple[IndexArray, FloatArray]:
        """Find triangles whose boxes are much larger than they are, and two edges; see `Boxes`."""
        (a, b), (c, d) = self.corners[1:] - self.corners[0]
        large = (high - low).prod(axis=0) > SLANTED * np.abs(a * d - b * c)
        which = np.flatnonzero(large & self.whole)
        corners, at = self.corners[..., which], np.arange(len(which))
        edges = np.roll(corners, -1, axis=0) - corners
        apex = ((edges**2).sum(axis=1).argmax(axis=0) + 2) % 3  # opposite the longest
        first = corners[apex, :, at]
        ends = [corners[(apex + i) % 3, :, at] - first for i in (1, 2)]
        return which, np.stack(ends).transpose(0, 2, 1)

    def half(self, boxes: Boxes) -> FloatArray:
        """Compute half extents in the boxes' variables."""
        if boxes.along is None:
            return 0.5 * (boxes.high - boxes.low)
        offset = self.corners - self.corners.mean(axis=0)
        return np.abs(np.einsum("vgn,cgn->cvn", boxes.along, offset)).max(axis=0)


def _crossed(levels: FloatArray) -> tuple[BoolArray, FloatArray]:
    """Tell whether a function that changes its sign is not affine, and its values at vertices.

    Of several functions on a triangle the first that does.

    Args:
        levels: See `Levels`.
    """
    levels = np.nan_to_num(levels, nan=0.0, posinf=1e300, neginf=-1e300)
    change = (levels.min(axis=1) < 0.0) & (levels.max(axis=1) > 0.0)
    own = levels[change.argmax(axis=0), :, np.arange(levels.shape[2])].T
    vertices, middles = own[:3], own[3:]
    off = np.abs(middles - 0.5 * (vertices.sum(axis=0) - vertices)).max(axis=0)
    return off > AFFINE * np.abs(vertices).max(axis=0), vertices


def _unit(d: int, n: int) -> FloatArray:
    """Return the unit matrix n times, shape (d, d, n); not to be changed."""
    return np.broadcast_to(np.eye(d)[:, :, None], (d, d, n))


def _between(x: FloatArray, start: IndexArray, end: IndexArray, where: FloatArray) -> FloatArray:
    """Find points on sides of simplices that start and end at some vertices, shape (·, n)."""
    at = np.arange(len(where))
    first = x[start, :, at].T
    return np.asarray(first + where * (x[end, :, at].T - first))
