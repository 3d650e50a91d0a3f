"""Places of contact, as lines and in words, for pictures."""

from __future__ import annotations

import numpy as np

from ..arrays import FloatArray
from ..vi.contact import ContactFacts


def contact_lines(contact: ContactFacts) -> tuple[FloatArray, FloatArray]:
    """Find the parts of a plane Γ1 in contact, and those that are not; collective.

    Where contact ends inside a facet, so does the line.

    Returns:
        Their ends on rank 0, shapes (n, 2, 2) and (m, 2, 2); none on the others.
    """
    comm = contact.comm
    pieces = comm.gather((contact.vertices[..., :2], contact.active), root=0)
    if pieces is None:
        return np.zeros((0, 2, 2)), np.zeros((0, 2, 2))
    ends, active = (np.concatenate(each) for each in zip(*pieces, strict=True))
    touching, free = [ends[active]], ends[~active]
    for point in contact.transitions[:, :2]:
        if not len(free):
            break
        away = np.linalg.norm(free - point, axis=2)
        length = np.linalg.norm(free[:, 1] - free[:, 0], axis=1)
        within = away.sum(axis=1) - length
        facet = int(np.argmin(within))
        near = int(np.argmin(away[facet]))
        if within[facet] < 1e-6 * length[facet]:
            touching.append(np.stack([free[facet, near], point])[None])
            free[facet, near] = point
    return np.concatenate(touching), free


def in_words(contact: ContactFacts) -> str:
    """Say how much of Γ1 is in contact, for a title; collective."""
    whole = contact.comm.allreduce(float(contact.measure.sum()))
    if contact.number_active in (0, contact.number):
        return "no contact" if contact.number_active == 0 else r"all of $\Gamma_1$ in contact"
    percent = min(max(round(100.0 * contact.length / whole), 1), 99)
    return rf"{percent} % of $\Gamma_1$ in contact"
