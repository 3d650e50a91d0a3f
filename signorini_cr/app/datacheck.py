"""The data tried out on a mesh, before anything is solved."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from typing import Any

import numpy as np
from dolfinx.mesh import compute_midpoints, entities_to_geometry

from ..arrays import FloatArray, Int32Array
from ..errors import InputError
from ..mesh.domain import CONTACT, DIRICHLET, NEUMANN, Domain
from .expressions import Expression

USED_ON: dict[str, int | None] = {
    "data.coefficient": None,
    "data.f": None,
    "data.reaction": None,
    "data.dirichlet": DIRICHLET,
    "data.g": NEUMANN,
    "data.obstacle": CONTACT,
    "exact.u": None,
}
"""Where each expression is used: a part of the boundary, or None for the whole domain; those of
[boundary.NAME] are used there."""


def _used_on(key: str, domain: Domain) -> int | None:
    section, name, *_ = key.split(".", 2)
    return domain.parts[name] if section == "boundary" else USED_ON[key]


def check_values(expressions: Mapping[str, Expression], domain: Domain) -> None:
    """Insist on finite data, and on a positive coefficient; collective.

    Args:
        expressions: The data by key, ``data.f`` … ``exact.u``.
        domain: They are evaluated at vertices and midpoints of its cells or, where they belong to
            a part of the boundary, of that part's facets.

    Raises:
        InputError: The message names the key and the first such point from the left.
    """
    x = domain.mesh.geometry.x
    size = max(domain.mesh.comm.allgather(float(np.abs(x).max(initial=0.0))))
    digits = 11 - math.ceil(math.log10(size))
    bad: tuple[Any, ...] = (math.inf,)
    for number, (key, expression) in enumerate(expressions.items()):
        points = _points(domain, _used_on(key, domain), digits)
        values = expression.numpy(points)
        wrong = ~np.isfinite(values)
        if key == "data.coefficient":
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
    message = f"{key}: the value at {_point(bad[1:3])} is {bad[3]:g}"
    if math.isfinite(bad[3]):
        what = "above 0" if key == "data.coefficient" else "0 or more"
        raise InputError(f"{message}; the {key.rpartition('.')[2]} must be {what} everywhere")
    part, named = _used_on(key, domain), {value: name for name, value in domain.parts.items()}
    where = "in the domain" if part is None else f"on the {named[part]} part"
    raise InputError(
        f"{message}; it must be finite everywhere {where}"
        " (where(condition, a, b) can set a value apart)"
    )


def _points(domain: Domain, part: int | None, digits: int) -> FloatArray:
    """Vertices and midpoints of the cells, or of the facets of one part, shape (n, 3).

    Rounded to so many digits after the point, because a mesh generator gets so many right: at
    1e-13 instead of 0, 1/x is finite and sqrt(-x) is not.
    """
    mesh = domain.mesh
    tdim = mesh.topology.dim
    if part is None:
        cells = np.arange(mesh.topology.index_map(tdim).size_local, dtype=np.int32)
        points = np.vstack([mesh.geometry.x, compute_midpoints(mesh, tdim, cells)])
    else:
        facets = domain.facets(part)
        vertices = mesh.geometry.x[_vertices(domain, facets)]
        points = np.vstack([vertices, compute_midpoints(mesh, tdim - 1, facets)])
    return np.round(points, digits) + 0.0


def _vertices(domain: Domain, facets: Int32Array) -> Int32Array:
    """Geometry nodes of the facets' vertices, each once."""
    mesh = domain.mesh
    if len(facets) == 0:
        return np.empty(0, dtype=np.int32)
    return np.unique(entities_to_geometry(mesh, mesh.topology.dim - 1, facets))


def _point(x: Collection[float]) -> str:
    return "(" + ", ".join(f"{value:.10g}" for value in x) + ")"
