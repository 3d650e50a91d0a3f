"""Problem files: TOML → domain, problem and refinement, with every key checked.

Each mistake is an :class:`~signorini_cr.errors.InputError` that names the key, what was found and
what is allowed, the same on all ranks; the command puts the file's name before it.
"""

from __future__ import annotations

import math
import os
import re
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
import ufl
from mpi4py import MPI
from ufl.algorithms.analysis import extract_constants

from ..adaptive import solve_adaptive
from ..arrays import FloatArray
from ..data.admissible import check_boundary, check_data, check_operator
from ..data.consistency import doubts
from ..diffusion import Diffusion
from ..errors import InputError, NotConverged, naming, on_root
from ..evolution import SCHEMES, solve_in_time
from ..fem.problem import Forms, Material, Problem
from ..hints import guess
from ..levels import check_pieces, solve_levels
from ..means import BOTH, DOMAIN
from ..mesh.balance import Refined
from ..mesh.domain import PARTS, Domain, Polygon, read_gmsh
from ..mesh.polygon import check_loops, coordinates, cut
from ..output.units import Units
from ..quantities import KINDS as QUANTITIES
from ..quantities import Quantity
from ..rounding import counted
from ..solution import Solution
from .datacheck import Datum, check_values
from .expressions import check_name, parse
from .formula import Clock, Expression, Node
from .readers import (
    HUGE,
    array,
    get,
    insist_known,
    insist_on_name,
    number,
    one_of,
    parse_toml,
    positive,
    read_text,
    shown,
    string,
    title,
    whole,
    word,
)
from .reference import (
    ADAPTIVE,
    ENDS,
    EXPRESSIONS,
    KINDS,
    MATERIAL,
    PART,
    QUANTITY,
    SECTIONS,
    TENSOR,
    TYPES,
    allowed,
)

KEYS_IN = {section: allowed(section) for section in SECTIONS if allowed(section)}
MODES = ("uniform", "adaptive")
TELLING = ("units", "names")
"""Sections that levels, and what is told of them, do not depend on."""
UNLIMITED = 1000
"""Levels of an adaptive run that names no limit: others end it."""
SIMPLE = "the polygon must be simple, its edges must meet at their common vertices only"
MOST_STEPS = 100_000
"""Of a run in time."""
MOST_CELLS = 1e9
"""More than anyone means for the last mesh of a uniform sequence."""


@dataclass(frozen=True, eq=False)
class Time:
    """Contents of the section [time].

    Attributes:
        end: The last time.
        steps: How many steps there are.
        scheme: "euler" or "bdf2".
        initial: u at the time 0.
        capacity: What multiplies ∂u/∂t.
        clock: The time that expressions hold.
    """

    end: float
    steps: int
    scheme: str
    initial: Any
    capacity: float
    clock: Clock

    def check(self, forms: Forms, domain: Domain, deadline: float | None = None) -> None:
        """Try out at all times what depends on them of a_h, u_D and bounds; collective.

        Args:
            forms: The problem on the mesh.
            domain: The mesh.
            deadline: When there is no time left, by `time.perf_counter`; None if there is any.

        Raises:
            InputError: The data of a step make no sense.
            NotConverged: There is no time left.
        """
        losses = [c.loss for c in forms.conditions if c.loss is not None]
        checks = [
            check
            for check, data in (
                (check_operator, (forms.kappa, forms.reaction, *losses)),
                (check_boundary, forms.holding),
            )
            if any(map(extract_constants, data))
        ]
        if not checks:
            return
        start = self.clock.value
        for step in range(1, self.steps + 1):
            self.clock.value = self.end * step / self.steps
            if deadline is not None:
                over = domain.mesh.comm.allreduce(perf_counter() > deadline, op=MPI.LOR)
                if over:
                    self.clock.value = start
                    raise NotConverged(
                        f"the time limit is over, and the data are looked at up to step {step - 1}"
                        f" of {self.steps}"
                    )
            try:
                for check in checks:
                    check(forms, domain)
            except InputError as error:
                raise InputError(f"{error}, at the time {self.clock.value:g}") from None
        self.clock.value = start


@dataclass(frozen=True, eq=False)
class ProblemFile:
    """Contents of a problem file.

    Attributes:
        title: For reports and pictures; the file's name where there is none.
        domain: A polygon, or the path of a gmsh file.
        size: Facet length wanted on the coarsest mesh of a polygon.
        parts: The parts of the boundary that have sections.
        materials: The materials.
        problem: The data as functions of x, which give UFL.
        expressions: The data that were written in the file, by where they stand.
        mode: "uniform" or "adaptive".
        levels: Number of meshes, the coarsest included.
        adaptive: What adaptive refinement goes by: arguments of `solve_adaptive` by name.
        quantities: What is asked for in an interval, by name.
        time: What [time] says; None for a problem without time.
        units: What [units] and [names] say.
        said: All that levels depend on, by key, as it was written.
        source: The text of the file.
    """

    title: str
    domain: Polygon | Path
    size: float | None
    parts: tuple[str, ...]
    materials: tuple[str, ...]
    problem: Problem
    expressions: Mapping[Datum, Expression]
    mode: str
    levels: int
    adaptive: Mapping[str, Any]
    quantities: Mapping[str, Quantity]
    time: Time | None
    units: Units
    said: Mapping[str, Any]
    source: str

    def mesh(self, comm: MPI.Comm = MPI.COMM_WORLD) -> Domain:
        """Make or read the coarsest mesh; collective."""
        key = "domain.mesh" if isinstance(self.domain, Path) else "domain"
        with naming(key):
            if isinstance(self.domain, Path):
                return read_gmsh(self.domain, comm, self.parts, self.materials)
            assert self.size is not None
            return self.domain.mesh(self.size, comm)

    def check(self, domain: Domain, deadline: float | None = None) -> list[str]:
        """Try the data out on the coarsest mesh; collective.

        Args:
            domain: From :meth:`mesh`.
            deadline: As for `Time.check`.

        Returns:
            What contradicts itself in data that can be solved with, a sentence each.

        Raises:
            InputError: An expression is not finite where it is needed, the coefficient is not
                positive, u_D jumps, the obstacle lies above u_D where Γ0 meets Γ1, nothing holds a
                piece of the domain, a quantity's part has no facet, or the last mesh of the
                sequence would be absurdly large.
            NotConverged: There is no time left.
        """
        topology = domain.mesh.topology
        cells = topology.index_map(topology.dim).size_global
        if self.mode == "uniform":
            _few_enough(self.levels, cells, topology.dim)
        self._insist_on_places(domain)
        weights = {name: quantity.place for name, quantity in self.quantities.items()}
        first = None
        if self.time is not None:  # no step looks at what the data are at the time 0
            first = self.time.clock.value = self.time.end / self.time.steps
        check_values(self.expressions, domain, weights, first)
        forms = Diffusion(self.problem, domain.mesh, "CR", domain.parts, domain.materials)
        there = sum(len(domain.facets(condition.number)) for condition in forms.bounded)
        if not domain.mesh.comm.allreduce(there):
            raise InputError("domain: no part of the boundary is contact; at least one is needed")
        if self.time is not None:
            self.time.check(forms, domain, deadline)
        check_data(forms, domain)
        if self.time is None:
            check_pieces(forms, domain)  # capacity would hold all
        return [*self._of_no_material(domain), *self._of_no_time(), *doubts(forms, domain)]

    def _insist_on_places(self, domain: Domain) -> None:
        """Refuse quantities of parts that no facet is in; collective."""
        there = [
            name
            for name, part in domain.parts.items()
            if domain.mesh.comm.allreduce(len(domain.facets(part)))
        ]
        for name, what in self.quantities.items():
            if what.place in domain.parts and what.place not in there:
                raise InputError(
                    f"quantities.{name}.{what.kind}: no facet is {what.place}; the boundary has"
                    f" {', '.join(there)}"
                )

    def _of_no_time(self) -> list[str]:
        """Say which capacities do nothing, for nothing changes in time."""
        if self.time is not None:
            return []
        return [
            f"material.{name}.capacity: it does nothing without a section [time]"
            for name, material in self.problem.materials.items()
            if material.capacity is not None
        ]

    @staticmethod
    def _of_no_material(domain: Domain) -> list[str]:
        """Say which physical surfaces of a mesh file have no section, where others have."""
        return [
            f"the physical surface {name} has no section [material.{name}]: all its data are those"
            " of [data]"
            for name in domain.materials.others
        ]

    def steps(
        self, domain: Domain, levels: int | Sequence[Refined], **arguments: Any
    ) -> Iterator[tuple[float, Solution]]:
        """Solve step by step what has a [time]; collective.

        Args:
            domain: From :meth:`mesh`.
            levels: As for `solve_in_time`.
            **arguments: What `solve_in_time` takes beside what the file says.
        """
        time = self.time
        assert time is not None
        return solve_in_time(
            self.problem,
            domain,
            end=time.end,
            steps=time.steps,
            scheme=time.scheme,
            initial=time.initial,
            capacity=time.capacity,
            levels=levels,
            time=time.clock,
            **arguments,
        )

    def solutions(self, domain: Domain, **arguments: Any) -> Iterator[Solution]:
        """Solve on the meshes that the file asks for; collective.

        Args:
            domain: From :meth:`mesh`.
            **arguments: What `solve_levels` and `solve_adaptive` take beside what the file says.
        """
        if self.mode == "uniform":
            return solve_levels(self.problem, domain, self.levels, **arguments)
        return solve_adaptive(
            self.problem, domain, levels=self.levels, **self.adaptive, **arguments
        )


def load(path: str | os.PathLike[str], comm: MPI.Comm = MPI.COMM_WORLD) -> ProblemFile:
    """Read a problem file on rank 0 and check it on every rank; collective.

    Args:
        path: The TOML file.
        comm: The ranks that take part.

    Raises:
        InputError: The file cannot be read or says something that is not allowed.
    """
    path = Path(path)
    source = on_root(comm, read_text, path)
    table = parse_toml(source)
    insist_known(table, "", (*allowed(""), *SECTIONS), KEYS_IN)
    heading = get(table, "", "title", title, path.stem)
    parts, materials = _parts(table), _materials(table)
    sections = {name: _section(table, name) for name in SECTIONS}
    if "domain" not in table:
        raise InputError(f"the section [domain] is missing; {_SECTIONS_NEEDED}")
    if not {"data", "exact", "boundary"} & set(table):
        raise InputError(f"the section [data] is missing; {_SECTIONS_NEEDED}")
    if "exact" in table and not table["exact"]:
        raise InputError("exact.u: this key is missing; an expression in x and y is needed")
    domain, size = _domain(sections["domain"], path.parent, tuple(parts), materials)
    clock = Clock() if "time" in table else None
    quantities = _quantities(sections["quantities"], parts, materials)
    expressions = _expressions(sections, parts, materials, clock)
    for name, quantity in quantities.items():
        if (weight := expressions.get(Datum("quantities", name, "weight"))) is not None:
            quantities[name] = quantity._replace(weight=_data(weight))
    refine = sections["refine"]
    mode = get(refine, "refine", "mode", one_of(MODES), "uniform")
    adaptive = {name: get(refine, "refine", name, *how) for name, how in ADAPTIVE.items()}
    for key in adaptive:
        if mode == "uniform" and refine.get(key):
            what = "where adaptive refinement ends" if f"refine.{key}" in ENDS else "for adaptive"
            raise InputError(
                f"refine.{key}: {shown(adaptive[key])} is {what};"
                ' mode = "adaptive" is needed beside it'
            )
    return ProblemFile(
        title=heading,
        domain=domain,
        size=size,
        parts=tuple(parts),
        materials=tuple(materials),
        problem=_problem(expressions, parts, materials),
        expressions=expressions,
        mode=mode,
        levels=get(refine, "refine", "levels", whole, 1 if mode == "uniform" else UNLIMITED),
        adaptive=adaptive,
        time=None if clock is None else _time(sections, expressions, clock),
        quantities=quantities,
        units=Units(**_words(sections, "units"), names=_words(sections, "names")),
        said={
            f"{name}.{key}": value
            for name, section in sections.items()
            for key, value in section.items()
            if f"{name}.{key}" not in ENDS and name not in TELLING
        },
        source=source,
    )


def _parts(table: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """Read the sections [boundary.NAME], each checked for its type's keys."""
    parts = table.get("boundary", {})
    if not isinstance(parts, dict) or not all(isinstance(part, dict) for part in parts.values()):
        raise InputError(f"boundary: sections [{PART}] are needed, found {shown(parts)}")
    for name, part in parts.items():
        section = f"boundary.{name}"
        insist_on_name("boundary", name)
        insist_known(part, section, allowed(PART), KEYS_IN)
        needed = f"one of {', '.join(TYPES)}"
        kind = get(part, section, "type", one_of(tuple(TYPES)), needed=needed)
        for key in part:
            if key not in ("type", *TYPES[kind]):
                raise InputError(
                    f"{section}.{key}: this does not go with the type {kind}; allowed are"
                    f" {', '.join(TYPES[kind])}"
                )
    return parts


def _materials(table: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """Read the sections [material.NAME], each checked for its keys."""
    found = table.get("material", {})
    if not isinstance(found, dict) or not all(isinstance(each, dict) for each in found.values()):
        raise InputError(f"material: sections [{MATERIAL}] are needed, found {shown(found)}")
    for name, material in found.items():
        insist_on_name("material", name)
        insist_known(material, f"material.{name}", allowed(MATERIAL), KEYS_IN)
    return found


def _quantities(
    table: Mapping[str, Any], parts: Mapping[str, Mapping[str, Any]], materials: Collection[str]
) -> dict[str, Quantity]:
    """Read [quantities]: each a kind, a place of a type that goes with it; yet without weights."""
    types = {name: name for name in PARTS} | {name: part["type"] for name, part in parts.items()}
    found: dict[str, Quantity] = {}
    for name, value in table.items():
        key = f"quantities.{name}"
        insist_on_name("quantities", name)
        kinds = [kind for kind in QUANTITIES if isinstance(value, dict) and kind in value]
        if isinstance(value, dict):
            insist_known(value, key, allowed(QUANTITY))
        if len(kinds) > 1:
            raise InputError(
                f"{key}: one of {', '.join(QUANTITIES)} is to be given, found {' and '.join(kinds)}"
            )
        if not kinds:
            *first, last = (
                f'{{ {kind} = "{"PLACE" if each.of_u else "PART"}" }}'
                for kind, each in QUANTITIES.items()
            )
            raise InputError(
                f"{key}: {', '.join(first)} or {last}, perhaps with a weight, is needed, found"
                f" {shown(value)}"
            )
        kind, of_u = kinds[0], QUANTITIES[kinds[0]].of_u
        own = [each for each, what in types.items() if KINDS[what] in QUANTITIES[kind].parts]
        if of_u:
            own += [*materials, DOMAIN]
        place = one_of(own)(f"{key}.{kind}", value[kind])
        if of_u and place in types and place in materials:
            raise InputError(f"{key}.{kind}: {place} {BOTH}")
        # own ends with all of the domain, unless something else is called so
        found[name] = Quantity(kind, None if of_u and own.index(place) == len(own) - 1 else place)
    return found


def _words(sections: Mapping[str, Mapping[str, Any]], name: str) -> dict[str, str]:
    """Read [units] or [names]: words by key."""
    return {key: word(f"{name}.{key}", value) for key, value in sections[name].items()}


_SECTIONS_NEEDED = (
    "[domain] and [data], [exact] or [boundary.NAME] are needed, the others are optional"
)


def _section(table: Mapping[str, Any], name: str) -> dict[str, Any]:
    section = table.get(name, {})
    if not isinstance(section, dict):
        raise InputError(f"{name}: a section [{name}] is needed, found {shown(section)}")
    if name in KEYS_IN:
        insist_known(section, name, KEYS_IN[name], KEYS_IN)
    return section


def _domain(
    table: Mapping[str, Any],
    folder: Path,
    names: tuple[str, ...],
    materials: Mapping[str, Mapping[str, Any]],
) -> tuple[Polygon | Path, float | None]:
    """Read [domain]: the polygon and its size, or the path of the mesh.

    Args:
        table: The section.
        folder: Where paths begin.
        names: The parts of the boundary that have sections.
        materials: The sections of the materials.
    """
    if "mesh" in table:
        others = [key for key in allowed("domain") if key != "mesh" and key in table]
        if others:
            raise InputError(
                f"domain: both mesh and {others[0]} are given; either a mesh file or a polygon"
                " (vertices, boundary, size) is allowed"
            )
        for name, material in materials.items():
            if "polygon" in material:
                raise InputError(
                    f"material.{name}.polygon: with a mesh file a physical surface named {name} is"
                    " needed instead"
                )
        return folder / get(table, "domain", "mesh", string), None
    if "vertices" not in table:
        raise InputError(
            "domain: neither vertices nor mesh is given; a polygon (vertices, boundary, size) or"
            " a mesh file is needed"
        )
    size = get(table, "domain", "size", positive, needed="a number above 0, the length of a facet,")
    polygon = _polygon(table, "domain", names, size)
    polygons = {name: _outline(name, material) for name, material in materials.items()}
    given = enumerate(array("domain.holes", table.get("holes", [])))
    holes = [_hole(f"domain.holes[{i}]", hole, names, size) for i, hole in given]
    if holes or polygons:
        with naming("domain.holes", "holes must lie inside the polygon and apart from each other"):
            polygon = replace(polygon, holes=tuple(holes))
        polygon = replace(polygon, materials=polygons)
    labels = {label for each in (polygon, *polygon.holes) for label in each.boundary}
    for name in names:
        if name not in labels:
            hint = guess(name, labels)
            raise InputError(f"boundary.{name}: no edge is labelled {name}{hint and f'; {hint}'}")
    with naming("domain.boundary"):
        polygon.check_parts()
    # From the longest edge on, facets grow inside only; none is longer than the diameter
    if size > polygon.diameter * (1 + 1e-9):
        raise InputError(
            f"domain.size: {size:g} is longer than the domain, whose diameter is"
            f" {polygon.diameter:.6g}; the length of a facet is needed, no more than that"
        )
    return polygon, size


def _outline(name: str, material: Mapping[str, Any]) -> FloatArray:
    """Read where a material is: the vertices of its polygon."""
    section, key = f"material.{name}", f"material.{name}.polygon"
    given = get(material, section, "polygon", array, needed="a list of points [x, y]")
    points = _points(key, given)
    with naming(key, SIMPLE):
        check_loops([coordinates(points)])
    return points


def _hole(key: str, hole: Any, names: tuple[str, ...], size: float) -> Polygon:
    """Read a polygon in the domain, or a circle."""
    if not isinstance(hole, dict):
        raise InputError(
            f"{key}: {{ vertices = [...], boundary = [...] }} or {{ center = [...], radius ="
            f" ..., boundary = ... }} is needed, found {shown(hole)}"
        )
    round_keys = ("center", "radius", "boundary")
    insist_known(hole, key, ("vertices", "arcs", *round_keys))
    if "center" not in hole and "radius" not in hole:
        return _polygon(hole, key, names, size)
    insist_known(hole, key, round_keys)
    return _circle(hole, key, names, size)


def _polygon(
    table: Mapping[str, Any], section: str, names: tuple[str, ...], size: float
) -> Polygon:
    key = f"{section}.vertices"
    vertices = get(table, section, "vertices", array, needed="a list of points [x, y]")
    points = _points(key, vertices, 2 if table.get("arcs") else 3)
    boundary = get(table, section, "boundary", array, needed="a list of labels, one for each edge,")
    for i, label in enumerate(boundary):
        _label(names)(f"{section}.boundary[{i}]", label)
    if len(boundary) != len(vertices):
        raise InputError(
            f"{section}.boundary: one label for each edge is needed: {len(vertices)} edges,"
            f" found {counted(len(boundary), 'label')}"
        )
    arcs = _arcs(f"{section}.arcs", array(f"{section}.arcs", table.get("arcs", [])))
    with naming(key):
        points = coordinates(points, 2)
    with naming(f"{section}.arcs"):
        points, labels, edges = cut(points, boundary, arcs, size)
    with naming(key, SIMPLE):
        return Polygon(points, labels, names=names, edges=edges)


def _arcs(key: str, arcs: list[Any]) -> dict[int, list[float]]:
    """Read the points that arcs pass through, by edge."""
    found: dict[int, list[float]] = {}
    for i, arc in enumerate(arcs):
        where = f"{key}[{i}]"
        if not isinstance(arc, dict) or {"edge", "through"} - arc.keys():
            raise InputError(
                f"{where}: {{ edge = i, through = [x, y] }} is needed, found {shown(arc)}"
            )
        insist_known(arc, where, ("edge", "through"))
        edge = arc["edge"]
        known = isinstance(edge, int) and not isinstance(edge, bool) and 0 <= edge < HUGE
        if not known or edge in found:
            raise InputError(
                f"{where}.edge: the number of an edge, from 0, that is no arc yet is needed, found"
                f" {shown(edge)}"
            )
        found[edge] = _pair(f"{where}.through", arc["through"])
    return found


def _circle(table: Mapping[str, Any], section: str, names: tuple[str, ...], size: float) -> Polygon:
    """Read a round hole."""
    center = get(table, section, "center", _pair, needed="a point [x, y]")
    radius = get(table, section, "radius", positive, needed="a number above 0")
    part = get(table, section, "boundary", _label(names), needed="one label")
    with naming(section):
        return Polygon.circle(center, radius, part, size, names=names)


def _label(names: tuple[str, ...]) -> Callable[[str, Any], str]:
    """Make a reader of labels of edges."""

    def more(found: str) -> str:
        plain = re.fullmatch(r"[A-Za-z0-9_-]+", found)
        return f", or a name with a section [boundary.{found}]" if plain else ""

    return one_of((*PARTS, *(name for name in names if name not in PARTS)), more)


def _points(key: str, vertices: list[Any], least: int = 3) -> FloatArray:
    """Read the vertices of a polygon, shape (n, 2)."""
    for i, vertex in enumerate(vertices):
        _pair(f"{key}[{i}]", vertex)
    if len(vertices) < least:
        raise InputError(f"{key}: at least {least} vertices are needed, found {len(vertices)}")
    return np.array(vertices, dtype=np.float64)


def _pair(key: str, point: Any) -> list[float]:
    """Insist on a point."""
    if not isinstance(point, list) or len(point) != 2:
        raise InputError(f"{key}: a point [x, y] is needed, found {shown(point)}")
    return [number(f"{key}[{j}]", coordinate) for j, coordinate in enumerate(point)]


def _few_enough(levels: int, cells: int, dim: int) -> None:
    most = 1 + int(math.log2(max(MOST_CELLS / cells, 1.0)) / dim)
    if levels > most:
        raise InputError(
            f"refine.levels (or --levels): {levels} meshes would end with far too many cells; from"
            f" the {cells} of the coarsest mesh on, at most {most} are allowed"
        )


def _expressions(
    sections: Mapping[str, Mapping[str, Any]],
    parts: Mapping[str, Mapping[str, Any]],
    materials: Mapping[str, Mapping[str, Any]],
    clock: Clock | None,
) -> dict[Datum, Expression]:
    """Read [define] and what may be an expression in other sections."""
    names: dict[str, Expression] = {}
    define = sections["define"]
    written: dict[str, str] = {}  # by what the parser sees
    for name in define:
        with naming(f"define.{name}"):
            if (seen := check_name(name)) in written:
                raise InputError(f"this is the name {written[seen]!r} once more, in other letters")
            if clock is not None and seen == "t":
                raise InputError("t is the time, as there is a section [time]")
        written[seen] = name
    if clock is not None:
        names["t"] = Expression("t", Node("clock", (clock,)))
    for seen, name in written.items():
        names[seen] = _expression(f"define.{name}", define[name], names, written)
    tables: list[tuple[str, str | None, Mapping[str, Any]]] = [
        *((name, None, sections[name]) for name in ("data", "exact")),
        *(("boundary", name, table) for name, table in parts.items()),
        *(("material", name, table) for name, table in materials.items()),
        ("time", None, sections["time"]),
        *(("quantities", name, each) for name, each in sections["quantities"].items()),
    ]
    result = {}
    for section, own, table in tables:
        like = section if own is None else f"{section}.NAME"
        for key, value in table.items():
            if f"{like}.{key}" not in EXPRESSIONS:
                continue
            for datum, given in _by_entries(Datum(section, own, key), value).items():
                expression = _expression(str(datum), given, names, ())
                if expression.is_condition:
                    raise InputError(f"{datum}: a number is needed, but this is a condition")
                result[datum] = expression
    return result


def _by_entries(datum: Datum, value: Any) -> dict[Datum, Any]:
    """Part a tensor into its entries, as ``data.coefficient[0][1]``; keep all else."""
    if not (isinstance(value, list) and datum.told.value == TENSOR):
        return {datum: value}
    if len(value) != 2 or not all(isinstance(row, list) and len(row) == 2 for row in value):
        raise InputError(
            f"{datum}: an expression, or a tensor [[xx, xy], [xy, yy]] of expressions, is needed,"
            f" found {shown(value)}"
        )
    return {datum._replace(entry=(i, j)): value[i][j] for i, j in ENTRIES}


def _time(
    sections: Mapping[str, Mapping[str, Any]],
    expressions: Mapping[Datum, Expression],
    clock: Clock,
) -> Time:
    """Read [time], and what goes with it."""
    table = sections["time"]
    if Datum("exact", None, "u") in expressions:
        raise InputError("exact.u: a problem in time has none")
    initial = expressions.get(Datum("time", None, "initial"))
    if initial is not None and initial.depends_on_time:
        raise InputError("time.initial: this must not depend on t")
    end = get(table, "time", "end", positive, needed="a number above 0, the last time,")
    steps = _steps(get(table, "time", "steps", whole, needed="a whole number, of steps,"))
    if not math.isfinite(steps / end):
        raise InputError(f"time.end: {end:g} is too little for numbers to tell steps apart")
    if not math.isfinite(end * steps):
        raise InputError(f"time.end: {end:g} is too much for numbers to tell the time of a step")
    return Time(
        end=end,
        steps=steps,
        scheme=get(table, "time", "scheme", one_of(SCHEMES), "euler"),
        initial=0.0 if initial is None else _data(initial),
        capacity=get(table, "time", "capacity", _capacity, 1.0),
        clock=clock,
    )


def _steps(number: int) -> int:
    """Insist on a number of steps that a folder has room for."""
    if number > MOST_STEPS:
        raise InputError(
            f"time.steps: {shown(number)} is too many, as each step leaves a file behind; up to"
            f" {MOST_STEPS} are allowed"
        )
    return number


def _capacity(key: str, value: Any) -> float:
    """Read a number above 0, which may be written as an expression."""
    found = _expression(key, value, {}, ()).constant
    if not isinstance(found, float) or found <= 0.0:
        raise InputError(f"{key}: a number above 0 is needed, found {shown(value)}")
    return found


def _own_capacity(name: str, material: Mapping[str, Any]) -> float | None:
    """Read the capacity of a material, if it has one."""
    if "capacity" not in material:
        return None
    return _capacity(f"material.{name}.capacity", material["capacity"])


def _data(expression: Expression) -> Any:
    """Return an expression as `Problem` takes it."""
    return expression.ufl if expression.constant is None else expression.constant


ENTRIES = ((0, 0), (0, 1), (1, 0), (1, 1))


def _tensor(entries: Sequence[Expression]) -> Any:
    """Return four expressions as `Problem` takes them."""

    def tensor(x: Any) -> Any:
        xx, xy, yx, yy = (entry.ufl(x) for entry in entries)
        return ufl.as_matrix([[xx, xy], [yx, yy]])

    return tensor


def _expression(
    key: str, value: Any, names: Mapping[str, Expression], later: Collection[str]
) -> Expression:
    if isinstance(value, str):
        with naming(key):
            return parse(value, names, later)
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise InputError(
            f"{key}: an expression (a string) or a number is needed, found {shown(value)}"
        )
    return parse(repr(number(key, value)))


def _problem(
    expressions: Mapping[Datum, Expression],
    parts: Mapping[str, Mapping[str, Any]],
    materials: Mapping[str, Mapping[str, Any]],
) -> Problem:
    def own(section: str, name: str | None = None) -> dict[str, Any]:
        """Take the data of a section, by key."""
        found: dict[str, Any] = {}
        for datum, expression in expressions.items():
            if datum[:2] != (section, name):
                continue
            if not datum.entry:
                found[datum.key] = _data(expression)
            elif datum.entry == ENTRIES[-1]:
                entries = [expressions[datum._replace(entry=each)] for each in ENTRIES]
                found[datum.key] = _tensor(entries)
        return found

    return Problem(
        **own("data"),
        exact=own("exact").get("u"),
        conditions={
            name: KINDS[part["type"]](**own("boundary", name)) for name, part in parts.items()
        },
        materials={
            name: Material(**own("material", name), capacity=_own_capacity(name, material))
            for name, material in materials.items()
        },
    )
