"""The problem that a file states, in a few lines."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping
from typing import Any

import numpy as np

from ..fem.conditions import Condition, as_factor
from ..fem.space import facet_measures
from ..mesh.domain import Domain
from .problemfile import ProblemFile
from .reference import EXPRESSIONS, KINDS
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

    materials = {name: case.said[f"material.{name}"] for name in case.materials}
    own_kappa = any("coefficient" in material for material in materials.values())
    kappa = "κ" if "data.coefficient" in said or own_kappa else ""
    gain = f" + {as_factor(_short(said['data.reaction']))} u" if "data.reaction" in said else ""
    if not gain and any("reaction" in material for material in materials.values()):
        gain = " + c u"
    usual, exact = _short(said.get("data.coefficient", 1)), "exact.u" in said
    load = _short(said.get("data.f", "f from exact.u" if exact else "0"))
    equation = f"−∇·(κ∇u){gain} = {load}, κ = {usual}"
    rows = {
        "domain": f"{mesh.topology.index_map(tdim).size_global} cells in {extent}{unit}",
        "equation": equation if kappa else f"−Δu{gain} = {load}",
    }
    for name, material in materials.items():
        tags = domain.materials
        number = np.count_nonzero(tags.where(name)[: mesh.topology.index_map(tdim).size_local])
        own = [f"{_SIGNS[key]} = {_short(material[key])}" for key in _SIGNS if key in material]
        rows[name] = f"{', '.join(own) or 'no data of its own'}; {comm.allreduce(number)} cells"
    for name, (kind, given) in _conditions(said).items():
        condition = kind.in_words({key: _short(v) for key, v in given.items()}, exact, kappa)
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


def _conditions(said: Mapping[str, Any]) -> dict[str, tuple[type[Condition], dict[str, Any]]]:
    """The kind of condition on each part, and what was written for its data, by name."""
    found = {}
    for name in ("dirichlet", "neumann", "contact"):
        (key,) = (key for key, told in EXPRESSIONS.items() if told.used_on == name)
        main = KINDS[name].names()[0]
        found[name] = KINDS[name], {main: said[key]} if key in said else {}
    for key, part in said.items():
        if key.startswith("boundary."):
            given = {datum: value for datum, value in part.items() if datum != "type"}
            found[key.removeprefix("boundary.")] = KINDS[part["type"]], given
    return found


def _short(value: object) -> str:
    """What was written, on one line."""
    text = " ".join(str(value).split())
    if isinstance(value, list):
        text = text.replace("'", "")
    return text if len(text) <= LONGEST else text[: LONGEST - 1] + "…"
