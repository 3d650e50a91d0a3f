"""Data for which the problem makes sense: K is not empty, and the energy is one.

They are tried out at points of the coarsest mesh, by `pointwise.evaluate`, which tells how far a
value can be trusted: no data are refused for what rounding has made of them.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product
from typing import TYPE_CHECKING

import numpy as np
import ufl
from dolfinx import fem
from dolfinx.fem.petsc import assemble_matrix
from dolfinx.mesh import Mesh, compute_midpoints, entities_to_geometry
from mpi4py import MPI
from scipy.sparse import csc_array, csr_array, diags_array, eye_array
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import splu

from ..arrays import BoolArray, FloatArray, IndexArray, Int32Array, Int64Array, found_in
from ..compat import cell_nodes
from ..errors import InputError, raise_together
from ..fem.cells import BoundaryFacets, Cells, corner_points
from ..fem.conditions import as_number, facets_of, is_by_cells, negative
from ..fem.pointwise import EPS, evaluate
from ..fem.problem import Forms
from ..fem.space import function_space, ghosted_vector
from ..garbage import release
from ..mesh.domain import Domain, facet_entities
from ..mesh.shared import bounding_box

if TYPE_CHECKING:
    from .quadrature import Tensor, Trace

Complaint = tuple[tuple[float, ...], str]
"""A place, and what is wrong there."""

SAFETY = 4.0
"""Factor on the bound of a rounding error: the bound is of first order."""

WANTED = "a symmetric positive definite tensor is needed"

MOST_SHOWN = 100
"""Points that are looked at for the one to be told."""

TOLERANCE = 1e-9
"""Excess that counts as none, in parts of u_D's size: formulas are written with so many digits."""

SKEW = 1e-12
"""The same for a tensor's entries, of which both are told: what is no rounding has no bound."""

COORDINATES = 1e-12
"""Digits of a vertex that a mesh generator gets right, in parts of the domain's diameter."""

SAMPLES, FEWEST_SAMPLES, MOST_SAMPLES = 50_000, 4, 128
"""Intervals in which u_D is looked at: about so many in all, and so many a facet."""

POLE = 1e3
"""Least value at a pole, in multiples of the largest value looked at first."""

AT_A_TIME = 20_000
"""Intervals that are cut at a time; of more, only the rougher part of each."""

MIDDLE = 0.45
"""Part of an interval at which it is cut: in its middle, a jump that lies just there, as sign(x) at
0, has the mean of both sides."""

SHORTEST = 1e3
"""Length of the shortest intervals, in units of the points' rounding."""

SPAN = 64.0
"""Length of the first intervals in parts of that, at least: u_D must have room to fall."""

LOOKS = 16
"""Parts that a facet's edge is cut into by the points at which two bounds are compared."""

FACTORISED = 100_000
"""Largest matrix of a form of the user's own that is looked at for eigenvalues below 0."""

DEFINITE = 1e-13
"""Eigenvalue that counts as 0 in a matrix whose diagonal is 1: a stiff part in one 1e12 times as
soft has 1e-12."""

NOT_DEFINITE = (
    "form: a(u, u) is not above 0 for all u that vanish on the dirichlet parts; without that there"
    " may be no solution"
)


def check_data(forms: Forms, domain: Domain) -> None:
    """Insist on data for which there is a solution; collective.

    Args:
        forms: The data.
        domain: Mesh and boundary parts; of a sequence, the coarsest.

    Raises:
        InputError: κ, or the user's form, is not symmetric and positive definite, u_D jumps, or α
            is above u_D where Γ0 meets Γ1. The message names the point and the values.
    """
    check_operator(forms, domain)
    check_boundary(forms, domain)


def check_boundary(forms: Forms, domain: Domain) -> None:
    """Insist on u_D, α and β that some function has, as `check_data` does; collective."""
    comm = domain.mesh.comm
    fixed = [(_Values(c.fixed, domain), _Facets.of(domain, c.number)) for c in forms.fixed]
    for condition, (u_D, facets) in zip(forms.fixed, fixed, strict=True):
        _raise_first(comm, _jump(u_D, facets, condition.source))
    if len(fixed) > 1:
        _raise_first(comm, _between(fixed, None, forms.fixed[-1].source))
    for contact in forms.bounded:
        bounded = _Facets.of(domain, contact.number)
        for sign, bound in contact.bounds:
            limit = _Values(bound, domain)
            label = contact.called("obstacle" if sign > 0 else "upper")
            for u_D, facets in fixed:
                complaints = _crossing(u_D, facets, limit, bounded, label, sign)
                _raise_first(comm, complaints)
            for other in forms.bounded:
                for _, rival in (b for b in other.bounds if b[0] != sign and other is not contact):
                    edge = _Values(negative(rival) if sign > 0 else rival, domain)
                    there = edge, _Facets.of(domain, other.number), limit, bounded
                    _raise_first(comm, _crossing(*there, label, sign, "contact"))
        if len(contact.bounds) == 2:
            (_, lower), (_, upper) = contact.bounds
            _raise_first(comm, _crossed(lower, upper, domain, bounded, contact.label))


def check_operator(forms: Forms, domain: Domain) -> None:
    """Insist on an a_h that is an energy, as `check_data` does; collective."""
    comm = domain.mesh.comm
    if forms.problem.form is not None:
        raise_together(comm, _bad_form(forms, domain))
    _raise_first(comm, _bad_coefficient(forms, domain))
    at, owner = _middles(domain), _owner(forms, domain, "reaction")
    names = {"": "the reaction"} | {m: f"the reaction of {m!r}" for m in forms.problem.materials}
    _raise_first(comm, _unfit(_Values(forms.reaction, domain), at, lambda cell: names[owner(cell)]))
    for condition in forms.conditions:
        if condition.loss is not None:
            facets = _Facets.of(domain, condition.number)
            at = facets.x.mean(axis=1), facets.cells
            name = f"the coefficient of the part {condition.part!r}"
            loss = _Values(condition.loss, domain)
            _raise_first(comm, _unfit(loss, at, lambda _: name))


def _middles(domain: Domain) -> tuple[FloatArray, Int32Array]:
    """Find the middles of this rank's cells, and the cells."""
    tdim = domain.mesh.topology.dim
    cells = np.arange(domain.mesh.topology.index_map(tdim).size_local, dtype=np.int32)
    return compute_midpoints(domain.mesh, tdim, cells), cells


def _owner(forms: Forms, domain: Domain, datum: str) -> Callable[[int], str]:
    """Tell which material a cell's datum is from, "" for none: `Problem`'s own."""
    own = [m for m, data in forms.problem.materials.items() if getattr(data, datum) is not None]
    where = {material: domain.materials.where(material) for material in own}
    return lambda cell: next((material for material in own if where[material][cell]), "")


def _unfit(
    datum: _Values, at: tuple[FloatArray, Int32Array], name: Callable[[int], str]
) -> list[Complaint]:
    """Find where a datum is below 0 that must not be; or not finite, and that on all of a cell.

    Args:
        datum: It.
        at: Points, and their cells.
        name: What it is called in a cell.
    """
    x, cells = at
    found = datum.at(x, cells, datum.precision.points)
    if found is None:
        return []
    values, errors = found
    complaints = []
    endless = ~np.isfinite(values) & is_by_cells(datum.expression)
    for i in np.flatnonzero(endless | (values < -errors)):
        where = place(x[i], datum.mesh)
        rule = "be finite" if endless[i] else "not be below 0"
        said = f"{name(cells[i])} is {values[i]:.10g} at {shown(where)}; it must {rule}"
        complaints.append((where, said))
    return complaints


def differs(
    cells: Cells, side: BoundaryFacets, excess: FloatArray, scale: float, *data: Trace
) -> bool:
    """Tell whether data differ at the vertices of facets by more than their rounding; collective.

    Args:
        cells: The mesh.
        side: The facets.
        excess: What should not be above 0 at their vertices, shape (d, n).
        scale: Size of what the data are compared with, the same on all ranks.
        *data: What the excess is made of.

    Returns:
        Whether they do on this rank.
    """
    vertex, facet = np.nonzero(excess > TOLERANCE * scale)
    if not cells.comm.allreduce(len(facet)):
        return False
    precision = Precision.of(cells.domain.mesh).vertices
    x = corner_points(cells, side)[1][vertex, facet]
    points = np.zeros((len(x), 3))
    points[:, : x.shape[1]] = x
    where = side.cells[facet].astype(np.int32)
    found = (evaluate(each.expression, points, precision, where) for each in data)
    slack = sum(SAFETY * each[1] for each in found if each is not None)
    return bool((excess[vertex, facet] > TOLERANCE * scale + slack).any())


@dataclass(frozen=True)
class Precision:
    """Errors that coordinates may have.

    Attributes:
        vertices: Of vertices, as they were given or made by a mesh generator.
        points: Of points between them.
    """

    vertices: float
    points: float

    @classmethod
    def of(cls, mesh: Mesh) -> Precision:
        """Look at the mesh; collective."""
        low, high = bounding_box(mesh)
        rounding = 4 * EPS * float(max(np.abs(low).max(), np.abs(high).max()))
        return cls(max(2 * rounding, COORDINATES * float(np.linalg.norm(high - low))), rounding)


class _Values:
    """An expression at points of a mesh.

    Args:
        expression: A scalar.
        domain: The mesh it may be tied to.
    """

    def __init__(self, expression: ufl.core.expr.Expr, domain: Domain):
        self.expression, self.mesh = expression, domain.mesh
        self.precision = Precision.of(domain.mesh)
        self.constant = as_number(expression) is not None
        self.tied = bool(ufl.algorithms.extract_coefficients(expression))

    def at(
        self, points: FloatArray, cells: Int32Array, error: float
    ) -> tuple[FloatArray, FloatArray] | None:
        """Evaluate, with tolerances for rounding, shapes of the points but for the last axis."""
        shape = points.shape[:-1]
        cells = np.broadcast_to(cells.reshape(cells.shape + (1,) * (len(shape) - 1)), shape)
        found = evaluate(self.expression, points.reshape(-1, 3), error, cells.ravel())
        if found is None:
            return None
        return found[0].reshape(shape), SAFETY * found[1].reshape(shape)


@dataclass(frozen=True)
class _Facets:
    """Facets of one part that this rank owns.

    Attributes:
        x: Their vertices, shape (n, d, 3).
        cells: Their cells, shape (n,).
        nodes: Global numbers of the vertices, shape (n, d).
    """

    x: FloatArray
    cells: Int32Array
    nodes: Int64Array

    @classmethod
    def of(cls, domain: Domain, part: int) -> _Facets:
        mesh, facets = domain.mesh, domain.facets(part)
        d = mesh.topology.dim
        nodes = np.zeros((0, d), dtype=np.int32)
        if len(facets):
            nodes = np.asarray(entities_to_geometry(mesh, d - 1, facets), dtype=np.int32)
        known = mesh.geometry.index_map().local_to_global(nodes.ravel())
        return cls(
            mesh.geometry.x[nodes],
            facet_entities(mesh, facets)[:, 0],
            np.asarray(known, dtype=np.int64).reshape(nodes.shape),
        )

    @property
    def paths(self) -> _Paths:
        """Segments that every facet is looked at along: the facet itself, or to its middle."""
        if self.x.shape[1] == 2:
            return _Paths(self.x[:, 0], self.x[:, 1], self.cells)
        middle = np.repeat(self.x.mean(axis=1), self.x.shape[1], axis=0)
        return _Paths(self.x.reshape(-1, 3), middle, np.repeat(self.cells, self.x.shape[1]))


@dataclass(frozen=True, eq=False)
class _Paths:
    """Segments on facets, all of shape (n, …).

    Attributes:
        start: One end of each.
        end: The other.
        cells: A cell that it is in.
    """

    start: FloatArray
    end: FloatArray
    cells: Int32Array

    @cached_property
    def lengths(self) -> FloatArray:
        """Lengths of the segments."""
        return np.asarray(np.linalg.norm(self.end - self.start, axis=1))

    def at(self, segment: IndexArray, s: FloatArray) -> FloatArray:
        """Find the points at s, from 0 to 1, of some segments, shape (*s.shape, 3)."""
        start = self.start[segment]
        return start + s[..., None] * (self.end[segment] - start)


def _jump(u_D: _Values, fixed: _Facets, key: str) -> list[Complaint]:
    """Find where u_D jumps, within a facet or between two that touch; collective.

    Every facet is looked at in intervals. Where u_D is far from affine on one, it is cut in two,
    until the digits of the coordinates end. What is continuous has fallen by then, however steep it
    is; a jump is as high as before. (|t|^s falls far enough for s > 0.05, near 0.)
    """
    comm, paths = u_D.mesh.comm, fixed.paths
    number = comm.allreduce(len(paths.cells))
    if u_D.constant or not number:
        return []
    shortest = SHORTEST * u_D.precision.points
    longest = max(comm.allgather(float(paths.lengths.max(initial=0.0))))
    usual = np.clip(SAMPLES // number, FEWEST_SAMPLES, MOST_SAMPLES)
    pieces = int(min(usual, longest / (SPAN * shortest)))
    if pieces < 1:
        return [_far_message(key, u_D.mesh, x) for x in paths.start[:1]]
    intervals = _sampled(u_D, paths, pieces)
    if intervals is None:
        return []
    finite = np.abs(intervals.u[np.isfinite(intervals.u)])
    largest = comm.allreduce(float(finite.max(initial=0.0)), op=MPI.MAX)
    scale = TOLERANCE * largest
    complaints = _between([(u_D, fixed)], scale, key) if u_D.tied else []

    # a jump is higher than intervals around it, of this length at most, are far from affine
    halfway = 16.0 * math.sqrt(longest / pieces * shortest)
    while len(intervals.segment):
        rough, width = intervals.roughness, intervals.widths(paths)
        roughest = np.where(width <= halfway, np.maximum(rough, intervals.roughest), 0.0)
        rounding, u = np.maximum(scale, _noise(intervals.e)), intervals.u
        pole = np.abs(u).max(axis=0) > POLE * largest
        short, height = width < shortest, np.abs(u[2] - u[0])
        jump = short & (height > np.maximum(rounding, roughest))
        middle = paths.at(intervals.segment, intervals.s[1])
        complaints += [_pole_message(key, u_D.mesh, x) for x in middle[pole]]
        complaints += [
            _jump_message(key, u_D.mesh, x, before, after)
            for x, before, after in zip(middle[jump], u[0, jump], u[2, jump], strict=True)
        ]
        still_open = replace(intervals, roughest=roughest).picked(~short & (rough > rounding))
        intervals = still_open.halved(u_D, paths)
        if len(intervals.segment) > AT_A_TIME:
            intervals = intervals.rougher()
    return complaints


@dataclass(frozen=True, eq=False)
class _Intervals:
    """Parts of segments on which a datum is looked at, with their ends and a middle.

    Attributes:
        segment: Which segment each is of, shape (n,).
        s: Places on the segment, from 0 to 1, shape (3, n).
        u: Values there, shape (3, n).
        e: What they may be off by, shape (3, n).
        roughest: How far from affine any was of which this is a part, from some length on, shape
            (n,).
    """

    segment: IndexArray
    s: FloatArray
    u: FloatArray
    e: FloatArray
    roughest: FloatArray

    @property
    def roughness(self) -> FloatArray:
        """Distances of u from affine; 0 where it is not finite, shape (n,)."""
        with np.errstate(all="ignore"):
            difference = np.abs((1.0 - MIDDLE) * self.u[0] - self.u[1] + MIDDLE * self.u[2])
        return np.where(np.isfinite(difference), difference, 0.0)

    def widths(self, paths: _Paths) -> FloatArray:
        """Compute the lengths of the intervals, shape (n,)."""
        return np.asarray((self.s[2] - self.s[0]) * paths.lengths[self.segment])

    def picked(self, which: BoolArray | IndexArray) -> _Intervals:
        """Return some of them."""
        return _Intervals(
            self.segment[which],
            self.s[:, which],
            self.u[:, which],
            self.e[:, which],
            self.roughest[which],
        )

    def halved(self, u_D: _Values, paths: _Paths) -> _Intervals:
        """Cut all in two, with values in the middles of both parts; the first parts come first."""
        cuts = self.s[:2] + MIDDLE * np.diff(self.s, axis=0)
        x = paths.at(self.segment, cuts).swapaxes(0, 1)
        found = u_D.at(x, paths.cells[self.segment], u_D.precision.points)
        assert found is not None
        return _Intervals(
            np.tile(self.segment, 2),
            _halves(self.s, cuts),
            _halves(self.u, found[0].T),
            _halves(self.e, found[1].T),
            np.tile(self.roughest, 2),
        )

    def rougher(self) -> _Intervals:
        """Keep of both parts, the first ones first, that which is farther from affine."""
        first, second = np.split(self.roughness, 2)
        place = np.arange(len(first))
        return self.picked(np.where(first >= second, place, len(first) + place))


def _sampled(u_D: _Values, paths: _Paths, pieces: int) -> _Intervals | None:
    """Cut facets into intervals; None where u_D has no values there on some rank; collective."""
    start, end, cells = paths.start, paths.end, paths.cells
    t = np.arange(pieces)[:, None] + [0.0, MIDDLE]
    t = np.append(t, pieces) / pieces
    x = start[:, None] + t[:, None] * (end - start)[:, None]
    found = u_D.at(x, cells, u_D.precision.points)
    if u_D.mesh.comm.allreduce(found is None, op=MPI.LOR):
        return None
    assert found is not None
    values, errors = found
    # vertices are where they are: next to a pole of the angle, its value there can be trusted
    at_ends = u_D.at(np.stack([start, end], axis=1), cells, 0.0)
    assert at_ends is not None
    errors[:, [0, -1]] = at_ends[1]

    def triples(array: FloatArray) -> FloatArray:
        return np.stack([array[:, :-2:2], array[:, 1:-1:2], array[:, 2::2]]).reshape(3, -1)

    segment: IndexArray = np.repeat(np.arange(len(start)), pieces)
    places = triples(np.broadcast_to(t, values.shape))
    return _Intervals(segment, places, triples(values), triples(errors), np.zeros(len(segment)))


def _halves(triples: FloatArray, cuts: FloatArray) -> FloatArray:
    """Cut every interval in two, the first parts first, shape (3, 2 intervals)."""
    (a, m, b), (p, q) = triples, cuts
    return np.hstack([np.stack([a, p, m]), np.stack([m, q, b])])


def _noise(e: FloatArray) -> FloatArray:
    """Bound what rounding makes of three values; one may lie where nothing can be known."""
    return 3.0 * np.median(e, axis=0)


def _pole_message(key: str, mesh: Mesh, x: FloatArray) -> Complaint:
    where = place(x, mesh)
    return where, (
        f"{key}: the dirichlet value grows without bound towards {shown(where)}; it must be finite"
        " and continuous"
    )


def _between(
    given: Sequence[tuple[_Values, _Facets]], scale: float | None, key: str
) -> list[Complaint]:
    """Find vertices at which facets give u_D different values; collective.

    On one part only Functions can: what else depends on x alone.

    Args:
        given: u_D and the facets of each part of Γ0.
        scale: What is no difference; None to tell it by the values.
        key: For the message.
    """
    comm, parts = given[0][0].mesh.comm, []
    for u_D, fixed in given:
        found = u_D.at(fixed.x, fixed.cells, u_D.precision.vertices)
        if comm.allreduce(found is None, op=MPI.LOR):
            continue
        assert found is not None
        parts.append([array.ravel() for array in (fixed.nodes, *found)])
    if not parts:
        return []
    mine = [np.concatenate(each) for each in zip(*parts, strict=True)]
    node, value, error = (np.concatenate(each) for each in zip(*comm.allgather(mine)))
    if scale is None:
        scale = TOLERANCE * float(np.abs(value[np.isfinite(value)]).max(initial=0.0))
    order = np.lexsort((value, node))
    node, value, error = node[order], value[order], error[order]
    same = np.flatnonzero(
        (node[1:] == node[:-1]) & (value[1:] - value[:-1] > scale + error[1:] + error[:-1])
    )
    places = {
        int(n): x
        for _, fixed in given
        for n, x in zip(fixed.nodes.ravel(), fixed.x.reshape(-1, 3), strict=True)
    }
    return [
        _jump_message(key, given[0][0].mesh, places[int(node[i])], value[i], value[i + 1])
        for i in same
        if int(node[i]) in places
    ]


def _far_message(key: str, mesh: Mesh, x: FloatArray) -> Complaint:
    where = place(x, mesh)
    return where, (
        f"{key}: around {shown(where)} coordinates have too few digits for facets as short as these"
        " to tell whether the dirichlet value jumps; the domain must lie nearer to the origin"
    )


def _jump_message(key: str, mesh: Mesh, x: FloatArray, a: float, b: float) -> Complaint:
    where = place(x, mesh)
    digits = 9 - math.ceil(math.log10(max(abs(a), abs(b))))
    a, b = round(a, digits) + 0.0, round(b, digits) + 0.0
    return where, (
        f"{key}: at {shown(where)} the dirichlet value jumps from {a:.10g} to {b:.10g}; it must be"
        " continuous wherever dirichlet facets touch, because no function of finite energy jumps"
        " on the boundary (a steep slope is allowed)"
    )


def _crossing(
    u_D: _Values,
    fixed: _Facets,
    alpha: _Values,
    contact: _Facets,
    label: str,
    sign: int,
    other: str = "dirichlet",
) -> list[Complaint]:
    """Find where Γ0 meets Γ1 with α above u_D, or −β above −u_D: K is empty; collective.

    In the place of u_D there may be the opposite bound of another part of Γ1.
    """
    mesh = u_D.mesh
    comm = mesh.comm
    error = u_D.precision.vertices
    value_of = f"the {other} value" if other == "dirichlet" else "the other part's bound"
    found = u_D.at(fixed.x, fixed.cells, error)
    above = alpha.at(contact.x, contact.cells, error)
    if comm.allreduce(found is None or above is None, op=MPI.LOR):
        return []
    assert found is not None and above is not None
    mine = [array.ravel() for array in (fixed.nodes, sign * found[0], found[1])]
    node, value, slack = (np.concatenate(each) for each in zip(*comm.allgather(mine)))
    node, one = np.unique(node, return_index=True)
    row, meets = found_in(node, contact.nodes)
    below, less = value[one][row[meets]], slack[one][row[meets]]
    top, more = (array[meets] for array in above)
    finite = np.abs(value[np.isfinite(value)]).max(initial=0.0)
    scale = max(float(finite), *comm.allgather(float(np.abs(top).max(initial=0.0))))
    wrong = np.flatnonzero(top - below > TOLERANCE * scale + less + more)
    bound = "the obstacle" if sign > 0 else "the upper bound"
    return [
        (
            where := place(contact.x[meets][i], mesh),
            f"{label}: at {shown(where)}, where contact and {other} meet, {bound} is"
            f" {sign * top[i]:.10g} but {value_of} is {'only ' if sign > 0 else ''}"
            f"{sign * below[i]:.10g}; {bound} must not be {'above' if sign > 0 else 'below'} it",
        )
        for i in wrong
    ]


def _crossed(
    lower: ufl.core.expr.Expr,
    upper: ufl.core.expr.Expr,
    domain: Domain,
    contact: _Facets,
    label: str,
) -> list[Complaint]:
    """Find where α is above β, at some points of each facet; β comes with the other sign."""
    room = _Values(upper + lower, domain)
    complaints = []
    d = contact.x.shape[1]
    steps = [i for i in product(range(LOOKS + 1), repeat=d) if sum(i) == LOOKS]
    for hats in np.array(steps) / LOOKS:
        x = np.einsum("d,ndk->nk", hats, contact.x)
        found = room.at(x, contact.cells, room.precision.vertices)
        if found is None:
            return []
        for i in np.flatnonzero(found[0] > found[1]):
            where = place(x[i], domain.mesh)
            said = f"{label}: at {shown(where)} it is {found[0][i]:.10g} above the upper bound"
            complaints.append((where, said))
    return complaints


def _bad_coefficient(forms: Forms, domain: Domain) -> list[Complaint]:
    """Find where κ is not symmetric or positive definite, at vertices and midpoints of cells."""
    mesh = domain.mesh
    if forms.uniform:
        return []
    tdim = mesh.topology.dim
    owned = np.arange(mesh.topology.index_map(tdim).size_local, dtype=np.int32)
    nodes, first = np.unique(cell_nodes(mesh)[owned], return_index=True)
    x = np.vstack([mesh.geometry.x[nodes], compute_midpoints(mesh, tdim, owned)])
    cells = np.concatenate([(first // (tdim + 1)).astype(np.int32), owned])
    found = evaluate(forms.kappa, x, Precision.of(mesh).vertices, cells)
    if found is None:
        return []
    values, errors = (array.reshape(len(x), *(forms.kappa.ufl_shape or (1, 1))) for array in found)
    usable = np.asarray(np.isfinite(values).all(axis=(1, 2)))
    values[~usable] = np.eye(values.shape[1])
    size = np.abs(values).max(axis=(1, 2), initial=0.0)
    skew = np.abs(values - values.transpose(0, 2, 1))
    allowed = SKEW * size[:, None, None] + SAFETY * (errors + errors.transpose(0, 2, 1))
    crooked = np.asarray((skew > allowed).any(axis=(1, 2)))
    least = np.linalg.eigvalsh(0.5 * values + 0.5 * values.transpose(0, 2, 1))[:, 0]
    wrong = np.flatnonzero(crooked | ~(least > 0))
    if not len(wrong):
        return []
    i = min(wrong, key=lambda i: place(x[i], mesh))
    where = place(x[i], mesh)
    if not forms.kappa.ufl_shape:
        said = f"is {values[i, 0, 0]:.10g}; it must be above 0 everywhere"
    else:
        said = f"is {_rows(values[i])}, which is not symmetric; "
        if not crooked[i]:
            said = f"is {_rows(values[i])}, with the eigenvalue {least[i]:.10g}; "
        said += WANTED
    material = _owner(forms, domain, "coefficient")(cells[i])
    key = f"material.{material}" if material else "data"
    return [(where, f"{key}.coefficient: the value at {shown(where)} {said}")]


def check_symmetry(kappa: Tensor, domain: Domain) -> None:
    """Insist on a tensor that is symmetric at the quadrature points of a mesh; collective.

    Nothing is to be done where its formulas say so.

    Raises:
        InputError: It is not.
    """
    if not kappa.skew:
        return
    mesh = domain.mesh
    number = mesh.topology.index_map(mesh.topology.dim).size_local
    values = kappa.as_given(domain, kappa.rule, slice(0, number))
    size = np.abs(values).max(axis=(2, 3), initial=0.0)
    skew = np.abs(values - values.transpose(0, 1, 3, 2)).max(axis=(2, 3), initial=0.0)
    found = []
    for cell, point in np.argwhere(skew > SKEW * size)[:MOST_SHOWN]:
        corners = mesh.geometry.x[cell_nodes(mesh)[cell]]
        where = place(kappa.rule.hats[:, point] @ corners, mesh)
        said = f"is {_rows(values[cell, point])}, which is not symmetric; {WANTED}"
        found.append((where, f"data.coefficient: the value at {shown(where)} {said}"))
    _raise_first(mesh.comm, found)


def _rows(tensor: FloatArray) -> str:
    """Write a tensor for a message."""
    return "[" + ", ".join("[" + ", ".join(f"{v:.10g}" for v in row) + "]" for row in tensor) + "]"


def _bad_form(forms: Forms, domain: Domain) -> str | None:
    """Say what is wrong with the matrix of the user's form, the same on all ranks; collective."""
    V = function_space(domain.mesh, forms.element)
    A = assemble_matrix(forms.a.on(domain, [V, V]))
    A.assemble()
    functions = fem.Function(V), fem.Function(V)
    functions[0].interpolate(lambda x: np.sin(1.0 + 7.0 * x[0] + 11.0 * x[1]))
    functions[1].interpolate(lambda x: np.cos(2.0 + 13.0 * x[0] - 5.0 * x[1]))
    x, y, image = (*(ghosted_vector(V, each.x.array) for each in functions), A.createVecLeft())
    A.mult(x, image)
    there = image.dot(y)
    A.mult(y, image)
    skew, size = abs(there - image.dot(x)), A.norm() * x.norm() * y.norm()
    least = A.getDiagonal().min()[1]
    fixed = fem.locate_dofs_topological(
        V, domain.mesh.topology.dim - 1, facets_of(domain, forms.fixed)
    )
    rows = A.getValuesCSR() if A.getSize()[0] <= FACTORISED else None
    release(A, x, y, image)
    if not np.isfinite(size):
        return "form: a(u, v) is not finite at some point of the mesh"
    if skew > TOLERANCE * size:
        return "form: a(u, v) is not a(v, u); without symmetry this is no problem of least energy"
    if least <= 0.0:
        return NOT_DEFINITE
    if rows is None:
        return None
    comm, held = domain.mesh.comm, V.dofmap.index_map.local_to_global(fixed)
    found = comm.gather((*rows, held))
    definite = None if found is None else _definite(found)
    return None if comm.bcast(definite) else NOT_DEFINITE


def _definite(ranks: Sequence[tuple[IndexArray, IndexArray, FloatArray, Int64Array]]) -> bool:
    """Tell whether a symmetric matrix is definite but for constants, which obstacles may hold.

    By Sylvester's law of inertia there are as many eigenvalues below 0 as pivots.

    Args:
        ranks: Of each rank the rows, as PETSc has them, and which unknowns are not free.
    """
    starts, columns, values, held = zip(*ranks, strict=True)
    counts = np.concatenate([np.diff(start) for start in starts])
    start = np.concatenate([[0], np.cumsum(counts)])
    A = csr_array((np.concatenate(values), np.concatenate(columns), start))
    free = np.setdiff1d(np.arange(len(counts)), np.concatenate(held))
    A = A[free][:, free]
    scale = diags_array(1.0 / np.sqrt(A.diagonal()))
    of_constants = np.abs(scale @ (A @ np.ones(len(free))))
    A = scale @ A @ scale
    number, piece = connected_components(A, directed=False)
    loose = np.count_nonzero(np.bincount(piece, of_constants, number) <= TOLERANCE)
    negative_pivots = []
    for sign in (1.0, -1.0):
        shifted = csc_array(A + sign * DEFINITE * eye_array(len(free)))
        try:
            factors = splu(
                shifted, "MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True}
            )
        except RuntimeError:  # a pivot is 0
            return False
        negative_pivots.append(np.count_nonzero(factors.U.diagonal() <= 0.0))
    return negative_pivots[0] == 0 and negative_pivots[1] <= loose


def place(x: FloatArray, mesh: Mesh) -> tuple[float, ...]:
    """Round a point for a message: leave out the digits that rounding has made."""
    digits = 11 - math.ceil(math.log10(np.abs(mesh.geometry.x).max()))
    return tuple(float(value) + 0.0 for value in np.round(x[: mesh.geometry.dim], digits))


def shown(x: Sequence[float]) -> str:
    """Write a point for a message."""
    return "(" + ", ".join(f"{value:.10g}" for value in x) + ")"


def first(comm: MPI.Comm, found: list[Complaint]) -> str | None:
    """Find the complaint about the first point from the left, on all ranks; collective."""
    every = [each for each in comm.allgather(min(found, default=None)) if each is not None]
    return min(every)[1] if every else None


def _raise_first(comm: MPI.Comm, found: list[Complaint]) -> None:
    if (message := first(comm, found)) is not None:
        raise InputError(message)
