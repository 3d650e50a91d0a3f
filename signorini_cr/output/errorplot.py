"""The picture of a certificate: where the error sits."""

from __future__ import annotations

import numpy as np

from .. import compat
from ..errors import InputError, on_root
from ..fem.space import facet_measures
from ..mesh.plane import cross
from ..rounding import at_most
from ..solution import Solution
from .canvas import RED, chains, draw_lines, headline, legend, log_ticks, plane_axes, save
from .files import Where
from .touching import contact_lines


def plot_error(solution: Solution, path: Where, title: str = "") -> None:
    """Draw the cells' shares of the certified bound, as densities; collective.

    The density of a cell is the root of its share of the bound's square over its area: adaptive
    refinement makes it even where the solution is smooth.

    Args:
        solution: On a plane domain.
        path: The PNG to write.
        title: What the picture is of, say the problem's name.

    Raises:
        InputError: The domain is not plane, there is no bound, or the file can't be written.
    """
    certificate, mesh = solution.certificate, solution.domain.mesh
    if mesh.geometry.dim != 2 or mesh.topology.dim != 2:
        raise InputError("pictures are of plane domains only")
    if certificate.bound_h1 is None or certificate.indicators is None:
        raise InputError(f"there is no bound to draw: {certificate.reason}")
    bound = at_most(certificate.bound_h1)
    number = len(certificate.indicators)
    corners = mesh.geometry.x[compat.cell_nodes(mesh)[:number, :3], :2]
    area = 0.5 * np.abs(cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]))
    density = np.sqrt(np.maximum(certificate.indicators, 0.0) / area)
    ends = [
        facet_measures(mesh, solution.domain.facets(part))[0][..., :2]
        for part in solution.domain.parts.values()
    ]
    touching, _ = contact_lines(solution.contact)
    pieces = mesh.comm.gather((corners, density, np.concatenate(ends)), root=0)

    def draw() -> None:
        from matplotlib.collections import PolyCollection
        from matplotlib.colors import LogNorm

        assert pieces is not None
        triangles, values, boundary = (np.concatenate(rows) for rows in zip(*pieces, strict=True))
        figure, axes, width = plane_axes(boundary.reshape(-1, 2), room=1.5)
        # A corner has few cells of very high density: they must not take all colours
        bottom, top = np.quantile(np.maximum(values, 1e-300), (0.005, 0.995))
        cells = PolyCollection(
            list(triangles),
            array=np.clip(values, bottom, top),
            norm=LogNorm(bottom, max(top, 1.0001 * bottom)),
            edgecolors="white" if len(values) < 10_000 else "face",
            linewidths=np.clip(15 / np.sqrt(len(values)), 0.1, 0.5),
            rasterized=True,
        )
        axes.add_collection(cells, autolim=False)
        draw_lines(axes, chains(boundary), color="black", linewidth=1.5, joinstyle="round")
        if len(touching):
            draw_lines(axes, chains(touching), color=RED, linewidth=4.5, zorder=3, label="contact")
            legend(figure, ncols=1)
        beside = axes.inset_axes((1.0 + 0.15 / width, 0.0, 0.25 / width, 1.0))
        bar = figure.colorbar(cells, cax=beside)
        log_ticks(bar.ax.yaxis)
        bar.set_label(r"$|\nabla(u-u_h)|$ by a cell's share of the bound", fontsize=12)
        known = f"where the error sits, at most {bound} in all"
        axes.set_title(headline(title, known), fontsize=14)
        save(figure, path)

    on_root(mesh.comm, draw)
