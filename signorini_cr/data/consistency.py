"""Data to think over: an exact solution that is none, a flux on no facet, a slit, κ that jumps."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import ufl
from dolfinx.geometry import bb_tree, compute_collisions_points
from dolfinx.mesh import Mesh, compute_midpoints
from mpi4py import MPI

from ..arrays import BoolArray, FloatArray, Int32Array, summed
from ..compat import cell_nodes
from ..fem.cells import barycentric_coordinates
from ..fem.conditions import Condition, as_number
from ..fem.pointwise import evaluate
from ..fem.problem import Forms
from ..fem.space import facet_measures, facet_normals
from ..mesh.domain import Domain, exterior_facets, facet_entities
from .admissible import SAFETY, Complaint, Precision, first, place, shown

Values = tuple[FloatArray, FloatArray]
"""Values at points, and what rounding may have done to them."""

SAME = 1e-6
"""Difference that counts as none, in parts of the largest value: an exact solution may be a fit."""

JUMP = 2.0
"""A factor by which κ may jump inside of a cell: the bound is not the sharper for another mesh."""

BEYOND, INSIDE = 1e-6, 1e-9
"""Distance behind a facet at which a cell is looked for, in the facet's size, and what barycentric
coordinates may be below 0 of a point that counts as inside."""

HALVINGS = 30
"""So many, and the halves of a cell's edge are shorter than what makes κ change by that factor,
unless it jumps."""


def doubts(forms: Forms, domain: Domain) -> list[str]:
    """Say what contradicts itself, or costs much, in data that can be solved with; collective.

    Args:
        forms: The data.
        domain: Mesh and boundary parts; of a sequence, the coarsest.

    Returns:
        A sentence each, the same on all ranks.
    """
    found = []
    for condition in forms.conditions:
        main = condition.main
        given = condition.source != "exact.u" and main is not None and as_number(main) != 0.0
        if given and domain.mesh.comm.allreduce(len(domain.facets(condition.number))) == 0:
            found.append(f"{condition.source}: it acts nowhere, for {_nowhere(condition, forms)}")
    if forms.exact is not None:
        said = _Solution(forms, domain).complaint()
        if said is not None:
            found.append(f"exact.u: {said}: it is not the solution, and errors say how far from it")
    return found + _slits(forms, domain) + _jumps(forms, domain)


def _nowhere(condition: Condition, forms: Forms) -> str:
    """Say why a condition has no facet, and where its main datum would belong."""
    if not any(
        type(each) is type(condition) and each is not condition for each in forms.conditions
    ):
        return f"no facet is {condition.part}"
    return (
        f"no edge is labelled {condition.part}; parts with a section of their own take"
        f" boundary.NAME.{condition.names()[0]}"
    )


def _slits(forms: Forms, domain: Domain) -> list[str]:
    """Say that there are cells behind facets through which nothing flows; collective."""
    mesh = domain.mesh
    facets: list[Int32Array] = [np.empty(0, dtype=np.int32)]
    for condition in forms.conditions:
        closed = condition.flux is None or as_number(condition.flux) == 0.0
        if closed and condition.fixed is None and condition.loss is None and not condition.bounds:
            facets.append(domain.facets(condition.number))
    own: Int32Array = np.concatenate(facets)
    corners, _, normals = _seen(mesh, own)
    sizes = np.linalg.norm(np.ptp(corners, axis=1), axis=1)
    middles = corners.mean(axis=1)
    behind = mesh.comm.allgather(middles + BEYOND * sizes[:, None] * normals)
    start = sum(map(len, behind[: mesh.comm.rank]))
    occupied = summed(mesh.comm, _inside_of(mesh, np.concatenate(behind)).astype(np.float64)) > 0.0
    slit = np.flatnonzero(occupied[start : start + len(own)])
    number = mesh.comm.allreduce(len(slit))
    at = [place(x, mesh) for x in middles[slit]]
    where = first(mesh.comm, [(each, shown(each)) for each in at])
    if where is None:
        return []
    return [
        f"domain: there are cells on both sides of {number} facets of its boundary, as at {where}:"
        " a slit, through which nothing flows; parts of a mesh that are to be one share their"
        " nodes, as after gmsh's fragment"
    ]


def _seen(mesh: Mesh, facets: Int32Array) -> tuple[FloatArray, Int32Array, FloatArray]:
    """Find the vertices of boundary facets, shape (n, d, 3), their cells and outward normals."""
    entities = facet_entities(mesh, facets)
    return facet_measures(mesh, facets)[0], entities[:, 0], facet_normals(mesh, entities)


def _inside_of(mesh: Mesh, x: FloatArray) -> BoolArray:
    """Tell which points, shape (n, 3), are in cells at the boundary that this rank has."""
    found = np.zeros(len(x), dtype=bool)
    cells = np.unique(facet_entities(mesh, exterior_facets(mesh))[:, 0])
    if not len(cells) or not len(x):
        return found
    # DOLFINx's own test of cells takes all that is nearer than a fixed length
    candidates = compute_collisions_points(
        bb_tree(mesh, mesh.topology.dim, padding=0.0, entities=cells), x
    )
    which = np.repeat(np.arange(len(x)), np.diff(candidates.offsets))
    corners = mesh.geometry.x[cell_nodes(mesh)[candidates.array]]
    hats = barycentric_coordinates(corners, x[which, None])[:, 0]
    found[which[hats.min(axis=1) >= -INSIDE]] = True
    return found


def _jumps(forms: Forms, domain: Domain) -> list[str]:
    """Say that κ jumps inside of cells; collective."""
    kappa: Any = forms.kappa
    if as_number(kappa) is not None:
        return []
    mesh = domain.mesh
    owned = mesh.topology.index_map(mesh.topology.dim).size_local
    cells: Int32Array = np.arange(owned, dtype=np.int32)
    corners = mesh.geometry.x[cell_nodes(mesh)[:owned]]
    middle = corners.mean(axis=1, keepdims=True)
    inner = middle + 0.99 * (corners - middle)  # what jumps at the cell's sides does not count

    def sizes(points: FloatArray, cells: Int32Array) -> FloatArray:
        found = evaluate(kappa, points.reshape(-1, 3), cells=cells)
        if found is None:
            return np.ones(len(cells))
        rows: FloatArray = found[0].reshape(len(cells), math.prod(kappa.ufl_shape))
        return np.linalg.norm(rows, axis=1)

    at = sizes(inner, cells.repeat(corners.shape[1])).reshape(corners.shape[:2])
    cells = np.flatnonzero(np.ptp(at, axis=1) > 0.0).astype(np.int32)
    ends = [which(at[cells], axis=1) for which in (np.argmin, np.argmax)]
    (low, high), (least, most) = ([each[cells, end] for end in ends] for each in (inner, at))
    for _ in range(HALVINGS):
        between = 0.5 * (low + high)
        value = sizes(between, cells)
        upper = value > np.sqrt(least) * np.sqrt(most)
        high[upper], most[upper] = between[upper], value[upper]
        low[~upper], least[~upper] = between[~upper], value[~upper]
    factors = most / least
    comm, many = mesh.comm, factors >= JUMP
    number_of = comm.allreduce(int(many.sum()))
    largest = comm.allreduce(float(factors.max(initial=1.0)), op=MPI.MAX)
    if not number_of:
        return []
    there = "a cell" if number_of == 1 else f"{number_of} cells"
    return [
        f"coefficient: it jumps by a factor of up to {largest:.4g} inside of {there}, and"
        " the bound is the larger for it; the mesh follows the polygon of a [material.NAME]"
    ]


class _Solution:
    """An exact solution on a mesh."""

    def __init__(self, forms: Forms, domain: Domain):
        """Take the data; collective."""
        self.forms, self.domain, self.mesh = forms, domain, domain.mesh
        self.precision = Precision.of(domain.mesh).vertices
        self.u: Any = forms.exact
        flat = as_number(self.u) is not None
        self.slope: Any = None if flat else forms.kappa * ufl.grad(self.u)

    def complaint(self) -> str | None:
        """Find the first condition that u violates: on Γ1, in Ω, on other parts; collective."""
        said = None
        for contact in self.forms.bounded:
            for sign, bound in contact.bounds:
                said = said or self._on_contact(contact, sign, bound)
        problem = self.forms.problem
        if problem.f is not None and not said:
            tdim = self.mesh.topology.dim
            number_of = self.mesh.topology.index_map(tdim).size_local
            cells: Int32Array = np.arange(number_of, dtype=np.int32)
            x = compute_midpoints(self.mesh, tdim, cells)
            f = ufl.as_ufl(0.0) if self.forms.asked is None else self.forms.asked
            given, wanted = self._values(self.forms.f, x, cells), self._values(f, x, cells)
            said = self._same("data.f", x, given, wanted)
        for condition in self.forms.conditions:
            if said or condition.source == "exact.u":
                continue
            x, cells, n = self._facets(condition.number)
            if condition.fixed is not None:
                given = self._values(condition.fixed, x, cells)
                said = self._same(condition.label, x, given, self._values(self.u, x, cells))
            elif not condition.bounds and condition.flux is not None:
                given = self._values(condition.flux, x, cells)
                said = self._same(condition.label, x, given, self._flux(condition, x, cells, n))
        return said

    def _on_contact(self, contact: Condition, sign: int, bound: Any) -> str | None:
        """Say what is wrong with one bound: sign u must not be below it."""
        x, cells, n = self._facets(contact.number)
        u, alpha = self._values(self.u, x, cells), self._values(bound, x, cells)
        pressure = self._flux(contact, x, cells, n)
        if contact.flux is not None:
            pressure = _difference(pressure, self._values(contact.flux, x, cells))
        u, pressure = ((sign * each[0], each[1]) for each in (u, pressure))
        gap = _difference(u, alpha)
        height, force = self._size(u, alpha), self._size(pressure)
        off, other = ("below", "above") if sign > 0 else ("above", "below")
        said = self._first(
            gap[0] < -SAME * height - gap[1],
            x,
            lambda u, obstacle: f"u is {u:.6g}, {off} the obstacle, {obstacle:.6g}",
            (sign * u[0], u[1]),
            (sign * alpha[0], alpha[1]),
        )
        low = SAME * force + pressure[1]
        pulls = (pressure[0] < -low) & (len(contact.bounds) == 1)
        said = said or self._first(
            pulls,
            x,
            lambda force: f"the pressure on the obstacle is {force:.6g}, below 0",
            pressure,
        )
        apart = (gap[0] > SAME * height + gap[1]) & (pressure[0] > low)
        return said or self._first(
            apart,
            x,
            lambda force, gap: f"the pressure on the obstacle is {force:.6g} though u is {other} it"
            f" by {gap:.6g}",
            pressure,
            gap,
        )

    def _same(self, key: str, x: FloatArray, given: Values, wanted: Values) -> str | None:
        apart = _difference(given, wanted)
        wrong = np.abs(apart[0]) > SAME * self._size(given, wanted) + apart[1]
        return self._first(
            wrong,
            x,
            lambda value, asked: f"{key} is {value:.6g}, but it asks for {asked:.6g}",
            given,
            wanted,
        )

    def _facets(self, part: int) -> tuple[FloatArray, Int32Array, FloatArray]:
        """Find midpoints of facets, their cells and outward normals."""
        corners, cells, normals = _seen(self.mesh, self.domain.facets(part))
        return corners.mean(axis=1), cells, normals

    def _values(self, e: Any, x: FloatArray, cells: Int32Array) -> Values:
        """Evaluate an expression at points; what can't be told is nan."""
        found = evaluate(e, x, self.precision, cells)
        if found is None:
            shape = (len(x), *e.ufl_shape)
            return np.full(shape, np.nan), np.full(shape, np.nan)
        return found[0], SAFETY * found[1]

    def _flux(self, where: Condition, x: FloatArray, cells: Int32Array, n: FloatArray) -> Values:
        """Evaluate κ∂ₙu + b u."""
        if self.slope is None:
            found = np.zeros(len(x)), np.zeros(len(x))
        else:
            values, errors = self._values(self.slope, x, cells)
            n = n[:, : values.shape[1]]
            found = (values * n).sum(axis=1), (errors * np.abs(n)).sum(axis=1)
        if where.loss is None:
            return found
        return _difference(found, self._values(-where.loss * self.u, x, cells))

    def _size(self, *found: Values) -> float:
        """Find the largest value on any rank."""
        values = np.concatenate([np.abs(each[0]) for each in found])
        largest = float(values[np.isfinite(values)].max(initial=0.0))
        return float(self.mesh.comm.allreduce(largest, op=MPI.MAX))

    def _first(
        self, wrong: BoolArray, x: FloatArray, words: Callable[..., str], *found: Values
    ) -> str | None:
        """Say what is wrong at the first point, in words made of what was found there; collective.

        They are made by a function, and of no template: a part's name may have braces.
        """
        complaints: list[Complaint] = []
        for i in np.flatnonzero(wrong):
            where = place(x[i], self.mesh)
            said = words(*(each[0][i] for each in found))
            complaints.append((where, f"at {shown(where)} {said}"))
        return first(self.mesh.comm, complaints)


def _difference(a: Values, b: Values) -> Values:
    return a[0] - b[0], a[1] + b[1]
