"""The problem that a file states, in a few lines."""

from __future__ import annotations

import textwrap
from collections.abc import Collection, Mapping
from typing import Any

import numpy as np

from ..fem.conditions import Condition, as_factor
from ..fem.space import facet_measures
from ..mesh.domain import Domain
from ..mesh.shared import bounding_box
from ..rounding import counted
from .problemfile import ProblemFile
from .reference import EXPRESSIONS, KINDS
from .screen import WIDTH

INDENT = 11
_SIGNS = {"coefficient": "κ", "f": "f", "reaction": "c", "capacity": "capacity"}
ROWS = ("domain", "equation", "time", "exact.u", "where")
"""Names of rows that are about no part and no material."""
LONGEST = 90
"""Characters of an expression; what is longer is cut."""


def statement(case: ProblemFile, domain: Domain) -> dict[str, str]:
    """Say what is solved and where; collective.

    Args:
        case: What the file says.
        domain: The coarsest mesh.

    Returns:
        A line by the name of what it is about.
    """
    said, unit = case.said, case.units.after("x")
    materials = {name: said[f"material.{name}"] for name in case.materials}
    own = set().union(*materials.values())
    kappa = "κ" if "data.coefficient" in said or "coefficient" in own else ""
    exact = "exact.u" in said
    rows = {
        "domain": f"{_extent(domain)}{unit}",
        "equation": _equation(said, own, kappa, _of_all_cells(materials, domain)),
    }
    for name, material in materials.items():
        data = [f"{_SIGNS[key]} = {_short(material[key])}" for key in _SIGNS if key in material]
        number = _cells(domain, name)
        called = f"material.{name}" if name in ROWS else name
        rows[called] = f"{', '.join(data) or 'no data of its own'}; {counted(number, 'cell')}"
    for name, (kind, given) in _conditions(said).items():
        condition = kind.in_words({key: _short(v) for key, v in given.items()}, exact, kappa)
        if there := _facets(domain, name):
            called = f"boundary.{name}" if name in (*ROWS, *rows) else name
            rows[called] = f"{condition}; {there}{unit}"
    if case.time is not None:
        words = f"t from 0 to {case.time.end:g}{case.units.after('time')} in"
        words += f" {counted(case.time.steps, 'step')} of {case.time.scheme}"
        rate = as_factor(f"{case.time.capacity:g}", "∂u/∂t")
        start = f"u = {_short(said.get('time.initial', 0))} at t = 0"
        rows["time"] = f"{words}; {rate} on the left; {start}"
    if "exact.u" in said:
        rows["exact.u"] = _short(said["exact.u"])
    helpers = [key.removeprefix("define.") for key in said if key.startswith("define.")]
    if helpers:
        rows["where"] = ", ".join(f"{name} = {_short(said[f'define.{name}'])}" for name in helpers)
    return rows


def folded(rows: Mapping[str, str]) -> str:
    """Fold a statement for the screen, two lines at most for each part of it."""
    return "\n".join(
        textwrap.fill(
            text,
            WIDTH,
            initial_indent=f"{name} ".ljust(INDENT),
            subsequent_indent=" " * INDENT,
            break_on_hyphens=False,
            max_lines=2,
            placeholder=" …",
        )
        for name, text in rows.items()
    )


def _extent(domain: Domain) -> str:
    """Say how many cells there are, and where; collective."""
    mesh = domain.mesh
    low, high = (end[: mesh.geometry.dim] for end in bounding_box(mesh))
    extent = " × ".join(f"[{a:.6g}, {b:.6g}]" for a, b in zip(low, high, strict=True))
    number = mesh.topology.index_map(mesh.topology.dim).size_global
    return f"{counted(number, 'cell')} in {extent}"


def _equation(
    said: Mapping[str, Any], own: Collection[str], kappa: str, of_all: Collection[str]
) -> str:
    """Say what holds in the domain.

    Args:
        said: What the file says.
        own: The data that materials have of their own.
        kappa: What stands before ∂ₙu.
        of_all: Those of them that all cells have from their materials.
    """
    gain = " + c u" if "reaction" in own else ""
    reaction = said.get("data.reaction", 0)
    if reaction not in (0, "0") and "reaction" not in of_all:
        gain = f" + {as_factor(_short(reaction), 'u')}"
    load = _short(said.get("data.f", "f from exact.u" if "exact.u" in said else "0"))
    parts = [f"{'−∇·(κ∇u)' if kappa else '−Δu'}{gain} = {'f' if 'f' in of_all else load}"]
    if kappa and "coefficient" not in of_all:
        parts.append(f"κ = {_short(said.get('data.coefficient', 1))}")
    if of_all:
        *first, last = (sign for key, sign in _SIGNS.items() if key in of_all)
        parts.append(f"{', '.join(first)}{' and ' if first else ''}{last} by material")
    return ", ".join(parts)


def _of_all_cells(materials: Mapping[str, Mapping[str, Any]], domain: Domain) -> set[str]:
    """Find which of κ, f and c all cells have from their materials; collective."""
    mesh = domain.mesh
    missed = {}
    for key in ("coefficient", "f", "reaction"):
        without = np.ones(mesh.topology.index_map(mesh.topology.dim).size_local, dtype=bool)
        for name, material in materials.items():
            if key in material:
                without &= ~domain.materials.where(name)[: len(without)]
        missed[key] = mesh.comm.allreduce(np.count_nonzero(without))
    return {key for key, number in missed.items() if number == 0}


def _cells(domain: Domain, material: str) -> int:
    """Count the cells of a material, over all ranks; collective."""
    topology = domain.mesh.topology
    there = domain.materials.where(material)[: topology.index_map(topology.dim).size_local]
    return int(domain.mesh.comm.allreduce(np.count_nonzero(there)))


def _facets(domain: Domain, part: str) -> str:
    """Say how many facets a part has, and its size; "" where there are none; collective."""
    mesh = domain.mesh
    measures = facet_measures(mesh, domain.facets(domain.parts[part]))[1]
    number = mesh.comm.allreduce(len(measures))
    if not number:
        return ""
    total = mesh.comm.allreduce(float(measures.sum()))
    size = "length" if mesh.geometry.dim == 2 else "area"
    return f"{counted(number, 'facet')}, {size} {total:.6g}"


def _conditions(said: Mapping[str, Any]) -> dict[str, tuple[type[Condition], dict[str, Any]]]:
    """Find the kind of condition on each part, and what was written for its data, by name."""
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
    """Put on one line what was written."""
    text = " ".join(str(value).split())
    if isinstance(value, list):
        text = text.replace("'", "")
    return text if len(text) <= LONGEST else text[: LONGEST - 1] + "…"
