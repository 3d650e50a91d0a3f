# %% [markdown]
# # The facet sets (2.2) and the discrete active set
#
# **Aim.** Count the contact facets of each kind that the proofs tell apart, and those where the
# discrete solution is mistaken about contact.
#
# **Mathematics.** The facets on $\Gamma_1$ fall into three sets (2.2): $\Gamma_{1h}^0$, on which
# $u = 0$; $\Gamma_{1h}^+$, on which $u > 0$; and $\Gamma_{1h}^-$, on which there is both. The
# proofs treat $\Gamma_{1h}^-$ one facet at a time: with finitely many critical points it has a
# bounded number of members. The discrete solution knows none of this, only its active set: the
# facets with $u_h(m_F) = 0$ and pressure. A facet is misjudged if it lies in $\Gamma_{1h}^0$ and is
# not active, or in $\Gamma_{1h}^+$ and is.
#
#     mpirun -n 2 python3 demos/demo_facet_sets.py [FOLDER]

# %%
import numpy as np
from study import COLOURS, MARKERS, Study, called, levels_wanted, name_curves, run

study = Study("demo_facet_sets", "The facet sets (2.2) against the discrete active set")
levels = levels_wanted(8)
cases = [
    ("S1", "structured"),
    ("S1", "mapped"),
    ("A", "structured"),
    ("A", "mapped"),
    ("C2", "mapped"),
    ("I", "structured"),
]

# %% [markdown]
# ## Solve and judge

# %%
judged = {
    (name, family): [(row.h, row.judgement) for row in run(name, family=family, levels=levels)]
    for name, family in cases
}

# %% [markdown]
# ## Tables
# S1's pressure rises steeply, like $\sqrt{|x|}$: no facet is misjudged. A's fades like $|x|^3$:
# near the critical point neither $u$ nor $\lambda$ is large enough to tell, and a few facets go
# wrong. Mistakes do not cost accuracy, since they are made where pressure and gap are tiny.

# %%
for (name, family), rows in judged.items():
    study.table(
        f"{called(name)} on the {family} meshes: number of facets",
        {
            "h": ("{:.5f}", [h for h, _ in rows]),
            "Γ1h⁰": ("{}", [j.bound for _, j in rows]),
            "Γ1h⁻": ("{}", [j.mixed for _, j in rows]),
            "Γ1h⁺": ("{}", [j.free for _, j in rows]),
            "active": ("{}", [j.active for _, j in rows]),
            "in Γ1h⁰, not active": ("{}", [j.missed for _, j in rows]),
            "in Γ1h⁺, active": ("{}", [j.extra for _, j in rows]),
            "misjudged": ("{}", [j.misjudged for _, j in rows]),
        },
    )


# %% [markdown]
# ## Picture
# The length of $\Gamma_1$ that is misjudged falls, as does that of the facets in $\Gamma_{1h}^-$.


# %%
def draw(left, right):
    """Shares of the facets misjudged, and of those in Γ1h⁻."""
    for axes, what, title in (
        (left, lambda j: j.misjudged, "Few facets are misjudged, none of S1"),
        (right, lambda j: j.mixed, r"Few facets are in $\Gamma_{1h}^-$, fewer the finer the mesh"),
    ):
        alike = {}  # one line, one label
        for (name, family), rows in judged.items():
            share = tuple(what(j) / (j.bound + j.mixed + j.free) for _, j in rows)
            alike.setdefault(share, []).append((name, family))
        curves, colours = {}, []
        for share, keys in alike.items():
            k = cases.index(keys[0])  # above and below the same
            h = [h for h, _ in judged[keys[0]]]
            label = ";\n".join(
                f"{', '.join(called(name) for name, each in keys if each == family)}, {family}"
                for family in dict.fromkeys(family for _, family in keys)
            )
            curves[label] = h, share
            colours.append(COLOURS[k])
            style = "--" if {family for _, family in keys} == {"mapped"} else "-"
            axes.plot(h, share, style, color=COLOURS[k], marker=MARKERS[k], linewidth=1.8)
        axes.set_xscale("log")
        axes.set_yscale("symlog", linthresh=1e-3, linscale=0.4)
        axes.set_ylim(-2e-4, 1)
        axes.set_title(title, fontsize=14)
        axes.set_xlabel("$h$", fontsize=14)
        axes.set_ylabel("share of the facets on $\\Gamma_1$", fontsize=13)
        axes.grid(alpha=0.3)
        name_curves(axes, curves, colours)


study.picture(
    "facet-sets.png",
    "Shares of the contact facets that are misjudged (above) and that hold critical points; where "
    "several examples have the same, one line stands for all of them, in the colour of the first.",
    draw,
    panels=2,
)

# %% [markdown]
# ## Check
# On S1 nothing is misjudged, and with one critical point there is at most one facet in
# $\Gamma_{1h}^-$. Everywhere the misjudged share shrinks.

# %%
assert all(j.misjudged == 0 for key in judged for _, j in judged[key] if key[0] == "S1")
assert all(j.mixed <= 1 for (name, _), rows in judged.items() if name != "I" for _, j in rows)
for key, rows in judged.items():
    share = np.array([j.misjudged / (j.bound + j.mixed + j.free) for _, j in rows])
    assert share[-1] <= max(share.max() / 2, 1e-12) or levels < 6, (key, share)
study.finish()
