# %% [markdown]
# # Theorem 3.1: at least $h^{3/4}$
#
# **Aim.** See how far the errors stay below the floor that $u \in H^2(\Omega)$ alone guarantees.
#
# **Mathematics.** Theorem 3.1 bounds the error in the broken norm (1.6) for every $u \in H^2$:
#
# $$\|u - u_h\|_h \le C h^{3/4} \|u\|_{2,\Omega}. \tag{3.1}$$
#
# It is a floor, not a prediction: the exponent comes from two of the terms into which the proof
# splits the error, (2.7) and (4.8), and later work proves $O(h)$ for this element under
# $u \in H^2$ alone (Li, Hua and Lian 2021; Bartels, Gudi and Kaltenbach 2024). So all the examples
# converge faster, as they must: $\|u-u_h\|_h / h^{3/4}$ tends to 0 like $h^{1/4}$. That does not
# contradict (3.1), it is better than (3.1) asks for.
#
#     mpirun -n 2 python3 demos/demo_theorem_31.py [FOLDER]

# %%
import numpy as np
from study import Study, called, column, levels_wanted, loglog, orders, run

study = Study("demo_theorem_31", "Theorem 3.1: a rate of at least 3/4 for u in H²")
levels = levels_wanted(8)
names = ("S1", "A", "B", "C", "C2", "I")

# %% [markdown]
# ## Solve
# Six solutions in $H^2$ on squares cut in two, from 4 to 512 squares per unit length.

# %%
results = {called(name): run(name, levels=levels) for name in names}
h = column(results["S1"], "h")
scaled = {name: column(rows, "h1") / h**0.75 for name, rows in results.items()}

# %% [markdown]
# ## Tables

# %%
study.table(
    "‖u − u_h‖_h (broken norm)",
    {"h": ("{:.5f}", h), "dofs": ("{}", [row.dofs for row in results["S1"]])}
    | {name: ("{:.3e}", column(rows, "h1")) for name, rows in results.items()},
)
study.table(
    "Rates of the broken norm",
    {"h": ("{:.5f}", h)} | {name: ("{:.3f}", orders(rows, "h1")) for name, rows in results.items()},
)
study.table(
    "Rates in L2",
    {"h": ("{:.5f}", h)} | {name: ("{:.3f}", orders(rows, "l2")) for name, rows in results.items()},
)
study.table(
    "$‖u − u_h‖_h / h^{3/4}$: bounded, as (3.1) says, and falling",
    {"h": ("{:.5f}", h)} | {name: ("{:.4f}", values) for name, values in scaled.items()},
)


# %% [markdown]
# ## Picture
# Above the errors, between lines of the slopes $3/4$ and $1$. Below the errors over $h^{3/4}$.


# %%
def draw(left, right):
    """Errors on the left, errors over h^{3/4} on the right."""
    top = max(values[0] for values in scaled.values()) * 1.6 * h**0.75
    left.plot(h, top, color="black", linewidth=1.2)
    left.annotate("$h^{3/4}$", (h[-3], top[-3]), xytext=(0, 8), ha="right",
                  textcoords="offset points", fontsize=13)  # fmt: skip
    curves = {name: (h, column(rows, "h1")) for name, rows in results.items()}
    loglog(
        left,
        curves,
        {1.0: "$h$"},
        title="All errors fall faster than $h^{3/4}$",
        y=r"$\|u-u_h\|_h$",
    )
    curves = {name: (h, values) for name, values in scaled.items()}
    loglog(right, curves, {0.25: "$h^{1/4}$"}, title="With $h^{3/4}$ taken out they still fall",
           y=r"$\|u-u_h\|_h\, /\, h^{3/4}$")  # fmt: skip


study.picture(
    "theorem-31.png",
    "Errors of six solutions in H² stay below the floor of Theorem 3.1 and leave it behind.",
    draw,
    panels=2,
)

# %% [markdown]
# ## Check
# The quotient falls on every solution; from six meshes on the last two rates are 1, and 2 in L2.

# %%
fall = {name: values[-1] / values[-2] for name, values in scaled.items()}
assert all(value < 1.0 for value in fall.values()), fall
if levels >= 6:
    for name, rows in results.items():
        assert np.all(abs(orders(rows, "h1")[-2:] - 1.0) < 0.03), name
        assert np.all(abs(orders(rows, "l2")[-2:] - 2.0) < 0.10), name
study.finish()
