# %% [markdown]
# # Theorem 3.4: infinitely many critical points
#
# **Aim.** See the full rate on a solution in whose contact zone there is no order at all.
#
# **Mathematics.** If $u \in W^{2,p}(\Omega)$ with $p > 2$, then whatever the critical points
#
# $$\|u-u_h\|_h \le C h \|u\|_{2,p,\Omega}. \tag{3.4}$$
#
# Two functions $a, b \ge 0$ with $ab = 0$ make an exact solution
# $u = (a(x) - y\,b(x))\,\varphi(x, y)$: on $y = 0$ it is $a\varphi$, and its normal derivative is
# $b\varphi$. Example I takes $a = x^6 \max(0, \sin\frac{\pi}{x})^3$ and
# $b = x^6 \max(0, -\sin\frac{\pi}{x})^3$ for $x > 0$: contact begins and ends at
# $x = 1, \frac12, \frac13, \dots$, infinitely often near the origin. Theorems 3.2 and 3.3 say
# nothing, Theorem 3.4 does, as the second derivatives are bounded.
#
#     mpirun -n 2 python3 demos/demo_theorem_34.py [FOLDER]

# %%
import numpy as np
import ufl
from study import Study, canvas, column, levels_wanted, loglog, orders, run

from signorini_cr import exact, solve, theory

study = Study("demo_theorem_34", "Theorem 3.4: infinitely many critical points")
levels = levels_wanted(8, least=5)

# %% [markdown]
# ## A second one, made here
# One call makes a solution of one's own, loads and boundary values included. This one has
# an interval of contact and a gap in every octave $2^{-k} < x < 2^{1-k}$.


# %%
def wave(sign):
    """The positive or the negative part of sin(2π log₂ x), cubed and faded out towards 0."""

    def function(t):
        inside = ufl.conditional(ufl.gt(t, 1e-9), t, 1.0)
        part = exact.positive(sign * ufl.sin(2 * np.pi * ufl.ln(inside) / np.log(2.0)))
        return ufl.conditional(ufl.gt(t, 1e-9), t**3 * part**3, 0.0)

    return function


pair = exact.from_pair(wave(1), wave(-1), name="octaves", quadrature_degree=10)
exact.ALL["octaves"] = pair

# %% [markdown]
# ## Solve

# %%
results = {name: run(name, levels=levels) for name in ("I", "octaves")}
h = column(results["I"], "h")

# %% [markdown]
# ## Tables

# %%
for name, rows in results.items():
    study.table(
        f"{name}: errors and rates",
        {
            "h": ("{:.5f}", h),
            "dofs": ("{}", [row.dofs for row in rows]),
            "H1 error": ("{:.3e}", column(rows, "h1")),
            "H1 rate": ("{:.3f}", orders(rows, "h1")),
            "L2 error": ("{:.3e}", column(rows, "l2")),
            "L2 rate": ("{:.3f}", orders(rows, "l2")),
            "active": ("{}", [row.active for row in rows]),
            "of facets": ("{}", [row.facets for row in rows]),
            "Newton": ("{}", [row.newton for row in rows]),
        },
    )


# %% [markdown]
# ## Pictures
# The first one shows the errors, the second gap and pressure of I near the origin, on a mesh whose
# facets are too long for the innermost intervals: there every facet lies in $\Gamma_{1h}^-$.


# %%
def draw(axes):
    """Errors of both solutions."""
    curves = {}
    for name, rows in results.items():
        where = {"I": "I, ends at $1/k$", "octaves": "ends in every octave"}[name]
        curves[f"{where}:\n$\\|u-u_h\\|_h$"] = (h, column(rows, "h1"))
        curves[f"{where}:\n$\\|u-u_h\\|$"] = (h, column(rows, "l2"))
    dashed = [label for label in curves if "octave" in label]
    loglog(axes, curves, {1.0: "$h$", 2.0: "$h^2$"},
           title="Contact ends infinitely often, and the rates are full",
           dashed=dashed)  # fmt: skip


study.picture(
    "theorem-34.png",
    "Infinitely many critical points: the rates of Theorem 3.4 hold where 3.2 and 3.3 are silent.",
    draw,
)

n = min(256, 4 * 2 ** (levels - 1))
solution = solve(exact.I.problem, exact.I.structured(n))
table = solution.contact.table()
judgement = theory.judge(solution, exact.I)


TOP = 2.0


def draw_contact(upper, lower):
    """Exact and discrete gap and pressure on 0 < x < 1, scaled by the power that fades them."""
    x = np.linspace(1e-3, 1.0, 20_001)
    fade = (1 - x**2) * np.sin(np.pi / x) ** 3
    near = table["x"] > 0
    middle = table["x"][near]
    for axes, sign, name, what, colour, label, peak in (
        (upper, 1, "u", "gap", canvas.BLUE, "u", 0.4),
        (lower, -1, "pressure", "pressure", canvas.RED, r"\lambda", 0.66),
    ):
        axes.plot(x, np.maximum(0, sign * fade), color="black", linewidth=0.8)
        seen = middle > 0.06
        values = table[name][near][seen] / middle[seen] ** 6
        inside = values <= TOP
        axes.plot(middle[seen][inside], values[inside], "o", color=colour, markersize=4)
        axes.text(peak, 1.2, f"dots: ${label}_h/x^6$", color=colour, fontsize=13, ha="center")
        axes.text(peak, 1.0, f"line: ${label}/x^6$", fontsize=13, ha="center")
        if not inside.all():
            axes.plot(middle[seen][~inside], np.full((~inside).sum(), TOP), "^", color=colour,
                      markersize=6)  # fmt: skip
            axes.annotate(f"above {TOP:g}", (middle[seen][~inside][-1], TOP), (8, 0), va="center",
                          textcoords="offset points", color=colour, fontsize=13)  # fmt: skip
        axes.set_xlim(0.06, 1)
        axes.set_ylim(-0.15, TOP + 0.15)
        axes.set_ylabel(f"{what} over $x^6$", fontsize=13)
        axes.set_xscale("log")
        ticks = [1 / k for k in (1, 2, 3, 4, 6, 8, 12)]
        axes.set_xticks(ticks, ["1", *(f"1/{round(1 / tick)}" for tick in ticks[1:])])
        axes.set_xticks([], minor=True)
        axes.set_xlabel("$x$", fontsize=14)
        axes.grid(alpha=0.3)
    upper.set_title("Example I: the gap is found wherever a few facets fit into it", fontsize=14)
    lower.set_title("Example I: the pressure between the gaps needs more facets", fontsize=14)


study.picture(
    "theorem-34-contact.png",
    f"Example I on {2 * n} facets: contact begins and ends at x = 1/k; both u and λ are divided by "
    "the factor x⁶.",
    draw_contact,
    panels=2,
    size=(8.5, 3.6),
)
study.say(
    f"With {2 * n} facets on Γ1, {judgement.mixed} of them hold critical points (Γ1h⁻), and the "
    f"discrete active set misjudges {judgement.misjudged} of the others."
)

# %% [markdown]
# ## Check
# The rates are 1, and 2 in $L^2$.

# %%
tolerance = (0.03, 0.1) if levels >= 7 else (0.15, 0.6)
for name, rows in results.items():
    assert np.all(abs(orders(rows, "h1")[-2:] - 1.0) < tolerance[0]), (name, orders(rows, "h1"))
    assert np.all(abs(orders(rows, "l2")[-2:] - 2.0) < tolerance[1]), (name, orders(rows, "l2"))
study.finish()
