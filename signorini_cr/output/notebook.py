"""A solution as a notebook shows it: what is known about it in a table, and its picture."""

from __future__ import annotations

import base64
from html import escape
from typing import TYPE_CHECKING

from ..rounding import at_most, digits_of, interval
from . import plots
from .canvas import as_png, grouped

if TYPE_CHECKING:
    from ..solution import Solution


def as_html(solution: Solution) -> str:
    """Write a table and, below it, the picture of u_h; not collective.

    Nothing is solved or certified for it: of the certificate there is what has been made. There is
    no picture where there are several ranks, which would have to draw it together, nor of
    domains in space or of several unknowns a facet, nor without Matplotlib.
    """
    contact, iterations = solution.contact, solution.iterations
    certificate = solution.certificate_if_made
    bracket = None if certificate is None else certificate.energy
    wide = bracket and bracket[1] - bracket[0]
    facet = contact.length / contact.number_active if contact.number_active else None
    size = "length" if solution.domain.mesh.topology.dim == 2 else "area"
    rows = {
        "element": solution.element,
        "cells": grouped(solution.cells),
        "degrees of freedom": grouped(solution.dofs),
        "energy J(u_h)": digits_of(solution.energy, wide, 4 if wide is None else 7),
        "facets in contact": f"{grouped(contact.number_active)} of {grouped(contact.number)}",
        f"{size} in contact": digits_of(contact.length, facet),
        "contact force": digits_of(contact.force, None, 4),
        "Newton steps, linear iterations": f"{iterations.newton}, {iterations.linear}",
    }
    if certificate is None:
        rows["error bound"] = "not asked for: solution.certificate"
    elif certificate.bound_h1 is None:
        rows["error bound"] = f"none: {certificate.reason}"
    else:
        rows["error at most"] = at_most(certificate.bound_h1)
        if certificate.energy is not None:
            rows["energy J(u) in"] = interval(*certificate.energy)
    left, right = 'style="text-align:left"', 'style="text-align:right"'
    table = "".join(
        f"<tr><th {left}>{escape(name)}</th><td {right}>{escape(value)}</td></tr>"
        for name, value in rows.items()
    )
    return f"<table>{table}</table>{_picture(solution)}"


def _picture(solution: Solution) -> str:
    mesh, block = solution.domain.mesh, solution.u.function_space.dofmap.index_map_bs
    if mesh.comm.size > 1 or mesh.geometry.dim != 2 or block > 1 or not plots.can_draw(mesh.comm):
        return ""
    figure = plots.plot_solution(solution)
    assert figure is not None
    data = base64.b64encode(as_png(figure)).decode()
    return f'<img alt="u_h" style="max-width:640px" src="data:image/png;base64,{data}"/>'
