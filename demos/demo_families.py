# %% [markdown]
# # Families of meshes
#
# **Aim.** See that the rates do not depend on a particular kind of mesh.
#
# **Mathematics.** The theorems ask for regular triangulations, no more. Structured meshes are more
# than that: neighbouring triangles form parallelograms, and errors may cancel. Here are four
# families: squares cut in two; their image under $x \mapsto x + 0.31(1 - x^2)$, which moves
# critical points inside facets; unstructured meshes from gmsh, refined; and squares cut in two with
# all vertices moved at random by up to a fifth of the square's side, anew on every level.
#
#     mpirun -n 2 python3 demos/demo_families.py [FOLDER]

# %%
import numpy as np
from study import (
    COLOURS,
    FAMILIES,
    Study,
    canvas,
    column,
    edges,
    levels_wanted,
    loglog,
    orders,
    run,
)

from signorini_cr import exact

study = Study("demo_families", "Structured, mapped, unstructured and perturbed meshes")
levels = {"structured": 7, "mapped": 7, "gmsh": 7, "jitter": 7}
levels = {family: levels_wanted(number) for family, number in levels.items()}
names = ("S1", "A", "I")

# %% [markdown]
# ## Solve

# %%
results = {
    (name, family): run(name, family=family, levels=levels[family])
    for name in names
    for family in FAMILIES
}

# %% [markdown]
# ## Tables

# %%
for family, words in FAMILIES.items():
    rows = results["S1", family]
    table = {"h": ("{:.5f}", column(rows, "h")), "dofs": ("{}", [row.dofs for row in rows])}
    for name in names:
        rows = results[name, family]
        table |= {
            f"{name}: H1 error": ("{:.3e}", column(rows, "h1")),
            f"{name}: H1 rate": ("{:.3f}", orders(rows, "h1")),
            f"{name}: L2 rate": ("{:.3f}", orders(rows, "l2")),
            f"{name}: λ rate": ("{:.3f}", orders(rows, "pressure")),
        }
    study.table(f"{family}: {words}".replace("$", "`").replace("\\mapsto", "↦"), table)


# %% [markdown]
# ## Pictures
# A coarse mesh of each family, and the errors of S1 against the number of degrees of freedom,
# by which meshes of different kinds can be compared.

# %%
meshes = {
    "structured": exact.S1.structured(8),
    "mapped": exact.S1.structured(8, shift=0.31),
    "gmsh": exact.S1.mesh(1 / 8),
    "jitter": exact.S1.structured(8, jitter=0.2),
}
lines = {family: edges(domain.mesh) for family, domain in meshes.items()}


def draw_meshes(*panels):
    """One mesh per panel, and the rate on its refinements."""
    for axes, (family, segments), colour in zip(panels, lines.items(), COLOURS, strict=False):
        canvas.draw_lines(axes, segments, color=colour, linewidth=0.9)
        axes.set_xlim(-1.03, 1.03)
        axes.set_ylim(-0.03, 1.03)
        axes.set_aspect("equal")
        rate = orders(results["S1", family], "h1")[-1]
        axes.set_title(f"{family}: the error falls as $h^{{{rate:.2f}}}$", fontsize=13)
        axes.axis("off")


study.picture(
    "families.png",
    "A mesh of each family, and the rate of the error of S1 in the energy norm on its refinements.",
    draw_meshes,
    panels=4,
    columns=2,
    size=(4.4, 2.6),
)


def draw(left, right):
    """Draw what is left of the errors when the expected power of N is taken out."""
    for axes, norm, power, label in (
        (left, "h1", 0.5, r"$\sqrt{N}\,\|u-u_h\|_h$"),
        (right, "l2", 1.0, r"$N\,\|u-u_h\|$"),
    ):
        curves = {}
        for family in FAMILIES:
            dofs, error = (column(results["S1", family], name) for name in ("dofs", norm))
            curves[family] = (dofs, dofs**power * error)
        loglog(axes, curves, {}, title=f"S1: full rates on all meshes, as {label} is level",
               x="degrees of freedom $N$", y=label, scale="linear")  # fmt: skip


study.picture(
    "families-errors.png",
    "Errors of S1 on all four families, times the power of N at which they fall: level lines mean "
    "full rates.",
    draw,
    panels=2,
)

# %% [markdown]
# ## Check

# %%
for (name, family), rows in results.items():
    loose = levels[family] < 6
    h1, l2 = orders(rows, "h1")[-2:], orders(rows, "l2")[-2:]
    assert np.all(abs(h1 - 1.0) < (0.2 if loose else 0.03)), (name, family, h1)
    assert np.all(abs(l2 - 2.0) < (0.6 if loose else 0.1)), (name, family, l2)
study.finish()
