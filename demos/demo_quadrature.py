# %% [markdown]
# # Quadrature: what the measured errors owe to it
#
# **Aim.** Make sure that the tables show the errors of the method, not those of the integration:
# of the norms, of the load, and of the boundary values.
#
# **Mathematics.** Near the origin $\nabla u$ behaves like $r^{1/2}$ (S1, B) or $r^{-1/2}$ (D), and
# the quadrature of $|\nabla(u-u_h)|^2$ is of limited order there, whatever its degree. On cells at
# the origin it misses a fixed share of their part of the error: of the order $h^{3}$ in
# $\|u-u_h\|_h^2 \sim h^2$ for S1 and B, which fades, but of the order $h$ in $\|u-u_h\|_h^2 \sim h$
# for D, which does not: there the constant is a few per cent off, the rate is not.
#
# The load $\chi$ is integrated as well. Example I's $f$ oscillates faster and faster towards the
# origin, and its error is not small compared with $\|u - u_h\| \sim h^2$.
#
# Bounds and boundary values are facet means, since $\Pi_h K \subset K_h$ then. The value at the
# midpoint of a facet differs from the mean by about $u_D'' |F|^2/24$: a perturbation of the
# boundary values that moves $u_h$ by $O(h^2)$, next to an error of $O(h)$ that it is nearly
# orthogonal to. The errors change by a share of $O(h^2)$.
#
#     mpirun -n 2 python3 demos/demo_quadrature.py [FOLDER]

# %%
from dataclasses import replace

import numpy as np
from study import Study, column, levels_wanted, loglog, orders, run, solutions

from signorini_cr import exact, norms

study = Study("demo_quadrature", "Quadrature of the errors, the load and the boundary values")
levels = levels_wanted(7)
degrees = (2, 4, 6, 10, 20)

# %% [markdown]
# ## The norms
# The last level of S1, B and D with quadratures of rising degree; the studies use 6.

# %%
measured = {}
for name in ("S1", "B", "D"):
    for solution in solutions(exact.ALL[name], "CR", "structured", levels):
        if solution.level.number >= levels - 2:
            measured[name, solution.level.number - levels + 2] = (
                solution.h,
                [norms.errors(solution, degree) for degree in degrees],
            )
table = {"degree": ("{}", degrees)}
for name in ("S1", "B", "D"):
    (h0, before), (h1, after) = measured[name, 0], measured[name, 1]
    table |= {
        f"{name}: H1 error": ("{:.6e}", [error[0] for error in after]),
        f"{name}: L2 error": ("{:.6e}", [error[1] for error in after]),
        f"{name}: H1 rate": (
            "{:.4f}",
            [
                float(norms.rates([h0, h1], [e0[0], e1[0]])[0])
                for e0, e1 in zip(before, after, strict=True)
            ],
        ),
    }
study.table(f"Errors at h = {h1:.5f} with quadratures of several degrees", table)

# %% [markdown]
# ## The load
# Example I with loads integrated to degree 4 and to degree 14.

# %%
loads = {}
for degree in (4, 14):
    name = f"I, degree {degree}"
    problem = replace(exact.I.problem, quadrature_degree=degree)
    exact.ALL[name] = replace(exact.I, problem=problem)
    loads[degree] = run(name, levels=levels)
h = column(loads[4], "h")
study.table(
    "Example I: quadrature of f",
    {"h": ("{:.5f}", h)}
    | {
        f"degree {degree}: {heading}": (form, value)
        for degree, rows in loads.items()
        for heading, form, value in (
            ("H1 error", "{:.3e}", column(rows, "h1")),
            ("L2 error", "{:.3e}", column(rows, "l2")),
            ("L2 rate", "{:.3f}", orders(rows, "l2")),
        )
    },
)

# %% [markdown]
# ## The boundary values
# Degree 1 on a facet is its midpoint. The loads of B and D vanish, so that nothing else changes;
# that of A is integrated with less accuracy, too.

# %%
boundary = {}
for name in ("A", "B", "D"):
    midpoint = f"{name}, midpoints"
    problem = replace(exact.ALL[name].problem, quadrature_degree=1)
    exact.ALL[midpoint] = replace(exact.ALL[name], problem=problem)
    boundary[name] = (run(name, levels=levels), run(midpoint, levels=levels))
table = {"h": ("{:.5f}", h)}
for name, (means, points) in boundary.items():
    a, b = column(means, "h1"), column(points, "h1")
    table |= {
        f"{name}: means": ("{:.5f}", a),
        f"{name}: midpoints": ("{:.5f}", b),
        f"{name}: difference": ("{:.2f} %", 100 * (b - a) / a),
    }
study.table("‖u − u_h‖_h with facet means and with midpoint values of u_D", table)


# %% [markdown]
# ## Picture


# %%
def draw(left, right):
    """Errors of I for both loads, and what the boundary values change."""
    curves = {
        f"f to degree {degree}: {label}": (h, column(rows, norm))
        for degree, rows in loads.items()
        for label, norm in ((r"$\|u-u_h\|_h$", "h1"), (r"$\|u-u_h\|$", "l2"))
    }
    loglog(left, curves, {1.0: "$h$", 2.0: "$h^2$"},
           title="I: a load to degree 4 costs accuracy in $L^2$",
           dashed=[label for label in curves if "degree 4" in label])  # fmt: skip
    curves = {
        name: (h, abs(column(points, "h1") / column(means, "h1") - 1))
        for name, (means, points) in boundary.items()
    }
    loglog(right, curves, {}, title="Midpoints in the place of facet means: the difference fades",
           y=r"relative change of $\|u-u_h\|_h$")  # fmt: skip


study.picture(
    "quadrature.png",
    "Above: an inaccurate load hides the rate in L2. Below: what midpoint values of u_D change.",
    draw,
    panels=2,
)

# %% [markdown]
# ## Check
# From degree 6 on nothing visible changes for S1 and B; for D the rate stays; midpoints and means
# differ by less than 2 %.

# %%
for name in ("S1", "B"):
    errors = np.array(measured[name, 1][1])
    assert np.all(abs(errors[2:] / errors[-1] - 1) < 1e-3), (name, errors)
rates = norms.rates([h0, h1], [measured["D", 0][1][2][0], measured["D", 1][1][2][0]])
assert abs(rates[0] - 0.5) < 0.03, rates
for name, (means, points) in boundary.items():
    change = abs(column(points, "h1") / column(means, "h1") - 1)
    assert np.all(change[1:] < 0.02), (name, change)
study.finish()
