# %% [markdown]
# # The abstract estimate (1.11), term by term
#
# **Aim.** See where the error comes from: evaluate each term of the estimate that the whole paper
# rests on, with its own observed order.
#
# **Mathematics.** For every $v_h \in K_h$,
#
# $$\|u-u_h\|_h^2 \le C \{ \|u-v_h\|_h^2 + a_h(u, v_h-u_h) - \chi(v_h-u_h) \}. \tag{1.11}$$
#
# The paper takes $v_h = \Pi_h u$, the function with $u$'s mean on every facet. Then more is true.
# $\nabla\Pi_h u$ is the mean of $\nabla u$ on each cell, so $\nabla(u - \Pi_h u)$ is orthogonal to
# all piecewise constant gradients: $\Pi_h u$ is the best approximation, the infimum of the first
# term, and with $w_h = \Pi_h u - u_h$ and (4.2)
#
# $$\|u-u_h\|_h^2 = \underbrace{\|u-\Pi_h u\|_h^2}_{\text{best approximation}}
#   + \underbrace{I_1}_{\text{interior facets}} + \underbrace{I_2}_{\Gamma_0}
#   + \underbrace{I_3}_{\Gamma_1}
#   - \underbrace{\textstyle\sum_F \lambda_F |F|\, \Pi_h u(m_F)}_{\text{slack}\ \ge\ 0},$$
#
# $I_k = \sum \int_F \partial_\nu u\, w_h$ over both sides of the facets: (1.11) holds with $C = 1$.
# All terms can be computed, and have to add up.
#
#     mpirun -n 2 python3 demos/demo_estimate.py [FOLDER]

# %%
import numpy as np
from study import Study, levels_wanted, loglog, solutions

from signorini_cr import exact, norms, theory

study = Study("demo_estimate", "The abstract estimate (1.11), term by term")
levels = levels_wanted(7)
cases = [("S1", "structured"), ("S1", "mapped"), ("A", "mapped"), ("I", "structured")]
terms = {
    "error": "‖u − u_h‖²",
    "best": "‖u − Π_h u‖²",
    "interior": "I1 (interior)",
    "dirichlet": "I2 (Γ0)",
    "contact_bound": "I3 on Γ1h⁰ (D1)",
    "contact_mixed": "I3 on Γ1h⁻ (D2 + B2)",
    "slack": "slack",
}

# %% [markdown]
# ## Solve and evaluate

# %%
found = {}
for name, family in cases:
    example = exact.ALL[name]
    found[name, family] = [
        (solution.h, theory.abstract_estimate(solution, example))
        for solution in solutions(example, "CR", family, levels)
    ]


# %% [markdown]
# ## Tables
# The error consists of the best approximation and of $I_1$, in about equal parts, both of order
# $h^2$. $I_2$ and $I_3$ are smaller by almost a factor $h$, though the proofs take all their
# trouble with $I_3$: contact costs nothing in the limit, and this is why no rate below 1 is seen.
# The sets that make the difference between the four theorems, $\Gamma_{1h}^0$ and
# $\Gamma_{1h}^-$, contribute least of all. Terms below $10^{-7}$ of the error are left out: they
# are the solver's and the quadrature's.


# %%
def values(rows, term):
    """One term on all levels."""
    return np.array([getattr(estimate, term) for _, estimate in rows])


sizes, rates = {}, {}
for (name, family), rows in found.items():
    h = np.array([h for h, _ in rows])
    floor = 1e-7 * values(rows, "error")
    size, order = {"h": ("{:.5f}", h)}, {"h": ("{:.5f}", h)}
    for term, heading in terms.items():
        value = np.where(abs(values(rows, term)) > floor, values(rows, term), np.nan)
        size[heading] = ("{:.2e}", value)
        order[heading] = ("{:.2f}", np.append(np.nan, norms.rates(h, abs(value))))
    balance = values(rows, "best") + values(rows, "interior") + values(rows, "dirichlet")
    balance += values(rows, "contact") - values(rows, "slack") - values(rows, "error")
    size["imbalance"] = ("{:.0e}", abs(balance) / values(rows, "error"))
    sizes[f"{name} on the {family} meshes: the terms"] = size
    rates[f"{name} on the {family} meshes: their orders"] = order
for caption, table in (*sizes.items(), *rates.items()):
    study.table(caption, table)


# %% [markdown]
# ## Picture


# %%
labels = {
    "error": r"$\|u-u_h\|_h^2$",
    "best": r"$\|u-\Pi_h u\|_h^2$",
    "interior": r"$|I_1|$, interior",
    "dirichlet": r"$|I_2|$, $\Gamma_0$",
    "contact_bound": r"$|I_3|$ on $\Gamma_{1h}^0$",
    "contact_mixed": r"$|I_3|$ on $\Gamma_{1h}^-$",
}


def draw(*panels):
    """The terms of all four cases."""
    for axes, ((name, family), rows) in zip(panels, found.items(), strict=True):
        h = np.array([h for h, _ in rows])
        curves = {}
        for term, label in labels.items():
            y = abs(values(rows, term))
            visible = y > 1e-7 * values(rows, "error")
            if visible.sum() > 2:
                curves[label] = (h[visible], y[visible])
        loglog(axes, curves, {2.0: "$h^2$", 3.0: "$h^3$"}, y="term", below=0.3,
               title=f"{name}, {family}: contact falls faster")  # fmt: skip


study.picture(
    "estimate.png",
    "Every term of (1.11): best approximation and interior consistency make up the error, the "
    "contact terms are of higher order.",
    draw,
    panels=4,
    columns=2,
    size=(5.4, 4.2),
)

# %% [markdown]
# ## Check
# The terms add up, and $I_3$ is of higher order than the error.

# %%
for (name, family), rows in found.items():
    h, estimate = rows[-1]
    lost = estimate.right_side - estimate.slack - estimate.error
    assert abs(lost) < 1e-4 * estimate.error or (name, levels) < ("I", 6), (name, lost)
    assert estimate.error <= estimate.right_side * (1 + 1e-4) or name == "I", name
    assert abs(estimate.contact) < 0.02 * estimate.error, (name, estimate.contact)
study.finish()
