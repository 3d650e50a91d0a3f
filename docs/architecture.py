"""Draw docs/architecture.svg: the streets of the package, and who imports from whom.

    container/run python3 docs/architecture.py

All of it is read from the sources: a sub-package is a street, the modules beside them are the
drivers, if they import from a street, and the ground floor if they do not; a street stands above
all that it imports from.
"""

from __future__ import annotations

import ast
from graphlib import TopologicalSorter
from pathlib import Path

HERE = Path(__file__).parent
PACKAGE = HERE.parent / "signorini_cr"
PICTURE = HERE / "architecture.svg"

GROUND, DRIVERS = "ground floor", "drivers"
COLOURS = ("#004488", "#BB5566", "#997700", "#117733", "#882255", "#555555")

Arrows = set[tuple[str, str]]
"""Who imports, and from whom."""

Module = tuple[str, ...]
"""A module's name below the package, part by part; () for the package itself."""


def public(package: Path) -> dict[str, Module]:
    """The names that the front door of a package loads on first use, and whose they are."""
    tables: dict[str, str] = {}
    for node in ast.parse((package / "__init__.py").read_text(encoding="utf-8")).body:
        if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) in ("_ROOMS", "_MODULES"):
            tables |= ast.literal_eval(node.value)
    return {name: tuple(module.split(".")) for name, module in tables.items()}


def imports(path: Path, package: Path = PACKAGE) -> list[Module]:
    """List the modules and streets of a package that a file of it imports, wherever in it.

    A public name counts as the module that defines it, not as the front door.

    Raises:
        ValueError: An import within the package is not relative, so nobody would see it.
    """
    doors, found = public(package), []
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom) and node.level:
            base = path.parents[node.level - 1].relative_to(package).parts
            base += tuple(node.module.split(".")) if node.module else ()
            for alias in node.names:
                place = package.joinpath(*base, alias.name)
                if place.is_dir() or place.with_suffix(".py").exists():
                    found.append((*base, alias.name))
                else:
                    found.append(base or doors.get(alias.name, ()))
        elif isinstance(node, ast.ImportFrom | ast.Import):
            names = [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            names += [alias.name for alias in node.names]
            if any(name.split(".")[0] == package.name for name in names):
                raise ValueError(f"{path.name}: imports within the package are relative")
    return found


def read(package: Path = PACKAGE) -> Arrows:
    """List who imports from whom; what streets import from themselves is left out."""
    found: dict[str, set[str]] = {}
    for path in sorted(package.rglob("*.py")):
        if path.parent == package and path.stem.startswith("__"):
            continue  # the public names, loaded when they are first used
        names = found.setdefault(path.relative_to(package).parts[0].removesuffix(".py"), set())
        # what is left is the front door's own, as the version
        names |= {module[0] for module in imports(path, package) if module}
    streets = {name for name in found if (package / name).is_dir()}
    beside = {name: DRIVERS if streets & found[name] else GROUND for name in set(found) - streets}
    ends = {
        (beside.get(here, here), beside.get(there, there))
        for here, others in found.items()
        for there in others
    }
    return {(here, there) for here, there in ends if here != there}


def floors(arrows: Arrows) -> list[str]:
    """The streets from the top to the bottom.

    Raises:
        graphlib.CycleError: If there is a circle.
    """
    below: dict[str, set[str]] = {}
    for here, there in sorted(arrows):
        below.setdefault(here, set()).add(there)
    return list(TopologicalSorter(below).static_order())[::-1]


def charter(name: str) -> str:
    """The first line of a street's charter."""
    if name == GROUND:
        return "Errors, PETSc's options and memory, versions of DOLFINx."
    if name == DRIVERS:
        return "`solve`, `solve_levels`, `solve_adaptive`, and the solution they give."
    text = ast.get_docstring(ast.parse((PACKAGE / name / "__init__.py").read_text("utf-8")))
    return (text or "").split("\n")[0]


def draw(arrows: Arrows, path: Path = PICTURE) -> None:
    """Make the picture; the `id` of each arrow says what it joins."""
    import matplotlib

    matplotlib.use("svg")
    from matplotlib import pyplot as plt

    plt.rcParams.update({"svg.fonttype": "none", "svg.hashsalt": "signorini_cr"})
    order = floors(arrows)
    row = {name: -k for k, name in enumerate(order)}
    text, lane, column = 8.4, 0.24, 0.0
    lanes = []
    for k, here in enumerate(order):
        targets = [there for there in order if (here, there) in arrows]
        for there in targets:
            lanes.append((text + column, here, there, COLOURS[k % len(COLOURS)]))
            column += lane
        column += lane * bool(targets)
    width = text + column
    figure, axes = plt.subplots(figsize=(12.5, 0.62 * len(order)), layout="constrained")
    for name, y in row.items():
        box = plt.Rectangle((0, y - 0.28), width, 0.56, facecolor="#F2F2F2", edgecolor="#888888")
        axes.add_patch(box)
        axes.text(0.1, y, name, weight="bold", size=11, va="center")
        axes.text(2.15, y, charter(name), size=8, va="center")
    for x, here, there, colour in lanes:
        top, bottom = row[here], row[there]
        axes.plot(x, top, "o", color=colour, markersize=3.5)
        arrow = axes.annotate(
            "",
            xy=(x, bottom),
            xytext=(x, top),
            arrowprops={"arrowstyle": "-|>", "color": colour, "lw": 1.6},
        )
        arrow.arrow_patch.set_gid(f"{here} > {there}")
    axes.set(xlim=(-0.1, width + 0.1), ylim=(0.6 - len(order), 0.4))
    axes.axis("off")
    figure.savefig(path, metadata={"Date": None})


if __name__ == "__main__":
    draw(read())
