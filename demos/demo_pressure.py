# %% [markdown]
# # The contact pressure
#
# **Aim.** See how fast the discrete pressure converges.
#
# **Mathematics.** $\lambda = \partial_\nu u$ on $\Gamma_1$ is the multiplier of the constraint. The
# scheme has its own: $\lambda_F = (A u_h - b)_F / |F|$, constant on each facet. The paper gives no
# estimate for it. In $L^2(\Gamma_1)$ a piecewise constant can do no better than $h$, and no better
# than $h^{s}$ with $s < 1$ for a pressure that begins like $\sqrt{|x|}$ only up to a logarithm:
# $\sqrt{|x|} \in H^{1-\varepsilon}$.
#
#     mpirun -n 2 python3 demos/demo_pressure.py [FOLDER]

# %%
import numpy as np
from study import Study, called, canvas, column, levels_wanted, loglog, orders, run

from signorini_cr import exact, solve

study = Study("demo_pressure", "‖λ − λ_h‖ on Γ1")
levels = levels_wanted(8)
cases = [
    ("S1", "CR", "structured"),
    ("S1", "CR", "mapped"),
    ("S1", "P1", "structured"),
    ("A", "CR", "structured"),
    ("B", "CR", "structured"),
    ("C2", "CR", "structured"),
    ("I", "CR", "structured"),
]

# %% [markdown]
# ## Solve

# %%
results = {case: run(*case, levels=levels) for case in cases}


def whole(name, *rest):
    """A case in words."""
    return ", ".join([called(name), *rest])


# %% [markdown]
# ## Tables
# For P1 the pressure of a facet is the mean of those of its two vertices.

# %%
study.table(
    "‖λ − λ_h‖ in L2(Γ1)",
    {"h, structured": ("{:.5f}", column(results[cases[0]], "h"))}
    | {
        ", ".join([called(case[0]), *case[1:]]): ("{:.2e}", column(rows, "pressure"))
        for case, rows in results.items()
    },
)
study.table(
    "Rates of ‖λ − λ_h‖",
    {"h, structured": ("{:.5f}", column(results[cases[0]], "h"))}
    | {
        ", ".join([called(case[0]), *case[1:]]): ("{:.3f}", orders(rows, "pressure"))
        for case, rows in results.items()
    },
)

# %% [markdown]
# ## Picture
# Above the errors, below the pressure of S1 near the critical point, inside a facet of the mapped
# mesh.

# %%
n = min(32, 4 * 2 ** (levels - 1))
solution = solve(exact.S1.problem, exact.S1.structured(n, shift=0.31))
table = solution.contact.table()


def short(name, element, family):
    """A case, without what is so unless it is told."""
    other = [word for word in (element, family) if word not in ("CR", "structured")]
    return ", ".join([called(name), *other])


def draw(left, right):
    """Errors, and λ with λ_h."""
    curves = {
        short(*case): (column(rows, "h"), column(rows, "pressure"))
        for case, rows in results.items()
    }
    loglog(left, curves, {1.0: "$h$"},
           title="The error of the pressure falls like $h$\n(CR, structured, where not said)",
           y=r"$\|\lambda-\lambda_h\|_{L^2(\Gamma_1)}$",
           dashed=[label for label in curves if "P1" in label])  # fmt: skip
    x = np.linspace(-1, 1, 2001)
    pressure = 1.5 * (1 - x**2) * np.sqrt(np.maximum(-x, 0))
    edges = np.append(table["x"] - table["length"] / 2, table["x"][-1] + table["length"][-1] / 2)
    right.plot(x, pressure, color="black", linewidth=1.2, label=r"$\lambda$")
    right.stairs(table["pressure"], edges, color=canvas.RED, linewidth=1.8, label=r"$\lambda_h$")
    right.set_xlim(-1, 0.25)
    right.set_xlabel("$x$", fontsize=14)
    right.set_ylabel("pressure", fontsize=13)
    right.set_ylim(0.0)
    right.set_title(f"S1, mapped: on each of {2 * n} facets $\\lambda_h$ is near $\\lambda$",
                    fontsize=14)  # fmt: skip
    right.grid(alpha=0.3)
    right.annotate(r"$\lambda$", (-0.1, 1.5 * (1 - 0.01) * np.sqrt(0.1)), (0.0, 0.6), fontsize=15,
                   arrowprops={"arrowstyle": "-"})  # fmt: skip
    steps = table["pressure"][np.searchsorted(edges, -0.62) - 1]
    right.annotate(r"$\lambda_h$", (-0.62, steps), (-0.55, 0.55), fontsize=15, color=canvas.RED,
                   arrowprops={"arrowstyle": "-", "color": canvas.RED})  # fmt: skip


study.picture(
    "pressure.png",
    "The error of the contact pressure on Γ1, and the pressure of S1 with the critical point "
    "inside a facet.",
    draw,
    panels=2,
)

# %% [markdown]
# ## Check
# The order is 1 for smooth pressures, and just below for $\sqrt{|x|}$.

# %%
for case, rows in results.items():
    rate = orders(rows, "pressure")[-1]
    assert 0.85 < rate < 1.5, (case, rate)
assert abs(orders(results["A", "CR", "structured"], "pressure")[-1] - 1.0) < 0.02
study.finish()
