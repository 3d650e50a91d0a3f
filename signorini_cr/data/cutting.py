"""Cells cut into pieces where errors are large, until what is missed is small.

Boxes that hold many cells come first; where R and W matter the boxes get smaller, down to those of
the single cells, and then the cells are cut into pieces, on which data are integrated apart. So a
jump costs no more than the pieces it crosses.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from mpi4py import MPI

from ..arrays import BoolArray, FloatArray, IndexArray, Int64Array, summed
from ..fem.cells import Cells, blocks
from .jets import Boxes
from .pieces import JUMP, QUARTERS, SLANTED, UNKNOWN, Levels, Pieces
from .ranges import Errors, errors_on

GROUPS = 700
"""Boxes to begin with, about."""
PIECES = 6_000
"""Pieces that a mesh's cells are cut into at most, in all, or one for 64 cells."""
BEHIND = 0.25
"""Part of what may be missed that is left to cells for which a large box is good enough."""
CUTS = 40
"""Rounds of cuts at most."""
BISECTIONS = 6
"""Steps towards the smallest size that there is room for."""
CELLS = 60_000
"""Cells that may have boxes of their own, if that is more than twice the pieces."""
SMALLEST = 1e-11
"""Part of a cell, or of a facet, that is not cut any more: coordinates have so many digits."""
IN_VAIN, GAIN = 6, 0.95
"""Rounds after which it ends if they have not made errors smaller by this factor; every other one
may be a look at the ways to cut."""
ROOMY, STEEP = 10, 1.2
"""More room for pieces where errors fall faster than with this power of their number."""
MUCH = 1.5
"""Sum of errors, 1 being the goal, for which there is more room."""
ACROSS = 1.15
"""Factor by which errors must fall better than by quarters for a cut across an axis."""
DEEP = 60.0
"""Multiple of the threshold from which on pieces are cut twice at once."""
DONE = 0.5
"""Sum of errors at which it ends."""
FALL = 4.0
"""Factor by which errors fall where pieces are cut, at least, as a rule."""
IDLE = 0.25
"""Exponent of the number of pieces by which a cut lowers the error that does little."""
_FEW = 1e-9


@dataclass(frozen=True, eq=False)
class Cut:
    """Errors of data on cells, some of which are cut into pieces.

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
        low, high = np.empty((2, cells.domain.mesh.geometry.dim, n))
        for block in blocks(n):
            low[:, block], high[:, block] = cells.extents(block)
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
        np.add.at(row, pieces.parent, pieces.share * amounts)
    kept = np.flatnonzero(pieces.share < 1.0)
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
    wanted, limit = _Wanted(errors, weights, levels), _Room(room)
    front = _Front.of(pieces, np.full(len(pieces.share), UNKNOWN), wanted)
    lost = np.asarray(~np.isfinite(front.inside).all(axis=0))
    if apart is not None and lost.any():
        finer = apart(pieces[lost])
        front = front[~lost] + _Front.of(finer, np.full(len(finer.share), UNKNOWN), wanted)
    past = [np.inf] * IN_VAIN
    for _ in range(CUTS):
        share = front.share
        bounded = share[np.isfinite(share)]
        number, have, missing = cells.total(len(share), bounded.sum(), len(share) - len(bounded))
        if not missing:
            limit.widen(number, have)
        before, *past = *past, np.inf if missing else have
        in_vain = not missing and have > GAIN * before
        if number >= limit.pieces or have + missing <= limit.enough or in_vain:
            break
        # above half the mean is at least half of it; what is not cut may be all that is left over
        threshold = max(0.5 * have, 0.25) / number
        if not missing and FALL * limit.enough > have:
            spare = (FALL * limit.enough - have) / (FALL - 1.0)
            threshold = max(threshold, _negligible(share, spare, cells.comm))
        space = int(limit.pieces - number) // 3 + 1
        large = (front.pieces.share > SMALLEST) | ~np.isfinite(share)
        chosen = _worst(np.where(large, share, 0.0), threshold, space, cells.comm)
        if not cells.total(chosen.sum())[0]:
            break
        deep = share > DEEP * (threshold if 8 * number > limit.usual else DONE / number)
        front = front[~chosen] + _split(front[chosen], deep[chosen], wanted)
    pieces, origin = front.pieces.triangles()
    return pieces, front.inside[:, origin]


class _Room:
    """Number of pieces at which it ends: later where errors fall faster than the number grows."""

    def __init__(self, pieces: int):
        """Begin with what is usual."""
        self.pieces = self.usual = pieces
        self._first: tuple[float, float] = (0.0, np.inf)

    def widen(self, number: float, have: float) -> None:
        """Make room, perhaps, when there are so many pieces and such a sum of errors."""
        if not (4 * number > self.pieces and MUCH < have < self._first[1]):
            return
        if not np.isfinite(self._first[1]):
            self._first = number, have
        of_number, of_errors = self._first
        if number > 0.7 * self.pieces and have / of_errors < (of_number / number) ** STEEP:
            self.pieces, self._first = ROOMY * self.pieces, (0.0, 0.0)

    @property
    def enough(self) -> float:
        """The sum of errors at which it ends."""
        return MUCH if self.pieces > self.usual else DONE


@dataclass(frozen=True, eq=False)
class _Wanted:
    """Errors that are to become small, see `refine`."""

    errors: Callable[[Pieces], FloatArray]
    weights: FloatArray
    levels: Levels | None

    def shares(self, pieces: Pieces, inside: FloatArray) -> FloatArray:
        """Compute weighted errors of pieces, shape (n,)."""
        return pieces.share * _shares(self.weights[:, pieces.parent], inside)


@dataclass(frozen=True, eq=False)
class _Front:
    """Pieces with what is known of them.

    Attributes:
        pieces: The pieces.
        inside: Errors on them, shape (rows, n).
        share: Weighted errors of them, shape (n,).
        ways: How to cut them, see `Pieces.cut`; or `UNKNOWN`.
    """

    pieces: Pieces
    inside: FloatArray
    share: FloatArray
    ways: IndexArray

    @classmethod
    def of(cls, pieces: Pieces, ways: IndexArray, wanted: _Wanted) -> _Front:
        """Look at pieces."""
        inside = wanted.errors(pieces)
        return cls(pieces, inside, wanted.shares(pieces, inside), ways)

    def __getitem__(self, which: BoolArray) -> _Front:
        """Take some of them."""
        return _Front(
            self.pieces[which], self.inside[:, which], self.share[which], self.ways[which]
        )

    def __add__(self, other: _Front) -> _Front:
        """Join these and others."""
        return _Front(
            self.pieces + other.pieces,
            np.hstack([self.inside, other.inside]),
            np.concatenate([self.share, other.share]),
            np.concatenate([self.ways, other.ways]),
        )


def _split(front: _Front, deep: BoolArray, wanted: _Wanted) -> _Front:
    """Cut each piece in the way that has proved good; or find that way; local.

    Args:
        front: What to cut.
        deep: Whether to cut twice.
        wanted: What is to become small.
    """
    if front.pieces.corners.shape[:2] != (3, 2):
        front = replace(front, ways=np.full(len(front.ways), QUARTERS))
    known = front.ways != UNKNOWN
    return _cut(front[known], deep[known], wanted) + _directed(front[~known], wanted)


def _cut(front: _Front, deep: BoolArray, wanted: _Wanted) -> _Front:
    """Cut each piece in its way, or leave it as it is where that made things worse."""
    finer, origin, ways = front.pieces.cut(front.ways, wanted.levels)
    again = deep[origin]
    if again.any():
        more, of, ways_of = finer[again].cut(ways[again], wanted.levels)
        finer, ways = finer[~again] + more, np.concatenate([ways[~again], ways_of])
        origin = np.concatenate([origin[~again], origin[again][of]])
    made = _Front.of(finer, ways, wanted)
    n, before = len(front.share), np.clip(front.share, 0, 1e300)
    sums = np.clip(np.bincount(origin, made.share, minlength=n), 0, 1e300)
    # what did little may be followed by another way
    idle = sums > before / np.maximum(np.bincount(origin, minlength=n), 1) ** IDLE
    made = replace(made, ways=np.where(idle[origin], UNKNOWN, ways))
    # slabs have no corners at which a condition could be decided: where that matters, quarters
    worse = (sums > 2.0 * before) & (front.ways != QUARTERS)
    if not worse.any():
        return made
    back = replace(front[worse], ways=np.full(np.count_nonzero(worse), QUARTERS))
    return made[~worse[origin]] + back


def _directed(front: _Front, wanted: _Wanted) -> _Front:
    """Find the way to cut each piece by looking at smaller boxes in its middle."""
    pieces, n = front.pieces, len(front.share)
    if not n:
        return front
    probes = [pieces.shrunk(axes) for axes in ((0, 1), (0,), (1,))]
    inside = wanted.errors(probes[0] + probes[1] + probes[2])
    left = _shares(wanted.weights[:, np.tile(pieces.parent, 3)], inside).reshape(3, n)
    rates = np.log(np.clip(left * pieces.share, 1e-300, 1e300))
    rates -= np.log(np.clip(front.share, 1e-300, 1e300))
    known = np.isfinite(front.share)
    best = (rates / np.array([[2.0], [ACROSS], [ACROSS]])).argmin(axis=0) + QUARTERS
    # where nothing is known there is a singular point, of which slabs do not know
    best = np.where(known, best, QUARTERS)
    # a jump through the middle is none the smaller on smaller boxes there
    if wanted.levels is not None:
        triangles, of = pieces.triangles()
        level = wanted.levels(triangles)
        jumps = np.zeros(n, dtype=bool)
        jumps[of[((level.min(axis=1) < 0.0) & (level.max(axis=1) > 0.0)).any(axis=0)]] = True
        jumps &= known
        if jumps.any():
            best[jumps] = _tried(front[jumps], wanted, wanted.levels)
    return replace(front, ways=best)


def _tried(front: _Front, wanted: _Wanted, levels: Levels) -> IndexArray:
    """Find the way to cut that leaves a jump in few pieces, by trying all; else quarters; local.

    Errors fall faster than the number of pieces grows where what is left, in parts of what there
    was, times the number of pieces that have it is below 1: about that is what quarters do.
    """
    n = len(front.share)
    ways = [QUARTERS, JUMP, 0, 1]
    growth = np.ones((len(ways), n))
    for row, way in zip(growth[1:], ways[1:], strict=True):
        finer, origin, _ = front.pieces.cut(np.full(n, way), levels)
        left = wanted.shares(finer, wanted.errors(finer))
        sums, counts = (np.bincount(origin, each, minlength=n) for each in (left, left > 0.0))
        row[:] = np.clip(sums / front.share, 0.0, 1e300) * counts
    return np.array(ways)[growth.argmin(axis=0)]


def _shares(weights: FloatArray, errors: FloatArray) -> FloatArray:
    with np.errstate(invalid="ignore"):
        share = sum(np.fmax(w * e, 0.0) for w, e in zip(weights, errors, strict=True))
    return np.asarray(share)


def _worst(share: FloatArray, threshold: float, room: int, comm: MPI.Comm) -> BoolArray:
    """Choose those above a threshold, which is raised until there is room for them; collective."""
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
    """Find a threshold below which shares add up to no more than some number; collective."""
    if comm.allreduce(float(share.sum())) <= enough:
        return enough
    # It is the largest of these powers of two, times the share that all cells might have
    count = max(comm.allreduce(len(share)), 1)
    least, highest = enough / count, int(np.ceil(np.log2(count)))
    mantissa, exponent = np.frexp(share / least)
    power = np.clip(exponent - (mantissa == 0.5), 0, highest + 1)
    power[~np.isfinite(share)] = highest + 1
    sums = summed(comm, np.bincount(power, share, minlength=highest + 2))
    return float(least * 2.0 ** np.searchsorted(np.cumsum(sums)[1:-1], enough, side="right"))


def _groups(low: FloatArray, high: FloatArray, level: int) -> tuple[Boxes, FloatArray, IndexArray]:
    """Make boxes on grids that depend on nothing but the cells' own extents.

    Returns:
        The boxes, upper bounds of half the extents of their cells, and each cell's box.
    """
    exponent, place = np.empty(low.shape, np.int64), np.empty(low.shape, np.int64)
    for block in blocks(low.shape[1]):
        least, most = low[:, block], high[:, block]
        # a power of two may have been rounded up
        power = np.frexp((most - least) * (1 - _FEW))[1]
        exponent[:, block] = power
        place[:, block] = np.floor(0.5 * (least + most) / np.ldexp(1.0, power + level))
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
        for block in blocks(len(key)):
            here = key[block]
            here *= width
            here += row[block]
            here -= first
        span *= width
    if span > 8 * len(key) + 1000:
        return np.unique(key, return_inverse=True)[1].reshape(-1)
    seen = np.zeros(span, dtype=np.intp)
    seen[key] = 1
    return (np.cumsum(seen) - 1)[key]
