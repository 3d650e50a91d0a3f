"""The problem that a file states, in a few lines."""

from __future__ import annotations

import re
import textwrap
from collections.abc import Mapping
from typing import Any

import numpy as np

from ..fem.space import facet_measures
from ..mesh.domain import Domain
from .problemfile import ProblemFile
from .screen import WIDTH

INDENT = 11
_SIGNS = {"coefficient": "κ", "f": "f", "reaction": "c", "capacity": "capacity"}
LONGEST = 50
"""Characters of an expression; what is longer is cut."""


def statement(case: ProblemFile, domain: Domain) -> dict[str, str]:
    """Say what is solved and where; collective.

    Args:
        case: What the file says.
        domain: The coarsest mesh.

    Returns:
        A line by the name of what it is about.
    """
    mesh, said = domain.mesh, case.said
    unit = case.units.after("x")
    comm, tdim, gdim = mesh.comm, mesh.topology.dim, mesh.geometry.dim
    x = mesh.geometry.x[:, :gdim]
    low = np.min(comm.allgather(x.min(axis=0, initial=np.inf)), axis=0)
    high = np.max(comm.allgather(x.max(axis=0, initial=-np.inf)), axis=0)
    extent = " × ".join(f"[{a:.6g}, {b:.6g}]" for a, b in zip(low, high, strict=True))

    def data(key: str, derived: str = "") -> str:
        return _short(said.get(f"data.{key}", derived if derived and "exact.u" in said else "0"))

    materials = {name: case.said[f"material.{name}"] for name in case.materials}
    own_kappa = any("coefficient" in material for material in materials.values())
    kappa = "κ" if "data.coefficient" in said or own_kappa else ""
    gain = f" + {_factor(data('reaction'))} u" if "data.reaction" in said else ""
    if not gain and any("reaction" in material for material in materials.values()):
        gain = " + c u"
    usual = _short(said.get("data.coefficient", 1))
    equation = f"−∇·(κ∇u){gain} = {data('f', 'f from exact.u')}, κ = {usual}"
    rows = {
        "domain": f"{mesh.topology.index_map(tdim).size_global} cells in {extent}{unit}",
        "equation": equation if kappa else f"−Δu{gain} = {data('f', 'f from exact.u')}",
    }
    for name, material in materials.items():
        tags = domain.materials
        number = np.count_nonzero(tags.where(name)[: mesh.topology.index_map(tdim).size_local])
        own = [f"{_SIGNS[key]} = {_short(material[key])}" for key in _SIGNS if key in material]
        rows[name] = f"{', '.join(own) or 'no data of its own'}; {comm.allreduce(number)} cells"
    conditions = {
        "dirichlet": f"u = {data('dirichlet', 'exact.u')}",
        "neumann": f"{kappa}∂ₙu = {data('g', 'g from exact.u')}",
        "contact": f"u ≥ {data('obstacle')}, {kappa}∂ₙu ≥ 0, one of them an equality",
    }
    for name, part in case.said.items():
        if name.startswith("boundary."):
            conditions[name.removeprefix("boundary.")] = _condition(part, kappa, "exact.u" in said)
    for name, condition in conditions.items():
        measures = facet_measures(mesh, domain.facets(domain.parts[name]))[1]
        number = comm.allreduce(len(measures))
        if number > 0:
            total = comm.allreduce(float(measures.sum()))
            what = "length" if gdim == 2 else "area"
            rows[name] = f"{condition}; {number} facets, {what} {total:.6g}{unit}"
    if case.time is not None:
        words = f"t from 0 to {case.time.end:g}{case.units.after('time')} in {case.time.steps}"
        words += f" steps of {case.time.scheme}"
        start = f"u = {_short(said.get('time.initial', 0))} at t = 0"
        rows["time"] = f"{words}; {case.time.capacity:g} ∂u/∂t on the left; {start}"
    if "exact.u" in said:
        rows["exact.u"] = _short(said["exact.u"])
    helpers = [key.removeprefix("define.") for key in said if key.startswith("define.")]
    if helpers:
        rows["where"] = ", ".join(f"{name} = {_short(said[f'define.{name}'])}" for name in helpers)
    return rows


def folded(rows: Mapping[str, str]) -> str:
    """A statement for the screen, two lines at most for each part of it."""
    return "\n".join(
        textwrap.fill(
            text,
            WIDTH,
            initial_indent=name.ljust(INDENT),
            subsequent_indent=" " * INDENT,
            break_on_hyphens=False,
            max_lines=2,
            placeholder=" …",
        )
        for name, text in rows.items()
    )


def _condition(part: Mapping[str, Any], kappa: str, known: bool) -> str:
    """What holds on a part that has a section."""

    def data(key: str, derived: str = "") -> str:
        return _short(part.get(key, derived if derived and known else "0"))

    kind, loss = part["type"], part.get("coefficient", 0) != 0
    flux = f"{kappa}∂ₙu"
    if loss:
        difference = _minus("u", data("external"))
        difference = f"({difference})" if difference != "u" else "u"
        flux += f" + {_factor(data('coefficient'))} {difference}"
    if kind == "dirichlet":
        return f"u = {data('value', 'exact.u')}"
    if kind != "contact":
        return f"{flux} = {data('g', 'g from exact.u')}"
    flux = _minus(flux, data("g"))
    if "upper" not in part:
        return f"u ≥ {data('obstacle')}, {flux} ≥ 0, one of them an equality"
    if "obstacle" not in part:
        return f"u ≤ {data('upper')}, {flux} ≤ 0, one of them an equality"
    return (
        f"{data('obstacle')} ≤ u ≤ {data('upper')}, {flux} ≥ 0 on the lower bound, ≤ 0 on "
        "the upper, 0 between them"
    )


def _factor(text: str) -> str:
    """What can be multiplied as it is, else in parentheses."""
    return text if re.fullmatch(r"[\w.]+", text) else f"({text})"


def _minus(left: str, right: str) -> str:
    """A difference as people write it: u − cold, u + 5 for u − (−5), u for u − 0."""
    try:
        number = float(right)
    except ValueError:
        return f"{left} − {_factor(right)}"
    if number == 0.0:
        return left
    return f"{left} + {right.lstrip('- ')}" if number < 0.0 else f"{left} − {right}"


def _short(value: object) -> str:
    """What was written, on one line."""
    text = " ".join(str(value).split())
    if isinstance(value, list):
        text = text.replace("'", "")
    return text if len(text) <= LONGEST else text[: LONGEST - 1] + "…"
