"""The data tried out on a mesh, before anything is solved."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from types import MappingProxyType
from typing import Any

import numpy as np
from dolfinx.mesh import compute_midpoints, entities_to_geometry

from ..arrays import BoolArray, FloatArray, Int32Array
from ..errors import InputError
from ..mesh.domain import Domain
from .expressions import Expression
from .reference import EXPRESSIONS

Weights = Mapping[str, str | None]
"""Where weights are used: the part or material by key, None for all of the domain."""


def _used_on(key: str, domain: Domain, weights: Weights) -> int | None:
    """Find the part of the boundary that an expression is used on, or None for the domain."""
    if key in weights:
        return domain.parts.get(weights[key] or "")
    section, name, *_ = key.split(".", 2)
    if section == "boundary":
        return domain.parts[name]
    told = EXPRESSIONS.get(bare(key))  # none for [material.NAME]
    return domain.parts[told.used_on] if told is not None and told.used_on else None


def _used_in(key: str, expressions: Collection[str], domain: Domain, weights: Weights) -> BoolArray:
    """Find the local cells in which a datum that is used on no part of the boundary is used."""
    section, name, *_ = bare(key).split(".", 2)
    bared = {bare(each) for each in expressions}
    tdim, materials = domain.mesh.topology.dim, domain.materials
    used = np.ones(domain.mesh.topology.index_map(tdim).size_local, dtype=bool)
    material = name if section == "material" else weights.get(key)
    if material is not None:
        return materials.where(material)[: len(used)]
    for other in materials.numbers:
        if section == "data" and f"material.{other}.{name}" in bared:
            used &= ~materials.where(other)[: len(used)]
    return used


def bare(key: str) -> str:
    """Return the key of a datum that one of its entries belongs to."""
    return key.partition("[")[0]


def is_kappa(key: str) -> bool:
    """Tell whether a key is that of κ; an entry of a tensor is not."""
    return key.endswith(".coefficient") and not key.startswith("boundary.")


def check_values(
    expressions: Mapping[str, Expression],
    domain: Domain,
    weights: Weights = MappingProxyType({}),
    time: float | None = None,
) -> None:
    """Insist on finite data, and on a positive coefficient; collective.

    Args:
        expressions: The data by key, ``data.f`` … ``exact.u``.
        domain: They are evaluated at vertices and midpoints of its cells or, where they belong to
            a part of the boundary, of that part's facets.
        weights: Where those that are weights are used.
        time: What the time is now, if there is one.

    Raises:
        InputError: The message names the key and the first such point from the left.
    """
    x = domain.mesh.geometry.x
    size = max(domain.mesh.comm.allgather(float(np.abs(x).max(initial=0.0))))
    digits = 11 - math.ceil(math.log10(size))
    bad: tuple[Any, ...] = (math.inf,)
    for number, (key, expression) in enumerate(expressions.items()):
        part = _used_on(key, domain, weights)
        which = _used_in(key, expressions, domain, weights) if part is None else domain.facets(part)
        points = _points(domain, domain.mesh.topology.dim - (part is not None), which, digits)
        values = expression.numpy(points)
        wrong = ~np.isfinite(values)
        if is_kappa(key):
            wrong |= values <= 0
        elif key.endswith((".reaction", ".coefficient")):
            wrong |= values < 0
        if wrong.any():
            found = np.column_stack([points[:, :2], values])[wrong]
            first = found[np.lexsort((found[:, 1], found[:, 0]))[0]]
            bad = (number, *first.tolist())
            break
    bad = min(domain.mesh.comm.allgather(bad), key=lambda found: found[:3])
    if len(bad) == 1:
        return
    key = list(expressions)[bad[0]]
    when = ""
    if time is not None and expressions[key].depends_on_time:
        when = f", at the time {time:g}"
    message = f"{key}: the value at {_point(bad[1:3])} is {bad[3]:g}"
    if math.isfinite(bad[3]):
        what = "above 0" if is_kappa(key) else "0 or more"
        there = "there" if key.startswith("material.") else "everywhere"
        raise InputError(f"{message}; the {key.rpartition('.')[2]} must be {what} {there}{when}")
    part, named = (
        _used_on(key, domain, weights),
        {value: name for name, value in domain.parts.items()},
    )
    where = "in the domain" if part is None else f"on the {named[part]} part"
    raise InputError(
        f"{message}; it must be finite everywhere {where}"
        f" (where(condition, a, b) can set a value apart){when}"
    )


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


def _point(x: Collection[float]) -> str:
    return "(" + ", ".join(f"{value:.10g}" for value in x) + ")"
