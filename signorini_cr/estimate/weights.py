"""Weights of the user's own on parts of the boundary, extended into Ω.

ω on the parts, 0 on the rest of Γ0 and Γ1, is the trace of φ + ℓ: φ in P1 has ω's values at the
vertices, and ℓ is what it lacks on the facets, lifted into their cells as u_D is.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import ufl
from dolfinx import fem

from ..arrays import FloatArray, Int32Array
from ..data.admissible import place, shown
from ..data.jets import Enclosure
from ..data.pieces import Pieces
from ..data.quadrature import OnFacets, OnParts, Trace
from ..errors import InputError
from ..fem.cells import BoundaryFacets, Cells, measures, pick
from ..fem.conditions import Condition, Data, as_number, facets_of
from ..fem.layout import Layout
from ..fem.problem import Forms, as_expression, carry
from ..fem.space import function_space
from ..mesh.domain import Domain
from .certificate import Made
from .lifting import JUMP, Cubic, Lift, lift

TOLERANCE = 1e-2
"""Accuracy of ‖Aℓ‖ that is enough, in parts of ‖Aφ‖, or thereabouts."""


@dataclass(frozen=True, eq=False)
class Weighed:
    """Figures of a weight against y, and of its part beyond P1; this rank's shares.

    Attributes:
        force: ∫ ω (y·n + t − g̃) over the parts.
        unsure: How far it may be from that.
        square: ‖Aℓ‖².
        left: Bound of what is left of −div y = f, tested by ℓ, where e does not vanish on the part.
        mean: Bound of |ℓ_T|.
        least: ω is not below it.
    """

    force: float
    unsure: float = 0.0
    square: float = 0.0
    left: float = 0.0
    mean: float = 0.0
    least: float = 1.0


@dataclass(frozen=True, eq=False)
class Weight:
    """A weight on some parts of the boundary.

    Attributes:
        trace: ω.
        parts: Its values on the facets of owned cells.
        values: The P1 function that has ω's values at the parts' vertices, and 0 at others.
        known: Local dofs of the vertices of the parts, Γ0 and Γ1, ghosts included.
        scale: The largest of its values at vertices, midpoints and quadrature points.
    """

    trace: Trace
    parts: OnParts
    values: fem.Function
    known: Int32Array
    scale: float

    @classmethod
    def of(
        cls,
        made: Made,
        cells: Cells,
        conditions: Sequence[Condition],
        weight: Data,
        free: Sequence[Condition] = (),
    ) -> Weight:
        """Evaluate a weight on the parts of some conditions; collective.

        Args:
            made: Whose data there are.
            cells: The mesh.
            conditions: They.
            weight: ω.
            free: Parts of Γ1 that are not among the rest: φ may be anything there.

        Raises:
            InputError: It is no scalar, or not 0 where the parts meet the rest of Γ0 and Γ1.
        """
        domain, data = cells.domain, made.data
        trace = data.compiled.trace(scalar(weight, data.forms, domain))
        parts = OnParts.of([OnFacets.of(each, trace, domain) for each in conditions], cells)
        V, side, ends = function_space(domain.mesh, "P1"), parts.side, parts.ends
        own = V.dofmap.list[side.cells[:, None], cells.others[side.local]].T
        values, layout = fem.Function(V), Layout.of_space(V)
        count = np.zeros_like(values.x.array)
        for array, amounts in ((values.x.array, ends), (count, np.ones_like(ends))):
            np.add.at(array, own, amounts)
            layout.shared_sum(array)
        chosen = count > 0.0
        values.x.array[chosen] /= count[chosen]
        known = (*conditions, *free)
        others = facets_of(
            domain, [c for c in (*data.forms.fixed, *data.forms.bounded) if c not in known]
        )
        rest = np.zeros(len(count), dtype=bool)
        rest[layout.nodes_at(others)] = True
        found = [np.ravel(row) for p in parts.parts for row in (p.ends, p.middle, p.inside)]
        seen = np.concatenate(found or [np.zeros(0)])
        largest = float(np.abs(seen[np.isfinite(seen)]).max(initial=0.0))
        scale = max(domain.mesh.comm.allgather(largest if np.isfinite(ends).all() else np.inf))
        if not np.isfinite(scale):
            raise InputError("the weight is not finite at a vertex of the part")
        _insist_on_zero(values, chosen & rest, scale)
        values.x.array[rest] = 0.0
        return cls(trace, parts, values, np.flatnonzero(chosen | rest).astype(np.int32), scale)

    def put_into(self, at: FloatArray) -> FloatArray:
        """Give a P1 function the known values: it at the cells' vertices, shape (3, cells)."""
        dofs = self.values.function_space.dofmap.list[: at.shape[1]].T
        return np.where(np.isin(dofs, self.known), self.values.x.array[dofs], at)

    def weighed(self, made: Made, cells: Cells, size: float) -> Weighed:
        """Integrate it against y, and bound what it has beyond P1; collective.

        Args:
            made: y.
            cells: The mesh.
            size: ‖Aφ‖.

        Raises:
            InputError: The weight jumps, or has no enclosure.
        """
        side = self.parts.side
        dofs = self.values.function_space.dofmap.list
        ends = self.values.x.array[dofs[side.cells[:, None], cells.others[side.local]].T]
        none, height = np.zeros(len(side.cells)), self.parts.middle - ends.mean(axis=0)
        goal = TOLERANCE * size / np.sqrt(max(cells.comm.allgather(made.most.max(initial=1e-300))))
        coarse, fine = (
            lift(cells, side, self.trace, None, Cubic(ends, bend, none), self.scale, goal, False)
            for bend in (none, height)
        )
        reasons = [each.reason for each in (coarse, fine)]
        for reason in (words for rank in cells.comm.allgather(reasons) for words in rank if words):
            raise InputError(reason.replace("u_D", "the weight"))
        length = measures(cells, side)
        pressure = pressed(made, cells, side) / length
        unsure = float(np.abs(pressure) @ fine.beyond)
        if made.beyond is not None:  # through Γ0 y has the curl of bumps, which is affine
            bumps = np.abs(made.beyond.heights[side.dofs])
            unsure += float(bumps @ (np.ptp(ends, axis=0) / 3.0 + 4.0 * coarse.edge / length**0.5))
        over_cells = coarse.area / np.sqrt(cells.volume[side.cells])
        left = np.abs(made.left[side.cells])
        if made.taken_up is not None:
            left = np.where(made.taken_up[side.cells], 0.0, left)
        return Weighed(
            float(pressure @ (length * (ends.mean(axis=0) + 2.0 / 3.0 * height))),
            unsure,
            _square(made, cells, side, coarse),
            float(left @ over_cells),
            float(np.bincount(side.cells, over_cells).max(initial=0.0)),
            float(np.min(ranges(self.trace, cells, side)[0], initial=np.inf)),
        )


def scalar(weight: Data, forms: Forms, domain: Domain) -> ufl.core.expr.Expr:
    """Write a weight as an expression in the coordinates of the mesh that the forms are on.

    Args:
        weight: The weight.
        forms: The forms.
        domain: Where it will be asked for; collective, as what it holds is carried there.

    Raises:
        InputError: It is no scalar, or on another mesh.
    """
    found = as_expression(weight, forms.x, "weight")
    if found.ufl_shape != ():
        raise InputError(f"the weight has the shape {found.ufl_shape}; a scalar is needed")
    if (number := as_number(found)) is not None and not np.isfinite(number):
        raise InputError(f"the weight is {number:g}; it must be finite")
    if any(each != forms.mesh.ufl_domain() for each in ufl.domain.extract_domains(found)):
        raise InputError("the weight is given on another mesh than the data")
    carry([found], domain)
    return found


def pressed(made: Made, cells: Cells, side: BoundaryFacets) -> FloatArray:
    """Compute ∫_F (y·n + t − g̃) on facets of Γ0 and Γ1, but for what is in σ, shape (n,)."""
    known, edge = np.zeros(len(cells.exterior)), made.segments
    known[edge.facets.dofs] = edge.through
    if made.shed is not None:
        known[edge.facets.dofs] -= made.shed
    return np.asarray(made.through(cells)[side.local, side.cells] - known[side.dofs])


def _square(made: Made, cells: Cells, side: BoundaryFacets, lifted: Lift) -> float:
    """Bound ‖Aℓ‖², this rank's share."""
    most = made.most
    which, place = np.unique(side.cells, return_inverse=True)
    steep, area = (np.bincount(place, row) for row in (lifted.steep, lifted.area))
    loss, edge = np.zeros(len(cells.exterior)), made.segments
    loss[edge.facets.dofs] = edge.most
    found = pick(most, which) @ steep**2 if most.ndim else float(most) * np.sum(steep**2)
    found += np.sum(pick(made.most_reaction, which) * area**2)
    return float(found + loss[side.dofs] @ lifted.edge**2)


def ranges(trace: Trace, cells: Cells, side: BoundaryFacets) -> tuple[FloatArray, FloatArray]:
    """Bound a weight on facets from below and from above, shapes (n,)."""
    none = np.zeros(len(side.cells))
    if trace.constant is not None:
        return none + trace.constant, none + trace.constant
    boxes = Pieces.of_facets(cells, side).boxes(cells, decide=True)
    found = Enclosure(boxes)(trace.deviation.expression)
    low, high = found.low + none, found.high + none
    return np.where(np.isnan(low), -np.inf, low), np.where(np.isnan(high), np.inf, high)


def _insist_on_zero(values: fem.Function, where: FloatArray, scale: float) -> None:
    """Refuse a weight that does not vanish at some vertices; collective."""
    V = values.function_space
    wrong = np.flatnonzero(where & (np.abs(values.x.array) > JUMP * scale))
    at = V.tabulate_dof_coordinates()[wrong, :2]
    own = [(place(x, V.mesh), float(w)) for x, w in zip(at, values.x.array[wrong], strict=True)]
    found = sorted(each for rank in V.mesh.comm.allgather(own) for each in rank)
    if found:
        at_vertex, value = found[0]
        raise InputError(
            f"the weight is {value:.4g} at {shown(at_vertex)}, where the part touches another one"
            " on which u is set or bounded; it must vanish there, as what flows through is no"
            " bounded functional of the solution otherwise"
        )
