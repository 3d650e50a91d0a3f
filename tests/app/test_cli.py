"""The command: what it prints, writes and returns, and one clear message for each mistake."""

import contextlib
import io
import json
import os
import re
import subprocess
import sys
import time
import tomllib
from collections.abc import Callable
from pathlib import Path

import helpers
import numpy as np
import pytest
from mpi4py import MPI

from signorini_cr.app import cli, commandline, problemfile, readers
from signorini_cr.app.screen import wrapped
from signorini_cr.app.statement import folded
from signorini_cr.errors import NotConverged
from signorini_cr.mesh import mshfile

pytestmark = pytest.mark.slow

COMM = MPI.COMM_WORLD
LINE = 'boundary = ["contact", "dirichlet", "dirichlet", "dirichlet"]'
CASE = f"""title = "S1"
[domain]
vertices = [[-1, 0], [1, 0], [1, 1], [-1, 1]]
{LINE}
size = 0.5
[define]
r = "sqrt(x**2 + y**2)"
[data]
f = "1 + r"
obstacle = 0
[refine]
mode = "uniform"
levels = 2
tolerance = 0
"""
NEUMANN = '["neumann", "neumann", "neumann"]'
HOLE = f"holes = [{{ vertices = [[3, 3], [4, 3], [4, 4]], boundary = {NEUMANN} }}]"
FLAT_HOLE = f"holes = [{{ vertices = [[0, 0.4], [0.1, 0.4]], boundary = {NEUMANN} }}]"


def with_(old: str, new: str) -> str:
    assert old in CASE
    return CASE.replace(old, new)


def without(section: str) -> str:
    parts = CASE.split("\n[")
    assert any(part.startswith(section) for part in parts)
    return "\n[".join(part for part in parts if not part.startswith(section))


def mesh_case(name: str) -> str:
    return f'domain.mesh = "{name}"\n[data]\nf = 1\n'


def part_case(section: str, more: str = 'type = "contact"') -> str:
    """CASE with its first edge labelled, and a section."""
    text = CASE.replace('["contact"', '["deck"', 1)
    return f"{text}\n[boundary.{section}]\n{more}\n"


SOIL = "polygon = [[-1, 0], [1, 0], [1, 0.5], [-1, 0.5]]"


def material_case(more: str, section: str = "[material.soil]") -> str:
    return f"{CASE}\n{section}\n{more}\n"


# name: (text of the file, what the message must hold)
BAD: dict[str, tuple[str, list[str]]] = {
    "unknown section": (
        with_("[refine]", "[refin]"),
        ["refin: there is no such section", "did you mean refine?"],
    ),
    "unknown key": (
        with_("levels", "level"),
        [
            "refine.level:",
            "did you mean levels? Allowed are mode, levels, tolerance, max_dofs, fraction",
        ],
    ),
    "key in the wrong section": (
        with_("[refine]", "[refine]\nobstacle = 1"),
        ["refine.obstacle:", "it belongs under [data]"],
    ),
    "section missing": (without("domain"), ["the section [domain] is missing"]),
    "no data": (without("data"), ["the section [data] is missing"]),
    "section of the wrong kind": ("domain = 3\n[data]\n", ["domain:", "section", "found 3"]),
    "key missing": (
        with_("size = 0.5\n", ""),
        ["domain.size: this key is missing; a number above 0, the length"],
    ),
    "empty exact": (CASE + "[exact]\n", ["exact.u: this key is missing; an expression"]),
    "levels a string": (with_("levels = 2", 'levels = "2"'), ["refine.levels:", 'string "2"']),
    "levels true": (with_("levels = 2", "levels = true"), ["refine.levels:", "found true"]),
    "levels 2.0": (with_("levels = 2", "levels = 2.0"), ["refine.levels:", "whole", "found 2.0"]),
    "levels 0": (with_("levels = 2", "levels = 0"), ["refine.levels: 1 or more", "found 0"]),
    "levels too many": (
        with_("levels = 2", "levels = 99"),
        ["refine.levels (or --levels): 99", "at most 13"],
    ),
    "unit of what is none": (CASE + '[units]\ny = "m"', ["units.y: there is no such key; it belo"]),
    "unit that is a number": (CASE + "[units]\nx = 3", ["units.x: a string is needed, found 3"]),
    "unit of two lines": (
        CASE + '[units]\nx = "m\\nm"',
        ["units.x: 1 to 40 characters on one line are needed"],
    ),
    "empty name": (CASE + '[names]\nu = " "', ["names.u: 1 to 40 characters on one line"]),
    "tolerance negative": (
        with_("tolerance = 0", "tolerance = -1e-3"),
        ["refine.tolerance: 0 or more is needed, found -0.001"],
    ),
    "tolerance of a uniform sequence": (
        with_("tolerance = 0", "tolerance = 0.25"),
        ["refine.tolerance: 0.25 is where adaptive", 'mode = "adaptive" is needed'],
    ),
    "max_dofs of a uniform sequence": (
        with_("tolerance = 0", "max_dofs = 1234567"),
        ["refine.max_dofs: 1234567 is where", 'mode = "adaptive" is needed'],
    ),
    "part without a type": (
        part_case("deck", "g = 0"),
        ["boundary.deck.type: this key is missing; one of contact, dirichlet, neumann, robin"],
    ),
    "part of an unknown type": (
        part_case("deck", 'type = "contakt"'),
        ["boundary.deck.type:", "did you mean contact?"],
    ),
    "key of another type": (
        part_case("deck", 'type = "contact"\nvalue = 3'),
        ["boundary.deck.value: this does not go with the type contact; allowed are obstacle"],
    ),
    "unknown key of a part": (
        part_case("deck", 'type = "contact"\nobstakle = 3'),
        ["boundary.deck.obstakle: there is no such key; did you mean obstacle?"],
    ),
    "label without a section": (
        CASE.replace('["contact"', '["deck"', 1),
        [
            *(
                "domain.boundary[0]:",
                '"deck" is unknown',
                "allowed are contact, dirichlet, neumann",
            ),
            "neumann, or a name with a section [boundary.deck]",
        ],
    ),
    "section without an edge": (
        part_case("desk"),
        ["domain.boundary[0]:", '"deck" is unknown; did you mean desk?'],
    ),
    "section for no edge": (
        part_case("deck") + '[boundary.roof]\ntype = "neumann"\n',
        ["boundary.roof: no edge is labelled roof"],
    ),
    "boundary no section": (
        "boundary = 3\n" + CASE,
        ["boundary: sections [boundary.NAME] are needed, found 3"],
    ),
    "no contact among the parts": (
        part_case("deck", 'type = "neumann"'),
        ["domain: no part of the boundary is contact; at least one is needed"],
    ),
    "coefficient of a part below 0": (
        part_case("deck", 'type = "contact"\ncoefficient = "x - 5"'),
        ["boundary.deck.coefficient: the value at", "must be 0 or more everywhere"],
    ),
    "material no section": (
        "material = 3\n" + CASE,
        ["material: sections [material.NAME] are needed, found 3"],
    ),
    "unknown key of a material": (
        material_case("kapa = 3"),
        ["material.soil.kapa: there is no such key; allowed are polygon, coefficient, f, reaction"],
    ),
    "material without a polygon": (
        material_case("f = 1"),
        ["material.soil.polygon: this key is missing; a list of points [x, y] is needed"],
    ),
    "polygon of a material not simple": (
        material_case("polygon = [[0, 0], [1, 1], [1, 0], [0, 1]]"),
        ["material.soil.polygon: edge 0 crosses edge 2; the polygon must be simple"],
    ),
    "polygon of a material no points": (
        material_case("polygon = [[0, 0], [1, 1], 3]"),
        ["material.soil.polygon[2]: a point [x, y] is needed, found 3"],
    ),
    "materials that overlap": (
        material_case(f"{SOIL}\n[material.sand]\npolygon = [[0, 0.2], [0.5, 0.2], [0.1, 0.9]]"),
        ["domain: the materials soil and sand overlap around ("],
    ),
    "material outside the domain": (
        material_case("polygon = [[2, 2], [3, 2], [3, 3]]"),
        ["domain: the material soil lies outside the domain"],
    ),
    "coefficient of a material 0": (
        material_case(f'{SOIL}\ncoefficient = "max(y - 0.2, 0)"'),
        [
            "material.soil.coefficient: the value at (-1, 0) is 0; the coefficient must be above 0 "
            "there"
        ],
    ),
    "data of a material not finite": (
        material_case(f'{SOIL}\nf = "1/y"'),
        ["material.soil.f: the value at", "in the domain"],
    ),
    "polygon beside a mesh file": (
        mesh_case("junk.msh") + f"[material.soil]\n{SOIL}\n",
        ["material.soil.polygon: with a mesh file a physical surface named soil is needed"],
    ),
    "reaction below 0": (
        with_("[refine]", "reaction = -1\n[refine]"),
        ["data.reaction: the value at", "the reaction must be 0 or more everywhere"],
    ),
    "data of a part not finite": (
        part_case("deck", 'type = "contact"\nobstacle = "1/y"'),
        ["boundary.deck.obstacle: the value at", "on the deck part"],
    ),
    "fraction of a uniform sequence": (
        with_("tolerance = 0", "fraction = 0.3"),
        ["refine.fraction: 0.3 is for adaptive", 'mode = "adaptive" is needed'],
    ),
    "fraction too large": (
        with_("tolerance = 0", "fraction = 30"),
        ["refine.fraction: 1 or less is needed, found 30"],
    ),
    "tolerance nan": (with_("tolerance = 0", "tolerance = nan"), ["tolerance:", "found nan"]),
    "mode": (
        with_('"uniform"', '"unifrom"'),
        ["refine.mode:", '"unifrom"', "did you mean uniform? Allowed are uniform, adaptive"],
    ),
    "max_dofs": (with_("levels = 2", "max_dofs = 0"), ["refine.max_dofs: 1 or more"]),
    "mean where u is set": (
        CASE + '[quantities]\nedge = { mean = "dirichlet" }\n',
        ["quantities.edge.mean", "allowed are contact, neumann, domain"],
    ),
    "mean over a part and a material of one name": (
        part_case("soil").replace('"deck"', '"soil"')
        + f'[material.soil]\n{SOIL}\n[quantities]\nwet = {{ mean = "soil" }}\n',
        ["quantities.wet.mean: soil is a part and a material: one of them needs another name"],
    ),
    "flux through a part that no facet is in": (
        part_case("deck").replace("dirichlet", "sides")
        + '[boundary.sides]\ntype = "dirichlet"\n[quantities]\nheat = { flux = "dirichlet" }\n',
        ["quantities.heat.flux: no facet is dirichlet; the boundary has deck, sides"],
    ),
    "mean over a part that no facet is in": (
        CASE + '[quantities]\nair = { mean = "neumann" }\n',
        ["quantities.air.mean: no facet is neumann; the boundary has contact, dirichlet"],
    ),
    "title a number": (with_('"S1"', "1"), ["title: a string is needed, found 1"]),
    "title with an escape": (
        with_('"S1"', '"a\\u001b[31mred"'),
        ["title: up to 200 characters on one line", r'found the string "a\x1b[31mred"'],
    ),
    "title too long": (with_('"S1"', f'"{"é" * 201}"'), ["title: up to 200 characters"]),
    "an integer without end": (
        with_("size = 0.5", f"size = {'9' * 4301}"),
        ["case.toml: a whole number in line 5 has more than 4300 digits"],
    ),
    "a hexadecimal number without end": (
        with_("levels = 2", f"levels = 0x{'f' * 5000}"),
        ["refine.levels: less than 1e+15 is needed, found a huge number"],
    ),
    "a hexadecimal edge without end": (
        with_("size", f"arcs = [{{ edge = 0x{'f' * 5000}, through = [0, 3] }}]\nsize"),
        ["domain.arcs[0].edge:", "found a huge number"],
    ),
    "a vertex far away": (
        with_("[1, 0]", "[1e300, 0]"),
        ["domain.vertices: vertex 1 is (1e+300, 0): coordinates up to 1e+100 are allowed"],
    ),
    "steps without end": (
        with_("[refine]", "[time]\nend = 1\nsteps = 100000000000\n[refine]"),
        ["time.steps: 100000000000 is too many", "up to 100000 are allowed"],
    ),
    "size zero": (with_("size = 0.5", "size = 0"), ["domain.size: a number above 0", "found 0"]),
    "size negative": (with_("size = 0.5", "size = -0.5"), ["domain.size:", "found -0.5"]),
    "size infinite": (with_("size = 0.5", "size = inf"), ["domain.size:", "found inf"]),
    "size far too small": (with_("size = 0.5", "size = 1e-12"), ["domain:", "size is 1e-12"]),
    "a strip too thin for its ends": (
        with_("[1, 1], [-1, 1]", "[1, 1e-6], [-1, 1e-6]"),
        ["domain:", "facets of 1e-06", "about 4", "30000 are allowed"],
    ),
    "vertices no list": (
        with_("vertices = [[-1, 0], [1, 0], [1, 1], [-1, 1]]", "vertices = 4"),
        ["domain.vertices: a list is needed, found 4"],
    ),
    "vertex of one number": (
        with_("[1, 0]", "[1]"),
        ["domain.vertices[1]: a point [x, y] is needed", "found a list of 1"],
    ),
    "vertex of strings": (with_("[1, 0]", '[1, "0"]'), ["domain.vertices[1][1]:", 'string "0"']),
    "vertex not finite": (with_("[1, 0]", "[1, inf]"), ["domain.vertices[1][1]:", "inf"]),
    "crossing": (
        with_("[1, 1], [-1, 1]", "[-1, 1], [1, 1]"),
        ["domain.vertices:", "edge 1 crosses edge 3; the polygon must be simple"],
    ),
    "vertex twice": (with_("[1, 1],", "[1, 0],"), ["domain.vertices:", "vertex 1", "vertex 2"]),
    "two vertices": (
        with_("[1, 0], [1, 1], [-1, 1]]", "[1, 0]]"),
        ["domain.vertices: at least 3", "found 2"],
    ),
    "too few labels": (
        with_(LINE, 'boundary = ["contact", "dirichlet"]'),
        ["domain.boundary:", "4 edges, found 2 labels"],
    ),
    "unknown label": (
        with_('"contact"', '"contct"'),
        [
            "domain.boundary[0]:",
            '"contct" is unknown; did you mean contact? Allowed are contact, dirichlet, neumann',
        ],
    ),
    "no dirichlet": (
        with_(', "dirichlet"' * 3, ', "neumann"' * 3),
        ["domain.boundary:", "'dirichlet'"],
    ),
    "no contact": (with_('"contact"', '"neumann"'), ["domain.boundary:", "'contact'"]),
    "arc without a point": (
        with_("size", "arcs = [{ edge = 2 }]\nsize"),
        ["domain.arcs[0]: { edge = i, through = [x, y] } is needed, found a table"],
    ),
    "arc of no edge": (
        with_("size", "arcs = [{ edge = 7, through = [0, 3] }]\nsize"),
        ["domain.arcs: there is no edge 7: they are 0 to 3"],
    ),
    "arc of an edge twice": (
        with_("size", f"arcs = [{', '.join(2 * ['{ edge = 2, through = [0, 3] }'])}]\nsize"),
        ["domain.arcs[1].edge: the number of an edge, from 0, that is no arc yet", "found 2"],
    ),
    "arc through half a point": (
        with_("size", "arcs = [{ edge = 2, through = [0] }]\nsize"),
        ["domain.arcs[0].through: a point [x, y] is needed, found a list of 1"],
    ),
    "straight arc": (
        with_("size", "arcs = [{ edge = 2, through = [0, 1] }]\nsize"),
        ["domain.arcs: the arc of edge 2: no circle passes through (1, 1), (0, 1) and (-1, 1)"],
    ),
    "arc across an edge": (
        with_("size", "arcs = [{ edge = 2, through = [0, -0.1] }]\nsize"),
        ["domain.vertices: edge 0 crosses edge 2; the polygon must be simple"],
    ),
    "round hole with corners": (
        with_("size", 'holes = [{ center = [0, 0.5], vertices = [], boundary = "neumann" }]\nsize'),
        ["domain.holes[0].vertices: there is no such key; allowed are center, radius, boundary"],
    ),
    "round hole without a radius": (
        with_("size", 'holes = [{ center = [0, 0.5], boundary = "neumann" }]\nsize'),
        ["domain.holes[0].radius: this key is missing"],
    ),
    "round hole of many parts": (
        with_("size", f"holes = [{{ center = [0, 1], radius = 1, boundary = {NEUMANN} }}]\nsize"),
        ["domain.holes[0].boundary: a string is needed, found a list of 3"],
    ),
    "round hole too large": (
        with_("size", 'holes = [{ center = [0, 1], radius = 1, boundary = "neumann" }]\nsize'),
        ["domain.holes: ", " hole 0", "holes must lie inside"],
    ),
    "hole outside": (with_("size", HOLE + "\nsize"), ["domain.holes:", "hole 0", "outside"]),
    "hole of two": (
        with_("size", FLAT_HOLE + "\nsize"),
        ["domain.holes[0].vertices: at least 3", "found 2"],
    ),
    "hole with a bad label": (
        with_("size", HOLE.replace('"neumann"]', '"slip"]') + "\nsize"),
        ["domain.holes[0].boundary[2]:", '"slip"', "contact, dirichlet, neumann"],
    ),
    "hole with an unknown key": (
        with_("size", HOLE.replace("vertices", "vertexes") + "\nsize"),
        ["domain.holes[0].vertexes:", "did you mean vertices?"],
    ),
    "mesh and polygon": (
        with_("size", 'mesh = "a.msh"\nsize'),
        ["domain: both mesh and vertices are given"],
    ),
    "mesh that no file can be": (
        '[domain]\nmesh = "a\\u0000b"\n[data]\nf = 1\n',
        ["domain.mesh: a\\x00b: cannot be read: ", "null"],
    ),
    "neither": ("[domain]\nsize = 1\n[data]\n", ["domain: neither vertices nor mesh"]),
    "unknown name": (
        with_("1 + r", "1 + rr"),
        ["data.f:", "no name 'rr'; did you mean r?", "1 + rr\n        ^^\n"],
    ),
    "unknown function": (with_("1 + r", "sine(r)"), ["data.f:", "did you mean sin?"]),
    "forbidden construct": (
        with_("1 + r", "__import__('os').system('true')"),
        ["data.f:", "a dot is not part of the language"],
    ),
    "attribute": (with_("1 + r", "x.real"), ["data.f: a dot is not part of the language"]),
    "condition for a number": (with_("1 + r", "r < 1"), ["data.f:", "condition"]),
    "expression of the wrong type": (with_('"1 + r"', "[1]"), ["data.f:", "found a list of 1"]),
    "expression true": (with_('"1 + r"', "true"), ["data.f:", "found true"]),
    "definition used before": (
        with_("[define]", '[define]\nq = "2*r"'),
        ["define.q:", "'r' is defined only further down"],
    ),
    "definition of a taken name": (with_("[define]", "[define]\nx = 1"), ["define.x:", "already"]),
    "definition of a taken name in other letters": (
        with_("[define]", '[define]\n"𝑥" = "-5"'),
        ["define.𝑥: '𝑥', which is 'x' in other letters, has a meaning already"],
    ),
    "one name twice in other letters": (
        with_("[define]", '[define]\n"ﬁ" = "5"\nfi = "7"'),
        ["define.fi: this is the name 'ﬁ' once more, in other letters"],
    ),
    "definition of no name": (with_("[define]", '[define]\n"a-b" = 1'), ["define.a-b:"]),
    "f not finite": (with_("1 + r", "1/r"), ["data.f: the value at (0, 0) is inf"]),
    "obstacle not finite": (
        with_("obstacle = 0", 'obstacle = "log(x)"'),
        ["data.obstacle: the value at (-1, 0) is nan", "on the contact part"],
    ),
    "dirichlet not finite": (
        with_("obstacle = 0", 'dirichlet = "1/(1 - y)"'),
        ["data.dirichlet: the value at (-1, 1) is inf", "on the dirichlet part"],
    ),
    "exact not finite": (CASE + '[exact]\nu = "sqrt(x)"\n', ["exact.u: the value at (-1, 0)"]),
    "coefficient": (
        with_("obstacle = 0", 'coefficient = "x"'),
        ["data.coefficient: the value at (-1, 0) is -1", "above 0"],
    ),
    "obstacle above u_D": (
        with_("obstacle = 0", 'obstacle = "x"\ndirichlet = "x/2"'),
        ["data.obstacle: at (1, 0)", "obstacle is 1", "value is only 0.5"],
    ),
    "obstacle above 0": (
        with_("obstacle = 0", "obstacle = 1e-3"),
        ["data.obstacle: at (-1, 0)", "0.001", "only 0"],
    ),
    "syntax": (with_("size = 0.5", "size = "), ["TOML syntax in line 5, column 8", "^"]),
    "an expression without quotes": (
        with_('f = "1 + r"', "f = -1*x"),
        ["TOML syntax in line 9", 'between quotes, as f = "-1*x"', "f = -1*x\n          ^"],
    ),
    "a function without quotes": (
        with_('f = "1 + r"', "f = -sin(x)  # down"),
        ['an expression or a name stands between quotes, as f = "-sin(x)"'],
    ),
    "a name without quotes": (
        CASE + "[quantities]\npush = { force = contact }\n",
        ['an expression or a name stands between quotes, as "contact"'],
    ),
    "a label without quotes": (
        CASE.replace('["contact"', "[contact", 1),
        ['an expression or a name stands between quotes, as "contact"'],
    ),
    "a comma without quotes": (
        with_("size = 0.5", "size = 0,5"),
        ["TOML syntax in line 5", "decimals have a point, as 0.5"],
    ),
    "no digit before the point": (
        with_("size = 0.5", "size = .5"),
        ["a point in a number has digits before it and behind it, as 0.5"],
    ),
    "a comma in an expression": (
        with_("obstacle = 0", 'obstacle = "-0,6"'),
        ["data.obstacle: a comma only separates", "decimals have a point, as 0.5"],
    ),
    "a comma and a nought": (
        with_("obstacle = 0", 'obstacle = "-0,06"'),
        ["data.obstacle: decimals have a point, as 0.5"],
    ),
    "a quote that is open": (
        with_('f = "1 + r"', 'f = "1 + r'),
        ["TOML syntax in line 9", "the quote is not closed in this line"],
    ),
    "a quote that is open at the end": (
        CASE + 'max_dofs = "3',
        ["TOML syntax at the end of the file (line 15): a quote is not closed"],
    ),
    "a single quote that is open": (
        with_('f = "1 + r"', "f = '1 + r") + "dirichlet = '0'",
        ["TOML syntax in line 9", "the quote is not closed in this line"],
    ),
    "far too small a size": (
        with_("size = 0.5", "size = 0.02").replace("[1, 1], [-1, 1]", "[1, 1500], [-1, 1500]"),
        ["the domain is 2 by 1500, and a size of 20 makes some hundred"],
    ),
    "a description in the place of a mesh": (
        mesh_case("wall.geo"),
        ["domain.mesh: ", "no mesh yet; `gmsh -2 wall.geo` makes wall.msh"],
    ),
    "syntax at the end": (CASE + "[other", ["TOML syntax at the end of the file (line 15)"]),
    "section twice": (CASE + "[data]\n", ["TOML syntax in line 15", "Cannot declare [data] twice"]),
    "keys of many parts": (
        CASE + "[define]\n" + "a . 'b'." * 15_000 + "c = 1\n",
        ["the key in line 16 has more than 100 parts"],
    ),
    "sections of many parts": (CASE + "[" + "a." * 30_000 + "b]\n", ["line 15 has more than 100"]),
    "key twice": (with_("size = 0.5", "size = 0.5\nsize = 1"), ["TOML syntax in line 6"]),
    "not text": ("\udcff", ["UTF-8"]),
    "mesh missing": (mesh_case("none.msh"), ["domain.mesh:", "none.msh", "No such file"]),
    "mesh a folder": (mesh_case("."), ["domain.mesh:", "cannot be read"]),
    "mesh no mesh": (mesh_case("junk.msh"), ["domain.mesh:", "not a gmsh mesh file"]),
    "mesh cut off": (mesh_case("cut.msh"), ["domain.mesh:", "cut.msh"]),
    "mesh without names": (
        mesh_case("nameless.msh"),
        ["domain.mesh:", "named 'contact'", "floor, dirichlet"],
    ),
    "mesh with quadrilaterals": (mesh_case("quads.msh"), ["domain.mesh:", "Quadrilateral"]),
    "mesh in 3D": (mesh_case("solid.msh"), ["domain.mesh:", "three dimensions"]),
    "mesh facet in two groups": (
        mesh_case("twice.msh"),
        ["domain.mesh:", "(0, 0) to (1, 0)", "contact and to dirichlet"],
    ),
}
_NODES = ["0 0 0", "1 0 0", "1 1 0", "0 1 0", "0 0 1"]
_LINES = ["1 2 1 1 1 2", "1 2 2 2 2 3 4"]
_TRIANGLES = ["2 2 3 3 1 2 3", "2 2 3 3 1 3 4"]


def msh(elements: list[str], contact: str = "contact") -> str:
    """A gmsh file of a unit square."""

    def block(name: str, rows: list[str], numbered: bool = True) -> str:
        rows = [f"{i + 1} {row}" if numbered else row for i, row in enumerate(rows)]
        return "\n".join([f"${name}", str(len(rows)), *rows, f"$End{name}", ""])

    names = [f'1 1 "{contact}"', '1 2 "dirichlet"', '2 3 "body"', '3 4 "solid"']
    return (
        "$MeshFormat\n2.2 0 8\n$EndMeshFormat\n"
        + block("PhysicalNames", names, numbered=False)
        + block("Nodes", _NODES)
        + block("Elements", elements)
    )


LINES = ["1 2 1 1 1 2", "1 2 2 2 3 4"]
MESHES = {
    "junk.msh": "nothing",
    "wall.geo": "Point(1) = {0, 0, 0};",
    "cut.msh": msh(LINES + _TRIANGLES)[:-60],
    "nameless.msh": msh(LINES + _TRIANGLES, "floor"),
    "quads.msh": msh([*LINES, "3 2 3 3 1 2 3 4"]),
    "solid.msh": msh([*LINES, *_TRIANGLES, "4 2 4 4 1 2 3 5"]),
    "twice.msh": msh([*LINES, "1 2 2 3 1 2", *_TRIANGLES]),
}


def run(*argv: str | Path, drawn: bool = False) -> tuple[int, str, str]:
    """The command in this process, on all ranks: status, stdout and stderr of this rank.

    Without pictures, unless they are asked for.
    """
    with (
        pytest.MonkeyPatch.context() as patch,
        contextlib.redirect_stdout(io.StringIO()) as out,
        contextlib.redirect_stderr(io.StringIO()) as err,
    ):
        if not drawn:
            helpers.undrawn(patch)
        status = cli.main([str(word) for word in argv])
    return status, out.getvalue(), err.getvalue()


def refused(*argv: str | Path) -> str:
    """The one message of a run that is turned down with nothing written, on every rank."""
    before = sorted(Path().rglob("*"))
    COMM.Barrier()
    status, out, err = run(*argv)
    assert COMM.allgather(status) == [cli.BAD_INPUT] * COMM.size
    assert COMM.allgather(out) == [""] * COMM.size
    said = COMM.allgather(err)
    assert said[1:] == [""] * (COMM.size - 1)
    assert said[0].startswith("signorini-cr: ") and "Traceback" not in said[0]
    assert max(map(len, said[0].split("\n"))) <= 80
    COMM.Barrier()
    assert sorted(Path().rglob("*")) == before
    return said[0]


@pytest.fixture
def write(shared_tmp_path: Path, monkeypatch) -> Callable[..., str]:
    """Write a file into the folder of the test, which is the current one."""
    monkeypatch.chdir(shared_tmp_path)

    def write(text: str, name: str = "case.toml") -> str:
        if COMM.rank == 0:
            Path(name).write_text(text, encoding="utf-8", errors="surrogateescape")
        COMM.Barrier()
        return name

    return write


@pytest.mark.parametrize("kind", ["file", "mesh"])
def test_what_has_no_end_is_not_read(kind: str, write, monkeypatch) -> None:
    """A device, a pipe, and a file that is larger than any that is meant."""
    case = write('[domain]\nmesh = "there"\n[data]\nf = 1\n', "mesh.toml")
    if COMM.rank == 0:
        os.mkfifo("pipe")
        Path("device").symlink_to("/dev/zero")
        Path("large").write_text("#" * 2000)
    monkeypatch.setattr(readers if kind == "file" else mshfile, "MOST_BYTES", 1000)
    for name, told in {
        "pipe": "this is a device or a pipe; a file is needed",
        "device": "this is a device or a pipe; a file is needed",
        "large": "the file has more than 0.001 MB; up to that are read",
    }.items():
        if COMM.rank == 0:
            Path("there").unlink(missing_ok=True)
            Path("there").symlink_to(name)
        COMM.Barrier()
        said = " ".join(refused("check", "there" if kind == "file" else case).split())
        if COMM.rank == 0:
            assert told in said
            assert ("domain.mesh" in said) is (kind == "mesh")


@pytest.mark.parametrize(
    "u, wrong", [("max(x - 0.3, 0)", True), ("abs(x - 0.5)", True), ("x**2 - y**2", False)]
)
def test_an_error_above_the_bound_is_told(u: str, wrong: bool, write) -> None:
    """Where `exact.u` is not the solution of what is derived from it, by what flows at kinks."""
    text = CASE[: CASE.index("[data]")] + f'[data]\nobstacle = -99\n[exact]\nu = "{u}"\n'
    status, _, err = run("solve", write(text), "--levels", "2", "--out", "out")
    assert status == cli.DONE
    if COMM.rank == 0:
        words = "exact.u: this is not the solution, as the error of "
        assert " ".join(err.split()).count(words) == wrong


@pytest.mark.parametrize("kind", ["max", "product"])
def test_what_is_short_but_would_be_long_written_out(kind: str, write) -> None:
    """Each step uses the one before it twice, and derivatives more often: 2⁴⁰ terms and more."""
    steps = ["1/2 + x*y/3"]
    for i in range(40):
        steps.append(f"max(s{i}, x - {i}*y)" if kind == "max" else f"s{i}*(1 - s{i})")
    names = "".join(f's{i} = "{step}"\n' for i, step in enumerate(steps))
    data = '[data]\ncoefficient = "3 + sin(s40)"\nobstacle = "s40 - 9 + s40"\n[exact]\nu = "s40"\n'
    case = CASE[: CASE.index("[data]")] + names + data
    done = run("check", write(case), "--out", "out")
    assert done[0] == cli.DONE, done


def test_curves_with_names_of_ones_own(write) -> None:
    """What holds the mesh is known by its sections: here a loss, or nothing."""
    write(msh(LINES + _TRIANGLES, "bed").replace("dirichlet", "air"), "own.msh")
    text = '[domain]\nmesh = "own.msh"\n[boundary.bed]\ntype = "contact"\n[data]\nf = 1\n'
    name = write(text + '[boundary.air]\ntype = "robin"\ncoefficient = 2\n')
    assert run("check", name)[0] == cli.DONE
    name = write(text + '[boundary.air]\ntype = "neumann"\n', "loose.toml")
    assert "a net force ∫f + ∫g of 1" in " ".join(refused("check", name).split())


def test_surfaces_without_a_section(write) -> None:
    """They have the data of [data], and where others have sections, that is said."""
    mesh = msh([*LINES, "2 2 3 3 1 2 3", "2 2 4 4 1 3 4"]).replace('3 4 "solid"', '2 4 "lining"')
    write(mesh, "two.msh")
    text = '[domain]\nmesh = "two.msh"\n[data]\nf = 1\n'
    for more, said in ("", False), ("[material.body]\ncoefficient = 2\n", True):
        status, _, err = run("check", write(text + more))
        assert status == cli.DONE
        assert (
            COMM.bcast("lining has no section [material.lining]" in " ".join(err.split())) == said
        )


def test_a_capacity_without_time(write) -> None:
    """It does nothing, and that is said; with a section [time] it does, and nothing is said."""
    mesh = msh([*LINES, "2 2 3 3 1 2 3", "2 2 3 3 1 3 4"])
    write(mesh, "one.msh")
    text = '[domain]\nmesh = "one.msh"\n[data]\nf = 1\n[material.body]\ncapacity = 2\n'
    for more, said in ("", True), ("[time]\nend = 1\nsteps = 2\n", False):
        status, _, err = run("check", write(text + more))
        assert status == cli.DONE
        told = "material.body.capacity: it does nothing without a section [time]"
        assert COMM.bcast(told in " ".join(err.split())) == said


@pytest.mark.parametrize("name", BAD)
def test_bad_input(name: str, write) -> None:
    text, words = BAD[name]
    for mesh, content in MESHES.items():
        if mesh in text:
            write(content, mesh)
    path = write(text)
    message = refused("solve", path, "--out", "out")
    assert message.startswith("signorini-cr: case.toml: ")
    flat = " ".join(message.split())
    for word in words:
        assert word in message or word in flat
    assert refused("check", path, "--out", "out") == message


@pytest.mark.parametrize(
    "argv, words",
    [
        ([], ["a command comes first", "solve and check"]),
        (["solv"], ["no command 'solv'", "did you mean solve?"]),
        (["solve"], ["FILE.toml"]),
        (["solve", "FILE", "two"], ["'two' is one argument too many"]),
        (["solve", "--", "FILE", "--out"], ["--out is behind --, where there are no options"]),
        (["solve", "FILE", "--outt", "DIR"], ["no option --outt", "did you mean --out?"]),
        (["solve", "FILE", "--level", "3"], ["no option --level", "did you mean --levels?"]),
        (["solve", "FILE", "--levels", "0"], ["--levels", "1 or more", "found 0"]),
        (["solve", "FILE", "--levels", "-2"], ["--levels", "1 or more", "found -2"]),
        (["solve", "FILE", "--levels", "two"], ["--levels", "whole number", "found two"]),
        (["solve", "FILE", "--levels"], ["--levels"]),
        (["solve", "FILE", "--max-time", "0"], ["--max-time", "above 0", "found 0"]),
        (["solve", "FILE", "--max-time", "1h"], ["--max-time", "seconds", "found 1h"]),
        (["solve", "FILE", "--out="], ["--out", "folder"]),
        (["solve", "FILE", "--element", "p2"], ["--element", "cr", "p1"]),
        (
            ["solve", "FILE", "--tolerance=0.1"],
            ["no option --tolerance; tolerance is a key of [refine] in the problem file"],
        ),
        (["solve", "FILE", "--max-dofs", "9"], ["max_dofs is a key of [refine]"]),
        (["check", "FILE", "--levels", "2"], ["no option --levels"]),
        (["solve", "FILE", "-levels", "2"], ["-levels, with one dash", "did you mean --levels?"]),
        (["solve", "FILE", "--out", "DIR", "-resume"], ["did you mean --resume?"]),
        (["solve", "FILE", "-options_file", "none"], ["-options_file none", "no such file"]),
        (["solve", "FILE", "-options_file", "/dev/zero"], ["-options_file", "this is no file"]),
        (["solve", "FILE", "-history", "/proc/no/it"], ["/proc/no is no folder that can be wr"]),
        (["solve", "FILE", "-log_view", ":/proc/no/it"], ["/proc/no is no folder that can be"]),
        (["solve", "none.toml"], ["none.toml: there is no such file"]),
        (["solve", "."], ["folder; a problem file (TOML) is needed"]),
        (["solve", "FILE", "--out", "FILE/out"], ["--out: cannot write", "not a folder"]),
        (["solve", "FILE", "--out", "/proc/none"], ["--out: cannot write", "not writable"]),
    ],
    ids=lambda argv: " ".join(argv)[:30],
)
def test_bad_command_lines(argv: list[str], words: list[str], write) -> None:
    path = write(CASE)
    argv = [word.replace("FILE", path) for word in argv]
    message = " ".join(refused(*argv).split())
    for word in words:
        assert word in message


def test_a_folder_without_permission(write) -> None:
    if os.geteuid() == 0:
        pytest.skip("root may write anywhere")
    path, folder = write(CASE), Path("kept")
    if COMM.rank == 0:
        folder.mkdir(mode=0o500)
    message = refused("solve", path, "--out", folder)
    assert "not writable" in message


def test_solve(write) -> None:
    path, out = write(CASE), Path("deep/out")
    status, text, err = run("solve", path, "--out", out, "--levels", "3")
    assert (status, err) == (0, "")
    if COMM.rank > 0:
        assert text == ""
        return
    lines = text.split("\n")
    head = lines.index("") + 1
    assert lines[head].split()[:4] == ["level", "cells", "dofs", "h"]
    assert [line.split()[0] for line in lines[head + 1 : head + 4]] == ["0", "1", "2"]
    assert max(map(len, lines)) <= 80
    assert "contact on" in text and "written to" in text
    report = json.loads((out / "report.json").read_text())
    assert (report["title"], report["element"], report["ranks"]) == ("S1", "CR", COMM.size)
    assert [level["level"] for level in report["levels"]] == [0, 1, 2]
    assert report["levels"][0]["seconds"]["mesh"] > 0
    assert {"levels.csv", "levels.md", "contact.csv"} <= {file.name for file in out.iterdir()}


def test_the_problem_is_stated_before_the_table(write) -> None:
    wall = '"neumann", "dirichlet", "neumann"'
    text = with_(LINE, LINE.replace('"dirichlet", "dirichlet", "dirichlet"', wall))
    long = " + ".join(["0.001*x*y"] * 30)
    text = text.replace('f = "1 + r"', f'f = "-1 - {long}"\ncoefficient = 2\ng = "r"')
    status, text, _ = run("solve", write(text), "--out", "out", "--levels", "1")
    assert status == 0
    if COMM.rank > 0:
        return
    lines = text.split("\n")
    told = lines[: lines.index("")]
    assert max(map(len, lines)) <= 80
    assert [line.split()[0] for line in told if line[0] != " "] == [
        *("domain", "equation", "dirichlet", "neumann", "contact", "where")
    ]
    rows = " ".join(" ".join(told).split())
    for words in (
        "cells in [-1, 1] × [0, 1]",
        "−∇·(κ∇u) = -1 - 0.001*x*y",
        "…, κ = 2 dirichlet u = 0; 4 facets, length 2",
        "neumann κ∂ₙu = r; 4 facets, length 2",
        "contact u ≥ 0, κ∂ₙu ≥ 0, one of them an equality; 4 facets, length 2",
        "where r = sqrt(x**2 + y**2)",
    ):
        assert words in rows
    found = re.search(r"the contact force is in \[(.*?), (.*?)\]", " ".join(text.split()))
    low, high = (float(end) for end in found.groups())
    report = json.loads(Path("out/report.json").read_text())
    bounds = report["force_bounds"]
    assert low <= bounds["lower"] <= report["levels"][0]["contact"]["force"] <= bounds["upper"]
    assert bounds["upper"] <= high


@pytest.mark.parametrize("whole", [True, False])
def test_what_all_cells_have_of_their_materials_is_not_stated_for_others(whole, write) -> None:
    top = 1 if whole else 0.8
    soil = f"""
[material.soil]
polygon = [[-1, 0], [1, 0], [1, 0.5], [-1, 0.5]]
coefficient = 2
[material.rock]
polygon = [[-1, 0.5], [1, 0.5], [1, {top}], [-1, {top}]]
coefficient = 3
f = -4
reaction = 5
"""
    status, text, _ = run("check", write(CASE + soil), "--out", "out")
    assert status == 0
    if COMM.rank == 0:
        last = "κ by material" if whole else "κ = 1"
        assert f"equation   −∇·(κ∇u) + c u = 1 + r, {last}\n" in text
    text = with_('f = "1 + r"\n', "") + soil.replace("ent = 2", "ent = 2\nf = -1\nreaction = 1")
    status, text, _ = run("check", write(text, "all.toml"), "--out", "out")
    if COMM.rank == 0:
        last = "f, κ, f and c by material" if whole else "0, κ = 1"
        assert f"equation   −∇·(κ∇u) + c u = {last}\n" in text


def test_one_facet_is_one(write) -> None:
    text = with_(LINE, LINE.replace("dirichlet", "neumann", 1)).replace("size = 0.5", "size = 1")
    text += "[time]\nend = 1\nsteps = 1\n"
    status, text, _ = run("check", write(text), "--out", "out")
    assert status == 0
    if COMM.rank == 0:
        flat = " ".join(text.split())
        assert "∂ₙu = 0; 1 facet, length 1" in flat and "in 1 step of euler" in flat


def test_what_is_certain_stands_line_by_line(write) -> None:
    """What goes on does so further in; the force is told once and kept under both names."""
    wall = '"neumann", "dirichlet", "neumann"'
    text = with_(LINE, LINE.replace('"dirichlet", "dirichlet", "dirichlet"', wall))
    asked = 'push = { force = "contact" }\nheat = { flux = "dirichlet", weight = "x**2" }'
    status, text, _ = run("solve", write(f"{text}\n[quantities]\n{asked}\n"), "--out", "out")
    assert status == 0
    if COMM.rank > 0:
        return
    lines = text.split("\n")
    assert max(map(len, lines)) <= 80
    first = lines.index("certified:") + 1
    told = lines[first : first + 4]
    for line, words in zip(
        told,
        ("‖∇_h(u − u_h)‖ is at most ", "J(u) is in [", "the contact force is in [", "heat "),
        strict=True,
    ):
        assert line.startswith(f"  {words}")
    assert told[2].endswith("] (this is push)")
    level = json.loads(Path("out/report.json").read_text())["levels"][-1]
    push = level["quantities"]["push"]
    assert {end: push[end] for end in ("lower", "upper")} == {
        end: level["contact"]["force_bounds"][end] for end in ("lower", "upper")
    }


def test_a_long_name_stands_apart_from_what_is_said_of_it() -> None:
    rows = folded({"underground_wall": "u = 0", "roof": "u = 1"})
    assert rows == "underground_wall u = 0\nroof       u = 1"


def test_long_figures_hang() -> None:
    lines = wrapped("; ".join(["a reason why"] * 20), "  ", "    ").split("\n")
    assert len(lines) > 2 and max(map(len, lines)) <= 80
    assert lines[0].startswith("  a") and all(line.startswith("    ") for line in lines[1:])


def test_where_the_force_has_no_bounds_the_reason_is_told(write) -> None:
    status, text, _ = run("solve", write(CASE), "--out", "out", "--levels", "1")
    assert status == 0
    if COMM.rank == 0:
        bounds = json.loads(Path("out/report.json").read_text())["force_bounds"]
        assert bounds["lower"] is None and bounds["upper"] is None
        assert bounds["reason"].startswith("Γ1 touches Γ0")
        assert "no bounds: Γ1 touches Γ0" in " ".join(text.split())


def test_a_bound_that_comes_and_goes(write) -> None:
    """α jumps inside a facet, which is in contact on some meshes, and then there is no bound."""
    text = CASE.replace("[-1, 0], [1, 0]", "[0, 0], [1, 0]").replace("[-1, 1]]", "[0, 1]]")
    text = text.replace(LINE, 'boundary = ["contact", "neumann", "dirichlet", "neumann"]')
    text = text.replace("size = 0.5", "size = SIZE").replace('"1 + r"', '"-0.4"')
    text = text.replace("obstacle = 0", 'obstacle = "where(x < 0.41, -0.3, -0.2)"')
    seen = set()
    for size in ("0.3", "0.6", "0.25"):
        path = write(text.replace("SIZE", size))
        status, _, err = run("solve", path, "--out", "out", "--levels", "4", "--html")
        assert (status, err) == (0, "")
        if COMM.rank == 0:
            levels = json.loads(Path("out/report.json").read_text())["levels"]
            assert len(levels) == 4
            seen |= {level["bound_h1"] is None for level in levels}
    assert seen == {True, False} or COMM.rank


def test_quiet_and_p1(write) -> None:
    path, out = write(CASE), Path("out")
    assert run("solve", path, "--out", out, "--element", "P1", "--quiet") == (0, "", "")
    if COMM.rank == 0:
        assert json.loads((out / "report.json").read_text())["element"] == "P1"


def test_verbose_prints_the_steps(write) -> None:
    status, text, _ = run("solve", write(CASE), "--out", "out", "-v")
    assert max(map(len, text.split("\n"))) <= 80
    assert status == 0
    steps = [line.split() for line in text.split("\n") if line.startswith("  level 1")]
    if COMM.rank == 0:
        assert [step[:4] for step in steps[:2]] == [
            ["level", "1", "step", "0"],
            ["level", "1", "step", "1"],
        ]
        assert {"residual", "active", "cg"} <= set(steps[0])


def test_progress_is_for_terminals(write, monkeypatch) -> None:
    class Terminal(io.StringIO):
        def isatty(self) -> bool:
            return True

    path, terminal = write(CASE), Terminal()
    monkeypatch.setattr(sys, "stderr", terminal)
    with contextlib.redirect_stdout(io.StringIO()):
        assert cli.main(["solve", str(path), "--out", "out"]) == 0
    if COMM.rank == 0:
        assert "level 1  step" in terminal.getvalue()
        assert terminal.getvalue().endswith("\r") and "\n" not in terminal.getvalue()
        assert max(map(len, terminal.getvalue().split("\r"))) < 80
    else:
        assert terminal.getvalue() == ""


def test_check(write) -> None:
    path, out = write(CASE), Path("out")
    status, text, err = run("check", path, "--out", out, drawn=True)
    assert (status, err) == (0, "")
    if COMM.rank == 0:
        assert "case.toml: in order" in text
        told = dict(line.split(maxsplit=1) for line in text.split("\n")[1:5])
        assert told["contact"].endswith("; 4 facets, length 2")
        assert told["dirichlet"].endswith("; 8 facets, length 4")
        assert "neumann" not in told
        assert [file.name for file in out.iterdir()] == ["mesh.png"] or "not drawn" in text


@pytest.mark.parametrize("word", ["check", "solve"])
def test_a_folder_whose_name_is_too_long(word: str, write) -> None:
    status, _, err = run(word, write(CASE), "--out", 300 * "x")
    told = "--out: cannot write to" in err and err.endswith("File name too long\n")
    assert status == 2 and (told if COMM.rank == 0 else not err)


@pytest.mark.parametrize("away", [1234567.123456, 3e9 + 0.123])
def test_data_with_an_end_at_a_side_far_from_the_origin(write, away: float) -> None:
    """Points are looked at where they are, not 11 digits of them, which would be beyond."""
    sides = [[away, 0], [away + 1, 0], [away + 1, 1], [away, 1]]
    text = with_("[[-1, 0], [1, 0], [1, 1], [-1, 1]]", str(sides))
    root = f"sqrt(x - {away!r}) + sqrt({away + 1!r} - x)"
    status, _, err = run("check", write(text.replace("1 + r", root)))
    assert (status, err) == (0, "")
    status, _, err = run("check", write(text.replace("1 + r", f"1/(x - {away!r})")))
    told = "is inf; it must be finite" in " ".join(err.split())
    assert status == 2 and (told if COMM.rank == 0 else not err)


def test_a_check_leaves_the_results_of_a_run_alone(write) -> None:
    """What lies beside a report is of its run; the picture goes with the next one."""
    path, out = write(CASE), Path("out")
    assert run("solve", path, "--out", out, "--levels", "1", drawn=True)[0] == 0

    def there() -> dict[str, bytes]:
        return {each.name: each.read_bytes() for each in out.iterdir()}

    before = there()
    write(CASE.replace("size = 0.5", "size = 1.0"))
    status, text, _ = run("check", path, "--out", out, drawn=True)
    assert status == 0
    after = there()
    drawn = after.pop("check.png", None)
    assert after == before and drawn != before.get("mesh.png", b"")
    assert COMM.rank > 0 or "out/check.png" in text or "not drawn" in text
    assert run("solve", path, "--out", out, "--levels", "1", drawn=True)[0] == 0
    assert set(there()) == set(before)


def test_the_deck(shared_tmp_path: Path) -> None:
    """Two materials, two ducts: heat is needed, but not above them."""
    out = shared_tmp_path / "out"
    words = "solve", helpers.MESHES / "deck.toml", "--out", out, "--levels", "2"
    status, text, err = run(*words, drawn=True)
    assert (status, err) == (0, "")
    if COMM.rank > 0:
        return
    assert "surface    u ≥ 0, κ∂ₙu + 20 (u + 5) ≥ 0" in text
    level = json.loads((out / "report.json").read_text())["levels"][-1]
    assert level["bound_h1"] is not None
    a, b, c, d = sorted(x for x, _ in level["contact"]["transitions"])
    assert [(a + b) / 2, (c + d) / 2] == pytest.approx([0.9, 2.6], abs=0.06)
    # without the ducts u = 0 on the deck, and what is lost goes through layers one after the other
    without = 4 * (20 * 5 + 5 / (1 / 8 + 0.24 / 1.6 + 0.06 / 0.75))
    heat = level["quantities"]["heat"]
    assert 0 < heat["lower"] < heat["value"] < min(heat["upper"], without)
    said = " ".join(text.split())
    length, force = map(float, re.search(r"length (\S+) m, force (\S+) W/m", said).groups())
    assert length == pytest.approx(level["contact"]["length"], abs=0.01)
    bounds = level["contact"]["force_bounds"]
    wide = bounds["upper"] - bounds["lower"]
    assert force == pytest.approx(level["contact"]["force"], abs=0.1 * wide) and "] W/m, " in said
    assert "h: largest diameter of a cell in m;" in said
    assert " h, m |" in (out / "levels.md").read_text().split("\n")[0]
    report = json.loads((out / "report.json").read_text())
    assert report["units"] == {"x": "m", "u": "°C", "flux": "W/m²", "force": "W/m"}
    assert report["names"] == {"u": "temperature", "flux": "heat"}


def test_the_dam(shared_tmp_path: Path) -> None:
    """Charny's discharge, and what seeps above the lower water by Polubarinova-Kochina."""
    out, path = shared_tmp_path / "out", helpers.MESHES / "dam.toml"
    status, text, err = run("solve", path, "--out", out, "--levels", "3")
    assert (status, err) == (0, "")
    if COMM.rank > 0:
        return
    assert "face       u ≤ y, κ∂ₙu ≤ 0, " in text
    level = json.loads((out / "report.json").read_text())["levels"][-1]
    assert level["contact"]["force"] == pytest.approx(-10.290, rel=0.01)
    assert level["contact"]["active"] == level["contact"]["facets"]  # up to the surface
    vertices = np.array(tomllib.loads(path.read_text(encoding="utf-8"))["domain"]["vertices"][3:])
    length = np.hypot(*np.diff(vertices, axis=0).T)
    height = length @ (vertices[1:, 1] + vertices[:-1, 1]) / 2 / length.sum()
    for name, exact in {"discharge": (24**2 - 4**2) / 32, "surface": height}.items():
        found = level["quantities"][name]
        assert found["lower"] < exact < found["upper"]
        assert found["value"] == pytest.approx(exact, rel=1e-3)


def test_data_need_to_make_sense_only_where_they_are_used(write) -> None:
    """1/y does not on Γ1, where the cells' material has a load of its own."""
    text = with_('f = "1 + r"', 'f = "1/y"')
    assert "data.f: the value at" in refused("check", write(text), "--out", "out")
    path = write(f"{text}\n[material.soil]\n{SOIL}\nf = 1\n")
    status, printed, err = run("check", path, "--out", "out")
    assert (status, err) == (0, "")
    assert COMM.rank > 0 or "soil       f = 1; " in printed


def test_a_deck_of_three_materials(shared_tmp_path: Path) -> None:
    """Those of two polygons and, elsewhere, of [data], through the command."""
    out = shared_tmp_path / "out"
    path = helpers.MESHES / "materials.toml"
    status, text, err = run("solve", path, "--out", out, "--levels", "2")
    assert (status, err) == (0, "")
    if COMM.rank > 0:
        return
    assert "steel      κ = 50; " in text and "foam       κ = 0.04; " in text
    level = json.loads((out / "report.json").read_text())["levels"][-1]
    assert level["bound_h1"] is not None
    assert 0 < level["contact"]["force"] < 800


@pytest.mark.parametrize("finished", [0, 2])
def test_levels_finished_before_a_failure_are_kept(finished: int, write, monkeypatch) -> None:
    solve_levels = problemfile.solve_levels

    def failing(problem, domain, number, *rest, **options):
        yield from (
            s for s in solve_levels(problem, domain, finished, *rest, **options) if finished
        )
        raise NotConverged("DIVERGED_MAX_IT after 50 steps", finished)

    monkeypatch.setattr(problemfile, "solve_levels", failing if finished else _at_once)
    path, out = write(CASE), Path("out")
    status, text, err = run("solve", path, "--out", out, "--levels", "4")
    assert status == cli.NOT_CONVERGED
    COMM.Barrier()
    if COMM.rank > 0:
        assert (text, err) == ("", "")
        return
    message = " ".join(err.split())
    assert f"case.toml: stopped on level {finished}: DIVERGED_MAX_IT after 50 steps" in message
    assert "Traceback" not in err
    if finished:
        assert "levels 0 to 1 are finished and kept in" in message
        assert len(json.loads((out / "report.json").read_text())["levels"]) == 2
    else:
        assert "nothing was written" in message and not out.exists()


@pytest.mark.parametrize("limit", ["levels = 2", "max_dofs = 100"])
def test_an_adaptive_run_that_a_limit_stops(limit: str, write) -> None:
    text = with_("uniform", "adaptive").replace("levels = 2", limit)
    path = write(text.replace("tolerance = 0", "tolerance = 1e-3"))
    status, _, err = run("solve", path, "--out", "out", "-q")
    assert status == cli.NOT_CONVERGED
    if COMM.rank == 0:
        message = " ".join(err.split())
        assert "case.toml: stopped on level 1: the certified bound is" in message
        assert f"above the tolerance of 0.001, and {limit} allows no further mesh" in message
        assert len(json.loads(Path("out/report.json").read_text())["levels"]) == 2


@pytest.mark.parametrize(
    ("tolerance", "most", "warned"), [("5e-6", 1000, True), ("0.05", 1000, False)]
)
def test_a_tolerance_out_of_reach_is_told_early(tolerance, most, warned, write) -> None:
    """After the third mesh, once, and the run goes on to its limit."""
    text = with_("uniform", "adaptive").replace("levels = 2", f"max_dofs = {most}")
    path = write(text.replace("tolerance = 0", f"tolerance = {tolerance}"))
    status, told, err = run("solve", path, "--out", "out")
    assert status == cli.NOT_CONVERGED
    if COMM.rank == 0:
        message = " ".join(err.split())
        found = re.findall(
            r"warning: case.toml: refine.tolerance: at this rate the tolerance 5e-06 takes about"
            r" (\de[+]\d\d) unknowns; max_dofs is 1000",
            message,
        )
        assert len(found) == warned and message.count("at this rate") == warned
        assert not warned or 1e9 < float(found[0]) < 1e14
        assert len(re.findall(r"^ +\d+ +\d+ ", told, re.M)) > 3
        assert "allows no further mesh" in message


def test_an_adaptive_run_that_is_good_enough_says_so(write) -> None:
    text = with_("uniform", "adaptive").replace("tolerance = 0", "tolerance = 40")
    text = text.replace("[data]\n", "[data]\nreaction = 1\n", 1)
    path = write(text)
    status, text, err = run("solve", path, "--out", "out")
    assert (status, err) == (0, "")
    again = run("solve", path, "--out", "out", "--resume")
    assert (again[0], again[2]) == (0, "")
    if COMM.rank == 0:
        assert "\ngoing on after level 0, kept in out\n" in again[1]
        said = " ".join(text.split())
        assert "the bound has reached the tolerance of 40: no further mesh is needed" in said
        assert "and restart.npz for --resume" in said and "−Δu + u = " in said


def test_an_adaptive_run_that_rounding_ends_says_so(write) -> None:
    """A constant needs one mesh: without a tolerance that is the end, else it is out of reach."""
    text = with_('dirichlet", "dirichlet", "dirichlet', 'neumann", "dirichlet", "neumann')
    text = text.replace('f = "1 + r"', "dirichlet = 1").replace("uniform", "adaptive")
    path = write(text.replace("levels = 2", "levels = 9"))
    status, said, err = run("solve", path, "--out", "out")
    assert (status, err) == (0, "")
    if COMM.rank == 0:
        assert "what is left of the bound is rounding: no finer mesh" in " ".join(said.split())
        assert len(json.loads(Path("out/report.json").read_text())["levels"]) == 1
    path = write(
        text.replace("levels = 2", "levels = 9").replace("tolerance = 0", "tolerance = 1e-15")
    )
    status, said, err = run("solve", path, "--out", "other")
    assert status == cli.NOT_CONVERGED
    if COMM.rank == 0:
        message = " ".join(err.split())
        assert "stopped on level 0: the certified bound is" in message
        assert "above the tolerance of 1e-15, and what is left of it is rounding" in message
        assert "what is left of the bound" not in said


def test_an_adaptive_run_without_a_tolerance_ends_at_its_limit(write) -> None:
    assert run("solve", write(with_("uniform", "adaptive")), "--out", "out", "-q") == (0, "", "")


def _at_once(*_, **__):
    raise NotConverged("DIVERGED_MAX_IT after 50 steps", 0)


@pytest.mark.serial
def test_the_unexpected_is_told_as_such(write, monkeypatch) -> None:
    monkeypatch.setattr(problemfile, "solve_levels", lambda *_, **__: 1 / 0)
    status, _, err = run("solve", write(CASE), "--out", "out")
    assert status == cli.FAULT
    assert "ZeroDivisionError" in err and "signorini-cr: unexpected error" in err


@pytest.mark.serial
def test_ctrl_c(write, monkeypatch) -> None:
    def interrupt(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr(problemfile, "solve_levels", interrupt)
    status, _, err = run("solve", write(CASE), "--out", "out")
    assert (status, err) == (cli.INTERRUPTED, "signorini-cr: interrupted\n")


@pytest.mark.parametrize(
    "argv, own, petsc",
    [
        (["solve", "a.toml", "-log_view"], ["solve", "a.toml"], ["-log_view"]),
        (["-log_view", "solve", "a.toml"], ["solve", "a.toml"], ["-log_view"]),
        (["solve", "-log_view", "a.toml"], ["solve", "a.toml"], ["-log_view"]),
        (["solve", "-k", "-ksp_x", "-1e-3", "a"], ["solve", "-k", "a"], ["-ksp_x", "-1e-3"]),
        (["-a_b", "-v", "-c_d", "x", "-q"], ["-v", "-q"], ["-a_b", "-c_d", "x"]),
        (["solve", "--levels", "2", "-view", "3"], ["solve", "--levels", "2"], ["-view", "3"]),
        (["solve", "--", "-odd.toml"], ["solve", "--", "-odd.toml"], []),
    ],
)
def test_single_dashes_are_left_to_petsc(argv, own, petsc) -> None:
    assert commandline._split(argv) == (own, petsc)


def test_petsc_takes_them(write) -> None:
    from petsc4py import PETSc

    out = Path("out")
    status, _, _ = run("solve", write(CASE), "--out", out, "-q", "-signorini_cr_probe", "1e-10")
    assert status == 0
    options = PETSc.Options()
    assert options.getReal("signorini_cr_probe") == 1e-10
    options.delValue("signorini_cr_probe")


def test_meshes_are_not_adapted_with_another_element(write) -> None:
    """As is clear before anything is solved: nothing is written."""
    adaptive = write(CASE.replace('"uniform"', '"adaptive"'))
    status, _, error = run("solve", adaptive, "--element", "p1", "--out", "out")
    assert status == 2 and not Path("out").exists()
    if COMM.rank == 0:
        assert "--element: meshes are adapted by bounds, which only cr has" in " ".join(
            error.split()
        )


def test_options_that_end_the_solver_early_are_told(write) -> None:
    """The start of the finer mesh counts as solved then, and what is left of the load is told."""
    from petsc4py import PETSc

    told = []
    for more in ((), ("-signorini_snes_atol", "1e10")):
        status, out, _ = run("solve", write(CASE), "--out", "out", *more)
        assert status == 0
        told.append("not converged as usual" in " ".join(out.split()))
    PETSc.Options().delValue("signorini_snes_atol")
    last = json.loads(Path("out/report.json").read_text())["levels"][-1]
    assert told == ([False, True] if COMM.rank == 0 else [False, False])
    assert last["kkt"]["residual"] > 1e-3 and last["kkt"]["force_error"] is None


@pytest.mark.serial
def test_help_answers_without_the_heavy_libraries() -> None:
    program = (
        "import sys\nfrom signorini_cr.app import cli\n"
        "assert cli.main(['solve', '--help', 'columns']) == 0\n"
        "assert cli.main(['solve', '--help']) == 0\n"
        "heavy = {'numpy', 'mpi4py', 'petsc4py', 'dolfinx', 'ufl', 'gmsh', 'matplotlib'}\n"
        "if 'dolfinx_solver' in sys.modules:  # the wheels, which load MPI first\n"
        "    heavy.remove('mpi4py')\n"
        "assert not heavy & set(sys.modules), heavy & set(sys.modules)"
    )
    began = time.perf_counter()
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert time.perf_counter() - began < 2.0
    for word in ("--out DIR", "--levels N", "cr|p1", "--quiet", "PETSc", "FILE-out"):
        assert word in done.stdout
    assert max(map(len, done.stdout.split("\n"))) <= 80
    columns = helpers.command("solve", "--help=columns").stdout
    for words in (["--help", "columns"], ["--help=columns"], ["-h", "columns"]):
        assert helpers.command(*words).stdout == columns
    assert "COMMAND" in helpers.command("--help").stdout
    assert max(map(len, columns.split("\n"))) <= 80
    assert {"active", "rate", "kkt.min_gap", "arc_length"} <= set(columns.split())
    assert helpers.command("--version").stdout.startswith("signorini-cr 0.")


@pytest.mark.serial
def test_on_two_ranks_mistakes_are_told_once(tmp_path: Path) -> None:
    for argv in (["solve", "x.toml", "--level", "3"], ["solve", tmp_path / "none.toml"]):
        done = helpers.command(*argv, ranks=2)
        assert done.returncode == 2
        assert done.stderr.count("signorini-cr: ") == 1 and "Traceback" not in done.stderr


@pytest.mark.serial
def test_a_rank_that_fails_alone_ends_the_run(tmp_path: Path) -> None:
    """In the midst of the solver, where the other one waits for it."""
    program = (
        "from signorini_cr.app import cli\n\ndef step(self, text):\n"
        "    if not self.root:\n        raise RuntimeError('here')\n\n"
        "cli.Screen.step = step"
    )
    done = helpers.altered(tmp_path, CASE, program, ranks=2)
    assert done.returncode == 1
    assert "RuntimeError: here" in done.stderr
    assert "signorini-cr: unexpected error on rank 1, see above" in done.stderr
    assert not (tmp_path / "out").exists()


@pytest.mark.serial
def test_on_two_ranks_the_figures_are_the_same(tmp_path: Path) -> None:
    (tmp_path / "case.toml").write_text(CASE)
    energies = []
    for ranks in (1, 2):
        out = tmp_path / str(ranks)
        argv = "solve", tmp_path / "case.toml", "--out", out
        done = helpers.undrawn_command(*argv, ranks=ranks)
        assert done.returncode == 0, done.stderr
        energies.append(
            [r["energy"] for r in json.loads((out / "report.json").read_text())["levels"]]
        )
    assert energies[0] == pytest.approx(energies[1], rel=1e-9)


@pytest.mark.serial
def test_without_out_the_results_lie_in_the_current_folder(tmp_path: Path) -> None:
    (tmp_path / "case.toml").write_text(CASE)
    (tmp_path / "work").mkdir()
    done = helpers.command("solve", "../case.toml", "--quiet", cwd=tmp_path / "work")
    assert (done.returncode, done.stdout) == (0, "")
    assert (tmp_path / "work" / "case-out" / "report.json").exists()


@pytest.mark.serial
def test_names_that_are_no_text(tmp_path: Path, monkeypatch) -> None:
    """Results in a folder the terminal can't spell, a problem file in a foreign encoding."""
    monkeypatch.setenv("PYTHONIOENCODING", "ascii")
    (tmp_path / "case.toml").write_text(CASE)
    done = helpers.command("solve", "case.toml", "--out", "Γ", cwd=tmp_path)
    assert (done.returncode, done.stderr) == (0, "")
    assert "\\u0393" in done.stdout
    assert (tmp_path / "Γ" / "report.json").exists()
    name = os.fsdecode(b"\xe4.toml")
    (tmp_path / name).write_text(CASE)
    done = helpers.command("solve", name, cwd=tmp_path)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.startswith("signorini-cr: \\udce4.toml: this is no text in UTF-8")


@pytest.mark.serial
@pytest.mark.parametrize(
    ("output", "words"),
    [
        ("| true", ""),
        (">&-", ""),
        (">&- 2>&-", ""),
        (">/dev/full 2>&1", ""),
        (">/dev/full", "signorini-cr: cannot print to standard output: No space left on device\n"),
    ],
)
def test_results_are_written_though_nothing_can_be_printed(
    output: str, words: str, tmp_path: Path
) -> None:
    """Without pictures, but for the one that has neither stdout nor stderr."""
    (tmp_path / "case.toml").write_text(CASE)
    (tmp_path / "undrawn.py").write_text(helpers.UNDRAWN)
    program = "-m signorini_cr" if output == ">&- 2>&-" else "undrawn.py"
    command = f"{sys.executable} {program} solve case.toml --out out; echo $? >status"
    done = subprocess.run(
        ["sh", "-c", f"({command}) {output}"], cwd=tmp_path, capture_output=True, text=True
    )
    assert done.stderr == words
    assert (tmp_path / "status").read_text().strip() == "0"
    assert (tmp_path / "out" / "report.json").exists()
