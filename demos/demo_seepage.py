# %% [markdown]
# # Where a river bank seeps
#
# **Aim.** Ground water goes through sand under a cover of clay to the bank of a river. Know how
# much leaves the bank, as an interval that is certain, and from which height down it does.
#
# **Mathematics.** In the sand the hydraulic head $u$ satisfies $-\nabla\cdot(\kappa\nabla u) = 0$.
# On the bank the water is in the air: its pressure, $u - y$ metres of water, can't be above that
# of the air, and where it is below nothing leaves:
#
# $$u \le y, \qquad \lambda = \kappa\,\partial_\nu u \le 0, \qquad \lambda\,(u - y) = 0.$$
#
# Where the one ends and the other begins is unknown: the exit point.
#
# Run it alone or on several ranks; the pictures go to `demo-output` or to the folder named:
#
#     mpirun -n 2 python3 demos/demo_seepage.py [FOLDER]

# %%
from dataclasses import replace
from pathlib import Path

import numpy as np
from study import ENDS, Study, canvas, levels_wanted, name_curves

from signorini_cr import Dirichlet, force, solve_levels
from signorini_cr.app.problemfile import load

study = Study("demo_seepage", "Where a river bank seeps")
CONDUCTIVITY, THICKNESS, LENGTH = 2.0, 10.0, 30.0  # m/d, m, m
case = load(Path(__file__).parent.parent / "meshes" / "seepage.toml")

# %% [markdown]
# ## The closed form
# With $D$ the thickness, $t = \cos(\pi(y + i(L - x))/D)$ takes a layer without end to the plane cut
# along $(a, 1)$, on which $u = \frac{D}{\pi}\arccos t$, where $a = \cos(\pi e/D)$ is the exit
# point's image. The flux that leaves the cut solves an airfoil equation. As it is bounded at $a$,
#
# $$\frac{Q}{\kappa} = \frac{D}{\pi}\int_a^1 \frac{ds}{\sqrt{(s - a)(1 + s)}},
# \qquad\text{that is}\qquad \cos\frac{\pi e}{2D}\,\cosh\frac{\pi Q}{2\kappa D} = 1,$$
#
# and the head at the distance $L$ is, but for $e^{-2\pi L/D}$,
#
# $$H = \frac{QL}{\kappa D} - \frac{2Q}{\pi\kappa}\ln\sin\frac{\pi e}{2D}
# + \frac{D}{\pi^2}\int_a^1 \frac{\arccos s\,ds}{\sqrt{(s - a)(1 - s)}}.$$


# %%
def discharge(exit_height):
    """Q of the closed form."""
    angle = 0.5 * np.pi * np.asarray(exit_height) / THICKNESS
    return CONDUCTIVITY * 2.0 * THICKNESS / np.pi * np.arccosh(1.0 / np.cos(angle))


def head(exit_height):
    """H of the closed form; the mean of arccos by Gauss and Chebyshev's rule."""
    angle = 0.5 * np.pi * np.asarray(exit_height) / THICKNESS
    nodes = np.cos(np.pi * (np.arange(4000) + 0.5) / 4000)
    points = 1.0 - np.sin(angle)[..., None] ** 2 * (1.0 - nodes)
    flow = discharge(exit_height) / CONDUCTIVITY
    mean = np.arccos(points).mean(axis=-1) * THICKNESS / np.pi
    return flow * LENGTH / THICKNESS - 2.0 * flow / np.pi * np.log(np.sin(angle)) + mean


def exit_height(wanted):
    """The height at which H is as wanted."""
    low, high = 1e-6, THICKNESS * (1.0 - 1e-6)
    for _ in range(60):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if head(middle) < wanted else (low, middle)
    return middle


# %% [markdown]
# ## The bank
# The head is 12 m at a distance of 30 m.

# %%
found = []
for solution in solve_levels(case.problem, case.mesh(), levels_wanted(6)):
    inflow, outflow = force.flux(solution, "hills"), -solution.contact.force
    found.append((solution.cells, *inflow, outflow, solution.contact.transitions[0, 1]))
cells, values, lower, upper, outflow, exits = map(np.array, zip(*found, strict=True))
exact = discharge(exit_height(12.0))
lower, upper = study.intervals(
    "The discharge, in m² a day, and the exit point's height, in m.",
    "discharge",
    (cells, values, lower, upper),
    3,
    {"exit": ("{:.2f}", exits)},
)
study.tell(f"closed form: {exact:.6f} m² a day, exit at {exit_height(12.0):.4f} m")
assert np.all(lower <= exact) and np.all(exact <= upper)
assert np.all(np.diff(upper - lower) < 0.0)
assert np.abs(outflow - values).max() < 1e-6 * exact
assert abs(values[-1] - exact) < 1e-3 * solution.h * exact
assert abs(exits[-1] - exit_height(12.0)) < solution.h


# %%
def draw_bank(field, beside, table):
    """Draw what leaves the bank at which height."""
    field.set_ylabel("height above the river in m", fontsize=13)
    order = np.argsort(table["y"])
    y, flow = table["y"][order], -table["pressure"][order]
    beside.fill_betweenx(y, flow, color=canvas.BLUE, alpha=0.35, step="mid")
    beside.plot(flow, y, color=canvas.BLUE)
    beside.axhline(exit_height(12.0), color=canvas.RED, linestyle="--")
    beside.text(
        flow.max(), exit_height(12.0) + 0.15, "exit point", color=canvas.RED, fontsize=13,
        horizontalalignment="right",
    )  # fmt: skip
    beside.tick_params(labelleft=True)
    beside.set_ylabel("height in m", fontsize=13)
    beside.set_xlabel("leaves the bank, in m/d", fontsize=13)
    beside.set_xlim(0.0)
    beside.grid(alpha=0.3)


study.field(
    "seepage.png",
    "The head in the sand, and what leaves the bank below the exit point.",
    solution,
    draw_bank,
    units=case.units,
    title=f"{values[-1]:.2f} m³ a day leave each metre of the bank, all of it below 3 m",
    size=(13.0, 4.8),
    words={"no contact": "stays dry", "contact": "seeps", ENDS: "exit point"},
    ncols=2,
    sharey=True,
    width_ratios=(3.4, 1.0),
)

# %% [markdown]
# ## Wet years and dry ones
# The exit point rises with the head in the hills.

# %%
heads = np.array([10.5, 12.0, 15.0, 20.0, 30.0])
rows = []
for wanted in heads:
    conditions = dict(case.problem.conditions) | {"hills": Dirichlet(wanted)}
    *_, solution = solve_levels(
        replace(case.problem, conditions=conditions), case.mesh(), levels_wanted(4)
    )
    rows.append((-solution.contact.force, solution.contact.transitions[0, 1]))
flows, heights = np.array(rows).T
expected = np.array([exit_height(wanted) for wanted in heads])
study.table(
    "Discharge and exit point at different heads, and those of the closed form.",
    {
        "head": ("{:.1f}", heads),
        "discharge": ("{:.4f}", flows),
        "closed form": ("{:.4f}", discharge(expected)),
        "exit": ("{:.2f}", heights),
        "closed form's": ("{:.2f}", expected),
    },
)
assert np.abs(heights - expected).max() < solution.h
assert np.abs(flows / discharge(expected) - 1.0).max() < 1e-3 * solution.h

# %% [markdown]
# ## Check: Dupuit's discharge
# The mean head over the thickness is linear in $x$, whatever happens on the bank, and there it is
# at most $D/2$: so $Q \ge \kappa\,(HD - D^2/2)/L$. For $H = D$ that is Dupuit's formula for a dam
# without water behind it. The difference is what is missing where the bank is dry.


# %%
def draw(axes):
    """Draw what leaves at which head."""
    fine = np.linspace(0.4, 9.4, 200)
    dupuit = CONDUCTIVITY * (heads * THICKNESS - THICKNESS**2 / 2) / LENGTH
    axes.plot(head(fine), discharge(fine), color=canvas.BLUE)
    axes.plot(heads, flows, "o", color=canvas.BLUE, markersize=8)
    axes.plot(heads, dupuit, "--", color=canvas.RED)
    axes.set_xlim(heads[0] - 1.0, heads[-1] + 1.0)
    axes.set_ylim(0.0, 1.1 * flows[-1])
    axes.set_xlabel("head in the hills, in m", fontsize=13)
    axes.set_ylabel("discharge in m² a day", fontsize=13)
    axes.set_title("More leaves than if all of the bank were wet", fontsize=14)
    axes.grid(alpha=0.3)
    wet = {"found (dots),\nclosed form (line)": (heads, flows), "Dupuit: all wet": (heads, dupuit)}
    name_curves(axes, wet, [canvas.BLUE, canvas.RED])


study.picture("seepage-heads.png", "What leaves the bank at which head.", draw, size=(8.0, 4.5))
assert np.all(flows > CONDUCTIVITY * (heads * THICKNESS - THICKNESS**2 / 2) / LENGTH)
study.finish()
