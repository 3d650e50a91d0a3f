"""Meanings of all figures that a run leaves behind, told once: legend, help and reference.

Nothing heavy is imported here: ``--help columns`` answers at once.
"""

from __future__ import annotations

from .sheets import SHEETS

PRINTED = {
    "level": ("", "The mesh: 0 is the first, and each next one is finer."),
    "cells": ("", "Number of triangles."),
    "dofs": (
        "unknowns",
        "Number of unknowns: for the element CR one a facet, the value of u_h at its midpoint.",
    ),
    "h": (
        "largest diameter of a cell",
        "The largest diameter of a cell: of all triangles the longest side.",
    ),
    "newton": (
        "steps of the active set method",
        "Steps of the active set method: each guesses which facets are in contact and solves one "
        "linear system.",
    ),
    "cg": (
        "of its linear solver, in all",
        "Steps of conjugate gradients in all of these systems together. That this number does not "
        "grow with the mesh is what multigrid is for.",
    ),
    "active": ("facets in contact", "Of the facets of Γ1, those in contact."),
    "energy": (
        "J(u_h)",
        "J(u_h) = ½∫κ∇u_h·∇u_h − ∫f u_h − ∫g u_h, cell by cell; a reaction c adds ½∫c u_h², and "
        "b (u − u_ext) on the boundary ½∫b u_h² − ∫b u_ext u_h.",
    ),
    "contact": ("their length", "Total length of the facets in contact."),
    "H1 error": (
        "‖∇_h(u − u_h)‖",
        "‖∇_h(u − u_h)‖, summed over the cells, where the file has [exact].",
    ),
    "L2 error": ("‖u − u_h‖", "‖u − u_h‖, where the file has [exact]."),
    "rate": (
        "of the error before it, as a power of h",
        "The power of h with which the error before it falls from the level before: 1 in H1 and 2 "
        "in L2 are the best that the element can do. Where not all cells are refined, N^(−1/2) "
        "for N unknowns takes the place of h.",
    ),
    "bound": (
        "certified, ‖∇_h(u − u_h)‖ is not above it",
        "The error ‖∇_h(u − u_h)‖ is not above this, whatever the mesh, the data and the solver "
        "did. Where there is none, the column is not there and the reason is below the table.",
    ),
    "eff.": ("bound / error", "Bound / error: 1 is perfect; below 1 would be a lie."),
}
"""The columns of the printed table: a few words for the legend, and a sentence."""

OF_STEPS = {
    "step": ("", "From 1."),
    "time": ("t at its end", "t at the end of the step."),
    "newton": PRINTED["newton"],
    "cg": PRINTED["cg"],
    "active": PRINTED["active"],
    "contact": PRINTED["contact"],
    "force": ("∫_Γ1 λ_h", "Total contact force, ∫_Γ1 λ_h."),
    "energy": (
        "J(u_h) of the step's own problem",
        "J(u_h) of the step's own problem, in which the steps before are data.",
    ),
    "bound": (
        "certified, ‖∇_h(u − u_h)‖ of that problem is not above it",
        "The error ‖∇_h(u − u_h)‖ of the step's own problem is not above this; none where there "
        "is no bound. It says nothing of what the length of the steps does to u.",
    ),
}
"""The columns of the table that is printed for a run in time."""

REPORT = {
    "title": "As the problem file has it.",
    "element": '"CR" or "P1".',
    "ranks": "Processes that solved it.",
    "versions.signorini_cr": "This program's version.",
    "versions.dolfinx": "DOLFINx's version.",
    "versions.petsc": "PETSc's version.",
    "versions.gmsh": "gmsh's version; null where it can't be told.",
    "units": "Only where the file has [units]: what it says there.",
    "names": "Only where the file has [names]: what it says there.",
    "complete": "Whether all that was asked for has been reached.",
    "force_bounds.lower": "The contact force ∫_Γ1 λ of u itself is not below it.",
    "force_bounds.upper": "The contact force of u itself is not above it.",
    "force_bounds.reason": "Why the force has no bounds; null where it has.",
    "levels": "The levels, coarsest first, with the figures below; in time the one that is solved "
    "on, as it is after the last step.",
    "search": "Only of runs in time on an adapted mesh: the meshes that were tried, coarsest "
    "first, each with level, cells, dofs and, as bound_h1, the largest bound of all steps.",
    "times": "Only of runs in time: the steps, each with the figures of times.csv.",
}
"""The keys of report.json, those of an object behind a dot."""

LEVEL = {
    "level": PRINTED["level"][1],
    "cells": PRINTED["cells"][1],
    "dofs": PRINTED["dofs"][1],
    "h": PRINTED["h"][1],
    "newton_iterations": f"{PRINTED['newton'][1]} The printed column newton.",
    "linear_iterations": "Steps of the linear solver in all of them. The printed column cg.",
    "energy": PRINTED["energy"][1],
    "kkt.min_gap": "Smallest u_h − α on Γ1, where the element respects it; 0 or above.",
    "kkt.min_pressure": "Smallest pressure in contact; 0 or above, up to the solver's tolerance.",
    "kkt.complementarity": "∫_Γ1 |λ_h (u_h − α)|: of pressure and gap one is 0.",
    "kkt.residual": "What the solver left of the equations, relative to the load.",
    "kkt.force_error": "What it left wrong with the contact forces, relative to their sum.",
    "contact.facets": "Facets of Γ1.",
    "contact.active": PRINTED["active"][1],
    "contact.length": PRINTED["contact"][1],
    "contact.force": "Total contact force, ∫_Γ1 λ_h.",
    "contact.transitions": "Points where contact begins or ends, [x, y] each.",
    "contact.force_bounds.lower": "∫_Γ1 λ is not below it.",
    "contact.force_bounds.upper": "∫_Γ1 λ is not above it.",
    "contact.force_bounds.reason": "Why the force has no bounds; null where it has.",
    "quantities": "What [quantities] asks for, by name: its `kind`, whether it is `weighted`, "
    "`value`, that of u_h, `lower` and `upper`, between which that of u is, and `reason` where "
    "these are null.",
    "error_h1": "‖∇_h(u − u_h)‖; null where u is not known.",
    "error_l2": "‖u − u_h‖; null where u is not known.",
    "rate_h1": "Of error_h1, against the level before. The printed column rate.",
    "rate_l2": "Of error_l2, against the level before.",
    "bound_h1": "‖∇_h(u − u_h)‖ is not above it. The printed column bound.",
    "bound_energy_norm": "‖κ^½ ∇_h(u − u_h)‖ is not above it, with c and b its energy norm.",
    "effectivity": "bound_h1 / error_h1. The printed column eff.",
    "bound_reason": "Why there is no bound; null where there is one.",
    "bound_parts.flux": "Of the bound: the norm of y − κ∇u_h, y the equilibrated flux.",
    "bound_parts.companion": "Of the bound: the norm of ∇_h(v − u_h), v the companion.",
    "bound_parts.contact": "Of the bound: the square root of what y and v leave of λ (u − α) = 0.",
    "bound_parts.load": "Of the bound: the part of f that is not constant on cells.",
    "bound_parts.neumann": "Of the bound: the part of g that is not constant on facets.",
    "bound_parts.boundary": "Of the bound: the parts of u_D and α that v does not have.",
    "bound_parts.solver": "Of the bound: what the solver left of the equations.",
    "energy_bounds.lower": "J(u) is not below it.",
    "energy_bounds.upper": "J(u) is not above it.",
    "seconds.mesh": "Wall time of the mesh: made or refined, and shared out.",
    "seconds.assemble": "Wall time of sampling data and assembling.",
    "seconds.solve": "Wall time of the solver.",
    "seconds.estimate": "Wall time of errors, bounds and certificate.",
}
"""The keys of a level in report.json, those of an object behind a dot."""

STEP = {
    "step": "From 1.",
    "time": "t at its end.",
    "newton_iterations": LEVEL["newton_iterations"],
    "linear_iterations": LEVEL["linear_iterations"],
    "active": LEVEL["contact.active"],
    "length": LEVEL["contact.length"],
    "force": LEVEL["contact.force"],
    "energy": "J(u_h) of the step's own problem, in which the steps before are data.",
    "bound_h1": "Of that problem: ‖∇_h(u − u_h)‖ is not above it.",
    "bound_energy_norm": "The same of the energy norm.",
    "energy_bounds": "J(u) of that problem is between these. Columns as energy_bounds_lower.",
    "quantities": "What [quantities] asks for, of the step's own problem: by name, what it is in "
    "a level. Columns as quantities_heat_lower.",
    "seconds": "Wall time, bounds included.",
}
"""The columns of times.csv."""

SECTIONS = {
    "Columns of the printed table and of levels.md": {
        name: meaning for name, (_, meaning) in PRINTED.items()
    },
    "Columns that are printed for [time], a line a step": {
        name: meaning for name, (_, meaning) in OF_STEPS.items()
    },
    "Keys of report.json": REPORT,
    "Keys of a level in report.json; columns of levels.csv, with _ in the place of the dot": LEVEL,
    "Columns of times.csv, a line a step, and keys of times in report.json, for [time]": STEP,
    **{sheet.head: sheet.columns for sheet in SHEETS.values()},
}
"""Everything, under the heads that help and reference give it."""
