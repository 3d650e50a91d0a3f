"""A film of meshes that adapt: where triangles are cut, and what that does to the bound.

    mpirun -n 2 python3 demos/film.py [FOLDER]

writes FOLDER/adaptive.gif (FOLDER is demo-output without an argument).
"""

from __future__ import annotations

import io
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from study import comm, levels_wanted, wanted_folder

from signorini_cr import Solution, exact, plots, solve_adaptive, solve_levels
from signorini_cr.errors import on_root
from signorini_cr.output import canvas
from signorini_cr.rounding import at_most

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from PIL.Image import Image

MAX_DOFS = 8_000
LAST, EACH = 4000, 700
"""Milliseconds that the last frame stands, and the others."""

Curve = list[tuple[int, float]]


def bound(solution: Solution) -> tuple[int, float]:
    """Its number of unknowns and its certified bound; collective."""
    found = solution.certificate.bound_h1
    assert found is not None
    return solution.dofs, found


def draw_bounds(axes: Axes, adaptive: Curve, uniform: Curve, points: Curve) -> None:
    """The bounds so far, on axes wide enough for all `points`."""
    for curve, style, colour, words, height in (
        (uniform, "s--", canvas.GREY, "all triangles cut", 0.13),
        (adaptive, "o-", canvas.BLUE, "triangles cut where the error sits", 0.05),
    ):
        axes.loglog(*zip(*curve, strict=True), style, color=colour, markersize=6, linewidth=1.8)
        axes.text(0.04, height, words, color=colour, fontsize=13, transform=axes.transAxes)
    dofs, bounds = zip(*points, strict=True)
    axes.set_xlim(0.6 * min(dofs), 1.8 * max(dofs))
    axes.set_ylim(0.4 * min(bounds), 1.4 * max(bounds))
    axes.set_xlabel("degrees of freedom", fontsize=13)
    axes.set_ylabel("certified bound of the error", fontsize=13)
    axes.set_title(f"the error is at most {at_most(adaptive[-1][1], 2)}", fontsize=14)
    axes.tick_params(labelsize=11)
    axes.grid(which="major", alpha=0.3)
    canvas.log_ticks(axes.yaxis)


def film(path: Path, max_dofs: int) -> None:
    """Solve, draw a frame a mesh, and put them together; collective."""
    coarsest, problem = exact.L.mesh(0.5), exact.L.problem
    solutions = list(solve_adaptive(problem, coarsest, max_dofs=max_dofs, fraction=0.3))
    levels = 1 + int(np.log(max_dofs / solutions[0].dofs) / np.log(4))
    uniform = [bound(solution) for solution in solve_levels(problem, coarsest, levels)]
    adaptive = [bound(solution) for solution in solutions]
    frames: list[Image] = []
    for number, solution in enumerate(solutions, 1):
        axes = bounds = None
        if comm.rank == 0:
            figure = canvas.new_figure(11.0, 5.6)
            figure.set_layout_engine("none")  # that moves axes from frame to frame
            axes = figure.add_axes((0.07, 0.2, 0.4, 0.7))
            bounds = figure.add_axes((0.58, 0.2, 0.4, 0.7))
        plots.plot_mesh(solution.domain, ax=axes)
        if bounds is not None:
            so_far = [each for each in uniform if each[0] <= adaptive[number - 1][0]]
            draw_bounds(bounds, adaptive[:number], so_far, adaptive + uniform)
            frames.append(as_frame(figure))
    on_root(comm, lambda: frames[0].save(
        path, save_all=True, append_images=frames[1:], loop=0, optimize=True,
        duration=[EACH] * (len(frames) - 1) + [LAST],
    ))  # fmt: skip


def as_frame(figure: Figure) -> Image:
    """The figure in few colours, all frames of one size."""
    from PIL import Image

    file = io.BytesIO()
    figure.savefig(file, format="png", dpi=80)
    with Image.open(file) as image:
        return image.convert("RGB").quantize(64, dither=Image.Dither.NONE)


if __name__ == "__main__":
    folder = wanted_folder("demo-output")
    folder.mkdir(parents=True, exist_ok=True)
    film(folder / "adaptive.gif", MAX_DOFS // 4 ** (8 - levels_wanted(8)))
