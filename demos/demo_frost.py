# %% [markdown]
# # A bridge deck kept free of frost
#
# **Aim.** Know what heat the surface of a bridge deck needs, and where, so that no point of it is
# below 0 °C: on a cold day that does not end, as an interval that is certain, and through a night.
#
# **Mathematics.** In the deck the temperature $u$ satisfies
# $c\,\partial_t u - \nabla\cdot(\kappa\nabla u) = 0$ with $\kappa$ that of concrete or asphalt;
# from all of its boundary heat goes to air of the temperature $e$, and on the surface
#
# $$u \ge 0, \qquad \lambda = \kappa\,\partial_\nu u + b\,(u - e) \ge 0, \qquad \lambda u = 0,$$
#
# where $\lambda$, in W/m², is the heat that must be added there. Of all ways to hold the surface
# at 0 °C or above it takes the least: none is added where the surface is warm already.
#
# Run it alone or on several ranks; the pictures go to `demo-output` or to the folder named:
#
#     mpirun -n 2 python3 demos/demo_frost.py [FOLDER]

# %%
from dataclasses import replace
from pathlib import Path

import numpy as np
import ufl
from study import ENDS, Study, canvas, levels_wanted

# isort: split
from dolfinx import fem  # behind study, which finds MPI for the wheels

from signorini_cr import (
    Contact,
    Material,
    Neumann,
    Polygon,
    Problem,
    Robin,
    force,
    solve,
    solve_in_time,
)
from signorini_cr.app.problemfile import load
from signorini_cr.output.strip import chosen, moment
from signorini_cr.rounding import interval

study = Study("demo_frost", "A bridge deck kept free of frost")
MESHES = Path(__file__).parent.parent / "meshes"
BELOW, ABOVE = 8.0, 20.0  # W/(m² K), lost to the air
LAYERS = ((0.24, 1.6), (0.06, 0.75))  # m and W/(m K), concrete and asphalt, from below
CAPACITY = 583.3  # W h/(m³ K)

# %% [markdown]
# ## A cold day
# Air of −5 °C above and below, warm air in two ducts; the interval holds the heat itself, not only
# that of a mesh. The meshes are those that the problem file asks for.

# %%
case = load(MESHES / "deck.toml")
case = replace(case, levels=levels_wanted(case.levels))
found = []
for solution in case.solutions(case.mesh()):
    found.append((solution.cells, *force.flux(solution, "surface")))
cells, values, lower, upper = map(np.array, zip(*found, strict=True))
lower, upper = study.intervals(
    "The heat that the surface needs, in W a metre of the bridge.",
    "heat",
    (cells, values, lower, upper),
    2,
)


def draw(field, below, table):
    """The heat along the surface."""
    field.set_xlabel("")
    order = np.argsort(table["x"])
    length, heat = (np.asarray(table[name])[order] for name in ("length", "pressure"))
    ends = np.append(0.0, np.cumsum(length))
    below.stairs(heat, ends, color=canvas.RED, alpha=0.35, fill=True)
    below.stairs(heat, ends, color=canvas.RED, linewidth=1.8)
    below.set_xlabel("$x$ in m", fontsize=13)
    below.set_ylabel("heat needed in W/m²", fontsize=13)
    below.set_ylim(0.0)
    below.grid(alpha=0.3)


least, most = interval(lower[-1], upper[-1]).strip("[]").split(", ")
study.field(
    "frost.png",
    "Temperature, and the heat that the surface needs: none above the ducts.",
    solution,
    draw,
    units=case.units,
    title=f"Free of frost with {least} to {most} W a metre, none above the ducts",
    size=(11.0, 7.0),
    words={"contact": "heated", "no contact": "not heated", ENDS: "heating begins or ends"},
    nrows=2,
    sharex=True,
    height_ratios=(1.2, 1.0),
)

# %% [markdown]
# ## A night
# The air cools from −2 °C to −7 °C and warms again, the deck begins at 6 °C.

# %%
night = load(MESHES / "night.toml")
steps, moments = [], []
for time, solution in night.steps(night.mesh(), levels_wanted(3)):
    steps.append((time, solution.contact.force, solution.contact.length))
    if len(steps) in chosen(night.time.steps):
        moments.append(moment(time, solution))
study.strip(
    "frost-night.png",
    "Through a night: where heat is needed, and when.",
    moments,
    units=night.units,
    title="Above the ducts heating begins last and ends first",
    words={
        r"of $\Gamma_1$ in contact": "of the surface heated",
        "no contact": "not heated",
        "contact": "heated",
    },
)
times, heats, lengths = map(np.array, zip(*steps, strict=True))
energy = np.trapezoid(heats, times) / 1000
study.tell(
    f"first at {times[np.argmax(heats > 0)]} h; most at {times[np.argmax(heats)]} h, "
    f"{heats.max():.0f} W/m; in all {energy:.2f} kWh/m"
)

# %% [markdown]
# ## Check: layers one after the other
# Without ducts, and far from the ends, nothing depends on $x$: to the air below heat goes through
# resistances in series, $R = 1/8 + 0.24/1.6 + 0.06/0.75$ m² K/W.

# %%
WIDTH = 0.3
height = sum(d for d, _ in LAYERS)
asphalt = [[0, LAYERS[0][0]], [WIDTH, LAYERS[0][0]], [WIDTH, height], [0, height]]
column = Polygon(
    [[0, 0], [WIDTH, 0], [WIDTH, height], [0, height]],
    ["air", "end", "surface", "end"],
    names=("air", "end", "surface"),
    materials={"asphalt": asphalt},
).mesh(0.1)


def deck(outside):
    """The column under air of this temperature."""
    return Problem(
        coefficient=LAYERS[0][1],
        materials={"asphalt": Material(coefficient=LAYERS[1][1])},
        conditions={
            "air": Robin(coefficient=BELOW, external=outside),
            "surface": Contact(0.0, coefficient=ABOVE, external=outside),
            "end": Neumann(),
        },
    )


resistance = 1 / BELOW + sum(d / k for d, k in LAYERS)
expected = 5.0 * (ABOVE + 1 / resistance)
value, low, high = np.array(force.flux(solve(deck(-5.0), column), "surface")) / WIDTH
study.tell(f"layers: {expected:.6f} W/m²; found {value:.6f}, in {interval(low, high)}")
assert abs(value - expected) < 1e-6 * expected
assert low - 1e-6 * expected <= expected <= high + 1e-6 * expected
# ducts can only take from it
assert np.all(lower < 4.0 * expected)
assert np.all(lower < values) and np.all(values < upper)
assert lower.max() < upper.min() and np.all(np.diff(upper - lower) < 0.0)

# %% [markdown]
# ## Check: nights without end
# Under air of $-10 - 5\sin\omega t$ °C, $\omega$ that of a day, the surface stays at 0 °C, and the
# heat becomes periodic: $u$ is a mean and the real part of $\hat u(y)e^{i\omega t}$, and
# $(\hat u, \kappa\hat u')$ goes through a layer by the matrix with $\cosh qd$, $\sinh qd$,
# $q^2 = i\omega c/\kappa$.

# %%
omega, through = 2 * np.pi / 24, np.eye(2, dtype=complex)
for d, k in LAYERS:
    q = np.sqrt(1j * omega * CAPACITY / k)
    layer = [[np.cosh(q * d), np.sinh(q * d) / (k * q)], [k * q * np.sinh(q * d), np.cosh(q * d)]]
    through = np.array(layer) @ through
wave = 5j  # −5 sin ωt = Re 5i e^{iωt}
start = through[0, 1] * BELOW * wave / (through[0, 0] + through[0, 1] * BELOW)
flow = through[1] @ [start, BELOW * (start - wave)]
clock = fem.Constant(column.mesh, 0.0)
steps = [
    (time, solution.contact.force / WIDTH)
    for time, solution in solve_in_time(
        deck(-10.0 - 5.0 * ufl.sin(omega * clock)), column, end=72.0, steps=144, scheme="bdf2",
        capacity=CAPACITY, levels=2, time=clock,
    )
]  # fmt: skip
times, heats = np.array(steps[-48:]).T
exact = 10.0 * (ABOVE + 1 / resistance) + ((flow - ABOVE * wave) * np.exp(1j * omega * times)).real
error = np.abs(heats - exact).max()
study.tell(
    f"the third day: {exact.min():.1f} to {exact.max():.1f} W/m², off by {error:.2f} at most"
)
assert error < 0.005 * np.ptp(exact)
study.finish()
