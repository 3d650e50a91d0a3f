"""How far data are from polynomials, on every cell and facet: enclosed, not sampled.

On a simplex T, data are within R of some quadratic polynomial, and within W ≤ R of a cubic one.
Both follow from the jets on a box around T. Boxes that hold many cells come first; where R and W
matter the boxes get smaller, down to those of the single cells, and then the cells are cut into
pieces, on which data are integrated apart. So a jump costs no more than the pieces it crosses.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
import ufl
from mpi4py import MPI

from ..arrays import BoolArray, FloatArray, IndexArray, Int64Array
from ..compat import cell_nodes
from ..fem.cells import BoundaryFacets, Cells, blocks, corner_points
from .balls import indices
from .germs import allowance, first_inside, may_be_singular
from .jets import (
    Boxes,
    Enclosure,
    Jet,
    Range,
    Unknown,
    differences,
    has_conditions,
    is_local,
    lowered,
    values,
)

Errors = Callable[[Boxes, FloatArray], FloatArray]
"""What is to be known of data on boxes and simplices of given half extents; shape (rows, n)."""
Levels = Callable[["Pieces"], FloatArray]
"""What changes its sign where data may jump, at triangles' vertices and their edges' middles.

The shape is (differences, 6, n).
"""

GROUPS = 700
"""Boxes to begin with, about."""
PIECES = 6_000
"""Pieces that a mesh's cells are cut into at most, in all, or one for 64 cells."""
CHUNK = 1 << 12
"""Boxes that are worked on at a time."""
BEHIND = 0.25
"""Part of what may be missed that is left to cells for which a large box is good enough."""
ROUNDS = 20
"""How often pieces are cut at most."""
BISECTIONS = 6
"""Steps towards the smallest size that there is room for."""
CELLS = 60_000
"""Cells that may have boxes of their own, if that is more than twice the pieces."""
LEAST = 1e-11
"""Part of a cell, or of a facet, that is not cut any more: coordinates have so many digits."""
IN_VAIN = 3
"""How often in turn they are, with next to no gain."""
SLABS = 4
"""What triangles are cut into across an axis."""
QUARTERS, UNKNOWN, JUMP = -1, -2, -3
"""Ways to cut pieces, besides across an axis; the last is along a line where data may jump."""
ROOMY, STEEP = 10, 1.2
"""More room for pieces where errors fall faster than with this power of their number."""
MUCH = 1.5
"""For how large a sum of errors, 1 being the goal, there is more room."""
ACROSS = 1.15
"""How much better than by quarters errors must fall for a cut across an axis."""
SILENT = 0.1
"""How little errors fall, in powers of e, where half a box says nothing about how to cut."""
DEEP = 60.0
"""How far above the threshold pieces are cut twice at once."""
ENOUGH = 0.5
"""Sum of errors at which it ends."""
FALL = 4.0
"""By how much errors fall where pieces are cut, at least, as a rule."""
IDLE = 0.25
"""Exponent of the number of pieces by which a cut lowers the error that does little."""
SLANTED = 4.0
"""Box of a triangle over twice its area, from which on its own coordinates are tried, too."""
_FEW = 1e-9
_CUBIC = {1: 1.0, 2: 0.5, 3: 0.25}
"""Distance on [−1, 1]^m of xyz, x²y and x³ from quadratics, by the largest exponent."""


def range_of(expression: ufl.core.expr.Expr, cells: Cells) -> Range | None:
    """Lower and upper bounds on each owned cell, shapes (cells,) or ().

    Args:
        expression: A scalar.
        cells: The mesh.

    Returns:
        None if the expression holds an operator whose range is not known, or has no bound.
    """
    data, whole = lowered(expression), Pieces.of_cells(cells)
    try:
        jet = Enclosure(whole.boxes(cells), order=0)(data)
        low, high = (np.array(np.broadcast_to(x, cells.number)) for x in (jet.low, jet.high))
        if has_conditions(data):
            # a jump along a cell's side does not concern the cell
            wide = np.flatnonzero(high > low)
            jet = Enclosure(whole[wide].boxes(cells, decide=True))(data)
            low[wide], high[wide] = jet.low, jet.high
    except Unknown:
        return None
    return (low, high) if np.isfinite(low).all() and np.isfinite(high).all() else None


def remainders(
    jet: Jet, half: FloatArray, in_the_mean: bool = False
) -> tuple[FloatArray, FloatArray]:
    """R and W for simplices within half extents of a point, shapes (n,).

    Taylor's polynomial of the point, with the middles of the coefficients of the highest order
    for these, is off by no more than their radii allow; a cubic is replaced by a quadratic.

    Args:
        jet: On boxes that hold the simplices.
        half: Shape (variables, n).
        in_the_mean: Whether R may be the root of a mean square and W a mean, also by a rule that
            is exact for degree 4; else they hold at every point.
    """
    variables, n = half.shape
    by_order, by_order_of_mean = np.zeros((2, 4, n))
    by_order[0] = by_order_of_mean[0] = 0.5 * (jet.high - jet.low)
    cubic = np.zeros(n)
    of_square, of_mean = means(variables) if in_the_mean else (_ONES, _ONES)
    for row, mid, rad in zip(jet.rest.rows, jet.rest.mid, jet.rest.rad, strict=True):
        index = indices(variables)[row]
        order = sum(index)
        size = np.prod([h**k for h, k in zip(half, index, strict=True) if k], axis=0)
        by_order[order] += of_square[order] * rad * size
        by_order_of_mean[order] += of_mean[order] * rad * size
        if order == 3:
            cubic += _CUBIC[max(index)] * np.abs(mid) * size
    by_order[3] += cubic
    found = np.fmin.reduce(by_order), np.fmin.reduce(by_order_of_mean)
    return tuple(np.where(np.isnan(x), np.inf, x * (1 + 1e-12)) for x in found)  # type: ignore[return-value]


_ONES = 1.0, 1.0, 1.0, 1.0


def means(variables: int) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Bounds of (mean t^2i)^½ and of the mean of |t^i| for multi-indices i, by their order.

    t runs through a simplex in the cube [−1, 1]^d that touches all of its faces, or through a slab
    of a triangle; means may be a rule's. t₁² and t₁⁴ have the means given here or less, and the
    inequality of Cauchy and Schwarz gives the others; |t₁|³ t₁³ is at most t₁⁴.
    """
    second, fourth = (2 / 5, 9 / 35) if variables == 3 else (1 / 3, 1 / 5)
    return (
        (1.0, second**0.5, fourth**0.5, fourth**0.5),
        (1.0, second**0.5, second, (second * fourth) ** 0.5),
    )


def _crossed(levels: FloatArray) -> tuple[BoolArray, FloatArray]:
    """Whether a function that changes its sign is not affine, and its values at the vertices.

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


EDGES = np.array([[0.0, 0.5, 0.5], [0.5, 0.0, 0.5], [0.5, 0.5, 0.0]])
"""The middles of a triangle's edges, each opposite to a vertex."""
AFFINE = 1e-13
"""What counts as rounding in values of an affine function, in parts of the largest."""


class Deviation:
    """R and W of expressions; an expression's inverse may be among them."""

    def __init__(self, expression: ufl.core.expr.Expr):
        """Prepare the expression."""
        self.expression = lowered(expression)
        self.local = is_local(self.expression)
        self.singular = not self.local and may_be_singular(self.expression)
        self.decides = self.singular or has_conditions(self.expression)
        self.differences = differences(self.expression)

    def __call__(
        self,
        at: Enclosure,
        half: FloatArray,
        inverse: bool = False,
        hats: FloatArray | None = None,
    ) -> tuple[FloatArray, FloatArray]:
        """R and W, shapes (n,).

        Args:
            at: On the boxes that are asked about.
            half: Half extents of the simplices in them, shape (variables, n).
            inverse: Of the expression's inverse.
            hats: Points of a rule that is exact for degree 4, where R and W need only hold in the
                mean over a simplex, so that data without a bound may be of use.

        Raises:
            Unknown: The expression holds an operator whose range is not known.
        """
        boxes = at.boxes
        quadratic, cubic = remainders(self._jet(at, inverse), half, in_the_mean=hats is not None)
        left_out = at.left_out
        if left_out.any():
            # What conditions left out along the boundary: there all values are possible
            which = np.flatnonzero(left_out)
            jet = self._jet(Enclosure(boxes.whole(which), order=0), inverse)
            part, width = left_out[which], jet.high - jet.low
            quadratic[which] += np.sqrt(part) * width
            cubic[which] = np.minimum(cubic[which] + 2 * part * width, quadratic[which])
        if hats is not None and boxes.corners is not None and self.singular:
            rough, missed = allowance(self.expression, boxes.corners, hats)
            quadratic, cubic = np.fmin(quadratic, rough), np.fmin(cubic, missed)
        if boxes.slanted is not None and len(boxes.slanted):
            own = boxes.own
            there = remainders(self._jet(Enclosure(own), inverse), np.full_like(own.low, 0.5))
            for row, values in zip((quadratic, cubic), there, strict=True):
                row[boxes.slanted] = np.fmin(row[boxes.slanted], values)
        return quadratic, cubic

    def apart(self, pieces: Pieces) -> Pieces:
        """Cut pieces so that no point at which the data may be singular is inside of one."""
        while self.singular and (found := first_inside(self.expression, pieces.corners)):
            point, which, hats = found
            rest = np.setdiff1d(np.arange(len(pieces.part)), which)
            pieces = pieces[rest] + pieces[which].around(point, hats)
        return pieces

    def levels(self, cells: Cells) -> Levels | None:
        """What changes its sign where the data may jump; None where nothing does."""
        if not self.differences:
            return None
        hats = np.hstack([np.eye(3), EDGES])

        def at(pieces: Pieces) -> FloatArray:
            points, shape = pieces.points(cells, hats), (hats.shape[1], len(pieces.part))
            return np.stack([values(each, points).reshape(shape) for each in self.differences])

        return at

    def _jet(self, enclosure: Enclosure, inverse: bool) -> Jet:
        return enclosure.inverse(self.expression) if inverse else enclosure(self.expression)

    def values(self, pieces: Pieces, cells: Cells, hats: FloatArray) -> FloatArray:
        """Values at points of pieces, shape (q, n).

        Args:
            pieces: The pieces.
            cells: The mesh.
            hats: Barycentric coordinates of the points in a piece, shape (d + 1, q).
        """
        found = np.empty((hats.shape[1], len(pieces.parent)))
        for part in chunks(len(pieces.parent)):
            here = found[:, part]
            here[:] = values(self.expression, pieces[part].points(cells, hats)).reshape(here.shape)
        return found


@dataclass(frozen=True, eq=False)
class Frame:
    """What belongs to facets.

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
        """Of the facets of one part of the boundary."""
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
        part: The piece's part of the cell's volume, shape (n,).
        frame: Of facets.
        span: Where pieces begin and end on the way from their first corner (0) to the opposite
            side (1), shape (2, n): slabs of triangles lie between two parallels of that side.
    """

    parent: IndexArray
    corners: FloatArray
    hats: FloatArray
    part: FloatArray
    frame: Frame | None = None
    span: FloatArray = field(default_factory=lambda: np.zeros((2, 0)))

    def __post_init__(self) -> None:
        """Without a span they are simplices."""
        if self.span.shape[1] != len(self.part):
            span = np.stack([np.zeros(len(self.part)), np.ones(len(self.part))])
            object.__setattr__(self, "span", span)

    @classmethod
    def of_facets(cls, cells: Cells, side: BoundaryFacets) -> Pieces:
        """Boundary facets themselves."""
        _, ends = corner_points(cells, side)
        n, corners = len(side.cells), ends.transpose(0, 2, 1)
        hats = np.repeat(np.eye(len(corners))[:, :, None], n, axis=2)
        return cls(np.arange(n), corners, hats, np.ones(n), Frame.of(cells, side))

    @classmethod
    def of_cells(cls, cells: Cells, which: IndexArray | None = None) -> Pieces:
        """The cells themselves."""
        mesh = cells.domain.mesh
        which = np.arange(cells.number) if which is None else which
        nodes = cell_nodes(mesh)[which]
        corners = mesh.geometry.x[nodes.T, : mesh.geometry.dim].transpose(0, 2, 1)
        hats = np.repeat(np.eye(len(corners))[:, :, None], len(which), axis=2)
        return cls(which, corners, hats, np.ones(len(which)))

    def __getitem__(self, which: BoolArray | IndexArray | slice) -> Pieces:
        """Some of them."""
        return Pieces(
            self.parent[which],
            self.corners[..., which],
            self.hats[..., which],
            self.part[which],
            self.frame,
            self.span[:, which],
        )

    def __add__(self, others: Pieces) -> Pieces:
        """These and others."""
        return Pieces(
            np.concatenate([self.parent, others.parent]),
            np.concatenate([self.corners, others.corners], axis=-1),
            np.concatenate([self.hats, others.hats], axis=-1),
            np.concatenate([self.part, others.part]),
            self.frame,
            np.concatenate([self.span, others.span], axis=1),
        )

    def halves(self) -> Pieces:
        """Both halves of each, cut through the longest edge's middle."""
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
            halves.append(Pieces(self.parent, corners, hats, 0.5 * self.part, self.frame))
        return halves[0] + halves[1]

    def around(self, point: FloatArray, hats: FloatArray) -> Pieces:
        """Cut each at a point inside of it with some barycentric coordinates, shape (d + 1, n)."""
        own = np.einsum("cn,chn->hn", hats, self.hats)
        found = []
        for i, part in enumerate(hats):
            corners, coordinates = self.corners.copy(), self.hats.copy()
            corners[i], coordinates[i] = point[:, None], own
            new = Pieces(self.parent, corners, coordinates, part * self.part, self.frame)
            found.append(new[np.flatnonzero(part > 1e-15)])
        return sum(found[1:], found[0])

    def quarters(self) -> tuple[Pieces, IndexArray]:
        """Four of each, and from which."""
        return self.halves().halves(), np.tile(np.arange(len(self.part)), 4)

    def slabs(self, axis: int) -> tuple[Pieces, IndexArray]:
        """Triangles cut across an axis, at the middle vertex and in between; from which."""
        at, x = np.arange(len(self.part)), self.corners[:, axis]
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
            whole = self.part[there] * part[there]
            for k in range(SLABS):
                span = np.repeat([[k / SLABS], [(k + 1) / SLABS]], len(there), axis=1)
                share = whole * (2 * k + 1) / SLABS**2
                pieces.append(Pieces(self.parent[there], corners, hats, share, self.frame, span))
                origin.append(there)
        return sum(pieces[1:], pieces[0]), np.concatenate(origin)

    def along(self, levels: Levels) -> tuple[Pieces, IndexArray]:
        """Triangles cut along lines on which something changes its sign, nearly; from which.

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
        """Triangles cut along the line on which an affine function is 0; from which.

        Args:
            level: Its values at the vertices, shape (3, n).
        """
        at = np.arange(len(self.part))
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
            part = self.part[of] * share[there]
            pieces.append(Pieces(self.parent[of], corners, hats, part, self.frame))
            origin.append(of)
        return pieces[0] + pieces[1] + pieces[2] + pieces[3], np.concatenate(origin)

    def thinner(self) -> tuple[Pieces, IndexArray]:
        """Both halves of each slab; from which."""
        start, end = self.span
        middle, halves = 0.5 * (start + end), []
        for a, b in ((start, middle), (middle, end)):
            part = self.part * ((a + b) * (b - a) / ((start + end) * (end - start)))
            halves.append(replace(self, part=part, span=np.stack([a, b])))
        return halves[0] + halves[1], np.tile(np.arange(len(self.part)), 2)

    def triangles(self) -> tuple[Pieces, IndexArray]:
        """Slabs as triangles; all, and from which."""
        thin = ~self.whole
        if not thin.any():
            return self, np.arange(len(self.part))
        slab, which = self[thin], np.flatnonzero(thin)
        (start, end), made, origin = slab.span, [self[~thin]], [np.flatnonzero(~thin)]
        corners, hats = slab._ends(slab.corners), slab._ends(slab.hats)
        for rows, part in (((0, 2, 3), end), ((0, 3, 1), start)):
            there = np.flatnonzero(part > 0)
            part = (slab.part * part / (start + end))[there]
            new = corners[list(rows)][..., there], hats[list(rows)][..., there]
            made.append(Pieces(slab.parent[there], *new, part, self.frame))
            origin.append(which[there])
        return made[0] + made[1] + made[2], np.concatenate(origin)

    @property
    def whole(self) -> BoolArray:
        """Which are simplices and no slabs, shape (n,)."""
        return np.asarray((self.span[0] == 0.0) & (self.span[1] == 1.0))

    def _ends(self, array: FloatArray) -> FloatArray:
        """A slab's four vertices, two at its start and two at its end; a simplex' own."""
        if self.corners.shape[:2] != (3, 2):
            return array
        apex, sides = array[0], array[1:] - array[0]
        return np.concatenate([apex + self.span[0] * sides, apex + self.span[1] * sides])

    def shrunk(self, axes: tuple[int, ...]) -> Pieces:
        """Pieces half as wide along some axes."""
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
        """The boxes around them; for `decide` see `Boxes.corners`, it is for simplices."""
        if decide or self.whole.all():
            low, high = self.corners.min(axis=0), self.corners.max(axis=0)
        else:
            ends = self._ends(self.corners)
            low, high = ends.min(axis=0), ends.max(axis=0)
            room = 1e-15 * np.maximum(np.abs(low), np.abs(high))
            low, high = low - room, high + room
        boxes = self._boxes(low, high, self.parent, cells, self.corners if decide else None)
        if self.corners.shape[:2] != (3, 2):
            return boxes
        slanted, edges = self._slanted(low, high)
        return replace(boxes, slanted=slanted, edges=edges)

    def points(self, cells: Cells, hats: FloatArray) -> Boxes:
        """Points with some barycentric coordinates, shape (d + 1, q), piece by piece for each."""
        points = np.einsum("cgn,cq->gqn", self.corners, hats)
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
        """Triangles whose boxes are much larger than they are, and two edges; see `Boxes`."""
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
        """Half extents in the boxes' variables."""
        if boxes.along is None:
            return 0.5 * (boxes.high - boxes.low)
        offset = self.corners - self.corners.mean(axis=0)
        return np.abs(np.einsum("vgn,cgn->cvn", boxes.along, offset)).max(axis=0)


@dataclass(frozen=True, eq=False)
class Cut:
    """What is known of data on cells, some of which are cut into pieces.

    Attributes:
        errors: On each cell, of one that is cut the mean by volume, shape (rows, cells).
        pieces: The pieces of the cells that are cut, in the order of the cells.
        errors_inside: Errors on these, shape (rows, pieces).
    """

    errors: FloatArray
    pieces: Pieces
    errors_inside: FloatArray

    @property
    def of(self) -> tuple[IndexArray, IndexArray]:
        """The cells that are cut, and where in the list each piece's cell is."""
        which, place = np.unique(self.pieces.parent, return_inverse=True)
        return which, place


def cut(
    cells: Cells,
    errors: Errors,
    weights: FloatArray,
    local: bool,
    decide: bool = True,
    apart: Callable[[Pieces], Pieces] | None = None,
    levels: Levels | None = None,
    at_most: int = PIECES,
) -> Cut:
    """Find errors, and where they are too large cut cells into pieces; collective.

    Args:
        cells: The mesh.
        errors: To be found on boxes.
        weights: What to multiply them with, shape (rows, cells): the sum is to be below 1.
        local: Whether the data differ from cell to cell.
        decide: Whether the corners of pieces matter, for conditions or singular points.
        apart: See `refine`.
        levels: See `refine`.
        at_most: Pieces in all; more where there are many cells.
    """
    comm, n = cells.comm, cells.number
    total, room = comm.allreduce(n), max(at_most, comm.allreduce(n) // 64)
    found = np.full((len(weights), n), np.inf)
    pending = np.arange(n)
    if not local:
        low, high = _extents(cells)
        top = int(np.log2(max(total / GROUPS, 1.0)) / 2)
        slanted = (high - low).prod(axis=0) > 2.0 * SLANTED * cells.volume
        if cells.tdim == 2 and 2 * comm.allreduce(np.count_nonzero(slanted)) > total:
            top = 0  # boxes that hold many such cells tell nothing of any
        for level in range(top, 0, -2):
            every = len(pending) == n
            ends = (low, high) if every else (low[:, pending], high[:, pending])
            boxes, half, place = _groups(*ends, level)
            there = np.stack([row[place] for row in errors(boxes, half)])
            if every:
                found, factors = there, weights
            else:
                found[:, pending], factors = there, weights.take(pending, axis=1)
            share = _shares(factors, there)
            least = _negligible(share, BEHIND, comm)
            most = max(2 * room, CELLS) << 2 * max(level - 2, 0)
            chosen = _worst(share, least, most, comm)
            pending = pending[chosen]
            if comm.allreduce(len(pending)) <= GROUPS:
                break
    room += comm.allreduce(len(pending))
    inside: FloatArray
    pieces, inside = refine(
        Pieces.of_cells(cells, pending),
        lambda pieces: errors_on(pieces, errors, cells, decide),
        weights,
        room,
        cells,
        apart,
        levels,
    )
    for row, amounts in zip(found, inside, strict=True):
        row[pending] = 0.0
        np.add.at(row, pieces.parent, pieces.part * amounts)
    kept = np.flatnonzero(pieces.part < 1.0)
    kept = kept[np.argsort(pieces.parent[kept], kind="stable")]
    return Cut(found, pieces[kept], inside[:, kept])


def refine(
    pieces: Pieces,
    errors: Callable[[Pieces], FloatArray],
    weights: FloatArray,
    room: int,
    cells: Cells,
    apart: Callable[[Pieces], Pieces] | None = None,
    levels: Levels | None = None,
) -> tuple[Pieces, FloatArray]:
    """Cut pieces smaller where the errors are large; collective.

    Args:
        pieces: To begin with.
        errors: What is to be known on pieces, shape (rows, n).
        weights: For each parent, shape (rows, parents): the weighted sum is to be below 1.
        room: Number of pieces on all ranks at which it ends.
        cells: The mesh.
        apart: How to cut pieces on which nothing is known at first.
        levels: What changes its sign where data may jump, for triangles.

    Returns:
        Pieces, and the errors on them.
    """
    inside, before = errors(pieces), np.inf
    lost = np.asarray(~np.isfinite(inside).all(axis=0))
    if apart is not None and lost.any():
        finer = apart(pieces[lost])
        inside = np.concatenate([inside[:, ~lost], errors(finer)], axis=1)
        pieces = pieces[~lost] + finer
    first: tuple[float, float] = (0.0, np.inf)
    usual, idle = room, 0
    ways: IndexArray = np.full(len(pieces.part), UNKNOWN)
    for _ in range(ROUNDS):
        share = pieces.part * _shares(weights[:, pieces.parent], inside)
        bounded = share[np.isfinite(share)]
        number, have, missing = cells.total(len(share), bounded.sum(), len(share) - len(bounded))
        if not missing and 4 * number > room and MUCH < have < first[1]:
            first = first if np.isfinite(first[1]) else (number, have)
            if number > 0.7 * room and have / first[1] < (first[0] / number) ** STEEP:
                room, first = ROOMY * room, (0.0, 0.0)
        enough = MUCH if room > usual else ENOUGH
        idle = idle + 1 if not missing and have > 0.95 * before else 0
        if number >= room or have + missing <= enough or idle == IN_VAIN:
            break
        # above half the mean is at least half of it; what is not cut may be all that is left over
        threshold = max(0.5 * have, 0.25) / number
        if not missing and FALL * enough > have:
            spare = (FALL * enough - have) / (FALL - 1.0)
            threshold = max(threshold, _negligible(share, spare, cells.comm))
        space = int(room - number) // 3 + 1
        large = (pieces.part > LEAST) | ~np.isfinite(share)
        chosen = _worst(np.where(large, share, 0.0), threshold, space, cells.comm)
        found, looked = cells.total(chosen.sum(), np.sum(ways[chosen] == UNKNOWN))
        if found == 0:
            break
        before = np.inf if missing or looked else have
        finer, errors_there, ways_there = _split(
            pieces[chosen],
            ways[chosen],
            share[chosen],
            inside[:, chosen],
            share[chosen] > DEEP * (threshold if 8 * number > usual else ENOUGH / number),
            errors,
            weights,
            levels,
        )
        inside = np.concatenate([inside[:, ~chosen], errors_there], axis=1)
        ways = np.concatenate([ways[~chosen], ways_there])
        pieces = pieces[~chosen] + finer
    pieces, origin = pieces.triangles()
    return pieces, inside[:, origin]


def _split(
    pieces: Pieces,
    ways: IndexArray,
    share: FloatArray,
    errors_of: FloatArray,
    deep: BoolArray,
    errors: Callable[[Pieces], FloatArray],
    weights: FloatArray,
    levels: Levels | None,
) -> tuple[Pieces, FloatArray, IndexArray]:
    """Cut each piece in the way that has proved good; or find that way by smaller pieces; local.

    Args:
        pieces: What to cut.
        ways: See `Pieces.cut`; or `UNKNOWN`.
        share: Weighted errors of the pieces.
        errors_of: Errors of the pieces.
        deep: Whether to cut twice.
        errors: See `refine`.
        weights: See `refine`.
        levels: See `refine`.

    Returns:
        The new pieces, their errors, and the ways to cut them.
    """
    if pieces.corners.shape[:2] != (3, 2):
        ways = np.full(len(ways), QUARTERS)
    known = np.flatnonzero(ways != UNKNOWN)
    finer, origin, made = pieces[known].cut(ways[known], levels)
    again = np.flatnonzero(deep[known[origin]])
    if len(again):
        more, of, ways_of = finer[again].cut(made[again], levels)
        once = np.flatnonzero(~deep[known[origin]])
        finer, made = finer[once] + more, np.concatenate([made[once], ways_of])
        origin = np.concatenate([origin[once], origin[again][of]])
    new = np.flatnonzero(ways == UNKNOWN)
    if not len(new):
        inside, probed = errors(finer), None
    else:
        some = pieces[new]
        probes = [some.shrunk(axes) for axes in ((0, 1), (0,), (1,))]
        both = probes[0] + probes[1] + probes[2] + finer
        everywhere = errors(both)
        inside, probed = everywhere[:, 3 * len(new) :], everywhere[:, : 3 * len(new)]
    before, n = np.clip(share[known], 0, 1e300), len(known)
    amounts = finer.part * _shares(weights[:, finer.parent], inside)
    sums = np.clip(np.bincount(origin, amounts, minlength=n), 0, 1e300)
    # what did little may be followed by another way
    idle = sums > before / np.maximum(np.bincount(origin, minlength=n), 1) ** IDLE
    made = np.where(idle[origin], UNKNOWN, made)
    # slabs have no corners at which a condition could be decided: where that matters, quarters
    worse = (sums > 2.0 * before) & (ways[known] != QUARTERS)
    if worse.any():
        good, back = ~worse[origin], known[worse]
        finer, inside = finer[good] + pieces[back], np.hstack([inside[:, good], errors_of[:, back]])
        made = np.concatenate([made[good], np.full(len(back), QUARTERS)])
    if probed is None:
        return finer, inside, made
    of_probes = np.tile(some.parent, 3)
    left = _shares(weights[:, of_probes], probed).reshape(3, -1) * some.part
    rates = np.log(np.clip(left, 1e-300, 1e300)) - np.log(np.clip(share[new], 1e-300, 1e300))
    best = (rates / np.array([[2.0], [ACROSS], [ACROSS]])).argmin(axis=0) + QUARTERS
    # where nothing is known there is a singular point, of which slabs do not know
    best = np.where(np.isfinite(share[new]), best, QUARTERS)
    # a jump through the middle is none the smaller on smaller boxes there
    silent = (rates > -SILENT).all(axis=0)
    if levels is not None:
        triangles, of = some.triangles()
        at = levels(triangles)
        jumps = ((at.min(axis=1) < 0.0) & (at.max(axis=1) > 0.0)).any(axis=0)
        silent[of[jumps]] = True
    silent = np.flatnonzero(silent & np.isfinite(share[new]))
    if len(silent):
        best[silent] = _tried(some[silent], share[new][silent], errors, weights, levels)
    return finer + some, np.hstack([inside, errors_of[:, new]]), np.concatenate([made, best])


def _tried(
    pieces: Pieces,
    share: FloatArray,
    errors: Callable[[Pieces], FloatArray],
    weights: FloatArray,
    levels: Levels | None,
) -> IndexArray:
    """The way to cut that leaves a jump in few pieces, by trying them all; else quarters; local.

    Errors fall faster than the number of pieces grows where what is left, in parts of what there
    was, times the number of pieces that have it is below 1: about that is what quarters do.

    Args:
        pieces: Triangles or slabs.
        share: Their weighted errors.
        errors: See `refine`.
        weights: See `refine`.
        levels: See `refine`.
    """
    n = len(share)
    ways = [QUARTERS, 0, 1] if levels is None else [QUARTERS, JUMP, 0, 1]
    growth = np.ones((len(ways), n))
    for row, way in zip(growth[1:], ways[1:], strict=True):
        finer, origin, _ = pieces.cut(np.full(n, way), levels)
        left = finer.part * _shares(weights[:, finer.parent], errors(finer))
        sums, counts = (np.bincount(origin, each, minlength=n) for each in (left, left > 0.0))
        row[:] = np.clip(sums / share, 0.0, 1e300) * counts
    return np.array(ways)[growth.argmin(axis=0)]


def chunks(n: int) -> list[slice]:
    """Consecutive ranges whose jets fit into the processor's cache; one at least."""
    return [slice(a, min(a + CHUNK, n)) for a in range(0, max(n, 1), CHUNK)]


def errors_on(pieces: Pieces, errors: Errors, cells: Cells, decide: bool = True) -> FloatArray:
    """Work out what is to be known on boxes around pieces; for `decide` see `Boxes.corners`."""
    n = len(pieces.part)
    if n > CHUNK:
        parts_of = [errors_on(pieces[part], errors, cells, decide) for part in chunks(n)]
        return np.concatenate(parts_of, axis=1)
    whole = pieces.whole
    if whole.all() or not decide:
        boxes = pieces.boxes(cells, decide)
        return errors(boxes, pieces.half(boxes))
    parts = []
    for which in (np.flatnonzero(whole), np.flatnonzero(~whole)):
        some = pieces[which]
        boxes = some.boxes(cells, decide=bool(some.whole.all()))
        parts.append((which, errors(boxes, some.half(boxes))))
    found = np.empty((len(parts[0][1]), len(whole)))
    for which, there in parts:
        found[:, which] = there
    return found


def _between(x: FloatArray, start: IndexArray, end: IndexArray, where: FloatArray) -> FloatArray:
    """Points on sides of simplices that start and end at some vertices, shape (·, n)."""
    at = np.arange(len(where))
    first = x[start, :, at].T
    return np.asarray(first + where * (x[end, :, at].T - first))


def _shares(weights: FloatArray, errors: FloatArray) -> FloatArray:
    with np.errstate(invalid="ignore"):
        share = sum(np.fmax(w * e, 0.0) for w, e in zip(weights, errors, strict=True))
    return np.asarray(share)


def _worst(share: FloatArray, threshold: float, room: int, comm: MPI.Comm) -> BoolArray:
    """Those above a threshold, which is raised until there is room for them; collective."""
    top = comm.allreduce(float(share.max(initial=0.0, where=np.isfinite(share))), op=MPI.MAX)
    least = threshold

    def fits(threshold: float) -> bool:
        return comm.allreduce(int(np.count_nonzero(share > threshold))) <= room

    while threshold < top and not fits(threshold):
        least, threshold = threshold, 2.0 * threshold
    for _ in range(BISECTIONS if least < threshold else 0):  # many may be of about one size
        middle = 0.5 * (least + threshold)
        least, threshold = (least, middle) if fits(middle) else (middle, threshold)
    return share > threshold


def _negligible(share: FloatArray, enough: float, comm: MPI.Comm) -> float:
    """A threshold below which shares add up to no more than some number; collective."""
    if comm.allreduce(float(share.sum())) <= enough:
        return enough
    # It is the largest of these powers of two, times the share that all cells might have
    count = max(comm.allreduce(len(share)), 1)
    least, highest = enough / count, int(np.ceil(np.log2(count)))
    mantissa, exponent = np.frexp(share / least)
    power = np.clip(exponent - (mantissa == 0.5), 0, highest + 1)
    power[~np.isfinite(share)] = highest + 1
    sums = comm.allreduce(np.bincount(power, share, minlength=highest + 2))
    return float(least * 2.0 ** np.searchsorted(np.cumsum(sums)[1:-1], enough, side="right"))


def _extents(cells: Cells) -> Range:
    """Least and largest coordinates in each cell, shapes (gdim, cells)."""
    mesh = cells.domain.mesh
    nodes = cell_nodes(mesh)[: cells.number]
    low, high = np.empty((2, mesh.geometry.dim, cells.number))
    points = np.ascontiguousarray(mesh.geometry.x[:, : mesh.geometry.dim].T)
    for part in blocks(cells.number):
        first, *others = np.ascontiguousarray(nodes[part].T, dtype=np.intp)
        for x, least, most in zip(points, low[:, part], high[:, part], strict=True):
            least[:] = most[:] = x[first]
            for node in others:
                corner = x[node]
                np.minimum(least, corner, out=least)
                np.maximum(most, corner, out=most)
    return low, high


def _groups(low: FloatArray, high: FloatArray, level: int) -> tuple[Boxes, FloatArray, IndexArray]:
    """Boxes on grids that depend on nothing but the cells' own extents.

    Returns:
        The boxes, upper bounds of half the extents of their cells, and each cell's box.
    """
    exponent, place = np.empty(low.shape, np.int64), np.empty(low.shape, np.int64)
    for part in blocks(low.shape[1]):
        least, most = low[:, part], high[:, part]
        # a power of two may have been rounded up
        power = np.frexp((most - least) * (1 - _FEW))[1]
        exponent[:, part] = power
        place[:, part] = np.floor(0.5 * (least + most) / np.ldexp(1.0, power + level))
    numbers = _numbers([*exponent, *place])
    count = int(numbers.max(initial=-1)) + 1
    one = np.empty(count, dtype=np.intp)
    one[numbers] = np.arange(low.shape[1])
    half = np.ldexp(0.5, exponent[:, one]) * (1 + 2 * _FEW)
    size = np.ldexp(1.0, exponent[:, one] + level)
    start = place[:, one] * size
    return Boxes(start - half, start + size + half), half, numbers


def _numbers(rows: list[Int64Array]) -> IndexArray:
    """Number the different columns of some rows."""
    key: IndexArray = np.zeros(len(rows[0]), dtype=np.intp)
    if not len(key):
        return key
    span = 1
    for row in rows:
        first = int(row.min())
        width = int(row.max()) - first + 1
        if span * width >= 1 << 62:
            key = np.unique(key, return_inverse=True)[1].reshape(-1)
            span = len(key)
        for part in blocks(len(key)):
            here = key[part]
            here *= width
            here += row[part]
            here -= first
        span *= width
    if span > 8 * len(key) + 1000:
        return np.unique(key, return_inverse=True)[1].reshape(-1)
    seen = np.zeros(span, dtype=np.intp)
    seen[key] = 1
    return (np.cumsum(seen) - 1)[key]
