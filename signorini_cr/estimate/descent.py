"""Conjugate gradients for quadratic functionals of one number for each facet."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ..arrays import FloatArray
from ..fem.cells import Cells, blocks

LONGEST = 1e100
"""Of a step that scaled matrices ask for; theirs are about 1."""


def descend(
    cells: Cells,
    image: Callable[[FloatArray], FloatArray],
    numbers: FloatArray,
    down: FloatArray,
    diagonal: FloatArray,
    steps: int,
    share: float = 0.0,
) -> tuple[float, float]:
    """Minimise z·Az/2 − b·z by conjugate gradients, scaled with a diagonal; collective.

    Args:
        cells: The mesh.
        image: Gives A times numbers by facet dof, ghosts included, 0 where they are held; a new
            array each time.
        numbers: z by facet dof, ghosts included, improved in place.
        down: b − Az, 0 where z is held; changed in place.
        diagonal: About A's, nowhere 0.
        steps: How many steps at most.
        share: Part of down's square, as the diagonal has it, at which to stop.

    Returns:
        What the functional has fallen by, times 2, and down's square in the end.
    """
    owned, fall = slice(cells.owned_facets()), 0.0
    way = down / diagonal
    first = square = float(cells.total(down[owned] @ way[owned])[0])
    for _ in range(steps):
        if not square > share * first:
            break
        change = image(way)
        bend = float(cells.total(way[owned] @ change[owned])[0])
        if not square < LONGEST * bend:  # A's products are below all numbers
            break
        length = square / bend
        fall += length * square
        for block in blocks(len(down)):
            numbers[block] += length * way[block]
            change[block] *= length
            down[block] -= change[block]
            np.divide(down[block], diagonal[block], out=change[block])
        straight = change
        before, square = square, float(cells.total(down[owned] @ straight[owned])[0])
        for block in blocks(len(down)):
            way[block] *= square / before
            way[block] += straight[block]
    return fall, square


def nonzero(diagonal: FloatArray) -> FloatArray:
    """Put 1 in place of 0, which facets have that no cell of this rank has; in place."""
    diagonal[diagonal == 0.0] = 1.0
    return diagonal
