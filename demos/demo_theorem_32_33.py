# %% [markdown]
# # Theorems 3.2 and 3.3: finitely many critical points
#
# **Aim.** Tell $h$ from $h|\log h|^{1/4}$ on solutions with one critical point, with that point
# at a vertex of the mesh and inside a facet.
#
# **Mathematics.** A critical point is one where contact ends. With finitely many of them,
#
# $$\|u-u_h\|_h \le C h |\log h|^{1/4} \|u\|_{2,\Omega} \tag{3.2}$$
#
# for $u \in H^2$, and $\|u-u_h\|_h \le C h$ if the gradient is bounded on the boundary as well
# (3.3). S1, A and B have one critical point, the origin, and a bounded gradient: (3.3) holds. The
# logarithm enters through the facets of $\Gamma_{1h}^-$ (2.2), those on which contact ends. When
# the origin is a vertex there are none; $x \mapsto x + 0.31(1-x^2)$ moves it inside a facet.
#
#     mpirun -n 2 python3 demos/demo_theorem_32_33.py [FOLDER]

# %%
import numpy as np
from study import COLOURS, Study, column, levels_wanted, loglog, orders, run

study = Study("demo_theorem_32_33", "Theorems 3.2 and 3.3: finitely many critical points")
levels = levels_wanted(8)
families = {"structured": "at a vertex", "mapped": "inside a facet"}

# %% [markdown]
# ## Solve

# %%
results = {
    (name, family): run(name, family=family, levels=levels)
    for family in families
    for name in ("S1", "A", "B")
}

# %% [markdown]
# ## Tables
# Under (3.3) the column e/h settles; $e/(h|\log h|^{1/4})$, which (3.2) bounds, then falls slowly.

# %%
for family, where in families.items():
    h = column(results["S1", family], "h")
    table = {"h": ("{:.5f}", h), "dofs": ("{}", [row.dofs for row in results["S1", family]])}
    for name in ("S1", "A", "B"):
        error = column(results[name, family], "h1")
        table |= {
            f"{name}: e": ("{:.3e}", error),
            f"{name}: rate": ("{:.3f}", orders(results[name, family], "h1")),
            f"{name}: e/h": ("{:.4f}", error / h),
            f"{name}: $e/(h|\\log h|^{{1/4}})$": ("{:.4f}", error / (h * abs(np.log(h)) ** 0.25)),
        }
    study.table(f"e = ‖u − u_h‖_h, critical point {where}", table)
study.table(
    "Rates in L2",
    {"h": ("{:.5f}", column(results["S1", "structured"], "h"))}
    | {
        f"{name}, {family}": ("{:.3f}", orders(rows, "l2"))
        for (name, family), rows in results.items()
    },
)


# %% [markdown]
# ## Picture


# %%
def draw(left, right):
    """Errors on the left, errors over h and over h|log h|^{1/4} on the right."""
    colours = COLOURS[:3]
    curves = {
        f"{name}, {families[family]}": (column(rows, "h"), column(rows, "h1"))
        for (name, family), rows in results.items()
    }
    dashed = [label for label in curves if "inside" in label]
    loglog(left, curves, {1.0: "$h$"}, y=r"$\|u-u_h\|_h$", dashed=dashed, colours=colours,
           named={label: label.split(",")[0] for label in dashed},
           title="Errors fall like $h$, wherever contact ends\n"
           "(solid: at a vertex, dashed: inside a facet)")  # fmt: skip
    level, log = {}, {}
    for name in ("S1", "A", "B"):
        rows = results[name, "mapped"]
        h, error = column(rows, "h"), column(rows, "h1")
        level[f"{name}: $e/h$"] = (h, error / h)
        log[rf"{name}: $e/(h|\log h|^{{1/4}})$"] = (h, error / (h * abs(np.log(h)) ** 0.25))
    loglog(right, level | log, {}, y="quotient of the error $e$", dashed=[*log], scale="linear",
           colours=colours,
           title="Inside a facet: $e/h$ is level, so there is no logarithm")  # fmt: skip


study.picture(
    "theorem-32-33.png",
    "One critical point, at a vertex or inside a facet: the errors fall like h, without logarithm.",
    draw,
    panels=2,
)

# %% [markdown]
# ## Check
# The rates are 1, and 2 in $L^2$, wherever the critical point lies.

# %%
tolerance = (0.03, 0.1) if levels >= 6 else (0.1, 0.2)
for key, rows in results.items():
    assert np.all(abs(orders(rows, "h1")[-2:] - 1.0) < tolerance[0]), (key, orders(rows, "h1"))
    assert np.all(abs(orders(rows, "l2")[-2:] - 2.0) < tolerance[1]), (key, orders(rows, "l2"))
study.finish()
