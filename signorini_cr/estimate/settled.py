"""Contact parts that are in contact everywhere, or nowhere: there u is known to second order."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..arrays import FloatArray, Int32Array
from ..data.quadrature import OnParts
from ..fem.cells import Cells
from ..fem.conditions import Condition
from .certificate import Certificate, Made
from .flux import unbalanced
from .lifting import gaps


@dataclass(frozen=True)
class Settled:
    """The parts of Γ1, sorted by whether contact begins or ends on them.

    Attributes:
        held: Where each facet has a force.
        free: Where none has.
        mixed: Where contact begins or ends.
        force: y's force on each facet of the boundary, off whichever bound.
        alpha: The bounds, off which v is where it is free.
    """

    held: list[Condition]
    free: list[Condition]
    mixed: list[Condition]
    force: FloatArray
    alpha: OnParts

    @classmethod
    def of(cls, made: Made, cells: Cells) -> Settled:
        """Sort the parts; collective."""
        data = made.data
        alpha = OnParts.of(data.alpha, cells)
        force = np.zeros(len(cells.exterior))
        np.maximum.at(force, alpha.side.dofs, made.contact)
        held: list[Condition] = []
        free: list[Condition] = []
        mixed: list[Condition] = []
        for condition in data.forms.bounded:
            dofs = cells.sides[condition.number].dofs
            touching, number = cells.total(float((force[dofs] > 0.0).sum()), float(len(dofs)))
            kind = mixed if 0 < touching < number else held if touching else free
            kind.append(condition)
        return cls(held, free, mixed, force, alpha)

    def unknown(self, made: Made, cells: Cells, flows: FloatArray, off: FloatArray) -> float:
        """Bound |∫ q e| over held parts and |∫ λ φ| over free ones, together; collective.

        |e| is at most (u − α) + (v + ℓ − α), where the force bounds the integrals of both; λ is
        bounded where v is off its bounds. ∞ where a force or a distance is not certain.

        Args:
            made: v and y.
            cells: The mesh.
            flows: max |q| |F| for each facet F of the boundary.
            off: max |φ| likewise.
        """
        room = gaps(cells, self.alpha, made.vertices, made.bumps, made.thirds)
        distance = np.full(len(cells.exterior), np.inf)
        np.minimum.at(distance, self.alpha.side.dofs, room)

        def most(parts: list[Condition], against: FloatArray, known: FloatArray) -> float:
            none: list[Int32Array] = [np.empty(0, dtype=np.int32)]
            dofs = np.concatenate(none + [cells.sides[each.number].dofs for each in parts])
            against, known = against[dofs], known[dofs]
            ratio = np.where(against == 0.0, 0.0, np.inf)
            with np.errstate(over="ignore"):  # by what is next to nothing
                np.divide(against, known, out=ratio, where=known > 0.0)
            return max(cells.comm.allgather(float(ratio.max(initial=0.0))))

        held = most(self.held, flows, self.force)
        free = most(self.free, off, distance)
        larger = max(held, free)
        if not np.isfinite(larger):
            return np.inf
        return larger * made.complementary + held * made.above


def left_by(dual: Made, made: Made) -> float:
    """Bound what a dual does not know of its load, for e that vanish on Γ0, in parts of ‖Ae‖.

    Its own certificate asks of e what only z does: to vanish where there is contact. That goes for
    what the solver left, and for the means that quadrature may have missed; collective.
    """
    around = made.data.cells  # these know Γ0
    left = dual.left if dual.taken_up is None else dual.left * ~dual.taken_up
    found = unbalanced(made.level, around, left, made.least, 0.0, made.reaction)
    if around.total(dual.missed.sum())[0] > 0.0:
        missed = np.array(np.broadcast_to(dual.missed, around.number))
        found += unbalanced(made.level, around, missed, made.least, 0.0, made.reaction)
    return found


def in_p1(dual: Certificate, cells: Cells, bent: bool = False) -> Made | None:
    """Return what a dual's certificate is made of, if v is in P1, y·n a number a facet; collective.

    Args:
        dual: The certificate.
        cells: The mesh.
        bent: Whether v may have bumps beside that.
    """
    made = dual.made
    if made is None or dual.bound_companion is None:
        return None
    if made.thirds is not None or made.beyond is not None:
        return None
    if bent:
        return made
    return None if cells.total(float(np.abs(made.bumps).sum()))[0] > 0.0 else made
