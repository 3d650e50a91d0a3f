# %% [markdown]
# # Outside the theory: solutions that are not in $H^2$
#
# **Aim.** See the rates that less regular solutions give, on both elements; a study that found 1
# here would be broken.
#
# **Mathematics.** All theorems of the paper ask for $u \in H^2(\Omega)$. Example D has
# $u = \sqrt r \sin(\theta/2)$, with $\Gamma_0$ and $\Gamma_1$ meeting at the origin: $u \in
# H^{3/2-\varepsilon}$, and the rate to expect is $\frac12$ (1 in $L^2$). Example L has a re-entrant
# corner, where $u \sim r^{2/3}$: rate $\frac23$. Its solution is not known, so the distances
# $\|u_H - u_h\|_h$ of successive solutions stand in for the errors; they fall at the same rate.
#
#     mpirun -n 2 python3 demos/demo_outside.py [FOLDER]

# %%
import numpy as np
from study import Study, column, levels_wanted, loglog, orders, run

study = Study("demo_outside", "Outside the theory: rates 1/2 and 2/3")
levels = levels_wanted(8)

# %% [markdown]
# ## Solve

# %%
results = {
    (name, element): run(name, element, levels=levels)
    for name in ("D", "L")
    for element in ("CR", "P1")
}
measure = {"D": "h1", "L": "distance"}

# %% [markdown]
# ## Tables
# $J(u_h)$ comes from below for CR and from above for P1, where u_D is matched exactly (L).

# %%
for element in ("CR", "P1"):
    d = results["D", element]
    ell = results["L", element]
    study.table(
        f"{element}: D (error known) and L (distance to the level before)",
        {
            "h": ("{:.5f}", column(d, "h")),
            "D: dofs": ("{}", [row.dofs for row in d]),
            "D: H1 error": ("{:.3e}", column(d, "h1")),
            "D: rate": ("{:.3f}", orders(d, "h1")),
            "D: L2 rate": ("{:.3f}", orders(d, "l2")),
            "L: dofs": ("{}", [row.dofs for row in ell]),
            "L: distance": ("{:.3e}", column(ell, "distance")),
            "L: rate": ("{:.3f}", orders(ell, "distance")),
            "L: energy": ("{:.7f}", column(ell, "energy")),
        },
    )


# %% [markdown]
# ## Picture


# %%
def draw(left, right):
    """Errors of D and distances of L, both elements."""
    for axes, name, slope, title, label in (
        (
            left,
            "D",
            {0.5: "$h^{1/2}$"},
            r"D, $\sqrt{r}\,\sin(\theta/2)$: rate 1/2",
            r"$\|u-u_h\|_h$",
        ),
        (right, "L", {2 / 3: "$h^{2/3}$"}, "L, re-entrant corner: rate 2/3", r"$\|u_{2h}-u_h\|_h$"),
    ):
        curves = {}
        for element in ("CR", "P1"):
            y = column(results[name, element], measure[name])
            known = np.isfinite(y)
            curves[element] = (column(results[name, element], "h")[known], y[known])
        loglog(axes, curves, slope, title=title, y=label, dashed=["P1"])


study.picture(
    "outside.png",
    "Solutions outside H²: the rates are those of the singularities, ½ and ⅔, on both elements.",
    draw,
    panels=2,
)

# %% [markdown]
# ## Check

# %%
full = levels >= 7
for (name, element), rows in results.items():
    expected, tolerance = {"D": (1 / 2, 0.03), "L": (2 / 3, 0.05 if full else 0.12)}[name]
    found = orders(rows, measure[name])[-2:]
    assert np.all(abs(found - expected) < tolerance), (name, element, found)
study.finish()
