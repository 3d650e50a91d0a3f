"""The data tried out on a mesh, before anything is solved."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
from dolfinx.mesh import compute_midpoints, entities_to_geometry

from ..arrays import BoolArray, FloatArray, Int32Array
from ..data.admissible import shown
from ..errors import InputError
from ..mesh.domain import Domain
from ..mesh.shared import bounding_box
from .formula import Expression
from .reference import ABOVE, EXPRESSIONS, Key


class Datum(NamedTuple):
    """Place of an expression in a problem file; as a text, its key.

    Attributes:
        section: "data", "exact", "boundary", "material", "time" or "quantities".
        name: What the section is about; None where there is one such section only.
        key: The key there.
        entry: Row and column, of an entry of a tensor.
    """

    section: str
    name: str | None
    key: str
    entry: tuple[int, ...] = ()

    def __str__(self) -> str:
        """Write it as messages do."""
        own = self.section if self.name is None else f"{self.section}.{self.name}"
        return f"{own}.{self.key}" + "".join(f"[{i}]" for i in self.entry)

    @property
    def told(self) -> Key:
        """The row that the reference has of its key."""
        return EXPRESSIONS[f"{self.section}{'.NAME' if self.name is not None else ''}.{self.key}"]


Weights = Mapping[str, str | None]
"""Part or material where each quantity's weight is used, None for all of the domain."""


def _used_on(datum: Datum, domain: Domain, weights: Weights) -> int | None:
    """Find the part of the boundary that an expression is used on, or None for the domain."""
    if datum.section == "quantities" and datum.name is not None:
        return domain.parts.get(weights[datum.name] or "")
    part = datum.name if datum.section == "boundary" else datum.told.used_on
    return domain.parts[part] if part else None


def _used_in(datum: Datum, data: Collection[Datum], domain: Domain, weights: Weights) -> BoolArray:
    """Find the local cells in which a datum that is used on no part of the boundary is used."""
    section, name, key, _ = datum
    tdim, materials = domain.mesh.topology.dim, domain.materials
    used = np.ones(domain.mesh.topology.index_map(tdim).size_local, dtype=bool)
    if section == "quantities" and name is not None:
        name = weights[name]
    if name is not None:
        return materials.where(name)[: len(used)]
    if section == "data":
        own = {each.name for each in data if each.section == "material" and each.key == key}
        for other in materials.numbers:
            if other in own:
                used &= ~materials.where(other)[: len(used)]
    return used


def check_values(
    expressions: Mapping[Datum, Expression],
    domain: Domain,
    weights: Weights = MappingProxyType({}),
    time: float | None = None,
) -> None:
    """Insist on finite data, and on a positive coefficient; collective.

    Args:
        expressions: The data, by where they stand.
        domain: They are evaluated at vertices and midpoints of its cells or, where they belong to
            a part of the boundary, of that part's facets.
        weights: Where those that are weights are used.
        time: What the time is now, if there is one.

    Raises:
        InputError: The message names the key and the first such point from the left.
    """
    digits = _digits(domain)
    bad: tuple[Any, ...] = (math.inf,)
    for number, (datum, expression) in enumerate(expressions.items()):
        part = _used_on(datum, domain, weights)
        which: BoolArray | Int32Array
        if part is None:
            which = _used_in(datum, expressions, domain, weights)
        else:
            which = domain.facets(part)
        points = _points(domain, domain.mesh.topology.dim - (part is not None), which, digits)
        values = expression.numpy(points)
        wrong = ~np.isfinite(values)
        if datum.told.least and not datum.entry:  # tensors are looked at as a whole
            wrong |= values <= 0 if datum.told.least == ABOVE else values < 0
        if wrong.any():
            found = np.column_stack([points[:, :2], values])[wrong]
            first = found[np.lexsort((found[:, 1], found[:, 0]))[0]]
            bad = (number, *first.tolist())
            break
    bad = min(domain.mesh.comm.allgather(bad), key=lambda found: found[:3])
    if len(bad) == 1:
        return
    datum = list(expressions)[bad[0]]
    when = ""
    if time is not None and expressions[datum].depends_on_time:
        when = f", at the time {time:g}"
    message = f"{datum}: the value at {shown(bad[1:3])} is {bad[3]:g}"
    if math.isfinite(bad[3]):
        there = "there" if datum.section == "material" else "everywhere"
        raise InputError(f"{message}; the {datum.key} must be {datum.told.least} {there}{when}")
    part = _used_on(datum, domain, weights)
    named = {value: name for name, value in domain.parts.items()}
    where = "in the domain" if part is None else f"on the {named[part]} part"
    raise InputError(
        f"{message}; it must be finite everywhere {where}"
        f" (where(condition, a, b) can set a value apart){when}"
    )


def _digits(domain: Domain) -> int:
    """Find how many digits after the point a mesh generator gets right; collective.

    Those of the domain's extent, but for what far from the origin is rounding.
    """
    low, high = bounding_box(domain.mesh)
    extent, farthest = float((high - low).max()), float(np.maximum(-low, high).max())
    return min(11 - math.ceil(math.log10(extent)), 14 - math.ceil(math.log10(farthest)))


def _points(domain: Domain, dim: int, which: BoolArray | Int32Array, digits: int) -> FloatArray:
    """Return vertices and midpoints of some cells or facets, shape (n, 3).

    Rounded to so many digits after the point, because a mesh generator gets so many right: at
    1e-13 instead of 0, 1/x is finite and sqrt(-x) is not.
    """
    mesh = domain.mesh
    entities = (np.flatnonzero(which) if which.dtype == bool else which).astype(np.int32)
    if not len(entities):
        return np.empty((0, 3))
    nodes = np.unique(entities_to_geometry(mesh, dim, entities))
    points = np.vstack([mesh.geometry.x[nodes], compute_midpoints(mesh, dim, entities)])
    return np.round(points, digits) + 0.0
