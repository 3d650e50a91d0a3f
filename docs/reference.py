"""Write the reference's pages from the tables that the program goes by, and from its docstrings.

container/run python3 docs/reference.py
"""

import ast
import contextlib
import inspect
import io
import re
import textwrap
from collections.abc import Container
from functools import cached_property
from importlib import import_module
from itertools import pairwise
from pathlib import Path
from types import ModuleType
from typing import Any

from mpi4py import MPI

import signorini_cr
from signorini_cr import options
from signorini_cr.app.commandline import read_arguments
from signorini_cr.app.reference import page
from signorini_cr.multigrid.smoothing import SMOOTHERS
from signorini_cr.output.meanings import SECTIONS

MADE = "\n*This page is made by `./container/run python3 docs/reference.py` from {}.*\n"


def command() -> str:
    """What `--help` says, in Markdown."""
    lines = ["# The command", "", ABOUT_COMMAND, ""]
    for words in ([], ["solve"], ["check"]):
        text = io.StringIO()
        with contextlib.redirect_stdout(text), contextlib.suppress(SystemExit):
            read_arguments([*words, "--help"])
        lines += [f"## {' '.join(['signorini-cr', *words])}", "", "```text"]
        lines += [text.getvalue().rstrip(), "```", ""]
    lines += ["## Options of PETSc", "", ABOUT_OPTIONS, *_options(), ""]
    return "\n".join(lines) + MADE.format("`signorini-cr --help` and `signorini_cr/options.py`")


ABOUT_COMMAND = """\
Where the program is not installed, by pip for one, put `./container/run` before each command:
`./container/run signorini-cr solve FILE.toml`, `./container/run mpirun -n 2 signorini-cr …`."""

ABOUT_OPTIONS = f"""\
PETSc's options that begin with `-{options.PREFIX}` reach the solvers of this program, from its
command line and from that of any script. What follows the prefix is PETSc's own, such as
`ksp_rtol 1e-10`; users' come before what the program sets. Tolerances that are not named here are
computed.

| they begin with | they are about | set by the program |
|---|---|---|"""

AMG = "BoomerAMG, or GAMG where PETSc is without hypre"
P = options.PREFIX
PREFIXES: dict[str, tuple[str, str | dict[str, object]]] = {
    f"{P}snes_": ("the active set method; its steps are Newton's", options.NEWTON),
    f"{P}ksp_": ("the linear systems of its steps", options.REDUCED),
    f"{P}pc_": ("what preconditions them, in Python: the multigrid cycle", options.REDUCED),
    options.REDUCED_PREFIX: ("what SNES itself asks: a shell around those two", "its `ksp_type`"),
    options.BOTTOM_PREFIX: ("the bottom of the cycle", f"small ones are factorised; {AMG}"),
    options.ALONE_PREFIX: (
        "what takes the cycle's place where it is given up",
        f"factors, where they fit; {AMG}",
    ),
    options.ESTIMATE_PREFIX: ("the certificate: its sharpness, not its validity", f"CG; {AMG}"),
}


def _options() -> list[str]:
    """A table of the prefixes, and what is the program's own."""
    lines = []
    for prefix, (what, settings) in PREFIXES.items():
        if not isinstance(settings, str):
            kind = prefix.removeprefix(P)
            values = {
                name: f"{value:g}" if isinstance(value, float) else value
                for name, value in settings.items()
                if name.startswith(kind)
            }
            settings = ", ".join(f"`{name} {value}`" for name, value in values.items())
        lines.append(f"| `-{prefix}` | {what} | {settings} |")
    first, *others = SMOOTHERS
    named = " or ".join(f"`{name}`" for name in others)
    lines += [
        "",
        f"`-{P}smoother NAME` is the program's own: what smooths in the cycle, `{first}`, "
        f"the default, or {named}.",
        "`jacobi` takes twice the steps, and gives the same figures on any number of ranks.",
    ]
    return lines


def figures() -> str:
    """What every figure of a run means, in Markdown."""
    lines = [
        "# The figures",
        "",
        "What is printed, and what lies in the folder of a run: each column and each key. "
        "`signorini-cr solve --help columns` says the same. What does not exist is null, `-` on "
        "the screen, and empty in CSV.",
        "",
    ]
    for head, entries in SECTIONS.items():
        lines += [f"## {head}", "", "| name | meaning |", "|---|---|"]
        lines += [
            f"| `{name}` | {meaning.replace('|', chr(92) + '|')} |"
            for name, meaning in entries.items()
        ]
        lines.append("")
    return "\n".join(lines) + MADE.format("the table that the program prints its legend from")


ABOUT_PYTHON = """\
# Python names

Everything here is in `import signorini_cr as scr`, as `scr.solve` or `scr.plots.plot_mesh`, which
`from signorini_cr.plots import plot_mesh` finds as well, but for what has a path of its own, as in
`from signorini_cr.output.vtu import write_solution`; the version is `scr.__version__`. All
functions are collective, every rank calls them, unless they say otherwise. Lengths are in the units
of the mesh, u in those of the data.

There is a line for each name. `help(signorini_cr.solve_adaptive)` says the same, with what it
takes, returns and raises, and so for the others; numbers such as (1.6) are those of formulas in
[the method](method.md). The site that `make docs` makes has that below
each table, where the repository has a list of names.

| type | what it is |
|---|---|
| `Data` | a number, a UFL expression, or a function of x that returns one |
| `x` | `ufl.SpatialCoordinate(mesh)` |
| `ArrayLike` | what NumPy makes an array of: lists of lists, for one |
| `FloatArray`, `BoolArray` | NumPy arrays of float64, of bool |
| `Int32Array`, `Int64Array` | of int32, as DOLFINx's indices are, of int64 |
| `IndexArray` | of NumPy's own indices |

```{eval-rst}
.. currentmodule:: signorini_cr
```
"""

NAMES = {
    "The problem": """\
        Problem Material Form Domain Polygon read_gmsh Dirichlet Neumann Robin Contact
        mesh.families""",
    "Solving": "solve solve_levels solve_adaptive solve_in_time adapt_to_run Solver",
    "Results": """\
        Solution vi.contact.ContactFacts vi.contact.Kkt vi.solver.Iterations Certificate
        adaptive.Tried force.force_bounds force.flux means.mean means.integral force.Interval""",
    "Errors": "InputError NotConverged",
    "Known solutions and rates": "verification.exact verification.norms verification.theory",
    "Pictures and files": """\
        output.plots plots.Units output.notebook output.strip.moment output.strip.plot_strip
        output.vtu.write_solution output.vtu.write_vtu""",
}
"""What is on the page of Python names, in `signorini_cr`."""
HANDED_OUT = ("Results", "Errors")
"""Where the classes are those that the program makes, not its users."""


def python() -> str:
    """What users call, with the first line of what each says of itself, and the rest for Sphinx."""
    parts = [ABOUT_PYTHON]
    for head, names in NAMES.items():
        rows, blocks = [], []
        for name in names.split():
            thing = _named(name)
            rows += _rows(name, thing, called=head not in HANDED_OUT)
            blocks.append(f".. auto{_kind(thing)}:: signorini_cr.{name}")
        table = [f"| {call} | {text.replace('|', chr(92) + '|')} |" for call, text in rows]
        parts += [f"## {head}", "", "| name | what it is |", "|---|---|", *table, ""]
        parts += ["```{eval-rst}", *blocks, "```", ""]
    return "\n".join(parts) + MADE.format("the docstrings")


def _named(name: str) -> Any:
    """What a dotted name in `signorini_cr` stands for."""
    thing: Any = signorini_cr
    for part in name.split("."):
        if not hasattr(thing, part):
            import_module(f"{thing.__name__}.{part}")
        thing = getattr(thing, part)
    return thing


def _kind(thing: Any) -> str:
    """What Sphinx calls it."""
    if isinstance(thing, ModuleType):
        return "module"
    if inspect.isclass(thing):
        return "exception" if issubclass(thing, Exception) else "class"
    return "function"


def _rows(name: str, thing: Any, called: bool) -> list[tuple[str, str]]:
    """A name and what it is, and the same for what is in it."""
    if isinstance(thing, ModuleType):
        return _in_a_module(name, thing)
    if not inspect.isclass(thing):
        return [(f"**`{_call(name, thing)}`**", _first(thing))]
    known = _attributes(thing)
    call = _call(name, thing, only=known) if called else name
    rows = [(f"**`{call}`**", _first(thing)), *((f"`.{each}`", known[each]) for each in known)]
    for each, value in vars(thing).items():
        again = any(each in vars(base) for base in thing.__mro__[1:])  # and is told of there
        if again or each.startswith("_") or not value.__doc__:
            continue
        if isinstance(value, classmethod):
            rows.append((f"`{_call(f'{name}.{each}', getattr(thing, each))}`", _first(value)))
        elif inspect.isfunction(value):
            rows.append((f"`.{_call(each, value, bound=True)}`", _first(value)))
        elif isinstance(value, property | cached_property):
            rows.append((f"`.{each}`", _first(value)))
    return rows


def _in_a_module(name: str, module: ModuleType) -> list[tuple[str, str]]:
    """The module, its functions and classes, and the constants that a text follows."""
    short = {place: word for word, place in signorini_cr._MODULES.items()}.get(name, name)
    rows = [(f"**`{short}`**", _first(module))]
    for each, value in vars(module).items():
        own = inspect.isclass(value) or inspect.isfunction(value)
        if own and value.__module__ == module.__name__ and not each.startswith("_"):
            rows.append((f"`{_call(f'{short}.{each}', value)}`", _first(value)))
    body = ast.parse(inspect.getsource(module)).body
    for statement, after in pairwise(body):
        if isinstance(statement, ast.Assign) and isinstance(after, ast.Expr):
            constant, text = ast.unparse(statement.targets[0]), ast.literal_eval(after.value)
            if not constant.startswith("_"):
                rows.append((f"`{short}.{constant}`", _sentence(text.partition("\n\n")[0])))
    return rows


def _first(thing: Any) -> str:
    """The first line of a docstring."""
    return inspect.cleandoc(thing.__doc__).partition("\n")[0]


def _sentence(text: str) -> str:
    """The first sentence of a paragraph, on one line."""
    return re.split(r"(?<=\.) ", " ".join(text.split()))[0]


def _attributes(thing: type) -> dict[str, str]:
    """The attributes that a class's docstring tells of, and the first sentence on each."""
    _, _, told = inspect.cleandoc(thing.__doc__ or "").partition("Attributes:\n")
    block = textwrap.dedent(told.partition("\n\n")[0])
    found = re.findall(r"^(\w+): (.*(?:\n .*)*)", block, re.MULTILINE)
    return {name: _sentence(text) for name, text in found}


def _call(name: str, thing: Any, only: Container[str] = (), bound: bool = False) -> str:
    """How it is called: with defaults and without types.

    Args:
        name: What it is called by.
        thing: A class or a function.
        only: Arguments that are for users, all of them where it is empty.
        bound: Whether the first argument goes without saying.
    """
    parameters = list(inspect.signature(thing).parameters.values())[bound:]
    words, starred = [], False
    for each in parameters:
        if only and each.name not in only:
            continue
        if each.kind is each.KEYWORD_ONLY and not starred:
            words.append("*")
        starred = starred or each.kind in (each.KEYWORD_ONLY, each.VAR_POSITIONAL)
        star = {each.VAR_POSITIONAL: "*", each.VAR_KEYWORD: "**"}.get(each.kind, "")
        default = "" if each.default is each.empty else f"={_shown(each.default)}"
        words.append(f"{star}{each.name}{default}")
    return f"{name}({', '.join(words)})"


def _shown(value: Any) -> str:
    """A default as one would write it; what has no short form is three dots."""
    if isinstance(value, MPI.Comm):
        return "MPI.COMM_WORLD"
    plain = value is None or isinstance(value, int | float | str)
    return repr(value) if plain or (isinstance(value, tuple) and not value) else "…"


def modules() -> str:
    """What each module is for, street by street, in Markdown."""
    lines = ["# Module by module", "", ABOUT_MODULES, ""]
    folders = [PACKAGE, *sorted(path.parent for path in PACKAGE.glob("*/__init__.py"))]
    for folder in folders:
        lines += [f"## {folder.name}" if folder != PACKAGE else "## Beside the streets", ""]
        if folder != PACKAGE:
            lines += [" ".join(_docstring(folder / "__init__.py").split()), ""]
        lines += ["| module | |", "|---|---|"]
        for path in sorted(folder.glob("*.py")):
            if path.stem != "__init__":
                first = " ".join(_docstring(path).split("\n\n")[0].split())
                lines.append(f"| `{path.stem}` | {first.replace('|', chr(92) + '|')} |")
        lines.append("")
    return "\n".join(lines) + MADE.format("the modules' docstrings")


PACKAGE = Path(signorini_cr.__file__).parent
ABOUT_MODULES = """\
What each file of the package is for, in the words it begins with. `ARCHITECTURE.md`, beside the
README, draws the streets, and says where a change goes."""


def _docstring(path: Path) -> str:
    return ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or ""


PAGES = {
    "modules.md": modules,
    "problem-file.md": page,
    "command.md": command,
    "figures.md": figures,
    "python.md": python,
}

if __name__ == "__main__":
    for name, make in PAGES.items():
        (Path(__file__).parent / name).write_text(make(), encoding="utf-8")
