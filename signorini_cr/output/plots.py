"""Pictures: the mesh and its boundary parts, u_h, what happens on Γ1, convergence.

Matplotlib is loaded when a picture is drawn, on rank 0 alone, and used through its objects:
nothing global is touched. Functions that take a domain or a solution are collective.

All of them take a path for a PNG, or Axes to draw on, or neither; they return the figure on rank 0,
None elsewhere, and a notebook shows it.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any

import numpy as np
from dolfinx import fem
from dolfinx.mesh import Mesh, entities_to_geometry
from mpi4py import MPI

from ..arrays import FloatArray
from ..compat import cell_nodes
from ..errors import InputError, on_root
from ..fem.layout import Layout
from ..fem.space import closure_dofs, facet_measures
from ..mesh.domain import CONTACT, DIRICHLET, NEUMANN, PARTS, Domain, named
from ..mesh.plane import cross
from ..rounding import at_most
from .canvas import (
    BLUE,
    GREY,
    RED,
    YELLOW,
    chains,
    contour_heights,
    draw_cells,
    draw_contours,
    draw_lines,
    fit,
    grouped,
    headline,
    label_bar,
    label_ends,
    legend,
    letters,
    log_ticks,
    new_figure,
    plane_axes,
    save,
    short_numbers,
)
from .contactpage import contact_page
from .files import Where
from .raster import averaged, plane, raster
from .touching import contact_lines, in_words
from .units import PLAIN, literal
from .units import Units as Units

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure, SubFigure

    from ..fem.problem import Problem
    from ..solution import Solution

_USUAL = {part: name for name, part in PARTS.items()}
"""Kinds of conditions on these parts, unless a problem says otherwise."""
STYLES: dict[int, dict[str, Any]] = {
    DIRICHLET: {"color": BLUE, "linewidth": 2.5, "label": r"$\Gamma_0$: Dirichlet"},
    NEUMANN: {"color": YELLOW, "linewidth": 3.5, "label": r"$\Gamma_g$: Neumann"},
    CONTACT: {"color": RED, "linewidth": 4.5, "label": r"$\Gamma_1$: contact"},
}
OTHERS = ("#009e73", "#cc79a7", "#56b4e9", "#e69f00", "black")
"""Colours of further parts, one after the other."""
TINTS = ("#d0d0d0", "#c6dbef", "#fdd8b0", "#d5ecd0", "#dadaeb")
"""Colours of materials, one after the other."""
SERIES = {
    "error_h1": {"color": BLUE, "marker": "o", "label": r"$\|\nabla_h(u-u_h)\|$"},
    "bound_h1": {
        "color": YELLOW,
        "marker": "D",
        "linestyle": "--",
        "label": "certified bound of\n" r"$\|\nabla_h(u-u_h)\|$",
    },
    "error_l2": {"color": RED, "marker": "s", "label": r"$\|u-u_h\|$"},
}
_SAME = 1e-6
"""By less, in parts of what u_h differs by, values do not differ on a picture."""
MOST_EDGES = 40_000
"""A mesh with more edges is drawn without those inside."""


def _styles(domain: Domain, problem: Problem | None) -> dict[int, dict[str, Any]]:
    """Choose how the parts of the boundary are drawn, and say what holds there if it is known."""
    kinds = {}
    for key, condition in getattr(problem, "conditions", {}).items():
        kinds[named(domain.parts, key)] = condition.kind
    called = {part: name for name, part in domain.parts.items()}
    styles = {
        part: style
        for part, style in STYLES.items()
        if kinds.get(called.get(part, ""), _USUAL[part]).lower() == _USUAL[part]
    }
    own = [(name, part) for name, part in domain.parts.items() if part not in styles]
    colors = itertools.cycle(OTHERS)
    for (name, part), color in zip(own, colors, strict=False):
        label = f"{name}: {kinds[name]}" if name in kinds else name
        styles[part] = {"color": color, "linewidth": 3.5, "label": literal(label)}
    return styles


def can_draw(comm: MPI.Comm) -> bool:
    """Tell whether rank 0 has Matplotlib; collective."""
    return on_root(comm, lambda: find_spec("matplotlib") is not None)


def plot_mesh(
    domain: Domain,
    path: Where | None = None,
    title: str = "",
    ax: Axes | None = None,
    units: Units = PLAIN,
    problem: Problem | None = None,
) -> Figure | SubFigure | None:
    """Draw the mesh with Γ0, Γ1 and Γg, and its materials.

    Args:
        domain: A plane domain.
        path: The PNG to write, if any.
        title: What the picture is of, say the problem's name.
        ax: Axes to draw on, on rank 0.
        units: What u and the axes are called and measured in.
        problem: Whose conditions are told beside the parts that have names of their own.

    Raises:
        InputError: The domain is not plane, or the file can't be written.
    """
    mesh = plane(domain)
    cells, edges = mesh.topology.index_map(2).size_global, _edges(mesh)
    parts = {part: _segments(domain, part) for part in domain.parts.values()}
    triangles = {name: _triangles(domain, name) for name in domain.materials.numbers}

    def draw() -> Figure | SubFigure:
        points = np.concatenate(list(parts.values())).reshape(-1, 2)
        figure, axes, _ = plane_axes(points, ax=ax, units=units)
        for (name, cells_of), tint in zip(triangles.items(), itertools.cycle(TINTS)):
            if len(cells_of):
                draw_cells(axes, cells_of, color=tint, label=literal(name))
        draw_lines(axes, edges, color=GREY, linewidth=np.clip(30 / np.sqrt(cells), 0.15, 0.8))
        for part, style in _styles(domain, problem).items():
            if len(parts[part]):
                lines = chains(parts[part])
                draw_lines(axes, lines, zorder=3, capstyle="round", joinstyle="round", **style)
        legend(figure, ncols=3, ax=ax)
        hidden = "" if len(edges) else ", inner edges not drawn"
        axes.set_title(headline(title, f"mesh of {grouped(cells)} cells{hidden}"), fontsize=14)
        fit(ax)
        save(figure, path)
        return figure

    return drawn(mesh.comm, draw)


def plot_solution(
    solution: Solution,
    path: Where | None = None,
    title: str = "",
    ax: Axes | None = None,
    units: Units = PLAIN,
) -> Figure | SubFigure | None:
    """Draw u_h as it is, jumps across the edges included, and where it is in contact.

    Args:
        solution: On a plane domain.
        path: The PNG to write, if any.
        title: What the picture is of, say the problem's name.
        ax: Axes to draw on, on rank 0.
        units: What u and the axes are called and measured in.

    Raises:
        InputError: The domain is not plane, or the file can't be written.
    """
    domain, contact = solution.domain, solution.contact
    mesh = plane(domain)
    image, box, limits = raster(solution.u)
    mean, of_parts = _smooth(solution, limits)
    smooth, words = raster(mean)[0], in_words(contact)
    boundary = np.concatenate([_segments(domain, part) for part in domain.parts.values()])
    touching, free = contact_lines(contact)

    def draw() -> Figure | SubFigure:
        from matplotlib.patheffects import Normal, Stroke

        figure, axes, width = plane_axes(box, room=1.5, ax=ax, units=units)
        shown = axes.imshow(
            image,
            extent=(box[0, 0], box[1, 0], box[0, 1], box[1, 1]),
            origin="lower",
            aspect=axes.get_aspect(),
            vmin=limits[0],
            vmax=limits[1],
        )
        inner = contour_heights(limits)
        draw_contours(axes, smooth, box, _beside(inner, of_parts, limits))
        draw_lines(axes, chains(boundary), color="black", linewidth=1.5, joinstyle="round")
        if len(free):
            outlined = [Stroke(linewidth=5.5, foreground="black"), Normal()]
            style: dict[str, Any] = {"color": "white", "linewidth": 3.5, "path_effects": outlined}
            draw_lines(axes, chains(free), zorder=3, **style)
            axes.plot([], [], label="no contact", **style)
        if len(touching):
            draw_lines(axes, chains(touching), color=RED, linewidth=5.5, zorder=3,
                       label="contact")  # fmt: skip
        points = contact.transitions
        if len(points):
            axes.plot(points[:, 0], points[:, 1], linestyle="none", marker="o", markersize=7,
                      color="white", markeredgecolor="black", zorder=4, clip_on=False,
                      label="contact begins or ends")  # fmt: skip
        if ax is not None and figure.get_layout_engine() is None:  # the bar takes its place of them
            x0, y0, whole, height = ax.get_position().bounds
            ax.set_position((x0, y0, 0.84 * whole, height))
        beside = axes.inset_axes((1.0 + 0.15 / width, 0.0, 0.25 / width, 1.0))
        bar = figure.colorbar(shown, cax=beside)
        bar.set_ticks(list(inner) if len(inner) else list(limits))
        for height in inner:
            bar.ax.axhline(height, color="white", linewidth=0.8, alpha=0.7)
        label_bar(bar, units)
        bar.ax.tick_params(labelsize=11)
        short_numbers(bar.ax.yaxis)
        legend(figure, ncols=3, ax=ax)
        axes.set_title(headline(title, f"$u_h$, {words}"), fontsize=14)
        fit(ax, bar.ax)
        save(figure, path)
        return figure

    return drawn(mesh.comm, draw)


def plot_contact(
    solution: Solution,
    path: Where | None = None,
    title: str = "",
    ax: Axes | None = None,
    units: Units = PLAIN,
) -> Figure | SubFigure | None:
    """Draw u_h with the obstacle, and the pressure λ_h below it, along Γ1.

    Args:
        solution: On a plane domain with a contact boundary.
        path: The PNG to write, if any.
        title: What the picture is of, say the problem's name.
        ax: Axes in a grid, on rank 0, whose place the panels take.
        units: What u, lengths and the pressure are called and measured in.

    Raises:
        InputError: The domain is not plane or has no Γ1, or the file can't be written.
    """
    comm, contact = plane(solution.domain).comm, solution.contact
    table = contact.table()
    if contact.number == 0:
        raise InputError("a picture of the contact needs a contact boundary")
    size = comm.allreduce(float(np.abs(solution.u.x.array).max(initial=0.0)), op=MPI.MAX)
    words = in_words(contact)

    def draw() -> Figure | SubFigure:
        assert table is not None
        figure = contact_page(table, contact.transitions, size, ax, units)
        figure.suptitle(headline(title, words), fontsize=14 * letters(figure))
        save(figure, path)
        return figure

    return drawn(comm, draw)


def plot_error(
    solution: Solution, path: Where | None = None, title: str = "", ax: Axes | None = None
) -> Figure | SubFigure | None:
    """Draw where the error sits: the cells' shares of the certified bound, as densities.

    The density of a cell is the root of its share of the bound's square over its area: adaptive
    refinement makes it even where the solution is smooth. Its unit is that of ∇u.

    Args:
        solution: On a plane domain.
        path: The PNG to write, if any.
        title: What the picture is of, say the problem's name.
        ax: Axes to draw on, on rank 0.

    Raises:
        InputError: The domain is not plane, there is no bound, or the file can't be written.
    """
    domain, mesh, certificate = solution.domain, plane(solution.domain), solution.certificate
    if certificate.bound_h1 is None or certificate.indicators is None:
        raise InputError(f"there is no bound to draw: {certificate.reason}")
    bound, number = at_most(certificate.bound_h1), len(certificate.indicators)
    corners = mesh.geometry.x[cell_nodes(mesh)[:number, :3], :2]
    area = 0.5 * np.abs(cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]))
    density = np.sqrt(np.maximum(certificate.indicators, 0.0) / area)
    triangles, values = _gather(mesh.comm, corners), _gather(mesh.comm, density)
    boundary = np.concatenate([_segments(domain, part) for part in domain.parts.values()])
    touching, _ = contact_lines(solution.contact)

    def draw() -> Figure | SubFigure:
        from matplotlib.colors import LogNorm

        figure, axes, width = plane_axes(boundary.reshape(-1, 2), room=1.5, ax=ax)
        # A corner has few cells of very high density: they must not take all colours
        bottom, top = np.quantile(np.maximum(values, 1e-300), (0.005, 0.995))
        cells = draw_cells(
            axes,
            triangles,
            array=np.clip(values, bottom, top),
            norm=LogNorm(bottom, max(top, 1.0001 * bottom)),
            edgecolors="white" if len(values) < 10_000 else "face",
            linewidths=np.clip(15 / np.sqrt(len(values)), 0.1, 0.5),
            rasterized=True,
        )
        draw_lines(axes, chains(boundary), color="black", linewidth=1.5, joinstyle="round")
        if len(touching):
            draw_lines(axes, chains(touching), color=RED, linewidth=4.5, zorder=3, label="contact")
            legend(figure, ncols=1, ax=ax)
        beside = axes.inset_axes((1.0 + 0.15 / width, 0.0, 0.25 / width, 1.0))
        bar = figure.colorbar(cells, cax=beside)
        log_ticks(bar.ax.yaxis)
        bar.set_label(r"$|\nabla(u-u_h)|$ by a cell's share of the bound", fontsize=12)
        known = f"where the error sits, at most {bound} in all"
        axes.set_title(headline(title, known), fontsize=14)
        fit(ax, bar.ax)
        save(figure, path)
        return figure

    return drawn(mesh.comm, draw)


def convergence_series(records: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return the keys of the records that `plot_convergence` has something to draw of."""
    return [key for key in SERIES if sum(bool(record[key]) for record in records) > 1]


def plot_convergence(
    records: Sequence[Mapping[str, Any]],
    path: Where | None = None,
    title: str = "",
    ax: Axes | None = None,
    units: Units = PLAIN,
) -> Figure | SubFigure:
    """Draw errors, and the certified bound, with the slopes of an undisturbed convergence.

    They are drawn against h, or against the number of dofs where refinement was adaptive and h
    says little.

    Args:
        records: From `output.level_record`; two at least with an error or a bound.
        path: The PNG to write, if any, by this rank.
        title: What the picture is of, say the problem's name.
        ax: Axes to draw on.
        units: What lengths are measured in.

    Raises:
        InputError: There is nothing to draw, or the file can't be written.
    """
    keys = convergence_series(records)
    if not keys:
        raise InputError("a picture of convergence needs two levels with an error or a bound")
    sizes = np.array([record["h"] for record in records])
    uniform = bool(np.all(sizes[1:] < 0.7 * sizes[:-1]))
    axes = ax or new_figure(9.5, 6.0).subplots()
    ends: list[tuple[float, float]] = []
    falls: dict[str, str] = {}
    measured = {"error_l2": " ".join(filter(None, (units.u, units.x)))}
    styles: list[dict[str, Any]] = []
    for key in keys:
        used = [record for record in records if record[key]]
        x = np.array([record["h" if uniform else "dofs"] for record in used])
        values = np.array([record[key] for record in used])
        style = dict(SERIES[key])
        rate = used[-1][key.replace("error", "rate")] if uniform and "error" in key else None
        if unit := measured.get(key, units.u):
            style["label"] += " in " + literal(unit)
        if rate is not None:
            style["label"] += f",\nlast rate {rate:.2f}"
        axes.loglog(x, values, markersize=7, linewidth=2, **style)
        styles.append(style)
        last = int(np.argmax(x))
        ends.append((x[last], values[last]))
        falls[key] = _course(x, values, rate, uniform)
        if (key == "bound_h1" and "error_h1" in keys) or not np.ptp(x):
            continue
        # A slope below the curve, touching it but for the factor
        order = (2 if key == "error_l2" else 1) * (1.0 if uniform else -0.5)
        slope = x**order
        slope *= 0.6 * np.min(values / slope)
        power = {1.0: "$h$", 2.0: "$h^2$", -0.5: "$N^{-1/2}$", -1.0: "$N^{-1}$"}[order]
        axes.loglog(x, slope, ":", color="black")
        axes.annotate(power, (np.sqrt(x[0] * x[-1]), np.sqrt(slope[0] * slope[-1])), fontsize=14,
                      xytext=(8 * np.sign(order), -5), textcoords="offset points",
                      ha="left" if uniform else "right", va="top")  # fmt: skip
    if uniform and len(sizes) <= 8:
        axes.set_xticks(sizes, [f"{h:.2g}" for h in sizes])
        axes.set_xticks([], minor=True)
    size = f"$h${units.within('x')}"
    axes.set_xlabel(size if uniform else "number $N$ of degrees of freedom", fontsize=14)
    if not uniform:
        log_ticks(axes.xaxis)
    kinds = sorted({"bound" if key == "bound_h1" else "error" for key in keys}, reverse=True)
    axes.set_ylabel(", ".join(kinds), fontsize=13)
    axes.tick_params(labelsize=11)
    axes.grid(which="both", alpha=0.25)
    log_ticks(axes.yaxis)
    label_ends(axes, ends, *([style[key] for style in styles] for key in ("label", "color")))
    axes.set_title(headline(title, _message(falls)), fontsize=14)
    save(axes.figure, path)
    return axes.figure


def _course(x: FloatArray, values: FloatArray, rate: float | None, uniform: bool) -> str:
    """Say with which power of h or N the last two values fall, if they do and there is one."""
    before, last = (float(value) for value in values[-2:])
    if rate is None and x[-1] != x[-2]:
        rate = float(np.log(last / before) / np.log(x[-1] / x[-2]))
    fall = 0.0 if rate is None else round(rate if uniform else -rate, 2)
    if 0.0 < fall < np.inf:
        return f"falls like ${f'h^{{{fall:.2f}}}' if uniform else f'N^{{{-fall:.2f}}}'}$"
    if last == before:
        return "stays as it is"
    return "falls" if last < before else "rises"


def _message(falls: Mapping[str, str]) -> str:
    """Say what a picture of convergence shows."""
    key, course = next(iter(falls.items()))
    said = f"the {'bound' if key == 'bound_h1' else 'error'} {course}"
    of_bound = falls.get("bound_h1") if key == "error_h1" else None
    if of_bound is None:
        return said
    same = of_bound.split()[0] == course.split()[0]
    return f"{said}, the bound {'with it' if same else of_bound}"


def drawn(comm: MPI.Comm, draw: Callable[[], Figure | SubFigure]) -> Figure | SubFigure | None:
    """Draw on rank 0, which alone gets the figure; collective."""
    figures: list[Figure | SubFigure] = []

    def attempt() -> None:
        from matplotlib import rc_context

        with rc_context({"text.usetex": False}):  # it has no words for λ and ‖∇u‖
            figures.append(draw())

    on_root(comm, attempt)
    return figures[0] if figures else None


def _gather(comm: MPI.Comm, array: FloatArray) -> FloatArray:
    """Gather the rows of all ranks on rank 0, none elsewhere."""
    pieces = comm.gather(array, root=0)
    return array[:0] if pieces is None else np.concatenate(pieces)


def _edges(mesh: Mesh) -> FloatArray:
    """Gather ends of all edges on rank 0, shape (n, 2, 2); none if there are too many to draw."""
    mesh.topology.create_entities(1)
    mesh.topology.create_connectivity(1, 2)
    mesh.topology.create_connectivity(2, 1)
    edges = mesh.topology.index_map(1)
    number = edges.size_local if edges.size_global <= MOST_EDGES else 0
    ends = np.zeros((0, 2), dtype=np.int32)
    if number:  # entities_to_geometry divides by it
        ends = entities_to_geometry(mesh, 1, np.arange(number, dtype=np.int32)).reshape(-1, 2)
    return _gather(mesh.comm, mesh.geometry.x[ends, :2])


def _triangles(domain: Domain, material: str) -> FloatArray:
    """Gather corners of a material's cells on rank 0, shape (n, 3, 2); none without edges drawn."""
    mesh = domain.mesh
    number = mesh.topology.index_map(2).size_local
    few = mesh.topology.index_map(1).size_global <= MOST_EDGES
    nodes = cell_nodes(mesh)[:number][few & domain.materials.where(material)[:number]]
    return _gather(mesh.comm, mesh.geometry.x[nodes, :2])


def _smooth(solution: Solution, limits: tuple[float, float]) -> tuple[fem.Function, list[float]]:
    """Make the function to draw contours of, and find its values on whole parts; collective.

    Means at vertices only nearly have the value that u_h has at all midpoints of a part, and its
    contour line would follow the part in shreds. There they get the value itself.
    """
    domain, u = solution.domain, averaged(solution.u)
    comm, layout, values = domain.mesh.comm, Layout.of_space(u.function_space), []
    for part in domain.parts.values():
        facets = domain.facets(part)
        middles = solution.u.x.array[closure_dofs(solution.u.function_space, facets)].mean(axis=1)
        low = comm.allreduce(float(middles.min(initial=np.inf)), op=MPI.MIN)
        high = comm.allreduce(float(middles.max(initial=-np.inf)), op=MPI.MAX)
        if not 0.0 <= high - low <= _SAME * (limits[1] - limits[0]):
            continue
        values.append(0.5 * (low + high))
        u.x.array[layout.nodes_at(facets)] = values[-1]
    return u, values


def _beside(
    heights: FloatArray, values: Sequence[float], limits: tuple[float, float]
) -> FloatArray:
    """Move heights of contour lines off those of whole parts by nothing that shows.

    A line then stays away from the part where all is on the other side, as most is.
    """
    low, high = limits
    found = heights.copy()
    for value in values:
        off = _SAME * (high - low) * (1.0 if value > 0.5 * (low + high) else -1.0)
        found[np.abs(heights - value) <= _SAME * (high - low)] = value + 2.0 * off
    return found


def _segments(domain: Domain, part: int) -> FloatArray:
    """Gather ends of the facets of a boundary part on rank 0, shape (n, 2, 2)."""
    ends, _ = facet_measures(domain.mesh, domain.facets(part))
    return _gather(domain.mesh.comm, ends[..., :2])
