"""Every key of a problem file, told once: what may be there, and what the reference says of it."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import Any, NamedTuple

from ..adaptive import solve_adaptive
from ..fem.conditions import Condition, Contact, Dirichlet, Neumann, Robin
from ..means import DOMAIN
from .formula import CONSTANTS, FUNCTIONS, VARIABLES
from .readers import MOST_CHARACTERS, fraction, not_negative, whole


class Key(NamedTuple):
    """One key.

    Attributes:
        section: Where it belongs; "" for the top of the file.
        name: What it is called.
        value: What belongs there.
        default: What it means to leave it out; "" where it is needed.
        about: What it does.
        example: A line of TOML.
        argument: How it is read, if it is nothing but an argument of `solve_adaptive` by the same
            name; it is a key of [refine] then, and `problemfile` hands it on.
        used_on: The part of the boundary that an expression of [data] is used on; "" for all of the
            domain.
        ends: Whether it says where a run ends, and nothing else: it may differ in a run that is
            resumed.
        least: What values of an expression are to be, `ABOVE` or `NOT_BELOW`; "" for anything
            finite. `datacheck` looks at it.
    """

    section: str
    name: str
    value: str
    default: str
    about: str
    example: str
    argument: Callable[[str, Any], Any] | None = None
    used_on: str = ""
    ends: bool = False
    least: str = ""

    @property
    def is_expression(self) -> bool:
        """True if expressions belong there."""
        return self.value in (EXPRESSION, TENSOR)


DEFAULTS = {
    name: each.default for name, each in inspect.signature(solve_adaptive).parameters.items()
}
"""Defaults of the arguments of `solve_adaptive`."""
USUAL = {name: f"{value}".removesuffix(".0") for name, value in DEFAULTS.items()}
"""The same in words."""
EXPRESSION = "an expression or a number"
TENSOR = "an expression or a number, or a tensor [[xx, xy], [xy, yy]] of these"
ABOVE, NOT_BELOW = "above 0", "0 or more"
WORD = f"a text of {MOST_CHARACTERS} characters at most"
PART = "boundary.NAME"
"""The sections of the parts of the boundary."""
MATERIAL = "material.NAME"
"""The sections of the materials."""
QUANTITY = "quantities.NAME"
"""The sections of quantities that are wanted in an interval; on one line each, usually."""
KINDS: dict[str, type[Condition]] = {
    kind.__name__.lower(): kind for kind in (Contact, Dirichlet, Neumann, Robin)
}
"""The class of condition for each type of a part; it takes the section's other keys."""
TYPES = {name: kind.names() for name, kind in KINDS.items()}
"""The keys that go with each type of a part."""

QUANTITIES_EXAMPLE = [
    'push = { force = "floor" }',
    'moment = { force = "floor", weight = "x" }',
    'inflow = { flux = "top" }',
    'mean_air = { mean = "air" }',
    'stored = { integral = "domain", weight = "where(y < 0.5, 2, 1)" }',
]
"""Examples of quantities, as a problem file has them."""

KEYS = (
    Key("", "title", "a text", "the file's name", "Stands in the report and over pictures.",
        'title = "S1"'),
    Key("domain", "vertices", "a list of points [x, y]", "", "The corners of a simple polygon, in "
        "either orientation. Needed, unless there is a `mesh`.",
        "vertices = [[-1, 0], [1, 0], [1, 1], [-1, 1]]"),
    Key("domain", "boundary", 'a list of "contact", "dirichlet", "neumann" or your own names', "",
        "What each edge is; edge i runs from vertex i to the next. One of them is to be contact, "
        "one dirichlet; with sections [boundary.NAME], one is to be of the type contact.",
        'boundary = ["contact", "dirichlet", "neumann", "dirichlet"]'),
    Key("domain", "size", "a number above 0", "", "Length of a facet on the coarsest mesh; at "
        "most the domain's diameter, the largest distance between two of its points.",
        "size = 0.25"),
    Key("domain", "arcs", "a list of { edge, through }", "straight edges", "Edges that are "
        "circular arcs: the number of the edge, and a point [x, y] between its ends that the arc "
        "passes through. With an arc two vertices are enough. It is cut into equal straight "
        "facets, no longer than `size` and 24 or more for a full circle, so that they are nowhere "
        "further from the arc than a thirtieth of their length and 1 % of the radius. Solved, "
        "refined and certified is the problem on this polygon: finer meshes do not come closer "
        "to the arc, a smaller `size` does.",
        "arcs = [{ edge = 2, through = [0, 1.2] }]"),
    Key("domain", "holes", "a list of { vertices, boundary } or { center, radius, boundary }",
        "no holes", "Polygons, which may have `arcs`, and circles, cut like them, inside the "
        "polygon and apart from one another. A polygon has labels of its own; a circle has one, "
        "which is no list.",
        'holes = [{ vertices = [[0.2, 0.4], [0.5, 0.4], [0.3, 0.7]], '
        'boundary = ["neumann", "neumann", "neumann"] }, '
        '{ center = [-0.5, 0.5], radius = 0.2, boundary = "neumann" }]'),
    Key("domain", "mesh", "the path of a .msh file, relative to this one", "", "A gmsh file, 2.2 "
        "or 4.1, in the place of the polygon; physical curves named contact, dirichlet and "
        "neumann, or as sections [boundary.NAME] are, are the parts of its boundary.",
        'mesh = "signorini.msh"'),
    Key("data", "f", EXPRESSION, "0, or derived from `exact.u`", "The load.", 'f = "-3 + x*y"'),
    Key("data", "g", EXPRESSION, "0, or derived from `exact.u`", "The flux κ∂ₙu on neumann edges.",
        'g = "where(y > 0.5, 1, 0)"', used_on="neumann"),
    Key("data", "obstacle", EXPRESSION, "0", "α: u stays above it on contact edges.",
        'obstacle = "0.1*sin(2*pi*x) - 0.25"', used_on="contact"),
    Key("data", "dirichlet", EXPRESSION, "0, or derived from `exact.u`",
        "u_D: the value of u on dirichlet edges. It is to be continuous, and not below the "
        "obstacle where the two parts meet.", 'dirichlet = "0.2*y"', used_on="dirichlet"),
    Key("data", "coefficient", TENSOR, "1", "κ, above 0 everywhere. It may jump. A tensor is "
        "symmetric, with eigenvalues above 0: [[\"2\", \"0.5\"], [\"0.5\", \"1\"]].",
        'coefficient = "where(x < 0, 1, 100)"', least=ABOVE),
    Key("data", "reaction", EXPRESSION, "0", "c of −∇·(κ∇u) + c u = f, nowhere below 0.",
        "reaction = 2", least=NOT_BELOW),
    Key(PART, "type", '"contact", "dirichlet", "neumann" or "robin"', "", "What holds there: u ≥ "
        "obstacle, or u ≤ upper, or both; u = value; κ∂ₙu = g; κ∂ₙu + coefficient (u − external) "
        "= g. On contact parts that has the pressure of the obstacle on its right, too.",
        'type = "contact"'),
    Key(PART, "obstacle", EXPRESSION, "0; nothing where there is an `upper`", "contact: α, which u "
        "is not to be below.", 'obstacle = "0.1*x"'),
    Key(PART, "upper", EXPRESSION, "nothing", "contact: β, which u is not to be above, instead of "
        "an obstacle or together with it.", "upper = 10"),
    Key(PART, "value", EXPRESSION, "0, or derived from `exact.u`", "dirichlet: u_D.", "value = 8"),
    Key(PART, "g", EXPRESSION, "0, or derived from `exact.u` but for contact",
        "neumann, robin, contact: the flux into the domain.", "g = 0.5"),
    Key(PART, "coefficient", EXPRESSION, "0", "robin, contact: what is lost there by a unit of u; "
        "nowhere below 0.", "coefficient = 20", least=NOT_BELOW),
    Key(PART, "external", EXPRESSION, "0", "robin, contact: the u at which nothing is lost.",
        "external = -10"),
    Key(MATERIAL, "polygon", "a list of points [x, y]", "", "Where the domain consists of it: "
        "what of it lies in this polygon. Its edges become lines of the mesh. Polygons may "
        "share edges, and reach beyond the domain, but not overlap. Needed, unless there is a "
        "`domain.mesh`, which has physical surfaces of such names.",
        "polygon = [[0, 0], [1, 0], [1, 1], [0, 1]]"),
    Key(MATERIAL, "coefficient", TENSOR, "that of [data]", "κ there: a number, or a tensor as that "
        "of wood along its grain and across.", "coefficient = [[0.3, 0], [0, 0.12]]", least=ABOVE),
    Key(MATERIAL, "f", EXPRESSION, "that of [data]", "The load there.", "f = -2"),
    Key(MATERIAL, "reaction", EXPRESSION, "that of [data]", "c there.", "reaction = 2",
        least=NOT_BELOW),
    Key(MATERIAL, "capacity", "a number above 0", "that of [time]", "What multiplies ∂u/∂t there, "
        "with a section [time].", "capacity = 1.7e6"),
    Key("exact", "u", EXPRESSION, "not known", "The solution, where it is known: errors and rates "
        "are then computed, and f, g and dirichlet, where left out, are derived from it. No "
        "kinks then, and no jumps of κ: what flows there is in no f. An error above the certified "
        "bound is told.",
        'u = "x**2 - y**2"'),
    Key("refine", "mode", '"uniform" or "adaptive"', '"uniform"', "Every triangle into four; or "
        "where the error sits. With [time] one mesh serves all steps; it is adapted to all of them "
        "by runs on coarser ones.", 'mode = "adaptive"'),
    Key("refine", "levels", "a whole number above 0", "1; if adaptive, as many as it takes",
        "Number of meshes, the coarsest included.", "levels = 5", ends=True),
    Key("refine", "tolerance", "a number, 0 or above", USUAL["tolerance"],
        "Adaptive: stop when the certified bound of ‖∇(u − u_h)‖ is below it, with [time] in each "
        "step. All stop where nothing but rounding is left of it.",
        "tolerance = 0.05", not_negative, ends=True),
    Key("refine", "max_dofs", "a whole number above 0", USUAL["max_dofs"],
        "Adaptive: stop before a mesh with more degrees of freedom.", "max_dofs = 200000", whole,
        ends=True),
    Key("refine", "fraction", "a number above 0, at most 1", USUAL["fraction"],
        "Adaptive: the part of the squared bound that the cells to be refined hold. Less takes "
        "more meshes, and fewer cells for the same bound.", "fraction = 0.3", fraction),
    Key("time", "end", "a number above 0", "", "The last time; the first is 0. Needed.",
        "end = 36000"),
    Key("time", "steps", "a whole number above 0", "", "Steps of equal length. Needed.",
        "steps = 60"),
    Key("time", "scheme", '"euler" or "bdf2"', '"euler"', "Implicit Euler, of first order; or the "
        "backward difference of second order.", 'scheme = "bdf2"'),
    Key("time", "initial", EXPRESSION, "0", "u at the time 0.", 'initial = "8 - 2*y"'),
    Key("time", "capacity", "a number above 0", "1", "What multiplies ∂u/∂t.", "capacity = 2e6"),
    Key(QUANTITY, "force", "a contact part", "", "The contact force ∫ λ on it.",
        'force = "contact"'),
    Key(QUANTITY, "flux", "a dirichlet part", "", "The flux ∫ κ∂ₙu through it, into the domain.",
        'flux = "dirichlet"'),
    Key(QUANTITY, "mean", "another part, a material, or domain", "", "The mean of u over it.",
        'mean = "neumann"'),
    Key(QUANTITY, "integral", "another part, a material, or domain", "", "The integral of u over "
        "it.", 'integral = "domain"'),
    Key(QUANTITY, "weight", EXPRESSION, "1", "w, of either sign, beside one of these: it makes "
        "∫ w λ of the force, ∫ w κ∂ₙu of the flux, ∫ w u of the integral, and of the mean "
        "∫ w u / ∫ w. For a force or a flux it is to be continuous on the part, and 0 where the "
        "part touches other dirichlet or contact parts.", 'weight = "1 - x**2"'),
    Key("units", "x", WORD, "not told", "Of lengths, along both axes.", 'x = "m"'),
    Key("units", "u", WORD, "not told", "Of u.", 'u = "°C"'),
    Key("units", "time", WORD, "not told", "Of t.", 'time = "h"'),
    Key("units", "flux", WORD, "not told", "Of κ∂ₙu, and so of the contact pressure.",
        'flux = "W/m²"'),
    Key("units", "force", WORD, "not told", "Of what flows through a whole part: of the contact "
        "force, and of [quantities].", 'force = "W/m"'),
    Key("names", "x", WORD, "not told", "Of the axis to the right.", 'x = "distance"'),
    Key("names", "y", WORD, "not told", "Of the axis upwards.", 'y = "height"'),
    Key("names", "u", WORD, "not told", "Of u.", 'u = "temperature"'),
    Key("names", "flux", WORD, '"contact pressure"', "Of what u gets on contact parts.",
        'flux = "heat"'),
)  # fmt: skip

ABOUT = {
    "": "At the top of the file, before all sections.",
    "domain": "A polygon, or a mesh. Needed.",
    "define": "Helper names, usable in what follows and in [data] and [exact], in this order.",
    PART: "Optional, one section for each part that has a name of its own; dirichlet, neumann and "
    "contact need none. With such sections there need be no dirichlet part where `reaction` or a "
    "`coefficient` holds the solution.",
    MATERIAL: "Optional, one section for each material that has a name. Its cells, on the coarsest "
    "mesh and when they are refined, have its data in the place of those in [data], which are for "
    "cells without material, and for what is left out here.",
    "data": "What is left out is 0; all of it may be where there are sections `[boundary.NAME]`. "
    "An expression stands between quotes.",
    "exact": "Optional.",
    "refine": "Optional.",
    "time": "Optional: capacity ∂u/∂t − ∇·(κ∇u) + c u = f, step by step. `t` may then stand in "
    "every expression; where those of κ, c or the coefficients of parts hold it, the matrix is "
    "assembled anew in each step. The bound of a step is that of its own problem, in which the "
    "steps before are data.",
    "units": "Optional. What is printed, written and drawn says them; nothing is converted, all "
    "data are to be in these units.",
    "names": "Optional. What stands in pictures beside x, y, u and the pressure.",
    QUANTITY: "Optional. What is wanted in an interval that is sure to hold it, each under a "
    "name of your own: one of `force`, `flux`, `mean` and `integral`, and where it is wanted. A "
    "part of a force or a flux must not touch other dirichlet or contact parts, where these have "
    f"no bounds, unless a `weight` vanishes there; `{DOMAIN}` is all of the domain, unless a part "
    "or a material is called so.",
}
"""The sections, and what is said of each."""

SECTIONS = tuple(name.split(".")[0] for name in ABOUT if name)


ADAPTIVE = {
    key.name: (key.argument, DEFAULTS[key.name]) for key in KEYS if key.argument is not None
}
"""The keys that only adaptive refinement has: how each is read, and what it is when left out."""
ENDS = tuple(f"{key.section}.{key.name}" for key in KEYS if key.ends)
"""The keys that say where a run ends, and nothing else."""
EXPRESSIONS = {f"{key.section}.{key.name}": key for key in KEYS if key.is_expression}
"""The keys whose values are expressions."""


def allowed(section: str) -> tuple[str, ...]:
    """Return the keys that may be in a section."""
    return tuple(key.name for key in KEYS if key.section == section)


def section_of(name: str) -> str | None:
    """Find the section that a key belongs to, in brackets; None if it belongs to none."""
    section = next((key.section for key in KEYS if key.name == name), "")
    return f"[{section}]" if section else None


def page() -> str:
    """Write the reference of the problem file, in Markdown."""
    lines = [
        "# The problem file",
        "",
        "TOML in UTF-8. A key that is not listed here, a value of another kind, and data that make "
        "no sense are refused with the key, what was found and what is allowed; `signorini-cr "
        "check FILE` does that without solving.",
        "",
    ]
    for section, about in ABOUT.items():
        title = "quantities" if section == QUANTITY else section
        lines += [f"## [{title}]" if section else "## Title", "", about, ""]
        if section == "define":
            example = ["[define]", 'r = "sqrt(x**2 + y**2)"', 'w = "r**1.5*cos(1.5*atan2(y, x))"']
            lines += ["```toml", *example, "```", ""]
            continue
        lines += ["| key | value | if left out | |", "|---|---|---|---|"]
        keys = [key for key in KEYS if key.section == section]
        lines += [f"| `{k.name}` | {k.value} | {k.default} | {k.about} |" for k in keys]
        lines += ["", "```toml", *([f"[{title}]"] if section else [])]
        if section == QUANTITY:
            lines += QUANTITIES_EXAMPLE
            keys = []
        lines += [("# or: " if key.name == "mesh" else "") + key.example for key in keys]
        lines += ["```", ""]
    names = ", ".join(f"`{name}`" for name in FUNCTIONS)
    variables = ", ".join(f"`{name}`" for name in (*VARIABLES, *CONSTANTS))
    lines += [
        "## Expressions",
        "",
        f"Numbers, {variables}, names from [define]; `+ - * / **` and parentheses; comparisons "
        "`< <= > >= == !=`, and, or, not; and the functions "
        f"{names}. `where(condition, a, b)` is a where the condition holds and b elsewhere; min "
        "and max take two or more. Angles are in radians. Expressions are parsed, never run as "
        "Python.",
        "",
        "*This page is made by `./container/run python3 docs/reference.py` from the table that the "
        "program reads files by.*",
    ]
    return "\n".join(lines) + "\n"
