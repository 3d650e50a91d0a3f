# %% [markdown]
# # Crouzeix–Raviart and conforming P1
#
# **Aim.** Check the paper's claim that the nonconforming element converges like the continuous
# one, and see what each costs: per mesh, and per degree of freedom.
#
# **Mathematics.** On the same triangles CR has a degree of freedom per facet and P1 one per
# vertex, a third as many. Both have the best approximation error $O(h)$. CR pays for its
# nonconformity with a consistency error (4.2), yet its best approximation is the best of *all*
# piecewise affine functions, as $\nabla\Pi_h u$ is the mean of $\nabla u$ on every cell. Its
# bounds are facet means, so $\Pi_h u \in K_h$, and with $u_D = 0$ it approaches $J(u)$ from below
# in these examples, while P1 approaches it from above: together they enclose the energy.
#
#     mpirun -n 2 python3 demos/demo_elements.py [FOLDER]

# %%
import numpy as np
from study import COLOURS, Study, called, column, levels_wanted, loglog, orders, run

from signorini_cr import exact

study = Study("demo_elements", "CR against conforming P1 on the same meshes")
levels = levels_wanted(8)
names = ("S1", "A", "B", "C", "C2", "I", "D")

# %% [markdown]
# ## Solve

# %%
results = {
    (name, element): run(name, element, levels=levels) for name in names for element in ("CR", "P1")
}
h = column(results["S1", "CR"], "h")

# %% [markdown]
# ## Tables
# First the rates of P1 (those of CR are in the other demos), then both errors side by side.

# %%
for norm, text in (("h1", "the broken norm"), ("l2", "L2")):
    study.table(
        f"Rates of P1 in {text}",
        {"h": ("{:.5f}", h)}
        | {called(name): ("{:.3f}", orders(results[name, "P1"], norm)) for name in names},
    )
for norm, text in (("h1", "Broken norm"), ("l2", "L2")):
    study.table(
        f"{text}: the error of CR over that of P1, on the same mesh",
        {"h": ("{:.5f}", h)}
        | {
            called(name): (
                "{:.3f}",
                column(results[name, "CR"], norm) / column(results[name, "P1"], norm),
            )
            for name in names
        },
    )

# %% [markdown]
# Per degree of freedom: with $e \approx c N^{-1/2}$ (or $c N^{-1}$ in $L^2$) the numbers $c$ tell
# which element makes more of $N$ degrees of freedom.

# %%
last = {key: rows[-1] for key, rows in results.items()}
power = {"h1": 0.5, "l2": 1.0}
smooth = [name for name in names if name != "D"]
study.table(
    "Per degree of freedom, finest level: √N ‖u − u_h‖_h and N ‖u − u_h‖",
    {"": ("{}", [called(name) for name in smooth])}
    | {
        f"{element} {norm.upper()}": (
            "{:.3f}",
            [
                getattr(last[name, element], norm) * last[name, element].dofs ** power[norm]
                for name in smooth
            ],
        )
        for norm in ("h1", "l2")
        for element in ("CR", "P1")
    },
)

# %% [markdown]
# $J(u_h)$ of the two elements encloses $J(u)$. That of E (the data of Ben Belgacem and Renard) and
# of L, whose solutions nobody knows, is thereby known to some digits.

# %%
known = ("S1", "I", "E", "L")
energies = {
    (name, element): run(name, element, levels=levels) for name in known for element in ("CR", "P1")
}
study.table(
    "J(u_h), from below and from above",
    {"level": ("{}", range(levels))}
    | {
        f"{name}, {element}": ("{:.7f}", column(energies[name, element], "energy"))
        for name in known
        for element in ("CR", "P1")
    },
)
study.table(
    "What is known of J(u)",
    {
        "": ("{}", known),
        "J(u)": ("{:.10g}", [exact.ALL[name].energy for name in known]),
    },
)


# %% [markdown]
# ## Picture


# %%
def draw(left, right):
    """S1, against h on the left and against the number of degrees of freedom right."""
    for axes, x, label, title in (
        (left, "h", "$h$", "S1: on the same mesh both elements are alike"),
        (right, "dofs", "degrees of freedom $N$", "S1: per degree of freedom P1 is ahead"),
    ):
        curves = {
            f"{element}: {norm}": (
                column(results["S1", element], x),
                column(results["S1", element], attribute),
            )
            for norm, attribute in ((r"$\|u-u_h\|_h$", "h1"), (r"$\|u-u_h\|$", "l2"))
            for element in ("CR", "P1")
        }
        slopes = {1.0: "$h$", 2.0: "$h^2$"} if x == "h" else {-0.5: "$N^{-1/2}$", -1.0: "$N^{-1}$"}
        same = x == "h"
        loglog(axes, curves, slopes, title=title, x=label, y="error of S1",
               dashed=[key for key in curves if "P1" in key],
               colours=[COLOURS[0], COLOURS[0], COLOURS[1], COLOURS[1]],
               named={key: key.removeprefix("CR: ") + same * ",\nCR and P1"
                      for key in curves if "CR" in key})  # fmt: skip
        for key, (abscissae, errors) in {} if same else curves.items():
            # beside the curves, which run apart
            colour, at = COLOURS["_h" not in key.split("u_h")[-1]], 3 if "CR" in key else -1
            axes.annotate(key.split(":")[0], (abscissae[at], errors[at]), (8, 4 if at > 0 else -4),
                          textcoords="offset points", fontsize=13, color=colour,
                          va="bottom" if at > 0 else "top")  # fmt: skip


study.picture(
    "elements.png",
    "S1 with CR and P1: the same rates; level on the same mesh, P1 ahead per degree of freedom.",
    draw,
    panels=2,
)

# %% [markdown]
# ## Check
# Both elements have the rate 1 (2 in $L^2$), on D ½ (1), and they enclose the energies.

# %%
loose = levels < 6
for (name, element), rows in results.items():
    h1, l2 = exact.ALL[name].rates
    assert np.all(abs(orders(rows, "h1")[-2:] - h1) < (0.15 if loose else 0.03)), (name, element)
    assert np.all(abs(orders(rows, "l2")[-2:] - l2) < (0.6 if loose else 0.1)), (name, element)
for name in known:
    below, above = (energies[name, element][-1].energy for element in ("CR", "P1"))
    assert below < exact.ALL[name].energy < above, (name, below, above)
study.finish()
